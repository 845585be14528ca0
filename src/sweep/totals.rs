//! Sums over the replicates of a sweep, and their spread.

use super::SweptSide;
use super::lit_rows::LitRows;
use super::planes::{HalfPlanes, Planes};
use super::reflect::RECEIVING;
use crate::flattened::Side;
use crate::scene::Scene;
use crate::sharpening::sharpened;
use ::half::bf16;
use glam::DVec3;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Of every `stride`th node all replicates are kept, to estimate how much better than independent ones they are
/// together: of 65 536 to 131 071 of many nodes, of a sixteenth of fewer.
pub(super) fn stride(nodes: usize) -> usize {
    (nodes >> 16).max(16)
}

/// What gathered light is without the blur of nodes that take four lines each: along axes on both sides of which nodes
/// are lit, [`RECEIVING`] of its second differences is taken off.
pub(super) struct Deblur<'a> {
    /// Nodes along x, y and z.
    pub(super) dims: [usize; 3],
    /// Whether a node is lit.
    pub(super) lit: &'a [bool],
}

impl Deblur<'_> {
    /// Of a lit node and what `light` tells of it and of others.
    #[inline]
    fn deblurred<const N: usize>(&self, node: usize, light: impl Fn(usize) -> [f32; N]) -> [f32; N] {
        // The node itself is lit.
        let value = |n: usize| (n == node || self.lit[n]).then(|| light(n));
        sharpened(self.dims, node, RECEIVING, value).expect("the light of a node that is lit")
    }
}

/// Sums over replicates, as planes keep light.
pub(super) struct Totals {
    /// The swept sides, the stored ones first.
    sides: Vec<Side>,
    stored: usize,
    /// Nodes, and numbers of a plane.
    pub(super) nodes: usize,
    pub(super) places: usize,
    /// Sum of the direct irradiance of all swept sides over the replicates so far; gone once it is that of all.
    pub(super) lighting: Vec<Planes>,
    /// Replicates whose direct light is known.
    pub(super) lit: usize,
    /// Mean of their direct irradiance.
    pub(super) direct: Vec<HalfPlanes>,
    /// Sum of the indirect irradiance of all swept sides.
    pub(super) light: Vec<HalfPlanes>,
    /// Roots of the sums of squared deviations of the luminance of ρE/π from its mean, of direct and of indirect light:
    /// they come from independent sets. \[Welford62\]
    pub(super) spread: Vec<Vec<bf16>>,
    /// That luminance of each replicate at every [`stride`]th node.
    pub(super) parts: Vec<Vec<f32>>,
    /// Replicates that are finished: those in `light`, if anything bounces.
    pub(super) done: usize,
}

impl Totals {
    /// Of so many nodes with so many places in planes.
    pub(super) fn new(sides: &[Side], stored: usize, [nodes, places]: [usize; 2], replicates: usize) -> Self {
        let spread = if replicates > 1 { vec![vec![bf16::ZERO; places]; stored] } else { Vec::new() };
        let (lighting, direct, light, parts) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Self { sides: sides.to_vec(), stored, nodes, places, lighting, lit: 0, direct, light, spread, parts, done: 0 }
    }

    /// The same before any replicate.
    pub(super) fn emptied(&self) -> Self {
        // Whether there is a spread is all that their number decides.
        let replicates = if self.spread.is_empty() { 1 } else { 2 };
        Self::new(&self.sides, self.stored, [self.nodes, self.places], replicates)
    }

    /// Takes the direct irradiance of a replicate. Returns the planes it does not keep.
    pub(super) fn add_direct(&mut self, new: Vec<Planes>, scene: &Scene, rows: &LitRows) -> Vec<Planes> {
        self.lit += 1;
        let before = 1.0 / (self.lit - 1) as f32;
        let lighting = std::mem::take(&mut self.lighting);
        let mean = |s: usize, i: usize| [0, 1, 2].map(|c| before * lighting[s][c][i]);
        self.deviate((scene, rows), &new, self.lit, mean, None);
        self.lighting = lighting;
        if self.lighting.is_empty() {
            self.lighting = new;
            return Vec::new();
        }
        for (sum, new) in self.lighting.iter_mut().flatten().zip(new.iter().flatten()) {
            sum.par_iter_mut().zip(new).with_min_len(1 << 12).for_each(|(s, n)| *s += n);
        }
        new
    }

    /// Makes the sum of direct light its mean.
    pub(super) fn average_direct(&mut self) {
        let share = 1.0 / self.lit as f32;
        let lighting = std::mem::take(&mut self.lighting);
        self.direct = lighting.iter().map(|planes| HalfPlanes::new(planes, share, None)).collect();
    }

    /// Takes the indirect irradiance of a replicate, or nothing if there is none.
    pub(super) fn add(&mut self, new: &[Planes], (scene, rows): (&Scene, &LitRows), deblur: &Deblur) {
        self.done += 1;
        if new.is_empty() {
            return;
        }
        let before = 1.0 / (self.done - 1) as f32;
        let light = std::mem::take(&mut self.light);
        let mean = |s: usize, i: usize| light[s].all(i).map(|x| before * x);
        self.deviate((scene, rows), new, self.done, mean, Some(deblur));
        let mut old = light.into_iter();
        self.light = new.iter().map(|new| HalfPlanes::new(new, 1.0, old.next())).collect();
    }

    /// Adds the deviations of the light of the replicate that is the `count`th of its kind, where `mean` (side, place)
    /// is that of those before; deblurred, if it will be.
    #[allow(clippy::cast_possible_truncation, reason = "albedo")]
    fn deviate(
        &mut self,
        (scene, rows): (&Scene, &LitRows),
        new: &[Planes],
        count: usize,
        mean: impl Fn(usize, usize) -> [f32; 3] + Sync,
        deblur: Option<&Deblur>,
    ) {
        if self.spread.is_empty() {
            return;
        }
        let luminance = |albedo: DVec3| -> [f32; 3] {
            std::array::from_fn(|c| [0.2126, 0.7152, 0.0722][c] * albedo[c] as f32 / PI)
        };
        let (albedo, h) = (&scene.surface.albedo, scene.field.samples());
        let same = (albedo.stops().len() == 1).then(|| luminance(albedo.at(0.0)));
        let luminance = |node: usize, light: [f32; 3]| -> f32 {
            let luminance = same.unwrap_or_else(|| luminance(albedo.at(f64::from(h[node]))));
            (0..3).map(|c| luminance[c] * light[c]).sum()
        };
        let all = |planes: &Planes, place: usize| [0, 1, 2].map(|c| planes[c][place]);
        let at = |planes: &Planes, node: usize| match deblur.filter(|deblur| deblur.lit[node]) {
            Some(deblur) => luminance(node, deblur.deblurred(node, |node| all(planes, rows.place_of_lit(node)))),
            None => rows.place_of(node).map_or(0.0, |place| luminance(node, all(planes, place))),
        };
        let nodes = (0..self.nodes).step_by(stride(self.nodes));
        let part = new[..self.stored].iter().flat_map(|planes| nodes.clone().map(|node| at(planes, node)));
        match self.parts.get_mut(count - 1) {
            // Its direct light is there.
            Some(sum) => sum.iter_mut().zip(part).for_each(|(sum, x)| *sum += x),
            None => self.parts.push(part.collect()),
        }
        if count == 1 {
            return;
        }
        // (x − mean of those before)² (n − 1)/n.
        let share = (count - 1) as f32 / count as f32;
        for (s, (spread, new)) in self.spread.iter_mut().zip(new).enumerate() {
            let deviation = |node: usize, place: usize| {
                let (new, mean) = (all(new, place), mean(s, place));
                luminance(node, [0, 1, 2].map(|c| new[c] - mean[c]))
            };
            // Known beforehand where a node's is deblurred by those beside it.
            let known = deblur.map(|deblur| {
                let mut known = vec![0f32; rows.len()];
                rows.for_each_run(&mut known, |first, run| {
                    let start = rows.place_of_lit(first);
                    run.iter_mut().enumerate().for_each(|(i, d)| *d = deviation(first + i, start + i));
                });
                (deblur, known)
            });
            rows.for_each_run(&mut spread[..rows.len()], |first, run| {
                let start = rows.place_of_lit(first);
                for (i, root) in run.iter_mut().enumerate() {
                    let node = first + i;
                    let d = match &known {
                        Some((deblur, known)) if deblur.lit[node] => {
                            deblur.deblurred(node, |node| [known[rows.place_of_lit(node)]])[0]
                        }
                        Some((_, known)) => known[start + i],
                        None => deviation(node, start + i),
                    };
                    let before = root.to_f32();
                    if d != 0.0 {
                        *root = bf16::from_f32((before * before + share * d * d).sqrt());
                    }
                }
            });
        }
    }

    /// What all replicates gave at the nodes that are lit: gathered light deblurred, direct light as it is, since
    /// borders of shadows would ring; `apart`: that on its own, too.
    #[allow(clippy::cast_possible_truncation, reason = "a factor of at most 1")]
    pub(super) fn finish(self, rows: &LitRows, deblur: &Deblur, apart: bool) -> Vec<SweptSide> {
        let done = self.done;
        let scale = 1.0 / done as f32;
        let together = together(&self.parts) as f32;
        let mut indirect = self.light.into_iter();
        let mut spread = self.spread.into_iter();
        let side = |(&side, direct): (&Side, HalfPlanes)| {
            let light = indirect.next();
            let own = |place: usize| [0, 1, 2].map(|c| direct.at(c, place));
            let irradiance = all_nodes(rows, deblur, |node, place| {
                let gathered = |light: &HalfPlanes| deblur.deblurred(node, |node| light.all(rows.place_of_lit(node)));
                let (direct, gathered) = (own(place), light.as_ref().map_or([0.0; 3], gathered));
                std::array::from_fn(|c| direct[c] + scale * gathered[c].max(0.0))
            });
            // Of two replicates or more.
            let error = |roots: Vec<bf16>| -> Vec<f32> {
                let factor = (together * scale / (done - 1) as f32).sqrt();
                all_nodes(rows, deblur, |_, place| factor * roots[place].to_f32())
            };
            let direct = if apart { all_nodes(rows, deblur, |_, place| own(place)) } else { Vec::new() };
            SweptSide { side, irradiance, direct, std_error: spread.next().map(error).unwrap_or_default() }
        };
        self.sides.iter().take(self.stored).zip(self.direct).map(side).collect()
    }
}

/// What `value` (node, place in planes) says of the nodes that are lit, in an array of all nodes; 0 at the others.
fn all_nodes<T: Clone + Default + Send>(
    rows: &LitRows,
    deblur: &Deblur,
    value: impl Fn(usize, usize) -> T + Sync,
) -> Vec<T> {
    let mut all = vec![T::default(); deblur.lit.len()];
    let nx = deblur.dims[0];
    all.par_chunks_exact_mut(nx).enumerate().with_min_len(64).for_each(|(row, all)| {
        let (first, run) = rows.run(row);
        for ((i, to), place) in all.iter_mut().enumerate().skip(first).zip(run) {
            let node = row * nx + i;
            if deblur.lit[node] {
                *to = value(node, place);
            }
        }
    });
    all
}

/// The variance of the mean of replicates over that of as many independent ones; 1 unless they are 4, 8, 16 …
///
/// Replicates are parts of one well distributed set, in an order in which their halves and quarters are evenly spread
/// parts of it. Squared deviations of halves from the mean of all average e₂ − e₄, since those from the truth average
/// e₂, and the mean's own is e₄; those of quarters average e₁ − e₄. What is independent of the set falls to a half from
/// quarters to halves to all, what a scrambled set integrates smoothly to an eighth \[Owen97\]: e₄ = (10 (e₂ − e₄) −
/// (e₁ − e₄))/7 is exact for both. For what falls at a rate in between it is too large, at most by two thirds.
fn together(parts: &[Vec<f32>]) -> f64 {
    let count = parts.len();
    if count < 4 || !count.is_power_of_two() {
        return 1.0;
    }
    // Squared deviations of runs of so many replicates, on average.
    let deviations = |run: usize| -> f64 {
        let mean = |run: &[Vec<f32>], i: usize| run.iter().map(|p| f64::from(p[i])).sum::<f64>() / run.len() as f64;
        let node = |i| {
            let all = mean(parts, i);
            parts.chunks(run).map(|run| (mean(run, i) - all).powi(2)).sum::<f64>()
        };
        (0..parts[0].len()).map(node).sum::<f64>() * run as f64 / count as f64
    };
    let [one, quarter, half] = [1, count / 4, count / 2].map(deviations);
    if !(one > 0.0) {
        return 1.0;
    }
    // Two halves may agree by chance: not less than if all fell to a quarter each time.
    let all = ((10.0 * half - quarter) / 7.0).max(quarter / 15.0);
    (all * (count - 1) as f64 / one).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    /// Light that curves loses its share of the curvature, along axes on both sides of which nodes are lit; light that
    /// rises evenly stays as it is, at ends, too.
    #[test]
    fn deblurring_takes_off_what_four_lines_blur() {
        let dims = [5, 4, 2];
        let place = |node: usize| [node % 5, node / 5 % 4, node / 20].map(|x| x as f32);
        let dark = 2 + 5 * 3;
        let lit: Vec<bool> = (0..40).map(|node| node != dark).collect();
        let deblur = Deblur { dims, lit: &lit };
        for node in (0..40).filter(|node| *node != dark) {
            let [even, curved] = deblur.deblurred(node, |node| {
                let [x, y, z] = place(node);
                [1.0 + 2.0 * x - y + 3.0 * z, x * x - 4.0 * y * y + z * z]
            });
            let [x, y, z] = place(node);
            assert!((even - (1.0 + 2.0 * x - y + 3.0 * z)).abs() < 1e-5, "{node}: {even}");
            // Of the node that is dark those beside it along x and y want a neighbour.
            let (along_x, along_y) = (z == 1.0 || y != 3.0 || (x - 2.0).abs() != 1.0, [x, y, z] != [2.0, 2.0, 0.0]);
            let mut expected = x * x - 4.0 * y * y + z * z;
            if (1.0..=3.0).contains(&x) && along_x {
                expected -= 2.0 / 18.0;
            }
            if (1.0..=2.0).contains(&y) && along_y {
                expected += 8.0 / 18.0;
            }
            assert!((curved - expected).abs() < 1e-4, "{node}: {curved} {expected}");
        }
    }

    /// Parts whose errors are drawn such that the squared error of `n` of them is `error(n)`.
    fn parts(count: usize, error: impl Fn(usize) -> f64) -> Vec<Vec<f32>> {
        let mut parts = vec![Vec::new(); count];
        for node in 0..20_000 {
            let mut rng = Rng::stream(1, Stage::Test, node);
            // What all have in common, and the difference of the halves of every run.
            let mut errors = vec![error(count).sqrt() * rng.normal()];
            while errors.len() < count {
                let run = count / errors.len();
                let spread = (error(run / 2) - error(run)).sqrt();
                let split = |e: f64| {
                    let d = spread * rng.normal();
                    [e + d, e - d]
                };
                errors = errors.into_iter().flat_map(split).collect();
            }
            parts.iter_mut().zip(errors).for_each(|(p, e)| p.push(0.7 + 0.01 * e as f32));
        }
        parts
    }

    #[test]
    fn the_variance_of_the_mean_follows_from_halves_and_quarters() {
        for count in [4usize, 8, 16] {
            for set in [0.0, 0.3, 0.6, 1.0] {
                let error = |n: usize| set / n.pow(3) as f64 + (1.0 - set) / n as f64;
                let all = error(count).max((error(count / 4) - error(count)) / 15.0);
                let expected = all * (count - 1) as f64 / (1.0 - error(count));
                let found = together(&parts(count, error));
                println!("{count} replicates, {set} by the set: {found:.4}, expected {expected:.4}");
                assert!((found / expected - 1.0).abs() < 0.1);
            }
        }
        for count in [2, 3, 6] {
            assert_eq!(together(&vec![vec![0.0; 5]; count]), 1.0);
        }
        assert_eq!(together(&vec![vec![0.5; 5]; 4]), 1.0, "no spread at all");
    }
}
