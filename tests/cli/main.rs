//! The program as users meet it: verbs, files, exit codes, and one clear line for every kind of bad input.

#[path = "../shared/folder.rs"]
mod folder;
#[path = "../shared/program.rs"]
mod program;

use folder::Folder;
use isolume::volume::vti::VtiFile;
use isolume::volume::{Samples, Volume};
use program::{isolume, ok};
use std::fs;
use std::path::Path;

mod bad_input;
mod compare;
mod engines;
mod final_gather;
mod flatland;
mod outputs;
mod pictures;
mod reproducibility;
mod split;
mod volumes;

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs what must fail as bad input: exit code 2, one line that holds `words`, and no `out.vti` of any size.
fn refused(dir: &Path, args: &[&str], words: &[&str]) {
    let output = isolume(dir, args);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert_eq!(message.lines().count(), 1, "{args:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{args:?}: '{word}' is missing in: {message}");
    }
    let left: Vec<String> = fs::read_dir(dir)
        .unwrap()
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .filter(|n| n.contains("out.vti"))
        .collect();
    assert!(left.is_empty(), "{args:?} left {left:?}");
}

const QUICK: [&str; 8] = ["--photons", "4000", "--samples", "2000", "--gather", "8", "--wall-resolution", "8"];

#[test]
fn generate_info_bake_render() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "21", "-o", "b.nrrd", "--quiet"]);
    let info = text(&ok(dir, &["info", "b.nrrd"]).stdout);
    assert!(info.contains("21") && info.to_lowercase().contains("sweep"), "{info}");
    let json: serde_json::Value = serde_json::from_slice(&ok(dir, &["info", "b.nrrd", "--json"]).stdout).unwrap();
    assert_eq!(json["dims"], serde_json::json!([21, 21, 21]));

    let mut bake =
        vec!["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "--report", "r.json", "--sides", "both"];
    bake.extend(QUICK);
    let lines = text(&ok(dir, &bake).stderr);
    assert!(lines.contains("photons") && lines.contains("total"), "plain lines without a terminal: {lines}");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap();
    for key in ["load", "build", "photons", "samples", "interpolate", "export", "total"] {
        assert!(report["seconds"][key].is_number(), "seconds.{key}");
    }
    assert_eq!(json.get("bake"), None, "of a volume");
    let info: serde_json::Value = serde_json::from_slice(&ok(dir, &["info", "out.vti", "--json"]).stdout).unwrap();
    assert_eq!(info["dims"], json["dims"]);
    let [own, written] =
        [&info["bake"]["report"], &report].map(|r| ["settings", "job", "rays"].map(|key| r[key].clone()));
    assert_eq!(own, written);
    let expected = serde_json::json!([[3.6, 95.0], "lower", true, false, 6]);
    let found = ["isovalues", "outside", "both_sides", "capped", "polygons"].map(|key| info["bake"][key].clone());
    assert_eq!(serde_json::json!(found), expected);
    let info = text(&ok(dir, &["info", "out.vti"]).stdout);
    assert!(info.contains("isovalues 3.6 … 95 on both sides, open, 6 polygons\n"), "{info}");
    assert!(info.contains("engine photon, grid 1x, seed 1: "), "{info}");
    assert!(!text(&ok(dir, &["info", "b.nrrd"]).stdout).contains("polygons"), "of a volume");
    for key in ["load", "samples", "total"] {
        let worked = report["processor_seconds"][key].as_f64().unwrap();
        assert!(worked > 0.0 || key != "total" && worked == 0.0, "the clock ticks every 10 ms: {key} {worked}");
    }
    for key in ["rays", "rays_per_second", "samples", "masked", "misses", "threads", "seed"] {
        assert!(report[key].is_number(), "{key}");
    }
    assert_eq!(report["photons"]["emitted"], 4000);
    assert!(report["photons"]["stored"].as_u64().unwrap() > 4000, "photons land more than once");
    assert!(report["embree"].as_str().unwrap().starts_with("4."));
    assert_eq!(report["isa"], isolume::isa::Isa::current().name());
    assert!(report["commit"].is_string() && report["settings"]["gather_rays"] == 8);

    let file = VtiFile::read(&dir.join("out.vti")).unwrap();
    let names: Vec<(&str, usize)> = file.point_data.iter().map(|a| (a.name.as_str(), a.components)).collect();
    let side = [("radiance", 3), ("rgb", 3), ("std_error", 1), ("mask", 1)];
    assert_eq!(names[0], ("value", 1));
    assert_eq!(names[1..5], side);
    assert_eq!(names[5].0, "radiance_inside");
    assert_eq!(file.active_scalars.as_deref(), Some("value"));
    let field: Vec<&str> = file.field_data.iter().map(|a| a.name.as_str()).collect();
    for name in [
        "wall_x_min",
        "wall_x_max",
        "wall_y_max",
        "wall_z_min",
        "wall_z_max",
        "exposure",
        "isovalues",
        "settings.photons",
    ] {
        assert!(field.contains(&name), "field data {name} in {field:?}");
    }
    let Samples::F32(rgb) = &file.point_data[2].samples else { panic!("rgb is f32") };
    assert!(rgb.iter().all(|x| (0.0..=1.0).contains(x)));

    // A bake without a volume of its own reads back as one.
    assert_eq!(Volume::open(dir.join("out.vti")).unwrap().lattice.dims(), [21, 21, 21]);
    for (name, extra) in [("a.png", None), ("a.exr", None), ("l.png", Some("--local"))] {
        let mut args = vec!["render", "out.vti", "--isovalue", "47", "-o", name, "--height", "40", "--samples", "4"];
        args.extend(extra);
        ok(dir, &args);
        assert!(fs::metadata(dir.join(name)).unwrap().len() > 500, "{name}");
    }
    assert_ne!(fs::read(dir.join("a.png")).unwrap(), fs::read(dir.join("l.png")).unwrap());
    // What leaves the bake: its arrays, and surfaces with their light.
    for name in ["a.nrrd", "a.npy", "slices.exr", "copy.vti"] {
        ok(dir, &["export", "out.vti", "--array", "rgb", "-o", name, "-q"]);
    }
    let values = ok(dir, &["export", "out.vti", "--array", "value", "-o", "v.npy"]).stderr;
    assert!(text(&values).contains("21×21×21 × 1 f32"), "{}", text(&values));
    assert_eq!(Volume::open(dir.join("v.npy")).unwrap().samples(), &file.point_data[0].samples);
    for name in ["m.ply", "m.obj", "m.glb", "m.vtp"] {
        ok(dir, &["extract", "out.vti", "--isovalue", "47", "-o", name, "-q"]);
        assert!(fs::metadata(dir.join(name)).unwrap().len() > 5000, "{name}");
    }
    let output = isolume(dir, &["export", "b.nrrd", "--array", "rgb", "-o", "x.npy"]);
    assert_eq!(output.status.code(), Some(2), "a volume has no rgb");
    let output = isolume(dir, &["export", "out.vti", "--array", "rbg", "-o", "x.npy"]);
    assert!(text(&output.stderr).contains("`rbg`") && text(&output.stderr).contains("`rgb`"));
    for file in ["b.nrrd", "r.json"] {
        let output = isolume(dir, &["render", file, "--isovalue", "47", "-o", "x.png"]);
        assert_eq!(output.status.code(), Some(2), "{file} is no bake");
        assert!(text(&output.stderr).contains(file));
    }
    let output = isolume(dir, &["render", "out.vti", "--isovalue", "99", "-o", "x.png"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("outside the sweep"));
}
