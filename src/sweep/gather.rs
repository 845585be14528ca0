//! One pass of gather sweeps: a bounce for every node and every isovalue at once, walls included.

use super::arrive;
use super::directions::{Layout, Shear};
use super::flats::{Arrivals, Ends, Flats, Incoming};
use super::grid::{Geometry, NORMAL_SCALE, Planes, transposed, untransposed};
use super::pack::{LANES, Pack, Plan, Way};
use super::simd::Isa;
use crate::flattened::Side;
use crate::scene::Scene;
use glam::DVec3;
use rayon::prelude::*;

/// What every pass of one bake shares.
pub(super) struct Pass<'a> {
    pub scene: &'a Scene,
    pub geometry: &'a Geometry<'a>,
    /// Which polygons stand inside Ω.
    pub inside: &'a [bool],
    /// The side that owns lines without samples.
    pub primary: Side,
    /// The instruction set of the hot loops.
    pub isa: Isa,
}

/// Rows of lines that are in memory at a time. Every node is written once per direction whatever this is.
const BLOCK: usize = 16;

/// The radiance that the samples of one row of lines meet: [±τ and channel][slice][line].
struct RowLight {
    q: isize,
    planes: [Vec<f32>; 6],
    arrivals: Arrivals,
}

impl Pass<'_> {
    /// Irradiance of every node of `side` from the radiance `b` of the nodes and the flats, along all `lines` and both
    /// their directions. Flats receive too. `tick` is asked before every family; false stops with what is done.
    pub(super) fn gather(
        &self,
        side: Side,
        lines: &[Shear],
        b: &Planes,
        flats: &Flats,
        incoming: &mut Incoming,
        tick: &mut dyn FnMut() -> bool,
    ) -> (Planes, bool) {
        let dims = self.geometry.dims;
        let mut e = super::grid::black(b[0].len());
        let split = lines.partition_point(|s| !s.layout.transposed);
        for shear in &lines[..split] {
            if !tick() {
                return (e, false);
            }
            self.family(side, shear, lines.len(), b, &mut e, flats, incoming);
        }
        if split < lines.len() {
            let turn = |p: &Planes| -> Planes { std::array::from_fn(|c| transposed(&p[c], dims)) };
            let b = turn(b);
            e = turn(&e);
            for shear in &lines[split..] {
                if !tick() {
                    return (std::array::from_fn(|c| untransposed(&e[c], dims)), false);
                }
                self.family(side, shear, lines.len(), &b, &mut e, flats, incoming);
            }
            drop(b);
            e = std::array::from_fn(|c| untransposed(&e[c], dims));
        }
        self.normalise(lines, &mut e);
        (e, true)
    }

    /// Divides by the sum of cosines that the directions gave each node's normal, which is π only in the mean: equal
    /// radiance from everywhere gives its irradiance exactly.
    fn normalise(&self, lines: &[Shear], e: &mut Planes) {
        let n = self.geometry.normals(&Layout::new(self.geometry.dims, 2));
        let omega: Vec<[f32; 3]> = lines.iter().map(|s| s.omega.as_vec3().to_array()).collect();
        // Σ|ω·N| · 4π/(2·lines) over N's units, against π.
        let half = 0.5 * lines.len() as f32 * NORMAL_SCALE;
        let [e0, e1, e2] = e;
        (e0.par_chunks_mut(COSINES), e1.par_chunks_mut(COSINES), e2.par_chunks_mut(COSINES))
            .into_par_iter()
            .enumerate()
            .for_each(|(row, (e0, e1, e2))| {
                let mut sum = [0f32; COSINES];
                self.isa.cosines(&omega, n.each_ref().map(|n| &n[row * COSINES..][..e0.len()]), &mut sum);
                for e in [e0, e1, e2] {
                    e.iter_mut().zip(&sum).for_each(|(e, s)| *e *= if *s > 0.0 { half / s } else { 0.0 });
                }
            });
    }

    /// All lines of one family, both ways.
    #[allow(clippy::too_many_arguments, reason = "one caller")]
    fn family(
        &self,
        side: Side,
        shear: &Shear,
        lines: usize,
        b: &Planes,
        e: &mut Planes,
        flats: &Flats,
        incoming: &mut Incoming,
    ) {
        let sign = if side == Side::Lower { 1.0 } else { -1.0 };
        let plan = Plan::new(*shear, sign);
        let ends = Ends::new(self.scene, flats, shear, self.inside);
        let walls = arrive::Walls::new(self, &plan, &ends, flats, side, lines);
        let h = self.geometry.h(&shear.layout);
        let na = shear.layout.dims[2];
        let size = na * plan.width;
        let new_row =
            || RowLight { q: 0, planes: std::array::from_fn(|_| vec![0.0; size]), arrivals: Arrivals::default() };
        let mut rows: Vec<RowLight> = (0..BLOCK + 1).map(|_| new_row()).collect();
        // Rows that meet Ω, one behind them for the last row of nodes, and those that only walls see.
        let first = plan.first[1].min(walls.rows.0);
        let last = (plan.first[1] + plan.count[1] as isize).max(walls.rows.1);
        let strict = side == Side::Higher;
        let isa = self.isa;
        let scale = 4.0 * std::f64::consts::PI / (2 * lines) as f64;
        let omega = (shear.omega * (f64::from(sign) * scale / f64::from(NORMAL_SCALE))).as_vec3().to_array();
        let mut q0 = first;
        while q0 <= last {
            let q1 = (q0 + BLOCK as isize).min(last + 1);
            let count = (q1 - q0).unsigned_abs();
            rows[1..=count].par_iter_mut().enumerate().for_each_init(
                || Pack::new(na, flats),
                |pack, (n, row)| {
                    row.q = q0 + n as isize;
                    row.arrivals = Arrivals::default();
                    let within = row.q >= plan.first[1] && row.q < plan.first[1] + plan.count[1] as isize;
                    for start in (0..plan.width).step_by(LANES).filter(|_| within) {
                        let p = plan.first[0] + start as isize;
                        if !isa.read(pack, &plan, h, b, p, row.q) {
                            continue;
                        }
                        isa.end(pack, &plan, &ends, flats, p, row.q);
                        let (plus, minus) = row.planes.split_at_mut(3);
                        for (forward, out) in [(true, plus), (false, minus)] {
                            isa.scan(pack, Way { forward, strict, sign }, out, (plan.width, start));
                        }
                        walls.through(pack, p, row.q, &mut row.arrivals);
                    }
                    walls.past(row.q, within, &mut row.arrivals);
                },
            );
            self.accumulate(&plan, omega, &rows[..=count], (q0, q1), e);
            let arrivals: Vec<Arrivals> = rows[1..=count].iter_mut().map(|r| std::mem::take(&mut r.arrivals)).collect();
            incoming.receive(&arrivals);
            rows.swap(0, count);
            q0 = q1;
        }
    }

    /// Adds what rows q0..q1 of lines (and the one before) brought to the nodes between them: each node takes its four
    /// nearest lines by bilinear weights, normalised at Ω's faces, times the cosine of its own normal.
    fn accumulate(&self, plan: &Plan, omega: [f32; 3], rows: &[RowLight], (q0, q1): (isize, isize), e: &mut Planes) {
        let layout = &plan.shear.layout;
        let [nu, nv, na] = layout.dims;
        let outer_is_slice = layout.slices_outermost();
        let inner = if outer_is_slice { nv } else { na };
        let normals = self.geometry.normals(layout);
        let chunk = nu * inner;
        let [e0, e1, e2] = e;
        (e0.par_chunks_mut(chunk), e1.par_chunks_mut(chunk), e2.par_chunks_mut(chunk))
            .into_par_iter()
            .enumerate()
            .for_each(|(outer, (e0, e1, e2))| {
                for m in 0..inner {
                    let (k, j) = if outer_is_slice { (outer, m) } else { (m, outer) };
                    let q = j as isize - plan.shift[1][k].0;
                    if q < q0 || q >= q1 {
                        continue;
                    }
                    let fv = plan.shift[1][k].1;
                    let this = (q - q0 + 1).unsigned_abs();
                    // Lines beyond Ω's faces do not exist: their neighbour counts alone.
                    let (near, far, fv) = match j {
                        0 => (this, this, 0.0),
                        j if j == nv - 1 => (this - 1, this - 1, 0.0),
                        _ => (this, this - 1, fv),
                    };
                    let (whole, fu) = plan.shift[0][k];
                    let line0 = (-whole - plan.first[0]).unsigned_abs();
                    let light: [[&[f32]; 6]; 2] = [near, far]
                        .map(|r| std::array::from_fn(|c| &rows[r].planes[c][k * plan.width..][..plan.width]));
                    let at = m * nu..(m + 1) * nu;
                    let n = [0, 1, 2].map(|a| &normals[a][outer * chunk..][at.clone()]);
                    let e = [&mut e0[at.clone()], &mut e1[at.clone()], &mut e2[at.clone()]];
                    self.isa.accumulate(e, n, omega, light, line0, fu, fv);
                }
            });
    }
}

/// One row of nodes. `line0` is the line (in `light`) just beyond node 0, −1 of which is missing.
#[inline(always)]
pub(super) fn accumulate_row(
    e: [&mut [f32]; 3],
    n: [&[i16]; 3],
    omega: [f32; 3],
    light: [[&[f32]; 6]; 2],
    line0: usize,
    fu: f32,
    fv: f32,
) {
    let nu = n[0].len();
    let cosine =
        |i: usize| omega[0] * f32::from(n[0][i]) + omega[1] * f32::from(n[1][i]) + omega[2] * f32::from(n[2][i]);
    // Ω's faces: one column of lines.
    for (i, line) in [(0, line0), (nu - 1, line0 + nu - 2)] {
        let cos = cosine(i);
        let way = if cos > 0.0 { 0 } else { 3 };
        for c in 0..3 {
            let (near, far) = (light[0][way + c][line], light[1][way + c][line]);
            e[c][i] += cos.abs() * ((1.0 - fv) * near + fv * far);
        }
    }
    if nu < 3 {
        return;
    }
    let inner = nu - 2;
    let w = [(1.0 - fv) * (1.0 - fu), (1.0 - fv) * fu, fv * (1.0 - fu), fv * fu];
    let n = n.map(|n| &n[1..][..inner]);
    for c in 0..3 {
        let lines = |row: usize, way: usize, before: usize| &light[row][way + c][line0 + 1 - before..][..inner];
        let plus = [lines(0, 0, 0), lines(0, 0, 1), lines(1, 0, 0), lines(1, 0, 1)];
        let minus = [lines(0, 3, 0), lines(0, 3, 1), lines(1, 3, 0), lines(1, 3, 1)];
        let e = &mut e[c][1..][..inner];
        for i in 0..inner {
            let cos = omega[0] * f32::from(n[0][i]) + omega[1] * f32::from(n[1][i]) + omega[2] * f32::from(n[2][i]);
            let a = (w[0] * plus[0][i] + w[1] * plus[1][i]) + (w[2] * plus[2][i] + w[3] * plus[3][i]);
            let b = (w[0] * minus[0][i] + w[1] * minus[1][i]) + (w[2] * minus[2][i] + w[3] * minus[3][i]);
            e[i] += cos.max(0.0) * a + (-cos).max(0.0) * b;
        }
    }
}

/// Nodes whose cosines are summed at a time.
pub(super) const COSINES: usize = 256;

/// Σ|ω·N| over directions, of up to [`COSINES`] nodes with normals `n`.
#[inline(always)]
pub(super) fn sum_cosines(omega: &[[f32; 3]], n: [&[i16]; 3], sum: &mut [f32; COSINES]) {
    let mut normal = [[0f32; COSINES]; 3];
    for (to, from) in normal.iter_mut().zip(n) {
        to.iter_mut().zip(from).for_each(|(o, &x)| *o = f32::from(x));
    }
    for w in omega {
        for i in 0..COSINES {
            sum[i] += (w[0] * normal[0][i] + w[1] * normal[1][i] + w[2] * normal[2][i]).abs();
        }
    }
}

/// World bounds in the local frame.
pub(super) fn local_bounds(scene: &Scene) -> [DVec3; 2] {
    let mut bounds = [DVec3::ZERO, scene.lattice().far()];
    for &x in scene.polygons().iter().flat_map(|p| p.vertices()) {
        let p = scene.lattice().to_index(x);
        bounds = [bounds[0].min(p), bounds[1].max(p)];
    }
    bounds
}
