//! Gather rays of the sweep engine (RGB lookup, cosine, accumulation and walls included) against Embree's rays on the
//! triangles of one extracted isosurface; per CPU second, medians of interleaved repetitions of one run.
//!
//! Those rays come twice: one by one and in random order, as bounces of paths do, ROBUST; and as a final gather sends
//! them, 64 from each place, places in Morton order, to a mesh that Embree built with care and without ROBUST, by the
//! faster of single rays and packets.
//!
//! `cargo bench --bench sweep [-- --full] [--data DIR]`. "bumps" leaves two thirds of its nodes outside the sweep,
//! "foam" (300 blobs, every node in the sweep) none. DIR holds pasta-proton.vti, fluid.vti, neuron.mha, ch2.nii.gz;
//! files that are not there are left out. `--full` adds the growth with the lattice.

use glam::{DVec3, Vec3};
use isolume::embree::{Bvh, BvhBuilder, Device, INVALID_ID, Quality, Ray, Ray16, RayHit, RayHit16, Valid16};
use isolume::field::{Field, Sweep};
use isolume::isa::Isa;
use isolume::isosurface::extract;
use isolume::progress::processor_seconds;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::sweep::{SweepSettings, sweep};
use isolume::volume::generate::Generator;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;
use std::path::Path;
use std::time::Instant;

/// Interleaved repetitions, of which medians are taken.
const REPEATS: usize = 7;

/// The sweep of bumps.
const BUMPS: [f64; 2] = [3.6, 95.0];

/// Real volumes, their sweeps, and the isovalue of the extracted mesh.
const DATA: [(&str, [f64; 2], f64); 4] = [
    ("pasta-proton.vti", [0.01, 0.05], 0.029),
    ("fluid.vti", [0.1, 0.6], 0.3375),
    ("neuron.mha", [20.0, 200.0], 60.0),
    ("ch2.nii.gz", [15.0, 200.0], 80.0),
];

fn scene_of(volume: &Volume, [lo, hi]: [f64; 2]) -> Scene {
    let field = Field::new(volume, Sweep::new(lo, hi).expect("a sweep")).expect("a field");
    let walls = cornell_box(field.lattice(), 0.0).expect("a box");
    Scene::new(field, Surface::default(), Boundary::Open, walls).expect("a scene")
}

fn bumps(n: usize) -> Volume {
    Generator::from_name("bumps").and_then(|g| g.sample([n; 3])).expect("a volume")
}

/// All that the samples span: every node lies on an isosurface of this sweep.
fn range_of(volume: &Volume) -> [f64; 2] {
    let (lo, hi) = volume.range().expect("samples");
    [lo, hi]
}

/// A sum of Gaussian blobs all over.
fn foam(n: usize) -> Volume {
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).expect("a lattice");
    let mut rng = Rng::stream(3, Stage::Test, 0);
    let blobs: Vec<DVec3> = (0..300).map(|_| DVec3::new(rng.unit(), rng.unit(), rng.unit())).collect();
    let samples: Vec<f32> = (0..lattice.len())
        .into_par_iter()
        .map(|at| {
            let [i, j, k] = lattice.ijk(at);
            let x = lattice.to_world(DVec3::new(i as f64, j as f64, k as f64));
            let blob = |m: &DVec3| (-(x - *m).length_squared() / (2.0 * 0.045 * 0.045)).exp();
            blobs.iter().map(blob).sum::<f64>() as f32
        })
        .collect();
    Volume::new("foam", lattice, Samples::F32(samples)).expect("a volume")
}

/// An isosurface in Embree, and cosine-distributed rays off its vertices.
struct Triangles {
    mesh: Bvh<'static>,
    count: usize,
    rays: Vec<Ray>,
}

/// Interleaves the bits of a place's cell.
fn morton(p: DVec3) -> u64 {
    let spread = |x: f64| (0..21).fold(0u64, |bits, b| bits | ((x * 16.0) as u64 >> b & 1) << (3 * b));
    spread(p.x) | spread(p.y) << 1 | spread(p.z) << 2
}

impl Triangles {
    /// The isosurface at unit isovalue `c`, and so many rays: `per_place` from each place, those in Morton order if
    /// they are several.
    fn new(mut builder: BvhBuilder<'static>, scene: &Scene, c: f32, per_place: usize, count: usize) -> Self {
        let surface = extract(scene.lattice().dims(), scene.field.samples(), c).expect("a mesh");
        let place = |p: DVec3| scene.lattice().to_world(p).as_vec3();
        let vertices: Vec<[f32; 3]> = surface.vertices.iter().map(|&p| place(p).to_array()).collect();
        let step = 1e-2 * scene.lattice().spacing().min_element() as f32;
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let mut places: Vec<usize> =
            (0..count / per_place).map(|_| (rng.unit() * vertices.len() as f64) as usize).collect();
        if per_place > 1 {
            places.sort_by_key(|&at| morton(surface.vertices[at]));
        }
        let mut ray = |at: usize| {
            let n = scene.field.falling_normal(surface.vertices[at]).unwrap_or(DVec3::Z);
            let d = Frame::new(n).to_world(cosine_hemisphere(rng.unit2())).as_vec3();
            Ray::new((Vec3::from_array(vertices[at]) + step * n.as_vec3()).to_array(), d.to_array(), 0.0, f32::INFINITY)
        };
        let rays = places.into_iter().flat_map(|at| vec![at; per_place]).map(&mut ray).collect();
        builder.triangles(&vertices, &surface.triangles, u32::MAX).expect("triangles");
        Self { mesh: builder.commit().expect("a built scene"), count: surface.triangles.len(), rays }
    }

    /// Rays per CPU second, of which `hits` counts what is hit.
    fn rate(&self, hits: impl Fn(&[Ray]) -> usize + Send + Sync) -> f64 {
        let start = processor_seconds();
        let hits: usize = self.rays.par_chunks(1 << 12).map(hits).sum();
        assert!(hits > 0);
        self.rays.len() as f64 / (processor_seconds() - start).max(1e-2)
    }

    fn single(&self) -> f64 {
        let hit = |ray: &&Ray| {
            let mut hit = RayHit::new(**ray);
            self.mesh.intersect1(&mut hit);
            hit.is_hit()
        };
        self.rate(|rays| rays.iter().filter(hit).count())
    }

    fn packets(&self) -> f64 {
        let hits = |rays: &[Ray]| {
            let mut hit = RayHit16::new(Ray16::new(&std::array::from_fn(|i| rays[i % rays.len()])));
            self.mesh.intersect16(&Valid16::ALL, &mut hit);
            hit.hit.geometry.iter().filter(|&&geometry| geometry != INVALID_ID).count()
        };
        self.rate(|rays| rays.chunks(16).map(hits).sum())
    }
}

fn median(mut x: Vec<f64>) -> f64 {
    x.sort_by(f64::total_cmp);
    x[x.len() / 2]
}

/// Prints the ratios of one scene; returns the CPU seconds of a pass.
fn compare(device: &Device, name: &str, scene: &Scene, c: f32) -> f64 {
    let builder = || BvhBuilder::new(device).expect("a scene");
    let bounces = Triangles::new(builder(), scene, c, 1, 1 << 20);
    let gathered = Triangles::new(builder().quality(Quality::High).robust(false), scene, c, 64, 1 << 20);
    let directions = if scene.lattice().len() < 3_000_000 { 128 } else { 32 };
    let settings = |max_bounces, light_points| SweepSettings {
        directions,
        light_points,
        max_bounces,
        replicates: 1,
        ..SweepSettings::default()
    };
    let time = |s: SweepSettings| {
        let start = processor_seconds();
        let out = sweep(scene, &s, &|_| true).expect("a sweep");
        (processor_seconds() - start, out.counts)
    };
    let mut columns: [Vec<f64>; 9] = Default::default();
    let mut valid = 0.0;
    for _ in 0..REPEATS {
        let exact = bounces.single();
        let best = gathered.single().max(gathered.packets());
        let (t0, _) = time(settings(0, 1));
        let (t1, _) = time(settings(0, 17));
        let (t2, counts) = time(settings(1, 1));
        let pass = t2 - t0;
        if pass < 0.05 || t1 <= t0 {
            println!("{name}: too short to time");
            return f64::NAN;
        }
        let gather = counts.gather_rays as f64 / pass;
        let direct = 16.0 * counts.valid as f64 / (t1 - t0);
        let nodes = scene.lattice().len() as f64;
        valid = counts.valid as f64 / nodes;
        let row = [exact, best, gather, gather / exact, gather / best, gather / valid, direct, direct / exact, pass];
        columns.iter_mut().zip(row).for_each(|(column, x)| column.push(x));
    }
    let [exact, best, gather, ratio, least, all, direct, direct_ratio, pass] = columns.map(median);
    println!(
        "{name}: Embree triangles {:.1} M rays/s, gathered in order {:.1} ({} triangles); gather {:.1} M/s ({ratio:.1}×, \
         {least:.1}×; {:.0} % of the nodes in the sweep, {:.1} M/s over all); direct {:.1} M/s ({direct_ratio:.1}×)",
        exact * 1e-6,
        best * 1e-6,
        bounces.count,
        gather * 1e-6,
        100.0 * valid,
        all * 1e-6,
        direct * 1e-6,
    );
    pass / directions as f64
}

/// Prints what converged light takes.
fn converge(scene: &Scene) {
    let settings = SweepSettings { directions: 128, light_points: 64, replicates: 1, ..SweepSettings::default() };
    let (start, cpu) = (Instant::now(), processor_seconds());
    let out = sweep(scene, &settings, &|_| true).expect("a sweep");
    let (wall, cpu) = (start.elapsed().as_secs_f64(), processor_seconds() - cpu);
    println!("      converged: {wall:.2} s ({cpu:.2} CPU s), {} bounces", out.bounces);
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let full = arguments.iter().any(|a| a == "--full");
    let data = arguments.iter().position(|a| a == "--data").and_then(|i| arguments.get(i + 1));
    let device = Device::new(1).expect("Embree starts");
    println!(
        "per CPU second (all threads), {} threads, {}, Embree {}",
        rayon::current_num_threads(),
        Isa::current().name(),
        device.version()
    );
    let mut passes = Vec::new();
    for n in if full { vec![64, 101, 128, 256] } else { vec![101] } {
        let scene = scene_of(&bumps(n), BUMPS);
        passes.push(((n as f64).ln() * 3.0, compare(&device, &format!("bumps {n}³"), &scene, 0.4).ln()));
        passes.retain(|pass| pass.1.is_finite());
        converge(&scene);
    }
    if full {
        let mean = |of: fn(&(f64, f64)) -> f64| passes.iter().map(of).sum::<f64>() / passes.len() as f64;
        let (x, y) = (mean(|p| p.0), mean(|p| p.1));
        let fit = |of: fn(f64, f64) -> f64| passes.iter().map(|p| of(p.0 - x, p.1 - y)).sum::<f64>();
        println!("time of a pass over voxels: fitted exponent {:.2}", fit(|x, y| x * y) / fit(|x, _| x * x));
    }
    let foam = foam(101);
    let scene = scene_of(&foam, range_of(&foam));
    compare(&device, "foam 101³", &scene, 0.2);
    converge(&scene);
    let whole = |name: &str, volume: &Volume, c: f64| {
        let scene = scene_of(volume, range_of(volume));
        compare(&device, &format!("{name}, whole range"), &scene, scene.field.sweep().isovalue(c));
    };
    whole("bumps 101³", &bumps(101), 40.16);
    for (file, range, c) in DATA {
        let Some(path) = data.map(|d| Path::new(d).join(file)) else { continue };
        if !path.exists() {
            println!("left out: there is no {file}");
            continue;
        }
        let volume = Volume::open(&path).expect("a volume");
        let scene = scene_of(&volume, range);
        compare(&device, file, &scene, scene.field.sweep().isovalue(c));
        converge(&scene);
        whole(file, &volume, c);
    }
}
