//! What each way of sampling direct and gathered light is worth: 1 / (variance × CPU seconds), relative to independent
//! random points, over receivers all over bumps 101³. Variances are over repetitions with other seeds, averaged over
//! the receivers.

use glam::{DVec3, Vec3};
use isolume::direct::{Receiver, direct_irradiance};
use isolume::embree::{Device, GraphTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, FlattenedRay, Side};
use isolume::luminaire::{Aim, point_term, unoccluded};
use isolume::progress::processor_seconds;
use isolume::rng::{Rng, Sobol, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::tracer::Tracer;
use isolume::volume::generate::Generator;
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;

const RECEIVERS: usize = 4000;
const REPETITIONS: u64 = 32;

/// An estimator of some light at a receiver from a number of rays, a seed and the receiver's number.
type Estimator<'a> = &'a (dyn Fn(&Receiver, u64, u64) -> f64 + Sync);

/// Mean variance over the receivers, mean of the estimates, and CPU seconds of one repetition.
fn measure(receivers: &[Receiver], estimator: Estimator<'_>) -> [f64; 3] {
    let start = processor_seconds();
    let moments: Vec<(f64, f64)> = receivers
        .par_iter()
        .enumerate()
        .with_min_len(16)
        .map(|(i, r)| {
            let values: Vec<f64> = (0..REPETITIONS).map(|seed| estimator(r, seed, i as u64)).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
            (mean, squares / (values.len() - 1) as f64)
        })
        .collect();
    let n = receivers.len() as f64;
    let seconds = (processor_seconds() - start) / REPETITIONS as f64;
    [moments.iter().map(|m| m.1).sum::<f64>() / n, moments.iter().map(|m| m.0).sum::<f64>() / n, seconds]
}

fn report(title: &str, receivers: &[Receiver], estimators: &[(&str, Estimator<'_>)]) {
    println!("{title:58} {:>9} {:>10} {:>8} {:>9}", "mean", "variance", "CPU s", "worth");
    let mut first = None;
    for (name, estimator) in estimators {
        let [variance, mean, seconds] = measure(receivers, estimator);
        let worth = 1.0 / (variance * seconds);
        let base = *first.get_or_insert(worth);
        println!("  {name:56} {mean:9.5} {variance:10.2e} {seconds:8.3} {:9.1}", worth / base);
    }
}

fn main() {
    let volume = Generator::from_name("bumps").and_then(|g| g.sample([101; 3])).expect("a volume");
    let field = Field::new(&volume, Sweep::new(3.6, 95.0).expect("a sweep")).expect("a field");
    let walls = cornell_box(field.lattice(), 0.0).expect("a box");
    let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).expect("a scene");
    let device = Device::new(1).expect("Embree starts");
    let tracer = GraphTracer::new(&device, &scene).expect("a tracer");
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let receivers: Vec<Receiver> = std::iter::repeat_with(|| {
        let position = (scene.lattice().far() * DVec3::new(rng.unit(), rng.unit(), rng.unit())).as_vec3();
        let isovalue = scene.field.value(position.as_dvec3());
        let normal = scene.normal(position.as_dvec3(), Side::Lower).filter(|_| (0.0..=1.0).contains(&isovalue))?;
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let isovalue = isovalue as f32;
        Some(Receiver { position, normal, isovalue, departure: Departure::Surface(Side::Lower) })
    })
    .flatten()
    .take(RECEIVERS)
    .collect();
    let (id, light) = (0, &scene.luminaires()[0]);
    let world = |r: &Receiver| scene.lattice().to_world(r.position.as_dvec3());
    let visible = |r: &Receiver, y: DVec3| {
        let direction: Vec3 = scene.lattice().to_index(y).as_vec3() - r.position;
        let ray = FlattenedRay {
            reach: 1.0,
            departure: r.departure,
            target: Some(id),
            ..FlattenedRay::free(r.position, direction, r.isovalue)
        };
        f64::from(!tracer.occluded(&ray))
    };
    let rays = 32u32;
    let random = |r: &Receiver, seed, i| {
        let mut rng = Rng::stream(seed, Stage::Direct, i);
        let x = world(r);
        let one = |_| {
            let y = light.sample(rng.unit2());
            let g = point_term(x, r.normal, y, light.normal());
            if g > 0.0 { g * visible(r, y) } else { 0.0 }
        };
        light.area() / f64::from(rays) * (0..rays).map(one).sum::<f64>()
    };
    let sobol = |r: &Receiver, seed, i| {
        let set = Sobol::set(seed, Stage::Direct, i);
        let x = world(r);
        let one = |n| {
            let y = light.sample(set.point2(n, 0));
            let g = point_term(x, r.normal, y, light.normal());
            if g > 0.0 { g * visible(r, y) } else { 0.0 }
        };
        light.area() / f64::from(rays) * (0..rays).map(one).sum::<f64>()
    };
    let ratio = |r: &Receiver, seed, i| {
        let set = Sobol::set(seed, Stage::Direct, i);
        let x = world(r);
        let open = unoccluded(light, x, r.normal);
        if open == 0.0 {
            return 0.0;
        }
        let (mut seen, mut all) = (0.0, 0.0);
        for n in 0..rays {
            let y = light.sample(set.point2(n, 0));
            let g = point_term(x, r.normal, y, light.normal());
            if g > 0.0 {
                seen += g * visible(r, y);
                all += g;
            }
        }
        if all > 0.0 { open * seen / all } else { 0.0 }
    };
    let solid = |r: &Receiver, seed, i| {
        let set = Sobol::set(seed, Stage::Direct, i);
        let x = world(r);
        let open = unoccluded(light, x, r.normal);
        if open == 0.0 {
            return 0.0;
        }
        let Some(aim) = Aim::new(light, x, r.normal) else { return 0.0 };
        let (mut seen, mut all) = (0.0, 0.0);
        for n in 0..rays {
            let (y, g) = aim.sample(set.point2(n, 0));
            if g > 0.0 {
                seen += g * visible(r, y);
                all += g;
            }
        }
        if all > 0.0 { open * seen / all } else { 0.0 }
    };
    let ours = |r: &Receiver, seed, i| direct_irradiance(&scene, &tracer, r, rays, Stage::Direct.key(seed, i)).mean.x;
    let ours64 =
        |r: &Receiver, seed, i| direct_irradiance(&scene, &tracer, r, 2 * rays, Stage::Direct.key(seed, i)).mean.x;
    report(
        "direct light, 32 rays",
        &receivers,
        &[
            ("independent points on the luminaire", &random),
            ("Owen-scrambled Sobol points", &sobol),
            ("the same, closed form × visible share", &ratio),
            ("the same, uniform in solid angle", &solid),
            ("isolume: on the part above the horizon, early end", &ours),
            ("isolume, 64 rays at most", &ours64),
        ],
    );
    for most in [32, 64, 128] {
        let rays = |(i, r)| direct_irradiance(&scene, &tracer, r, most, Stage::Direct.key(0, i as u64)).rays;
        let sum: u64 = receivers.par_iter().enumerate().map(rays).sum();
        println!("  isolume traces {:.1} of {most} rays on average", sum as f64 / RECEIVERS as f64);
    }

    let sky = |d: DVec3| if d.z > 0.0 { 1.0 } else { 0.2 };
    let gather = |r: &Receiver, u: [f64; 2]| {
        let direction = Frame::new(r.normal).to_world(cosine_hemisphere(u));
        let ray = scene.ray(r.position, direction, r.isovalue, r.departure);
        if tracer.occluded(&ray) { 0.5 } else { sky(direction) }
    };
    let random = |r: &Receiver, seed, i| {
        let mut rng = Rng::stream(seed, Stage::Gather, i);
        (0..64).map(|_| gather(r, rng.unit2())).sum::<f64>() / 64.0
    };
    let sobol = |r: &Receiver, seed, i| {
        let set = Sobol::set(seed, Stage::Gather, i);
        (0..64).map(|n| gather(r, set.point2(n, 0))).sum::<f64>() / 64.0
    };
    report(
        "gathered light, 64 rays",
        &receivers,
        &[("independent directions", &random), ("Owen-scrambled Sobol directions", &sobol)],
    );
}
