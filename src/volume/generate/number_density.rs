//! Particles to a field: each spread by a Gaussian onto a lattice that spans the simulation's box.

use super::neighbours::SimulationBox;
use crate::error::Result;
use crate::volume::{Lattice, Samples, Volume};
use glam::DVec3;
use rayon::prelude::*;

/// Where a Gaussian ends, in its standard deviations: what is left out weighs 6·10⁻⁹ of it.
const REACH: f64 = 6.0;

/// Number density of points, each convolved with a normalised Gaussian of standard deviation `sigma`, on dims³ samples
/// over the whole box, both faces included. Along an axis that repeats, the last sample stands for the same place as
/// the first, and images count; along others the Gaussian is cut at the face.
///
/// # Errors
/// `Invalid` as [`Lattice::new`].
pub fn number_density(
    name: &str,
    bounds: &SimulationBox,
    points: &[DVec3],
    sigma: f64,
    dims: [usize; 3],
) -> Result<Volume> {
    let cells = DVec3::from_array(dims.map(|n| n.saturating_sub(1).max(1) as f64));
    let spacing = bounds.size / cells;
    let lattice = Lattice::aligned(dims, DVec3::ZERO, spacing)?;
    let profiles: Vec<[Profile; 3]> = points
        .par_iter()
        .map(|&x| std::array::from_fn(|a| Profile::new(bounds, a, x[a], sigma, dims[a], spacing[a])))
        .collect();
    // Per slice and in the order of the points: the same bits for any number of threads.
    let slice = |k: usize| {
        let mut sum = vec![0.0; dims[0] * dims[1]];
        for [px, py, pz] in &profiles {
            for z in pz.at(k) {
                for (j, y) in py.iter() {
                    let row = &mut sum[j * dims[0]..][..dims[0]];
                    for (i, x) in px.iter() {
                        row[i] += z * y * x;
                    }
                }
            }
        }
        #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
        sum.into_iter().map(|s| s as f32).collect::<Vec<f32>>()
    };
    let samples: Vec<Vec<f32>> = (0..dims[2]).into_par_iter().map(slice).collect();
    Volume::new(name, lattice, Samples::F32(samples.concat()))
}

/// A one-dimensional normalised Gaussian on the samples of one axis.
struct Profile {
    /// (sample, weight); a sample may occur more than once, for different images.
    weights: Vec<(usize, f64)>,
}

impl Profile {
    fn new(bounds: &SimulationBox, axis: usize, x: f64, sigma: f64, n: usize, spacing: f64) -> Self {
        let scale = 1.0 / (std::f64::consts::TAU.sqrt() * sigma);
        let size = bounds.size[axis];
        #[allow(clippy::cast_possible_truncation, reason = "a few images")]
        let images = if bounds.periodic[axis] { (REACH * sigma / size).ceil() as i32 + 1 } else { 0 };
        let mut weights = Vec::new();
        for image in -images..=images {
            let x = x + f64::from(image) * size;
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "negative numbers become 0")]
            let first = ((x - REACH * sigma) / spacing).ceil().max(0.0) as usize;
            for i in first..n {
                let d = (i as f64 * spacing - x) / sigma;
                if d > REACH {
                    break;
                }
                weights.push((i, scale * (-0.5 * d * d).exp()));
            }
        }
        Self { weights }
    }

    fn iter(&self) -> impl Iterator<Item = (usize, f64)> {
        self.weights.iter().copied()
    }

    fn at(&self, i: usize) -> impl Iterator<Item = f64> {
        self.weights.iter().filter(move |w| w.0 == i).map(|w| w.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    #[test]
    fn the_field_integrates_to_the_number_of_points() {
        let bounds = SimulationBox { size: DVec3::new(12.0, 9.0, 10.0), periodic: [false, true, true] };
        let points: Vec<DVec3> = (0..50)
            .map(|i| {
                let mut rng = Rng::stream(1, Stage::Test, i);
                // 6 σ from the faces that do not repeat.
                DVec3::new(4.8 + 2.4 * rng.unit(), 9.0 * rng.unit(), 10.0 * rng.unit())
            })
            .collect();
        let v = number_density("n", &bounds, &points, 0.8, [31, 21, 26]).unwrap();
        // Of samples that stand for the same place, one counts.
        let sum: f64 = (0..v.lattice.len())
            .filter(|&o| {
                let [_, j, k] = v.lattice.ijk(o);
                j < 20 && k < 25
            })
            .map(|o| v.value(o))
            .sum();
        let number = sum * v.lattice.cell_volume();
        assert!((number - 50.0).abs() < 1e-4, "{number}");
        for k in 0..26 {
            assert_eq!(v.value(v.lattice.offset(9, 0, k)), v.value(v.lattice.offset(9, 20, k)), "the faces agree");
        }
    }

    #[test]
    fn one_point_makes_one_gaussian() {
        let bounds = SimulationBox { size: DVec3::splat(10.0), periodic: [true; 3] };
        let v = number_density("n", &bounds, &[DVec3::new(9.5, 5.0, 0.0)], 1.0, [21; 3]).unwrap();
        let peak = std::f64::consts::TAU.powf(-1.5);
        for (at, d2) in [([19, 10, 0], 0.0), ([19, 10, 20], 0.0), ([1, 10, 0], 1.0), ([17, 12, 18], 3.0f64)] {
            let [i, j, k] = at;
            let want = peak * (-0.5 * d2).exp();
            let have = v.value(v.lattice.offset(i, j, k));
            assert!((have - want).abs() < 1e-6 * want, "{at:?}: {have} {want}");
        }
    }
}
