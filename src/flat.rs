//! Flats: everything planar that holds a (u, v, isovalue) texture of light – walls, luminaires' fronts, and the caps of
//! Ω's faces. Flat numbers are polygon numbers, then six caps (axis + 3 · far end) for each field.

use crate::flattened::{Departure, Side};
use crate::isovalue_axis::IsovalueAxis;
use crate::polygon::clip;
use crate::reflectance::Reflectance;
use crate::scene::{Boundary, Scene};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// A flat's place and material in the world.
#[derive(Clone, Debug)]
pub struct Flat {
    corner: DVec3,
    edges: [DVec3; 2],
    /// Unit normal of its lit side.
    pub normal: DVec3,
    /// Diffuse reflectance; a wall's is the same at every isovalue.
    pub albedo: Reflectance,
    /// What rays from it start on.
    pub departure: Departure,
    /// The outline in texture coordinates, counter-clockwise, unless the texture's parallelogram is all of it.
    outline: Option<Vec<[f64; 2]>>,
    /// The length that the nominal resolution spans.
    span: f64,
}

/// A texel's share of a flat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Texel {
    /// Share of its area that lies in the flat, [0, 1].
    pub covered: f64,
    /// Centroid of that part in texture coordinates; of `source`'s if nothing is covered.
    pub at: [f64; 2],
    /// The texel that stands for it: itself, or the nearest covered one.
    pub source: usize,
}

/// Number of flats of a scene, caps included.
pub fn count(scene: &Scene) -> usize {
    scene.polygons().len() + 6 * scene.fields()
}

/// Flat number `number` of `scene`; `None` for caps of an open boundary.
pub fn flat(scene: &Scene, number: usize) -> Option<Flat> {
    if let Some(p) = scene.polygons().get(number) {
        let id = u32::try_from(number).expect("scenes hold fewer than 2¹⁶ polygons");
        return Some(Flat {
            corner: p.at([0.0, 0.0]),
            edges: p.texture_edges(),
            normal: p.normal(),
            albedo: p.albedo.into(),
            departure: Departure::Polygon(id),
            outline: (!p.is_parallelogram()).then(|| p.outline()),
            // A wall has the nominal resolution however small it is; of context geometry, the scene has.
            span: match p.other_face {
                0 => longest(p.texture_edges()),
                _ => scene.bounds().into_iter().reduce(|lo, hi| hi - lo).expect("two corners").max_element(),
            },
        });
    }
    let (face, lattice, surface, boundary) = scene.numbered_face(number - scene.polygons().len());
    if boundary == Boundary::Open {
        return None;
    }
    let a = usize::from(face % 3);
    let far = lattice.far();
    let mut corner = DVec3::ZERO;
    if face % 6 >= 3 {
        corner[a] = far[a];
    }
    let edge = |b: usize| lattice.axes().col(b) * far[b];
    let edges = [edge((a + 1) % 3), edge((a + 2) % 3)];
    Some(Flat {
        corner: lattice.to_world(corner),
        edges,
        outline: None,
        span: longest(edges),
        normal: scene.face_normal(face),
        albedo: surface.albedo.clone(),
        departure: Departure::Cap(face, Side::Lower),
    })
}

impl Flat {
    /// World position of texture coordinates.
    #[inline]
    pub fn at(&self, [u, v]: [f64; 2]) -> DVec3 {
        self.corner + u * self.edges[0] + v * self.edges[1]
    }

    /// Whether the texture's parallelogram is all of it.
    pub fn is_parallelogram(&self) -> bool {
        self.outline.is_none()
    }

    /// World area of the texture's parallelogram.
    pub fn area(&self) -> f64 {
        self.edges[0].cross(self.edges[1]).length()
    }

    /// Texels along u, v and the isovalue, about `across` of them along the longer edge of a wall, or along the scene's
    /// extent for context geometry, of which there may be much.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few hundred at most")]
    pub fn resolution(&self, across: usize, isovalues: usize) -> [usize; 3] {
        let least = if self.span > longest(self.edges) { 1 } else { 2 };
        let [u, v] = self.edges.map(|e| ((e.length() / self.span * across as f64).round() as usize).max(least));
        [u, v, isovalues]
    }

    /// Texels across for light that bounces from texel to texel: `least`, or as many more as it takes for none to be
    /// longer than `narrow` on a wall that is long, but no more in all than a square wall would have.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most its square")]
    pub fn across(&self, least: usize, narrow: f64) -> usize {
        if self.span > longest(self.edges) {
            return least;
        }
        let texel = narrow.max(self.area().sqrt() / least as f64);
        least.max((self.span / texel).ceil() as usize)
    }

    /// The texels of one isovalue of a texture of `dims`, u fastest.
    pub fn texels(&self, dims: [usize; 3]) -> Vec<Texel> {
        let [nu, nv, _] = dims;
        let mut texels: Vec<Texel> = (0..nu * nv)
            .map(|source| {
                let (i, j) = ((source % nu) as f64, (source / nu) as f64);
                let centre = [(i + 0.5) / nu as f64, (j + 0.5) / nv as f64];
                let Some(outline) = &self.outline else { return Texel { covered: 1.0, at: centre, source } };
                // In units of texels, from this one's corner.
                let part = outline.iter().map(|&[u, v]| DVec2::new(u * nu as f64 - i, v * nv as f64 - j)).collect();
                let (covered, middle) = area_and_centroid(&clipped(part));
                Texel { covered, at: [(i + middle.x) / nu as f64, (j + middle.y) / nv as f64], source }
            })
            .collect();
        // Slivers see too little to speak for themselves.
        let counts = |t: &Texel| t.covered > 1e-3;
        let counting: Vec<bool> = texels.iter().map(counts).collect();
        if counting.contains(&false) {
            for (n, source) in nearest(&counting, nu).into_iter().enumerate().filter(|&(n, _)| !counting[n]) {
                if let Some(source) = source {
                    texels[n] = Texel { covered: 0.0, at: texels[source].at, source };
                }
            }
        }
        texels
    }
}

/// Length of the longer edge.
fn longest(edges: [DVec3; 2]) -> f64 {
    edges[0].length().max(edges[1].length())
}

/// The part of a convex polygon in the unit square.
fn clipped(mut points: Vec<DVec2>) -> Vec<DVec2> {
    for (a, sign, edge) in [(0, 1.0, 0.0), (0, -1.0, -1.0), (1, 1.0, 0.0), (1, -1.0, -1.0)] {
        let mut kept = Vec::with_capacity(points.len() + 1);
        clip(points.len(), |n| points[n], |p| sign * p[a] - edge, |p| kept.push(p));
        points = kept;
    }
    points
}

/// The nearest of those that count for each in a raster of rows of `nu`, the first of several as near.
fn nearest(counting: &[bool], nu: usize) -> Vec<Option<usize>> {
    // By row, the column of the nearest in it, the left of two.
    let in_row: Vec<Option<usize>> = counting
        .chunks(nu)
        .flat_map(|row| {
            let mut found = vec![None; nu];
            let mut left = None;
            for (i, found) in found.iter_mut().enumerate() {
                left = if row[i] { Some(i) } else { left };
                *found = left;
            }
            let mut right: Option<usize> = None;
            for (i, found) in found.iter_mut().enumerate().rev() {
                right = if row[i] { Some(i) } else { right };
                let nearer = |r: usize| found.is_none_or(|l| r - i < i - l);
                *found = right.filter(|&r| nearer(r)).or(*found);
            }
            found
        })
        .collect();
    let nv = in_row.len() / nu;
    let search = |n: usize| {
        let (i, j) = (n % nu, n / nu);
        let mut best = None;
        // Rows further and further away, as long as they may hold one as near.
        for away in 0..nv {
            if best.is_some_and(|(least, _)| away * away > least) {
                break;
            }
            let rows = [j.checked_sub(away), Some(j + away).filter(|&r| r < nv && away > 0)];
            for row in rows.into_iter().flatten() {
                if let Some(c) = in_row[row * nu + i] {
                    let found = (away * away + i.abs_diff(c).pow(2), row * nu + c);
                    best = Some(best.map_or(found, |b: (usize, usize)| b.min(found)));
                }
            }
        }
        best.map(|b| b.1)
    };
    (0..counting.len()).into_par_iter().map(|n| if counting[n] { Some(n) } else { search(n) }).collect()
}

/// Area and centroid of a convex polygon; the middle of the unit square if it has none.
fn area_and_centroid(points: &[DVec2]) -> (f64, DVec2) {
    let (mut area, mut sum) = (0.0, DVec2::ZERO);
    for w in points.windows(2).skip(1) {
        let [o, p, q] = [points[0], w[0], w[1]];
        let a = 0.5 * (p - o).perp_dot(q - o).abs();
        area += a;
        sum += a * (o + p + q) / 3.0;
    }
    if area > 0.0 { (area, sum / area) } else { (0.0, DVec2::splat(0.5)) }
}

/// The number of the flat that is a cap on this face of Ω ([`crate::flattened::face_of`]).
#[inline]
pub fn cap(scene: &Scene, face: u8) -> usize {
    scene.polygons().len() + scene.face_number(face)
}

/// Texture coordinates on a face of Ω of local `p`: the two other axes in cyclic order, scaled to [0, 1].
#[inline]
pub fn face_texture(scene: &Scene, face: u8, p: DVec3) -> [f64; 2] {
    let (p, lattice) = scene.to_face_index(face, p);
    let far = lattice.far();
    let a = usize::from(face % 3);
    let (b, c) = ((a + 1) % 3, (a + 2) % 3);
    [p[b] / far[b], p[c] / far[c]]
}

/// Light over (u, v, c), at texel centres, u fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatTexture {
    /// Texels along u, v and the isovalue.
    pub dims: [usize; 3],
    /// Where the isovalue's texels stand.
    pub axis: IsovalueAxis,
    /// RGB per texel.
    pub texels: Vec<[f32; 3]>,
}

impl FlatTexture {
    /// A black texture, its isovalue's texels standing evenly.
    pub fn black(dims: [usize; 3]) -> Self {
        Self { dims, axis: IsovalueAxis::EVEN, texels: vec![[0.0; 3]; dims.iter().product()] }
    }

    /// Texel-centred trilinear lookup at (u, v, c) ∈ [0, 1]³, continued linearly over the outer half texels (a constant
    /// there would darken what a wall sends, since radiance peaks beside its neighbours). Where light falls off steeply
    /// that may lead below 0.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the texture")]
    pub fn lookup(&self, [u, v, c]: [f64; 3]) -> DVec3 {
        let uvc = [u, v, if self.axis.is_even() { c } else { f64::from(self.axis.place(c as f32)) }];
        let mut base = [0usize; 3];
        let mut frac = [0f64; 3];
        for a in 0..3 {
            let last = self.dims[a] - 1;
            let x = uvc[a].clamp(0.0, 1.0) * self.dims[a] as f64 - 0.5;
            base[a] = (x.max(0.0) as usize).min(last.saturating_sub(1));
            frac[a] = if last == 0 { 0.0 } else { x - base[a] as f64 };
        }
        let mut sum = DVec3::ZERO;
        for corner in 0..8usize {
            let mut w = 1.0;
            let mut at = [0usize; 3];
            for a in 0..3 {
                let bit = corner >> a & 1;
                w *= if bit == 1 { frac[a] } else { 1.0 - frac[a] };
                at[a] = (base[a] + bit).min(self.dims[a] - 1);
            }
            if w != 0.0 {
                let t = self.texels[(at[2] * self.dims[1] + at[1]) * self.dims[0] + at[0]];
                sum += w * DVec3::from_array(t.map(f64::from));
            }
        }
        sum
    }

    /// Texture coordinates of the centre of texel `index`.
    pub fn centre(&self, index: usize) -> [f64; 3] {
        let [nu, nv, nc] = self.dims;
        let ijk = [index % nu, index / nu % nv, index / (nu * nv)];
        let dims = [nu, nv, nc];
        let [u, v, c] = std::array::from_fn(|a| (ijk[a] as f64 + 0.5) / dims[a] as f64);
        [u, v, self.axis.isovalue(c)]
    }

    /// The texel that holds (u, v, c).
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the texture")]
    pub fn texel(&self, [u, v, c]: [f32; 3]) -> usize {
        let uvc = [u, v, self.axis.place(c)];
        let i: [usize; 3] = std::array::from_fn(|a| ((uvc[a] * self.dims[a] as f32) as usize).min(self.dims[a] - 1));
        (i[2] * self.dims[1] + i[1]) * self.dims[0] + i[0]
    }
}

/// What a flat reflects, to whom it shows.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatLight {
    /// To all that is not within solids.
    pub outside: FlatTexture,
    /// To what is within the solids that stand on it.
    pub within: Within,
}

/// What a flat shows within the solids that stand on it.
#[derive(Clone, Debug, PartialEq)]
pub enum Within {
    /// What it shows outside, since nothing tells the two apart.
    Same,
    /// Their own light in all texels that they cover, whatever else lies in these.
    Own(FlatTexture),
    /// Nobody looked for light there.
    Unknown,
}

impl FlatLight {
    /// What is seen from within solids, or not; `None` if that is not known.
    #[inline]
    pub fn seen(&self, within: bool) -> Option<&FlatTexture> {
        match &self.within {
            Within::Own(texture) if within => Some(texture),
            Within::Unknown if within => None,
            _ => Some(&self.outside),
        }
    }

    /// The texture that is seen from within solids only.
    pub fn own(&self) -> Option<&FlatTexture> {
        match &self.within {
            Within::Own(texture) => Some(texture),
            Within::Same | Within::Unknown => None,
        }
    }

    /// Its one or two textures, the outside's first.
    pub fn textures(&self) -> impl Iterator<Item = &FlatTexture> {
        std::iter::once(&self.outside).chain(self.own())
    }
}

/// Texels of the textures of all flats of a scene, at most: as [`Flat::resolution`] sizes them.
pub fn texels(scene: &Scene, across: usize, isovalues: usize) -> usize {
    texels_where(scene, [across, isovalues], |_| true)
}

/// As [`texels`], of flats that reflect something: the others need none.
pub fn lit_texels(scene: &Scene, across: usize, isovalues: usize) -> usize {
    texels_where(scene, [across, isovalues], |flat| !flat.albedo.black())
}

fn texels_where(scene: &Scene, [across, isovalues]: [usize; 2], holds: fn(&Flat) -> bool) -> usize {
    let flats = (0..count(scene)).filter_map(|n| flat(scene, n)).filter(holds);
    flats.map(|f| f.resolution(across, isovalues).iter().product::<usize>()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    #[test]
    fn the_nearest_is_that_of_a_search_through_all() {
        let mut rng = Rng::stream(7, Stage::Test, 0);
        for case in 0..200 {
            let [nu, nv] = rng.unit2().map(|u| 1 + (12.0 * u) as usize);
            let share = if case % 7 > 0 { [1.0, 0.5, 0.1, 0.025][case % 4] } else { 0.0 };
            let counting: Vec<bool> = (0..nu * nv).map(|_| rng.unit() < share).collect();
            let all: Vec<usize> = (0..nu * nv).filter(|&n| counting[n]).collect();
            for (n, found) in nearest(&counting, nu).into_iter().enumerate() {
                let away = |&m: &usize| (n % nu).abs_diff(m % nu).pow(2) + (n / nu).abs_diff(m / nu).pow(2);
                assert_eq!(found, all.iter().copied().min_by_key(away), "{n} of {nu}×{nv}");
            }
        }
    }

    #[test]
    fn areas_and_centroids_have_no_winding() {
        let mut square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(DVec2::from_array);
        for _ in 0..2 {
            assert_eq!(area_and_centroid(&square), (1.0, DVec2::splat(0.5)));
            assert_eq!(area_and_centroid(&square[..2]), (0.0, DVec2::splat(0.5)));
            square.reverse();
        }
        let (area, centroid) = area_and_centroid(&[DVec2::ZERO, DVec2::new(0.9, 0.0), DVec2::new(0.0, 0.6)]);
        assert!((area - 0.27).abs() < 1e-15 && centroid.distance(DVec2::new(0.3, 0.2)) < 1e-15, "{area} {centroid}");
    }

    #[test]
    fn long_walls_have_more_texels_across() {
        let wall = |u: f64, v: f64, span: f64| Flat {
            corner: DVec3::ZERO,
            edges: [u * DVec3::X, v * DVec3::Y],
            normal: DVec3::Z,
            albedo: DVec3::ONE.into(),
            departure: Departure::Polygon(0),
            outline: None,
            span,
        };
        assert_eq!(wall(10.0, 10.0, 10.0).across(32, 0.1), 32, "no more than a square wall has");
        assert_eq!(wall(10.0, 40.0, 40.0).across(32, 2.0), 32, "short enough as they are");
        assert_eq!(wall(10.0, 40.0, 40.0).across(32, 1.0), 40);
        let most = wall(10.0, 40.0, 40.0);
        assert_eq!((most.across(32, 0.1), most.resolution(64, 1)), (64, [16, 64, 1]), "32² texels");
        assert_eq!(wall(10.0, 40.0, 100.0).across(32, 1.0), 32, "context geometry");
    }

    #[test]
    fn lookup_reproduces_linear_functions_between_centres() {
        let mut t = FlatTexture::black([5, 4, 3]);
        for i in 0..t.texels.len() {
            let [u, v, c] = t.centre(i);
            t.texels[i] = [u as f32, (2.0 * v + c) as f32, 1.0];
            assert_eq!(t.texel([u as f32, v as f32, c as f32]), i);
        }
        let got = t.lookup([0.37, 0.61, 0.44]);
        assert!((got - DVec3::new(0.37, 1.66, 1.0)).length() < 1e-6, "{got}");
        let corner = t.lookup([1.0, 1.0, 1.0]);
        assert!((corner - DVec3::new(1.0, 3.0, 1.0)).length() < 1e-6, "continued to the border: {corner}");
        assert_eq!(t.lookup([2.0, 1.0, 1.0]), corner, "and no further");
    }
}
