//! Progress of long work: a bar with an ETA on a terminal, plain lines otherwise, and the wish to stop.

use crate::error::{Error, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, Ordering};
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

/// Asks all running stages to stop; what a signal handler calls.
pub fn interrupt() {
    INTERRUPTED.store(true, Ordering::Relaxed);
}

/// Whether someone has asked to stop.
#[inline]
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Goes on unless someone has asked to stop.
///
/// # Errors
/// `Interrupted`.
pub fn unless_interrupted() -> Result<()> {
    if interrupted() { Err(Error::Interrupted) } else { Ok(()) }
}

/// Where progress goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Nowhere.
    Quiet,
    /// To standard error: bars on a terminal, a line per stage otherwise.
    Shown,
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
pub struct Stage {
    bar: Option<ProgressBar>,
    name: String,
    shown: bool,
    begun: Instant,
}

impl Progress {
    /// Prints how long a part of the work took.
    pub fn line(self, name: &str, seconds: f64) {
        if self == Self::Shown {
            say!("{name:>14}  {seconds:.2} s");
        }
    }

    /// Begins a stage of `total` units of work.
    pub fn stage(self, name: &str, total: u64) -> Stage {
        let shown = self == Progress::Shown;
        let bar = (shown && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(8));
            let template = "{prefix:>14} [{bar:30}] {percent:>3} %  {elapsed} elapsed, {eta} left";
            bar.set_style(ProgressStyle::with_template(template).expect("the template is fixed").progress_chars("=> "));
            bar.set_prefix(name.to_owned());
            bar
        });
        Stage { bar, name: name.to_owned(), shown, begun: Instant::now() }
    }
}

impl Stage {
    /// Reports `n` more units done; false if the work should stop.
    #[inline]
    pub fn tick(&self, n: u64) -> bool {
        if n > 0
            && let Some(bar) = &self.bar
        {
            bar.inc(n);
        }
        !interrupted()
    }

    /// Prints a line without disturbing the bar.
    pub fn note(&self, label: &str, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| say!("{label:>14}  {text}")),
            None if self.shown => say!("{label:>14}  {text}"),
            None => {}
        }
    }

    /// Ends the stage; returns its wall seconds.
    ///
    /// # Errors
    /// `Interrupted` if someone has asked to stop meanwhile.
    pub fn end(self) -> Result<f64> {
        let seconds = self.begun.elapsed().as_secs_f64();
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        unless_interrupted()?;
        if self.shown {
            say!("{:>14}  {seconds:.2} s", self.name);
        }
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
