//! Statistics that judge: running moments, z and χ² tests, Šidák's correction.

/// Running mean and variance. \[Welford62\]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    n: u64,
    mean: f64,
    m2: f64,
}

impl Moments {
    /// Takes one value in.
    #[inline]
    pub fn push(&mut self, x: f64) {
        self.n += 1;
        let d = x - self.mean;
        self.mean += d / self.n as f64;
        self.m2 += d * (x - self.mean);
    }

    /// Number of values.
    pub fn count(&self) -> u64 {
        self.n
    }

    /// Mean; 0 without values.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Unbiased variance of one value; 0 for fewer than two.
    pub fn variance(&self) -> f64 {
        if self.n < 2 { 0.0 } else { self.m2 / (self.n - 1) as f64 }
    }

    /// Standard error of the mean, for independent values.
    pub fn std_error(&self) -> f64 {
        if self.n == 0 { 0.0 } else { (self.variance() / self.n as f64).sqrt() }
    }
}

/// The level each of `n` independent tests must be run at so that the family errs with probability `alpha`. \[Šidák67\]
pub fn sidak(alpha: f64, n: usize) -> f64 {
    1.0 - (1.0 - alpha).powf(1.0 / n as f64)
}

/// Probability that a χ² variable of `dof` degrees of freedom exceeds `statistic`.
pub fn chi_square_p(statistic: f64, dof: usize) -> f64 {
    1.0 - lower_gamma(dof as f64 / 2.0, statistic / 2.0)
}

/// Two-sided probability of a standard normal beyond |z|.
fn normal_p(z: f64) -> f64 {
    // erfc(x) = 1 − P(½, x²)
    1.0 - lower_gamma(0.5, z * z / 2.0)
}

/// The |z| that a standard normal exceeds with probability `p` (two-sided), by bisection to 1e-9.
pub fn normal_quantile(p: f64) -> f64 {
    let (mut lo, mut hi) = (0.0, 40.0);
    for _ in 0..60 {
        let z = 0.5 * (lo + hi);
        if normal_p(z) > p { lo = z } else { hi = z }
    }
    0.5 * (lo + hi)
}

/// The regularised lower incomplete gamma function P(a, x): series below a + 1, continued fraction above. \[DLMF 8.11,
/// 8.9\]
fn lower_gamma(a: f64, x: f64) -> f64 {
    if x <= 0.0 {
        return 0.0;
    }
    let front = (a * x.ln() - x - ln_gamma(a)).exp();
    if x < a + 1.0 {
        let (mut term, mut sum) = (1.0 / a, 1.0 / a);
        for n in 1..10_000 {
            term *= x / (a + f64::from(n));
            sum += term;
            if term < sum * 1e-15 {
                break;
            }
        }
        sum * front
    } else {
        // Lentz's method on the continued fraction of Q.
        let mut b = x + 1.0 - a;
        let mut c = 1e300;
        let mut d = 1.0 / b;
        let mut h = d;
        for n in 1..10_000 {
            let an = -f64::from(n) * (f64::from(n) - a);
            b += 2.0;
            d = 1.0 / (an * d + b);
            c = b + an / c;
            let step = d * c;
            h *= step;
            if (step - 1.0).abs() < 1e-15 {
                break;
            }
        }
        1.0 - front * h
    }
}

/// ln Γ by Lanczos' approximation, relative error below 1e-13 for a > 0. \[Lanczos64\]
fn ln_gamma(a: f64) -> f64 {
    const G: f64 = 7.0;
    const P: [f64; 9] = [
        0.999_999_999_999_809_9,
        676.520_368_121_885_1,
        -1_259.139_216_722_402_8,
        771.323_428_777_653_1,
        -176.615_029_162_140_6,
        12.507_343_278_686_905,
        -0.138_571_095_265_720_12,
        9.984_369_578_019_572e-6,
        1.505_632_735_149_311_6e-7,
    ];
    let a = a - 1.0;
    let t = a + G + 0.5;
    let series = P[0] + (1..9).map(|i| P[i] / (a + i as f64)).sum::<f64>();
    0.5 * (std::f64::consts::TAU).ln() + (a + 0.5) * t.ln() - t + series.ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tabulated_values() {
        // NIST tables: χ²(0.05; 10) = 18.307, χ²(0.01; 100) = 135.807; two-sided normal 1.959964 and 2.575829.
        assert!((chi_square_p(18.307, 10) - 0.05).abs() < 1e-5);
        assert!((chi_square_p(135.807, 100) - 0.01).abs() < 1e-6);
        // Four degrees: e^(−x/2) (1 + x/2).
        assert!((chi_square_p(2.0, 4) - 2.0 * (-1f64).exp()).abs() < 1e-13);
        assert!((normal_p(1.959_964) - 0.05).abs() < 1e-7);
        assert!((normal_quantile(0.01) - 2.575_829).abs() < 1e-5);
        assert!((sidak(0.05, 10) - 0.005_116_2).abs() < 1e-7);
    }

    #[test]
    fn moments_match_the_two_pass_formulas() {
        let values = [1e9 + 4.0, 1e9 + 7.0, 1e9 + 13.0, 1e9 + 16.0];
        let mut m = Moments::default();
        values.iter().for_each(|&v| m.push(v));
        assert_eq!((m.mean(), m.variance()), (1e9 + 10.0, 30.0));
    }
}
