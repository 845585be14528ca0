//! Light from polygons: closed-form irradiance, and points to aim shadow rays at.

mod solid_angle;
mod spherical_fan;
mod spherical_rectangle;

pub use solid_angle::Aim;

use crate::polygon::{Polygon, clip};
use glam::DVec3;

/// Irradiance per unit radiance at `x` with unit normal `n` from a polygon that faces x: Lambert's formula
/// ½ Σ θ_i (n · γ_i) over the edges, after clipping at the receiver's horizon. 0 behind the polygon or below the
/// horizon; 2π·½ = π where the polygon fills the hemisphere. \[Lambert1760; Nishita85\]
pub fn unoccluded(polygon: &Polygon, x: DVec3, n: DVec3) -> f64 {
    if polygon.height(x) <= 0.0 {
        return 0.0;
    }
    // Edges are summed as the clipped vertices come.
    let v = polygon.vertices();
    let mut sum = 0.0;
    let (mut first, mut last): (Option<DVec3>, Option<DVec3>) = (None, None);
    let take = |p: DVec3| {
        if let Some(a) = last {
            sum += edge_term(a, p, n);
        }
        first = first.or(Some(p));
        last = Some(p);
    };
    clip(v.len(), |i| v[i] - x, |p| p.dot(n), take);
    if let (Some(a), Some(b)) = (last, first) {
        sum += edge_term(a, b, n);
    }
    // x sees the front, whose vertices run counter-clockwise: n · (a × b) is negative about the axis to it.
    (-0.5 * sum).max(0.0)
}

/// The part of `polygon` above the horizon of `x` with normal `n`, as vertices of a convex polygon; `None` if that is
/// all of it. Fewer than three vertices: nothing is above.
fn above_horizon(polygon: &Polygon, x: DVec3, n: DVec3) -> Option<Vec<DVec3>> {
    let v = polygon.vertices();
    let height = |p: DVec3| (p - x).dot(n);
    if v.iter().all(|&p| height(p) >= 0.0) {
        return None;
    }
    let mut part = Vec::with_capacity(v.len() + 1);
    clip(v.len(), |i| v[i], height, |p| part.push(p));
    Some(part)
}

/// θ n · γ of one edge: its angle seen from the origin times the projection of the edge plane's normal.
#[inline]
fn edge_term(a: DVec3, b: DVec3, n: DVec3) -> f64 {
    let cross = a.cross(b);
    let sine = cross.length();
    if sine > 0.0 { sine.atan2(a.dot(b)) * n.dot(cross) / sine } else { 0.0 }
}

/// Irradiance per unit radiance and area that a point `y` of a luminaire with unit normal `m` gives at `x` with unit
/// normal `n`: cos θ cos θ′ / r². 0 if either faces away.
#[inline]
pub fn point_term(x: DVec3, n: DVec3, y: DVec3, m: DVec3) -> f64 {
    let d = y - x;
    let r2 = d.length_squared();
    let (cos_x, cos_y) = (d.dot(n), -d.dot(m));
    if cos_x > 0.0 && cos_y > 0.0 { cos_x * cos_y / (r2 * r2) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Sobol, Stage};

    /// The rectangle [−¼, ¼]² at z = 1 facing down, and three receivers with their irradiance (design: known answers).
    fn cases() -> (Polygon, [(DVec3, DVec3, f64); 3]) {
        let v = [(-0.25, -0.25), (-0.25, 0.25), (0.25, 0.25), (0.25, -0.25)];
        let light =
            Polygon::new("light", v.map(|(x, y)| DVec3::new(x, y, 1.0)).to_vec(), DVec3::ZERO, DVec3::ONE).unwrap();
        assert_eq!(light.normal(), -DVec3::Z);
        let cases = [
            (DVec3::new(0.2, 0.3, 0.1), DVec3::Z, 0.217_520_93),
            (DVec3::new(0.1, 0.1, 0.9), DVec3::new(0.3, 0.2, 1.0).normalize(), 2.292_566_50),
            (DVec3::new(-0.8, 0.2, 0.3), DVec3::new(1.0, 0.0, -0.35).normalize(), 0.063_425_42),
        ];
        (light, cases)
    }

    #[test]
    fn closed_form() {
        let (light, cases) = cases();
        for (x, n, expected) in cases {
            let e = unoccluded(&light, x, n);
            assert!((e - expected).abs() < 1e-8, "at {x}: {e}, expected {expected}");
        }
        assert_eq!(unoccluded(&light, DVec3::new(0.0, 0.0, 1.5), -DVec3::Z), 0.0, "dark behind");
        assert_eq!(unoccluded(&light, DVec3::ZERO, -DVec3::Z), 0.0, "below the horizon");
        let close = unoccluded(&light, DVec3::new(0.0, 0.0, 1.0 - 1e-6), DVec3::Z);
        assert!((close - std::f64::consts::PI).abs() < 1e-4, "fills the hemisphere: {close}");
    }

    #[test]
    fn monte_carlo_and_quadrature_agree_with_it() {
        let (light, cases) = cases();
        for (i, (x, n, expected)) in cases.into_iter().enumerate() {
            let f = |u: [f64; 2]| point_term(x, n, light.sample(u), light.normal()) * light.area();
            let mut rng = Rng::stream(11, Stage::Test, i as u64);
            let mut m = crate::stats::Moments::default();
            (0..200_000).for_each(|_| m.push(f(rng.unit2())));
            let z = (m.mean() - expected) / m.std_error();
            assert!(z.abs() < 4.0, "independent points, case {i}: z = {z}");
            let set = Sobol::set(11, Stage::Test, i as u64);
            let q: f64 = (0..1 << 16).map(|k| f(set.point2(k, 0))).sum::<f64>() / f64::from(1 << 16);
            assert!((q / expected - 1.0).abs() < 1e-4, "low-discrepancy, case {i}: {q}");
        }
    }

    #[test]
    fn sphere_light() {
        // Far above the horizon a sphere of radius R at distance d gives πL (R/d)² cos θ; a disk through its silhouette
        // circle subtends the same cone. R = .4, d = 1.7, θ = .9: 0.10811600.
        let (radius, d, theta) = (0.4f64, 1.7f64, 0.9f64);
        let axis = DVec3::new(theta.sin(), 0.0, theta.cos());
        let f = crate::warp::Frame::new(-axis);
        let sine = radius / d;
        let (distance, r) = (d * (1.0 - sine * sine), radius * (1.0 - sine * sine).sqrt());
        let n = 4096;
        let v = (0..n)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / f64::from(n);
                axis * distance + r * f.to_world(DVec3::new(a.cos(), a.sin(), 0.0))
            })
            .collect();
        let disk = Polygon::new("disk", v, DVec3::ZERO, DVec3::ONE).unwrap();
        let e = unoccluded(&disk, DVec3::ZERO, DVec3::Z);
        assert!((e - 0.108_116_00).abs() < 1e-6, "{e}");
    }
}
