//! Points uniform over the solid angle of a rectangle.

use crate::polygon::{Polygon, SQUARE};
use glam::DVec3;

/// A rectangle projected onto the unit sphere. \[Urena13\]
#[derive(Debug)]
pub(super) struct SphericalRectangle {
    /// Along its edges, and across it towards the other side of the receiver.
    axes: [DVec3; 3],
    /// The rectangle in these axes: ends along both edges, and the plane's coordinate, below 0.
    x: [f64; 2],
    y: [f64; 2],
    z: f64,
    /// The normals' z at the edges along x.
    b: [f64; 2],
    k: f64,
    pub(super) solid_angle: f64,
}

impl SphericalRectangle {
    /// `None` if the polygon is no rectangle.
    pub(super) fn new(polygon: &Polygon, o: DVec3) -> Option<Self> {
        let [e, f] = polygon.texture_edges();
        let lengths = [e.length(), f.length()];
        if !polygon.is_parallelogram() || e.dot(f).abs() > SQUARE * lengths[0] * lengths[1] {
            return None;
        }
        let (ex, ey) = (e / lengths[0], f / lengths[1]);
        let d = polygon.at([0.0, 0.0]) - o;
        let across = ex.cross(ey);
        let ez = if d.dot(across) > 0.0 { -across } else { across };
        let (x0, y0, z) = (d.dot(ex), d.dot(ey), d.dot(ez));
        let (x, y) = ([x0, x0 + lengths[0]], [y0, y0 + lengths[1]]);
        let corner = |i: usize, j: usize| DVec3::new(x[i], y[j], z);
        let normal = |a: DVec3, b: DVec3| a.cross(b).normalize_or_zero();
        let n = [
            normal(corner(0, 0), corner(1, 0)),
            normal(corner(1, 0), corner(1, 1)),
            normal(corner(1, 1), corner(0, 1)),
            normal(corner(0, 1), corner(0, 0)),
        ];
        let angle = |i: usize| (-n[i].dot(n[(i + 1) % 4])).clamp(-1.0, 1.0).acos();
        let k = std::f64::consts::TAU - angle(2) - angle(3);
        let solid_angle = angle(0) + angle(1) - k;
        Some(Self { axes: [ex, ey, ez], x, y, z, b: [n[0].z, n[2].z], k, solid_angle })
    }

    /// A point of the rectangle, from the receiver.
    #[inline]
    pub(super) fn sample(&self, [u, v]: [f64; 2]) -> DVec3 {
        let (sine, cosine) = (u * self.solid_angle + self.k).sin_cos();
        let f = (cosine * self.b[0] - self.b[1]) / sine;
        let c = (1.0 / (f * f + self.b[0] * self.b[0]).sqrt()).copysign(f).clamp(-1.0, 1.0);
        let x = (-c * self.z / (1.0 - c * c).sqrt().max(1e-12)).clamp(self.x[0], self.x[1]);
        let d2 = x * x + self.z * self.z;
        let [h0, h1] = self.y.map(|y| y / (d2 + y * y).sqrt());
        let h = h0 + v * (h1 - h0);
        let y = (h * (d2 / (1.0 - h * h).max(1e-24)).sqrt()).clamp(self.y[0], self.y[1]);
        let [ex, ey, ez] = self.axes;
        x * ex + y * ey + self.z * ez
    }
}
