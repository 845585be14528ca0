//! Where along the isovalue the texels of walls' light stand: half of them evenly, half where most of a volume is.
//! Densities fall by orders of magnitude, and so do the isovalues that tell their level sets apart.

use rayon::prelude::*;
use serde::Serialize;

/// The share of texels that do not stand evenly.
const BENT: f32 = 0.5;
/// Texels stand evenly unless half of all samples lie within this share of the sweep at one of its ends.
const END: f32 = 0.1;
/// No nearer to an end of the sweep does an axis crowd: six decades.
const LEAST: f32 = 1e-3;
/// Bins of samples between the ends of the sweep.
const BINS: usize = 1 << 16;
/// Samples that one thread counts at least.
const BLOCK: usize = 1 << 20;

/// A rising map of the sweep, [0, 1], onto itself: (1 − s) c + s ln(1 + c / a) / ln(1 + 1 / a) with s = ½ if half
/// of all samples lie in the lowest tenth, that upside down if they lie in the highest, and otherwise c. The middle of
/// the second term is at their median m with a = m² / (1 − 2 m). For the logarithm stands what a float's bits are as
/// an integer, which is linear between powers of two: the same everywhere, and inverted without loss.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct IsovalueAxis {
    middle: f32,
    pub(crate) even: f32,
    /// u = from + slope · c.
    pub(crate) from: f32,
    pub(crate) slope: f32,
    /// Bits of u at c = 0, and what the difference to them counts for.
    pub(crate) first: i32,
    pub(crate) scale: f32,
}

impl IsovalueAxis {
    /// All texels as long.
    pub const EVEN: Self =
        Self { middle: 0.5, even: 1.0, from: 1.0, slope: 0.0, first: 1f32.to_bits() as i32, scale: 0.0 };

    /// Crowds about `middle` ∈ [0, 1], in units of the sweep, if that is in its lowest or highest tenth; else even.
    #[must_use]
    pub fn around(middle: f32) -> Self {
        let m = middle.min(1.0 - middle).max(LEAST);
        let a = m * m / (1.0 - 2.0 * m);
        if m >= END || middle.is_nan() {
            return Self::EVEN;
        }
        let (from, slope) = if middle < 0.5 { (a, 1.0) } else { (1.0 + a, -1.0) };
        let first = bits(from);
        #[allow(clippy::cast_precision_loss, reason = "as `place` has it")]
        let all = (bits(from + slope) - first) as f32;
        Self { middle, even: 1.0 - BENT, from, slope, first, scale: BENT / all }
    }

    /// The axis for those samples of volumes (in units of the sweep) that lie in it.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "bins of [0, 1]")]
    pub fn of<'a>(volumes: impl IntoIterator<Item = &'a [f32]>) -> Self {
        let count = |block: &[f32]| {
            let mut bins = vec![0u64; BINS];
            for h in block.iter().filter(|h| (0.0..=1.0).contains(*h)) {
                bins[((h * BINS as f32) as usize).min(BINS - 1)] += 1;
            }
            bins
        };
        let add = |mut a: Vec<u64>, b: Vec<u64>| {
            a.iter_mut().zip(&b).for_each(|(a, b)| *a += b);
            a
        };
        let bins = volumes.into_iter().filter_map(|samples| samples.par_chunks(BLOCK).map(count).reduce_with(add));
        let Some(bins) = bins.reduce(add) else { return Self::EVEN };
        let all: u64 = bins.iter().sum();
        let mut below = 0;
        let median = bins.iter().position(|n| {
            below += n;
            2 * below > all
        });
        median.map_or(Self::EVEN, |bin| Self::around((bin as f32 + 0.5) / BINS as f32))
    }

    /// What [`Self::around`] makes it from.
    #[must_use]
    pub fn middle(&self) -> f32 {
        self.middle
    }

    /// Whether all texels are as long.
    #[must_use]
    pub fn is_even(&self) -> bool {
        self.scale == 0.0
    }

    /// Where isovalue c stands, in [0, 1]; beyond the sweep, as its nearer end.
    #[must_use]
    #[inline(always)]
    pub fn place(&self, c: f32) -> f32 {
        let c = c.clamp(0.0, 1.0);
        let u = self.from + self.slope * c;
        #[allow(clippy::cast_precision_loss, reason = "a ten-millionth of the axis")]
        let rise = (bits(u) - self.first) as f32;
        self.even * c + self.scale * rise
    }

    /// By how much places rise with the isovalue at c ∈ [0, 1]: how many times as many texels are there as evenly.
    #[must_use]
    pub fn density(&self, c: f32) -> f32 {
        let u = self.from + self.slope * c;
        // Bits rise by 2²³ from a power of two to the next.
        let octave = f32::from_bits(u.to_bits() & 0x7f80_0000);
        self.even + self.scale * self.slope * (8_388_608.0 / octave)
    }

    /// The isovalue that stands at `place` ∈ [0, 1].
    #[must_use]
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    pub fn isovalue(&self, place: f64) -> f64 {
        if self.is_even() {
            return place;
        }
        let (mut lo, mut hi) = (0.0, 1.0);
        // Bisection: few are asked for.
        for _ in 0..40 {
            let c = 0.5 * (lo + hi);
            (lo, hi) = if f64::from(self.place(c as f32)) < place { (c, hi) } else { (lo, c) };
        }
        0.5 * (lo + hi)
    }

    /// The isovalues where `n` texels begin, and where the last one ends.
    #[must_use]
    pub fn edges(&self, n: usize) -> Vec<f64> {
        (0..=n).map(|i| self.isovalue(i as f64 / n as f64)).collect()
    }

    /// The isovalues of the centres of `n` texels.
    #[must_use]
    pub fn centres(&self, n: usize) -> Vec<f64> {
        (0..n).map(|i| self.isovalue((i as f64 + 0.5) / n as f64)).collect()
    }
}

/// A positive float's bits: 2²³ log₂ x and a constant, linear between powers of two.
#[inline(always)]
#[allow(clippy::cast_possible_wrap, reason = "the sign bit is not set")]
fn bits(x: f32) -> i32 {
    x.to_bits() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIDDLES: [f32; 8] = [0.0, 0.001, 0.02, 0.09, 0.3, 0.92, 0.995, 1.0];

    /// Ends stay where they are, nothing is stood on its head, and texels are found at their isovalues.
    #[test]
    fn the_sweep_is_mapped_onto_itself() {
        for middle in MIDDLES {
            let axis = IsovalueAxis::around(middle);
            assert!(axis.place(-3.0).abs() < 1e-6 && axis.place(f32::NEG_INFINITY).abs() < 1e-6, "{middle}");
            assert!((axis.place(1.0) - 1.0).abs() < 1e-6 && (axis.place(7.0) - 1.0).abs() < 1e-6, "{middle}");
            let mut last = -1.0;
            for i in 0..=10_000u16 {
                let place = axis.place(f32::from(i) * 1e-4);
                assert!(place > last, "{middle}: {place} after {last}");
                last = place;
            }
            for (i, c) in axis.centres(32).into_iter().enumerate() {
                let place = f64::from(axis.place(c as f32));
                // Next to 1 floats are as far apart as that.
                assert!((32.0 * place - i as f64 - 0.5).abs() < if middle > 0.9 { 0.1 } else { 1e-4 }, "{middle}: {i}");
            }
        }
    }

    /// Half of the texels that do not stand evenly are on either side of the median, and nowhere are texels more than
    /// twice as long as even ones.
    #[test]
    fn texels_are_where_samples_are() {
        for middle in MIDDLES {
            let axis = IsovalueAxis::around(middle);
            for c in [0.0, 0.003, 0.1, 0.47, 0.81, 0.995] {
                let step = 1e-4;
                // Powers of two in between.
                let near = [axis.density(c), axis.density(c + step)];
                let found = (axis.place(c + step) - axis.place(c)) / step;
                let within = near[0].min(near[1]) * 0.99..=near[0].max(near[1]) * 1.01;
                assert!(within.contains(&found), "{middle}, {c}: {found}, not {near:?}");
            }
            let slope = |c: f32| (axis.place(c + 0.01) - axis.place(c)) / 0.01;
            assert!((0..99u8).all(|i| slope(f32::from(i) * 0.01) > 0.499), "{middle}");
            assert_eq!(axis.is_even(), middle == 0.3);
            if (0.02..0.99).contains(&middle) && !axis.is_even() {
                // The bits are up to 0.086 octaves off the logarithm.
                let half = axis.place(middle) - 0.5 * middle;
                assert!((half - 0.25).abs() < 0.03, "{middle}: {half}");
            }
        }
        let axis = IsovalueAxis::around(0.02);
        assert!(axis.place(0.001) > 0.07, "{}", axis.place(0.001));
        assert!((1.0 - IsovalueAxis::around(0.98).place(0.999) - axis.place(0.001)).abs() < 1e-3);
    }

    #[test]
    fn medians_are_those_of_samples_in_the_sweep() {
        // Fourth powers: a sixteenth is the median of those up to 1.
        let samples: Vec<f32> = (0..3_000_000).map(|i| (i as f32 / 2_000_000.0).powi(4)).collect();
        let axis = IsovalueAxis::of([&samples[..1_000_000], &samples[1_000_000..]]);
        assert!((axis.middle() - 0.0625).abs() < 1e-4, "{}", axis.middle());
        let below: Vec<f32> = samples.iter().map(|h| -1.0 - h).chain([f32::NAN]).collect();
        assert_eq!(IsovalueAxis::of([&below[..]]), IsovalueAxis::EVEN, "no sample is in the sweep");
        assert_eq!(IsovalueAxis::of([&[][..]]), IsovalueAxis::EVEN);
        assert_eq!(IsovalueAxis::around(f32::NAN), IsovalueAxis::EVEN);
    }

    #[test]
    fn even_axes_change_nothing() {
        let axis = IsovalueAxis::of([&[0.3, 0.5, 0.55, 0.9][..]]);
        assert!([0.0, 0.125, 0.3, 0.77, 1.0].into_iter().all(|c| axis.place(c) == c));
        assert_eq!(axis.centres(4), [0.125, 0.375, 0.625, 0.875]);
    }
}
