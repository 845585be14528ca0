//! `isolume init`: a scene file for a volume, with the keys that are changed most, their defaults and what they do.

use super::{expect_extension, one_frame};
use crate::digits::brief_span;
use crate::error::{Error, Result};
use crate::files;
use crate::illumination_grid::GridSize;
use crate::progress::{Progress, say};
use crate::scene_file::ReadOptions;
use crate::volume::Lattice;
use crate::volume::statistics::VolumeStatistics;
use std::path::{Path, PathBuf};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Every key of the file is commented; those with a # before them show the default. An existing file is left alone.

Examples:
  isolume init head.nii.gz                               writes head.toml beside it
  isolume init head.nii.gz -o scene.toml
  isolume init scan.raw --raw-dims 305,224,14 -o scan.toml")]
pub(super) struct Init {
    /// Volume
    file: PathBuf,
    /// Output: .toml (default: the volume's name, beside it)
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    read: ReadOptions,
}

impl Init {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let output = self.output.clone().unwrap_or_else(|| beside(&self.file));
        expect_extension(&output, &["toml"])?;
        one_frame(&self.file)?;
        if output.exists() {
            return Err(Error::invalid(&output, "exists already; give another name with -o, or remove it first"));
        }
        let volume = self.read.open(&self.file)?;
        let statistics = VolumeStatistics::of(&volume);
        let named = relative(&self.file, &output)?;
        let text = scene_text(&named, &self.read, &statistics, &volume.lattice);
        files::write_text(&output, &text)?;
        if progress.is_shown() {
            say!("{}: edit it, then: isolume bake {} -o lit.vti", output.display(), for_shell(&output));
        }
        Ok(())
    }
}

/// A path as a shell takes it.
fn for_shell(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+=@:,%".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// `head.nii.gz` to `head.toml`.
fn beside(volume: &Path) -> PathBuf {
    let name = volume.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let stem = name.split('.').find(|s| !s.is_empty()).unwrap_or("scene");
    volume.with_file_name(format!("{stem}.toml"))
}

/// The volume's path as the scene file must name it, since paths in scene files are relative to them.
fn relative(volume: &Path, output: &Path) -> Result<PathBuf> {
    if volume.to_str().is_none() {
        return Err(Error::invalid(volume, "its name is no Unicode, which scene files are written in; rename it"));
    }
    let folder = |p: &Path| p.parent().unwrap_or(Path::new("")).to_path_buf();
    if folder(volume) == folder(output) {
        return Ok(volume.file_name().map_or_else(|| volume.to_path_buf(), PathBuf::from));
    }
    if folder(output) == Path::new("") {
        return Ok(volume.to_path_buf());
    }
    std::path::absolute(volume).map_err(|e| Error::io(volume, e))
}

fn scene_text(volume: &Path, read: &ReadOptions, statistics: &VolumeStatistics, lattice: &Lattice) -> String {
    // Debug strings of text without control characters are TOML strings.
    let quoted = |s: &str| toml::Value::String(s.to_owned()).to_string();
    let [nx, ny, nz] = statistics.dims;
    let about = match statistics.range {
        Some([lo, hi]) => {
            format!("{nx} x {ny} x {nz} samples of type {}, values {}", statistics.element_type, brief_span([lo, hi]))
        }
        None => format!("{nx} x {ny} x {nz} samples, none of them finite"),
    };
    let none = || format!("# isovalues = [LO, HI]    # {}", statistics.without_sweep().unwrap_or_default());
    let sweep = statistics.sweep.map_or_else(none, |[lo, hi]| format!("isovalues = [{lo:?}, {hi:?}]"));
    // Light on a grid of long voxels is blurred.
    let grid = if GridSize::Cubic.of(lattice) == GridSize::OWN { "# grid = \"1x\"" } else { "grid = \"cubic\"" };
    let mut layout = String::new();
    let mut key = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            layout += &format!("{name} = {value}\n");
        }
    };
    let ReadOptions { array, place, raw } = read;
    key("array", array.as_deref().map(quoted));
    key("spacing", place.spacing.as_ref().map(|v| format!("{v:?}")));
    key("origin", place.origin.as_ref().map(|v| format!("{v:?}")));
    if raw.given() {
        layout += "\n# The layout of the headerless file.\n[volume.raw]\n";
        let mut key = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                layout += &format!("{name} = {value}\n");
            }
        };
        key("dims", raw.dims.as_ref().map(|v| format!("{v:?}")));
        key("type", raw.element.as_deref().map(quoted));
        key("endian", raw.endian.as_deref().map(quoted));
        key("spacing", raw.spacing.as_ref().map(|v| format!("{v:?}")));
        key("origin", raw.origin.as_ref().map(|v| format!("{v:?}")));
        key("skip", raw.skip.map(|v| v.to_string()));
    }
    include_str!("init/scene.toml")
        .replace("@about@", &about)
        .replace("@sweep@", &sweep)
        .replace("@grid@", &format!("{grid:<26}"))
        .replace("@layout@", &layout)
        .replace("@file@", &quoted(&volume.to_string_lossy()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hints_can_be_pasted() {
        for (path, text) in
            [("a/b-1.toml", "a/b-1.toml"), ("süb/ü.toml", "süb/ü.toml"), ("a b", "'a b'"), ("it's", "'it'\\''s'")]
        {
            assert_eq!(for_shell(Path::new(path)), text);
        }
    }
}
