//! NRRD volumes, attached (`.nrrd`) and detached (`.nhdr`, or a `.nrrd` that names a data file).
//!
//! The world is the one of the file's own `space`, whatever it is called: the `space directions` and the
//! `space origin` are taken as numbers, and a left-posterior-superior file is not turned into RAS.

use crate::error::{Error, Result};
use crate::files::{self, Packing, Section};
use crate::volume::header::{Header, Line, before_last};
use crate::volume::plane::Plane;
use crate::volume::vti::SamplesRef;
use crate::volume::{ElementType, Endian, Lattice, Samples, Space, Volume, ascii};
use flate2::{Compression, write::GzEncoder};
use glam::{DMat3, DVec3};
use std::collections::HashSet;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

/// Reads a 3D scalar volume (or a 4D one with an axis of a single sample). Samples keep the file's type.
///
/// Encodings raw, gzip and ascii; versions NRRD0001 to NRRD0005. Without `space directions`, `spacings` and the `space
/// origin`, or `axis mins` or `axis maxs`, place the lattice; a missing spacing is 1, and samples of which nothing is
/// said stand in the middle of cells, as the format's own library has it. By their `kinds` axes are of space (`domain`,
/// `space`, `time`, or unknown: `???`, `none`) or hold the components of vectors, colours or lists.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, too few bytes (known before they are allocated) or a damaged stream;
/// `NotSupported` for vectors (axes of more than one component), other dimensions, other encodings and split data
/// files.
pub fn read(path: &Path) -> Result<Volume> {
    let header = Fields::read(path)?;
    let keep = header.kept_axes()?;
    let sizes: Vec<usize> = header.list("sizes")?;
    let dims = keep.map(|a| sizes[a]);
    let lattice = header.lattice(dims, keep)?;
    let element = header.element()?;
    let samples = header.samples(lattice.len(), element)?;
    // Who gives a dimension instead of a name means none.
    let named = header.get("space").or(header.get("spacedimension"));
    let space = named.map_or(Space::default(), |name| Space::from_name(name).unwrap_or(Space::Unnamed));
    Ok(Volume { space, ..Volume::new(path.display().to_string(), lattice, samples)? })
}

/// The file that a header names for its samples.
pub(crate) fn data_file(path: &Path) -> Option<PathBuf> {
    let header = Fields::read(path).ok()?;
    header.beside("data file", header.get("datafile")?).ok()
}

/// Reads a field of two axes (others must hold a single sample); `None` if the file holds a volume. The steps along the
/// axes are the lengths of their `space directions`, or `spacings`, or 1.
///
/// # Errors
/// As [`read`].
pub fn read_plane(path: &Path) -> Result<Option<Plane>> {
    let header = Fields::read(path)?;
    let sizes: Vec<usize> = header.list("sizes")?;
    header.refuse_vectors(&sizes)?;
    let Some(axes) = Plane::long_axes(&sizes).map_err(|e| e.in_file(path))? else { return Ok(None) };
    let spacing = if header.get("spacedirections").is_some() {
        let vectors = header.vectors("spacedirections")?;
        axes.map(|a| {
            vectors.get(a).and_then(Option::as_ref).map_or(1.0, |v| v.iter().map(|x| x * x).sum::<f64>().sqrt())
        })
    } else if header.get("spacings").is_some() {
        let steps: Vec<f64> = header.list("spacings")?;
        axes.map(|a| if steps[a].is_nan() { 1.0 } else { steps[a].abs() })
    } else {
        [1.0; 2]
    };
    let dims = axes.map(|a| sizes[a]);
    let count = dims[0].checked_mul(dims[1]).ok_or_else(|| header.wrong("sizes", "that is too large"))?;
    Ok(Some(Plane { dims, spacing, samples: header.samples(count, header.element()?)? }))
}

/// Writes values on a lattice as an attached, gzip-packed, little-endian NRRD that 3D Slicer, ITK and pynrrd read: one
/// component as a scalar volume, more as a vector image, whose vector axis is the first and has no direction. `notes`
/// become `key:=value` lines.
///
/// The file appears under its name only when it is complete. VTK's and ParaView's own NRRD reader does not read
/// vectors.
///
/// # Errors
/// `Invalid` if the count is not the lattice's samples × `components`; `Io`.
pub fn write(
    path: &Path,
    lattice: &Lattice,
    space: Space,
    components: usize,
    values: SamplesRef<'_>,
    notes: &[(&str, &str)],
) -> Result<()> {
    values.check(lattice, components).map_err(|e| Error::invalid(path, e))?;
    let [nx, ny, nz] = lattice.dims();
    let kind = match values.element_type() {
        ElementType::U8 => "uint8",
        ElementType::I8 => "int8",
        ElementType::U16 => "uint16",
        ElementType::I16 => "int16",
        ElementType::U32 => "uint32",
        ElementType::I32 => "int32",
        ElementType::U64 => "uint64",
        ElementType::I64 => "int64",
        ElementType::F32 => "float",
        ElementType::F64 => "double",
    };
    let vector = |v: DVec3| format!("({},{},{})", v.x, v.y, v.z);
    let axes = lattice.axes();
    let [x, y, z] = [axes.x_axis, axes.y_axis, axes.z_axis].map(vector);
    let (dimension, sizes, none, kinds) = match components {
        1 => (3, String::new(), "", "domain domain domain"),
        n => (4, format!("{n} "), "none ", "vector domain domain domain"),
    };
    let origin = vector(lattice.origin());
    let world = match space {
        Space::Unnamed => "space dimension: 3".to_owned(),
        space => format!("space: {}", space.name()),
    };
    let mut head = format!(
        "NRRD0005\n# written by isolume\ntype: {kind}\ndimension: {dimension}\n{world}\n\
         sizes: {sizes}{nx} {ny} {nz}\nspace directions: {none}{x} {y} {z}\nkinds: {kinds}\nendian: little\n\
         encoding: gzip\nspace origin: {origin}\n"
    );
    for (key, value) in notes {
        let value = value.replace('\\', "\\\\").replace('\n', "\\n");
        head += &format!("{key}:={value}\n");
    }
    files::write_atomically(path, |out| {
        out.write_all(head.as_bytes())?;
        out.write_all(b"\n")?;
        let mut packed = GzEncoder::new(out, Compression::fast());
        values.write_le(&mut packed)?;
        packed.finish().map(drop)
    })
}

/// A vector of three numbers.
fn in_world(vector: Option<&Option<Vec<f64>>>) -> Option<DVec3> {
    vector?.clone()?.try_into().ok().map(DVec3::from_array)
}

/// The fields of an NRRD header: lower case, without blanks, since "data file" and "datafile" are the same field.
struct Fields<'a>(Header<'a>);

impl<'a> std::ops::Deref for Fields<'a> {
    type Target = Header<'a>;

    fn deref(&self) -> &Header<'a> {
        &self.0
    }
}

impl<'a> Fields<'a> {
    /// Reads the lines up to the first empty one; a detached header may end without it.
    fn read(path: &'a Path) -> Result<Self> {
        let (mut begun, mut listed, mut seen) = (false, false, HashSet::new());
        let no_nrrd = || Error::invalid(path, "does not begin with NRRD0001 … NRRD0005, so it is no NRRD file");
        let header = Header::read(path, |number, text| {
            if number == 1 {
                begun = true;
                return match text.strip_prefix("NRRD000").ok_or_else(no_nrrd)? {
                    "1" | "2" | "3" | "4" | "5" => Ok(Line::Nothing),
                    _ => Err(Error::not_supported(path, format!("{text}: only NRRD0001 … NRRD0005 are read"))),
                };
            }
            if text.is_empty() {
                return Ok(Line::End);
            }
            if listed {
                // The names of files follow, on which `samples` has the last word.
                return Ok(Line::Nothing);
            }
            // `key:=value` pairs are the user's own notes.
            match text.split_once(':').filter(|(_, v)| !v.starts_with('=')) {
                _ if text.starts_with('#') => Ok(Line::Nothing),
                Some((key, value)) => {
                    let written = key;
                    let (key, value) = (key.replace(' ', "").to_ascii_lowercase(), value.trim().to_string());
                    listed = key.starts_with("datafile") && value.starts_with("LIST");
                    if !seen.insert(key.clone()) {
                        return Err(Error::invalid(path, format!("line {number}: field `{written}` is there twice")));
                    }
                    Ok(Line::Field(key, value))
                }
                None if text.contains(":=") => Ok(Line::Nothing),
                None => {
                    let shown: String = text.chars().take(80).flat_map(char::escape_debug).collect();
                    Err(Error::invalid(path, format!("line {number}, `{shown}`, is no `field: value`")))
                }
            }
        })?;
        if begun { Ok(Self(header)) } else { Err(no_nrrd()) }
    }

    /// A field with one number per axis.
    fn list<T: std::str::FromStr>(&self, key: &str) -> Result<Vec<T>> {
        let n: usize = self.need("dimension")?.parse().map_err(|_| self.wrong("dimension", "it must be a number"))?;
        self.need(key)?;
        Ok(self.numbers(key, n)?.unwrap_or_default())
    }

    /// One vector per axis (`None` for `none`), by the parentheses.
    fn vectors(&self, key: &str) -> Result<Vec<Option<Vec<f64>>>> {
        let wanted = "it must hold vectors like `(1,0,0)`, or `none`";
        let mut vectors = Vec::new();
        let mut rest = self.need(key)?.trim();
        while !rest.is_empty() {
            if let Some(tail) = rest.strip_prefix("none") {
                vectors.push(None);
                rest = tail.trim_start();
                continue;
            }
            let (inside, tail) =
                rest.strip_prefix('(').and_then(|r| r.split_once(')')).ok_or_else(|| self.wrong(key, wanted))?;
            let numbers: Option<Vec<f64>> = inside.split(',').map(|w| w.trim().parse().ok()).collect();
            vectors.push(Some(numbers.ok_or_else(|| self.wrong(key, wanted))?));
            rest = tail.trim_start();
        }
        Ok(vectors)
    }

    /// Fails if an axis of several components is none of space.
    fn refuse_vectors(&self, sizes: &[usize]) -> Result<()> {
        let kinds = self.get("kinds").unwrap_or("").split_whitespace();
        let domain =
            |kind: &str| ["domain", "space", "time", "???", "none"].contains(&kind.to_ascii_lowercase().as_str());
        match kinds.zip(sizes).enumerate().find(|(_, (kind, size))| **size > 1 && !domain(kind)) {
            None => Ok(()),
            Some((a, (kind, size))) => Err(Error::not_supported(
                self.path,
                format!(
                    "axis {a} is of kind `{kind}` with {size} components: vectors and colours are not read; extract \
                     one component, as with `unu slice -a {a} -p 0`"
                ),
            )),
        }
    }

    /// The three axes of space. Of four, one of a single sample is dropped: the one without a direction if it can be.
    fn kept_axes(&self) -> Result<[usize; 3]> {
        let sizes: Vec<usize> = self.list("sizes")?;
        self.refuse_vectors(&sizes)?;
        match sizes.len() {
            3 => Ok([0, 1, 2]),
            4 => {
                let directions =
                    if self.get("spacedirections").is_some() { self.vectors("spacedirections")? } else { vec![] };
                let single = |a: &usize| sizes[*a] == 1;
                let drop = (0..4)
                    .find(|a| single(a) && directions.get(*a) == Some(&None))
                    .or_else(|| (0..4).find(single))
                    .ok_or_else(|| {
                        Error::not_supported(
                            self.path,
                            format!("sizes {sizes:?}: vectors and series are not read; extract one scalar volume"),
                        )
                    })?;
                let kept: Vec<usize> = (0..4).filter(|&a| a != drop).collect();
                Ok([kept[0], kept[1], kept[2]])
            }
            n => Err(Error::not_supported(
                self.path,
                format!("dimension {n}: only 3D scalar volumes are read (a 2D field goes to `isolume flatland`)"),
            )),
        }
    }

    fn lattice(&self, dims: [usize; 3], keep: [usize; 3]) -> Result<Lattice> {
        if self.get("spacedirections").is_some() {
            let vectors = self.vectors("spacedirections")?;
            let column = |a: usize| {
                in_world(vectors.get(keep[a]))
                    .ok_or_else(|| self.wrong("spacedirections", "every axis of the volume needs its vector `(x,y,z)`"))
            };
            let axes = DMat3::from_cols(column(0)?, column(1)?, column(2)?);
            let origin = self.space_origin()?.unwrap_or_default();
            return Lattice::new(dims, origin, axes).map_err(|e| e.in_file(self.path));
        }
        let per_axis = |key: &str| -> Result<[f64; 3]> {
            let values: Vec<f64> =
                if self.get(key).is_some() { self.list(key)? } else { vec![f64::NAN; keep[2].max(3) + 1] };
            Ok(keep.map(|a| values[a]))
        };
        let (spacings, mins, maxs) = (per_axis("spacings")?, per_axis("axismins")?, per_axis("axismaxs")?);
        let centers: Vec<&str> =
            self.get("centerings").or(self.get("centers")).unwrap_or("").split_whitespace().collect();
        let stands = self.space_origin()?;
        let (mut step, mut origin) = (DVec3::ONE, stands.unwrap_or_default());
        for a in 0..3 {
            // Cell-centred samples stand half a step inside the axis' ends, node-centred ones on them.
            let cell = !centers.get(keep[a]).is_some_and(|c| c.eq_ignore_ascii_case("node"));
            let steps = if cell { dims[a] as f64 } else { dims[a].saturating_sub(1) as f64 };
            if !spacings[a].is_nan() {
                step[a] = spacings[a];
            } else if !mins[a].is_nan() && !maxs[a].is_nan() {
                step[a] = (maxs[a] - mins[a]) / steps;
            }
            let inset = if cell { 0.5 * step[a] } else { 0.0 };
            if stands.is_some() {
                // The first sample itself.
            } else if !mins[a].is_nan() {
                origin[a] = mins[a] + inset;
            } else if !maxs[a].is_nan() {
                origin[a] = maxs[a] - inset - step[a] * dims[a].saturating_sub(1) as f64;
            }
        }
        Lattice::aligned(dims, origin, step).map_err(|e| e.in_file(self.path))
    }

    /// Where the first sample stands, if that is said.
    fn space_origin(&self) -> Result<Option<DVec3>> {
        if self.get("spaceorigin").is_none() {
            return Ok(None);
        }
        let origin = in_world(self.vectors("spaceorigin")?.first());
        origin.map(Some).ok_or_else(|| self.wrong("spaceorigin", "it must be one vector `(x,y,z)`"))
    }

    fn element(&self) -> Result<ElementType> {
        Ok(match self.need("type")?.to_ascii_lowercase().as_str() {
            "signed char" | "int8" | "int8_t" => ElementType::I8,
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => ElementType::U8,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => ElementType::I16,
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => ElementType::U16,
            "int" | "signed int" | "int32" | "int32_t" => ElementType::I32,
            "uint" | "unsigned int" | "uint32" | "uint32_t" => ElementType::U32,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => ElementType::I64,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => ElementType::U64,
            "float" => ElementType::F32,
            "double" => ElementType::F64,
            other => {
                return Err(Error::not_supported(
                    self.path,
                    format!("type `{other}`: integers of 8 to 64 bits, float and double are read"),
                ));
            }
        })
    }

    fn samples(&self, count: usize, element: ElementType) -> Result<Samples> {
        let (path, start) = match self.get("datafile") {
            None => (self.path.to_path_buf(), self.length),
            Some(name) => (self.beside("data file", name)?, 0),
        };
        let encoding = self.need("encoding")?.to_ascii_lowercase();
        let packing = match encoding.as_str() {
            "raw" | "ascii" | "text" | "txt" => Packing::Plain,
            "gzip" | "gz" => Packing::Gzip,
            other => {
                return Err(Error::not_supported(
                    self.path,
                    format!("encoding `{other}`: raw, gzip and ascii are read; convert it with `unu save -e gzip`"),
                ));
            }
        };
        let number = |key: &str| -> Result<i64> {
            self.get(key).map_or(Ok(0), |v| v.parse().map_err(|_| self.wrong(key, "it must be a whole number")))
        };
        let start = start + skip_lines(&path, start, number("lineskip")?)?;
        let promised = element.bytes(count);
        let skip = match number("byteskip")? {
            n if n >= 0 => n as u64,
            // -1: the samples are the end of the file.
            -1 if encoding == "raw" => before_last(&path, start, promised)?,
            _ => return Err(self.wrong("byteskip", "it must not be negative (-1 is for the raw encoding only)")),
        };
        if matches!(encoding.as_str(), "ascii" | "text" | "txt") {
            return ascii::read(&path, start.saturating_add(skip), element, count);
        }
        let endian = match self.get("endian").map(str::to_ascii_lowercase).as_deref() {
            Some("little") => Endian::Little,
            Some("big") => Endian::Big,
            None if element.size() == 1 => Endian::Little,
            Some(_) => return Err(self.wrong("endian", "it must be `little` or `big`")),
            None => return Err(Error::invalid(self.path, "samples of several bytes need the field `endian`")),
        };
        let bytes = files::read_section(&path, Section { start, packing, skip }, promised)?;
        Ok(Samples::from_vec(bytes, element, endian))
    }
}

/// Length of the first `lines` lines behind `start`.
fn skip_lines(path: &Path, start: u64, lines: i64) -> Result<u64> {
    if lines < 0 {
        return Err(Error::invalid(path, format!("line skip is {lines}; it must not be negative")));
    }
    if lines == 0 {
        return Ok(0);
    }
    let mut reader = BufReader::new(files::open(path)?);
    let io = |e| Error::io(path, e);
    reader.seek_relative(start as i64).map_err(io)?;
    let mut length = 0;
    for _ in 0..lines {
        match reader.skip_until(b'\n').map_err(io)? {
            0 => return Err(Error::invalid(path, format!("line skip is {lines}, but the file has fewer lines"))),
            n => length += n as u64,
        }
    }
    Ok(length)
}

#[cfg(test)]
#[path = "nrrd_tests.rs"]
mod tests;
