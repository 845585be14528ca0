//! The one reflectance: Lambert's, f = ρ/π in three dimensions and f♭ = ρ/2 in flatland. \[BB09 Eqs. 1, 2\]

use glam::DVec3;
use std::f64::consts::PI;

/// Radiance reflected by a Lambertian surface of `albedo` under `irradiance`: ρE/π.
#[inline]
pub fn reflected(albedo: DVec3, irradiance: DVec3) -> DVec3 {
    albedo * irradiance / PI
}
