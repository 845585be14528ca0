//! Diffuse reflectance of level sets by isovalue: a transfer function that takes part in transport. \[Levoy88\]

use crate::error::{Error, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Albedo over isovalues in units of the sweep: linear between stops, constant beyond the outer ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct Reflectance {
    /// (isovalue, albedo), isovalues rising; at least one.
    stops: Vec<(f64, DVec3)>,
}

/// As files hold it: one colour, or [isovalue, colour] of every stop.
#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Stored {
    Uniform(DVec3),
    Stops(Vec<(f64, DVec3)>),
}

impl From<Reflectance> for Stored {
    fn from(r: Reflectance) -> Self {
        r.uniform().map_or(Stored::Stops(r.stops), Stored::Uniform)
    }
}

impl TryFrom<Stored> for Reflectance {
    type Error = Error;

    fn try_from(stored: Stored) -> Result<Self> {
        match stored {
            Stored::Uniform(albedo) => Ok(albedo.into()),
            Stored::Stops(stops) => Self::new(stops),
        }
    }
}

impl From<DVec3> for Reflectance {
    /// The same albedo at every isovalue.
    fn from(albedo: DVec3) -> Self {
        Self { stops: vec![(0.0, albedo)] }
    }
}

impl Reflectance {
    /// Albedo at isovalues, in any order, in units of the sweep.
    ///
    /// # Errors
    /// `Invalid` without stops, for two at the same isovalue, or an isovalue that is not finite.
    pub fn new(mut stops: Vec<(f64, DVec3)>) -> Result<Self> {
        if stops.is_empty() {
            return Err(Error::Invalid("a list of colours needs at least one".into()));
        }
        stops.sort_by(|a, b| a.0.total_cmp(&b.0));
        if !stops.iter().all(|s| s.0.is_finite()) || stops.windows(2).any(|w| w[0].0 >= w[1].0) {
            return Err(Error::Invalid("colours must stand at different, finite isovalues".into()));
        }
        Ok(Self { stops })
    }

    /// Albedo of the level set at `isovalue`, in units of the sweep.
    #[inline]
    pub fn at(&self, isovalue: f64) -> DVec3 {
        let first = self.stops[0];
        if self.stops.len() == 1 || !(isovalue > first.0) {
            return first.1;
        }
        let next = self.stops.partition_point(|s| s.0 < isovalue);
        let Some(&(c1, b)) = self.stops.get(next) else { return self.stops[next - 1].1 };
        let (c0, a) = self.stops[next - 1];
        a + (b - a) * ((isovalue - c0) / (c1 - c0))
    }

    /// The one albedo, if it does not depend on the isovalue.
    pub fn uniform(&self) -> Option<DVec3> {
        let first = self.stops[0].1;
        self.stops.iter().all(|s| s.1 == first).then_some(first)
    }

    /// (isovalue, albedo) of every stop, isovalues rising.
    pub fn stops(&self) -> &[(f64, DVec3)] {
        &self.stops
    }

    /// The largest albedo over the sweep, per channel.
    pub fn greatest(&self) -> DVec3 {
        let inside = self.stops.iter().filter(|s| (0.0..=1.0).contains(&s.0)).map(|s| s.1);
        inside.chain([self.at(0.0), self.at(1.0)]).fold(DVec3::ZERO, DVec3::max)
    }

    /// Whether every level set is black.
    pub fn black(&self) -> bool {
        self.greatest() == DVec3::ZERO
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_between_stops_constant_beyond() {
        let (red, blue) = (DVec3::new(0.8, 0.1, 0.0), DVec3::new(0.2, 0.1, 0.6));
        let r = Reflectance::new(vec![(0.75, blue), (0.25, red)]).unwrap();
        for (c, albedo) in [(-1.0, red), (0.25, red), (0.5, 0.5 * (red + blue)), (0.75, blue), (9.0, blue)] {
            assert!((r.at(c) - albedo).length() < 1e-15, "{c}");
        }
        assert_eq!((r.greatest(), r.uniform()), (DVec3::new(0.8, 0.1, 0.6), None));
        assert_eq!(r.at(f64::NAN), red);
        let beyond = Reflectance::new(vec![(0.0, DVec3::ZERO), (2.0, DVec3::ONE)]).unwrap();
        assert_eq!(beyond.greatest(), DVec3::splat(0.5), "what the sweep does not reach does not count");
        assert_eq!(Reflectance::from(red).uniform(), Some(red));
        for r in [r, beyond, red.into()] {
            let text = serde_json::to_string(&r).unwrap();
            assert_eq!(serde_json::from_str::<Reflectance>(&text).unwrap(), r, "{text}");
        }
        assert!(Reflectance::new(vec![(0.5, red), (0.5, blue)]).is_err() && Reflectance::new(Vec::new()).is_err());
    }
}
