//! Cubics and cells against double-double arithmetic: no sign change is missed, and what is returned is a root to 8 ulp
//! plus the conditioning term.
//!
//! A returned t passes if the exact function changes sign within 8 ulp of t, or if its exact value at t is no more than
//! what rounding the function's own terms may amount to: t is then the exact root of a function whose terms differ by
//! a few ε, which is all that a root of any conditioning can promise. It must also be the *first* crossing: none before
//! it may be clear, that is, have an exact value beyond that rounding on its far side.

use super::double::Double;
use super::{Case, Tally, Trials, many};
use crate::cell::Cell;
use crate::cubic::Cubic;
use crate::error::Result;
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use glam::DVec3;

/// Bound on |p(t)| / (ε Σ|c_i| tⁱ) of a cubic's root, unless the sign changes within [`ULPS`].
const CUBIC_BOUND: f64 = 8.0;

/// Bound on |h(x(t)) − c| / (ε max(|s|, |c|)) of a cell's root, unless the sign changes within [`ULPS`]: the rounding
/// of the cubic's own coefficients is part of it.
const CELL_BOUND: f64 = 8.0;

/// Steps of f64 around a root within which the sign may change.
const ULPS: f64 = 8.0;

/// The families of cubics.
const CUBICS: [&str; 9] = [
    "random roots",
    "double root",
    "triple root",
    "near-double root",
    "near-triple root, far from 1",
    "quadratic",
    "linear",
    "constant",
    "random coefficients over 10^±30",
];

/// The families of cells.
const CELLS: [&str; 5] = ["random", "integers, integer c", "c on 1, 2, 4, 8 corners", "values over 10^±30", "flat"];

/// Σ |c_i| tⁱ.
fn magnitude(p: &Cubic, t: f64) -> f64 {
    let [a, b, c, d] = p.c.map(f64::abs);
    a + t * (b + t * (c + t * d))
}

/// Where the slope of the cubic vanishes in (0, end), ascending, exactly enough.
fn turning_points(p: &Cubic, end: f64) -> Vec<Double> {
    let [_, c1, c2, c3] = p.c.map(Double::from);
    let a = c3 * Double::from(3.0);
    let mut turns = Vec::new();
    if a.hi == 0.0 {
        if c2.hi != 0.0 {
            turns.push((-c1).over(c2 * Double::from(2.0)));
        }
    } else {
        let discriminant = c2 * c2 - a * c1;
        if discriminant.hi >= 0.0 {
            let root = discriminant.sqrt();
            let q = -(if c2.hi < 0.0 { c2 - root } else { c2 + root });
            turns.push(q.over(a));
            if q.hi != 0.0 {
                turns.push(c1.over(q));
            }
        }
    }
    turns.retain(|t| t.hi > 0.0 && t.hi < end);
    turns.sort_by(|a, b| a.hi.total_cmp(&b.hi));
    turns
}

/// Judges the first crossing of `p` in [0, end]: the error in units of ε Σ|c_i| tⁱ, or what is wrong.
pub fn judge_cubic(p: &Cubic, end: f64) -> Result<f64, String> {
    judge_cubic_by(Cubic::first_crossing, p, end)
}

/// Finds a first crossing as [`Cubic::first_crossing`] does.
trait Solver: Fn(&Cubic, f64, bool, bool) -> Option<f64> {}
impl<F: Fn(&Cubic, f64, bool, bool) -> Option<f64>> Solver for F {}

fn judge_cubic_by(solver: impl Solver, p: &Cubic, end: f64) -> Result<f64, String> {
    let exact = p.c.map(Double::from);
    let at = |t: Double| Double::polynomial(exact, t);
    let inside = at(Double::default()).not_negative();
    let inside_end = at(Double::from(end)).not_negative();
    let clear = |t: Double, v: Double| v.hi.abs() > CUBIC_BOUND * f64::EPSILON * magnitude(p, t.hi);
    let found = solver(p, end, inside, inside_end);
    // The end of the first monotone piece that clearly changes sides.
    let turns = turning_points(p, end);
    let by = turns.iter().copied().find(|&t| at(t).not_negative() != inside && clear(t, at(t)));
    let by = by.or((inside != inside_end).then_some(Double::from(end)));
    let case = || format!("{:?} on [0, {end}]: found {found:?}", p.c);
    match (found, by) {
        (None, None) => Ok(0.0),
        (None, Some(by)) => Err(format!("{}, but it changes sides before {}", case(), by.hi)),
        (Some(t), by) => {
            if !(0.0..=end).contains(&t) {
                return Err(case());
            }
            if let Some(by) = by
                && t > by.hi + ULPS * (by.hi.next_up() - by.hi)
            {
                return Err(format!("{}, but it changes sides before {}", case(), by.hi));
            }
            let step = ULPS * (t.next_up() - t);
            let (lo, hi) = (at(Double::from((t - step).max(0.0))), at(Double::from((t + step).min(end))));
            let value = at(Double::from(t));
            if lo.not_negative() != hi.not_negative() || value.hi == 0.0 {
                return Ok(0.0);
            }
            Ok(value.hi.abs() / (f64::EPSILON * magnitude(p, t)))
        }
    }
}

/// Cubic `index` of a family.
fn cubic(family: usize, index: u64) -> (Cubic, f64) {
    let mut rng = Rng::stream(11 + family as u64, Stage::Test, index);
    let mut root = || rng.unit();
    let (a, b, c) = (root(), root(), root());
    let sign = if rng.bits() & 1 == 0 { 1.0 } else { -1.0 };
    let scale = sign * 10f64.powf(60.0 * rng.unit() - 30.0);
    let from_roots =
        |[a, b, c]: [f64; 3]| Cubic { c: [-a * b * c, a * b + a * c + b * c, -(a + b + c), 1.0].map(|x| x * scale) };
    let near = 10f64.powf(-16.0 * rng.unit());
    let small = 10f64.powf(-20.0 * rng.unit());
    let p = match family {
        0 => from_roots([a, b, 3.0 * c - 1.0]),
        1 => from_roots([a, a, 3.0 * b - 1.0]),
        2 => from_roots([a, a, a]),
        3 => from_roots([a, a * (1.0 + near), 3.0 * b - 1.0]),
        4 => from_roots([a, a * (1.0 + near), a * (1.0 - near * b)].map(|x| x * small)),
        5 => Cubic { c: [a * b * scale, -(a + b) * scale, scale, 0.0] },
        6 => Cubic { c: [-a * scale, scale, 0.0, if b < 0.5 { 0.0 } else { near * 1e-9 * scale }] },
        7 => Cubic { c: [if a < 0.3 { 0.0 } else { scale }, 0.0, 0.0, 0.0] },
        _ => {
            let mut coefficient =
                || if rng.unit() < 0.15 { 0.0 } else { (rng.unit() - 0.5) * 10f64.powf(60.0 * rng.unit() - 30.0) };
            Cubic { c: [coefficient(), coefficient(), coefficient(), coefficient()] }
        }
    };
    (p, if index.is_multiple_of(3) { 1.0 } else { 1.7 * (1e-3 + c) })
}

/// Cell `index` of a family with an isovalue and a ray through it: cell-local start on a face, and direction.
#[allow(clippy::cast_possible_truncation, reason = "samples are f32")]
fn cell(family: usize, index: u64) -> (Cell, f32, DVec3, DVec3) {
    let mut rng = Rng::stream(31 + family as u64, Stage::Test, index);
    let scale = 10f64.powf(60.0 * rng.unit() - 30.0);
    let mut s = std::array::from_fn(|_| match family {
        0 | 2 => rng.unit() as f32,
        1 => (rng.bits() % 5) as f32,
        3 => ((rng.unit() - 0.4) * 10f64.powf(60.0 * rng.unit() - 30.0)) as f32,
        _ => (scale * (1.0 + 1e-6 * (rng.bits() % 3) as f64)) as f32,
    });
    let c = match family {
        0 => rng.unit() as f32,
        2 => {
            let corners = 1 << (rng.bits() % 4);
            let first = (rng.bits() % 8) as usize;
            let c = s[first];
            (0..corners).for_each(|k| s[(first + k) % 8] = c);
            c
        }
        _ => s[(rng.bits() % 8) as usize],
    };
    let axis = (rng.bits() % 3) as usize;
    let far = rng.bits() & 1 == 1;
    let mut p = DVec3::new(rng.unit(), rng.unit(), rng.unit());
    let mut d = DVec3::new(rng.unit(), rng.unit(), rng.unit()) * 2.0 - 1.0;
    if rng.bits().is_multiple_of(8) {
        p = p.round();
    }
    for a in 0..3 {
        match rng.bits() % 12 {
            0 => d[a] = 0.0,
            1 => d[a] *= 1e-7,
            _ => {}
        }
    }
    p[axis] = f64::from(far);
    d[axis] = (0.05 + d[axis].abs()) * if far { -1.0 } else { 1.0 };
    // From an edge or a corner into the cell, not away from it at once.
    if leave(p, d).1 <= 0.0 {
        d = d.abs() * (1.0 - 2.0 * p.round());
    }
    (Cell { s }, c, p, d)
}

/// Judges what the walk does in a cell: signs on the faces, the cubic, its first crossing. The ray from `p`, in the
/// unit cube, along `d` goes into the cell.
pub fn judge_cell(cell: &Cell, c: f32, p: DVec3, d: DVec3) -> Result<f64, String> {
    judge_cell_by(Cubic::first_crossing, cell, c, p, d)
}

/// The axis across which a ray from `p` leaves the unit cube, and when.
fn leave(p: DVec3, d: DVec3) -> (usize, f64) {
    let time = |a: usize| {
        if d[a] > 0.0 {
            (1.0 - p[a]) / d[a]
        } else if d[a] < 0.0 {
            -p[a] / d[a]
        } else {
            f64::INFINITY
        }
    };
    (0..3).map(|a| (a, time(a))).min_by(|(_, a), (_, b)| a.total_cmp(b)).expect("three axes")
}

fn judge_cell_by(solver: impl Solver, cell: &Cell, c: f32, p: DVec3, d: DVec3) -> Result<f64, String> {
    let (axis, end) = leave(p, d);
    let exact = |t: f64| {
        let at = |a: usize| {
            let x = Double::from(p[a]) + Double::from(t) * Double::from(d[a]);
            if x.hi < 0.0 { Double::default() } else { x }
        };
        Double::trilinear(cell.s, [at(0), at(1), at(2)]) - Double::from(c)
    };
    let unit = f64::EPSILON * f64::from(cell.s.iter().fold(c.abs(), |m, s| m.max(s.abs())));
    let start = exact(0.0);
    let q = (p + end * d).clamp(DVec3::ZERO, DVec3::ONE);
    let inside_end = cell.face_inside(axis, d[axis] > 0.0, f64::from(c), q[(axis + 1) % 3], q[(axis + 2) % 3]);
    let last = exact(end);
    let case = || format!("cell {:?}, c {c}, ray {p} {d}", cell.s);
    if last.not_negative() != inside_end && last.hi.abs() > CELL_BOUND * unit {
        return Err(format!("{}: the face's sign is wrong, h − c = {}", case(), last.hi));
    }
    let cubic = cell.cubic(f64::from(c), p, d);
    let found = solver(&cubic, end, start.not_negative(), inside_end);
    match found {
        None if start.not_negative() != inside_end => Err(format!("{}: the demanded crossing is missing", case())),
        None => {
            // Nothing between: look where the exact function turns, approximately.
            let hidden = turning_points(&cubic, end)
                .into_iter()
                .map(|t| exact(t.hi))
                .find(|v| v.not_negative() != start.not_negative() && v.hi.abs() > CELL_BOUND * unit);
            hidden.map_or(Ok(0.0), |v| Err(format!("{}: a pair of crossings is missing, depth {}", case(), v.hi)))
        }
        Some(t) if !(0.0..=end).contains(&t) => Err(format!("{}: t = {t} is outside [0, {end}]", case())),
        Some(t) => {
            let step = ULPS * (end.next_up() - end);
            // The first: where the exact function turns before it, it has not crossed yet.
            let before = turning_points(&cubic, t - step)
                .into_iter()
                .map(|turn| exact(turn.hi))
                .find(|v| v.not_negative() != start.not_negative() && v.hi.abs() > CELL_BOUND * unit);
            if let Some(v) = before {
                return Err(format!("{}: t = {t} is not the first crossing, depth {} before", case(), v.hi));
            }
            let (lo, hi) = (exact((t - step).max(0.0)), exact((t + step).min(end)));
            let value = exact(t).hi.abs();
            if lo.not_negative() != hi.not_negative() || unit == 0.0 { Ok(0.0) } else { Ok(value / unit) }
        }
    }
}

/// Cubics and cells, shared among the families.
///
/// # Errors
/// `Interrupted`.
pub fn cases(trials: &Trials, progress: Progress) -> Result<Vec<Case>> {
    let share = trials.roots.div_ceil((CUBICS.len() + CELLS.len()) as u64);
    let mut cases = Vec::new();
    let mut add = |tally: Tally, name: String, bound, note| cases.push(tally.case("roots", name, Some(bound), note));
    for (family, name) in CUBICS.iter().enumerate() {
        let tally = many(progress, "cubics", share, trials.seconds, |i| {
            let (p, end) = cubic(family, i);
            Some(judge_cubic(&p, end))
        })?;
        add(tally, format!("cubic, {name}"), CUBIC_BOUND, "ε Σ|c_i| tⁱ beyond 8 ulp");
    }
    for (family, name) in CELLS.iter().enumerate() {
        let tally = many(progress, "cells", share, trials.seconds, |i| {
            let (s, c, p, d) = cell(family, i);
            Some(judge_cell(&s, c, p, d))
        })?;
        add(tally, format!("cell, {name}"), CELL_BOUND, "ε max(|s|, |c|) beyond 8 ulp of the way through the cell");
    }
    Ok(cases)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_judge_sees_what_is_wrong() {
        // x = ½ exactly, and a crossing that the caller's signs hide from a wrong solver.
        assert_eq!(judge_cubic(&Cubic { c: [-1.0, 2.0, 0.0, 0.0] }, 1.0), Ok(0.0));
        let p = Cubic { c: [0.25 - 1e-3, -1.0, 1.0, 0.0] };
        assert!(judge_cubic(&p, 1.0).unwrap() <= CUBIC_BOUND);
        let turns = turning_points(&p, 1.0);
        assert_eq!(turns.len(), 1);
        assert_eq!(turns[0].hi, 0.5);
        assert_eq!(turning_points(&Cubic { c: [0.0, 3.0, -9.0 / 2.0 * 0.9, 2.0 * 0.5] }, 10.0).len(), 2);
    }
    /// Worst error and failures of a solver over 20 000 cells of each family.
    fn judged(solver: impl Solver + Copy) -> (f64, u32) {
        let (mut worst, mut failures) = (0f64, 0);
        for i in 0..20_000 {
            for family in 0..CELLS.len() {
                let (s, c, p, d) = cell(family, i);
                match judge_cell_by(solver, &s, c, p, d) {
                    Ok(error) => worst = worst.max(error),
                    Err(_) => failures += 1,
                }
            }
        }
        (worst, failures)
    }

    #[test]
    fn worse_solvers_break_the_bound() {
        let (worst, failures) = judged(Cubic::first_crossing);
        assert!(worst <= CELL_BOUND && failures == 0, "{worst} ε, {failures} failures");
        // 32 ε beside the root, of the way through the cell.
        let beside = |p: &Cubic, end: f64, a: bool, b: bool| {
            p.first_crossing(end, a, b).map(|t| (t + 32.0 * f64::EPSILON * end).min(end))
        };
        let (worst, failures) = judged(beside);
        assert!(worst > CELL_BOUND && worst < 1000.0, "{worst} ε, {failures} failures");
        // Roots in f32.
        #[allow(clippy::cast_possible_truncation, reason = "that is what is wrong with it")]
        let single =
            |p: &Cubic, end: f64, a: bool, b: bool| p.first_crossing(end, a, b).map(|t| f64::from(t as f32).min(end));
        assert!(judged(single).0 > 1e6);
        // Sign changes that the ends do not demand, and those that they do.
        assert!(judged(|p: &Cubic, end: f64, a: bool, b: bool| p.first_crossing(end, a, b).filter(|_| a != b)).1 > 0);
        assert!(judged(|p: &Cubic, end: f64, a: bool, b: bool| p.first_crossing(end, a, b).filter(|_| a == b)).1 > 0);
    }

    /// From the other end the first crossing is the last.
    #[test]
    fn the_last_crossing_is_not_the_first() {
        let last = |p: &Cubic, end: f64, a: bool, b: bool| {
            let [c0, c1, c2, c3] = p.c;
            let at_end = ((c3 * end + c2) * end + c1) * end + c0;
            let slope = (3.0 * c3 * end + 2.0 * c2) * end + c1;
            let turned = Cubic { c: [at_end, -slope, 3.0 * c3 * end + c2, -c3] };
            turned.first_crossing(end, b, a).map(|t| (end - t).max(0.0))
        };
        let mut caught = 0;
        for (i, family) in (0..20_000).flat_map(|i| (0..CELLS.len()).map(move |family| (i, family))) {
            let (s, c, p, d) = cell(family, i);
            let judged = judge_cell_by(last, &s, c, p, d);
            caught += u32::from(judged.is_err_and(|message| message.contains("is not the first crossing")));
        }
        assert!(caught > 100, "{caught}");
    }
}
