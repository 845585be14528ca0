//! Light at nodes of a lattice, sharpened by what interpolation blurs. \[Condat05\]

use crate::node_set::NodeSet;
use rayon::prelude::*;

/// Nodes sharpened on a block of the lattice.
const BLOCK: usize = 4096;

/// What `value` tells of a node of a lattice with so many along x, y and z, less `share` of its second differences
/// along the axes on both sides of which there is light. Light that rises evenly stays as it is; some may become less
/// than black.
#[inline]
pub(crate) fn sharpened<const N: usize>(
    dims: [usize; 3],
    node: usize,
    share: f32,
    value: impl Fn(usize) -> Option<[f32; N]>,
) -> Option<[f32; N]> {
    let here = value(node)?;
    let mut sharp = here;
    let mut step = 1;
    for n in dims {
        if (1..n - 1).contains(&(node / step % n))
            && let (Some(before), Some(behind)) = (value(node - step), value(node + step))
        {
            for c in 0..N {
                sharp[c] -= share * ((before[c] - here[c]) + (behind[c] - here[c]));
            }
        }
        step *= n;
    }
    Some(sharp)
}

/// All nodes `looked_at` as [`sharpened`] has them, of the `values` of those that are `stored`; NaN, which also stands
/// for no light, at the others.
pub(crate) fn sharpen(
    stored: &NodeSet,
    values: &[[f32; 3]],
    looked_at: &NodeSet,
    dims: [usize; 3],
    share: f32,
) -> Vec<[f32; 3]> {
    let points: usize = dims.iter().product();
    let value = |o: usize| stored.slot(o).map(|slot| values[slot]).filter(|v| !v[0].is_nan());
    let mut sharp = vec![[f32::NAN; 3]; values.len()];
    stored.split(&mut sharp, BLOCK).into_par_iter().enumerate().for_each(|(block, out)| {
        let first = block * BLOCK;
        let before = stored.before(first);
        for o in looked_at.members(first..points.min(first + BLOCK)) {
            if let Some(light) = sharpened(dims, o, share, value) {
                out[stored.before(o) - before] = light;
            }
        }
    });
    sharp
}

#[cfg(test)]
mod tests {
    use super::*;

    const DIMS: [usize; 3] = [9, 8, 7];
    const SHARE: f32 = 1.0 / 12.0;

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
        let sharp = sharpen(&all, &values, &all, DIMS, SHARE);
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
        let sharp = sharpen(&stored, &values, &looked_at, DIMS, SHARE);
        for o in 0..points {
            let Some(slot) = stored.slot(o) else { continue };
            let x = place(o)[0];
            match sharp[slot][0] {
                found if !looked_at.contains(o) => assert!(found.is_nan()),
                found if [0.0, 3.0, 5.0, 8.0].contains(&x) => assert_eq!(found, values[slot][0]),
                found => assert!((found - values[slot][0] + 2.0 * SHARE).abs() < 1e-5),
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
        let sharp = sharpen(&all, &values, &all, DIMS, SHARE);
        assert_eq!((sharp[lit], sharp[lit + 1], sharp[lit - DIMS[0]]), ([18.0; 3], [-1.0; 3], [-1.0; 3]));
        assert!((sharp.iter().map(|v| v[1]).sum::<f32>() - 12.0).abs() < 1e-4);
    }
}
