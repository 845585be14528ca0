//! What lines bring to walls, luminaires and caps.

use crate::isa::Isa;
use rayon::prelude::*;

/// The four texels around (u, v) and their weights, clamped at the borders.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the texture")]
pub(super) fn texels_around(dims: [usize; 3], uv: [f32; 2]) -> [(usize, f32); 4] {
    let mut base = [0usize; 2];
    let mut next = [0usize; 2];
    let mut frac = [0f32; 2];
    for a in 0..2 {
        let last = dims[a] - 1;
        let x = (uv[a] * dims[a] as f32 - 0.5).clamp(0.0, last as f32);
        base[a] = (x as usize).min(last);
        next[a] = (base[a] + 1).min(last);
        frac[a] = x - base[a] as f32;
    }
    let row = |v: usize, u: usize| v * dims[0] + u;
    let [f, g] = frac;
    [
        (row(base[1], base[0]), (1.0 - f) * (1.0 - g)),
        (row(base[1], next[0]), f * (1.0 - g)),
        (row(next[1], base[0]), (1.0 - f) * g),
        (row(next[1], next[0]), f * g),
    ]
}

/// What one line brought to a flat.
pub(super) struct Arrival {
    flat: u32,
    uv: [f32; 2],
    weight: f32,
    /// Isovalue texels that lie on the swept side there.
    range: (u32, u32),
    /// Where the radiances start in [`Arrivals::values`].
    start: usize,
}

/// What the lines of some rows brought.
#[derive(Default)]
pub(super) struct Arrivals {
    list: Vec<Arrival>,
    values: Vec<f32>,
}

impl Arrivals {
    /// Room for three channels of isovalues, which [`Self::push`] keeps.
    #[inline(always)]
    pub(super) fn room(&mut self, isovalues: usize) -> &mut [f32] {
        let start = self.values.len();
        self.values.resize(start + 3 * isovalues, 0.0);
        &mut self.values[start..]
    }

    /// Adds what was written to the last room, which stands for `weight` = dω × area across, for a range of isovalues.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "isovalue texels")]
    pub(super) fn push(
        &mut self,
        (flat, uv): (u32, [f32; 2]),
        weight: f32,
        isovalues: usize,
        (from, to): (usize, usize),
    ) {
        let start = self.values.len() - 3 * isovalues;
        if from < to {
            self.list.push(Arrival { flat, uv, weight, range: (from as u32, to as u32), start });
        } else {
            self.values.truncate(start);
        }
    }
}

/// What one flat receives in a pass.
pub(super) struct Sink {
    /// Texels along u, v and isovalues.
    pub dims: [usize; 3],
    /// Sums of radiance; isovalues fastest, then the channel, then u, then v.
    pub indirect: Vec<f32>,
    /// ∫cos dω of what was summed.
    pub weight: Vec<f32>,
}

/// What all flats receive in a pass.
pub(super) struct Incoming {
    /// By texture number.
    pub sinks: Vec<Option<Sink>>,
}

impl Incoming {
    /// Adds what lines brought, in their order.
    pub(super) fn receive(&mut self, isa: Isa, arrivals: &[Arrivals]) {
        self.sinks.par_iter_mut().enumerate().for_each(|(number, sink)| {
            if let Some(sink) = sink {
                arrivals.iter().for_each(|all| isa.receive_arrivals(sink, number, all));
            }
        });
    }
}

impl Sink {
    /// Nothing yet.
    pub(super) fn new(dims: [usize; 3]) -> Self {
        let n = dims.iter().product();
        Self { dims, indirect: vec![0.0; 3 * n], weight: vec![0.0; n] }
    }

    /// Adds what lines brought to flat `number`.
    #[inline(always)]
    pub(super) fn receive(&mut self, number: usize, all: &Arrivals) {
        let nc = self.dims[2];
        for a in all.list.iter().filter(|a| a.flat as usize == number) {
            let (first, last) = (a.range.0 as usize, a.range.1 as usize);
            for (texel, w) in texels_around(self.dims, a.uv) {
                let w = w * a.weight;
                self.weight[texel * nc..][first..last].iter_mut().for_each(|x| *x += w);
                for c in 0..3 {
                    let from = &all.values[a.start + c * nc..][first..last];
                    let to = &mut self.indirect[(3 * texel + c) * nc..][first..last];
                    to.iter_mut().zip(from).for_each(|(x, v)| *x += w * v);
                }
            }
        }
    }
}
