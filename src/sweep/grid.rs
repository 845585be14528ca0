//! The lattice's share of the sweep: planes of normals, radiance and irradiance, their transposition, and the filling
//! of nodes without a surface.

use super::directions::Layout;
use crate::field::Field;
use glam::DVec3;
use rayon::prelude::*;

/// Normals are stored in units of 1/32767.
pub(super) const NORMAL_SCALE: f32 = 32767.0;

/// Nodes this far outside the sweep, in its units, are still lit.
const OVERSHOOT: f32 = 0.1;

/// Red, green and blue, a plane each, so that neighbouring lines load neighbouring numbers.
pub(super) type Planes = [Vec<f32>; 3];

/// `n` black values.
pub(super) fn black(n: usize) -> Planes {
    std::array::from_fn(|_| vec![0.0; n])
}

/// What every pass reads: h and the receiver normals towards the lower side, in both memory orders.
pub(super) struct Geometry<'a> {
    pub dims: [usize; 3],
    pub h: &'a [f32],
    h_transposed: Vec<f32>,
    normals: [Vec<i16>; 3],
    normals_transposed: [Vec<i16>; 3],
    /// Nodes that hold a surface of the sweep.
    pub valid: Vec<bool>,
    /// Nodes that are lit: the valid ones, and those just outside the sweep, whose own light is a better neighbour to
    /// interpolate with than a copy.
    pub lit: Vec<bool>,
    rings: Vec<Vec<u32>>,
}

impl<'a> Geometry<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "a unit vector in 16 bits")]
    pub(super) fn new(field: &'a Field) -> Self {
        let (dims, h) = (field.lattice().dims(), field.samples());
        let encoded: Vec<[i16; 3]> = (0..h.len())
            .into_par_iter()
            .with_min_len(1 << 12)
            .map(|at| {
                let g = -field.node_gradient(field.lattice().ijk(at));
                let scale = g.abs().max_element();
                if !(scale > 0.0 && scale.is_finite()) {
                    return [0; 3];
                }
                ((g / scale).normalize() * f64::from(NORMAL_SCALE)).to_array().map(|x| x.round() as i16)
            })
            .collect();
        let valid: Vec<bool> = h.iter().zip(&encoded).map(|(h, n)| (0.0..=1.0).contains(h) && *n != [0; 3]).collect();
        let normals: [Vec<i16>; 3] = std::array::from_fn(|a| encoded.iter().map(|n| n[a]).collect());
        let normals_transposed = std::array::from_fn(|a| transposed(&normals[a], dims));
        let lit: Vec<bool> =
            h.iter().zip(&encoded).map(|(h, n)| (-OVERSHOOT..=1.0 + OVERSHOOT).contains(h) && *n != [0; 3]).collect();
        let rings = rings(dims, &lit);
        Self { dims, h, h_transposed: transposed(h, dims), normals, normals_transposed, valid, lit, rings }
    }

    /// h in the memory order of `layout`.
    pub(super) fn h(&self, layout: &Layout) -> &[f32] {
        if layout.transposed { &self.h_transposed } else { self.h }
    }

    /// Normals in the memory order of `layout`.
    pub(super) fn normals(&self, layout: &Layout) -> &[Vec<i16>; 3] {
        if layout.transposed { &self.normals_transposed } else { &self.normals }
    }

    /// The unit normal of a node towards the lower side; `None` where none is lit.
    pub(super) fn normal(&self, at: usize) -> Option<DVec3> {
        if !self.lit[at] {
            return None;
        }
        DVec3::from_array(std::array::from_fn(|a| f64::from(self.normals[a][at]))).try_normalize()
    }

    /// Gives nodes without a surface the mean of their neighbours that have one (or were filled before), so that
    /// interpolation near the sweep's ends meets no black.
    pub(super) fn fill(&self, planes: &mut Planes) {
        let mut known = self.lit.clone();
        let [nx, ny, nz] = self.dims;
        for ring in &self.rings {
            let known_before = &known;
            let values: Vec<[f32; 3]> = ring
                .par_iter()
                .with_min_len(1 << 10)
                .map(|&at| {
                    let (mut sum, mut count) = ([0f32; 3], 0f32);
                    neighbours([nx, ny, nz], at as usize, |n| {
                        if known_before[n] {
                            (0..3).for_each(|c| sum[c] += planes[c][n]);
                            count += 1.0;
                        }
                    });
                    sum.map(|s| s / count.max(1.0))
                })
                .collect();
            for (&at, v) in ring.iter().zip(values) {
                (0..3).for_each(|c| planes[c][at as usize] = v[c]);
            }
            ring.iter().for_each(|&at| known[at as usize] = true);
        }
    }
}

fn neighbours([nx, ny, nz]: [usize; 3], at: usize, mut visit: impl FnMut(usize)) {
    let (i, j, k) = (at % nx, at / nx % ny, at / (nx * ny));
    for z in k.saturating_sub(1)..(k + 2).min(nz) {
        for y in j.saturating_sub(1)..(j + 2).min(ny) {
            for x in i.saturating_sub(1)..(i + 2).min(nx) {
                visit((z * ny + y) * nx + x);
            }
        }
    }
}

/// Nodes without surface that share a cell with a valid node, then those that share a cell with these.
#[allow(clippy::cast_possible_truncation, reason = "nodes are numbered in 32 bits")]
fn rings(dims: [usize; 3], valid: &[bool]) -> Vec<Vec<u32>> {
    let mut known = valid.to_vec();
    (0..2)
        .map(|_| {
            let ring: Vec<u32> = (0..known.len())
                .into_par_iter()
                .with_min_len(1 << 12)
                .filter(|&at| {
                    let mut any = false;
                    if !known[at] {
                        neighbours(dims, at, |n| any |= known[n]);
                    }
                    any
                })
                .map(|at| at as u32)
                .collect();
            ring.iter().for_each(|&at| known[at as usize] = true);
            ring
        })
        .collect()
}

/// Columns of x are moved this many at a time: a cache line of f32.
const STRIP: usize = 16;

/// x, y, z order to y, z, x.
pub(super) fn transposed<T: Copy + Default + Send + Sync>(from: &[T], [nx, ny, nz]: [usize; 3]) -> Vec<T> {
    let mut to = vec![T::default(); from.len()];
    to.par_chunks_mut(STRIP * ny * nz).enumerate().for_each(|(strip, out)| {
        let x0 = strip * STRIP;
        let width = STRIP.min(nx - x0);
        for (row, line) in from.chunks_exact(nx).enumerate() {
            // Row (y, z) in memory order has number z·ny + y in both orders.
            for (x, &value) in line[x0..x0 + width].iter().enumerate() {
                out[x * ny * nz + row] = value;
            }
        }
    });
    to
}

/// y, z, x order back to x, y, z; `dims` are still those of x, y, z.
pub(super) fn untransposed<T: Copy + Default + Send + Sync>(from: &[T], [nx, ny, nz]: [usize; 3]) -> Vec<T> {
    let mut to = vec![T::default(); from.len()];
    let rows = 64.min(ny * nz);
    to.par_chunks_mut(rows * nx).enumerate().for_each(|(chunk, out)| {
        for x in 0..nx {
            let column = &from[x * ny * nz + chunk * rows..];
            for (row, line) in out.chunks_exact_mut(nx).enumerate() {
                line[x] = column[row];
            }
        }
    });
    to
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transposition_is_undone() {
        let dims = [19, 7, 5];
        let from: Vec<f32> = (0..19 * 7 * 5).map(|i| i as f32).collect();
        let to = transposed(&from, dims);
        // (x, y, z) = (17, 3, 4).
        assert_eq!(to[(17 * 5 + 4) * 7 + 3], from[(4 * 7 + 3) * 19 + 17]);
        assert_eq!(untransposed(&to, dims), from);
    }
}
