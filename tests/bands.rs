//! Bakes cut into bands of isovalues: the same light to the bit, in the memory that is allowed.

use isolume::bake::{Bake, BakeOptions, BakeSettings, StrategyName, bake_fields};
use isolume::embree::Device;
use isolume::field::{Field, Sweep};
use isolume::flat::FlatLight;
use isolume::illumination_grid::GridSize;
use isolume::progress::Progress;
use isolume::scene::{Boundary, Member, Policy, Scene, Surface, cornell_box};
use isolume::volume::generate::Generator;
use isolume::volume::{Lattice, Samples, Volume};
use std::process::Command;

/// The bumps; or a ball whose edge is one step from below to above the sweep, with a slow slope through it on its
/// sides.
fn field(steep: bool, size: usize) -> Field {
    if !steep {
        let volume = Generator::from_name("bumps").unwrap().sample([size; 3]).unwrap();
        return Field::new(&volume, Sweep::new(3.6, 95.0).unwrap()).unwrap();
    }
    let lattice = Lattice::aligned([size; 3], glam::DVec3::ZERO, glam::DVec3::splat(1.0 / (size - 1) as f64)).unwrap();
    let value = |o: usize| {
        let p = lattice.to_world(lattice.point(o));
        let slope = 40.0 + 20.0 * (7.0 * p.x).sin() * (5.0 * p.y).cos();
        let inside = (p - glam::DVec3::new(0.5, 0.45, 0.4)).length() < 0.3;
        (if inside { 500.0 } else { slope * p.z }) as f32
    };
    let samples = (0..lattice.len()).map(value).collect();
    let volume = Volume::new("steep", lattice, Samples::F32(samples)).unwrap();
    Field::new(&volume, Sweep::new(5.0, 100.0).unwrap()).unwrap()
}

fn scene(steep: bool, size: usize, both_sides: bool) -> Scene {
    let field = field(steep, size);
    let walls = cornell_box(field.lattice(), 0.0).unwrap();
    let surface = Surface { both_sides, ..Surface::default() };
    Scene::new(field, surface, Boundary::Open, walls).unwrap()
}

fn options() -> BakeOptions {
    BakeOptions {
        photons: Some(20_000),
        gather_rays: Some(8),
        shadow_rays: Some(16),
        wall_resolution: Some(8),
        ..BakeOptions::default()
    }
}

/// Every bit of light and every count; and the bands there were.
fn light(bakes: &[Bake]) -> (Vec<u64>, usize) {
    let mut bits = Vec::new();
    for bake in bakes {
        for (_, grid) in &bake.sides {
            bits.extend(grid.radiance.as_flattened().iter().map(|x| u64::from(x.to_bits())));
            bits.extend(grid.std_error.iter().map(|x| u64::from(x.to_bits())));
            bits.extend(grid.mask.iter().map(|&m| m as u64));
        }
        bits.extend(
            bake.flats
                .iter()
                .flatten()
                .flat_map(FlatLight::textures)
                .flat_map(|f| f.texels.as_flattened())
                .map(|x| u64::from(x.to_bits())),
        );
        let r = &bake.report;
        bits.extend([r.rays, r.samples, r.misses, r.filled, r.masked, r.samples_without_gradient, r.photons.stored]);
    }
    (bits, bakes[0].report.bands)
}

fn same_in_bands(name: &str, scene: &Scene, options: &BakeOptions) {
    let device = Device::new(1).unwrap();
    let baked = |bands: usize| {
        let settings = BakeSettings::new(&BakeOptions { bands: Some(bands), ..options.clone() }, scene).unwrap();
        let bakes = bake_fields(scene, &settings, &device, Progress::Quiet, None).unwrap();
        assert!(bakes.iter().all(|b| b.report.misses == 0), "{name}: every ray lands where the cache holds something");
        light(&bakes)
    };
    let (whole, one) = baked(1);
    assert_eq!(one, 1);
    assert!(whole.iter().filter(|&&b| b != 0).count() > 1000, "{name}: there is light");
    for bands in [2, 7, 100] {
        let (cut, count) = baked(bands);
        assert!(count > bands / 3 && count <= bands, "{name}: {count} bands");
        let apart = whole.iter().zip(&cut).filter(|(a, b)| a != b).count();
        assert!(apart == 0 && whole.len() == cut.len(), "{name}, {bands} bands: {apart} of {} differ", whole.len());
    }
}

#[test]
fn light_and_counts_do_not_depend_on_the_bands() {
    same_in_bands("bumps", &scene(false, 25, true), &options());
    same_in_bands("steep", &scene(true, 25, true), &options());
    let finer = BakeOptions { grid: Some(GridSize::Factors([2; 3])), ..options() };
    same_in_bands("a finer grid", &scene(true, 13, false), &finer);
}

#[test]
fn nor_do_other_ways_of_sampling() {
    let scene = scene(true, 21, false);
    same_in_bands("straight from the map", &scene, &BakeOptions { gather_rays: Some(0), ..options() });
    same_in_bands("not smoothed", &scene, &BakeOptions { smoothing: Some(false), ..options() });
    let scattered = BakeOptions { samples: Some(5000), strategy: Some(StrategyName::Uniform), ..options() };
    same_in_bands("scattered", &scene, &scattered);
}

#[test]
fn nor_do_several_fields() {
    let members = [false, true].map(|steep| Member {
        name: if steep { "steep" } else { "bumps" }.into(),
        field: field(steep, 19).into(),
        surface: Surface::default(),
        boundary: Boundary::Open,
    });
    let walls = cornell_box(members[0].field.lattice(), 0.0).unwrap();
    for policy in [Policy::Joint, Policy::Independent] {
        let scene = Scene::with_members(members.to_vec(), policy, walls.clone()).unwrap();
        same_in_bands(&format!("{policy:?}"), &scene, &options());
    }
}

#[test]
fn memory_that_is_allowed_decides_the_bands() {
    let dir = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_isolume"));
        let output = command.current_dir(dir.path()).args(args).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    assert_eq!(run(&["generate", "bumps", "--size", "145", "-o", "b.vti", "-q"]).0, Some(0));
    // Surfaces everywhere, so that the cache is large beside what every band shares.
    let all = ["bake", "b.vti", "-o", "o.vti", "--isovalues", "-20", "120", "--smoothing", "false"];
    let few = ["--wall-resolution", "8", "--photons", "2000", "--gather", "2", "--shadow-rays", "1"];
    let bake = |more: &[&str]| run(&[&all[..], &few, more].concat());
    let about = |text: &str| -> f64 {
        text.split("about ").nth(1).unwrap().split_whitespace().next().unwrap().parse().unwrap()
    };
    // What the estimate says of one band and of many.
    let estimate = |bands: &str| {
        let (code, text) = bake(&["--dry-run", "--bands", bands]);
        assert_eq!(code, Some(0), "{text}");
        about(&text)
    };
    let (one, many) = (estimate("1"), estimate("64"));
    assert!(many < 0.9 * one, "{one} {many}");
    let limit = format!("{}", (0.5 * (one + many) * 1e6) as u64);
    let (code, text) = bake(&["--max-memory", &limit, "--report", "r.json"]);
    assert_eq!(code, Some(0), "{text}");
    let report: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(dir.path().join("r.json")).unwrap()).unwrap();
    let bands = report["bands"].as_u64().unwrap();
    assert!((2..64).contains(&bands) && report["settings"]["bands"] == bands, "{report}");
    assert!(text.contains(&format!("band {bands} of {bands}")) && text.contains("of isovalues"), "{text}");
    // One less would be too much.
    assert!(estimate(&(bands - 1).to_string()) * 1e6 > limit.parse::<f64>().unwrap() - 1e6);
    // Bands by hand, and an estimate that fits, are left alone.
    let (_, text) = bake(&["--max-memory", "64G", "--dry-run"]);
    assert!(!text.contains("bands"), "{text}");
    let (_, text) = bake(&["--max-memory", "64G", "--dry-run", "--bands", "3"]);
    assert!(text.contains("3 of isovalues"), "{text}");
    // What fits in no number of bands is refused in one line, before the work.
    let (code, text) = bake(&["--max-memory", "30M", "-q"]);
    assert_eq!((code, text.lines().count()), (Some(2), 1), "{text}");
    assert!(text.contains("--max-memory") && text.contains("cut into") && text.contains("at its peak"), "{text}");
    for (args, word) in [(["--bands", "0"], "1 to 256"), (["--bands", "257"], "1 to 256")] {
        let (code, text) = bake(&args);
        assert!(code == Some(2) && text.contains(word), "{text}");
    }
    let (code, text) = bake(&["--engine", "sweep", "--bands", "2"]);
    assert!(code == Some(2) && text.contains("bands") && text.lines().count() == 1, "{text}");

    // Sweeps know no bands: too large for the memory, they leave the work to photons, unless they were asked for. Of a
    // smaller volume, one side of which is wanted, they need less than photons in any number of bands.
    assert_eq!(run(&["generate", "bumps", "--size", "200", "-o", "l.vti", "-q"]).0, Some(0));
    let dry = |volume: &str, more: &[&str]| {
        let bake = ["bake", volume, "-o", "o.vti", "--isovalues", "3.6", "95", "--preset", "preview", "--dry-run"];
        run(&[&bake, more].concat())
    };
    let both = |more: &[&str]| dry("l.vti", &[&["--sides", "both"], more].concat());
    let engines = [&["--engine", "sweep"][..], &["--engine", "photon", "--bands", "64"]];
    let [sweep, photon] = engines.map(|engine| about(&both(engine).1));
    assert!(photon < sweep, "{sweep} {photon}");
    let limit = format!("{}", ((0.1 * sweep + 0.9 * photon) * 1e6) as u64);
    let (code, text) = both(&["--max-memory", &limit]);
    assert!(code == Some(0) && text.contains("engine  photon") && text.contains("of isovalues"), "{text}");
    let (code, text) = both(&["--max-memory", "64G"]);
    assert!(code == Some(0) && text.contains("engine  sweep"), "{text}");
    assert_eq!(both(&["--max-memory", &limit, "--engine", "sweep"]).0, Some(2));
    let [sweep, photon] = engines.map(|engine| about(&dry("b.vti", engine).1));
    assert!(sweep < photon, "{sweep} {photon}");
}
