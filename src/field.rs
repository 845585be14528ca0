//! The function h whose graph is illuminated: a volume's samples mapped so that the sweep is [0, 1], trilinear in
//! every cell, with its gradient and the one receiver normal that every engine shares.

mod cells;
mod rows;
mod sweep;

pub use rows::{FieldRows, GradientRow};
pub use sweep::Sweep;

use crate::digits::span;
use crate::error::{Error, Result};
use crate::neighbourhood::within;
use crate::volume::{Lattice, Volume};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::sync::Arc;

/// h in units of the sweep. Positions are index coordinates of the lattice, clamped to Ω.
#[derive(Clone, Debug)]
pub struct Field {
    lattice: Lattice,
    sweep: Sweep,
    samples: Vec<f32>,
    /// No finite sample is larger in magnitude.
    largest: f32,
    /// Whether some sample is NaN.
    gaps: bool,
    /// The field that gives receiver normals, if this one is a finer copy of it.
    coarse: Option<Arc<Field>>,
}

/// Samples are stored up to this: so far from the sweep only the side counts, and sums and differences of a few stay
/// finite.
const FARTHEST: f32 = f32::MAX / 16.0;

impl Field {
    /// Maps a volume's samples to the sweep's units, in f64, and stores f32. Non-finite samples become NaN; those
    /// 2·10³⁷ times the sweep and more away are stored as that.
    ///
    /// # Errors
    /// `Invalid` if no sample is finite, if the sweep does not overlap the data, or if the samples in units of the
    /// sweep do not fit f32.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; overflow is checked")]
    pub fn new(volume: &Volume, sweep: Sweep) -> Result<Self> {
        let name = &volume.name;
        let Some(data @ (min, max)) = volume.range() else {
            return Err(Error::Invalid(format!("{name}: none of its {} samples is finite", volume.samples().len())));
        };
        if sweep.hi() <= min || sweep.lo() >= max {
            return Err(Error::Invalid(format!(
                "{name}: the sweep {sweep} lies outside the data, which span {}; choose --isovalues inside",
                span(data)
            )));
        }
        let largest = [min, max].iter().fold(0f32, |m, &v| m.max((sweep.to_unit(v) as f32).abs()));
        if !largest.is_finite() {
            return Err(Error::Invalid(format!(
                "{name}: data {} in units of the sweep {sweep} do not fit 32-bit floats; widen the sweep",
                span(data)
            )));
        }
        let samples: Vec<f32> = (0..volume.samples().len())
            .into_par_iter()
            .with_min_len(1 << 14)
            .map(|i| {
                let v = volume.value(i);
                if v.is_finite() { sweep.isovalue(v).clamp(-FARTHEST, FARTHEST) } else { f32::NAN }
            })
            .collect();
        let gaps = samples.par_iter().with_min_len(1 << 14).any(|s| s.is_nan());
        let (lattice, largest) = (volume.lattice.clone(), largest.min(FARTHEST));
        Ok(Self { lattice, sweep, samples, largest, gaps, coarse: None })
    }

    /// The same function on another lattice over the same Ω: exactly the same where that divides this one's cells.
    /// Receiver normals stay those of this field, so that a finer grid does not sharpen them.
    #[must_use]
    pub fn resampled(&self, lattice: &Lattice) -> Self {
        Self {
            lattice: lattice.clone(),
            sweep: self.sweep,
            samples: self.samples_at(lattice),
            largest: self.largest,
            gaps: self.gaps,
            coarse: Some(Arc::new(self.clone())),
        }
    }

    /// This field with the receiver normals of `coarse`, of which it is a finer copy.
    #[must_use]
    pub fn with_normals_of(self, coarse: Field) -> Self {
        Self { coarse: Some(Arc::new(coarse)), ..self }
    }

    /// The field of which this is a copy on a lattice so many times as fine along each axis: every so many-th sample.
    /// `None` if the lattice is of no such.
    #[must_use]
    pub fn coarsened(&self, factors: [usize; 3]) -> Option<Self> {
        let cells = self.lattice.cells();
        if (0..3).any(|a| !cells[a].is_multiple_of(factors[a])) {
            return None;
        }
        let dims = [0, 1, 2].map(|a| cells[a] / factors[a] + 1);
        let scale = DMat3::from_diagonal(DVec3::from_array(factors.map(|n| n as f64)));
        let lattice = Lattice::new(dims, self.lattice.origin(), self.lattice.axes() * scale).ok()?;
        let at = |o: usize| {
            let coarse = lattice.ijk(o);
            let [i, j, k] = [0, 1, 2].map(|a| coarse[a] * factors[a]);
            self.samples[self.lattice.offset(i, j, k)]
        };
        let samples = (0..lattice.len()).into_par_iter().with_min_len(1 << 14).map(at).collect();
        Some(Self { lattice, sweep: self.sweep, samples, largest: self.largest, gaps: self.gaps, coarse: None })
    }

    /// h at the points of another lattice over the same Ω, x fastest.
    pub fn samples_at(&self, lattice: &Lattice) -> Vec<f32> {
        let [nx, ny, _] = lattice.dims();
        let rows = FieldRows::new(self, lattice);
        let mut samples = vec![0.0; lattice.len()];
        let each = samples.par_chunks_exact_mut(nx).enumerate().with_min_len(16);
        each.for_each(|(row, to)| rows.values(row % ny, row / ny, to));
        samples
    }

    /// Index coordinates of the coarse field at index coordinates of this one.
    #[inline]
    fn to_coarse(&self, coarse: &Field, p: DVec3) -> DVec3 {
        p * (coarse.lattice.far() / self.lattice.far())
    }

    /// Where the samples stand.
    #[inline]
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// The sweep whose range is [0, 1] here.
    pub fn sweep(&self) -> Sweep {
        self.sweep
    }

    /// Samples in units of the sweep, x fastest; NaN where the source is not finite.
    #[inline]
    pub fn samples(&self) -> &[f32] {
        &self.samples
    }

    /// Whether normals come from these samples, not from those of a coarser field that these interpolate.
    pub fn has_own_normals(&self) -> bool {
        self.coarse.is_none()
    }

    /// The field of which receiver normals are: this one, or a coarser one.
    pub fn normals_from(&self) -> &Field {
        self.coarse.as_deref().unwrap_or(self)
    }

    /// The largest magnitude that a sample may have.
    pub fn largest(&self) -> f32 {
        self.largest
    }

    /// Whether some sample is not finite, so that the cells around it hold no surface.
    pub fn has_gaps(&self) -> bool {
        self.gaps
    }

    /// The cell that holds `p`, and `p` inside it in [0, 1]³.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    pub fn locate(&self, p: DVec3) -> ([usize; 3], DVec3) {
        let mut cell = [0usize; 3];
        let mut local = DVec3::ZERO;
        for a in 0..3 {
            let last = self.lattice.dims()[a] - 2;
            cell[a] = (p[a].max(0.0) as usize).min(last);
            local[a] = (p[a] - cell[a] as f64).clamp(0.0, 1.0);
        }
        (cell, local)
    }

    /// The 8 samples of a cell; bit a of the position says which end along axis a.
    #[inline(always)]
    pub fn corners(&self, [i, j, k]: [usize; 3]) -> [f32; 8] {
        let [nx, ny, _] = self.lattice.dims();
        let at = (k * ny + j) * nx + i;
        // One bound for all: the last corner's.
        let (y, z) = (nx, nx * ny);
        let s = &self.samples[at..at + z + y + 2];
        [s[0], s[1], s[y], s[y + 1], s[z], s[z + 1], s[z + y], s[z + y + 1]]
    }

    /// Least and greatest sample within so many steps of node `o`, with one of the cells around it; infinities of the
    /// wrong order if none is finite.
    pub fn range_around(&self, o: usize, steps: usize) -> [f32; 2] {
        let (mut lo, mut hi) = (f32::INFINITY, f32::NEG_INFINITY);
        for run in within(self.lattice.dims(), o, steps) {
            for &s in &self.samples[run] {
                (lo, hi) = (lo.min(s), hi.max(s));
            }
        }
        [lo, hi]
    }

    /// h at `p` (trilinear), exact at the nodes; NaN unless a cell that holds `p` has finite samples only.
    pub fn value(&self, p: DVec3) -> f64 {
        let (cell, u) = self.locate(p);
        self.value_in(cell, u)
    }

    /// [`Field::value`] at `u` in a cell.
    #[inline(always)]
    fn value_in(&self, cell: [usize; 3], u: DVec3) -> f64 {
        let h = trilinear(&self.corners(cell).map(f64::from), u);
        if h.is_nan() { self.beside(cell, u).map_or(h, |(s, u)| trilinear(&s, u)) } else { h }
    }

    /// The samples of a cell that has finite ones only and shares the place `u` of a cell that has not, and the place
    /// in it.
    #[cold]
    fn beside(&self, cell: [usize; 3], u: DVec3) -> Option<([f64; 8], DVec3)> {
        self.sharing(cell, u).find(|(s, _)| s.iter().all(|s| s.is_finite())).map(|(s, u)| (s.map(f64::from), u))
    }

    /// The samples of all cells that share the place `u` of one, and the place in each: faces, edges and nodes belong
    /// to the cells on all their sides.
    fn sharing(&self, cell: [usize; 3], u: DVec3) -> impl Iterator<Item = ([f32; 8], DVec3)> {
        (0..8usize).filter_map(move |sides| {
            let (mut cell, mut u) = (cell, u);
            for a in (0..3).filter(|a| sides >> a & 1 == 1) {
                if u[a] != 0.0 || cell[a] == 0 {
                    return None;
                }
                (cell[a], u[a]) = (cell[a] - 1, 1.0);
            }
            Some((self.corners(cell), u))
        })
    }

    /// Whether a cell around sample `o` has finite ones only: elsewhere no level set passes through it.
    #[inline]
    pub fn is_in_whole_cell(&self, o: usize) -> bool {
        !self.gaps || self.value(self.lattice.point(o)).is_finite()
    }

    /// Whether all cells that hold `p` have finite samples only.
    pub fn is_whole_around(&self, p: DVec3) -> bool {
        let (cell, u) = self.locate(p);
        self.sharing(cell, u).all(|(s, _)| s.iter().all(|s| s.is_finite()))
    }

    /// ∇h at `p` of the trilinear cell, per world unit. Jumps at cell faces: it serves sides and |∇h|, not cosines.
    pub fn gradient(&self, p: DVec3) -> DVec3 {
        let (cell, u) = self.locate(p);
        let g = trilinear_gradient(&self.corners(cell).map(f64::from), u);
        let g = if g.is_nan() { self.beside(cell, u).map_or(g, |(s, u)| trilinear_gradient(&s, u)) } else { g };
        self.lattice.gradient_to_world(g)
    }

    /// [`Field::value`] and [`Field::gradient`].
    #[inline]
    pub fn value_and_gradient(&self, p: DVec3) -> (f64, DVec3) {
        let (cell, u) = self.locate(p);
        let (mut s, mut u) = (self.corners(cell).map(f64::from), u);
        let mut h = trilinear(&s, u);
        if h.is_nan()
            && let Some(finite) = self.beside(cell, u)
        {
            (s, u) = finite;
            h = trilinear(&s, u);
        }
        (h, self.lattice.gradient_to_world(trilinear_gradient(&s, u)))
    }

    /// Central-difference gradient at a node, per world unit: one-sided at Ω's faces and beside non-finite samples,
    /// 0 along an axis without a finite neighbour.
    pub fn node_gradient(&self, [i, j, k]: [usize; 3]) -> DVec3 {
        if let Some(coarse) = &self.coarse {
            return coarse.receiver_gradient(self.to_coarse(coarse, DVec3::new(i as f64, j as f64, k as f64)));
        }
        self.lattice.gradient_to_world(self.node_differences([i, j, k]))
    }

    /// [`Field::node_gradient`] in index space.
    #[inline]
    fn node_differences(&self, [i, j, k]: [usize; 3]) -> DVec3 {
        let dims = self.lattice.dims();
        let strides = [1, dims[0], dims[0] * dims[1]];
        let at = self.lattice.offset(i, j, k);
        let mut g = DVec3::ZERO;
        for (a, n) in [i, j, k].into_iter().enumerate() {
            let here = self.samples[at];
            let finite = |s: f32| s.is_finite().then_some(f64::from(s));
            let before = if n > 0 { finite(self.samples[at - strides[a]]) } else { None };
            let after = if n + 1 < dims[a] { finite(self.samples[at + strides[a]]) } else { None };
            g[a] = match (before, finite(here), after) {
                (Some(b), _, Some(c)) => 0.5 * (c - b),
                (Some(b), Some(h), None) => h - b,
                (None, Some(h), Some(c)) => c - h,
                _ => 0.0,
            };
        }
        g
    }

    /// The receiver gradient at `p`: central differences at the nodes, interpolated trilinearly, per world unit.
    /// Continuous; its direction is the normal of every cosine in every engine.
    pub fn receiver_gradient(&self, p: DVec3) -> DVec3 {
        if let Some(coarse) = &self.coarse {
            return coarse.receiver_gradient(self.to_coarse(coarse, p));
        }
        let (cell, u) = self.locate(p);
        // Of a cell's nodes only this one counts: bakes ask at grid points.
        if u == DVec3::ZERO {
            return self.node_gradient(cell);
        }
        let dims = self.lattice.dims();
        let interior = (0..3).all(|a| cell[a] > 0 && cell[a] + 2 < dims[a]);
        if interior {
            let g = self.interior_receiver_gradient(cell, u);
            if g.is_finite() {
                return self.lattice.gradient_to_world(g);
            }
        }
        let mut g = DVec3::ZERO;
        for corner in 0..8 {
            let [x, y, z] = [corner & 1, corner >> 1 & 1, corner >> 2];
            let w = if x == 1 { u.x } else { 1.0 - u.x }
                * if y == 1 { u.y } else { 1.0 - u.y }
                * if z == 1 { u.z } else { 1.0 - u.z };
            g += w * self.node_gradient([cell[0] + x, cell[1] + y, cell[2] + z]);
        }
        g
    }

    /// [`Field::receiver_gradient`] in index space where all 32 samples exist; NaN spreads.
    #[inline]
    fn interior_receiver_gradient(&self, [i, j, k]: [usize; 3], u: DVec3) -> DVec3 {
        let [nx, ny, _] = self.lattice.dims();
        let stride = [1, nx, nx * ny];
        let at = (k * ny + j) * nx + i;
        let mut g = DVec3::ZERO;
        for a in 0..3 {
            let (b, c) = ((a + 1) % 3, (a + 2) % 3);
            // Along axis a four samples −1 … 2 give the two node differences; bilinear across the other axes.
            let line = |o: usize| {
                let s = |n: usize| f64::from(self.samples[o + n * stride[a] - stride[a]]);
                0.5 * ((1.0 - u[a]) * (s(2) - s(0)) + u[a] * (s(3) - s(1)))
            };
            let (l00, l10) = (line(at), line(at + stride[b]));
            let (l01, l11) = (line(at + stride[c]), line(at + stride[b] + stride[c]));
            let (l0, l1) = (l00 + u[b] * (l10 - l00), l01 + u[b] * (l11 - l01));
            g[a] = l0 + u[c] * (l1 - l0);
        }
        g
    }

    /// Unit normal of the level set at `p`, towards falling h (the lower side); `None` where ∇h vanishes or no value
    /// is finite. \[BB09 §2.3: N♭\]
    #[inline]
    pub fn falling_normal(&self, p: DVec3) -> Option<DVec3> {
        unit(-self.receiver_gradient(p))
    }
}

/// A cell's samples interpolated at `u` in [0, 1]³, bit a of their position being the end along axis a; exact at the
/// corners.
#[inline(always)]
pub(crate) fn trilinear(s: &[f64; 8], u: DVec3) -> f64 {
    // By weights: a corner that does not count leaves no rounding behind, however large it is.
    let lerp = |a: f64, b: f64, u: f64| (1.0 - u) * a + u * b;
    let x = |a: usize| lerp(s[a], s[a + 1], u.x);
    lerp(lerp(x(0), x(2), u.y), lerp(x(4), x(6), u.y), u.z)
}

/// Its derivatives by `u`.
#[inline]
fn trilinear_gradient(s: &[f64; 8], u: DVec3) -> DVec3 {
    let lerp = |t: f64, a: f64, b: f64| a + t * (b - a);
    let x = lerp(u.z, lerp(u.y, s[1] - s[0], s[3] - s[2]), lerp(u.y, s[5] - s[4], s[7] - s[6]));
    let y = lerp(u.z, lerp(u.x, s[2] - s[0], s[3] - s[1]), lerp(u.x, s[6] - s[4], s[7] - s[5]));
    let z = lerp(u.y, lerp(u.x, s[4] - s[0], s[5] - s[1]), lerp(u.x, s[6] - s[2], s[7] - s[3]));
    DVec3::new(x, y, z)
}

/// `v` normalised, also for lengths whose square under- or overflows; `None` for 0 and non-finite.
#[inline]
fn unit(v: DVec3) -> Option<DVec3> {
    has_direction(v).then(|| (v / v.abs().max_element()).normalize())
}

/// Whether a gradient is neither 0 nor NaN nor infinite: [`Field::falling_normal`] is there.
#[inline]
pub(crate) fn has_direction(v: DVec3) -> bool {
    // A largest component leaves NaN aside.
    v.abs().max_element() > 0.0 && v.is_finite()
}

#[cfg(test)]
impl Field {
    /// Of these samples, swept from `lo` to `hi`.
    pub(crate) fn made(lattice: Lattice, samples: crate::volume::Samples, lo: f64, hi: f64) -> Self {
        let volume = Volume::new("made", lattice, samples).unwrap();
        Self::new(&volume, Sweep::new(lo, hi).unwrap()).unwrap()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::Samples;

    #[test]
    fn no_unit_vector_comes_from_a_nan() {
        assert_eq!(unit(DVec3::new(f64::NAN, 1.0, 0.0)), None);
        assert_eq!(unit(DVec3::new(0.0, f64::INFINITY, 1.0)), None);
        assert_eq!(unit(DVec3::ZERO), None);
        assert!((unit(DVec3::new(1e-200, 0.0, 1e-200)).unwrap().length() - 1.0).abs() < 1e-12);
    }
    use glam::DMat3;

    /// 5×4×6 samples of a trilinear function on an oblique, flipped lattice.
    fn oblique(f: impl Fn(DVec3) -> f64) -> Field {
        let axes = DMat3::from_cols(DVec3::new(-0.5, 0.1, 0.0), DVec3::new(0.2, 0.7, 0.0), DVec3::new(0.0, 0.3, 2.0));
        let lattice = Lattice::new([5, 4, 6], DVec3::new(10.0, -3.0, 1e3), axes).unwrap();
        let samples = (0..lattice.len())
            .map(|o| {
                let [i, j, k] = lattice.ijk(o);
                f(lattice.to_world(DVec3::new(i as f64, j as f64, k as f64)))
            })
            .collect();
        Field::new(&Volume::new("test", lattice, Samples::F64(samples)).unwrap(), Sweep::new(0.0, 1.0).unwrap())
            .unwrap()
    }

    #[test]
    fn gradients_are_world_gradients_on_oblique_axes() {
        let slope = DVec3::new(0.3, -0.2, 0.05);
        let f = oblique(|x| slope.dot(x - DVec3::new(10.0, -3.0, 1e3)));
        for p in [DVec3::new(2.3, 1.7, 3.1), DVec3::new(0.1, 0.2, 0.3), DVec3::new(4.0, 3.0, 5.0)] {
            assert!((f.gradient(p) - slope).length() < 1e-5, "{p}");
            assert!((f.receiver_gradient(p) - slope).length() < 1e-5, "{p}");
            let expected = slope.dot(f.lattice().axes() * p);
            assert!((f.value(p) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn receiver_gradient_is_continuous_and_the_same_on_both_paths() {
        let f = oblique(|x| (3.0 * x.x).sin() + (x.y * x.z * 0.002).cos());
        let slow = |p: DVec3| {
            let (cell, u) = f.locate(p);
            (0..8)
                .map(|n| {
                    let o = [n & 1, n >> 1 & 1, n >> 2];
                    let w: f64 = (0..3).map(|a| if o[a] == 1 { u[a] } else { 1.0 - u[a] }).product();
                    w * f.node_gradient([cell[0] + o[0], cell[1] + o[1], cell[2] + o[2]])
                })
                .sum::<DVec3>()
        };
        let nodes = [DVec3::new(2.0, 1.0, 3.0), DVec3::new(0.0, 2.0, 4.0), DVec3::new(4.0, 3.0, 5.0)];
        for p in [DVec3::new(1.5, 1.25, 2.75), DVec3::new(2.999, 1.001, 1.5)].into_iter().chain(nodes) {
            assert!((f.receiver_gradient(p) - slow(p)).length() < 1e-12, "{p}");
        }
        let (a, b) = (DVec3::new(2.0 - 1e-9, 1.5, 2.5), DVec3::new(2.0 + 1e-9, 1.5, 2.5));
        assert!((f.receiver_gradient(a) - f.receiver_gradient(b)).length() < 1e-6);
    }

    #[test]
    fn a_sample_equal_to_the_isovalue_compares_equal() {
        let sweep = Sweep::new(15.0, 200.0).unwrap();
        let lattice = Lattice::aligned([2, 2, 64], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..=255u8).collect();
        let f = Field::new(&Volume::new("test", lattice, Samples::U8(samples)).unwrap(), sweep).unwrap();
        for v in 0..=255u8 {
            assert_eq!(f.samples()[v as usize].to_bits(), sweep.isovalue(f64::from(v)).to_bits());
        }
    }

    #[test]
    fn non_finite_samples_stay_out_of_gradients() {
        let lattice = Lattice::aligned([4, 4, 4], DVec3::ZERO, DVec3::ONE).unwrap();
        let mut samples: Vec<f32> = (0..64).map(|o| (o % 4) as f32 / 4.0).collect();
        samples[0] = f32::NAN;
        let f = Field::new(&Volume::new("t", lattice, Samples::F32(samples)).unwrap(), Sweep::new(0.0, 1.0).unwrap())
            .unwrap();
        assert_eq!(f.node_gradient([1, 0, 0]), DVec3::new(0.25, 0.0, 0.0));
        assert!(f.falling_normal(DVec3::new(1.5, 0.5, 0.5)).unwrap().is_finite());
    }

    /// A place on the border of cells is known as soon as one of them has finite samples only.
    #[test]
    fn a_place_is_known_by_any_of_its_cells_that_is_finite() {
        let mut f = oblique(|x| (3.0 * x.x).sin() + (x.y * x.z * 0.002).cos());
        let whole = f.clone();
        let gap = DVec3::new(2.0, 2.0, 3.0);
        let o = f.lattice().offset(2, 2, 3);
        f.samples[o] = f32::NAN;
        for twice in (0..9).flat_map(|x| (0..7).flat_map(move |y| (0..11).map(move |z| [x, y, z]))) {
            let p = DVec3::from_array(twice.map(|x| 0.5 * f64::from(x)));
            // Within the eight cells that are gone, or where they end at Ω's face y = 3.
            let d = p - gap;
            let gone = d.x.abs() < 1.0 && d.y > -1.0 && d.z.abs() < 1.0;
            let (h, g) = f.value_and_gradient(p);
            assert_eq!((h.is_nan(), g.is_nan()), (gone, gone), "{p}");
            assert_eq!((f.value(p).to_bits(), f.gradient(p).is_nan()), (h.to_bits(), gone), "{p}");
            if !gone {
                assert!((h - whole.value(p)).abs() < 1e-12 && f.gradient(p) == g, "{p}");
            }
            // On the gap's faces the cell beyond is the only one.
            let beyond = d.abs().cmpeq(DVec3::ONE).bitmask();
            if !gone && d.abs().max_element() == 1.0 && beyond.count_ones() == 1 {
                assert!((g - whole.gradient(p + 1e-9 * d)).length() < 1e-6, "{p}");
            }
        }
    }

    #[test]
    fn a_finer_copy_is_the_same_function_with_the_same_normals() {
        let f = oblique(|x| (3.0 * x.x).sin() + (x.y * x.z * 0.002).cos());
        let axes = f.lattice().axes();
        let fine = f.resampled(&Lattice::new([9, 7, 11], f.lattice().origin(), axes * 0.5).unwrap());
        for p in [DVec3::new(1.3, 2.2, 3.7), DVec3::new(0.0, 3.0, 5.0), DVec3::new(2.5, 0.25, 1.0)] {
            assert!((f.value(p) - fine.value(2.0 * p)).abs() < 1e-6);
            assert!((f.receiver_gradient(p) - fine.receiver_gradient(2.0 * p)).length() < 1e-9);
        }
        assert!((fine.node_gradient([3, 2, 5]) - f.receiver_gradient(DVec3::new(1.5, 1.0, 2.5))).length() < 1e-12);
        let back = fine.coarsened([2; 3]).unwrap();
        assert_eq!(back.samples(), f.samples());
        assert!(back.has_own_normals() && back.lattice().dims() == f.lattice().dims());
        assert!(
            (back.lattice().to_world(back.lattice().far()) - f.lattice().to_world(f.lattice().far())).length() < 1e-12
        );
        assert!(fine.coarsened([2, 4, 2]).is_none() && fine.coarsened([2, 2, 0]).is_none());
        let other = fine.coarsened([4, 3, 5]).unwrap();
        assert_eq!(other.lattice().dims(), [3, 3, 3]);
        for o in 0..27 {
            let p = other.lattice().point(o) * DVec3::new(4.0, 3.0, 5.0);
            assert_eq!(f64::from(other.samples()[o]), fine.value(p));
        }
        assert_eq!(f.coarsened([1; 3]).unwrap().samples(), f.samples());
    }

    /// A lattice whose points lie in cells and on nodes, the field's own, and those of a finer copy; gaps in the
    /// samples.
    #[test]
    fn rows_hold_what_points_do() {
        let mut f = oblique(|x| (3.0 * x.x).sin() + (x.y * x.z * 0.002).cos());
        f.samples[31] = f32::NAN;
        let axes = f.lattice().axes();
        let origin = f.lattice().origin();
        let finer = |n: [usize; 3]| {
            let far = DVec3::from_array(n.map(|n| (n - 1) as f64));
            Lattice::new(n, origin, axes * DMat3::from_diagonal(f.lattice().far() / far)).unwrap()
        };
        let lattices = [finer([5, 4, 6]), finer([9, 7, 11]), finer([4, 9, 8])];
        let copy = f.resampled(&lattices[1]);
        let mut row = GradientRow::default();
        let mut gaps = 0;
        for (field, lattice) in lattices.iter().map(|l| (&f, l)).chain([(&copy, &lattices[1])]) {
            let rows = FieldRows::new(field, lattice);
            let scale = field.lattice().far() / lattice.far();
            let [nx, ny, nz] = lattice.dims();
            for (j, k) in (0..nz).flat_map(|k| (0..ny).map(move |j| (j, k))) {
                let mut values = vec![0.0; nx];
                rows.values(j, k, &mut values);
                let gradients = rows.gradients(j, k, &mut row);
                for i in 0..nx {
                    let p = DVec3::new(i as f64, j as f64, k as f64) * scale;
                    assert_eq!(values[i].to_bits(), (field.value(p) as f32).to_bits(), "{p}");
                    assert!((gradients[i] - field.receiver_gradient(p)).length() < 1e-12, "{p}");
                    gaps += usize::from(values[i].is_nan());
                }
            }
        }
        assert!(gaps > 4);
    }

    #[test]
    fn clear_errors() {
        let lattice = Lattice::aligned([2, 2, 2], DVec3::ZERO, DVec3::ONE).unwrap();
        let v = |x: f32| Volume::new("v", lattice.clone(), Samples::F32(vec![x; 8])).unwrap();
        let sweep = Sweep::new(0.0, 1.0).unwrap();
        assert!(Field::new(&v(f32::NAN), sweep).unwrap_err().to_string().contains("finite"));
        assert!(Field::new(&v(7.0), sweep).unwrap_err().to_string().contains("outside"));
        assert!(Sweep::new(3.0, 3.0).is_err() && Sweep::new(f64::NAN, 1.0).is_err());
    }
}
