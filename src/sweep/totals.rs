//! Sums over the replicates of a sweep, and their spread.

use super::grid::{Geometry, Planes};
use super::{Replicate, SweptSide};
use crate::flattened::Side;
use crate::scene::Scene;
use glam::DVec3;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Sums over replicates.
pub(super) struct Totals {
    sides: Vec<Side>,
    nodes: usize,
    pub(super) direct: Vec<Planes>,
    pub(super) indirect: Vec<Planes>,
    /// Running mean and sum of squared deviations of the luminance of ρE/π. \[Welford62\]
    pub(super) spread: Vec<Vec<[f32; 2]>>,
    pub(super) count: f32,
}

impl Totals {
    pub(super) fn new(sides: &[Side], n: usize, replicates: usize) -> Self {
        let spread = if replicates > 1 { vec![vec![[0.0; 2]; n]; sides.len()] } else { Vec::new() };
        Self { sides: sides.to_vec(), nodes: n, direct: Vec::new(), indirect: Vec::new(), spread, count: 0.0 }
    }

    pub(super) fn sides(&self) -> &[Side] {
        &self.sides
    }

    pub(super) fn nodes(&self) -> usize {
        self.nodes
    }

    #[allow(clippy::cast_possible_truncation, reason = "albedo")]
    pub(super) fn add(&mut self, r: &Replicate, scene: &Scene) {
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
