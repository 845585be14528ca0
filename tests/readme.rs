//! The README stays true: every shell command in it runs, in order, but `make test`.

use std::path::Path;
use std::process::Command;

#[test]
fn every_command_of_the_readme_runs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = std::fs::read_to_string(root.join("README.md")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let binary = Path::new(env!("CARGO_BIN_EXE_isolume")).parent().unwrap();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths(std::iter::once(binary.to_path_buf()).chain(std::env::split_paths(&path))).unwrap();
    let mut ran = 0;
    for block in readme.split("```sh\n").skip(1) {
        for command in block.split("```").next().unwrap().lines().filter(|l| !l.is_empty()) {
            if command == "make test" {
                continue;
            }
            // Commands about the checkout run in it, the tutorial's in a folder of its own.
            let folder = if command.starts_with("make") { root } else { dir.path() };
            let mut shell = Command::new("sh");
            shell.arg("-c").arg(command).current_dir(folder).env("PATH", &path);
            // Errands of `make` take this program: the release profile would compile everything once more.
            shell.env("ISOLUME", env!("CARGO_BIN_EXE_isolume"));
            let output = shell.output().unwrap();
            assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
            ran += 1;
        }
    }
    assert!(ran >= 6, "only {ran} commands found");
    for file in ["lit.vti", "lit.json", "lit.png", "local.png"] {
        assert!(dir.path().join(file).exists(), "the tutorial did not make {file}");
    }
    for picture in readme.split("](").skip(1).filter_map(|s| s.split(')').next()).filter(|s| s.ends_with(".png")) {
        assert!(root.join(picture).exists(), "the README shows {picture}, which does not exist");
    }
}
