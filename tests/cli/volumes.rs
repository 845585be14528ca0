//! Volumes of every kind from file to file: simulated, on an offset, without a header, with axes that mean something,
//! several in a scene.

use super::{Folder, QUICK, ok, refused, text};
use glam::{DMat3, DVec3};
use isolume::export::ply;
use isolume::volume::vti::{VtiFile, VtiWriter};
use isolume::volume::{Lattice, Samples, Space, Volume, npy};
use std::fs;

#[test]
fn simulations_write_one_file_per_field() {
    let dir = Folder::new();
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

/// Bumps on an offset a thousand million times their range: the bake has the isosurfaces of its volume, which are those
/// without it.
#[test]
fn bakes_of_data_on_an_offset_hold_their_isosurfaces() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "13", "-o", "b.vti", "-q"]);
    let bumps = Volume::open(dir.join("b.vti")).unwrap();
    let raised = (0..bumps.lattice.len()).map(|o| 1e9 + 0.01 * bumps.value(o)).collect();
    Volume::new("raised", bumps.lattice.clone(), Samples::F64(raised)).unwrap().write(dir.join("raised.vti")).unwrap();
    let bake = |volume: &str, output: &str, sweep: [&str; 2], more: &[&str]| {
        let given = ["bake", volume, "-o", output, "--preset", "preview", "-q", "--isovalues", sweep[0], sweep[1]];
        ok(dir, &[&given[..], more].concat());
    };
    let surface = |file: &str, isovalue: &str, more: &[&str]| {
        ok(dir, &[&["extract", file, "--isovalue", isovalue, "-o", "s.ply", "-q"], more].concat());
        let mesh = isolume::export::ply::read(dir.join("s.ply")).unwrap();
        mesh.triple(["x", "y", "z"]).unwrap()
    };
    let farthest = |a: &[[f64; 3]], b: &[[f64; 3]]| {
        a.iter().zip(b).flat_map(|(a, b)| [0, 1, 2].map(|x| (a[x] - b[x]).abs())).fold(0.0, f64::max)
    };
    let size = bumps.lattice.spacing().max_element();
    for grid in ["1x", "2x"] {
        bake("b.vti", "lit.vti", ["5", "95"], &["--grid", grid]);
        bake("raised.vti", "high.vti", ["1000000000.05", "1000000000.95"], &["--grid", grid]);
        let (plain, raised) = (surface("lit.vti", "47", &[]), surface("high.vti", "1000000000.47", &[]));
        assert!(plain.len() == raised.len() && plain.len() > 100, "{grid}: {} {}", plain.len(), raised.len());
        let off = farthest(&plain, &raised);
        assert!(off < 1e-3 * size, "{grid}: {off} of {size}");
    }
    let fifths = text(&ok(dir, &["compare", "high.vti", "--points", "40", "--paths", "2", "-q"]).stdout);
    assert!(fifths.contains("(1000000000.05 … 1000000000.23;"), "{fifths}");
    // In units in which f32 has no such numbers, or whole steps; and a sample beyond f32 in a sweep that is not.
    let scaled = |by: f64| -> Vec<f64> { (0..bumps.lattice.len()).map(|o| by * bumps.value(o)).collect() };
    let mut one = scaled(1.0);
    one[0] = 1e39;
    for (samples, by) in [(scaled(1e38), 1e38), (scaled(1e-45), 1e-45), (one, 1.0)] {
        let volume = Volume::new("scaled", bumps.lattice.clone(), Samples::F64(samples)).unwrap();
        volume.write(dir.join("scaled.vti")).unwrap();
        let of = |x: f64| format!("{:e}", x * by);
        let sweep = [of(5.0), of(95.0)];
        bake("scaled.vti", "far.vti", [&sweep[0], &sweep[1]], &[]);
        let far = surface("far.vti", &of(47.0), &[]);
        let own = surface("scaled.vti", &of(47.0), &["--isovalues", &sweep[0], &sweep[1]]);
        assert!(far.len() == own.len() && farthest(&far, &own) < 1e-5 * size, "{by:e}: {}", farthest(&far, &own));
    }
    let stored = |name: &str| {
        let file = VtiFile::read(&dir.join(name)).unwrap();
        matches!(file.point_data.iter().find(|a| a.name == "value").unwrap().samples, Samples::F32(_))
    };
    assert!(stored("lit.vti") && !stored("high.vti"), "no more bytes than are needed");
}

/// What is printed of data on an offset tells its ends apart, and can be pasted.
#[test]
fn the_suggested_sweep_of_data_on_an_offset_can_be_pasted() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([20; 3], DVec3::splat(-1.0), DVec3::splat(2.0 / 19.0)).unwrap();
    let ball = |o: usize| {
        let [i, j, k] = lattice.ijk(o).map(|i| i as f64);
        1.0 - lattice.to_world(DVec3::new(i, j, k)).length()
    };
    for offset in [1e8, 101_325.0, -3e12] {
        let samples = (0..lattice.len()).map(|o| offset + ball(o)).collect();
        Volume::new("ball", lattice.clone(), Samples::F64(samples)).unwrap().write(dir.join("ball.npy")).unwrap();
        let info = text(&ok(dir, &["info", "ball.npy"]).stdout);
        let json: serde_json::Value = serde_json::from_slice(&ok(dir, &["info", "ball.npy", "--json"]).stdout).unwrap();
        for (key, field) in [("range", "range"), ("suggested sweep", "sweep")] {
            let line = info.lines().find_map(|l| l.strip_prefix(key)).unwrap();
            let ends: Vec<f64> = line.split('…').map(|end| end.trim().parse().unwrap()).collect();
            let exact = [0, 1].map(|n| json[field][n].as_f64().unwrap());
            let off = (ends[0] - exact[0]).abs().max((ends[1] - exact[1]).abs());
            assert!(off <= 1e-3 * (exact[1] - exact[0]), "{offset}: {line}");
            if field == "sweep" {
                let ends: Vec<String> = line.split('…').map(|end| end.trim().to_owned()).collect();
                ok(dir, &["bake", "ball.npy", "-o", "b.vti", "--dry-run", "-q", "--isovalues", &ends[0], &ends[1]]);
            }
        }
        let percentiles = info.lines().find_map(|l| l.strip_prefix("percentiles")).unwrap();
        let values: Vec<&str> = percentiles.split_once('(').unwrap().0.split_whitespace().collect();
        assert!(values.windows(2).all(|w| w[0] != w[1]), "{percentiles}");
        ok(dir, &["init", "ball.npy", "-o", "ball.toml", "-q"]);
        let scene = fs::read_to_string(dir.join("ball.toml")).unwrap();
        let range = info.lines().find_map(|l| l.strip_prefix("range")).unwrap().trim();
        assert!(scene.contains(range), "{range} in {scene}");
        fs::remove_file(dir.join("ball.toml")).unwrap();
    }
}

/// 64-bit integers that become the same floats are told from samples that are the same.
#[test]
fn integers_that_floats_do_not_hold_are_told_of() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([4; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let write = |factor: i64| {
        let samples = Samples::I64((0..64).map(|k| (1 << 60) + factor * k).collect());
        Volume::new("v", lattice.clone(), samples).unwrap().write(dir.join("v.npy")).unwrap();
    };
    write(1);
    for verb in [&["bake", "v.npy", "-o", "out.vti"][..], &["extract", "v.npy", "--isovalue", "1", "-o", "m.ply"]] {
        refused(dir, verb, &["v.npy", "apart", "subtract"]);
    }
    ok(dir, &["init", "v.npy", "-o", "v.toml", "-q"]);
    assert!(!text(&fs::read(dir.join("v.toml")).unwrap()).contains("no isosurface"));
    write(100);
    let said = text(&ok(dir, &["bake", "v.npy", "-o", "v.vti", "--dry-run", "-q"]).stderr);
    let lines = ["warning: ", "v.npy", "63 of 64 samples", "subtract an offset"];
    assert!(lines.iter().all(|w| said.contains(w)), "{said}");
    let info = text(&ok(dir, &["info", "v.npy"]).stdout);
    assert!(info.contains("63 (98.438 %)") && info.contains("subtract an offset"), "{info}");
}

#[test]
fn a_headerless_file_may_have_flipped_axes() {
    let dir = Folder::new();
    let dir = dir.path();
    fs::write(dir.join("r.raw"), (0..12).collect::<Vec<u8>>()).unwrap();
    let place = ["--raw-dims", "3,2,2", "--raw-spacing", "-1,2,-3", "--raw-origin", "-7,0,1"];
    let info = ok(dir, &[&["info", "r.raw", "--json"], &place[..]].concat());
    let json: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!(json["axes"], serde_json::json!([[-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, -3.0]]));
    assert_eq!(json["origin"], serde_json::json!([-7.0, 0.0, 1.0]));
    // Flags take the place of single keys.
    fs::write(dir.join("r.toml"), "[volume]\nfile = \"r.raw\"\nraw = { dims = [3, 2, 2], type = \"u8\" }\n").unwrap();
    let spaced = ["extract", "r.toml", "--raw-spacing", "5,2,2", "--isovalue", "5.5", "-o", "r.ply", "-q"];
    ok(dir, &spaced);
    let mesh = isolume::export::ply::read(dir.join("r.ply")).unwrap();
    let most = mesh.property("x").unwrap().iter().fold(0.0, |a: f64, x| a.max(*x));
    assert_eq!(most, 10.0);
}

/// What Slicer draws mirrored if it is lost.
#[test]
fn what_the_axes_mean_goes_from_file_to_file() {
    let dir = Folder::new();
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

/// Two volumes: a file each and one that names them; every verb that should takes them.
#[test]
fn several_volumes_in_one_scene() {
    let dir = Folder::new();
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
    refused(dir, &["compare", "two.vtm", "r.ply"], &["two.vtm", "several"]);
    // One of them alone is another scene than the one that lit it.
    let alone = ["two-b.vti", "--isovalue", "0.11", "-o"];
    refused(dir, &[&["reference"], &alone[..], &["c.ply"]].concat(), &["two-b.vti", ".vtm", "--field"]);
    refused(dir, &[&["render", "--reference"], &alone[..], &["c.png"]].concat(), &["two-b.vti", ".vtm"]);
    refused(dir, &["render", "two.vtm", "--isovalue", "5", "--field", "b", "-o", "c.png"], &["'b'", "0.02"]);

    let first = fs::read(dir.join("two-a.vti")).unwrap();
    bake("2");
    assert_ne!(fs::read(dir.join("two-a.vti")).unwrap(), first);
    fs::remove_file(dir.join("two-b.vti")).unwrap();
    refused(dir, &["render", "two.vtm", "--isovalue", "50", "-o", "c.png"], &["two-b.vti"]);
}

#[test]
fn info_of_a_damaged_bake_is_that_of_its_volume() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([3; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let volume = Volume::new("v", lattice, Samples::F32((0u8..27).map(f32::from).collect())).unwrap();
    volume.write_with_notes(dir.join("v.vti"), &[("isolume".into(), "{}".into())]).unwrap();
    let output = ok(dir, &["info", "v.vti", "--json"]);
    let info: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&info["range"], info.get("bake")), (&serde_json::json!([0.0, 26.0]), None));
    let said = text(&output.stderr);
    assert!(said.contains("v.vti") && said.contains("'isolume'") && said.contains("isovalues"), "{said}");
}

/// A Gaussian: what is suggested leaves out its tail, of which 32 bits in the sweep's units tell nothing.
fn gaussian() -> (Lattice, Vec<f64>) {
    let lattice = Lattice::aligned([24; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let value = |o: usize| {
        let p = lattice.point(o) - 11.5;
        (-p.length_squared() / 5.0).exp()
    };
    let values = (0..lattice.len()).map(value).collect();
    (lattice, values)
}

#[test]
fn isosurfaces_far_outside_the_suggested_sweep_are_where_they_are() {
    let dir = Folder::new();
    let dir = dir.path();
    let (lattice, values) = gaussian();
    npy::write(&dir.join("g.npy"), &lattice, 1, (&Samples::F64(values)).into()).unwrap();
    for (isovalue, sweep) in [("1e-7", ["5e-8", "2e-7"]), ("1e-11", ["5e-12", "2e-11"])] {
        ok(dir, &["extract", "g.npy", "--isovalue", isovalue, "-o", "m.ply", "-q"]);
        let there = ["extract", "g.npy", "--isovalue", isovalue, "-o", "n.ply", "-q", "--isovalues"];
        ok(dir, &[&there[..], &sweep].concat());
        let [m, n] = ["m.ply", "n.ply"].map(|name| ply::read(dir.join(name)).unwrap());
        assert_eq!(m.triangles, n.triangles, "{isovalue}");
        for axis in ["x", "y", "z"] {
            let [a, b] = [&m, &n].map(|mesh| mesh.property(axis).unwrap());
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4), "{isovalue}");
        }
    }
    refused(dir, &["extract", "g.npy", "--isovalue", "3", "-o", "m.ply"], &["no surface at this isovalue"]);
}

/// Not what happens to be called as a bake's array is.
#[test]
fn the_scalars_of_a_volume_are_exported() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([2; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let [density, radiance] = [[1u8, 2, 3, 4, 5, 6, 7, 8], [9; 8]].map(|v| Samples::U8(v.to_vec()));
    let file = VtiWriter::new(&lattice).point_data("radiance", 1, &radiance).point_data("density", 1, &density);
    file.active_scalars("density").write(&dir.join("v.vti")).unwrap();
    for (array, expected) in [(&[][..], &density), (&["--array", "radiance"], &radiance)] {
        ok(dir, &[&["export", "v.vti", "-o", "v.npy", "-q"], array].concat());
        assert_eq!(Volume::open(dir.join("v.npy")).unwrap().samples(), expected, "{array:?}");
    }
}

/// By flags and by a scene file's keys: an array of its name, steps that keep their directions, an origin; of formats
/// that say where they stand, too.
#[test]
fn what_a_file_does_not_say_is_said_beside_it() {
    let dir = Folder::new();
    let dir = dir.path();
    let skew = DMat3::from_cols(DVec3::new(0.0, 2.0, 0.0), DVec3::new(-3.0, 0.0, 0.0), DVec3::new(0.0, 1.0, 1.0));
    let lattice = Lattice::new([2; 3], DVec3::ONE, skew).unwrap();
    let [p, q] = [[1u8, 2, 3, 4, 5, 6, 7, 8], [9, 1, 1, 1, 1, 1, 1, 1]].map(|v| Samples::U8(v.to_vec()));
    VtiWriter::new(&lattice).point_data("p", 1, &p).point_data("q", 1, &q).write(&dir.join("two.vti")).unwrap();
    npy::write(&dir.join("plain.npy"), &lattice, 1, (&p).into()).unwrap();
    let legacy = "# vtk DataFile Version 3.0\nt\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 2 2\nPOINT_DATA 8\n\
                  SCALARS p int\nLOOKUP_TABLE default\n1 2 3 4 5 6 7 8\nSCALARS q%20r int\nLOOKUP_TABLE default\n\
                  9 1 1 1 1 1 1 1\nFIELD FieldData 1\ns 1 8 int\n7 7 7 7 7 7 7 6\n";
    fs::write(dir.join("two.vtk"), legacy).unwrap();

    let info = |args: &[&str]| -> serde_json::Value {
        serde_json::from_slice(&ok(dir, &[&["info", "--json"], args].concat()).stdout).unwrap()
    };
    let range = |args: &[&str]| info(args)["range"].clone();
    refused(dir, &["info", "two.vti"], &["cannot tell which", "`p` (1 components), `q`", "--array"]);
    refused(dir, &["info", "two.vti", "--array", "r"], &["no point data `r`", "`p`"]);
    refused(dir, &["info", "two.vtk", "--array", "r"], &["no point data `r`"]);
    refused(dir, &["info", "plain.npy", "--array", "p"], &["no named arrays"]);
    assert_eq!(range(&["two.vti", "--array", "p"]), serde_json::json!([1.0, 8.0]));
    assert_eq!(range(&["two.vti", "--array", "q"]), serde_json::json!([1.0, 9.0]));
    let said = text(&ok(dir, &["info", "two.vti", "--array", "q"]).stdout);
    assert!(said.contains("`q` of `p`, `q`"), "{said}");
    assert_eq!(range(&["two.vtk"]), serde_json::json!([1.0, 8.0]));
    assert_eq!(range(&["two.vtk", "--array", "q r"]), serde_json::json!([1.0, 9.0]));
    assert_eq!(range(&["two.vtk", "--array", "s"]), serde_json::json!([6.0, 7.0]));

    let placed = info(&["two.vti", "--array", "p", "--spacing", "4,-1,2", "--origin", "-1,0,5"]);
    let root = 2f64.sqrt();
    assert_eq!(placed["origin"], serde_json::json!([-1.0, 0.0, 5.0]));
    assert_eq!(placed["axes"][0], serde_json::json!([0.0, 4.0, 0.0]));
    assert_eq!(placed["axes"][1], serde_json::json!([1.0, 0.0, 0.0]));
    assert!((placed["axes"][2][2].as_f64().unwrap() - root).abs() < 1e-12, "{placed}");
    refused(dir, &["info", "plain.npy", "--spacing", "1,2"], &["spacing needs three numbers, found 2"]);
    refused(dir, &["info", "plain.npy", "--spacing", "1,0,2"], &["plain.npy"]);
    refused(dir, &["info", "plain.npy", "--raw-spacing", "1,1,2"], &["--spacing"]);

    let scene = |keys: &str| fs::write(dir.join("s.toml"), keys).unwrap();
    scene(
        "isovalues = [2.0, 7.0]\n[volume]\nfile = \"two.vti\"\narray = \"p\"\nspacing = [1, 1, 3]\norigin = [0, 0, 7]\n",
    );
    let bake = |more: &[&str]| {
        ok(dir, &[&["bake", "s.toml", "-o", "lit.vti", "-q"], &QUICK[..], more].concat());
        VtiFile::read(&dir.join("lit.vti")).unwrap().lattice
    };
    let lattice = bake(&[]);
    assert_eq!((lattice.origin(), lattice.spacing().x), (DVec3::new(0.0, 0.0, 7.0), 1.0));
    assert!((lattice.spacing().z - 3.0).abs() < 1e-12);
    // Flags win.
    assert_eq!(bake(&["--origin", "1,2,3"]).origin(), DVec3::new(1.0, 2.0, 3.0));
    scene("isovalues = [0.3, 0.7]\n[volume]\ngenerator = \"sphere\"\nsize = 9\narray = \"p\"\n");
    refused(dir, &["bake", "s.toml", "-o", "lit.vti"], &["array is for a file"]);
    scene("isovalues = [0.3, 0.7]\n[volume]\ngenerator = \"sphere\"\nsize = 9\nspacing = [1, 1, 2]\n");
    assert_eq!(bake(&[]).spacing(), DVec3::new(1.0, 1.0, 2.0));
}

/// Where no sweep is given, the one that is suggested holds the isovalue that is asked for.
#[test]
fn isovalues_outside_a_suggested_sweep_are_in_it() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "17", "-o", "b.vti"]);
    let sweep = serde_json::from_slice::<serde_json::Value>(&ok(dir, &["info", "b.vti", "--json"]).stdout).unwrap();
    let [lo, max] = [&sweep["sweep"][0], &sweep["range"][1]].map(|x| x.as_f64().unwrap());
    let above = format!("{}", 0.9 * max + 0.1 * sweep["sweep"][1].as_f64().unwrap());
    assert!(lo < max);
    let few = ["--samples", "4", "--vertices", "10", "-q"];
    ok(dir, &[&["reference", "b.vti", "--isovalue", &above, "-o", "r.ply"], &few[..]].concat());
    ok(
        dir,
        &["render", "b.vti", "--local", "--isovalue", &above, "--width", "32", "--height", "32", "-o", "l.png", "-q"],
    );
    let given = ["reference", "b.vti", "--isovalue", &above, "--isovalues", "10,20", "-o", "r.ply"];
    refused(dir, &[&given[..], &few].concat(), &["outside the sweep 10 … 20"]);
}

/// A world of another handedness, walls of another unit, sweeps and colours beside the data, grids that leave points
/// out.
#[test]
fn what_does_not_fit_together_is_warned_of() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([9; 3], DVec3::splat(100.0), DVec3::splat(20.0)).unwrap();
    let h =
        |o: usize| (20.0 * (1.0 - lattice.ijk(o).map(|i| (i as f64 - 4.0).powi(2)).iter().sum::<f64>() / 20.0)) as f32;
    let samples = Samples::F32((0..lattice.len()).map(h).collect());
    let mut volume = Volume::new("v", lattice.clone(), samples).unwrap();
    volume.write(dir.join("v.vti")).unwrap();
    volume.space = Space::RightAnteriorSuperior;
    volume.write(dir.join("ras.vti")).unwrap();
    let square = |z: f64, emission: &str| {
        format!("v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\nv 0 1 {z}\nusemtl {emission}\nf -4 -3 -2 -1\n")
    };
    fs::write(dir.join("m.mtl"), "newmtl wall\nKd 0.5 0.5 0.5\nnewmtl lamp\nKe 1 1 1\n").unwrap();
    fs::write(dir.join("unit.obj"), format!("mtllib m.mtl\n{}{}", square(0.0, "wall"), square(1.0, "lamp"))).unwrap();
    let bake = |args: &[&str]| {
        let given =
            ["bake", "v.vti", "-o", "o.vti", "--directions", "8", "--light-points", "4", "--wall-resolution", "8"];
        let sweep: &[&str] = if args.contains(&"--isovalues") { &[] } else { &["--isovalues", "5,15"] };
        text(&ok(dir, &[&given[..], sweep, args].concat()).stderr)
    };
    let nothing = bake(&[]);
    assert!(!nothing.contains("warning"), "{nothing}");
    for (args, words) in [
        (&["--box", "unit.obj"][..], "beside the volume, not around it: they span 0 … 1 × 0 … 1 × 0 … 1"),
        (&["--isovalues", "-100", "10"], "of the sweep -100 … 10 is beyond them"),
        (&["--grid", "5,5,5"], "5×5×5 points does not hold the volume's 9×9×9"),
    ] {
        let said = bake(args);
        assert!(said.contains(words), "{args:?}: {said}");
    }
    // As fine, finer by whole numbers, or with a lamp of its own far away: nothing to say.
    fs::write(dir.join("lamp.obj"), format!("mtllib m.mtl\n{}", square(5000.0, "lamp"))).unwrap();
    for args in [&["--grid", "2x"][..], &["--grid", "17,9,9"], &["--box", "lamp.obj", "--sides", "both"]] {
        let said = bake(args);
        assert!(!said.contains("warning"), "{args:?}: {said}");
    }
    fs::write(dir.join("wall.obj"), format!("mtllib m.mtl\n{}", square(5000.0, "wall"))).unwrap();
    fs::write(
        dir.join("far.toml"),
        "isovalues = [5, 15]\n[volume]\nfile = \"v.vti\"\n[[context]]\nfile = \"wall.obj\"\n[surface]\nalbedo = \
         [{ isovalue = 30, colour = 0.2 }, { isovalue = 40, colour = 0.3 }]\n",
    )
    .unwrap();
    let far = text(&ok(dir, &[&["bake", "far.toml", "-o", "o.vti"], &QUICK[..]].concat()).stderr);
    assert!(far.contains("times the volume's size away") && far.contains("on one side of the sweep"), "{far}");
    let entry =
        |name: &str, file: &str| format!("[[volume]]\nname = \"{name}\"\nfile = \"{file}\"\nisovalues = [5, 15]\n");
    let held = entry("b", "ras.vti").replace("isovalues = [5, 15]", "held = 10");
    for (second, output) in [(entry("b", "ras.vti"), "o.vtm"), (held, "o.vti")] {
        fs::write(dir.join("both.toml"), entry("a", "v.vti") + &second).unwrap();
        let both = text(&ok(dir, &[&["bake", "both.toml", "-o", output], &QUICK[..]].concat()).stderr);
        assert!(both.contains("left-posterior-superior") && both.contains("right-anterior-superior"), "{both}");
    }
}
