//! Walls and luminaires from a Wavefront OBJ with MTL, through tobj: Kd is the albedo, Ke the emission.

use crate::error::{Error, Result};
use crate::polygon::Polygon;
use glam::DVec3;
use std::path::Path;

/// Reads all faces as polygons, in file order; vertices counter-clockwise from the visible side. A face without a
/// material is white as the default box's walls.
///
/// # Errors
/// `Io` if the OBJ or its MTL cannot be read, `Invalid` for faces that are no planar convex polygons; messages name
/// the file and the face.
pub fn read_obj(path: &Path) -> Result<Vec<Polygon>> {
    let options = tobj::LoadOptions { single_index: false, triangulate: false, ..Default::default() };
    if let Err(e) = std::fs::metadata(path) {
        return Err(Error::io(path, e));
    }
    let (models, materials) = tobj::load_obj(path, &options).map_err(|e| Error::invalid(path, e))?;
    let materials = materials.map_err(|e| Error::invalid(path, format!("its material library: {e}")))?;
    let mut polygons = Vec::new();
    for model in &models {
        let mesh = &model.mesh;
        let material = mesh.material_id.map(|i| &materials[i]);
        let channels = |v: Option<[f32; 3]>, default: DVec3| v.map_or(default, |c| DVec3::from_array(c.map(f64::from)));
        let albedo = channels(material.and_then(|m| m.diffuse), DVec3::new(0.725, 0.71, 0.68));
        let emission = channels(material.and_then(|m| m.emissive), DVec3::ZERO);
        let vertex = |i: u32| {
            let p = &mesh.positions[3 * i as usize..][..3];
            DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))
        };
        let mut at = 0;
        // tobj leaves the arities out when all faces are triangles.
        let triangles = vec![3; if mesh.face_arities.is_empty() { mesh.indices.len() / 3 } else { 0 }];
        let arities = if mesh.face_arities.is_empty() { &triangles } else { &mesh.face_arities };
        for (face, &arity) in arities.iter().enumerate() {
            let vertices = mesh.indices[at..at + arity as usize].iter().map(|&i| vertex(i)).collect();
            at += arity as usize;
            let name = if arities.len() == 1 { model.name.clone() } else { format!("{}_{face}", model.name) };
            let polygon = Polygon::new(&name, vertices, albedo, emission)
                .map_err(|e| Error::invalid(path, format!("face {} of '{}': {e}", face + 1, model.name)))?;
            polygons.push(polygon);
        }
    }
    if polygons.is_empty() {
        return Err(Error::invalid(path, "holds no faces; walls and luminaires are 'f' lines"));
    }
    Ok(polygons)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_with_a_light() {
        let dir = tempfile::tempdir().unwrap();
        let obj = dir.path().join("box.obj");
        std::fs::write(dir.path().join("box.mtl"), "newmtl red\nKd 0.63 0.065 0.05\nnewmtl lamp\nKd 0 0 0\nKe 2 3 4\n")
            .unwrap();
        std::fs::write(
            &obj,
            "mtllib box.mtl\nv 0 0 0\nv 0 1 0\nv 0 1 1\nv 0 0 1\nv 1 1 1\no wall\nusemtl red\nf 1 2 3 4\no light\nusemtl lamp\nf 1 2 5\n",
        )
        .unwrap();
        let p = read_obj(&obj).unwrap();
        assert_eq!((p.len(), p[0].name.as_str(), p[1].name.as_str()), (2, "wall", "light"));
        assert!((p[0].albedo - DVec3::new(0.63, 0.065, 0.05)).length() < 1e-7);
        assert_eq!((p[0].normal(), p[0].emission), (DVec3::X, DVec3::ZERO));
        assert_eq!(p[1].emission, DVec3::new(2.0, 3.0, 4.0));
        std::fs::write(&obj, "v 0 0 0\nv 0 1 0\nv 0 2 0\nf 1 2 3\n").unwrap();
        let message = read_obj(&obj).unwrap_err().to_string();
        assert!(message.contains("box.obj") && message.contains("face 1"), "{message}");
    }

    #[test]
    fn the_shipped_box_is_the_default_one() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/cornell-box.obj");
        let lattice = crate::volume::Lattice::aligned([5; 3], DVec3::ZERO, DVec3::splat(0.25)).unwrap();
        let built = super::super::cornell_box(&lattice, 0.0).unwrap();
        let shipped = read_obj(&path).unwrap();
        assert_eq!(built.len(), shipped.len());
        for b in &built {
            let s = shipped.iter().find(|s| s.name == b.name).unwrap_or_else(|| panic!("{} is missing", b.name));
            assert!((s.normal() - b.normal()).length() < 1e-6 && (s.area() - b.area()).abs() < 1e-6, "{}", b.name);
            assert!((s.albedo - b.albedo).length() < 1e-6 && (s.emission - b.emission).length() < 1e-6, "{}", b.name);
            for v in b.vertices() {
                assert!(s.vertices().iter().any(|w| (*w - *v).length() < 1e-6), "{}: {v}", b.name);
            }
        }
    }
}
