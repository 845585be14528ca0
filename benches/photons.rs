//! Photons traced per second, and irradiance estimated from them: rate and error of every estimator over the photons
//! per estimate, against a gather of many rays. Then the reference's paths. Rates are per CPU second of all threads.

use glam::DVec3;
use isolume::direct::{Receiver, luminance};
use isolume::embree::{Device, GraphTracer, SurfaceTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, Side};
use isolume::gather::gathered_irradiance;
use isolume::isa::Isa;
use isolume::isovalue_axis::IsovalueAxis;
use isolume::nearest::Neighbours;
use isolume::photon::{PhotonSettings, trace_photons};
use isolume::photon_map::{EstimateSettings, Estimator, PhotonMap};
use isolume::progress::processor_seconds;
use isolume::radiance_cache::{CacheSettings, NodeBand, NodePhotons, RadianceCache};
use isolume::reference::{Integrator, ReferenceSettings, reference};
use isolume::rng::Stage;
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::surface_mesh::{SurfaceMesh, unit_isovalue};
use isolume::volume::generate::Generator;
use rayon::prelude::*;

const ISOVALUE: f64 = 47.0;

fn bumps() -> Scene {
    let volume = Generator::from_name("bumps").and_then(|g| g.sample([101; 3])).expect("a volume");
    let field = Field::new(&volume, Sweep::new(3.6, 95.0).expect("a sweep")).expect("a field");
    let walls = cornell_box(field.lattice(), 0.0).expect("a box");
    Scene::new(field, Surface::default(), Boundary::Open, walls).expect("a scene")
}

/// Every so many nodes are asked about.
const STRIDE: usize = 7;

/// The work's result and its CPU seconds.
fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = processor_seconds();
    let result = work();
    (result, (processor_seconds() - start).max(1e-9))
}

/// The same, of work done again and again: CPU time is told in steps of 10 ms.
fn timed_often<T>(work: impl Fn() -> T) -> (T, f64) {
    let (mut result, mut seconds) = timed(&work);
    let mut times = 1.0;
    while seconds < 0.5 {
        let (again, spent) = timed(&work);
        (result, seconds, times) = (again, seconds + spent, times + 1.0);
    }
    (result, seconds / times)
}

fn main() {
    let scene = bumps();
    let device = Device::new(1).expect("Embree starts");
    let tracer = GraphTracer::new(&device, &scene).expect("a tracer");
    let emission = |count, seed| PhotonSettings {
        count,
        max_bounces: u16::MAX,
        seed,
        axis: IsovalueAxis::EVEN,
        fixed_isovalue: None,
    };
    println!(
        "per CPU second, {} threads, {}, Embree {}; bumps 101³",
        rayon::current_num_threads(),
        Isa::current().name(),
        device.version()
    );
    let (photons, seconds) = timed(|| trace_photons(&scene, &tracer, &emission(1 << 21, 1), &|_| true));
    let millions = |n: u64, seconds: f64| n as f64 / seconds / 1e6;
    println!(
        "photons: {:.2} M emitted/s, {:.2} M stored/s, {:.2} M rays/s",
        millions(photons.emitted, seconds),
        millions(photons.stored(), seconds),
        millions(photons.rays, seconds)
    );

    // In the lattice's order.
    let receivers: Vec<Receiver> = (0..scene.lattice().len())
        .step_by(STRIDE)
        .filter_map(|o| {
            let p = scene.lattice().point(o);
            let isovalue = scene.field.value(p);
            let normal = scene.normal(p, Side::Lower).filter(|_| (0.0..=1.0).contains(&isovalue))?;
            let departure = Departure::Surface(Side::Lower);
            Some(Receiver { position: p.as_vec3(), normal, isovalue: isovalue as f32, departure })
        })
        .collect();
    let cache_settings = CacheSettings {
        node_shadow_rays: 16,
        flat_shadow_rays: 64,
        flat_resolution: 64,
        isovalue_resolution: 32,
        axis: IsovalueAxis::EVEN,
        seed: 3,
    };
    let other = trace_photons(&scene, &tracer, &emission(1 << 22, 2), &|_| true);
    let truth: Vec<DVec3> = {
        let fine = EstimateSettings::default();
        let mut cache = RadianceCache::new(&scene, &tracer, &other, &cache_settings, &|_| true);
        let source = NodePhotons::new(&scene, &other, fine);
        cache.fill(&scene, &tracer, &source, &cache_settings, NodeBand::WHOLE, &|_| true);
        let gather = |(i, r): (usize, &Receiver)| {
            gathered_irradiance(&scene, &tracer, &cache, r, 512, Stage::Gather.key(3, i as u64)).estimate.mean
        };
        receivers.par_iter().step_by(16).enumerate().map(gather).collect()
    };
    let scale = (truth.iter().map(|t| luminance(*t).powi(2)).sum::<f64>() / truth.len() as f64).sqrt();
    let counted = photons.surface.iter().filter(|p| p.bounces > 0 && p.side == Side::Lower).count();
    println!("estimates of indirect irradiance from {counted} photons; error in % of its RMS");
    println!("  {:10} {:>4} {:>9} {:>12} {:>8}", "estimator", "k", "map, s", "estimates/s", "error");
    let mut rows: Vec<(Estimator, usize, f64, [f64; 2])> = Vec::new();
    for estimator in [Estimator::Nearest, Estimator::Radius, Estimator::Splat] {
        for k in [16, 32, 48, 64, 96, 128, 256, 1024] {
            let settings = EstimateSettings { estimator, photons: k, ..EstimateSettings::default() };
            let built = || PhotonMap::new(&scene, &photons.surface, Side::Lower, |p| p.bounces > 0, settings);
            let (map, building) = timed_often(built);
            let estimate = |scratch: &mut Neighbours, r: &Receiver| map.irradiance(r, scratch).mean;
            let (estimates, seconds): (Vec<DVec3>, f64) = timed_often(|| {
                receivers.par_iter().with_min_len(256).map_init(Neighbours::default, estimate).collect()
            });
            let squares: f64 = estimates.iter().step_by(16).zip(&truth).map(|(e, t)| luminance(*e - *t).powi(2)).sum();
            let error = 100.0 * (squares / truth.len() as f64).sqrt() / scale;
            let rate = receivers.len() as f64 / seconds;
            println!("  {:10} {k:4} {building:9.3} {rate:12.0} {error:8.2}", format!("{estimator:?}").to_lowercase());
            // A bake asks at every node, of a map that is built once.
            let nodes = (STRIDE * receivers.len()) as f64;
            let whole = nodes / (building + nodes / rate);
            rows.push((estimator, k, error, [rate, whole]));
        }
    }
    // The fastest of each estimator that is as good as the k nearest.
    for &(_, k, asked, nearest) in rows.iter().filter(|r| r.0 == Estimator::Nearest) {
        let fastest = |e: Estimator| {
            let good = rows.iter().filter(|r| r.0 == e && r.2 <= asked * 1.001);
            let best = good.fold([0.0f64; 2], |a, r| [a[0].max(r.3[0]), a[1].max(r.3[1])]);
            format!("{:.1} ({:.1})", best[0] / nearest[0], best[1] / nearest[1])
        };
        let [radius, splat] = [Estimator::Radius, Estimator::Splat].map(fastest);
        println!(
            "  at the error of the {k:4} nearest or less, times the rate (with the map's building): radius {radius}, splat {splat}"
        );
    }

    let isovalue = unit_isovalue(&scene.field, ISOVALUE).expect("in the sweep");
    let mesh = SurfaceMesh::extract(&scene, isovalue, 1).expect("a mesh");
    let tracer = SurfaceTracer::new(&device, &scene, isovalue, 1).expect("a tracer");
    let settings = ReferenceSettings {
        integrator: Integrator::Path,
        samples: 256,
        vertices: Some(1000),
        ..ReferenceSettings::default()
    };
    let (found, seconds) = timed(|| reference(&scene, &tracer, &mesh, isovalue, &settings, &|_| true).unwrap());
    println!(
        "reference on {} triangles: {:.0} vertices/s of {} paths, {:.2} M rays/s",
        mesh.triangles.len(),
        1000.0 / seconds,
        settings.samples,
        millions(found.rays, seconds)
    );
}
