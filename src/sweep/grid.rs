//! The lattice's share of the sweep: h and normals as lines read them, which nodes are lit, and the filling of those
//! without a surface.

use super::blocks::Blocks;
use super::directions::Layout;
use super::gaps::Rims;
use super::half::{Half4, decode, encode};
use super::lit_rows::{LitRows, transpose, untranspose};
use super::normals;
use super::pack::LANES;
use super::planes::{PlanePool, Planes, transposed};
use crate::field::{Field, FieldRows, GradientRow};
use crate::flattened::Side;
use crate::mask::{lights_itself, may_light_itself};
use crate::neighbourhood::neighbourhood;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::borrow::Cow;

/// What there is of nodes in one memory order.
pub(super) struct Order<'a> {
    pub h: Cow<'a, [f32]>,
    /// The blocks of lit nodes, and where planes keep their light.
    pub lit_blocks: Blocks,
    pub lit_rows: LitRows,
    /// The lit nodes beside samples that are not finite; `None` if all are.
    pub rims: Option<Rims>,
    /// Per side, the blocks of nodes within one node of those that reach the sweep.
    pub awake: [Blocks; 2],
}

/// What every pass reads: h in both memory orders, and the receiver normals towards the lower side.
///
/// Nodes are *lit* that hold a surface of the sweep, and those just outside the sweep, whose own light is a better
/// neighbour to interpolate with than a copy.
pub(super) struct Geometry<'a> {
    pub dims: [usize; 3],
    pub h: &'a [f32],
    /// Of lit nodes, as planes of light keep them; the others have none.
    pub normals: Vec<u32>,
    rings: Vec<Vec<u32>>,
    /// Whether a row along x holds nodes of `rings`.
    ringed: Vec<bool>,
    /// x, y, z and y, z, x.
    orders: [Order<'a>; 2],
}

/// What lines read: h in one memory order, and B.
pub(super) struct Source<'a> {
    pub h: &'a [f32],
    pub b: &'a [Half4],
    awake: &'a Blocks,
    /// Whether some samples are not finite.
    pub gaps: bool,
    /// Rows of nodes from one v or slice to the next.
    step: [usize; 2],
}

impl Source<'_> {
    /// The blocks of rows j and j + 1 in slice k that may reach the sweep.
    #[inline(always)]
    pub(super) fn awake(&self, k: usize, j: usize) -> u64 {
        let row = j * self.step[0] + k * self.step[1];
        self.awake.rows[row] | self.awake.rows[row + self.step[0]]
    }

    /// Whether a block of `bits` holds one of nodes from..to.
    #[inline(always)]
    pub(super) fn meets(&self, bits: u64, from: usize, to: usize) -> bool {
        self.awake.meets(bits, from, to)
    }
}

impl<'a> Geometry<'a> {
    pub(super) fn new(field: &'a Field) -> Self {
        let (dims, h) = (field.lattice().dims(), field.samples());
        let mut normals = vec![0; h.len()];
        let [nx, ny, nz] = dims;
        let rows = FieldRows::new(field, field.lattice());
        let each = normals.par_chunks_exact_mut(nx).zip(h.par_chunks_exact(nx)).enumerate().with_min_len(16);
        each.for_each_init(GradientRow::default, |gradients, (row, (normals, h))| {
            let wanted = |h: f32| may_light_itself(f64::from(h));
            if !h.iter().any(|h| wanted(*h)) {
                return;
            }
            let nodes = normals.iter_mut().zip(h).zip(rows.gradients(row % ny, row / ny, gradients));
            nodes.filter(|((_, h), _)| wanted(**h)).for_each(|((normal, _), g)| *normal = normals::encode(-*g));
        });
        let on_surface = |at: usize| (0.0..=1.0).contains(&h[at]) && normals[at] != 0 && field.is_in_whole_cell(at);
        let mut lit: Vec<bool> = (0..h.len()).into_par_iter().with_min_len(1 << 14).map(on_surface).collect();
        let near = |at: &u32| normals[*at as usize] != 0 && lights_itself(field, field.lattice(), *at as usize);
        let near: Vec<u32> = ring(dims, &lit).into_par_iter().with_min_len(256).filter(near).collect();
        near.into_iter().for_each(|at| lit[at as usize] = true);
        let rings = rings(dims, &lit);
        let mut ringed = vec![false; ny * nz];
        rings.iter().flatten().for_each(|&at| ringed[at as usize / nx] = true);
        let rims = field.has_gaps().then(|| Rims::both(dims, h, |at| lit[at]));
        let turned = transposed(h, dims);
        let (lit_blocks, lit_rows) = lit_rows(dims, &lit);
        // Nodes that are not lit take no light whatever lines bring.
        let mut kept = vec![0; lit_rows[0].len()];
        lit_rows[0].for_each_run(&mut kept, |first, run| {
            let nodes = normals[first..].iter().zip(&lit[first..]);
            run.iter_mut().zip(nodes).filter(|(_, (_, lit))| **lit).for_each(|(kept, (n, _))| *kept = *n);
        });
        drop(normals);
        let fine = |n: usize| (n.div_ceil(64), 1);
        let reaches = |side| move |at: usize| if side == Side::Lower { !(h[at] < 0.0) } else { !(h[at] > 1.0) };
        let along = Side::BOTH.map(|side| Blocks::along(nx, ny * nz, fine(nx), reaches(side)).joined(ny));
        let across = Side::BOTH.map(|side| Blocks::across(dims, fine(ny), reaches(side)).joined(nz));
        let ([blocks, turned_blocks], [rows, turned_rows]) = (lit_blocks, lit_rows);
        let [rims, turned_rims] = rims.map_or([None, None], |both| both.map(Some));
        let orders = [
            Order { h: Cow::Borrowed(h), lit_blocks: blocks, lit_rows: rows, rims, awake: along },
            Order {
                h: Cow::Owned(turned),
                lit_blocks: turned_blocks,
                lit_rows: turned_rows,
                rims: turned_rims,
                awake: across,
            },
        ];
        Self { dims, h, normals: kept, rings, ringed, orders }
    }

    /// What there is in the memory order of `layout`.
    #[inline(always)]
    pub(super) fn order(&self, layout: &Layout) -> &Order<'a> {
        &self.orders[usize::from(layout.transposed)]
    }

    /// Whether a node is lit.
    #[inline(always)]
    pub(super) fn lit(&self, at: usize) -> bool {
        self.packed_normal(at) != 0
    }

    #[inline(always)]
    fn packed_normal(&self, at: usize) -> u32 {
        self.lit_rows().place_of(at).map_or(0, |place| self.normals[place])
    }

    /// Whether nodes of a row along x may hold what is reflected: lit ones, or some that [`Self::fill`] fills.
    pub(super) fn shows(&self, row: usize) -> bool {
        self.ringed[row] || !self.lit_rows().run(row).1.is_empty()
    }

    /// Numbers of a plane of light, in either memory order.
    pub(super) fn places(&self) -> usize {
        let [rows, turned] = self.orders.each_ref().map(|order| order.lit_rows.len());
        rows.max(turned)
    }

    /// Where planes in x, y, z order keep what.
    pub(super) fn lit_rows(&self) -> &LitRows {
        &self.orders[0].lit_rows
    }

    /// The same, for those who need nothing else.
    pub(super) fn into_lit_rows(self) -> LitRows {
        let [order, _] = self.orders;
        order.lit_rows
    }

    /// Whether a node holds a surface of the sweep.
    #[inline(always)]
    pub(super) fn valid(&self, at: usize) -> bool {
        self.lit(at) && (0.0..=1.0).contains(&self.h[at])
    }

    /// [`Self::lit`] of all nodes.
    pub(super) fn all_lit(&self) -> Vec<bool> {
        let mut lit = vec![false; self.h.len()];
        let nx = self.dims[0];
        lit.par_chunks_exact_mut(nx).enumerate().with_min_len(64).for_each(|(row, lit)| {
            let (first, run) = self.lit_rows().run(row);
            lit[first..].iter_mut().zip(&self.normals[run]).for_each(|(lit, n)| *lit = *n != 0);
        });
        lit
    }

    /// The normals in y, z, x order.
    pub(super) fn transposed_normals(&self, pool: &PlanePool) -> Vec<u32> {
        let mut to = pool.numbers(self.places());
        let [rows, turned] = self.orders.each_ref().map(|order| &order.lit_rows);
        transpose([rows, turned], self.dims, &self.normals, &mut to);
        to
    }

    /// What lines of `side` read.
    pub(super) fn source<'s>(&'s self, layout: &Layout, side: Side, b: &'s [Half4]) -> Source<'s> {
        let (nu, order) = (layout.dims[0], self.order(layout));
        let step = layout.stride.map(|s| s / nu);
        Source { h: &order.h, b, awake: &order.awake[side.index()], gaps: self.has_gaps(), step }
    }

    /// Whether h may reach the sweep from below in the cell of a place in Ω.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    pub(super) fn reaches(&self, place: DVec3) -> bool {
        let [i, j, k] = [0, 1, 2].map(|a| (place[a] as usize).min(self.dims[a] - 1));
        let blocks = &self.orders[0].awake[Side::Lower.index()];
        blocks.meets(blocks.rows[k * self.dims[1] + j], i, i + 1)
    }

    /// The nodes of row `row` along x within one of those that may reach the sweep from below, from first to behind
    /// last.
    pub(super) fn reaching(&self, row: usize) -> impl Iterator<Item = (usize, usize)> {
        self.orders[0].awake[Side::Lower.index()].each(row, self.dims[0])
    }

    /// Light of the lit nodes from y, z, x order back to x, y, z; the others are black.
    pub(super) fn untransposed(&self, planes: Planes, pool: &PlanePool) -> Planes {
        let ([rows, turned], [_, ny, nz]) = (self.orders.each_ref().map(|order| &order.lit_rows), self.dims);
        planes.map(|from| {
            let mut to = pool.plane(from.len());
            untranspose([turned, rows], [ny, nz], &from, &mut to);
            pool.keep([from]);
            to
        })
    }

    /// Calls `visit` with the lit nodes of a row along x.
    #[inline(always)]
    pub(super) fn lit_nodes(&self, row: usize, mut visit: impl FnMut(usize)) {
        let (first, run) = self.lit_rows().run(row);
        let normals = &self.normals[run];
        for (a, b) in self.orders[0].lit_blocks.each(row, self.dims[0]) {
            let nodes = normals[a - first..b - first].iter().zip(a..b);
            nodes.filter(|(normal, _)| **normal != 0).for_each(|(_, i)| visit(i));
        }
    }

    /// Calls `visit` with ranges of nodes of a row along x that hold all that are lit, at most [`LANES`] at a time.
    #[inline(always)]
    pub(super) fn lit_vectors(&self, row: usize, mut visit: impl FnMut(usize, usize)) {
        for (a, b) in self.orders[0].lit_blocks.each(row, self.dims[0]) {
            (a..b).step_by(LANES).for_each(|a| visit(a, (a + LANES).min(b)));
        }
    }

    /// A vector of any length along the normal of a lit node towards the lower side.
    #[inline(always)]
    pub(super) fn along_normal(&self, at: usize) -> Vec3 {
        Vec3::from_array(normals::decode(self.packed_normal(at)))
    }

    /// Whether some samples are not finite.
    pub(super) fn has_gaps(&self) -> bool {
        self.orders[0].rims.is_some()
    }

    /// The unit normal of a node towards the lower side; `None` where none is lit.
    pub(super) fn normal(&self, at: usize) -> Option<DVec3> {
        self.along_normal(at).as_dvec3().try_normalize()
    }

    /// Gives nodes without a surface the mean of their neighbours that have one (or were filled before), so that
    /// interpolation near the sweep's ends meets no black.
    pub(super) fn fill(&self, b: &mut [Half4]) {
        let mut known = self.all_lit();
        for ring in &self.rings {
            let known_before = &known;
            let old = &*b;
            let values: Vec<Half4> = ring
                .par_iter()
                .with_min_len(1 << 10)
                .map(|&at| {
                    let (mut sum, mut count) = ([0f32; 3], 0f32);
                    for run in neighbourhood(self.dims, at as usize) {
                        for n in run.filter(|n| known_before[*n]) {
                            (0..3).for_each(|c| sum[c] += decode(old[n][c]));
                            count += 1.0;
                        }
                    }
                    let [r, g, b] = sum.map(|s| encode(s / count.max(1.0)));
                    [r, g, b, 0]
                })
                .collect();
            for (&at, v) in ring.iter().zip(values) {
                b[at as usize] = v;
            }
            ring.iter().for_each(|&at| known[at as usize] = true);
        }
    }
}

/// Per memory order, the blocks of lit nodes, and where planes keep their light.
pub(super) fn lit_rows(dims: [usize; 3], lit: &[bool]) -> ([Blocks; 2], [LitRows; 2]) {
    let [nx, ny, nz] = dims;
    // Whole vectors are accumulated; packs of lines start anywhere.
    let whole = |n: usize| (n.div_ceil(64).next_multiple_of(16), 0);
    let blocks = [Blocks::along(nx, ny * nz, whole(nx), |at| lit[at]), Blocks::across(dims, whole(ny), |at| lit[at])];
    let rows = [LitRows::new(nx, &blocks[0]), LitRows::new(ny, &blocks[1])];
    (blocks, rows)
}

/// Nodes that are not known but share a cell with one that is.
#[allow(clippy::cast_possible_truncation, reason = "nodes are numbered in 32 bits")]
pub(super) fn ring([nx, ny, nz]: [usize; 3], known: &[bool]) -> Vec<u32> {
    // One axis at a time.
    let along = |from: &[bool], stride: usize, n: usize| -> Vec<bool> {
        let mut to = from.to_vec();
        to.par_chunks_mut(stride * n).zip(from.par_chunks(stride * n)).for_each(|(to, from)| {
            let inner = stride * (n - 1);
            to[stride..].iter_mut().zip(&from[..inner]).for_each(|(t, f)| *t |= f);
            to[..inner].iter_mut().zip(&from[stride..]).for_each(|(t, f)| *t |= f);
        });
        to
    };
    let wide = along(&along(&along(known, 1, nx), nx, ny), nx * ny, nz);
    // Most runs of nodes have none.
    const RUN: usize = 256;
    let runs = wide.par_chunks(RUN).zip(known.par_chunks(RUN)).enumerate().with_min_len(64);
    runs.flat_map_iter(|(run, (wide, known))| {
        let any = wide.iter().zip(known).fold(false, |any, (wide, known)| any | (*wide & !*known));
        let places = if any { 0..wide.len() } else { 0..0 };
        places.filter(move |&i| wide[i] && !known[i]).map(move |i| (run * RUN + i) as u32)
    })
    .collect()
}

/// Nodes without light that share a cell with a lit node, then those that share a cell with these.
fn rings(dims: [usize; 3], lit: &[bool]) -> Vec<Vec<u32>> {
    let mut known = lit.to_vec();
    (0..2)
        .map(|_| {
            let ring = ring(dims, &known);
            ring.iter().for_each(|&at| known[at as usize] = true);
            ring
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::rng::{Rng, Stage};
    use crate::volume::{Lattice, Samples};

    /// Every cell with a node that is not below the sweep, and of the others few: those of the same blocks and beside.
    #[test]
    fn what_reaches_the_sweep_is_found_in_its_cell() {
        let dims = [140, 9, 11];
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let mut rng = Rng::stream(7, Stage::Test, 0);
        let h = |_| if rng.unit() < 2e-3 { 2.0 * rng.unit() } else { -rng.unit() };
        let mut samples: Vec<f64> = (0..lattice.len()).map(h).collect();
        samples[77] = f64::NAN;
        let field = Field::made(lattice.clone(), Samples::F64(samples), 0.0, 1.0);
        let geometry = Geometry::new(&field);
        let mut counts = [0; 3];
        for _ in 0..20_000 {
            let place = DVec3::new(rng.unit(), rng.unit(), rng.unit()) * lattice.far();
            let cell = place.floor().as_ivec3();
            // Whether a node from `before` to `behind` nodes beside that of the cell does.
            let any = |before: i32, behind: i32| {
                let axis = |a: usize| (cell[a] + before).max(0)..=(cell[a] + behind).min(dims[a] as i32 - 1);
                axis(2).flat_map(|k| axis(1).flat_map(move |j| axis(0).map(move |i| [i, j, k]))).any(|ijk| {
                    let [i, j, k] = ijk.map(|x| x as usize);
                    !(geometry.h[lattice.offset(i, j, k)] < 0.0)
                })
            };
            let reaches = geometry.reaches(place);
            assert!(reaches || !any(0, 1), "{place}");
            // Blocks hold three nodes of 140.
            assert!(!reaches || any(-3, 3), "{place}");
            counts[usize::from(reaches) + usize::from(any(0, 1))] += 1;
        }
        assert!(counts.iter().all(|n| *n > 300), "{counts:?}");
    }

    /// Lit nodes in a corner, across blocks of rows, and in a row of their own.
    #[test]
    fn transposition_is_undone_where_nodes_are_lit() {
        let dims = [67, 9, 11];
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let inside = |[x, y, z]: [usize; 3]| x < 4 && y < 5 || (x > 60 && z > 8) || (y == 7 && z == 3);
        let h = |o: usize| if inside(lattice.ijk(o)) { 0.5 + 1e-3 * (o % 7) as f32 } else { -9.0 + (o % 3) as f32 };
        let samples = (0..lattice.len()).map(h).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 1.0);
        let geometry = Geometry::new(&field);
        let lit = (0..lattice.len()).filter(|&o| geometry.lit(o)).count();
        assert!(lit > 200);
        // (x, y, z) = (2, 3, 4).
        assert_eq!(transposed(geometry.h, dims)[(2 * 11 + 4) * 9 + 3], geometry.h[(4 * 9 + 3) * 67 + 2]);
        let [rows, turned] = geometry.orders.each_ref().map(|order| &order.lit_rows);
        let places = geometry.places();
        // Dark nodes beside lit ones have places, and none at the other end of their row; some have one in one order.
        assert!(lit < places && places < lattice.len() / 2, "{lit} {places}");
        let pool = PlanePool::default();
        // What planes held before is forgotten.
        pool.keep(std::array::from_fn::<_, 7, _>(|_| vec![3.0; places]));
        let mut plane = vec![0.0; places];
        for o in (0..lattice.len()).filter(|&o| geometry.lit(o)) {
            plane[rows.place_of(o).unwrap()] = 1.0 + o as f32;
        }
        let mut to = pool.plane(places);
        transpose([rows, turned], dims, &plane, &mut to);
        for o in 0..lattice.len() {
            let [x, y, z] = lattice.ijk(o);
            let expected = if geometry.lit(o) { 1.0 + o as f32 } else { 0.0 };
            assert_eq!(turned.place(x * 11 + z, y).map_or(0.0, |place| to[place]), expected, "{x} {y} {z}");
        }
        let got = geometry.untransposed(std::array::from_fn(|_| to.clone()), &pool);
        got.iter().for_each(|got| assert_eq!(got, &plane));
    }
}
