//! Pictures of n = 2 from the command line.

use super::{Folder, ok, refused, text};
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;
use std::path::Path;

const SCENE: &str = "[field]\ngenerator = \"bumps2\"\nsize = 17\n";

fn write(dir: &Path, name: &str, nz: usize) {
    let lattice = Lattice::aligned([9, 9, nz], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let mut samples: Vec<f32> = (0..lattice.len()).map(|o| (o % 9) as f32).collect();
    (samples[20], samples[40]) = (f32::NAN, f32::INFINITY);
    Volume::new("v", lattice, Samples::F32(samples)).unwrap().write(dir.join(name)).unwrap();
}

#[test]
fn samples_that_are_not_finite_are_told_of() {
    let dir = Folder::new();
    let dir = dir.path();
    write(dir, "v.npy", 2);
    fs::write(dir.join("s.toml"), "[field]\nfile = \"v.npy\"\n").unwrap();
    let said = text(&ok(dir, &["flatland", "s.toml", "-o", "out", "--width", "16", "--gather", "2", "-q"]).stderr);
    assert!(said.contains("s.toml: 2 of 81 samples are not finite"), "{said}");
    write(dir, "v.npy", 3);
    refused(dir, &["flatland", "s.toml", "-o", "out"], &["v.npy: 9×9×3 samples", "one sample thick", "or two"]);
}

#[test]
fn paths_have_a_most() {
    let dir = Folder::new();
    fs::write(dir.path().join("s.toml"), SCENE).unwrap();
    refused(dir.path(), &["flatland", "s.toml", "-o", "o", "--paths", "65537"], &["--paths 65537: 0 to 65536"]);
    // Before there is a folder.
    refused(dir.path(), &["study", "flatland", "--most", "999", "-o", "none"], &["--most 999"]);
    refused(dir.path(), &["study", "flatland", "--most", "1000001", "-o", "none"], &["--most 1000001"]);
    for limit in ["nan", "-5"] {
        let curve = ["study", "curve", "s.toml", "-o", "none", &format!("--limit={limit}")];
        refused(dir.path(), &curve, &["--limit", "0 seconds or more"]);
    }
    assert!(!dir.path().join("none").exists());
}

/// The picture of the paths is the last one.
#[cfg(unix)]
#[test]
fn drawing_paths_can_be_interrupted() {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};
    for signal in ["-INT", "-TERM"] {
        let dir = Folder::new();
        let dir = dir.path();
        fs::write(dir.join("s.toml"), SCENE).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_isolume"))
            .current_dir(dir)
            .args(["flatland", "s.toml", "-o", "o", "--paths", "65536", "--width", "100", "--gather", "2", "-q"])
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        while !dir.join("o/levelsets.svg").exists() && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        let asked = Instant::now();
        let code = child.wait().unwrap().code();
        assert!(
            code == Some(130) && asked.elapsed() < Duration::from_secs(1),
            "{signal}: {code:?} {:?}",
            asked.elapsed()
        );
        assert!(!dir.join("o/paths.png").exists());
    }
}
