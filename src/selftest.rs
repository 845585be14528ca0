//! Hard cases, counted on the user's own machine: what `isolume selftest` runs and `tests/selftest.rs` runs smaller.
//!
//! Every case says how many trials it made, how many failed, the worst error it saw and the bound that error must keep.
//! All random numbers are by index, so a failure names a trial that can be repeated.

pub mod degenerate;
pub mod double;
pub mod invariance;
pub mod roots;
pub mod spawned;
pub mod watertight;

use crate::embree::Device;
use crate::error::{Error, Result};
use crate::progress::Progress;
use rayon::prelude::*;
use serde::Serialize;
use std::fmt::Write;
use std::time::Instant;

/// How many trials of each kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trials {
    /// Rays drawn per watertight class; a little less than half of them start inside, and count.
    pub watertight: u64,
    /// Rays per watertight class through triangles, for comparison.
    pub triangles: u64,
    /// Cubics and cells.
    pub roots: u64,
    /// Spawned rays drawn, all scenes; three in ten start on a surface, and count.
    pub spawned: u64,
    /// Rays per transformation.
    pub invariance: u64,
    /// Independent bakes per side of each z-test.
    pub bakes: u64,
    /// Seconds after which a watertight, root or spawned case makes no further trials: it counts those that it made.
    pub seconds: f64,
}

impl Trials {
    /// Seconds.
    pub const QUICK: Self = Self {
        watertight: 200_000,
        triangles: 50_000,
        roots: 200_000,
        spawned: 300_000,
        invariance: 50_000,
        bakes: 8,
        seconds: f64::INFINITY,
    };
    /// Minutes: 10⁷ rays per watertight class, 10⁷ cells (and nearly twice as many cubics), 10⁷ spawned rays.
    pub const STANDARD: Self = Self {
        watertight: 23_000_000,
        triangles: 1_000_000,
        roots: 28_000_000,
        spawned: 35_000_000,
        invariance: 1_000_000,
        bakes: 16,
        seconds: f64::INFINITY,
    };
    /// Hours: 10⁹ rays per watertight class, 10⁸ spawned ones.
    pub const LONG: Self = Self {
        watertight: 2_300_000_000,
        triangles: 10_000_000,
        roots: 100_000_000,
        spawned: 350_000_000,
        invariance: 10_000_000,
        bakes: 64,
        seconds: f64::INFINITY,
    };
}

/// One line of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Case {
    /// The kind of case.
    pub group: &'static str,
    /// Which one.
    pub name: String,
    /// Trials made.
    pub trials: u64,
    /// Trials that failed.
    pub failures: u64,
    /// The largest error seen, in the unit that `bound` names; `None` where a trial is right or wrong.
    pub worst: Option<f64>,
    /// What `worst` must not exceed.
    pub bound: Option<f64>,
    /// Whether failures fail the self-test; false for what stands beside it for comparison.
    pub required: bool,
    /// Unit of the error, and what else there is to say.
    pub note: String,
    /// The first trial that failed.
    pub first_failure: Option<String>,
}

impl Case {
    /// Whether the case is as it must be. A required case without trials tests nothing, and fails.
    pub fn passed(&self) -> bool {
        !self.required || (self.trials > 0 && self.failures == 0 && self.within())
    }

    fn within(&self) -> bool {
        match (self.worst, self.bound) {
            (Some(worst), Some(bound)) => worst <= bound,
            _ => true,
        }
    }
}

/// What many trials of one case amount to; joined in any order with the same result.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// Trials made.
    pub trials: u64,
    /// Trials that failed.
    pub failures: u64,
    /// Largest error.
    pub worst: f64,
    /// Number of the first failing trial, and what happened there.
    pub first: Option<(u64, String)>,
}

impl Tally {
    /// Counts trial `index`: `Ok(error)`, or `Err(what happened)`.
    pub fn push(&mut self, index: u64, outcome: Result<f64, String>) {
        self.trials += 1;
        match outcome {
            // A NaN is larger than any bound.
            Ok(error) => self.worst = if error.is_nan() { f64::INFINITY } else { self.worst.max(error) },
            Err(what) => {
                self.failures += 1;
                if self.first.as_ref().is_none_or(|(first, _)| index < *first) {
                    self.first = Some((index, what));
                }
            }
        }
    }

    /// Both.
    #[must_use]
    pub fn join(self, other: Self) -> Self {
        let first = match (self.first, other.first) {
            (Some(a), Some(b)) => Some(if b.0 < a.0 { b } else { a }),
            (a, b) => a.or(b),
        };
        Self {
            trials: self.trials + other.trials,
            failures: self.failures + other.failures,
            worst: self.worst.max(other.worst),
            first,
        }
    }

    /// The case of these trials; errors count if there is a `bound`.
    pub fn case(self, group: &'static str, name: impl Into<String>, bound: Option<f64>, note: &str) -> Case {
        Case {
            group,
            name: name.into(),
            trials: self.trials,
            failures: self.failures,
            worst: bound.map(|_| self.worst),
            bound,
            required: true,
            note: note.to_owned(),
            first_failure: self.first.map(|(index, what)| format!("trial {index}: {what}")),
        }
    }
}

/// Runs `trial(index)` for all indices below `count` on all threads; `None` is no trial (a ray that starts outside,
/// say). What is not begun after so many seconds is left out.
///
/// # Errors
/// `Interrupted`.
pub fn many<F>(progress: Progress, name: &str, count: u64, seconds: f64, trial: F) -> Result<Tally>
where
    F: Fn(u64) -> Option<Result<f64, String>> + Sync,
{
    const BLOCK: u64 = 1 << 14;
    let stage = progress.stage(name, count);
    let begun = Instant::now();
    let tally = (0..count.div_ceil(BLOCK))
        .into_par_iter()
        .map(|block| {
            let mut tally = Tally::default();
            if stage.tick(0) && begun.elapsed().as_secs_f64() < seconds {
                let range = block * BLOCK..((block + 1) * BLOCK).min(count);
                let n = range.end - range.start;
                for index in range {
                    if let Some(outcome) = trial(index) {
                        tally.push(index, outcome);
                    }
                }
                stage.tick(n);
            }
            tally
        })
        .reduce(Tally::default, Tally::join);
    stage.end()?;
    Ok(tally)
}

/// All cases of some groups.
///
/// # Errors
/// `Embree`, `Interrupted`; failures of cases are no errors but counts.
pub fn run(trials: &Trials, groups: &[Group], device: &Device, progress: Progress) -> Result<Vec<Case>> {
    let mut cases = Vec::new();
    for group in groups {
        cases.extend(match group {
            Group::Watertight => watertight::cases(trials, device, progress)?,
            Group::Roots => roots::cases(trials, progress)?,
            Group::Spawned => spawned::cases(trials, device, progress)?,
            Group::Invariance => invariance::cases(trials, device, progress)?,
            Group::Degenerate => degenerate::cases(device)?,
        });
    }
    Ok(cases)
}

/// The kinds of cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
#[allow(missing_docs, reason = "the names of the modules")]
pub enum Group {
    Watertight,
    Roots,
    Spawned,
    Invariance,
    Degenerate,
}

impl Group {
    /// In the order of the table.
    pub const ALL: [Self; 5] = [Self::Watertight, Self::Roots, Self::Spawned, Self::Invariance, Self::Degenerate];
}

/// The table as text.
pub fn table(cases: &[Case]) -> String {
    let mut out = String::new();
    let width = cases.iter().map(|c| c.group.chars().count() + 2 + c.name.chars().count()).max().unwrap_or(0);
    let number = |x: Option<f64>| x.map_or_else(|| "–".to_owned(), |x| format!("{x:.3e}"));
    let _ = writeln!(
        out,
        "      {:width$} {:>13} {:>9} {:>10} {:>10}  unit, notes",
        "case", "trials", "failures", "worst", "bound"
    );
    for c in cases {
        let mark = match (c.passed(), c.required) {
            (true, true) => "ok",
            (false, _) => "FAIL",
            (true, false) => "·",
        };
        let name = format!("{}: {}", c.group, c.name);
        let _ = writeln!(
            out,
            "{mark:>4}  {name:width$} {:>13} {:>9} {:>10} {:>10}  {}",
            c.trials,
            c.failures,
            number(c.worst),
            number(c.bound),
            c.note
        );
        if let Some(first) = c.first_failure.as_ref().filter(|_| c.required) {
            let _ = writeln!(out, "      {first}");
        }
    }
    out
}

/// Fails if a case did.
///
/// # Errors
/// `Failed` with the names of the failed cases.
pub fn verdict(cases: &[Case]) -> Result<()> {
    let failed: Vec<String> =
        cases.iter().filter(|c| !c.passed()).map(|c| format!("{}: {}", c.group, c.name)).collect();
    if failed.is_empty() {
        return Ok(());
    }
    Err(Error::Failed(format!("selftest: {} of {} cases failed: {}", failed.len(), cases.len(), failed.join("; "))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_errors_and_empty_cases_fail_the_test() {
        let tally = |outcomes: &[Result<f64, String>]| {
            let mut t = Tally::default();
            outcomes.iter().enumerate().for_each(|(i, o)| t.push(i as u64, o.clone()));
            t
        };
        let good = tally(&[Ok(0.5), Ok(1.0)]).case("g", "good", Some(1.0), "");
        let bad = tally(&[Ok(0.5), Err("x".into()), Err("y".into())]).case("g", "bad", None, "");
        let off = tally(&[Ok(1.5)]).case("g", "off", Some(1.0), "");
        let nan = tally(&[Ok(f64::NAN)]).case("g", "nan", Some(1.0), "");
        let none = tally(&[]).case("g", "none", None, "");
        let beside = Case { required: false, ..bad.clone() };
        assert_eq!(
            [&good, &bad, &off, &nan, &none, &beside].map(Case::passed),
            [true, false, false, false, false, true]
        );
        assert_eq!(bad.first_failure.as_deref(), Some("trial 1: x"));
        let message = verdict(&[good.clone(), bad.clone()]).unwrap_err().to_string();
        assert!(message.contains("1 of 2") && message.contains("g: bad"), "{message}");
        assert!(verdict(&[good, beside]).is_ok());
        assert!(table(&[bad]).contains("FAIL  g: bad"));
    }
}
