//! Fans of lines from a luminaire's point through every slice of the lattice: along each the running extrema of h tell
//! which samples see the point on their own level set.

mod fan;

use super::gaps::HiddenRanges;
use super::grid::Geometry;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::scene::Scene;
use crate::volume::Lattice;
pub(super) use fan::{Fan, Kept};
use fan::{Scratch, Through};
use glam::DVec3;
use rayon::prelude::*;

/// A sample of a fan that lies in Ω; what it sees of its source on either side.
pub(super) const SAMPLED: u8 = 1;
pub(super) const LOWER: u8 = 2;
pub(super) const HIGHER: u8 = 4;
/// One of a turn, in the bits above: what is left of turns before is like no sample.
pub(super) const TURN: u8 = 8;

/// The six fans of a point, and what their lines see.
#[derive(Default)]
pub(super) struct Fans {
    pub source: DVec3,
    /// The last node of the lattice.
    pub far: [f64; 3],
    /// What is seen of the source before anything of Ω is passed: lower, higher side.
    pub entering: [f32; 2],
    pub fans: [Option<Fan>; 6],
    /// What their lines see, [fan][row][slice][line], where that is [`Kept`], and what is left of other points' fans.
    pub seen: Vec<u8>,
    /// A multiple of [`TURN`].
    pub turn: u8,
}

impl Fans {
    /// Marches along all lines of the fans of local point `y`, where `start` is the greatest and least h so far, side
    /// by side: the rows of one fan alone are too few for threads to share well. They take the place of another
    /// point's: memory that is new, or cleared, for every point would be written as a whole.
    pub(super) fn march(&mut self, (geometry, isa, sides): (&Geometry, Isa, &[Side]), y: DVec3, start: [f32; 2]) {
        self.source = y;
        self.far = geometry.dims.map(|n| (n - 1) as f64);
        self.entering = [start[0] == f32::NEG_INFINITY, start[1] == f32::INFINITY].map(f32::from);
        self.fans = std::array::from_fn(|f| Fan::new(geometry.dims, y, f % 3, f >= 3));
        self.turn = self.turn.wrapping_add(TURN);
        if self.turn == 0 {
            self.seen.par_chunks_mut(1 << 20).for_each(|seen| seen.fill(0));
            self.turn = TURN;
        }
        let turn = self.turn;
        let length = self.fans.iter_mut().flatten().fold(0, |begin, fan| fan.place(begin));
        if self.seen.len() < length {
            self.seen = Vec::new();
            self.seen = vec![0; length];
        }
        let (mut rows, mut rest) = (Vec::new(), &mut self.seen[..]);
        for fan in self.fans.iter().flatten() {
            for row in 0..fan.rows.len() {
                let out;
                (out, rest) = rest.split_at_mut(fan.length(row));
                rows.push((fan, row, out));
            }
        }
        rows.into_par_iter().with_max_len(8).for_each_init(
            || Scratch { hidden: geometry.has_gaps().then(HiddenRanges::default), ..Scratch::default() },
            |scratch, (fan, row, out)| {
                let order = geometry.order(&fan.layout);
                let awake = std::array::from_fn(|s| Some(&order.awake[sides.get(s)?.index()]));
                let through = Through { isa, h: &order.h, awake, start, turn };
                fan.march(&through, row, scratch, out);
            },
        );
    }
}

/// Bytes of what the fans of luminaires' middles and corners see on `lattice`, at most.
pub(crate) fn seen(scene: &Scene, lattice: &Lattice) -> u64 {
    let of = |x: DVec3| {
        let y = lattice.to_index(x);
        let fans = (0..6).filter_map(|f| Fan::new(lattice.dims(), y, f % 3, f >= 3));
        fans.flat_map(|fan| fan.kept).map(|kept| kept.count[0] as u64 * kept.count[1] as u64).sum()
    };
    let points = scene.luminaires().iter().flat_map(|light| light.vertices().iter().copied().chain([light.middle()]));
    points.map(of).max().unwrap_or(0)
}

/// What lines from number `start` on see that meet u = place\[0\] + n · place\[1\] (line n) in a row of samples, in
/// this turn; takes the row into their extrema.
#[inline(always)]
pub(super) fn march_row(
    row: &[f32],
    [u0, du]: [f32; 2],
    start: usize,
    [most, least]: [&mut [f32]; 2],
    out: &mut [u8],
    turn: u8,
) {
    for (n, ((most, least), out)) in most.iter_mut().zip(least).zip(out).enumerate().skip(start) {
        let x = sample(row, [u0, du], n);
        let seen = u8::from(x > *most) * LOWER + u8::from(x <= *least) * HIGHER + SAMPLED;
        *out = if x.is_nan() { 0 } else { seen + turn };
        // f32::max and min pass over NaN.
        *most = most.max(x);
        *least = least.min(x);
    }
}

/// h where line `n` meets a row of samples, as [`march_row`] has them.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the row")]
pub(super) fn sample(row: &[f32], [u0, du]: [f32; 2], n: usize) -> f32 {
    let u = (u0 + n as f32 * du).max(0.0);
    let i = (u as usize).min(row.len() - 2);
    let (a, b) = (row[i], row[i + 1]);
    a + (u - i as f32) * (b - a)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::rng::{Rng, Stage};
    use crate::sweep::pack::LANES;
    use crate::volume::{Lattice, Samples, Volume};

    /// Noise, of which x ≤ `most` is in the sweep: elsewhere lines are not marched along, and what others saw stays.
    /// Sample `missing` is no number.
    pub(in crate::sweep) fn noise(dims: [usize; 3], most: usize, missing: Option<usize>) -> Field {
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let mut rng = Rng::stream(3, Stage::Test, 0);
        let low = |at: usize| if at % dims[0] > most { -7.0 } else { 0.0 };
        let mut samples: Vec<f32> = (0..lattice.len()).map(|at| low(at) + rng.unit() as f32).collect();
        missing.iter().for_each(|&at| samples[at] = f32::NAN);
        Field::new(&Volume::new("noise", lattice, Samples::F32(samples)).unwrap(), Sweep::new(0.0, 1.0).unwrap())
            .unwrap()
    }

    impl Fan {
        /// Where what line (p, q) sees in the slice at `step` is kept.
        pub(in crate::sweep) fn at(&self, [p, q]: [usize; 2], step: usize) -> Option<usize> {
            let kept = self.kept[step];
            let within = |n: usize, x: usize| (kept.first[n]..kept.first[n] + kept.count[n]).contains(&x);
            (within(0, p) && within(1, q)).then(|| self.line_zero(q, step).wrapping_add(p))
        }
    }

    /// What node x sees, beside others of its row.
    pub(in crate::sweep) fn visibility(fans: &Fans, [i, j, k]: [usize; 3]) -> Option<[f32; 2]> {
        let seen = fans.visibility([i / LANES * LANES, j, k], &[true; LANES]);
        let lane = i % LANES;
        seen.known[lane].then(|| seen.shares.map(|shares| shares[lane]))
    }

    /// From sources beyond Ω's sides, edges and corners: a line's sample is lit if it exceeds h where the line enters
    /// Ω and in all slices from there on.
    #[test]
    fn lines_know_where_they_enter() {
        let field = noise([17, 12, 14], 8, None);
        let (geometry, isa, sides) = (Geometry::new(&field), Isa::current(), Side::BOTH);
        let (far, in_sweep) = (field.lattice().far(), |h: f32| (0.0..=1.0).contains(&h));
        let mut fans = Fans::default();
        let (mut known, mut entries) = ([0; 2], 0);
        for y in [
            [-3.0, 5.2, 6.1],
            [20.3, 3.0, 7.7],
            [8.0, -0.4, 15.5],
            [4.4, 14.0, -2.0],
            [-1.5, -2.5, 17.0],
            [7.9, 6.3, 15.2],
        ] {
            let y = DVec3::from_array(y);
            fans.march((&geometry, isa, &sides), y, [f32::NEG_INFINITY, f32::INFINITY]);
            for fan in fans.fans.iter().flatten() {
                let [u, v, a] = fan.layout.axes;
                for line in 0..fan.count[0] * fan.count[1] {
                    let (p, q) = (line % fan.count[0], line / fan.count[0]);
                    let at = |tau: f64| {
                        let ratio = (tau - y[a]) / fan.depth;
                        let mut x = DVec3::ZERO;
                        x[u] = y[u] + (fan.first[0] as f64 + p as f64 - y[u]) * ratio;
                        x[v] = y[v] + (fan.first[1] as f64 + q as f64 - y[v]) * ratio;
                        x[a] = tau;
                        x
                    };
                    let inside = |x: DVec3| x.cmpge(DVec3::splat(-1e-9)).all() && x.cmple(far + 1e-9).all();
                    // By bisection, which knows nothing of sides.
                    let mut extrema: Option<[f32; 2]> = None;
                    for step in 0..fan.slices.1 {
                        let k = fan.slice(step) as f64;
                        if !inside(at(k)) {
                            continue;
                        }
                        let [mut most, mut least] = extrema.unwrap_or([f32::NEG_INFINITY, f32::INFINITY]);
                        if extrema.is_none() {
                            let (mut out, mut within) = (if step == 0 { y[a] } else { fan.slice(step - 1) as f64 }, k);
                            for _ in 0..60 {
                                let middle = 0.5 * (out + within);
                                *(if inside(at(middle)) { &mut within } else { &mut out }) = middle;
                            }
                            let h = field.value(at(within).clamp(DVec3::ZERO, far)) as f32;
                            (most, least) = (most.max(h), least.min(h));
                            entries += usize::from((within - k).abs() > 1e-6);
                        }
                        let h = field.value(at(k).clamp(DVec3::ZERO, far)) as f32;
                        let seen = fans.seen[fan.at([p, q], step).expect("lines that meet Ω are kept")];
                        // What others hide below the sweep, or above, lines need not know.
                        if seen & !(TURN - 1) == fans.turn && seen & SAMPLED != 0 && in_sweep(h) {
                            for (n, (bit, margin)) in [(LOWER, h - most), (HIGHER, least - h)].into_iter().enumerate() {
                                if !(margin.abs() < 1e-5) {
                                    assert_eq!(seen & bit != 0, margin > 0.0, "{y} {} {h} {most} {least}", at(k));
                                    known[n] += 1;
                                }
                            }
                        }
                        extrema = Some([most.max(h), least.min(h)]);
                    }
                }
            }
        }
        println!("{known:?} {entries}");
        assert!(known[0] > 3000 && known[1] > 3000 && entries > 1000, "{known:?} {entries}");
    }

    /// From sources far away, whose lines are as good as parallel: as many as slices have nodes.
    #[test]
    fn fans_of_far_points_are_no_larger_than_the_lattice() {
        let field = noise([17, 12, 14], 8, Some(18));
        let (geometry, isa, sides) = (Geometry::new(&field), Isa::current(), Side::BOTH);
        let middle = DVec3::new(8.0, 5.5, 6.5);
        let (mut known, mut lit) = (0, 0);
        for to in [DVec3::Z, DVec3::new(0.3, -0.2, 1.0), DVec3::new(-1.0, 0.9, 0.0), DVec3::new(1.0, 1.0, -1.0)] {
            let fans = [1e5, 1e6, 1e7].map(|far| {
                let mut fans = Fans::default();
                fans.march((&geometry, isa, &sides), middle + far * to, [f32::NEG_INFINITY, f32::INFINITY]);
                // A lattice for each pyramid that it may lie in, sheared by no more than its depth.
                assert!(fans.seen.len() < 6 * 32 * 32 * 32, "{to} {far}: {}", fans.seen.len());
                fans
            });
            for at in (0..geometry.h.len()).filter(|&at| geometry.lit(at)) {
                let x = field.lattice().ijk(at);
                let [near, far, farther] = fans.each_ref().map(|fans| visibility(fans, x));
                // Beside the sample that is no number lines know nothing.
                let beside = x.iter().all(|x| *x < 3);
                assert!(beside || near.is_some() && far.is_some(), "{to} {x:?}");
                // As good as parallel.
                let alike = |a: Option<[f32; 2]>, b: Option<[f32; 2]>| {
                    a.zip(b).is_some_and(|(a, b)| (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 0.1)
                };
                known += 1;
                lit += usize::from(alike(near, far) && alike(far, farther));
            }
        }
        assert!(known > 3000 && lit * 20 > known * 19, "{lit} of {known}");
    }

    /// Lines spread from a source in a long volume, most of which leave it after a few slices.
    #[test]
    fn fans_of_long_volumes_hold_what_meets_these() {
        let field = noise([400, 5, 4], 400, None);
        let (geometry, isa) = (Geometry::new(&field), Isa::current());
        let mut fans = Fans::default();
        fans.march((&geometry, isa, &[Side::Lower]), DVec3::new(13.3, 2.2, 1.7), [0.3; 2]);
        assert!(fans.seen.len() < 400 * 400 * 40, "{} bytes", fans.seen.len());
        let known = |&at: &usize| visibility(&fans, field.lattice().ijk(at)).is_some();
        assert_eq!((0..geometry.h.len()).filter(known).count(), geometry.h.len());
    }

    /// From sources within the lattice and outside, one after the other and whole rounds of turns apart.
    #[test]
    fn fans_of_other_points_leave_nothing() {
        let (field, small) = (noise([17, 12, 14], 8, Some(18)), noise([3, 3, 3], 3, Some(4)));
        let (geometry, small) = (Geometry::new(&field), Geometry::new(&small));
        let (isa, sides) = (Isa::current(), Side::BOTH);
        let mut rng = Rng::stream(4, Stage::Test, 0);
        let mut fans = Fans::default();
        let mut partial = 0;
        for n in 0..60 {
            let mut y = DVec3::new(rng.unit(), rng.unit(), rng.unit()) * DVec3::new(16.0, 11.0, 13.0);
            if n % 3 == 0 {
                y.z = 14.0 + rng.unit();
            }
            let mut new = Fans::default();
            // Both sides march along all lines, one along those in the sweep.
            let sides = &sides[..1 + n % 2];
            fans.march((&geometry, isa, sides), y, [0.3; 2]);
            new.march((&geometry, isa, sides), y, [0.3; 2]);
            for x in (0..geometry.h.len()).map(|at| field.lattice().ijk(at)) {
                let seen = visibility(&fans, x);
                assert_eq!(seen, visibility(&new, x), "point {n}, {x:?}");
                partial += usize::from(seen.is_some_and(|s| s[0] > 0.0 && s[0] < 1.0));
            }
            // Until the next has the same turn.
            for _ in 0..if n % 2 == 1 { u8::MAX / TURN - 1 } else { 0 } {
                fans.march((&small, isa, sides), DVec3::splat(1.3), [0.3; 2]);
            }
        }
        assert!(partial > 1000, "{partial}");
    }
}
