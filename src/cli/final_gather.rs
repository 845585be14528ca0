//! Rays from what is looked at, for the verbs that look at a bake.

use super::device;
use crate::direct::Estimate;
use crate::embree::GraphTracer;
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::final_gather::{FinalGather, FinalGatherSettings};
use crate::progress::Progress;
use crate::surface_mesh::texture;
use glam::DVec3;
use rayon::prelude::*;

#[derive(clap::Args, Clone, Copy, Debug)]
pub(super) struct FinalGatherOptions {
    /// Direct light not from the bake, but by N shadow rays to each luminaire from every point that is looked at
    /// (default: four times as many as gather rays; without these the bake must have been made with --split)
    #[arg(long, value_name = "N")]
    shadow_rays: Option<u32>,
    /// Indirect light of every point that is looked at by N rays into the bake: as a rule 64 are within 2 % or so of
    /// path tracing, 1024 within 1 %, in a tenth of its time
    #[arg(long, value_name = "N")]
    gather_rays: Option<u32>,
}

impl FinalGatherOptions {
    /// What is asked for; `None` if nothing is.
    ///
    /// # Errors
    /// `Invalid` for numbers out of range.
    pub(super) fn settings(self) -> Result<Option<FinalGatherSettings>> {
        if [self.shadow_rays, self.gather_rays].into_iter().flatten().any(|n| !(1..=MOST).contains(&n)) {
            return Err(Error::Invalid(format!("--shadow-rays, --gather-rays: 1 to {MOST}")));
        }
        let gather_rays = self.gather_rays.unwrap_or(0);
        // They cost less than gather rays and have as much of the noise.
        let shadow_rays = self.shadow_rays.or(self.gather_rays.map(|n| (4 * n).min(MOST)));
        Ok(shadow_rays.map(|shadow_rays| FinalGatherSettings { shadow_rays, gather_rays }))
    }
}

/// Rays of either kind from one place, at most.
const MOST: u32 = 1 << 20;

/// Light of a mesh's vertices and the rays that it cost.
pub(super) struct Gathered {
    pub(super) radiance: Vec<DVec3>,
    /// Of its luminance, if rays found it.
    pub(super) std_error: Option<Vec<f32>>,
    pub(super) rays: u64,
}

/// Radiance of the outside of level sets through world `positions`: as a 3D texture gives it, or by rays into `baked`.
///
/// # Errors
/// As [`FinalGatherSettings::check`]; `Invalid` if the bake does not hold the outside; `Embree`; `Interrupted`.
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
pub(super) fn light(
    baked: &BakedVolume,
    settings: Option<FinalGatherSettings>,
    positions: &[DVec3],
    progress: Progress,
) -> Result<Gathered> {
    let Some(settings) = settings else {
        return Ok(Gathered { radiance: texture(baked, positions)?, std_error: None, rays: 0 });
    };
    settings.check(baked)?;
    let tracer = GraphTracer::new(&device()?, &baked.scene)?;
    let gather = FinalGather::new(baked, &tracer, settings)?;
    let stage = progress.stage("final gather", positions.len() as u64);
    let at = |(index, &x): (usize, &DVec3)| {
        let p = baked.lattice().to_index(x);
        let isovalue = baked.scene.field.value(p) as f32;
        if stage.tick(1) { gather.outside(p, isovalue, index as u64) } else { Some(Estimate::default()) }
    };
    let light: Option<Vec<Estimate>> = positions.par_iter().enumerate().with_min_len(16).map(at).collect();
    stage.end()?;
    let light = light.ok_or_else(|| Error::Invalid("the bake does not hold the surface's outside".into()))?;
    let (radiance, std_error) = light.into_iter().map(|l| (l.mean, l.variance.sqrt() as f32)).unzip();
    Ok(Gathered { radiance, std_error: Some(std_error), rays: gather.rays() })
}
