//! A scalar volume as its file gives it: a regular lattice placed in the world, and samples in their source type.
//! Readers live below, one per format; generators make volumes with exact value and gradient.

pub(crate) mod ascii;
pub mod cube;
pub mod generate;
mod header;
mod lattice;
pub mod legacy_vtk;
pub mod metaimage;
pub mod mrc;
pub mod nifti;
pub mod npy;
pub mod nrrd;
pub mod plane;
pub mod raw;
mod samples;
mod space;
pub mod statistics;
pub mod tiff;
pub mod vti;

pub use lattice::Lattice;
pub(crate) use samples::each_sample_type;
pub use samples::{ElementType, Endian, Samples};
pub use space::Space;

use crate::error::{Error, Result};
use crate::files;
use rayon::prelude::*;
use std::path::Path;

/// The extensions that [`Volume::open`] reads.
pub const READ: &str = ".nii, .mrc, .map, .ccp4, .rec, .cube and .npy (these also as .gz), .nrrd, .nhdr, .mha, .mhd, .vti, .vtk, \
                        .tif, .tiff and .tif.zip";

/// A scalar volume: samples on a lattice.
#[derive(Clone, Debug, PartialEq)]
pub struct Volume {
    /// What to call it in messages: the file's path or the generator's name.
    pub name: String,
    /// What the world's axes mean.
    pub space: Space,
    /// Where the samples stand.
    pub lattice: Lattice,
    samples: Samples,
}

impl Volume {
    /// Joins samples and lattice.
    ///
    /// # Errors
    /// `Invalid` if the counts differ.
    pub fn new(name: impl Into<String>, lattice: Lattice, samples: Samples) -> Result<Self> {
        let name = name.into();
        if samples.len() != lattice.len() {
            let [nx, ny, nz] = lattice.dims();
            return Err(Error::Invalid(format!(
                "{name}: {nx}×{ny}×{nz} = {} samples promised, {} found",
                lattice.len(),
                samples.len()
            )));
        }
        Ok(Self { name, space: Space::default(), lattice, samples })
    }

    /// Reads a file by its extension, whatever its case: [`READ`] names them. Of a `.vti` it takes the scalars that
    /// [`vti::VtiFile::into_scalars`] names. Files without a header go through [`raw::RawLayout::read`].
    ///
    /// # Errors
    /// `Io` for a missing file, `NotSupported` with the list of extensions, or what the format's reader returns.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Self::open_array(path.as_ref(), None)
    }

    /// [`Volume::open`], of a VTK file that holds several arrays the one of that name, if one is given.
    ///
    /// # Errors
    /// As [`Volume::open`]; `Invalid` if there is no such array, or the file is of another format.
    pub fn open_array(path: &Path, array: Option<&str>) -> Result<Self> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        // A missing file is the better complaint, whatever its extension.
        std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
        if path.is_dir() {
            return Err(Error::invalid(
                path,
                "is a folder; name a file in it (slices as files of their own: stack them)",
            ));
        }
        // What stands before `.gz` or `.zip` is the format's.
        let mut words = name.rsplit('.');
        let last = words.next().unwrap_or("");
        let (extension, packed) = match last {
            "gz" | "zip" => (words.next().unwrap_or(""), last),
            _ => (last, ""),
        };
        if let (Some(array), false) = (array, matches!((extension, packed), ("vti" | "vtk", ""))) {
            return Err(Error::invalid(path, format!("has no named arrays to choose `{array}` of, as VTK files have")));
        }
        match (extension, packed) {
            ("nii", "" | "gz") => nifti::read(path),
            ("nrrd" | "nhdr", "") => nrrd::read(path),
            ("mha" | "mhd", "") => metaimage::read(path),
            ("mrc" | "map" | "ccp4" | "rec", "" | "gz") => mrc::read(path),
            ("cube" | "cub", "" | "gz") => cube::read(path),
            ("vti", "") => Self::of_vti(path, vti::VtiFile::read_scalars(path, array)?, array),
            ("vtk", "") => legacy_vtk::read(path, array),
            ("npy", "" | "gz") => npy::read(path),
            ("tif" | "tiff", "" | "zip") => tiff::read(path),
            ("raw", "" | "gz") => Err(Error::invalid(
                path,
                "has no header: give its layout with --raw-dims, --raw-type …, or as [volume.raw]",
            )),
            ("toml" | "vtm", "") => {
                Err(Error::not_supported(path, "names volumes, of which this takes one: give that volume's file"))
            }
            ("dcm" | "dicom" | "ima", "") => {
                Err(Error::not_supported(path, "is DICOM: a converter to NIfTI or NRRD puts the slices together"))
            }
            ("vtr" | "vts" | "vtu" | "pvti" | "pvtr", "") => Err(Error::not_supported(
                path,
                "is no image of VTK's (.vti): resample it to one, as ParaView's `Resample To Image` does",
            )),
            ("pvd", "") => Err(Error::not_supported(path, "is a series: name one of its files")),
            ("npz", "") => Err(Error::not_supported(path, "holds several arrays: save one as a .npy")),
            _ => Err(Error::not_supported(
                path,
                format!("unknown extension; {READ} are read, and any file with its layout given (--raw-dims …)"),
            )),
        }
    }

    /// The volume in a `.vti` that was read from `path`, as [`Volume::open_array`] takes it.
    ///
    /// # Errors
    /// `Invalid` with the list of arrays if none are its scalars.
    pub fn of_vti(path: &Path, file: vti::VtiFile, array: Option<&str>) -> Result<Self> {
        let space = file.space();
        let (lattice, samples) = file.into_scalars(array).map_err(|e| e.in_file(path))?;
        Ok(Self { space, ..Self::new(path.display().to_string(), lattice, samples)? })
    }

    /// Writes a `.vti` (one point array `value`, active), a `.nrrd` or a `.npy` (without its place in the world), by
    /// the extension. The file appears under its name only when it is complete.
    ///
    /// # Errors
    /// `NotSupported` for another extension; `Io`.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        self.write_with_notes(path, &[])
    }

    /// [`Volume::write`] with texts by name, about where the volume comes from: field data of a `.vti`, key/value
    /// pairs of a `.nrrd`.
    ///
    /// # Errors
    /// As [`Volume::write`].
    pub fn write_with_notes(&self, path: impl AsRef<Path>, notes: &[(String, String)]) -> Result<()> {
        let path = path.as_ref();
        match files::extension(path).as_str() {
            "vti" => {
                let writer = vti::VtiWriter::new(&self.lattice)
                    .point_data("value", 1, &self.samples)
                    .field_string(vti::SPACE, self.space.name());
                notes
                    .iter()
                    .fold(writer, |w, (name, text)| w.field_string(name, text))
                    .active_scalars("value")
                    .write(path)
            }
            "nrrd" => {
                let notes: Vec<(&str, &str)> = notes.iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
                nrrd::write(path, &self.lattice, self.space, 1, (&self.samples).into(), &notes)
            }
            "npy" => npy::write(path, &self.lattice, 1, (&self.samples).into()),
            _ => Err(Error::not_supported(
                path,
                "volumes are written as .vti, .nrrd or .npy; give it one of these extensions",
            )),
        }
    }

    /// The samples, x fastest.
    pub fn samples(&self) -> &Samples {
        &self.samples
    }

    /// The samples, without the rest.
    pub fn into_samples(self) -> Samples {
        self.samples
    }

    /// Sample at a position in memory, in source units.
    #[inline]
    pub fn value(&self, offset: usize) -> f64 {
        self.samples.get(offset)
    }

    /// Least and greatest finite sample; `None` if no sample is finite.
    pub fn range(&self) -> Option<(f64, f64)> {
        (0..self.samples.len())
            .map(|i| self.value(i))
            .filter(|v| v.is_finite())
            .fold(None, |r, v| Some(r.map_or((v, v), |(lo, hi): (f64, f64)| (lo.min(v), hi.max(v)))))
    }

    /// Number of NaN and infinite samples.
    pub fn non_finite(&self) -> usize {
        match &self.samples {
            Samples::F32(v) => v.iter().filter(|v| !v.is_finite()).count(),
            Samples::F64(v) => v.iter().filter(|v| !v.is_finite()).count(),
            _ => 0,
        }
    }

    /// Number of samples that [`Volume::value`] rounds: integers beyond 2⁵³ that f64 does not hold.
    #[allow(clippy::cast_possible_truncation, reason = "integers come back whole")]
    pub fn rounded(&self) -> usize {
        match &self.samples {
            Samples::U64(v) => v.par_iter().filter(|&&v| v as f64 as u128 != u128::from(v)).count(),
            Samples::I64(v) => v.par_iter().filter(|&&v| v as f64 as i128 != i128::from(v)).count(),
            _ => 0,
        }
    }
}

#[cfg(test)]
#[path = "volume/tests.rs"]
mod tests;
