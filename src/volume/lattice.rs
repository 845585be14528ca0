//! The regular lattice that samples stand on.

use crate::digits::Shortest;
use crate::error::{Error, Result};
use glam::{DMat3, DVec3};

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

    /// Index coordinates of the sample at a position in memory.
    #[inline]
    pub fn point(&self, offset: usize) -> DVec3 {
        DVec3::from_array(self.ijk(offset).map(|i| i as f64))
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
