//! A volume that changes with time: frames in files, linear in between.

use crate::error::{Error, Result};
use crate::files;
use crate::volume::statistics::VolumeStatistics;
use crate::volume::vti::escape;
use crate::volume::{Samples, Volume};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Frames at rising times, two or more.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    times: Vec<f64>,
    files: Vec<PathBuf>,
}

impl Series {
    /// Frames in `files` at `times`, by default 0, 1, 2 …
    ///
    /// # Errors
    /// `Invalid` for fewer than two files, or times that do not rise or are not as many.
    pub fn new(files: Vec<PathBuf>, times: Option<Vec<f64>>) -> Result<Self> {
        let times = times.unwrap_or_else(|| (0..files.len()).map(|n| n as f64).collect());
        let fail = |what: String| Err(Error::Invalid(what));
        if files.len() < 2 {
            return fail(format!("a series of {} file(s) needs two or more", files.len()));
        }
        if times.len() != files.len() {
            return fail(format!("times: {} for {} files; give one each", times.len(), files.len()));
        }
        if !times.iter().all(|t| t.is_finite()) || times.windows(2).any(|w| w[0] >= w[1]) {
            return fail(format!("times {times:?}: each must be later than the one before"));
        }
        Ok(Self { times, files })
    }

    /// The files that `pattern` stands for, such as `rho_%04d.vti`: `%d` is any number, `%04d` one of four digits or
    /// more. Times are their numbers unless given. `None` if the name holds no `%d`.
    ///
    /// # Errors
    /// `Io` if the folder cannot be read, else as [`Series::new`].
    pub fn find(pattern: &Path, times: Option<Vec<f64>>) -> Result<Option<Self>> {
        if !is_pattern(pattern) {
            return Ok(None);
        }
        let folder = match pattern.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        let mut found: Vec<(u64, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
            let entry = entry.map_err(|e| Error::io(folder, e))?;
            let file = entry.file_name();
            if let Some(number) = number(pattern, Path::new(&file)) {
                found.push((number, pattern.with_file_name(file)));
            }
        }
        if found.is_empty() {
            return Err(Error::invalid(pattern, "no file has such a name; a series needs two or more"));
        }
        found.sort();
        let numbers = found.iter().map(|f| f.0 as f64).collect();
        Self::new(found.into_iter().map(|f| f.1).collect(), Some(times.unwrap_or(numbers)))
            .map(Some)
            .map_err(|e| Error::invalid(pattern, e))
    }

    /// When the frames are.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// The volume at `time`: a frame as it is, or the blend of its two neighbours in f64.
    ///
    /// # Errors
    /// `Invalid` outside the series' times, or for neighbours on different lattices; what `read` meets.
    pub fn at(&self, time: f64, read: impl Fn(&Path) -> Result<Volume>) -> Result<Volume> {
        let (first, last) = (self.times[0], self.times[self.times.len() - 1]);
        if !(time >= first && time <= last) {
            return Err(Error::Invalid(format!("time {time}: the series runs from {first} to {last}")));
        }
        let next = self.times.partition_point(|&t| t < time);
        if self.times[next] == time {
            return read(&self.files[next]);
        }
        let (a, b) = (read(&self.files[next - 1])?, read(&self.files[next])?);
        let weight = (time - self.times[next - 1]) / (self.times[next] - self.times[next - 1]);
        blend(&a, &b, weight)
    }

    /// Reads every frame: they must share a lattice. Returns the sweep that holds each frame's suggested one, `None` if
    /// no frame has any.
    ///
    /// # Errors
    /// `Invalid` with the first frame that stands elsewhere; what `read` meets.
    pub fn check(&self, read: impl Fn(&Path) -> Result<Volume>) -> Result<Option<[f64; 2]>> {
        let mut first: Option<Volume> = None;
        let mut sweep: Option<[f64; 2]> = None;
        for file in &self.files {
            let volume = read(file)?;
            if let Some([lo, hi]) = VolumeStatistics::of(&volume).sweep {
                sweep = Some(sweep.map_or([lo, hi], |s| [s[0].min(lo), s[1].max(hi)]));
            }
            match &first {
                Some(first) => same_lattice(first, &volume)?,
                None => first = Some(volume),
            }
        }
        Ok(sweep)
    }

    /// `name.vti` as that of frame `n`: `name_0000.vti`.
    pub fn numbered(path: &Path, n: usize) -> PathBuf {
        suffixed(path, &format!("_{n:04}"))
    }
}

/// `name.vti` as `name<suffix>.vti`.
pub(crate) fn suffixed(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_os_string();
    name.push(suffix);
    if let Some(extension) = path.extension() {
        name.push(".");
        name.push(extension);
    }
    path.with_file_name(name)
}

/// Whether files stand for a path that is no file itself: its name holds `%d`.
pub(crate) fn is_pattern(path: &Path) -> bool {
    path.file_name().and_then(|name| name.to_str()).is_some_and(|name| split(name).is_some()) && !path.exists()
}

/// The number of a file whose name is as `pattern` says.
pub(crate) fn number(pattern: &Path, file: &Path) -> Option<u64> {
    let (head, digits, tail) = split(pattern.file_name()?.to_str()?)?;
    let number = file.file_name()?.to_str()?.strip_prefix(head)?.strip_suffix(tail)?;
    let number = Some(number).filter(|n| n.len() >= digits && n.bytes().all(|b| b.is_ascii_digit()))?;
    number.parse().ok()
}

/// What stands before `%d`, the least number of digits, and what stands behind.
fn split(name: &str) -> Option<(&str, usize, &str)> {
    let (head, rest) = name.split_once('%')?;
    let (digits, tail) = rest.split_once('d')?;
    let least = if digits.is_empty() { 1 } else { digits.parse().ok()? };
    Some((head, least, tail))
}

fn same_lattice(a: &Volume, b: &Volume) -> Result<()> {
    if a.lattice == b.lattice && a.space == b.space {
        return Ok(());
    }
    let of = |v: &Volume| {
        let ([x, y, z], spacing, origin) = (v.lattice.dims(), v.lattice.spacing(), v.lattice.origin());
        format!("{x}×{y}×{z} samples, spacing {spacing}, origin {origin}, {}", v.space.name())
    };
    Err(Error::Invalid(format!(
        "{}: its lattice ({}) is not that of {} ({}); frames of a series must share one",
        b.name,
        of(b),
        a.name,
        of(a)
    )))
}

/// (1 − `weight`) `a` + `weight` `b`, sample by sample, in f64.
///
/// # Errors
/// `Invalid` if they stand on different lattices.
pub fn blend(a: &Volume, b: &Volume, weight: f64) -> Result<Volume> {
    same_lattice(a, b)?;
    let samples = (0..a.samples().len())
        .into_par_iter()
        .with_min_len(1 << 14)
        .map(|i| (1.0 - weight) * a.value(i) + weight * b.value(i))
        .collect();
    let mut blended = Volume::new(a.name.clone(), a.lattice.clone(), Samples::F64(samples))?;
    blended.space = a.space;
    Ok(blended)
}

/// Writes a ParaView collection of files at times; names are relative to its folder. \[VTK\]
///
/// # Errors
/// `Io`.
pub fn write_collection(path: &Path, frames: &[(f64, PathBuf)]) -> Result<()> {
    let mut text = String::from(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"0.1\" byte_order=\"LittleEndian\">\n  <Collection>\n",
    );
    for (time, file) in frames {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let name = escape(&name);
        text += &format!("    <DataSet timestep=\"{time}\" group=\"\" part=\"0\" file=\"{name}\"/>\n");
    }
    text += "  </Collection>\n</VTKFile>\n";
    files::write_text(path, &text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::Lattice;
    use glam::DVec3;

    fn volume(n: usize, value: f32) -> Volume {
        let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        Volume::new(format!("of {n}"), lattice, Samples::F32(vec![value; n * n * n])).unwrap()
    }

    #[test]
    fn patterns_find_their_files_in_order() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["r_0010.vti", "r_0002.vti", "r_12345.vti", "r_1.vti", "r_0003.nrrd", "r_abcd.vti"] {
            std::fs::write(dir.path().join(name), "").unwrap();
        }
        let series = Series::find(&dir.path().join("r_%04d.vti"), None).unwrap().unwrap();
        assert_eq!(series.times(), [2.0, 10.0, 12345.0]);
        assert!(series.files[0].ends_with("r_0002.vti"));
        assert_eq!(Series::find(&dir.path().join("r_%d.vti"), None).unwrap().unwrap().times().len(), 4);
        assert_eq!(Series::find(&dir.path().join("r_1.vti"), None).unwrap(), None);
        let missing = Series::find(&dir.path().join("s_%d.vti"), None).unwrap_err().to_string();
        assert!(missing.contains("s_%d.vti") && missing.contains("two or more"), "{missing}");
        assert_eq!(Series::numbered(Path::new("a/b.vti"), 7), Path::new("a/b_0007.vti"));
        assert_eq!(Series::numbered(Path::new("a.b/c"), 7), Path::new("a.b/c_0007"));
    }

    #[test]
    fn linear_between_frames() {
        let files = |n: usize| (0..n).map(|i| PathBuf::from(i.to_string())).collect::<Vec<_>>();
        let series = Series::new(files(3), Some(vec![0.0, 1.0, 3.0])).unwrap();
        let read = |p: &Path| Ok(volume(2, [10.0, 20.0, 40.0][p.to_str().unwrap().parse::<usize>().unwrap()]));
        for (time, value) in [(0.0, 10.0), (1.0, 20.0), (0.25, 12.5), (2.0, 30.0), (3.0, 40.0)] {
            assert_eq!(series.at(time, read).unwrap().value(5), value, "{time}");
        }
        assert!(matches!(series.at(1.0, read).unwrap().samples(), Samples::F32(_)), "a frame stays as it is");
        for time in [-0.1, 3.1, f64::NAN] {
            assert!(series.at(time, read).unwrap_err().to_string().contains("from 0 to 3"));
        }
        let differing = |p: &Path| Ok(volume(2 + p.to_str().unwrap().parse::<usize>().unwrap() / 2, 1.0));
        let e = series.check(differing).unwrap_err().to_string();
        assert!(e.contains("of 3") && e.contains("3×3×3") && e.contains("of 2"), "{e}");
        assert!(Series::new(files(1), None).is_err() && Series::new(files(2), Some(vec![1.0, 1.0])).is_err());
        assert!(Series::new(files(2), Some(vec![1.0])).is_err());
    }
}
