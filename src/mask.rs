//! Which points of a lattice over Ω the sweep's surfaces need, and points of the graph that can stand for them.

use crate::field::{Field, FieldRows, GradientRow, has_direction};
use crate::neighbourhood::neighbourhood;
use crate::rng::{Rng, Stage};
use crate::volume::Lattice;
use glam::DVec3;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// What a grid point holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Mask {
    /// Nothing: no level set of the sweep passes near, or no cell around has finite samples only. Stored as 0.
    Empty = 0,
    /// Radiance of the level set through the point.
    Valid = 1,
    /// Outside the sweep or without gradient itself, but in a cell that surfaces of the sweep cross, or beside one:
    /// those surfaces interpolate it. Holds light of its own level set, or what fits samples nearby.
    Filled = 2,
}

/// Lattice point `o` in the local frame of the field.
#[inline]
pub fn local_position(field: &Field, lattice: &Lattice, o: usize) -> DVec3 {
    let p = lattice.point(o);
    if lattice == field.lattice() { p } else { p * (field.lattice().far() / lattice.far()) }
}

/// Where a lattice over Ω holds surfaces of the sweep.
pub fn masks(field: &Field, lattice: &Lattice) -> Vec<Mask> {
    let dims = lattice.dims();
    let values: Cow<'_, [f32]> =
        if lattice == field.lattice() { field.samples().into() } else { field.samples_at(lattice).into() };
    let rows = FieldRows::new(field, lattice);
    // Values of other lattices are finite in whole cells only.
    let gaps = lattice == field.lattice() && field.has_gaps();
    let area = dims[0] * dims[1];
    let within = |h: f32| (0.0..=1.0).contains(&h);
    let mut out = vec![Mask::Empty; lattice.len()];
    out.par_chunks_mut(SLICES * area).enumerate().for_each_init(Work::default, |work, (chunk, out)| {
        let first = chunk * SLICES;
        let plane = |z: usize| &values[z * area..(z + 1) * area];
        (first.saturating_sub(1)..=first).for_each(|z| work.look(z, plane(z), dims[0]));
        for (z, out) in (first..).zip(out.chunks_exact_mut(area)) {
            if z + 1 < dims[2] {
                work.look(z + 1, plane(z + 1), dims[0]);
            }
            for (j, out) in out.chunks_exact_mut(dims[0]).enumerate() {
                let across = j * dims[0]..(j + 1) * dims[0];
                let around = work.around(z.saturating_sub(1)..(z + 2).min(dims[2]), across.clone());
                for ((mask, &lo), &hi) in out.iter_mut().zip(&around.lo).zip(&around.hi) {
                    *mask = if (lo <= 1.0) & (hi >= 0.0) & (lo < hi) { Mask::Filled } else { Mask::Empty };
                }
                let values = &plane(z)[across.clone()];
                if values.iter().any(|h| within(*h)) {
                    let gradients = rows.gradients(j, z, &mut work.gradients);
                    for ((mask, &h), &gradient) in out.iter_mut().zip(values).zip(gradients) {
                        if within(h) && has_direction(gradient) {
                            *mask = Mask::Valid;
                        }
                    }
                }
                if gaps {
                    let start = z * area + across.start;
                    for (i, mask) in out.iter_mut().enumerate().filter(|(_, mask)| **mask != Mask::Empty) {
                        if !field.is_in_whole_cell(start + i) {
                            *mask = Mask::Empty;
                        }
                    }
                }
            }
        }
    });
    out
}

/// How far outside the sweep, in its units, points may hold light of their own.
const OVERSHOOT: f64 = 0.25;
/// How much h may bend at such points: level sets on a plateau beside a steep edge are dark, and no end to interpolate
/// from.
const BEND: f64 = 0.8;

/// Whether light on its own level set makes a filled point a better end to interpolate from than what fits the light
/// around it: closely outside the sweep, where h goes on as it does within. Its second differences over the first ones
/// between both neighbours, summed over the axes, are 1 where a plateau ends.
pub fn lights_itself(field: &Field, lattice: &Lattice, o: usize) -> bool {
    let own = lattice == field.lattice();
    let value = |o: usize| match own {
        true => f64::from(field.samples()[o]),
        false => field.value(local_position(field, lattice, o)),
    };
    let h = value(o);
    if !may_light_itself(h)
        || own && !field.is_in_whole_cell(o)
        || field.falling_normal(local_position(field, lattice, o)).is_none()
    {
        return false;
    }
    let (mut first, mut second, mut step) = (0.0, 0.0, 1);
    for n in lattice.dims() {
        if (1..n - 1).contains(&(o / step % n)) {
            let (before, after) = (value(o - step), value(o + step));
            first += (after - before).abs();
            second += (after + before - 2.0 * h).abs();
        }
        step *= n;
    }
    second / first < BEND
}

/// Whether a point with value `h` may hold light of its own level set, in the sweep or by [`lights_itself`].
pub(crate) fn may_light_itself(h: f64) -> bool {
    (-OVERSHOOT..=1.0 + OVERSHOOT).contains(&h)
}

/// Tells which points are to hold light of their own level set: the valid ones, and with `beyond` those just outside
/// the sweep that [`lights_itself`] picks.
pub fn own_light<'a>(
    field: &'a Field,
    lattice: &'a Lattice,
    masks: &'a [Mask],
    beyond: bool,
) -> impl Fn(usize) -> bool + Sync + 'a {
    move |o| match masks[o] {
        Mask::Empty => false,
        Mask::Valid => true,
        Mask::Filled => beyond && lights_itself(field, lattice, o),
    }
}

/// Of the points that the sweep's surfaces need, the share with none beside them that sweeps light: where samples jump
/// over the sweep, as in binary volumes, or where it is a small part of a voxel's step. Nothing but rays knows what
/// surfaces reflect there.
pub fn unknown_share(field: &Field, lattice: &Lattice) -> f64 {
    let masks = masks(field, lattice);
    let beside = |o: usize, all: &[bool]| neighbourhood(lattice.dims(), o).any(|run| all[run].contains(&true));
    let pick = |chosen: &(dyn Fn(usize) -> bool + Sync)| -> Vec<bool> {
        (0..masks.len()).into_par_iter().with_min_len(1 << 12).map(chosen).collect()
    };
    let valid = pick(&|o| masks[o] == Mask::Valid);
    // Beyond the sweep lines light what is beside a point of it.
    let own = own_light(field, lattice, &masks, true);
    let own = pick(&|o| own(o) && beside(o, &valid));
    let needed = || (0..masks.len()).into_par_iter().with_min_len(1 << 12).filter(|&o| masks[o] != Mask::Empty);
    1.0 - needed().filter(|&o| beside(o, &own)).count() as f64 / needed().count().max(1) as f64
}

/// Slices of constant z that are looked at together.
const SLICES: usize = 8;

/// Ranges of values; NaN is none.
#[derive(Default)]
struct Extrema {
    lo: Vec<f32>,
    hi: Vec<f32>,
}

impl Extrema {
    /// Becomes the ranges from `lo` to `hi`.
    fn set(&mut self, lo: &[f32], hi: &[f32]) {
        for (own, new) in [(&mut self.lo, lo), (&mut self.hi, hi)] {
            own.clear();
            own.extend_from_slice(new);
        }
    }

    /// Takes others into those from `at` on.
    fn widen(&mut self, at: usize, lo: &[f32], hi: &[f32]) {
        self.lo[at..].iter_mut().zip(lo).for_each(|(a, &b)| *a = a.min(b));
        self.hi[at..].iter_mut().zip(hi).for_each(|(a, &b)| *a = a.max(b));
    }
}

/// Planes of a chunk at work.
#[derive(Default)]
struct Work {
    /// The ranges within a step of the points of three planes; plane z is at z mod 3.
    planes: [Extrema; 3],
    along: Extrema,
    around: Extrema,
    gradients: GradientRow,
}

impl Work {
    /// Takes in plane `z`, in rows of `nx`: ranges along rows, then across.
    fn look(&mut self, z: usize, plane: &[f32], nx: usize) {
        let (along, across) = (&mut self.along, &mut self.planes[z % 3]);
        along.set(plane, plane);
        for row in (0..plane.len()).step_by(nx) {
            let (before, after) = (&plane[row..row + nx - 1], &plane[row + 1..row + nx]);
            along.widen(row + 1, before, before);
            along.widen(row, after, after);
        }
        across.set(&along.lo, &along.hi);
        let last = plane.len() - nx;
        across.widen(nx, &along.lo[..last], &along.hi[..last]);
        across.widen(0, &along.lo[nx..], &along.hi[nx..]);
    }

    /// The ranges over planes of a row.
    fn around(&mut self, planes: Range<usize>, row: Range<usize>) -> &Extrema {
        let first = &self.planes[planes.start % 3];
        self.around.set(&first.lo[row.clone()], &first.hi[row.clone()]);
        for z in planes.skip(1) {
            let Extrema { lo, hi } = &self.planes[z % 3];
            self.around.widen(0, &lo[row.clone()], &hi[row.clone()]);
        }
        &self.around
    }
}

/// Points of the graph that stand for lattice point `o`: itself if a level set of the sweep passes through it, else up
/// to `N` points of the cells around it where one does (keyed by `seed`); none where none is found.
pub fn stand_ins<const N: usize>(field: &Field, lattice: &Lattice, o: usize, seed: u64) -> [Option<DVec3>; N] {
    let centre = local_position(field, lattice, o);
    let usable = |p: &DVec3| (0.0..=1.0).contains(&field.value(*p)) && field.falling_normal(*p).is_some();
    let mut found = [None; N];
    if usable(&centre) {
        found[0] = Some(centre);
        return found;
    }
    let cell = field.lattice().far() / lattice.far();
    let mut rng = Rng::stream(seed, Stage::Cache, o as u64);
    let place = |steps: DVec3| (centre + steps * cell).clamp(DVec3::ZERO, field.lattice().far());
    let around = |rng: &mut Rng| place(DVec3::new(rng.unit(), rng.unit(), rng.unit()) * 2.0 - 1.0);
    let tries = (0..16 * N).map(|_| around(&mut rng));
    found.iter_mut().zip(tries.filter(usable)).for_each(|(place, p)| *place = Some(p));
    if found[0].is_none() {
        // A sweep that is a thin slice of its cells lies on the way from anywhere to one of their corners.
        let corner = |n: i32| place(DVec3::from_array([n % 3, n / 3 % 3, n / 9].map(f64::from)) - 1.0);
        let corners = (0..27).map(corner).map(|p| (field.value(p), p));
        let corners: Vec<(f64, DVec3)> = corners.filter(|(h, _)| h.is_finite()).collect();
        let lowest = corners.iter().min_by(|a, b| a.0.total_cmp(&b.0));
        let highest = corners.iter().max_by(|a, b| a.0.total_cmp(&b.0));
        if let (Some(&lowest), Some(&highest)) = (lowest, highest) {
            let ways = (0..16 * N).filter_map(|_| between(field, around(&mut rng), [lowest, highest], rng.unit()));
            found.iter_mut().zip(ways.filter(usable)).for_each(|(place, p)| *place = Some(p));
        }
    }
    found
}

/// Halvings after which f32 tells no more places apart: 24 divide two cells into its steps between 1 and 2, and there
/// are finer ones near 0.
const HALVINGS: usize = 32;
/// The most that h may rise over a step of f32, as a part of the sweep. Where steps are coarser some places are in the
/// sweep by luck, beside many that are not: sweeps of 10⁻⁷ and 10⁻⁹ of their isovalues had a few, and holes.
const COARSEST: f64 = 0.25;

/// A place of f32 where h is in the sweep, around `isovalue`, on the way from `p` to the one of two places with h at
/// them that lies on the other side; `None` if there is none.
fn between(field: &Field, p: DVec3, [lowest, highest]: [(f64, DVec3); 2], isovalue: f64) -> Option<DVec3> {
    let h = field.value(p);
    if !(h.is_finite() && lowest.0 <= isovalue && highest.0 >= isovalue) {
        return None;
    }
    let (mut low, mut high) = if h < isovalue { (p, highest.1) } else { (lowest.1, p) };
    for _ in 0..HALVINGS {
        let middle = (0.5 * (low + high)).as_vec3().as_dvec3();
        let h = field.value(middle);
        if (0.0..=1.0).contains(&h) {
            let step = f64::from(f32::EPSILON) * middle.max_element();
            let slope = field.lattice().axes().transpose() * field.value_and_gradient(middle).1;
            let rise = slope.abs().element_sum() * step;
            return (rise < COARSEST).then_some(middle);
        }
        if h < isovalue {
            low = middle;
        } else {
            high = middle;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::volume::{Samples, Volume};

    #[test]
    fn masks_say_what_a_point_holds() {
        let lattice = Lattice::aligned([8, 3, 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let row = [0.0, 0.0, 0.0, 0.5, 2.0, 9.0, 9.0, 9.0f32];
        let samples = (0..lattice.len()).map(|o| row[o % 8]).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.2, 1.2);
        let got = masks(&field, &lattice);
        use Mask::{Empty, Filled, Valid};
        // Cells 2–3, 3–4 hold the sweep; nodes of those cells and the cells beside them are filled.
        assert_eq!(got[..8], [Empty, Empty, Filled, Valid, Filled, Empty, Empty, Empty]);
    }

    /// Specks in more slices than are looked at together: points that, with all around them, span part of the sweep are
    /// filled.
    #[test]
    fn what_a_point_holds_is_what_stands_around_it() {
        let dims = [7, 5, 2 * SLICES + 3];
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let mut rng = Rng::stream(3, Stage::Test, 0);
        // A ramp around them, so that all have a gradient.
        let mut value = |o: usize| if rng.unit() < 0.06 { 60.0 * rng.unit() as f32 } else { 100.0 + o as f32 };
        let values = (0..lattice.len()).map(&mut value).collect();
        let field = Field::made(lattice.clone(), Samples::F32(values), -1.0, 40.0);
        let h = field.samples();
        let mut count = [0; 3];
        for (o, mask) in masks(&field, &lattice).into_iter().enumerate() {
            let at = lattice.ijk(o);
            let near = |n: usize| lattice.ijk(n).iter().zip(at).all(|(&a, b)| a.abs_diff(b) <= 1);
            let around = || (0..h.len()).filter(|n| near(*n)).map(|n| h[n]);
            let (lo, hi) = (around().fold(f32::INFINITY, f32::min), around().fold(f32::NEG_INFINITY, f32::max));
            let expected = match h[o] {
                0.0..=1.0 => Mask::Valid,
                _ if lo <= 1.0 && hi >= 0.0 => Mask::Filled,
                _ => Mask::Empty,
            };
            assert_eq!(mask, expected, "{at:?}");
            count[mask as usize] += 1;
        }
        assert!(count.iter().all(|n| *n > 5), "{count:?}");
    }

    /// Where Ω's faces leave a node no cell without a missing sample.
    #[test]
    fn points_without_a_whole_cell_hold_no_surface() {
        let lattice = Lattice::aligned([6; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let missing = |[i, j, k]: [usize; 3]| [[1, 1, 1], [3, 1, 0], [4, 3, 5]].contains(&[i, j, k]);
        let h = |o: usize| lattice.ijk(o).map(|i| i as f64).iter().sum::<f64>();
        let samples = (0..lattice.len()).map(|o| if missing(lattice.ijk(o)) { f64::NAN } else { h(o) });
        let field = Field::made(lattice.clone(), Samples::F64(samples.collect()), -1.0, 16.0);
        let got = masks(&field, &lattice);
        let mut alone = Vec::new();
        for (o, mask) in got.iter().enumerate() {
            let at = lattice.ijk(o);
            let whole = (0..8).any(|cell: usize| {
                let first = [0, 1, 2].map(|a| (at[a] + (cell >> a & 1)).wrapping_sub(1));
                first.iter().all(|i| *i < 5) && (0..8).all(|c| !missing([0, 1, 2].map(|a| first[a] + (c >> a & 1))))
            });
            assert_eq!(*mask, if whole { Mask::Valid } else { Mask::Empty }, "{at:?}");
            assert!(whole || !lights_itself(&field, &lattice, o), "{at:?}");
            if !(whole || missing(at)) {
                alone.push(at);
            }
        }
        assert!(alone.contains(&[0, 0, 0]) && alone.contains(&[2, 0, 0]) && alone.len() == 11, "{alone:?}");
    }

    /// A ball in a smooth field, and in one that jumps over the sweep within a step, all over or on one side.
    #[test]
    fn points_are_unknown_where_samples_jump_over_the_sweep() {
        let lattice = Lattice::aligned([24; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let share = |jumps: &dyn Fn(f64) -> bool| {
            let h = |o: usize| {
                let [i, j, k] = lattice.ijk(o).map(|i| i as f64 - 11.5);
                let smooth = 0.5 + (8.0 - DVec3::new(i, j, k).length()) / 6.0;
                if jumps(i) { smooth.round().clamp(0.0, 1.0) } else { smooth }
            };
            let samples = Samples::F64((0..lattice.len()).map(h).collect());
            let volume = Volume::new("ball", lattice.clone(), samples).unwrap();
            unknown_share(&Field::new(&volume, Sweep::new(0.1, 0.9).unwrap()).unwrap(), &lattice)
        };
        assert_eq!(share(&|_| false), 0.0);
        assert_eq!(share(&|_| true), 1.0);
        let half = share(&|x| x > 0.0);
        assert!((0.1..0.5).contains(&half), "{half}");
    }

    /// Between two shells of points, of a sweep that holds none: those closely outside are not lit.
    #[test]
    fn points_are_unknown_where_the_sweep_holds_none() {
        let lattice = Lattice::aligned([20; 3], DVec3::splat(-0.5), DVec3::splat(1.0 / 19.0)).unwrap();
        let place = |o: usize| lattice.to_world(lattice.point(o));
        let samples = Samples::F64((0..lattice.len()).map(|o| 1.0 - place(o).length()).collect());
        let volume = Volume::new("ball", lattice.clone(), samples).unwrap();
        let share = |hi: f64| {
            let field = Field::new(&volume, Sweep::new(0.7, hi).unwrap()).unwrap();
            let valid = masks(&field, &lattice).into_iter().filter(|m| *m == Mask::Valid).count();
            (valid, unknown_share(&field, &lattice))
        };
        assert_eq!([0.704, 0.705, 0.707].map(share), [(0, 1.0); 3]);
        assert!(share(0.74).0 > 100 && share(0.74).1 < 0.05, "{:?}", share(0.74));
    }

    /// Waves over a sweep of a thousandth of a voxel's step: every point whose cells it crosses has places in it, the
    /// same in any unit of length.
    #[test]
    fn thin_sweeps_have_stand_ins_everywhere() {
        let lattice = Lattice::aligned([16; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let scaled = |s: f64| Lattice::aligned([16; 3], DVec3::ZERO, DVec3::splat(s)).unwrap();
        let h = |o: usize| {
            let [i, j, k] = lattice.ijk(o).map(|i| i as f64);
            (0.7 * i).sin() + (0.5 * j + 1.0).cos() + 0.3 * k
        };
        let samples = Samples::F64((0..lattice.len()).map(h).collect());
        let with = |lattice: &Lattice, lo: f64, hi: f64| {
            let volume = Volume::new("waves", lattice.clone(), samples.clone()).unwrap();
            Field::new(&volume, Sweep::new(lo, hi).unwrap()).unwrap()
        };
        // Wide enough for points to fall into it, it may have fewer than are asked for.
        for (lo, hi, wanted) in [(2.0, 2.00003, 4), (2.0, 2.0003, 4), (2.0, 2.3, 1)] {
            let field = with(&lattice, lo, hi);
            let others = [1e-3, 1e3].map(|s| with(&scaled(s), lo, hi));
            let masks = masks(&field, &lattice);
            let filled: Vec<usize> = (0..masks.len()).filter(|&o| masks[o] == Mask::Filled).collect();
            let mut all = 0;
            for &o in &filled {
                let places: [Option<DVec3>; 4] = stand_ins(&field, &lattice, o, 1);
                all += usize::from(places[wanted - 1].is_some());
                for other in &others {
                    assert_eq!(stand_ins(other, other.lattice(), o, 1), places, "{lo} {hi} {o}");
                }
                for p in places.into_iter().flatten() {
                    let far = (p - local_position(&field, &lattice, o)).abs().max_element();
                    assert!((0.0..=1.0).contains(&field.value(p)) && far <= 1.0, "{lo} {hi} {o}: {p}");
                }
            }
            assert!(filled.len() > 400 && all * 100 > filled.len() * 99, "{lo} … {hi}: {all} of {}", filled.len());
        }
    }

    /// Along each axis and across the slices that are looked at together: one point of the sweep among emptiness.
    #[test]
    fn one_point_fills_the_cells_around_it() {
        for place in [[0, 0, 0], [4, 2, 7], [4, 2, 8], [3, 3, 16], [5, 4, 18]] {
            let lattice = Lattice::aligned([6, 5, 19], DVec3::ZERO, DVec3::ONE).unwrap();
            let far = |o: usize| (0..3).map(|a| lattice.ijk(o)[a].abs_diff(place[a])).max().unwrap();
            let samples = (0..lattice.len()).map(|o| if far(o) == 0 { 0.5 } else { -1.0 }).collect();
            let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 1.0);
            for (o, mask) in masks(&field, &lattice).into_iter().enumerate() {
                assert_eq!(mask == Mask::Empty, far(o) > 1, "{place:?}: {:?}", lattice.ijk(o));
            }
        }
    }
}
