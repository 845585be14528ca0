//! Analytic fields on `[0,1]³` with exact value and gradient: what the tests know the answers of. Simulated ones stand
//! in the modules, and where BB09 looks at the bumps.

pub mod bumps;
pub mod fluid;
pub mod molecular_dynamics;
pub mod neighbours;
pub mod number_density;
pub mod pair_potential;
pub mod pasta;
#[cfg(test)]
mod simulation_tests;

use crate::error::{Error, Result};
use crate::volume::{Lattice, Samples, Volume};
use glam::DVec3;
use rayon::prelude::*;

/// The bumps: peak, centre, width.
const BUMPS: [(f64, DVec3, f64); 4] = [
    (100.0, DVec3::new(0.50, 0.50, 0.38), 0.16),
    (80.0, DVec3::new(0.32, 0.40, 0.74), 0.05),
    (80.0, DVec3::new(0.62, 0.35, 0.76), 0.05),
    (80.0, DVec3::new(0.52, 0.66, 0.72), 0.05),
];

/// Radius of each of the two cylinders at h = 1/2.
pub const CYLINDER_RADIUS: f64 = 0.08;

/// Half the angle between the two cylinders' axes, radians.
const CYLINDER_ANGLE: f64 = 0.25;

/// Sharpness of the union of the two cylinders.
const CYLINDER_POWER: i32 = 8;

/// Gap of the `two-cylinders` when none is given: half a radius.
const CYLINDER_GAP: f64 = 0.04;

/// Names of the simulations, which are no [`Generator`]s: they take minutes, and go through a file.
pub const SIMULATED: [&str; 2] = ["pasta", "fluid"];

/// A field on `[0,1]³`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Generator {
    /// A large Gaussian bump under three small ones that shadow it; values 0 … 100, sweep [3.6, 95].
    Bumps,
    /// h = |x − (½,½,½)|², growing outwards from 0 to ¾. Inside is h ≥ c, so the ball is the *outside* (the lower
    /// side): light in it sees an integrating sphere of radius √c. With the outside flipped it is a solid ball.
    Sphere,
    /// h = a·x: level sets are planes.
    Linear(
        /// The gradient.
        DVec3,
    ),
    /// h = x·y·z.
    Xyz,
    /// Two cylinders, one above the other, whose axes cross at 0.5 rad when seen from above \[BB09 Fig. 1\].
    ///
    /// hᵢ = 2^−(dᵢ/R)², d the distance from axis i and R = [`CYLINDER_RADIUS`], joined smoothly as (h₁⁸ + h₂⁸)^⅛. The
    /// level set at ½ is the two cylinders of radius R; where they nearly touch they swell towards each other, and
    /// below a gap of 0.12 R they join.
    TwoCylinders {
        /// Free distance between the two cylinders at h = ½ in the field's units. BB09 shows several diameters and
        /// less than one.
        gap: f64,
    },
}

impl Generator {
    /// The names [`Generator::from_name`] knows.
    pub fn names() -> &'static [&'static str] {
        &["bumps", "sphere", "linear", "xyz", "two-cylinders"]
    }

    /// The generator of a name. `linear:a,b,c` sets the gradient (0,0,1 without), `two-cylinders:gap` the gap (0.04
    /// without).
    ///
    /// # Errors
    /// `Invalid` with the list of names, or if a parameter is none.
    pub fn from_name(name: &str) -> Result<Self> {
        let (kind, parameters) = name.split_once(':').map_or((name, None), |(k, p)| (k, Some(p)));
        let numbers: Option<Vec<f64>> =
            parameters.map_or(Some(vec![]), |p| p.split(',').map(|w| w.trim().parse().ok()).collect());
        let numbers = numbers.filter(|n| n.iter().all(|v: &f64| v.is_finite()));
        match (kind, numbers.as_deref()) {
            ("bumps", Some([])) => Ok(Self::Bumps),
            ("sphere", Some([])) => Ok(Self::Sphere),
            ("linear", Some([])) => Ok(Self::Linear(DVec3::Z)),
            ("linear", Some(&[x, y, z])) if (x, y, z) != (0.0, 0.0, 0.0) => Ok(Self::Linear(DVec3::new(x, y, z))),
            ("xyz", Some([])) => Ok(Self::Xyz),
            ("two-cylinders", Some([])) => Ok(Self::TwoCylinders { gap: CYLINDER_GAP }),
            // Farther apart, they would leave the cube.
            ("two-cylinders", Some(&[gap])) if (0.0..=0.6).contains(&gap) => Ok(Self::TwoCylinders { gap }),
            _ if SIMULATED.contains(&name) => Err(Error::Invalid(format!(
                "generator `{name}` is a simulation: run `isolume generate {name} -o FILE` and name the file"
            ))),
            _ => Err(Error::Invalid(format!(
                "generator `{name}`: known are {} and the simulations {}; `linear:a,b,c` takes a gradient other than 0, \
                 `two-cylinders:gap` a gap from 0 to 0.6",
                Self::names().join(", "),
                SIMULATED.join(", ")
            ))),
        }
    }

    /// The name, without parameters.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Bumps => "bumps",
            Self::Sphere => "sphere",
            Self::Linear(_) => "linear",
            Self::Xyz => "xyz",
            Self::TwoCylinders { .. } => "two-cylinders",
        }
    }

    /// The samples per axis of the tables: 101³.
    pub const DIMS: [usize; 3] = [101; 3];

    /// h at a point.
    pub fn value(&self, x: DVec3) -> f64 {
        match *self {
            Self::Bumps => BUMPS.iter().map(|&(peak, m, s)| peak * gauss(x - m, s)).sum(),
            Self::Sphere => (x - 0.5).length_squared(),
            Self::Linear(a) => a.dot(x),
            Self::Xyz => x.x * x.y * x.z,
            Self::TwoCylinders { gap } => cylinders(x, gap).0,
        }
    }

    /// ∇h at a point.
    pub fn gradient(&self, x: DVec3) -> DVec3 {
        match *self {
            Self::Bumps => BUMPS.iter().map(|&(peak, m, s)| (x - m) * (-peak * gauss(x - m, s) / (s * s))).sum(),
            Self::Sphere => 2.0 * (x - 0.5),
            Self::Linear(a) => a,
            Self::Xyz => DVec3::new(x.y * x.z, x.x * x.z, x.x * x.y),
            Self::TwoCylinders { gap } => cylinders(x, gap).1,
        }
    }

    /// Samples along each edge at most.
    pub const MOST: usize = 2048;

    /// Samples the field, as f32, on a vertex-centred lattice over `[0,1]³`.
    ///
    /// # Errors
    /// `Invalid` as [`Lattice::new`], beyond [`Generator::MOST`] samples along an edge, and for samples that f32 does
    /// not hold or tell apart.
    pub fn sample(&self, dims: [usize; 3]) -> Result<Volume> {
        if let Some(n) = dims.into_iter().find(|&n| n > Self::MOST) {
            return Err(Error::Invalid(format!("size {n}: at most {} samples along each edge", Self::MOST)));
        }
        let spacing = DVec3::from_array(dims.map(|n| 1.0 / n.saturating_sub(1).max(1) as f64));
        let lattice = Lattice::aligned(dims, DVec3::ZERO, spacing)?;
        let at = |o: usize| {
            let [i, j, k] = lattice.ijk(o);
            // A quotient, unlike a multiple of the spacing, ends at 1 exactly.
            let along = |i: usize, n: usize| i as f64 / (n - 1) as f64;
            self.value(DVec3::new(along(i, dims[0]), along(j, dims[1]), along(k, dims[2]))) as f32
        };
        let samples = (0..lattice.len()).into_par_iter().map(at).collect();
        let volume = Volume::new(self.name(), lattice, Samples::F32(samples))?;
        if volume.non_finite() > 0 || volume.range().is_none_or(|(lo, hi)| lo == hi) {
            return Err(Error::Invalid(format!(
                "generator `{}`: its samples are infinite or all the same as 32-bit floats; give parameters between 1e-30 and 1e30, \
                 or more samples",
                self.name()
            )));
        }
        Ok(volume)
    }
}

/// exp(−|d|²/2σ²).
fn gauss(d: DVec3, sigma: f64) -> f64 {
    (-d.length_squared() / (2.0 * sigma * sigma)).exp()
}

/// Value and gradient of the two cylinders.
fn cylinders(x: DVec3, gap: f64) -> (f64, DVec3) {
    let rate = std::f64::consts::LN_2 / (CYLINDER_RADIUS * CYLINDER_RADIUS);
    let one = |side: f64| {
        let axis = DVec3::new(CYLINDER_ANGLE.cos(), side * CYLINDER_ANGLE.sin(), 0.0);
        let d = x - DVec3::new(0.5, 0.5, 0.5 + side * (CYLINDER_RADIUS + 0.5 * gap));
        let away = d - axis * d.dot(axis);
        let h = (-rate * away.length_squared()).exp();
        (h, away * (-2.0 * rate * h))
    };
    let [(h1, g1), (h2, g2)] = [one(-1.0), one(1.0)];
    let most = h1.max(h2);
    if most == 0.0 {
        return (0.0, DVec3::ZERO);
    }
    // Relative to the greater one, whose power cannot underflow.
    let (r1, r2) = (h1 / most, h2 / most);
    let norm = (r1.powi(CYLINDER_POWER) + r2.powi(CYLINDER_POWER)).powf(1.0 / CYLINDER_POWER as f64);
    let weight = |r: f64| (r / norm).powi(CYLINDER_POWER - 1);
    (most * norm, g1 * weight(r1) + g2 * weight(r2))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> Vec<Generator> {
        let mut all: Vec<_> = Generator::names().iter().map(|n| Generator::from_name(n).unwrap()).collect();
        all.push(Generator::from_name("two-cylinders:0.4").unwrap());
        all.push(Generator::from_name("linear:1,-2,0.5").unwrap());
        all
    }

    #[test]
    fn gradients_match_central_differences() {
        let step = 1e-5;
        for g in all() {
            for n in 0..200u32 {
                let x = DVec3::new(0.7548, 0.5698, 0.3281) * n as f64;
                let x = x - x.floor();
                let difference = |e: DVec3| (g.value(x + e * step) - g.value(x - e * step)) / (2.0 * step);
                let numeric = DVec3::new(difference(DVec3::X), difference(DVec3::Y), difference(DVec3::Z));
                let exact = g.gradient(x);
                assert!((numeric - exact).length() <= 1e-5 * (1.0 + exact.length()), "{g:?} {x}: {numeric} {exact}");
            }
        }
    }

    #[test]
    fn values_are_known() {
        // Evaluated independently.
        let b = Generator::Bumps;
        for (x, h) in [
            ([0.5, 0.5, 0.38], 100.00000000004027),
            ([0.32, 0.4, 0.74], 83.47569824219272),
            ([0.3, 0.6, 0.7], 5.117010270720861),
        ] {
            assert!((b.value(DVec3::from_array(x)) - h).abs() < 1e-12 * h, "{x:?}");
        }
        assert_eq!(Generator::Sphere.value(DVec3::ZERO), 0.75);
        assert!(Generator::Sphere.gradient(DVec3::new(0.7, 0.5, 0.5)).x > 0.0, "grows outwards");
        assert_eq!(Generator::Linear(DVec3::new(1.0, 2.0, 3.0)).value(DVec3::new(1.0, 0.5, -1.0)), -1.0);
        assert_eq!(Generator::Xyz.value(DVec3::new(0.5, 0.5, 0.25)), 0.0625);
    }

    #[test]
    fn the_cylinders_stand_apart_by_their_gap() {
        for gap in [0.04, 0.4] {
            let g = Generator::TwoCylinders { gap };
            let top = |z: f64| g.value(DVec3::new(0.5, 0.5, z));
            let far = 0.5 + 0.5 * gap + 2.0 * CYLINDER_RADIUS;
            assert!((top(far) - 0.5).abs() < 1e-4, "the upper cylinder's upper side: {}", top(far));
            assert!((top(1.0 - far) - 0.5).abs() < 1e-4);
            assert!(top(0.5) < 0.5, "the gap is open: {}", top(0.5));
            assert!((top(0.5 + 0.5 * gap + CYLINDER_RADIUS) - 1.0).abs() < 1e-3, "the axis");
        }
        assert!(Generator::TwoCylinders { gap: 0.0 }.value(DVec3::splat(0.5)) > 0.5, "touching cylinders join");
    }

    #[test]
    fn samples_stand_on_the_unit_cube() {
        let v = Generator::Xyz.sample([5, 3, 2]).unwrap();
        assert_eq!(v.name, "xyz");
        assert_eq!(v.lattice.to_world(v.lattice.far()), DVec3::ONE);
        assert_eq!(v.lattice.spacing(), DVec3::new(0.25, 0.5, 1.0));
        assert_eq!(v.value(v.lattice.offset(2, 1, 1)), 0.25);
        assert_eq!(v.value(v.lattice.offset(4, 2, 1)), 1.0);
        assert!(Generator::Xyz.sample([1, 3, 2]).is_err());
    }

    #[test]
    fn unknown_names_list_the_known() {
        for bad in ["bump", "bumps:1", "linear:1,2", "linear:0,0,0", "two-cylinders:-1", "two-cylinders:x", "xyz:"] {
            let message = Generator::from_name(bad).unwrap_err().to_string();
            assert!(message.contains(bad) && message.contains("two-cylinders"), "{message}");
        }
        for (generator, name) in all().iter().zip(Generator::names()) {
            assert_eq!(generator.name(), *name);
        }
    }
}
