//! Numbers as people write them.

use std::fmt;

/// A number with all digits that tell it from others, an exponent where it is very large or small.
#[derive(Debug)]
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

/// A range with all digits of its ends.
pub fn span((lo, hi): (f64, f64)) -> String {
    format!("{} … {}", Shortest(lo), Shortest(hi))
}

/// Six digits of a number; all of a whole one.
pub fn brief(v: f64) -> Shortest {
    rounded(v, FEWEST)
}

/// Six digits of a number of the range lo … hi, or as many more as tell a thousandth of the range apart: an offset
/// takes digits of its own. All of a whole one: identifiers and counts are not what they are nearly.
pub fn brief_within(v: f64, [lo, hi]: [f64; 2]) -> Shortest {
    let place = |x: f64| x.abs().log10().floor();
    let needed = place(v) - place(1e-3 * (hi - lo)) + 1.0;
    // Nothing tells numbers without a difference apart; a range that f64 does not hold needs no more.
    rounded(v, if hi > lo { needed.clamp(FEWEST, MOST) } else { FEWEST })
}

/// A range with as many digits of its ends as [`brief_within`] gives.
pub fn brief_span(range: [f64; 2]) -> String {
    let [lo, hi] = range.map(|v| brief_within(v, range).0);
    span((lo, hi))
}

/// Digits of a number that stands for itself.
const FEWEST: f64 = 6.0;
/// Below this all digits of a whole number are written out.
const WHOLE: f64 = 1e15;
/// Digits that tell every f64 from all others.
const MOST: f64 = 17.0;

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "6 to 17")]
fn rounded(v: f64, digits: f64) -> Shortest {
    if v.fract() == 0.0 && v.abs() < WHOLE {
        return Shortest(v);
    }
    Shortest(format!("{v:.*e}", digits as usize - 1).parse().unwrap_or(v))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_their_digits_and_no_more() {
        let written = [47.0, -0.25, 0.1 + 0.2, 1e300, 5e-324, 7.18e299].map(|v| Shortest(v).to_string());
        assert_eq!(written, ["47", "-0.25", "0.30000000000000004", "1e300", "5e-324", "7.18e299"]);
        assert_eq!(span((-3.5, 1e20)), "-3.5 … 1e20");
    }

    #[test]
    fn brief_numbers_are_short() {
        let all = [0.0, 1.0, -0.25, 1.0 / 3.0, 22526.0, 1e-7, 2.5e9, 123456.7, f64::INFINITY];
        let expected = ["0", "1", "-0.25", "0.333333", "22526", "1e-7", "2500000000", "123457", "inf"];
        assert_eq!(all.map(|v| brief(v).to_string()), expected);
    }

    #[test]
    fn ranges_on_an_offset_have_the_digits_of_their_difference() {
        for (range, text) in [
            ([0.0, 255.0], "0 … 255"),
            ([-1.0 / 3.0, 200.0 / 3.0], "-0.333333 … 66.6667"),
            ([1e8 - 0.654_321, 1e8 + 0.876_543], "99999999.346 … 100000000.877"),
            ([101_325.123_456, 101_325.987_654], "101325.1235 … 101325.9877"),
            ([1e15, 1e15 + 0.125], "1000000000000000 … 1000000000000000.1"),
            ([-f64::MAX, f64::MAX], "-1.79769e308 … 1.79769e308"),
            ([1e8 + 1.0 / 3.0, 1e8 + 1.0 / 3.0], "100000000 … 100000000"),
            ([123_456_789.0, 4_294_967_295.0], "123456789 … 4294967295"),
            ([0.0, 1.234_567_891e18], "0 … 1.23457e18"),
        ] {
            assert_eq!(brief_span(range), text);
        }
        // No two thousandths look alike.
        for (lo, width) in [(1e8, 1.0), (-273.15, 1e-4), (1e300, 1e297), (0.0, 1e-320), (5.0, 1e9)] {
            let range = [lo, lo + width];
            let step = |n: u32| lo + width * f64::from(n) / 1000.0;
            let written: Vec<String> = (0..=1000).map(|n| brief_within(step(n), range).to_string()).collect();
            assert!(written.windows(2).all(|w| w[0] != w[1]), "{lo} {width}");
        }
    }
}
