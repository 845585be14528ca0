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
        // Which it is not if one of them is infinite.
        if lo < hi && (hi - lo).is_finite() {
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
    fn the_ends_are_kept_bit_for_bit() {
        let mut rounded = 0;
        for n in 1..1000 {
            let (lo, hi) = (f64::from(n).sqrt(), 1e3 / f64::from(n) + 40.0);
            let sweep = Sweep::new(lo, hi).unwrap();
            assert_eq!([0.0, 1.0].map(|s| sweep.from_unit(s)), [lo, hi]);
            rounded += u32::from(lo + (hi - lo) != hi);
        }
        assert!(rounded > 10, "{rounded}");
    }

    #[test]
    fn sweeps_are_written_with_all_digits() {
        assert_eq!(Sweep::new(-3.5, 1e20).unwrap().to_string(), "-3.5 … 1e20");
        for [lo, hi] in [[1.0, f64::INFINITY], [f64::NEG_INFINITY, 1.0], [f64::NAN, 1.0], [-1e308, 1e308], [1.0, 1.0]] {
            assert!(Sweep::new(lo, hi).is_err(), "{lo} {hi}");
        }
        assert!(Sweep::new(1e300, 1.0).unwrap_err().to_string().contains("isovalues 1e300 1:"));
    }
}
