//! Light by isovalue texel.

/// Light by isovalue texel as sums of steps: lit from a texel on, on the lower side, and up to one, on the higher.
pub(super) struct Staircases {
    from: Vec<f64>,
    until: Vec<f64>,
}

impl Staircases {
    pub(super) fn new(isovalues: usize) -> Self {
        Self { from: vec![0.0; isovalues + 1], until: vec![0.0; isovalues + 1] }
    }

    /// `g` at texels `from`.. on the lower side and ..`until` on the higher.
    #[inline]
    pub(super) fn add(&mut self, g: f64, from: usize, until: usize) {
        self.from[from] += g;
        self.until[until] += g;
    }

    /// `g` at all texels that no range of h of `hidden` hides, from texel `here` on on the lower side, before on the
    /// higher; `below`: the number of texels at or below h.
    pub(super) fn add_beside(&mut self, g: f64, here: usize, hidden: &[[f32; 2]], below: impl Fn(f32) -> usize) {
        let n = self.from.len() - 1;
        let open = |t: &usize| !hidden.iter().any(|[least, most]| (below(*least)..below(*most)).contains(t));
        for t in (0..n).filter(open) {
            let (sums, begin, end) = if t < here { (&mut self.until, t + 1, t) } else { (&mut self.from, t, t + 1) };
            sums[begin] += g;
            sums[end] -= g;
        }
    }

    /// Light of each texel, of the sides that count, times the factors of the lower and the higher one.
    pub(super) fn sums(&self, lower: bool, higher: bool, factors: &[Vec<f64>; 2]) -> Vec<f64> {
        let n = self.from.len() - 1;
        let mut out = vec![0.0; n];
        if lower {
            let mut sum = 0.0;
            for ((out, g), factor) in out.iter_mut().zip(&self.from).zip(&factors[0]) {
                sum += g;
                *out += factor * sum;
            }
        }
        if higher {
            let mut sum = 0.0;
            for ((out, g), factor) in out.iter_mut().zip(&self.until[1..]).zip(&factors[1]).rev() {
                sum += g;
                *out += factor * sum;
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What one range hides lies between the steps from its greatest on and up to its least; two also leave what is
    /// between them.
    #[test]
    fn ranges_hide_texels() {
        const N: usize = 8;
        let even = [1.0; 2].map(|x| vec![x; N]);
        let below = |h: f32| (h.max(0.0) as usize).min(N);
        let beside = |here, hidden: &[[f32; 2]]| {
            [(true, false), (false, true)].map(|(lower, higher)| {
                let mut stairs = Staircases::new(N);
                stairs.add_beside(2.0, here, hidden, below);
                stairs.sums(lower, higher, &even)
            })
        };
        for (least, most, here) in [(2.0, 5.0, 3), (2.0, 5.0, 2), (2.0, 5.0, 5), (-1.0, 3.0, 0), (6.0, 99.0, 8)] {
            let expected = [(true, false), (false, true)].map(|(lower, higher)| {
                let mut stairs = Staircases::new(N);
                let open = below(most).max(here);
                stairs.add(2.0, open, below(least).min(open));
                stairs.sums(lower, higher, &even)
            });
            assert_eq!(beside(here, &[[least, most]]), expected, "{least} … {most}, {here}");
        }
        let [lower, higher] = beside(4, &[[1.0, 2.0], [5.0, 6.0]]);
        assert_eq!(lower, [0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 2.0, 2.0]);
        assert_eq!(higher, [2.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(beside(8, &[]), [vec![0.0; N], vec![2.0; N]]);
    }
}
