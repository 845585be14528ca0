//! Studies as users meet them: what an earlier run left is taken up if it is of the same scene, settings and volume,
//! and refused otherwise.

#[path = "shared/folder.rs"]
mod folder;
#[path = "shared/program.rs"]
mod program;

use folder::Folder;
use program::{isolume, ok};
use std::fs;
use std::path::Path;

fn scene(dir: &Path, albedo: f64) {
    fs::create_dir_all(dir).unwrap();
    fs::write(dir.join("s.toml"), format!("[volume]\nfile = \"../b.vti\"\n[surface]\nalbedo = {albedo}\n")).unwrap();
}

/// All files below `dir` with their content.
fn content(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()) {
        if entry.is_dir() {
            files.extend(content(&entry));
        } else {
            files.push((entry.display().to_string(), fs::read(&entry).unwrap()));
        }
    }
    files.sort();
    files
}

#[test]
fn what_another_scene_or_other_settings_left_is_refused_and_the_same_study_adds_nothing() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "8", "-o", "b.vti", "-q"]);
    scene(&dir.join("sa"), 0.1);
    scene(&dir.join("sb"), 0.9);
    let study = |scenes: &[&str], more: &[&str]| {
        let common = ["-o", "st", "--quick", "-q", "--engine", "photon", "--photons", "2000", "--gather", "2"];
        isolume(dir, &[&["study", "datasets"], scenes, &common, more].concat())
    };
    let refused = |scenes: &[&str], more: &[&str], words: &[&str]| {
        let before = fs::exists(dir.join("st")).unwrap().then(|| content(&dir.join("st")));
        let output = study(scenes, more);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{scenes:?} {more:?}: {message}");
        for word in words {
            assert!(message.contains(word), "'{word}' is missing in: {message}");
        }
        if let Some(before) = before {
            assert!(content(&dir.join("st")) == before, "{scenes:?} {more:?} changed files");
        }
    };
    // Two of one name at once would be told apart by nothing.
    refused(&["sa/s.toml", "sb/s.toml"], &[], &["'s'", "folder"]);

    let first = study(&["sa/s.toml"], &[]);
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let table = fs::read_to_string(dir.join("st/datasets.csv")).unwrap();
    assert_eq!(table.lines().count(), 4, "{table}");
    let before = content(&dir.join("st"));
    assert!(study(&["sa/s.toml"], &[]).status.success());
    assert!(content(&dir.join("st")) == before, "the same command again added something");

    // Figures of another version are not for this one's table, whatever the scene.
    let rows = dir.join("st/datasets.csv");
    fs::write(&rows, table.replace("isolume 0.", "isolume 99.")).unwrap();
    refused(&["sa/s.toml"], &[], &["datasets.csv", "`isolume 99.", "`isolume 0.", "another folder"]);
    refused(&["sb/s.toml"], &[], &["datasets.csv", "another folder"]);
    fs::write(&rows, table.replace(" threads, ", "0 threads, ")).unwrap();
    refused(&["sa/s.toml"], &[], &["datasets.csv", "0 threads", "another folder"]);
    fs::write(&rows, &table).unwrap();

    refused(&["sb/s.toml"], &[], &["datasets.csv", "'s'", "another folder"]);
    refused(&["sa/s.toml"], &["--preset", "preview"], &["datasets.csv", "'s'", "another folder"]);
    scene(&dir.join("sa"), 0.2);
    refused(&["sa/s.toml"], &[], &["datasets.csv", "'s'", "another folder"]);
    scene(&dir.join("sa"), 0.1);
    let other = isolume(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    assert!(other.status.success());
    refused(&["sa/s.toml"], &[], &["datasets.csv", "'s'", "another folder"]);
}

#[test]
fn settings_are_checked_before_anything_is_computed() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "8", "-o", "b.vti", "-q"]);
    for n in 0..2 {
        fs::copy(dir.join("b.vti"), dir.join(format!("t_{n}.vti"))).unwrap();
    }
    let output = isolume(dir, &["study", "datasets", "t_%d.vti", "-o", "st", "--quick"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.contains("name one of its files"), "{said}");
    // Of the last, each study has values of its own.
    let own = [("--strategy", "planes"), ("--samples", "1000"), ("--photons", "1000")];
    for (study, own) in ["datasets", "strategies", "curve"].into_iter().zip(own) {
        for (option, value) in [("--gather", "2000000"), ("--wall-resolution", "1"), ("--bands", "1000"), own] {
            let output = isolume(dir, &["study", study, "b.vti", "-o", "st", "--quick", option, value]);
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.code() == Some(2) && said.lines().count() == 1, "{study} {option}: {said}");
            assert!(said.contains(option.trim_start_matches('-')), "{study} {option}: {said}");
            assert!(!dir.join("st/references").exists() || content(&dir.join("st/references")).is_empty());
        }
    }
}

#[test]
fn strategies_are_not_baked_again_where_there_is_no_surface_to_compare() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "8", "-o", "b.vti", "-q"]);
    let study = |range: &str| {
        let text = format!("isovalues = [{range}]\n[volume]\nfile = \"b.vti\"\n");
        fs::write(dir.join("s.toml"), text).unwrap();
        // On another grid than the volume's: figures of it once read beyond its end.
        let common =
            ["-o", "st", "--quick", "--photons", "2000", "--gather", "2", "--wall-resolution", "4", "--grid", "6,6,6"];
        let output = isolume(dir, &[&["study", "strategies", "s.toml"][..], &common].concat());
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    // The upper half of the sweep lies above all samples.
    let bakes = |said: &str| said.lines().filter(|l| l.contains("samples, ")).count();
    let (code, said) = study("3.6, 190");
    assert_eq!((code, bakes(&said)), (Some(0), 8), "{said}");
    let table = fs::read_to_string(dir.join("st/strategies.csv")).unwrap();
    let rows = table.lines().count() - 1;
    assert!(rows > 0 && rows.is_multiple_of(8) && rows < 7 * 8, "{table}");
    let (code, said) = study("3.6, 190");
    assert_eq!((code, bakes(&said)), (Some(0), 0), "{said}");
    assert_eq!(fs::read_to_string(dir.join("st/strategies.csv")).unwrap(), table);

    // No isovalue that is compared has a surface.
    fs::remove_dir_all(dir.join("st")).unwrap();
    let (code, said) = study("-1e6, 1e6");
    assert!(code == Some(2) && said.contains("'s' has no surface") && bakes(&said) == 0, "{code:?} {said}");
}

#[test]
fn curves_are_refused_where_no_error_would_be_known() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "8", "-o", "b.vti", "-q"]);
    let text = |range: &str| format!("isovalues = [{range}]\n[volume]\nfile = \"b.vti\"\n");
    fs::write(dir.join("good.toml"), text("3.6, 95")).unwrap();
    fs::write(dir.join("bad.toml"), text("-1e6, 1e6")).unwrap();
    let common = ["-o", "st", "--quick", "--wall-resolution", "4", "--limit", "0"];
    let study = |scenes: &[&str]| {
        let output = isolume(dir, &[&["study", "curve"], scenes, &common].concat());
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    // Before any of them is begun.
    let (code, said) = study(&["good.toml", "bad.toml"]);
    assert!(code == Some(2) && said.contains("'bad' has no surface") && !said.contains("good"), "{code:?} {said}");
    let (code, said) = study(&["good.toml"]);
    assert!(code == Some(0) && said.contains("good"), "{code:?} {said}");
}

/// Each volume of an independent scene is judged as it was lit, without the others; what a study leaves aside it says.
#[test]
fn volumes_are_judged_by_the_light_that_they_get() {
    let dir = Folder::new();
    let dir = dir.path();
    for policy in ["joint", "independent"] {
        let scene = format!(
            "policy = \"{policy}\"\n[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 9\nisovalues = [10, 90]\n\
             [[volume]]\nname = \"b\"\ngenerator = \"sphere\"\nsize = 9\norigin = [0, 0, 0.9]\nisovalues = [0.02, 0.2]\n\
             outside = \"higher\"\n[bake]\ngrid = \"2x\"\n"
        );
        fs::write(dir.join(format!("{policy}.toml")), scene).unwrap();
    }
    let output = ok(
        dir,
        &[
            "study",
            "datasets",
            "joint.toml",
            "independent.toml",
            "-o",
            "st",
            "--quick",
            "-q",
            "--engine",
            "photon",
            "--photons",
            "2000",
            "--gather",
            "2",
        ],
    );
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("independent.toml: its [bake] is left aside (grid)"), "{message}");
    let table = fs::read_to_string(dir.join("st/datasets.csv")).unwrap();
    let floor = |name: &str| -> f64 {
        let names: Vec<&str> = table.lines().next().unwrap().split(',').collect();
        let at = names.iter().position(|n| *n == "floor_total").unwrap();
        let row = table.lines().find(|l| l.starts_with(&format!("{name},"))).unwrap();
        row.split(',').nth(at).unwrap().parse().unwrap()
    };
    // The sphere in the light's way darkens the bumps that it hangs above.
    assert!((floor("joint") - floor("independent")).abs() > 0.1, "{} {}", floor("joint"), floor("independent"));
}
