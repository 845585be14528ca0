//! Binary glTF 2.0 (`.glb`): one mesh with colours at its vertices, for browsers, Blender, ChimeraX and office
//! programs. \[glTF\]
//!
//! glTF's y points up where the box's z does: the node's matrix turns the mesh, whose own coordinates stay the world's,
//! less the centre of its bounds, so that f32 holds them well wherever the world's origin is.

use super::Mesh;
use super::picture::srgb_decode;
use crate::error::{Error, Result};
use crate::files;
use glam::{DVec3, Vec3};
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const UNLIT: &str = "KHR_materials_unlit";

/// Writes `mesh`: `POSITION`, `NORMAL`, and the display colours as linear floats in `COLOR_0`, with a material that
/// shows them without further light (`KHR_materials_unlit`): light is what they are; without colours the viewer's light
/// falls on it. The named properties become `_NAME` attributes.
///
/// # Errors
/// `Invalid` if the arrays do not fit each other, a position is not finite in f32 or the mesh is empty; `NotSupported`
/// beyond 4 GB, the format's limit; `Io`.
pub fn write(path: impl AsRef<Path>, mesh: &Mesh) -> Result<()> {
    let path = path.as_ref();
    mesh.check(path)?;
    if mesh.triangles.is_empty() {
        return Err(Error::invalid(path, "the mesh has no triangles, and glTF holds no empty arrays"));
    }
    let (lo, hi) =
        mesh.positions.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), &p| (lo.min(p), hi.max(p)));
    let centre = 0.5 * (lo + hi);
    let floats = 3 + mesh.normals.map_or(0, |_| 3) + mesh.colours.map_or(0, |_| 3) + mesh.properties.len();
    let length = 4 * (floats as u64 * mesh.positions.len() as u64 + 3 * mesh.triangles.len() as u64);
    if length > u64::from(u32::MAX) - (1 << 20) {
        return Err(Error::not_supported(path, format!("{length} bytes of mesh: a .glb ends at 4 GB; write a .ply")));
    }

    let mut data = Data { bytes: Vec::with_capacity(length as usize), views: vec![], accessors: vec![] };
    let local: Vec<[f32; 3]> = mesh.positions.iter().map(|&p| (p - centre).as_vec3().to_array()).collect();
    let mut attributes = serde_json::Map::new();
    attributes.insert("POSITION".into(), data.vectors(&local).into());
    let bounds = |pick: fn(f32, f32) -> f32| {
        local.iter().copied().reduce(|a, b| std::array::from_fn(|i| pick(a[i], b[i]))).expect("there are triangles")
    };
    data.accessors[0]["min"] = json!(bounds(f32::min));
    data.accessors[0]["max"] = json!(bounds(f32::max));
    if let Some(normals) = mesh.normals {
        // The format knows unit normals only; where ∇h vanishes any will do.
        let unit: Vec<[f32; 3]> =
            normals.iter().map(|n| if *n == Vec3::ZERO { [0.0, 0.0, 1.0] } else { n.to_array() }).collect();
        attributes.insert("NORMAL".into(), data.vectors(&unit).into());
    }
    if let Some(colours) = mesh.colours {
        let linear: Vec<[f32; 3]> = colours.iter().map(|c| c.map(srgb_decode)).collect();
        attributes.insert("COLOR_0".into(), data.vectors(&linear).into());
    }
    for (name, values) in mesh.properties {
        let index = data.accessor(values.iter().flat_map(|v| v.to_le_bytes()), values.len(), "SCALAR", FLOAT);
        attributes.insert(format!("_{}", name.to_ascii_uppercase()), index.into());
    }
    let corners = mesh.triangles.as_flattened();
    let indices = data.accessor(corners.iter().flat_map(|v| v.to_le_bytes()), corners.len(), "SCALAR", UNSIGNED_INT);

    let c = centre;
    let mut document = json!({
        "asset": {"version": "2.0", "generator": format!("isolume {}", env!("CARGO_PKG_VERSION"))},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        // (x, y, z) + centre, then to (x, z, −y).
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, c.x, c.z, -c.y, 1]}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"doubleSided": true, "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}],
        "buffers": [{"byteLength": data.bytes.len()}],
        "bufferViews": data.views,
        "accessors": data.accessors,
    });
    if mesh.colours.is_some() {
        document["extensionsUsed"] = json!([UNLIT]);
        document["materials"][0]["extensions"] = json!({UNLIT: {}});
    }
    let mut text = document.to_string().into_bytes();
    // Chunks end at multiples of 4: the text with spaces; the data does so by itself.
    text.resize(text.len().next_multiple_of(4), b' ');
    files::write_atomically(path, |file| {
        let total = 12 + 8 + text.len() + 8 + data.bytes.len();
        let word = |n: usize| (n as u32).to_le_bytes();
        file.write_all(&[*b"glTF", word(2), word(total)].concat())?;
        file.write_all(&[word(text.len()), *b"JSON"].concat())?;
        file.write_all(&text)?;
        file.write_all(&[word(data.bytes.len()), *b"BIN\0"].concat())?;
        file.write_all(&data.bytes)
    })
}

/// The binary chunk, and what describes it.
struct Data {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Data {
    /// Adds values of 4 bytes and returns the accessor's number.
    fn accessor(&mut self, values: impl Iterator<Item = u8>, count: usize, shape: &str, component: u32) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend(values);
        let target = if component == UNSIGNED_INT { ELEMENT_ARRAY_BUFFER } else { ARRAY_BUFFER };
        let length = self.bytes.len() - offset;
        self.views.push(json!({"buffer": 0, "byteOffset": offset, "byteLength": length, "target": target}));
        let view = self.views.len() - 1;
        self.accessors.push(json!({"bufferView": view, "componentType": component, "count": count, "type": shape}));
        self.accessors.len() - 1
    }

    fn vectors(&mut self, vectors: &[[f32; 3]]) -> usize {
        let bytes = vectors.as_flattened().iter().flat_map(|v| v.to_le_bytes());
        self.accessor(bytes, vectors.len(), "VEC3", FLOAT)
    }
}
