//! `make gallery`, tiny: the script, the scenes it uses and its page.

use std::fs;
use std::path::Path;
use std::process::Command;

#[test]
fn two_figures_render_tiny() {
    let dir = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/gallery");
    let mut command = Command::new("python3");
    command.arg(script).arg(env!("CARGO_BIN_EXE_isolume")).arg(dir.path()).args(["--tiny", "--only", "1", "4"]);
    let output = command.output().expect("python3, which make deps needs too");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = fs::read_to_string(dir.path().join("README.md")).unwrap();
    let shown: Vec<&str> = page.split("](").skip(1).filter_map(|s| s.split(')').next()).collect();
    let pictures: Vec<&&str> = shown.iter().filter(|s| s.ends_with(".png")).collect();
    assert_eq!(pictures.len(), 7, "{page}");
    for name in pictures {
        let bytes = fs::read(dir.path().join(name)).unwrap();
        assert!(bytes.starts_with(b"\x89PNG") && bytes.len() > 300, "{name}");
    }
    // The contrast of the contact shadow: near is darker.
    let numbers: Vec<f64> = page.split("**").skip(1).step_by(2).filter_map(|n| n.parse().ok()).collect();
    assert!(matches!(numbers[..], [far, near] if near > far + 0.15), "{page}");
}
