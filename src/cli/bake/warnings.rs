//! What a bake warns of before it begins.

use crate::bake::{BakeOptions, BakeSettings, Engine, common_size, left_out};
use crate::error::Result;
use crate::flattened::Side;
use crate::illumination_grid::GridSize;
use crate::scene::Scene;
use crate::sweep::{lit_mostly_within, lit_within_solids};
use crate::volume::Volume;
use glam::DVec3;

/// What a user may not expect of the bake of `scene` that `options` ask for and `settings` describe.
///
/// # Errors
/// As [`left_out`].
pub(super) fn warnings(
    scene: &Scene,
    volumes: &[&Volume],
    options: &BakeOptions,
    settings: &BakeSettings,
) -> Result<Vec<String>> {
    let mut lines = options.idle(settings);
    for volume in volumes {
        let rounded = volume.rounded();
        if rounded > 0 {
            lines.push(format!(
                "{}: {rounded} of {} samples are integers beyond 2^53, which 64-bit floats round; subtract an offset from them",
                volume.name,
                volume.samples().len()
            ));
        }
    }
    let dark = scene.members().iter().all(|m| m.surface.emission == DVec3::ZERO);
    if scene.luminaires().is_empty() && dark {
        lines.push("nothing emits light; everything will be black".into());
    }
    let sealed = scene.is_capped() && scene.surface.outside == Side::Higher;
    if sealed && scene.fields() == 1 && !lit_within_solids(scene) {
        lines.push(
            "boundary = \"capped\" closes the higher side of surfaces off, which is to be their outside: it will be black; \
             use outside = \"lower\" or boundary = \"open\""
                .into(),
        );
    }
    let mostly_within = |scene: &Scene| {
        let stored = scene.surface.both_sides || scene.surface.emission != DVec3::ZERO;
        !stored && !scene.is_capped() && lit_mostly_within(scene)
    };
    if (0..scene.fields()).any(|n| mostly_within(&scene.lit(n))) {
        lines.push(
            "the luminaires stand mostly within the solids, whose outside is stored; use --sides both, or the other outside"
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
        lines.extend(long_voxels(scene));
    }
    Ok(lines)
}

/// Of volumes whose voxels are long what grid would suit them, if one suits all of them and is not too large.
fn long_voxels(scene: &Scene) -> Option<String> {
    let cubic = common_size(GridSize::Cubic, scene).ok().filter(|size| *size != GridSize::OWN)?;
    let volume = scene.lattice();
    let [nx, ny, nz] = cubic.lattice(volume).ok()?.dims();
    let spacing = volume.spacing();
    Some(format!(
        "voxels are {:.1} times as long as wide, and light on a grid of these is blurred as much; use --grid cubic \
         ({nx}×{ny}×{nz} points), or --grid 1x for the volume's own",
        spacing.max_element() / spacing.min_element()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Lattice, Samples};

    /// A grid that no lattice can be is no advice, nor a fault of a bake that did not ask for it.
    #[test]
    fn long_voxels_are_told_of_a_grid_that_can_be() {
        let said = |dims: [usize; 3], spacing: DVec3| {
            let lattice = Lattice::aligned(dims, DVec3::ZERO, spacing).unwrap();
            let samples = (0..lattice.len()).map(|o| (o % 2) as u8).collect();
            let volume = Volume::new("v", lattice, Samples::U8(samples)).unwrap();
            let field = Field::new(&volume, Sweep::new(0.2, 0.8).unwrap()).unwrap();
            long_voxels(&Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap())
        };
        let advice = said([5, 3, 3], DVec3::new(3.2, 1.0, 1.0)).unwrap();
        assert!(advice.contains("3.2 times") && advice.contains("13×3×3"), "{advice}");
        assert_eq!(said([5, 3, 3], DVec3::new(1.0, 1.3, 1.0)), None);
        assert_eq!(said([600_000, 2, 2], DVec3::new(20.0, 1.0, 1.0)), None);
    }
}
