//! What the command line says about itself: help with examples that parse, completions, manual pages, `init`, JSON, and
//! what it makes of misspellings.

#[path = "shared/folder.rs"]
mod folder;
#[path = "shared/program.rs"]
mod program;

use clap::{CommandFactory, Parser};
use folder::Folder;
use isolume::bake::BakeSettings;
use isolume::cli::Cli;
use isolume::illumination_grid::GridSize;
use isolume::scene::Surface;
use isolume::scene_file::{SceneFile, SceneOptions, load};
use program::{isolume, ok};
use std::fs;
use std::path::Path;
use std::process::Command;

fn printed(dir: &Path, args: &[&str]) -> String {
    String::from_utf8(ok(dir, args).stdout).unwrap()
}

/// An example as a shell would split it; what two blanks set apart is a comment.
fn shell_words(line: &str) -> Vec<String> {
    let (mut words, mut quoted) = (vec![String::new()], false);
    for c in line.split("   ").next().unwrap().chars() {
        match c {
            '"' => quoted = !quoted,
            ' ' if !quoted => words.push(String::new()),
            '>' if !quoted => break,
            c => words.last_mut().unwrap().push(c),
        }
    }
    words.retain(|w| !w.is_empty());
    words
}

fn check_examples(command: &clap::Command, checked: &mut usize) {
    let name = command.get_name();
    let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    let own_verbs = command.get_subcommands().next().is_some() && name != "isolume" && name != "study";
    assert!(own_verbs || help.contains("Examples:"), "`{name} --help` has no examples");
    for line in help.lines().filter_map(|l| l.strip_prefix("  isolume ")) {
        let words = shell_words(line);
        if let Err(e) = Cli::try_parse_from(std::iter::once("isolume".to_owned()).chain(words)) {
            panic!("the example `isolume {line}` of {name} does not parse: {e}");
        }
        *checked += 1;
    }
    for verb in command.get_subcommands().filter(|v| v.get_name() != "help") {
        check_examples(verb, checked);
    }
}

#[test]
fn every_verb_teaches_by_examples_that_parse() {
    let mut checked = 0;
    check_examples(&Cli::command(), &mut checked);
    assert!(checked > 30, "{checked} examples");
    let dir = Folder::new();
    let help = printed(dir.path(), &["bake", "--help"]);
    assert!(help.contains("--isovalues") && !help.contains('\u{1b}'), "no colours into a pipe");
}

#[test]
fn completions_and_manual_pages() {
    let dir = Folder::new();
    let dir = dir.path();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let script = printed(dir, &["completions", shell]);
        for word in ["bake", "wall-resolution", "completions"] {
            assert!(script.contains(word), "{shell}: {word}");
        }
    }
    let script = printed(dir, &["completions", "bash"]);
    fs::write(dir.join("c.sh"), script).unwrap();
    let tried = Command::new("bash")
        .current_dir(dir)
        .args([
            "-c",
            "source ./c.sh; COMP_WORDS=(isolume ba); COMP_CWORD=1; _isolume isolume ba isolume; echo ${COMPREPLY[@]}",
        ])
        .output()
        .unwrap();
    assert_eq!(String::from_utf8_lossy(&tried.stdout).trim(), "bake", "{}", String::from_utf8_lossy(&tried.stderr));
    ok(dir, &["man", "-o", "pages/man1", "-q"]);
    for verb in Cli::command().get_subcommands() {
        let path = dir.join(format!("pages/man1/isolume-{}.1", verb.get_name()));
        let page = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(page.contains(".SH SYNOPSIS") && page.contains(&format!("isolume {}", verb.get_name())), "{page}");
    }
    let page = fs::read_to_string(dir.join("pages/man1/isolume-bake.1")).unwrap();
    let examples = page.split_once(".SH EXAMPLES\n.nf\n").unwrap().1.split_once("\n.fi\n").unwrap().0;
    assert!(
        examples.lines().count() > 5 && examples.lines().all(|line| line.starts_with("  isolume bake ")),
        "{examples}"
    );
    assert!(page.contains(".SH NOTES\n") && !page.contains(".SH EXTRA"));
    assert!(dir.join("pages/man1/isolume-study-curve.1").exists());
}

#[test]
fn init_writes_a_scene_whose_comments_are_the_defaults() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "21", "-o", "my bumps.v1.nrrd", "-q"]);
    ok(dir, &["init", "my bumps.v1.nrrd", "-q"]);
    let path = dir.join("my bumps.toml");
    let loaded = load(&path, &SceneOptions::default()).unwrap();
    let info: serde_json::Value = serde_json::from_str(&printed(dir, &["info", "my bumps.v1.nrrd", "--json"])).unwrap();
    let sweep = loaded.scene.field.sweep();
    assert_eq!(info["sweep"], serde_json::json!([sweep.lo(), sweep.hi()]));

    // Every key that is commented out, taken in: the same settings as without.
    let text = fs::read_to_string(&path).unwrap();
    let mut keys = 0;
    let open = |l: &str| {
        let key = l
            .strip_prefix("# ")
            .filter(|l| l.split(" = ").next().is_some_and(|k| !k.contains(' ')) && l.contains(" = "));
        keys += usize::from(key.is_some());
        key.unwrap_or(l).to_owned()
    };
    let opened: Vec<String> = text.lines().map(open).collect();
    assert!(keys >= 14, "{keys} keys");
    fs::write(dir.join("all.toml"), opened.join("\n")).unwrap();
    let all = load(&dir.join("all.toml"), &SceneOptions::default()).unwrap();
    let settings = |options| BakeSettings::new(options, &all.scene).unwrap();
    assert_eq!(settings(&all.bake), settings(&SceneFile::default().bake));
    assert_eq!((&all.scene.surface, all.scene.boundary), (&Surface::default(), loaded.scene.boundary));
    assert_eq!(all.scene.polygons(), loaded.scene.polygons());

    let again = isolume(dir, &["init", "my bumps.v1.nrrd"]);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("exists already"));
    assert_eq!(fs::read_to_string(&path).unwrap(), text, "left alone");

    // Paths in a scene file are relative to it.
    fs::create_dir(dir.join("sub")).unwrap();
    ok(dir, &["init", "my bumps.v1.nrrd", "-o", "sub/s.toml", "-q"]);
    assert!(load(&dir.join("sub/s.toml"), &SceneOptions::default()).is_ok());
    let bytes: Vec<u8> = (0..60u32).flat_map(|i| (i as u16 * 7).to_be_bytes()).collect();
    fs::write(dir.join("scan.raw"), bytes).unwrap();
    let raw = ["--raw-dims", "5,4,3", "--raw-type", "u16", "--raw-endian", "big", "--raw-spacing", "1,1,2.5"];
    ok(dir, &[&["init", "scan.raw", "-o", "scan.toml", "-q"], &raw[..]].concat());
    let scan = load(&dir.join("scan.toml"), &SceneOptions::default()).unwrap();
    assert_eq!((scan.volume.value(59), scan.volume.lattice.spacing().z), (413.0, 2.5));
    // Its voxels are long.
    assert_eq!((loaded.bake.grid, scan.bake.grid), (None, Some(GridSize::Cubic)));
}

#[test]
fn results_as_json() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "15", "-o", "b.vti", "-q"]);
    let bake = ["bake", "b.vti", "--isovalues", "3.6", "95", "-o", "out.vti", "--photons", "4000", "--gather", "4"];
    let parse = |text: String| -> serde_json::Value { serde_json::from_str(&text).unwrap() };
    let dry = parse(printed(dir, &[&bake[..], &["--dry-run", "--json", "--report", "r.json"]].concat()));
    assert_eq!((&dry["settings"]["engine"], &dry["settings"]["photons"]), (&"photon".into(), &4000.into()), "{dry}");
    let stages = |key: &str| dry[key].as_object().unwrap().values().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>();
    let close = |a: f64, b: &serde_json::Value| (a / b.as_f64().unwrap() - 1.0).abs() < 1e-9;
    assert!(close(stages("seconds").iter().sum(), &dry["total_seconds"]), "{dry}");
    assert!(close(stages("bytes").iter().copied().fold(0.0, f64::max), &dry["peak_bytes"]), "{dry}");
    assert!(!dir.join("r.json").exists() && !dir.join("out.vti").exists());
    let report = parse(printed(dir, &[&bake[..], &["--samples", "2000", "--json", "--report", "r.json"]].concat()));
    assert_eq!(report["photons"]["emitted"], 4000);
    assert_eq!(report["settings"], parse(fs::read_to_string(dir.join("r.json")).unwrap())["settings"]);
    let mesh = parse(printed(dir, &["extract", "out.vti", "--isovalue", "47", "-o", "m.ply", "--json"]));
    assert!(mesh["vertices"].as_u64().unwrap() > 50 && mesh["lit"] == true, "{mesh}");
    let reference =
        ["reference", "out.vti", "--isovalue", "47", "-o", "ref.ply", "--vertices", "50", "--samples", "16"];
    let reference = parse(printed(dir, &[&reference[..], &["--json"]].concat()));
    assert_eq!((&reference["sampled"], &reference["vertices"]), (&serde_json::json!(50), &mesh["vertices"]));
    assert!(parse(printed(dir, &["compare", "out.vti", "ref.ply", "--json"]))["percent_rms"].is_number());
}

#[test]
fn misspellings_are_told_what_was_meant() {
    let dir = Folder::new();
    let dir = dir.path();
    fs::write(dir.join("s.toml"), "[volume]\ngenerator = \"bumps\"\n[bake]\nphotns = 5\n").unwrap();
    fs::write(dir.join("f.toml"), "[field]\ngenerator = \"bumps2\"\n[box]\nluminair = 1\n").unwrap();
    for (args, said) in [
        (&["bkae", "x.vti"][..], "'bake'"),
        (&["bake", "x.vti", "-o", "y.vti", "--isovalue", "1", "2"], "'--isovalues'"),
        (&["bake", "s.toml", "-o", "y.vti", "--isovalues", "1", "2", "--isovalues", "3", "4"], "'--isovalues"),
        (&["bake", "s.toml", "-o", "y.vti"], "s.toml:4: unknown key `photns` in [bake]; did you mean `photons`?"),
        (&["flatland", "f.toml", "-o", "d"], "f.toml:4: unknown key `luminair` in [box]; did you mean `luminaire`?"),
    ] {
        let output = isolume(dir, args);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(text.contains(said), "{args:?}: {text}");
    }
}
