//! Arrays of a bake's file, by name.

use crate::error::{Error, Result};
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
    pub(super) fn floats_of(&self, name: &str, count: usize) -> Result<Vec<f32>> {
        let v = self.floats(name)?;
        if v.len() == count {
            return Ok(v.to_vec());
        }
        Err(Error::Invalid(format!("the array '{name}' holds {} values, not {count} floats", v.len())))
    }

    /// Colours, as many as there are.
    pub(super) fn colours(&self, name: &str) -> Result<Vec<[f32; 3]>> {
        match self.floats(name)?.as_chunks() {
            (colours, []) => Ok(colours.to_vec()),
            _ => Err(Error::Invalid(format!("the array '{name}' does not hold three floats per colour"))),
        }
    }

    /// `count` colours.
    pub(super) fn colours_of(&self, name: &str, count: usize) -> Result<Vec<[f32; 3]>> {
        let colours = self.colours(name)?;
        if colours.len() == count {
            return Ok(colours);
        }
        Err(Error::Invalid(format!("the array '{name}' holds {} colours, not {count}", colours.len())))
    }
}
