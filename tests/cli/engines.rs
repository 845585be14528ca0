//! Which engine lights a scene, and what is said about it.

use super::pictures::pixels;
use super::{Folder, ok, refused, text};
use isolume::volume::vti::VtiFile;
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;

/// Sweeps, unless the scene, an option or the user asks for photons; options of both need a word.
#[test]
fn scene_and_options_choose_the_engine() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "13", "-o", "b.nrrd", "--quiet"]);
    fs::write(dir.join("needle.obj"), "v .4 .4 .4\nv .6 .4 .4\nv .4 .6 .4\nf 1 2 3\n").unwrap();
    let volume = "isovalues = [10, 90]\n[volume]\nfile = \"b.nrrd\"\n";
    fs::write(dir.join("plain.toml"), volume).unwrap();
    fs::write(dir.join("needle.toml"), format!("{volume}[[context]]\nfile = \"needle.obj\"\n")).unwrap();
    fs::write(dir.join("map.toml"), format!("{volume}[bake]\ngather = 0\n")).unwrap();
    for (scene, more, engine) in [
        ("plain.toml", &[][..], "sweep"),
        ("plain.toml", &["--preset", "reference", "--grid", "2x"], "sweep"),
        ("plain.toml", &["--directions", "64"], "sweep"),
        ("plain.toml", &["--photons", "1000"], "photon"),
        ("plain.toml", &["--strategy", "planes"], "photon"),
        ("plain.toml", &["--engine", "photon"], "photon"),
        ("plain.toml", &["--engine", "sweep", "--gather", "8"], "sweep"),
        ("map.toml", &[], "photon"),
        ("map.toml", &["--engine", "sweep"], "sweep"),
        ("needle.toml", &[], "photon"),
    ] {
        let dry = ok(dir, &[&["bake", scene, "-o", "out.vti", "--dry-run"], more].concat());
        let lines = text(&dry.stderr);
        assert!(lines.contains(&format!("engine  {engine}")), "{scene} {more:?}: {lines}");
    }
    let both = ["bake", "map.toml", "-o", "out.vti", "--directions", "64"];
    refused(dir, &both, &["gather", "directions", "photon engine", "sweep engine"]);
    refused(dir, &["bake", "needle.toml", "-o", "out.vti", "--engine", "sweep"], &["needle", "--engine photon"]);
    // A bake says what it was.
    ok(dir, &["bake", "plain.toml", "-o", "out.vti", "--preset", "preview", "--report", "r.json", "--quiet"]);
    let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap();
    assert_eq!(report["settings"]["engine"], "sweep");
    assert!(report["sweep_queries"].as_u64() > Some(50_000) && report["photons"]["emitted"] == 0, "{report}");
}

/// A cavity in a volume of zeros and ones: no grid point holds light of its own level set, and what sweeps know of it
/// is its emission. Its walls emit 1 and reflect half: 2 comes from everywhere.
#[test]
fn binary_volumes_are_baked_by_exact_rays() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([20; 3], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let outside = |o: usize| lattice.ijk(o).iter().map(|&i| (i as f64 - 9.5).powi(2)).sum::<f64>() > 36.0;
    let samples = Samples::U8((0..lattice.len()).map(|o| u8::from(outside(o))).collect());
    Volume::new("cavity", lattice.clone(), samples).unwrap().write(dir.join("cavity.vti")).unwrap();
    let bake =
        ["bake", "cavity.vti", "--isovalues", ".25", ".75", "--box", "none", "--emission", "1", "--albedo", ".5"];
    let more = ["--preset", "preview", "-o", "lit.vti"];
    let lines = text(&ok(dir, &[&bake[..], &more].concat()).stderr);
    assert!(lines.contains("engine  photon") && !lines.contains("warning"), "{lines}");
    let file = VtiFile::read(&dir.join("lit.vti")).unwrap();
    let of = |name: &str| &file.point_data.iter().find(|a| a.name == name).unwrap().samples;
    let (Samples::F32(light), Samples::U8(mask)) = (of("radiance"), of("mask")) else { panic!("other types") };
    let lit: Vec<f32> = light.chunks_exact(3).zip(mask).filter(|(_, m)| **m != 0).map(|(rgb, _)| rgb[0]).collect();
    let mean = lit.iter().sum::<f32>() / lit.len() as f32;
    assert!(lit.len() > 500 && (1.9..2.1).contains(&mean), "{mean} of {}", lit.len());
    // All samples are at places beside steep edges, which take a quarter of the gather rays.
    let [few, many] = ["64", "128"].map(|gather| {
        let json = ok(dir, &[&bake[..], &more, &["--gather", gather, "--json", "-q"]].concat()).stdout;
        let report: serde_json::Value = serde_json::from_slice(&json).unwrap();
        ["rays", "samples"].map(|name| report[name].as_u64().unwrap())
    });
    assert!(few[1] == many[1] && many[0] - few[0] == 16 * few[1], "{few:?} {many:?}");
    // Sweeps that are asked for say what they leave out; on a finer grid points lie within the sweep.
    let dry = |more: &[&str]| text(&ok(dir, &[&bake[..], &["-o", "lit.vti", "--dry-run"], more].concat()).stderr);
    let lines = dry(&["--engine", "sweep"]);
    assert!(lines.contains("warning: samples jump over the whole sweep at 100 %"), "{lines}");
    let lines = dry(&["--grid", "2x"]);
    assert!(lines.contains("engine  sweep") && !lines.contains("warning"), "{lines}");
}

/// Caps close the higher side off: what is stored of it alone is black, unless there is light within.
#[test]
fn an_outside_that_caps_close_off_is_warned_of() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "13", "-o", "b.vti", "-q"]);
    let bake = ["bake", "b.vti", "--isovalues", "3.6", "95", "--margin", "0.1", "-o", "lit.vti", "--dry-run"];
    for (more, warned) in [
        (&["--boundary", "capped", "--outside", "higher"][..], true),
        (&["--boundary", "capped", "--outside", "higher", "--sides", "both"], true),
        (&["--boundary", "capped", "--outside", "higher", "--emission", "1"], false),
        (&["--boundary", "capped"], false),
        (&["--outside", "higher"], false),
    ] {
        let lines = text(&ok(dir, &[&bake[..], more].concat()).stderr);
        assert_eq!(
            lines.contains("warning: boundary = \"capped\" closes the higher side"),
            warned,
            "{more:?}: {lines}"
        );
    }
}

/// Planes across the whole box, whose higher side holds the luminaire at most isovalues: its walls are lit though the
/// lower side alone is stored, which is said to be dark.
#[test]
fn rooms_within_solids_are_lit() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "linear:1,2,4", "--size", "17", "-o", "lin.vti", "-q"]);
    let bake = ["bake", "lin.vti", "--isovalues", "0.1", "6.9", "-o", "lit.vti", "--preset", "preview"];
    let dry = |more: &[&str]| text(&ok(dir, &[&bake[..], &["--dry-run"], more].concat()).stderr);
    for (more, engine, warned) in [
        (&[][..], "sweep", true),
        (&["--engine", "photon"], "photon", true),
        (&["--outside", "higher"], "sweep", false),
        (&["--sides", "both"], "sweep", false),
        (&["--margin", "0.1"], "sweep", false),
    ] {
        let lines = dry(more);
        let warning = lines.contains("warning: the luminaires stand mostly within the solids");
        assert!(lines.contains(&format!("engine  {engine}")) && warning == warned, "{more:?}: {lines}");
    }
    for engine in ["sweep", "photon"] {
        ok(dir, &[&bake[..], &["-q", "--engine", engine]].concat());
        ok(dir, &["render", "lit.vti", "--isovalue", "3.5", "--height", "60", "--samples", "4", "-o", "room.png"]);
        let (rgb, _) = pixels(&dir.join("room.png"));
        let bright = rgb.iter().flatten().filter(|x| **x > 60).count();
        assert!(4 * bright > rgb.len(), "{engine}: {bright} of {}", rgb.len());
    }
}

/// Two solids that end in the same face: whose cap is seen there nothing tells.
#[test]
fn caps_in_the_same_faces_are_warned_of() {
    let dir = Folder::new();
    let dir = dir.path();
    let volume = |name: &str, generator: &str, more: &str| {
        format!("[[volume]]\nname = \"{name}\"\ngenerator = \"{generator}\"\nisovalues = [0.05, 0.2]\n{more}\n")
    };
    let capped = "boundary = \"capped\"\n";
    for (one, other, warned) in [
        ("size = 9\n", "size = 9\n", true),
        ("size = 9\n", "size = 13\n", true),
        ("size = 9\n", "size = 9\norigin = [0.1, 0.1, 0.1]\nscale = 0.7\n", false),
    ] {
        for (both, expected) in [(capped, warned), ("", false)] {
            let volumes = [
                volume("a", "bumps", &[one, capped].concat()).replace("[0.05, 0.2]", "[10, 90]"),
                volume("b", "sphere", &[other, both].concat()),
            ];
            fs::write(dir.join("two.toml"), format!("{}[box]\nmargin = 0.1\n", volumes.concat())).unwrap();
            let lines = text(&ok(dir, &["bake", "two.toml", "-o", "two.vtm", "--dry-run"]).stderr);
            let found = lines.contains("'a' and 'b' end in the same faces");
            assert_eq!(found, expected, "{one} {other} {both}: {lines}");
        }
    }
}

/// A solid that caps close towards the camera: its reference is no triangles, and a bake shows the same.
#[test]
fn capped_solids_have_a_path_traced_picture() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([13; 3], glam::DVec3::ZERO, glam::DVec3::splat(1.0 / 12.0)).unwrap();
    let falling = (0..lattice.len()).map(|o| 1.0 - lattice.ijk(o)[1] as f32 / 12.0);
    Volume::new("b", lattice.clone(), Samples::F32(falling.collect())).unwrap().write(dir.join("b.vti")).unwrap();
    let scene = ["b.vti", "--isovalues", "0.1", "0.9", "--margin", "0.4", "--boundary"];
    let draw = |file: &[&str], more: &[&str]| {
        let fixed = ["--isovalue", "0.5", "--height", "40", "-o", "p.exr", "-q"];
        ok(dir, &[&["render"], file, &fixed, more].concat());
        let image = exr::prelude::read_all_flat_layers_from_file(dir.join("p.exr")).unwrap();
        // The middle fifth.
        let red = image.layer_data[0].channel_data.list.iter().find(|c| c.name.to_string() == "R").unwrap();
        let [w, h] = [image.layer_data[0].size.x(), image.layer_data[0].size.y()];
        let values: Vec<f32> = red.sample_data.values_as_f32().collect();
        let middle = |n: usize| n * 2 / 5..n * 3 / 5;
        let of = |y: usize| middle(w).map(move |x| (x, y));
        let pixels: Vec<f32> = middle(h).flat_map(of).map(|(x, y)| values[x + y * w]).collect();
        pixels.iter().sum::<f32>() / pixels.len() as f32
    };
    let capped = [&scene[..], &["capped"]].concat();
    refused(
        dir,
        &[&["render"], &capped[..], &["--isovalue", "0.5", "-o", "p.png", "--reference"]].concat(),
        &["--trilinear"],
    );
    let path_traced = |samples| ["--reference", "--trilinear", "--samples", samples];
    // One path in hundreds finds the cap lit.
    let truth = draw(&capped, &path_traced("4096"));
    let open = draw(&[&scene[..], &["open"]].concat(), &path_traced("64"));
    ok(dir, &[&["bake"], &capped[..], &["-o", "lit.vti", "--directions", "1024", "-q"]].concat());
    let baked = draw(&["lit.vti"], &["--samples", "4"]);
    println!("cap {truth}, baked {baked}, open {open}");
    assert!(truth > 0.0 && (baked / truth - 1.0).abs() < 0.05, "{truth}, {baked}");
    assert!((open / truth - 1.0).abs() > 0.2, "{open}: the solid's back is no cap");
}

/// A closed room whose surfaces absorb nothing, and its walls a half or a thousandth: where bounces end before light
/// has settled, a bake says so.
#[test]
fn light_that_has_not_settled_is_warned_of() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "13", "-o", "b.vti", "-q"]);
    let corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0 0 1\nv 1 0 1\nv 0 1 1\nv 1 1 1\n";
    let faces = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n";
    fs::write(dir.join("room.obj"), format!("mtllib room.mtl\n{corners}usemtl w\n{faces}")).unwrap();
    let bake = ["bake", "b.vti", "--isovalues", "3.6", "95", "--box", "room.obj", "--albedo", "1", "-o", "lit.vti"];
    let settles = |walls: f64| {
        let (kd, ke) = (walls, 1.0 - walls);
        fs::write(dir.join("room.mtl"), format!("newmtl w\nKd {kd} {kd} {kd}\nKe {ke} {ke} {ke}\n")).unwrap();
        let more = ["--engine", "sweep", "--preset", "preview", "--report", "r.json"];
        let lines = text(&ok(dir, &[&bake[..], &more].concat()).stderr);
        let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap();
        let (share, bounces) = (report["unsettled"].as_f64().unwrap(), report["sweep_bounces"].as_u64().unwrap());
        println!("{walls}: {share} may be missing after {bounces} bounces");
        (lines.contains("warning: light has not settled"), share, bounces)
    };
    let (warned, share, bounces) = settles(0.5);
    assert!(!warned && share > 0.0 && share < 0.004 && bounces < 64, "{share} {bounces}");
    let (warned, share, bounces) = settles(0.999);
    assert!(warned && share > 0.02 && bounces > 500, "{share} {bounces}");
}
