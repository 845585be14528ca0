//! Whether a mesh is an isosurface of a volume.

use crate::digits::{Shortest, brief_within};
use crate::error::{Error, Result};
use crate::field::Field;
use glam::DVec3;

/// How far h may be from the isovalue everywhere, in units of the sweep: the rounding of positions and samples.
const ROUNDING: f64 = 1e-4;

/// Share of the spread that h may be off where the isovalue is not known: those that fit best lie nearer.
const UNKNOWN: f64 = 0.3;
/// The same where isovalue and samples are known.
const EXACT: f64 = 0.02;

/// Refuses vertices (world) that are of no isosurface of `field`'s sweep: some lie outside of the volume, or h at most
/// of them is further from `isovalue` (source units; their median if `None`) than the samples of its cell are from
/// each other (a share of it if `None`), which the same volume on another grid is at few of them. `exact`: the field
/// has the volume's own samples, whose isosurface lies where h is the isovalue.
///
/// # Errors
/// `Invalid` for such vertices, and for an isovalue outside the sweep.
pub fn belongs(positions: &[DVec3], isovalue: Option<f64>, field: &Field, exact: bool) -> Result<()> {
    let (lattice, sweep) = (field.lattice(), field.sweep());
    let local: Vec<DVec3> = positions.iter().map(|&x| lattice.to_index(x)).collect();
    // Files in f32 move vertices far from the origin by up to a voxel.
    let within = |p: &DVec3| p.cmpge(DVec3::NEG_ONE).all() && p.cmple(lattice.far() + 1.0).all();
    let outside = local.iter().filter(|p| !within(p)).count();
    if outside > 0 {
        return Err(Error::Invalid(format!(
            "{outside} of its {} vertices lie outside of the bake's volume; make it of the volume that was baked",
            local.len()
        )));
    }
    // h and the spread of the cell's samples; none beside gaps.
    let found: Vec<[f64; 2]> = local
        .iter()
        .filter_map(|&p| {
            let corners = field.corners(field.locate(p).0);
            let (lo, hi) = corners.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &s| (l.min(s), h.max(s)));
            Some([field.value(p), f64::from(hi) - f64::from(lo)]).filter(|f| f[0].is_finite())
        })
        .collect();
    let Some(middle) = median(found.iter().map(|f| f[0])) else { return Ok(()) };
    let c = isovalue.map_or(middle, |c| sweep.to_unit(c));
    let slack = match isovalue {
        Some(_) => 0.01 * ROUNDING,
        None => ROUNDING + median(found.iter().map(|f| (f[0] - c).abs())).unwrap_or(0.0),
    };
    // A median has digits that mean nothing.
    let rounded = || brief_within(sweep.from_unit(c), [sweep.lo(), sweep.hi()]);
    let said = isovalue.map_or_else(rounded, Shortest);
    if !(-slack..=1.0 + slack).contains(&c) {
        return Err(Error::Invalid(format!(
            "is of isovalue {said}, outside of the bake's sweep {sweep}; make one inside, or bake a wider sweep"
        )));
    }
    let share = match isovalue {
        None => UNKNOWN,
        Some(_) if exact => EXACT,
        Some(_) => 1.0,
    };
    let off = found.iter().filter(|[h, spread]| (h - c).abs() > share * spread + ROUNDING).count();
    if 2 * off > found.len() {
        return Err(Error::Invalid(format!(
            "is no isosurface of the bake's volume: {off} of {} vertices do not lie at isovalue {said}; make it of the \
             volume that was baked",
            found.len()
        )));
    }
    Ok(())
}

/// The middle one of some numbers.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}
