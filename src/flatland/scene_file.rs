//! Scene files of n = 2.

use super::{FlatScene, HeightField, Segment};
use crate::error::{Error, Result};
use crate::field::Sweep;
use crate::files;
use crate::flattened::Side;
use crate::scene_file::{OutsideName, Rgb, numbers, parse_toml};
use glam::{DVec2, DVec3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct File {
    field: FieldSource,
    #[serde(default, deserialize_with = "numbers")]
    isovalues: Option<[f64; 2]>,
    height: Option<f64>,
    #[serde(default)]
    surface: SurfaceKeys,
    #[serde(default, rename = "box")]
    surroundings: BoxKeys,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct FieldSource {
    file: Option<PathBuf>,
    generator: Option<String>,
    size: Option<usize>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct SurfaceKeys {
    albedo: Option<Rgb>,
    outside: Option<OutsideName>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct BoxKeys {
    walls: Option<bool>,
    left: Option<Rgb>,
    right: Option<Rgb>,
    back: Option<Rgb>,
    luminaire: Option<[[f64; 2]; 2]>,
    radiance: Option<Rgb>,
}

/// Reads a scene file: `[field]` with `generator` (and `size`) or `file`; optional `isovalues`, `height` (world height
/// of the sweep, default 1), `[surface]` with `albedo`, `outside`, and `[box]` with `walls = false`, the walls' albedos
/// `left`, `right`, `back`, the `luminaire`'s ends in world units and its `radiance`.
///
/// # Errors
/// `Io`; `Invalid` with file, line and key; what reading the field returns.
pub fn load(path: &Path) -> Result<FlatScene> {
    let text = String::from_utf8(files::read(path)?)
        .map_err(|_| Error::invalid(path, "is no text; a scene file of n = 2 (.toml) is wanted"))?;
    let file: File = parse_toml(path, &text)?;
    build(path, &file).map_err(|e| match e {
        // What is wrong in the field's own file names that file already.
        Error::Invalid(message) if !message.starts_with(&field_name(path, &file)) => Error::invalid(path, message),
        other => other,
    })
}

/// The field file as messages begin with it; a character that no message begins with if there is none.
fn field_name(path: &Path, file: &File) -> String {
    file.field.file.as_ref().map_or("\0".into(), |f| folder(path).join(f).display().to_string())
}

fn folder(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

fn build(path: &Path, file: &File) -> Result<FlatScene> {
    let sweep = file.isovalues.map(|[lo, hi]| Sweep::new(lo, hi)).transpose()?;
    let field = match (&file.field.file, &file.field.generator) {
        (Some(_), None) if file.field.size.is_some() => {
            return Err(Error::Invalid("[field] size is the generator's; a file has its own".into()));
        }
        (Some(f), None) => HeightField::open(&folder(path).join(f), sweep)?,
        (None, Some(name)) => {
            let default = if name == "ramp" { (0.0, 1.0) } else { (3.6, 95.0) };
            let sweep = sweep.map_or_else(|| Sweep::new(default.0, default.1), Ok)?;
            HeightField::generate(name, file.field.size.unwrap_or(101), sweep)?
        }
        _ => return Err(Error::Invalid("[field] needs either file or generator".into())),
    };
    let keys = &file.surroundings;
    let [lo, hi] = field.bounds();
    let mut segments = FlatScene::default_box(&field)?;
    if keys.walls == Some(false) {
        segments.truncate(1);
    }
    let light = &segments[0];
    let ends = keys.luminaire.map_or(light.ends, |ends| ends.map(DVec2::from_array));
    let radiance = keys.radiance.map_or(light.emission, Rgb::vector);
    segments[0] = Segment::facing("luminaire", ends, 0.5 * (lo + hi), DVec3::ZERO, radiance)?;
    if radiance == DVec3::ZERO {
        segments.remove(0);
    }
    for (name, albedo) in [("x_min", keys.left), ("x_max", keys.right), ("y_max", keys.back)] {
        if let (Some(wall), Some(albedo)) = (segments.iter_mut().find(|s| s.name == name), albedo) {
            *wall = Segment::facing(name, wall.ends, 0.5 * (lo + hi), albedo.vector(), DVec3::ZERO)?;
        }
    }
    let albedo = file.surface.albedo.map_or(DVec3::splat(0.75), Rgb::vector);
    let outside = if file.surface.outside == Some(OutsideName::Higher) { Side::Higher } else { Side::Lower };
    FlatScene::new(field, albedo, outside, file.height.unwrap_or(1.0), segments)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(text: &str) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.toml");
        std::fs::write(&path, text).unwrap();
        (folder, path)
    }

    #[test]
    fn a_whole_scene_and_the_defaults() {
        let (_keep, path) = write(
            "isovalues = [10, 90]\nheight = 0.5\n[field]\ngenerator = \"bumps2\"\nsize = 33\n[surface]\nalbedo = 0.5\n\
             outside = \"higher\"\n[box]\nleft = 0.1\nluminaire = [[0.2, 0.9], [0.4, 0.9]]\nradiance = [1, 2, 3]\n",
        );
        let scene = load(&path).unwrap();
        assert_eq!((scene.field.dims(), scene.height, scene.outside), ([33, 33], 0.5, Side::Higher));
        assert_eq!(scene.segments[0].emission, DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(scene.segments[0].normal(), -DVec2::Y);
        assert_eq!(scene.segments[1].albedo, DVec3::splat(0.1));
        let (_keep, path) = write("[field]\ngenerator = \"bumps2\"\n");
        let scene = load(&path).unwrap();
        assert_eq!((scene.field.dims(), scene.field.sweep().lo(), scene.segments.len()), ([101, 101], 3.6, 4));
    }

    #[test]
    fn errors_name_the_file_and_the_key() {
        for (text, expected) in [
            ("[field]\ngenerator = \"bumps2\"\ncolour = 1\n", "scene.toml:3"),
            ("[field]\n", "either file or generator"),
            ("height = -1\n[field]\ngenerator = \"bumps2\"\n", "height -1"),
            ("isovalues = [200, 300]\n[field]\ngenerator = \"bumps2\"\n", "outside the data"),
            ("[field]\ngenerator = \"bumps2\"\n[box]\nback = 2\n", "y_max"),
            ("[field]\nfile = \"nowhere.png\"\n", "nowhere.png"),
        ] {
            let (_keep, path) = write(text);
            let e = load(&path).unwrap_err();
            assert!(e.to_string().contains(expected) && e.exit_code() == 2, "{text}: {e}");
        }
    }
}
