//! Each long stage on one thread and on two, interleaved: wall seconds at the quietest of several turns, and CPU
//! seconds, which other work on the machine hardly changes. Two threads that share a stage well need half the wall
//! seconds; if they need more CPU seconds than one, they get into each other's way. With `growth SIZE…` instead: CPU
//! seconds of the stages of a bake against the size of the lattice, and the exponents between sizes.

use glam::Vec3;
use isolume::bake::{BakeOptions, BakeSettings, Engine, Preset, bake};
use isolume::embree::{Device, GraphTracer, SurfaceTracer};
use isolume::export::bake_file;
use isolume::field::{Field, Sweep};
use isolume::fitted_grid::{FitSample, GridFit};
use isolume::flattened::Side;
use isolume::illumination_grid::shepard;
use isolume::isovalue_axis::IsovalueAxis;
use isolume::mask::{Mask, masks};
use isolume::node_set::NodeSet;
use isolume::photon::{PhotonSettings, trace_photons};
use isolume::photon_map::EstimateSettings;
use isolume::progress::{Clock, Progress};
use isolume::radiance::{Indirect, RadianceSample, Sampler};
use isolume::radiance_cache::{CacheSettings, NodeBand, NodePhotons, RadianceCache};
use isolume::reference::{Integrator, ReferenceSettings, reference};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::smoothing::{Smoothing, smooth};
use isolume::surface_mesh::{SurfaceMesh, unit_isovalue};
use isolume::sweep::{SweepSettings, sweep};
use isolume::volume::Volume;
use isolume::volume::generate::Generator;
use std::hint::black_box;

const SIZE: usize = 101;
const TURNS: usize = 5;

/// A stage.
type Work<'a> = Box<dyn Fn() + Sync + 'a>;

/// Least wall seconds and mean CPU seconds of a stage on one and on two threads.
fn measure(pools: &[rayon::ThreadPool; 2], work: &(dyn Fn() + Sync)) -> [[f64; 2]; 2] {
    let mut found = [[f64::INFINITY, 0.0]; 2];
    // The first turn finds caches and memory cold.
    pools.iter().for_each(|pool| pool.install(work));
    for _ in 0..TURNS {
        for (pool, found) in pools.iter().zip(&mut found) {
            let clock = Clock::start();
            pool.install(work);
            let [wall, cpu] = clock.seconds();
            *found = [found[0].min(wall), found[1] + cpu / TURNS as f64];
        }
    }
    found
}

/// CPU seconds of a bake's stages at several sizes, few rays each.
fn growth(sizes: &[usize]) {
    let device = Device::new(1).expect("Embree starts");
    let few = BakeOptions {
        preset: Some(Preset::Preview),
        gather_rays: Some(4),
        shadow_rays: Some(4),
        ..BakeOptions::default()
    };
    let settings = BakeSettings::with_engine(&few, Engine::Photon).expect("settings");
    let mut before: Option<(usize, [f64; 4])> = None;
    println!(
        "bumps, preview with 4 gather and 4 shadow rays; CPU seconds, exponent of the points since the size before"
    );
    println!("  {:>5} {:>16} {:>16} {:>16} {:>16}", "size", "photons", "cache", "samples", "interpolate");
    for &size in sizes {
        let scene = bumps(&Generator::from_name("bumps").and_then(|g| g.sample([size; 3])).expect("a volume"));
        let report = bake(&scene, &settings, &device, Progress::Quiet).expect("a bake").report;
        let s = report.processor_seconds;
        let now = [s.photons, s.cache, s.samples, s.interpolate];
        print!("  {size:5}");
        for n in 0..4 {
            let exponent =
                before.map(|(small, old)| (now[n] / old[n]).ln() / (3.0 * (size as f64 / small as f64).ln()));
            print!(" {:9.2} {:6}", now[n], exponent.map_or(String::new(), |e| format!("{e:.2}")));
        }
        println!();
        before = Some((size, now));
    }
}

fn bumps(volume: &Volume) -> Scene {
    let field = Field::new(volume, Sweep::new(3.6, 95.0).expect("a sweep")).expect("a field");
    let walls = cornell_box(field.lattice(), 0.0).expect("a box");
    Scene::new(field, Surface::default(), Boundary::Open, walls).expect("a scene")
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    if words.first().is_some_and(|w| w == "growth") {
        let sizes: Vec<usize> = words[1..].iter().map(|w| w.parse().expect("a size")).collect();
        return growth(if sizes.is_empty() { &[64, 128, 256] } else { &sizes });
    }
    let only = words.first();
    let volume = Generator::from_name("bumps").and_then(|g| g.sample([SIZE; 3])).expect("a volume");
    let scene = bumps(&volume);
    let device = Device::new(1).expect("Embree starts");
    let tracer = GraphTracer::new(&device, &scene).expect("a tracer");
    let lattice = scene.lattice();

    let photon_settings = PhotonSettings {
        count: 1 << 20,
        max_bounces: u16::MAX,
        seed: 1,
        axis: IsovalueAxis::EVEN,
        fixed_isovalue: None,
    };
    let photons = trace_photons(&scene, &tracer, &photon_settings, &|_| true);
    let cache_settings = CacheSettings {
        node_shadow_rays: 4,
        flat_shadow_rays: 32,
        flat_resolution: 64,
        isovalue_resolution: 32,
        axis: IsovalueAxis::EVEN,
        seed: 1,
    };
    let estimate = EstimateSettings::default();
    let dark = || RadianceCache::new(&scene, &tracer, &photons, &cache_settings, &|_| true);
    let source = NodePhotons::new(&scene, &photons, estimate);
    let filled = |cache: &mut RadianceCache| {
        cache.fill(&scene, &tracer, &source, &cache_settings, NodeBand::WHOLE, &|_| true);
    };
    let mut cache = dark();
    filled(&mut cache);
    let place = |o: usize| Vec3::from_array(lattice.ijk(o).map(|i| i as f32));
    let masks = masks(&scene.field, lattice);
    let nodes: Vec<Vec3> = (0..lattice.len()).filter(|&o| masks[o] == Mask::Valid).map(place).collect();
    let some: Vec<Vec3> = nodes.iter().copied().step_by(5).collect();
    let gather = Indirect::Gather(&cache, 64);
    let sampled = |at: &[Vec3], rays: u32| {
        let (scene, tracer, indirect, side) = (&scene, &tracer, &gather, Side::Lower);
        Sampler { scene, tracer, indirect, side, shadow_rays: rays, seed: 1 }.samples(at, &|_| true)
    };
    let samples: Vec<RadianceSample> = sampled(&some, 16).samples.into_iter().flatten().collect();
    // As many as BB09 took, around nodes with a surface of the sweep.
    let many: Vec<RadianceSample> = (0..10_000_000u64)
        .map(|n| {
            let hash =
                |n: u64| (n.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ n >> 7).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40;
            let unit = |axis| hash(4 * n + axis) as f32 / (1 << 24) as f32;
            let near = nodes[(unit(3) * nodes.len() as f32) as usize % nodes.len()];
            let position = (near + Vec3::new(unit(0), unit(1), unit(2)) - 0.5).clamp(Vec3::ZERO, Vec3::splat(100.0));
            RadianceSample { position, radiance: position, ..RadianceSample::default() }
        })
        .collect();
    let targets: Vec<FitSample> = samples.iter().map(FitSample::from).collect();
    let start = shepard(&scene.field, lattice, &masks, &samples, 8, &|_| true);
    // Noise of its own for each half.
    let halves = |o: usize| {
        [0u64, 1].map(|h| {
            let hash = (o as u64 * 2 + h + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
            if masks[o] == Mask::Valid { Vec3::splat(0.5 + hash as f32 / (1 << 26) as f32) } else { Vec3::NAN }
        })
    };
    let swept = |directions, light_points, max_bounces| {
        let settings =
            SweepSettings { directions, light_points, max_bounces, replicates: 1, ..SweepSettings::default() };
        black_box(sweep(&scene, &settings, &|_| true).expect("a sweep"));
    };
    let isovalue = unit_isovalue(&scene.field, 47.0).expect("in the sweep");
    let mesh = SurfaceMesh::extract(&scene, isovalue, 1).expect("a mesh");
    let surface = SurfaceTracer::new(&device, &scene, isovalue, 1).expect("a tracer");
    let reference_settings = ReferenceSettings {
        integrator: Integrator::Path,
        samples: 64,
        vertices: Some(2000),
        ..ReferenceSettings::default()
    };
    let few = BakeOptions {
        photons: Some(1000),
        gather_rays: Some(1),
        shadow_rays: Some(1),
        wall_resolution: Some(8),
        ..BakeOptions::default()
    };
    let settings = BakeSettings::new(&few, &scene).expect("settings");
    let baked = bake(&scene, &settings, &device, Progress::Quiet).expect("a bake");
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("a.vti");
    volume.write(&file).expect("a file");

    let stages: Vec<(&str, Work<'_>)> = vec![
        ("read", Box::new(|| drop(black_box(Volume::open(&file).expect("a volume"))))),
        ("photons", Box::new(|| drop(black_box(trace_photons(&scene, &tracer, &photon_settings, &|_| true))))),
        ("walls", Box::new(|| drop(black_box(dark())))),
        ("photon maps", Box::new(|| drop(black_box(NodePhotons::new(&scene, &photons, estimate))))),
        (
            "cache",
            Box::new(|| {
                let nowhere = NodeSet::all(scene.lattice().len());
                let mut cache = RadianceCache::from_parts([None, None], nowhere, scene.lattice().dims(), Vec::new());
                filled(&mut cache);
            }),
        ),
        ("samples", Box::new(|| drop(black_box(sampled(&some, 128))))),
        (
            "smoothing",
            Box::new(|| {
                let smoothing = Smoothing { scene: &scene, side: Side::Lower, tau: 0.1 };
                smooth(smoothing, lattice, &halves, &mut |_, slice| drop(black_box(slice)));
            }),
        ),
        ("shepard", Box::new(|| drop(black_box(shepard(&scene.field, lattice, &masks, &samples, 8, &|_| true))))),
        ("shepard, 10^7", Box::new(|| drop(black_box(shepard(&scene.field, lattice, &masks, &many, 8, &|_| true))))),
        (
            "fit",
            Box::new(|| {
                let free = NodeSet::new(lattice.len(), |o| start.mask[o] != Mask::Empty);
                let fit = GridFit::new(&scene.field, lattice, &free, &|_| true);
                drop(black_box(fit.light(&targets, start.radiance.clone())));
            }),
        ),
        ("sweep, direct", Box::new(|| swept(8, 64, 1))),
        ("sweep, gather", Box::new(|| swept(128, 1, 8))),
        (
            "reference",
            Box::new(|| {
                drop(black_box(reference(&scene, &surface, &mesh, isovalue, &reference_settings, &|_| true)));
            }),
        ),
        (
            "export",
            Box::new(|| {
                bake_file::write(&folder.path().join("b.vti"), &scene, &volume, &baked).expect("a file");
            }),
        ),
    ];
    let pools = [1, 2].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().expect("threads"));
    println!(
        "bumps {SIZE}³, {} sampled nodes, {} fitted samples; the least wall seconds of {TURNS}",
        nodes.len() / 5,
        targets.len()
    );
    println!(
        "  {:14} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "stage", "wall 1", "wall 2", "speed-up", "CPU 1", "CPU 2", "CPU 2:1"
    );
    for (name, work) in &stages {
        if only.is_some_and(|o| !name.contains(o.as_str())) {
            continue;
        }
        let [[wall1, cpu1], [wall2, cpu2]] = measure(&pools, work);
        println!("  {name:14} {wall1:8.3} {wall2:8.3} {:8.2} {cpu1:8.2} {cpu2:8.2} {:8.2}", wall1 / wall2, cpu2 / cpu1);
    }
}
