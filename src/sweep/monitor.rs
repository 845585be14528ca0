//! When to stop bouncing: the tail of all bounces that are left, from the passes' means.

/// Watches the mean of indirect light, per channel, from pass to pass.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Monitor {
    pub(super) means: Vec<[f64; 3]>,
    /// Ratio of successive changes, and the share of the mean that all later bounces would add, when last measured.
    pub(super) ratio: [f64; 3],
    pub(super) tail: [f64; 3],
    /// Passes since then.
    pub(super) since: i32,
}

/// The pass whose change predicts the tail: by then light has left the neighbourhood of the luminaires.
const PREDICTS: usize = 4;

impl Monitor {
    /// Takes the means of a pass; returns per channel the factor that adds the predicted tail of all bounces that are
    /// left. It is applied once: passes after it start from light that is complete in the mean.
    #[allow(clippy::cast_possible_truncation, reason = "a factor near 1")]
    pub(super) fn push(&mut self, mean: [f64; 3]) -> [f32; 3] {
        self.means.push(mean);
        self.since += 1;
        if self.means.len() != PREDICTS {
            return [1.0; 3];
        }
        self.since = 0;
        let [a, b, c] = [1, 2, 3].map(|i| self.means[i]);
        std::array::from_fn(|i| {
            let (old, new) = (b[i] - a[i], c[i] - b[i]);
            if !(old > 0.0 && new > 0.0) {
                return 1.0;
            }
            self.ratio[i] = (new / old).min(0.98);
            let rest = new * self.ratio[i] / (1.0 - self.ratio[i]);
            self.tail[i] = rest / c[i];
            1.0 + (rest / c[i]) as f32
        })
    }

    /// Bound on the share of the mean that is still missing, `more` passes from now; `None` before the prediction. The
    /// change of a pass itself stalls at the directions' noise.
    pub(super) fn missing(&self, more: i32) -> Option<f64> {
        (self.means.len() >= PREDICTS)
            .then(|| (0..3).map(|i| self.tail[i] * self.ratio[i].powi(self.since + more)).fold(0.0, f64::max))
    }
}
