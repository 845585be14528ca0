//! Nodes sharpened by what interpolation blurs.

use crate::node_set::NodeSet;
use rayon::prelude::*;

/// What a hit finds is interpolated between two nodes along every axis: on average over all places E + E″/12, too
/// bright in hollows, where the next bounce carries it on. So much of their second differences is taken off the nodes.
/// \[Condat05\]
const SHARPENING: f32 = 1.0 / 12.0;

/// Nodes sharpened on a block of the lattice.
const BLOCK: usize = 4096;

/// What the nodes `looked_at` hold, of all that are `stored` on a lattice of so many nodes along x, y and z, sharpened
/// along the axes on both sides of which there is light; NaN at the others. Some may be less than black: what hits find
/// is averaged, and is to be right on average.
pub(super) fn sharpen(
    stored: &NodeSet,
    values: &[[f32; 3]],
    looked_at: &NodeSet,
    [nx, ny, nz]: [usize; 3],
) -> Vec<[f32; 3]> {
    let points = nx * ny * nz;
    let value = |o: usize| stored.slot(o).map(|slot| values[slot]).filter(|v| !v[0].is_nan());
    let mut sharp = vec![[f32::NAN; 3]; values.len()];
    stored.split(&mut sharp, BLOCK).into_par_iter().enumerate().for_each(|(block, out)| {
        let first = block * BLOCK;
        let before = stored.before(first);
        for o in looked_at.members(first..points.min(first + BLOCK)) {
            let (Some(here), Some(slot)) = (value(o), stored.slot(o)) else { continue };
            let mut there = here;
            for (i, n, step) in [(o % nx, nx, 1), (o / nx % ny, ny, nx), (o / (nx * ny), nz, nx * ny)] {
                if !(1..n - 1).contains(&i) {
                    continue;
                }
                if let (Some(a), Some(b)) = (value(o - step), value(o + step)) {
                    for c in 0..3 {
                        there[c] -= SHARPENING * ((a[c] - here[c]) + (b[c] - here[c]));
                    }
                }
            }
            out[slot - before] = there;
        }
    });
    sharp
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIMS: [usize; 3] = [9, 8, 7];

    fn place(o: usize) -> [f64; 3] {
        [o % DIMS[0], o / DIMS[0] % DIMS[1], o / (DIMS[0] * DIMS[1])].map(|i| i as f64)
    }

    /// Of light whose second differences are known the mean of what is interpolated over a cell is that of the light
    /// itself; without sharpening it would be off by (2 + 4 − 1) / 12.
    #[test]
    fn what_is_interpolated_is_on_average_what_is_there() {
        let light = |[x, y, z]: [f64; 3]| 100.0 + x * x + 2.0 * y * y - 0.5 * z * z + 0.5 * x * y - x;
        let points = DIMS.iter().product();
        let all = NodeSet::all(points);
        let values: Vec<[f32; 3]> = (0..points).map(|o| [light(place(o)) as f32; 3]).collect();
        let sharp = sharpen(&all, &values, &all, DIMS);
        // Linear interpolation's mean over a cell is that of its corners; a parabola's is less by its second
        // derivative / 12.
        let corners = [0, 1].map(|k| [0, 1].map(|j| [0, 1].map(|i| [3 + i, 2 + j, 4 + k]))).concat().concat();
        let mean = |of: &dyn Fn([usize; 3]) -> f64| corners.iter().map(|&at| of(at)).sum::<f64>() / 8.0;
        let found = mean(&|[i, j, k]| f64::from(sharp[(k * DIMS[1] + j) * DIMS[0] + i][0]));
        let there = mean(&|at| light(at.map(|i| i as f64))) - (2.0 + 4.0 - 1.0) / 12.0;
        assert!((found - there).abs() < 1e-4, "{found}, not {there}");
    }

    /// Along an axis on one side of which there is no light nothing is known; what nobody looks at is not there.
    #[test]
    fn ends_stay_as_they_are() {
        let points: usize = DIMS.iter().product();
        let dark = |o: usize| place(o)[0] == 4.0;
        let stored = NodeSet::new(points, |o| !dark(o));
        // Along x alone it is bent.
        let values: Vec<[f32; 3]> = stored.members(0..points).map(|o| [place(o)[0].powi(2) as f32 + 5.0; 3]).collect();
        let looked_at = NodeSet::new(points, |o| place(o)[1] > 2.0);
        let sharp = sharpen(&stored, &values, &looked_at, DIMS);
        for o in 0..points {
            let Some(slot) = stored.slot(o) else { continue };
            let x = place(o)[0];
            match sharp[slot][0] {
                found if !looked_at.contains(o) => assert!(found.is_nan()),
                found if [0.0, 3.0, 5.0, 8.0].contains(&x) => assert_eq!(found, values[slot][0]),
                found => assert!((found - values[slot][0] + 2.0 * SHARPENING).abs() < 1e-5),
            }
        }
    }

    /// Among dark nodes a lit one is as much brighter as those beside it are darker.
    #[test]
    fn light_is_kept() {
        let points = DIMS.iter().product();
        let all = NodeSet::all(points);
        let lit = DIMS[0] * DIMS[1] * 3 + DIMS[0] * 3 + 3;
        let values: Vec<[f32; 3]> = (0..points).map(|o| [if o == lit { 12.0 } else { 0.0 }; 3]).collect();
        let sharp = sharpen(&all, &values, &all, DIMS);
        assert_eq!((sharp[lit], sharp[lit + 1], sharp[lit - DIMS[0]]), ([18.0; 3], [-1.0; 3], [-1.0; 3]));
        assert!((sharp.iter().map(|v| v[1]).sum::<f32>() - 12.0).abs() < 1e-4);
    }
}
