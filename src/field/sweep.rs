//! The range of isovalues that is swept.

use crate::digits::{Shortest, span};
use crate::error::{Error, Result};
use std::fmt;

/// The sweep's isovalue range I = [lo, hi] in source units, mapped affinely to [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sweep {
    lo: f64,
    hi: f64,
}

impl Sweep {
    /// The range [lo, hi].
    ///
    /// # Errors
    /// `Invalid` unless both are finite and lo < hi.
    pub fn new(lo: f64, hi: f64) -> Result<Self> {
        if lo.is_finite() && hi.is_finite() && lo < hi && (hi - lo).is_finite() {
            Ok(Self { lo, hi })
        } else {
            Err(Error::Invalid(format!(
                "isovalues {} {}: the sweep needs two different finite numbers, the lower first",
                Shortest(lo),
                Shortest(hi)
            )))
        }
    }

    /// Lower end, source units.
    pub fn lo(&self) -> f64 {
        self.lo
    }

    /// Upper end, source units.
    pub fn hi(&self) -> f64 {
        self.hi
    }

    /// Source units to [0, 1].
    #[inline]
    pub fn to_unit(&self, value: f64) -> f64 {
        (value - self.lo) / (self.hi - self.lo)
    }

    /// [0, 1] to source units; 0 and 1 are the sweep's ends, bit for bit.
    #[inline]
    pub fn from_unit(&self, s: f64) -> f64 {
        if s == 1.0 { self.hi } else { self.lo + s * (self.hi - self.lo) }
    }

    /// The unit isovalue of a source value exactly as samples are stored, so that a sample equal to `value` compares
    /// equal to it.
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32 wherever they meet samples")]
    pub fn isovalue(&self, value: f64) -> f32 {
        self.to_unit(value) as f32
    }
}

impl fmt::Display for Sweep {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&span((self.lo, self.hi)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sweeps_are_written_with_all_digits() {
        assert_eq!(Sweep::new(-3.5, 1e20).unwrap().to_string(), "-3.5 … 1e20");
        assert!(Sweep::new(1e300, 1.0).unwrap_err().to_string().contains("isovalues 1e300 1:"));
    }
}
