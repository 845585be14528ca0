//! Maps from the unit square to the distributions that light needs, each beside its density.

use glam::DVec3;
use std::f64::consts::{PI, TAU};

/// An orthonormal frame whose third axis is a given unit normal. \[Duff17\]
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// First tangent.
    pub s: DVec3,
    /// Second tangent.
    pub t: DVec3,
    /// The normal.
    pub n: DVec3,
}

impl Frame {
    /// The frame of unit normal `n`; continuous but for the plane n.z = 0.
    #[inline]
    pub fn new(n: DVec3) -> Self {
        let sign = 1f64.copysign(n.z);
        let a = -1.0 / (sign + n.z);
        let b = n.x * n.y * a;
        Self {
            s: DVec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
            t: DVec3::new(b, sign + n.y * n.y * a, -n.y),
            n,
        }
    }

    /// A local direction (z along the normal) in the world.
    #[inline]
    pub fn to_world(&self, d: DVec3) -> DVec3 {
        self.s * d.x + self.t * d.y + self.n * d.z
    }
}

/// Concentric map of the unit square onto the unit disk: area-preserving, so strata stay compact. \[Shirley97\]
#[inline]
pub fn disk([u, v]: [f64; 2]) -> [f64; 2] {
    let (x, y) = (2.0 * u - 1.0, 2.0 * v - 1.0);
    if x == 0.0 && y == 0.0 {
        return [0.0, 0.0];
    }
    let (r, phi) = if x.abs() > y.abs() { (x, PI / 4.0 * (y / x)) } else { (y, PI / 2.0 - PI / 4.0 * (x / y)) };
    [r * phi.cos(), r * phi.sin()]
}

/// Directions about +z with density cos θ / π (Malley's method). Never below the horizon.
#[inline]
pub fn cosine_hemisphere(u: [f64; 2]) -> DVec3 {
    let [x, y] = disk(u);
    DVec3::new(x, y, (1.0 - x * x - y * y).max(0.0).sqrt())
}

/// Density of [`cosine_hemisphere`] per steradian.
#[inline]
pub fn cosine_hemisphere_pdf(d: DVec3) -> f64 {
    d.z.max(0.0) / PI
}

/// Directions uniform on the unit sphere.
#[inline]
pub fn sphere([u, v]: [f64; 2]) -> DVec3 {
    let z = 1.0 - 2.0 * u;
    let r = (1.0 - z * z).max(0.0).sqrt();
    DVec3::new(r * (TAU * v).cos(), r * (TAU * v).sin(), z)
}

/// Density of [`sphere`] per steradian.
#[inline]
pub fn sphere_pdf() -> f64 {
    1.0 / (4.0 * PI)
}

/// Points uniform in the unit ball from three uniforms.
#[inline]
pub fn ball([u, v]: [f64; 2], w: f64) -> DVec3 {
    sphere([u, v]) * w.cbrt()
}

/// Barycentric weights of the second and third corner, uniform over a triangle: √u is how far from the first corner,
/// v where across.
#[inline]
pub fn triangle([u, v]: [f64; 2]) -> [f64; 2] {
    let r = u.sqrt();
    [r * (1.0 - v), r * v]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};
    use crate::stats::{chi_square_p, sidak};

    /// χ² of 200 000 draws over `bins` equal-probability-free bins with expected shares `p`.
    fn chi2(bins: usize, p: impl Fn(usize) -> f64, draw: impl Fn(&mut Rng) -> usize) -> f64 {
        let n = 200_000u32;
        let mut counts = vec![0u32; bins];
        let mut rng = Rng::stream(42, Stage::Test, bins as u64);
        for _ in 0..n {
            counts[draw(&mut rng)] += 1;
        }
        let statistic: f64 = (0..bins)
            .map(|b| {
                let e = p(b) * f64::from(n);
                (f64::from(counts[b]) - e).powi(2) / e
            })
            .sum();
        chi_square_p(statistic, bins - 1)
    }

    #[test]
    fn samplers_agree_with_their_densities() {
        let level = sidak(0.01, 5);
        // Bands of z times sectors of φ; the share of a band is the density integrated over it.
        let (nz, nphi) = (10usize, 16usize);
        let sector = |x: f64, y: f64| (((y.atan2(x) / TAU + 1.0) % 1.0) * nphi as f64) as usize % nphi;
        let p = chi2(
            nz * nphi,
            |b| {
                let z = (b / nphi) as f64 / nz as f64;
                let dz = 1.0 / nz as f64;
                // ∫ pdf dω over the band: pdf is linear in z, so the midpoint is exact.
                cosine_hemisphere_pdf(DVec3::new(0.0, 0.0, z + dz / 2.0)) * TAU * dz / nphi as f64
            },
            |rng| {
                let d = cosine_hemisphere(rng.unit2());
                ((d.z * nz as f64) as usize).min(nz - 1) * nphi + sector(d.x, d.y)
            },
        );
        assert!(p > level, "cosine_hemisphere p = {p}");
        let p = chi2(
            nz * nphi,
            |_| sphere_pdf() * 4.0 * PI / (nz * nphi) as f64,
            |rng| {
                let d = sphere(rng.unit2());
                (((d.z + 1.0) / 2.0 * nz as f64) as usize).min(nz - 1) * nphi + sector(d.x, d.y)
            },
        );
        assert!(p > level, "sphere p = {p}");
        let p = chi2(
            nz * nphi,
            |_| 1.0 / (nz * nphi) as f64,
            |rng| {
                let [x, y] = disk(rng.unit2());
                (((x * x + y * y) * nz as f64) as usize).min(nz - 1) * nphi + sector(x, y)
            },
        );
        assert!(p > level, "disk p = {p}");
        let p = chi2(
            nz * nphi,
            |_| 1.0 / (nz * nphi) as f64,
            |rng| {
                let u = rng.unit2();
                let d = ball(u, rng.unit());
                ((d.length().powi(3) * nz as f64) as usize).min(nz - 1) * nphi + sector(d.x, d.y)
            },
        );
        assert!(p > level, "ball p = {p}");
        // A triangle cut by lines parallel to one side: cumulative area (1 − b)².
        let p = chi2(
            10,
            |b| (1.0 - b as f64 / 10.0).powi(2) - (1.0 - (b + 1) as f64 / 10.0).powi(2),
            |rng| ((triangle(rng.unit2())[0] * 10.0) as usize).min(9),
        );
        assert!(p > level, "triangle p = {p}");
    }

    #[test]
    fn frames_are_orthonormal_and_right_handed() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        for i in 0..1000 {
            let n = if i < 2 { DVec3::new(0.0, 0.0, 1.0 - 2.0 * f64::from(i)) } else { sphere(rng.unit2()) };
            let f = Frame::new(n);
            assert!((f.s.cross(f.t) - n).length() < 1e-12, "{n}");
            assert!((f.s.length() - 1.0).abs() < 1e-12 && f.s.dot(n).abs() < 1e-12);
        }
    }
}
