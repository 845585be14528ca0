//! The two geometries of a height field behind the [`Tracer`] seam.
//!
//! * [`LevelCurves`]: rays in horizontal planes. The local frame is (x index, y index, 0), the isovalue rides in the
//!   ray. The whole field is one user primitive: a walk over cells by the sign of h − c, above a layer of min/max
//!   blocks.
//! * [`GraphSurface`]: rays in R³. The local frame is (x index, y index, height in units of the sweep); the graph is
//!   two triangles per cell.
//!
//! A segment is met where its ends lie on different sides of the ray: two walls with a common end leave no slit.

use super::{FlatScene, HeightField, Segment};
use crate::cubic::Cubic;
use crate::embree::{Bvh, BvhBuilder, Device, Ray, RayHit, UserGeometry, UserHit, embree_ray, flattened_ray, padded};
use crate::error::Result;
use crate::flattened::{Departure, Ends, Entry, FlattenedHit, FlattenedRay, Side, Target, enter};
use crate::tracer::Tracer;
use glam::{DVec2, DVec3};
use std::sync::Arc;

/// log₂ of the cells along an edge of a min/max block.
const BLOCK: usize = 3;

/// A field with the min/max of its blocks.
struct Curves {
    field: Arc<HeightField>,
    block_dims: [usize; 2],
    /// (min, max) over a block's finite samples.
    ranges: Vec<(f32, f32)>,
}

impl Curves {
    fn new(field: Arc<HeightField>) -> Self {
        let cells = field.dims().map(|n| n - 1);
        let block_dims = cells.map(|n| n.div_ceil(1 << BLOCK));
        let mut ranges = vec![(f32::INFINITY, f32::NEG_INFINITY); block_dims[0] * block_dims[1]];
        for j in 0..cells[1] {
            for i in 0..cells[0] {
                let (lo, hi) = &mut ranges[(j >> BLOCK) * block_dims[0] + (i >> BLOCK)];
                for s in field.corners([i, j]) {
                    (*lo, *hi) = (lo.min(s), hi.max(s));
                }
            }
        }
        Self { field, block_dims, ranges }
    }

    /// The first t in [0, reach] at which the ray meets its level curve, and the side it comes from.
    ///
    /// The state h ≥ c at a crossing is a function of that edge's two samples and the crossing alone, computed once and
    /// used for both cells: a cell whose ends differ always gives a hit.
    fn meet(&self, ray: &FlattenedRay, reach: f64) -> Option<(f64, Side)> {
        let n = self.field.dims().map(|n| n - 1);
        let o = [ray.origin.x, ray.origin.y].map(f64::from);
        let d = [ray.direction.x, ray.direction.y].map(f64::from);
        let inv = d.map(|x| 1.0 / x);
        let Entry { mut t, axis: mut entry } = enter(n, o, d, inv, reach)?;
        let mut cell: [i64; 2] = std::array::from_fn(|a| {
            let p = o[a] + t * d[a];
            // On a shared line the ray is in the cell it goes to.
            let below = d[a] < 0.0 && p == p.floor();
            (p.floor() as i64 - i64::from(below)).clamp(0, n[a] as i64 - 1)
        });
        let corners = |cell: [i64; 2]| self.field.corners(cell.map(|i| i as usize));
        let local = |cell: [i64; 2], t: f64| {
            DVec2::from_array(std::array::from_fn(|a| (o[a] + t * d[a] - cell[a] as f64).clamp(0.0, 1.0)))
        };

        let mut c = f64::from(ray.isovalue);
        let mut departing = None;
        if let (Departure::Surface(side), None) = (ray.departure, entry) {
            // h at the start, so that the root there is exactly 0.
            let here = super::field2::bilinear(corners(cell).map(f64::from), local(cell, 0.0));
            if here.is_finite() {
                (c, departing) = (here, Some(side));
            }
        }
        let excludes = |(lo, hi): (f32, f32)| !(f64::from(lo) < c && f64::from(hi) >= c);
        // The state at the current crossing where known.
        let mut inside: Option<bool> = None;
        let mut fresh = true;
        loop {
            let block = cell.map(|i| i as usize >> BLOCK);
            let skip = fresh && departing.is_none() && excludes(self.ranges[block[1] * self.block_dims[0] + block[0]]);
            let (lo, hi) = if skip {
                let lo = block.map(|b| (b << BLOCK) as i64);
                (lo, std::array::from_fn(|a| (lo[a] + (1 << BLOCK)).min(n[a] as i64)))
            } else {
                (cell, cell.map(|i| i + 1))
            };
            let (mut axis, mut t_exit) = (0, f64::INFINITY);
            for a in 0..2 {
                if d[a] != 0.0 {
                    let plane = if d[a] > 0.0 { hi[a] } else { lo[a] };
                    let t_plane = (plane as f64 - o[a]) * inv[a];
                    if t_plane < t_exit {
                        (axis, t_exit) = (a, t_plane);
                    }
                }
            }
            let t_exit = t_exit.max(t);
            let last = t_exit >= reach;
            let s = corners(cell);
            if skip || (departing.is_none() && !straddles(s, c)) {
                inside = None;
            } else {
                let mut along = quadratic(s, c, local(cell, t), DVec2::from_array(d));
                let start = match departing.take() {
                    Some(side) => {
                        along = along.deflate();
                        let leaves_inside = along.c.iter().find(|&&x| x != 0.0).is_none_or(|&x| x > 0.0);
                        if leaves_inside != (side == Side::Higher) {
                            return Some((0.0, side));
                        }
                        leaves_inside
                    }
                    None => inside.unwrap_or_else(|| match entry {
                        Some(a) => edge_inside(s, a, d[a] < 0.0, c, local(cell, t)[1 - a]),
                        None => along.value(0.0) >= 0.0,
                    }),
                };
                let span = (if last { reach } else { t_exit } - t).max(0.0);
                let end = if last {
                    along.value(span) >= 0.0
                } else {
                    edge_inside(s, axis, d[axis] > 0.0, c, local(cell, t_exit)[1 - axis])
                };
                if let Some(dt) = along.first_crossing(span, start, end) {
                    return Some(((t + dt).min(reach), if start { Side::Higher } else { Side::Lower }));
                }
                inside = Some(end);
            }
            if last {
                return None;
            }
            let mut next = cell;
            next[axis] = if d[axis] > 0.0 { hi[axis] } else { lo[axis] - 1 };
            if skip {
                let other = 1 - axis;
                next[other] = ((o[other] + t_exit * d[other]).floor() as i64).clamp(lo[other], hi[other] - 1);
            }
            if next[axis] < 0 || next[axis] >= n[axis] as i64 {
                return None;
            }
            fresh = (next[axis] ^ cell[axis]) >> BLOCK != 0;
            (cell, t, entry) = (next, t_exit, Some(axis));
        }
    }
}

/// Whether a cell holds a piece of L(h, c); false if a corner is NaN.
#[inline]
fn straddles(s: [f32; 4], c: f64) -> bool {
    let lo = s[0].min(s[1]).min(s[2].min(s[3]));
    let hi = s[0].max(s[1]).max(s[2].max(s[3]));
    f64::from(lo) < c && f64::from(hi) >= c && !(s[0] + s[1] + s[2] + s[3]).is_nan()
}

/// h − c along p + t d in a bilinear cell.
#[inline]
fn quadratic(s: [f32; 4], c: f64, p: DVec2, d: DVec2) -> Cubic {
    let s = s.map(f64::from);
    let (k1, k2) = (s[1] - s[0], s[2] - s[0]);
    let k3 = s[3] - s[2] - k1;
    Cubic {
        c: [
            (s[0] - c) + k1 * p.x + k2 * p.y + k3 * p.x * p.y,
            k1 * d.x + k2 * d.y + k3 * (p.x * d.y + p.y * d.x),
            k3 * d.x * d.y,
            0.0,
        ],
    }
}

/// Whether h ≥ c at `v` on the edge across `axis`: from the edge's own samples, the same from both of its cells.
#[inline]
fn edge_inside(s: [f32; 4], axis: usize, far: bool, c: f64, v: f64) -> bool {
    let base = usize::from(far) << axis;
    let (a, b) = (f64::from(s[base]), f64::from(s[base + (1 << (1 - axis))]));
    match (a >= c, b >= c) {
        (true, true) => true,
        (false, false) => false,
        _ => a + v * (b - a) >= c,
    }
}

impl UserGeometry for Curves {
    fn len(&self) -> u32 {
        1
    }

    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        padded(DVec3::new(0.0, 0.0, -1.0), self.field.far().extend(1.0))
    }

    #[inline]
    fn intersect(&self, _: u32, ray: &Ray) -> Option<UserHit> {
        let (t, side) = self.meet(&flattened_ray(ray), f64::from(ray.tfar))?;
        Some(UserHit { t: t as f32, u: side.index() as f32, v: 0.0, normal: [0.0; 3] })
    }

    #[inline]
    fn occluded(&self, _: u32, ray: &Ray) -> bool {
        self.meet(&flattened_ray(ray), f64::from(ray.tfar)).is_some()
    }
}

/// Walls and luminaires in the local frame, a primitive each.
struct Extrusions {
    /// Ends, and whether the back blocks.
    segments: Vec<([DVec2; 2], bool)>,
    /// Heights that they cover; without bounds when flattened.
    heights: Option<[f64; 2]>,
    slack: f64,
}

impl Extrusions {
    fn new(field: &HeightField, segments: &[Segment], heights: Option<[f64; 2]>) -> Self {
        let segments: Vec<_> = segments.iter().map(|s| (s.ends.map(|x| field.to_index(x)), s.emits())).collect();
        let reach = segments.iter().flat_map(|(e, _)| e).fold(1.0, |r: f64, p| r.max(p.abs().max_element()));
        Self { segments, heights, slack: 8.0 * f64::from(f32::EPSILON) * reach }
    }

    /// Where the ray meets segment `id`. One that starts on its line, within the rounding of f32, meets it at 0.
    #[inline]
    fn meet(&self, id: u32, ray: &Ray) -> Option<f64> {
        let ([a, b], opaque_back) = self.segments[id as usize];
        let Ends { departure, target, .. } = FlattenedRay::unpack_ends(ray.time);
        if departure == Departure::Polygon(id) || target == Some(id) {
            return None;
        }
        let o = DVec3::from_array(ray.org.map(f64::from));
        let d = DVec3::from_array(ray.dir.map(f64::from));
        let (p, q, flat) = (a - o.truncate(), b - o.truncate(), d.truncate());
        if (flat.perp_dot(p) >= 0.0) == (flat.perp_dot(q) >= 0.0) {
            return None;
        }
        // The front is to the left of a → b; a ray to the front's line comes from the left.
        let along = b - a;
        let across = along.perp_dot(flat);
        if across == 0.0 || (across > 0.0 && !opaque_back) {
            return None;
        }
        let height = -along.perp_dot(p);
        let before = if across < 0.0 { height } else { -height };
        if before < -self.slack * along.length() {
            return None;
        }
        let t = (before / across.abs()).max(0.0);
        let covered = self.heights.is_none_or(|[lo, hi]| {
            let z = o.z + t * d.z;
            z >= lo && z <= hi
        });
        (t <= f64::from(ray.tfar) && covered).then_some(t)
    }
}

impl UserGeometry for Extrusions {
    fn len(&self) -> u32 {
        u32::try_from(self.segments.len()).expect("scenes hold fewer than 4096 segments")
    }

    fn bounds(&self, prim: u32) -> ([f32; 3], [f32; 3]) {
        let [a, b] = self.segments[prim as usize].0;
        let [lo, hi] = self.heights.unwrap_or([-1.0, 1.0]);
        padded(a.min(b).extend(lo), a.max(b).extend(hi))
    }

    #[inline]
    fn intersect(&self, prim: u32, ray: &Ray) -> Option<UserHit> {
        let t = (self.meet(prim, ray)? as f32).min(ray.tfar);
        Some(UserHit { t, u: 0.0, v: 0.0, normal: [0.0; 3] })
    }

    #[inline]
    fn occluded(&self, prim: u32, ray: &Ray) -> bool {
        self.meet(prim, ray).is_some()
    }
}

/// Flattened geometry: level curves and segments; every ray has direction (·, ·, 0).
#[derive(Debug)]
pub struct LevelCurves {
    bvh: Bvh<'static>,
    curves: u32,
}

impl LevelCurves {
    /// Commits the scene; valid for every isovalue.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn new(device: &Device, scene: &FlatScene) -> Result<Self> {
        let mut builder = BvhBuilder::new(device)?;
        let curves = builder.user_shared(Arc::new(Curves::new(scene.field.clone())), u32::MAX)?;
        if !scene.segments.is_empty() {
            builder.user_shared(Arc::new(Extrusions::new(&scene.field, &scene.segments, None)), u32::MAX)?;
        }
        Ok(Self { bvh: builder.commit()?, curves })
    }
}

impl Tracer for LevelCurves {
    #[inline]
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        let mut rayhit = RayHit::new(embree_ray(ray));
        self.bvh.intersect1(&mut rayhit);
        if !rayhit.is_hit() {
            return None;
        }
        let target = if rayhit.hit.geometry != self.curves {
            Target::Polygon(rayhit.hit.prim)
        } else if rayhit.hit.u == 0.0 {
            Target::Surface(Side::Lower)
        } else {
            Target::Surface(Side::Higher)
        };
        Some(FlattenedHit { t: rayhit.ray.tfar, target })
    }

    #[inline]
    fn occluded(&self, ray: &FlattenedRay) -> bool {
        self.bvh.occluded1(&mut embree_ray(ray))
    }
}

/// Ordinary geometry: the graph as triangles, walls and luminaires upright over the sweep. Rays ignore the isovalue.
#[derive(Debug)]
pub struct GraphSurface {
    bvh: Bvh<'static>,
    graph: u32,
    field: Arc<HeightField>,
    /// Cell · 2 + half of each triangle.
    triangles: Vec<u32>,
}

impl GraphSurface {
    /// Commits the scene.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn new(device: &Device, scene: &FlatScene) -> Result<Self> {
        Self::with_heights(device, scene, [0.0, 1.0])
    }

    /// [`GraphSurface::new`] with walls and luminaires over other heights than the sweep's, in its units: for pictures
    /// of a graph that reaches below it.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn with_heights(device: &Device, scene: &FlatScene, heights: [f64; 2]) -> Result<Self> {
        let field = scene.field.clone();
        let [nx, ny] = field.dims();
        let z = |o: usize| if field.samples()[o].is_finite() { field.samples()[o] } else { 0.0 };
        let vertices: Vec<[f32; 3]> = (0..nx * ny).map(|o| [(o % nx) as f32, (o / nx) as f32, z(o)]).collect();
        let (mut indices, mut triangles) = (Vec::new(), Vec::new());
        for j in 0..ny - 1 {
            for i in 0..nx - 1 {
                if field.corners([i, j]).iter().any(|s| s.is_nan()) {
                    continue;
                }
                let o = (j * nx + i) as u32;
                let [right, up, both] = [o + 1, o + nx as u32, o + nx as u32 + 1];
                indices.extend([[o, right, both], [o, both, up]]);
                triangles.extend([2 * o, 2 * o + 1]);
            }
        }
        let mut builder = BvhBuilder::new(device)?;
        let graph = builder.triangles(&vertices, &indices, u32::MAX)?;
        if !scene.segments.is_empty() {
            let walls = Extrusions::new(&field, &scene.segments, Some(heights));
            builder.user_shared(Arc::new(walls), u32::MAX)?;
        }
        Ok(Self { bvh: builder.commit()?, graph, field, triangles })
    }

    /// Height of the triangles above `p`, and their slope there, in the local frame. On the diagonal, `towards`
    /// decides.
    pub fn plane(&self, p: DVec2, towards: DVec2) -> (f64, DVec2) {
        plane(&self.field, p, towards)
    }

    /// Whether triangle `prim` touches the upright line through `p`.
    fn touches(&self, prim: u32, p: DVec2) -> bool {
        let id = self.triangles[prim as usize] as usize;
        let (cell, upper, nx) = (id / 2, id % 2 == 1, self.field.dims()[0]);
        let u = p - DVec2::new((cell % nx) as f64, (cell / nx) as f64);
        u.cmpge(DVec2::ZERO).all() && u.cmple(DVec2::ONE).all() && if upper { u.y >= u.x } else { u.x >= u.y }
    }

    /// The nearest hit. A ray from the graph leaves its own triangles out by their place, since a straight line meets a
    /// plane once: no epsilon. A direction that goes to the other side meets the graph at 0.
    fn nearest(&self, ray: &FlattenedRay) -> Option<(f32, RayHit)> {
        let mut r = embree_ray(ray);
        let start = ray.origin.truncate().as_dvec2();
        loop {
            let mut rayhit = RayHit::new(r);
            self.bvh.intersect1(&mut rayhit);
            if !rayhit.is_hit() {
                return None;
            }
            let own = matches!(ray.departure, Departure::Surface(_))
                && rayhit.hit.geometry == self.graph
                && self.touches(rayhit.hit.prim, start);
            if !own {
                return Some((rayhit.ray.tfar, rayhit));
            }
            r.tnear = rayhit.ray.tfar.next_up();
        }
    }

    /// Whether a ray from the graph goes at once to the other side.
    fn turns_back(&self, ray: &FlattenedRay) -> Option<Side> {
        let Departure::Surface(side) = ray.departure else { return None };
        let d = ray.direction.as_dvec3();
        let (_, slope) = self.plane(ray.origin.truncate().as_dvec2(), d.truncate());
        let goes = if d.z - slope.dot(d.truncate()) > 0.0 { Side::Lower } else { Side::Higher };
        (goes != side).then_some(side)
    }
}

/// Height and slope of the triangle of `p`'s cell that `p` + ε · `towards` stands on, in index units and sweep units.
pub(super) fn plane(field: &HeightField, p: DVec2, towards: DVec2) -> (f64, DVec2) {
    let n = field.dims();
    let cell: [usize; 2] = std::array::from_fn(|a| {
        let below = towards[a] < 0.0 && p[a] == p[a].floor();
        ((p[a].floor() as i64) - i64::from(below)).clamp(0, n[a] as i64 - 2) as usize
    });
    let s = field.corners(cell).map(f64::from);
    let u = p - DVec2::from_array(cell.map(|i| i as f64));
    let across = u.x - u.y;
    let lower = across > 0.0 || (across == 0.0 && towards.x >= towards.y);
    let slope = if lower { DVec2::new(s[1] - s[0], s[3] - s[1]) } else { DVec2::new(s[3] - s[2], s[2] - s[0]) };
    (s[0] + slope.dot(u), slope)
}

impl Tracer for GraphSurface {
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        if let Some(side) = self.turns_back(ray) {
            return Some(FlattenedHit { t: 0.0, target: Target::Surface(side) });
        }
        let (t, rayhit) = self.nearest(ray)?;
        let target = if rayhit.hit.geometry == self.graph {
            let (_, slope) = self.plane(ray.at(t).truncate(), ray.direction.truncate().as_dvec2());
            let d = ray.direction.as_dvec3();
            let from_above = d.z - slope.dot(d.truncate()) < 0.0;
            Target::Surface(if from_above { Side::Lower } else { Side::Higher })
        } else {
            Target::Polygon(rayhit.hit.prim)
        };
        Some(FlattenedHit { t, target })
    }

    fn occluded(&self, ray: &FlattenedRay) -> bool {
        if self.turns_back(ray).is_some() {
            return true;
        }
        match ray.departure {
            Departure::Surface(_) => self.nearest(ray).is_some(),
            _ => self.bvh.occluded1(&mut embree_ray(ray)),
        }
    }
}

#[cfg(test)]
mod tests;
