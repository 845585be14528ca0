//! One pass of gather sweeps: a bounce for every node and every isovalue at once, walls included.

use super::accumulate::{Lines, cosine};
use super::arrive;
use super::directions::{Layout, Shear};
use super::ends::{LineEnds, Standing};
use super::faces::{FaceWallLight, FaceWalls, RowEnds, Sides, inwards, note, on_side};
use super::flats::Flats;
use super::gaps::FourLines;
use super::grid::{Geometry, Source};
use super::half::Half4;
use super::incoming::{Arrivals, Incoming};
use super::lit_rows::LitRows;
use super::normals::decode;
use super::pack::{LANES, Pack, Plan};
use super::planes::{PlanePool, Planes};
use super::reflect::Reflected;
use super::scan::{Light, ScanRule};
use super::simd::prefetch;
use super::work_queue::WorkQueue;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::scene::Scene;
use crate::volume::Lattice;
use rayon::prelude::*;
use std::sync::{Mutex, MutexGuard};

/// What every pass of one bake shares.
pub(super) struct Pass<'a> {
    pub scene: &'a Scene,
    pub geometry: &'a Geometry<'a>,
    /// Where polygons stand, and what Ω's faces touch.
    pub standing: &'a [Standing],
    pub face_walls: FaceWalls<'a>,
    /// The sides that receive; the first owns lines without samples.
    pub sides: &'a [Side],
    /// The instruction set of the hot loops.
    pub isa: Isa,
    /// Memory to use again.
    pub pool: &'a PlanePool,
    pub workspaces: Mutex<Vec<Workspace>>,
}

/// The radiance that the samples of a row of lines meet: [channel][slice][line].
type RowLight = [Vec<f32>; 3];

/// Lines of a row without a sample, a bit each: [slice][pack]. Empty where all samples are finite.
type RowGaps = Vec<u16>;

/// The irradiance of a row's run of nodes, a slice per channel.
type Row<'a> = [&'a mut [f32]; 3];

/// Rows of nodes in memory, each of which one row of lines of a family adds to.
type Rows<'a> = Vec<Mutex<Row<'a>>>;

/// What a row of lines brings.
#[derive(Default)]
struct LineRow {
    light: RowLight,
    gaps: RowGaps,
    ends: RowEnds,
}

/// What a thread needs beside its rows.
pub(super) struct Workspace {
    pack: Pack,
    /// A row of lines and the one before it, by turns.
    lines: [LineRow; 2],
    /// Slice and place along v of the rows of nodes beside a row of lines.
    nodes: Vec<[usize; 2]>,
}

/// The light of a bounce, and the families of lines that bring it.
pub(super) struct Bounce<'a> {
    /// Each goes both ways.
    pub lines: &'a [Shear],
    /// As [`Sides::extrapolates`].
    pub extrapolates: bool,
    /// What nodes reflect.
    pub light: &'a Reflected,
    /// What flats reflect; they receive too.
    pub flats: &'a Flats,
}

/// What the families of one order of memory share that bring light to one side.
struct Receivers<'a> {
    side: Side,
    /// What this side's nodes reflect.
    b: &'a [Half4],
    /// What the other side's do; nothing if that is dark.
    back: &'a [Half4],
    normals: &'a [u32],
    wall_light: &'a FaceWallLight<'a>,
    rows: Rows<'a>,
}

/// What one family of lines reads.
struct Family<'a> {
    plan: &'a Plan,
    source: Source<'a>,
    /// B of the other side; nothing if that is dark.
    back: &'a [Half4],
    /// In the memory order of its lines.
    normals: &'a [u32],
    ends: &'a LineEnds,
    flats: &'a Flats,
    wall_light: &'a FaceWallLight<'a>,
    walls: arrive::Walls<'a>,
    rule: ScanRule,
    /// As [`Sides::extrapolates`].
    extrapolates: bool,
    /// The direction times what |ω·N| weighs.
    omega: [f32; 3],
}

impl Family<'_> {
    fn light(&self) -> Light<'_> {
        let across = self.flats.across().cast_signed();
        Light {
            b: self.source.b,
            back: self.back,
            flats: &self.flats.packed,
            isovalues: self.flats.isovalues,
            axis: &self.flats.axis,
            across: if self.rule.strict { -across } else { across },
        }
    }
}

/// Bytes of what a thread needs beside its rows, at most: lines are as steep as one cell a slice.
pub(crate) fn workspace(lattice: &Lattice) -> u64 {
    let bytes = |axis: usize| {
        let [nu, _, na] = Layout::new(lattice.dims(), axis).dims.map(|n| n as u64);
        // Three channels of two rows.
        (6 * size_of::<f32>() as u64).saturating_mul(na).saturating_mul(nu + na)
    };
    (0..3).map(bytes).max().unwrap_or(0)
}

impl Pass<'_> {
    /// Irradiance of every node of side `n` of [`Pass::sides`] by a bounce; the flats' is added to `incoming`. `tick`
    /// is asked before every family; `None` if it stopped the work.
    pub(super) fn gather(
        &self,
        bounce: &Bounce,
        n: usize,
        incoming: &mut Incoming,
        tick: &mut dyn FnMut() -> bool,
    ) -> Option<Planes> {
        let side = self.sides[n];
        // Vector kernels read it without looking.
        let nodes = self.geometry.dims.iter().product::<usize>();
        assert!(
            bounce.light.b.len() == self.sides.len() && bounce.light.b.iter().all(|b| b.len() == nodes),
            "light of all sides and nodes"
        );
        let of = |n: usize| bounce.light.b.get(n).map_or(&[][..], |b| &b[..]);
        let lines = bounce.lines;
        let mut e = self.pool.black(self.geometry.places());
        let wall_light = self.face_walls.now(self.geometry, bounce.flats, side);
        let split = lines.partition_point(|s| !s.layout.transposed);
        // Walls receive what one family brought while the next is under way.
        let mut arrivals = Vec::new();
        // Darkness is the same in both orders.
        for (transposed, some) in [(true, &lines[split..]), (false, &lines[..split])] {
            let Some(any) = some.first() else { continue };
            let turned = transposed.then(|| self.geometry.transposed_normals(self.pool));
            let receivers = Receivers {
                side,
                b: of(n),
                back: of(1 - n),
                normals: turned.as_ref().unwrap_or(&self.geometry.normals),
                wall_light: &wall_light,
                rows: node_rows(&mut e, &self.geometry.order(&any.layout).lit_rows),
            };
            for shear in some {
                if !tick() {
                    return None;
                }
                arrivals = self.family(bounce, &receivers, shear, incoming, arrivals);
            }
            drop(receivers);
            if let Some(turned) = turned {
                self.pool.keep_numbers(turned);
                e = self.geometry.untransposed(e, self.pool);
            }
        }
        incoming.receive(self.isa, &arrivals);
        self.normalise(lines, &mut e);
        Some(e)
    }

    /// Divides by the sum of cosines that the directions gave each node's normal, which is π only in the mean: equal
    /// radiance from everywhere gives its irradiance exactly.
    fn normalise(&self, lines: &[Shear], e: &mut Planes) {
        let omega: Vec<[f32; 3]> = lines.iter().map(|s| s.omega.as_vec3().to_array()).collect();
        // Σ|ω·N| · 4π/(2·lines) against π; N's length falls out.
        let half = 0.5 * lines.len() as f32;
        let [e0, e1, e2] = e.each_mut().map(|e| &mut e[..self.geometry.normals.len()]);
        (e0.par_chunks_mut(COSINES), e1.par_chunks_mut(COSINES), e2.par_chunks_mut(COSINES))
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (e0, e1, e2))| {
                let normals = &self.geometry.normals[chunk * COSINES..][..e0.len()];
                if normals.iter().all(|n| *n == 0) {
                    return;
                }
                let mut sum = [0f32; COSINES];
                self.isa.cosines(&omega, normals, &mut sum);
                // What goes on linearly beyond the last lines may fall below 0.
                for e in [e0, e1, e2] {
                    let scaled = |(e, s): (&mut f32, &f32)| *e = if *s > 0.0 { (*e * half / s).max(0.0) } else { 0.0 };
                    e.iter_mut().zip(&sum).for_each(scaled);
                }
            });
    }

    /// All lines of one family, both ways. `before` is what the last family brought to walls; returns what this one
    /// does.
    fn family(
        &self,
        bounce: &Bounce,
        receivers: &Receivers,
        shear: &Shear,
        incoming: &mut Incoming,
        before: Vec<Arrivals>,
    ) -> Vec<Arrivals> {
        let (flats, side, lines, scale) = (bounce.flats, receivers.side, bounce.lines.len(), bounce.light.unit);
        let sign = if side == Side::Lower { 1.0 } else { -1.0 };
        let plan = Plan::new(*shear, sign);
        let ends = LineEnds::new(self.scene, (flats, side), shear, self.standing);
        let walls = arrive::Walls::new(self, bounce, side, &plan, &ends);
        let share = 4.0 * std::f64::consts::PI / (2 * lines) as f64 / f64::from(scale);
        let family = Family {
            plan: &plan,
            source: self.geometry.source(&shear.layout, side, receivers.b),
            back: receivers.back,
            normals: receivers.normals,
            ends: &ends,
            flats,
            wall_light: receivers.wall_light,
            rule: ScanRule { strict: side == Side::Higher, sign, capped: self.scene.is_capped() },
            extrapolates: bounce.extrapolates,
            omega: (shear.omega * share).as_vec3().to_array(),
            walls,
        };
        // Rows that meet Ω, one behind them for the last row of nodes, and those that only walls see.
        let near = (plan.first[1], plan.first[1] + plan.count[1] as isize);
        let [below, above] = family.walls.rows_beside(near);
        let lines: Vec<isize> = below.into_iter().chain(near.0..=near.1).chain(above).collect();
        let arrivals: Vec<Mutex<Arrivals>> = lines.iter().map(|_| Mutex::default()).collect();
        let threads = rayon::current_num_threads();
        let queue = WorkQueue::new(lines.len(), threads);
        let shares = || {
            let share = |own| self.rows_of_lines(&family, (&lines, &arrivals), &receivers.rows, (&queue, own));
            (0..threads).into_par_iter().with_max_len(1).for_each(share);
        };
        rayon::join(shares, || incoming.receive(self.isa, &before));
        arrivals.into_iter().map(|a| a.into_inner().expect("no thread panics")).collect()
    }

    /// Slice and place along v of the rows of lit nodes between row `q` of lines and the one before.
    fn nodes(&self, plan: &Plan, q: isize, out: &mut Vec<[usize; 2]>) {
        let layout = &plan.shear.layout;
        let [nu, nv, na] = layout.dims;
        let lit = &self.geometry.order(layout).lit_blocks.rows;
        out.clear();
        for (k, (whole, _)) in plan.shift[1][..na].iter().enumerate() {
            let cell = q + whole;
            let beside = (cell - 1..=cell + 1).filter_map(|j| usize::try_from(j).ok()).filter(|j| *j < nv);
            let own = beside.filter(|&j| j as isize + inwards(j, nv) == cell);
            let lit = own.filter(|&j| lit[(k * layout.stride[1] + j * layout.stride[0]) / nu] != 0);
            out.extend(lit.map(|j| [k, j]));
        }
    }

    /// Those of the rows `lines` that thread `own` gets: their light to the nodes between each and the one before, and
    /// to walls. Only for a row that does not follow the thread's last one the one before is walked through again.
    fn rows_of_lines(
        &self,
        family: &Family,
        (lines, arrivals): (&[isize], &[Mutex<Arrivals>]),
        rows: &Rows,
        (queue, own): (&WorkQueue, usize),
    ) {
        let plan = family.plan;
        let size = plan.shear.layout.dims[2] * plan.width;
        let spare = self.workspaces.lock().expect("no thread panics").pop();
        let empty = || Workspace { pack: Pack::with_rows(0), lines: Default::default(), nodes: Vec::new() };
        let mut work = spare.unwrap_or_else(empty);
        work.pack.fit(plan.shear.layout.dims[2]);
        let packs = if family.source.gaps { size / LANES } else { 0 };
        for row in &mut work.lines {
            row.light.iter_mut().for_each(|l| l.resize(size, 0.0));
            row.ends.iter_mut().for_each(|ends| ends.resize(plan.width, 0));
            row.gaps.resize(packs, 0);
        }
        let mut walked = None;
        while let Some(n) = queue.next(own) {
            let q = lines[n];
            let mut nodes = std::mem::take(&mut work.nodes);
            self.nodes(plan, q, &mut nodes);
            let follows = walked == Some(q - 1);
            if !follows && !nodes.is_empty() {
                self.row_of_lines(family, q - 1, &mut work, 1 - n % 2, None);
            }
            let mut arrivals = arrivals[n].lock().expect("no thread panics");
            self.row_of_lines(family, q, &mut work, n % 2, Some(&mut arrivals));
            let around = [&work.lines[n % 2], &work.lines[1 - n % 2]];
            let mut coming = nodes.first().map(|&at| self.ask(family, rows, at));
            for (i, &at) in nodes.iter().enumerate() {
                let next = nodes.get(i + 1).map(|&at| self.ask(family, rows, at));
                let row = std::mem::replace(&mut coming, next);
                self.accumulate(family, around, &mut row.expect("asked for before"), at);
            }
            work.nodes = nodes;
            walked = Some(q);
        }
        self.workspaces.lock().expect("no thread panics").push(work);
    }

    /// Light along one row of lines.
    fn row_of_lines(
        &self,
        family: &Family,
        q: isize,
        work: &mut Workspace,
        which: usize,
        mut arrivals: Option<&mut Arrivals>,
    ) {
        let plan = family.plan;
        let (pack, row) = (&mut work.pack, &mut work.lines[which]);
        let within = q >= plan.first[1] && q < plan.first[1] + plan.count[1] as isize;
        if within {
            pack.begin(plan, &family.source, q);
        }
        for start in (0..plan.width).step_by(LANES).filter(|_| within) {
            let p = plan.first[0] + start as isize;
            if self.isa.read(pack, plan, &family.source, p, q) {
                self.isa.end(pack, plan, family.ends, family.flats, p, q);
                if family.rule.capped && family.rule.strict {
                    pack.lasts = [[0; LANES]; 2];
                }
                note(pack, &mut row.ends, start);
                let light = family.light();
                let place = (plan.width, start);
                self.isa.scan(pack, family.rule, light, &mut row.light, place);
                if family.source.gaps {
                    self.isa.look_through_gaps(pack, family.rule, light, &mut row.light, &mut row.gaps, place);
                }
            }
            if let Some(arrivals) = &mut arrivals {
                self.isa.report(&family.walls, pack, [family.source.b, family.back], p, q, arrivals);
            }
        }
        if let Some(arrivals) = arrivals {
            family.walls.past(q, within, arrivals);
        }
    }

    /// A row of nodes, which memory is asked for with what else [`Self::accumulate`] reads. It may be held beside the
    /// one before: no other row of lines adds to either.
    fn ask<'r, 'e>(&self, family: &Family, rows: &'r Rows<'e>, [k, j]: [usize; 2]) -> MutexGuard<'r, Row<'e>> {
        let layout = &family.plan.shear.layout;
        let at = k * layout.stride[1] + j * layout.stride[0];
        let nu = layout.dims[0];
        let row = rows[at / nu].lock().expect("no thread panics");
        row.iter().for_each(|e| prefetch(e));
        prefetch(&family.normals[self.geometry.order(layout).lit_rows.run(at / nu).1]);
        row
    }

    /// Adds what a row of lines and the one before it brought to a row of nodes: each node takes its four nearest lines
    /// by bilinear weights, which go on linearly on Ω's faces ([`inwards`]), times the cosine of its own normal.
    fn accumulate(&self, family: &Family, around: [&LineRow; 2], row: &mut Row, [k, j]: [usize; 2]) {
        let plan = family.plan;
        let layout = &plan.shear.layout;
        let [nu, nv, _] = layout.dims;
        let fv = plan.shift[1][k].1 + inwards(j, nv) as f32;
        // Of a single row of lines, all.
        let fv = if nv > 2 { fv } else { j as f32 };
        let (whole, fu) = plan.shift[0][k];
        let line0 = (-whole - plan.first[0]).unsigned_abs();
        let light: [[&[f32]; 3]; 2] =
            around.map(|lines| std::array::from_fn(|c| &lines.light[c][k * plan.width..][..plan.width]));
        let at = k * layout.stride[1] + j * layout.stride[0];
        // Normals and light of the row's run, from its first node on.
        let order = self.geometry.order(layout);
        let (first, run) = order.lit_rows.run(at / nu);
        let n = &family.normals[run];
        let gaps = around.map(|lines| lines.gaps.get(k * plan.width / LANES..).unwrap_or_default());
        let (lit, rims) = (&order.lit_blocks, order.rims.as_ref());
        let [e0, e1, e2] = row;
        let sides = Sides {
            layout: *layout,
            row: [j, k],
            slope: plan.shear.slope,
            light,
            ends: around.map(|lines| &lines.ends),
            line0,
            weights: [fu, fv],
            extrapolates: family.extrapolates,
            stands: family.light(),
            wall_light: family.wall_light,
        };
        let h = &order.h[at..][..nu];
        let lines = Lines { rows: light, first: line0 + first, shift: [fu, fv], omega: family.omega };
        let mut bits = lit.rows[at / nu];
        while bits != 0 {
            // Runs of lit blocks.
            let a = bits.trailing_zeros() as usize;
            let run = (!(bits >> a)).trailing_zeros() as usize;
            bits = if a + run >= 64 { 0 } else { bits >> (a + run) << (a + run) };
            let (a, b) = (a * lit.size, ((a + run) * lit.size).min(nu));
            let mut some = |a: usize, b: usize| {
                let mut single = |i: usize| {
                    let [x, y, z] = decode(n[i - first]);
                    let cos = family.omega[0] * x + family.omega[1] * y + family.omega[2] * z;
                    let light = sides.radiance(i, h[i], (cos > 0.0) != family.rule.strict);
                    let e = [&mut e0[i - first], &mut e1[i - first], &mut e2[i - first]];
                    e.into_iter().zip(light).for_each(|(e, light)| *e += cos.abs() * light);
                };
                if on_side(j, nv) {
                    (a..b).for_each(single);
                    return;
                }
                let ends = [0, nu - 1].into_iter().filter(|i| (a..b).contains(i));
                ends.for_each(&mut single);
                let (a, b) = (a.max(1), b.min(nu - 1));
                if a < b {
                    let e = &mut [&mut e0[..], &mut e1[..], &mut e2[..]];
                    self.isa.accumulate(&lines, n, e, (a - first, b - first));
                }
            };
            let mut from = a;
            for &i in rims.map_or(&[][..], |rims| rims.within(at / nu, a, b)) {
                let i = i as usize;
                some(from, i);
                from = i + 1;
            }
            some(from, b);
        }
        for &i in rims.map_or(&[][..], |rims| rims.within(at / nu, 0, nu)) {
            let i = i as usize;
            let cos = cosine(family.omega, n[i - first]);
            let lines = FourLines::new((i, nu), line0, [fu, fv], family.extrapolates);
            for (c, e) in [&mut e0[..], &mut e1[..], &mut e2[..]].into_iter().enumerate() {
                e[i - first] += cos * lines.mean([light[0][c], light[1][c]], gaps);
            }
        }
    }
}

/// Planes by rows of nodes.
fn node_rows<'e>([e0, e1, e2]: &'e mut Planes, lit: &LitRows) -> Rows<'e> {
    let [e0, e1, e2] = [e0, e1, e2].map(|e| lit.split(e, 1));
    e0.into_iter().zip(e1).zip(e2).map(|((e0, e1), e2)| Mutex::new([e0, e1, e2])).collect()
}

/// Nodes whose cosines are summed at a time.
pub(super) const COSINES: usize = 256;

/// Σ|ω·N| over directions, of up to [`COSINES`] nodes with normals `n`.
#[inline(always)]
pub(super) fn sum_cosines(omega: &[[f32; 3]], n: &[u32], sum: &mut [f32; COSINES]) {
    let mut normal = [[0f32; COSINES]; 3];
    for i in 0..n.len() {
        let [x, y, z] = decode(n[i]);
        (normal[0][i], normal[1][i], normal[2][i]) = (x, y, z);
    }
    for w in omega {
        for i in 0..COSINES {
            sum[i] += (w[0] * normal[0][i] + w[1] * normal[1][i] + w[2] * normal[2][i]).abs();
        }
    }
}
