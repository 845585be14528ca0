//! The command line's entry: parse, run, one clear line and an exit code on failure.

use isolume::cli::Cli;
use std::io::Write;
use std::process::ExitCode;

fn main() -> ExitCode {
    end_quietly_when_nobody_reads();
    match Cli::from_arguments().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            let _ = writeln!(std::io::stderr(), "isolume: {e}");
            ExitCode::from(e.exit_code())
        }
    }
}

/// `isolume info … | head` closes the pipe early, and `println!` panics when it does: that is no fault to report. A
/// full disk is.
fn end_quietly_when_nobody_reads() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let text = panic.payload().downcast_ref::<String>();
        if let Some(fault) = text.and_then(|t| t.strip_prefix("failed printing to stdout: ")) {
            if fault.contains("Broken pipe") || fault.contains("pipe is being closed") {
                std::process::exit(0);
            }
            let _ = writeln!(std::io::stderr(), "isolume: standard output: {fault}");
            std::process::exit(1);
        }
        report(panic);
    }));
}
