//! Families of parallel lines: a world direction as a shear of the lattice, and the low-discrepancy sets they come
//! from.

use crate::rng::Key;
use crate::volume::Lattice;
use glam::{DMat3, DQuat, DVec3};
use std::f64::consts::TAU;

/// How a family of lines walks through memory: slices across `axis`, lines side by side along `u`, the fastest axis of
/// the memory they read, and rows of lines along `v`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    /// Lattice axes of u, v and the slices.
    pub axes: [usize; 3],
    /// Samples along u, v and the slices.
    pub dims: [usize; 3],
    /// Memory strides of v and the slices; that of u is 1.
    pub stride: [usize; 2],
    /// Strides of u, v and the slices in x, y, z order, in which nodes are numbered.
    pub node: [usize; 3],
    /// Whether memory runs y, z, x instead of x, y, z.
    pub transposed: bool,
}

impl Layout {
    pub(super) fn new(dims: [usize; 3], axis: usize) -> Self {
        let [nx, ny, nz] = dims;
        let (axes, stride, transposed) = match axis {
            0 => ([1, 2, 0], [ny, ny * nz], true),
            1 => ([0, 2, 1], [nx * ny, nx], false),
            _ => ([0, 1, 2], [nx, nx * ny], false),
        };
        let node = axes.map(|a| [1, nx, nx * ny][a]);
        Self { axes, dims: axes.map(|a| [nx, ny, nz][a]), stride, node, transposed }
    }
}

/// Parallel lines on the sheared unit lattice: line (p, q) meets slice τ at (p + offset + slope·τ) in (u, v).
#[derive(Clone, Copy, Debug)]
pub(super) struct Shear {
    pub layout: Layout,
    /// World unit direction in which τ grows.
    pub omega: DVec3,
    /// Steps along u and v per slice, each in [−1, 1].
    pub slope: [f64; 2],
    /// The lattice's jitter, [0, 1).
    pub offset: [f64; 2],
    /// World area that one line stands for, across it.
    pub area: f64,
}

impl Shear {
    /// The lines along ±`omega`.
    pub(super) fn new(lattice: &Lattice, omega: DVec3, offset: [f64; 2]) -> Self {
        let mut omega = omega;
        let mut d = lattice.direction_to_index(omega);
        let size = d.abs();
        let axis = if size.z >= size.x && size.z >= size.y { 2 } else { usize::from(size.y >= size.x) };
        if d[axis] < 0.0 {
            (omega, d) = (-omega, -d);
        }
        let layout = Layout::new(lattice.dims(), axis);
        let [u, v, a] = layout.axes;
        let area = lattice.axes().col(u).cross(lattice.axes().col(v)).dot(omega).abs();
        Self { layout, omega, slope: [d[u] / d[a], d[v] / d[a]], offset, area }
    }

    /// Whole and broken part of the offset of slice `k` along u (0) or v (1): line p runs through cell column p +
    /// whole.
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "a few thousand cells")]
    pub(super) fn shift(&self, axis: usize, k: f64) -> (isize, f64) {
        let x = self.offset[axis] + self.slope[axis] * k;
        (x.floor() as isize, x - x.floor())
    }
}

/// `directions`/2 lines, low-discrepancy and uniform over the projective sphere in **world** space, each family with
/// its own lattice offset: a Fibonacci lattice of the hemisphere \[Marques13\], turned at random. Sets of different
/// keys are independent; the `parts` of one are interleaved, and together as well distributed as one set of that
/// many more. The first 2, 4, 8 … parts of a power of two of them are evenly spread, too.
#[allow(clippy::cast_possible_truncation, reason = "at most 2³¹ directions")]
pub(super) fn lines(lattice: &Lattice, key: Key, directions: usize, (part, parts): (usize, usize)) -> Vec<Shear> {
    let (set, mut rng) = (key.set(), key.stream());
    let count = (directions / 2).max(1) as u32;
    let turn = rotation([rng.unit(), rng.unit(), rng.unit()]);
    let (shift, phase) = (rng.unit(), rng.unit());
    let (part, parts) = (part as u32, parts as u32);
    // Halves and quarters of a power of two, in the order in which they come, are every second and fourth direction.
    let place = if parts > 1 && parts.is_power_of_two() { part.reverse_bits() >> (32 - parts.ilog2()) } else { part };
    let mut all: Vec<Shear> = (0..count)
        .map(|n| {
            let i = n * parts + place;
            let z = (f64::from(i) + shift) / f64::from(count * parts);
            let phi = TAU * (f64::from(i) * GOLDEN_RATIO + phase).fract();
            let r = (1.0 - z * z).max(0.0).sqrt();
            let omega = turn * DVec3::new(r * phi.cos(), r * phi.sin(), z);
            // Runs of a power of two are stratified, and so are several of them.
            Shear::new(lattice, omega, set.point2(part * count + n, 0))
        })
        .collect();
    // The x-dominant families come last: they read a transposed copy.
    all.sort_by_key(|s| (s.layout.transposed, s.layout.axes[2]));
    all
}

const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;

/// A rotation uniform over all from three uniforms. \[Shoemake92\]
fn rotation([u, v, w]: [f64; 3]) -> DMat3 {
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    let ((s1, c1), (s2, c2)) = ((TAU * v).sin_cos(), (TAU * w).sin_cos());
    DMat3::from_quat(DQuat::from_xyzw(a * s1, a * c1, b * s2, b * c2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    #[test]
    fn a_shear_is_its_direction_whatever_the_axes() {
        let axes = DMat3::from_cols(DVec3::new(-0.5, 0.1, 0.0), DVec3::new(0.2, 0.7, 0.0), DVec3::new(0.0, 0.3, 9.0));
        let lattice = Lattice::new([5, 4, 6], DVec3::ZERO, axes).unwrap();
        let mut total = 0.0;
        for s in lines(&lattice, Stage::Sweep.key(1, 2), 256, (0, 1)) {
            let [u, v, a] = s.layout.axes;
            let step = s.slope[0] * axes.col(u) + s.slope[1] * axes.col(v) + axes.col(a);
            assert!((step.normalize() - s.omega).length() < 1e-12);
            assert!(s.slope.iter().all(|x| x.abs() <= 1.0));
            // Lines fill space: area across × world length of a slice step is the cell's volume.
            assert!((s.area * step.length() / lattice.cell_volume() - 1.0).abs() < 1e-12);
            total += s.omega.z * s.omega.z;
        }
        assert!((total / 128.0 - 1.0 / 3.0).abs() < 1e-2, "uniform over the sphere: {total}");
    }

    /// The largest distance of any direction to the nearest line of a set: 2.3/√n for a good one, three times that for
    /// a random one.
    #[test]
    fn parts_of_a_set_cover_the_sphere_together() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let hole = |all: &[Shear]| {
            let mut rng = Rng::stream(1, Stage::Test, 0);
            let worst = (0..4000).map(|_| {
                let d = crate::warp::sphere(rng.unit2());
                all.iter().map(|s| s.omega.dot(d).abs()).fold(0.0, f64::max).min(1.0).acos()
            });
            worst.fold(0.0, f64::max) * (all.len() as f64).sqrt()
        };
        let parts = |indices: [u64; 4]| -> Vec<Shear> {
            (0..4).flat_map(|part| lines(&lattice, Stage::Sweep.key(1, indices[part]), 128, (part, 4))).collect()
        };
        let (one, others) = (hole(&parts([7; 4])), hole(&parts([7, 8, 9, 10])));
        let whole = hole(&lines(&lattice, Stage::Sweep.key(1, 7), 512, (0, 1)));
        let first: Vec<Shear> =
            (0..2).flat_map(|part| lines(&lattice, Stage::Sweep.key(1, 7), 128, (part, 4))).collect();
        let half = hole(&first);
        println!("holes: a whole set {whole:.2}, four parts {one:.2}, two {half:.2}, parts of four sets {others:.2}");
        assert!(one < 1.02 * whole && others > 1.2 * whole && half < 1.2 * whole);
    }
}
