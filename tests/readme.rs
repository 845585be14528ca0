//! The README stays true: every shell command in it runs, in order, but `make test`; its scene is one.

use isolume::scene_file::SceneFile;
use std::collections::BTreeSet;
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

/// What the README says of scenes, verbs and flags beside its commands.
#[test]
fn what_the_readme_names_is_there() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = std::fs::read_to_string(root.join("README.md")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let scene = readme.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    std::fs::write(dir.path().join("s.toml"), scene).unwrap();
    SceneFile::read(&dir.path().join("s.toml")).unwrap();
    let help = |verb: &str| {
        let output = Command::new(env!("CARGO_BIN_EXE_isolume")).args([verb, "--help"]).output().unwrap();
        assert!(output.status.success(), "the README names the verb '{verb}'");
        String::from_utf8(output.stdout).unwrap()
    };
    let word = |text: &str| -> String {
        text.chars().take_while(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || *c == '-').collect()
    };
    let verbs: BTreeSet<String> = readme.split("`isolume ").skip(1).map(word).collect();
    let verbs: Vec<String> = verbs.into_iter().filter(|verb| !["", "help"].contains(&verb.as_str())).collect();
    let all: String = verbs.iter().map(|verb| help(verb)).collect();
    let flags: BTreeSet<String> = readme.split("`--").skip(1).map(word).collect();
    assert!(verbs.len() >= 5 && flags.len() >= 8, "{verbs:?}, {flags:?}");
    for flag in flags {
        let found = all.match_indices(&format!("--{flag}")).any(|(at, m)| word(&all[at + m.len()..]).is_empty());
        assert!(found, "the README names --{flag}, which no verb of {verbs:?} has");
    }
}
