//! What a bake warns of before it begins.

use crate::bake::{BakeOptions, BakeSettings, Engine, common_size, left_out};
use crate::digits::brief_span;
use crate::error::Result;
use crate::field::Sweep;
use crate::flattened::Side;
use crate::illumination_grid::GridSize;
use crate::polygon::Polygon;
use crate::scene::{Scene, Surface};
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
    lines.extend(spaces(volumes));
    lines.extend(scene.members().iter().zip(volumes).filter_map(|(m, volume)| beyond(m.field.sweep(), volume)));
    lines.extend(scene.members().iter().filter_map(|m| single_colour(&m.surface)));
    lines.extend(resampled(scene, settings.grid));
    lines.extend(elsewhere(scene));
    Ok(lines)
}

/// Of volumes whose worlds differ.
fn spaces(volumes: &[&Volume]) -> Option<String> {
    let (first, others) = volumes.split_first()?;
    let other = others.iter().find(|v| v.space != first.space)?;
    Some(format!(
        "{} has its world {}, {} {} (which is meant where a file says nothing): they stand where their numbers are; if \
         both show the same, turn the axes of one",
        first.name,
        first.space.name(),
        other.name,
        other.space.name()
    ))
}

/// Of a sweep that is mostly beyond the data.
fn beyond(sweep: Sweep, volume: &Volume) -> Option<String> {
    let (min, max) = volume.range()?;
    let share = (sweep.hi().min(max) - sweep.lo().max(min)) / (sweep.hi() - sweep.lo());
    (share < 0.5).then(|| {
        format!(
            "{}: the data span {}; {:.0} % of the sweep {sweep} is beyond them, where no isosurfaces are",
            volume.name,
            brief_span([min, max]),
            100.0 * (1.0 - share)
        )
    })
}

/// Of colours by isovalue, none of which is one of the sweep.
fn single_colour(surface: &Surface) -> Option<String> {
    let stops = surface.albedo.stops();
    let outside = stops.iter().all(|s| s.0 <= 0.0) || stops.iter().all(|s| s.0 >= 1.0);
    (stops.len() > 1 && outside)
        .then(|| "albedo: all its isovalues are on one side of the sweep; every surface has the same colour".into())
}

/// Of a grid that does not hold the volume's points.
fn resampled(scene: &Scene, grid: GridSize) -> Option<String> {
    let (volume, grid) = (scene.lattice(), grid.lattice(scene.lattice()).ok()?);
    let whole = grid.cells().iter().zip(volume.cells()).all(|(fine, coarse)| fine % coarse == 0);
    let [[x, y, z], [nx, ny, nz]] = [grid.dims(), volume.dims()];
    (!whole).then(|| {
        format!(
            "a grid of {x}×{y}×{z} points does not hold the volume's {nx}×{ny}×{nz}: the bake's `value` is the volume \
             resampled to it, whose isosurfaces are others; --grid 1x, 2x … keeps them"
        )
    })
}

/// Of surroundings that do not surround any volume, and of walls far away: another unit, or another place.
fn elsewhere(scene: &Scene) -> Option<String> {
    /// How many times the volume's own size.
    const FAR: f64 = 10.0;
    /// Less of the volumes than this within is no room.
    const HELD: f64 = 0.1;
    let bounds = |points: &mut dyn Iterator<Item = DVec3>| {
        points.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[lo, hi], x| [lo.min(x), hi.max(x)])
    };
    let members = scene.members();
    let corners = members.iter().flat_map(|m| m.field.lattice().corners().map(|p| m.field.lattice().to_world(p)));
    let [volume_lo, volume_hi] = bounds(&mut corners.into_iter());
    let size = volume_hi - volume_lo;
    // The volumes are [0, 1]³.
    let of = |p: &Polygon| bounds(&mut p.vertices().iter().map(|x| (*x - volume_lo) / size));
    let away = |p: &&Polygon| {
        let [lo, hi] = of(p);
        p.emission == DVec3::ZERO && (lo - 1.0).max(-hi).max_element() > FAR
    };
    if let Some(p) = scene.polygons().iter().find(away) {
        return Some(format!("'{}' is more than {FAR} times the volume's size away; is it in the same unit?", p.name));
    }
    let all = scene.polygons().iter().map(of);
    let [lo, hi] = all.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[a, b], [lo, hi]| [a.min(lo), b.max(hi)]);
    let (extent, within) = (hi - lo, (hi.min(DVec3::ONE) - lo.max(DVec3::ZERO)).max(DVec3::ZERO));
    // Lamps that hang side by side may hang anywhere.
    let room = extent.min_element() > 1e-3 * extent.max_element();
    (room && within.element_product() < HELD).then(|| {
        let spans = |lo: DVec3, hi: DVec3| [0, 1, 2].map(|a| brief_span([lo[a], hi[a]])).join(" × ");
        format!(
            "walls and luminaires stand beside the volume, not around it: they span {}, the volume {}; are both in the \
             same unit and place?",
            spans(volume_lo + lo * size, volume_lo + hi * size),
            spans(volume_lo, volume_hi)
        )
    })
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
    use crate::field::Field;
    use crate::scene::Boundary;
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
