//! `[surface]`: the isosurfaces' material and sides.

use crate::error::Result;
use crate::field::Sweep;
use crate::flattened::Side;
use crate::reflectance::Reflectance;
use crate::scene::{Boundary, Surface};
use glam::DVec3;
use serde::Deserialize;

/// A number for all channels, or three.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(untagged, expecting = "expected a number, or three: [red, green, blue]")]
pub enum Rgb {
    /// The same in all channels.
    Grey(f64),
    /// Red, green, blue.
    Channels([f64; 3]),
}

impl Rgb {
    /// As a vector.
    pub fn vector(self) -> DVec3 {
        match self {
            Rgb::Grey(x) => DVec3::splat(x),
            Rgb::Channels(c) => DVec3::from_array(c),
        }
    }
}

impl std::str::FromStr for Rgb {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let v: Option<Vec<f64>> = text.split(',').map(|w| w.trim().parse().ok()).collect();
        match v.as_deref() {
            Some(&[x]) => Ok(Rgb::Grey(x)),
            Some(&[r, g, b]) => Ok(Rgb::Channels([r, g, b])),
            _ => Err(format!("'{text}' is no colour; write one number or three such as 0.8,0.7,0.6")),
        }
    }
}

/// `albedo`: a colour, or one at each of some isovalues.
#[derive(Clone, Debug, PartialEq)]
pub enum Albedo {
    /// The same at every isovalue.
    Uniform(Rgb),
    /// Linear in between, constant beyond.
    Stops(Vec<ColourStop>),
}

/// A colour at an isovalue.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColourStop {
    /// In source units.
    pub isovalue: f64,
    /// Linear.
    pub colour: Rgb,
}

impl Albedo {
    /// In units of the sweep.
    ///
    /// # Errors
    /// `Invalid` as [`Reflectance::new`].
    fn reflectance(&self, sweep: Sweep) -> Result<Reflectance> {
        match self {
            Albedo::Uniform(colour) => Ok(colour.vector().into()),
            Albedo::Stops(stops) => {
                Reflectance::new(stops.iter().map(|s| (sweep.to_unit(s.isovalue), s.colour.vector())).collect())
            }
        }
    }
}

impl std::str::FromStr for Albedo {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        text.parse().map(Albedo::Uniform)
    }
}

impl<'de> Deserialize<'de> for Albedo {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        // By hand, since an untagged enum would only say that nothing fits.
        let fail = |e: toml::de::Error| serde::de::Error::custom(e.message());
        let value = toml::Value::deserialize(deserializer)?;
        match value.as_array() {
            Some(list) if list.iter().any(toml::Value::is_table) => value.try_into().map(Albedo::Stops).map_err(fail),
            _ => value.try_into().map(Albedo::Uniform).map_err(|_| {
                serde::de::Error::custom(
                    "a colour is one number or [red, green, blue]; colours by isovalue are a list of { isovalue, colour }",
                )
            }),
        }
    }
}

/// Which side of the level sets is outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs, reason = "the names say it")]
pub enum OutsideName {
    Lower,
    Higher,
}

/// Which sides are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum SidesName {
    /// The outside only.
    Outside,
    /// Two grids.
    Both,
}

/// What the volume's faces do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum BoundaryName {
    /// Cut level sets open.
    Open,
    /// Close them.
    Capped,
}

/// `[surface]`, and the flags of the same names.
#[derive(Clone, Debug, Default, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct SurfaceOptions {
    /// Diffuse reflectance of the isosurfaces: one number or R,G,B in [0, 1] (default 0.75)
    #[arg(long, value_name = "RGB")]
    pub albedo: Option<Albedo>,
    /// Radiance that the isosurfaces emit: 0 (default), or 1e-15 to 1e18 in the brightest channel
    #[arg(long, value_name = "RGB")]
    pub emission: Option<Rgb>,
    /// The side of the surface that is outside: where values are lower (default) or higher
    #[arg(long)]
    pub outside: Option<OutsideName>,
    /// Sides to store (default: outside)
    #[arg(long)]
    pub sides: Option<SidesName>,
    /// What the volume's faces do to surfaces that run into them (default: open)
    #[arg(long)]
    pub boundary: Option<BoundaryName>,
}

pub(super) fn surface(file: &SurfaceOptions, flags: &SurfaceOptions, sweep: Sweep) -> Result<(Surface, Boundary)> {
    let default = Surface::default();
    let outside = flags.outside.or(file.outside).map_or(default.outside, |o| match o {
        OutsideName::Lower => Side::Lower,
        OutsideName::Higher => Side::Higher,
    });
    let surface = Surface {
        albedo: match flags.albedo.as_ref().or(file.albedo.as_ref()) {
            Some(albedo) => albedo.reflectance(sweep)?,
            None => default.albedo,
        },
        emission: flags.emission.or(file.emission).map_or(default.emission, Rgb::vector),
        outside,
        both_sides: flags.sides.or(file.sides) == Some(SidesName::Both),
    };
    let boundary = match flags.boundary.or(file.boundary) {
        Some(BoundaryName::Capped) => Boundary::Capped,
        _ => Boundary::Open,
    };
    Ok((surface, boundary))
}
