//! The illumination grid: radiance at the points of a regular lattice over Ω, of samples at the points themselves or,
//! by modified Shepard interpolation, of scattered ones. Linear interpolation of it is what every viewer does with a
//! 3D texture.

use crate::error::{Error, Result};
use crate::field::Field;
use crate::flattened::Side;
use crate::mask::Mask;
use crate::nearest::{Neighbours, PointGrid};
use crate::progress::Tick;
use crate::radiance::RadianceSample;
use crate::scene::Scene;
use crate::split::{self, Split};
use crate::volume::Lattice;
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use std::str::FromStr;

/// The size of a grid over Ω.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridSize {
    /// So many intervals per interval of the volume along each axis: 1 is the volume's own lattice.
    Factors([usize; 3]),
    /// The factors that make cells nearest to cubes, the least of them 1: `Factors` once a volume is known
    /// ([`GridSize::of`]).
    Cubic,
    /// Points along each axis.
    Points([usize; 3]),
}

/// The greatest factor of a grid along an axis.
const MOST_FACTOR: usize = 16;

impl FromStr for GridSize {
    type Err = String;

    /// `2x`, `FXx,FYx,FZx`, `cubic` or `NX,NY,NZ`.
    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let factor = |word: &str| {
            let n = word.trim().strip_suffix('x')?.parse().ok()?;
            (1..=MOST_FACTOR).contains(&n).then_some(n)
        };
        let points = |word: &str| word.trim().parse().ok().filter(|&n| n >= 2);
        let words: Vec<&str> = text.split(',').collect();
        let all = |number: &dyn Fn(&str) -> Option<usize>| {
            words.iter().map(|w| number(w)).collect::<Option<Vec<_>>>()?.try_into().ok()
        };
        let size = match words[..] {
            ["cubic"] => Some(GridSize::Cubic),
            [one] => factor(one).map(|n| GridSize::Factors([n; 3])),
            _ => all(&factor).map(GridSize::Factors).or_else(|| all(&points).map(GridSize::Points)),
        };
        size.ok_or_else(|| {
            format!(
                "'{text}' is no grid size; write a factor from 1x to {MOST_FACTOR}x, one of each axis such as 1x,1x,4x, \
                 cubic, or points such as 101,101,101"
            )
        })
    }
}

impl std::fmt::Display for GridSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            GridSize::Factors([x, y, z]) if x == y && y == z => write!(f, "{x}x"),
            GridSize::Factors([x, y, z]) => write!(f, "{x}x,{y}x,{z}x"),
            GridSize::Cubic => write!(f, "cubic"),
            GridSize::Points([x, y, z]) => write!(f, "{x},{y},{z}"),
        }
    }
}

impl GridSize {
    /// The volume's own lattice.
    pub const OWN: Self = Self::Factors([1; 3]);

    /// This size for `volume`: what is cubic becomes factors.
    #[must_use]
    pub fn of(self, volume: &Lattice) -> Self {
        match self {
            Self::Cubic => Self::Factors(cubic(volume)),
            other => other,
        }
    }

    /// The lattice of this size over the Ω of `volume`: same corners, other spacing.
    ///
    /// # Errors
    /// `Invalid` if it has too many points.
    pub fn lattice(self, volume: &Lattice) -> Result<Lattice> {
        let times = |n: [usize; 3]| std::array::from_fn(|a| volume.cells()[a] * n[a] + 1);
        let dims = match self {
            GridSize::Factors(n) => times(n),
            GridSize::Cubic => times(cubic(volume)),
            GridSize::Points(p) => p,
        };
        if dims == volume.dims() {
            return Ok(volume.clone());
        }
        let step = volume.far() / DVec3::from_array(dims.map(|n| (n - 1) as f64));
        let axes = volume.axes();
        let axes = DMat3::from_cols(axes.x_axis * step.x, axes.y_axis * step.y, axes.z_axis * step.z);
        Lattice::new(dims, volume.origin(), axes).map_err(|e| Error::Invalid(format!("--grid {self}: {e}")))
    }
}

/// The factors that make cells of `volume` nearest to cubes.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the factors")]
fn cubic(volume: &Lattice) -> [usize; 3] {
    let spacing = volume.spacing();
    (spacing / spacing.min_element()).to_array().map(|x| (x.round() as usize).clamp(1, MOST_FACTOR))
}

/// Radiance of one side over a lattice.
#[derive(Clone, Debug)]
pub struct IlluminationGrid {
    /// Linear RGB radiance per point, x fastest; 0 where empty.
    pub radiance: Vec<[f32; 3]>,
    /// Standard error of the luminance.
    pub std_error: Vec<f32>,
    /// What each point holds.
    pub mask: Vec<Mask>,
    /// The radiance in two parts, if that is asked for.
    pub split: Option<Split>,
}

impl IlluminationGrid {
    /// Radiance at index coordinates `p` of its `lattice`, as a 3D texture gives it: trilinear over the points of the
    /// cell that hold something; 0 where none does.
    pub fn interpolate(&self, lattice: &Lattice, p: DVec3) -> DVec3 {
        self.between(lattice, p, [&self.radiance]).map_or(DVec3::ZERO, |[radiance]| radiance)
    }

    /// Radiance of `side` at local position `p` of `scene`, which this grid over `lattice` lights: as
    /// [`IlluminationGrid::interpolate`] of a grid that is not split; else direct light is that of the place and its
    /// normal, in closed form, times the share that is visible.
    pub fn radiance_at(&self, scene: &Scene, lattice: &Lattice, p: DVec3, side: Side) -> DVec3 {
        self.known_at(scene, lattice, p, side).unwrap_or_default()
    }

    /// As [`IlluminationGrid::radiance_at`]; `None` where no point of the cell holds something.
    pub fn known_at(&self, scene: &Scene, lattice: &Lattice, p: DVec3, side: Side) -> Option<DVec3> {
        let at = if lattice == scene.lattice() { p } else { p * (lattice.far() / scene.lattice().far()) };
        let Some(Split { indirect, visible }) = &self.split else {
            return self.between(lattice, at, [&self.radiance]).map(|[radiance]| radiance);
        };
        let [indirect, visible] = self.between(lattice, at, [indirect, visible])?;
        Some(split::radiance(scene, p, side, indirect, visible))
    }

    /// Radiance at index coordinates `p` of its `lattice`, but for what is reflected of direct light; `None` of a grid
    /// that is not split, and where no point of the cell holds something.
    pub fn indirect_at(&self, lattice: &Lattice, p: DVec3) -> Option<DVec3> {
        self.between(lattice, p, [&self.split.as_ref()?.indirect]).map(|[indirect]| indirect)
    }

    /// What `values` of the points, three channels each, say between them; `None` where none of the points holds
    /// something.
    fn between<const N: usize>(&self, lattice: &Lattice, p: DVec3, values: [&[[f32; 3]]; N]) -> Option<[DVec3; N]> {
        let (mut sums, mut weight) = ([DVec3::ZERO; N], 0.0);
        for (o, w) in lattice.around(p).into_iter().filter(|(o, _)| self.mask[*o] != Mask::Empty) {
            sums.iter_mut().zip(values).for_each(|(sum, v)| *sum += w * DVec3::from_array(v[o].map(f64::from)));
            weight += w;
        }
        (weight > 0.0).then(|| sums.map(|sum| sum / weight))
    }

    /// Empties points whose radiance or standard error is not finite, and counts them.
    pub(crate) fn clear_non_finite(&mut self) -> u64 {
        let points = self.radiance.par_iter_mut().zip(&mut self.std_error).zip(&mut self.mask);
        let bad = points.filter(|((rgb, e), _)| !(e.is_finite() && rgb.iter().all(|x| x.is_finite())));
        let count = bad.map(|((rgb, e), mask)| (*rgb, *e, *mask) = ([0.0; 3], 0.0, Mask::Empty)).count() as u64;
        if let (Some(Split { indirect, visible }), true) = (&mut self.split, count > 0) {
            let points = indirect.par_iter_mut().zip(visible).zip(&self.mask);
            points.filter(|(_, m)| **m == Mask::Empty).for_each(|((a, b), _)| (*a, *b) = ([0.0; 3], [0.0; 3]));
        }
        count
    }
}

/// Modified Shepard interpolation: the `neighbours` nearest samples, weighted ((R − d)/(R d))² with R the distance of
/// the farthest. \[Shepard68; FN80\] `tick(n)` reports n points done; returning false stops early.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
pub fn shepard(
    field: &Field,
    lattice: &Lattice,
    masks: &[Mask],
    samples: &[RadianceSample],
    neighbours: usize,
    tick: Tick,
) -> IlluminationGrid {
    let grid = point_grid(field, samples);
    let light = |&n: &u32| (samples[n as usize].radiance, samples[n as usize].variance);
    let sorted: Vec<(Vec3, f32)> = grid.numbers().par_iter().map(light).collect();
    let result = from_nearest(lattice, masks, (&grid, neighbours), tick, |_, _, found| blend(found, &sorted));
    // To give the memory of 10⁷ samples back takes one thread a tenth of all this.
    rayon::join(|| drop(grid), || drop(sorted));
    result
}

/// The samples' places in the world, relative to Ω's corner so that f32 stays fine-grained, for searches.
pub(crate) fn point_grid(field: &Field, samples: &[RadianceSample]) -> PointGrid {
    let axes = field.lattice().axes();
    let places: Vec<Vec3> = samples.par_iter().map(|s| (axes * s.position.as_dvec3()).as_vec3()).collect();
    PointGrid::new(&places, 2.0)
}

/// A grid of what `value` says of each point that `masks` say holds light, radiance and standard error, from its
/// number, its place as in [`point_grid`], and the so many samples nearest to it, as (squared distance, slot). `tick`
/// as in [`shepard`].
pub(crate) fn from_nearest(
    lattice: &Lattice,
    masks: &[Mask],
    (grid, neighbours): (&PointGrid, usize),
    tick: Tick,
    value: impl Fn(usize, Vec3, &[(f32, u32)]) -> ([f32; 3], f32) + Sync,
) -> IlluminationGrid {
    let step = lattice.axes();
    const CHUNK: usize = 4096;
    let (mut radiance, mut std_error) = (vec![[0.0; 3]; lattice.len()], vec![0.0; lattice.len()]);
    let chunks = radiance.par_chunks_mut(CHUNK).zip(std_error.par_chunks_mut(CHUNK));
    chunks.enumerate().with_max_len(1).for_each(|(chunk, (radiance, std_error))| {
        if !tick(0) {
            return;
        }
        let mut found = Neighbours::default();
        for n in 0..radiance.len() {
            let o = chunk * CHUNK + n;
            if masks[o] == Mask::Empty {
                continue;
            }
            let place = (step * lattice.point(o)).as_vec3();
            grid.nearest(place, neighbours, f32::INFINITY, |_| true, &mut found);
            (radiance[n], std_error[n]) = value(o, place, found.found());
        }
        tick(radiance.len() as u64);
    });
    IlluminationGrid { radiance, std_error, mask: masks.to_vec(), split: None }
}

/// Shepard's mean of (squared distance, slot) entries of (radiance, variance), and its standard error.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn blend(found: &[(f32, u32)], samples: &[(Vec3, f32)]) -> ([f32; 3], f32) {
    let Some(farthest) = found.iter().map(|e| e.0).reduce(f32::max) else { return ([0.0; 3], 0.0) };
    let radius = f64::from(farthest).sqrt() * (1.0 + 1e-6);
    let (mut sum, mut weights, mut variance) = (DVec3::ZERO, 0.0, 0.0);
    for &(d2, slot) in found {
        // A sample on the point itself takes all the weight that f64 can hold.
        let d = f64::from(d2).sqrt().max(1e-9 * radius);
        let w = if found.len() == 1 { 1.0 } else { ((radius - d) / (radius * d)).powi(2) * radius * radius };
        let (radiance, own) = samples[slot as usize];
        sum += w * radiance.as_dvec3();
        variance += w * w * f64::from(own);
        weights += w;
    }
    ((sum / weights).as_vec3().to_array(), (variance.sqrt() / weights) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::rng::{Sobol, Stage};
    use crate::volume::{Samples, Volume};

    fn field() -> Field {
        let lattice = Lattice::aligned([9, 9, 9], DVec3::splat(-3.0), DVec3::new(0.5, 1.0, 2.0)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let volume = Volume::new("x", lattice, Samples::F32(samples)).unwrap();
        Field::new(&volume, Sweep::new(0.0, 8.0).unwrap()).unwrap()
    }

    #[test]
    fn what_is_not_finite_is_emptied_and_counted() {
        let light = [[0.5, 1.0, 2.0], [0.5, f32::NAN, 2.0], [3.0; 3], [4.0; 3], [f32::INFINITY, 0.0, 0.0]];
        let mut grid = IlluminationGrid {
            radiance: light.to_vec(),
            std_error: vec![0.1, 0.2, f32::NAN, f32::INFINITY, f32::NAN],
            mask: vec![Mask::Valid, Mask::Valid, Mask::Valid, Mask::Filled, Mask::Empty],
            split: Some(Split { indirect: light.to_vec(), visible: vec![[0.5; 3]; 5] }),
        };
        assert_eq!(grid.clear_non_finite(), 4);
        assert_eq!((grid.radiance[0], grid.std_error[0], grid.mask[0]), (light[0], 0.1, Mask::Valid));
        for o in 1..5 {
            assert_eq!((grid.radiance[o], grid.std_error[o], grid.mask[o]), ([0.0; 3], 0.0, Mask::Empty), "point {o}");
        }
        let split = grid.split.unwrap();
        assert_eq!((split.indirect[0], split.visible[0]), (light[0], [0.5; 3]));
        assert_eq!((&split.indirect[1..], &split.visible[1..]), (&[[0.0; 3]; 4][..], &[[0.0; 3]; 4][..]));
    }

    #[test]
    fn shepard_reproduces_constants_and_approaches_smooth_functions() {
        let field = field();
        let set = Sobol::set(1, Stage::Test, 0);
        let f = |p: DVec3| (0.3 * p.x + 0.2 * p.y).sin() + 2.0;
        let mut worst = Vec::new();
        for n in [4_000u32, 32_000] {
            let samples: Vec<RadianceSample> = (0..n)
                .map(|i| {
                    let [x, y] = set.point2(i, 0);
                    let p = field.lattice().far() * DVec3::new(x, y, set.coordinate(i, 2));
                    let radiance = Vec3::new(7.0, f(p) as f32, 0.0);
                    RadianceSample { position: p.as_vec3(), radiance, ..RadianceSample::default() }
                })
                .collect();
            let masks = crate::mask::masks(&field, field.lattice());
            let grid = shepard(&field, field.lattice(), &masks, &samples, 12, &|_| true);
            let mut error = 0f64;
            for (o, rgb) in grid.radiance.iter().enumerate() {
                let p = field.lattice().point(o);
                assert!((rgb[0] - 7.0).abs() < 1e-5);
                error = error.max((f64::from(rgb[1]) - f(p)).abs());
            }
            worst.push(error);
        }
        assert!(worst[1] < 0.6 * worst[0] && worst[0] < 0.4, "halving the distance: {worst:?}");
    }

    #[test]
    fn grid_sizes() {
        let lattice = Lattice::aligned([3, 4, 5], DVec3::ONE, DVec3::ONE).unwrap();
        let fine = "2x".parse::<GridSize>().unwrap().lattice(&lattice).unwrap();
        assert_eq!((fine.dims(), fine.spacing()), ([5, 7, 9], DVec3::splat(0.5)));
        assert_eq!(fine.to_world(fine.far()), lattice.to_world(lattice.far()));
        let own = "1x".parse::<GridSize>().unwrap();
        assert_eq!((own, own.lattice(&lattice).unwrap().dims()), (GridSize::OWN, [3, 4, 5]));
        let long = "1x, 2x,3x".parse::<GridSize>().unwrap().lattice(&lattice).unwrap();
        assert_eq!(long.dims(), [3, 7, 13]);
        assert!((long.spacing() - DVec3::new(1.0, 1.0 / 2.0, 1.0 / 3.0)).length() < 1e-15);
        for text in ["2x", "1x,2x,3x", "cubic", "7,8,9"] {
            assert_eq!(text.parse::<GridSize>().unwrap().to_string(), text);
        }
        assert_eq!("7, 8,9".parse::<GridSize>(), Ok(GridSize::Points([7, 8, 9])));
        assert_eq!("4x,4x,4x".parse::<GridSize>().unwrap().to_string(), "4x");
        for wrong in ["0x", "17x", "4,4", "1x,2x", "1x,2x,17x", "1x,2x,3", "2x,cubic", "1,2,3", "", "x"] {
            let message = wrong.parse::<GridSize>().unwrap_err();
            assert!(message.contains(&format!("'{wrong}'")) && message.contains("cubic"), "{message}");
        }
    }

    /// Whatever the unit is, and however axes lean; no factor is greater than the greatest.
    #[test]
    fn cubic_grids() {
        for (spacing, factors) in [
            ([1.0, 1.0, 1.0], [1, 1, 1]),
            ([1.0, 1.4, 1.6], [1, 1, 2]),
            ([0.7e-3, 0.7e-3, 3.0e-3], [1, 1, 4]),
            ([5.0, 2.0, 1.0], [5, 2, 1]),
            ([1.0, 1.0, 50.0], [1, 1, 16]),
        ] {
            for lean in [DMat3::IDENTITY, DMat3::from_rotation_y(0.7), DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0))]
            {
                let axes = lean * DMat3::from_diagonal(DVec3::from_array(spacing));
                let lattice = Lattice::new([3, 4, 5], DVec3::ONE, axes).unwrap();
                assert_eq!(GridSize::Cubic.of(&lattice), GridSize::Factors(factors), "{spacing:?}");
                let [a, b] = [GridSize::Cubic, GridSize::Factors(factors)].map(|size| size.lattice(&lattice).unwrap());
                assert_eq!(a, b);
                assert_eq!(GridSize::Points([2, 3, 4]).of(&lattice), GridSize::Points([2, 3, 4]));
            }
        }
    }
}
