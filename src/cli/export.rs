//! `isolume export`: one array of a bake, or a volume, in another format.

use super::{expect_extension, one_frame, outputs};
use crate::error::{Error, Result};
use crate::export::{bake_file, slices};
use crate::files;
use crate::progress::{Progress, say, unless_interrupted};
use crate::scene_file::{Inputs, PlaceOptions, RawOptions, ReadOptions};
use crate::volume::vti::{self, VtiFile, VtiWriter};
use crate::volume::{Lattice, Samples, Space, npy, nrrd};
use std::path::{Path, PathBuf};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The arrays of a bake: `radiance` (linear RGB), `rgb` (the same for the eye: exposed, clamped, sRGB-encoded), `std_error` (of
radiance, in luminance), `mask` (1: light of the point's own isosurface; 2: filled for those beside it; 0: none), of --split
`indirect` and `visible`, the same of the other side with _inside, and `value`, the volume itself. A .nrrd holds vectors as 3D
Slicer reads them; a .npy has the shape (z, y, x) or (z, y, x, 3); an .exr has one layer per slice along z.

Examples:
  isolume export lit.vti -o radiance.npy
  isolume export lit.vti --array rgb -o rgb.nrrd
  isolume export map.mrc -o map.vti")]
pub(super) struct Export {
    /// Bake (.vti), or any volume
    input: PathBuf,
    /// Output: .nrrd, .npy, .exr or .vti
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The array to write (default: radiance of a bake, the scalars of a volume)
    #[arg(long, value_name = "NAME")]
    array: Option<String>,
    /// What the world's axes mean, for a .nrrd or .vti: lps, ras, las or none (default: as the volume's own file said,
    /// lps where it said nothing); nothing is turned
    #[arg(long, value_name = "SPACE")]
    space: Option<String>,
    #[command(flatten)]
    place: PlaceOptions,
    #[command(flatten)]
    raw: RawOptions,
}

/// Values on a lattice, with what to call them.
struct Array {
    lattice: Lattice,
    space: Space,
    name: String,
    components: usize,
    samples: Samples,
}

impl Export {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["nrrd", "npy", "exr", "vti"])?;
        one_frame(&self.input)?;
        let extension = files::extension(&self.output);
        if let (Some(space), "npy" | "exr") = (&self.space, extension.as_str()) {
            return Err(Error::invalid(
                &self.output,
                format!(
                    "--space {space}: a .{extension} does not say what the axes mean; leave it out, or export a .nrrd or .vti"
                ),
            ));
        }
        outputs([&*self.output], &Inputs::files([&*self.input]))?;
        let space = self.space.as_ref().map(|name| {
            let unknown = || Error::Invalid(format!("--space {name}: give lps, ras, las or none"));
            Space::from_name(name).ok_or_else(unknown)
        });
        let mut array = self.load()?;
        unless_interrupted()?;
        if let Some(space) = space {
            array.space = space?;
        }
        let Array { lattice, space, name, components, samples } = &array;
        let path = &self.output;
        let mut written = samples.element_type();
        match extension.as_str() {
            "nrrd" => nrrd::write(path, lattice, *space, *components, samples.into(), &[("array", name)])?,
            "npy" => npy::write(path, lattice, *components, samples.into())?,
            "exr" => {
                slices::write(path, lattice, *components, samples.into())?;
                if slices::are_coarse(samples.into()) {
                    say!(
                        "warning: {}: EXR holds 32-bit floats, too coarse for `{name}`; write .nrrd, .npy or .vti",
                        path.display()
                    );
                }
                written = slices::ELEMENT;
            }
            _ => VtiWriter::new(lattice)
                .point_data(name, *components, samples)
                .active_scalars(name)
                .field_string(vti::SPACE, space.name())
                .write(path)?,
        }
        if progress.is_shown() {
            let [x, y, z] = lattice.dims();
            say!("{}: `{name}`, {x}×{y}×{z} × {components} {}", path.display(), written.name());
        }
        Ok(())
    }

    fn load(&self) -> Result<Array> {
        let is_vti = files::has_extension(&self.input, "vti");
        if is_vti && !self.raw.given() {
            let array = array_of(&self.input, self.array.as_deref())?;
            return Ok(Array { lattice: self.place.of(array.lattice, &self.input)?, ..array });
        }
        let is_vtk = files::has_extension(&self.input, "vtk");
        if let Some(name) = self.array.as_deref().filter(|n| !is_vtk && *n != "value") {
            return Err(Error::invalid(
                &self.input,
                format!("is a volume with one array, `value`, and has no `{name}`"),
            ));
        }
        let read = |array| ReadOptions { array, place: self.place.clone(), raw: self.raw.clone() }.open(&self.input);
        let volume = match self.array.clone().filter(|_| is_vtk) {
            // What every volume's array is called once it is written.
            Some(name) if name == "value" => read(Some(name)).or_else(|_| read(None))?,
            name => read(name)?,
        };
        let (lattice, space) = (volume.lattice.clone(), volume.space);
        Ok(Array { lattice, space, name: "value".into(), components: 1, samples: volume.into_samples() })
    }
}

/// An array of a `.vti`: the one of that name, else `radiance` of a bake, else the scalars.
fn array_of(path: &Path, name: Option<&str>) -> Result<Array> {
    let mut file = VtiFile::read(path)?;
    let space = file.space();
    let name = name.or_else(|| bake_file::is_bake(&file).then_some("radiance"));
    let chosen = file.point_data.iter().position(|a| Some(&*a.name) == name);
    let Some(chosen) = chosen else {
        if let Some(name) = name {
            let names: Vec<String> = file.point_data.iter().map(|a| format!("`{}`", a.name)).collect();
            let names = names.join(", ");
            return Err(Error::invalid(path, format!("has no point data `{name}`; it has {names}")));
        }
        let (lattice, samples) = file.into_scalars(None).map_err(|e| e.in_file(path))?;
        return Ok(Array { lattice, space, name: "value".into(), components: 1, samples });
    };
    let array = file.point_data.swap_remove(chosen);
    Ok(Array { lattice: file.lattice, space, name: array.name, components: array.components, samples: array.samples })
}
