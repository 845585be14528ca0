//! Arrays of a bake's file, by name.

use crate::error::{Error, Result};
use crate::illumination_grid::IlluminationGrid;
use crate::mask::Mask;
use crate::split::Split;
use crate::volume::Samples;
use crate::volume::vti::VtiArray;

/// The arrays of one kind; every error is `Invalid` and names the array.
pub(super) struct Arrays<'a>(pub &'a [VtiArray]);

impl Arrays<'_> {
    /// Whether there is one of that name.
    pub(super) fn holds(&self, name: &str) -> bool {
        self.0.iter().any(|a| a.name == name)
    }

    /// The only one of that name.
    pub(super) fn samples(&self, name: &str) -> Result<&Samples> {
        let mut found = self.0.iter().filter(|a| a.name == name);
        match (found.next(), found.next()) {
            (Some(array), None) => Ok(&array.samples),
            (None, _) => Err(Error::Invalid(format!("the array '{name}' is missing"))),
            (Some(_), Some(_)) => Err(Error::Invalid(format!("the array '{name}' is there twice; bake anew"))),
        }
    }

    /// 32-bit floats.
    fn floats(&self, name: &str) -> Result<&[f32]> {
        match self.samples(name)? {
            Samples::F32(v) => Ok(v),
            _ => Err(Error::Invalid(format!("the array '{name}' holds no 32-bit floats"))),
        }
    }

    /// `count` 32-bit floats.
    fn floats_of(&self, name: &str, count: usize) -> Result<Vec<f32>> {
        let v = self.floats(name)?;
        if v.len() == count {
            return Ok(v.to_vec());
        }
        Err(Error::Invalid(format!("the array '{name}' holds {} values, not {count} floats", v.len())))
    }

    /// Colours, as many as there are.
    pub(super) fn colours(&self, name: &str) -> Result<Vec<[f32; 3]>> {
        let (colours, []) = self.floats(name)?.as_chunks() else {
            return Err(Error::Invalid(format!("the array '{name}' does not hold three floats per colour")));
        };
        match colours.iter().position(|c| !c.iter().all(|v| v.is_finite())) {
            None => Ok(colours.to_vec()),
            Some(n) => Err(Error::Invalid(format!(
                "the array '{name}' holds the colour {:?} at {n}, where numbers are finite; bake anew",
                colours[n]
            ))),
        }
    }

    /// `count` colours.
    fn colours_of(&self, name: &str, count: usize) -> Result<Vec<[f32; 3]>> {
        let colours = self.colours(name)?;
        if colours.len() == count {
            return Ok(colours);
        }
        Err(Error::Invalid(format!("the array '{name}' holds {} colours, not {count}", colours.len())))
    }

    /// The light of one side at `count` points, in arrays whose names end in `suffix`.
    pub(super) fn grid(&self, suffix: &str, count: usize) -> Result<IlluminationGrid> {
        let colours = |name: &str| self.colours_of(&format!("{name}{suffix}"), count);
        let mask = match self.samples(&format!("mask{suffix}"))? {
            Samples::U8(v) if v.len() == count => v,
            _ => return Err(Error::Invalid(format!("the array 'mask{suffix}' does not hold a byte per point"))),
        };
        let split = || Ok(Split { indirect: colours("indirect")?, visible: colours("visible")? });
        Ok(IlluminationGrid {
            split: self.holds(&format!("visible{suffix}")).then(split).transpose()?,
            radiance: colours("radiance")?,
            std_error: self.floats_of(&format!("std_error{suffix}"), count)?,
            mask: mask
                .iter()
                .map(|m| match m {
                    1 => Mask::Valid,
                    2 => Mask::Filled,
                    _ => Mask::Empty,
                })
                .collect(),
        })
    }

    /// `count` samples of the volume.
    pub(super) fn values(&self, count: usize) -> Result<Samples> {
        match self.samples("value")? {
            values @ Samples::F64(_) if values.len() == count => Ok(values.clone()),
            _ => Ok(Samples::F32(self.floats_of("value", count)?)),
        }
    }
}
