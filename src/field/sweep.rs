//! The range of isovalues that is swept, and how people write such numbers.

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

/// A range as people write it.
pub fn span((lo, hi): (f64, f64)) -> String {
    format!("{} … {}", Shortest(lo), Shortest(hi))
}

/// A number as people write it: all digits that tell it from others, an exponent where it is very large or small.
pub struct Shortest(
    /// The number.
    pub f64,
);

impl fmt::Display for Shortest {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let text = format!("{:?}", self.0);
        f.write_str(text.strip_suffix(".0").unwrap_or(&text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_their_digits_and_no_more() {
        let written = [47.0, -0.25, 0.1 + 0.2, 1e300, 5e-324, 7.18e299].map(|v| Shortest(v).to_string());
        assert_eq!(written, ["47", "-0.25", "0.30000000000000004", "1e300", "5e-324", "7.18e299"]);
        assert_eq!(Sweep::new(-3.5, 1e20).unwrap().to_string(), "-3.5 … 1e20");
        assert!(Sweep::new(1e300, 1.0).unwrap_err().to_string().contains("isovalues 1e300 1:"));
    }
}
