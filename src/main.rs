//! The command line's entry: parse, run, one clear line and an exit code on failure.

use clap::Parser;
use isolume::cli::Cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("isolume: {e}");
            ExitCode::from(e.exit_code())
        }
    }
}
