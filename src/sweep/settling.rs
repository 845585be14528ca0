//! How bounces settle: sooner than one by one, and when they have.
//!
//! Reflected radiance is the fixed point of x = D + T x, where a pass makes y = D + T x of x. T is nearly self-adjoint, and light that goes
//! to and fro between walls and surfaces gives it eigenvalues of either sign. So the next x is x₋ + ω (y − x₋), where x₋ was before x, with
//! Chebyshev's ω for ±r: errors shrink by √(ω∞ − 1) a pass, 0.39 where passes alone would leave r = 0.68. \[GV61\]

/// What is known of a replicate's light while few directions spread it, per channel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Settling {
    /// Σ of nodes' light before the first pass.
    pub(super) first: [f64; 3],
    /// Σ|y − x| of the last passes, at most [`KNOWN`], the newest last.
    pub(super) changes: Vec<[f64; 3]>,
    /// The newest one as a share of indirect light.
    pub(super) share: [f64; 3],
    /// r, the greatest modulus of an eigenvalue; 0 until it is known.
    pub(super) radius: [f64; 3],
    /// ω of the pass to come; 1 makes y the next x.
    pub(super) omega: [f64; 3],
    /// Passes since the newest change.
    pub(super) since: i32,
}

/// Passes until r is known. It is taken over two of them, since what goes to and fro makes every other change small.
pub(super) const KNOWN: usize = 3;
/// The greatest r that is believed.
const MOST: f64 = 0.98;

/// Sums over nodes that show light of their own and over sides, per channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sums {
    /// Σ y.
    pub light: [f64; 3],
    /// Σ|y − x|.
    pub change: [f64; 3],
}

impl Sums {
    /// Adds others, times `scale`.
    pub(super) fn add(&mut self, other: &Self, scale: f64) {
        for c in 0..3 {
            self.light[c] += scale * other.light[c];
            self.change[c] += scale * other.change[c];
        }
    }
}

impl Settling {
    /// Begins at light whose sum is `first`.
    pub(super) fn new(first: [f64; 3]) -> Self {
        Self { first, omega: [1.0; 3], ..Self::default() }
    }

    /// Takes what a pass changed.
    pub(super) fn push(&mut self, sums: Sums) {
        self.since = 0;
        if self.changes.len() == KNOWN {
            self.changes.remove(0);
        }
        self.changes.push(sums.change);
        for c in 0..3 {
            self.share[c] = sums.change[c] / (sums.light[c] - self.first[c]).max(f64::MIN_POSITIVE);
            let [old, _, new] = self.changes[..] else { continue };
            let (old, new) = (old[c], new[c]);
            self.omega[c] = match self.omega[c] {
                omega if self.radius[c] > 0.0 => {
                    // Where light does not settle T is not what ω is for, or rounding is all that is left: passes alone settle.
                    let apt = omega > 1.0 && new < old;
                    if apt { 1.0 / (1.0 - self.radius[c].powi(2) * omega / 4.0) } else { 1.0 }
                }
                omega if old > 0.0 && new > 0.0 => {
                    self.radius[c] = (new / old).sqrt().min(MOST);
                    omega / (1.0 - self.radius[c].powi(2) / 2.0)
                }
                omega => omega,
            };
        }
    }

    /// The share of indirect light that is still missing, `more` passes from now: at most |y − x| r / (1 − r) after a pass, as far as
    /// r is known. `None` before that.
    pub(super) fn missing(&self, more: i32) -> Option<f64> {
        let left = |c: usize| self.share[c] * self.radius[c].powi(1 + self.since + more) / (1.0 - self.radius[c]);
        (self.changes.len() == KNOWN).then(|| (0..3).map(left).fold(0.0, f64::max))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nodes.
    const N: usize = 64;
    /// Modulus of the operators.
    const R: f64 = 0.7;

    /// Light of one node that `spread` hands on, until `target` of what is indirect is missing: passes, the share that is, and what is
    /// said of it.
    fn settle(spread: impl Fn(&[f64]) -> Vec<f64>, relaxed: bool, target: f64) -> (usize, f64, f64) {
        let direct: Vec<f64> = (0..N).map(|i| if i == 5 { 1.0 } else { 0.0 }).collect();
        let pass = |x: &[f64]| -> Vec<f64> { spread(x).iter().zip(&direct).map(|(t, d)| t + d).collect() };
        let distance = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum() };
        let mut whole = direct.clone();
        (0..1000).for_each(|_| whole = pass(&whole));
        let (mut x, mut before) = (direct.clone(), direct.clone());
        let mut settling = Settling::new([1.0; 3]);
        for passes in 1..200 {
            let y = pass(&x);
            let omega = if relaxed { settling.omega[0] } else { 1.0 };
            let next = before.iter().zip(&y).map(|(b, y)| b + omega * (y - b)).collect();
            settling.push(Sums { light: [y.iter().sum(); 3], change: [distance(&y, &x); 3] });
            if let Some(said) = settling.missing(0).filter(|m| *m < target) {
                return (passes, distance(&y, &whole) / distance(&whole, &direct), said);
            }
            before = std::mem::replace(&mut x, next);
        }
        panic!("does not settle");
    }

    /// Along a ring each node hands half of its light to either neighbour: eigenvalues R cos(2πk/N), of either sign.
    #[test]
    fn to_and_fro_settles_in_half_the_passes() {
        let ring =
            |x: &[f64]| -> Vec<f64> { (0..N).map(|i| 0.5 * R * (x[(i + 1) % N] + x[(i + N - 1) % N])).collect() };
        for target in [1e-2, 1e-3, 1e-5] {
            let (alone, left, said) = settle(ring, false, target);
            assert!(left <= said && left > 0.2 * said, "{left} {said}");
            let (relaxed, left, said) = settle(ring, true, target);
            println!("{target}: {alone} passes alone, {relaxed} with ω: {left} is missing, said {said}");
            assert!(left < target && left <= said, "{left} {said}");
            assert!(relaxed as f64 <= 0.4 * alone as f64 + 4.0, "{relaxed} {alone}");
        }
    }

    /// Light that goes around the ring one way only has eigenvalues on a circle, which ω would drive apart.
    #[test]
    fn what_omega_is_not_for_settles() {
        let around = |x: &[f64]| -> Vec<f64> { (0..N).map(|i| R * x[(i + N - 1) % N]).collect() };
        let (passes, left, said) = settle(around, true, 1e-4);
        println!("{passes} passes: {left} is missing, said {said}");
        assert!(left < 1e-3 && passes < 60, "{passes} {left}");
    }

    /// Nothing bounces, or nothing is lit.
    #[test]
    fn darkness_is_settled() {
        let mut settling = Settling::new([2.0, 0.0, 1.0]);
        for _ in 0..KNOWN {
            assert_eq!(settling.missing(0), None);
            settling.push(Sums { light: [2.0, 0.0, 1.0], change: [0.0; 3] });
        }
        assert_eq!((settling.missing(0), settling.omega), (Some(0.0), [1.0; 3]));
    }
}
