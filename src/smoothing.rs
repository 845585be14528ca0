//! Gathered light smoothed over neighbouring grid points.
//!
//! Each point's gather is unbiased and noisy, and its neighbours' know nearly the same light: a linear function fitted to
//! those around a point has a small part of the noise and, where light curves, a bias. How far to look is decided at each
//! place by cross-validation: what half of the rays gives, smoothed, is compared with the other half at the points
//! around, whose noise is independent; the width that predicts best wins, and "not at all" competes. \[Rousselle12\]

use crate::direct::luminance;
use crate::field::Field;
use crate::flattened::Side;
use crate::mask::local_position;
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::{DMat4, DVec3, DVec4, Vec3};
use rayon::prelude::*;

/// Radii, in the lattice's shortest spacing.
const RADII: [f64; 2] = [1.5, 2.5];
/// Least cosine between the normals of points that share light.
const CONE: f32 = 0.7;
/// Prior weight of "no slope", as a share of what full coverage says.
const RIDGE: f64 = 0.05;

/// Light smoothed at one point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Smoothed {
    /// Mean irradiance.
    pub mean: Vec3,
    /// Σ of the squared weights: variance after over variance before, if the points around are as noisy.
    pub gain: f32,
}

/// A neighbour's place relative to a point.
struct Tap {
    step: [isize; 3],
    /// Offset in radii of the largest ball.
    d: Vec3,
    d2: f32,
}

/// What the points hold.
struct Points<'a> {
    lattice: &'a Lattice,
    taps: Vec<Tap>,
    /// Both halves; NaN: nothing.
    halves: &'a [[Vec3; 2]],
    normals: Vec<Vec3>,
    isovalues: Vec<f32>,
    /// Largest isovalue difference.
    tau: f32,
}

/// Smooths the irradiance of points whose two `halves` are given, NaN for those that hold nothing. `tau`: largest
/// isovalue difference of points that share light, in units of the sweep. The same bits on any number of threads.
pub fn smooth(scene: &Scene, lattice: &Lattice, side: Side, tau: f64, halves: &[[Vec3; 2]]) -> Vec<Smoothed> {
    let points = Points::new(scene, lattice, side, tau, halves);
    let range = |f: &(dyn Fn(usize) -> [f32; 3] + Sync)| -> Vec<[f32; 3]> {
        (0..halves.len()).into_par_iter().with_min_len(1024).map(f).collect()
    };
    // (prediction − other half)² at each point, without smoothing and for both radii.
    let errors = range(&|o| {
        let own = halves[o];
        if own[0].is_nan() {
            return [0.0; 3];
        }
        let error = |fit: [Vec3; 2]| {
            let e = |a: Vec3, b: Vec3| luminance((a - b).as_dvec3()).powi(2) as f32;
            0.5 * (e(fit[0], own[1]) + e(fit[1], own[0]))
        };
        [error(own), error(points.fit(o, RADII[0]).0), error(points.fit(o, RADII[1]).0)]
    });
    (0..halves.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|o| {
            let own = halves[o];
            if own[0].is_nan() {
                return Smoothed::default();
            }
            let mut sums = [0.0f32; 3];
            points.around(o, RADII[1], |n, tap, _| {
                for (sum, e) in sums.iter_mut().zip(errors[n]) {
                    *sum += (1.0 - tap.d2) * e;
                }
            });
            let (fit, gain) = match (sums[1] < sums[0], sums[2] < sums[0].min(sums[1])) {
                (_, true) => points.fit(o, RADII[1]),
                (true, _) => points.fit(o, RADII[0]),
                _ => (own, 1.0),
            };
            Smoothed { mean: 0.5 * (fit[0] + fit[1]), gain }
        })
        .collect()
}

impl<'a> Points<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn new(scene: &Scene, lattice: &'a Lattice, side: Side, tau: f64, halves: &'a [[Vec3; 2]]) -> Self {
        let field: &Field = &scene.field;
        let axes = lattice.axes();
        let shortest = (0..3).map(|a| axes.col(a).length()).fold(f64::INFINITY, f64::min);
        let largest = RADII[1] * shortest;
        let inverse = axes.inverse();
        let reach: [isize; 3] = std::array::from_fn(|a| (inverse.row(a).length() * largest).floor() as isize);
        let mut taps = Vec::new();
        for z in -reach[2]..=reach[2] {
            for y in -reach[1]..=reach[1] {
                for x in -reach[0]..=reach[0] {
                    let d = axes * DVec3::new(x as f64, y as f64, z as f64) / largest;
                    if d.length_squared() < 1.0 {
                        taps.push(Tap { step: [x, y, z], d: d.as_vec3(), d2: d.length_squared() as f32 });
                    }
                }
            }
        }
        let (normals, isovalues) = (0..halves.len())
            .into_par_iter()
            .map(|o| {
                if halves[o][0].is_nan() {
                    return (Vec3::ZERO, 0.0);
                }
                let p = local_position(field, lattice, o);
                (scene.normal(p, side).unwrap_or_default().as_vec3(), field.value(p) as f32)
            })
            .unzip();
        Self { lattice, taps, halves, normals, isovalues, tau: tau as f32 }
    }

    /// Calls `visit(number, tap, (d/r)²)` for the points within `radius` that share the light of point `o`.
    #[inline]
    fn around(&self, o: usize, radius: f64, mut visit: impl FnMut(usize, &Tap, f32)) {
        let at = self.lattice.ijk(o).map(|i| i as isize);
        let dims = self.lattice.dims().map(|n| n as isize);
        let scale = (RADII[1] / radius).powi(2) as f32;
        let (normal, isovalue) = (self.normals[o], self.isovalues[o]);
        for tap in self.taps.iter().filter(|t| t.d2 * scale < 1.0) {
            let q: [isize; 3] = std::array::from_fn(|a| at[a] + tap.step[a]);
            if (0..3).any(|a| q[a] < 0 || q[a] >= dims[a]) {
                continue;
            }
            let n = self.lattice.offset(q[0] as usize, q[1] as usize, q[2] as usize);
            if !self.halves[n][0].is_nan()
                && (self.isovalues[n] - isovalue).abs() <= self.tau
                && self.normals[n].dot(normal) >= CONE
            {
                visit(n, tap, tap.d2 * scale);
            }
        }
    }

    /// Both halves at point `o` by a linear fit within `radius`, and Σ of its squared weights.
    fn fit(&self, o: usize, radius: f64) -> ([Vec3; 2], f32) {
        let mut m = [0.0f32; 10];
        self.around(o, radius, |_, tap, d2| {
            let (w, d) = (1.0 - d2, tap.d);
            let terms = [1.0, d.x, d.y, d.z, d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.x * d.z, d.y * d.z];
            m.iter_mut().zip(terms).for_each(|(m, t)| *m += w * t);
        });
        let m = m.map(f64::from);
        let r = radius / RADII[1];
        // ∫K d_x² / ∫K over the ball is r²/7 for Epanechnikov's kernel.
        let ridge = RIDGE / 7.0 * r * r * m[0];
        let matrix = DMat4::from_cols(
            DVec4::new(m[0], m[1], m[2], m[3]),
            DVec4::new(m[1], m[4] + ridge, m[7], m[8]),
            DVec4::new(m[2], m[7], m[5] + ridge, m[9]),
            DVec4::new(m[3], m[8], m[9], m[6] + ridge),
        );
        let g = matrix.inverse().x_axis.as_vec4();
        let mut fit = [Vec3::ZERO; 2];
        let mut gain = 0.0;
        self.around(o, radius, |n, tap, d2| {
            let w = (1.0 - d2) * (g.x + g.y * tap.d.x + g.z * tap.d.y + g.w * tap.d.z);
            let [a, b] = self.halves[n];
            fit[0] += w * a;
            fit[1] += w * b;
            gain += w * w;
        });
        (fit, gain)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Samples, Volume};

    /// RMS error before and after smoothing noise of standard deviation 0.1 per half off `light`, on planes of h = x.
    fn errors(light: impl Fn(DVec3) -> f32, judged: impl Fn(DVec3) -> bool) -> [f64; 2] {
        let lattice = Lattice::aligned([16, 17, 18], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let volume = Volume::new("x", lattice.clone(), Samples::F32(samples)).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 15.0).unwrap()).unwrap();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap();
        let place = |o: usize| DVec3::from_array(lattice.ijk(o).map(|i| i as f64));
        let halves: Vec<[Vec3; 2]> = (0..lattice.len())
            .map(|o| {
                let mut rng = Rng::stream(1, Stage::Test, o as u64);
                let mut noise = || 0.1 * 12f64.sqrt() * (rng.unit() - 0.5);
                [noise(), noise()].map(|n| Vec3::splat(light(place(o)) + n as f32))
            })
            .collect();
        let smoothed = smooth(&scene, &lattice, Side::Lower, 0.2, &halves);
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
