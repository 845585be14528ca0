//! Gather rays of the sweep engine (RGB lookup, cosine and accumulation included) against Embree's rays on the triangles
//! of one extracted isosurface; per CPU second, interleaved in one run.

use glam::{DVec3, Vec3};
use isolume::embree::{Device, Ray, RayHit, SceneBuilder};
use isolume::field::{Field, Sweep};
use isolume::isosurface::extract;
use isolume::progress::processor_seconds;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::sweep::{SweepSettings, sweep};
use isolume::volume::generate::Generator;
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;
use std::time::Instant;

fn bumps(n: usize) -> Scene {
    let volume = Generator::from_name("bumps").and_then(|g| g.sample([n; 3])).expect("a volume");
    let field = Field::new(&volume, Sweep::new(3.6, 95.0).expect("a sweep")).expect("a field");
    let walls = cornell_box(field.lattice(), 0.0).expect("a box");
    Scene::new(field, Surface::default(), Boundary::Open, walls).expect("a scene")
}

/// Cosine-distributed rays off the isosurface of the middle isovalue, in random order.
fn bounces(scene: &Scene, count: usize) -> (Vec<[f32; 3]>, Vec<[u32; 3]>, Vec<Ray>) {
    let surface = extract(scene.lattice().dims(), scene.field.samples(), 0.4).expect("a mesh");
    let vertices: Vec<[f32; 3]> = surface.vertices.iter().map(|p| p.as_vec3().to_array()).collect();
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let rays = (0..count)
        .map(|_| {
            let p = Vec3::from_array(vertices[(rng.unit() * vertices.len() as f64) as usize]);
            let n = scene.field.falling_normal(p.as_dvec3()).unwrap_or(DVec3::Z);
            let d = Frame::new(n).to_world(cosine_hemisphere(rng.unit2())).as_vec3();
            Ray::new((p + 1e-2 * n.as_vec3()).to_array(), d.to_array(), 0.0, f32::INFINITY)
        })
        .collect();
    (vertices, surface.triangles.clone(), rays)
}

fn main() {
    let all = std::env::args().any(|a| a == "--full");
    let device = Device::new(1).expect("Embree starts");
    println!("per CPU second (all threads), {} threads, Embree {}", rayon::current_num_threads(), device.version());
    for n in if all { vec![64, 101, 128, 256] } else { vec![101, 128] } {
        let scene = bumps(n);
        let (vertices, triangles, rays) = bounces(&scene, 1 << 20);
        let mut builder = SceneBuilder::new(&device).expect("a scene");
        builder.triangles(&vertices, &triangles, u32::MAX).expect("triangles");
        let mesh = builder.commit().expect("a built scene");
        let settings = |max_bounces, light_points| SweepSettings {
            directions: 64,
            light_points,
            max_bounces,
            replicates: 1,
            ..SweepSettings::default()
        };
        let (mut exact, mut gather, mut direct, mut node) = (0f64, 0f64, 0f64, 0f64);
        for _ in 0..3 {
            let start = processor_seconds();
            let hits: usize = rays
                .par_chunks(1 << 12)
                .map(|chunk| {
                    chunk
                        .iter()
                        .filter(|&&ray| {
                            let mut hit = RayHit::new(ray);
                            mesh.intersect1(&mut hit);
                            hit.is_hit()
                        })
                        .count()
                })
                .sum();
            assert!(hits > 0);
            exact = exact.max(rays.len() as f64 / (processor_seconds() - start).max(1e-2));
            let time = |s: SweepSettings| {
                let start = processor_seconds();
                let out = sweep(&scene, &s, &|_| true).expect("a sweep");
                (processor_seconds() - start, out)
            };
            let (t0, _) = time(settings(0, 1));
            let (t1, _) = time(settings(0, 17));
            let (t2, out) = time(settings(1, 1));
            gather = gather.max(out.counts.gather_rays as f64 / (t2 - t0).max(1e-9));
            node = node.max(scene.lattice().len() as f64 * 32.0 / (t2 - t0).max(1e-9));
            direct = direct.max(16.0 * out.counts.valid as f64 / (t1 - t0).max(1e-9));
        }
        println!(
            "{n:4}³: Embree triangles {:6.1} M rays/s ({} triangles); gather {:6.1} M/s ({:.1}×; {:.1} M/s with masked nodes); \
             direct {:6.1} M/s ({:.1}×)",
            exact * 1e-6,
            triangles.len(),
            gather * 1e-6,
            gather / exact,
            node * 1e-6,
            direct * 1e-6,
            direct / exact
        );
        let start = Instant::now();
        let cpu = processor_seconds();
        let out = sweep(
            &scene,
            &SweepSettings { directions: 128, light_points: 64, replicates: 1, ..settings(64, 64) },
            &|_| true,
        )
        .expect("a sweep");
        println!(
            "      converged: {:.2} s ({:.2} CPU s), {} bounces",
            start.elapsed().as_secs_f64(),
            processor_seconds() - cpu,
            out.bounces
        );
    }
}
