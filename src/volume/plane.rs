//! A flat field as its file gives it: what `isolume flatland` takes for h₂.

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{Samples, nrrd, vti};
use std::path::Path;

/// Samples on a rectangle, x fastest, in their source type. Each dimension is at least 2.
#[derive(Clone, Debug, PartialEq)]
pub struct Plane {
    /// Samples along x and y.
    pub dims: [usize; 2],
    /// World distance between samples along x and y.
    pub spacing: [f64; 2],
    /// `dims[0]` × `dims[1]` of them.
    pub samples: Samples,
}

impl Plane {
    /// Reads a 2D `.nrrd` (or one with further axes of a single sample) or a `.vti` that is one sample thick; `None` if
    /// the file is a volume or has another extension.
    ///
    /// # Errors
    /// What the format's reader returns.
    pub fn open(path: &Path) -> Result<Option<Self>> {
        match files::extension(path).as_str() {
            "nrrd" | "nhdr" => nrrd::read_plane(path),
            "vti" => vti::read_plane(path),
            _ => Ok(None),
        }
    }

    /// The two of several axes that hold more than one sample, in order; `None` if there are more or fewer.
    ///
    /// # Errors
    /// `Invalid` if less than a rectangle is left.
    pub(super) fn long_axes(dims: &[usize]) -> Result<Option<[usize; 2]>> {
        let long: Vec<usize> = (0..dims.len()).filter(|&a| dims[a] != 1).collect();
        match long[..] {
            [a, b] if dims[a] > 1 && dims[b] > 1 => Ok(Some([a, b])),
            [_, _, _, ..] => Ok(None),
            _ => Err(Error::Invalid(format!("{dims:?} samples hold no rectangle of 2×2 or more"))),
        }
    }
}
