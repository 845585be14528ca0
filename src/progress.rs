//! Progress of long work: a bar with an ETA on a terminal, plain lines otherwise, or whoever asks for it; and the wish
//! to stop.

use crate::error::{Error, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::fmt;
use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

/// Prints a line to standard error. Where nobody reads it nothing else is lost; the library's own macro would end the
/// work.
macro_rules! say {
    ($($line:tt)*) => {{
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), $($line)*);
    }};
}
pub(crate) use say;

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Asks all work of this process to stop, now and later; what a signal handler calls. [`Observer::stops`] ends one
/// piece of work alone.
pub fn interrupt() {
    INTERRUPTED.store(true, Ordering::Relaxed);
}

/// Whether [`interrupt`] was called.
#[inline]
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Goes on unless [`interrupt`] was called.
///
/// # Errors
/// `Interrupted`.
pub fn unless_interrupted() -> Result<()> {
    if interrupted() { Err(Error::Interrupted) } else { Ok(()) }
}

/// How work tells how far it is: called from any of its threads with the units that were done since the last call;
/// returning false ends the work early.
pub type Tick<'a> = &'a (dyn Fn(u64) -> bool + Sync);

/// Watches work, from any of its threads, and may end it.
///
/// ```
/// use isolume::progress::{Observer, Progress};
/// use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
/// /// A window's button that ends the work.
/// #[derive(Default)]
/// struct Button(AtomicBool);
/// impl Observer for Button {
///     fn stops(&self) -> bool {
///         self.0.load(Relaxed)
///     }
/// }
/// let button = Button::default();
/// let stage = Progress::Watched(&button).stage("work", 100);
/// assert!(stage.tick(1));
/// button.0.store(true, Relaxed);
/// assert!(!stage.tick(1) && stage.end().is_err());
/// ```
pub trait Observer: Sync {
    /// A stage begins that has `total` units of work.
    fn begins(&self, stage: &str, total: u64) {
        let _ = (stage, total);
    }

    /// So many more units of a stage are done.
    fn advances(&self, stage: &str, units: u64) {
        let _ = (stage, units);
    }

    /// A stage, or a part of one, took so long.
    fn ends(&self, stage: &str, seconds: f64) {
        let _ = (stage, seconds);
    }

    /// Whether the work is to end, with `Interrupted`. Asked many times a second, and once more when a stage ends.
    fn stops(&self) -> bool {
        false
    }
}

impl fmt::Debug for dyn Observer + '_ {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Observer")
    }
}

/// Where progress goes.
#[derive(Clone, Copy, Debug)]
pub enum Progress<'a> {
    /// Nowhere.
    Quiet,
    /// To standard error: bars on a terminal, otherwise a line per stage, and one a minute while it lasts.
    Shown,
    /// To an observer, and nothing to standard error.
    Watched(&'a dyn Observer),
}

/// Wall and processor seconds since it was started.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    begun: Instant,
    processor: f64,
}

impl Clock {
    /// Starts now.
    pub fn start() -> Self {
        Self { begun: Instant::now(), processor: processor_seconds() }
    }

    /// Wall seconds, and those that all threads of the process have worked, NaN where the system does not tell.
    pub fn seconds(&self) -> [f64; 2] {
        [self.begun.elapsed().as_secs_f64(), processor_seconds() - self.processor]
    }
}

/// One running stage.
#[derive(Debug)]
pub struct Stage<'a> {
    progress: Progress<'a>,
    bar: Option<ProgressBar>,
    lines: Option<Lines>,
    name: String,
    begun: Instant,
}

/// Lines about long work, for logs.
#[derive(Debug)]
struct Lines {
    total: u64,
    done: AtomicU64,
    /// Seconds from the beginning to the next line.
    next: AtomicU64,
}

/// Seconds between two of them.
const BETWEEN: u64 = 60;

impl Lines {
    /// What there is to say after some time, once at a time.
    fn advance(&self, n: u64, begun: Instant) -> Option<String> {
        let done = self.done.fetch_add(n, Ordering::Relaxed) + n;
        let next = self.next.load(Ordering::Relaxed);
        let seconds = begun.elapsed().as_secs_f64();
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "seconds")]
        let then = seconds as u64 + BETWEEN;
        let due = seconds >= next as f64
            && self.next.compare_exchange(next, then, Ordering::Relaxed, Ordering::Relaxed).is_ok();
        let share = done as f64 / self.total.max(1) as f64;
        due.then(|| {
            let left = seconds * (1.0 - share).max(0.0) / share;
            format!("{:.0} % after {seconds:.0} s, about {left:.0} s left", 100.0 * share.min(1.0))
        })
    }
}

impl<'a> Progress<'a> {
    /// Whether people read standard error.
    #[inline]
    pub fn is_shown(self) -> bool {
        matches!(self, Self::Shown)
    }

    /// Whether the work is to end.
    #[inline]
    pub fn stops(self) -> bool {
        interrupted() || matches!(self, Self::Watched(observer) if observer.stops())
    }

    /// Tells how long a part of the work took.
    pub fn line(self, name: &str, seconds: f64) {
        match self {
            Self::Quiet => {}
            Self::Shown => say!("{name:>14}  {seconds:.2} s"),
            Self::Watched(observer) => observer.ends(name, seconds),
        }
    }

    /// Begins a stage of `total` units of work.
    pub fn stage(self, name: &str, total: u64) -> Stage<'a> {
        if let Self::Watched(observer) = self {
            observer.begins(name, total);
        }
        let bar = (self.is_shown() && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(8));
            let template = "{prefix:>14} [{bar:30}] {percent:>3} %  {elapsed} elapsed, {eta} left";
            bar.set_style(ProgressStyle::with_template(template).expect("the template is fixed").progress_chars("=> "));
            bar.set_prefix(name.to_owned());
            bar
        });
        let lines = (self.is_shown() && bar.is_none()).then(|| Lines {
            total,
            done: AtomicU64::new(0),
            next: AtomicU64::new(BETWEEN),
        });
        Stage { progress: self, bar, lines, name: name.to_owned(), begun: Instant::now() }
    }
}

impl Stage<'_> {
    /// Reports `n` more units done; false if the work should stop.
    #[inline]
    pub fn tick(&self, n: u64) -> bool {
        match (self.progress, &self.bar) {
            (Progress::Watched(observer), _) if n > 0 => observer.advances(&self.name, n),
            (_, Some(bar)) if n > 0 => bar.inc(n),
            _ if n > 0 => {
                if let Some(line) = self.lines.as_ref().and_then(|lines| lines.advance(n, self.begun)) {
                    say!("{:>14}  {line}", self.name);
                }
            }
            _ => {}
        }
        !self.progress.stops()
    }

    /// Prints a line without disturbing the bar.
    pub fn note(&self, label: &str, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say!("{label:>14}  {text}")),
            None if self.progress.is_shown() => say!("{label:>14}  {text}"),
            None => {}
        }
    }

    /// Ends the stage; returns its wall seconds.
    ///
    /// # Errors
    /// `Interrupted` if the work is to end.
    pub fn end(self) -> Result<f64> {
        let seconds = self.begun.elapsed().as_secs_f64();
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        if self.progress.stops() {
            return Err(Error::Interrupted);
        }
        self.progress.line(&self.name, seconds);
        Ok(seconds)
    }
}

/// Seconds that all threads of this process have worked, which other work on the machine hardly changes; NaN where the
/// system does not tell.
pub fn processor_seconds() -> f64 {
    // Fields 14 and 15, counted from behind the name's parenthesis, in ticks of 10 ms.
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let mut fields =
        stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).map_while(|f| f.parse::<f64>().ok());
    match (fields.next(), fields.next()) {
        (Some(user), Some(system)) => (user + system) * 0.01,
        _ => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// One a minute, whoever reports first, with what is left at the same pace.
    #[test]
    fn logs_get_a_line_a_minute() {
        let lines = Lines { total: 200, done: AtomicU64::new(0), next: AtomicU64::new(BETWEEN) };
        let ago = |seconds: u64| Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
        assert_eq!(lines.advance(40, ago(59)), None);
        assert_eq!(lines.advance(10, ago(75)).as_deref(), Some("25 % after 75 s, about 225 s left"));
        assert_eq!(lines.advance(10, ago(130)), None);
        assert_eq!(lines.advance(140, ago(136)).as_deref(), Some("100 % after 136 s, about 0 s left"));
    }
}
