//! Photons of a flat by texel, and the irradiance they stand for.

use glam::DVec3;
use rayon::prelude::*;

/// Photons by texel.
pub(super) struct Binned {
    /// Their power per area and isovalue, as if all of each texel could receive it.
    pub(super) densities: Vec<DVec3>,
    /// The share of each texel that can.
    pub(super) shares: Vec<f64>,
    /// How many photons they are.
    pub(super) count: u64,
}

impl Binned {
    /// Irradiance.
    pub(super) fn smoothed(&self, dims: [usize; 3], width: &Width) -> Vec<DVec3> {
        let per_texel = self.count as f64 / self.shares.iter().sum::<f64>().max(1.0);
        smooth_twice(&self.densities, &self.shares, dims, width.passes(per_texel))
    }
}

/// How far photons on a flat are smoothed: a kernel that shrinks as they grow in number.
pub(super) struct Width {
    /// Photons that it should hold.
    photons: f64,
    /// Most passes of ¼ ½ ¼ along u and v; c gets half of them, since there are fewer texels along it.
    most: f64,
}

pub(super) const GATHERED: Width = Width { photons: 300.0, most: 2.0 };
pub(super) const SHOWN: Width = Width { photons: 2000.0, most: 16.0 };

impl Width {
    /// Passes of ¼ ½ ¼ along u, v and c for so many photons per texel: the kernel is (2√π σ)³ texels worth, with σ² of
    /// half the passes.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
    fn passes(&self, photons_per_texel: f64) -> [usize; 3] {
        let texels = self.photons / photons_per_texel.max(1e-9);
        let sigma = (texels * 2f64.sqrt()).cbrt() / (2.0 * std::f64::consts::PI.sqrt());
        let along = (2.0 * sigma * sigma).clamp(1.0, self.most);
        let n = |x: f64| x.round().max(1.0) as usize;
        [n(along), n(along), n(0.5 * along)]
    }
}

/// What `image` holds per `share`, smoothed by a 2D kernel × a 1D kernel in c that keep flux, twice: what the first
/// smoothing took away is smoothed and put back, so that the bias left is of fourth order in their width \[Tukey77\].
/// Texels of which there is little are so spoken for by those around them.
fn smooth_twice(image: &[DVec3], shares: &[f64], dims: [usize; 3], passes: [usize; 3]) -> Vec<DVec3> {
    let area = smooth(shares.iter().map(|&s| DVec3::splat(s)).collect(), dims, passes);
    let mean = |image: Vec<DVec3>| -> Vec<DVec3> {
        smooth(image, dims, passes).iter().zip(&area).map(|(i, a)| *i / a.x.max(1e-9)).collect()
    };
    let once = mean(image.to_vec());
    let lost = mean((0..image.len()).map(|n| image[n] - once[n] * shares[n]).collect());
    once.iter().zip(&lost).map(|(s, l)| *s + *l).collect()
}

/// Passes of ¼ ½ ¼ along each axis, to and fro between two images: where they are large, new memory for each takes as
/// long as the pass.
fn smooth(mut image: Vec<DVec3>, dims: [usize; 3], passes: [usize; 3]) -> Vec<DVec3> {
    let mut next = vec![DVec3::ZERO; image.len()];
    for (axis, &count) in passes.iter().enumerate() {
        for _ in 0..count {
            smooth_along(&image, &mut next, dims, axis);
            std::mem::swap(&mut image, &mut next);
        }
    }
    image
}

/// ¼ ½ ¼ along one axis into `out`, the missing quarter folded back at the ends (flux is kept).
fn smooth_along(image: &[DVec3], out: &mut [DVec3], dims: [usize; 3], axis: usize) {
    let stride = [1, dims[0], dims[0] * dims[1]][axis];
    let n = dims[axis];
    out.par_iter_mut().enumerate().with_min_len(4096).for_each(|(i, out)| {
        let at = i / stride % n;
        let before = if at > 0 { image[i - stride] } else { image[i] };
        let after = if at + 1 < n { image[i + stride] } else { image[i] };
        *out = 0.25 * before + 0.5 * image[i] + 0.25 * after;
    });
}
