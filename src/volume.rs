//! A scalar volume as its file gives it: a regular lattice placed in the world, and samples in their source type.
//! Readers live below, one per format; generators make volumes with exact value and gradient.

pub(crate) mod ascii;
pub mod cube;
pub mod generate;
mod header;
pub mod legacy_vtk;
pub mod metaimage;
pub mod mrc;
pub mod nifti;
pub mod npy;
pub mod nrrd;
pub mod plane;
pub mod raw;
mod space;
pub mod statistics;
pub mod tiff;
pub mod vti;

pub use space::Space;

use crate::digits::Shortest;
use crate::error::{Error, Result};
use crate::files;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::path::Path;

/// The extensions that [`Volume::open`] reads.
pub const READ: &str = ".nii, .mrc, .map, .ccp4, .rec, .cube and .npy (these also as .gz), .nrrd, .nhdr, .mha, .mhd, .vti, .vtk, \
                        .tif, .tiff and .tif.zip";

/// A regular lattice of `dims` samples, vertex-centred: sample (i, j, k) stands at `origin + axes · (i, j, k)`.
///
/// Index space is the space of (i, j, k); x runs fastest in memory. The axes may be oblique or flipped,
/// but not degenerate.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    dims: [usize; 3],
    origin: DVec3,
    axes: DMat3,
    inverse: DMat3,
}

/// Samples along an axis: half of what 32-bit floats number.
const MOST_ALONG: usize = 1 << 23;

impl Lattice {
    /// Builds a lattice. Column a of `axes` is the world step of one index along axis a.
    ///
    /// # Errors
    /// `Invalid` if a dimension is below 2 or above 2²³, the sample count overflows, or the axes are singular or not
    /// finite.
    pub fn new(dims: [usize; 3], origin: DVec3, axes: DMat3) -> Result<Self> {
        if dims.iter().any(|&n| n < 2) {
            return Err(Error::Invalid(format!(
                "lattice of {}×{}×{} samples: every dimension must be at least 2 to hold a cell (a flat \
                 field goes to `isolume flatland`, as .png, .nrrd or .vti)",
                dims[0], dims[1], dims[2]
            )));
        }
        if dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).is_none_or(|n| n > isize::MAX as usize / 16) {
            return Err(Error::Invalid(format!(
                "lattice of {}×{}×{} samples: too large for this machine's address space",
                dims[0], dims[1], dims[2]
            )));
        }
        if let Some(n) = dims.into_iter().find(|&n| n > MOST_ALONG) {
            return Err(Error::Invalid(format!("lattice of {n} samples along an axis: {MOST_ALONG} at most")));
        }
        let size: f64 = (0..3).map(|a| axes.col(a).length()).product();
        let inverse = axes.inverse();
        let determinant = axes.determinant();
        if !origin.is_finite()
            || !axes.is_finite()
            || determinant.is_nan()
            || determinant.abs() <= 1e-9 * size
            || !inverse.is_finite()
        {
            let shown = |v: DVec3| format!("({}, {}, {})", Shortest(v.x), Shortest(v.y), Shortest(v.z));
            let [x, y, z] = [axes.x_axis, axes.y_axis, axes.z_axis].map(shown);
            let [dx, dy, dz] = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| Shortest(axis.length()));
            let origin = shown(origin);
            return Err(Error::Invalid(format!(
                "spacing {dx}, {dy}, {dz} along the axes {x}, {y}, {z} from the origin {origin}: must be finite and not 0, and \
                 the axes linearly independent"
            )));
        }
        Ok(Self { dims, origin, axes, inverse })
    }

    /// A lattice with axes along the world's, `spacing` apart.
    ///
    /// # Errors
    /// As [`Lattice::new`].
    pub fn aligned(dims: [usize; 3], origin: DVec3, spacing: DVec3) -> Result<Self> {
        Self::new(dims, origin, DMat3::from_diagonal(spacing))
    }

    /// Samples along each axis, each at least 2.
    #[inline]
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Cells along each axis: one fewer than the samples.
    #[inline]
    pub fn cells(&self) -> [usize; 3] {
        self.dims.map(|n| n - 1)
    }

    /// World position of sample (0, 0, 0).
    pub fn origin(&self) -> DVec3 {
        self.origin
    }

    /// World steps per index, one column per axis.
    pub fn axes(&self) -> DMat3 {
        self.axes
    }

    /// World length of one index step along each axis.
    pub fn spacing(&self) -> DVec3 {
        DVec3::new(self.axes.x_axis.length(), self.axes.y_axis.length(), self.axes.z_axis.length())
    }

    /// World volume of one cell.
    pub fn cell_volume(&self) -> f64 {
        self.axes.determinant().abs()
    }

    /// The power of two next to the width of a cell: in it the world's lengths fit f32, and no bits change.
    pub fn unit(&self) -> f64 {
        (self.cell_volume().log2() / 3.0).round().exp2()
    }

    /// World volume of Ω, the whole lattice.
    pub fn world_volume(&self) -> f64 {
        self.cell_volume() * self.cells().iter().map(|&n| n as f64).product::<f64>()
    }

    /// Number of samples.
    #[allow(clippy::len_without_is_empty, reason = "a lattice always holds at least 8 samples")]
    pub fn len(&self) -> usize {
        self.dims.iter().product()
    }

    /// Position in memory of sample (i, j, k).
    #[inline]
    pub fn offset(&self, i: usize, j: usize, k: usize) -> usize {
        (k * self.dims[1] + j) * self.dims[0] + i
    }

    /// Sample (i, j, k) at a position in memory.
    #[inline]
    pub fn ijk(&self, offset: usize) -> [usize; 3] {
        let [nx, ny, _] = self.dims;
        [offset % nx, offset / nx % ny, offset / (nx * ny)]
    }

    /// Index coordinates to world coordinates.
    #[inline]
    pub fn to_world(&self, p: DVec3) -> DVec3 {
        self.origin + self.axes * p
    }

    /// World coordinates to index coordinates.
    #[inline]
    pub fn to_index(&self, x: DVec3) -> DVec3 {
        self.inverse * (x - self.origin)
    }

    /// A world direction in index space (not normalised, so that a ray's t stays in world units).
    #[inline]
    pub fn direction_to_index(&self, d: DVec3) -> DVec3 {
        self.inverse * d
    }

    /// An index-space gradient in the world: the inverse transpose of the axes.
    #[inline]
    pub fn gradient_to_world(&self, g: DVec3) -> DVec3 {
        self.inverse.transpose() * g
    }

    /// The index coordinates of Ω's far corner.
    pub fn far(&self) -> DVec3 {
        DVec3::from_array(self.cells().map(|n| n as f64))
    }

    /// Length of Ω's diagonal from its first to its far corner, world.
    pub fn diagonal(&self) -> f64 {
        (self.axes * self.far()).length()
    }

    /// Ω's corners, index coordinates.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|n| self.far() * DVec3::from_array([n & 1, n >> 1 & 1, n >> 2].map(|i| i as f64)))
    }

    /// The points of the cell around index coordinates `p`, of Ω's nearest if that is outside, with the weights of
    /// trilinear interpolation; x fastest.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside the lattice")]
    pub fn around(&self, p: DVec3) -> [(usize, f64); 8] {
        let far = self.far();
        let p = p.clamp(DVec3::ZERO, far);
        let base = p.floor().min(far - 1.0);
        let (u, v) = (p - base, DVec3::ONE - (p - base));
        let cell = base.to_array().map(|x| x as usize);
        std::array::from_fn(|n| {
            let [x, y, z] = [n & 1, n >> 1 & 1, n >> 2];
            let w = [v.x, u.x][x] * [v.y, u.y][y] * [v.z, u.z][z];
            (self.offset(cell[0] + x, cell[1] + y, cell[2] + z), w)
        })
    }

    /// Whether index coordinates lie in Ω, or as near as rounding puts what stands on its faces (10⁻⁶ of a step).
    #[inline]
    pub fn holds(&self, p: DVec3) -> bool {
        self.nearest(p, 1e-6).is_some()
    }

    /// The point of Ω next to index coordinates that lie at most `slack` steps outside along any axis.
    #[inline]
    pub fn nearest(&self, p: DVec3, slack: f64) -> Option<DVec3> {
        let nearest = p.clamp(DVec3::ZERO, self.far());
        (p - nearest).abs().cmple(DVec3::splat(slack)).all().then_some(nearest)
    }
}

/// Samples in the type of the file. x fastest.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the variants are the element types")]
pub enum Samples {
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    U64(Vec<u64>),
    I64(Vec<i64>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// The element type of [`Samples`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants are the element types")]
pub enum ElementType {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

/// Byte order of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the variants say it")]
pub enum Endian {
    Little,
    Big,
}

/// Runs `$body` with `$v` bound to the vector inside a [`Samples`].
macro_rules! each_sample_type {
    ($samples:expr, $v:ident => $body:expr) => {
        match $samples {
            $crate::volume::Samples::U8($v) => $body,
            $crate::volume::Samples::I8($v) => $body,
            $crate::volume::Samples::U16($v) => $body,
            $crate::volume::Samples::I16($v) => $body,
            $crate::volume::Samples::U32($v) => $body,
            $crate::volume::Samples::I32($v) => $body,
            $crate::volume::Samples::U64($v) => $body,
            $crate::volume::Samples::I64($v) => $body,
            $crate::volume::Samples::F32($v) => $body,
            $crate::volume::Samples::F64($v) => $body,
        }
    };
}

pub(crate) use each_sample_type;

impl ElementType {
    /// Every one.
    const ALL: [Self; 10] =
        [Self::U8, Self::I8, Self::U16, Self::I16, Self::U32, Self::I32, Self::U64, Self::I64, Self::F32, Self::F64];

    /// Bytes per element.
    pub fn size(self) -> usize {
        match self {
            ElementType::U8 | ElementType::I8 => 1,
            ElementType::U16 | ElementType::I16 => 2,
            ElementType::U32 | ElementType::I32 | ElementType::F32 => 4,
            ElementType::U64 | ElementType::I64 | ElementType::F64 => 8,
        }
    }

    /// Bytes of `count` elements, `u64::MAX` if there are more.
    pub fn bytes(self, count: usize) -> u64 {
        (count as u64).saturating_mul(self.size() as u64)
    }

    /// The name used on the command line and in messages: `u8`, `i16`, `f32` …
    pub fn name(self) -> &'static str {
        match self {
            ElementType::U8 => "u8",
            ElementType::I8 => "i8",
            ElementType::U16 => "u16",
            ElementType::I16 => "i16",
            ElementType::U32 => "u32",
            ElementType::I32 => "i32",
            ElementType::U64 => "u64",
            ElementType::I64 => "i64",
            ElementType::F32 => "f32",
            ElementType::F64 => "f64",
        }
    }

    /// The type of a [`ElementType::name`].
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|t| t.name() == name)
    }
}

impl Samples {
    /// Decodes raw bytes. `bytes.len()` must be a multiple of the element size; the rest is ignored.
    pub fn from_bytes(bytes: &[u8], element: ElementType, endian: Endian) -> Self {
        macro_rules! decode {
            ($t:ty) => {
                bytes
                    .chunks_exact(std::mem::size_of::<$t>())
                    .map(|b| {
                        let b = b.try_into().expect("chunks_exact gives whole elements");
                        match endian {
                            Endian::Little => <$t>::from_le_bytes(b),
                            Endian::Big => <$t>::from_be_bytes(b),
                        }
                    })
                    .collect()
            };
        }
        match element {
            ElementType::U8 => Samples::U8(bytes.to_vec()),
            ElementType::I8 => Samples::I8(decode!(i8)),
            ElementType::U16 => Samples::U16(decode!(u16)),
            ElementType::I16 => Samples::I16(decode!(i16)),
            ElementType::U32 => Samples::U32(decode!(u32)),
            ElementType::I32 => Samples::I32(decode!(i32)),
            ElementType::U64 => Samples::U64(decode!(u64)),
            ElementType::I64 => Samples::I64(decode!(i64)),
            ElementType::F32 => Samples::F32(decode!(f32)),
            ElementType::F64 => Samples::F64(decode!(f64)),
        }
    }

    /// [`Samples::from_bytes`] that keeps the buffer where its bytes are the samples.
    pub fn from_vec(bytes: Vec<u8>, element: ElementType, endian: Endian) -> Self {
        match element {
            ElementType::U8 => Samples::U8(bytes),
            _ => Self::from_bytes(&bytes, element, endian),
        }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        each_sample_type!(self, v => v.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Sample `i` as f64 (64-bit integers beyond 2⁵³ round to nearest).
    #[inline]
    #[allow(clippy::unnecessary_cast, reason = "the macro's f64 arm casts to itself")]
    pub fn get(&self, i: usize) -> f64 {
        each_sample_type!(self, v => v[i] as f64)
    }

    /// The element type.
    pub fn element_type(&self) -> ElementType {
        match self {
            Samples::U8(_) => ElementType::U8,
            Samples::I8(_) => ElementType::I8,
            Samples::U16(_) => ElementType::U16,
            Samples::I16(_) => ElementType::I16,
            Samples::U32(_) => ElementType::U32,
            Samples::I32(_) => ElementType::I32,
            Samples::U64(_) => ElementType::U64,
            Samples::I64(_) => ElementType::I64,
            Samples::F32(_) => ElementType::F32,
            Samples::F64(_) => ElementType::F64,
        }
    }
}

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
