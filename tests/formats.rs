//! Registration: a bake-shaped grid that holds (x, y, z) as its light is written in every format, read back by a reader
//! of other authors (or written here from the format's definition), and looked up at the vertices of a contour. What
//! comes out must be where the vertex is: half a voxel, a swapped axis, a flipped one or a wrong spacing would show.

use flate2::read::{GzDecoder, ZlibDecoder};
use glam::{DMat3, DMat4, DVec3, Vec3};
use isolume::export::Mesh;
use isolume::export::picture::srgb_encode;
use isolume::isosurface::extract;
use isolume::volume::vti::{VtiFile, VtiWriter};
use isolume::volume::{Lattice, Samples, Space};
use std::io::Read;
use std::path::Path;
use std::process::Command;

/// Of the largest side of Ω's bounds.
const TOLERANCE: f64 = 1e-6;

/// Oblique, anisotropic and flipped, away from the world's origin.
fn lattice() -> Lattice {
    let axes = DMat3::from_cols(DVec3::new(-0.7, 0.1, 0.05), DVec3::new(0.2, 1.3, 0.0), DVec3::new(0.1, -0.3, 2.1));
    Lattice::new([13, 9, 7], DVec3::new(20.0, -7.0, 3.0), axes).unwrap()
}

/// What all checks share: the grid, and vertices of a contour of it.
struct Case {
    lattice: Lattice,
    values: Vec<f32>,
    radiance: Vec<f32>,
    /// Vertices in the world.
    vertices: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    lo: DVec3,
    extent: f64,
}

impl Case {
    fn new() -> Self {
        let lattice = lattice();
        let world: Vec<DVec3> = (0..lattice.len()).map(|o| lattice.to_world(lattice.point(o))).collect();
        let middle = lattice.to_world(0.5 * lattice.far());
        let values: Vec<f32> = world.iter().map(|&x| (x - middle).length() as f32).collect();
        let radiance = world.iter().flat_map(|x| x.as_vec3().to_array()).collect();
        let mesh = extract(lattice.dims(), &values, 3.3).unwrap();
        assert!(mesh.vertices.len() > 80, "{}", mesh.vertices.len());
        let vertices = mesh.vertices.iter().map(|&p| lattice.to_world(p)).collect();
        let (lo, hi) = world.iter().fold((world[0], world[0]), |(lo, hi), &x| (lo.min(x), hi.max(x)));
        Self { lattice, values, radiance, vertices, triangles: mesh.triangles, lo, extent: (hi - lo).max_element() }
    }

    /// Fails unless a grid, as another reader placed it, holds at every vertex where the vertex is.
    fn check_grid(&self, what: &str, grid: &Grid) {
        let far = DVec3::from_array(grid.dims.map(|n| (n - 1) as f64));
        let worst = self
            .vertices
            .iter()
            .map(|&x| {
                let p = grid.axes.inverse() * (x - grid.origin);
                assert!(p.cmpge(DVec3::splat(-1e-9)).all() && p.cmple(far + 1e-9).all(), "{what}: {x} is at {p}");
                (grid.trilinear(p.clamp(DVec3::ZERO, far)) - x).length()
            })
            .fold(0.0, f64::max);
        assert!(worst <= TOLERANCE * self.extent, "{what}: {worst} of {}", self.extent);
        println!("{what}: {:.1e} of the extent", worst / self.extent);
    }

    /// Fails unless vertices and what they hold agree with the contour.
    fn check_vertices(&self, what: &str, positions: &[DVec3], held: &[DVec3], triangles: &[[u32; 3]]) {
        assert_eq!(triangles, self.triangles, "{what}");
        assert_eq!((positions.len(), held.len()), (self.vertices.len(), self.vertices.len()), "{what}");
        for (name, values) in [("position", positions), ("light", held)] {
            let worst = values.iter().zip(&self.vertices).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max);
            assert!(worst <= TOLERANCE * self.extent, "{what}: {name} {worst} of {}", self.extent);
            println!("{what}, {name}: {:.1e} of the extent", worst / self.extent);
        }
    }

    /// Positions as display colours, and back.
    fn colour(&self, x: DVec3) -> [f32; 3] {
        ((x - self.lo) / self.extent).as_vec3().to_array()
    }

    fn place(&self, colour: [f32; 3]) -> DVec3 {
        self.lo + self.extent * Vec3::from_array(colour).as_dvec3()
    }

    /// The same as a bake's file, and `isolume export` of one of its arrays.
    fn export(&self, folder: &Path, array: &str, name: &str) -> std::path::PathBuf {
        let bake = folder.join("bake.vti");
        VtiWriter::new(&self.lattice)
            .point_data("value", 1, &self.values[..])
            .active_scalars("value")
            .point_data("radiance", 3, &self.radiance[..])
            .field_string("space", "right-anterior-superior")
            .write(&bake)
            .unwrap();
        let path = folder.join(name);
        let output = Command::new(env!("CARGO_BIN_EXE_isolume"))
            .arg("export")
            .arg(&bake)
            .args(["--array", array, "-q", "-o"])
            .arg(&path)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        path
    }
}

/// Vectors on a lattice, x fastest.
struct Grid {
    dims: [usize; 3],
    origin: DVec3,
    axes: DMat3,
    vectors: Vec<DVec3>,
}

impl Grid {
    fn trilinear(&self, p: DVec3) -> DVec3 {
        let cell: [usize; 3] = std::array::from_fn(|a| (p[a] as usize).min(self.dims[a] - 2));
        let u = p - DVec3::from_array(cell.map(|i| i as f64));
        let mut sum = DVec3::ZERO;
        for corner in 0..8 {
            let d = [corner & 1, corner >> 1 & 1, corner >> 2];
            let weight: f64 = (0..3).map(|a| if d[a] == 1 { u[a] } else { 1.0 - u[a] }).product();
            let [i, j, k] = [cell[0] + d[0], cell[1] + d[1], cell[2] + d[2]];
            sum += weight * self.vectors[(k * self.dims[1] + j) * self.dims[0] + i];
        }
        sum
    }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn doubles(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
}

fn vectors(floats: &[f32]) -> Vec<DVec3> {
    floats.as_chunks().0.iter().map(|v| Vec3::from_array(*v).as_dvec3()).collect()
}

fn numbers(text: &str) -> Vec<f64> {
    text.split(|c: char| !(c.is_ascii_alphanumeric() || "+-.".contains(c)))
        .filter(|w| !w.is_empty())
        .map(|w| w.parse().unwrap())
        .collect()
}

fn columns(n: &[f64]) -> DMat3 {
    DMat3::from_cols_slice(n)
}

#[test]
fn vti_and_its_copy() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let copy = case.export(folder.path(), "radiance", "copy.vti");
    for (path, array) in [(folder.path().join("bake.vti"), 1), (copy, 0)] {
        let file = VtiFile::read(&path).unwrap();
        let Samples::F32(v) = &file.point_data[array].samples else { panic!("radiance is float") };
        let l = &file.lattice;
        let grid = Grid { dims: l.dims(), origin: l.origin(), axes: l.axes(), vectors: vectors(v) };
        case.check_grid(&path.display().to_string(), &grid);
    }
}

#[test]
fn nrrd_as_slicer_reads_it() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let bytes = std::fs::read(case.export(folder.path(), "radiance", "a.nrrd")).unwrap();
    let end = bytes.windows(2).position(|w| w == b"\n\n").unwrap();
    let head = std::str::from_utf8(&bytes[..end]).unwrap();
    let field = |key: &str| head.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix(": ")).unwrap();
    assert!(head.starts_with("NRRD0005\n"));
    assert_eq!((field("type"), field("dimension"), field("encoding")), ("float", "4", "gzip"));
    assert_eq!((field("endian"), field("kinds")), ("little", "vector domain domain domain"));
    assert_eq!(field("space"), "right-anterior-superior");
    assert_eq!(field("sizes"), "3 13 9 7");
    let mut data = Vec::new();
    GzDecoder::new(&bytes[end + 2..]).read_to_end(&mut data).unwrap();
    let directions = numbers(field("space directions").strip_prefix("none ").unwrap());
    let origin = DVec3::from_slice(&numbers(field("space origin")));
    case.check_grid(
        "nrrd",
        &Grid { dims: [13, 9, 7], origin, axes: columns(&directions), vectors: vectors(&floats(&data)) },
    );
    // And one component as a plain scalar volume.
    let path = case.export(folder.path(), "value", "s.nrrd");
    let volume = isolume::volume::Volume::open(path).unwrap();
    assert_eq!((volume.lattice.dims(), volume.samples()), (case.lattice.dims(), &Samples::F32(case.values.clone())));
}

#[test]
fn npy_is_indexed_z_y_x() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let bytes = std::fs::read(case.export(folder.path(), "radiance", "a.npy")).unwrap();
    assert_eq!(bytes[..8], *b"\x93NUMPY\x01\x00");
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    assert_eq!(start % 64, 0);
    let head = std::str::from_utf8(&bytes[10..start]).unwrap().trim_end();
    assert_eq!(head, "{'descr': '<f4', 'fortran_order': False, 'shape': (7, 9, 13, 3), }");
    // The format has no place in the world: that is the bake's.
    let l = &case.lattice;
    let grid =
        Grid { dims: [13, 9, 7], origin: l.origin(), axes: l.axes(), vectors: vectors(&floats(&bytes[start..])) };
    case.check_grid("npy", &grid);
}

#[test]
fn exr_has_a_layer_per_slice() {
    use exr::meta::attribute::AttributeValue;
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let path = case.export(folder.path(), "radiance", "a.exr");
    let image = exr::prelude::read_all_flat_layers_from_file(path).unwrap();
    let attribute = |key: &str| {
        let other = &image.layer_data[0].attributes.other;
        let (_, value) = other.iter().find(|(name, _)| name.to_string() == format!("isolume:{key}")).unwrap();
        let AttributeValue::Text(text) = value else { panic!("{key} is a text") };
        numbers(&text.to_string())
    };
    let [nx, ny, nz] = case.lattice.dims();
    assert_eq!(image.layer_data.len(), nz);
    let mut grid = Grid {
        dims: [nx, ny, nz],
        origin: DVec3::from_slice(&attribute("origin")),
        axes: columns(&attribute("axes")),
        vectors: vec![],
    };
    for (k, layer) in image.layer_data.iter().enumerate() {
        assert_eq!(layer.attributes.layer_name.as_ref().unwrap().to_string(), format!("z{k:04}"));
        assert_eq!((layer.size.x(), layer.size.y()), (nx, ny));
        let channel = |name: &str| -> Vec<f32> {
            let found = layer.channel_data.list.iter().find(|c| c.name.to_string() == name).unwrap();
            found.sample_data.values_as_f32().collect()
        };
        let (r, g, b) = (channel("R"), channel("G"), channel("B"));
        grid.vectors.extend((0..nx * ny).map(|i| Vec3::new(r[i], g[i], b[i]).as_dvec3()));
    }
    case.check_grid("exr", &grid);
}

/// Writes the contour with its own positions as light and colours, by the writer of the extension.
fn write_mesh(case: &Case, path: &Path) {
    let channels: Vec<Vec<f32>> = (0..3).map(|c| case.vertices.iter().map(|x| x[c] as f32).collect()).collect();
    let colours: Vec<[f32; 3]> = case.vertices.iter().map(|&x| case.colour(x)).collect();
    let normals: Vec<Vec3> = case.vertices.iter().map(|x| x.as_vec3().normalize()).collect();
    let mesh = Mesh {
        positions: &case.vertices,
        triangles: &case.triangles,
        normals: Some(&normals),
        colours: Some(&colours),
        properties: &[("radiance_r", &channels[0]), ("radiance_g", &channels[1]), ("radiance_b", &channels[2])],
        space: Some(Space::RightAnteriorSuperior),
    };
    mesh.write(path).unwrap();
}

fn check_normals(what: &str, case: &Case, normals: &[DVec3]) {
    assert_eq!(normals.len(), case.vertices.len(), "{what}");
    let right = normals.iter().zip(&case.vertices).all(|(n, x)| (*n - x.normalize()).length() < 1e-6);
    assert!(right, "{what}: normals");
}

#[test]
fn ply_holds_linear_light() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let path = folder.path().join("a.ply");
    write_mesh(&case, &path);
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = std::str::from_utf8(&bytes[..end]).unwrap();
    let names: Vec<&str> = head.lines().filter_map(|l| l.strip_prefix("property ")).collect();
    assert!(head.contains("\ncomment SPACE=RAS\n"), "for 3D Slicer: {head}");
    let float = ["x", "y", "z", "nx", "ny", "nz", "radiance_r", "radiance_g", "radiance_b"];
    assert!(names.iter().zip(float).all(|(n, f)| *n == format!("float {f}")), "{names:?}");
    assert_eq!(names[9..12], ["uchar red", "uchar green", "uchar blue"]);
    let n = case.vertices.len();
    let (records, faces) = bytes[end..].split_at(39 * n);
    let part = |from: usize| -> Vec<DVec3> {
        records.chunks_exact(39).flat_map(|r| vectors(&floats(&r[4 * from..4 * from + 12]))).collect()
    };
    let triangles: Vec<[u32; 3]> = faces
        .chunks_exact(13)
        .map(|f| std::array::from_fn(|i| u32::from_le_bytes(f[1 + 4 * i..5 + 4 * i].try_into().unwrap())))
        .collect();
    case.check_vertices("ply", &part(0), &part(6), &triangles);
    check_normals("ply", &case, &part(3));
    for (record, &x) in records.chunks_exact(39).zip(&case.vertices) {
        let expected = case.colour(x).map(|v| (255.0 * v).round() as u8);
        assert_eq!(record[36..], expected);
    }
}

#[test]
fn obj_through_tobj() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let path = folder.path().join("a.obj");
    write_mesh(&case, &path);
    let options = tobj::LoadOptions { single_index: true, ..Default::default() };
    let (models, _) = tobj::load_obj(&path, &options).unwrap();
    let mesh = &models[0].mesh;
    // Vertices come in the order in which triangles name them first.
    let triples = |x: &[f64]| -> Vec<DVec3> { x.as_chunks().0.iter().map(|v| DVec3::from_array(*v)).collect() };
    let positions = triples(&mesh.positions);
    let held: Vec<DVec3> = triples(&mesh.vertex_color).iter().map(|c| case.place(c.as_vec3().to_array())).collect();
    let normals = triples(&mesh.normals);
    let mut order = vec![None; case.vertices.len()];
    for (read, own) in mesh.indices.iter().zip(case.triangles.as_flattened()) {
        order[*own as usize] = Some(*read as usize);
    }
    let order: Vec<usize> = order.into_iter().map(Option::unwrap).collect();
    let sorted = |v: &[DVec3]| -> Vec<DVec3> { order.iter().map(|&i| v[i]).collect() };
    case.check_vertices("obj", &sorted(&positions), &sorted(&held), &case.triangles);
    check_normals("obj", &case, &sorted(&normals));
}

#[test]
fn glb_through_gltf() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let path = folder.path().join("a.glb");
    write_mesh(&case, &path);
    let file = gltf::Gltf::open(&path).unwrap();
    let node = file.default_scene().unwrap().nodes().next().unwrap();
    let matrix: [f64; 16] = std::array::from_fn(|i| f64::from(node.transform().matrix()[i / 4][i % 4]));
    // glTF's y is up where the world's z is: what a viewer shows is the world, turned.
    let matrix = DMat4::from_cols_array(&matrix);
    let world = |v: DVec3| DVec3::new(v.x, -v.z, v.y);
    let primitive = node.mesh().unwrap().primitives().next().unwrap();
    assert!(primitive.material().unlit());
    let reader = primitive.reader(|_| file.blob.as_deref());
    let f64s = |v: [f32; 3]| Vec3::from_array(v).as_dvec3();
    let positions: Vec<DVec3> =
        reader.read_positions().unwrap().map(|p| world(matrix.transform_point3(f64s(p)))).collect();
    let colours = reader.read_colors(0).unwrap().into_rgb_f32();
    let held: Vec<DVec3> = colours.map(|c| case.place(c.map(srgb_encode))).collect();
    let corners: Vec<u32> = reader.read_indices().unwrap().into_u32().collect();
    case.check_vertices("glb", &positions, &held, corners.as_chunks().0);
    let normals: Vec<DVec3> =
        reader.read_normals().unwrap().map(|n| world(matrix.transform_vector3(f64s(n)))).collect();
    check_normals("glb", &case, &normals);
    let bounds = primitive.bounding_box();
    let local = reader.read_positions().unwrap().map(Vec3::from_array);
    let (lo, hi) = local.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
    assert_eq!((bounds.min, bounds.max), (lo.to_array(), hi.to_array()));
    // Without light of its own it takes the viewer's.
    let bare = Mesh { positions: &case.vertices, triangles: &case.triangles, ..Mesh::default() };
    bare.write(&path).unwrap();
    let file = gltf::Gltf::open(&path).unwrap();
    assert!(file.materials().all(|m| !m.unlit()) && file.extensions_used().next().is_none());
}

#[test]
fn vtp_by_its_definition() {
    let (case, folder) = (Case::new(), tempfile::tempdir().unwrap());
    let path = folder.path().join("a.vtp");
    write_mesh(&case, &path);
    let bytes = std::fs::read(path).unwrap();
    let tag = b"<AppendedData encoding=\"raw\">";
    let at = bytes.windows(tag.len()).position(|w| w == tag).unwrap();
    let text = format!("{}</VTKFile>", std::str::from_utf8(&bytes[..at]).unwrap());
    let document = roxmltree::Document::parse(&text).unwrap();
    assert_eq!(document.root_element().attribute("type"), Some("PolyData"));
    let data = at + bytes[at..].iter().position(|&b| b == b'_').unwrap() + 1;
    let array = |name: &str, kind: &str, components: &str| -> Vec<u8> {
        let node = document.descendants().find(|n| n.attribute("Name") == Some(name)).unwrap();
        assert_eq!((node.attribute("type"), node.attribute("NumberOfComponents")), (Some(kind), Some(components)));
        let from = data + node.attribute("offset").unwrap().trim().parse::<usize>().unwrap();
        let word = |i: usize| u64::from_le_bytes(bytes[from + 8 * i..][..8].try_into().unwrap()) as usize;
        let mut block = from + 8 * (3 + word(0));
        let mut out = Vec::new();
        for b in 0..word(0) {
            ZlibDecoder::new(&bytes[block..block + word(3 + b)]).read_to_end(&mut out).unwrap();
            block += word(3 + b);
        }
        out
    };
    let space = document.descendants().find(|n| n.attribute("Name") == Some("SPACE")).unwrap();
    assert_eq!(
        (space.attribute("type"), space.text().unwrap().trim()),
        (Some("String"), "82 65 83 0"),
        "for 3D Slicer"
    );
    let n = case.vertices.len();
    let piece = document.descendants().find(|n| n.has_tag_name("Piece")).unwrap();
    assert_eq!(piece.attribute("NumberOfPoints"), Some(&*n.to_string()));
    assert_eq!(piece.attribute("NumberOfPolys"), Some(&*case.triangles.len().to_string()));
    let positions: Vec<DVec3> =
        doubles(&array("Points", "Float64", "3")).as_chunks().0.iter().map(|v| DVec3::from_array(*v)).collect();
    let corners = array("connectivity", "Int32", "1");
    let corners: Vec<u32> = corners.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
    let held = vectors(&floats(&array("radiance", "Float32", "3")));
    case.check_vertices("vtp", &positions, &held, corners.as_chunks().0);
    let offsets = array("offsets", "Int64", "1");
    let offsets: Vec<i64> = offsets.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b)).collect();
    assert!(offsets.iter().enumerate().all(|(t, &o)| o == 3 * (t as i64 + 1)));
    check_normals("vtp", &case, &vectors(&floats(&array("Normals", "Float32", "3"))));
    let rgb = array("rgb", "UInt8", "3");
    assert_eq!(rgb[..3], case.colour(case.vertices[0]).map(|v| (255.0 * v).round() as u8));
    let points = document.descendants().find(|n| n.has_tag_name("PointData")).unwrap();
    assert_eq!((points.attribute("Scalars"), points.attribute("Normals")), (Some("rgb"), Some("Normals")));
}
