//! The second engine: **line sweeps**. Every point of a line lies on *some* level set, so one line answers for all
//! isovalues at once (design §7).
//!
//! * Direct light: along a line from a luminaire's point, a sample is lit on its own level set iff h there exceeds the
//!   running maximum. One fan of lines lights every node and every isovalue.
//! * Indirect light: along a line, the first hit of the ray that leaves sample k is the next value ≥ h_k
//!   (all nearest greater values, amortised O(1) with a stack \[BSV93\]). There h = h_k again, so the grid itself holds
//!   the right level set's radiance. A pass over all directions is one bounce for every node and isovalue; passes are
//!   iterated (Jacobi) until what is left out is small.
//!
//! Limits: between samples of a line h counts as linear (visibility agrees with exact rays on about 99 % of samples);
//! all nodes share directions and luminaire points, so what noise there is is smooth in space; polygons that stand
//! inside the volume are refused unless they are luminaires.

mod arrive;
mod direct;
mod directions;
mod flats;
mod gather;
mod grid;
mod half;
mod pack;
#[allow(unsafe_code, reason = "vector instructions: measured to pay, chosen at run time")]
mod simd;

use crate::error::{Error, Result};
use crate::flat::FlatTexture;
use crate::flattened::Side;
use crate::scene::{Boundary, Scene};
use flats::Flats;
use gather::Pass;
use glam::DVec3;
use grid::{Geometry, Planes};
use half::Half4;
use rayon::prelude::*;
use simd::Isa;
use std::f32::consts::PI;
use std::sync::Mutex;

/// How to sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepSettings {
    /// Directions over the sphere per full pass and replicate, a power of two; every line serves two.
    pub directions: usize,
    /// Points per luminaire and replicate, a power of two.
    pub light_points: usize,
    /// Indirect bounces; what is left beyond is cut off. Large values mean: until `target` is met.
    pub max_bounces: usize,
    /// The share of mean indirect light that may be left out when the bounces stop.
    pub target: f64,
    /// Independent repetitions of everything, averaged; 4 or more give a standard error.
    pub replicates: usize,
    /// Texels along the longer edge of a wall, and isovalues of its texture.
    pub flat_resolution: (usize, usize),
    /// Seed of the run.
    pub seed: u64,
}

impl Default for SweepSettings {
    fn default() -> Self {
        Self {
            directions: 64,
            light_points: 16,
            max_bounces: 64,
            target: 1e-3,
            replicates: 4,
            flat_resolution: (32, 32),
            seed: 1,
        }
    }
}

/// Light on one stored side of every level set, at the lattice's nodes. Nodes that hold no surface of the sweep (h outside
/// it or not finite, or ∇h = 0) are 0.
#[derive(Clone, Debug)]
pub struct SweptSide {
    /// Which side.
    pub side: Side,
    /// Irradiance E straight from luminaires (world, not divided by π).
    pub direct: Vec<[f32; 3]>,
    /// Irradiance from everything else, emission of the level sets included.
    pub indirect: Vec<[f32; 3]>,
    /// Standard error of the luminance of the reflected radiance ρE/π, from the spread of the replicates. Empty with
    /// fewer than 2. What the grid cannot hold between its nodes is not part of it.
    pub std_error: Vec<f32>,
}

/// What a sweep gave.
#[derive(Clone, Debug)]
pub struct SweepResult {
    /// The stored sides, in the order of [`crate::scene::Surface::stored_sides`].
    pub sides: Vec<SweptSide>,
    /// Reflected radiance of walls, luminaires and caps, by flat number; `None` where nothing is reflected.
    pub flats: Vec<Option<FlatTexture>>,
    /// Indirect bounces of the replicate that took the most.
    pub bounces: usize,
    /// Bound on the share of mean indirect light that later bounces would add; NaN where `max_bounces` came first.
    pub residual: f64,
    /// Whether `tick` stopped the work.
    pub stopped: bool,
    /// Counts for the report.
    pub counts: SweepCounts,
}

/// How much was done.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SweepCounts {
    /// Gather rays: pairs of a valid node and a direction above its horizon.
    pub gather_rays: u64,
    /// Visibility queries: pairs of a valid node and a luminaire point.
    pub shadow_rays: u64,
    /// Families of parallel lines.
    pub families: u64,
    /// Nodes that hold a surface of the sweep.
    pub valid: u64,
    /// Nodes that do not.
    pub masked: u64,
}

/// Polygons that a sweep takes.
pub const MOST_POLYGONS: usize = 256;

/// Passes with few directions take this share of the full number.
const COARSE: usize = 4;
/// Full passes after the light has settled.
const FULL_PASSES: usize = 2;
/// Fewest directions of a coarse pass.
const LEAST: usize = 32;

/// Whether sweeps can light a scene.
///
/// # Errors
/// `NotSupported` as [`sweep`].
pub fn supported(scene: &Scene) -> Result<()> {
    if scene.fields() > 1 {
        return Err(Error::NotSupported(
            "engine = \"sweep\" lights one volume at a time; several that light each other need engine = \"photon\" (or \
             policy = \"independent\")"
                .into(),
        ));
    }
    let polygons = scene.polygons().len();
    if polygons > MOST_POLYGONS {
        return Err(Error::NotSupported(format!(
            "{polygons} polygons: sweeps test each line against all, {MOST_POLYGONS} at most; use --engine photon"
        )));
    }
    let inside = flats::inside(scene);
    if let Some((_, p)) = inside.iter().zip(scene.polygons()).find(|(inside, p)| **inside && !p.opaque_back) {
        return Err(Error::NotSupported(format!(
            "polygon '{}' stands inside the volume, where sweeps cannot see it; use --engine photon",
            p.name
        )));
    }
    Ok(())
}

/// Lights every node of the lattice for every isovalue of the sweep. `tick` receives the fraction done (an estimate while
/// bounces converge); returning false stops early with what there is.
///
/// # Errors
/// `NotSupported` for several fields that light each other, if a polygon that is not a luminaire stands inside the volume,
/// or if there are more than [`MOST_POLYGONS`]: that needs the photon engine.
pub fn sweep(scene: &Scene, settings: &SweepSettings, tick: &(dyn Fn(f64) -> bool + Sync)) -> Result<SweepResult> {
    supported(scene)?;
    let inside = flats::inside(scene);
    let geometry = Geometry::new(&scene.field);
    let stored = scene.surface.stored_sides();
    // Light passes from one side to the other only around the open rims of level sets, outside Ω.
    let margin = {
        let [lo, hi] = gather::local_bounds(scene);
        lo.min(scene.lattice().far() - hi).min_element() < -1e-6
    };
    let coupled = margin && scene.boundary == Boundary::Open && !scene.polygons().is_empty();
    let mut sides = stored.clone();
    if coupled && sides.len() == 1 {
        sides.push(sides[0].opposite());
    }
    let replicates = settings.replicates.max(1);
    let mut total = Totals::new(&stored, geometry.h.len(), replicates);
    let mut flats_sum: Vec<Option<Vec<f32>>> = Vec::new();
    let mut flats = Flats::new(scene, settings.flat_resolution.0.max(2), settings.flat_resolution.1.max(2));
    let mut out = SweepResult {
        sides: Vec::new(),
        flats: Vec::new(),
        bounces: 0,
        residual: 0.0,
        stopped: false,
        counts: SweepCounts::default(),
    };
    out.counts.valid = geometry.valid.iter().filter(|v| **v).count() as u64;
    out.counts.masked = geometry.valid.len() as u64 - out.counts.valid;
    let mut done = 0;
    for r in 0..replicates {
        let run = Run { scene, settings, geometry: &geometry, inside: &inside, sides: &sides, isa: Isa::detect() };
        let progress = |x: f64| tick((r as f64 + x) / replicates as f64);
        let replicate = run.replicate(r as u64, &mut flats, &mut out, &progress);
        if out.stopped && done > 0 {
            break;
        }
        done += 1;
        total.add(&replicate, scene);
        for (i, t) in flats.textures.iter().enumerate() {
            if r == 0 {
                flats_sum.push(t.as_ref().map(|t| t.radiance.clone()));
            } else if let (Some(sum), Some(t)) = (&mut flats_sum[i], t) {
                sum.iter_mut().zip(&t.radiance).for_each(|(s, x)| *s += x);
            }
        }
        if out.stopped {
            break;
        }
    }
    out.sides = total.finish(&geometry, done);
    for (texture, sum) in flats.textures.iter().zip(flats_sum) {
        out.flats.push(texture.as_ref().zip(sum).map(|(t, mut sum)| {
            sum.iter_mut().for_each(|x| *x /= done as f32);
            t.export(&sum)
        }));
    }
    Ok(out)
}

/// What the replicates of one sweep share.
struct Run<'a> {
    scene: &'a Scene,
    settings: &'a SweepSettings,
    geometry: &'a Geometry<'a>,
    inside: &'a [bool],
    sides: &'a [Side],
    isa: Isa,
}

/// Direct and indirect irradiance of one replicate, per side.
struct Replicate {
    direct: Vec<Planes>,
    indirect: Vec<Planes>,
}

impl Run<'_> {
    /// Direct light, then bounces: coarse passes until the tail is predictable and small, full passes, whose mean counts.
    fn replicate(
        &self,
        number: u64,
        flats: &mut Flats,
        out: &mut SweepResult,
        progress: &dyn Fn(f64) -> bool,
    ) -> Replicate {
        let s = self.settings;
        let n = self.geometry.h.len();
        let points = s.light_points.max(1);
        let lights = points * self.scene.luminaires().len();
        let mut step = 0;
        let mut stopped = false;
        let mut ask = || {
            step += 1;
            progress(0.2 * f64::from(step) / lights as f64)
        };
        let (direct, complete) = direct::direct(
            self.scene,
            (self.geometry, self.isa),
            flats,
            self.sides,
            (s.seed, number, points),
            &mut ask,
        );
        stopped |= !complete;
        out.counts.shadow_rays += out.counts.valid * lights as u64;
        let mut indirect: Vec<Planes> = self.sides.iter().map(|_| grid::black(n)).collect();
        let pass = Pass {
            scene: self.scene,
            geometry: self.geometry,
            inside: self.inside,
            primary: self.sides[0],
            isa: self.isa,
            workspaces: Mutex::default(),
        };
        let nothing = flats.open();
        flats.close(nothing);
        flats.reflect([1.0; 3], false);
        let (mut b, mut unit) = self.reflect(flats, &direct, None, [1.0; 3]);
        let fixed = s.max_bounces < 6;
        let mut monitor = Monitor::default();
        let mut averaged = 0;
        let mut bounce = 0;
        while bounce < s.max_bounces && !stopped {
            bounce += 1;
            let settled = fixed || averaged > 0 || monitor.missing(FULL_PASSES as i32).is_some_and(|m| m < s.target);
            let last_coarse = settled || bounce + FULL_PASSES > s.max_bounces;
            let directions =
                if last_coarse { s.directions } else { (s.directions / COARSE).max(LEAST).min(s.directions) };
            let lines = directions::lines(self.scene.lattice(), s.seed, number << 32 | bounce as u64, directions);
            let mut incoming = flats.open();
            let mut family = 0;
            let total = lines.len() * self.sides.len();
            let mut ask = || {
                family += 1;
                progress(0.2 + 0.8 * (bounce as f64 - 1.0 + f64::from(family) / total as f64) / (bounce as f64 + 3.0))
            };
            let mut fresh = Vec::new();
            for (&side, b) in self.sides.iter().zip(&b) {
                let (e, complete) = pass.gather(side, &lines, b, unit, flats, &mut incoming, &mut ask);
                stopped |= !complete;
                fresh.push(e);
            }
            flats.close(incoming);
            if stopped {
                break;
            }
            out.counts.families += (lines.len() * self.sides.len()) as u64;
            out.counts.gather_rays += out.counts.valid * (lines.len() * self.sides.len()) as u64;
            let mean = self.mean(&fresh);
            if averaged > 0 {
                // Full passes are averaged: each saw the light that the one before left.
                let w = 1.0 / (averaged + 1) as f32;
                for (old, new) in indirect.iter_mut().flatten().zip(fresh.iter().flatten()) {
                    old.par_iter_mut().zip(new).with_min_len(1 << 12).for_each(|(o, n)| *o += w * (n - *o));
                }
            } else {
                indirect = fresh;
            }
            averaged += usize::from(last_coarse && !fixed);
            let scale = if fixed { [1.0; 3] } else { monitor.push(mean) };
            flats.reflect(scale, true);
            if bounce == s.max_bounces || (!fixed && averaged == FULL_PASSES) {
                break;
            }
            (b, unit) = self.reflect(flats, &direct, Some(&indirect), scale);
        }
        out.bounces = out.bounces.max(bounce);
        out.residual = monitor.missing(0).unwrap_or(f64::NAN).max(out.residual);
        out.stopped |= stopped;
        Replicate { direct, indirect }
    }

    /// B = Le + ρ/π (direct + scale · indirect) of the sides, filled where no surface is, as lines read it; packs the flats
    /// too. Returns what all was multiplied by.
    #[allow(clippy::cast_possible_truncation, reason = "albedo and emission")]
    fn reflect(
        &self,
        flats: &mut Flats,
        direct: &[Planes],
        indirect: Option<&[Planes]>,
        scale: [f32; 3],
    ) -> (Vec<Vec<Half4>>, f32) {
        let surface = &self.scene.surface;
        let over_pi =
            |albedo: DVec3| -> [f32; 3] { std::array::from_fn(|c| (albedo[c] / std::f64::consts::PI) as f32) };
        // Of every stop: also a bound for nodes just outside the sweep.
        let greatest = over_pi(surface.albedo.stops().iter().fold(DVec3::ZERO, |m, s| m.max(s.1)));
        let by_node: Option<Vec<[f32; 3]>> = (surface.albedo.stops().len() > 1).then(|| {
            let h = self.geometry.h.par_iter().with_min_len(1 << 12);
            h.map(|&h| over_pi(surface.albedo.at(f64::from(h)))).collect()
        });
        let emission = surface.emission.as_vec3().to_array();
        let mut most = flats.greatest();
        for (s, direct) in direct.iter().enumerate() {
            for c in 0..3 {
                let indirect = indirect.map_or(0.0, |e| scale[c] * grid::greatest(&e[s][c]));
                most = most.max(emission[c] + greatest[c] * (grid::greatest(&direct[c]) + indirect));
            }
        }
        let unit = half::scale(most);
        flats.pack(unit);
        let b = (0..direct.len()).map(|s| {
            let n = direct[s][0].len();
            let mut b = vec![[0; 4]; n];
            b.par_chunks_mut(1 << 12).enumerate().for_each(|(chunk, b)| {
                let range = chunk << 12..(chunk << 12) + b.len();
                let lit = &self.geometry.lit[range.clone()];
                for c in 0..3 {
                    let (le, rho) = (unit * emission[c], unit * greatest[c]);
                    let direct = &direct[s][c][range.clone()];
                    let indirect = indirect.map(|e| &e[s][c][range.clone()]);
                    if let Some(by_node) = &by_node {
                        for (n, (b, rho)) in b.iter_mut().zip(&by_node[range.clone()]).enumerate().filter(|n| lit[n.0])
                        {
                            let e = direct[n] + indirect.map_or(0.0, |e| scale[c] * e[n]);
                            b[c] = half::encode(le + unit * rho[c] * e);
                        }
                        continue;
                    }
                    match indirect {
                        Some(e) => {
                            for (((b, d), e), lit) in b.iter_mut().zip(direct).zip(e).zip(lit) {
                                b[c] = half::encode(if *lit { le + rho * (d + scale[c] * e) } else { 0.0 });
                            }
                        }
                        None => {
                            for ((b, d), lit) in b.iter_mut().zip(direct).zip(lit) {
                                b[c] = half::encode(if *lit { le + rho * d } else { 0.0 });
                            }
                        }
                    }
                }
            });
            self.geometry.fill(&mut b);
            b
        });
        (b.collect(), unit)
    }

    /// Indirect irradiance summed over valid nodes and sides, per channel.
    fn mean(&self, planes: &[Planes]) -> [f64; 3] {
        // Sums by fixed chunks: the same bits on any number of threads.
        let sum = |plane: &Vec<f32>| -> f64 {
            let chunks: Vec<f64> = plane
                .par_chunks(1 << 14)
                .zip(self.geometry.valid.par_chunks(1 << 14))
                .map(|(x, v)| x.iter().zip(v).filter(|(_, v)| **v).map(|(x, _)| f64::from(*x)).sum())
                .collect();
            chunks.iter().sum()
        };
        std::array::from_fn(|c| planes.iter().map(|p| sum(&p[c])).sum())
    }
}

/// Watches the mean of indirect light, per channel, from pass to pass.
#[derive(Default)]
struct Monitor {
    means: Vec<[f64; 3]>,
    /// Ratio of successive changes, and the share of the mean that all later bounces would add, when last measured.
    ratio: [f64; 3],
    tail: [f64; 3],
    /// Passes since then.
    since: i32,
}

/// The pass whose change predicts the tail: by then light has left the neighbourhood of the luminaires.
const PREDICTS: usize = 4;

impl Monitor {
    /// Takes the means of a pass; returns per channel the factor that adds the predicted tail of all bounces that are
    /// left. It is applied once: passes after it start from light that is complete in the mean.
    #[allow(clippy::cast_possible_truncation, reason = "a factor near 1")]
    fn push(&mut self, mean: [f64; 3]) -> [f32; 3] {
        self.means.push(mean);
        self.since += 1;
        if self.means.len() != PREDICTS {
            return [1.0; 3];
        }
        self.since = 0;
        let [a, b, c] = [1, 2, 3].map(|i| self.means[i]);
        std::array::from_fn(|i| {
            let (old, new) = (b[i] - a[i], c[i] - b[i]);
            if !(old > 0.0 && new > 0.0) {
                return 1.0;
            }
            self.ratio[i] = (new / old).min(0.98);
            let rest = new * self.ratio[i] / (1.0 - self.ratio[i]);
            self.tail[i] = rest / c[i];
            1.0 + (rest / c[i]) as f32
        })
    }

    /// Bound on the share of the mean that is still missing, `more` passes from now; `None` before the prediction. The
    /// change of a pass itself stalls at the directions' noise.
    fn missing(&self, more: i32) -> Option<f64> {
        (self.means.len() >= PREDICTS)
            .then(|| (0..3).map(|i| self.tail[i] * self.ratio[i].powi(self.since + more)).fold(0.0, f64::max))
    }
}

/// Sums over replicates.
struct Totals {
    sides: Vec<Side>,
    direct: Vec<Planes>,
    indirect: Vec<Planes>,
    /// Running mean and sum of squared deviations of the luminance of ρE/π. \[Welford62\]
    spread: Vec<Vec<[f32; 2]>>,
    count: f32,
}

impl Totals {
    fn new(sides: &[Side], n: usize, replicates: usize) -> Self {
        let spread = if replicates > 1 { vec![vec![[0.0; 2]; n]; sides.len()] } else { Vec::new() };
        Self { sides: sides.to_vec(), direct: Vec::new(), indirect: Vec::new(), spread, count: 0.0 }
    }

    #[allow(clippy::cast_possible_truncation, reason = "albedo")]
    fn add(&mut self, r: &Replicate, scene: &Scene) {
        self.count += 1.0;
        let luminance = |albedo: DVec3| -> [f32; 3] {
            std::array::from_fn(|c| [0.2126, 0.7152, 0.0722][c] * albedo[c] as f32 / PI)
        };
        let (albedo, h) = (&scene.surface.albedo, scene.field.samples());
        let same = (albedo.stops().len() == 1).then(|| luminance(albedo.at(0.0)));
        for (s, spread) in self.spread.iter_mut().enumerate() {
            let (d, e) = (&r.direct[s], &r.indirect[s]);
            let count = self.count;
            spread.par_iter_mut().enumerate().with_min_len(1 << 12).for_each(|(i, m)| {
                let luminance = same.unwrap_or_else(|| luminance(albedo.at(f64::from(h[i]))));
                let x: f32 = (0..3).map(|c| luminance[c] * (d[c][i] + e[c][i])).sum();
                let old = x - m[0];
                m[0] += old / count;
                m[1] += old * (x - m[0]);
            });
        }
        if self.direct.is_empty() {
            (self.direct, self.indirect) =
                (r.direct[..self.sides.len()].to_vec(), r.indirect[..self.sides.len()].to_vec());
            return;
        }
        for (sum, new) in [(&mut self.direct, &r.direct), (&mut self.indirect, &r.indirect)] {
            for (s, n) in sum.iter_mut().flatten().zip(new.iter().flatten()) {
                s.par_iter_mut().zip(n).with_min_len(1 << 12).for_each(|(s, n)| *s += n);
            }
        }
    }

    fn finish(self, geometry: &Geometry, done: usize) -> Vec<SweptSide> {
        let scale = 1.0 / done.max(1) as f32;
        let collect = |planes: &Planes| -> Vec<[f32; 3]> {
            let [r, g, b] = planes;
            (0..r.len())
                .into_par_iter()
                .with_min_len(1 << 12)
                .map(|i| if geometry.valid[i] { [scale * r[i], scale * g[i], scale * b[i]] } else { [0.0; 3] })
                .collect()
        };
        let mut spread = self.spread.into_iter();
        self.sides
            .iter()
            .enumerate()
            .map(|(s, &side)| SweptSide {
                side,
                direct: collect(&self.direct[s]),
                indirect: collect(&self.indirect[s]),
                std_error: match spread.next() {
                    Some(m) if done > 1 => m
                        .iter()
                        .zip(&geometry.valid)
                        .map(|(m, v)| if *v { (m[1] * scale / (done - 1) as f32).sqrt() } else { 0.0 })
                        .collect(),
                    _ => Vec::new(),
                },
            })
            .collect()
    }
}
