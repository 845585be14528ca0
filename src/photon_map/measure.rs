//! The measure ∫|∇h| dV of level sets in the cells of a grid, by the octants that they face: what photons' power is
//! divided by.
//!
//! One point stands for each eighth of a voxel, or in cells of many voxels for each voxel. Points of a row share their
//! place along y and z, so that a row of the lattice is interpolated across once, and then along x.

use super::cells::Cells;
use super::shares::{Block, Point};
use super::slots::{Along, LANES, Slot};
use crate::field::Field;
use crate::isa::{Isa, Work};
use crate::photon::octant;
use glam::{DVec3, DVec4, Mat3, Vec3};
use rayon::prelude::*;

/// The level sets in a cell that face one octant.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Bin {
    /// Centroid by `measure`, in coordinates of the cells.
    pub centroid: Vec3,
    /// ∫ |∇h| dV over what lies in Ω and in the sweep, per [`unit`](crate::volume::Lattice::unit) squared.
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

/// The bins of all cells, in the cells' order, and the first bin of each cell, with one more entry than cells. `tau`:
/// see [`Bin::reach`].
#[allow(clippy::cast_possible_truncation, reason = "2³² bins take 240 GB")]
pub(super) fn bins(field: &Field, cells: &Cells, tau: f64) -> (Vec<u32>, Vec<Bin>) {
    let (points, isa) = (Points::new(field, cells, tau), Isa::current());
    let [_, ny, nz] = cells.dims;
    let rows: Vec<(Vec<u32>, Vec<Bin>)> = (0..ny * nz)
        .into_par_iter()
        .with_max_len(16)
        .map_init(Row::default, |row, n| isa.run(RowOfBins { points: &points, place: [n % ny, n / ny], row }))
        .collect();
    let (mut starts, mut bins) = (vec![0], Vec::with_capacity(rows.iter().map(|(_, bins)| bins.len()).sum()));
    for (ends, more) in rows {
        let before = bins.len() as u32;
        starts.extend(ends.iter().map(|e| before + e));
        bins.extend(more);
    }
    (starts, bins)
}

/// A row of the cells to be done.
struct RowOfBins<'a> {
    points: &'a Points<'a>,
    place: [usize; 2],
    row: &'a mut Row,
}

impl Work for RowOfBins<'_> {
    type Output = (Vec<u32>, Vec<Bin>);

    #[inline(always)]
    fn work(self) -> Self::Output {
        self.points.bins_of_row(self.place, self.row)
    }
}

/// The points of a lattice that stand for its volume.
struct Points<'a> {
    field: &'a Field,
    cells: &'a Cells,
    tau: f64,
    /// Points per lattice step along each axis: cells of many voxels need fewer.
    fine: [usize; 3],
    /// Along y and z, as many per cell as a cell has; `None` outside Ω.
    across: [Vec<Option<Slot>>; 2],
    /// Along x: below their nodes and above them, or where one stands for both by turns.
    along: Vec<Along>,
    /// World volume of a voxel, per unit squared.
    volume: f64,
    /// From gradients in index space to the world.
    to_world: Mat3,
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

/// A row of points at work.
#[derive(Default)]
struct Row {
    /// h, ∂h/∂y, ∂h/∂z, and the receiver gradient at the nodes along x, behind a place that none has.
    nodes: [Vec<f32>; 6],
    block: Block,
    /// Of each cell, empty between rows of cells.
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
        let dims = lattice.dims();
        let fine = cells.factor.map(|f| if f < 3 { 2 } else { 1 });
        let world = |g: DVec3| lattice.gradient_to_world(g).as_vec3();
        let rows = field.samples().par_chunks(dims[0]).with_min_len(64).map(LatticeRow::new).collect();
        Self {
            field,
            cells,
            tau,
            fine,
            across: [1, 2].map(|a| Slot::all(fine[a], dims[a])),
            along: Along::all(fine[0], cells, dims[0]),
            volume: lattice.cell_volume() / lattice.unit().powi(2),
            to_world: Mat3::from_cols(world(DVec3::X), world(DVec3::Y), world(DVec3::Z)),
            rows,
        }
    }

    /// The bins of row (j, k) of the cells: the end of each cell's, and the bins.
    #[allow(clippy::cast_possible_truncation, reason = "2³² bins take 240 GB")]
    #[inline(always)]
    fn bins_of_row(&self, [j, k]: [usize; 2], row: &mut Row) -> (Vec<u32>, Vec<Bin>) {
        let count = self.cells.dims[0];
        row.parts.resize(count, Default::default());
        let slots = |axis: usize, cell: usize| {
            let count = self.cells.factor[axis] * self.fine[axis];
            self.across[axis - 1].iter().skip(cell * count).take(count).flatten()
        };
        // The cells that were met.
        let (mut first, mut end) = (count, 0);
        for (y, z) in slots(2, k).flat_map(|z| slots(1, j).map(move |y| (y, z))) {
            let Some(range) = self.reach(y, z) else { continue };
            (first, end) =
                (first.min(range[0] / self.cells.factor[0]), end.max(range[1].div_ceil(self.cells.factor[0])));
            if self.regular(y.cell, z.cell) {
                self.add_row([y, z], range, row);
            } else {
                self.add_points([y, z], range, row);
            }
        }
        let (mut ends, mut bins) = (Vec::with_capacity(count), Vec::new());
        ends.resize(first, 0);
        for parts in row.parts.get_mut(first..end).unwrap_or_default() {
            bins.extend((0..).zip(&*parts).filter_map(|(octant, part)| part.bin(octant, self.cells, self.tau)));
            *parts = Default::default();
            ends.push(bins.len() as u32);
        }
        ends.resize(count, bins.len() as u32);
        (ends, bins)
    }

    /// From which to behind which node along x those points lie in whose share level sets of the sweep may pass.
    fn reach(&self, y: &Slot, z: &Slot) -> Option<[usize; 2]> {
        let [nx, ny, _] = self.field.lattice().dims();
        let (mut first, mut last, mut lowest) = (nx, 0, f32::INFINITY);
        for row in (z.nodes[0]..=z.nodes[1]).flat_map(|k| (y.nodes[0]..=y.nodes[1]).map(move |j| k * ny + j)) {
            let row = self.rows[row];
            (first, last) = (first.min(row.reach[0]), last.max(row.reach[1]));
            lowest = lowest.min(row.lowest);
        }
        // A voxel lies in the cells on both sides of its node, its point in one.
        let beside = 3 - self.fine[0];
        (first < last && lowest <= 1.0).then(|| [first.saturating_sub(beside), (last + beside).min(nx)])
    }

    /// Whether all samples that gradients there look at are finite, and normals are those of these samples.
    fn regular(&self, j: usize, k: usize) -> bool {
        let [_, ny, nz] = self.field.lattice().dims();
        let around = |j: usize, n: usize| j.saturating_sub(1)..=(j + 2).min(n - 1);
        self.field.has_own_normals() && around(k, nz).all(|k| around(j, ny).all(|j| self.rows[k * ny + j].finite))
    }

    /// [`Row::nodes`] at y and z over a range of x.
    #[inline(always)]
    fn read_nodes(&self, [y, z]: [&Slot; 2], range: [usize; 2], nodes: &mut [Vec<f32>; 6]) {
        let [nx, ny, nz] = self.field.lattice().dims();
        let ((j, v), (k, w)) = ((y.cell, y.inside), (z.cell, z.inside));
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
        nodes.iter_mut().for_each(|n| n.resize(nx + LANES + 1, 0.0));
        let [h, dy, dz, rx, ry, rz] = nodes.each_mut().map(|n| &mut n[from + 1..=to]);
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
            let [a, b, c, d] = rows.map(|(before, after, _)| (&before[..len], &after[..len]));
            let w: [f32; 4] = std::array::from_fn(|n| weights[n] * rows[n].2);
            for i in 0..len {
                let rise = |(before, after): (&[f32], &[f32])| after[i] - before[i];
                out[i] = w[0] * rise(a) + w[1] * rise(b) + w[2] * rise(c) + w[3] * rise(d);
            }
        }
        for i in 1..len - 1 {
            rx[i] = 0.5 * (h[i + 1] - h[i - 1]);
        }
        // At Ω's faces; elsewhere beyond the range.
        (rx[0], rx[len - 1]) = (h[1] - h[0], h[len - 1] - h[len - 2]);
    }

    /// Any point in Ω; `None` if nothing is known there.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn point(&self, p: DVec3) -> Option<Point> {
        let to_index = self.field.lattice().axes().transpose();
        let (h, slope) = self.field.value_and_gradient(p);
        let receiver = self.field.receiver_gradient(p);
        let index = |g: DVec3| (to_index * g).as_vec3();
        h.is_finite().then(|| Point { h: h as f32, slope: index(slope), receiver: index(receiver) })
    }

    /// Adds the points of the row at y and z between two nodes to the parts of their cells, one by one.
    fn add_points(&self, across: [&Slot; 2], [first, end]: [usize; 2], row: &mut Row) {
        let (Row { block, parts, .. }, [y, z]) = (row, across);
        for along in &self.along {
            for x in along.slots[first..end].iter().flatten().filter(|x| x.cell >= first && x.cell + 1 < end) {
                if let Some(point) = self.point(DVec3::new(x.at, y.at, z.at)) {
                    block.push(&point, x, along.cell[x.node]);
                }
                if block.len == LANES {
                    self.add(block, across, parts);
                }
            }
        }
        self.add(block, across, parts);
    }

    /// The same where all samples around are finite.
    #[inline(always)]
    fn add_row(&self, across: [&Slot; 2], [first, end]: [usize; 2], Row { nodes, block, parts }: &mut Row) {
        self.read_nodes(across, [first, end], nodes);
        for along in &self.along {
            let (first, end) = (first + usize::from(!along.up[first]), end - usize::from(along.up[end - 1]));
            for n in (first..end).step_by(LANES) {
                block.read(nodes, along, n, LANES.min(end - n));
                self.add(block, across, parts);
            }
        }
    }

    /// Adds a block's points to the parts of their cells, and empties it.
    #[inline(always)]
    fn add(&self, block: &mut Block, across: [&Slot; 2], parts: &mut [[Part; 8]]) {
        let [y, z] = across;
        let volume = self.volume * f64::from(y.width * z.width);
        let shares = block.shares(across, &self.to_world);
        for n in 0..block.len {
            if shares.weight[n] <= 0.0 {
                continue;
            }
            let (h, spread) = (shares.h[n], shares.spread[n]);
            let normal = Vec3::from_array(shares.normal.each_ref().map(|c| c[n]));
            let centre = Vec3::new(block.centre[n], y.centre, z.centre);
            let w = volume * f64::from(shares.weight[n]);
            let part = &mut parts[block.cell[n]][usize::from(octant(normal))];
            if h - spread >= 0.0 && h + spread <= 1.0 {
                part.add(w, [h; 2], normal, centre);
                continue;
            }
            // Where the sweep ends, eight points of the tangent; of a sweep that is a thin slice of what they stand for
            // they would miss most: what it has of each's eighth.
            let width = Vec3::new(block.width[n], y.width, z.width);
            let rise = Vec3::from_array(block.slope.each_ref().map(|s| s[n])) * width;
            for eighth in 0..8usize {
                let at = |axis: usize| if eighth >> axis & 1 == 1 { 0.25 } else { -0.25 };
                let offset = Vec3::new(at(0), at(1), at(2));
                let h = h + rise.dot(offset);
                if spread <= THIN {
                    if (0.0..=1.0).contains(&h) {
                        part.add(w / 8.0, [h; 2], normal, centre + offset * width);
                    }
                    continue;
                }
                let half = 0.5 * spread;
                let [low, high] = [(h - half).max(0.0), (h + half).min(1.0)];
                if low < high {
                    let share = f64::from((high - low) / spread).min(1.0);
                    let along = rise * ((0.5 * (low + high) - h) / rise.length_squared());
                    let place = offset + along.clamp(Vec3::splat(-0.25), Vec3::splat(0.25));
                    part.add(w / 8.0 * share, [low, high], normal, centre + place * width);
                }
            }
        }
        block.len = 0;
    }
}

/// How far h goes to either side of its middle, in sweeps, where the sweep is a thin slice.
const THIN: f32 = 0.5;

/// Sums over the points of a cell that face one octant, weighted by |∇h| dV.
#[derive(Clone, Copy)]
struct Part {
    /// Of the normal, and the measure.
    normal: DVec4,
    /// Of the place, and of h.
    place: DVec4,
    lowest: f32,
    highest: f32,
}

impl Default for Part {
    fn default() -> Self {
        Self { normal: DVec4::ZERO, place: DVec4::ZERO, lowest: f32::INFINITY, highest: f32::NEG_INFINITY }
    }
}

impl Part {
    #[inline]
    fn add(&mut self, w: f64, [low, high]: [f32; 2], normal: Vec3, p: Vec3) {
        self.normal += w * normal.extend(1.0).as_dvec4();
        self.place += w * p.extend(0.5 * (low + high)).as_dvec4();
        (self.lowest, self.highest) = (self.lowest.min(low), self.highest.max(high));
    }

    /// What has no measure is no bin.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn bin(&self, octant: u8, cells: &Cells, tau: f64) -> Option<Bin> {
        let measure = self.normal.w;
        (measure > 0.0).then(|| Bin {
            centroid: cells.place(self.place.truncate() / measure),
            measure: measure as f32,
            normal: (self.normal.truncate() / measure).as_vec3().normalize_or_zero(),
            isovalue: (self.place.w / measure) as f32,
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
            let slots = |axis: usize| points.across[axis - 1].iter().flatten();
            let (mut nodes, mut block, mut compared) = (Default::default(), Block::default(), 0);
            for (y, z) in slots(2).flat_map(|z| slots(1).map(move |y| (y, z))) {
                assert!(points.regular(y.cell, z.cell) && points.reach(y, z) == Some([0, 9]));
                let along = points.along.iter().flat_map(|a| a.slots.iter().flatten().map(move |x| (a, x)));
                for (range, (along, x)) in along.flat_map(|x| [[0, 9], [2, 7]].map(|r| (r, x))) {
                    if x.cell < range[0] || x.cell + 1 >= range[1] {
                        continue;
                    }
                    points.read_nodes([y, z], range, &mut nodes);
                    block.read(&nodes, along, x.node, 1);
                    let slow = points.point(DVec3::new(x.at, y.at, z.at)).unwrap();
                    let [slope, receiver] = [block.slope, block.receiver].map(|lanes| Vec3::from(lanes.map(|l| l[0])));
                    let gradients = [(slope, slow.slope), (receiver, slow.receiver)];
                    let far = gradients.iter().map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max);
                    let far = (block.h[0] - slow.h).abs().max(far);
                    assert!(far < 1e-5, "{factor}: {x:?} {y:?} {z:?}: {slope} {receiver} {slow:?}");
                    compared += 1;
                }
            }
            assert!(compared >= 8 * 6 * 7, "{compared}");
        }
    }

    #[test]
    fn the_measure_of_a_ramp_is_its_slope_times_its_volume() {
        let dims = [13, 11, 12];
        let cases = (0..3).flat_map(|axis| [1, 2, 3, 5].map(|factor| (axis, factor)));
        for ((axis, factor), begin) in cases.flat_map(|case| [3.0, 3.3, 3.55, 3.8, 4.05].map(|begin| (case, begin))) {
            for falling in [false, true] {
                let lattice = oblique(dims);
                let axes = lattice.axes();
                // Runs along one axis, from outside the sweep through all of it.
                let ramp = field(lattice, |ijk| {
                    let h = (ijk[axis] as f64 - begin) / 5.1;
                    if falling { 1.0 - h } else { h }
                });
                let slope = ramp.lattice().gradient_to_world(DVec3::AXES[axis]).length() / 5.1;
                let across: f64 = (0..3).filter(|&a| a != axis).map(|a| (dims[a] - 1) as f64).product();
                let expected = slope * across * 5.1 * axes.determinant().abs();
                let (starts, found) = bins(&ramp, &Cells::new([factor; 3], dims), 0.1);
                assert_eq!(*starts.last().unwrap() as usize, found.len());
                let measure: f64 = found.iter().map(|b| f64::from(b.measure)).sum();
                let error = measure / expected - 1.0;
                // A quarter of a voxel at either end is all that eight points of a tangent leave open.
                assert!(error.abs() < 0.05, "axis {axis}, factor {factor}, from {begin}, {falling}: {error}");
                assert!(
                    found.iter().all(|b| (0.0..=1.0).contains(&b.isovalue) && (b.normal.length() - 1.0).abs() < 1e-5)
                );
                // The mean place is the middle, to half of what is left open.
                let mean = found.iter().map(|b| f64::from(b.centroid[axis]) * f64::from(b.measure)).sum::<f64>();
                let place = mean / measure * factor as f64 - 0.5;
                let within = if factor < 3 { 0.13 } else { 0.26 };
                assert!((place - begin - 2.55).abs() < within, "axis {axis}, factor {factor}, from {begin}: {place}");
            }
        }
    }

    #[test]
    fn every_instruction_set_finds_the_same_bins() {
        let dims = [37, 7, 8];
        let mut rng = Rng::stream(6, Stage::Test, 0);
        let noise = field(oblique(dims), |_| 1.4 * rng.unit() - 0.2);
        for factor in [1, 2, 3] {
            let cells = Cells::new([factor; 3], dims);
            let points = Points::new(&noise, &cells, 0.1);
            let rows = |isa: Isa| -> Vec<(Vec<u32>, Vec<Bin>)> {
                let row = &mut Row::default();
                let mut bins =
                    |n| isa.run(RowOfBins { points: &points, place: [n % cells.dims[1], n / cells.dims[1]], row });
                (0..cells.dims[1] * cells.dims[2]).map(&mut bins).collect()
            };
            let expected = rows(Isa::PLAIN);
            assert!(expected.iter().map(|(_, bins)| bins.len()).sum::<usize>() > 60);
            for isa in Isa::found() {
                // Numbers are written so that no two are alike.
                assert_eq!(format!("{:?}", rows(isa)), format!("{expected:?}"), "{}", isa.name());
            }
        }
    }

    /// Against all points one by one, on balls that bulge towards all sides, beside a sample that is no number, and
    /// within Ω's faces.
    #[test]
    fn rows_and_ranges_leave_nothing_out() {
        let dims = [15, 14, 16];
        for (bulge, hole, factor) in [1.0, -1.0]
            .into_iter()
            .flat_map(|bulge| [false, true].map(|hole| (bulge, hole)))
            .flat_map(|(bulge, hole)| [[1; 3], [3; 3], [1, 3, 4], [16; 3]].map(|factor| (bulge, hole, factor)))
        {
            let ball = field(oblique(dims), |[i, j, k]| {
                let r = (DVec3::new(i as f64, j as f64, k as f64) - DVec3::new(6.3, 7.1, 8.4)).length();
                let here = hole && [i, j, k] == [9, 7, 8];
                if here { f64::NAN } else { 0.5 + bulge * (0.4 - 0.2 * (r - 2.0)) }
            });
            let cells = Cells::new(factor, dims);
            let points = Points::new(&ball, &cells, 0.1);
            let (_, found) = bins(&ball, &cells, 0.1);
            let mut row = Row { parts: vec![[Part::default(); 8]; cells.dims[0]], ..Row::default() };
            let slots = |axis: usize| points.across[axis - 1].iter().flatten();
            for (y, z) in slots(2).flat_map(|z| slots(1).map(move |y| (y, z))) {
                points.add_points([y, z], [0, dims[0]], &mut row);
            }
            for n in 0..8 {
                let expected: f64 = row.parts.iter().map(|parts| parts[n].normal.w).sum();
                let measure: f64 =
                    found.iter().filter(|b| usize::from(b.octant) == n).map(|b| f64::from(b.measure)).sum();
                assert!(expected > 0.0);
                assert!((measure / expected - 1.0).abs() < 1e-5, "{bulge} {hole} {factor:?} {n}: {measure} {expected}");
            }
        }
    }

    /// The mean of |∇h| over noise is the same whatever the cells: points that lie at nodes find it half as large
    /// again.
    #[test]
    fn noise_has_the_same_measure_in_cells_of_any_size() {
        let dims = [24, 22, 26];
        let mut rng = Rng::stream(5, Stage::Test, 0);
        let noise = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |_| 0.4 + 0.2 * rng.unit());
        // ∫ |∇h| dV by 6³ points a cell.
        let mut expected = 0.0;
        let fine = |axis: usize| (0..6 * (dims[axis] - 1)).map(|n| (n as f64 + 0.5) / 6.0);
        for (y, z) in fine(2).flat_map(|z| fine(1).map(move |y| (y, z))) {
            expected += fine(0).map(|x| noise.value_and_gradient(DVec3::new(x, y, z)).1.length()).sum::<f64>() / 216.0;
        }
        for factor in [1, 2, 3, 5, 30] {
            let (_, found) = bins(&noise, &Cells::new([factor; 3], dims), 0.1);
            let measure = found.iter().map(|b| f64::from(b.measure)).sum::<f64>();
            assert!((measure / expected - 1.0).abs() < 0.03, "{factor}: {measure} {expected}");
        }
    }

    /// Waves over a sweep of a thousandth of a voxel's rise: their measure is the area of their surface, and few of the
    /// cells that the surface passes lack a bin, where photons would be lost.
    #[test]
    fn thin_sweeps_have_the_measure_of_their_surface() {
        let lattice = Lattice::aligned([18; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let wave = |[i, j, k]: [usize; 3]| {
            let [i, j, k] = [i, j, k].map(|n| n as f64);
            (0.35 * i).sin() + (0.25 * j + 1.0).cos() + 0.3 * k - 2.0
        };
        for factor in [1, 2, 4] {
            let of = |width: f64| {
                let thin = field(lattice.clone(), |ijk| wave(ijk) / width);
                let (starts, found) = bins(&thin, &Cells::new([factor; 3], [18; 3]), 0.1);
                let passed = starts.windows(2).filter(|w| w[0] < w[1]).count();
                assert!(found.iter().all(|b| (0.0..=1.0).contains(&b.isovalue)));
                let measure = found.iter().map(|b| f64::from(b.measure)).sum::<f64>();
                // Isovalues in a bin differ by all of the sweep.
                let reach = found.iter().map(|b| f64::from(b.measure * b.reach)).sum::<f64>() / measure;
                assert!(width > 0.01 || reach > 0.45, "{factor}, {width}: {reach}");
                (measure, passed as f64)
            };
            let (area, cells) = of(0.03);
            for width in [1e-3, 1e-5] {
                let (measure, passed) = of(width);
                assert!((measure / area - 1.0).abs() < 0.01, "{factor}, {width}: {measure} for {area}");
                assert!(passed > 0.9 * cells, "{factor}, {width}: {passed} cells for {cells}");
            }
        }
    }

    #[test]
    fn slopes_as_large_as_fill_values_have_a_measure() {
        let dims = [9, 9, 9];
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let cells = Cells::new([1; 3], dims);
        // From the fill value down to 1/8 within the last rounding before node 1: all level sets above stand there, 7/8
        // of the sweep on 64 faces, or all of it where h is rounded.
        let filled = field(lattice, |ijk| if ijk[0] == 0 { 1e20 } else { ijk[0] as f64 / 8.0 });
        let measure = |at: f32| -> f64 {
            let (_, found) = bins(&filled, &cells, 0.1);
            let in_layer = |b: &&Bin| (b.centroid.x - 0.5 - at).abs() < 0.3;
            found.iter().filter(in_layer).map(|b| f64::from(b.measure)).sum()
        };
        assert!((59.9..68.1).contains(&measure(1.0)), "{}", measure(1.0));
        assert!((measure(4.0) - 8.0).abs() < 0.01, "{}", measure(4.0));
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
