//! Noise of what is displayed.

use std::f64::consts::{FRAC_2_SQRT_PI, SQRT_2};

/// Variance of a Gaussian of this mean and variance that is clamped to [0, 1]: with z = (x − μ)/σ clamped to
/// [a, b] = [−μ/σ, (1 − μ)/σ], σ² (⟨z²⟩ − ⟨z⟩²), where φ and Φ are the normal density and distribution,
/// ⟨z⟩ = φ(a) − φ(b) + a Φ(a) + b Φ(−b) and ⟨z²⟩ = Φ(b) − Φ(a) + a φ(a) − b φ(b) + a² Φ(a) + b² Φ(−b).
pub(super) fn clamped_variance(mean: f64, variance: f64) -> f64 {
    if !(variance > 0.0 && variance.is_finite() && mean.is_finite()) {
        return 0.0;
    }
    let deviation = variance.sqrt();
    // Further out nothing is left that f64 holds, and squares would be large.
    let [a, b] = [-mean / deviation, (1.0 - mean) / deviation].map(|x| x.clamp(-FAR, FAR));
    let [below, above] = [distribution(a), distribution(-b)];
    let first = density(a) - density(b) + a * below + b * above;
    let second = 1.0 - below - above + a * density(a) - b * density(b) + a * a * below + b * b * above;
    // Nothing in [0, 1] varies more, whatever rounding of very wide noise says.
    (variance * (second - first * first).max(0.0)).min(0.25)
}

/// Standard deviations beyond which a normal density is 0 in f64.
const FAR: f64 = 40.0;

fn density(x: f64) -> f64 {
    0.5 * FRAC_2_SQRT_PI / SQRT_2 * (-0.5 * x * x).exp()
}

/// Φ, to a few 1e-16: 1/2 + φ(x) Σ x^(2n+1) / (1·3·…·(2n+1)), whose terms have one sign.
fn distribution(x: f64) -> f64 {
    if x.abs() > 9.0 {
        return if x > 0.0 { 1.0 } else { 0.0 };
    }
    let (mut term, mut sum, mut n) = (x, x, 1.0);
    while term.abs() > 1e-17 * sum.abs() {
        n += 2.0;
        term *= x * x / n;
        sum += term;
    }
    (0.5 + density(x) * sum).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(x: f64, y: f64) {
        assert!((x - y).abs() <= 1e-9 * y.abs().max(1e-3), "{x} {y}");
    }

    #[test]
    fn far_from_both_ends_all_variance_is_left_and_beyond_them_none() {
        close(clamped_variance(0.5, 1e-4), 1e-4);
        close(clamped_variance(0.5, 1e-300), 1e-300);
        for mean in [-3.0, 2.0, 1e6, f64::INFINITY] {
            assert!(clamped_variance(mean, 1e-4) < 1e-18, "{mean}");
        }
        assert!(clamped_variance(0.5, 0.0) == 0.0 && clamped_variance(0.5, f64::INFINITY) == 0.0);
    }

    /// At an end max(0, N) is left, of mean 1/√(2π) and mean square 1/2; wide noise is 0 or 1, half of the time each,
    /// but for the share 1/(σ √(2π)) that is spread evenly between, of variance 1/12.
    #[test]
    fn at_an_end_and_for_wide_noise_it_is_what_is_known() {
        let half = 1e-4 * (0.5 - 0.5 / std::f64::consts::PI);
        close(clamped_variance(0.0, 1e-4), half);
        close(clamped_variance(1.0, 1e-4), half);
        let between = 0.01 / (2.0 * std::f64::consts::PI).sqrt();
        assert!((clamped_variance(0.5, 1e4) - (0.25 - between / 6.0)).abs() < 1e-7);
        assert!((0.0..=0.25).contains(&clamped_variance(0.5, 1e30)));
    }

    #[test]
    fn it_is_what_integration_gives() {
        for (mean, deviation) in [(0.02, 0.03), (0.9, 0.2), (1.1, 0.08), (0.4, 1.5), (-0.1, 0.1), (1.3, 0.1)] {
            // The midpoint rule over ±10 σ, with the clamp's kinks a step's error at most.
            let n = 400_000;
            let at = |i: u32| (f64::from(i) + 0.5) * 20.0 / f64::from(n) - 10.0;
            let (mut weight, mut sum, mut square) = (0.0, 0.0, 0.0);
            for z in (0..n).map(at) {
                let (w, x) = ((-0.5 * z * z).exp(), (mean + deviation * z).clamp(0.0, 1.0));
                (weight, sum, square) = (weight + w, sum + w * x, square + w * x * x);
            }
            let expected = square / weight - (sum / weight).powi(2);
            let found = clamped_variance(mean, deviation * deviation);
            assert!((found - expected).abs() < 1e-7 * expected, "{mean} {deviation}: {found} {expected}");
        }
    }
}
