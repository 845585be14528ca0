//! The measure ∫|∇h| dV of level sets in the cells of a grid, by the octants that they face: what photons' power is
//! divided by.
//!
//! One point stands for each eighth of a voxel, or in cells of many voxels for each voxel. Points of a row share their
//! place along y and z, so that a row of the lattice is interpolated across once, and then along x.

#[cfg(test)]
mod tests;

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
