//! How bounces settle: sooner than one by one, and when they have.
//!
//! Reflected radiance is the fixed point of x = D + T x, where a pass makes y = D + T x of x. T is nearly self-adjoint,
//! and light that goes to and fro between walls and surfaces gives it eigenvalues of either sign. So the next x is x₋ +
//! ω (y − x₋), where x₋ was before x, with Chebyshev's ω for ±r: errors shrink by √(ω∞ − 1) a pass, 0.39 where passes
//! alone would leave r = 0.68. \[GV61\]

/// What is known of a replicate's light while few directions spread it, per channel.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Settling {
    /// Passes, and those since the newest change.
    pub(super) passes: usize,
    pub(super) since: usize,
    /// Σ of nodes' light before the first pass.
    first: [f64; 3],
    /// Σ|y − x| of the last three passes, the newest last; and the least since r is known, or 0 once they have
    /// grown to [`APART`] times that.
    changes: [[f64; 3]; 3],
    least: [f64; 3],
    /// Σ|y − x| and |Σ(y − x)| of the last pass as shares of indirect light.
    share: [f64; 3],
    drift: [f64; 3],
    /// r, the greatest modulus of an eigenvalue; 0 until it is known.
    radius: [f64; 3],
    /// The eigenvalue of what the last pass changed, where that has one sign; 0 where it has not.
    slow: [f64; 3],
    /// ω of the last three passes and of the one to come; 1 makes y the next x.
    omega: [[f64; 3]; 4],
}

/// Passes until r is known. It is taken over two of them, since what goes to and fro makes every other change small.
const KNOWN: usize = 3;
/// The greatest r that is believed, of the slowest light and of all other.
const MOST: f64 = 0.98;
const OTHERS: f64 = 0.93;
/// The greatest r of a bright room's level that is told from none.
const LEVEL: f64 = 0.9998;
/// A level is known once two passes after each other tell it alike: this near, as a share of 1 − r.
const STEADY: f64 = 0.05;
/// What changes in one way only: |Σ(y − x)| as a share of Σ|y − x|.
const ONE_SIGN: f64 = 0.9;
/// Changes below [`ROUNDING`] that two passes leave this much of do not shrink any more.
const STANDS: f64 = 0.95;
/// The greatest r that ω is for: few directions make noise, too, whose eigenvalues are not all real.
const RELAXED: f64 = 0.95;
/// Changes this much greater than the least tell that ω or sharpening drives light apart.
const APART: f64 = 10.0;
/// Smaller changes, as a share of light, say nothing more of r once it is known: light is kept to 2⁻¹² of each number.
const ROUNDING: f64 = 1.0 / 4096.0;

/// Sums over nodes that show light of their own and over sides, per channel; where nodes reflect nothing, over flats,
/// each texel times its area.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Sums {
    /// Σ y.
    pub light: [f64; 3],
    /// Σ|y − x|.
    pub change: [f64; 3],
    /// Σ(y − x).
    pub drift: [f64; 3],
}

impl Sums {
    /// Adds what a pass made `y` of light that was `x`, in channel `c`, times `scale`.
    pub(super) fn count(&mut self, c: usize, [x, y]: [f32; 2], scale: f64) {
        let [x, y] = [x, y].map(f64::from);
        self.light[c] += scale * y;
        self.change[c] += scale * (y - x).abs();
        self.drift[c] += scale * (y - x);
    }

    /// Takes the channels that are chosen from others.
    pub(super) fn take(&mut self, other: &Self, chosen: [bool; 3]) {
        for c in (0..3).filter(|&c| chosen[c]) {
            (self.light[c], self.change[c], self.drift[c]) = (other.light[c], other.change[c], other.drift[c]);
        }
    }

    /// Adds others, times `scale`.
    pub(super) fn add(&mut self, other: &Self, scale: f64) {
        for c in 0..3 {
            self.light[c] += scale * other.light[c];
            self.change[c] += scale * other.change[c];
            self.drift[c] += scale * other.drift[c];
        }
    }
}

impl Settling {
    /// Begins at light whose sum is `first`.
    pub(super) fn new(first: [f64; 3]) -> Self {
        let none = [0.0; 3];
        Self {
            passes: 0,
            since: 0,
            first,
            changes: [none; 3],
            least: [f64::INFINITY; 3],
            share: none,
            drift: none,
            radius: none,
            slow: none,
            omega: [[1.0; 3]; 4],
        }
    }

    /// All that a checkpoint holds of it besides counts.
    pub(super) fn reals(&mut self) -> [&mut [f64; 3]; 13] {
        let Self { first, changes: [a, b, c], least, share, drift, radius, slow, omega: [d, e, f, g], .. } = self;
        [first, a, b, c, least, share, drift, radius, slow, d, e, f, g]
    }

    /// Begins again at the light there is, with what is known of r.
    pub(super) fn again(&mut self) {
        let Self { passes, since, first, radius, .. } = *self;
        *self = Self { passes, since, radius, ..Self::new(first) };
    }

    /// The greatest r of any channel; 0 until it is known.
    pub(super) fn slowest(&self) -> f64 {
        self.radius.into_iter().fold(0.0, f64::max)
    }

    /// Whether changes have grown to [`APART`] times the least.
    pub(super) fn grows(&self) -> bool {
        self.least.contains(&0.0)
    }

    /// ω of the pass to come.
    #[allow(clippy::cast_possible_truncation, reason = "a number in [1, 2]")]
    pub(super) fn omega(&self) -> [f32; 3] {
        self.omega[3].map(|x| x as f32)
    }

    /// Takes what a pass changed.
    pub(super) fn push(&mut self, sums: Sums) {
        (self.passes, self.since) = (self.passes + 1, 0);
        self.changes.rotate_left(1);
        self.changes[2] = sums.change;
        self.omega.rotate_left(1);
        self.omega[3] = self.omega[2];
        for c in 0..3 {
            let indirect = (sums.light[c] - self.first[c]).max(f64::MIN_POSITIVE);
            let share = |x: f64| if sums.light[c].is_finite() { x / indirect } else { f64::INFINITY };
            (self.share[c], self.drift[c]) = (share(sums.change[c]), share(sums.drift[c].abs()));
            let [old, _, new] = self.changes.map(|change| change[c]);
            let known = old > 0.0 || self.radius[c] > 0.0;
            if self.passes < KNOWN || !(known && new > 0.0) {
                continue;
            }
            let begins = self.least[c] == f64::INFINITY;
            let lambda = self.eigenvalue(c);
            if new > ROUNDING * sums.light[c] || self.radius[c] == 0.0 {
                self.radius[c] = self.radius[c].max(lambda.min(MOST));
            }
            let one_sign = self.drift[c] > ONE_SIGN * self.share[c];
            let slow = if one_sign { lambda } else { 0.0 };
            let before = std::mem::replace(&mut self.slow[c], slow);
            // Light that grows is no level.
            let [level, last] = [slow, before].map(|s| if s < 1.0 { s.min(LEVEL) } else { 0.0 });
            let steady = level > RELAXED && (level - last).abs() < STEADY * (1.0 - level);
            if steady && self.radius[c] >= MOST {
                self.radius[c] = level.max(MOST);
            }
            // What is left is rounding. Its sum counts still.
            if old > 0.0 && new < ROUNDING * sums.light[c] && new > STANDS * old {
                self.share[c] = 0.0;
            }
            self.least[c] = if new < APART * self.least[c] { self.least[c].min(new) } else { 0.0 };
            let r2 = self.radius[c].min(RELAXED).powi(2);
            let omega = &mut self.omega[3][c];
            *omega = match *omega {
                // ω₂ and its successors. [GV61]
                _ if begins => 1.0 / (1.0 - r2 / 2.0),
                omega if omega > 1.0 && new < APART * self.least[c] => 1.0 / (1.0 - r2 * omega / 4.0),
                // T is not what ω is for: passes alone settle.
                _ => 1.0,
            };
        }
    }

    /// λ of what the last two passes changed, should that be one eigenvector: of it they leave q each, where
    /// ω λ q = q² + ω − 1 \[GV61\]. 0 where that cannot be, or nothing is known.
    fn eigenvalue(&self, c: usize) -> f64 {
        let [old, _, new] = self.changes.map(|change| change[c]);
        // ω is that of the x which the changes are measured from.
        let (q, omega) = ((new / old).sqrt(), 0.5 * (self.omega[0][c] + self.omega[1][c]));
        if old > 0.0 && q * q > omega - 1.0 { (q + (omega - 1.0) / q) / omega } else { 0.0 }
    }

    /// The share of indirect light that is still missing, `more` passes from now: at most |y − x| r / (1 − r) after a
    /// pass, as far as r is known. `None` before that. Where r is near 1 that is light of one sign everywhere, so that
    /// its sum tells; other light settles sooner, and rounding, which has no sign, does not count.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "few passes")]
    pub(super) fn missing(&self, more: usize) -> Option<f64> {
        let after = (1 + self.since + more) as i32;
        // Light that has grown beyond all numbers, of which no share is left, does not settle.
        let left =
            |share: f64, r: f64| if share.is_finite() { share * r.powi(after) / (1.0 - r) } else { f64::INFINITY };
        let of = |c: usize| left(self.drift[c], self.radius[c]).max(left(self.share[c], self.radius[c].min(OTHERS)));
        (self.passes >= KNOWN).then(|| (0..3).map(of).fold(0.0, f64::max))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Nodes.
    const N: usize = 64;
    /// Modulus of the operators.
    const R: f64 = 0.7;

    /// Each bounce brighter than the one before, until sums are no numbers any more, or changes are none, or both.
    #[test]
    fn light_that_grows_never_settles() {
        for (rate, over) in [(1.5f64, 1e35), (1.5, f64::INFINITY), (1.5, f64::NAN), (1e30, f64::NAN)] {
            let mut settling = Settling::new([1.0; 3]);
            for n in 0..400 {
                let light = rate.powi(n);
                let most = f64::from(f32::MAX);
                let sum = if light > most { f64::INFINITY } else { light };
                let change = if light > most { over } else { light * (1.0 - 1.0 / rate) };
                settling.push(Sums { light: [sum; 3], change: [change; 3], drift: [change; 3] });
                let missing = settling.missing(2);
                assert!(missing.is_none_or(|missing| missing > 1.0), "{n}: {missing:?}");
            }
        }
    }

    /// The light of one node, before any of it spreads.
    fn direct() -> Vec<f64> {
        (0..N).map(|i| if i == 5 { 1.0 } else { 0.0 }).collect()
    }

    fn pass(spread: &impl Fn(&[f64]) -> Vec<f64>, x: &[f64]) -> Vec<f64> {
        spread(x).iter().zip(direct()).map(|(t, d)| t + d).collect()
    }

    /// Light that `spread` hands on for ever.
    fn whole(spread: &impl Fn(&[f64]) -> Vec<f64>) -> Vec<f64> {
        (0..5000).fold(direct(), |x, _| pass(spread, &x))
    }

    /// Light that `spread` hands on from `x` until `target` of what is indirect is missing: passes, the share that is,
    /// and what is said of it.
    fn go_on(
        settling: &mut Settling,
        mut x: Vec<f64>,
        spread: impl Fn(&[f64]) -> Vec<f64>,
        relaxed: bool,
        target: f64,
    ) -> (usize, f64, f64) {
        let sum = |x: &[f64]| -> f64 { x.iter().sum() };
        let distance = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum() };
        let whole = whole(&spread);
        let mut before = x.clone();
        for passes in 1..500 {
            let y = pass(&spread, &x);
            let omega = if relaxed { f64::from(settling.omega()[0]) } else { 1.0 };
            let next = before.iter().zip(&y).map(|(b, y)| b + omega * (y - b)).collect();
            if !relaxed {
                settling.omega[3] = [1.0; 3];
            }
            settling.push(Sums { light: [sum(&y); 3], change: [distance(&y, &x); 3], drift: [sum(&y) - sum(&x); 3] });
            if let Some(said) = settling.missing(0).filter(|m| *m < target) {
                return (passes, distance(&y, &whole) / distance(&whole, &direct()), said);
            }
            before = std::mem::replace(&mut x, next);
        }
        panic!("does not settle");
    }

    /// The same from the beginning.
    fn settle(spread: impl Fn(&[f64]) -> Vec<f64>, relaxed: bool, target: f64) -> (usize, f64, f64) {
        go_on(&mut Settling::new([1.0; 3]), direct(), spread, relaxed, target)
    }

    /// Each node of a ring hands half of its light to either neighbour.
    fn ring(x: &[f64]) -> Vec<f64> {
        (0..N).map(|i| 0.5 * R * (x[(i + 1) % N] + x[(i + N - 1) % N])).collect()
    }

    /// Along a ring each node hands half of its light to either neighbour: eigenvalues R cos(2πk/N), of either sign.
    #[test]
    fn to_and_fro_settles_in_half_the_passes() {
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
        assert!(left < 1e-4 && passes < 60, "{passes} {left}");
    }

    /// A ring that begins again with r known and a light that is a little too bright everywhere needs few passes more,
    /// and what is said to be missing holds.
    #[test]
    fn light_that_begins_again_settles_sooner() {
        let mut settling = Settling::new([1.0; 3]);
        let (first, ..) = go_on(&mut settling, direct(), ring, true, 1e-3);
        settling.again();
        let bright = whole(&ring).iter().map(|x| 1.05 * x).collect();
        let (again, left, said) = go_on(&mut settling, bright, ring, true, 1e-3);
        println!("{first} passes, {again} again: {left} is missing, said {said}");
        assert!(left < 1e-3 && left <= said, "{left} {said}");
        assert!(again < first, "{again} {first}");
    }

    /// Each node hands most of its light to all alike and the rest to its neighbours: one slow eigenvalue, as closed
    /// bright rooms have. What is said to be missing holds for any.
    #[test]
    fn the_level_of_a_bright_room_settles() {
        for r in [0.97, 0.99, 0.995] {
            let room = |x: &[f64]| -> Vec<f64> {
                let mean = x.iter().sum::<f64>() / N as f64;
                ring(x).iter().map(|x| 0.7 * r * mean + 0.3 * r * (x / R)).collect()
            };
            let (passes, left, said) = settle(room, true, 1e-3);
            println!("{r}: {passes} passes: {left} is missing, said {said}");
            assert!(left < 1e-3 && left <= said && left > 0.5 * said, "{passes} {left} {said}");
        }
    }

    /// Surfaces that shine much more than they reflect: what rounding of that changes in every pass is no light that
    /// settles slowly. Changes of a bake, whose r is taken for greater than it is.
    #[test]
    fn rounding_of_emission_is_no_light() {
        let mut settling = Settling::new([10_290.0; 3]);
        let bounces =
            [1168.0, 290.0, 237.0, 276.0, 44.0, 230.0, 80.0, 40.0, 31.0, 39.0, 19.0, 14.0, 12.0, 8.0, 5.5, 4.3];
        for (n, change) in bounces.into_iter().chain([1.6; 8]).enumerate() {
            let drift = if n < 10 { change } else { 0.02 * change };
            settling.push(Sums { light: [12_518.0; 3], change: [change; 3], drift: [drift; 3] });
        }
        assert!(settling.slowest() >= MOST, "{}", settling.slowest());
        assert!(settling.missing(0).unwrap() < 2e-3, "{:?}", settling.missing(0));
        // Of changes that begin anew nobody knows yet whether they shrink.
        settling.again();
        for change in [2.0, 1.9] {
            settling.push(Sums { light: [12_518.0; 3], change: [change; 3], drift: [0.0; 3] });
            assert!(settling.missing(0).unwrap() > 5e-3, "{:?}", settling.missing(0));
        }
    }

    /// Changes that grow twice, all of one sign, as the first bounces of such surfaces may.
    #[test]
    fn light_that_grows_for_a_while_is_no_level() {
        let mut settling = Settling::new([1000.0; 3]);
        for change in [100.0, 90.0, 95.0, 98.0, 105.0, 110.0, 50.0, 10.0, 2.0] {
            settling.push(Sums { light: [2000.0; 3], change: [change; 3], drift: [change; 3] });
        }
        assert!(settling.slowest() <= MOST, "{}", settling.slowest());
    }

    /// Nothing bounces, or nothing is lit.
    #[test]
    fn darkness_is_settled() {
        let mut settling = Settling::new([2.0, 0.0, 1.0]);
        for _ in 0..KNOWN {
            assert_eq!(settling.missing(0), None);
            settling.push(Sums { light: [2.0, 0.0, 1.0], ..Sums::default() });
        }
        assert_eq!((settling.missing(0), settling.omega()), (Some(0.0), [1.0; 3]));
    }
}
