//! Gathered light smoothed over neighbouring grid points, or over places scattered beside them.
//!
//! Each point's gather is unbiased and noisy, and its neighbours' know nearly the same light. A linear function fitted
//! to those around a point, and what that leaves fitted once more, has a small part of the noise and a bias of fourth
//! order in the radius \[Tukey77\]. How far to trust it is decided at each place by cross-validation: what half of the
//! rays gives, smoothed by a share λ, is compared with the other half at the points around, whose noise is independent;
//! the λ that predicts best wins. \[Rousselle12\]

mod scattered;

pub use scattered::{Scattered, smooth_scattered};

use crate::direct::luminance;
use crate::field::Field;
use crate::flattened::Side;
use crate::linear_fit::{NormalMatrix, Sums};
use crate::mask::local_position;
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::collections::VecDeque;

/// Radius of the fits, in the lattice's shortest spacing.
const RADIUS: f64 = 2.5;
/// Least cosine between the normals of points that share light.
const CONE: f32 = 0.7;

/// Light smoothed at one point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Smoothed {
    /// Mean irradiance.
    pub mean: Vec3,
    /// Variance of its luminance, from how far the halves are apart around.
    pub variance: f32,
}

/// A neighbour's place relative to a point.
struct Tap {
    step: [isize; 3],
    /// Offset in radii, and its square.
    d: Vec3,
    d2: f32,
}

/// Whose light is smoothed, and how far it is shared.
#[derive(Clone, Copy, Debug)]
pub struct Smoothing<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// The side of its level sets.
    pub side: Side,
    /// Largest isovalue difference of points that share light, in units of the sweep.
    pub tau: f64,
}

/// Two independent estimates of one irradiance; NaN: none.
pub type Halves = [Vec3; 2];

/// Places among which light is smoothed.
trait Surroundings {
    type Place: Copy;

    /// Calls `visit` for the places that share the light of one, itself among them, with their offset in radii and its
    /// square.
    fn around(&self, at: Self::Place, visit: impl FnMut(Self::Place, Vec3, f32));

    /// What a linear fit of `values` around a place says there.
    fn fit(&self, at: Self::Place, values: impl Fn(Self::Place) -> Halves) -> Halves {
        let mut matrix = NormalMatrix::default();
        let mut sums = [Sums::default(); 2];
        self.around(at, |n, d, d2| {
            let w = 1.0 - d2;
            matrix.add(w, d);
            sums.iter_mut().zip(values(n)).for_each(|(sums, v)| sums.add(w * v, d));
        });
        let g = matrix.at_origin();
        sums.map(|sums| sums.fitted(g).as_vec3())
    }

    /// [`Surroundings::fit`] to what it left of `raw` is added to it; `once`: the first fits.
    fn fit_again(
        &self,
        at: Self::Place,
        raw: impl Fn(Self::Place) -> Halves,
        once: impl Fn(Self::Place) -> Halves,
    ) -> Halves {
        let rest = self.fit(at, |m| {
            let (raw, once) = (raw(m), once(m));
            [0, 1].map(|h| raw[h] - once[h])
        });
        let once = once(at);
        [0, 1].map(|h| once[h] + rest[h])
    }

    /// `raw` and the share of the way to `fitted` that predicts best.
    fn blend(
        &self,
        at: Self::Place,
        raw: impl Fn(Self::Place) -> Halves,
        fitted: impl Fn(Self::Place) -> Halves,
    ) -> Halves {
        // Σ (a + λ (ã − a) − b)² over the places around and both ways is least at −Σ (ã − a)(a − b) / Σ (ã − a)².
        let (mut along, mut squares) = (0.0f32, 0.0f32);
        self.around(at, |m, _, d2| {
            let (raw, fitted) = (raw(m), fitted(m));
            for h in [0, 1] {
                let change = light(fitted[h] - raw[h]);
                along += (1.0 - d2) * change * light(raw[1 - h] - raw[h]);
                squares += (1.0 - d2) * change * change;
            }
        });
        let share = if squares > 0.0 { (along / squares).clamp(0.0, 1.0) } else { 0.0 };
        let (raw, fitted) = (raw(at), fitted(at));
        [0, 1].map(|h| raw[h] + share * (fitted[h] - raw[h]))
    }

    /// The mean of both halves, and how far they are apart around.
    fn mean(&self, at: Self::Place, blended: impl Fn(Self::Place) -> Halves) -> Smoothed {
        let (mut sum, mut weight) = (0.0f32, 0.0f32);
        self.around(at, |m, _, d2| {
            let [a, b] = blended(m);
            sum += (1.0 - d2) * (0.5 * light(a - b)).powi(2);
            weight += 1.0 - d2;
        });
        let [a, b] = blended(at);
        Smoothed { mean: 0.5 * (a + b), variance: sum / weight }
    }
}

#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn light(v: Vec3) -> f32 {
    luminance(v.as_dvec3()) as f32
}

/// Where the points stand.
struct Points<'a> {
    scene: &'a Scene,
    lattice: &'a Lattice,
    side: Side,
    taps: Vec<Tap>,
    /// Steps that taps span along z.
    reach: usize,
    /// Unit normal of the side in question, 0 where there is nothing; isovalue.
    places: Slices<(Vec3, f32)>,
    /// Largest isovalue difference.
    tau: f32,
}

/// A few of a lattice's slices of constant z.
#[derive(Default)]
struct Slices<T> {
    first: usize,
    slices: VecDeque<Vec<T>>,
}

impl<T> Slices<T> {
    /// Adds the next slice and drops those below slice `keep`.
    fn push(&mut self, slice: Vec<T>, keep: usize) {
        self.slices.push_back(slice);
        while self.first < keep && !self.slices.is_empty() {
            self.slices.pop_front();
            self.first += 1;
        }
    }

    /// Point `n` of slice `z`.
    #[inline]
    fn at(&self, (z, n): (usize, usize)) -> &T {
        &self.slices[z - self.first][n]
    }
}

/// Smooths the irradiance of points whose two `halves` are given by their offset. Slice after slice of the lattice goes
/// to `out`, with its number: about 770 bytes per point of a slice are held at once. The same bits on any number of
/// threads.
pub fn smooth(
    smoothing: Smoothing<'_>,
    lattice: &Lattice,
    halves: &(dyn Fn(usize) -> Halves + Sync),
    out: &mut dyn FnMut(usize, Vec<Smoothed>),
) {
    let mut points = Points::new(smoothing, lattice);
    let [nx, ny, nz] = lattice.dims();
    let (area, reach) = (nx * ny, points.reach);
    let (mut raw, mut once, mut twice, mut blended) =
        (Slices::default(), Slices::default(), Slices::default(), Slices::default());
    // Each stage looks `reach` slices ahead into the one before.
    for k in 0..nz + 4 * reach {
        let before = |stages: usize| k.checked_sub(stages * reach).filter(|&z| z < nz);
        let keep = |stages: usize| k.saturating_sub(stages * reach);
        if let Some(z) = before(0) {
            let slice: Vec<Halves> =
                (0..area).into_par_iter().with_min_len(1024).map(|n| halves(z * area + n)).collect();
            points.places.push(points.placed(z, &slice), keep(5));
            raw.push(slice, keep(4));
        }
        if let Some(z) = before(1) {
            once.push(points.each(z, |n| points.fit((z, n), |m| *raw.at(m))), keep(3));
        }
        if let Some(z) = before(2) {
            twice.push(points.each(z, |n| points.fit_again((z, n), |m| *raw.at(m), |m| *once.at(m))), keep(4));
        }
        if let Some(z) = before(3) {
            blended.push(points.each(z, |n| points.blend((z, n), |m| *raw.at(m), |m| *twice.at(m))), keep(5));
        }
        if let Some(z) = before(4) {
            let slice = points.each(z, |n| points.mean((z, n), |m| *blended.at(m)));
            out(z, slice);
        }
    }
}

impl<'a> Points<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn new(Smoothing { scene, side, tau }: Smoothing<'a>, lattice: &'a Lattice) -> Self {
        let axes = lattice.axes();
        let radius = RADIUS * lattice.spacing().min_element();
        let inverse = axes.inverse();
        let reach: [isize; 3] = std::array::from_fn(|a| (inverse.row(a).length() * radius).floor() as isize);
        let mut taps = Vec::new();
        for z in -reach[2]..=reach[2] {
            for y in -reach[1]..=reach[1] {
                for x in -reach[0]..=reach[0] {
                    let d = axes * DVec3::new(x as f64, y as f64, z as f64) / radius;
                    if d.length_squared() < 1.0 {
                        taps.push(Tap { step: [x, y, z], d: d.as_vec3(), d2: d.length_squared() as f32 });
                    }
                }
            }
        }
        let reach = reach[2].unsigned_abs();
        Self { scene, lattice, side, taps, reach, places: Slices::default(), tau: tau as f32 }
    }

    /// Points of a slice.
    fn area(&self) -> usize {
        let [nx, ny, _] = self.lattice.dims();
        nx * ny
    }

    /// Where the points of slice `z` with light stand.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn placed(&self, z: usize, halves: &[Halves]) -> Vec<(Vec3, f32)> {
        let field: &Field = &self.scene.field;
        let place = |(n, halves): (usize, &Halves)| {
            if halves[0].is_nan() {
                return (Vec3::ZERO, 0.0);
            }
            let p = local_position(field, self.lattice, z * self.area() + n);
            (self.scene.normal(p, self.side).unwrap_or_default().as_vec3(), field.value(p) as f32)
        };
        halves.par_iter().enumerate().with_min_len(1024).map(place).collect()
    }

    /// `f` of every point of slice `z` that holds light, nothing of the others.
    fn each<T: Default + Send>(&self, z: usize, f: impl Fn(usize) -> T + Sync) -> Vec<T> {
        let of = |n: usize| if self.places.at((z, n)).0 == Vec3::ZERO { T::default() } else { f(n) };
        (0..self.area()).into_par_iter().with_min_len(256).map(of).collect()
    }
}

impl Surroundings for Points<'_> {
    /// Slice and number in it.
    type Place = (usize, usize);

    #[inline]
    fn around(&self, (z, n): (usize, usize), mut visit: impl FnMut((usize, usize), Vec3, f32)) {
        let [nx, ny, nz] = self.lattice.dims().map(|n| n as isize);
        let at = [(n as isize) % nx, (n as isize) / nx, z as isize];
        let &(normal, isovalue) = self.places.at((z, n));
        for tap in &self.taps {
            let [x, y, z]: [isize; 3] = std::array::from_fn(|a| at[a] + tap.step[a]);
            if x < 0 || x >= nx || y < 0 || y >= ny || z < 0 || z >= nz {
                continue;
            }
            let m = (z as usize, (y * nx + x) as usize);
            let &(other, c) = self.places.at(m);
            if other.dot(normal) >= CONE && (c - isovalue).abs() <= self.tau {
                visit(m, tap.d, tap.d2);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::Samples;

    /// RMS error before and after smoothing noise of standard deviation 0.1 per half off `light`, on planes of h = x.
    fn errors(light: impl Fn(DVec3) -> f32, judged: impl Fn(DVec3) -> bool) -> [f64; 2] {
        let lattice = Lattice::aligned([16, 17, 18], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 15.0);
        let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap();
        let place = |o: usize| lattice.point(o);
        let halves: Vec<[Vec3; 2]> = (0..lattice.len())
            .map(|o| {
                let mut rng = Rng::stream(1, Stage::Test, o as u64);
                let mut noise = || 0.1 * 12f64.sqrt() * (rng.unit() - 0.5);
                [noise(), noise()].map(|n| Vec3::splat(light(place(o)) + n as f32))
            })
            .collect();
        let mut smoothed = Vec::new();
        let smoothing = Smoothing { scene: &scene, side: Side::Lower, tau: 0.2 };
        smooth(smoothing, &lattice, &|o| halves[o], &mut |z, slice| {
            assert_eq!(smoothed.len(), z * 16 * 17);
            smoothed.extend(slice);
        });
        let (mut sums, mut count) = ([0.0; 2], 0.0);
        for o in (0..lattice.len()).filter(|&o| judged(place(o))) {
            let truth = light(place(o));
            sums[0] += f64::from(0.5 * (halves[o][0].x + halves[o][1].x) - truth).powi(2);
            sums[1] += f64::from(smoothed[o].mean.x - truth).powi(2);
            count += 1.0;
        }
        sums.map(|s: f64| (s / count).sqrt())
    }

    #[test]
    fn noise_goes_where_light_is_linear_up_to_the_border() {
        let light = |p: DVec3| (0.5 + 0.03 * p.y - 0.02 * p.z + 0.01 * p.x) as f32;
        let [before, after] = errors(light, |_| true);
        println!("{before} -> {after}");
        assert!((before / 0.0707 - 1.0).abs() < 0.05 && after < 0.3 * before);
        let [before, after] = errors(light, |p| p.y == 0.0 || p.z == 17.0);
        println!("at the border {before} -> {after}");
        assert!(after < 0.6 * before);
    }

    #[test]
    fn an_edge_stays_sharp() {
        let light = |p: DVec3| if p.y < 8.0 { 0.1 } else { 1.1 };
        let [before, after] = errors(light, |p| (6.0..=9.0).contains(&p.y));
        println!("at the edge {before} -> {after}");
        assert!(after < 1.1 * before);
        let [before, after] = errors(light, |p| !(4.0..=11.0).contains(&p.y));
        assert!(after < 0.4 * before, "{before} -> {after}");
    }

    #[test]
    fn points_that_hold_nothing_take_no_part() {
        let [before, after] = errors(|p| if p.z == 9.0 { f32::NAN } else { 0.5 }, |p| p.z == 8.0 || p.z == 10.0);
        assert!(after < 0.6 * before, "{before} -> {after}");
    }
}
