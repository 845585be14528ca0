//! Points of a luminaire, uniform over the solid angle under which a receiver sees it: what they give is bounded,
//! however near the luminaire is. Points uniform over the area give cos θ cos θ′/r², which is not.

use super::spherical_fan::SphericalFan;
use super::spherical_rectangle::SphericalRectangle;
use super::{above_horizon, point_term};
use crate::polygon::{Polygon, convex_area, sample_convex};
use glam::DVec3;

/// Solid angles below this are sampled by area: cancellation would show, and the area's points hardly vary.
const LEAST: f64 = 1e-5;

/// Solid angle beyond which a luminaire is near: that of a square seen from 0.8 of its edge away.
const NEAR: f64 = 1.0;

/// A luminaire as one receiver sees it.
#[derive(Debug)]
pub struct Aim<'a> {
    polygon: &'a Polygon,
    x: DVec3,
    n: DVec3,
    spread: Spread,
}

/// What points are uniform over.
#[derive(Debug)]
enum Spread {
    /// The solid angle of all of a rectangle.
    Rectangle(SphericalRectangle),
    /// The solid angle of the part above the horizon.
    Fan(SphericalFan),
    /// The area of the part above the horizon, or, without one, of the whole.
    Area { part: Option<Vec<DVec3>>, area: f64 },
}

impl Spread {
    /// By solid angle; `part` of the polygon, or all of it.
    fn over_solid_angle(polygon: &Polygon, part: Option<&[DVec3]>, x: DVec3) -> Self {
        match part.map_or_else(|| SphericalRectangle::new(polygon, x), |_| None) {
            Some(rectangle) => Self::Rectangle(rectangle),
            None => Self::Fan(SphericalFan::new(part.unwrap_or(polygon.vertices()), polygon.normal(), x)),
        }
    }

    fn solid_angle(&self) -> f64 {
        match self {
            Self::Rectangle(rectangle) => rectangle.solid_angle,
            Self::Fan(fan) => fan.solid_angle,
            Self::Area { .. } => 0.0,
        }
    }
}

impl<'a> Aim<'a> {
    /// Points uniform over the solid angle of rectangles, and of other polygons that are near: all are worth less than
    /// 2π. Of what is near only the part above the horizon of `x` with unit normal `n` is taken. `None` behind the
    /// polygon, and if nothing near is above the horizon.
    pub fn new(polygon: &'a Polygon, x: DVec3, n: DVec3) -> Option<Self> {
        if !(polygon.height(x) > 0.0) {
            return None;
        }
        if may_be_near(polygon, x) {
            return Self::above(polygon, x, n, Some(LEAST));
        }
        let rectangle = SphericalRectangle::new(polygon, x).filter(|r| r.solid_angle > LEAST);
        let area = || Spread::Area { part: None, area: polygon.area() };
        Some(Self { polygon, x, n, spread: rectangle.map_or_else(area, Spread::Rectangle) })
    }

    /// The points that tell most of what `x` sees: by solid angle of a luminaire that fills 1 sr and more, since hardly
    /// any point uniform over the area falls on what a receiver there looks at, otherwise over the area; in either case
    /// of the part above the horizon. `None` as for [`Aim::new`].
    pub fn best(polygon: &'a Polygon, x: DVec3, n: DVec3) -> Option<Self> {
        if !(polygon.height(x) > 0.0) {
            return None;
        }
        Self::above(polygon, x, n, may_be_near(polygon, x).then_some(NEAR))
    }

    /// The part above the horizon: by solid angle if that exceeds `least`.
    fn above(polygon: &'a Polygon, x: DVec3, n: DVec3, least: Option<f64>) -> Option<Self> {
        let part = above_horizon(polygon, x, n);
        if let Some(least) = least {
            let spread = Spread::over_solid_angle(polygon, part.as_deref(), x);
            if spread.solid_angle() > least {
                return Some(Self { polygon, x, n, spread });
            }
        }
        let area = part.as_ref().map_or(polygon.area(), |part| convex_area(part));
        (area > 0.0).then_some(Self { polygon, x, n, spread: Spread::Area { part, area } })
    }

    /// A point of the luminaire from two uniforms, and the irradiance per unit radiance that it gives: the mean of
    /// these is what the whole luminaire gives.
    #[inline]
    pub fn sample(&self, u: [f64; 2]) -> (DVec3, f64) {
        let to = match &self.spread {
            Spread::Rectangle(rectangle) => rectangle.sample(u),
            Spread::Fan(fan) => fan.sample(u),
            Spread::Area { part, area } => {
                let y = part.as_ref().map_or_else(|| self.polygon.sample(u), |part| sample_convex(part, u));
                return (y, area * point_term(self.x, self.n, y, self.polygon.normal()));
            }
        };
        (self.x + to, self.spread.solid_angle() * (to.normalize().dot(self.n)).max(0.0))
    }
}

/// Whether the polygon may fill more than [`NEAR`]: from its nearest point r away it fills area / r² at most.
fn may_be_near(polygon: &Polygon, x: DVec3) -> bool {
    polygon.is_nearer(x, (polygon.area() / NEAR).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::luminaire::unoccluded;
    use crate::rng::{Sobol, Stage};
    use crate::stats::Moments;

    fn flat(corners: &[(f64, f64)]) -> Polygon {
        let v = corners.iter().map(|&(x, y)| DVec3::new(x, y, 1.0)).collect();
        Polygon::new("light", v, DVec3::ZERO, DVec3::ONE).unwrap()
    }

    fn rectangle(x: [f64; 2], y: [f64; 2]) -> Polygon {
        flat(&[(x[0], y[0]), (x[0], y[1]), (x[1], y[1]), (x[1], y[0])])
    }

    /// Of polygons of three, four and six corners, the first of which is a rectangle, and a part of each.
    fn luminaires() -> [(Polygon, Polygon); 4] {
        let hexagon = flat(&[(-0.3, 0.0), (-0.1, 0.3), (0.2, 0.3), (0.3, 0.1), (0.2, -0.1), (-0.1, -0.1)]);
        let triangle = flat(&[(-0.25, -0.1), (-0.2, 0.3), (0.5, 0.1)]);
        let skewed = flat(&[(-0.3, -0.1), (-0.2, 0.3), (0.4, 0.3), (0.3, -0.1)]);
        let part = || rectangle([-0.2, 0.05], [-0.05, 0.1]);
        [
            (rectangle([-0.25, 0.25], [-0.1, 0.3]), part()),
            (triangle, rectangle([-0.2, 0.05], [0.1, 0.15])),
            (skewed, part()),
            (hexagon, part()),
        ]
    }

    const RECEIVERS: [(DVec3, DVec3); 8] = [
        (DVec3::new(0.2, 0.3, 0.1), DVec3::Z),
        (DVec3::new(0.1, 0.1, 0.9), DVec3::new(0.3, 0.2, 1.0)),
        (DVec3::new(-0.8, 0.2, 0.3), DVec3::new(1.0, 0.0, -0.35)),
        (DVec3::new(0.1, 0.0, 0.999), DVec3::new(1.0, -0.5, 0.1)),
        (DVec3::new(0.3, 0.0, 0.9999), DVec3::new(-1.0, -0.5, 0.1)),
        (DVec3::new(0.0, 0.1, 1.0 - 1e-6), DVec3::Z),
        (DVec3::new(-0.05, 0.15, 1.0 - 1e-6), DVec3::new(0.0, 1.0, 1e-3)),
        (DVec3::new(0.0, 0.1, -40.0), DVec3::new(0.1, 0.0, 1.0)),
    ];

    /// Means over luminaires and over a part of each against the closed form, near and far, below the horizon in part.
    #[test]
    fn means_are_the_closed_form() {
        let mut fans = 0;
        for (l, (light, part)) in luminaires().iter().enumerate() {
            for (i, (x, n)) in RECEIVERS.into_iter().enumerate() {
                let n = n.normalize();
                let open = unoccluded(light, x, n);
                let aim = Aim::new(light, x, n).unwrap();
                assert!(l == 0 || !matches!(aim.spread, Spread::Rectangle(_)));
                fans += usize::from(matches!(aim.spread, Spread::Fan(_)));
                let set = Sobol::set(3, Stage::Test, i as u64);
                let count = 1 << 17;
                if let Some(best) = Aim::best(light, x, n) {
                    let mean = (0..count).map(|k| best.sample(set.point2(k, 0)).1).sum::<f64>() / f64::from(count);
                    assert!((mean - open).abs() < 2e-3 * open.max(1e-2), "{l}, receiver {i}: {mean} {open}");
                }
                let (mut whole, mut inside) = (0.0, 0.0);
                for k in 0..count {
                    let (y, w) = aim.sample(set.point2(k, 0));
                    assert!(light.contains(y) || light.contains(y + 1e-9 * (DVec3::new(0.0, 0.1, 1.0) - y)), "{y}");
                    assert!((0.0..=std::f64::consts::TAU).contains(&w), "bounded: {w}");
                    whole += w / f64::from(count);
                    inside += if part.contains(y) { w / f64::from(count) } else { 0.0 };
                }
                for (mean, polygon, least) in [(whole, light, 0.0), (inside, part, 1e-2)] {
                    let exact = unoccluded(polygon, x, n);
                    assert!((mean - exact).abs() < 2e-3 * exact.max(least), "{l}, receiver {i}: {mean} {exact}");
                }
            }
        }
        assert_eq!(fans, 19, "what is near, and no rectangle or cut by the horizon");
    }

    /// Beside luminaires of any shape, and where they are half below the horizon, no point is worth many times the
    /// mean, as some of those uniform over the area are.
    #[test]
    fn no_point_outweighs_the_others() {
        for (l, (light, _)) in luminaires().iter().enumerate() {
            for (i, (x, n)) in RECEIVERS.into_iter().enumerate() {
                let n = n.normalize();
                let (mut worths, set) = (Moments::default(), Sobol::set(7, Stage::Test, i as u64));
                let aim = Aim::new(light, x, n).unwrap();
                let most = (0..4096).map(|k| aim.sample(set.point2(k, 0)).1).inspect(|&w| worths.push(w));
                let most = most.fold(0.0, f64::max);
                let relative = 64.0 * worths.std_error() / worths.mean();
                assert!(most < 4.0 * worths.mean() && relative < 1.0, "{l}, receiver {i}: {most} {relative}");
            }
        }
    }

    /// What a receiver next to a luminaire sees through a hole: π r²/(r² + h²) for a disk of radius r at height h. Of
    /// points over the area one in 80 000 would fall there.
    #[test]
    fn a_few_points_find_what_is_seen_of_a_near_luminaire() {
        let half = flat(&[(-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]);
        for light in [rectangle([-0.5, 0.5], [-0.5, 0.5]), half] {
            let (x, h, r) = (DVec3::new(-0.2, 0.1, 0.999), 0.001, 0.002);
            let aim = Aim::best(&light, x, DVec3::Z).unwrap();
            let set = Sobol::set(5, Stage::Test, 0);
            let (mut seen, mut all) = (0.0, 0.0);
            for k in 0..128 {
                let (y, g) = aim.sample(set.point2(k, 0));
                all += g;
                seen += if (y - x).truncate().length() < r { g } else { 0.0 };
            }
            assert!((seen / all - r * r / (r * r + h * h)).abs() < 0.05, "{}", seen / all);
            let far = Aim::best(&light, DVec3::ZERO, DVec3::Z).unwrap();
            assert!(matches!(far.spread, Spread::Area { .. }), "not near");
            assert!(Aim::best(&light, x, -DVec3::Z).is_none(), "looks away");
            assert!(Aim::new(&light, DVec3::new(0.0, 0.0, 1.1), -DVec3::Z).is_none(), "behind");
        }
    }

    #[test]
    fn what_is_far_is_sampled_by_area() {
        for (light, _) in &luminaires() {
            let x = DVec3::new(0.0, 0.0, -500.0);
            let aim = Aim::new(light, x, DVec3::Z).unwrap();
            assert!(matches!(aim.spread, Spread::Area { .. }));
            let set = Sobol::set(4, Stage::Test, 0);
            let mean = (0..1 << 14).map(|k| aim.sample(set.point2(k, 0)).1).sum::<f64>() / f64::from(1 << 14);
            assert!((mean / unoccluded(light, x, DVec3::Z) - 1.0).abs() < 1e-3);
        }
    }
}
