//! `isolume selftest`: the hard cases on this machine, as one table.

use super::device;
use crate::error::{Error, Result};
use crate::progress::Progress;
use crate::selftest::{Group, Trials, run, table, verdict};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Exit code 1 if any case fails. Cases marked · stand beside the others for comparison.

Examples:
  isolume selftest --quick
  isolume selftest --long --only watertight --seconds-per-case 600
  isolume selftest --json > selftest.json")]
pub(super) struct SelfTest {
    /// Seconds instead of minutes
    #[arg(long, conflicts_with = "long")]
    quick: bool,
    /// Hours: 10⁹ rays per watertight class, 10⁸ spawned rays
    #[arg(long)]
    long: bool,
    /// Only these groups of cases
    #[arg(long, value_enum, value_delimiter = ',', value_name = "GROUP")]
    only: Vec<Group>,
    /// End a watertight, root or spawned case after so many seconds: it counts the trials that it made
    #[arg(long, value_name = "SECONDS")]
    seconds_per_case: Option<f64>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl SelfTest {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let mut trials = match (self.quick, self.long) {
            (true, _) => Trials::QUICK,
            (_, true) => Trials::LONG,
            _ => Trials::STANDARD,
        };
        trials.seconds = self.seconds_per_case.unwrap_or(trials.seconds);
        if !(trials.seconds > 0.0) {
            return Err(Error::Invalid(format!("--seconds-per-case {}: must be above 0", trials.seconds)));
        }
        let groups = if self.only.is_empty() { &Group::ALL[..] } else { &self.only };
        let device = device()?;
        let cases = run(&trials, groups, &device, progress)?;
        if self.json {
            let json = serde_json::json!({
                "version": env!("CARGO_PKG_VERSION"),
                "commit": env!("ISOLUME_COMMIT"),
                "embree": device.version(),
                "threads": rayon::current_num_threads(),
                "isa": crate::isa::Isa::current().name(),
                "passed": verdict(&cases).is_ok(),
                "cases": cases,
            });
            println!("{}", serde_json::to_string_pretty(&json).expect("cases are plain data"));
        } else {
            print!("{}", table(&cases));
        }
        verdict(&cases)
    }
}
