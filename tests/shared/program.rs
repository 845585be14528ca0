//! Runs the program as users do.

use std::path::Path;
use std::process::{Command, Output};

/// Runs it in `dir`.
pub(crate) fn isolume(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_isolume")).current_dir(dir).args(args).output().expect("the program starts")
}

/// Runs what must succeed.
#[allow(dead_code, reason = "not every program needs it")]
pub(crate) fn ok(dir: &Path, args: &[&str]) -> Output {
    let output = isolume(dir, args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}
