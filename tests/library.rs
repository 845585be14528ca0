//! What programs that use the library rely on.

use glam::DVec3;
use isolume::bake::{Bake, BakeOptions, BakeSettings, Engine, Preset, bake};
use isolume::embree::{Device, GraphTracer, pyramids};
use isolume::error::{Error, Result};
use isolume::export::bake_file::BakedVolume;
use isolume::field::{Field, Sweep};
use isolume::flattened::Side;
use isolume::isosurface;
use isolume::progress::{Observer, Progress};
use isolume::reference::{Integrator, ReferenceSettings, reference};
use isolume::render::{Camera, Shading, render};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::scene_file::{self, SceneOptions};
use isolume::surface_mesh::SurfaceMesh;
use isolume::volume::{Lattice, Samples, Volume};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// Balls h = distance from the middle of the unit cube, in `n`³ samples, and the default box.
fn scene(n: usize) -> Scene {
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).unwrap();
    let at = |i: usize| lattice.to_world(lattice.point(i));
    let samples = (0..lattice.len()).map(|i| at(i).distance(DVec3::splat(0.5)) as f32).collect();
    let volume = Volume::new("balls", lattice.clone(), Samples::F32(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(0.2, 0.4).unwrap()).unwrap();
    let walls = cornell_box(field.lattice(), 0.1).unwrap();
    Scene::new(field, Surface { outside: Side::Higher, ..Surface::default() }, Boundary::Open, walls).unwrap()
}

fn settings(scene: &Scene, engine: Engine) -> BakeSettings {
    let options = BakeOptions {
        engine: Some(engine),
        preset: Some(Preset::Preview),
        photons: (engine == Engine::Photon).then_some(10_000),
        ..BakeOptions::default()
    };
    BakeSettings::new(&options, scene).unwrap()
}

fn quietly(scene: &Scene, settings: &BakeSettings) -> Result<Bake> {
    bake(scene, settings, &Device::new(1).unwrap(), Progress::Quiet)
}

/// Ends the work when so many units are done, if any.
#[derive(Default)]
struct Watcher {
    stages: Mutex<Vec<(String, u64)>>,
    ended: Mutex<Vec<String>>,
    done: AtomicU64,
    most: Option<u64>,
    stopped: AtomicBool,
}

impl Observer for Watcher {
    fn begins(&self, stage: &str, total: u64) {
        self.stages.lock().unwrap().push((stage.into(), total));
    }

    fn advances(&self, _: &str, units: u64) {
        self.done.fetch_add(units, Relaxed);
    }

    fn ends(&self, stage: &str, seconds: f64) {
        assert!(seconds >= 0.0);
        self.ended.lock().unwrap().push(stage.into());
    }

    fn stops(&self) -> bool {
        let stops = self.most.is_some_and(|most| self.done.load(Relaxed) > most);
        self.stopped.fetch_or(stops, Relaxed);
        stops
    }
}

#[test]
fn an_observer_sees_one_bake_and_ends_it_alone() {
    let scene = scene(17);
    let device = Device::new(1).unwrap();
    for engine in [Engine::Sweep, Engine::Photon] {
        let settings = settings(&scene, engine);
        let whole = Watcher::default();
        bake(&scene, &settings, &device, Progress::Watched(&whole)).unwrap();
        let (stages, ended) = (whole.stages.into_inner().unwrap(), whole.ended.into_inner().unwrap());
        let done = whole.done.into_inner();
        println!("{engine:?}: {stages:?}, {ended:?}, {done} units");
        assert!(!stages.is_empty() && stages.iter().all(|(name, _)| ended.contains(name)));
        assert!(done > 0 && done <= stages.iter().map(|s| s.1).sum::<u64>());

        let impatient = Watcher { most: Some(done / 4), ..Watcher::default() };
        let found = bake(&scene, &settings, &device, Progress::Watched(&impatient));
        assert!(matches!(found, Err(Error::Interrupted)), "{engine:?}");
        assert!(impatient.stopped.into_inner());
        // Others go on.
        assert!(bake(&scene, &settings, &device, Progress::Quiet).is_ok());
    }
}

#[test]
fn what_was_changed_is_checked_again() {
    let refused = |what: &str, found: Result<Bake>| {
        let error = found.expect_err(what).to_string();
        assert!(error.contains(what), "{what}: {error}");
    };
    let good = scene(9);
    let usual = settings(&good, Engine::Sweep);
    refused("directions 7", quietly(&good, &BakeSettings { directions: 7, ..usual.clone() }));
    refused("tau NaN", quietly(&good, &BakeSettings { tau: f64::NAN, ..usual.clone() }));
    refused("wall_isovalues 0", quietly(&good, &BakeSettings { wall_isovalues: 0, ..usual.clone() }));
    let mut bright = good.clone();
    bright.surface.albedo = DVec3::splat(3.0).into();
    refused("surface albedo", quietly(&bright, &usual));

    let lamp = good.luminaires()[0].clone();
    let with = |polygon| Scene::new(good.field.clone(), Surface::default(), Boundary::Open, vec![polygon]);
    for emission in [DVec3::NAN, DVec3::NEG_ONE] {
        let mut polygon = lamp.clone();
        polygon.emission = emission;
        assert!(matches!(with(polygon), Err(Error::Invalid(_))), "{emission}");
    }
    let mut polygon = lamp.clone();
    polygon.albedo = DVec3::splat(1.5);
    assert!(matches!(with(polygon), Err(Error::Invalid(_))));
    // What shines hides what is behind it, and what no longer does does not.
    let mut wall = good.polygons().last().unwrap().clone();
    wall.emission = DVec3::ONE;
    assert!(with(wall).unwrap().luminaires()[0].opaque_back);
    let mut dark = lamp;
    dark.emission = DVec3::ZERO;
    assert!(!with(dark).unwrap().polygons()[0].opaque_back);
}

/// On a grid of its own a bake is as bright as on the volume's, whatever lattice the scene has.
#[test]
fn light_is_found_by_places_of_the_world() {
    let scene = scene(13);
    let usual = settings(&scene, Engine::Sweep);
    let fine = BakeSettings { grid: "2x".parse().unwrap(), ..usual.clone() };
    let [own, fine] = [usual, fine].map(|s| BakedVolume::new(scene.clone(), quietly(&scene, &s).unwrap()));
    let above = DVec3::new(0.5, 0.5, 0.8);
    let [own_light, fine_light] = [&own, &fine].map(|baked| baked.radiance_at(Side::Higher, above).unwrap().y);
    assert!(own_light > 0.05 && (own_light / fine_light - 1.0).abs() < 0.2, "{own_light}, {fine_light}");
    for nowhere in [DVec3::splat(1e6), DVec3::splat(-0.1), DVec3::NAN, DVec3::splat(0.5)] {
        assert_eq!(own.radiance_at(Side::Higher, nowhere), None, "{nowhere}");
    }
    assert_eq!(own.radiance_at(Side::Lower, above), None);
}

#[test]
fn what_is_stopped_or_does_not_fit_is_no_result() {
    let scene = scene(9);
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mesh = isosurface::extract(scene.lattice().dims(), scene.field.samples(), 0.5).unwrap();
    let mesh = SurfaceMesh::new(&scene, mesh).unwrap();
    for integrator in [Integrator::Path, Integrator::Photon] {
        let settings = ReferenceSettings { integrator, photons: 1000, samples: 4, ..ReferenceSettings::default() };
        let found = reference(&scene, &tracer, &mesh, 0.5, &settings, &|_| false);
        assert!(matches!(found, Err(Error::Interrupted)));
    }
    let other = self::scene(11);
    for pyramids in [pyramids(&other), Vec::new()] {
        assert!(matches!(GraphTracer::with_pyramids(&device, &scene, &pyramids), Err(Error::Invalid(_))));
    }
    let camera = Camera { samples: 0, ..Camera::facing(&scene, 8) };
    let picture = render(&scene, 0.3, &camera, Shading::Local(1.0), &device, Progress::Quiet);
    assert!(matches!(picture, Err(Error::Invalid(_))));
}

/// Whoever asked for it, what failed is known by its kind.
#[test]
fn errors_of_scene_files_keep_their_kind() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    let found = |text: &str| {
        std::fs::write(&path, text).unwrap();
        scene_file::load(&path, &SceneOptions::default()).unwrap_err()
    };
    for text in ["[volume]\nfile = \"none.vti\"\n", "[[volume]]\nfile = \"none.vti\"\nisovalues = [0.0, 1.0]\n"] {
        let error = found(text);
        let Error::At { place, source } = &error else { panic!("{error:?}") };
        assert!(place.contains("scene.toml:") && matches!(**source, Error::Io { .. }), "{error:?}");
        assert_eq!(error.exit_code(), 2);
    }
    std::fs::write(folder.path().join("page.vti"), "<VTKFile type=\"PolyData\"/>").unwrap();
    let error = found("[volume]\nfile = \"page.vti\"\n");
    assert!(matches!(&error, Error::NotSupported(m) if m.contains("scene.toml:2: file: ")), "{error:?}");
    let error = found("[volume]\ngenerator = \"none\"\n");
    assert!(matches!(&error, Error::Invalid(m) if m.contains("scene.toml:2: generator: ")), "{error:?}");
}

/// Walls in the faces that caps close, on either side, and voxels of which a side is too long.
#[test]
fn what_cannot_stand_together_is_refused() {
    let good = scene(9);
    let walls = cornell_box(good.lattice(), 0.0).unwrap();
    let mut faces = 0;
    for wall in walls.into_iter().filter(|wall| wall.emission == DVec3::ZERO) {
        let with = |boundary| Scene::new(good.field.clone(), Surface::default(), boundary, vec![wall.clone()]);
        assert!(with(Boundary::Open).is_ok(), "{}", wall.name);
        assert!(matches!(with(Boundary::Capped), Err(Error::Invalid(_))), "{}", wall.name);
        faces += 1;
    }
    assert_eq!(faces, 5);
    for long in [DVec3::new(1e17, 1.0, 1.0), DVec3::new(1.0, 1.0, 1e17), DVec3::new(1.0, 1e-17, 1.0)] {
        let lattice = Lattice::aligned([3; 3], DVec3::ZERO, long).unwrap();
        let volume = Volume::new("x", lattice, Samples::F32((0..27).map(|o| o as f32).collect())).unwrap();
        let field = Field::new(&volume, Sweep::new(2.0, 20.0).unwrap()).unwrap();
        let found = Scene::new(field, Surface::default(), Boundary::Open, Vec::new());
        assert!(matches!(found, Err(Error::Invalid(_))), "{long}");
    }
}

/// A sweep holds its ends.
#[test]
fn the_ends_of_a_sweep_are_drawn_and_extracted() {
    let scene = scene(13);
    let device = Device::new(1).unwrap();
    let camera = Camera { samples: 1, ..Camera::facing(&scene, 8) };
    for isovalue in [0.2, 0.4] {
        render(&scene, isovalue, &camera, Shading::Local(1.0), &device, Progress::Quiet).unwrap();
        let unit = scene.field.sweep().isovalue(isovalue);
        let mesh = isosurface::extract(scene.lattice().dims(), scene.field.samples(), unit).unwrap();
        assert!(!SurfaceMesh::new(&scene, mesh).unwrap().triangles.is_empty());
    }
    for outside in [0.199, 0.401] {
        let drawn = render(&scene, outside, &camera, Shading::Local(1.0), &device, Progress::Quiet);
        assert!(matches!(drawn, Err(Error::Invalid(_))), "{outside}");
    }
}
