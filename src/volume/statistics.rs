//! What a volume holds, for `info`: range, percentiles, histogram, flat share, and a sweep to start from.

mod sweep;

use crate::digits::{Shortest, brief, brief_span, brief_within, span};
use crate::volume::{Samples, Volume};
use rayon::prelude::*;
use serde::Serialize;
use std::fmt::Write as _;

/// The percentiles that are reported.
pub const PERCENTILES: [f64; 5] = [1.0, 50.0, 90.0, 99.0, 99.9];

/// Bins of [`VolumeStatistics::histogram`].
pub const BINS: usize = 64;

/// What a volume holds. Values are in source units; NaN and infinities are counted and left out of everything else.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VolumeStatistics {
    /// The volume's name.
    pub name: String,
    /// Samples along x, y, z.
    pub dims: [usize; 3],
    /// World position of the first sample.
    pub origin: [f64; 3],
    /// World step of one index along each axis: `axes[a]` is axis a.
    pub axes: [[f64; 3]; 3],
    /// World length of the steps.
    pub spacing: [f64; 3],
    /// What the world's axes mean ([`crate::volume::Space`]); left-posterior-superior where the file says nothing.
    pub space: &'static str,
    /// Name of the sample type: `u8`, `f32` …
    pub element_type: &'static str,
    /// Number of samples.
    pub samples: usize,
    /// Samples that are NaN or infinite.
    pub non_finite: usize,
    /// Samples that f64 does not hold: integers beyond 2⁵³, which are rounded in everything below.
    pub rounded: usize,
    /// Least and greatest sample; `None` (as all below) if no sample is finite.
    pub range: Option<[f64; 2]>,
    /// The samples at [`PERCENTILES`], each a value that occurs.
    pub percentiles: Option<[f64; 5]>,
    /// Samples in each of [`BINS`] bins of equal width over the range; the last includes the maximum.
    pub histogram: Option<Vec<u64>>,
    /// The value of most samples; of several, the least.
    pub commonest: Option<f64>,
    /// Its share of the finite samples, 0 … 1.
    pub commonest_share: Option<f64>,
    /// Distinct values.
    pub distinct: usize,
    /// The commonest value, if it is so far from all others as only a mark for missing samples is: 90 times as far as
    /// they are apart. Then no sweep is suggested.
    pub fill: Option<f64>,
    /// Samples whose central-difference gradient (one-sided on the boundary) is exactly zero.
    pub flat: usize,
    /// Suggested sweep [lo, hi]: see [`VolumeStatistics::of`]. `None` for a constant volume, for a range that f64 does
    /// not hold, if no neighbours are finite, and beside a [`VolumeStatistics::fill`].
    pub sweep: Option<[f64; 2]>,
}

/// See [`VolumeStatistics::fill`].
const APART: f64 = 90.0;

/// The share of samples from which on a value is more than one of many.
const COMMON: f64 = 0.01;

/// Volumes of at most so many values may be of labels.
const LABELS: usize = 32;

/// The samples in order, as far as percentiles need it.
struct Distribution {
    /// Distinct values, ascending.
    values: Vec<f64>,
    /// Samples up to and with each value.
    cumulative: Vec<u64>,
}

impl VolumeStatistics {
    /// Examines a volume: one pass over the samples and one over their gradients (plus a parallel sort for types of
    /// more than 16 bits), with the same result for every number of threads.
    ///
    /// The suggested sweep leaves out background and noise. Its upper end holds back ½ % of all isosurface area
    /// (∫|∇h| dV, by the coarea formula) and 2 % of the range; its lower end stands above the background (the commonest
    /// value), past 5 % of the area, and where the field becomes coherent: gradients taken over ±1 and over ±2 samples
    /// agree on surfaces and are independent in noise. For a background brighter than the middle of the range the two
    /// ends change roles. Both ends lie strictly inside the range, so that no isosurface of a volume of finite samples
    /// is empty.
    pub fn of(volume: &Volume) -> Self {
        let lattice = &volume.lattice;
        let distribution = Distribution::of(volume.samples());
        let axes = lattice.axes();
        let mut statistics = Self {
            name: volume.name.clone(),
            dims: lattice.dims(),
            origin: lattice.origin().to_array(),
            axes: [axes.x_axis, axes.y_axis, axes.z_axis].map(|a| a.to_array()),
            spacing: lattice.spacing().to_array(),
            space: volume.space.name(),
            element_type: volume.samples().element_type().name(),
            samples: lattice.len(),
            non_finite: volume.non_finite(),
            rounded: volume.rounded(),
            range: None,
            percentiles: None,
            histogram: None,
            commonest: None,
            commonest_share: None,
            distinct: distribution.values.len(),
            fill: None,
            flat: 0,
            sweep: None,
        };
        let (Some(&min), Some(&max)) = (distribution.values.first(), distribution.values.last()) else {
            return statistics;
        };
        let (commonest, share) = distribution.commonest();
        statistics.range = Some([min, max]);
        statistics.percentiles = Some(PERCENTILES.map(|p| distribution.percentile(p)));
        statistics.histogram = Some(distribution.histogram());
        (statistics.commonest, statistics.commonest_share) = (Some(commonest), Some(share));
        statistics.fill = (share >= COMMON && distribution.is_apart(commonest)).then_some(commonest);
        let survey = sweep::Survey::of(volume, [min, max]);
        statistics.flat = survey.flat;
        let integer = !matches!(volume.samples(), Samples::F32(_) | Samples::F64(_));
        // Measured fields may never take the same value twice; then the fullest bin tells the background.
        let background = if share >= COMMON { commonest } else { distribution.fullest() };
        statistics.sweep = survey.suggest(background, integer).filter(|_| statistics.fill.is_none());
        statistics
    }

    /// Why no sweep is suggested and what to do, for people; `None` if one is.
    pub fn without_sweep(&self) -> Option<String> {
        if let (None, Some(fill), Some(share)) = (self.sweep, self.fill, self.commonest_share) {
            return Some(format!(
                "{:.1} % of its samples are {}, far from all others, as if these were missing: make them NaN (other files \
                 than those of integers hold it), or choose a sweep (--isovalues, or `isovalues` in a scene file)",
                100.0 * share,
                brief(fill)
            ));
        }
        let why = match self.range {
            _ if self.sweep.is_some() => return None,
            None => "none of its samples is finite: it holds no isosurface".into(),
            Some([min, max]) if min < max => format!(
                "its samples, {}, suggest none (they are too far apart, or no neighbours are finite); choose one \
                 (--isovalues, or `isovalues` in a scene file)",
                span((min, max))
            ),
            Some([v, _]) if self.rounded > 0 => {
                format!(
                    "64-bit floats do not tell its samples, all near {}, apart: subtract that from them",
                    Shortest(v)
                )
            }
            Some([v, _]) => format!("every sample is {}: it holds no isosurface", Shortest(v)),
        };
        Some(why)
    }

    /// A table for people, one fact per line.
    pub fn to_text(&self) -> String {
        let mut t = String::new();
        let mut line = |key: &str, value: String| {
            let _ = writeln!(t, "{key:<18}{value}");
        };
        let list = |v: &[f64]| v.iter().map(|v| brief(*v).to_string()).collect::<Vec<_>>().join("  ");
        let percent = |n: usize| format!("{:.3} %", 100.0 * n as f64 / self.samples as f64);
        let [nx, ny, nz] = self.dims;
        line("volume", self.name.clone());
        line("samples", format!("{nx} × {ny} × {nz} = {}, type {}", self.samples, self.element_type));
        line("world", self.space.to_owned());
        line("spacing", list(&self.spacing));
        // A place needs digits by what stands beside it, however far away the world's begins.
        let step = self.spacing.into_iter().fold(f64::INFINITY, f64::min);
        line("origin", self.origin.map(|x| brief_within(x, [0.0, step]).to_string()).join("  "));
        let aligned = (0..3).all(|a| (0..3).all(|c| a == c || self.axes[a][c] == 0.0) && self.axes[a][a] > 0.0);
        if !aligned {
            let rows: Vec<String> = self.axes.iter().map(|a| format!("({})", list(a))).collect();
            line("axes", rows.join(" "));
        }
        line("not finite", format!("{} ({})", self.non_finite, percent(self.non_finite)));
        if self.rounded > 0 {
            let rounded = format!("{} ({})", self.rounded, percent(self.rounded));
            line(
                "rounded",
                format!("{rounded}: integers beyond 2^53, which 64-bit floats do not hold; subtract an offset"),
            );
        }
        if let (Some(range), Some(p), Some(c), Some(share)) =
            (self.range, self.percentiles, self.commonest, self.commonest_share)
        {
            line("range", brief_span(range));
            let values = p.map(|v| brief_within(v, range).to_string()).join("  ");
            line("percentiles", format!("{values}  (at {} %)", PERCENTILES.map(|p| p.to_string()).join(", ")));
            line("commonest value", format!("{}, {:.3} % of samples", brief_within(c, range), 100.0 * share));
            line("zero gradient", format!("{} ({})", self.flat, percent(self.flat)));
            if (3..=LABELS).contains(&self.distinct) {
                line("distinct values", format!("{}; if they are labels, see the recipes", self.distinct));
            }
        }
        let none = || self.without_sweep().map_or_else(String::new, |why| format!("none: {why}"));
        line("suggested sweep", self.sweep.map_or_else(none, brief_span));
        if let Some(histogram) = &self.histogram {
            line("histogram", bars(histogram));
        }
        t
    }
}

impl std::fmt::Display for VolumeStatistics {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(&self.to_text())
    }
}

/// A histogram as a line of bars, logarithmic: backgrounds are many orders of magnitude commoner than surfaces.
fn bars(histogram: &[u64]) -> String {
    const BARS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let most = histogram.iter().copied().max().unwrap_or(0).max(1) as f64;
    let bar = |&n: &u64| if n == 0 { 0 } else { 1 + ((n as f64).ln_1p() / most.ln_1p() * 7.0).round() as usize };
    let line: String = histogram.iter().map(|n| BARS[bar(n).min(8)]).collect();
    format!("|{line}| (logarithmic)")
}

impl Distribution {
    fn of(samples: &Samples) -> Self {
        match samples {
            Samples::U8(v) => Self::count(v, u8::MIN as i32, |s| s as i32),
            Samples::I8(v) => Self::count(v, i8::MIN as i32, |s| s as i32),
            Samples::U16(v) => Self::count(v, u16::MIN as i32, |s| s as i32),
            Samples::I16(v) => Self::count(v, i16::MIN as i32, |s| s as i32),
            Samples::U32(v) => Self::sort(v.clone(), |s| s as f64),
            Samples::I32(v) => Self::sort(v.clone(), |s| s as f64),
            Samples::U64(v) => Self::sort(v.clone(), |s| s as f64),
            Samples::I64(v) => Self::sort(v.clone(), |s| s as f64),
            // Integers whose order is the floats' own; −0 becomes 0, as they are the same value.
            Samples::F32(v) => {
                Self::sort(v.par_iter().filter(|s| s.is_finite()).map(|s| key32(s + 0.0)).collect(), |k: i32| {
                    f32::from_bits(unkey32(k)) as f64
                })
            }
            Samples::F64(v) => {
                Self::sort(v.par_iter().filter(|s| s.is_finite()).map(|s| key64(s + 0.0)).collect(), |k: i64| {
                    f64::from_bits(unkey64(k))
                })
            }
        }
    }

    /// For types of at most 16 bits.
    fn count<T: Copy + Sync>(samples: &[T], least: i32, value: impl Fn(T) -> i32 + Sync) -> Self {
        let counts = samples
            .par_chunks(1 << 20)
            .map(|chunk| {
                let mut counts = vec![0u64; 1 << 16];
                chunk.iter().for_each(|&s| counts[(value(s) - least) as usize] += 1);
                counts
            })
            .reduce(
                || vec![0; 1 << 16],
                |mut a, b| {
                    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
                    a
                },
            );
        let (mut values, mut cumulative, mut total) = (vec![], vec![], 0);
        for (i, &n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
            total += n;
            values.push((i as i32 + least) as f64);
            cumulative.push(total);
        }
        Self { values, cumulative }
    }

    fn sort<T: Copy + Ord + Send>(mut samples: Vec<T>, value: impl Fn(T) -> f64) -> Self {
        samples.par_sort_unstable();
        let (mut values, mut cumulative, mut total) = (vec![], vec![], 0);
        for run in samples.chunk_by(|a, b| a == b) {
            total += run.len() as u64;
            let v = value(run[0]);
            // 64-bit integers beyond 2⁵³ may become the same f64.
            if values.last() == Some(&v) {
                cumulative.pop();
            } else {
                values.push(v);
            }
            cumulative.push(total);
        }
        Self { values, cumulative }
    }

    fn total(&self) -> u64 {
        self.cumulative.last().copied().unwrap_or(0)
    }

    /// The least value that at least p % of the samples do not exceed.
    fn percentile(&self, p: f64) -> f64 {
        let rank = (p / 100.0 * self.total() as f64).ceil().max(1.0) as u64;
        self.values[self.cumulative.partition_point(|&n| n < rank).min(self.values.len() - 1)]
    }

    /// Whether a value is the least or greatest, and [`APART`] times as far from the others as they are apart.
    fn is_apart(&self, value: f64) -> bool {
        let (others, gap) = match &self.values[..] {
            [first, others @ ..] if *first == value && others.len() > 1 => (others, 0.5 * others[0] - 0.5 * value),
            [others @ .., last] if *last == value && others.len() > 1 => {
                (others, 0.5 * value - 0.5 * others[others.len() - 1])
            }
            _ => return false,
        };
        // Halves, since differences may overflow.
        gap > APART * (0.5 * others[others.len() - 1] - 0.5 * others[0])
    }

    fn commonest(&self) -> (f64, f64) {
        let (mut best, mut most, mut before) = (self.values[0], 0, 0);
        for (&v, &n) in self.values.iter().zip(&self.cumulative) {
            if n - before > most {
                (best, most) = (v, n - before);
            }
            before = n;
        }
        (best, most as f64 / self.total() as f64)
    }

    /// The middle of the histogram's fullest bin; of the first and last, the range's end.
    fn fullest(&self) -> f64 {
        let (min, max) = (self.values[0], self.values[self.values.len() - 1]);
        let histogram = self.histogram();
        let most = histogram.iter().copied().max();
        match histogram.iter().position(|&n| Some(n) == most).unwrap_or(0) {
            0 => min,
            b if b == BINS - 1 => max,
            b => {
                let t = (b as f64 + 0.5) / BINS as f64;
                min * (1.0 - t) + max * t
            }
        }
    }

    fn histogram(&self) -> Vec<u64> {
        let (min, max) = (self.values[0], self.values[self.values.len() - 1]);
        let mut bins = vec![0; BINS];
        let mut before = 0;
        for (&v, &n) in self.values.iter().zip(&self.cumulative) {
            bins[bin(v, [min, max], BINS)] += n - before;
            before = n;
        }
        bins
    }
}

/// The bin of a value: equal widths over the range, the last with the maximum.
fn bin(v: f64, [min, max]: [f64; 2], bins: usize) -> usize {
    // Halves, because max − min of two finite values may overflow.
    let at = (0.5 * v - 0.5 * min) / (0.5 * max - 0.5 * min);
    if at.is_nan() { 0 } else { ((at * bins as f64) as usize).min(bins - 1) }
}

fn key32(v: f32) -> i32 {
    let b = v.to_bits() as i32;
    b ^ ((b >> 31) as u32 >> 1) as i32
}

fn unkey32(k: i32) -> u32 {
    (k ^ ((k >> 31) as u32 >> 1) as i32) as u32
}

fn key64(v: f64) -> i64 {
    let b = v.to_bits() as i64;
    b ^ ((b >> 63) as u64 >> 1) as i64
}

fn unkey64(k: i64) -> u64 {
    (k ^ ((k >> 63) as u64 >> 1) as i64) as u64
}

#[cfg(test)]
#[path = "statistics/tests.rs"]
mod tests;
