//! Points uniform over the solid angle of a convex polygon.

use glam::DVec3;

/// A planar convex polygon projected onto the unit sphere around a receiver, as a fan of spherical triangles.
#[derive(Debug)]
pub(super) struct SphericalFan {
    /// Towards the vertex that all triangles share.
    apex: DVec3,
    triangles: Vec<SphericalTriangle>,
    /// Towards the plane, its distance, and that of the farthest vertex.
    towards: DVec3,
    distance: f64,
    farthest: f64,
    pub(super) solid_angle: f64,
}

/// The triangle between the apex and an arc.
#[derive(Debug)]
struct SphericalTriangle {
    /// Where the arc starts, and its tangent there.
    start: DVec3,
    tangent: DVec3,
    /// |apex · (start × tangent)|, 1 + apex · start, and tangent · apex.
    volume: f64,
    beside: f64,
    along: f64,
    solid_angle: f64,
}

impl SphericalFan {
    /// The polygon with `vertices` in the plane with unit normal `m`, in front of which `x` lies. The solid angle is 0
    /// of fewer than three vertices.
    pub(super) fn new(vertices: &[DVec3], m: DVec3, x: DVec3) -> Self {
        let to = |v: &DVec3| *v - x;
        let directions: Vec<DVec3> = vertices.iter().map(|v| to(v).normalize_or_zero()).collect();
        let apex = directions.first().copied().unwrap_or_default();
        let arcs = directions.get(1..).unwrap_or_default().windows(2);
        let triangles: Vec<_> = arcs.map(|arc| SphericalTriangle::new(apex, arc[0], arc[1])).collect();
        let solid_angle = triangles.iter().map(|triangle| triangle.solid_angle).sum();
        let distance = vertices.first().map_or(0.0, |v| -to(v).dot(m));
        let farthest = vertices.iter().map(|v| to(v).length()).fold(0.0, f64::max);
        Self { apex, triangles, towards: -m, distance, farthest, solid_angle }
    }

    /// A point of the polygon, from the receiver. \[Arvo95\]
    #[inline]
    pub(super) fn sample(&self, [u, v]: [f64; 2]) -> DVec3 {
        let mut rest = u * self.solid_angle;
        let mut triangles = self.triangles.iter();
        let mut triangle = triangles.next().expect("a fan that is sampled has an area");
        for next in triangles {
            if rest < triangle.solid_angle {
                break;
            }
            rest -= triangle.solid_angle;
            triangle = next;
        }
        let end = triangle.cut(rest.min(triangle.solid_angle));
        // The height of the cap around the apex is uniform along the arc to it.
        let height = 0.5 * v * (end - self.apex).length_squared();
        let across = (end - end.dot(self.apex) * self.apex).normalize_or_zero();
        let direction = (1.0 - height) * self.apex + (height * (2.0 - height)).max(0.0).sqrt() * across;
        direction * (self.distance / direction.dot(self.towards).max(self.distance / self.farthest))
    }
}

impl SphericalTriangle {
    /// Unit vectors; `solid_angle` by \[VanOosterom83\].
    fn new(apex: DVec3, start: DVec3, end: DVec3) -> Self {
        let tangent = (end - start - (end - start).dot(start) * start).normalize_or_zero();
        let (beside, along) = (1.0 + apex.dot(start), tangent.dot(apex));
        let volume = apex.dot(start.cross(end)).abs();
        let solid_angle = 2.0 * volume.atan2(beside + end.dot(apex) + start.dot(end));
        Self { start, tangent, volume: apex.dot(start.cross(tangent)).abs(), beside, along, solid_angle }
    }

    /// The point of the arc that cuts `solid_angle` off the triangle, on the start's side. With τ = tan ½t of the
    /// point t along the arc, tan ½Ω of what is cut off \[VanOosterom83\] is τ · volume / (beside + τ · along).
    #[inline]
    fn cut(&self, solid_angle: f64) -> DVec3 {
        let (sine, cosine) = (0.5 * solid_angle).sin_cos();
        let (a, b) = (sine * self.beside, (cosine * self.volume - sine * self.along).max(0.0));
        let length2 = a * a + b * b;
        if length2 > 0.0 { ((b * b - a * a) * self.start + 2.0 * a * b * self.tangent) / length2 } else { self.start }
    }
}
