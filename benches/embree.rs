//! What Embree itself costs: a user geometry that never hits, against triangles.
//! One thread; the best of seven interleaved runs, in nanoseconds per ray.

use isolume::embree::{Bvh, BvhBuilder, Device, Ray, Ray16, RayHit, RayHit16, UserGeometry, UserHit, Valid16};
use isolume::isa::Isa;
use std::hint::black_box;
use std::time::Instant;

const RAYS: usize = 1 << 20;

/// One box that every ray enters, and nothing inside.
struct Null;

impl UserGeometry for Null {
    fn len(&self) -> u32 {
        1
    }
    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        ([0.0; 3], [1.0; 3])
    }
    #[inline]
    fn intersect(&self, _: u32, _: &Ray) -> Option<UserHit> {
        None
    }
    #[inline]
    fn occluded(&self, _: u32, _: &Ray) -> bool {
        false
    }
}

fn main() {
    let device = Device::new(1).expect("Embree starts");
    // Two scenes: a mask hides triangles, but their hierarchy would still be walked.
    let mut builder = BvhBuilder::new(&device).expect("a scene");
    builder.user(&Null, u32::MAX).expect("a user geometry");
    let null = builder.commit().expect("a built scene");
    // A 64×64 grid of squares in the plane z = 0.5, tilted a little.
    let at = |i: u32| [(i % 65) as f32 / 64.0, (i / 65) as f32 / 64.0, 0.5 + 1e-3 * (i % 7) as f32];
    let vertices: Vec<_> = (0..65 * 65).map(at).collect();
    let corners = (0..64 * 64_u32).map(|i| i % 64 + i / 64 * 65);
    let indices: Vec<_> = corners.flat_map(|c| [[c, c + 1, c + 66], [c, c + 66, c + 65]]).collect();
    let mut builder = BvhBuilder::new(&device).expect("a scene");
    builder.triangles(&vertices, &indices, u32::MAX).expect("triangles");
    let mesh = builder.commit().expect("a built scene");

    // From a point of the face z = 0 to one of the face z = 1: incoherent, and always through the box.
    let mut state = 1_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let rays: Vec<Ray> = (0..RAYS)
        .map(|_| {
            let (from, to) = ([uniform(), uniform(), -0.5], [uniform(), uniform(), 1.0]);
            Ray::new(from, std::array::from_fn(|a| to[a] - from[a]), 0.0, f32::INFINITY)
        })
        .collect();
    let rays = &rays[..];
    let singly = |scene: &Bvh, rays: &[Ray]| {
        rays.iter()
            .filter(|&&ray| {
                let mut rayhit = RayHit::new(ray);
                scene.intersect1(&mut rayhit);
                rayhit.is_hit()
            })
            .count()
    };
    let shadows = |scene: &Bvh, rays: &[Ray]| rays.iter().filter(|&&ray| scene.occluded1(&mut ray.clone())).count();
    let packets = |scene: &Bvh, rays: &[Ray]| {
        let mut hits = 0;
        for sixteen in rays.as_chunks::<16>().0 {
            let mut rayhit = RayHit16::new(Ray16::new(sixteen));
            scene.intersect16(&Valid16::ALL, &mut rayhit);
            hits += rayhit.hit.geometry.iter().filter(|&&geometry| geometry == 0).count();
        }
        hits
    };
    let copied = |_: &Bvh, rays: &[Ray]| rays.iter().filter(|&&ray| black_box(&RayHit::new(ray)).is_hit()).count();

    type Run<'r> = (&'r str, &'r Bvh<'r>, &'r [Ray], &'r dyn Fn(&Bvh, &[Ray]) -> usize, usize);
    let runs: [Run; 6] = [
        ("no Embree: the ray is set up", &null, rays, &copied, 0),
        ("intersect1, null callback", &null, rays, &singly, 0),
        ("occluded1, null callback", &null, rays, &shadows, 0),
        ("intersect16, null callback per lane", &null, rays, &packets, 0),
        ("intersect1, 8192 triangles", &mesh, rays, &singly, RAYS),
        ("intersect16, 8192 triangles", &mesh, rays, &packets, RAYS),
    ];
    let mut best = [f64::INFINITY; 6];
    for _ in 0..7 {
        for ((_, scene, rays, run, hits), best) in runs.iter().zip(&mut best) {
            let start = Instant::now();
            assert_eq!(black_box(run(scene, black_box(rays))), *hits);
            *best = best.min(start.elapsed().as_secs_f64());
        }
    }
    println!("Embree {}, {}", device.version(), Isa::current().name());
    for ((name, ..), best) in runs.iter().zip(best) {
        println!("{name:38} {:7.1} ns per ray", best / RAYS as f64 * 1e9);
    }
}
