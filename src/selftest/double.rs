//! Double-double numbers, the sum of two f64 \[Dekker71\]: 106 bits, the judge of f64 results.

use std::ops::{Add, Mul, Neg, Sub};

/// hi + lo, where lo is below half an ulp of hi. Exact to about 2⁻¹⁰⁴ relative unless 1e-290 or 1e300 is passed on
/// the way.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Double {
    /// The nearest f64.
    pub hi: f64,
    /// The rest.
    pub lo: f64,
}

/// a + b exactly. \[Knuth97\]
#[inline]
fn two_sum(a: f64, b: f64) -> Double {
    let hi = a + b;
    let bb = hi - a;
    Double { hi, lo: (a - (hi - bb)) + (b - bb) }
}

/// a + b exactly, for |a| ≥ |b|. \[Dekker71\]
#[inline]
fn fast_two_sum(a: f64, b: f64) -> Double {
    let hi = a + b;
    Double { hi, lo: b - (hi - a) }
}

/// a · b exactly. \[Dekker71\]
#[inline]
fn two_product(a: f64, b: f64) -> Double {
    let split = |x: f64| {
        let t = 134_217_729.0 * x;
        let hi = t - (t - x);
        (hi, x - hi)
    };
    let hi = a * b;
    let ((ah, al), (bh, bl)) = (split(a), split(b));
    Double { hi, lo: ((ah * bh - hi) + ah * bl + al * bh) + al * bl }
}

impl From<f64> for Double {
    #[inline]
    fn from(hi: f64) -> Self {
        Self { hi, lo: 0.0 }
    }
}

impl From<f32> for Double {
    #[inline]
    fn from(x: f32) -> Self {
        Self::from(f64::from(x))
    }
}

impl Add for Double {
    type Output = Self;
    #[inline]
    fn add(self, o: Self) -> Self {
        let (s, t) = (two_sum(self.hi, o.hi), two_sum(self.lo, o.lo));
        let s = fast_two_sum(s.hi, s.lo + t.hi);
        fast_two_sum(s.hi, s.lo + t.lo)
    }
}

impl Neg for Double {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        Self { hi: -self.hi, lo: -self.lo }
    }
}

impl Sub for Double {
    type Output = Self;
    #[inline]
    fn sub(self, o: Self) -> Self {
        self + -o
    }
}

impl Mul for Double {
    type Output = Self;
    #[inline]
    fn mul(self, o: Self) -> Self {
        let p = two_product(self.hi, o.hi);
        fast_two_sum(p.hi, p.lo + (self.hi * o.lo + self.lo * o.hi))
    }
}

impl Double {
    /// Whether it is 0 or more.
    #[inline]
    pub fn not_negative(self) -> bool {
        self.hi >= 0.0
    }

    /// The square root, to about 100 bits; 0 of negative numbers.
    pub fn sqrt(self) -> Self {
        if self.hi <= 0.0 {
            return Self::default();
        }
        let r = self.hi.sqrt();
        let rest = self - two_product(r, r);
        fast_two_sum(r, rest.hi / (2.0 * r))
    }

    /// The quotient, to about 100 bits.
    pub fn over(self, o: Self) -> Self {
        let q = self.hi / o.hi;
        let rest = self - o * Self::from(q);
        fast_two_sum(q, rest.hi / o.hi)
    }

    /// c0 + c1 t + c2 t² + c3 t³.
    #[inline]
    pub fn polynomial(c: [Self; 4], t: Self) -> Self {
        c[0] + t * (c[1] + t * (c[2] + t * c[3]))
    }

    /// The trilinear value of 8 corners (bit a of the position: which end along axis a) at a local position.
    #[inline]
    pub fn trilinear(s: [f32; 8], p: [Self; 3]) -> Self {
        let s = s.map(Self::from);
        let lerp = |a: Self, b: Self, t: Self| a + t * (b - a);
        let [x, y, z] = p;
        let (y0, y1) = (lerp(s[0], s[1], x), lerp(s[2], s[3], x));
        let (y2, y3) = (lerp(s[4], s[5], x), lerp(s[6], s[7], x));
        lerp(lerp(y0, y1, y), lerp(y2, y3, y), z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_bits_survive() {
        let (tiny, one) = (Double::from(2f64.powi(-80)), Double::from(1.0));
        assert_eq!(((one + tiny) - one).hi, 2f64.powi(-80));
        assert_eq!(((one + tiny) * (one - tiny) - one).hi, 0.0, "2⁻¹⁶⁰ is beyond");
        let third = one.over(Double::from(3.0));
        assert!((third * Double::from(3.0) - one).hi.abs() < 2f64.powi(-100));
        let root = Double::from(2.0).sqrt();
        assert!((root * root - Double::from(2.0)).hi.abs() < 2f64.powi(-98));
        // 1e8 + 1 squared loses its last digit in f64.
        let x = Double::from(134_217_729.0);
        assert_eq!((x * x - Double::from(134_217_729.0 * 134_217_729.0)).hi, 1.0);
    }

    #[test]
    fn polynomials_and_cells_are_evaluated_exactly() {
        let c = [1.0, -3.0, 3.0, -1.0].map(Double::from);
        // (1 − t)³ at 1 − 2⁻³⁰ is 2⁻⁹⁰.
        assert_eq!(Double::polynomial(c, Double::from(1.0 - 2f64.powi(-30))).hi, 2f64.powi(-90));
        let s = [0.0, 1e30, 1.0, 1.0, 2.0, 2.0, 2.0, 5.0f32];
        assert_eq!(Double::trilinear(s, [1.0, 1.0, 1.0].map(Double::from)).hi, 5.0);
        assert_eq!(Double::trilinear(s, [0.0, 0.5, 0.0].map(Double::from)).hi, 0.5);
    }
}
