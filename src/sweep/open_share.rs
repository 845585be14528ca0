//! The share of a luminaire outside the matter. A luminaire may stand in the volume; then part of it lies within the
//! solid of an isovalue, and how much its points say of that is the same error at all receivers.

use crate::direct::luminance;
use crate::field::Field;
use crate::flattened::Side;
use crate::polygon::Polygon;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use glam::DVec3;

/// Points that tell the share itself: their error is small beside that of any luminaire points.
const POINTS: u32 = 1 << 14;
/// Points that tell where a luminaire stands, at most; of many luminaires as many together as of sixteen, and eight at
/// least.
const ROUGHLY: u32 = 1 << 10;

/// Of a luminaire: its open share over what its points say it is.
pub(super) struct OpenShare {
    /// Number of points, and h of those within Ω, ascending: of many, and of those that light.
    many: (usize, Vec<f32>),
    few: (usize, Vec<f32>),
}

impl OpenShare {
    /// `points`: those that light, of all replicates; `set`: where others come from.
    pub(super) fn new(field: &Field, light: &Polygon, points: &[DVec3], set: &Sobol) -> Self {
        let sorted = |points: &mut dyn Iterator<Item = DVec3>| {
            let mut h: Vec<f32> = heights(field, points).collect();
            h.sort_unstable_by(f32::total_cmp);
            h
        };
        let mut many = (0..POINTS).map(|i| light.sample(set.point2(i, 0)));
        Self { many: (POINTS as usize, sorted(&mut many)), few: (points.len(), sorted(&mut points.iter().copied())) }
    }

    /// What light at isovalue `c` is multiplied by; 1 where no point is open.
    pub(super) fn correction(&self, side: Side, c: f32) -> f64 {
        let [many, few] = [&self.many, &self.few].map(|(count, h)| {
            let below = h.partition_point(|h| *h < c);
            let closed = if side == Side::Lower { h.len() - below } else { below };
            (count - closed) as f64 / *count as f64
        });
        if few > 0.0 { many / few } else { 1.0 }
    }

    /// Whether the luminaire is open at every isovalue of the sweep, on either side.
    pub(super) fn whole(&self) -> bool {
        self.many.1.is_empty() && self.few.1.is_empty()
    }
}

/// h at those of the points that lie within Ω, where it is known.
#[allow(clippy::cast_possible_truncation, reason = "h is f32")]
fn heights(field: &Field, points: impl Iterator<Item = DVec3>) -> impl Iterator<Item = f32> {
    let (lattice, far) = (field.lattice(), field.lattice().far());
    let inside = points.map(|y| lattice.to_index(y)).filter(move |y| y.cmpge(DVec3::ZERO).all() && y.cmple(far).all());
    inside.map(|y| field.value(y) as f32).filter(|h| !h.is_nan())
}

/// The share of what a scene's luminaires emit over the whole sweep that is open on one side; 1 if there are none.
pub(super) fn open_over_sweep(scene: &Scene, side: Side) -> f64 {
    let (set, far) = (Sobol::set(0, Stage::Sweep, 0), scene.lattice().far());
    let count = u32::try_from(scene.luminaires().len()).unwrap_or(u32::MAX);
    let each = (16 * ROUGHLY / count.max(1)).clamp(8, ROUGHLY);
    let (mut all, mut closed) = (0.0, 0.0);
    for light in scene.luminaires() {
        let flux = light.area() * luminance(light.emission);
        all += flux;
        let corners = || light.vertices().iter().map(|&x| scene.lattice().to_index(x));
        let (lo, hi) = (corners().fold(DVec3::INFINITY, DVec3::min), corners().fold(DVec3::NEG_INFINITY, DVec3::max));
        if lo.cmpgt(far).any() || hi.cmplt(DVec3::ZERO).any() {
            continue;
        }
        // At h a point is closed below c = h on the lower side, above it on the higher one.
        let share = |h: f32| f64::from(if side == Side::Lower { h.clamp(0.0, 1.0) } else { 1.0 - h.clamp(0.0, 1.0) });
        let points = (0..each).map(|i| light.sample(set.point2(i, 0)));
        closed += flux * heights(&scene.field, points).map(share).sum::<f64>() / f64::from(each);
    }
    if all > 0.0 { 1.0 - closed / all } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::volume::{Lattice, Samples};

    /// h = x on the unit cube, a luminaire from x = 0.5 to 1.5 across its face: at isovalue c the part c < x < 1 lies
    /// in the solid.
    #[test]
    fn shares_follow_from_the_field_on_the_luminaire() {
        let lattice = Lattice::aligned([11; 3], DVec3::ZERO, DVec3::splat(0.1)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f64 / 10.0).collect();
        let field = Field::made(lattice, Samples::F64(samples), 0.0, 1.0);
        let corners = [(0.5, 0.2), (1.5, 0.2), (1.5, 0.8), (0.5, 0.8)];
        let corners = corners.map(|(x, y)| DVec3::new(x, y, 0.5)).to_vec();
        let light = Polygon::new("light", corners, DVec3::ZERO, DVec3::ONE).unwrap();
        // Of three points one is open at 0.7 on the lower side, two on the higher.
        let points = [0.6, 0.9, 1.2].map(|x| DVec3::new(x, 0.5, 0.5));
        let open = OpenShare::new(&field, &light, &points, &Sobol::set(1, Stage::Test, 1));
        assert!(!open.whole());
        for (side, c, expected) in [
            (Side::Lower, 0.7, 0.7 / (2.0 / 3.0)),
            (Side::Higher, 0.7, 0.8 / (2.0 / 3.0)),
            (Side::Lower, 0.95, 0.95),
            (Side::Lower, 0.3, 0.5 / (1.0 / 3.0)),
        ] {
            let got = open.correction(side, c);
            assert!((got - expected).abs() < 1e-3, "{side:?} {c}: {got}, expected {expected}");
        }
        let none = OpenShare::new(&field, &light, &points[..2], &Sobol::set(1, Stage::Test, 1));
        assert_eq!(none.correction(Side::Lower, 0.3), 1.0, "no point is open");
    }
}
