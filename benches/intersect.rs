//! Isovalue rays beside Embree's triangle rays: how fast every isosurface is traced, against one extracted isosurface.
//!
//! `cargo bench --bench intersect [-- --data DIR] [--quick]`; DIR holds ch2.nii.gz, engine.vti and pasta-proton.vti,
//! which `isolume generate pasta --species both -o DIR/pasta.vti` makes; files that are not there are left out.
//!
//! "fixed c": cosine-hemisphere rays leave vertices of the isosurface that was extracted; the same rays go to its
//! triangles in Embree (quality HIGH, the faster of single rays and packets: rtcIntersect16, or rtcIntersect8 twice
//! where Embree takes sixteen apart). "any c": they leave random points x of Ω with c = h(x), over the whole sweep.
//! "random": every ray from another place; "gather64": 64 rays per place, places in Morton order. Two threads; medians
//! of interleaved repetitions, since machines are shared: only the ratios mean anything. The isovalue rays pay for the
//! set-up, spread over 10 M rays; the triangle rays do not. At random places with any c every instruction set of the
//! machine is compared with plain code.

use glam::DVec3;
use isolume::embree::{
    Bvh, BvhBuilder, Device, GraphTracer, INVALID_ID, Quality, Ray, Ray16, RayHit, RayHit16, Valid16,
};
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, FlattenedRay, Side};
use isolume::isa::Isa;
use isolume::isosurface::extract;
use isolume::pyramid::Pyramid;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface};
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;
use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

/// The set-up is spread over so many rays.
const AMORTISED: f64 = 1e7;
/// Rays that one task traces.
const TASK: usize = 4096;
/// Where a triangle ray starts, in index units: vertices belong to their triangles.
const TNEAR: f32 = 1e-3;

struct Case {
    name: &'static str,
    volume: Volume,
    sweep: [f64; 2],
    /// Isovalue of the extracted mesh.
    mesh: f64,
}

/// design §6, on [0, 1]³.
fn bumps() -> Case {
    let n = 101;
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).expect("a lattice");
    let g = |x: DVec3, m: [f64; 3], s: f64| (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp();
    let samples = (0..lattice.len())
        .map(|o| {
            let [i, j, k] = lattice.ijk(o);
            let x = lattice.to_world(DVec3::new(i as f64, j as f64, k as f64));
            let small =
                g(x, [0.32, 0.40, 0.74], 0.05) + g(x, [0.62, 0.35, 0.76], 0.05) + g(x, [0.52, 0.66, 0.72], 0.05);
            (100.0 * g(x, [0.50, 0.50, 0.38], 0.16) + 80.0 * small) as f32
        })
        .collect();
    let volume = Volume::new("bumps", lattice, Samples::F32(samples)).expect("a volume");
    Case { name: "bumps 101³", volume, sweep: [3.6, 95.0], mesh: 47.0 }
}

/// Real volumes, their sweeps, and the isovalue of the extracted mesh.
const DATA: [(&str, [f64; 2], f64); 3] = [
    ("pasta-proton.vti", [0.01, 0.05], 0.03),
    ("ch2.nii.gz", [15.0, 200.0], 80.0),
    ("engine.vti", [40.0, 230.0], 100.0),
];

/// A file of the data folder.
fn file(dir: &Path, name: &'static str, sweep: [f64; 2], mesh: f64) -> isolume::error::Result<Case> {
    Ok(Case { name, volume: Volume::open(dir.join(name))?, sweep, mesh })
}

/// Interleaves the bits of an index position.
fn morton(p: DVec3) -> u64 {
    let spread = |x: f64| (0..21).fold(0u64, |bits, b| bits | ((x * 16.0) as u64 >> b & 1) << (3 * b));
    spread(p.x) | spread(p.y) << 1 | spread(p.z) << 2
}

/// A cosine-hemisphere ray that leaves the level set through `p` on its lower side.
fn leave(field: &Field, p: DVec3, isovalue: f32, rng: &mut Rng) -> Option<FlattenedRay> {
    let local = cosine_hemisphere(rng.unit2());
    let world = Frame::new(field.falling_normal(p)?).to_world(local);
    let direction = field.lattice().direction_to_index(world).as_vec3();
    Some(FlattenedRay {
        departure: Departure::Surface(Side::Lower),
        ..FlattenedRay::free(p.as_vec3(), direction, isovalue)
    })
}

/// `count` rays, `per_place` from each of the places that `place` draws, those in Morton order if there are several.
fn rays_from(
    field: &Field,
    count: usize,
    per_place: usize,
    place: impl Fn(&mut Rng) -> Option<(DVec3, f32)>,
) -> Vec<FlattenedRay> {
    let mut rng = Rng::stream(11, Stage::Test, per_place as u64);
    let mut places = Vec::new();
    while places.len() < count / per_place {
        places.extend(place(&mut rng).filter(|(p, _)| field.falling_normal(*p).is_some()));
    }
    if per_place > 1 {
        places.sort_by_key(|&(p, _)| morton(p));
    }
    places
        .iter()
        .flat_map(|&(p, c)| (0..per_place).map(move |_| (p, c)))
        .filter_map(|(p, c)| leave(field, p, c, &mut rng))
        .collect()
}

fn triangle_ray(ray: &FlattenedRay) -> Ray {
    Ray::new(ray.origin.to_array(), ray.direction.to_array(), TNEAR / ray.direction.length(), ray.reach)
}

/// What is timed: hits among a task's rays, so that nothing is optimised away.
type Kernel<'k> = Box<dyn Fn(&[FlattenedRay]) -> usize + Sync + 'k>;

fn triangle_kernels<'k>(mesh: &'k Bvh<'k>) -> [Kernel<'k>; 4] {
    let sixteen = |rays: &[FlattenedRay]| Ray16::new(&std::array::from_fn(|i| triangle_ray(&rays[i % rays.len()])));
    [
        Box::new(|rays| {
            let hit = |ray: &&FlattenedRay| {
                let mut rayhit = RayHit::new(triangle_ray(ray));
                mesh.intersect1(&mut rayhit);
                rayhit.is_hit()
            };
            rays.iter().filter(hit).count()
        }),
        Box::new(move |rays| {
            let hits = |rays: &[FlattenedRay]| {
                let mut rayhit = RayHit16::new(sixteen(rays));
                mesh.intersect16(&Valid16::ALL, &mut rayhit);
                rayhit.hit.geometry.iter().filter(|&&geometry| geometry != INVALID_ID).count()
            };
            rays.chunks(16).map(hits).sum()
        }),
        Box::new(|rays| rays.iter().filter(|ray| mesh.occluded1(&mut triangle_ray(ray))).count()),
        Box::new(move |rays| {
            let hits = |rays: &[FlattenedRay]| {
                let mut packet = sixteen(rays);
                mesh.occluded16(&Valid16::ALL, &mut packet);
                packet.tfar.iter().filter(|&&t| t == f32::NEG_INFINITY).count()
            };
            rays.chunks(16).map(hits).sum()
        }),
    ]
}

fn graph_kernels<'k>(tracer: &'k GraphTracer<'k>) -> [Kernel<'k>; 4] {
    [
        Box::new(|rays| rays.iter().filter(|ray| tracer.intersect(ray).is_some()).count()),
        Box::new(|rays| {
            let mut hits = [None; TASK];
            tracer.intersect_many(rays, &mut hits[..rays.len()]);
            hits[..rays.len()].iter().flatten().count()
        }),
        Box::new(|rays| rays.iter().filter(|ray| tracer.occluded(ray)).count()),
        Box::new(|rays| {
            let mut blocked = [false; TASK];
            tracer.occluded_many(rays, &mut blocked[..rays.len()]);
            blocked[..rays.len()].iter().filter(|&&b| b).count()
        }),
    ]
}

fn seconds(f: impl FnOnce() -> usize) -> (f64, usize) {
    let start = Instant::now();
    let count = black_box(f());
    (start.elapsed().as_secs_f64(), count)
}

fn median(mut x: Vec<f64>) -> f64 {
    x.sort_by(f64::total_cmp);
    x[x.len() / 2]
}

/// Ratios that the issue asks about, over all cases.
#[derive(Default)]
struct Summary {
    single: Vec<f64>,
    packets: Vec<f64>,
    any_single: Vec<f64>,
    any_packets: Vec<f64>,
    shadow: Vec<f64>,
    shadow_gain: Vec<f64>,
    setup: Vec<f64>,
    bytes: f64,
}

fn run(case: &Case, device: &Device, count: usize, repetitions: usize, summary: &mut Summary) {
    let [lo, hi] = case.sweep;
    let sweep = Sweep::new(lo, hi).expect("a sweep");
    let field = Field::new(&case.volume, sweep).expect("a field");
    let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).expect("a scene");
    let field = &scene.field;
    let isovalue = sweep.isovalue(case.mesh);
    let surface = extract(field.lattice().dims(), field.samples(), isovalue).expect("a mesh");
    let vertices: Vec<[f32; 3]> = surface.vertices.iter().map(|v| v.as_vec3().to_array()).collect();
    let tracer = GraphTracer::new(device, &scene).expect("a tracer");

    let commit = |quality: Quality| {
        let mut builder = BvhBuilder::new(device).expect("a scene").quality(quality).robust(false);
        builder.triangles(&vertices, &surface.triangles, u32::MAX).expect("triangles");
        builder.commit().expect("a built scene")
    };
    let mesh = commit(Quality::High);
    // Set-up alone: the pyramid and the commit of its one primitive, against the commit of the mesh.
    let mut setups = [vec![], vec![], vec![], vec![]];
    for _ in 0..repetitions {
        setups[0].push(seconds(|| usize::from(GraphTracer::new(device, &scene).is_ok())).0);
        setups[1].push(seconds(|| size_of_val(&commit(Quality::Medium))).0);
        setups[2].push(seconds(|| size_of_val(&commit(Quality::High))).0);
        setups[3].push(seconds(|| Pyramid::new(field, false).bytes()).0);
    }
    let [setup, commit, careful, pyramid] = setups.map(median);
    let cells: usize = field.lattice().cells().iter().product();
    let bytes = Pyramid::new(field, false).bytes() as f64 / cells as f64;
    println!("\n{}: {} cells, mesh of {} triangles at {}", case.name, cells, surface.triangles.len(), case.mesh);
    println!(
        "  set-up {:.2} ms (pyramid {:.2}), commit of the mesh {:.2} ms: {:.1} times faster (quality HIGH {:.2} ms: \
         {:.1}); {bytes:.2} bytes per cell",
        1e3 * setup,
        1e3 * pyramid,
        1e3 * commit,
        commit / setup,
        1e3 * careful,
        careful / setup
    );
    summary.setup.push(commit / setup);
    summary.bytes = summary.bytes.max(bytes);

    let on_mesh =
        |rng: &mut Rng| Some((surface.vertices[(rng.unit() * surface.vertices.len() as f64) as usize], isovalue));
    let anywhere = |rng: &mut Rng| {
        // As rays will start there: rounded to f32.
        let p = (DVec3::new(rng.unit(), rng.unit(), rng.unit()) * field.lattice().far()).as_vec3().as_dvec3();
        let c = field.value(p);
        (c > 0.0 && c < 1.0).then_some((p, c as f32))
    };
    println!(
        "  {:10} {:8} {:>9} {:>9} {:>9} {:>9} {:>9}   ratios: {:>6} {:>7} {:>7} {:>7}",
        "", "Mrays/s:", "tri 1", "tri 16", "c 1", "c 16", "hits", "1", "16", "occl 1", "occl 16"
    );
    for (order, per_place) in [("random", 1), ("gather64", 64)] {
        let fixed = rays_from(field, count, per_place, on_mesh);
        let any = rays_from(field, count, per_place, anywhere);
        let (tri, graph) = (triangle_kernels(&mesh), graph_kernels(&tracer));
        // All twelve runs interleaved: 4 of triangles, 4 at fixed c, 4 at any c.
        let runs: Vec<(&Kernel, &[FlattenedRay])> = tri
            .iter()
            .map(|k| (k, &fixed[..]))
            .chain(graph.iter().map(|k| (k, &fixed[..])))
            .chain(graph.iter().map(|k| (k, &any[..])))
            .collect();
        let mut times = vec![vec![]; runs.len()];
        let mut hits = vec![0; runs.len()];
        for repetition in 0..=repetitions {
            for (r, (kernel, rays)) in runs.iter().enumerate() {
                let (time, n) = seconds(|| rays.par_chunks(TASK).map(kernel).sum());
                hits[r] = n;
                // The first round warms up.
                if repetition > 0 {
                    times[r].push(time / rays.len() as f64);
                }
            }
        }
        assert_eq!((hits[4], hits[8]), (hits[6], hits[10]), "occluded disagrees with intersect");
        assert_eq!((hits[4], hits[8]), (hits[5], hits[9]), "packets disagree with single rays");
        // Ratios within a repetition, then their median.
        let ratio = |triangles: usize, graph: usize, setup: f64| {
            let both = times[triangles].iter().zip(&times[triangles + 1]).zip(&times[graph]);
            median(both.map(|((a, b), g)| a.min(*b) / (g + setup / AMORTISED)).collect())
        };
        for (what, r) in [("fixed c", 4), ("any c", 8)] {
            let rate = |r: usize| 1e-6 / median(times[r].clone());
            let all = [ratio(0, r, setup), ratio(0, r + 1, setup), ratio(2, r + 2, setup), ratio(2, r + 3, setup)];
            println!(
                "  {order:10} {what:8} {:9.2} {:9.2} {:9.2} {:9.2} {:8.1}%           {:6.2} {:7.2} {:7.2} {:7.2}   occluded {:.2} and {:.2} Mrays/s",
                rate(0),
                rate(1),
                rate(r),
                rate(r + 1),
                100.0 * hits[r] as f64 / if r == 4 { fixed.len() } else { any.len() } as f64,
                all[0],
                all[1],
                all[2],
                all[3],
                rate(r + 2),
                rate(r + 3),
            );
            summary.single.push(all[0]);
            summary.packets.push(all[1]);
            summary.shadow.extend([all[2], all[3]]);
            if r == 8 {
                summary.any_single.push(all[0]);
                summary.any_packets.push(all[1]);
            }
            let gain = |a: usize, b: usize| median(times[a].iter().zip(&times[b]).map(|(a, b)| a / b).collect());
            summary.shadow_gain.extend([gain(r, r + 2), gain(r + 1, r + 3)]);
        }
        if order == "random" {
            let agree = hits[4].abs_diff(hits[0]) as f64 / fixed.len() as f64;
            println!(
                "  {:10} {:8} hit or not differs from the triangles' in the net for {:.2} % of the rays",
                "",
                "",
                100.0 * agree
            );
            compare_sets(device, &scene, &any, repetitions);
        }
    }
}

/// The same rays with every instruction set that this machine has, interleaved: rates relative to plain code.
fn compare_sets(device: &Device, scene: &Scene, rays: &[FlattenedRay], repetitions: usize) {
    let found = Isa::found();
    let current = Isa::current();
    let tracers: Vec<GraphTracer> = found
        .iter()
        .map(|isa| {
            isa.choose();
            GraphTracer::new(device, scene).expect("a tracer")
        })
        .collect();
    current.choose();
    let kernels: Vec<[Kernel; 4]> = tracers.iter().map(|tracer| graph_kernels(tracer)).collect();
    // Per set: single and in packets.
    let mut times = vec![[vec![], vec![]]; found.len()];
    for repetition in 0..=repetitions {
        for (times, kernels) in times.iter_mut().zip(&kernels) {
            for (times, kernel) in times.iter_mut().zip(kernels) {
                let (time, _) = seconds(|| rays.par_chunks(TASK).map(kernel).sum());
                if repetition > 0 {
                    times.push(time);
                }
            }
        }
    }
    let gain = |set: usize, way: usize| {
        median(times[0][way].iter().zip(&times[set][way]).map(|(plain, time)| plain / time).collect())
    };
    for (set, isa) in found.iter().enumerate().skip(1) {
        println!(
            "  {:10} {:8} {} : plain code {:.2}, in packets {:.2}",
            "",
            "",
            isa.name(),
            gain(set, 0),
            gain(set, 1)
        );
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let quick = arguments.iter().any(|a| a == "--quick");
    let data = arguments.iter().position(|a| a == "--data").and_then(|i| arguments.get(i + 1));
    rayon::ThreadPoolBuilder::new().num_threads(2).build_global().expect("two threads");
    let device = Device::new(2).expect("Embree starts");
    println!("Embree {}, 2 threads, {}", device.version(), Isa::current().name());

    let mut cases = vec![bumps()];
    if let Some(dir) = data.map(Path::new) {
        for (name, sweep, mesh) in DATA {
            match file(dir, name, sweep, mesh) {
                Ok(case) => cases.push(case),
                Err(e) => println!("left out: {e}"),
            }
        }
    }
    let mut summary = Summary::default();
    for case in &cases {
        run(case, &device, if quick { 1 << 16 } else { 1 << 19 }, if quick { 7 } else { 9 }, &mut summary);
    }
    let mean = |x: &[f64]| (x.iter().map(|x| x.ln()).sum::<f64>() / x.len() as f64).exp();
    let least = |x: &[f64]| x.iter().copied().fold(f64::INFINITY, f64::min);
    println!("\nisovalue rays : triangle rays, set-up counted      geomean   least   asked");
    for (what, ratios, asked) in [
        ("single, c over the whole sweep", &summary.any_single, "0.7 geomean"),
        ("packets, c over the whole sweep", &summary.any_packets, "1.0 geomean"),
        ("single, fixed and any c", &summary.single, "-"),
        ("packets, fixed and any c", &summary.packets, "-"),
        ("occluded : occluded", &summary.shadow, "-"),
        ("occluded : intersect, both isovalue rays", &summary.shadow_gain, "above 1"),
        ("set-up: commit of the mesh : ours", &summary.setup, "10"),
    ] {
        println!("  {what:45} {:10.2} {:7.2}   {asked}", mean(ratios), least(ratios));
    }
    println!("  {:45} {:10.2} {:7}   at most 8", "bytes per cell beside the samples, most", summary.bytes, "");
}
