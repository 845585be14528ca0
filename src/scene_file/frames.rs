//! `[volume]` in time: `file` as a pattern, or `files`.

use super::{SceneOptions, VolumeSource, Volumes, blame, parse};
use crate::error::{Error, Result};
use crate::series::Series;
use crate::volume::Volume;
use std::path::Path;

/// The series of volumes that `input` is, if it is one.
///
/// # Errors
/// As [`super::load`]; `Invalid` also if its frames do not share a lattice.
pub fn load_series(input: &Path, options: &SceneOptions) -> Result<Option<Series>> {
    let (source, file, folder) = parse(input)?;
    let Volumes::One(single) = &file.volume else { return Ok(None) };
    let series = single.series(&folder).map_err(|e| blame(source.as_ref(), single.key(), e))?;
    if let Some(series) = &series {
        series.check(|path| single.read(path, &options.read))?;
    }
    Ok(series)
}

impl VolumeSource {
    /// The path of the key that says where the volume comes from.
    pub(super) fn key(&self) -> &'static [&'static str] {
        match self {
            VolumeSource { files: Some(_), .. } => &["volume", "files"],
            VolumeSource { file: Some(_), .. } => &["volume", "file"],
            _ => &["volume", "generator"],
        }
    }

    pub(super) fn series(&self, folder: &Path) -> Result<Option<Series>> {
        self.check()?;
        let times = self.times.clone();
        let series = match (&self.files, &self.file) {
            (Some(files), _) => Some(Series::new(files.iter().map(|f| folder.join(f)).collect(), times)?),
            (None, Some(file)) => Series::find(&folder.join(file), times)?,
            (None, None) => None,
        };
        match &self.times {
            Some(_) if series.is_none() => Err(Error::Invalid("times are for a series of files".into())),
            _ => Ok(series),
        }
    }
}

/// The volume of `series` that `time` chooses.
pub(super) fn moment(
    series: &Series,
    time: Option<f64>,
    input: &Path,
    read: impl Fn(&Path) -> Result<Volume>,
) -> Result<Volume> {
    let Some(time) = time else {
        let n = series.times().len();
        return Err(Error::invalid(input, format!("is a series of {n} volumes; choose a moment with --time")));
    };
    series.at(time, read)
}
