//! Binary little-endian PLY: a mesh with named values at its vertices.
//!
//! What is written is read by ParaView/VTK, MeshLab, Blender and Mitsuba. So there is no `obj_info` line (Mitsuba
//! refuses it), the face list is `uchar int`, and positions are `float`; but `double` far from the origin, where steps
//! of `float` are to be seen.

use super::{Mesh, coarse_in_f32, colour_bytes};
use crate::error::{Error, Result};
use crate::files;
use crate::volume::Space;
use glam::DVec3;
use std::io::{self, Write};
use std::path::Path;

/// Names of vertex properties with a meaning of their own.
const RESERVED: [&str; 9] = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"];

/// The vertex properties of radiance, linear: red, green, blue.
pub const RADIANCE: [&str; 3] = ["radiance_r", "radiance_g", "radiance_b"];

/// The vertex properties of the variance of a reference's radiance.
pub const VARIANCE: [&str; 3] = ["variance_r", "variance_g", "variance_b"];

/// The vertex property that is 1 where a reference was computed, else 0.
pub const SAMPLED: &str = "sampled";

/// Writes `mesh`: `x y z`, `nx ny nz`, the named properties (all float, but see above), then `red green blue` (uchar).
///
/// # Errors
/// `Invalid` if the arrays do not fit each other, a position is not finite in f32, or a property's name is taken, used
/// twice or not a plain word; `NotSupported` beyond 2³¹ − 1 vertices or triangles; `Io`.
pub fn write(path: impl AsRef<Path>, mesh: &Mesh) -> Result<()> {
    write_with_comments(path, mesh, &[])
}

/// As [`write()`], with lines of `comments` in its header.
///
/// # Errors
/// As [`write()`]; `Invalid` for a comment that is not one line.
pub fn write_with_comments(path: impl AsRef<Path>, mesh: &Mesh, comments: &[String]) -> Result<()> {
    let path = path.as_ref();
    if let Some(c) = comments.iter().find(|c| c.contains(char::is_control)) {
        return Err(Error::invalid(path, format!("comment {c:?}: must be one line")));
    }
    mesh.check(path)?;
    for (i, (name, _)) in mesh.properties.iter().enumerate() {
        let word = !name.is_empty() && name.bytes().all(|b| b.is_ascii_graphic());
        if !word || RESERVED.contains(name) || mesh.properties[..i].iter().any(|(other, _)| other == name) {
            return Err(Error::invalid(
                path,
                format!("vertex property {name:?}: names must be ASCII words, differ, and not be one of {RESERVED:?}"),
            ));
        }
    }
    files::write_atomically(path, |out| write_to(out, mesh, comments))
}

fn write_to(out: &mut impl Write, mesh: &Mesh, comments: &[String]) -> io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment isolume {}", env!("CARGO_PKG_VERSION"))?;
    mesh.space.and_then(Space::of_mesh).map_or(Ok(()), |space| writeln!(out, "comment SPACE={space}"))?;
    comments.iter().try_for_each(|c| writeln!(out, "comment {c}"))?;
    writeln!(out, "element vertex {}", mesh.positions.len())?;
    let (lo, hi) =
        mesh.positions.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let double = coarse_in_f32(lo.abs().max(hi.abs()).max_element(), (hi - lo).length());
    for name in ["x", "y", "z"] {
        writeln!(out, "property {} {name}", if double { "double" } else { "float" })?;
    }
    let normals = mesh.normals.map_or(&[][..], |_| &["nx", "ny", "nz"]);
    for name in normals.iter().chain(mesh.properties.iter().map(|(name, _)| name)) {
        writeln!(out, "property float {name}")?;
    }
    if mesh.colours.is_some() {
        writeln!(out, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
    }
    writeln!(out, "element face {}\nproperty list uchar int vertex_indices\nend_header", mesh.triangles.len())?;

    let mut record = Vec::new();
    for (i, p) in mesh.positions.iter().enumerate() {
        record.clear();
        if double {
            p.to_array().into_iter().for_each(|x| record.extend_from_slice(&x.to_le_bytes()));
        }
        let mut float = |value: f32| record.extend_from_slice(&value.to_le_bytes());
        if !double {
            p.as_vec3().to_array().into_iter().for_each(&mut float);
        }
        if let Some(normals) = mesh.normals {
            normals[i].to_array().into_iter().for_each(&mut float);
        }
        mesh.properties.iter().for_each(|(_, values)| float(values[i]));
        if let Some(colours) = mesh.colours {
            record.extend_from_slice(&colour_bytes(colours[i]));
        }
        out.write_all(&record)?;
    }
    for t in mesh.triangles {
        let mut record = [3; 13];
        record[1..].as_chunks_mut().0.iter_mut().zip(t).for_each(|(b, v)| *b = v.to_le_bytes());
        out.write_all(&record)?;
    }
    Ok(())
}

/// A mesh from a PLY file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyMesh {
    /// Number of vertices.
    pub vertices: usize,
    /// All vertex properties, in the order of the file (integers as they are: a uchar colour reaches 255).
    pub properties: Vec<(String, Vec<f64>)>,
    /// Triangles as vertex indices, each below `vertices`.
    pub triangles: Vec<[u32; 3]>,
    /// Comments of the header, in the order of the file.
    pub comments: Vec<String>,
}

impl PlyMesh {
    /// The values of a vertex property.
    pub fn property(&self, name: &str) -> Option<&[f64]> {
        self.properties.iter().find(|(n, _)| n == name).map(|(_, values)| values.as_slice())
    }

    /// Three vertex properties side by side, such as `["x", "y", "z"]` or [`RADIANCE`].
    pub fn triple(&self, names: [&str; 3]) -> Option<Vec<[f64; 3]>> {
        let [a, b, c] = names.map(|name| self.property(name));
        Some(a?.iter().zip(b?).zip(c?).map(|((a, b), c)| [*a, *b, *c]).collect())
    }
}

/// Reads a PLY file as [`write()`] makes it.
///
/// # Errors
/// `Io`, or as [`parse`].
pub fn read(path: impl AsRef<Path>) -> Result<PlyMesh> {
    let path = path.as_ref();
    parse(&files::read(path)?, path)
}

/// The scalar types of PLY.
#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// The value at the start of `bytes`, which holds at least [`Scalar::size`] of them. f64 holds all types exactly.
    fn get(self, bytes: &[u8]) -> f64 {
        fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
            *bytes.first_chunk().expect("the caller gives a whole value")
        }
        match self {
            Scalar::I8 => i8::from_le_bytes(first(bytes)).into(),
            Scalar::U8 => bytes[0].into(),
            Scalar::I16 => i16::from_le_bytes(first(bytes)).into(),
            Scalar::U16 => u16::from_le_bytes(first(bytes)).into(),
            Scalar::I32 => i32::from_le_bytes(first(bytes)).into(),
            Scalar::U32 => u32::from_le_bytes(first(bytes)).into(),
            Scalar::F32 => f32::from_le_bytes(first(bytes)).into(),
            Scalar::F64 => f64::from_le_bytes(first(bytes)),
        }
    }
}

/// What a header says.
#[derive(Default)]
struct Header {
    vertices: Option<usize>,
    properties: Vec<(String, Scalar)>,
    faces: Option<usize>,
    /// Types of the count and of the indices.
    list: Option<(Scalar, Scalar)>,
    comments: Vec<String>,
}

/// Reads the bytes of a PLY file; `name` is for messages. Binary little-endian, vertices before triangles, any scalar
/// vertex properties, one index list per face, nothing else. Sizes are checked against the bytes there are before room
/// for them is made.
///
/// # Errors
/// `Invalid` if the bytes are no PLY, are cut short or go on, or name vertices that do not exist; `NotSupported` for
/// other encodings, elements and polygons.
pub fn parse(bytes: &[u8], name: impl AsRef<Path>) -> Result<PlyMesh> {
    let name = name.as_ref();
    let (header, body) = parse_header(bytes, name)?;
    let vertices = header.vertices.ok_or_else(|| Error::invalid(name, "has no element vertex"))?;
    let stride: usize = header.properties.iter().map(|(_, t)| t.size()).sum();
    let size = vertices.checked_mul(stride).filter(|size| *size <= body.len() && stride > 0);
    let Some(size) = size else {
        return Err(Error::invalid(
            name,
            format!("promises {vertices} vertices of {stride} bytes, {} bytes are there", body.len()),
        ));
    };
    let (body, rest) = body.split_at(size);
    let mut offset = 0;
    let mut properties = Vec::with_capacity(header.properties.len());
    for (property, scalar) in header.properties {
        let values = body.chunks_exact(stride).map(|record| scalar.get(&record[offset..])).collect();
        offset += scalar.size();
        properties.push((property, values));
    }

    let faces = header.faces.unwrap_or(0);
    let mut triangles = Vec::new();
    if faces > 0 || !rest.is_empty() {
        let (count, index) = header.list.ok_or_else(|| Error::invalid(name, "has faces without an index list"))?;
        let stride = count.size() + 3 * index.size();
        if faces.checked_mul(stride) != Some(rest.len()) {
            // Polygons change the size too: name them first.
            let polygon = rest.chunks_exact(stride).take(faces).find(|r| count.get(r) != 3.0);
            let message = match polygon {
                Some(r) => return Err(not_a_triangle(name, count.get(r))),
                None => format!("promises {faces} triangles of {stride} bytes, {} bytes are there", rest.len()),
            };
            return Err(Error::invalid(name, message));
        }
        triangles.reserve_exact(faces);
        for (face, record) in rest.chunks_exact(stride).enumerate() {
            if count.get(record) != 3.0 {
                return Err(not_a_triangle(name, count.get(record)));
            }
            let corner = |i: usize| index.get(&record[count.size() + i * index.size()..]);
            let corners = [corner(0), corner(1), corner(2)];
            if !corners.iter().all(|c| (0.0..vertices as f64).contains(c)) {
                return Err(Error::invalid(name, format!("triangle {face} names {corners:?} of {vertices} vertices")));
            }
            triangles.push(corners.map(|c| c as u32));
        }
    }
    Ok(PlyMesh { vertices, properties, triangles, comments: header.comments })
}

fn not_a_triangle(name: &Path, corners: f64) -> Error {
    Error::not_supported(name, format!("has a face of {corners} corners; only triangles are read"))
}

/// Splits off the header.
fn parse_header<'a>(bytes: &'a [u8], name: &Path) -> Result<(Header, &'a [u8])> {
    let mut header = Header::default();
    let (mut rest, mut element, mut number) = (bytes, String::new(), 0);
    let mut format_seen = false;
    loop {
        number += 1;
        let end = rest.iter().position(|b| *b == b'\n');
        let line = end.and_then(|end| std::str::from_utf8(&rest[..end]).ok());
        let (Some(end), Some(line)) = (end, line) else {
            return Err(Error::invalid(name, "is not a PLY file, or its header is cut short: no end_header was found"));
        };
        rest = &rest[end + 1..];
        let wrong = || Error::invalid(name, format!("line {number} of the header, {line:?}, is not understood"));
        let unsupported =
            |why: &str| Error::not_supported(name, format!("line {number} of the header, {line:?}: {why}"));
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["ply"] if number == 1 => {}
            _ if number == 1 => return Err(Error::invalid(name, "is not a PLY file: the first line is not \"ply\"")),
            ["format", "binary_little_endian", "1.0"] => format_seen = true,
            ["format", ..] => return Err(unsupported("only binary_little_endian 1.0 is read")),
            ["comment", ref words @ ..] => header.comments.push(words.join(" ")),
            ["obj_info", ..] | [] => {}
            ["element", which, count] => {
                let count = count.parse().map_err(|_| wrong())?;
                match which {
                    "vertex" if header.vertices.is_none() && header.faces.is_none() => header.vertices = Some(count),
                    "face" if header.faces.is_none() => header.faces = Some(count),
                    _ => return Err(unsupported("only one element vertex, then one element face are read")),
                }
                element = which.to_string();
            }
            ["property", "list", count, index, _] if element == "face" && header.list.is_none() => {
                let types = (Scalar::from_name(count), Scalar::from_name(index));
                let (Some(count), Some(index)) = types else { return Err(wrong()) };
                if [count, index].iter().any(|t| matches!(t, Scalar::F32 | Scalar::F64)) {
                    return Err(wrong());
                }
                header.list = Some((count, index));
            }
            ["property", scalar, property] if element == "vertex" => {
                let scalar = Scalar::from_name(scalar).ok_or_else(wrong)?;
                if header.properties.iter().any(|(other, _)| other == property) {
                    return Err(Error::invalid(name, format!("has two vertex properties {property:?}")));
                }
                header.properties.push((property.to_string(), scalar));
            }
            ["property", ..] => return Err(unsupported("only scalars per vertex and one list per face are read")),
            ["end_header"] if format_seen => return Ok((header, rest)),
            _ => return Err(wrong()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    const COLOURS: [[f32; 3]; 4] = [[1.0, 0.0, 7.0 / 255.0], [0.0; 3], [0.5; 3], [1.0; 3]];
    const POSITIONS: [DVec3; 4] = [DVec3::new(0.1, -2.5, 1e20), DVec3::X, DVec3::Y, DVec3::Z];

    fn example<'a>(radiance: &'a [(&'a str, &'a [f32])]) -> Mesh<'a> {
        Mesh {
            positions: &POSITIONS,
            triangles: &[[0, 1, 2], [3, 2, 1]],
            normals: Some(&[Vec3::X, Vec3::NEG_Y, Vec3::Z, Vec3::X]),
            colours: Some(&COLOURS),
            properties: radiance,
            space: None,
        }
    }

    fn bytes_of(mesh: &Mesh) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_to(&mut bytes, mesh, &[]).unwrap();
        bytes
    }

    #[test]
    fn what_is_written_is_read_back() {
        let radiance = [0.25, f32::MIN_POSITIVE, -1.0, 3e38];
        let properties = [("radiance_r", &radiance[..]), ("σ", &radiance[..])];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.ply");
        write(&path, &example(&properties[..1])).unwrap();
        let read = read(&path).unwrap();
        assert_eq!(read.vertices, 4);
        let names: Vec<_> = read.properties.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["x", "y", "z", "nx", "ny", "nz", "radiance_r", "red", "green", "blue"]);
        assert_eq!(read.triple(["x", "y", "z"]).unwrap()[0], [0.1f32, -2.5, 1e20].map(f64::from));
        assert_eq!(read.triple(["nx", "ny", "nz"]).unwrap()[1], [0.0, -1.0, 0.0]);
        assert_eq!(read.property("radiance_r").unwrap(), radiance.map(f64::from));
        assert_eq!(read.triple(["red", "green", "blue"]).unwrap()[0], [255.0, 0.0, 7.0]);
        assert_eq!(read.triangles, [[0, 1, 2], [3, 2, 1]]);
        assert_eq!(read.property("radiance_g"), None);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

        let refused = |mesh: &Mesh| write(folder.path().join("no.ply"), mesh).unwrap_err().to_string();
        assert!(refused(&example(&properties)).contains("σ"));
        assert!(refused(&example(&[("nx", &radiance)])).contains("\"nx\""));
        assert!(refused(&example(&[("a b", &radiance)])).contains("\"a b\""));
        assert!(refused(&example(&[("a", &radiance), ("a", &radiance)])).contains("differ"));
        assert!(refused(&example(&[("a", &radiance[1..])])).contains("3 values of a"));
        assert!(refused(&Mesh { triangles: &[[0, 1, 4]], ..example(&[]) }).contains("[0, 1, 4] of 4"));
        assert!(refused(&Mesh { positions: &[DVec3::splat(1e39); 4], ..example(&[]) }).contains("beyond f32"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    /// Steps of f32 are 0.0625 there.
    #[test]
    fn places_far_away_are_double() {
        let positions = POSITIONS.map(|p| 1e6 + 0.3 * p.clamp(DVec3::splat(-1.0), DVec3::ONE));
        let bytes = bytes_of(&Mesh { positions: &positions, ..example(&[("a", &[0.5; 4])]) });
        assert!(String::from_utf8_lossy(&bytes).contains("property double z\nproperty float nx\n"));
        let read = parse(&bytes, "far").unwrap();
        assert_eq!(read.triple(["x", "y", "z"]).unwrap(), positions.map(|p| p.to_array()));
        assert_eq!((read.property("a").unwrap()[3], read.triangles[1]), (0.5, [3, 2, 1]));
    }

    #[test]
    fn the_bytes_are_the_format() {
        let mesh = Mesh { positions: &[DVec3::ONE; 3], triangles: &[[0, 1, 2]], ..Mesh::default() };
        let bytes = bytes_of(&mesh);
        let header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment isolume {}\nelement vertex 3\nproperty float x\n\
             property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n",
            env!("CARGO_PKG_VERSION")
        );
        assert_eq!(&bytes[..header.len()], header.as_bytes());
        assert_eq!(bytes[header.len()..][..4], [0, 0, 0x80, 0x3f]);
        assert_eq!(bytes[header.len() + 36..], [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
        assert!(parse(&bytes_of(&Mesh::default()), "empty").unwrap().triangles.is_empty());
    }

    #[test]
    fn every_truncation_and_every_extension_is_an_error() {
        let bytes = bytes_of(&example(&[("a", &[1.0; 4])]));
        for n in 0..bytes.len() {
            assert!(matches!(parse(&bytes[..n], "cut"), Err(Error::Invalid(_))), "{n} of {} bytes", bytes.len());
        }
        let longer: Vec<u8> = bytes.iter().copied().chain([0]).collect();
        assert!(parse(&longer, "longer").is_err());
    }

    #[test]
    fn damaged_bytes_never_panic_and_huge_counts_take_no_memory() {
        let bytes = bytes_of(&example(&[("a", &[1.0; 4])]));
        for n in 0..bytes.len() {
            for value in [0, b'9', b'\n', 255] {
                let mut damaged = bytes.clone();
                damaged[n] = value;
                let _ = parse(&damaged, "damaged");
            }
        }
        let head = |vertex: &str, face: &str| {
            format!(
                "ply\nformat binary_little_endian 1.0\nelement vertex {vertex}\nproperty float x\nelement face {face}\n\
                 property list uchar int vertex_indices\nend_header\n"
            )
        };
        for (vertex, face) in
            [("9999999999999999999", "0"), ("4611686018427387904", "0"), ("0", "18446744073709551615")]
        {
            assert!(matches!(parse(head(vertex, face).as_bytes(), "huge"), Err(Error::Invalid(_))));
        }
        let quad = [head("0", "1").as_bytes(), &[4], &[0; 16]].concat();
        assert!(parse(&quad, "quad").unwrap_err().to_string().contains("4 corners"));
        let negative = [head("1", "1").as_bytes(), &[0; 4], &[3], &[255; 12]].concat();
        assert!(parse(&negative, "negative").unwrap_err().to_string().contains("-1"));
        let ascii = parse(b"ply\nformat ascii 1.0\nend_header\n", "ascii").unwrap_err();
        assert!(matches!(ascii, Error::NotSupported(_)));
    }
}
