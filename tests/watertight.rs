//! Packets of rays against single rays, and volumes among walls against volumes alone, degenerate rays included. Rays
//! from inside and rays that leave the surface are counted in `tests/selftest.rs`.

use glam::{DVec3, Vec3};
use isolume::embree::{Device, GraphTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::{FlattenedRay, Target};
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::selftest::watertight::{direction, noise, start};
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};

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

/// Embree tests the boxes of several primitives, without care, and that of a single one not at all: no wall around a
/// volume may cost a ray that grazes the volume's faces, edges or corners, or travels within them.
#[test]
fn walls_hide_nothing_of_what_touches_the_faces() {
    let dims = [9, 6, 12];
    let lattice = Lattice::aligned(dims, DVec3::new(0.3, -7.0, 2.0), DVec3::new(0.1, 0.7, 0.3)).unwrap();
    let mut rng = Rng::stream(7, Stage::Test, 0);
    // Level sets that end on all faces.
    let samples = (0..lattice.len()).map(|_| (rng.bits() % 4) as f32).collect();
    let volume = Volume::new("noise", lattice, Samples::F32(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(0.0, 3.0).unwrap()).unwrap();
    let walls = cornell_box(field.lattice(), 0.2).unwrap();
    let [alone, among] = [Vec::new(), walls]
        .map(|polygons| Scene::new(field.clone(), Surface::default(), Boundary::Open, polygons).unwrap());
    let device = Device::new(1).unwrap();
    let [alone, among] = [&alone, &among].map(|scene| GraphTracer::new(&device, scene).unwrap());
    let far = field.lattice().far();
    let rays: Vec<_> = (0..400_000)
        .map(|n| {
            // A point on a face, an edge or a corner, and an origin inside the walls, from within the same planes too.
            let bits = rng.bits();
            let [mut to, mut from] = [0.0, 0.1].map(|margin| {
                DVec3::from_array([0, 1, 2].map(|_| rng.unit())) * (1.0 + 2.0 * margin) * far - margin * far
            });
            for a in (0..3).filter(|a| bits >> a & 1 == 1) {
                to[a] = if bits >> (a + 3) & 1 == 1 { far[a] } else { 0.0 };
                if bits >> (a + 6) & 1 == 1 {
                    from[a] = to[a];
                }
            }
            let c = if n % 2 == 0 { rng.unit() as f32 } else { [1.0, 2.0][(bits >> 9) as usize % 2] / 3.0 };
            FlattenedRay::free(from.as_vec3(), (to - from).as_vec3(), c)
        })
        .filter(|ray| ray.direction != Vec3::ZERO)
        .collect();
    let mut hits = [vec![None; rays.len()], vec![None; rays.len()]];
    alone.intersect_many(&rays, &mut hits[0]);
    among.intersect_many(&rays, &mut hits[1]);
    let found = hits[0].iter().flatten().count();
    assert!(found > rays.len() / 4, "{found} of {}", rays.len());
    for ((ray, own), among_walls) in rays.iter().zip(&hits[0]).zip(&hits[1]) {
        if own.is_some() {
            assert_eq!(own, among_walls, "{ray:?}");
            assert_eq!(*own, among.intersect(ray), "{ray:?}");
            assert!(among.occluded(ray), "{ray:?}");
        }
    }
}
