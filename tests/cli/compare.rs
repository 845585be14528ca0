//! `compare`: what it takes for a reference of a bake, what it finds without, and what it writes.

use super::{Folder, QUICK, isolume, ok, refused, text};
use glam::DVec3;
use isolume::accuracy::{Shown, SurveySettings};
use isolume::embree::{Device, GraphTracer};
use isolume::export::bake_file::BakedVolume;
use isolume::export::ply::{self, PlyMesh};
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;
use std::path::Path;

const RANGE: [&str; 3] = ["--isovalues", "3.6", "95"];

/// h = 60 |x − (½, ½, ½)| on a cube of this edge, where x runs over the unit cube.
fn cone(edge: f64) -> Volume {
    let lattice = Lattice::aligned([15; 3], DVec3::ZERO, DVec3::splat(edge / 14.0)).unwrap();
    let at = |o: usize| (lattice.point(o) / 14.0 - 0.5).length();
    let samples = (0..lattice.len()).map(|o| 60.0 * at(o) as f32).collect();
    Volume::new("cone", lattice, Samples::F32(samples)).unwrap()
}

fn bake(dir: &Path, input: &str, output: &str, more: &[&str]) {
    ok(dir, &[&["bake", input, "-o", output, "-q"], &QUICK[..], more].concat());
}

fn reference(dir: &Path, input: &str, output: &str, more: &[&str]) {
    let few = ["--samples", "4", "--batches", "2", "--vertices", "40", "-q"];
    ok(dir, &[&["reference", input, "-o", output], &few[..], more].concat());
}

/// Without the comment that says what it is of, as older versions and other programs write it.
fn unsigned(dir: &Path, from: &str, to: &str) {
    let bytes = fs::read(dir.join(from)).unwrap();
    let mark = b"comment isolume reference ";
    let start = bytes.windows(mark.len()).position(|w| w == mark).expect("the comment");
    let end = start + bytes[start..].iter().position(|b| *b == b'\n').unwrap() + 1;
    fs::write(dir.join(to), [&bytes[..start], &bytes[end..]].concat()).unwrap();
}

#[test]
fn references_of_other_volumes_and_isovalues_are_refused() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "15", "-o", "b.vti", "-q"]);
    cone(1.0).write(dir.join("cone.vti")).unwrap();
    cone(40.0).write(dir.join("large.vti")).unwrap();
    bake(dir, "b.vti", "lit.vti", &RANGE);
    bake(dir, "b.vti", "upper.vti", &["--isovalues", "40", "95"]);
    for (input, isovalue) in [("cone.vti", "22"), ("large.vti", "22"), ("b.vti", "20")] {
        let output = format!("r-{input}.ply");
        reference(dir, input, &output, &[&RANGE[..], &["--isovalue", isovalue]].concat());
        unsigned(dir, &output, &format!("u-{input}.ply"));
    }
    for signed in ["r", "u"] {
        let name = |input: &str| format!("{signed}-{input}.ply");
        let (cone, large, own) = (name("cone.vti"), name("large.vti"), name("b.vti"));
        refused(dir, &["compare", "lit.vti", &cone], &[&cone, "no isosurface of the bake's volume"]);
        refused(dir, &["compare", "lit.vti", &large], &[&large, "outside of the bake's volume"]);
        refused(dir, &["compare", "upper.vti", &own], &[&own, "isovalue 20, outside of the bake's sweep 40 … 95"]);
        refused(dir, &["compare", "lit.vti", &own, &cone], &[&cone, "no isosurface"]);
        ok(dir, &["compare", "lit.vti", &own]);
    }
    // The next moment: a third of what the samples of a cell differ by.
    let now = Volume::open(dir.join("b.vti")).unwrap();
    let later = Samples::F64((0..now.lattice.len()).map(|o| now.value(o) + 2.0).collect());
    Volume::new("later", now.lattice.clone(), later).unwrap().write(dir.join("later.vti")).unwrap();
    reference(dir, "later.vti", "later.ply", &[&RANGE[..], &["--isovalue", "20"]].concat());
    bake(dir, "b.vti", "fine.vti", &[&RANGE[..], &["--grid", "2x"]].concat());
    for bake in ["lit.vti", "fine.vti"] {
        refused(dir, &["compare", bake, "later.ply"], &["later.ply", "no isosurface of the bake's volume"]);
        ok(dir, &["compare", bake, "r-b.vti.ply"]);
    }
}

#[test]
fn bakes_of_any_grid_and_sweep_take_the_volumes_references() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "15", "-o", "b.vti", "-q"]);
    for isovalue in ["30", "90"] {
        reference(dir, "b.vti", "r.ply", &[&RANGE[..], &["--isovalue", isovalue, "--albedo", "0.4"]].concat());
        unsigned(dir, "r.ply", "u.ply");
        for grid in ["8,8,8", "2x", "17,16,15"] {
            // Its end is a reference's isovalue.
            let range = ["--isovalues", "10", "90", "--grid", grid, "--albedo", "0.4"];
            bake(dir, "b.vti", "lit.vti", &range);
            for file in ["r.ply", "u.ply"] {
                let said = text(&ok(dir, &["compare", "lit.vti", file]).stderr);
                assert_eq!(said, "", "{isovalue} {grid} {file}");
            }
        }
    }
}

#[test]
fn another_material_or_box_is_warned_of() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    bake(dir, "b.vti", "lit.vti", &RANGE);
    let at = |more: &[&str]| reference(dir, "b.vti", "r.ply", &[&RANGE[..], &["--isovalue", "47"], more].concat());
    for (more, warned) in
        [(&[][..], false), (&["--seed", "2"], false), (&["--albedo", "0.2"], true), (&["--margin", "0.2"], true)]
    {
        at(more);
        for quiet in ["--json", "-q"] {
            let said = text(&ok(dir, &["compare", "lit.vti", "r.ply", quiet]).stderr);
            assert_eq!(
                said.contains("warning: r.ply: was made of another material or box"),
                warned,
                "{more:?}: {said}"
            );
            assert_eq!(said.lines().count(), usize::from(warned), "{more:?}: {said}");
        }
    }
    // The same walls of another colour, and a brighter lamp.
    for (name, kd, ke) in [("one", "0.7", "1"), ("red", "0.7 0.1 0.1", "1"), ("bright", "0.7", "2")] {
        let material = format!("newmtl floor\nKd {kd}\nnewmtl lamp\nKd 0\nKe {ke}\n");
        fs::write(dir.join(format!("{name}.mtl")), material).unwrap();
        let quad = |z: f64, order: &str| format!("v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\nv 0 1 {z}\nf {order}\n");
        let (floor, lamp) = (quad(-0.1, "1 2 3 4"), quad(1.1, "8 7 6 5"));
        let room = format!("mtllib {name}.mtl\nusemtl floor\n{floor}usemtl lamp\n{lamp}");
        fs::write(dir.join(format!("{name}.obj")), room).unwrap();
    }
    bake(dir, "b.vti", "room.vti", &[&RANGE[..], &["--box", "one.obj"]].concat());
    for (room, warned) in [("one.obj", false), ("red.obj", true), ("bright.obj", true)] {
        at(&["--box", room]);
        let said = text(&ok(dir, &["compare", "room.vti", "r.ply"]).stderr);
        assert_eq!(said.contains("of another material or box than room.vti"), warned, "{room}: {said}");
    }
    at(&[]);
    let comments = ply::read(dir.join("r.ply")).unwrap().comments;
    let told = |what: &str| comments.iter().any(|comment| comment.starts_with(what));
    assert!(told("isolume reference isovalue=47.0 seed=1 samples=4 integrator=path light="), "{comments:?}");
    assert!(told("SPACE=LPS"), "{comments:?}");
    let output = isolume(dir, &["compare", "lit.vti", "b.vti"]);
    assert_eq!(output.status.code(), Some(2), "a volume is no reference");
    // The same numbers through another tracer.
    let again = |name: &str, more: &[&str]| {
        reference(dir, "b.vti", name, &[&RANGE[..], &["--isovalue", "47"], more].concat());
    };
    again("more.ply", &["--trilinear"]);
    refused(dir, &["compare", "lit.vti", "r.ply", "more.ply"], &["both references are of seed 1"]);
    again("two.ply", &["--seed", "2"]);
    ok(dir, &["compare", "lit.vti", "r.ply", "two.ply"]);
}

fn survey(dir: &Path, file: &str, more: &[&str]) -> serde_json::Value {
    serde_json::from_slice(&ok(dir, &[&["compare", file, "--json", "-q"], more].concat()).stdout).unwrap()
}

/// Without references: a preview is as far off whatever the number of paths, with the same bits on any number of
/// threads; and farther if some of its light is missing.
#[test]
fn all_isosurfaces_are_compared_with_paths() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "31", "-o", "b.vti", "-q"]);
    ok(dir, &[&["bake", "b.vti", "-o", "lit.vti", "--preset", "preview", "-q"], &RANGE[..]].concat());
    let number = |s: &serde_json::Value, name: &str| s[name].as_f64().unwrap();
    let few = ["--points", "6000", "--paths", "16"];
    let found = survey(dir, "lit.vti", &few);
    assert_eq!(found, survey(dir, "lit.vti", &[&few[..], &["--threads", "1"]].concat()));
    let other = survey(dir, "lit.vti", &[&few[..], &["--seed", "2"]].concat());
    assert_ne!(found, other);
    // However noisy paths are, that does not count.
    let fewest = survey(dir, "lit.vti", &["--points", "6000", "--paths", "8"]);
    for s in [&found, &other, &fewest] {
        let confidence = s["confidence"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect::<Vec<_>>();
        // 4.88 (4.64 to 5.11) by 60 000 points and 256 paths, 1.35 (1.21 to 1.48) at the grid's.
        assert!((confidence[0]..confidence[1]).contains(&4.88) && number(s, "percent_rms") < 6.0, "{s}");
        assert!((0.6..2.1).contains(&number(s, "percent_rms_grid_points")), "{s}");
        assert!(number(s, "bias").abs() < 1.0 && s["parts"].as_array().unwrap().len() == 5, "{s}");
    }
    // A tenth of the light is missing.
    let baked = BakedVolume::read(&dir.join("lit.vti")).unwrap();
    let (device, scene) = (Device::new(0).unwrap(), baked.source().unwrap().unwrap());
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mut grid = baked.sides[0].1.clone();
    grid.radiance.as_flattened_mut().iter_mut().for_each(|x| *x *= 0.9);
    let settings = SurveySettings { points: 6000, paths: 16, seed: 1 };
    let radiance = |p, _| grid.interpolate(baked.lattice(), p);
    let shown = Shown { grid: &grid, lattice: baked.lattice(), radiance: &radiance, exposure: baked.exposure };
    let dim = isolume::accuracy::survey(&scene, &tracer, shown, &settings, &|_| true).unwrap();
    let missing = number(&found, "bias") - dim.bias;
    assert!((1.0..8.0).contains(&missing) && dim.percent_rms > number(&found, "percent_rms") + 1.0, "{dim:?}");
    let said = text(&ok(dir, &["compare", "lit.vti", "-q"]).stdout);
    for words in ["percent RMS", "at grid points", "(58.44 … 76.72; ", "most of it lies between grid points"] {
        assert!(said.contains(words), "{said}");
    }
}

/// Paths see the volume's normals, not those of a grid twice as fine, as long as the file tells them.
#[test]
fn finer_grids_are_compared_on_the_volume_they_are_of() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let field = |file: &str| BakedVolume::read(&dir.join(file)).unwrap().source().unwrap();
    for (grid, own) in [("1x", true), ("3x", true), ("1x,3x,2x", true), ("12,12,12", false)] {
        bake(dir, "b.vti", "lit.vti", &[&RANGE[..], &["--grid", grid]].concat());
        let said = text(&ok(dir, &["compare", "lit.vti", "--points", "50", "--paths", "2"]).stderr);
        assert_eq!(said.contains("warning: lit.vti: its grid is not a whole number of times as fine"), !own, "{said}");
        let Some(scene) = field("lit.vti") else {
            assert!(!own, "{grid}");
            continue;
        };
        assert!(own && scene.lattice().dims() == [9; 3]);
        // Pictures and meshes see the same ones.
        let fine = BakedVolume::read(&dir.join("lit.vti")).unwrap().scene;
        let scale = fine.lattice().far() / scene.lattice().far();
        for n in 0..50 {
            let p = DVec3::splat(8.0) * (DVec3::new(0.37, 0.61, 0.83) * f64::from(n) + 0.1).fract();
            let [a, b] = [fine.normal(p * scale, fine.surface.outside), scene.normal(p, scene.surface.outside)];
            assert!((a.unwrap() - b.unwrap()).length() < 1e-4, "{grid} {p}: {a:?} {b:?}");
        }
        let volume = Volume::open(dir.join("b.vti")).unwrap();
        let exact = (0..volume.samples().len()).map(|o| scene.field.sweep().isovalue(volume.value(o)));
        assert!(scene.field.samples().iter().zip(exact).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}

/// Slices four voxels apart: without a grid of its own a bake warns of that, and cubes have a fraction of the error.
#[test]
fn cubic_grids_suit_long_voxels() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([21, 21, 6], DVec3::ZERO, DVec3::new(0.05, 0.05, 0.2)).unwrap();
    let bumps =
        |p: DVec3| [1.0, 2.0].map(|f| (3.0 * f * p.x + f).sin() * (4.0 * p.y).cos() + (8.0 * p.z / f).sin() + 1.0);
    let at = |o: usize| bumps(lattice.to_world(lattice.point(o))).iter().sum();
    let samples = Samples::F64((0..lattice.len()).map(at).collect());
    Volume::new("slices", lattice.clone(), samples).unwrap().write(dir.join("slices.nrrd")).unwrap();
    let bake = |grid: &[&str]| {
        let given =
            ["bake", "slices.nrrd", "--isovalues", "0.5", "4", "-o", "lit.vti", "--preset", "preview", "--json"];
        let output = ok(dir, &[&given[..], grid].concat());
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let warned = text(&output.stderr).contains("warning: voxels are 4.0 times as long as wide");
        let error = survey(dir, "lit.vti", &["--points", "1000", "--paths", "64"])["percent_rms"].as_f64().unwrap();
        let said = text(&ok(dir, &["compare", "lit.vti", "--points", "300", "--paths", "16"]).stdout);
        assert_eq!(
            said.contains("most of it lies between grid points: --grid cubic lowers it"),
            grid != ["--grid", "cubic"]
        );
        (report["settings"]["grid"].as_str().unwrap().to_owned(), warned, error)
    };
    let (grid, warned, long) = bake(&[]);
    assert!(warned && grid == "1x");
    let (grid, warned, own) = bake(&["--grid", "1x"]);
    assert!(!warned && grid == "1x" && own == long);
    let (grid, warned, cubic) = bake(&["--grid", "cubic"]);
    assert!(!warned && grid == "1x,1x,4x", "{grid}");
    assert_eq!(BakedVolume::read(&dir.join("lit.vti")).unwrap().lattice().dims(), [21, 21, 21]);
    assert!(cubic < 0.5 * long, "{long} {cubic}");

    // One grid is for all volumes of a scene.
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let scene = "[[volume]]\nname = \"a\"\nfile = \"slices.nrrd\"\nisovalues = [0.5, 4]\n\
                 [[volume]]\nname = \"b\"\nfile = \"b.vti\"\nisovalues = [3.6, 95]\n";
    fs::write(dir.join("two.toml"), scene).unwrap();
    let words = ["cubic", "1x,1x,4x of one volume and 1x of another"];
    refused(dir, &["bake", "two.toml", "--grid", "cubic", "-o", "two.vtm"], &words);
    let few = ["--engine", "photon", "--dry-run"];
    let said = text(&ok(dir, &[&["bake", "two.toml", "-o", "two.vtm"], &few[..]].concat()).stderr);
    assert!(!said.contains("cubic"), "no advice that is refused: {said}");
}

#[test]
fn several_volumes_are_compared_one_by_one_with_all_of_them_there() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let volume = |name: &str, origin: &str| {
        format!("[[volume]]\nname = \"{name}\"\nfile = \"b.vti\"\nisovalues = [3.6, 95.0]\norigin = {origin}\n")
    };
    let two = volume("left", "[0.0, 0.0, 0.0]") + &volume("right", "[1.5, 0.0, 0.0]");
    fs::write(dir.join("two.toml"), two).unwrap();
    bake(dir, "two.toml", "two.vtm", &["--engine", "photon"]);
    let few = ["--points", "100", "--paths", "4"];
    let [first, left, right] =
        [&[][..], &["--field", "left"], &["--field", "right"]].map(|f| survey(dir, "two.vtm", &[&few[..], f].concat()));
    assert!(first == left && left != right, "{left} {right}");
    refused(dir, &["compare", "two-left.vti"], &["two-left.vti", "name the .vtm"]);
    refused(dir, &["compare", "two.vtm", "--field", "middle"], &["two.vtm", "left", "right"]);
    // A bake that was killed while its files took their names leaves a mixture with the one before.
    bake(dir, "two.toml", "other.vtm", &["--engine", "photon", "--seed", "2"]);
    fs::copy(dir.join("other-right.vti"), dir.join("two-right.vti")).unwrap();
    refused(dir, &["compare", "two.vtm"], &["two.vtm", "of different bakes"]);
}

/// Errors are measured in the colours of the bake. Its exposure is that of the brighter volume, too, which path tracing
/// the other one does not need.
#[test]
fn volumes_that_see_nothing_of_each_other_are_compared_in_the_colours_of_both() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let volume = |name: &str, albedo: f64| {
        format!("[[volume]]\nname = \"{name}\"\nfile = \"b.vti\"\nisovalues = [3.6, 95.0]\nalbedo = {albedo}\n")
    };
    fs::write(dir.join("two.toml"), "policy = \"independent\"\n".to_owned() + &volume("a", 0.9) + &volume("b", 0.3))
        .unwrap();
    fs::write(dir.join("one.toml"), volume("b", 0.3)).unwrap();
    bake(dir, "two.toml", "two.vtm", &["--engine", "photon"]);
    bake(dir, "one.toml", "one.vti", &["--engine", "photon"]);
    let exposure = |file: &str| BakedVolume::read(&dir.join(file)).unwrap().exposure;
    let brighter = exposure("one.vti") / exposure("two.vtm");
    assert!((brighter - 3.0).abs() < 1e-6, "{brighter}");
    let few = ["--points", "1000", "--paths", "32"];
    let [of_two, alone] = [["two.vtm", "b"], ["one.vti", "b"]].map(|[file, field]| {
        survey(dir, file, &[&few[..], &["--field", field]].concat())["percent_rms"].as_f64().unwrap()
    });
    // Less than three times as much: colours end at white.
    assert!((2.0..3.3).contains(&(alone / of_two)), "{alone} {of_two}");
}

#[test]
fn what_is_for_the_other_way_to_compare_is_refused() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    bake(dir, "b.vti", "lit.vti", &RANGE);
    reference(dir, "lit.vti", "r.ply", &["--isovalue", "47"]);
    for wrong in [
        &["compare", "lit.vti", "-o", "e.ply"][..],
        &["compare", "lit.vti", "r.ply", "--points", "9"],
        &["compare", "lit.vti", "r.ply", "--paths", "9"],
        &["compare", "lit.vti", "r.ply", "--field", "x"],
    ] {
        let output = isolume(dir, wrong);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
    }
    for wrong in [["--points", "0"], ["--paths", "0"], ["--exposure", "0"], ["--exposure", "inf"]] {
        refused(dir, &["compare", "lit.vti", wrong[0], wrong[1]], &[wrong[0]]);
    }
    refused(dir, &["compare", "b.vti"], &["b.vti", "is no bake"]);
}

/// Surfaces that shine brighter than what is displayed show no error, however wrong they are.
#[test]
fn what_is_too_bright_to_show_an_error_is_told() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    let few = ["--points", "100", "--paths", "4"];
    for (emission, shines) in [("0", false), ("9", true)] {
        bake(dir, "b.vti", "lit.vti", &[&RANGE[..], &["--emission", emission]].concat());
        reference(dir, "lit.vti", "r.ply", &["--isovalue", "47"]);
        let clamped = survey(dir, "lit.vti", &few)["clamped"].as_f64().unwrap();
        assert!(if shines { clamped == 1.0 } else { (0.0..0.2).contains(&clamped) }, "{clamped}");
        for arguments in [&["r.ply"][..], &few] {
            let said = text(&ok(dir, &[&["compare", "lit.vti"], arguments].concat()).stderr);
            let warned = said.contains("warning: 100 % of the ") && said.contains("error counts as 0");
            assert_eq!(warned, shines, "{emission} {arguments:?}: {said}");
            let darker = [&["compare", "lit.vti", "--exposure", "0.01"], arguments].concat();
            assert!(!text(&ok(dir, &darker).stderr).contains("error counts as 0"));
        }
    }
}

/// `error` and colour of every vertex of `compare -o`, from the two files that were compared.
#[test]
fn the_mesh_of_errors_holds_them() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    bake(dir, "b.vti", "lit.vti", &RANGE);
    reference(dir, "lit.vti", "r.ply", &["--isovalue", "47"]);
    ok(dir, &["extract", "lit.vti", "--isovalue", "47", "-o", "t.ply", "-q"]);
    let said = text(&ok(dir, &["compare", "lit.vti", "t.ply"]).stderr);
    assert!(said.contains("warning: t.ply: holds the light of a bake"), "{said}");
    let said = text(&ok(dir, &["compare", "lit.vti", "r.ply", "-o", "e.ply", "-q"]).stderr);
    assert_eq!(said, "");
    let exposure = BakedVolume::read(&dir.join("lit.vti")).unwrap().exposure;
    let [t, r, e] = ["t.ply", "r.ply", "e.ply"].map(|f| ply::read(dir.join(f)).unwrap());
    let shown = |m: &PlyMesh| -> Vec<DVec3> {
        let radiance = m.triple(["radiance_r", "radiance_g", "radiance_b"]).unwrap();
        radiance.into_iter().map(|c| (DVec3::from(c) * exposure).clamp(DVec3::ZERO, DVec3::ONE)).collect()
    };
    let bytes = e.triple(["red", "green", "blue"]).unwrap();
    let (mut sampled, mut most) = (0, 0.0f64);
    for (v, (t, r)) in shown(&t).into_iter().zip(shown(&r)).enumerate() {
        let error = e.property("error").unwrap()[v];
        if was_compared(&e, v, &bytes) {
            sampled += 1;
            most = most.max(error);
            assert!((error - (t - r).length()).abs() < 1e-5, "vertex {v}: {error} {t} {r}");
            let ramp = [0.0, 1.0, 2.0].map(|k| 255.0 * (30.0 * error - k).clamp(0.0, 1.0));
            assert!((0..3).all(|c| (bytes[v][c] - ramp[c]).abs() < 0.51), "{error} {:?}", bytes[v]);
        }
    }
    assert_eq!(sampled, r.property("sampled").unwrap().iter().filter(|s| **s > 0.0).count());
    assert!(sampled == 40 && most > 0.01, "{sampled} {most}");
}

/// Whether a vertex of a mesh of errors was compared: those that were not are grey and have no error.
fn was_compared(mesh: &PlyMesh, v: usize, bytes: &[[f64; 3]]) -> bool {
    let grey = bytes[v] == [96.0; 3];
    assert!(!grey || mesh.property("error").unwrap()[v] == 0.0);
    !grey
}
