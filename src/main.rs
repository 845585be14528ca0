//! The command line's entry: parse, run, one clear line and an exit code on failure.

use clap::Parser;
use isolume::cli::Cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    end_quietly_when_nobody_reads();
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("isolume: {e}");
            ExitCode::from(e.exit_code())
        }
    }
}

/// `isolume info … | head` closes the pipe early, and `println!` panics when it does: that is no fault to report.
fn end_quietly_when_nobody_reads() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let text = panic.payload().downcast_ref::<String>();
        if text.is_some_and(|t| t.contains("failed printing to stdout")) {
            std::process::exit(0);
        }
        report(panic);
    }));
}
