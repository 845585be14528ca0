//! The measure ∫|∇h| dV of level sets in the cells of a grid, by the octants that they face: what photons' power is divided by.
//!
//! One point stands for each octant of a voxel. Points of a row share their place along y and z, so that a row of the lattice is
//! interpolated across once, and then along x.

use crate::field::Field;
use glam::{DVec3, Mat3A, Vec3, Vec3A, Vec4};
use rayon::prelude::*;

/// The level sets in a cell that face one octant.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Bin {
    /// Centroid by `measure`, in coordinates of the cells.
    pub centroid: Vec3,
    /// ∫ |∇h| dV over what lies in Ω and in the sweep.
    pub measure: f32,
    /// Mean unit receiver normal by that measure, towards falling h, normalised.
    pub normal: Vec3,
    /// Mean isovalue by that measure.
    pub isovalue: f32,
    /// How far another isovalue may be to share light: τ, or half of what the bin spans. A steep edge spans the sweep
    /// within a voxel, where c hardly moves its level set.
    pub reach: f32,
    /// Signs of the normal.
    pub octant: u8,
}

/// The octant of a normal: a bit per negative coordinate.
#[inline]
pub(super) fn octant(n: Vec3A) -> u8 {
    n.cmplt(Vec3A::ZERO).bitmask() as u8
}

/// Cells of whole voxels over a lattice: cell n along an axis holds the lattice's places from f n − ½ to f (n + 1) − ½.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    /// Lattice steps per cell along each axis.
    pub factor: [usize; 3],
    pub dims: [usize; 3],
}

impl Cells {
    /// Cells of `factor` lattice steps each over `dims` samples.
    pub(super) fn new(factor: [usize; 3], dims: [usize; 3]) -> Self {
        Self { factor, dims: std::array::from_fn(|a| dims[a].div_ceil(factor[a])) }
    }

    /// Coordinates of the cells of a local position: cell n spans [n, n + 1].
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn place(&self, p: DVec3) -> Vec3 {
        ((p + 0.5) / DVec3::from_array(self.factor.map(|f| f as f64))).as_vec3()
    }

    /// The cell of one such coordinate, or the nearest.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the cells")]
    pub(super) fn cell(&self, axis: usize, at: f32) -> usize {
        (at as usize).min(self.dims[axis] - 1)
    }
}

/// The bins of all cells, in the cells' order, and the first bin of each cell, with one more entry than cells. `tau`: see
/// [`Bin::reach`].
#[allow(clippy::cast_possible_truncation, reason = "fewer bins than voxels times eight")]
pub(super) fn bins(field: &Field, cells: &Cells, tau: f64) -> (Vec<u32>, Vec<Bin>) {
    let points = Points::new(field, cells, tau);
    let [_, ny, nz] = cells.dims;
    let rows: Vec<(Vec<u32>, Vec<Bin>)> = (0..ny * nz)
        .into_par_iter()
        .with_max_len(16)
        .map_init(Row::default, |row, n| points.bins_of_row([n % ny, n / ny], row))
        .collect();
    let (mut starts, mut bins) = (vec![0], Vec::with_capacity(rows.iter().map(|(_, bins)| bins.len()).sum()));
    for (ends, more) in rows {
        let before = bins.len() as u32;
        starts.extend(ends.iter().map(|e| before + e));
        bins.extend(more);
    }
    (starts, bins)
}

/// The points of a lattice that stand for its volume.
struct Points<'a> {
    field: &'a Field,
    cells: &'a Cells,
    tau: f64,
    /// Points per lattice step along each axis: cells of many voxels need fewer.
    fine: [usize; 3],
    /// Lattice steps between points.
    step: Vec3A,
    /// World volume of a point.
    volume: f32,
    /// From gradients in index space to the world.
    to_world: Mat3A,
    /// What is known of each row of the lattice.
    rows: Vec<LatticeRow>,
}

/// The samples of a row of the lattice.
#[derive(Clone, Copy)]
struct LatticeRow {
    finite: bool,
    lowest: f32,
    /// From the first to behind the last sample that is not below the sweep.
    reach: [usize; 2],
}

/// What is known at a point, gradients by index.
#[derive(Clone, Copy, Debug)]
struct Point {
    h: f32,
    slope: Vec3A,
    /// See [`Field::receiver_gradient`].
    receiver: Vec3A,
}

/// Between nodes of a row of points.
#[derive(Default)]
struct Row {
    /// h, ∂h/∂y, ∂h/∂z, and the receiver gradient at the nodes along x.
    nodes: [Vec<f32>; 6],
    parts: Vec<[Part; 8]>,
}

impl LatticeRow {
    fn new(samples: &[f32]) -> Self {
        let first = samples.iter().position(|&h| h >= 0.0).unwrap_or(samples.len());
        let last = samples.iter().rposition(|&h| h >= 0.0).map_or(0, |last| last + 1);
        Self {
            finite: samples.iter().map(|h| h * 0.0).sum::<f32>() == 0.0,
            lowest: samples.iter().fold(f32::INFINITY, |lowest, &h| lowest.min(h)),
            reach: [first, last],
        }
    }
}

impl<'a> Points<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn new(field: &'a Field, cells: &'a Cells, tau: f64) -> Self {
        let lattice = field.lattice();
        let fine = cells.factor.map(|f| if f < 3 { 2 } else { 1 });
        let step = Vec3A::from_array(fine.map(|f| 1.0 / f as f32));
        let world = |g: DVec3| lattice.gradient_to_world(g).as_vec3a();
        let rows = field.samples().par_chunks(lattice.dims()[0]).with_min_len(64).map(LatticeRow::new).collect();
        Self {
            field,
            cells,
            tau,
            fine,
            step,
            volume: step.element_product() * lattice.axes().determinant().abs() as f32,
            to_world: Mat3A::from_cols(world(DVec3::X), world(DVec3::Y), world(DVec3::Z)),
            rows,
        }
    }

    /// The place of point `n` along an axis, in lattice steps; `None` outside Ω.
    #[inline]
    fn place(&self, axis: usize, n: usize) -> Option<f64> {
        let place = (n as f64 + 0.5) * f64::from(self.step[axis]) - 0.5;
        (place >= 0.0 && place <= self.field.lattice().cells()[axis] as f64).then_some(place)
    }

    /// How much of what a point stands for lies in Ω.
    fn share(&self, axis: usize, place: f64) -> f32 {
        let face = place == 0.0 || place == self.field.lattice().cells()[axis] as f64;
        if face { 0.5 } else { 1.0 }
    }

    /// The lattice's cell along an axis that holds a place, and where in it.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the lattice")]
    fn cell(&self, axis: usize, place: f64) -> (usize, f32) {
        let cell = (place as usize).min(self.field.lattice().cells()[axis] - 1);
        (cell, (place - cell as f64) as f32)
    }

    /// The bins of row (j, k) of the cells: the end of each cell's, and the bins.
    #[allow(clippy::cast_possible_truncation, reason = "fewer bins than voxels times eight")]
    fn bins_of_row(&self, [j, k]: [usize; 2], row: &mut Row) -> (Vec<u32>, Vec<Bin>) {
        let Row { nodes, parts } = row;
        parts.clear();
        parts.resize(self.cells.dims[0], Default::default());
        let points = |axis: usize, cell: usize| {
            let count = self.cells.factor[axis] * self.fine[axis];
            (cell * count..(cell + 1) * count).filter_map(move |n| self.place(axis, n))
        };
        let mut met = false;
        for (y, z) in points(2, k).flat_map(|z| points(1, j).map(move |y| (y, z))) {
            let ((j, v), (k, w)) = (self.cell(1, y), self.cell(2, z));
            let Some(range) = self.reach(j, k) else { continue };
            met = true;
            if self.regular(j, k) {
                self.read_nodes([j, k], [v, w], range, nodes);
                self.add([y, z], range, |x| Some(self.between(nodes, x)), parts);
            } else {
                self.add([y, z], range, |x| self.point(DVec3::new(x, y, z)), parts);
            }
        }
        let (mut ends, mut bins) = (vec![0; self.cells.dims[0]], Vec::new());
        if met {
            for (end, parts) in ends.iter_mut().zip(parts) {
                bins.extend((0..).zip(parts).filter_map(|(octant, part)| part.bin(octant, self.cells, self.tau)));
                *end = bins.len() as u32;
            }
        }
        (ends, bins)
    }

    /// From which to behind which node along x level sets of the sweep may pass between rows j, j + 1 and k, k + 1.
    fn reach(&self, j: usize, k: usize) -> Option<[usize; 2]> {
        let [nx, ny, _] = self.field.lattice().dims();
        let rows = [(j, k), (j + 1, k), (j, k + 1), (j + 1, k + 1)].map(|(j, k)| self.rows[k * ny + j]);
        let first = rows.iter().map(|r| r.reach[0]).min()?;
        let last = rows.iter().map(|r| r.reach[1]).max()?;
        let any = first < last && rows.iter().any(|r| r.lowest <= 1.0);
        any.then(|| [first.saturating_sub(1), (last + 1).min(nx)])
    }

    /// Whether all samples that gradients there look at are finite, and normals are those of these samples.
    fn regular(&self, j: usize, k: usize) -> bool {
        let [_, ny, nz] = self.field.lattice().dims();
        let around = |j: usize, n: usize| j.saturating_sub(1)..=(j + 2).min(n - 1);
        self.field.has_own_normals() && around(k, nz).all(|k| around(j, ny).all(|j| self.rows[k * ny + j].finite))
    }

    /// [`Row::nodes`] at y = j + v, z = k + w over a range of x.
    fn read_nodes(&self, [j, k]: [usize; 2], [v, w]: [f32; 2], range: [usize; 2], nodes: &mut [Vec<f32>; 6]) {
        let [nx, ny, nz] = self.field.lattice().dims();
        // Differences along x look one node further.
        let (from, to) = (range[0].saturating_sub(1), (range[1] + 1).min(nx));
        let len = to - from;
        let row = |j: usize, k: usize| &self.field.samples()[(k * ny + j) * nx..][from..to];
        let [r00, r10, r01, r11] = [row(j, k), row(j + 1, k), row(j, k + 1), row(j + 1, k + 1)];
        // Central differences at the nodes across the row, one-sided at Ω's faces.
        let beside = |j: usize, n: usize| {
            let (before, after) = (j.saturating_sub(1), (j + 1).min(n - 1));
            (before, after, 1.0 / (after - before) as f32)
        };
        let across = |j: usize, k: usize| {
            let (before, after, scale) = beside(j, ny);
            (row(before, k), row(after, k), scale)
        };
        let up = |j: usize, k: usize| {
            let (before, after, scale) = beside(k, nz);
            (row(j, before), row(j, after), scale)
        };
        let across = [across(j, k), across(j + 1, k), across(j, k + 1), across(j + 1, k + 1)];
        let up = [up(j, k), up(j + 1, k), up(j, k + 1), up(j + 1, k + 1)];
        nodes.iter_mut().for_each(|n| n.resize(nx, 0.0));
        let [h, dy, dz, rx, ry, rz] = nodes.each_mut().map(|n| &mut n[from..to]);
        // Known lengths, for the compiler.
        let (h, dy, dz, rx) = (&mut h[..len], &mut dy[..len], &mut dz[..len], &mut rx[..len]);
        let (r00, r10, r01, r11) = (&r00[..len], &r10[..len], &r01[..len], &r11[..len]);
        let weights = [(1.0 - v) * (1.0 - w), v * (1.0 - w), (1.0 - v) * w, v * w];
        for i in 0..len {
            let (a, b, c, d) = (r00[i], r10[i], r01[i], r11[i]);
            h[i] = (weights[0] * a + weights[1] * b) + (weights[2] * c + weights[3] * d);
            dy[i] = (1.0 - w) * (b - a) + w * (d - c);
            dz[i] = (1.0 - v) * (c - a) + v * (d - b);
        }
        for (out, rows) in [(&mut ry[..len], across), (&mut rz[..len], up)] {
            out.fill(0.0);
            for ((before, after, scale), weight) in rows.into_iter().zip(weights) {
                let (before, after, weight) = (&before[..len], &after[..len], weight * scale);
                for i in 0..len {
                    out[i] += weight * (after[i] - before[i]);
                }
            }
        }
        for i in 1..len - 1 {
            rx[i] = 0.5 * (h[i + 1] - h[i - 1]);
        }
        // At Ω's faces; elsewhere beyond the range.
        (rx[0], rx[len - 1]) = (h[1] - h[0], h[len - 1] - h[len - 2]);
    }

    /// A point between the nodes of a row.
    #[inline(always)]
    fn between(&self, [h, dy, dz, rx, ry, rz]: &[Vec<f32>; 6], x: f64) -> Point {
        let (i, u) = self.cell(0, x);
        let at = |n: &[f32]| (1.0 - u) * n[i] + u * n[i + 1];
        Point {
            h: at(h),
            slope: Vec3A::new(h[i + 1] - h[i], at(dy), at(dz)),
            receiver: Vec3A::new(at(rx), at(ry), at(rz)),
        }
    }

    /// Any point in Ω; `None` if nothing is known there.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn point(&self, p: DVec3) -> Option<Point> {
        let to_index = self.field.lattice().axes().transpose();
        let (h, slope) = self.field.value_and_gradient(p);
        let receiver = self.field.receiver_gradient(p);
        let index = |g: DVec3| (to_index * g).as_vec3a();
        h.is_finite().then(|| Point { h: h as f32, slope: index(slope), receiver: index(receiver) })
    }

    /// Adds the points of the row at y and z between two nodes to the parts of their cells.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn add(
        &self,
        [y, z]: [f64; 2],
        [first, end]: [usize; 2],
        point: impl Fn(f64) -> Option<Point>,
        parts: &mut [[Part; 8]],
    ) {
        let across = self.volume * self.share(1, y) * self.share(2, z);
        let per_cell = self.cells.factor[0] * self.fine[0];
        let within = first as f64..=(end - 1) as f64;
        for n in self.fine[0] * first..self.fine[0] * end {
            let Some(x) = self.place(0, n).filter(|x| within.contains(x)) else { continue };
            let Some(Point { h, slope, receiver }) = point(x) else { continue };
            // How far h goes within the octant.
            let rise = slope * self.step;
            let spread = 0.5 * rise.abs().element_sum();
            if !(h + spread >= 0.0 && h - spread <= 1.0) {
                continue;
            }
            let w = (self.to_world * slope).length() * across * self.share(0, x);
            let Some(normal) = (self.to_world * -receiver).try_normalize() else { continue };
            if !(w > 0.0 && w < f32::INFINITY) {
                continue;
            }
            let p = Vec3A::new(x as f32, y as f32, z as f32);
            let part = &mut parts[n / per_cell][usize::from(octant(normal))];
            if h - spread >= 0.0 && h + spread <= 1.0 {
                part.add(w, h, normal, p);
                continue;
            }
            // Where the sweep ends, eight points of the tangent.
            for eighth in 0..8usize {
                let at = |axis: usize| if eighth >> axis & 1 == 1 { 0.25 } else { -0.25 };
                let offset = Vec3A::new(at(0), at(1), at(2));
                let h = h + rise.dot(offset);
                if (0.0..=1.0).contains(&h) {
                    part.add(w / 8.0, h, normal, p + offset * self.step);
                }
            }
        }
    }
}

/// Sums over the points of a cell that face one octant, weighted by |∇h| dV.
#[derive(Clone, Copy)]
struct Part {
    /// Of the normal, and the measure.
    normal: Vec4,
    /// Of the place, and of h.
    place: Vec4,
    lowest: f32,
    highest: f32,
}

impl Default for Part {
    fn default() -> Self {
        Self { normal: Vec4::ZERO, place: Vec4::ZERO, lowest: f32::INFINITY, highest: f32::NEG_INFINITY }
    }
}

impl Part {
    #[inline]
    fn add(&mut self, w: f32, h: f32, normal: Vec3A, p: Vec3A) {
        self.normal += w * normal.extend(1.0);
        self.place += w * p.extend(h);
        (self.lowest, self.highest) = (self.lowest.min(h), self.highest.max(h));
    }

    /// What has no measure is no bin.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn bin(&self, octant: u8, cells: &Cells, tau: f64) -> Option<Bin> {
        let measure = self.normal.w;
        (measure > 0.0).then(|| Bin {
            centroid: cells.place((self.place.truncate() / measure).as_dvec3()),
            measure,
            normal: self.normal.truncate().normalize_or_zero(),
            isovalue: self.place.w / measure,
            reach: (tau as f32).max(0.5 * (self.highest - self.lowest)),
            octant,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::rng::{Rng, Stage};
    use crate::volume::{Lattice, Samples, Volume};
    use glam::DMat3;

    fn field(lattice: Lattice, mut h: impl FnMut([usize; 3]) -> f64) -> Field {
        let samples = (0..lattice.len()).map(|o| h(lattice.ijk(o))).collect();
        let volume = Volume::new("test", lattice, Samples::F64(samples)).unwrap();
        Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap()
    }

    fn oblique(dims: [usize; 3]) -> Lattice {
        let axes = DMat3::from_cols(DVec3::new(-0.5, 0.1, 0.0), DVec3::new(0.2, 0.7, 0.0), DVec3::new(0.0, 0.3, 2.0));
        Lattice::new(dims, DVec3::new(10.0, -3.0, 1e3), axes).unwrap()
    }

    #[test]
    fn rows_read_what_points_read() {
        let mut rng = Rng::stream(3, Stage::Test, 0);
        let noise = field(oblique([9, 7, 8]), |_| rng.unit());
        for factor in [1, 2, 3] {
            let cells = Cells::new([factor; 3], noise.lattice().dims());
            let points = Points::new(&noise, &cells, 0.1);
            let places = |axis: usize| {
                let count = points.fine[axis] * noise.lattice().dims()[axis];
                (0..count).filter_map(|n| points.place(axis, n)).collect::<Vec<_>>()
            };
            let (mut nodes, mut compared) = (Default::default(), 0);
            for (y, z) in places(2).into_iter().flat_map(|z| places(1).into_iter().map(move |y| (y, z))) {
                let ((j, v), (k, w)) = (points.cell(1, y), points.cell(2, z));
                assert!(points.regular(j, k) && points.reach(j, k) == Some([0, 9]));
                for (range, x) in [[0, 9], [2, 7]].into_iter().flat_map(|r| places(0).into_iter().map(move |x| (r, x)))
                {
                    if x < range[0] as f64 || x > (range[1] - 1) as f64 {
                        continue;
                    }
                    points.read_nodes([j, k], [v, w], range, &mut nodes);
                    let (fast, slow) = (points.between(&nodes, x), points.point(DVec3::new(x, y, z)).unwrap());
                    let gradients = [(fast.slope, slow.slope), (fast.receiver, slow.receiver)];
                    let far = gradients.iter().map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max);
                    assert!((fast.h - slow.h).abs().max(far) < 1e-5, "{factor}: {x} {y} {z}: {fast:?} {slow:?}");
                    compared += 1;
                }
            }
            assert!(compared >= 8 * 6 * 7, "{compared}");
        }
    }

    #[test]
    fn the_measure_of_a_ramp_is_its_slope_times_its_volume() {
        let dims = [13, 11, 12];
        for (axis, factor) in (0..3).flat_map(|axis| [(axis, 1), (axis, 2), (axis, 3), (axis, 5)]) {
            let lattice = oblique(dims);
            let axes = lattice.axes();
            // Runs along one axis, from outside the sweep through all of it.
            let ramp = field(lattice, |ijk| (ijk[axis] as f64 - 3.3) / 5.1);
            let slope = ramp.lattice().gradient_to_world(DVec3::AXES[axis]).length() / 5.1;
            let across: f64 = (0..3).filter(|&a| a != axis).map(|a| (dims[a] - 1) as f64).product();
            let expected = slope * across * 5.1 * axes.determinant().abs();
            let (starts, found) = bins(&ramp, &Cells::new([factor; 3], dims), 0.1);
            assert_eq!(*starts.last().unwrap() as usize, found.len());
            let measure: f64 = found.iter().map(|b| f64::from(b.measure)).sum();
            assert!((measure / expected - 1.0).abs() < 0.05, "{axis} {factor}: {measure} {expected}");
            assert!(found.iter().all(|b| (0.0..=1.0).contains(&b.isovalue) && (b.normal.length() - 1.0).abs() < 1e-5));
        }
    }

    #[test]
    fn samples_that_are_no_numbers_cost_their_cells_only() {
        let dims = [9, 9, 9];
        let whole = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |ijk| ijk[0] as f64 / 8.0);
        let holed = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |ijk| {
            if ijk == [4, 4, 4] { f64::NAN } else { ijk[0] as f64 / 8.0 }
        });
        let cells = Cells::new([1; 3], dims);
        let total = |field: &Field| bins(field, &cells, 0.1).1.iter().map(|b| f64::from(b.measure)).sum::<f64>();
        // Eight cells of 8³.
        assert!((total(&whole) - total(&holed) - 1.0).abs() < 1e-4, "{} {}", total(&whole), total(&holed));
    }
}
