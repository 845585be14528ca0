//! One isosurface as users take it away: world units, unit normals, outside faces out.

use crate::digits::{Shortest, brief_span};
use crate::error::{Error, Result};
use crate::export::Mesh;
use crate::export::bake_file::BakedVolume;
use crate::export::picture::srgb_encode;
use crate::field::Field;
use crate::flattened::Side;
use crate::isosurface::{Isosurface, extract_refined};
use crate::scene::Scene;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// An isosurface in the world, with the local positions it came from.
#[derive(Clone, Debug, Default)]
pub struct SurfaceMesh {
    /// Vertices, local frame: on the trilinear level set up to rounding.
    pub local: Vec<DVec3>,
    /// Vertices, world.
    pub positions: Vec<DVec3>,
    /// The shared receiver normals on the outside; 0 where ∇h vanishes.
    pub normals: Vec<Vec3>,
    /// Triangles, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// The isovalue in units of the sweep, as the field stores samples.
///
/// # Errors
/// `Invalid` if it lies outside the sweep.
pub fn unit_isovalue(field: &Field, isovalue: f64) -> Result<f32> {
    let sweep = field.sweep();
    if isovalue >= sweep.lo() && isovalue <= sweep.hi() {
        return Ok(sweep.isovalue(isovalue));
    }
    let isovalue = Shortest(isovalue);
    Err(Error::Invalid(format!("--isovalue {isovalue}: outside the sweep {sweep}; choose one inside")))
}

impl SurfaceMesh {
    /// The isosurface at `isovalue` (units of the sweep), every cell cut into `refine`³.
    ///
    /// # Errors
    /// From extraction; `Invalid` if there is no surface at this isovalue.
    pub fn extract(scene: &Scene, isovalue: f32, refine: usize) -> Result<Self> {
        let mesh = extract_refined(scene.lattice().dims(), scene.field.samples(), isovalue, refine)?;
        Self::new(scene, mesh)
    }

    /// From a mesh as extracted (not flipped).
    ///
    /// # Errors
    /// `Invalid` if it is empty.
    pub fn new(scene: &Scene, mut mesh: Isosurface) -> Result<Self> {
        if mesh.triangles.is_empty() {
            let finite = scene.field.samples().iter().filter(|h| h.is_finite()).map(|h| f64::from(*h));
            let [lo, hi] = finite.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], h| [h.min(lo), h.max(hi)]);
            let [lo, hi] = [lo, hi].map(|h| scene.field.sweep().from_unit(h));
            // In units of the sweep an end at 0 may have become nearly that.
            let data = [lo, hi].map(|x| if x.abs() < 1e-6 * (hi - lo) { 0.0 } else { x });
            let span = if lo < hi { format!(" (the data span {})", brief_span(data)) } else { String::new() };
            return Err(Error::Invalid(format!("there is no surface at this isovalue; choose another{span}")));
        }
        let outside = scene.surface.outside;
        mesh.face_outside(scene.lattice().axes(), outside == Side::Higher);
        let positions = mesh.vertices.par_iter().map(|&p| scene.lattice().to_world(p)).collect();
        let normals =
            mesh.vertices.par_iter().map(|&p| scene.normal(p, outside).unwrap_or_default().as_vec3()).collect();
        Ok(Self { local: mesh.vertices, positions, normals, triangles: mesh.triangles })
    }

    /// A third of the world area of the triangles around each vertex.
    pub fn areas(&self) -> Vec<f64> {
        vertex_areas(&self.positions, &self.triangles)
    }

    /// The mesh for a writer, without colours.
    pub fn export<'a>(&'a self, properties: &'a [(&'a str, &'a [f32])]) -> Mesh<'a> {
        Mesh {
            positions: &self.positions,
            triangles: &self.triangles,
            normals: Some(&self.normals),
            properties,
            ..Mesh::default()
        }
    }
}

/// A third of the area of the triangles around each vertex, in the units of the positions.
pub fn vertex_areas(positions: &[DVec3], triangles: &[[u32; 3]]) -> Vec<f64> {
    let mut areas = vec![0.0; positions.len()];
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        let area = (b - a).cross(c - a).length() / 6.0;
        t.iter().for_each(|&v| areas[v as usize] += area);
    }
    areas
}

/// One channel of vertex colours as f32, for a named property.
#[allow(clippy::cast_possible_truncation, reason = "files hold f32")]
pub fn channel(rgb: &[DVec3], channel: usize) -> Vec<f32> {
    rgb.iter().map(|c| c[channel] as f32).collect()
}

/// Linear radiance as display colours: × exposure, clamped, sRGB-encoded, in [0, 1].
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
pub fn display_colours(radiance: &[DVec3], exposure: f64) -> Vec<[f32; 3]> {
    radiance.iter().map(|c| c.to_array().map(|x| srgb_encode((x * exposure) as f32))).collect()
}

/// The radiance of a bake's outside at world positions, as a 3D texture would give it.
///
/// # Errors
/// `Invalid` if the bake does not hold the outside.
pub fn texture(baked: &BakedVolume, positions: &[DVec3]) -> Result<Vec<DVec3>> {
    let (lattice, side) = (baked.lattice(), baked.scene.surface.outside);
    positions
        .par_iter()
        .map(|&x| baked.radiance(side, lattice.to_index(x)))
        .collect::<Option<_>>()
        .ok_or_else(|| Error::Invalid("the bake does not hold the surface's outside".into()))
}
