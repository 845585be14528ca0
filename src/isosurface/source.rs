//! Where the samples of the lattice that is marched come from: memory, or trilinear values between samples in memory.

/// Samples on a lattice, x fastest.
pub(super) trait Source: Sync {
    /// Samples along each axis.
    fn dims(&self) -> [usize; 3];

    /// Fills `row` with the samples (·, j, k).
    fn row(&self, j: usize, k: usize, row: &mut [f64]);

    /// Sample (i, j, k): the same bits as in [`Source::row`].
    fn at(&self, i: usize, j: usize, k: usize) -> f64;

    /// Sets bit i of `inside` if sample (i, j, k) is at least `c`, and returns whether all samples of the row are
    /// finite. `row` is room for [`Source::row`].
    fn classify(&self, j: usize, k: usize, c: f64, row: &mut [f64], inside: &mut [u64]) -> bool {
        self.row(j, k, row);
        let mut finite = true;
        for (word, values) in inside.iter_mut().zip(row.chunks(64)) {
            let mut bits = 0;
            for (i, h) in values.iter().enumerate() {
                bits |= u64::from(*h >= c) << i;
                finite &= h.is_finite();
            }
            *word = bits;
        }
        finite
    }

    /// Index coordinates of the samples in memory, from those of this lattice.
    fn index_coordinate(&self, x: f64) -> f64;
}

/// The samples in memory.
pub(super) struct Plain<'a> {
    pub(super) dims: [usize; 3],
    pub(super) samples: &'a [f32],
}

impl Plain<'_> {
    #[inline]
    fn slice(&self, j: usize, k: usize) -> &[f32] {
        let [nx, ny, _] = self.dims;
        let start = (k * ny + j) * nx;
        &self.samples[start..start + nx]
    }
}

impl Source for Plain<'_> {
    fn dims(&self) -> [usize; 3] {
        self.dims
    }

    fn row(&self, j: usize, k: usize, row: &mut [f64]) {
        row.iter_mut().zip(self.slice(j, k)).for_each(|(r, h)| *r = f64::from(*h));
    }

    #[inline]
    fn at(&self, i: usize, j: usize, k: usize) -> f64 {
        f64::from(self.slice(j, k)[i])
    }

    #[inline]
    fn index_coordinate(&self, x: f64) -> f64 {
        x
    }
}

/// Every cell of a lattice in memory cut in `factor`³, with trilinear values.
///
/// A value depends on its place in the refined lattice only, never on the cell that asks: neighbours see the same bits.
pub(super) struct Refined<'a> {
    pub(super) coarse: Plain<'a>,
    pub(super) factor: usize,
}

/// a + (b − a)t, and exactly `a` at t = 0 whatever b is: a NaN or infinity beyond a face does not reach the face.
#[inline]
fn lerp(a: f64, b: impl FnOnce() -> f64, t: f64) -> f64 {
    if t == 0.0 { a } else { a + (b() - a) * t }
}

impl Refined<'_> {
    /// The sample below a place in the refined lattice, and the fraction of a cell beyond it.
    #[inline]
    fn split(&self, i: usize) -> (usize, f64) {
        (i / self.factor, (i % self.factor) as f64 / self.factor as f64)
    }

    /// The value at sample i of a coarse row between rows j and j + 1, k and k + 1.
    #[inline]
    fn between(&self, i: usize, (j, v): (usize, f64), (k, w): (usize, f64)) -> f64 {
        let along_z = |j| lerp(self.coarse.at(i, j, k), || self.coarse.at(i, j, k + 1), w);
        lerp(along_z(j), || along_z(j + 1), v)
    }
}

impl Source for Refined<'_> {
    fn dims(&self) -> [usize; 3] {
        self.coarse.dims.map(|n| (n - 1) * self.factor + 1)
    }

    fn row(&self, j: usize, k: usize, row: &mut [f64]) {
        let (j, k) = (self.split(j), self.split(k));
        let mut a = self.between(0, j, k);
        for (i, cell) in row.chunks_mut(self.factor).enumerate() {
            // The last chunk is the far face alone, where there is no sample beyond.
            let b = if i + 1 < self.coarse.dims[0] { self.between(i + 1, j, k) } else { a };
            for (n, h) in cell.iter_mut().enumerate() {
                *h = lerp(a, || b, n as f64 / self.factor as f64);
            }
            a = b;
        }
    }

    fn at(&self, i: usize, j: usize, k: usize) -> f64 {
        let ((i, u), j, k) = (self.split(i), self.split(j), self.split(k));
        lerp(self.between(i, j, k), || self.between(i + 1, j, k), u)
    }

    #[inline]
    fn index_coordinate(&self, x: f64) -> f64 {
        x / self.factor as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_single_samples_have_the_same_bits() {
        let dims = [5, 4, 3];
        let samples: Vec<f32> = (0..60).map(|i| ((i * 7919) % 61) as f32 / 7.0).collect();
        let refined = Refined { coarse: Plain { dims, samples: &samples }, factor: 3 };
        assert_eq!(refined.dims(), [13, 10, 7]);
        let mut row = vec![0.0; 13];
        for k in 0..7 {
            for j in 0..10 {
                refined.row(j, k, &mut row);
                for (i, h) in row.iter().enumerate() {
                    assert_eq!(h.to_bits(), refined.at(i, j, k).to_bits(), "({i}, {j}, {k})");
                }
            }
        }
        // A sample of the lattice is itself; a midpoint of a trilinear function is its value.
        assert_eq!(refined.at(6, 3, 3), f64::from(samples[(5 * 4) + 5 + 2]));
        let linear: Vec<f32> = (0..60).map(|i| (i % 5 + 10 * (i / 5 % 4) + 100 * (i / 20)) as f32).collect();
        let refined = Refined { coarse: Plain { dims, samples: &linear }, factor: 4 };
        assert_eq!(refined.at(1, 2, 3), 0.25 + 5.0 + 75.0);
    }

    #[test]
    fn a_nan_stays_on_its_side_of_a_face() {
        let mut samples = vec![1.0f32; 27];
        samples[26] = f32::NAN;
        let refined = Refined { coarse: Plain { dims: [3; 3], samples: &samples }, factor: 2 };
        for k in 0..5 {
            for j in 0..5 {
                for i in 0..5 {
                    let touched = i > 2 && j > 2 && k > 2;
                    assert_eq!(refined.at(i, j, k).is_nan(), touched, "({i}, {j}, {k})");
                }
            }
        }
    }
}
