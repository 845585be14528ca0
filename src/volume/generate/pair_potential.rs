//! Pair potentials as tables over the squared distance: one lookup gives energy and force, with neither root nor
//! exponential.

use std::fmt;

/// Energy V and slope dV/dr at a distance.
type Exact = Box<dyn Fn(f64) -> [f64; 2] + Send + Sync>;

/// Bins of a table.
const BINS: u32 = 8192;

/// Distances below this fraction of the cut-off are evaluated exactly: a table over r² is coarse there.
const INNER: f64 = 1.0 / 16.0;

/// A pair potential, cut off with shifted force: V(r) − V(r_c) − (r − r_c) V′(r_c), 0 beyond r_c, so that neither
/// energy nor force jumps. \[AT17 Ch. 5\]
///
/// Between nodes it is a cubic Hermite polynomial in r², and the force is that polynomial's own derivative: energy is
/// conserved as well as by the formula itself.
pub struct PairPotential {
    cutoff: f64,
    per_unit: f64,
    inner: f64,
    bins: Vec<[f64; 4]>,
    exact: Exact,
}

impl fmt::Debug for PairPotential {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PairPotential").field("cutoff", &self.cutoff).finish_non_exhaustive()
    }
}

impl PairPotential {
    /// The potential with V and dV/dr as `exact` gives them for r > 0, up to `cutoff` > 0.
    pub fn new(cutoff: f64, exact: impl Fn(f64) -> [f64; 2] + Send + Sync + 'static) -> Self {
        let [end, slope] = exact(cutoff);
        let shifted = move |r: f64| {
            let [v, d] = exact(r);
            [v - end - (r - cutoff) * slope, d - slope]
        };
        let width = cutoff * cutoff / f64::from(BINS);
        // In s = r²: dV/ds = V′/2r.
        let node = |n: u32| {
            let r = (f64::from(n.max(1)) * width).sqrt();
            let [v, d] = shifted(r);
            (v, d / (2.0 * r) * width)
        };
        let bins = (0..BINS)
            .map(|n| {
                let ((a, b), (c, d)) = (node(n), node(n + 1));
                [a, b, 3.0 * (c - a) - 2.0 * b - d, 2.0 * (a - c) + b + d]
            })
            .collect();
        // On a node, so that energy and force are continuous there.
        let inner = (INNER * INNER * f64::from(BINS)).ceil() * width;
        Self { cutoff, per_unit: 1.0 / width, inner, bins, exact: Box::new(shifted) }
    }

    /// The distance beyond which nothing acts.
    pub fn cutoff(&self) -> f64 {
        self.cutoff
    }

    /// Energy and −V′(r)/r, by which the separation vector is multiplied to give the force, at a squared distance > 0.
    #[inline]
    pub fn at(&self, squared: f64) -> [f64; 2] {
        let x = squared * self.per_unit;
        if squared < self.inner {
            let r = squared.sqrt();
            let [v, d] = (self.exact)(r);
            return [v, -d / r];
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a bin")]
        let n = x as usize;
        let Some(&[a, b, c, d]) = self.bins.get(n) else { return [0.0; 2] };
        let x = x - n as f64;
        [a + x * (b + x * (c + x * d)), -2.0 * self.per_unit * (b + x * (2.0 * c + x * 3.0 * d))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 1/r e^−r and its slope.
    fn yukawa(r: f64) -> [f64; 2] {
        let v = (-r).exp() / r;
        [v, -v * (1.0 + 1.0 / r)]
    }

    #[test]
    fn the_table_follows_the_shifted_formula() {
        let p = PairPotential::new(4.0, yukawa);
        let [end, slope] = yukawa(4.0);
        for n in 1..400 {
            let r = 0.01 * f64::from(n);
            let [v, d] = yukawa(r);
            let [energy, force] = p.at(r * r);
            let want = v - end - (r - 4.0) * slope;
            assert!((energy - want).abs() < 1e-7 * v.max(1.0), "{r}: {energy} {want}");
            assert!((force * r + (d - slope)).abs() < 1e-5 * d.abs().max(1.0), "{r}: {} {}", force * r, slope - d);
        }
        let [energy, force] = p.at(3.999_999_f64.powi(2));
        assert!(energy.abs() < 1e-9 && force.abs() < 1e-6, "both vanish at the cut-off: {energy} {force}");
        assert_eq!(p.at(16.0), [0.0; 2]);
        assert_eq!(p.at(1e9), [0.0; 2]);
    }

    #[test]
    fn the_force_is_the_energys_derivative() {
        let p = PairPotential::new(4.0, yukawa);
        for n in 0..300 {
            let r = 0.2 + 0.012_34 * f64::from(n);
            let step = 1e-5;
            let energy = |r: f64| p.at(r * r)[0];
            let numeric = -(energy(r + step) - energy(r - step)) / (2.0 * step);
            let force = p.at(r * r)[1] * r;
            assert!((numeric - force).abs() < 1e-6 * force.abs().max(1.0), "{r}: {numeric} {force}");
        }
    }
}
