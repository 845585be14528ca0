//! The signals that ask a process to end.

use crate::progress;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use std::time::{Duration, Instant};

/// Signals this close to each other are one.
const TOGETHER: Duration = Duration::from_millis(500);

/// Interrupts all work when the process is asked to end.
///
/// Another signal ends the process at once; not one that came with the first, as `timeout` and shells send them to a
/// process and to its group. What `nohup` started lives on when its terminal goes.
pub(super) fn heed() {
    let hangup = (!ignored(SIGHUP)).then_some(SIGHUP);
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM].into_iter().chain(hangup)) else { return };
    std::thread::spawn(move || {
        let mut first: Option<Instant> = None;
        for _ in signals.forever() {
            if first.get_or_insert_with(Instant::now).elapsed() > TOGETHER {
                std::process::exit(130);
            }
            progress::interrupt();
        }
    });
}

/// Whether whoever started the process had it ignore `signal`, as far as the system tells.
fn ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}
