//! What lines bring to nodes that are not on a side: each takes the four around it by bilinear weights, times the
//! cosine of its normal.

use super::normals::decode;
use super::pack::LANES;

/// What two rows of lines, the nearer one first, bring to a row of nodes.
pub(super) struct Lines<'a> {
    /// Radiance per channel.
    pub rows: [[&'a [f32]; 3]; 2],
    /// The line just beyond node 0, −1 of which is missing.
    pub first: usize,
    /// Weights of the line before, and of the row before.
    pub shift: [f32; 2],
    /// The lines' direction times what |ω·N| weighs.
    pub omega: [f32; 3],
}

/// |ω·N|, times N's length.
#[inline(always)]
pub(super) fn cosine(omega: [f32; 3], normal: u32) -> f32 {
    let [x, y, z] = decode(normal);
    (omega[0] * x + omega[1] * y + omega[2] * z).abs()
}

/// Adds what `lines` bring to nodes a..b of a row with these `normals`, none of them on a side, to its irradiance `e`.
#[inline(always)]
pub(super) fn accumulate_row(lines: &Lines, normals: &[u32], e: &mut [&mut [f32]; 3], (a, b): (usize, usize)) {
    let last = normals.len() - 1;
    if last <= LANES {
        (a..b).for_each(|i| accumulate_some::<1>(lines, normals, e, i, (i, b)));
        return;
    }
    for from in (a..b).step_by(LANES) {
        // The last ones once more, those that are done for nothing: no node is left for slower code.
        accumulate_some::<LANES>(lines, normals, e, from.min(last - LANES), (from, b));
    }
}

/// Adds what `lines` bring to those of `N` nodes from `at` on that lie in `from..to`.
#[inline(always)]
fn accumulate_some<const N: usize>(
    lines: &Lines,
    normals: &[u32],
    e: &mut [&mut [f32]; 3],
    at: usize,
    (from, to): (usize, usize),
) {
    let [fu, fv] = lines.shift;
    let w = [(1.0 - fv) * (1.0 - fu), (1.0 - fv) * fu, fv * (1.0 - fu), fv * fu];
    let line = lines.first + at;
    let normals: &[u32; N] = normals[at..].first_chunk().expect("N nodes");
    let cos = normals.map(|n| cosine(lines.omega, n));
    for (c, e) in e.iter_mut().enumerate() {
        let [near, far] = [lines.rows[0][c], lines.rows[1][c]];
        let some = |l: &[f32]| -> [f32; N] { *l.first_chunk().expect("N lines") };
        let [l0, l1, l2, l3] =
            [some(&near[line..]), some(&near[line - 1..]), some(&far[line..]), some(&far[line - 1..])];
        let e: &mut [f32; N] = e[at..].first_chunk_mut().expect("N nodes");
        for i in 0..N {
            let brought = cos[i] * ((w[0] * l0[i] + w[1] * l1[i]) + (w[2] * l2[i] + w[3] * l3[i]));
            e[i] += if (from..to).contains(&(at + i)) { brought } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::normals::encode;
    use super::*;
    use crate::isa::Isa;
    use crate::rng::{Rng, Stage};
    use glam::DVec3;

    /// Of every range of long and short rows: nodes in it get what the formula says, others nothing, the same bits by
    /// all instruction sets.
    #[test]
    fn nodes_take_the_four_lines_around_them() {
        let (shift, omega) = ([0.3, 0.8], [0.1, 0.0, 0.5]);
        let w = [0.2 * 0.7, 0.2 * 0.3, 0.8 * 0.7, 0.8 * 0.3];
        for nu in [5, 17, 18, 19, 33, 50] {
            let mut rng = Rng::stream(1, Stage::Test, nu as u64);
            let mut some = |n: usize| -> Vec<f32> { (0..n).map(|_| rng.unit() as f32).collect() };
            // Nobody reads beyond the lines around the last node that is not on a side.
            let rows: [[Vec<f32>; 3]; 2] = [0, 1].map(|_| [0; 3].map(|_| some(nu + 1)));
            let before: [Vec<f32>; 3] = [0; 3].map(|_| some(nu));
            let normals: Vec<u32> =
                (0..nu).map(|i| encode(DVec3::new((i as f64).sin(), (i as f64).cos(), 1.0).normalize())).collect();
            let lines = Lines { rows: rows.each_ref().map(|r| r.each_ref().map(|l| &l[..])), first: 2, shift, omega };
            for (a, b) in [(1, nu - 1), (2, 3), (nu / 2, nu - 1), (1, nu / 2 + 1), (3, 3)] {
                let added = |isa: Isa| {
                    let mut e = before.clone();
                    let [x, y, z] = &mut e;
                    isa.accumulate(&lines, &normals, &mut [x, y, z], (a, b));
                    e
                };
                let e = added(Isa::PLAIN);
                Isa::found().into_iter().for_each(|isa| assert_eq!(added(isa), e, "{}", isa.name()));
                for (c, e) in e.iter().enumerate() {
                    for i in 0..nu {
                        let light = |(n, l): (usize, usize)| rows[n][c][i + l];
                        let mean = || w.iter().zip([(0, 2), (0, 1), (1, 2), (1, 1)]).map(|(w, l)| w * light(l)).sum();
                        let mean: f32 = if (a..b).contains(&i) { mean() } else { 0.0 };
                        let brought = cosine(omega, normals[i]) * mean;
                        assert!(
                            (e[i] - before[c][i] - brought).abs() < 1e-5 * (1.0 + brought),
                            "{i} of {nu}, {a}..{b}"
                        );
                    }
                }
            }
        }
    }
}
