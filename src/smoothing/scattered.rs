//! Light smoothed over places scattered beside grid points.

use super::{CONE, Halves, Smoothed, Smoothing, Surroundings};
use crate::node_set::NodeSet;
use crate::progress::Tick;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Places of the graph, each of which belongs to a point of a lattice that is at most a step away along every axis.
#[derive(Debug)]
pub struct Scattered<'a> {
    /// The lattice.
    pub lattice: &'a Lattice,
    /// The points that have places.
    pub owners: &'a NodeSet,
    /// The first place of each of them; one more entry than points.
    pub starts: &'a [u32],
    /// In local coordinates of the field.
    pub positions: &'a [Vec3],
}

/// What is known of a place.
#[derive(Clone, Copy, Default)]
struct Place {
    /// Of the side in question; 0 where there is no light.
    normal: Vec3,
    isovalue: f32,
    /// Largest isovalue difference of places that share its light.
    tau: f32,
}

/// Radius of the fits, in the lattice's shortest spacing: less than that for points, since a point has several places.
const RADIUS: f64 = 1.75;
/// Places whose distance is looked at together.
const CHUNK: usize = 8;

/// Scattered places at work.
struct Cloud<'a> {
    scattered: &'a Scattered<'a>,
    places: Vec<Place>,
    /// x, y and z of the places in radii of the fits, and a whole chunk more.
    positions: [Vec<f32>; 3],
    /// From local coordinates of the field to the lattice.
    to_lattice: Vec3,
    /// How far places' owners may be from a place, in the lattice.
    reach: Vec3,
}

/// Smooths the irradiance of scattered places whose two `halves` are given by their number, and returns it by that
/// number. Places share light if their normals agree and their isovalues differ by `tau` at most, or by what h rises in
/// half a step of the lattice where that is more: a steep edge has few places of one isovalue. Places without light
/// (NaN) or without a normal take no part and stay 0. 80 bytes per place. The same bits on any number of threads. None
/// once `tick` says stop.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
pub fn smooth_scattered(
    smoothing: Smoothing<'_>,
    scattered: &Scattered<'_>,
    halves: &(dyn Fn(usize) -> Halves + Sync),
    tick: Tick,
) -> Option<Vec<Smoothed>> {
    let cloud = Cloud::new(smoothing, scattered, halves);
    let once = cloud.each(tick, |n| cloud.fit(n, halves))?;
    let twice = cloud.each(tick, |n| cloud.fit_again(n, halves, |m| once[m]))?;
    drop(once);
    let blended = cloud.each(tick, |n| cloud.blend(n, halves, |m| twice[m]))?;
    drop(twice);
    cloud.each(tick, |n| cloud.mean(n, |m| blended[m]))
}

impl<'a> Cloud<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn new(
        Smoothing { scene, side, tau }: Smoothing<'_>,
        scattered: &'a Scattered<'a>,
        halves: &(dyn Fn(usize) -> Halves + Sync),
    ) -> Self {
        let (field, lattice) = (&scene.field, scattered.lattice);
        let step = lattice.spacing().min_element();
        let place = |(n, p): (usize, &Vec3)| {
            if halves(n)[0].is_nan() {
                return Place::default();
            }
            let p = p.as_dvec3();
            let normal = scene.normal(p, side).unwrap_or_default().as_vec3();
            let rise = 0.5 * step * field.gradient(p).length();
            Place { normal, isovalue: field.value(p) as f32, tau: tau.max(rise) as f32 }
        };
        let places = scattered.positions.par_iter().enumerate().with_min_len(1024).map(place).collect();
        let to_radii = field.lattice().axes() * (1.0 / (RADIUS * step));
        let positions = [0, 1, 2].map(|a| {
            let row = to_radii.row(a);
            let all = scattered.positions.par_iter().map(|p| row.dot(p.as_dvec3()) as f32);
            all.chain([f32::INFINITY; CHUNK]).collect()
        });
        let inverse = lattice.axes().inverse();
        let reach = DVec3::from_array(std::array::from_fn(|a| inverse.row(a).length() * RADIUS * step)) + 1.0;
        let to_lattice = (lattice.far() / field.lattice().far()).as_vec3();
        Self { scattered, places, positions, to_lattice, reach: reach.as_vec3() }
    }

    /// Which of the places from `first` on lie within a radius of one, bit by bit.
    #[inline(always)]
    fn near(&self, first: usize, position: Vec3) -> u32 {
        let chunk = |a: usize| -> &[f32; CHUNK] { self.positions[a][first..][..CHUNK].try_into().expect("a chunk") };
        let (x, y, z) = (chunk(0), chunk(1), chunk(2));
        let mut near = 0;
        for l in 0..CHUNK {
            let (x, y, z) = (x[l] - position.x, y[l] - position.y, z[l] - position.z);
            near |= u32::from(x * x + y * y + z * z < 1.0) << l;
        }
        near
    }

    #[inline(always)]
    fn position(&self, n: usize) -> Vec3 {
        let [x, y, z] = &self.positions;
        Vec3::new(x[n], y[n], z[n])
    }

    /// `f` of every place with light, nothing of the others; none once `tick` says stop.
    fn each<T: Default + Send>(&self, tick: Tick, f: impl Fn(usize) -> T + Sync) -> Option<Vec<T>> {
        let of = |n: usize| match self.places[n].normal {
            Vec3::ZERO => Some(T::default()),
            _ => tick(0).then(|| f(n)),
        };
        (0..self.places.len()).into_par_iter().with_min_len(64).map(of).collect()
    }
}

impl Surroundings for Cloud<'_> {
    type Place = usize;

    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn around(&self, at: usize, mut visit: impl FnMut(usize, Vec3, f32)) {
        let Scattered { lattice, owners, starts, positions } = self.scattered;
        let (place, position) = (self.places[at], self.position(at));
        let centre = positions[at] * self.to_lattice;
        let lo = (centre - self.reach).ceil().max(Vec3::ZERO).to_array().map(|x| x as usize);
        let hi = (centre + self.reach).floor().to_array().map(|x| x as usize);
        let last = lattice.dims().map(|n| n - 1);
        for z in lo[2]..=hi[2].min(last[2]) {
            for y in lo[1]..=hi[1].min(last[1]) {
                // The places of points that follow one another do so, too.
                let row = |x: usize| starts[owners.before(lattice.offset(0, y, z) + x)] as usize;
                let range = row(lo[0])..row(hi[0].min(last[0]) + 1);
                for first in range.clone().step_by(CHUNK) {
                    let count = (range.end - first).min(CHUNK);
                    let mut near = self.near(first, position) & ((1 << count) - 1);
                    while near != 0 {
                        let m = first + near.trailing_zeros() as usize;
                        near &= near - 1;
                        let other = &self.places[m];
                        let alike = (other.isovalue - place.isovalue).abs() <= place.tau;
                        if alike && other.normal.dot(place.normal) >= CONE {
                            let d = self.position(m) - position;
                            visit(m, d, d.length_squared());
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::flattened::Side;
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Scene, Surface};
    use crate::volume::Samples;

    /// Four places about most points of three in four planes of x, where h rises by `slope` a step from x = 0 and falls
    /// from x = 8 on.
    struct Steep {
        scene: Scene,
        owners: NodeSet,
        starts: Vec<u32>,
        positions: Vec<Vec3>,
    }

    impl Steep {
        fn new(slope: f32) -> Self {
            let lattice = Lattice::aligned([17, 14, 15], DVec3::ZERO, DVec3::ONE).unwrap();
            let height = |o: usize| slope * (8.0 - (lattice.ijk(o)[0] as f32 - 8.0).abs());
            let samples = (0..lattice.len()).map(height).collect();
            let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 8.0);
            let owners = NodeSet::new(lattice.len(), |o| !lattice.ijk(o)[0].is_multiple_of(4));
            let (mut positions, mut starts) = (Vec::new(), vec![0]);
            for o in owners.members(0..lattice.len()) {
                let mut rng = Rng::stream(1, Stage::Test, o as u64);
                // A point may have none.
                for _ in 0..if o.is_multiple_of(5) { 0 } else { 4 } {
                    let offset = DVec3::from_array(std::array::from_fn(|_| 2.0 * rng.unit() - 1.0));
                    let p = lattice.point(o) + offset;
                    positions.push(p.clamp(DVec3::ZERO, lattice.far()).as_vec3());
                }
                starts.push(positions.len() as u32);
            }
            let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap();
            Self { scene, owners, starts, positions }
        }

        fn scattered(&self) -> Scattered<'_> {
            let (lattice, owners) = (self.scene.field.lattice(), &self.owners);
            Scattered { lattice, owners, starts: &self.starts, positions: &self.positions }
        }

        fn smoothing(&self) -> Smoothing<'_> {
            Smoothing { scene: &self.scene, side: Side::Lower, tau: 0.01 }
        }

        /// `light` with noise of standard deviation 0.1 on either half, as it is and smoothed.
        fn smoothed(&self, light: impl Fn(DVec3) -> f32) -> (Vec<Halves>, Vec<Smoothed>) {
            let noisy = |(n, p): (usize, &Vec3)| {
                let mut rng = Rng::stream(2, Stage::Test, n as u64);
                let mut noise = || 0.1 * 12f64.sqrt() * (rng.unit() - 0.5);
                [noise(), noise()].map(|noise| Vec3::splat(light(p.as_dvec3()) + noise as f32))
            };
            let halves: Vec<Halves> = self.positions.iter().enumerate().map(noisy).collect();
            let get = |n: usize| halves[n];
            let smoothed = smooth_scattered(self.smoothing(), &self.scattered(), &get, &|_| true);
            (halves, smoothed.unwrap())
        }

        /// RMS error of the mean before and after, at the places judged.
        fn errors(&self, light: impl Fn(DVec3) -> f32, judged: impl Fn(DVec3) -> bool) -> [f64; 2] {
            let (halves, smoothed) = self.smoothed(&light);
            let (mut sums, mut count) = ([0.0; 2], 0.0);
            for ((p, [a, b]), smoothed) in self.positions.iter().zip(halves).zip(smoothed) {
                let p = p.as_dvec3();
                if judged(p) {
                    let errors = [0.5 * (a.x + b.x), smoothed.mean.x].map(|x| f64::from(x - light(p)));
                    sums = [0, 1].map(|n| sums[n] + errors[n] * errors[n]);
                    count += 1.0;
                }
            }
            assert!(count > 100.0, "{count} places");
            sums.map(|s: f64| (s / count).sqrt())
        }
    }

    #[test]
    fn noise_goes_where_light_is_linear_and_edges_stay() {
        // A step of the lattice is an eighth of the sweep: far more than tau.
        let steep = Steep::new(1.0);
        let [before, after] = steep.errors(|p| (0.5 + 0.03 * p.y - 0.02 * p.z + 0.01 * p.x) as f32, |_| true);
        println!("linear {before} -> {after}");
        assert!((before / 0.0707 - 1.0).abs() < 0.05 && after < 0.6 * before);
        let light = |p: DVec3| if p.y < 6.5 { 0.1 } else { 1.1 };
        let [before, after] = steep.errors(light, |p| (5.5..7.5).contains(&p.y));
        println!("at the edge {before} -> {after}");
        assert!(after < 1.15 * before);
        let [before, after] = steep.errors(light, |p| !(3.5..9.5).contains(&p.y));
        println!("away from it {before} -> {after}");
        assert!(after < 0.7 * before);
    }

    /// The ridge at x = 8 is bright on one face and dark on the other; no light crosses it, however near.
    #[test]
    fn faces_turned_away_from_each_other_share_nothing() {
        let light = |p: DVec3| if p.x < 8.0 { 0.0 } else { 1.0 };
        let [before, after] = Steep::new(1.0).errors(light, |p| (7.0..9.0).contains(&p.x));
        println!("at the ridge {before} -> {after}");
        assert!(after < 0.9 * before);
    }

    #[test]
    fn places_without_light_take_no_part_and_threads_do_not_matter() {
        let steep = Steep::new(1.0);
        let light = |p: DVec3| if (4.0..6.0).contains(&p.z) { f32::NAN } else { 0.5 };
        let [before, after] = steep.errors(light, |p| !(4.0..6.0).contains(&p.z));
        assert!(after < 0.6 * before, "{before} -> {after}");
        let with = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| steep.smoothed(light).1)
        };
        let one = with(1);
        assert_eq!(one, with(3));
        let dark = one.iter().zip(&steep.positions).filter(|(_, p)| light(p.as_dvec3()).is_nan());
        assert!(dark.clone().count() > 100 && dark.clone().all(|(s, _)| *s == Smoothed::default()));
    }

    #[test]
    fn a_stop_gives_nothing_rather_than_a_part() {
        use std::sync::atomic::{AtomicUsize, Ordering};
        let steep = Steep::new(1.0);
        // In the midst of the second pass.
        let left = AtomicUsize::new(3 * steep.positions.len() / 2);
        let tick = |_: u64| left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_ok();
        let bright = |_: usize| [Vec3::ONE; 2];
        assert_eq!(smooth_scattered(steep.smoothing(), &steep.scattered(), &bright, &tick), None);
    }

    /// The variance told is that of the error, not of what went in.
    #[test]
    fn the_variance_is_that_of_the_result() {
        let steep = Steep::new(1.0);
        let [_, after] = steep.errors(|_| 0.5, |_| true);
        let (_, smoothed) = steep.smoothed(|_| 0.5);
        let told = (smoothed.iter().map(|s| f64::from(s.variance)).sum::<f64>() / smoothed.len() as f64).sqrt();
        println!("standard error {after}, told {told}");
        assert!((told / after - 1.0).abs() < 0.3);
    }
}
