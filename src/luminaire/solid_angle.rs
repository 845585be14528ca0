//! Points of a luminaire, uniform over the solid angle under which a receiver sees it: what they give is bounded,
//! however near the luminaire is. Points uniform over the area give cos θ cos θ′/r², which is not.

use super::{above_horizon, point_term};
use crate::polygon::{Polygon, convex_area, sample_convex};
use glam::DVec3;

/// Solid angles below this are sampled by area: cancellation would show, and the area's points hardly vary.
const LEAST: f64 = 1e-5;

/// Solid angle beyond which a luminaire is near: that of a square seen from 0.8 of its edge away.
const NEAR: f64 = 1.0;

/// A luminaire as one receiver sees it.
pub struct Aim<'a> {
    polygon: &'a Polygon,
    x: DVec3,
    n: DVec3,
    /// Sampled by solid angle.
    rectangle: Option<SphericalRectangle>,
    /// What is sampled by area, if that is not all of it.
    part: Option<Vec<DVec3>>,
    area: f64,
}

impl<'a> Aim<'a> {
    /// `polygon` from `x` with unit normal `n`. Rectangles are sampled by solid angle, other polygons by area.
    pub fn new(polygon: &'a Polygon, x: DVec3, n: DVec3) -> Self {
        let in_front = (x - polygon.vertices()[0]).dot(polygon.normal()) > 0.0;
        let rectangle = if in_front { SphericalRectangle::new(polygon, x) } else { None };
        let rectangle = rectangle.filter(|r| r.solid_angle > LEAST);
        Self { polygon, x, n, rectangle, part: None, area: polygon.area() }
    }

    /// The points that tell most of what `x` sees, where the whole luminaire gives `open` > 0: by solid angle of a
    /// rectangle that fills 1 sr and more, and gives an eighth of that, so that an eighth of the points and more lie
    /// above the horizon; there points spread over the area would hardly ever fall on what a receiver sees. Otherwise
    /// over the area of the part above the horizon. `None` if that has no area.
    pub fn best(polygon: &'a Polygon, x: DVec3, n: DVec3, open: f64) -> Option<Self> {
        let mut aim = Self::new(polygon, x, n);
        let fills = aim.rectangle.as_ref().map_or(0.0, |r| r.solid_angle);
        if fills > NEAR && open > 0.125 * fills {
            return Some(aim);
        }
        aim.rectangle = None;
        aim.part = above_horizon(polygon, x, n);
        if let Some(part) = &aim.part {
            aim.area = convex_area(part);
        }
        (aim.area > 0.0).then_some(aim)
    }

    /// A point of the luminaire from two uniforms, and the irradiance per unit radiance that it gives: the mean of
    /// these is what the whole luminaire gives.
    #[inline]
    pub fn sample(&self, u: [f64; 2]) -> (DVec3, f64) {
        if let Some(r) = &self.rectangle {
            let to = r.sample(u);
            return (self.x + to, r.solid_angle * (to.normalize().dot(self.n)).max(0.0));
        }
        let y = self.part.as_ref().map_or_else(|| self.polygon.sample(u), |part| sample_convex(part, u));
        (y, self.area * point_term(self.x, self.n, y, self.polygon.normal()))
    }
}

/// A rectangle projected onto the unit sphere. \[Urena13\]
struct SphericalRectangle {
    /// Along its edges, and across it towards the other side of the receiver.
    axes: [DVec3; 3],
    /// The rectangle in these axes: ends along both edges, and the plane's coordinate, below 0.
    x: [f64; 2],
    y: [f64; 2],
    z: f64,
    /// The normals' z at the edges along x.
    b: [f64; 2],
    k: f64,
    solid_angle: f64,
}

impl SphericalRectangle {
    /// `None` if the polygon is no rectangle.
    fn new(polygon: &Polygon, o: DVec3) -> Option<Self> {
        let [e, f] = polygon.texture_edges();
        let lengths = [e.length(), f.length()];
        if !polygon.is_parallelogram() || e.dot(f).abs() > 1e-12 * lengths[0] * lengths[1] {
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
    fn sample(&self, [u, v]: [f64; 2]) -> DVec3 {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::luminaire::unoccluded;
    use crate::rng::{Sobol, Stage};

    fn rectangle(x: [f64; 2], y: [f64; 2]) -> Polygon {
        let v = [(x[0], y[0]), (x[0], y[1]), (x[1], y[1]), (x[1], y[0])];
        Polygon::new("light", v.map(|(x, y)| DVec3::new(x, y, 1.0)).to_vec(), DVec3::ZERO, DVec3::ONE).unwrap()
    }

    /// Means over the light and over one part of it against the closed form, near and far, below the horizon in part.
    #[test]
    fn means_are_the_closed_form() {
        let light = rectangle([-0.25, 0.25], [-0.1, 0.3]);
        let part = rectangle([-0.25, 0.05], [-0.1, 0.1]);
        for (i, (x, n)) in [
            (DVec3::new(0.2, 0.3, 0.1), DVec3::Z),
            (DVec3::new(0.1, 0.1, 0.9), DVec3::new(0.3, 0.2, 1.0)),
            (DVec3::new(-0.8, 0.2, 0.3), DVec3::new(1.0, 0.0, -0.35)),
            (DVec3::new(0.1, 0.0, 0.999), DVec3::new(1.0, -0.5, 0.1)),
            (DVec3::new(0.3, 0.0, 0.9999), DVec3::new(-1.0, -0.5, 0.1)),
            (DVec3::new(0.0, 0.1, 1.0 - 1e-6), DVec3::Z),
        ]
        .into_iter()
        .enumerate()
        {
            let n = n.normalize();
            let aim = Aim::new(&light, x, n);
            assert!(aim.rectangle.is_some());
            let set = Sobol::set(3, Stage::Test, i as u64);
            let open = unoccluded(&light, x, n);
            if let Some(best) = Aim::best(&light, x, n, open) {
                let mean = (0..1 << 16).map(|k| best.sample(set.point2(k, 0)).1).sum::<f64>() / f64::from(1 << 16);
                assert!(open > 0.0 && (mean - open).abs() < 2e-3 * open.max(1e-2), "receiver {i}: {mean} {open}");
            }
            let (mut whole, mut inside, count) = (0.0, 0.0, 1 << 16);
            for k in 0..count {
                let (y, w) = aim.sample(set.point2(k, 0));
                assert!(light.contains(y) || light.vertices().iter().any(|v| v.distance(y) < 1e-9), "{y}");
                assert!((0.0..=std::f64::consts::TAU).contains(&w), "bounded: {w}");
                whole += w / f64::from(count);
                inside += if part.contains(y) { w / f64::from(count) } else { 0.0 };
            }
            for (mean, polygon) in [(whole, &light), (inside, &part)] {
                let exact = unoccluded(polygon, x, n);
                assert!((mean - exact).abs() < 2e-3 * exact.max(1e-2), "receiver {i}: {mean} {exact}");
            }
        }
    }

    /// What a receiver next to a luminaire sees through a hole: π r²/(r² + h²) for a disk of radius r at height h. Of
    /// points over the area one in 80 000 would fall there.
    #[test]
    fn a_few_points_find_what_is_seen_of_a_near_luminaire() {
        let light = rectangle([-0.5, 0.5], [-0.5, 0.5]);
        let (x, h, r) = (DVec3::new(0.1, -0.2, 0.999), 0.001, 0.002);
        let aim = Aim::best(&light, x, DVec3::Z, unoccluded(&light, x, DVec3::Z)).unwrap();
        let set = Sobol::set(5, Stage::Test, 0);
        let (mut seen, mut all) = (0.0, 0.0);
        for k in 0..128 {
            let (y, g) = aim.sample(set.point2(k, 0));
            all += g;
            seen += if (y - x).truncate().length() < r { g } else { 0.0 };
        }
        assert!((seen / all - r * r / (r * r + h * h)).abs() < 0.05, "{}", seen / all);
        let far = Aim::best(&light, DVec3::ZERO, DVec3::Z, 0.5).unwrap();
        assert!(far.rectangle.is_none(), "not near");
        assert!(Aim::best(&light, x, -DVec3::Z, 0.0).is_none(), "looks away");
    }

    #[test]
    fn what_is_no_rectangle_or_far_is_sampled_by_area() {
        let v = [(0.0, 0.0), (0.1, 0.5), (0.6, 0.5), (0.5, 0.0)].map(|(x, y)| DVec3::new(x, y, 1.0));
        let skewed = Polygon::new("light", v.to_vec(), DVec3::ZERO, DVec3::ONE).unwrap();
        for (light, x) in [(&skewed, DVec3::ZERO), (&rectangle([0.0, 0.5], [0.0, 0.5]), DVec3::new(0.0, 0.0, -500.0))] {
            let aim = Aim::new(light, x, DVec3::Z);
            assert!(aim.rectangle.is_none());
            let set = Sobol::set(4, Stage::Test, 0);
            let mean = (0..1 << 14).map(|k| aim.sample(set.point2(k, 0)).1).sum::<f64>() / f64::from(1 << 14);
            assert!((mean / unoccluded(light, x, DVec3::Z) - 1.0).abs() < 1e-3);
        }
    }
}
