//! Walls, luminaires and context geometry from a Wavefront OBJ with MTL, through tobj: Kd is the albedo, Ke the
//! emission.

use super::mtl;
use crate::error::{Error, Result};
use crate::files;
use crate::polygon::Polygon;
use glam::{DQuat, DVec3, EulerRot};
use std::cell::RefCell;
use std::io::Read;
use std::path::Path;

/// Reads all faces as polygons, in file order; vertices counter-clockwise from the visible side. A face without a
/// material is white as the default box's walls.
///
/// # Errors
/// `Io` if the OBJ or its MTL cannot be read, `Invalid` for faces that are no planar convex polygons, for materials
/// that no library has, and for malformed lines of the MTL; messages name the file and the face or line.
pub fn read_obj(path: &Path) -> Result<Vec<Polygon>> {
    let mut polygons = Vec::new();
    for face in faces(path, true)? {
        let polygon = Polygon::new(&face.name, face.vertices, face.albedo, face.emission)
            .map_err(|e| Error::invalid(path, format!("{}: {e}", face.place)))?;
        polygons.push(polygon);
    }
    Ok(polygons)
}

/// How context geometry differs from its file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Instead of the materials' albedo.
    pub albedo: Option<DVec3>,
    /// Instead of the materials' emission.
    pub emission: Option<DVec3>,
    /// Factor of all coordinates, first.
    pub scale: f64,
    /// Then turns about world x, y and z, in that order, degrees.
    pub rotate: DVec3,
    /// Then a shift.
    pub translate: DVec3,
}

impl Default for Placement {
    fn default() -> Self {
        Self { albedo: None, emission: None, scale: 1.0, rotate: DVec3::ZERO, translate: DVec3::ZERO }
    }
}

/// Reads all faces as polygons with two faces each ([`Polygon::both_faces`]). Faces that are not planar and convex are
/// split into triangles from a vertex that sees all of them; those without an area are left out.
///
/// # Errors
/// `Io` if the OBJ or its MTL cannot be read; `Invalid` if no face has an area, for coordinates that are not finite,
/// for faces that no vertex sees all of, for an albedo or emission out of range, for malformed lines of the MTL, and
/// for materials that no library has unless `placement` has an albedo in place of them.
pub fn read_context(path: &Path, placement: &Placement) -> Result<Vec<Polygon>> {
    let Placement { scale, rotate, translate, .. } = *placement;
    let [x, y, z] = rotate.to_array().map(f64::to_radians);
    let turn = DQuat::from_euler(EulerRot::ZYX, z, y, x);
    let mut polygons = Vec::new();
    for face in faces(path, placement.albedo.is_none())? {
        let vertices: Vec<DVec3> = face.vertices.iter().map(|&v| turn * (scale * v) + translate).collect();
        if !vertices.iter().all(|v| v.is_finite()) {
            return Err(Error::invalid(path, format!("{}: a vertex is not finite", face.place)));
        }
        let (albedo, emission) = (placement.albedo.unwrap_or(face.albedo), placement.emission.unwrap_or(face.emission));
        let polygon = |v: Vec<DVec3>| Polygon::new(&face.name, v, albedo, emission);
        let has_area = |t: &[DVec3]| {
            let (a, b) = (t[1] - t[0], t[2] - t[0]);
            a.cross(b).length() > 1e-9 * a.length_squared().max(b.length_squared())
        };
        match polygon(vertices.clone()) {
            Ok(whole) => polygons.extend(whole.both_faces()),
            Err(_) if vertices.len() < 3 => {}
            Err(_) => {
                let fan = fan(&vertices).ok_or_else(|| {
                    Error::invalid(path, format!("{}: no vertex sees all of it; split it into triangles", face.place))
                })?;
                for triangle in fan {
                    if has_area(&triangle) {
                        let triangle =
                            polygon(triangle).map_err(|e| Error::invalid(path, format!("{}: {e}", face.place)))?;
                        polygons.extend(triangle.both_faces());
                    }
                }
            }
        }
    }
    if polygons.is_empty() {
        return Err(Error::invalid(path, "none of its faces has an area"));
    }
    Ok(polygons)
}

/// The triangles from a vertex that sees all of a face, planar or not; `None` if there is none.
fn fan(v: &[DVec3]) -> Option<Vec<Vec<DVec3>>> {
    let n = v.len();
    let from = |s: usize| (1..n - 1).map(move |i| [v[s], v[(s + i) % n], v[(s + i + 1) % n]]);
    let area = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
    let whole: DVec3 = from(0).map(area).sum();
    let folds = |s: usize| from(s).any(|t| area(t).dot(whole) < -1e-9 * whole.length_squared());
    let s = (0..n).find(|&s| !folds(s))?;
    Some(from(s).map(|t| t.to_vec()).collect())
}

/// An 'f' line.
struct Face {
    name: String,
    /// For messages.
    place: String,
    vertices: Vec<DVec3>,
    albedo: DVec3,
    emission: DVec3,
}

/// All faces; `must_exist`: whether what they name for a material must.
fn faces(path: &Path, must_exist: bool) -> Result<Vec<Face>> {
    let options = tobj::LoadOptions { single_index: false, triangulate: false, ..Default::default() };
    let folder = path.parent().unwrap_or(Path::new(""));
    // tobj takes none of our errors.
    let fault = RefCell::new(None);
    let library = |name: &Path| match mtl::text(&folder.join(name)) {
        Ok(text) => tobj::load_mtl_buf(&mut text.as_bytes()),
        Err(e) => {
            fault.borrow_mut().get_or_insert(e);
            Err(tobj::LoadError::MaterialParseError)
        }
    };
    let mut bytes = Vec::new();
    files::open(path)?.read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    let source = String::from_utf8_lossy(&bytes);
    // Windows' editors begin files with a mark.
    let source = source.trim_start_matches('\u{feff}');
    let loaded = tobj::load_obj_buf(&mut normalised(source).as_bytes(), &options, library);
    if let Some(e) = fault.into_inner() {
        return Err(e);
    }
    let (models, materials) = loaded.map_err(|e| Error::invalid(path, e))?;
    let materials = materials.map_err(|e| Error::invalid(path, format!("its material library: {e}")))?;
    if must_exist {
        check_materials(path, source, &materials.iter().map(|m| m.name.as_str()).collect::<Vec<_>>())?;
    }
    let mut faces = Vec::new();
    for model in &models {
        let mesh = &model.mesh;
        let material = mesh.material_id.map(|i| &materials[i]);
        let channels = |v: Option<[f64; 3]>, default: DVec3| v.map_or(default, DVec3::from_array);
        let albedo = channels(material.and_then(|m| m.diffuse), DVec3::new(0.725, 0.71, 0.68));
        let emission = channels(material.and_then(|m| m.emissive), DVec3::ZERO);
        let vertex = |i: u32| DVec3::from_slice(&mesh.positions[3 * i as usize..]);
        let mut at = 0;
        // tobj leaves the arities out when all faces are triangles.
        let triangles = vec![3; if mesh.face_arities.is_empty() { mesh.indices.len() / 3 } else { 0 }];
        let arities = if mesh.face_arities.is_empty() { &triangles } else { &mesh.face_arities };
        for (face, &arity) in arities.iter().enumerate() {
            let vertices = mesh.indices[at..at + arity as usize].iter().map(|&i| vertex(i)).collect();
            at += arity as usize;
            let name = if arities.len() == 1 { model.name.clone() } else { format!("{}_{face}", model.name) };
            let place = format!("face {} of '{}'", face + 1, model.name);
            faces.push(Face { name, place, vertices, albedo, emission });
        }
    }
    if faces.is_empty() {
        return Err(Error::invalid(path, "holds no faces; polygons are 'f' lines"));
    }
    Ok(faces)
}

/// The text of an OBJ file as tobj takes it: statements of materials and their libraries without indentation, with one
/// space, and libraries first, since tobj knows none that comes after its use.
fn normalised(source: &str) -> String {
    let [mut libraries, mut rest] = [String::new(), String::with_capacity(source.len())];
    for line in source.lines() {
        match (statement("mtllib", line), statement("usemtl", line)) {
            (Some(name), _) => libraries.extend(["mtllib ", name, "\n"]),
            (_, Some(name)) => rest.extend(["usemtl ", name, "\n"]),
            (None, None) => rest.extend([line, "\n"]),
        }
    }
    libraries + &rest
}

/// What follows `key` in a line that is such a statement.
fn statement<'a>(key: &str, line: &'a str) -> Option<&'a str> {
    line.trim().strip_prefix(key).filter(|rest| rest.starts_with(char::is_whitespace)).map(str::trim)
}

/// Whether every material that faces use is among `known`: tobj takes others for none at all, which would make a white
/// wall of a luminaire.
fn check_materials(path: &Path, source: &str, known: &[&str]) -> Result<()> {
    let mut wrong = None;
    for (n, line) in source.lines().enumerate() {
        if let Some(name) = statement("usemtl", line) {
            wrong = (!known.contains(&name)).then_some((n + 1, name));
        }
        if let Some((n, name)) = wrong.filter(|_| statement("f", line).is_some()) {
            let known = if known.is_empty() { "none; name their library by mtllib".into() } else { known.join(", ") };
            let place = format!("{}:{n}", path.display());
            return Err(Error::invalid(place, format!("usemtl {name}: there is no such material; known: {known}")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A misspelt luminaire would be a white wall.
    #[test]
    fn materials_must_exist() {
        let dir = tempfile::tempdir().unwrap();
        let obj = dir.path().join("box.obj");
        std::fs::write(dir.path().join("box.mtl"), "newmtl my lamp\nKe 2 3 4\n").unwrap();
        let triangle = "v 0 0 0\nv 0 1 0\nv 0 1 1\n";
        for (head, name, found) in [
            ("mtllib box.mtl\n", "my lamp ", None),
            (
                "mtllib box.mtl\n",
                "My lamp",
                Some("box.obj:5: usemtl My lamp: there is no such material; known: my lamp"),
            ),
            ("", "my lamp", Some("box.obj:4: usemtl my lamp: there is no such material; known: none; ")),
            ("mtllib\tbox.mtl\r\n", "\tmy lamp\r", None),
            ("\u{ef}\u{bb}\u{bf}mtllib box.mtl\n", "my lamp", None),
            ("# M\u{f6}bel\n\tmtllib box.mtl\nusemtl no face\n", "my lamp", None),
        ] {
            let latin: Vec<u8> = head.chars().map(|c| u8::try_from(u32::from(c)).unwrap()).collect();
            let rest = format!("{triangle}  usemtl {name}\nf 1 2 3\nusemtl no face\n");
            std::fs::write(&obj, [latin, rest.into_bytes()].concat()).unwrap();
            if found.is_none() {
                assert_eq!(read_obj(&obj).unwrap()[0].emission, DVec3::new(2.0, 3.0, 4.0), "{head}usemtl {name}");
            }
            let context = |albedo| read_context(&obj, &Placement { albedo, ..Placement::default() });
            for error in [read_obj(&obj).err(), context(None).err()] {
                match (found, error) {
                    (None, None) => (),
                    (Some(found), Some(e)) => assert!(e.to_string().contains(found), "{e}"),
                    (_, other) => panic!("{head}usemtl {name}: {other:?}"),
                }
            }
            assert!(context(Some(DVec3::splat(0.5))).is_ok());
        }
        // A library that comes after its use.
        std::fs::write(&obj, format!("{triangle}usemtl my lamp\nf 1 2 3\nmtllib box.mtl\n")).unwrap();
        assert_eq!(read_obj(&obj).unwrap()[0].emission, DVec3::new(2.0, 3.0, 4.0));
    }

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
        assert_eq!(p[0].albedo, DVec3::new(0.63, 0.065, 0.05));
        assert_eq!((p[0].normal(), p[0].emission), (DVec3::X, DVec3::ZERO));
        assert_eq!(p[1].emission, DVec3::new(2.0, 3.0, 4.0));
        std::fs::write(&obj, "v 0 0 0\nv 0 1 0\nv 0 2 0\nf 1 2 3\n").unwrap();
        let message = read_obj(&obj).unwrap_err().to_string();
        assert!(message.contains("box.obj") && message.contains("face 1"), "{message}");
    }

    #[test]
    fn context_is_placed_has_two_faces_and_is_split_where_it_must() {
        let dir = tempfile::tempdir().unwrap();
        let obj = dir.path().join("thing.obj");
        // A square, a twisted quad, and a triangle without an area.
        let text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1 1 1\nv 2 0 0\nf 1 2 3 4\nf 1 2 5 4\nf 1 2 6\n";
        std::fs::write(&obj, text).unwrap();
        let placement = Placement {
            albedo: Some(DVec3::splat(0.3)),
            scale: 2.0,
            rotate: DVec3::new(90.0, 0.0, 90.0),
            translate: DVec3::new(0.0, 0.0, 5.0),
            ..Placement::default()
        };
        let p = read_context(&obj, &placement).unwrap();
        assert_eq!(p.len(), 2 * (1 + 2));
        // (1, 0, 0) → 2x → x → y; (0, 1, 0) → 2y → z → z.
        for (got, expected) in p[0].vertices().iter().zip([(0., 0., 5.), (0., 2., 5.), (0., 2., 7.), (0., 0., 7.)]) {
            assert!((*got - DVec3::from(expected)).length() < 1e-12, "{got}");
        }
        assert!(p.chunks(2).all(|f| (f[0].normal() + f[1].normal()).length() < 1e-12 && f[0].albedo.x == 0.3));
        assert!(p.iter().zip([1, -1].into_iter().cycle()).all(|(p, n)| p.other_face == n && !p.opaque_back));
        // An L, begun at each of its corners, of which two see all of it; and a Z, of which none does.
        let l = [(0, 0), (4, 0), (4, 4), (3, 4), (3, 1), (0, 1)];
        let placement = Placement { albedo: Some(DVec3::splat(0.3)), ..Placement::default() };
        let face = |corners: &[(i32, i32)], first: usize| {
            let n = corners.len();
            let vertices: String =
                (0..n).map(|i| corners[(first + i) % n]).map(|(x, y)| format!("v {x} {y} 0\n")).collect();
            let numbers: Vec<String> = (1..=n).map(|i| i.to_string()).collect();
            std::fs::write(&obj, format!("{vertices}f {}\n", numbers.join(" "))).unwrap();
            read_context(&obj, &placement)
        };
        for first in 0..6 {
            let p = face(&l, first).unwrap();
            let area = p.iter().map(Polygon::area).sum::<f64>();
            assert!((area - 2.0 * 7.0).abs() < 1e-12, "from corner {first}: {area}");
        }
        let z = [(0, 0), (5, 0), (5, 5), (9, 5), (9, 6), (4, 6), (4, 1), (0, 1)];
        let message = face(&z, 0).unwrap_err().to_string();
        assert!(message.contains("face 1") && message.contains("split it into triangles"), "{message}");
        std::fs::write(&obj, "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n").unwrap();
        assert!(read_context(&obj, &Placement::default()).unwrap_err().to_string().contains("thing.obj"));
    }

    /// Far from the origin, and with a vertex given twice: f32 knows nothing between 1 000 001 and 1 000 001.06.
    #[test]
    fn vertices_are_where_the_file_says() {
        let dir = tempfile::tempdir().unwrap();
        let obj = dir.path().join("far.obj");
        let text = "v 1000000 0 0\nv 1000001.02 0 0\nv 1000001.02 1 0\nv 1000000 1 0\nf 1 2 3 4\nf 1 1 2 3\nf 1 2 3 3\n\
                    f 1 2 3 1\n";
        std::fs::write(&obj, text).unwrap();
        let p = read_obj(&obj).unwrap();
        assert!((p[0].area() - 1.02).abs() < 1e-9, "{}", p[0].area());
        for p in &p[1..] {
            assert_eq!(p.vertices().len(), 3, "{p:?}");
            assert!((p.area() - 0.51).abs() < 1e-9 && p.texture(p.at([0.5, 0.5])) == [0.5, 0.5], "{p:?}");
        }
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
