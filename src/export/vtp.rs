//! VTK XML polygons (`.vtp`) with appended zlib arrays, for ParaView, VTK and PyVista. Positions keep all digits of
//! f64. \[VTK\]

use super::{Mesh, colour_bytes};
use crate::error::{Error, Result};
use crate::volume::Space;
use crate::volume::vti::XmlDocument;
use std::path::Path;

/// Writes `mesh`: point data `Normals` (active normals), `rgb` (active scalars, uchar, sRGB-encoded) and the named
/// properties, of which `x_r`, `x_g`, `x_b` in this order become one array `x` of three components.
///
/// # Errors
/// `Invalid` if the arrays do not fit each other, a position is not finite or the mesh is empty; `NotSupported` beyond
/// 2³¹ − 1 vertices or triangles; `Io`.
pub fn write(path: impl AsRef<Path>, mesh: &Mesh) -> Result<()> {
    let path = path.as_ref();
    mesh.check(path)?;
    let (points, polys) = (mesh.positions.len(), mesh.triangles.len());
    if polys == 0 {
        return Err(Error::invalid(path, "the mesh has no triangles, and VTK cannot read empty arrays"));
    }
    let positions: Vec<f64> = mesh.positions.iter().flat_map(|p| p.to_array()).collect();
    let normals: Option<Vec<f32>> = mesh.normals.map(|n| n.iter().flat_map(|n| n.to_array()).collect());
    let colours: Option<Vec<u8>> = mesh.colours.map(|c| c.iter().flat_map(|&c| colour_bytes(c)).collect());
    let properties = merged(mesh);
    #[allow(clippy::cast_possible_wrap, reason = "checked to fit i32")]
    let connectivity: Vec<i32> = mesh.triangles.as_flattened().iter().map(|&v| v as i32).collect();
    let offsets: Vec<i64> = (1..=polys as i64).map(|t| 3 * t).collect();

    let mut d = XmlDocument::new("PolyData");
    d.text("  <PolyData>\n");
    if let Some(space) = mesh.space.and_then(Space::of_mesh) {
        d.text("    <FieldData>\n");
        d.string("SPACE", space);
        d.text("    </FieldData>\n");
    }
    d.text(&format!(
        "    <Piece NumberOfPoints=\"{points}\" NumberOfVerts=\"0\" NumberOfLines=\"0\" NumberOfStrips=\"0\" \
         NumberOfPolys=\"{polys}\">\n"
    ));
    let scalars = if colours.is_some() { " Scalars=\"rgb\"" } else { "" };
    let active = if normals.is_some() { " Normals=\"Normals\"" } else { "" };
    d.text(&format!("      <PointData{scalars}{active}>\n"));
    if let Some(colours) = &colours {
        d.array("rgb", 3, colours[..].into(), "");
    }
    if let Some(normals) = &normals {
        d.array("Normals", 3, normals[..].into(), "");
    }
    for (name, components, values) in &properties {
        d.array(name, *components, values[..].into(), "");
    }
    d.text("      </PointData>\n      <Points>\n");
    d.array("Points", 3, positions[..].into(), "");
    d.text("      </Points>\n      <Polys>\n");
    d.array("connectivity", 1, connectivity[..].into(), "");
    d.array("offsets", 1, offsets[..].into(), "");
    d.text("      </Polys>\n    </Piece>\n  </PolyData>\n");
    d.write(path)
}

/// The named properties, colours of three channels joined.
fn merged<'a>(mesh: &Mesh<'a>) -> Vec<(&'a str, usize, Vec<f32>)> {
    let mut out = Vec::new();
    let mut rest = mesh.properties;
    while let [(name, values), tail @ ..] = rest {
        if let (Some(stem), [(g, greens), (b, blues), after @ ..]) = (name.strip_suffix("_r"), tail)
            && g.strip_suffix("_g") == Some(stem)
            && b.strip_suffix("_b") == Some(stem)
        {
            let triples = values.iter().zip(*greens).zip(*blues).flat_map(|((r, g), b)| [*r, *g, *b]).collect();
            out.push((stem, 3, triples));
            rest = after;
        } else {
            out.push((*name, 1, values.to_vec()));
            rest = tail;
        }
    }
    out
}
