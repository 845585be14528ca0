//! Sums over the replicates of a sweep, and their spread.

use super::SweptSide;
use super::grid::{Geometry, Planes};
use crate::flattened::Side;
use crate::scene::Scene;
use glam::DVec3;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Sums over replicates.
pub(super) struct Totals {
    sides: Vec<Side>,
    nodes: usize,
    /// Irradiance.
    pub(super) light: Vec<Planes>,
    /// Squared deviations of the luminance of ρE/π from its mean. \[Welford62\]
    pub(super) spread: Vec<Vec<f32>>,
    pub(super) count: f32,
}

impl Totals {
    pub(super) fn new(sides: &[Side], n: usize, replicates: usize) -> Self {
        let spread = if replicates > 1 { vec![vec![0.0; n]; sides.len()] } else { Vec::new() };
        Self { sides: sides.to_vec(), nodes: n, light: Vec::new(), spread, count: 0.0 }
    }

    pub(super) fn sides(&self) -> &[Side] {
        &self.sides
    }

    pub(super) fn nodes(&self) -> usize {
        self.nodes
    }

    /// Takes the direct and indirect irradiance of a replicate, or the direct one alone.
    #[allow(clippy::cast_possible_truncation, reason = "albedo")]
    pub(super) fn add(&mut self, [mut direct, indirect]: [Vec<Planes>; 2], scene: &Scene) {
        direct.truncate(self.sides.len());
        for (sum, new) in direct.iter_mut().flatten().zip(indirect.iter().flatten()) {
            sum.par_iter_mut().zip(new).with_min_len(1 << 12).for_each(|(s, n)| *s += n);
        }
        drop(indirect);
        let new = direct;
        self.count += 1.0;
        if self.light.is_empty() {
            self.light = new;
            return;
        }
        let luminance = |albedo: DVec3| -> [f32; 3] {
            std::array::from_fn(|c| [0.2126, 0.7152, 0.0722][c] * albedo[c] as f32 / PI)
        };
        let (albedo, h) = (&scene.surface.albedo, scene.field.samples());
        let same = (albedo.stops().len() == 1).then(|| luminance(albedo.at(0.0)));
        // (x − mean of those before)² (n − 1)/n.
        let (before, share) = (1.0 / (self.count - 1.0), (self.count - 1.0) / self.count);
        for (spread, (light, new)) in self.spread.iter_mut().zip(self.light.iter().zip(&new)) {
            spread.par_iter_mut().enumerate().with_min_len(1 << 12).for_each(|(i, m)| {
                let luminance = same.unwrap_or_else(|| luminance(albedo.at(f64::from(h[i]))));
                let d: f32 = (0..3).map(|c| luminance[c] * (new[c][i] - before * light[c][i])).sum();
                *m += share * d * d;
            });
        }
        for (s, n) in self.light.iter_mut().flatten().zip(new.iter().flatten()) {
            s.par_iter_mut().zip(n).with_min_len(1 << 12).for_each(|(s, n)| *s += n);
        }
    }

    pub(super) fn finish(self, geometry: &Geometry, done: usize) -> Vec<SweptSide> {
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
                irradiance: collect(&self.light[s]),
                std_error: match spread.next() {
                    Some(m) if done > 1 => m
                        .iter()
                        .zip(&geometry.valid)
                        .map(|(m, v)| if *v { (m * scale / (done - 1) as f32).sqrt() } else { 0.0 })
                        .collect(),
                    _ => Vec::new(),
                },
            })
            .collect()
    }
}
