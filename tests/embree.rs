//! The fence around Embree: layout, callbacks, errors. Every expected distance is known without Embree.

#[path = "shared/skipped.rs"]
mod skipped;

use isolume::embree::{
    Bvh, BvhBuilder, Device, INVALID_ID, Ray, Ray16, RayHit, RayHit16, UserGeometry, UserHit, UserHits16, Valid16,
};
use isolume::error::Error;
use isolume::isa::Isa;
use skipped::skipped;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

const FAR: f32 = f32::INFINITY;

/// The unit square z = 0, counter-clockwise from above.
const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
const SQUARE: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];

/// Of triangles Embree divides by a reciprocal whose last bits are the processor's.
fn near(a: f32, b: f32) -> bool {
    (a - b).abs() <= 4.0 * f32::EPSILON * b.abs()
}

fn device() -> Device {
    Device::new(1).unwrap()
}

fn square(device: &Device) -> Bvh<'static> {
    let mut builder = BvhBuilder::new(device).unwrap();
    builder.triangles(&CORNERS, &SQUARE, u32::MAX).unwrap();
    builder.commit().unwrap()
}

/// A sphere per primitive, centred at (4·prim, 0, 0); remembers the `id` and `time` of every ray it sees.
struct Spheres {
    count: u32,
    seen: Mutex<Vec<(u32, u32)>>,
}

impl Spheres {
    const RADIUS: f32 = 1.0;

    fn new(count: u32) -> Self {
        Self { count, seen: Mutex::new(Vec::new()) }
    }
}

impl UserGeometry for Spheres {
    fn len(&self) -> u32 {
        self.count
    }

    fn bounds(&self, prim: u32) -> ([f32; 3], [f32; 3]) {
        let (x, r) = (4.0 * prim as f32, Self::RADIUS + 1e-3);
        ([x - r, -r, -r], [x + r, r, r])
    }

    fn intersect(&self, prim: u32, ray: &Ray) -> Option<UserHit> {
        self.seen.lock().unwrap().push((ray.id, ray.time));
        let o = [ray.org[0] - 4.0 * prim as f32, ray.org[1], ray.org[2]];
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (a, b, c) = (dot(ray.dir, ray.dir), dot(o, ray.dir), dot(o, o) - Self::RADIUS * Self::RADIUS);
        let root = (b * b - a * c).sqrt();
        let t = [(-b - root) / a, (-b + root) / a].into_iter().find(|&t| ray.tnear < t && t < ray.tfar)?;
        let normal = std::array::from_fn(|i| o[i] + t * ray.dir[i]);
        Some(UserHit { t, u: 0.25, v: 0.75, normal })
    }

    fn occluded(&self, prim: u32, ray: &Ray) -> bool {
        self.intersect(prim, ray).is_some()
    }
}

#[test]
fn the_library_is_a_four() {
    let version = device().version();
    assert!(version.starts_with("4.") && version.split('.').count() == 3, "{version}");
}

#[test]
fn a_triangle_is_hit_where_it_is() {
    let scene = square(&device());
    let mut rayhit = RayHit::new(Ray::new([0.75, 0.25, 3.0], [0.0, 0.0, -2.0], 0.0, FAR));
    scene.intersect1(&mut rayhit);
    assert_eq!((rayhit.hit.geometry, rayhit.hit.prim), (0, 0));
    assert!(near(rayhit.ray.tfar, 1.5), "{rayhit:?}");
    // Embree's normal is the cross product of two edges: here (0, 0, 1) for counter-clockwise.
    assert_eq!(rayhit.hit.normal, [0.0, 0.0, 1.0]);
    assert!(near(rayhit.hit.u, 0.5) && near(rayhit.hit.v, 0.25), "{rayhit:?}");
}

#[test]
fn a_miss_changes_nothing() {
    let scene = square(&device());
    for (org, tnear, tfar) in [([2.0, 0.5, 3.0], 0.0, FAR), ([0.5, 0.5, 3.0], 3.5, FAR), ([0.5, 0.5, 3.0], 0.0, 2.5)] {
        let ray = Ray::new(org, [0.0, 0.0, -1.0], tnear, tfar);
        let (mut rayhit, mut shadow) = (RayHit::new(ray), ray);
        scene.intersect1(&mut rayhit);
        assert!(!rayhit.is_hit() && rayhit.hit.prim == INVALID_ID && rayhit.ray.tfar == tfar, "{rayhit:?}");
        assert!(!scene.occluded1(&mut shadow) && shadow.tfar == tfar);
    }
}

/// Embree 4.3 and later write `instPrimID` to bytes 80..84. With embree4-sys' own 80-byte struct that is the first
/// guard word here (it came back ffffffff), and the `org[0]` of the next ray in a `Vec`, which then misses.
#[test]
fn embree_writes_nothing_behind_our_structs() {
    #[repr(C)]
    struct Guarded {
        rayhit: RayHit,
        guard: [u32; 4],
    }
    #[repr(C)]
    struct Guarded16 {
        rayhit: RayHit16,
        guard: [u32; 16],
    }
    const GUARD: u32 = 0xdead_beef;
    assert_eq!((size_of::<Guarded>(), size_of::<Guarded16>()), (112, 1408));

    let spheres = Spheres::new(1);
    let device = device();
    let mut builder = BvhBuilder::new(&device).unwrap();
    let triangles = builder.triangles(&CORNERS.map(|c| [c[0] + 10.0, c[1], c[2]]), &SQUARE, u32::MAX).unwrap();
    let sphere = builder.user(&spheres, u32::MAX).unwrap();
    let scene = builder.commit().unwrap();
    for (x, geometry, t) in [(10.5, triangles, 5.0), (0.0, sphere, 4.0)] {
        // The sphere's own t comes back as it is.
        let same = |tfar: f32| if geometry == triangles { near(tfar, t) } else { tfar == t };
        let ray = Ray::new([x, 0.0, 5.0], [0.0, 0.0, -1.0], 0.0, FAR);
        let mut one = Guarded { rayhit: RayHit::new(ray), guard: [GUARD; 4] };
        scene.intersect1(&mut one.rayhit);
        assert!(one.rayhit.hit.geometry == geometry && same(one.rayhit.ray.tfar), "{:?}", one.rayhit);
        assert_eq!(one.guard, [GUARD; 4]);

        let mut sixteen = Guarded16 { rayhit: RayHit16::new(Ray16::new(&[ray; 16])), guard: [GUARD; 16] };
        scene.intersect16(&Valid16::ALL, &mut sixteen.rayhit);
        assert_eq!(sixteen.rayhit.hit.geometry, [geometry; 16]);
        assert!(sixteen.rayhit.ray.tfar.iter().all(|&tfar| same(tfar)), "{:?}", sixteen.rayhit.ray.tfar);
        assert_eq!(sixteen.guard, [GUARD; 16]);

        let mut row = vec![RayHit::new(ray); 4];
        for rayhit in &mut row {
            scene.intersect1(rayhit);
        }
        for rayhit in &row {
            assert_eq!((rayhit.hit.geometry, rayhit.ray.org), (geometry, ray.org));
            assert!(same(rayhit.ray.tfar), "{rayhit:?}");
        }
    }
}

#[test]
fn a_user_sphere_is_hit_where_it_is() {
    let spheres = Spheres::new(3);
    let device = device();
    let mut builder = BvhBuilder::new(&device).unwrap();
    let id = builder.user(&spheres, u32::MAX).unwrap();
    let scene = builder.commit().unwrap();
    // Straight down on each; along the row from both ends; from inside.
    for (org, dir, prim, t) in [
        ([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], 0, 4.0),
        ([4.0, 0.0, 5.0], [0.0, 0.0, -2.0], 1, 2.0),
        ([8.0, 5.0, 0.0], [0.0, -1.0, 0.0], 2, 4.0),
        ([-4.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0, 3.0),
        ([12.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 2, 3.0),
        ([4.0, 0.0, 0.0], [0.0, 0.0, 0.5], 1, 2.0),
    ] {
        let ray = Ray::new(org, dir, 0.0, FAR);
        let mut rayhit = RayHit::new(ray);
        scene.intersect1(&mut rayhit);
        assert_eq!((rayhit.hit.geometry, rayhit.hit.prim, rayhit.ray.tfar), (id, prim, t), "{org:?}");
        assert_eq!((rayhit.hit.u, rayhit.hit.v, rayhit.hit.instance), (0.25, 0.75, INVALID_ID));
        let centre = [4.0 * prim as f32, 0.0, 0.0];
        assert_eq!(rayhit.hit.normal, std::array::from_fn(|i| org[i] + t * dir[i] - centre[i]));
    }
}

#[test]
fn id_and_time_arrive_bit_for_bit() {
    let spheres = Spheres::new(1);
    let device = device();
    let mut builder = BvhBuilder::new(&device).unwrap();
    builder.user(&spheres, u32::MAX).unwrap();
    let scene = builder.commit().unwrap();
    // Zeros, denormals, ones, infinities, quiet and signalling NaNs with payloads, all bits.
    let patterns = [0, 1, 0x007f_ffff, 0x8000_0001, 0x3f80_0000, 0x7f80_0000, 0xff80_0000, 0x7fc0_1234, 0x7f80_0001];
    for &id in patterns.iter().chain(&[0xffc5_4321, 0xff80_beef, u32::MAX, 47.125_f32.to_bits()]) {
        let time = !id;
        let ray = Ray { id, time, ..Ray::new([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], 0.0, FAR) };
        let mut rayhit = RayHit::new(ray);
        scene.intersect1(&mut rayhit);
        assert!(rayhit.is_hit() && scene.occluded1(&mut ray.clone()));
        assert_eq!((rayhit.ray.id, rayhit.ray.time), (id, time));
        assert_eq!(std::mem::take(&mut *spheres.seen.lock().unwrap()), [(id, time); 2], "{id:#010x}");
    }
}

#[test]
fn occluded_and_packets_agree_with_intersect() {
    let spheres = Arc::new(Spheres::new(5));
    let device = device();
    let mut builder = BvhBuilder::new(&device).unwrap();
    builder.user_shared(Arc::clone(&spheres), u32::MAX).unwrap();
    builder.triangles(&CORNERS.map(|c| [20.0 * c[0] - 2.0, 8.0 * c[1] - 4.0, -0.5]), &SQUARE, u32::MAX).unwrap();
    let scene = builder.commit().unwrap();
    // A fixed fan of rays, two thirds of which end before, on or behind something.
    let (mut hits, mut rays) = (0, Vec::new());
    for i in 0..1600_u32 {
        let x = |k: u32| (i.wrapping_mul(2_654_435_761).wrapping_mul(k) >> 8) as f32 / (1 << 24) as f32;
        let tfar = if i % 3 == 0 { FAR } else { 2.0 + 6.0 * x(7) };
        let ray = Ray::new([24.0 * x(3) - 4.0, 10.0 * x(5) - 5.0, 4.0], [x(11) - 0.5, x(13) - 0.5, -1.0], 0.0, tfar);
        rays.push(Ray { id: i, ..ray });
    }
    for sixteen in rays.chunks_exact(16).map(|rays| <&[Ray; 16]>::try_from(rays).unwrap()) {
        let active = 0xbeef_u16.rotate_left(sixteen[0].id / 16);
        let (mut packet, mut shadows) = (RayHit16::new(Ray16::new(sixteen)), Ray16::new(sixteen));
        scene.intersect16(&Valid16::from_bits(active), &mut packet);
        scene.occluded16(&Valid16::from_bits(active), &mut shadows);
        for (lane, &ray) in sixteen.iter().enumerate() {
            let mut rayhit = RayHit::new(ray);
            scene.intersect1(&mut rayhit);
            hits += u32::from(rayhit.is_hit());
            assert_eq!(scene.occluded1(&mut ray.clone()), rayhit.is_hit(), "{ray:?}");
            if active >> lane & 1 == 0 {
                rayhit = RayHit::new(ray);
            }
            assert_eq!(packet.hit.geometry[lane], rayhit.hit.geometry, "{ray:?}");
            assert_eq!(packet.hit.prim[lane], rayhit.hit.prim);
            assert!((packet.ray.tfar[lane] - rayhit.ray.tfar).abs() < 1e-5 || packet.ray.tfar[lane] == FAR);
            assert_eq!(shadows.tfar[lane] == f32::NEG_INFINITY, rayhit.is_hit());
        }
    }
    assert!((300..1300).contains(&hits), "{hits} of 1600 rays hit: the fan tests nothing");
}

/// Hits nothing, and counts how rays arrive: single ones, and those of packets.
#[derive(Default)]
struct Counter {
    single: AtomicU32,
    together: AtomicU32,
}

impl Counter {
    fn packet(&self, active: u16) -> u16 {
        self.together.fetch_add(active.count_ones(), Ordering::Relaxed);
        0
    }
}

impl UserGeometry for Counter {
    fn len(&self) -> u32 {
        1
    }
    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        ([-1.0; 3], [1.0; 3])
    }
    fn intersect(&self, _: u32, _: &Ray) -> Option<UserHit> {
        self.single.fetch_add(1, Ordering::Relaxed);
        None
    }
    fn occluded(&self, prim: u32, ray: &Ray) -> bool {
        self.intersect(prim, ray).is_some()
    }
    fn intersect16(&self, _: u32, active: u16, _: &Ray16, _: &mut UserHits16) -> u16 {
        self.packet(active)
    }
    fn occluded16(&self, _: u32, active: u16, _: &Ray16) -> u16 {
        self.packet(active)
    }
}

/// Embree takes sixteen rays apart, one by one, where its own vectors are eight wide.
#[test]
fn packets_arrive_as_packets() {
    for name in Isa::NAMES.iter().filter(|name| Isa::found().iter().all(|isa| isa.name() != **name)) {
        skipped(name, "this machine has no such instructions");
    }
    if Isa::found().len() < 2 {
        return;
    }
    let (device, counter) = (device(), Counter::default());
    let mut builder = BvhBuilder::new(&device).unwrap();
    builder.user(&counter, u32::MAX).unwrap();
    let scene = builder.commit().unwrap();
    let rays = Ray16::new(&[Ray::new([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], 0.0, FAR); 16]);
    for active in [0xffff, 0x00ff, 0x8000, 0x0110] {
        scene.intersect16(&Valid16::from_bits(active), &mut RayHit16::new(rays));
        let mut shadows = rays;
        scene.occluded16(&Valid16::from_bits(active), &mut shadows);
    }
    let count = |x: &AtomicU32| x.load(Ordering::Relaxed);
    assert_eq!((count(&counter.single), count(&counter.together)), (0, 2 * (16 + 8 + 1 + 2)));
}

/// A geometry whose hits lie outside the ray, or nowhere.
struct Liar(f32);

impl UserGeometry for Liar {
    fn len(&self) -> u32 {
        1
    }
    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        ([-1.0; 3], [1.0; 3])
    }
    fn intersect(&self, _: u32, _: &Ray) -> Option<UserHit> {
        Some(UserHit { t: self.0, u: 0.0, v: 0.0, normal: [0.0; 3] })
    }
    fn occluded(&self, _: u32, _: &Ray) -> bool {
        true
    }
}

#[test]
fn hits_outside_the_ray_are_ignored() {
    for (t, counts) in [(1.0, true), (4.0, true), (8.0, true), (0.5, false), (8.5, false), (f32::NAN, false)] {
        let liar = Liar(t);
        let mut builder = BvhBuilder::new(&device()).unwrap();
        builder.user(&liar, u32::MAX).unwrap();
        let scene = builder.commit().unwrap();
        let mut rayhit = RayHit::new(Ray::new([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], 1.0, 8.0));
        scene.intersect1(&mut rayhit);
        assert_eq!((rayhit.is_hit(), rayhit.ray.tfar), if counts { (true, t) } else { (false, 8.0) }, "{t}");
    }
}

#[test]
fn masks_select_geometries() {
    let spheres = Spheres::new(1);
    let mut builder = BvhBuilder::new(&device()).unwrap();
    let sphere = builder.user(&spheres, 0b01).unwrap();
    let floor = builder.triangles(&CORNERS.map(|c| [c[0] - 0.5, c[1] - 0.5, -2.0]), &SQUARE, 0b10).unwrap();
    let scene = builder.commit().unwrap();
    for (mask, geometry) in [(0b11, sphere), (0b01, sphere), (0b10, floor), (0b100, INVALID_ID)] {
        let ray = Ray { mask, ..Ray::new([0.0, 0.0, 5.0], [0.0, 0.0, -1.0], 0.0, FAR) };
        let mut rayhit = RayHit::new(ray);
        scene.intersect1(&mut rayhit);
        assert_eq!(rayhit.hit.geometry, geometry, "mask {mask:#b}");
        assert_eq!(scene.occluded1(&mut ray.clone()), geometry != INVALID_ID);
    }
}

/// A ray that starts on a ROBUST triangle sees it at t = 0: a grid point on a wall plane is on the wall.
#[test]
fn a_ray_that_starts_on_a_wall_sees_it() {
    let scene = square(&device());
    for down in [-1.0, 1.0] {
        let ray = Ray::new([0.75, 0.25, 0.0], [0.0, 0.0, down], 0.0, FAR);
        let mut rayhit = RayHit::new(ray);
        scene.intersect1(&mut rayhit);
        assert_eq!((rayhit.hit.geometry, rayhit.ray.tfar), (0, 0.0));
        assert!(scene.occluded1(&mut ray.clone()));
    }
}

#[test]
fn empty_geometries_and_scenes_are_fine() {
    let (device, nothing) = (device(), Spheres::new(0));
    let mut builder = BvhBuilder::new(&device).unwrap();
    assert_eq!(builder.triangles(&[], &[], u32::MAX).unwrap(), 0);
    assert_eq!(builder.user(&nothing, u32::MAX).unwrap(), 1);
    for scene in [builder.commit().unwrap(), BvhBuilder::new(&device).unwrap().commit().unwrap()] {
        let ray = Ray::new([0.5, 0.5, 1.0], [0.0, 0.0, -1.0], 0.0, FAR);
        let mut rayhit = RayHit::new(ray);
        scene.intersect1(&mut rayhit);
        assert!(!rayhit.is_hit() && !scene.occluded1(&mut ray.clone()));
    }
}

#[test]
fn what_embree_would_swallow_is_refused() {
    struct Box([f32; 3], [f32; 3]);
    impl UserGeometry for Box {
        fn len(&self) -> u32 {
            1
        }
        fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
            (self.0, self.1)
        }
        fn intersect(&self, _: u32, _: &Ray) -> Option<UserHit> {
            None
        }
        fn occluded(&self, _: u32, _: &Ray) -> bool {
            false
        }
    }
    let invalid = |result: Result<u32, Error>, words: &str| match result {
        Err(Error::Invalid(message)) => assert!(message.contains(words), "{message}"),
        other => panic!("{other:?} instead of an error about {words:?}"),
    };
    let bad = [
        Box([0.0; 3], [f32::NAN; 3]),
        Box([0.0; 3], [f32::INFINITY; 3]),
        Box([1.0; 3], [0.0; 3]),
        Box([-1.9e18; 3], [0.0; 3]),
    ];
    let mut builder = BvhBuilder::new(&device()).unwrap();
    for geometry in &bad {
        invalid(builder.user(geometry, u32::MAX), "user primitive 0 has the bounds");
    }
    invalid(builder.triangles(&CORNERS, &[[0, 1, 2], [1, 2, 4]], u32::MAX), "triangle 1 has the vertices [1, 2, 4]");
    invalid(builder.triangles(&[[0.0; 3], [f32::NAN; 3], [1.0; 3]], &[[0, 1, 2]], u32::MAX), "vertex 1 is");
    invalid(builder.triangles(&[[2e18; 3]; 3], &[[0, 1, 2]], u32::MAX), "vertex 0 is");
}

/// Scenes are queried by rayon's threads, and outlive the `Device` value they were made with.
#[test]
fn scenes_are_shared_between_threads() {
    let scene = square(&device());
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for i in 0..1000 {
                    let x = (i as f32 + 0.5) / 1000.0;
                    let mut rayhit = RayHit::new(Ray::new([x, 0.5, 2.0], [0.0, 0.0, -1.0], 0.0, FAR));
                    scene.intersect1(&mut rayhit);
                    assert!(near(rayhit.ray.tfar, 2.0), "{rayhit:?}");
                }
            });
        }
    });
}
