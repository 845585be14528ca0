//! The signals that ask a process to end.

use crate::progress;
use std::time::{Duration, Instant};

/// Signals this close to each other are one.
const TOGETHER: Duration = Duration::from_millis(500);

/// What comes of a signal: all work is interrupted. Another one ends the process at once; not one that came with the
/// first, as `timeout` and shells send them to a process and to its group.
fn on_signal() -> impl FnMut() {
    let mut first: Option<Instant> = None;
    move || {
        if first.get_or_insert_with(Instant::now).elapsed() > TOGETHER {
            std::process::exit(130);
        }
        progress::interrupt();
    }
}

/// Interrupts all work when the process is asked to end. What `nohup` started lives on when its terminal goes, where
/// the system tells of it (Linux does).
#[cfg(unix)]
pub(super) fn heed() {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
    // A file that may not grow further is an error of writing, after which what is finished is kept.
    let _ = signal_hook::flag::register(SIGXFSZ, std::sync::Arc::default());
    let hangup = (!ignored(SIGHUP)).then_some(SIGHUP);
    let signals = [SIGINT, SIGTERM].into_iter().chain(hangup);
    let Ok(mut signals) = signal_hook::iterator::Signals::new(signals) else { return };
    std::thread::spawn(move || {
        let mut act = on_signal();
        signals.forever().for_each(|_| act());
    });
}

/// Interrupts all work when the process is asked to end.
#[cfg(not(unix))]
pub(super) fn heed() {
    let _ = ctrlc::set_handler(on_signal());
}

/// Whether whoever started the process had it ignore `signal`.
#[cfg(unix)]
fn ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}
