//! Wavefront OBJ with vertex colours, for tools that read nothing better. Positions keep all digits of f64.

use super::Mesh;
use crate::error::Result;
use crate::files;
use crate::volume::Space;
use std::io::{self, Write};
use std::path::Path;

/// Writes `mesh` as `v x y z [r g b]`, `vn` and `f`. Colours are the display colours, the convention of
/// MeshLab, Blender and ParaView. The named properties are left out: OBJ has no place for them.
///
/// # Errors
/// `Invalid` if the arrays do not fit each other or a position is not finite; `NotSupported` beyond 2³¹ − 1 vertices or
/// triangles; `Io`.
pub fn write(path: impl AsRef<Path>, mesh: &Mesh) -> Result<()> {
    mesh.check(path.as_ref())?;
    files::write_atomically(path.as_ref(), |out| write_to(out, mesh))
}

fn write_to(out: &mut impl Write, mesh: &Mesh) -> io::Result<()> {
    writeln!(out, "# isolume {}: {} vertices", env!("CARGO_PKG_VERSION"), mesh.positions.len())?;
    mesh.space.and_then(Space::of_mesh).map_or(Ok(()), |space| writeln!(out, "# SPACE={space}"))?;
    for (i, p) in mesh.positions.iter().enumerate() {
        write!(out, "v {} {} {}", p.x, p.y, p.z)?;
        if let Some(colours) = mesh.colours {
            let [r, g, b] = colours[i];
            write!(out, " {r} {g} {b}")?;
        }
        writeln!(out)?;
    }
    for n in mesh.normals.unwrap_or_default() {
        writeln!(out, "vn {} {} {}", n.x, n.y, n.z)?;
    }
    for t in mesh.triangles {
        let [a, b, c] = t.map(|v| u64::from(v) + 1);
        match mesh.normals {
            Some(_) => writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?,
            None => writeln!(out, "f {a} {b} {c}")?,
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec3, Vec3};

    #[test]
    fn another_reader_sees_what_was_written() {
        let positions = [DVec3::new(1e6 + 0.1, -2.5, 1e-30), DVec3::X, DVec3::Y, DVec3::Z];
        let mesh = Mesh {
            positions: &positions,
            triangles: &[[0, 1, 2], [2, 1, 3]],
            normals: Some(&[Vec3::X, Vec3::Y, Vec3::Z, Vec3::NEG_X]),
            colours: Some(&[[1.0, 0.0, 0.2]; 4]),
            space: Some(Space::LeftPosteriorSuperior),
            ..Mesh::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.obj");
        write(&path, &mesh).unwrap();
        let (models, _) =
            tobj::load_obj(&path, &tobj::LoadOptions { single_index: true, ..Default::default() }).unwrap();
        let read = &models[0].mesh;
        assert_eq!(read.indices, [0, 1, 2, 2, 1, 3]);
        assert_eq!(read.positions[..6], [1_000_000.1, -2.5, 1e-30, 1.0, 0.0, 0.0]);
        assert_eq!(read.vertex_color[..3], [1.0, 0.0, 0.2]);
        assert_eq!(read.normals[9..], [-1.0, 0.0, 0.0]);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains("\n# SPACE=LPS\n"), "{text}");
        assert!(text.contains("v 1000000.1 -2.5 ") && text.contains("f 1//1 2//2 3//3\n"), "{text}");

        let bare = Mesh { normals: None, colours: None, space: Some(Space::Unnamed), ..mesh };
        write(&path, &bare).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("SPACE"), "{text}");
        assert!(text.contains("v 1 0 0\n") && text.contains("f 3 2 4\n"), "{text}");
    }
}
