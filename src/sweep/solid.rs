//! Where solids stand on flats: in Ω's faces light of either side of the level sets is kept apart.

use super::flats::below;
use crate::flat::Flat;
use crate::isovalue_axis::IsovalueAxis;
use crate::scene::Scene;
use glam::DVec3;
use rayon::prelude::*;

/// Off Ω, and beside samples that are not finite, there is one light for all.
pub(super) const FREE: u32 = u32::MAX;

/// How many of `n` isovalues along `axis` lie in the solid at the centre of each texel of a flat, or [`FREE`].
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32 and few")]
pub(super) fn solid(scene: &Scene, flat: &Flat, [nu, nv]: [usize; 2], axis: &IsovalueAxis, n: usize) -> Vec<u32> {
    let far = scene.lattice().far();
    let of = |texel: usize| {
        let uv = [((texel % nu) as f64 + 0.5) / nu as f64, ((texel / nu) as f64 + 0.5) / nv as f64];
        let p = scene.lattice().to_index(flat.at(uv));
        let within = p.cmpge(DVec3::splat(-1e-6)).all() && p.cmple(far + 1e-6).all();
        let h = if within { scene.field.value(p) as f32 } else { f32::NAN };
        if h.is_nan() { FREE } else { below(axis, n, h) as u32 }
    };
    (0..nu * nv).into_par_iter().with_min_len(256).map(of).collect()
}
