//! The suggested sweep: where isosurfaces are, and where they are noise.

use super::bin;
use crate::volume::{Lattice, Volume, each_sample_type};
use glam::DVec3;
use rayon::prelude::*;

/// Bins of the survey over the range: enough to resolve a sweep that spans a hundredth of it.
const FINE: usize = 1 << 14;

/// Bins between the background and the far end, for the coherence.
const COARSE: usize = 64;

/// Slabs of the lattice whose sums are added in order, whatever the number of threads.
const SLABS: usize = 32;

/// Share of the isosurface area left out beyond the far end of the sweep, and before its near end.
const FAR_AREA: f64 = 0.005;
const NEAR_AREA: f64 = 0.05;

/// Share of the range kept free at the ends, against plateaus (saturated detectors, clipped data).
const MARGIN: f64 = 0.02;

/// Coherence, relative to the sweep's median, that surfaces have and noise has not.
const COHERENT: f64 = 0.85;

/// Sums over the samples of each fine bin, and the samples whose gradient is zero.
pub(super) struct Survey {
    range: [f64; 2],
    /// ∫|∇h| dV in units of the cell volume and of [`unit`]: isosurface area × bin width.
    area: Vec<f64>,
    /// Σ ∇₁h·∇₂h/|∇₂h| over gradients of ±1 and ±2 samples: the part of `area` that the wider one confirms.
    confirmed: Vec<f64>,
    pub(super) flat: usize,
}

impl Survey {
    pub(super) fn of(volume: &Volume, range: [f64; 2]) -> Self {
        #[allow(clippy::unnecessary_cast, reason = "the macro's f64 arm casts to itself")]
        let survey = each_sample_type!(volume.samples(), v => scan(&volume.lattice, range, |o| v[o] as f64));
        survey
    }

    fn new(range: [f64; 2]) -> Self {
        Self { range, area: vec![0.0; FINE], confirmed: vec![0.0; FINE], flat: 0 }
    }

    /// The value in the middle of a fine bin.
    fn value(&self, bin: usize) -> f64 {
        let t = (bin as f64 + 0.5) / FINE as f64;
        self.range[0] * (1.0 - t) + self.range[1] * t
    }

    /// The sweep for a background value; `None` if there is no surface.
    pub(super) fn suggest(&self, background: f64, integer: bool) -> Option<[f64; 2]> {
        let total: f64 = self.area.iter().sum();
        let [min, max] = self.range;
        if total == 0.0 || !total.is_finite() || !(max - min).is_finite() {
            return None;
        }
        // All is said from the background's end of the range; a bright background is seen in a mirror.
        let mirrored = background > 0.5 * min + 0.5 * max;
        let far_end = if mirrored { min } else { max };
        let order = |n: usize| if mirrored { FINE - 1 - n } else { n };
        let quantile = |share: f64| {
            let mut sum = 0.0;
            let reached = |n: &usize| {
                sum += self.area[order(*n)];
                sum >= share * total
            };
            self.value(order((0..FINE).find(reached).unwrap_or(FINE - 1)))
        };
        let span = far_end - background;
        // A sign, because the product of two differences may vanish.
        let side = span.signum();
        let beyond = |a: f64, b: f64| if (a - b) * side > 0.0 { a } else { b };
        let before = |a: f64, b: f64| if (a - b) * side > 0.0 { b } else { a };
        let far = before(quantile(1.0 - FAR_AREA), far_end - MARGIN * span);
        let mut near = beyond(quantile(NEAR_AREA), self.coherent_from(background, far));
        // The background itself has no surface: it is a plateau.
        near = beyond(near, background + MARGIN * (far - background));
        if (far - near) * side <= 0.0 {
            // A field of two plateaus: anything between them will do.
            let middle = |t: f64| background + t * span;
            return Some(sorted(middle(0.25), middle(0.75)));
        }
        let sweep = sorted(near, far);
        // Rounding must not undo what was decided, and both ends must stay inside the range: try finer steps then.
        let kept = |c: f64| c > min && c < max && (c - background) * side > 0.0;
        let parts: [f64; 3] = if integer { [20.0, 50.0, 100.0] } else { [200.0, 500.0, 1000.0] };
        let mut tries = parts.into_iter().map(|p| nice(sweep, p));
        Some(tries.find(|r| r[0] < r[1] && kept(r[0]) && kept(r[1])).unwrap_or(sweep))
    }

    /// The first value between background and `far` from which on the field is coherent.
    fn coherent_from(&self, background: f64, far: f64) -> f64 {
        let (mut area, mut confirmed) = ([0.0; COARSE], [0.0; COARSE]);
        for n in 0..FINE {
            let t = (self.value(n) - background) / (far - background);
            if (0.0..1.0).contains(&t) {
                area[(t * COARSE as f64) as usize] += self.area[n];
                confirmed[(t * COARSE as f64) as usize] += self.confirmed[n];
            }
        }
        // Empty bins, between the integers of a narrow range, say nothing.
        let bins: Vec<(usize, f64)> =
            (0..COARSE).filter(|&b| area[b] > 0.0).map(|b| (b, confirmed[b] / area[b])).collect();
        if bins.is_empty() {
            return background;
        }
        let mut sorted: Vec<f64> = bins.iter().map(|b| b.1).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let limit = COHERENT * sorted[sorted.len() / 2];
        // One coherent bin is not enough: a background's own rim is coherent too.
        let first = (bins.windows(2).find(|w| w.iter().all(|b| b.1 >= limit))).map_or(0, |w| w[0].0);
        background + (far - background) * first as f64 / COARSE as f64
    }
}

fn sorted(a: f64, b: f64) -> [f64; 2] {
    [a.min(b), a.max(b)]
}

/// Both ends as multiples of 1, 2 or 5 · 10ⁿ, at most a `parts`-th of the sweep apart.
fn nice([lo, hi]: [f64; 2], parts: f64) -> [f64; 2] {
    let most = (hi - lo) / parts;
    let exponent = most.log10().floor();
    let power = 10f64.powf(exponent);
    let multiple = [5.0, 2.0, 1.0].into_iter().find(|m| m * power <= most).unwrap_or(1.0);
    // Written down and read: decimals like 0.3, where multiplying gives 0.30000000000000004.
    let round = |v: f64| {
        let count = (v / (multiple * power)).round() * multiple + 0.0;
        format!("{count}e{exponent}").parse().unwrap_or(f64::NAN)
    };
    let rounded = [round(lo), round(hi)];
    if rounded.iter().all(|v| v.is_finite()) { rounded } else { [lo, hi] }
}

/// Central difference over ±`reach` samples along one axis, one-sided where the lattice ends.
#[inline]
fn difference(get: &impl Fn(usize) -> f64, o: usize, i: usize, n: usize, stride: usize, reach: usize) -> f64 {
    let (below, above) = (reach.min(i), reach.min(n - 1 - i));
    (get(o + above * stride) - get(o - below * stride)) / (below + above) as f64
}

/// The power of two next to 1 / the range's greatest magnitude: squares of what it multiplies neither overflow nor
/// vanish, and no bits change.
fn unit([min, max]: [f64; 2]) -> f64 {
    (-min.abs().max(max.abs()).log2().floor()).clamp(-1022.0, 1022.0).exp2()
}

fn scan(lattice: &Lattice, range: [f64; 2], get: impl Fn(usize) -> f64 + Sync) -> Survey {
    let unit = unit(range);
    let [nx, ny, nz] = lattice.dims();
    let slabs = SLABS.min(nz);
    let parts: Vec<Survey> = (0..slabs)
        .into_par_iter()
        .map(|slab| {
            let mut part = Survey::new(range);
            for k in slab * nz / slabs..(slab + 1) * nz / slabs {
                for j in 0..ny {
                    for i in 0..nx {
                        let o = lattice.offset(i, j, k);
                        let gradient = |reach| {
                            DVec3::new(
                                difference(&get, o, i, nx, 1, reach),
                                difference(&get, o, j, ny, nx, reach),
                                difference(&get, o, k, nz, nx * ny, reach),
                            )
                        };
                        let near = gradient(1);
                        let h = get(o);
                        if near == DVec3::ZERO {
                            part.flat += usize::from(h.is_finite());
                            continue;
                        }
                        let near = lattice.gradient_to_world(near * unit);
                        let area = near.length();
                        if !(area.is_finite() && h.is_finite()) {
                            continue;
                        }
                        let wide = lattice.gradient_to_world(gradient(2) * unit).normalize_or_zero();
                        let b = bin(h, range, FINE);
                        part.area[b] += area;
                        part.confirmed[b] += if wide.is_finite() { near.dot(wide) } else { 0.0 };
                    }
                }
            }
            part
        })
        .collect();
    let mut sum = Survey::new(range);
    for part in parts {
        sum.flat += part.flat;
        sum.area.iter_mut().zip(part.area).for_each(|(a, b)| *a += b);
        sum.confirmed.iter_mut().zip(part.confirmed).for_each(|(a, b)| *a += b);
    }
    sum
}
