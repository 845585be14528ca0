//! How volumes and colours travel inside the page: quantised, as differences of neighbours split into byte planes,
//! which is what makes zlib effective on them.

use crate::export::picture::srgb_encode;
use crate::isovalue_axis::IsovalueAxis;

/// The code of a sample that is not finite.
pub const HOLE: u16 = 0;

/// The codes of 0 and 1: between them lie equal steps of the axis, so that every isovalue of the sweep is met to
/// 1/32768 of it, or of what is left of an axis that crowds at one end.
const UNIT: [u16; 2] = [16_384, 49_152];

/// Beyond the sweep codes grow geometrically: so many per octave, from steps as long as the ones inside.
const PER_OCTAVE: f64 = 512.0;

/// The distance from the sweep at which an octave has doubled once: PER_OCTAVE steps of 1/32768, over ln 2.
const OCTAVE: f64 = PER_OCTAVE / (32_768.0 * std::f64::consts::LN_2);

/// A field value in units of the sweep as a code: equal steps of 1/32768 of the `axis` in [0, 1], relative steps of
/// 0.14 % of the distance to it outside, as far as 9.7·10⁷; [`HOLE`] unless finite.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "rounded and clamped to the codes")]
pub fn encode(axis: &IsovalueAxis, value: f32) -> u16 {
    let v = f64::from(value);
    let beyond = |d: f64| (PER_OCTAVE * (1.0 + d / OCTAVE).log2()).round().min(16_383.0) as u16;
    match v {
        v if !v.is_finite() => HOLE,
        v if v < 0.0 => UNIT[0] - beyond(-v),
        v if v > 1.0 => UNIT[1] + beyond(v - 1.0),
        _ => UNIT[0] + (f64::from(axis.place(value)) * 32_768.0).round() as u16,
    }
}

/// The value of a code; NaN for [`HOLE`]. The page has the same function.
pub fn decode(axis: &IsovalueAxis, code: u16) -> f64 {
    let beyond = |steps: u16| OCTAVE * ((f64::from(steps) / PER_OCTAVE).exp2() - 1.0);
    match code {
        HOLE => f64::NAN,
        c if c < UNIT[0] => -beyond(UNIT[0] - c),
        c if c > UNIT[1] => 1.0 + beyond(c - UNIT[1]),
        c => axis.isovalue(f64::from(c - UNIT[0]) / 32_768.0),
    }
}

/// Appends 16-bit codes as differences, first all high bytes, then all low ones.
pub fn append_codes(out: &mut Vec<u8>, codes: &[u16]) {
    let differences = || codes.iter().scan(0u16, |last, &c| Some(c.wrapping_sub(std::mem::replace(last, c))));
    out.extend(differences().map(|d| d.to_be_bytes()[0]));
    out.extend(differences().map(|d| d.to_be_bytes()[1]));
}

/// Appends one plane of bytes as differences.
pub fn append_plane(out: &mut Vec<u8>, bytes: impl Iterator<Item = u8>) {
    out.extend(bytes.scan(0u8, |last, b| Some(b.wrapping_sub(std::mem::replace(last, b)))));
}

/// Appends linear colours × `factor`, clamped to [0, 1], as three planes of sRGB-encoded bytes.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in [0, 255]")]
pub fn append_colours(out: &mut Vec<u8>, colours: &[[f32; 3]], factor: f32) {
    for channel in 0..3 {
        append_plane(out, colours.iter().map(|c| (srgb_encode(c[channel] * factor) * 255.0).round() as u8));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encode(value: f32) -> u16 {
        super::encode(&IsovalueAxis::EVEN, value)
    }

    fn decode(code: u16) -> f64 {
        super::decode(&IsovalueAxis::EVEN, code)
    }

    /// Densities over decades: each isovalue is met to a thousandth of itself down to a hundred-thousandth of the
    /// sweep.
    #[test]
    fn codes_crowd_where_most_of_a_volume_is() {
        let axis = IsovalueAxis::around(1e-3);
        for decade in [1e-5f32, 1e-4, 1e-3, 1e-2, 0.1] {
            for v in [1.0, 2.3, 9.9].map(|n| n * decade) {
                let back = super::decode(&axis, super::encode(&axis, v));
                assert!((back / f64::from(v) - 1.0).abs() < 2e-3, "{v}: {back}");
            }
        }
        let codes: Vec<u16> = (0..=4000).map(|i| super::encode(&axis, i as f32 / 4000.0)).collect();
        assert!(codes.windows(2).all(|w| w[0] < w[1]) && [codes[0], codes[4000]] == UNIT, "order is kept");
    }

    #[test]
    fn codes_keep_the_sweep_fine_and_the_rest_in_proportion() {
        for i in 0..=1000 {
            let v = f64::from(i) / 1000.0;
            assert!((decode(encode(v as f32)) - v).abs() <= 0.5001 / 32_768.0 + 1e-7, "{v}");
        }
        for e in -40..180 {
            let d = f64::from(e).mul_add(0.1, 0.0).exp2();
            for v in [1.0 + d, -d] {
                let error = (decode(encode(v as f32)) - v).abs();
                assert!(error <= 0.0008 * d + 1e-4, "{v}: {error}");
            }
        }
        assert!(decode(encode(f32::NAN)).is_nan() && decode(encode(f32::INFINITY)).is_nan());
        assert_eq!([0.0, 1.0].map(|v| decode(encode(v))), [0.0, 1.0]);
        let far = decode(encode(1e30));
        assert!(far > 9e7 && decode(encode(-1e30)) < -9e7, "beyond the codes: the greatest, {far}");
        let codes: Vec<u16> = (0..400).map(|i| encode(i as f32 * 0.01 - 1.5)).collect();
        assert!(codes.windows(2).all(|w| w[0] < w[1]), "order is kept");
    }

    #[test]
    fn planes_sum_up_to_what_went_in() {
        let codes = [5u16, 0, 65_535, 300, 299];
        let mut out = Vec::new();
        append_codes(&mut out, &codes);
        let mut last = 0u16;
        for (i, &c) in codes.iter().enumerate() {
            last = last.wrapping_add(u16::from_be_bytes([out[i], out[codes.len() + i]]));
            assert_eq!(last, c);
        }
    }
}
