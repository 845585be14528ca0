//! Packets of rays against single rays, degenerate ones included. Rays from inside and rays that leave the surface are
//! counted in `tests/selftest.rs`.

use glam::{DVec3, Vec3};
use isolume::embree::{Device, GraphTracer};
use isolume::flattened::{FlattenedRay, Target};
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::selftest::watertight::{direction, noise, start};
use isolume::tracer::Tracer;

#[test]
fn batches_find_what_single_rays_find() {
    let plain = noise([33, 34, 35], [DVec3::ONE, DVec3::ZERO], 4).unwrap();
    for (boundary, margin) in [(Boundary::Open, 0.0), (Boundary::Open, 0.2), (Boundary::Capped, 0.2)] {
        let polygons = cornell_box(plain.lattice(), margin).unwrap();
        let scene = Scene::new(plain.field.clone(), Surface::default(), boundary, polygons).unwrap();
        let device = Device::new(1).unwrap();
        let tracer = GraphTracer::new(&device, &scene).unwrap();
        let mut rng = Rng::stream(9, Stage::Test, 0);
        // Not a multiple of sixteen.
        let rays: Vec<_> = (0..50_003)
            .map(|_| {
                let origin: Vec3 = start(&mut rng, scene.lattice().dims()).as_vec3();
                let mut ray = FlattenedRay::free(origin, direction(&mut rng).as_vec3(), 0.9 * rng.unit() as f32);
                if rng.bits().is_multiple_of(4) {
                    ray.reach = (10.0 * rng.unit()) as f32;
                }
                ray
            })
            .collect();
        let mut hits = vec![None; rays.len()];
        let mut blocked = vec![false; rays.len()];
        tracer.intersect_many(&rays, &mut hits);
        tracer.occluded_many(&rays, &mut blocked);
        let mut kinds = [0; 3];
        for ((ray, hit), blocked) in rays.iter().zip(hits).zip(blocked) {
            assert_eq!(hit.is_some(), blocked, "{ray:?}");
            // Embree may ask for the volume with the reach that a polygon left over, or the other way round.
            assert_eq!(hit, tracer.intersect(ray), "{ray:?}");
            kinds[match hit.map(|h| h.target) {
                Some(Target::Polygon(_)) => 0,
                Some(_) => 1,
                None => 2,
            }] += 1;
        }
        assert!(kinds.iter().all(|&n| n > 100), "{kinds:?}: polygons, volume, nothing");
    }
}
