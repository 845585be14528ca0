//! n = 2: light on height fields, where BB09's idea shows in one picture. \[BB09 §2–2.2\]
//!
//! h₂: R² → R has a surface in R³ for a graph. *Flattened*, light stays in horizontal planes: the plane at height c
//! holds the level curve L(h, c), the walls and the luminaire as segments, and a point reflects by f♭ = ρ/2.
//! *Ordinary*, the same surface is lit as a surface in R³, by f = ρ/π, between the walls and the luminaire extruded
//! upright over the sweep. Both go through [`crate::tracer::Tracer`], and everything above it is one code.
//!
//! It is a second solver as well: an n = 2 field extruded along z must look to the n = 3 pipeline as it looks here.

mod contour;
mod field2;
mod pictures;
mod scene_file;
mod solution;
pub mod study;
mod tracer2;
mod transport;

pub use field2::HeightField;
pub use pictures::{PictureSettings, write_pictures};
pub use scene_file::load;
pub use solution::{Solution, SolveSettings};
pub use tracer2::{GraphSurface, LevelCurves};
pub use transport::{Landing, PathVertex, Receiver, World, unoccluded_share};

use crate::error::{Error, Result};
use crate::flattened::Side;
use glam::{DVec2, DVec3};
use std::sync::Arc;

/// How light travels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// In horizontal planes, a circle of directions about every point. \[BB09 Eq. 2\]
    Flattened,
    /// In R³, a sphere of directions about every point. \[BB09 Eq. 1\]
    Ordinary,
}

/// A wall or luminaire of the plane: a straight segment, extruded over all heights when flattened and over the sweep's
/// when ordinary. It stands on the ground in world units.
///
/// Walls are seen, lit and light from the front only. A luminaire (emission ≠ 0) blocks light from both sides.
#[derive(Clone, Debug, PartialEq)]
pub struct Segment {
    /// Name, for messages.
    pub name: String,
    /// Ends, in world units; the front is to the left of the way from the first to the second.
    pub ends: [DVec2; 2],
    /// Diffuse reflectance per channel, [0, 1].
    pub albedo: DVec3,
    /// Emitted radiance per channel.
    pub emission: DVec3,
}

impl Segment {
    /// A segment from `a` to `b` whose front looks to the side of `towards`.
    ///
    /// # Errors
    /// `Invalid` if the ends coincide or are not finite, or a coefficient is out of range.
    pub fn facing(name: &str, [a, b]: [DVec2; 2], towards: DVec2, albedo: DVec3, emission: DVec3) -> Result<Self> {
        let fail = |what: String| Err(Error::Invalid(format!("segment '{name}': {what}")));
        if !(a.is_finite() && b.is_finite() && a != b) {
            return fail(format!("ends {a} and {b}: they must be finite and differ"));
        }
        if !(albedo.cmpge(DVec3::ZERO).all() && albedo.cmple(DVec3::ONE).all()) {
            return fail(format!("albedo {albedo}: every channel must lie in [0, 1]"));
        }
        if !(emission.cmpge(DVec3::ZERO).all() && emission.is_finite()) {
            return fail(format!("emission {emission}: must be finite and not negative"));
        }
        let ends = if (b - a).perp_dot(towards - a) >= 0.0 { [a, b] } else { [b, a] };
        Ok(Self { name: name.to_owned(), ends, albedo, emission })
    }

    /// Unit normal of the front.
    pub fn normal(&self) -> DVec2 {
        (self.ends[1] - self.ends[0]).perp().normalize()
    }

    /// The point a fraction `u` of the way from the first end to the second.
    #[inline]
    pub fn at(&self, u: f64) -> DVec2 {
        self.ends[0].lerp(self.ends[1], u)
    }

    /// Whether it is a luminaire.
    pub fn emits(&self) -> bool {
        self.emission != DVec3::ZERO
    }
}

/// A height field between walls, under a luminaire.
#[derive(Clone, Debug)]
pub struct FlatScene {
    /// h and the sweep.
    pub field: Arc<HeightField>,
    /// Diffuse reflectance of the graph, both sides.
    pub albedo: DVec3,
    /// The side that is shown: lower is the graph seen from above.
    pub outside: Side,
    /// World height of the sweep: isovalue lo stands at 0, hi at `height`. Flattened light does not depend on it.
    pub height: f64,
    /// Walls and luminaires.
    pub segments: Arc<Vec<Segment>>,
}

impl FlatScene {
    /// Puts a scene together.
    ///
    /// # Errors
    /// `Invalid` for an albedo outside [0, 1], a height that is not positive, or more than 4095 segments.
    pub fn new(field: HeightField, albedo: DVec3, outside: Side, height: f64, segments: Vec<Segment>) -> Result<Self> {
        let fail = |what: String| Err(Error::Invalid(what));
        if !(albedo.cmpge(DVec3::ZERO).all() && albedo.cmple(DVec3::ONE).all()) {
            return fail(format!("surface albedo {albedo}: every channel must lie in [0, 1]"));
        }
        if !(height > 0.0 && height.is_finite()) {
            return fail(format!("height {height}: the sweep's height must be positive and finite"));
        }
        if segments.len() >= crate::flattened::MAX_TARGETS as usize {
            return fail(format!("{} segments: at most {}", segments.len(), crate::flattened::MAX_TARGETS - 1));
        }
        Ok(Self { field: Arc::new(field), albedo, outside, height, segments: Arc::new(segments) })
    }

    /// The default surroundings of a field on [lo, hi]: walls x = lo red, x = hi green, y = hi white, y = lo open; a
    /// luminaire of radiance 1 from 30 to 70 % of the back wall, 0.1 % of the depth in front of it.
    ///
    /// # Errors
    /// Never for a field's own bounds.
    pub fn default_box(field: &HeightField) -> Result<Vec<Segment>> {
        let [lo, hi] = field.bounds();
        let centre = 0.5 * (lo + hi);
        let at = |x: f64, y: f64| lo + (hi - lo) * DVec2::new(x, y);
        let (red, green) = (DVec3::new(0.63, 0.065, 0.05), DVec3::new(0.14, 0.45, 0.091));
        let (white, none) = (DVec3::new(0.725, 0.71, 0.68), DVec3::ZERO);
        Ok(vec![
            Segment::facing("luminaire", [at(0.3, 0.999), at(0.7, 0.999)], centre, none, DVec3::ONE)?,
            Segment::facing("x_min", [at(0.0, 0.0), at(0.0, 1.0)], centre, red, none)?,
            Segment::facing("x_max", [at(1.0, 0.0), at(1.0, 1.0)], centre, green, none)?,
            Segment::facing("y_max", [at(0.0, 1.0), at(1.0, 1.0)], centre, white, none)?,
        ])
    }

    /// Numbers of the segments that emit.
    pub fn luminaires(&self) -> impl Iterator<Item = u32> + '_ {
        (0u32..).zip(self.segments.iter()).filter(|(_, s)| s.emits()).map(|(i, _)| i)
    }
}
