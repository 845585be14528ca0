//! Where BB09 looks at the bumps, as fractions of their sweep: the same fractions of any sweep are looked at.

/// The sweep of the bumps.
const SWEEP: [f64; 2] = [3.6, 95.0];

/// The isovalues of its tables, of which the second, midway between two level sets of strategy 1, is reported first.
pub const TABLE: [f64; 3] = [35.0, 47.0, 80.0];

/// Where isovalue `c` of the bumps lies in their sweep.
pub fn fraction(c: f64) -> f64 {
    (c - SWEEP[0]) / (SWEEP[1] - SWEEP[0])
}

/// The level sets 39.0 + 17.7 k of strategy 1, rising. \[BB09 §3\]
pub fn level_sets() -> Vec<f64> {
    (-2..=3).map(|k| fraction(39.0 + 17.7 * f64::from(k))).filter(|s| (0.0..=1.0).contains(s)).collect()
}
