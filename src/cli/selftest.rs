//! `isolume selftest`: the hard cases on this machine, as one table.

use super::device;
use crate::error::Result;
use crate::progress::Progress;
use crate::selftest::{Trials, run, table, verdict};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Exit code 1 if any case fails. Cases marked · stand beside the others for comparison.

Examples:
  isolume selftest --quick
  isolume selftest --json > selftest.json")]
pub(super) struct SelfTest {
    /// Seconds instead of minutes
    #[arg(long, conflicts_with = "long")]
    quick: bool,
    /// Hours: 10⁹ rays per watertight class, 10⁸ spawned rays
    #[arg(long)]
    long: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl SelfTest {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let trials = match (self.quick, self.long) {
            (true, _) => Trials::QUICK,
            (_, true) => Trials::LONG,
            _ => Trials::STANDARD,
        };
        let device = device()?;
        let cases = run(&trials, &device, progress)?;
        if self.json {
            let json = serde_json::json!({
                "version": env!("CARGO_PKG_VERSION"),
                "commit": env!("ISOLUME_COMMIT"),
                "embree": device.version(),
                "threads": rayon::current_num_threads(),
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
