//! What is written where: never over an input, never twice, and into a pipe only while someone reads it.

use super::{Folder, QUICK, isolume, ok, refused, text};
use isolume::volume::vti::VtiFile;
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::process::Command;

#[test]
fn a_second_bake_never_harms_the_first_unless_it_finishes() {
    let dir = Folder::new();
    let dir = dir.path();
    fs::write(dir.join("keep.vti"), "precious").unwrap();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let output = isolume(dir, &["bake", "b.vti", "-o", "keep.vti", "--isovalues", "500", "600"]);
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(fs::read(dir.join("keep.vti")).unwrap(), b"precious");
    let mut bake = vec!["bake", "b.vti", "-o", "keep.vti", "--isovalues", "3.6", "95", "-q"];
    bake.extend(QUICK);
    assert_eq!(text(&ok(dir, &bake).stderr), "", "--quiet is quiet");
    let lines = text(&ok(dir, &[&bake[..], &["--directions", "64", "--engine", "photon"]].concat()).stderr);
    assert_eq!(lines, "warning: directions has no effect with engine = \"photon\"\n", "but for warnings");
    assert!(VtiFile::read(&dir.join("keep.vti")).is_ok());
}

/// Whatever a verb reads is as it was, and nothing is written twice.
#[test]
fn no_output_takes_the_place_of_an_input() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let mut bake = vec!["bake", "b.vti", "-o", "lit.vti", "--isovalues", "3.6", "95", "-q"];
    bake.extend(QUICK);
    ok(dir, &bake);
    let reference = ["--isovalue", "47", "--samples", "2", "--batches", "2", "-q"];
    ok(dir, &[&["reference", "b.vti", "--isovalues", "3.6", "95", "-o", "r.ply"], &reference[..]].concat());
    fs::create_dir(dir.join("series")).unwrap();
    for n in 0..3 {
        fs::copy(dir.join("b.vti"), dir.join(format!("series/rho_{n:04}.vti"))).unwrap();
    }
    fs::write(dir.join("room.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    let scene = "isovalues = [3.6, 95]\n[volume]\nfile = \"b.vti\"\n[[context]]\nfile = \"room.obj\"\n";
    fs::write(dir.join("scene.toml"), scene).unwrap();
    ok(dir, &["extract", "series/rho_%04d.vti", "--time", "0.5", "--isovalue", "47", "-o", "moment.ply", "-q"]);
    let all = || {
        let files =
            ["b.vti", "lit.vti", "r.ply", "room.obj", "scene.toml", "series/rho_0000.vti", "series/rho_0002.vti"];
        files.map(|name| fs::read(dir.join(name)).unwrap())
    };
    let before = all();
    let taken = |args: &[&str], words: &[&str]| refused(dir, args, words);
    taken(&["bake", "b.vti", "-o", "b.vti"], &["b.vti", "is an input"]);
    taken(&["bake", "scene.toml", "-o", "./b.vti"], &["b.vti", "is an input"]);
    taken(&["bake", "b.vti", "-o", "new.vti", "--report", "b.vti"], &["b.vti", "is an input"]);
    taken(&["bake", "b.vti", "-o", "new.vti", "--report", "new.vti"], &["new.vti", "two outputs"]);
    taken(&["bake", "b.vti", "-o", "new.vti", "--checkpoint", "new.vti"], &["new.vti", "two outputs"]);
    let default = ["bake", "b.vti", "-o", "new.vti", "--report", "new.vti.checkpoint"];
    taken(&default, &["new.vti.checkpoint", "two outputs"]);
    taken(&["bake", "series/rho_%04d.vti", "-o", "series/rho.vti"], &["rho_%04d.vti", "would be a frame"]);
    let two = "isovalues = [3.6, 95]\n[[volume]]\nname = \"a\"\nfile = \"b.vti\"\n[[volume]]\nname = \"b\"\nfile = \"b-a.vti\"\n";
    fs::write(dir.join("two.toml"), two).unwrap();
    fs::copy(dir.join("b.vti"), dir.join("b-a.vti")).unwrap();
    taken(&["bake", "two.toml", "-o", "b.vtm"], &["b-a.vti", "is an input"]);
    taken(&["compare", "lit.vti", "r.ply", "-o", "r.ply"], &["r.ply", "is an input"]);
    taken(&["export", "lit.vti", "-o", "lit.vti"], &["lit.vti", "is an input"]);
    taken(&["extract", "scene.toml", "--isovalue", "47", "-o", "room.obj"], &["room.obj", "is an input"]);
    assert!(all() == before && !dir.join("new.vti").exists());
}

#[test]
fn a_pipe_that_nobody_reads_is_no_fault() {
    let dir = Folder::new();
    ok(dir.path(), &["generate", "bumps", "--size", "9", "-o", "b.vti"]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_isolume"));
    command.current_dir(dir.path()).args(["info", "b.vti", "--json"]);
    let mut child = command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{}", text(&output.stderr));
}

/// Names of walls may hold what XML cannot, paths what JSON cannot, and scripts name ends of sweeps by all their
/// digits.
#[test]
fn bakes_open_whatever_their_names_and_numbers_are() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let floor = |name: &str, z: &str| {
        format!("o {name}\nv -1 -1 {z}\nv 2 -1 {z}\nv 2 2 {z}\nv -1 2 {z}\nusemtl w\nf -4 -3 -2 -1\n")
    };
    let names = ["tab\tx", "tab x", "a\u{1}b", "a\u{fffe}b"];
    let walls: String = names.iter().zip(["-1", "-2", "-3", "-4"]).map(|(name, z)| floor(name, z)).collect();
    fs::write(dir.join("w.obj"), format!("mtllib w.mtl\n{walls}")).unwrap();
    fs::write(dir.join("w.mtl"), "newmtl w\nKd 0.5 0.5 0.5\nKe 1 1 1\n").unwrap();
    // Parsers that round roughly give 90.75844800894184.
    let (lo, hi) = ("3.6", "90.75844800894185");
    let bake = ["bake", "b.vti", "--isovalues", lo, hi, "--box", "w.obj", "-o", "lit.vti", "-q"];
    ok(dir, &[&bake[..], &QUICK].concat());
    let path = OsStr::from_bytes(b"\xff.ply");
    for (verb, input) in [("extract", "lit.vti"), ("reference", "lit.vti")] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_isolume"));
        command.current_dir(dir).args([verb, input, "--isovalue", hi, "--json", "-q", "-o"]).arg(path);
        if verb == "reference" {
            command.args(["--samples", "2", "--batches", "2"]);
        }
        let output = command.output().unwrap();
        assert!(output.status.success(), "{verb}: {}", text(&output.stderr));
        let printed: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(printed["file"], "\u{fffd}.ply");
    }
    let file = VtiFile::read(&dir.join("lit.vti")).unwrap();
    let arrays = file.field_data.iter().filter(|a| a.name.starts_with("wall_"));
    assert_eq!(arrays.count(), names.len());

    let scene = "[[volume]]\nname = \"a\"\nfile = \"b.vti\"\nisovalues = [3.6, 95]\n";
    fs::write(dir.join("two.toml"), format!("{scene}{}", scene.replace("\"a\"", "\"b\""))).unwrap();
    refused(dir, &["bake", "two.toml", "-o", "a\nb.vtm"], &["a\\nb.vtm", "the .vtm", "line breaks"]);
}
