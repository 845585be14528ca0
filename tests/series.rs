//! Series in time: frames are their own single bakes, moments between them the bakes of blended volumes.

#[path = "shared/folder.rs"]
mod folder;
#[path = "shared/program.rs"]
mod program;

use folder::Folder;
use isolume::volume::Samples;
use isolume::volume::vti::VtiFile;
use program::isolume;
use std::fs;
use std::path::Path;
use std::process::Output;

/// A ball of radius √0.06 whose centre moves along x with time, n³ samples on [0, 1]³; the value rises inwards.
fn ball(time: f64, n: usize) -> Vec<f32> {
    let mut samples = Vec::new();
    for o in 0..n * n * n {
        let at = |i: usize| i as f64 / (n - 1) as f64 - 0.5;
        let (x, y, z) = (at(o % n) + 0.15 - 0.15 * time, at(o / n % n), at(o / (n * n)));
        samples.push((1.0 - x * x - y * y - z * z) as f32);
    }
    samples
}

fn write(path: &Path, samples: &[f32], kind: &str, n: usize) {
    let header = format!(
        "NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {n} {n} {n}\nspacings: {s} {s} {s}\nencoding: raw\nendian: little\n\n",
        s = 1.0 / (n - 1) as f64
    );
    let mut bytes = header.into_bytes();
    for s in samples {
        if kind == "double" { bytes.extend(f64::from(*s).to_le_bytes()) } else { bytes.extend(s.to_le_bytes()) }
    }
    fs::write(path, bytes).unwrap();
}

/// Runs a quick bake.
fn bake(dir: &Path, args: &[&str]) -> Output {
    let few = ["--photons", "4000", "--gather", "8", "--wall-resolution", "8", "--shadow-rays", "16"];
    isolume(dir, &[args, &few].concat())
}

/// What is said by a quick bake that must succeed.
fn told(dir: &Path, args: &[&str]) -> String {
    let output = bake(dir, args);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?}: {text}");
    text
}

/// Every bit of a bake's light, walls included.
fn light(path: &Path) -> Vec<u32> {
    let file = VtiFile::read(path).unwrap();
    let walls = file.field_data.iter().filter(|a| a.name.starts_with("wall_"));
    let mut bits = Vec::new();
    for array in file.point_data.iter().chain(walls) {
        match &array.samples {
            Samples::F32(v) => bits.extend(v.iter().map(|x| x.to_bits())),
            Samples::U8(v) => bits.extend(v.iter().map(|&x| u32::from(x))),
            other => panic!("{}: {:?}", array.name, other.element_type()),
        }
    }
    assert!(bits.len() > 10_000);
    bits
}

#[test]
fn frames_are_single_bakes_and_blends_those_of_blended_volumes() {
    let dir = Folder::new();
    let dir = dir.path();
    let frames: Vec<Vec<f32>> = (0..3).map(|t| ball(f64::from(t), 13)).collect();
    for (n, frame) in frames.iter().enumerate() {
        write(&dir.join(format!("ball_{:03}.nrrd", 5 * n)), frame, "float", 13);
    }
    let range = ["--isovalues", "0.9", "0.97"];
    let with = |args: &[&'static str]| [args, &range].concat();
    let output = bake(dir, &with(&["bake", "ball_%03d.nrrd", "-o", "lit.vti", "--tau", "0.1", "--json"]));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("frame  3 of 3, time 10") && text.contains("lit.pvd"), "{text}");
    // One document, a report each.
    let reports: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert!(reports.len() == 3 && reports.iter().all(|r| r["photons"]["emitted"] == 4000), "{reports:?}");
    // As ParaView opens it: a collection whose files, beside it, are image data.
    let text = fs::read_to_string(dir.join("lit.pvd")).unwrap();
    let collection = roxmltree::Document::parse(&text).unwrap();
    let root = collection.root_element();
    assert_eq!((root.tag_name().name(), root.attribute("type")), ("VTKFile", Some("Collection")));
    let sets: Vec<_> = collection.descendants().filter(|n| n.has_tag_name("DataSet")).collect();
    assert!(sets.iter().all(|n| n.parent().unwrap().has_tag_name("Collection")));
    let times: Vec<f64> = sets.iter().map(|n| n.attribute("timestep").unwrap().parse().unwrap()).collect();
    assert_eq!(times, [0.0, 5.0, 10.0]);
    for (n, set) in sets.iter().enumerate() {
        assert_eq!(set.attribute("file").unwrap(), format!("lit_{n:04}.vti"));
        let image = fs::read(dir.join(set.attribute("file").unwrap())).unwrap();
        assert!(String::from_utf8_lossy(&image[..200]).contains("type=\"ImageData\""));
        assert_eq!(light(&dir.join(set.attribute("file").unwrap())).len(), light(&dir.join("lit_0000.vti")).len());
    }
    told(dir, &with(&["bake", "ball_005.nrrd", "-o", "single.vti"]));
    assert!(light(&dir.join("lit_0001.vti")) == light(&dir.join("single.vti")));
    assert!(light(&dir.join("lit_0001.vti")) != light(&dir.join("lit_0002.vti")), "the ball moves");

    // 0.2 of the way from the second to the third, in f64 as the blend is.
    told(dir, &with(&["bake", "ball_%03d.nrrd", "--time", "6.0", "-o", "between.vti"]));
    let samples: Vec<f64> =
        frames[1].iter().zip(&frames[2]).map(|(a, b)| (1.0 - 0.2) * f64::from(*a) + 0.2 * f64::from(*b)).collect();
    let mut bytes = fs::read(dir.join("ball_000.nrrd")).unwrap();
    bytes.truncate(bytes.len() - 4 * samples.len());
    let mut bytes = String::from_utf8(bytes).unwrap().replace("float", "double").into_bytes();
    samples.iter().for_each(|s| bytes.extend(s.to_le_bytes()));
    fs::write(dir.join("blend.nrrd"), bytes).unwrap();
    told(dir, &with(&["bake", "blend.nrrd", "-o", "blended.vti"]));
    assert!(light(&dir.join("between.vti")) == light(&dir.join("blended.vti")));

    // What is there stays with --resume, if it is of the same job.
    let written = |n: usize| fs::metadata(dir.join(format!("lit_{n:04}.vti"))).unwrap().modified().unwrap();
    let before: Vec<_> = (0..3).map(written).collect();
    let first = light(&dir.join("lit_0001.vti"));
    fs::remove_file(dir.join("lit_0001.vti")).unwrap();
    let text = told(dir, &with(&["bake", "ball_%03d.nrrd", "-o", "lit.vti", "--resume", "--report", "r.json"]));
    assert!(text.contains("lit_0000.vti is complete") && !text.contains("lit_0001.vti is complete"), "{text}");
    assert_eq!((written(0), written(2)), (before[0], before[2]));
    // Reports tell of all frames.
    let report = |n: usize| -> serde_json::Value {
        serde_json::from_slice(&fs::read(dir.join(format!("r_{n:04}.json"))).unwrap()).unwrap()
    };
    assert!((0..3).all(|n| report(n)["photons"]["emitted"] == 4000 && report(n)["job"].is_string()));
    assert_ne!(report(0)["job"], report(1)["job"]);
    assert!(light(&dir.join("lit_0001.vti")) == first);
    // Nor is a series of other settings replaced, unless this one was begun.
    let other = with(&["bake", "ball_%03d.nrrd", "-o", "lit.vti", "--resume", "--seed", "2"]);
    let before: Vec<_> = (0..3).map(written).collect();
    let output = bake(dir, &other);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && text.contains("lit_0000.vti: is a bake of other settings"), "{text}");
    assert!((0..3).map(written).eq(before.iter().copied()), "{text}");
    fs::remove_file(dir.join("lit_0000.vti")).unwrap();
    let text = told(dir, &other);
    assert!(!text.contains("is complete") && light(&dir.join("lit_0001.vti")) != first, "{text}");
    told(dir, &with(&["bake", "ball_%03d.nrrd", "-o", "lit.vti"]));
    assert!(written(0) > before[0], "without --resume all is done again");
}

#[test]
fn scenes_name_series_and_share_a_sweep() {
    let dir = Folder::new();
    let dir = dir.path();
    // The second frame is four times as large: its own suggested sweep would be another.
    let scaled: Vec<f32> = ball(1.0, 11).iter().map(|v| 4.0 * v).collect();
    write(&dir.join("a.nrrd"), &ball(0.0, 11), "float", 11);
    write(&dir.join("b.nrrd"), &scaled, "float", 11);
    let scene = "[volume]\nfiles = [\"a.nrrd\", \"b.nrrd\"]\ntimes = [0.5, 2.0]\n[bake]\npreset = \"preview\"\n";
    fs::write(dir.join("s.toml"), scene).unwrap();
    told(dir, &["bake", "s.toml", "-o", "lit.vti", "--report", "r.json"]);
    let sweep = |name: &str| {
        let file = VtiFile::read(&dir.join(name)).unwrap();
        match &file.field_data.iter().find(|a| a.name == "isovalues").unwrap().samples {
            Samples::F64(v) => v.clone(),
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(sweep("lit_0000.vti"), sweep("lit_0001.vti"));
    assert!(dir.join("r_0001.json").exists() && fs::read_to_string(dir.join("lit.pvd")).unwrap().contains("\"0.5\""));

    let refused = |args: &[&str], words: &[&str]| {
        let output = bake(dir, args);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!((output.status.code(), text.lines().count()), (Some(2), 1), "{text}");
        words.iter().for_each(|w| assert!(text.contains(w), "{w}: {text}"));
    };
    refused(&["bake", "s.toml", "--time", "3", "-o", "x.vti"], &["time 3", "from 0.5 to 2"]);
    refused(&["bake", "s.toml", "-o", "x\n.vti"], &["which names the frames"]);
    refused(&["bake", "s.toml", "-o", "x.vtm"], &["x.vtm", "ends in .vti"]);
    refused(&["bake", "a.nrrd", "--time", "3", "-o", "x.vti"], &["single volume"]);
    refused(&["bake", "c_%d.nrrd", "-o", "x.vti"], &["c_%d.nrrd", "two or more"]);
    // Before the first frame.
    for folder in ["y_0001.vti", "z.pvd", "r_0001.json"] {
        fs::remove_file(dir.join(folder)).unwrap_or_default();
        fs::create_dir(dir.join(folder)).unwrap();
        let output = if folder.starts_with('z') { "z.vti" } else { "y.vti" };
        refused(&["bake", "s.toml", "-o", output, "--report", "r.json"], &[folder, "is a folder"]);
        fs::remove_dir(dir.join(folder)).unwrap();
    }
    write(&dir.join("b.nrrd"), &ball(1.0, 9), "float", 9);
    refused(&["bake", "s.toml", "-o", "x.vti"], &["b.nrrd", "9×9×9", "11×11×11", "share"]);
    fs::write(dir.join("s.toml"), scene.replace(", 2.0", "")).unwrap();
    refused(&["bake", "s.toml", "-o", "x.vti"], &["s.toml", "times: 1 for 2 files"]);
}
