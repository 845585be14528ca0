//! Which part of a flat light reaches: what luminaires hide of it, and where solids stand on it.

use crate::field::Field;
use crate::flat::{Flat, Texel};
use crate::flattened::{Side, split_face};
use crate::isovalue_axis::IsovalueAxis;
use crate::neighbourhood::neighbourhood;
use crate::polygon::Polygon;
use crate::scene::{Scene, value_on};
use glam::DVec3;
use rayon::prelude::*;

/// What luminaires closely before a flat hide of it.
pub(super) struct CoveredPart<'a> {
    flat: &'a Flat,
    covering: Vec<&'a Polygon>,
}

impl<'a> CoveredPart<'a> {
    pub(super) fn new(scene: &'a Scene, number: usize, flat: &'a Flat) -> Self {
        let wall = u32::try_from(number).ok().filter(|_| number < scene.polygons().len());
        Self { flat, covering: wall.into_iter().flat_map(|wall| scene.covering(wall)).collect() }
    }

    pub(super) fn holds(&self, uv: Place) -> bool {
        !self.covering.is_empty() && {
            let x = self.flat.at(uv);
            self.covering.iter().any(|light| light.contains(x))
        }
    }

    /// Takes it off each texel.
    pub(super) fn take_off(&self, dims: [usize; 3], parts: &mut [Texel]) {
        if self.covering.is_empty() {
            return;
        }
        for (texel, part) in parts.iter_mut().enumerate() {
            let hidden = (0..MOST).filter(|&n| self.holds(place(dims, texel, n)));
            part.covered *= 1.0 - hidden.count() as f64 / MOST as f64;
        }
    }
}

/// Where on a flat solids stand: light reaches a wall on Ω's faces where the level sets' outer sides are, and a cap
/// where the solid is that it closes.
pub(super) struct Solid<'a> {
    scene: &'a Scene,
    flat: &'a Flat,
    /// The field whose cap this is: the scene's own, or a companion's.
    capped: Option<Option<u8>>,
}

/// A place on a flat, in texture coordinates.
type Place = [f64; 2];

/// The isovalues at which light reaches a place: above the first and up to the second.
pub(super) type Opening = [f64; 2];

impl<'a> Solid<'a> {
    /// `None` for flats that are no parallelograms, which count as open everywhere.
    pub(super) fn new(scene: &'a Scene, number: usize, flat: &'a Flat) -> Option<Self> {
        let cap = number.checked_sub(scene.polygons().len());
        let capped = cap.map(|n| split_face(scene.numbered_face(n).0).0);
        flat.is_parallelogram().then_some(Self { scene, flat, capped })
    }

    /// What all fields around a place leave open.
    pub(super) fn opening(&self, uv: Place) -> Opening {
        let p = self.scene.lattice().to_index(self.flat.at(uv));
        let mut open = [f64::NEG_INFINITY, f64::INFINITY];
        let mut close = |number: Option<u8>, field: &Field, p: DVec3, outside: Side| {
            let h = value_on(field, p);
            // A cap is the outer side of what is higher.
            let below = outside == Side::Lower && self.capped != Some(number);
            // NaN: nothing is there.
            open = if below { [open[0].max(h), open[1]] } else { [open[0], open[1].min(h)] };
        };
        close(None, &self.scene.field, p, self.scene.surface.outside);
        for (n, c) in (0..).zip(self.scene.companions()) {
            close(Some(n), &c.member.field, c.to_index(p), c.member.surface.outside);
        }
        open
    }
}

/// Whether light reaches a place at isovalue `c`.
pub(super) fn is_open([above, up_to]: Opening, c: f64) -> bool {
    c > above && c <= up_to
}

/// Places along each edge of a texel that are asked whether they are open.
const PLACES: usize = 4;

/// The part of each texel that light reaches.
pub(super) struct Open {
    dims: [usize; 3],
    /// The isovalues' centres.
    middles: Vec<f64>,
    /// Per texel of one isovalue: at its places, the last of which is its centre.
    openings: Vec<[Opening; MOST + 1]>,
    /// Its share, [0, 1].
    pub shares: Vec<f64>,
    /// Texels that have such a part, and those around them, which are looked up together. The others hold what light
    /// there is within solids.
    pub outer: Vec<bool>,
}

/// Places of a texel beside its centre.
const MOST: usize = PLACES * PLACES;

impl Open {
    /// `None` if all is open.
    pub(super) fn new(solid: &Solid, dims: [usize; 3], axis: &IsovalueAxis) -> Option<Self> {
        let [nu, nv, nc] = dims;
        let edges = axis.edges(nc);
        let openings: Vec<[Opening; MOST + 1]> = (0..nu * nv)
            .into_par_iter()
            .with_min_len(64)
            .map(|texel| std::array::from_fn(|n| solid.opening(place(dims, texel, n))))
            .collect();
        let shares: Vec<f64> = (0..nu * nv * nc)
            .into_par_iter()
            .with_min_len(1024)
            .map(|i| {
                let isovalue = i / (nu * nv);
                let [lo, hi] = [edges[isovalue], edges[isovalue + 1]];
                let open = |[above, up_to]: Opening| (hi.min(up_to) - lo.max(above)).max(0.0) / (hi - lo);
                openings[i % (nu * nv)][..MOST].iter().map(|&p| open(p)).sum::<f64>() / MOST as f64
            })
            .collect();
        let outer = |i: usize| neighbourhood(dims, i).any(|run| shares[run].iter().any(|s| *s > 0.0));
        let outer = (0..shares.len()).map(outer).collect();
        shares.iter().any(|&s| s < 1.0).then_some(Self { dims, middles: axis.centres(nc), openings, shares, outer })
    }

    /// Where texel `i` is open at its middle isovalue, or where it is not: its centre if that is so, else the place
    /// nearest to the centroid of those that are; `None` if it is nowhere so.
    pub(super) fn place(&self, i: usize, open: bool) -> Option<Place> {
        let [nu, nv, _] = self.dims;
        let (texel, middle) = (i % (nu * nv), self.middles[i / (nu * nv)]);
        let of = |n: usize| is_open(self.openings[texel][n], middle) == open;
        if of(MOST) {
            return Some(place(self.dims, texel, MOST));
        }
        central(&(0..MOST).filter(|&n| of(n)).map(|n| place(self.dims, texel, n)).collect::<Vec<_>>())
    }
}

/// Place `n` of a texel.
fn place([nu, nv, _]: [usize; 3], texel: usize, n: usize) -> Place {
    let offset = |i: usize| if n == MOST { 0.5 } else { (i as f64 + 0.5) / PLACES as f64 };
    [((texel % nu) as f64 + offset(n % PLACES)) / nu as f64, ((texel / nu) as f64 + offset(n / PLACES)) / nv as f64]
}

/// The one of some places that is nearest to their centroid.
fn central(places: &[Place]) -> Option<Place> {
    let n = places.len() as f64;
    let mean = [0, 1].map(|a| places.iter().map(|p| p[a]).sum::<f64>() / n);
    let away = |p: &Place| (p[0] - mean[0]).powi(2) + (p[1] - mean[1]).powi(2);
    places.iter().copied().min_by(|p, q| away(p).total_cmp(&away(q)))
}
