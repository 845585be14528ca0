//! What a bake survives: kills, interrupts, full disks, folders that cannot be written, too little memory.

#![cfg(target_os = "linux")]

mod memory;

use isolume::bake::{BakeOptions, BakeSettings, Engine, Preset, job};
use isolume::checkpoint::Checkpoint;
use isolume::embree::Device;
use isolume::rng::{Rng, Stage};
use isolume::scene_file::{SceneOptions, load};
use isolume::volume::Samples;
use isolume::volume::vti::VtiFile;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

const PROGRAM: &str = env!("CARGO_BIN_EXE_isolume");

/// A bake of a second or two, with checkpoints many times a second.
const BAKE: [&str; 16] = [
    "bake",
    "b.vti",
    "--isovalues",
    "3.6",
    "95",
    "--photons",
    "20000",
    "--gather",
    "48",
    "--shadow-rays",
    "64",
    "--wall-resolution",
    "8",
    "--checkpoint-every",
    "0.02",
    "--sides=both",
];

/// So that it takes that long on any machine.
const TWO_THREADS: [(&str, &str); 1] = [("RAYON_NUM_THREADS", "2")];

fn volume(dir: &Path, size: &str) {
    let mut command = Command::new(PROGRAM);
    command.current_dir(dir).args(["generate", "bumps", "--size", size, "-o", "b.vti", "-q"]);
    assert!(command.status().unwrap().success());
}

fn bake(dir: &Path, output: &str, more: &[&str]) -> Child {
    let mut command = Command::new(PROGRAM);
    command.current_dir(dir).args(BAKE).args(["-o", output]).args(more).envs(TWO_THREADS);
    command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts")
}

fn finish(child: Child) -> (Output, String) {
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    (output, text)
}

/// Every bit of light and every count.
fn light(path: &Path) -> Vec<u64> {
    let file = VtiFile::read(path).unwrap();
    let counts = ["rays", "samples", "masked", "filled", "misses", "photons.stored", "samples_without_gradient"];
    let fields = file.field_data.iter().filter(|a| a.name.starts_with("wall_") || counts.contains(&a.name.as_str()));
    let mut bits = Vec::new();
    for array in file.point_data.iter().chain(fields) {
        match &array.samples {
            Samples::F32(v) => bits.extend(v.iter().map(|x| u64::from(x.to_bits()))),
            Samples::F64(v) => bits.extend(v.iter().map(|x| x.to_bits())),
            Samples::U8(v) => bits.extend(v.iter().map(|&x| u64::from(x))),
            other => panic!("{}: {:?}", array.name, other.element_type()),
        }
    }
    bits
}

#[test]
fn twenty_kills_leave_no_trace_in_the_result() {
    killed(20, &[], |found| assert!(found >= 8, "kills came too early to test anything"));
}

#[test]
fn twenty_four_kills_between_bands_leave_no_trace_in_the_result() {
    killed(24, &["--bands", "5"], |found| assert!(found >= 8, "kills came too early to test anything"));
}

#[test]
fn ten_kills_of_a_sweep_leave_no_trace_in_the_result() {
    // One block holds all finished passes.
    let sweep = ["--engine", "sweep", "--directions", "256", "--light-points", "16"];
    killed(10, &sweep, |found| assert!(found >= 1, "kills came too early to test anything"));
}

/// Kills a bake so many times, resumes it, and compares its bits with those of one that nobody killed. `check` receives
/// the most finished blocks that a killed bake left.
fn killed(kills: u32, more: &[&str], check: impl Fn(u64)) {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "33");
    let (output, text) = finish(bake(dir, "whole.vti", more));
    assert!(output.status.success(), "{text}");
    assert!(!dir.join("whole.vti.checkpoint").exists(), "a finished bake needs no checkpoint");
    let whole = light(&dir.join("whole.vti"));
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let (mut killed, mut blocks, mut early, mut most) = (0, vec![0], 0, 0);
    let checkpoint = dir.join("cut.vti.checkpoint");
    // Length and time of the file.
    let written = || fs::metadata(&checkpoint).map_or((0, None), |m| (m.len(), m.modified().ok()));
    while killed < kills {
        let before = written();
        let mut child = bake(dir, "cut.vti", &[more, &["--resume"]].concat());
        // Every other kill comes at any time; the rest at any time after some progress, however busy the machine is.
        if killed % 2 == 1 {
            for _ in 0..3000 {
                if written() != before || child.try_wait().unwrap().is_some() {
                    break;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        std::thread::sleep(Duration::from_millis(rng.bits() % 150));
        // SIGKILL, which may come too late.
        child.kill().unwrap();
        let (output, text) = finish(child);
        assert!(output.status.success() || output.status.signal() == Some(9), "{text}");
        if dir.join("cut.vti").exists() {
            // The last kills left little to do: no half result, and begin again.
            assert!(light(&dir.join("cut.vti")) == whole, "the same bits");
            fs::remove_file(dir.join("cut.vti")).unwrap();
            (early, blocks) = (early + 1, vec![0]);
            continue;
        }
        assert!(!output.status.success(), "a result is missing: {text}");
        let resumed = text.lines().find(|l| l.contains("finished blocks"));
        let found = resumed.map_or(0, |l| l.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap());
        assert!(blocks.last() <= Some(&found) || resumed.is_none(), "progress is lost: {blocks:?}, then {found}");
        blocks.extend(resumed.map(|_| found));
        most = most.max(found);
        killed += 1;
    }
    let (output, text) = finish(bake(dir, "cut.vti", &[more, &["--resume", "--threads", "3"]].concat()));
    assert!(output.status.success(), "{text}");
    println!("{killed} kills, {early} runs that came through, blocks found: {blocks:?}");
    check(most);
    assert!(light(&dir.join("cut.vti")) == whole, "the same bits");
    let left: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    assert!(!left.iter().any(|n| n.contains("checkpoint")), "{left:?}");
}

#[test]
fn an_interrupt_keeps_progress_and_the_old_result() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "33");
    fs::write(dir.join("out.vti"), "precious").unwrap();
    for (signal, n) in [("-INT", 0), ("-TERM", 1)] {
        let child = bake(dir, "out.vti", if n == 0 { &[] } else { &["--resume"] });
        let checkpoint = dir.join("out.vti.checkpoint");
        for _ in 0..500 {
            if checkpoint.exists() {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        std::thread::sleep(Duration::from_millis(100));
        // Twice within moments, as `timeout` sends it to a process and to its group.
        for _ in 0..2 {
            assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
            std::thread::sleep(Duration::from_millis(2));
        }
        let (output, text) = finish(child);
        assert_eq!(output.status.code(), Some(130), "{text}");
        assert!(text.contains("--resume") && text.contains("interrupted"), "{text}");
        assert!(checkpoint.exists());
        assert_eq!(fs::read(dir.join("out.vti")).unwrap(), b"precious");
    }
    // Other settings must not take these blocks.
    let (output, text) = finish(bake(dir, "out.vti", &["--resume", "--seed", "7"]));
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("another bake") && text.contains("seed: 1") && text.contains("seed: 7"), "{text}");
    // A file that is no checkpoint is not overwritten.
    fs::copy(dir.join("b.vti"), dir.join("other.vti")).unwrap();
    let (output, text) = finish(bake(dir, "out.vti", &["--checkpoint", "other.vti"]));
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("no checkpoint"), "{text}");
    // One whose beginning is damaged is refused.
    let damage = |at: usize| {
        let mut bytes = fs::read(dir.join("out.vti.checkpoint")).unwrap();
        let at = at.min(bytes.len() - 1);
        bytes[at] ^= 1;
        fs::write(dir.join("out.vti.checkpoint"), bytes).unwrap();
    };
    damage(100);
    let (output, text) = finish(bake(dir, "out.vti", &["--resume"]));
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("damaged"), "{text}");
    // What stands before damage further on is taken.
    damage(100);
    damage(usize::MAX);
    let report = || -> serde_json::Value { serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap() };
    let (output, text) = finish(bake(dir, "out.vti", &["--resume", "--report", "r.json"]));
    assert!(output.status.success() && text.contains("are damaged") && text.contains("finished blocks"), "{text}");
    assert!(report()["resumed_blocks"].as_u64().unwrap() > 0 && report()["rays_per_second"].is_null(), "{text}");
    // What is complete is not done again.
    let (written, first) = (fs::metadata(dir.join("out.vti")).unwrap().modified().unwrap(), report());
    fs::remove_file(dir.join("r.json")).unwrap();
    let (output, text) = finish(bake(dir, "out.vti", &["--resume", "--report", "r.json"]));
    assert!(output.status.success() && text.contains("out.vti is complete"), "{text}");
    assert_eq!(fs::metadata(dir.join("out.vti")).unwrap().modified().unwrap(), written);
    assert_eq!(report()["job"], first["job"]);
    // Nor is it replaced by one of other settings.
    let (output, text) = finish(bake(dir, "out.vti", &["--resume", "--seed", "7"]));
    assert!(output.status.code() == Some(2) && text.contains("out.vti: is a bake of other settings"), "{text}");
    assert_eq!(fs::metadata(dir.join("out.vti")).unwrap().modified().unwrap(), written);
    let (output, text) = finish(bake(dir, "whole.vti", &[]));
    assert!(output.status.success(), "{text}");
    assert!(light(&dir.join("out.vti")) == light(&dir.join("whole.vti")), "the same bits");
}

/// `nohup` has a program ignore that its terminal goes.
#[test]
fn what_nohup_started_outlives_its_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "33");
    let mut command = Command::new("sh");
    command.current_dir(dir).args(["-c", "trap '' HUP; exec \"$0\" \"$@\"", PROGRAM]).args(BAKE);
    command.args(["-o", "out.vti"]).envs(TWO_THREADS).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    while !dir.join("out.vti.checkpoint").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it could be asked to");
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(Command::new("kill").args(["-HUP", &child.id().to_string()]).status().unwrap().success());
    assert!(!dir.join("out.vti").exists(), "it was done before it was asked");
    let (output, text) = finish(child);
    assert!(output.status.success(), "{text}");
    assert!(dir.join("out.vti").exists());
}

/// Of a loop of brief commands one signal is the end: a shell goes on with the next one if they say that all is well.
#[test]
fn brief_commands_say_that_they_were_interrupted() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let mut generate = Command::new(PROGRAM);
    generate.current_dir(dir).args(["generate", "bumps", "--size", "320", "-o", "big.nrrd", "-q"]);
    assert!(generate.status().unwrap().success());
    fs::write(dir.join("out.vti"), "precious").unwrap();
    // A temporary file of a process that was killed: of this boot and namespace, and of no process that lives.
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id");
    let space = fs::read_link("/proc/self/ns/pid");
    let orphan = boot.ok().zip(space.ok()).map(|(boot, space)| {
        let digits: String = space.to_string_lossy().chars().filter(char::is_ascii_digit).collect();
        let boot = boot.trim().rsplit('-').next().unwrap_or_default().to_owned();
        dir.join(format!(".out.vti.{boot}{digits}-4294967-0.tmp"))
    });
    orphan.iter().for_each(|path| fs::write(path, "left").unwrap());
    for args in [&["export", "big.nrrd", "-o", "out.vti"][..], &["info", "big.nrrd"]] {
        let mut command = Command::new(PROGRAM);
        let child = command.current_dir(dir).args(args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(200));
        assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
        let (output, text) = finish(child);
        assert_eq!(output.status.code(), Some(130), "{args:?}: {text}");
    }
    assert_eq!(fs::read(dir.join("out.vti")).unwrap(), b"precious");
    assert!(orphan.iter().all(|path| !path.exists()), "left over: {orphan:?}");
}

/// Runs a bake that may write files of so many blocks of 512 bytes: a full disk, as far as a process can tell.
fn with_small_files(dir: &Path, blocks: u32, more: &[&str]) -> (Output, String) {
    let script = format!("ulimit -f {blocks}; exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command.current_dir(dir).args(["-c", &script, PROGRAM]).args(BAKE).args(["-o", "out.vti"]).args(more);
    finish(command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap())
}

#[test]
fn a_full_disk_is_one_clear_line_and_keeps_the_last_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "17");
    fs::write(dir.join("out.vti"), "precious").unwrap();
    // Room for no checkpoint at all.
    let (output, text) = with_small_files(dir, 0, &[]);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("out.vti") && text.contains("arge"), "{text}");
    assert_eq!(text.matches("no checkpoint could be written").count(), 1, "warned once: {text}");
    // Room for some checkpoints, not for all nor for the result.
    let (output, text) = with_small_files(dir, 300, &[]);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert_eq!(fs::read(dir.join("out.vti")).unwrap(), b"precious");
    let left: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    assert!(!left.iter().any(|n| n.ends_with(".tmp")), "{left:?}");
    let (output, text) = finish(bake(dir, "out.vti", &["--resume"]));
    assert!(output.status.success() && text.contains("finished blocks"), "{text}");
    let (output, text) = finish(bake(dir, "whole.vti", &[]));
    assert!(output.status.success(), "{text}");
    assert!(light(&dir.join("out.vti")) == light(&dir.join("whole.vti")));
}

#[test]
fn pictures_and_meshes_can_be_interrupted_and_keep_older_ones() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "33");
    let flat = "[field]\ngenerator = \"bumps2\"\n";
    fs::write(dir.join("flat.toml"), flat).unwrap();
    fs::create_dir(dir.join("flat")).unwrap();
    let kept = ["out.png", "out.ply", "flat/flattened.png"];
    kept.iter().for_each(|name| fs::write(dir.join(name), "precious").unwrap());
    // Seconds to minutes of work.
    let render = ["render", "b.vti", "--isovalue", "50", "-o", "out.png", "--samples", "60000"];
    for args in [
        &[&render[..], &["--reference"]].concat()[..],
        &[&render[..], &["--reference", "--trilinear"]].concat(),
        &[&render[..], &["--local"]].concat(),
        &["extract", "b.vti", "--isovalue", "50", "--refine", "64", "-o", "out.ply"],
        &["flatland", "flat.toml", "-o", "flat", "--gather", "60000"],
        &["flatland", "flat.toml", "-o", "flat", "--gather", "4", "--width", "8192"],
    ] {
        let mut command = Command::new(PROGRAM);
        command.current_dir(dir).args(args).stdout(Stdio::null()).stderr(Stdio::piped());
        let child = command.spawn().unwrap();
        std::thread::sleep(Duration::from_secs(1));
        let begun = std::time::Instant::now();
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        let (output, text) = finish(child);
        assert_eq!(output.status.code(), Some(130), "{args:?}: {text}");
        assert!(text.contains("interrupted"), "{args:?}: {text}");
        println!("{args:?} {:?}", begun.elapsed());
        assert!(begun.elapsed() < Duration::from_secs(20), "{args:?}: {:?}", begun.elapsed());
    }
    for name in kept {
        assert_eq!(fs::read(dir.join(name)).unwrap(), b"precious", "{name}");
    }
}

/// A sweep so thin that it holds one sample of `b.vti` and, between samples, no place that f32 tells apart.
fn thin(dir: &Path) -> [f64; 2] {
    let value = load(&dir.join("b.vti"), &SceneOptions::default()).unwrap().volume.samples().get(6 + 17 * (7 + 17 * 9));
    [value, value + 1e-8]
}

/// What is said of a bake that is refused.
fn refused(dir: &Path, more: &[&str]) -> String {
    let mut command = Command::new(PROGRAM);
    let [lo, hi] = thin(dir).map(|c| format!("{c:?}"));
    command.current_dir(dir).args(["bake", "b.vti", "-o", "out.vti", "--isovalues", &lo, &hi]);
    // Every other sample, and not that one.
    command.args(["--engine", "sweep", "--preset", "preview", "--grid", "9,9,9"]).args(more);
    let (output, text) = finish(command.stderr(Stdio::piped()).spawn().unwrap());
    assert_eq!(output.status.code(), Some(2), "{text}");
    text
}

/// A bake that no resuming can help: no grid point holds anything of its sweep, which is seen at its end.
fn hopeless(dir: &Path, more: &[&str]) -> String {
    let text = refused(dir, more);
    assert!(text.contains("no grid point lies on"), "{text}");
    text
}

#[test]
fn what_can_never_succeed_leaves_no_checkpoint_and_spares_older_ones() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "17");
    let checkpoint = dir.join("out.vti.checkpoint");
    // One that waits for its minute, one that is written as the work goes on.
    for every in ["60", "0"] {
        let text = hopeless(dir, &["--checkpoint-every", every]);
        assert!(!text.contains("--resume") && !checkpoint.exists(), "{text}");
    }
    // Another bake's.
    let older = b"isolume checkpoint 8\nof another bake";
    fs::write(&checkpoint, older).unwrap();
    let text = hopeless(dir, &[]);
    assert_eq!(fs::read(&checkpoint).unwrap(), older, "{text}");
    assert!(text.contains("unfinished bake of another version"), "{text}");
    fs::remove_file(&checkpoint).unwrap();
    // Its own, of an interrupted run, however much this one adds.
    let scene = SceneOptions { isovalues: Some(thin(dir).to_vec()), ..SceneOptions::default() };
    let scene = load(&dir.join("b.vti"), &scene).unwrap().scene;
    let options = BakeOptions {
        engine: Some(Engine::Sweep),
        preset: Some(Preset::Preview),
        grid: Some("9,9,9".parse().unwrap()),
        ..BakeOptions::default()
    };
    let settings = BakeSettings::new(&options, &scene).unwrap();
    let of = |embree: &str| Checkpoint::new(&checkpoint, job(&scene, &settings, embree), Duration::ZERO).unwrap();
    // By another Embree, which gives other bits.
    of("4.0.0").stage(99).save(0, || vec![7; 100]);
    let text = refused(dir, &["--resume"]);
    assert!(text.contains("another bake: it has `embree: 4.0.0`"), "{text}");
    let embree = Device::new(1).unwrap().version();
    let running = of(&embree);
    running.stage(99).save(0, || vec![7; 100]);
    for more in [&[][..], &["--resume"]] {
        let text = refused(dir, more);
        assert!(text.contains("out.vti.checkpoint: another bake writes it"), "{text}");
    }
    drop(running);
    let notes = [&[][..], &["--seed", "8"]].map(|more| hopeless(dir, more));
    assert!(notes[0].contains("--resume would go on with it"), "{}", notes[0]);
    assert!(notes[1].contains("unfinished bake of other settings"), "{}", notes[1]);
    for every in ["60", "0"] {
        let text = hopeless(dir, &["--resume", "--checkpoint-every", every]);
        assert!(text.contains("1 finished blocks") || every == "0", "{text}");
        assert!(checkpoint.exists(), "{text}");
    }
    assert!(of(&embree).resume().unwrap(), "whole");
}

#[test]
fn a_full_disk_leaves_a_set_of_several_volumes_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let scene = "[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 9\nisovalues = [10, 90]\n\
        [[volume]]\nname = \"b\"\ngenerator = \"bumps\"\nsize = 31\norigin = [0.05, 0.1, 0.02]\nscale = 0.3\n\
        isovalues = [10, 90]\n";
    fs::write(dir.join("two.toml"), scene).unwrap();
    let names = ["two-a.vti", "two-b.vti", "two.vtm"];
    names.iter().for_each(|name| fs::write(dir.join(name), "precious").unwrap());
    // Room for the first, not for the second.
    let script = "ulimit -f 600; exec \"$0\" \"$@\"";
    let mut command = Command::new("sh");
    command.current_dir(dir).args(["-c", script, PROGRAM, "bake", "two.toml", "-o", "two.vtm", "-q"]);
    command.args(["--photons", "2000", "--gather", "2", "--wall-resolution", "4"]);
    let (output, text) = finish(command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("two-b.vti"), "the second failed: {text}");
    for name in names {
        assert!(fs::read(dir.join(name)).unwrap() == b"precious", "{name} is of another bake than the others");
    }
    assert_eq!(fs::read_dir(dir).unwrap().count(), 4, "a temporary file was left");
}

#[test]
fn output_that_cannot_be_written_is_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    volume(dir, "101");
    // Not writable for anybody, nor an existing folder.
    for output in ["/sys/out.vti", "nowhere/out.vti"] {
        let begun = std::time::Instant::now();
        let (done, text) = finish(bake(dir, output, &[]));
        assert_eq!(done.status.code(), Some(2), "{text}");
        assert!(text.lines().count() == 1 && text.contains(output), "{text}");
        assert!(begun.elapsed() < Duration::from_secs(2), "before the work, not behind it");
    }
}

/// Lines that nobody reads, on a full disk or a pipe that was closed, cost no work; output that is wanted is another
/// matter.
#[test]
fn standard_error_that_takes_nothing_ends_no_bake() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    volume(dir, "13");
    let full = || Stdio::from(fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    let command = |output: &str| {
        let mut command = Command::new(PROGRAM);
        command.current_dir(dir).args(BAKE).args(["-o", output]).stdout(Stdio::null());
        command
    };
    assert_eq!(command("full.vti").stderr(full()).status().unwrap().code(), Some(0));
    let mut child = command("closed.vti").stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stderr.take());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert_eq!(light(&dir.join("full.vti")), light(&dir.join("closed.vti")));
    // Bad input is told by the code at least.
    assert_eq!(command("full.vti").arg("--photons=x").stderr(full()).status().unwrap().code(), Some(2));
    let mut info = Command::new(PROGRAM);
    let output = info.current_dir(dir).args(["info", "b.vti"]).stdout(full()).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && message.contains("standard output: No space"), "{message}");
}
