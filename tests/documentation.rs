//! The documents stay true: keys, defaults, names in the code, links, commands of the tutorial.

use isolume::bake::{BakeOptions, BakeSettings, Preset};
use isolume::scene_file::{SceneFile, SceneOptions, load};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn document(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// What `isolume help bake` says about a flag, on one line.
fn help(flag: &str) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_isolume")).args(["help", "bake"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    // Its value follows, which of some may be left out.
    let from = [" ", "[="].iter().find_map(|end| text.find(&format!("      --{flag}{end}")));
    let from = from.unwrap_or_else(|| panic!("no --{flag} in: {text}"));
    let about = text[from..].lines().skip(1).take_while(|l| !l.trim_start().starts_with('-'));
    about.flat_map(str::split_whitespace).collect::<Vec<_>>().join(" ")
}

/// The texts between backticks.
fn quoted(text: &str) -> Vec<&str> {
    text.split('`').skip(1).step_by(2).collect()
}

/// The table below a heading: rows of trimmed cells, without the head.
fn table<'a>(text: &'a str, heading: &str) -> Vec<Vec<&'a str>> {
    let (_, section) = text.split_once(&format!("\n## {heading}\n")).unwrap_or_else(|| panic!("no heading {heading}"));
    let section = section.split("\n## ").next().unwrap().split("\n# ").next().unwrap();
    let rows = section.lines().filter(|l| l.starts_with("| ")).skip(1);
    rows.map(|l| l.trim_matches('|').split(" | ").map(str::trim).collect()).collect()
}

/// The keys that serde knows in a table: what the error about a key that no table has lists.
fn known_keys(header: &str, flatland: bool) -> BTreeSet<String> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.toml");
    let needed = if flatland { "[field]\n" } else { "[volume]\n" };
    let text = match header {
        "" => format!("zzz = 1\n{needed}"),
        "[volume]" => "[[volume]]\nname = \"a\"\nzzz = 1\n".to_owned(),
        h if needed.contains(&format!("[{h}]")) => format!("[{h}]\nzzz = 1\n"),
        "context" => format!("{needed}[[context]]\nfile = \"a.obj\"\nzzz = 1\n"),
        h => format!("{needed}[{h}]\nzzz = 1\n"),
    };
    fs::write(&path, text).unwrap();
    let error = if flatland {
        isolume::flatland::load(&path).err().unwrap().to_string()
    } else {
        SceneFile::read(&path).err().unwrap().to_string()
    };
    let (_, keys) = error.split_once("known: ").unwrap_or_else(|| panic!("{error}"));
    keys.split(", ").map(str::to_owned).collect()
}

#[test]
fn every_key_of_a_scene_is_described_and_no_other() {
    let text = document("docs/scene.md");
    let mut count = 0;
    for (header, heading, flatland) in [
        ("", "Top level", false),
        ("volume", "[volume]", false),
        ("[volume]", "[[volume]]", false),
        ("volume.raw", "[volume.raw]", false),
        ("surface", "[surface]", false),
        ("box", "[box]", false),
        ("context", "[[context]]", false),
        ("bake", "[bake]", false),
        ("", "Flatland: top level", true),
        ("field", "Flatland: [field]", true),
        ("surface", "Flatland: [surface]", true),
        ("box", "Flatland: [box]", true),
    ] {
        let rows = table(&text, heading);
        assert!(rows.iter().all(|r| r.len() == 4), "{heading}: key, type, default, meaning");
        let described: BTreeSet<String> = rows.iter().flat_map(|r| quoted(r[0])).map(str::to_owned).collect();
        assert_eq!(described, known_keys(header, flatland), "docs/scene.md, {heading}");
        count += described.len();
    }
    assert!(count > 40, "{count} keys");
    let example = text.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("s.toml"), example).unwrap();
    assert!(SceneFile::read(&dir.path().join("s.toml")).is_ok());
}

#[test]
fn the_defaults_of_bakes_are_the_described_ones() {
    let text = document("docs/scene.md");
    let number = |cell: &str| -> Option<f64> {
        if let Some(power) =
            cell.strip_prefix('2').filter(|p| !p.is_empty() && p.chars().all(|c| "⁰¹²³⁴⁵⁶⁷⁸⁹".contains(c)))
        {
            let digits = power.chars().map(|c| "⁰¹²³⁴⁵⁶⁷⁸⁹".chars().position(|d| d == c).unwrap());
            return Some(f64::from(digits.fold(0, |n, d| 10 * n + d) as u32).exp2());
        }
        cell.parse().ok()
    };
    let scene = load(&root().join("scenes/cornell-bumps.toml"), &SceneOptions::default()).unwrap().scene;
    let mut compared = 0;
    for (i, preset) in [Preset::Preview, Preset::Standard, Preset::Reference].into_iter().enumerate() {
        let options = BakeOptions { preset: Some(preset), ..BakeOptions::default() };
        let settings = serde_json::to_value(BakeSettings::new(&options, &scene).unwrap()).unwrap();
        for row in table(&text, "[bake]") {
            let key = quoted(row[0])[0].replace('-', "_");
            let key = if key == "gather" { "gather_rays" } else { &key };
            let cells: Vec<&str> = row[2].split(" / ").collect();
            // Options say the same.
            let (flag, about) = (quoted(row[0])[0], help(quoted(row[0])[0]));
            let values = cells.iter().map(|c| number(c).map(|n| n.to_string())).collect::<Option<Vec<_>>>();
            let said = match (values, quoted(row[2]).first()) {
                (Some(each), _) if each.len() > 1 => format!("by preset {}", each.join(" / ")),
                (Some(one), _) => format!("default: {}", one[0]),
                (None, Some(name)) => name.trim_matches('"').to_owned(),
                (None, None) => "default".to_owned(),
            };
            assert!(about.contains("by preset") || about.contains("default"), "--{flag}: {about}");
            assert!(about.contains(&said), "--{flag}: no '{said}' in: {about}");
            let cell = cells[i.min(cells.len() - 1)];
            if let Some(described) = number(cell) {
                assert_eq!(settings[key].as_f64(), Some(described), "{key}, {preset:?}");
                compared += 1;
            } else if let Some(name) = quoted(cell).first().filter(|_| key != "preset" && key != "samples") {
                assert_eq!(settings[key], name.trim_matches('"'), "{key}, {preset:?}");
                compared += 1;
            }
        }
    }
    assert!(compared >= 39, "{compared} defaults compared");
}

#[test]
fn files_and_names_beside_equations_exist() {
    let text = document("docs/equations.md");
    let mut names = 0;
    for row in text.lines().filter(|l| l.starts_with("| ") && l.contains("`src/")) {
        let cells: Vec<&str> = row.trim_matches('|').split(" | ").collect();
        let (file, cited) = (quoted(cells[cells.len() - 2])[0], quoted(cells[cells.len() - 1]));
        let code = document(file);
        assert!(!cited.is_empty(), "{row}");
        for name in cited {
            let defined = ["fn ", "struct ", "enum ", "trait ", "const ", "static ", "type ", "mod "].iter().any(|k| {
                code.match_indices(&format!("{k}{name}")).any(|(at, m)| {
                    let next = code[at + m.len()..].chars().next().unwrap_or(' ');
                    !next.is_alphanumeric() && next != '_'
                })
            });
            // A field or a variant: in a line of its own among those of a struct or an enum.
            let mut item = false;
            let declared = code.lines().any(|line| {
                let own =
                    line.trim_start_matches("pub ").trim_start_matches("pub(crate) ").trim_start_matches("pub(super) ");
                item = own.starts_with("struct ") || own.starts_with("enum ") || item && line != "}";
                let rest = line.trim_start().trim_start_matches("pub ").strip_prefix(name);
                let ends = [": ", ",", " {", "("];
                item && line.starts_with("    ")
                    && rest.is_some_and(|rest| ends.iter().any(|end| rest.starts_with(end)))
            });
            let defined = defined || declared;
            assert!(defined, "{file} defines no {name}, which docs/equations.md names");
            names += 1;
        }
    }
    assert!(names > 45, "{names} names");
}

#[test]
fn links_lead_somewhere() {
    let mut links = 0;
    let documents = fs::read_dir(root().join("docs")).unwrap().map(|e| e.unwrap().path());
    let documents = documents.filter(|p| p.extension().is_some_and(|e| e == "md"));
    for path in documents.chain(["README.md", "CONTRIBUTING.md", "scenes/README.md"].map(|n| root().join(n))) {
        let text = fs::read_to_string(&path).unwrap();
        for target in text.split("](").skip(1).filter_map(|s| s.split([')', '#']).next()) {
            if !target.is_empty() && !target.contains(':') && !target.contains(' ') {
                let file = path.parent().unwrap().join(target);
                assert!(file.exists(), "{}: the link to {target} leads nowhere", path.display());
                links += 1;
            }
        }
    }
    assert!(links > 8, "{links} links");
    assert!(document("README.md").lines().count() <= 200, "the README has grown past 200 lines");
}

#[test]
fn every_command_of_the_tutorial_runs() {
    let dir = tempfile::tempdir().unwrap();
    let binary = Path::new(env!("CARGO_BIN_EXE_isolume")).parent().unwrap();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths(std::iter::once(binary.to_path_buf()).chain(std::env::split_paths(&path))).unwrap();
    let text = document("docs/tutorial.md");
    let mut ran = 0;
    for block in text.split("```sh\n").skip(1) {
        for command in block.split("```").next().unwrap().lines().filter(|l| !l.is_empty()) {
            let output =
                Command::new("sh").arg("-c").arg(command).current_dir(dir.path()).env("PATH", &path).output().unwrap();
            assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
            ran += 1;
        }
    }
    assert!(ran >= 10, "only {ran} commands found");
    for file in ["cylinders.toml", "cylinders.vti", "cylinders.png", "cylinders.html", "ref1.ply"] {
        assert!(dir.path().join(file).exists(), "the tutorial did not make {file}");
    }
}
