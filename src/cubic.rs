//! Cubics in f64: where one first changes sign on an interval, by signs that the caller owns.
//!
//! A trilinear cell restricted to a ray is a cubic \[Parker99\]. Neighbouring cells must agree whether a ray crosses
//! the level set, so the signs at the ends come from outside (the shared faces), and the solver only has to say where.

/// c0 + c1 t + c2 t² + c3 t³.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cubic {
    /// Coefficients, constant first.
    pub c: [f64; 4],
}

/// Steps in which Newton may show its worth; as many halvings follow, which exhaust an f64's bits from any bracket.
const NEWTON_STEPS: usize = 64;

impl Cubic {
    /// The value at t (Horner).
    #[inline(always)]
    pub fn value(&self, t: f64) -> f64 {
        let [c0, c1, c2, c3] = self.c;
        c0 + t * (c1 + t * (c2 + t * c3))
    }

    /// The slope at t.
    #[inline(always)]
    pub fn slope(&self, t: f64) -> f64 {
        let [_, c1, c2, c3] = self.c;
        c1 + t * (2.0 * c2 + t * (3.0 * c3))
    }

    /// The cubic without its root at 0, divided by t. The caller knows that c0 is 0; what is stored there is ignored.
    #[inline(always)]
    pub fn deflate(&self) -> Self {
        Self { c: [self.c[1], self.c[2], self.c[3], 0.0] }
    }

    /// The first t in [0, end] where "inside" (value ≥ 0) changes from `inside_start`.
    ///
    /// `inside_end` is the state at `end`; if it differs from `inside_start` a t is always returned, whatever rounding
    /// makes of the coefficients. Equal states are searched for a pair of roots between the turning points: a pair
    /// closer than the rounding of the value there (a tangent ray) may be missed, one that is found is a crossing.
    #[inline(always)]
    pub fn first_crossing(&self, end: f64, inside_start: bool, inside_end: bool) -> Option<f64> {
        let mut start = 0.0;
        for turn in self.turning_points(end).into_iter().flatten() {
            if (self.value(turn) >= 0.0) != inside_start {
                return Some(self.bracketed_root(start, turn, inside_start));
            }
            start = turn;
        }
        (inside_end != inside_start).then(|| self.bracketed_root(start, end, inside_start))
    }

    /// Roots of the slope inside (0, end), ascending.
    #[inline(always)]
    fn turning_points(&self, end: f64) -> [Option<f64>; 2] {
        let [_, c1, c2, c3] = self.c;
        let (a, half_b) = (3.0 * c3, c2);
        let inside = |t: f64| (t > 0.0 && t < end).then_some(t);
        let discriminant = half_b * half_b - a * c1;
        // Not positive, or not a number: monotone as far as f64 can tell.
        if !(discriminant > 0.0) {
            return [None, None];
        }
        // The root of larger magnitude first, the other from the product: no cancellation.
        let q = -(half_b + discriminant.sqrt().copysign(half_b));
        let (r0, r1) = (q / a, c1 / q);
        if r0 < r1 { [inside(r0), inside(r1)] } else { [inside(r1), inside(r0)] }
    }

    /// The root in [lo, hi] on which the caller insists, `inside_lo` being the state at lo ≥ 0: Newton kept inside a
    /// shrinking bracket; where its steps do not halve (a triple root, a root far below the bracket's length) the
    /// bracket is halved instead, in bits, so that a root of any size is met. Ends when the bracket is as small as f64
    /// allows or the value is 0; at most 128 steps.
    #[inline(never)]
    fn bracketed_root(&self, mut lo: f64, mut hi: f64, inside_lo: bool) -> f64 {
        let middle = |lo: f64, hi: f64| f64::from_bits(lo.to_bits() + hi.to_bits().saturating_sub(lo.to_bits()) / 2);
        let (f_lo, f_hi) = (self.value(lo), self.value(hi));
        // A secant start; rounding may have left both values on one side, then the middle.
        let mut t =
            if (f_lo < 0.0) != (f_hi < 0.0) { lo + (hi - lo) * (f_lo / (f_lo - f_hi)) } else { 0.5 * (lo + hi) };
        let mut previous = f64::INFINITY;
        for n in 0..2 * NEWTON_STEPS {
            if !(t > lo && t < hi) {
                t = middle(lo, hi);
                if t <= lo || t >= hi {
                    break;
                }
            }
            let f = self.value(t);
            if f == 0.0 {
                return t;
            }
            if (f >= 0.0) == inside_lo {
                lo = t
            } else {
                hi = t
            }
            let step = (f / self.slope(t)).abs();
            let next = t - f / self.slope(t);
            if step <= 2.0 * f64::EPSILON * t {
                return next.clamp(lo, hi);
            }
            let gains = step <= 0.5 * previous && n < NEWTON_STEPS;
            (t, previous) = if gains { (next, step) } else { (middle(lo, hi), f64::INFINITY) };
        }
        t.clamp(lo, hi)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    /// a (t − r0)(t − r1)(t − r2), expanded.
    fn from_roots(a: f64, [r0, r1, r2]: [f64; 3]) -> Cubic {
        Cubic { c: [-a * r0 * r1 * r2, a * (r0 * r1 + r0 * r2 + r1 * r2), -a * (r0 + r1 + r2), a] }
    }

    #[test]
    fn first_of_three_roots() {
        let mut rng = Rng::stream(7, Stage::Test, 0);
        for _ in 0..100_000 {
            let mut r = [rng.unit(), rng.unit(), rng.unit()];
            r.sort_by(f64::total_cmp);
            let scale = 10f64.powf(60.0 * rng.unit() - 30.0);
            let p = from_roots(scale * if rng.unit() < 0.5 { -1.0 } else { 1.0 }, r);
            let (inside_start, inside_end) = (p.value(0.0) >= 0.0, p.value(1.0) >= 0.0);
            let t = p.first_crossing(1.0, inside_start, inside_end).expect("three roots in the interval");
            // Conditioning: δt = ε Σ|c_i| t^i / |p'(t)|.
            let bound = 8.0 * f64::EPSILON * p.c.iter().map(|c| c.abs()).sum::<f64>() / p.slope(t).abs() + 1e-15;
            let close = r.iter().map(|x| (x - t).abs()).fold(f64::INFINITY, f64::min);
            assert!(close <= bound, "{r:?}: {t}, off by {close}, bound {bound}");
            // Nearly double first roots may be skipped, others not.
            if r[1] - r[0] > 1e-6 {
                assert!((t - r[0]).abs() <= bound, "{r:?}: {t} is not the first");
            }
        }
    }

    #[test]
    fn a_demanded_crossing_is_always_given() {
        let mut rng = Rng::stream(7, Stage::Test, 1);
        for _ in 0..100_000 {
            let mut c = [0.0; 4];
            for x in &mut c {
                *x = (rng.unit() - 0.5) * 10f64.powf(20.0 * rng.unit() - 10.0) * f64::from(rng.unit() < 0.8);
            }
            let t = Cubic { c }.first_crossing(1.5, true, false).expect("states differ");
            assert!((0.0..=1.5).contains(&t), "{c:?}: {t}");
        }
    }

    #[test]
    fn roots_far_below_the_bracket_are_as_exact_as_others() {
        // Newton alone gains a third per step at a triple root, and no bisection of [0, 1] by length ends at 1e-15.
        for exponent in [-3, -6, -15, -30] {
            let r = 10f64.powi(exponent);
            let t = Cubic { c: [-r * r * r, 0.0, 0.0, 1.0] }.first_crossing(1.0, false, true).expect("states differ");
            assert!((t - r).abs() <= 4.0 * f64::EPSILON * r, "{t} instead of {r}");
        }
    }

    #[test]
    fn linear_quadratic_and_constant() {
        assert_eq!(Cubic { c: [-1.0, 2.0, 0.0, 0.0] }.first_crossing(1.0, false, true), Some(0.5));
        let pair = Cubic { c: [-0.1, 1.0, -1.0, 0.0] }.first_crossing(1.0, false, false).expect("a pair of roots");
        assert!((pair - (1.0 - 0.6f64.sqrt()) / 2.0).abs() < 1e-15);
        assert_eq!(Cubic { c: [-0.3, 1.0, -1.0, 0.0] }.first_crossing(1.0, false, false), None);
        assert_eq!(Cubic { c: [-1.0, 0.0, 0.0, 0.0] }.first_crossing(1.0, false, false), None);
    }

    #[test]
    fn deflation_divides_the_root_at_zero_out() {
        let p = from_roots(2.0, [0.0, 0.25, 0.75]);
        let t = p.deflate().first_crossing(1.0, true, true).expect("0.25 and 0.75 remain");
        assert!((t - 0.25).abs() < 1e-15);
    }
}
