//! Planar convex polygons of R³: walls and luminaires, extruded over the sweep's isovalue range by standing in every
//! hyperplane alike. \[BB09 §2.3: p × I\]

use crate::emission;
use crate::error::{Error, Result};
use crate::flattened::{Departure, Ends, FlattenedRay};
use crate::volume::Lattice;
use glam::{DVec2, DVec3};
use std::ops::{Add, Mul, Sub};

/// A planar convex polygon in world coordinates, counter-clockwise seen from its front.
///
/// Walls are seen, lit and light from the front only; from behind they are not there. A luminaire (`emission` ≠ 0 and
/// `opaque_back`) blocks light from both sides and emits from its front. Context geometry is two polygons back to back,
/// [`Polygon::both_faces`].
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    /// Name of the wall, the `o`, `g` or material of an OBJ file.
    pub name: String,
    vertices: Vec<DVec3>,
    normal: DVec3,
    area: f64,
    corner: DVec3,
    edges: [DVec3; 2],
    /// Diffuse reflectance per channel, [0, 1].
    pub albedo: DVec3,
    /// Emitted radiance L_e per channel.
    pub emission: DVec3,
    /// Whether the back blocks light: that of luminaires with one face, says [`crate::scene::Scene::new`], and of no
    /// others.
    pub opaque_back: bool,
    /// What to add to this polygon's number in a scene for that of its other face; 0 if it has none.
    pub other_face: i32,
}

impl Polygon {
    /// A polygon of at least three vertices; `albedo` in [0, 1], `emission` as [`emission::check`] takes it. Emitters
    /// block light from both sides. Of neighbouring vertices that coincide (1e-12 of its size) one is kept.
    ///
    /// # Errors
    /// `Invalid` if it has no area, is not planar (1e-5 of its size), not convex, or a coefficient is out of range.
    pub fn new(name: &str, mut vertices: Vec<DVec3>, albedo: DVec3, emission: DVec3) -> Result<Self> {
        let fail = |what: String| Err(Error::Invalid(format!("polygon '{name}': {what}")));
        if vertices.len() < 3 || !vertices.iter().all(|v| v.is_finite()) {
            return fail(format!("{} vertices; it needs at least 3 finite ones", vertices.len()));
        }
        let base = vertices[0];
        let size = vertices.iter().map(|&v| (v - base).length()).fold(0.0, f64::max);
        // An edge of no length has no direction.
        let coincide = |a: DVec3, b: DVec3| (a - b).length() <= 1e-12 * size;
        vertices.dedup_by(|a, b| coincide(*a, *b));
        while vertices.len() > 1 && coincide(vertices[vertices.len() - 1], base) {
            vertices.pop();
        }
        // Twice the vector area: independent of which vertex comes first.
        let n = vertices.len();
        let twice: DVec3 = (2..n).map(|i| (vertices[i - 1] - base).cross(vertices[i] - base)).sum();
        let area = 0.5 * twice.length();
        if !(area > 1e-12 * size * size) {
            return fail(format!(
                "area {area:.3e} for a size of {size:.3e}; its vertices coincide or stand in one line"
            ));
        }
        let normal = twice.normalize();
        if let Some(i) = (0..n).find(|&i| (vertices[i] - base).dot(normal).abs() > 1e-5 * size) {
            return fail(format!("vertex {} leaves the plane of the others; split it into triangles", i + 1));
        }
        let turn = |i: usize| {
            let (a, b, c) = (vertices[i], vertices[(i + 1) % n], vertices[(i + 2) % n]);
            (b - a).cross(c - b).dot(normal)
        };
        if let Some(i) = (0..n).find(|&i| turn(i) < -1e-9 * size * size) {
            return fail(format!("not convex at vertex {}; split it into triangles", (i + 1) % n + 1));
        }
        // A pentagram turns left everywhere, twice around.
        let angle = |i: usize| {
            let [a, b] = [1, 2].map(|k| vertices[(i + k) % n] - vertices[(i + k - 1) % n]);
            a.cross(b).dot(normal).atan2(a.dot(b))
        };
        let turns = (0..n).map(angle).sum::<f64>() / std::f64::consts::TAU;
        if turns > 1.5 {
            return fail(format!("winds {turns:.0} times around; split it into triangles"));
        }
        let (corner, edges) = parametrise(&vertices, normal);
        let opaque_back = emission != DVec3::ZERO;
        let polygon = Self {
            name: name.to_owned(),
            vertices,
            normal,
            area,
            corner,
            edges,
            albedo,
            emission,
            opaque_back,
            other_face: 0,
        };
        polygon.check()?;
        Ok(polygon)
    }

    /// Whether it reflects no more than it receives, and f32 holds what it emits.
    ///
    /// # Errors
    /// `Invalid` for an albedo or an emission out of range.
    pub(crate) fn check(&self) -> Result<()> {
        let fail = |what: String| Err(Error::Invalid(format!("polygon '{}': {what}", self.name)));
        let albedo = self.albedo;
        if !(albedo.cmpge(DVec3::ZERO).all() && albedo.cmple(DVec3::ONE).all()) {
            return fail(format!("albedo {albedo} must lie in [0, 1]"));
        }
        emission::check(self.emission).or_else(|e| fail(e.to_string()))
    }

    /// The polygon as its two faces, one after the other: seen, lit and, if it emits, light from both sides. They must
    /// stay neighbours in that order.
    #[must_use]
    pub fn both_faces(self) -> [Self; 2] {
        let front = Self { opaque_back: false, other_face: 1, ..self };
        let vertices: Vec<DVec3> = front.vertices.iter().rev().copied().collect();
        let normal = -front.normal;
        let (corner, edges) = parametrise(&vertices, normal);
        let name = format!("{}_back", front.name);
        let back = Self { name, vertices, normal, corner, edges, other_face: -1, ..front.clone() };
        [front, back]
    }

    /// Moves it.
    pub(crate) fn translate(&mut self, by: DVec3) {
        self.vertices.iter_mut().for_each(|x| *x += by);
        self.corner += by;
    }

    /// Texture coordinates of the vertices, counter-clockwise.
    pub fn outline(&self) -> Vec<[f64; 2]> {
        self.vertices.iter().map(|&x| self.texture(x)).collect()
    }

    /// Vertices, counter-clockwise from the front.
    pub fn vertices(&self) -> &[DVec3] {
        &self.vertices
    }

    /// The mean of the vertices.
    pub fn middle(&self) -> DVec3 {
        self.vertices.iter().sum::<DVec3>() / self.vertices.len() as f64
    }

    /// Unit normal of the front.
    pub fn normal(&self) -> DVec3 {
        self.normal
    }

    /// How far world point `x` is before the polygon's plane; negative behind it.
    #[inline]
    pub fn height(&self, x: DVec3) -> f64 {
        (x - self.vertices[0]).dot(self.normal)
    }

    /// World area.
    pub fn area(&self) -> f64 {
        self.area
    }

    /// World position of texture coordinates (u, v) ∈ [0, 1]²: along the edges of a parallelogram, along the first edge
    /// and across it over the bounding rectangle of any other polygon.
    #[inline]
    pub fn at(&self, [u, v]: [f64; 2]) -> DVec3 {
        self.corner + u * self.edges[0] + v * self.edges[1]
    }

    /// The vectors of u and v.
    pub fn texture_edges(&self) -> [DVec3; 2] {
        self.edges
    }

    /// Texture coordinates of a point of the plane.
    #[inline]
    pub fn texture(&self, x: DVec3) -> [f64; 2] {
        let [e, f] = self.edges;
        let d = x - self.corner;
        // Gram system of the two edges, which need not be perpendicular.
        let (ee, ef, ff) = (e.dot(e), e.dot(f), f.dot(f));
        let (de, df) = (d.dot(e), d.dot(f));
        let det = ee * ff - ef * ef;
        [(de * ff - df * ef) / det, (df * ee - de * ef) / det]
    }

    /// A point uniform over the area from two uniforms: straight through (u, v) for parallelograms, which keeps strata
    /// whole, by the triangle fan otherwise.
    pub fn sample(&self, u: [f64; 2]) -> DVec3 {
        if self.is_parallelogram() {
            return self.at(u);
        }
        sample_convex(&self.vertices, u)
    }

    /// Whether what leaves from `departure` leaves from this polygon, number `id`, or from its other face.
    #[inline]
    pub fn is_left(&self, id: u32, departure: Departure) -> bool {
        departs(departure, id, self.other_face)
    }

    /// Whether a point of the plane lies inside.
    pub fn contains(&self, x: DVec3) -> bool {
        let (v, n) = (&self.vertices, self.vertices.len());
        (0..n).all(|i| (v[(i + 1) % n] - v[i]).cross(x - v[i]).dot(self.normal) >= 0.0)
    }

    /// Distance of a point of the world.
    pub fn distance(&self, x: DVec3) -> f64 {
        let (v, n) = (&self.vertices, self.vertices.len());
        let height = self.height(x);
        if self.contains(x - height * self.normal) {
            return height.abs();
        }
        let to_edge = |i: usize| {
            let (a, edge) = (v[i], v[(i + 1) % n] - v[i]);
            let t = ((x - a).dot(edge) / edge.length_squared()).clamp(0.0, 1.0);
            (x - a - t * edge).length()
        };
        (0..n).map(to_edge).fold(f64::INFINITY, f64::min)
    }

    /// Whether a point of the world is less than `reach` away.
    pub fn is_nearer(&self, x: DVec3, reach: f64) -> bool {
        // Its plane is no farther.
        self.height(x).abs() < reach && self.distance(x) < reach
    }

    /// Whether texture coordinates cover the polygon exactly.
    pub fn is_parallelogram(&self) -> bool {
        is_parallelogram(&self.vertices)
    }
}

/// How far, as a share of its size, a parallelogram or rectangle may be off: as coordinates of six digits, and those
/// of f64 far from the origin, put it. As far as vertices may leave their plane.
pub(crate) const SQUARE: f64 = 1e-5;

fn is_parallelogram(v: &[DVec3]) -> bool {
    v.len() == 4 && (v[0] + v[2] - v[1] - v[3]).length() <= SQUARE * (v[2] - v[0]).length()
}

/// Area of triangle `i` of the fan of a planar convex polygon.
fn fan_area(v: &[DVec3], i: usize) -> f64 {
    0.5 * (v[i + 1] - v[0]).cross(v[i + 2] - v[0]).length()
}

/// Area of the planar convex polygon `v`; 0 of fewer than three vertices.
pub fn convex_area(v: &[DVec3]) -> f64 {
    (0..v.len().saturating_sub(2)).map(|i| fan_area(v, i)).sum()
}

/// A point uniform over the area of the planar convex polygon `v` of at least three vertices, by its triangle fan.
pub fn sample_convex(v: &[DVec3], u: [f64; 2]) -> DVec3 {
    let last = v.len() - 3;
    let mut rest = u[0] * convex_area(v);
    for i in 0..=last {
        let area = fan_area(v, i);
        if rest < area || i == last {
            let [s, t] = crate::warp::triangle([if area > 0.0 { (rest / area).min(1.0) } else { 0.0 }, u[1]]);
            return v[0] + s * (v[i + 1] - v[0]) + t * (v[i + 2] - v[0]);
        }
        rest -= area;
    }
    unreachable!("the last triangle takes the rest")
}

/// Corner and edges of the texture of a planar polygon.
fn parametrise(v: &[DVec3], normal: DVec3) -> (DVec3, [DVec3; 2]) {
    if is_parallelogram(v) {
        return (v[0], [v[1] - v[0], v[3] - v[0]]);
    }
    let s = (v[1] - v[0]).normalize();
    let t = normal.cross(s);
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for &x in v {
        let p = DVec2::new((x - v[0]).dot(s), (x - v[0]).dot(t));
        (lo, hi) = (lo.min(p), hi.max(p));
    }
    (v[0] + lo.x * s + lo.y * t, [(hi.x - lo.x) * s, (hi.y - lo.y) * t])
}

/// A polygon in the local frame, ready to be met by rays: plane and edges in f64.
#[derive(Clone, Debug)]
pub struct LocalPolygon {
    normal: DVec3,
    offset: f64,
    /// World slope of a ray per local slope.
    stretch: f64,
    /// How far behind the plane a start may lie by the rounding of f32 coordinates and still count as on it.
    slack: f64,
    /// Inside is where every edge's plane is not negative: (normal of the edge in the polygon's plane, offset).
    edges: Vec<(DVec3, f64)>,
    lo: DVec3,
    hi: DVec3,
    opaque_back: bool,
    /// Whether it lies in a face of Ω with its front away from Ω.
    looks_away: bool,
    other_face: i32,
}

/// The corners, in order, of the part of a convex polygon of `count` corners where `height`, which is linear, is not
/// negative. \[Sutherland74\]
#[inline]
pub(crate) fn clip<P>(count: usize, corner: impl Fn(usize) -> P, height: impl Fn(P) -> f64, mut take: impl FnMut(P))
where
    P: Copy + Add<Output = P> + Sub<Output = P> + Mul<f64, Output = P>,
{
    for i in 0..count {
        let (a, b) = (corner(i), corner((i + 1) % count));
        let (ha, hb) = (height(a), height(b));
        if ha >= 0.0 {
            take(a);
        }
        if (ha >= 0.0) != (hb >= 0.0) {
            take(a + (b - a) * (ha / (ha - hb)));
        }
    }
}

/// Whether `departure` is polygon `id`, or its other face.
#[inline]
fn departs(departure: Departure, id: u32, other_face: i32) -> bool {
    matches!(departure, Departure::Polygon(from) if from == id || from == id.wrapping_add_signed(other_face))
}

impl LocalPolygon {
    /// `polygon` in the index coordinates of `lattice`.
    pub fn new(polygon: &Polygon, lattice: &Lattice) -> Self {
        let v: Vec<DVec3> = polygon.vertices.iter().map(|&x| lattice.to_index(x)).collect();
        // The world normal's plane in local coordinates; flipped axes turn the winding, not the plane.
        let axes = lattice.axes();
        let normal = axes.transpose() * polygon.normal;
        let stretch = normal.length();
        let normal = normal / stretch;
        let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for &p in &v {
            (lo, hi) = (lo.min(p), hi.max(p));
        }
        let centre = v.iter().sum::<DVec3>() / v.len() as f64;
        let size = (hi - lo).length();
        let edges = (0..v.len())
            .map(|i| {
                let (a, b) = (v[i], v[(i + 1) % v.len()]);
                let mut e = normal.cross(b - a).normalize();
                if e.dot(centre - a) < 0.0 {
                    e = -e;
                }
                // 1e-9 of the size: two walls that share an edge leave no slit between them.
                (e, e.dot(a) - 1e-9 * size)
            })
            .collect();
        let reach = lo.abs().max(hi.abs()).max_element().max(1.0);
        let slack = 8.0 * f64::from(f32::EPSILON) * reach;
        let Polygon { opaque_back, other_face, .. } = *polygon;
        let far = lattice.far();
        let looks_away = (0..3).any(|a| {
            let lies_in = |plane: f64| lo[a].min(hi[a]) >= plane - slack && lo[a].max(hi[a]) <= plane + slack;
            (lies_in(0.0) && normal[a] < 0.0) || (lies_in(far[a]) && normal[a] > 0.0)
        });
        Self { normal, offset: normal.dot(v[0]), stretch, slack, edges, lo, hi, opaque_back, looks_away, other_face }
    }

    /// Bounds in the local frame.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        (self.lo, self.hi)
    }

    /// t at which `ray` meets polygon number `id` (this one) with 0 ≤ t ≤ `reach`. Fronts only, unless the back is
    /// opaque, or stops light that comes from well behind it. A ray that departs from it or its other face, or ends on
    /// it, does not meet it; one that starts on the plane (within the rounding of f32 coordinates) and goes into it
    /// meets it at 0, unless it lies in a face of Ω and looks away from Ω, where all is that starts there.
    #[inline]
    pub fn intersect(&self, id: u32, ends: Ends, o: DVec3, d: DVec3, reach: f64) -> Option<f64> {
        let slope = self.normal.dot(d);
        let dark_back = slope > 0.0 && !self.opaque_back;
        // How far before it a ray starts at least.
        let least = if dark_back || (slope < 0.0 && self.looks_away) { self.slack } else { -self.slack };
        if slope == 0.0 || (dark_back && !(ends.with_light && self.other_face == 0)) || ends.target == Some(id) {
            return None;
        }
        if departs(ends.departure, id, self.other_face) {
            return None;
        }
        let height = self.normal.dot(o) - self.offset;
        let before = if slope < 0.0 { height } else { -height };
        if before < least {
            return None;
        }
        let t = (before / slope.abs()).max(0.0);
        let p = o + t * d;
        // A front in the same plane as a back counts first.
        let t = if dark_back { t + (self.slack / slope).max(1e-6 * t) } else { t };
        (t <= reach && self.edges.iter().all(|&(e, offset)| e.dot(p) >= offset)).then_some(t)
    }

    /// If a ray from `o` along `d` that meets this polygon starts on its plane, within the rounding of f32 coordinates:
    /// how fast it goes in, in the world. Where several walls meet, a start on their edge lies on all of them, and the
    /// one it goes into fastest is the one that a ray from beside the edge meets first: the same wall in every frame.
    #[inline]
    pub fn starts_on(&self, o: DVec3, d: DVec3) -> Option<f64> {
        let on = (self.normal.dot(o) - self.offset).abs() <= self.slack;
        on.then(|| self.stretch * self.normal.dot(d).abs())
    }

    /// [`LocalPolygon::intersect`] for a whole ray.
    pub fn meet(&self, id: u32, ray: &FlattenedRay) -> Option<f64> {
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        self.intersect(id, ray.ends(), o, d, f64::from(ray.reach))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};
    use glam::DMat3;

    fn square() -> Polygon {
        let v = [(0., 0.), (2., 0.), (2., 1.), (0., 1.)].map(|(x, y)| DVec3::new(x, y, 3.0)).to_vec();
        Polygon::new("s", v, DVec3::ONE, DVec3::ZERO).unwrap()
    }

    /// Survey coordinates, and what a modeller writes with six digits.
    #[test]
    fn rounded_rectangles_are_rectangles() {
        let mut rng = Rng::stream(6, Stage::Test, 0);
        let mut most = 0f64;
        for (far, digits) in [(2e5, 1e15), (0.3, 1e6)] {
            for _ in 0..1000 {
                let mut unit = || DVec3::new(rng.unit(), rng.unit(), rng.unit());
                let (shift, turn) = (far * unit(), unit() * std::f64::consts::TAU);
                let turn = DMat3::from_euler(glam::EulerRot::XYZ, turn.x, turn.y, turn.z);
                let e = [0.6 * turn.x_axis, 0.5 * turn.y_axis];
                let corners = [shift, shift + e[0], shift + e[0] + e[1], shift + e[1]];
                let rounded = corners.map(|x| (x * digits).round() / digits);
                most = most.max((rounded[0] + rounded[2] - rounded[1] - rounded[3]).length());
                let p = Polygon::new("s", rounded.to_vec(), DVec3::ONE, DVec3::ONE).unwrap();
                assert!(p.is_parallelogram(), "{shift}");
                let [e, f] = p.texture_edges();
                assert!(e.dot(f).abs() <= SQUARE * e.length() * f.length(), "{shift}");
                assert!((p.area() - 0.3).abs() < 2e-6);
            }
        }
        assert!(most > 1.5e-6, "nothing was rounded");
        let off = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::new(0.001, 1.0, 0.0)];
        assert!(!Polygon::new("s", off.to_vec(), DVec3::ONE, DVec3::ONE).unwrap().is_parallelogram());
    }

    #[test]
    fn geometry_of_a_rectangle() {
        let s = square();
        assert_eq!((s.area(), s.normal()), (2.0, DVec3::Z));
        assert_eq!(s.at([0.5, 1.0]), DVec3::new(1.0, 1.0, 3.0));
        assert_eq!(s.texture(DVec3::new(1.0, 1.0, 3.0)), [0.5, 1.0]);
    }

    #[test]
    fn distances_to_face_edge_and_corner() {
        let turned = DMat3::from_axis_angle(DVec3::new(2.0, -1.0, 3.0).normalize(), 1.1);
        for (turn, away) in [(DMat3::IDENTITY, DVec3::ZERO), (turned, DVec3::new(40.0, -70.0, 90.0))] {
            let vertices = square().vertices().iter().map(|v| away + turn * *v).collect();
            let p = Polygon::new("s", vertices, DVec3::ONE, DVec3::ZERO).unwrap();
            let [a, b, _, d] = p.vertices().try_into().unwrap();
            let (s, t) = ((b - a).normalize(), (d - a).normalize());
            let middle = 0.5 * (b + d);
            for (x, expected) in [
                (middle + 0.3 * p.normal(), 0.3),
                (middle - 0.3 * p.normal(), 0.3),
                (0.5 * (a + d) - 0.3 * s + 0.4 * p.normal(), 0.5),
                (a - 0.2 * s - 0.2 * t + 0.1 * p.normal(), 0.3),
            ] {
                assert!((p.distance(x) - expected).abs() < 1e-12, "{x}: {} {expected}", p.distance(x));
                assert!(p.is_nearer(x, expected + 1e-9) && !p.is_nearer(x, expected - 1e-9), "{x}");
            }
        }
    }

    #[test]
    fn samples_are_uniform_over_a_pentagon() {
        let v: Vec<DVec3> = (0..5)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / 5.0;
                DVec3::new(a.cos(), a.sin(), 0.0)
            })
            .collect();
        let p = Polygon::new("p", v, DVec3::ONE, DVec3::ZERO).unwrap();
        let n = 256;
        let mean: DVec3 = (0..n * n)
            .map(|i| p.sample([(f64::from(i % n) + 0.5) / f64::from(n), (f64::from(i / n) + 0.5) / f64::from(n)]))
            .sum::<DVec3>()
            / f64::from(n * n);
        assert!(mean.length() < 1e-3, "{mean}: the centroid of a regular pentagon is its centre");
    }

    #[test]
    fn rejects_what_is_no_polygon() {
        // Every so many of seven corners.
        let star = |step: u32| -> Vec<(f64, f64, f64)> {
            (0..7).map(|n| f64::from(n * step) * std::f64::consts::TAU / 7.0).map(|a| (a.cos(), a.sin(), 5.0)).collect()
        };
        let p = |v: &[(f64, f64, f64)]| {
            Polygon::new("x", v.iter().map(|&(x, y, z)| DVec3::new(x, y, z)).collect(), DVec3::ONE, DVec3::ZERO)
        };
        for (vertices, word) in [
            (vec![(0., 0., 0.), (1., 0., 0.)], "vertices"),
            (vec![(0., 0., 0.), (1., 0., 0.), (2., 0., 0.)], "area"),
            (vec![(0., 0., 0.), (1., 0., 0.), (1., 1., 0.1), (0., 1., 0.)], "plane"),
            (vec![(0., 0., 0.), (2., 0., 0.), (0.5, 0.5, 0.), (0., 2., 0.)], "convex"),
            (star(2), "2 times around"),
            (star(3), "3 times around"),
        ] {
            assert!(p(&vertices).unwrap_err().to_string().contains(word), "{word}");
        }
        assert!(p(&star(1)).is_ok());
    }

    #[test]
    fn two_faces_see_both_sides_and_not_each_other() {
        let lattice = Lattice::aligned([4, 4, 8], DVec3::ZERO, DVec3::ONE).unwrap();
        let faces = square().both_faces();
        assert_eq!(faces[1].normal(), -DVec3::Z);
        let local = faces.each_ref().map(|p| LocalPolygon::new(p, &lattice));
        let met = |ray: &FlattenedRay| [local[0].meet(6, ray), local[1].meet(7, ray)];
        let above = FlattenedRay::free(glam::Vec3::new(1.5, 0.5, 5.0), -glam::Vec3::Z, 0.0);
        let below = FlattenedRay::free(glam::Vec3::new(1.5, 0.5, 1.0), glam::Vec3::Z, 0.0);
        assert_eq!((met(&above), met(&below)), ([Some(2.0), None], [None, Some(2.0)]));
        for (face, direction) in [(6, glam::Vec3::Z), (7, -glam::Vec3::Z)] {
            let on = FlattenedRay::free(glam::Vec3::new(1.5, 0.5, 3.0), direction, 0.0);
            assert_eq!(met(&FlattenedRay { departure: Departure::Polygon(face), ..on }), [None, None]);
            assert!(met(&on).iter().any(Option::is_some));
        }
    }

    #[test]
    fn fronts_backs_starts_and_ends() {
        let axes = DMat3::from_cols(-DVec3::X, DVec3::Y, 2.0 * DVec3::Z);
        let lattice = Lattice::new([4, 4, 4], DVec3::new(1.0, 0.0, 0.0), axes).unwrap();
        let wall = LocalPolygon::new(&square(), &lattice);
        let local = |x: f64, y: f64, z: f64| lattice.to_index(DVec3::new(x, y, z)).as_vec3();
        let down = lattice.direction_to_index(-DVec3::Z).as_vec3();
        let ray = FlattenedRay::free(local(1.5, 0.5, 5.0), down, 0.0);
        assert_eq!(wall.meet(0, &ray), Some(2.0), "t is in world units");
        let behind = FlattenedRay::free(local(1.5, 0.5, 1.0), -down, 0.0);
        assert_eq!(wall.meet(0, &behind), None, "seen from the front only");
        let light = FlattenedRay { with_light: true, ..behind };
        let t = wall.meet(0, &light).expect("light from behind is stopped");
        assert!(t > 2.0 && t < 2.0001, "after a front in the same plane: {t}");
        let on = FlattenedRay { origin: local(1.5, 0.5, 3.0), ..light };
        assert_eq!(wall.meet(0, &on), None, "what begins on a wall is before it");
        let faces = square().both_faces().map(|p| LocalPolygon::new(&p, &lattice));
        let met = [0, 1].map(|n| faces[n].meet(n as u32, &light));
        assert_eq!(met, [None, Some(2.0)], "of two faces light meets the front");
        let on = FlattenedRay::free(local(1.5, 0.5, 3.0), down, 0.0);
        assert_eq!(wall.meet(0, &on), Some(0.0), "a start on the plane sees it at 0");
        assert_eq!(wall.meet(0, &FlattenedRay { departure: Departure::Polygon(0), ..on }), None);
        assert_eq!(wall.meet(0, &FlattenedRay { target: Some(0), ..ray }), None);
        assert_eq!(wall.meet(1, &FlattenedRay { target: Some(0), ..ray }), Some(2.0));
        assert_eq!(wall.meet(0, &FlattenedRay::free(local(2.5, 0.5, 5.0), down, 0.0)), None);
    }
}
