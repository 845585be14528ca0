//! Writers of what users take away: textured meshes, pictures and stacks of slices. Every file appears under its name
//! only when it is complete.

pub mod bake_file;
pub mod glb;
pub mod multi_block;
pub mod obj;
pub mod picture;
pub mod ply;
pub mod slices;
pub mod vtp;

use crate::error::{Error, Result};
use crate::files;
use crate::volume::Space;
use glam::{DVec3, Vec3};
use std::path::Path;

/// A display colour as bytes: rounded to nearest, clamped.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to a byte")]
fn colour_bytes(colour: [f32; 3]) -> [u8; 3] {
    colour.map(|v| (v * 255.0).round() as u8)
}

/// Steps of f32 this large, in what is to be told apart, are steps to be seen.
const COARSE: f64 = 1e-5;

/// Whether f32 is too coarse for numbers up to `largest` that span `extent`.
fn coarse_in_f32(largest: f64, extent: f64) -> bool {
    // Its smallest numbers have steps of 2⁻¹⁴⁹.
    let step = (largest * f64::from(f32::EPSILON)).max(f64::from(f32::from_bits(1)));
    extent > 0.0 && step > COARSE * extent
}

/// A mesh to be written, in world units. All vertex arrays are in the order of `positions`.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mesh<'a> {
    /// Vertices in world coordinates.
    pub positions: &'a [DVec3],
    /// Triangles as indices into `positions`, counter-clockwise seen from outside.
    pub triangles: &'a [[u32; 3]],
    /// Unit normals at the vertices, pointing outside. Written as they are.
    pub normals: Option<&'a [Vec3]>,
    /// Display colours at the vertices, sRGB-encoded, in [0, 1].
    pub colours: Option<&'a [[f32; 3]]>,
    /// Named values at the vertices, such as `radiance_r`. Formats that cannot hold them leave them out.
    pub properties: &'a [(&'a str, &'a [f32])],
    /// What the world's axes mean, if that is to be said: to 3D Slicer, by `.ply`, `.obj` and `.vtp`.
    pub space: Option<Space>,
}

impl Mesh<'_> {
    /// Writes the mesh in the format of the extension, `.ply`, `.obj`, `.glb` or `.vtp`.
    ///
    /// # Errors
    /// `NotSupported` for another extension, or what the format's writer returns.
    pub fn write(&self, path: &Path) -> Result<()> {
        match files::extension(path).as_str() {
            "ply" => ply::write(path, self),
            "obj" => obj::write(path, self),
            "glb" => glb::write(path, self),
            "vtp" => vtp::write(path, self),
            _ => Err(Error::not_supported(path, "meshes are written as .ply, .obj, .glb or .vtp")),
        }
    }

    /// Whether the arrays fit each other, before anything is written.
    fn check(&self, path: &Path) -> Result<()> {
        let n = self.positions.len();
        let lengths = [("normals", self.normals.map(<[_]>::len)), ("colours", self.colours.map(<[_]>::len))];
        let named = self.properties.iter().map(|(name, values)| (*name, Some(values.len())));
        for (name, length) in lengths.into_iter().chain(named) {
            if let Some(length) = length
                && length != n
            {
                return Err(Error::invalid(path, format!("mesh of {n} vertices with {length} values of {name}")));
            }
        }
        if n > i32::MAX as usize || self.triangles.len() > i32::MAX as usize {
            return Err(Error::not_supported(
                path,
                format!("mesh of {n} vertices and {} triangles: readers count to {}", self.triangles.len(), i32::MAX),
            ));
        }
        if let Some(t) = self.triangles.iter().position(|t| t.iter().any(|v| *v as usize >= n)) {
            return Err(Error::invalid(path, format!("triangle {t} names {:?} of {n} vertices", self.triangles[t])));
        }
        if let Some(v) = self.positions.iter().position(|p| !p.as_vec3().is_finite()) {
            return Err(Error::invalid(path, format!("vertex {v} stands at {}, beyond f32", self.positions[v])));
        }
        Ok(())
    }
}
