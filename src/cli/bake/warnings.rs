//! What a bake warns of before it begins.

use crate::bake::{BakeOptions, BakeSettings, Engine, left_out};
use crate::error::Result;
use crate::flattened::Side;
use crate::illumination_grid::GridSize;
use crate::scene::{Boundary, Scene};
use crate::sweep::lit_within_solids;
use glam::DVec3;

/// What a user may not expect of the bake of `scene` that `options` ask for and `settings` describe.
///
/// # Errors
/// As [`left_out`].
pub(super) fn warnings(scene: &Scene, options: &BakeOptions, settings: &BakeSettings) -> Result<Vec<String>> {
    let mut lines = options.idle(settings);
    let dark = scene.members().iter().all(|m| m.surface.emission == DVec3::ZERO);
    if scene.luminaires().is_empty() && dark {
        lines.push("nothing emits light; everything will be black".into());
    }
    let sealed = scene.boundary == Boundary::Capped && scene.surface.outside == Side::Higher;
    if sealed && scene.fields() == 1 && !lit_within_solids(scene) {
        lines.push(
            "boundary = \"capped\" closes the higher side of surfaces off, which is to be their outside: it will be black; \
             use outside = \"lower\" or boundary = \"open\""
                .into(),
        );
    }
    if let Some([a, b]) = scene.coplanar_caps() {
        lines.push(format!(
            "boundary = \"capped\": '{a}' and '{b}' end in the same faces; where both are solid there, neither cap lies \
             before the other and light near it is uncertain; let one end within the other"
        ));
    }
    // Sweeps that nobody asked for were chosen because they leave out nothing to speak of.
    if settings.engine == Engine::Sweep
        && !options.leaves_engine()
        && let Some(share) = left_out(scene, &settings.grid)?
    {
        lines.push(format!(
            "samples jump over the whole sweep at {:.0} % of the points that surfaces need, where sweeps leave out what \
             surfaces reflect; use --engine photon, a finer --grid or smoother samples",
            100.0 * share
        ));
    }
    if options.grid.is_none() {
        lines.extend(long_voxels(scene)?);
    }
    Ok(lines)
}

/// Of volumes whose voxels are long what grid would suit them.
fn long_voxels(scene: &Scene) -> Result<Option<String>> {
    let lattices = scene.members().into_iter().map(|m| m.field.lattice().clone());
    let Some(volume) = lattices.into_iter().find(|l| GridSize::Cubic.of(l) != GridSize::OWN) else { return Ok(None) };
    let [nx, ny, nz] = GridSize::Cubic.lattice(&volume)?.dims();
    let spacing = volume.spacing();
    Ok(Some(format!(
        "voxels are {:.1} times as long as wide, and light on a grid of these is blurred as much; use --grid cubic \
         ({nx}×{ny}×{nz} points), or --grid 1x for the volume's own",
        spacing.max_element() / spacing.min_element()
    )))
}
