//! What is not tested on a machine is told.

use std::io::Write;

/// Tells that `what` is not tested, and why, though the test passes: to standard error itself, since what tests print
/// is shown only if they fail. Where `ISOLUME_SKIP_NOTHING` is set it fails.
pub(crate) fn skipped(what: &str, why: &str) {
    let _ = writeln!(std::io::stderr(), "not tested: {what}: {why}");
    assert!(std::env::var_os("ISOLUME_SKIP_NOTHING").is_none(), "{what}: {why}");
}
