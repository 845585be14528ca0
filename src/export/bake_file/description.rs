//! The text of a bake's file: scene, settings and report, and where textures are, as JSON.

use crate::error::{Error, Result};
use crate::flat::FlatTexture;
use crate::flattened::Side;
use crate::isovalue_axis::IsovalueAxis;
use crate::polygon::Polygon;
use crate::reflectance::Reflectance;
use crate::volume::vti::VtiFile;
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Name of the field string that holds scene and report as JSON.
pub(super) const DESCRIPTION: &str = "isolume";

/// A scene without its samples: enough to draw the box and to trace the stored volume again.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Description {
    pub isovalues: [f64; 2],
    pub exposure: f64,
    /// Stops, if any, in units of the sweep.
    pub albedo: Reflectance,
    pub emission: DVec3,
    pub outside: Side,
    pub both_sides: bool,
    pub capped: bool,
    pub polygons: Vec<PolygonDescription>,
    pub textures: Vec<TextureDescription>,
    pub report: serde_json::Value,
    /// The volume's name, if there are others.
    #[serde(default)]
    pub volume: String,
    /// Whether the others gave it no light.
    #[serde(default)]
    pub independent: bool,
}

/// Where the texture of a flat is stored.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct TextureDescription {
    pub flat: usize,
    pub array: String,
    /// Texels along u, v and the isovalue.
    pub dims: [usize; 3],
    /// Where the isovalue's texels crowd, if not ½ ([`IsovalueAxis::around`]).
    #[serde(default = "half", skip_serializing_if = "is_half")]
    pub middle: f32,
    /// Texels of the array before it.
    #[serde(default)]
    pub start: usize,
    /// Whether it is what is seen from within solids, if that differs; it follows what is seen from outside.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub inside: bool,
    /// Whether nothing is known of what is seen from within solids.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outside_only: bool,
}

impl TextureDescription {
    /// The texture, of the colours of its array.
    pub(super) fn of(&self, array: &[[f32; 3]]) -> Result<FlatTexture> {
        let [nu, nv, nc] = self.dims;
        let count = nu.checked_mul(nv).and_then(|n| n.checked_mul(nc)).filter(|&n| n > 0);
        let count = count.ok_or_else(|| self.wrong(format!("dims {:?} are those of no texture", self.dims)))?;
        let end =
            self.start.checked_add(count).filter(|&end| end <= array.len()).ok_or_else(|| {
                self.wrong(format!("holds {} colours, not {count} from {} on", array.len(), self.start))
            })?;
        let texels = array[self.start..end].to_vec();
        Ok(FlatTexture { dims: self.dims, axis: IsovalueAxis::around(self.middle), texels })
    }

    pub(super) fn wrong(&self, what: impl std::fmt::Display) -> Error {
        Error::Invalid(format!("the array '{}', texture of flat {}: {what}; bake anew", self.array, self.flat))
    }
}

/// [`IsovalueAxis::middle`] of even texels.
fn half() -> f32 {
    0.5
}

fn is_half(middle: &f32) -> bool {
    *middle == 0.5
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PolygonDescription {
    pub name: String,
    pub vertices: Vec<DVec3>,
    pub albedo: DVec3,
    pub emission: DVec3,
    /// As [`Polygon::other_face`].
    #[serde(default)]
    pub other_face: i32,
}

impl PolygonDescription {
    /// # Errors
    /// `Invalid` if it is no planar convex polygon, or light does not fit it.
    pub(super) fn polygon(self) -> Result<Polygon> {
        let mut polygon = Polygon::new(&self.name, self.vertices, self.albedo, self.emission)?;
        polygon.opaque_back &= self.other_face == 0;
        polygon.other_face = self.other_face;
        Ok(polygon)
    }
}

impl Description {
    /// What a file holds, if it is a bake.
    pub(super) fn of(file: &VtiFile) -> Result<Option<Self>> {
        let Some(text) = Self::text(file) else { return Ok(None) };
        let parsed = serde_json::from_str(text);
        parsed.map(Some).map_err(|e| Error::Invalid(format!("field data '{DESCRIPTION}': {e}")))
    }

    /// Its text, if the file is a bake.
    pub(super) fn text(file: &VtiFile) -> Option<&str> {
        // Other files may use the name for something else, as generated volumes did.
        let own = |(name, text): &&(String, String)| name == DESCRIPTION && text.starts_with('{');
        file.field_strings.iter().find(own).map(|(_, text)| &**text)
    }
}
