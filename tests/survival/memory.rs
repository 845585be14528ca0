//! What bakes take, and what they say of it beforehand.

use super::{PROGRAM, finish, volume};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

#[test]
fn a_dry_run_takes_little_memory_whatever_the_walls() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "12");
    let dry = |more: &[&str]| {
        let script = "ulimit -v 4000000; exec \"$0\" \"$@\"";
        let mut command = Command::new("sh");
        command.current_dir(dir).args(["-c", script, PROGRAM, "bake", "b.vti", "-o", "q.vti", "--dry-run"]).args(more);
        let (output, text) =
            finish(command.args(["--threads", "2"]).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
        assert!(output.status.success(), "{more:?}: {text}");
        let line = text.lines().find(|l| l.trim_start().starts_with("time")).expect("the time is printed").to_owned();
        let seconds: f64 = line.split_whitespace().nth(2).unwrap().parse().unwrap();
        (seconds, line)
    };
    let (small, _) = dry(&["--wall-resolution", "256"]);
    let (large, line) = dry(&["--wall-resolution", "2048"]);
    // 64 times as many texels, which are nearly all of the work.
    assert!(large > 8.0 * small, "{small} s, then {line}");
    dry(&["--wall-resolution", "2048", "--engine", "photon"]);
    let (_, line) = dry(&["--engine", "photon", "--photons", "0"]);
    assert!(line.contains("photons 0.0"), "{line}");
}

/// Lines that miss the volume report to walls as often as walls are fine, not as voxels are: 6 GB at this margin.
#[test]
fn walls_far_away_take_no_more_memory() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "21");
    let peak = |margin: &str| memory(dir, &["--preset", "preview", "--margin", margin]).0;
    let (near, far) = (peak("1"), peak("1000"));
    println!("{:.0} and {:.0} MB", near / 1e6, far / 1e6);
    assert!(far < near + 64e6, "{near} {far}");
}

/// Peak resident memory of a bake, bytes; and the estimate it printed.
fn memory(dir: &Path, more: &[&str]) -> (f64, f64) {
    peak(dir, more, &mut Command::new(PROGRAM))
}

/// The same by a `command` of its own, such as in another environment.
fn peak(dir: &Path, more: &[&str], command: &mut Command) -> (f64, f64) {
    peak_of(dir, &[&["b.vti"], more].concat(), command)
}

/// The same of a volume that is named.
fn peak_of(dir: &Path, given: &[&str], command: &mut Command) -> (f64, f64) {
    command.current_dir(dir).args(["bake", "-o", "m.vti", "--threads", "2"]);
    let mut child = command.args(given).stderr(Stdio::piped()).spawn().unwrap();
    let status = format!("/proc/{}/status", child.id());
    let mut peak = 0f64;
    while child.try_wait().unwrap().is_none() {
        let text = fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find(|l| l.starts_with("VmHWM:"));
        if let Some(kb) = line.and_then(|l| l.split_whitespace().nth(1)?.parse::<f64>().ok()) {
            peak = peak.max(1024.0 * kb);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    let (output, text) = finish(child);
    assert!(output.status.success(), "{text}");
    let line = text.lines().find(|l| l.contains("at its peak")).expect("the estimate is printed");
    let mut words = line.split_whitespace().skip_while(|w| *w != "about").skip(1);
    let number: f64 = words.next().unwrap().parse().unwrap();
    let unit = if words.next() == Some("GB") { 1e9 } else { 1e6 };
    (peak, number * unit)
}

/// What a bake by sweeps takes more for more points. Where there is a surface everywhere, 48 bytes a point of its own,
/// 14 of the volume as read, its field, its pyramid and masks, and 14 of a checkpoint that is small enough to wait in
/// memory (79 before). Where one point in sixty is lit little more than the volume; it was 54.
#[test]
fn sweeps_take_48_bytes_a_point_that_is_lit() {
    let dir = tempfile::tempdir().unwrap();
    // On a busy machine a checkpoint would be due, which takes memory of its own.
    let few = ["--engine", "sweep", "--directions", "8", "--light-points", "1", "--wall-resolution", "8"];
    let few = [&few[..], &["--checkpoint-every", "3600"]].concat();
    for (isovalues, expected) in [(["-20", "120"], 48.0..64.0), (["60", "95"], 14.0..24.0)] {
        let [small, large] = [128, 192].map(|size| {
            volume(dir.path(), &size.to_string());
            // Else glibc keeps what is freed, 25 of 165 MB at 128³ in one run of three; blocks above 32 MB never.
            let mut command = Command::new(PROGRAM);
            command.env("MALLOC_MMAP_THRESHOLD_", "131072");
            peak(dir.path(), &[&["--isovalues"], &isovalues[..], &few].concat(), &mut command).0
        });
        let each = (large - small) / (192f64.powi(3) - 128f64.powi(3));
        println!("{isovalues:?}: {each:.1} bytes a point");
        assert!(expected.contains(&each), "{isovalues:?}: {each:.1} bytes a point");
    }
}

#[test]
fn the_memory_estimate_is_near_the_peak() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let few = ["--isovalues", "3.6", "95", "--gather", "1", "--shadow-rays", "1", "--wall-resolution", "8"];
    let sweep = ["--engine", "sweep", "--directions", "8", "--light-points", "4", "--checkpoint-every", "0"];
    let both = [&sweep[..], &["--sides=both"]].concat();
    for (size, more, within) in [
        ("33", &["--photons", "1000000"][..], 0.5..1.3),
        ("101", &["--photons", "200000"], 0.5..1.3),
        ("101", &["--photons", "200000", "--bands", "16", "--sides=both"], 0.5..1.3),
        // What a checkpoint holds is part of it.
        ("64", &sweep, 0.7..1.3),
        ("101", &sweep, 0.7..1.3),
        ("101", &both, 0.7..1.3),
    ] {
        volume(dir, size);
        let (peak, estimate) = memory(dir, &[&few[..], more].concat());
        println!("{size}³ {more:?}: peak {:.0} MB, estimate {:.0} MB", peak / 1e6, estimate / 1e6);
        assert!(within.contains(&(peak / estimate)), "peak over estimate: {:.2}", peak / estimate);
    }
    let dry = |most: &str, engine: &str| {
        let mut command = Command::new(PROGRAM);
        command.current_dir(dir).args(["bake", "b.vti", "-o", "x.vti", "--isovalues", "3.6", "95", "--engine", engine]);
        finish(command.args(["--max-memory", most, "--dry-run"]).stderr(Stdio::piped()).spawn().unwrap())
    };
    for (engine, stages) in [("photon", &["photons", "cache", "samples"][..]), ("sweep", &["sweep"])] {
        let (output, text) = dry("20M", engine);
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains("--max-memory") && text.contains("at its peak"), "{text}");
        let (output, text) = dry("64G", engine);
        assert!(output.status.success() && text.contains("at its peak"), "{text}");
        let time =
            text.lines().find(|l| l.trim_start().starts_with("time ")).unwrap_or_else(|| panic!("no time in {text}"));
        for stage in stages {
            let (_, after) = time.split_once(&format!("{stage} ")).unwrap_or_else(|| panic!("no {stage} in {time}"));
            let seconds: f64 = after.split(',').next().unwrap().trim().parse().unwrap();
            assert!((0.0..1e5).contains(&seconds) && (engine == "photon" || seconds > 0.0), "{time}");
        }
    }
    assert!(!dir.join("x.vti").exists(), "a dry run writes nothing");
}

/// When neither engine fits, the one that needs less says so, with what helps it; the limit stands as it is given.
#[test]
fn too_little_memory_is_told_for_the_engine_that_needs_less() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "20");
    let dry = |most: &str, more: &[&str]| {
        let mut command = Command::new(PROGRAM);
        command.current_dir(dir).args(["bake", "b.vti", "-o", "x.vti", "--isovalues", "3.6", "95"]);
        command.args(["--preset", "preview", "--dry-run", "--max-memory", most]).args(more);
        let (output, text) = finish(command.stderr(Stdio::piped()).spawn().unwrap());
        (output.status.code(), text)
    };
    let (code, text) = dry("30M", &[]);
    assert_eq!(code, Some(2), "{text}");
    let message = text.lines().find(|l| l.contains("--max-memory")).unwrap_or_else(|| panic!("no word of it: {text}"));
    assert!(message.contains("--max-memory 30M: ") && message.contains("(sweep "), "{message}");
    assert!(!message.contains("photons") && message.contains("--grid"), "{message}");
    let needed: f64 = message.split("about ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    let (code, text) = dry(&format!("{}", (needed + 1.0) * 1e6), &[]);
    assert!(code == Some(0) && text.contains("sweep: every isovalue"), "what it asked for is enough: {text}");
    let (code, text) = dry("30M", &["--engine", "photon"]);
    assert!(code == Some(2) && text.contains("--max-memory 30M: ") && text.contains("lower --photons"), "{text}");
    // As it would be read again.
    for (given, printed) in
        [("1000", "1000"), ("1024", "1K"), ("1.5k", "1.5K"), ("2560KiB", "2.5M"), ("20000000", "20000000")]
    {
        let (code, text) = dry(given, &["--engine", "sweep"]);
        assert!(code == Some(2) && text.contains(&format!("--max-memory {printed}: ")), "{given}: {text}");
    }
}

/// Lines across the long axis of a volume are as many in each of its slices.
#[test]
fn long_volumes_take_what_is_estimated() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let samples = (0..3000 * 8 * 8).map(|o: u32| (o / 3000 % 8 * 30) as u8).collect::<Vec<_>>();
    fs::write(dir.join("long.raw"), samples).unwrap();
    let raw = ["long.raw", "--raw-dims", "3000,8,8", "--raw-type", "u8", "--isovalues", "20", "190"];
    let few = ["--engine", "sweep", "--directions", "16", "--light-points", "1", "--wall-resolution", "8"];
    let (peak, estimate) = peak_of(dir, &[&raw[..], &few].concat(), &mut Command::new(PROGRAM));
    println!("peak {:.0} MB, estimate {:.0} MB", peak / 1e6, estimate / 1e6);
    assert!((0.5..1.3).contains(&(peak / estimate)), "peak over estimate: {:.2}", peak / estimate);
}
