//! BB09's Figure 6: where the samples lie, the illumination grid they make, and an isosurface that it lights.

use super::{Study, Subject};
use crate::bake::{Bake, StrategyName};
use crate::error::Result;
use crate::export::bake_file::BakedVolume;
use crate::export::picture::Picture;
use crate::progress::Progress;
use crate::render::{Camera, Shading, render};
use crate::sampling::positions;
use glam::DVec3;
use std::path::PathBuf;

/// Pixels along a panel's edge, and between panels.
const PANEL: usize = 400;
const GAP: usize = 8;
/// Samples drawn: more would cover the panel.
const DRAWN: u64 = 40_000;

/// Writes `figure6-<subject>-<strategy>.png`: seen along +y, with z up, samples coloured by the grid's light there
/// (left), a slice through the illumination grid at 0.4 of its depth (middle), the isosurface reported first (right).
///
/// # Errors
/// As rendering; `Io`.
pub(super) fn figure6(study: &Study, subject: &Subject, name: &str, strategy: StrategyName, bake: Bake) -> Result<()> {
    let seed = bake.report.seed;
    let baked = BakedVolume::new(subject.scene.clone(), bake);
    let panels = [
        samples(&baked, strategy, seed)?,
        slice(&baked, 0.4),
        render(
            &baked.scene,
            subject.main_isovalue(),
            &square(&baked),
            Shading::Baked(&baked, None),
            &study.device,
            Progress::Quiet,
        )?
        .picture,
    ];
    let mut sheet = Picture::new(3 * PANEL + 2 * GAP, PANEL);
    sheet.rgb.fill([1.0 / baked.exposure as f32; 3]);
    for (n, panel) in panels.iter().enumerate() {
        for (row, pixels) in panel.rgb.chunks_exact(PANEL).enumerate() {
            let at = row * sheet.width + n * (PANEL + GAP);
            sheet.rgb[at..at + PANEL].copy_from_slice(pixels);
        }
    }
    sheet.write_png(figure6_path(study, subject, name), baked.exposure as f32)
}

/// Where the picture of a strategy goes.
pub(super) fn figure6_path(study: &Study, subject: &Subject, name: &str) -> PathBuf {
    study.folder.join(format!("figure6-{}-{name}.png", subject.name))
}

fn square(baked: &BakedVolume) -> Camera {
    Camera { size: [PANEL; 2], samples: 8, ..Camera::facing(&baked.scene, PANEL) }
}

/// Samples as the strategy places them, projected along y; the nearest to the viewer covers the others.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixels, clamped")]
fn samples(baked: &BakedVolume, strategy: StrategyName, seed: u64) -> Result<Picture> {
    let mut picture = Picture::new(PANEL, PANEL);
    let mut at = match strategy.placed() {
        Some(s) => positions(&baked.scene.field, &s, DRAWN, seed)?,
        None => Vec::new(),
    };
    at.sort_by(|a, b| b.y.total_cmp(&a.y));
    let far = baked.lattice().far();
    for p in at {
        let p = p.as_dvec3();
        let last = (PANEL - 1) as f64;
        let (x, y) = ((p.x / far.x * last) as usize, ((1.0 - p.z / far.z) * last) as usize);
        picture.rgb[y.min(PANEL - 1) * PANEL + x.min(PANEL - 1)] = colour(baked, p);
    }
    Ok(picture)
}

/// The grid in the plane at `depth` of Ω along y.
fn slice(baked: &BakedVolume, depth: f64) -> Picture {
    let mut picture = Picture::new(PANEL, PANEL);
    let far = baked.lattice().far();
    for (i, pixel) in picture.rgb.iter_mut().enumerate() {
        let (x, z) = ((i % PANEL) as f64 + 0.5, (PANEL - 1 - i / PANEL) as f64 + 0.5);
        *pixel = colour(baked, far * DVec3::new(x / PANEL as f64, depth, z / PANEL as f64));
    }
    picture
}

fn colour(baked: &BakedVolume, p: DVec3) -> [f32; 3] {
    let radiance = baked.radiance(baked.scene.surface.outside, p).unwrap_or(DVec3::ZERO);
    radiance.as_vec3().to_array()
}
