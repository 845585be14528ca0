//! Radiance in half precision: four numbers a node (red, green, blue, nothing) in eight bytes, which one load of a
//! gather fetches. Numbers are not negative; those below 2⁻¹⁴ are 0, so that no instruction meets a subnormal.

/// Red, green, blue and 0.
pub(super) type Half4 = [u16; 4];

/// 2¹¹²: the distance of the exponents' offsets.
const REBIAS: f32 = f32::from_bits((112 + 127) << 23);
/// The least number that is not 0.
const LEAST: f32 = f32::from_bits((127 - 14) << 23);
/// What the greatest number is scaled to.
const GREATEST: f32 = 32768.0;

/// x ∈ [0, 65504], rounded to nearest, ties to even.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, reason = "sixteen bits are left")]
pub(super) fn encode(x: f32) -> u16 {
    let bits = x.to_bits();
    let rounded = (bits.wrapping_add(0xfff + (bits >> 13 & 1))) >> 13;
    if x >= LEAST { rounded.wrapping_sub(112 << 10) as u16 } else { 0 }
}

/// The number.
#[inline(always)]
pub(super) fn decode(x: u16) -> f32 {
    f32::from_bits(u32::from(x) << 13) * REBIAS
}

/// Red, green and blue.
#[inline(always)]
pub(super) fn colour([r, g, b, _]: Half4) -> [f32; 3] {
    [decode(r), decode(g), decode(b)]
}

/// The power of two that brings `greatest` near the top of the range.
pub(super) fn scale(greatest: f32) -> f32 {
    if !(greatest > 0.0 && greatest.is_finite()) {
        return 1.0;
    }
    (GREATEST / greatest).log2().floor().clamp(-100.0, 126.0).exp2()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_survive_to_eleven_bits() {
        for i in 1..2000 {
            let x = 1.0003f32.powi(i * 30) * 1e-4;
            if x > 60000.0 {
                break;
            }
            let back = decode(encode(x));
            assert!((back / x - 1.0).abs() <= 0.5f32.powi(11), "{x} {back}");
            assert_eq!(encode(back), encode(x));
        }
        assert_eq!((decode(encode(0.0)), decode(encode(1.0)), decode(encode(1.5))), (0.0, 1.0, 1.5));
        assert_eq!(encode(1e-5), 0);
        // Ties go to even: 1 + 2⁻¹¹ down, 1 + 3·2⁻¹¹ up.
        assert_eq!(encode(1.0 + 0.5f32.powi(11)), encode(1.0));
        assert_eq!(decode(encode(1.0 + 3.0 * 0.5f32.powi(11))), 1.0 + 0.5f32.powi(9));
        for x in [1e-30, 3e-5, 0.7, 9e4, 1e30] {
            let s = scale(x);
            assert!(x * s <= GREATEST && x * s > 0.49 * GREATEST && s.to_bits() & 0x7f_ffff == 0, "{x} {s}");
        }
    }
}
