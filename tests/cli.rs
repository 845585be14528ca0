//! The program as users meet it: verbs, files, exit codes, and one clear line for every kind of bad input.

use isolume::volume::vti::VtiFile;
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn isolume(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_isolume")).current_dir(dir).args(args).output().expect("the program starts")
}

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
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .filter(|n| n.contains("out.vti"))
        .collect();
    assert!(left.is_empty(), "{args:?} left {left:?}");
}

fn ok(dir: &Path, args: &[&str]) -> Output {
    let output = isolume(dir, args);
    assert!(output.status.success(), "{args:?}: {}", text(&output.stderr));
    output
}

const QUICK: [&str; 8] = ["--photons", "4000", "--samples", "2000", "--gather", "8", "--wall-resolution", "8"];

#[test]
fn generate_info_bake_render() {
    let dir = tempfile::tempdir().unwrap();
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

#[test]
fn simulations_write_one_file_per_field() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let small = ["--size", "13", "--steps", "20", "--particles", "400", "--density", "0.05"];
    let with = |args: &[&'static str]| [args, &small[..]].concat();
    ok(dir, &with(&["generate", "pasta", "--species", "both", "-o", "p.vti"]));
    ok(dir, &with(&["generate", "pasta", "-o", "p.nrrd"]));
    ok(dir, &with(&["generate", "fluid", "-o", "f.vti"]));
    assert!(!dir.join("p.vti").exists());
    let [protons, neutrons, all] =
        ["p-proton.vti", "p-neutron.vti", "p.nrrd"].map(|f| Volume::open(dir.join(f)).unwrap());
    for o in 0..all.lattice.len() {
        assert!((protons.value(o) + neutrons.value(o) - all.value(o)).abs() < 1e-6, "sample {o}");
    }
    let edge = all.lattice.world_volume().cbrt();
    assert!((edge - 20.0).abs() < 1e-9, "400 nucleons at 0.05 per fm³: {edge}");
    assert!(Volume::open(dir.join("f.vti")).unwrap().range().unwrap().1 > 0.0);
    assert!(text(&fs::read(dir.join("p-proton.vti")).unwrap()[..4096]).contains("generator"), "provenance");
    // A volume's notes are not a bake's description of itself.
    let (lo, hi) = Volume::open(dir.join("f.vti")).unwrap().range().unwrap();
    ok(dir, &["extract", "f.vti", "--isovalue", &(0.5 * (lo + hi)).to_string(), "-o", "f.ply"]);
    refused(dir, &["generate", "pasta", "--particles", "9", "-o", "out.vti"], &["--particles 9"]);
    refused(dir, &["generate", "fluid", "--species", "proton", "-o", "out.vti"], &["--species"]);
    refused(dir, &["generate", "bumps", "--seed", "2", "-o", "out.vti"], &["bumps", "pasta"]);
}

#[test]
fn bad_input_is_one_clear_line_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    refused(dir, &["bake", "nowhere.nii.gz", "-o", "out.vti"], &["nowhere.nii.gz"]);
    refused(dir, &["bake", "nowhere.xyz", "-o", "out.vti"], &["nowhere.xyz"]);

    // A gzip stream cut short.
    let lattice = Lattice::aligned([8, 8, 8], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let ramp = Samples::F32((0..512).map(|i| i as f32).collect());
    Volume::new("ramp", lattice.clone(), ramp).unwrap().write(dir.join("ramp.nrrd")).unwrap();
    let header = b"NRRD0004\ntype: float\ndimension: 3\nsizes: 8 8 8\nencoding: gzip\nendian: little\n\n";
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut gz, &[7; 2048]).unwrap();
    let packed = gz.finish().unwrap();
    fs::write(dir.join("cut.nrrd"), [&header[..], &packed[..packed.len() / 2]].concat()).unwrap();
    refused(dir, &["bake", "cut.nrrd", "-o", "out.vti"], &["cut.nrrd"]);

    // A header that promises 10¹² samples.
    let big = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 10000 10000 10000\nencoding: raw\nendian: little\n\nxx";
    fs::write(dir.join("big.nrrd"), big).unwrap();
    refused(dir, &["bake", "big.nrrd", "-o", "out.vti"], &["big.nrrd", "1000000000000"]);

    Volume::new("nan", lattice.clone(), Samples::F32(vec![f32::NAN; 512]))
        .unwrap()
        .write(dir.join("nan.nrrd"))
        .unwrap();
    refused(dir, &["bake", "nan.nrrd", "-o", "out.vti"], &["nan.nrrd", "finite"]);
    Volume::new("flat", lattice, Samples::F32(vec![3.0; 512])).unwrap().write(dir.join("flat.nrrd")).unwrap();
    refused(dir, &["bake", "flat.nrrd", "-o", "out.vti"], &["flat.nrrd", "isosurface"]);

    let ramp = ["bake", "ramp.nrrd", "-o", "out.vti"];
    let with = |extra: &[&'static str]| [&ramp[..], extra].concat();
    refused(dir, &with(&["--isovalues", "600", "700"]), &["outside the data", "0 … 511"]);
    refused(dir, &with(&["--isovalues", "7", "7"]), &["isovalues"]);
    refused(dir, &with(&["--albedo", "1.5"]), &["albedo"]);
    refused(dir, &with(&["--boundary", "capped"]), &["margin"]);
    refused(dir, &with(&["--gather", "9999999"]), &["gather"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "missing/folder/out.vti"], &["missing"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "out.png"], &["out.png", ".vti"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "out.nrrd"], &["out.nrrd", "isolume export"]);

    // Before the file is opened, which is not there.
    for exposure in ["nan", "inf", "-inf", "-1", "0", "-0"] {
        for output in ["out.png", "out.exr"] {
            let exposure = format!("--exposure={exposure}");
            let render = ["render", "nowhere.vti", "--isovalue", "5", "-o", output, &exposure];
            refused(dir, &render, &["--exposure", "positive"]);
        }
    }

    // A luminaire without area, and a scene with an unknown key.
    fs::write(dir.join("l.mtl"), "newmtl lamp\nKe 1 1 1\n").unwrap();
    fs::write(dir.join("l.obj"), "mtllib l.mtl\nv 0 0 0\nv 1 1 1\nv 2 2 2\nusemtl lamp\nf 1 2 3\n").unwrap();
    refused(dir, &with(&["--box", "l.obj"]), &["l.obj", "face 1", "area"]);
    fs::write(dir.join("s.toml"), "[volume]\nfile = \"ramp.nrrd\"\n\n[surface]\nalbdo = 0.5\n").unwrap();
    refused(dir, &["bake", "s.toml", "-o", "out.vti"], &["s.toml:5", "albdo", "albedo"]);
}

/// The surfaces are there, but between the grid's points; a volume without any is another matter.
#[test]
fn a_grid_that_is_too_coarse_is_told_from_a_constant_volume() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "20", "-o", "b.nrrd", "-q"]);
    for engine in ["sweep", "photon"] {
        let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--engine", engine];
        refused(dir, &[&bake[..], &["--grid", "2,2,2"]].concat(), &["too coarse", "--grid", "2×2×2"]);
    }
    // 0 and 10, and what is not finite between them.
    let lattice = Lattice::aligned([8; 3], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let halves = (0..512).map(|o| [0.0, 0.0, 0.0, f32::NAN, f32::NAN, 10.0, 10.0, 10.0][o % 8]).collect();
    Volume::new("halves", lattice, Samples::F32(halves)).unwrap().write(dir.join("h.nrrd")).unwrap();
    for grid in ["1x", "2x"] {
        let bake = ["bake", "h.nrrd", "--isovalues", "3", "4", "-o", "out.vti", "-q", "--grid", grid];
        refused(dir, &bake, &["constant", "other isovalues"]);
    }
}

/// MTL: one number is grey; what tobj would panic at is refused with its line.
#[test]
fn colours_of_an_mtl_are_one_number_or_three() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.nrrd", "-q"]);
    fs::write(dir.join("w.obj"), "mtllib w.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl w\nf 1 2 3\n").unwrap();
    fs::write(
        dir.join("s.toml"),
        "[volume]\nfile = \"b.nrrd\"\n[box]\nkind = \"none\"\n[[context]]\nfile = \"w.obj\"\n",
    )
    .unwrap();
    let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--dry-run", "--box", "w.obj"];
    let context = ["bake", "s.toml", "-o", "out.vti", "-q", "--dry-run"];
    for lines in
        ["Kd 0.7", "Ks 0", "Ka 0.2", "Tf 1", "Ke 2", "Kd 0.7\nKs 0\nKa 0.2\nTf 1\nKe 2", "Kd 0.1 0.2 0.3 # and more"]
    {
        fs::write(dir.join("w.mtl"), format!("newmtl w\n{lines}\n")).unwrap();
        ok(dir, &bake);
        ok(dir, &context);
    }
    for (line, found) in [
        ("Kd 0.7 0.7", "Kd 0.7 0.7"),
        ("Ks", "Ks"),
        ("Ka red", "Ka red"),
        ("Ke 1 2 x", "Ke 1 2 x"),
        ("Kd spectral red.rfl", "Kd spectral red.rfl"),
        ("Kd # 1 1 1", "Kd # 1 1 1"),
        ("Ns", "Ns"),
        ("illum x", "illum x"),
    ] {
        fs::write(dir.join("w.mtl"), format!("newmtl w\n\n  {line}\n")).unwrap();
        refused(dir, &bake, &["w.mtl:3: ", found]);
        refused(dir, &context, &["s.toml", "w.mtl:3: ", found]);
    }
}

/// Radiances are stored in 32 bits, and so are the squares that their standard errors come from.
#[test]
fn emissions_that_floats_cannot_square_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.nrrd", "-q"]);
    let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--dry-run"];
    let with = |extra: &[&'static str]| [&bake[..], extra].concat();
    let lamp = |emission: &str| {
        fs::write(dir.join("l.mtl"), format!("newmtl lamp\nKd 0 0 0\nKe {emission}\n")).unwrap();
        fs::write(dir.join("l.obj"), "mtllib l.mtl\nv 0 0 1\nv 1 0 1\nv 0 1 1\nusemtl lamp\nf 1 3 2\n").unwrap();
    };
    for fine in ["0 0 0", "1e-15 0 0", "1e18 1e18 1e18", "1e18 1e-30 0"] {
        lamp(fine);
        ok(dir, &with(&["--box", "l.obj"]));
    }
    for wrong in ["1e22 1e22 1e22", "1.1e18 1 1", "0 1e22 0", "9e-16 0 0", "1e-20 1e-20 1e-20", "-1 0 0"] {
        lamp(wrong);
        refused(dir, &with(&["--box", "l.obj"]), &["l.obj", "face 1", "emission", "1e-15", "1e18"]);
    }
    ok(dir, &with(&["--emission", "1e18"]));
    ok(dir, &with(&["--emission", "1e-15,0,0"]));
    for wrong in ["1e22", "1e-20", "0,0,2e18", "inf", "nan", "-1"] {
        let emission = format!("--emission={wrong}");
        refused(dir, &[&bake[..], &[&emission]].concat(), &["emission", "1e-15", "1e18"]);
    }
    fs::write(dir.join("s.toml"), "[volume]\nfile = \"b.nrrd\"\n[surface]\nemission = 1e22\n").unwrap();
    refused(dir, &["bake", "s.toml", "-o", "out.vti"], &["s.toml", "emission", "1e18"]);
}

/// Sweeps, unless the scene, an option or the user asks for photons; options of both need a word.
#[test]
fn scene_and_options_choose_the_engine() {
    let dir = tempfile::tempdir().unwrap();
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

/// A cavity in a volume of zeros and ones: no grid point holds light of its own level set, and what sweeps know of it is its emission.
/// Its walls emit 1 and reflect half: 2 comes from everywhere.
#[test]
fn binary_volumes_are_baked_by_exact_rays() {
    let dir = tempfile::tempdir().unwrap();
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
    // Sweeps that are asked for say what they leave out; on a finer grid points lie within the sweep.
    let dry = |more: &[&str]| text(&ok(dir, &[&bake[..], &["-o", "lit.vti", "--dry-run"], more].concat()).stderr);
    let lines = dry(&["--engine", "sweep"]);
    assert!(lines.contains("warning: samples jump over the whole sweep at 100 %"), "{lines}");
    let lines = dry(&["--grid", "2x"]);
    assert!(lines.contains("engine  sweep") && !lines.contains("warning"), "{lines}");
}

/// Bumps on an offset a thousand million times their range: the bake has the isosurfaces of its volume, which are those without it.
#[test]
fn bakes_of_data_on_an_offset_hold_their_isosurfaces() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "13", "-o", "b.vti", "-q"]);
    let bumps = Volume::open(dir.join("b.vti")).unwrap();
    let raised = (0..bumps.lattice.len()).map(|o| 1e9 + 0.01 * bumps.value(o)).collect();
    Volume::new("raised", bumps.lattice.clone(), Samples::F64(raised)).unwrap().write(dir.join("raised.vti")).unwrap();
    let bake = |volume: &str, output: &str, sweep: [&str; 2], more: &[&str]| {
        let given = ["bake", volume, "-o", output, "--preset", "preview", "-q", "--isovalues", sweep[0], sweep[1]];
        ok(dir, &[&given[..], more].concat());
    };
    let surface = |bake: &str, isovalue: &str| {
        ok(dir, &["extract", bake, "--isovalue", isovalue, "-o", "s.ply", "-q"]);
        let mesh = isolume::export::ply::read(dir.join("s.ply")).unwrap();
        mesh.triple(["x", "y", "z"]).unwrap()
    };
    for grid in ["1x", "2x"] {
        bake("b.vti", "lit.vti", ["5", "95"], &["--grid", grid]);
        bake("raised.vti", "high.vti", ["1000000000.05", "1000000000.95"], &["--grid", grid]);
        let (plain, raised) = (surface("lit.vti", "47"), surface("high.vti", "1000000000.47"));
        assert!(plain.len() == raised.len() && plain.len() > 100, "{grid}: {} {}", plain.len(), raised.len());
        let off =
            plain.iter().zip(&raised).flat_map(|(a, b)| [0, 1, 2].map(|x| (a[x] - b[x]).abs())).fold(0.0, f32::max);
        let size = bumps.lattice.spacing().max_element();
        assert!(f64::from(off) < 1e-3 * size, "{grid}: {off} of {size}");
    }
    let stored = |name: &str| {
        let file = VtiFile::read(&dir.join(name)).unwrap();
        matches!(file.point_data.iter().find(|a| a.name == "value").unwrap().samples, Samples::F32(_))
    };
    assert!(stored("lit.vti") && !stored("high.vti"), "no more bytes than are needed");
}

/// Two volumes: a file each and one that names them; every verb that should takes them.
#[test]
fn a_headerless_file_may_have_flipped_axes() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    fs::write(dir.join("r.raw"), (0..12).collect::<Vec<u8>>()).unwrap();
    let place = ["--raw-dims", "3,2,2", "--raw-spacing", "-1,2,-3", "--raw-origin", "-7,0,1"];
    let info = ok(dir, &[&["info", "r.raw", "--json"], &place[..]].concat());
    let json: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!(json["axes"], serde_json::json!([[-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, -3.0]]));
    assert_eq!(json["origin"], serde_json::json!([-7.0, 0.0, 1.0]));
}

/// What Slicer draws mirrored if it is lost.
#[test]
fn what_the_axes_mean_goes_from_file_to_file() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.nrrd", "--quiet"]);
    ok(dir, &["export", "b.nrrd", "--space", "ras", "-o", "b.vti", "--quiet"]);
    let mut bake = vec!["bake", "b.vti", "--isovalues", "3.6", "95", "-o", "lit.vti", "--quiet"];
    bake.extend(QUICK);
    ok(dir, &bake);
    for input in ["b.vti", "lit.vti"] {
        ok(dir, &["export", input, "-o", "e.nrrd", "--quiet"]);
        let head = text(&fs::read(dir.join("e.nrrd")).unwrap());
        assert!(head.contains("\nspace: right-anterior-superior\n"), "{input}");
    }
}

#[test]
fn several_volumes_in_one_scene() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let scene = "[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 13\nisovalues = [10, 90]\n\
        [[volume]]\nname = \"b\"\ngenerator = \"sphere\"\nsize = 9\norigin = [0.05, 0.1, 0.02]\nscale = 0.3\n\
        isovalues = [0.02, 0.2]\nalbedo = [0.8, 0.1, 0.1]\noutside = \"higher\"\n";
    fs::write(dir.join("two.toml"), scene).unwrap();
    refused(dir, &["bake", "two.toml", "-o", "two.vti"], &["two.vti", ".vtm", "2"]);
    refused(dir, &["bake", "two.toml", "-o", "two.vtm", "--engine", "sweep"], &["sweep", "photon"]);
    refused(dir, &["bake", "two.toml", "-o", "two.vtm", "--albedo", "1"], &["--albedo", "[[volume]]"]);
    // At once: before a line about the scene.
    fs::create_dir(dir.join("two-b.vti")).unwrap();
    refused(dir, &["bake", "two.toml", "-o", "two.vtm"], &["two-b.vti", "is a folder"]);
    fs::remove_dir(dir.join("two-b.vti")).unwrap();
    let bake = |seed: &str| {
        let mut args = vec!["bake", "two.toml", "-o", "two.vtm", "-q", "--seed", seed, "--report", "two.json"];
        args.extend(QUICK);
        ok(dir, &args);
    };
    bake("1");
    let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("two.json")).unwrap()).unwrap();
    assert_eq!((report["a"]["grid"][0].as_u64(), report["b"]["grid"][0].as_u64()), (Some(13), Some(9)));
    let file = VtiFile::read(&dir.join("two-b.vti")).unwrap();
    let array = |name: &str| file.point_data.iter().find(|a| a.name == name).unwrap().samples.clone();
    let (Samples::F32(s), Samples::F32(value)) = (array("s"), array("value")) else { panic!("floats") };
    assert!(s.iter().zip(&value).all(|(s, v)| (s - (v - 0.02) / 0.18).abs() < 1e-5), "s is the shared parameter");
    let index = text(&fs::read(dir.join("two.vtm")).unwrap());
    assert!(index.contains("vtkMultiBlockDataSet") && index.contains("file=\"two-a.vti\""), "{index}");

    // The same s, whichever volume the isovalue speaks of: 50 of [10, 90] is 0.11 of [0.02, 0.2].
    let render =
        |args: &[&str]| ok(dir, &[&["render", "two.vtm", "--height", "40", "--samples", "2", "-q"], args].concat());
    render(&["--isovalue", "50", "-o", "a.png"]);
    render(&["--isovalue", "0.11", "--field", "b", "-o", "b.png"]);
    assert_eq!(fs::read(dir.join("a.png")).unwrap(), fs::read(dir.join("b.png")).unwrap());
    // One alone is another picture.
    ok(dir, &["render", "two-a.vti", "--height", "40", "--samples", "2", "-q", "--isovalue", "50", "-o", "alone.png"]);
    assert_ne!(fs::read(dir.join("a.png")).unwrap(), fs::read(dir.join("alone.png")).unwrap());
    ok(dir, &["extract", "two.vtm", "--field", "b", "--isovalue", "0.11", "-o", "b.ply", "-q"]);
    ok(dir, &["extract", "two-b.vti", "--isovalue", "0.11", "-o", "own.ply", "-q"]);
    assert_eq!(fs::read(dir.join("b.ply")).unwrap(), fs::read(dir.join("own.ply")).unwrap());
    let reference = ["reference", "--field", "b", "--isovalue", "0.11", "--samples", "16", "--vertices", "20", "-q"];
    ok(dir, &[&reference[..], &["two.toml", "-o", "r.ply"]].concat());
    ok(dir, &["compare", "two-b.vti", "r.ply", "--json"]);
    refused(dir, &[&reference[..2], &["c", "two.toml", "--isovalue", "0.11", "-o", "r.ply"]].concat(), &["a, b"]);
    refused(dir, &["view", "two.vtm", "-o", "two.html"], &["two.vtm", "several"]);
    refused(dir, &["render", "two.vtm", "--isovalue", "5", "--field", "b", "-o", "c.png"], &["'b'", "0.02"]);

    let first = fs::read(dir.join("two-a.vti")).unwrap();
    bake("2");
    assert_ne!(fs::read(dir.join("two-a.vti")).unwrap(), first);
    fs::remove_file(dir.join("two-b.vti")).unwrap();
    refused(dir, &["render", "two.vtm", "--isovalue", "50", "-o", "c.png"], &["two-b.vti"]);
}

/// What would change a bake's scene is refused where a bake is read: its light is that of the scene it holds.
#[test]
fn scene_flags_are_refused_where_the_input_is_a_bake() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    ok(dir, &[&["bake", "b.vti", "--isovalues", "30", "60", "-o", "lit.vti", "-q"], &QUICK[..]].concat());
    let verbs: [&[&str]; 5] = [
        &["reference", "--samples", "16", "--vertices", "5", "-o", "r.ply"],
        &["extract", "-o", "m.ply"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1", "--local"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1", "--reference"],
    ];
    for verb in verbs {
        let with = |extra: &[&'static str]| [verb, &["lit.vti", "-q"], extra].concat();
        for flags in [
            &["--isovalues", "49", "51"][..],
            &["--time", "1"],
            &["--albedo", "0"],
            &["--emission", "1"],
            &["--outside", "higher"],
            &["--sides", "both"],
            &["--boundary", "open"],
            &["--box", "none"],
            &["--margin", "0"],
            &["--raw-skip", "0"],
        ] {
            let named = if flags[0].starts_with("--raw") { "--raw-…" } else { flags[0] };
            let says = ["lit.vti", &format!("{named}: "), "the bake holds its scene"];
            refused(dir, &with(&[flags, &["--isovalue", "50"]].concat()), &says);
        }
        // No light is no light of 0.
        refused(dir, &with(&["--isovalue", "90"]), &["90", "outside the sweep", "30 … 60"]);
        ok(dir, &with(&["--isovalue", "50"]));
    }
    refused(dir, &["extract", "lit.vti", "-o", "m.ply", "--isovalue", "90"], &["lit.vti", "isolume export", "value"]);
    // The way that the message says, and a volume as it was.
    ok(dir, &["export", "lit.vti", "--array", "value", "-o", "value.vti", "-q"]);
    for volume in ["value.vti", "b.vti"] {
        ok(dir, &["extract", volume, "-o", "m.ply", "--isovalue", "90", "--outside", "higher", "-q"]);
    }
    assert!(!text(&fs::read(dir.join("m.ply")).unwrap()).contains("radiance"));
}

#[test]
fn a_second_bake_never_harms_the_first_unless_it_finishes() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    fs::write(dir.join("keep.vti"), "precious").unwrap();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let output = isolume(dir, &["bake", "b.vti", "-o", "keep.vti", "--isovalues", "500", "600"]);
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(fs::read(dir.join("keep.vti")).unwrap(), b"precious");
    let mut bake = vec!["bake", "b.vti", "-o", "keep.vti", "--isovalues", "3.6", "95", "-q"];
    bake.extend(QUICK);
    assert_eq!(text(&ok(dir, &bake).stderr), "", "--quiet is quiet");
    assert!(VtiFile::read(&dir.join("keep.vti")).is_ok());
}

/// Whatever a verb reads is as it was, and nothing is written twice.
#[test]
fn no_output_takes_the_place_of_an_input() {
    let dir = tempfile::tempdir().unwrap();
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
fn the_same_bits_for_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "17", "-o", "b.vti", "-q"]);
    let grids: Vec<Vec<f32>> = ["1", "2", "7", "16"]
        .iter()
        .map(|threads| {
            let mut bake = vec!["bake", "b.vti", "-o", "t.vti", "--isovalues", "3.6", "95", "--threads", threads, "-q"];
            bake.extend(QUICK);
            ok(dir, &bake);
            let file = VtiFile::read(&dir.join("t.vti")).unwrap();
            let walls = file.field_data.iter().filter(|a| a.name.starts_with("wall_"));
            let arrays = file.point_data.iter().filter(|a| a.name != "mask").chain(walls);
            arrays
                .flat_map(|a| match &a.samples {
                    Samples::F32(v) => v.clone(),
                    _ => panic!("{} is not f32", a.name),
                })
                .collect()
        })
        .collect();
    let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    assert!(grids[0].iter().any(|&x| x > 0.0));
    for other in &grids[1..] {
        assert_eq!(bits(&grids[0]), bits(other));
    }
}

#[test]
fn a_pipe_that_nobody_reads_is_no_fault() {
    let dir = tempfile::tempdir().unwrap();
    ok(dir.path(), &["generate", "bumps", "--size", "9", "-o", "b.vti"]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_isolume"));
    command.current_dir(dir.path()).args(["info", "b.vti", "--json"]);
    let mut child = command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{}", text(&output.stderr));
}

/// Every kernel gives the same bits; what the machine lacks is refused before any work.
#[test]
fn every_instruction_set_bakes_the_same_light() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "21", "-o", "b.nrrd", "--quiet"]);
    let found = isolume::isa::Isa::found();
    for engine in ["sweep", "photon"] {
        let effort: &[&str] =
            if engine == "sweep" { &["--directions", "16", "--light-points", "4"] } else { &["--photons", "4000"] };
        let light = |isa: &str| {
            let mut args = vec!["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "--engine", engine];
            args.extend(effort);
            args.extend(["--isa", isa, "--report", "r.json", "--quiet"]);
            ok(dir, &args);
            let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap();
            assert_eq!(report["isa"], isa);
            let file = VtiFile::read(&dir.join("out.vti")).unwrap();
            fs::remove_file(dir.join("out.vti")).unwrap();
            let radiance = file.point_data.into_iter().find(|a| a.name == "radiance").unwrap();
            format!("{:?}", radiance.samples)
        };
        let plain = light("plain");
        assert!(plain.len() > 20_000, "{} letters are no light", plain.len());
        for isa in &found[1..] {
            assert!(light(isa.name()) == plain, "{engine}: {} is not plain", isa.name());
        }
    }
    for name in isolume::isa::Isa::NAMES.into_iter().skip(found.len()) {
        refused(dir, &["bake", "b.nrrd", "-o", "out.vti", "--isa", name], &[name, "this machine has plain"]);
    }
    let output = isolume(dir, &["bake", "b.nrrd", "-o", "out.vti", "--isa", "sse9"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("avx512"), "{}", text(&output.stderr));
}
