//! Radiance that walls, luminaires and isosurfaces emit: which of it can be computed with.

use crate::error::{Error, Result};
use glam::DVec3;
use std::ops::RangeInclusive;

/// Of the brightest channel. Light is stored in 32-bit floats, and so are the squares that its standard errors come
/// from: within this range all results scale with the emission.
const RANGE: RangeInclusive<f64> = 1e-15..=1e18;

/// Whether `emission` can be emitted.
///
/// # Errors
/// `Invalid` if a channel is negative or not finite, or the brightest is neither 0 nor within 10⁻¹⁵ to 10¹⁸.
pub fn check(emission: DVec3) -> Result<()> {
    let brightest = emission.max_element();
    if emission.is_finite() && emission.min_element() >= 0.0 && (brightest == 0.0 || RANGE.contains(&brightest)) {
        return Ok(());
    }
    Err(Error::Invalid(format!(
        "emission {:?}, {:?}, {:?}: must be 0, or not negative with {:e} to {:e} in the brightest channel; light scales with it",
        emission.x,
        emission.y,
        emission.z,
        RANGE.start(),
        RANGE.end()
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_floats_can_square_or_nothing() {
        for fine in [[0.0; 3], [1e-15; 3], [1e18; 3], [0.0, 1e18, 1e-30], [0.0, 0.0, 1e-15]] {
            assert!(check(fine.into()).is_ok(), "{fine:?}");
        }
        for wrong in [[1.1e18; 3], [0.0, 1e22, 0.0], [9e-16; 3], [1e-30; 3], [1.0, -1e-9, 1.0], [1.0, f64::NAN, 1.0]] {
            assert!(check(wrong.into()).is_err_and(|e| e.to_string().contains("1e-15 to 1e18")), "{wrong:?}");
        }
        assert!(check(DVec3::INFINITY).is_err());
    }
}
