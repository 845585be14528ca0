//! The grid of bins.

use glam::{DVec3, Vec3};

/// Cells of whole voxels over a lattice: cell n along an axis holds the lattice's places from f n − ½ to f (n + 1) − ½.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    /// Lattice steps per cell along each axis.
    pub factor: [usize; 3],
    pub dims: [usize; 3],
}

impl Cells {
    /// Cells of `factor` lattice steps each over `dims` samples.
    pub(super) fn new(factor: [usize; 3], dims: [usize; 3]) -> Self {
        Self { factor, dims: std::array::from_fn(|a| dims[a].div_ceil(factor[a])) }
    }

    /// Coordinates of the cells of a local position: cell n spans [n, n + 1].
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn place(&self, p: DVec3) -> Vec3 {
        ((p + 0.5) / DVec3::from_array(self.factor.map(|f| f as f64))).as_vec3()
    }

    /// The cell of one such coordinate, or the nearest.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the cells")]
    pub(super) fn cell(&self, axis: usize, at: f32) -> usize {
        (at as usize).min(self.dims[axis] - 1)
    }
}
