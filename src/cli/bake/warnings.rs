//! What a bake warns of before it begins.

use crate::bake::{BakeOptions, BakeSettings, Engine, common_size, left_out};
use crate::digits::brief_span;
use crate::error::Result;
use crate::field::Sweep;
use crate::flattened::Side;
use crate::illumination_grid::GridSize;
use crate::polygon::Polygon;
use crate::scene::{Scene, Surface};
use crate::scene_file::Loaded;
use crate::sweep::{lit_mostly_within, lit_within_solids};
use crate::volume::{Lattice, Space, Volume};
use glam::DVec3;

/// What a user may not expect of the bake of what is `loaded`, which may be one `frame` of many, that `options` ask for
/// and `settings` describe.
///
/// # Errors
/// As [`left_out`].
pub(super) fn warnings(
    loaded: &Loaded,
    options: &BakeOptions,
    settings: &BakeSettings,
    frame: bool,
) -> Result<Vec<String>> {
    let (scene, volumes) = (&loaded.scene, loaded.volumes());
    let mut lines = options.idle(settings);
    for volume in &volumes {
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
    lines.extend(spaces(&loaded.spaces));
    // The sweep of a series is that of all its frames.
    let alone = scene.members().into_iter().zip(&volumes).filter(|_| !frame);
    lines.extend(alone.filter_map(|(m, volume)| beyond(m.field.sweep(), volume)));
    lines.extend(scene.members().iter().filter_map(|m| single_colour(&m.surface)));
    lines.extend(scene.members().iter().find_map(|m| resampled(m.field.lattice(), settings.grid)));
    lines.extend(elsewhere(scene));
    Ok(lines)
}

/// Of volumes whose worlds differ.
fn spaces(spaces: &[(String, Space)]) -> Option<String> {
    let ((first, space), others) = spaces.split_first()?;
    let (other, another) = others.iter().find(|(_, another)| another != space)?;
    Some(format!(
        "{first} has its world {}, {other} {} (where a file says nothing, {} is meant): they stand where their numbers \
         are; if both show the same, turn the axes of one",
        space.name(),
        another.name(),
        Space::default().name()
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
fn resampled(volume: &Lattice, grid: GridSize) -> Option<String> {
    let grid = grid.lattice(volume).ok()?;
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
    let of = |p: &Polygon| bounds(&mut p.vertices().iter().copied());
    let away = |p: &&Polygon| {
        let [lo, hi] = of(p);
        let gap = (lo - volume_hi).max(volume_lo - hi).max_element();
        p.emission == DVec3::ZERO && gap > FAR * size.max_element()
    };
    if let Some(p) = scene.polygons().iter().find(away) {
        return Some(format!("'{}' is more than {FAR} times the volume's size away; is it in the same unit?", p.name));
    }
    let all = scene.polygons().iter().map(of);
    let [lo, hi] = all.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[a, b], [lo, hi]| [a.min(lo), b.max(hi)]);
    let extent = hi - lo;
    let held = (hi.min(volume_hi) - lo.max(volume_lo)).max(DVec3::ZERO) / size;
    // A wall, or lamps without any, may be anywhere.
    let walls = scene.polygons().iter().any(|p| p.emission == DVec3::ZERO);
    let room = walls && extent.min_element() > 1e-3 * extent.max_element();
    (room && held.element_product() < HELD).then(|| {
        let spans = |lo: DVec3, hi: DVec3| [0, 1, 2].map(|a| brief_span([lo[a], hi[a]])).join(" × ");
        format!(
            "walls and luminaires stand beside the volume, not around it: they span {}, the volume {}; are both in the \
             same unit and place?",
            spans(lo, hi),
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
    use crate::volume::Samples;

    /// A grid that no lattice can be is no advice, nor a fault of a bake that did not ask for it.
    #[test]
    fn long_voxels_are_told_of_a_grid_that_can_be() {
        let said = |dims: [usize; 3], spacing: DVec3| {
            let lattice = Lattice::aligned(dims, DVec3::ZERO, spacing).unwrap();
            let samples = (0..lattice.len()).map(|o| (o % 2) as u8).collect();
            let field = Field::made(lattice, Samples::U8(samples), 0.2, 0.8);
            long_voxels(&Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap())
        };
        let advice = said([5, 3, 3], DVec3::new(3.2, 1.0, 1.0)).unwrap();
        assert!(advice.contains("3.2 times") && advice.contains("13×3×3"), "{advice}");
        assert_eq!(said([5, 3, 3], DVec3::new(1.0, 1.3, 1.0)), None);
        assert_eq!(said([600_000, 2, 2], DVec3::new(20.0, 1.0, 1.0)), None);
    }

    /// Rooms much higher than a thin volume, lamps by themselves and walls beyond an open room are where they are meant
    /// to be; a room of another size or place is not.
    #[test]
    fn surroundings_elsewhere_are_told() {
        let lattice = Lattice::aligned([33, 33, 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| (o % 2) as u8).collect();
        let volume = Volume::new("v", lattice, Samples::U8(samples)).unwrap();
        let field = std::sync::Arc::new(Field::new(&volume, Sweep::new(0.2, 0.8).unwrap()).unwrap());
        let square = |z: f64, half: f64, emission: f64| {
            let at = |x: f64, y: f64| DVec3::new(16.0 + half * x, 16.0 + half * y, z);
            let corners = vec![at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)];
            Polygon::new("square", corners, DVec3::splat(0.5), DVec3::splat(emission)).unwrap()
        };
        let told = |polygons: Vec<Polygon>| {
            elsewhere(&Scene::new(field.clone(), Surface::default(), Boundary::Open, polygons).unwrap())
        };
        assert_eq!(told(Vec::new()), None);
        assert_eq!(told(vec![square(-1.0, 20.0, 0.0), square(40.0, 20.0, 0.0), square(39.0, 5.0, 1.0)]), None);
        assert_eq!(told(vec![square(50.0, 5.0, 1.0), square(60.0, 5.0, 1.0)]), None);
        assert_eq!(told(vec![square(900.0, 5.0, 1.0)]), None);
        assert_eq!(told(vec![square(-1.0, 20.0, 0.0)]), None);
        let beside = told(vec![square(50.0, 20.0, 0.0), square(60.0, 20.0, 1.0)]).unwrap();
        assert!(beside.contains("-4 … 36 × -4 … 36 × 50 … 60, the volume 0 … 32 × 0 … 32 × 0 … 2"), "{beside}");
        assert!(told(vec![square(0.0, 1.0, 0.0), square(1.0, 1.0, 1.0)]).is_some());
        assert!(told(vec![square(400.0, 20.0, 0.0)]).unwrap().contains("'square' is more than 10 times"));
    }
}
