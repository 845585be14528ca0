//! `isolume extract`: one isosurface as a mesh, with a bake's light on its vertices.

use super::final_gather::{FinalGatherOptions, light};
use super::{expect_extension, outputs};
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::export::{Mesh, ply};
use crate::field::{Field, Sweep};
use crate::files;
use crate::progress::{Progress, say, unless_interrupted};
use crate::reference::Origin;
use crate::scene::Scene;
use crate::scene_file::{BoundaryName, Inputs, Loaded, SceneOptions, load};
use crate::series::is_pattern;
use crate::surface_mesh::{SurfaceMesh, channel, display_colours, unit_isovalue};
use crate::volume::Volume;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
From a bake, vertices also hold its light, as colours for the eye (exposed; sRGB-encoded but in .glb, whose colours are linear)
and, in .ply as `radiance_r`, `radiance_g`, `radiance_b` and in .vtp as `radiance`, linear and not exposed. It is the light of the
outside; that of the inside, of a bake with --sides both, is in the bake's array `radiance_inside` (isolume export). By rays
(--gather-rays), `std_error` says what noise they leave in its luminance, as if they were independent.

Examples:
  isolume extract head.nii.gz --isovalue 80 -o head.ply
  isolume extract baked.vti --isovalue 80 -o textured.ply --refine 2
  isolume extract baked.vti --isovalue 80 -o exact.ply --gather-rays 256    light by rays from every vertex
  isolume extract baked.vti --isovalue 80 -o textured.glb     for browsers, Blender, ChimeraX, PowerPoint")]
pub(super) struct Extract {
    /// Volume, scene file (.toml), or bake (.vti, .vtm)
    input: PathBuf,
    /// The isosurface, in the volume's units
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    isovalue: f64,
    /// Of several volumes, the one to take: its name (default: the first)
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Output: .ply, .obj, .glb or .vtp
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Cut every cell into R³ by trilinear interpolation first, so that the triangles follow the surface more closely
    #[arg(long, default_value_t = 1, value_name = "R")]
    refine: usize,
    #[command(flatten)]
    rays: FinalGatherOptions,
    /// Print vertices, triangles and seconds as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    scene: SceneOptions,
}

impl Extract {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["ply", "obj", "glb", "vtp"])?;
        outputs([&*self.output], &Inputs::of(&self.input, &self.scene)?)?;
        let rays = self.rays.settings()?;
        let begun = Instant::now();
        if self.scene.surface.boundary == Some(BoundaryName::Capped) {
            return Err(Error::Invalid(
                "--boundary capped: the mesh is the surface alone, open where the volume's faces cut it; leave the flag out"
                    .into(),
            ));
        }
        let Opened { mut scene, baked, volume } = open_scene(&self.input, &self.scene, self.field.as_deref())?;
        match (rays, &baked) {
            (Some(_), None) => {
                return Err(Error::invalid(
                    &self.input,
                    "is no bake: --shadow-rays, --gather-rays are for the light of one; leave them out, or bake first",
                ));
            }
            (Some(rays), Some(baked)) => rays.check(baked).map_err(|e| e.in_file(&self.input))?,
            (None, _) => {}
        }
        let isovalue = match &baked {
            // There is light on isosurfaces of the sweep only.
            Some(_) => unit_isovalue(&scene.field, self.isovalue).map_err(|e| self.without_light(&e))?,
            None => {
                if let Some(field) =
                    volume.as_ref().and_then(|volume| around(volume, scene.field.sweep(), self.isovalue))
                {
                    scene.field = field.into();
                }
                scene.field.sweep().isovalue(self.isovalue)
            }
        };
        unless_interrupted()?;
        let mesh = SurfaceMesh::extract(&scene, isovalue, self.refine).map_err(|e| e.in_file(&self.input))?;
        let found = baked.as_ref().map(|b| light(b, rays, &mesh.positions, progress)).transpose();
        let found = found.map_err(|e| e.in_file(&self.input))?;
        let radiance = found.as_ref().map(|f| &f.radiance);
        let channels: Option<[Vec<f32>; 3]> = radiance.map(|r| [0, 1, 2].map(|c| channel(r, c)));
        let colours = radiance.zip(baked.as_ref()).map(|(r, b)| display_colours(r, b.exposure));
        let values = channels.iter().flatten().map(Vec::as_slice);
        let mut properties: Vec<(&str, &[f32])> = ply::RADIANCE.into_iter().zip(values).collect();
        let std_error = found.as_ref().and_then(|f| f.std_error.as_ref());
        properties.extend(std_error.map(|std_error| ("std_error", &std_error[..])));
        unless_interrupted()?;
        let space = volume.map(|v| v.space).or_else(|| baked.as_ref().map(|b| b.space));
        let lit = Mesh { colours: colours.as_deref(), space, ..mesh.export(&properties) };
        // Where it can be said, for compare.
        match baked.is_some() && files::has_extension(&self.output, "ply") {
            true => ply::write_with_comments(&self.output, &lit, &[Origin::comment_of_bake(self.isovalue)])?,
            false => lit.write(&self.output)?,
        }
        if self.json {
            let numbers = serde_json::json!({
                "file": self.output.to_string_lossy(),
                "isovalue": self.isovalue,
                "vertices": mesh.positions.len(),
                "triangles": mesh.triangles.len(),
                "lit": radiance.is_some(),
                "rays": found.as_ref().map_or(0, |f| f.rays),
                "seconds": begun.elapsed().as_secs_f64(),
            });
            println!("{numbers:#}");
        } else if progress.is_shown() {
            say!(
                "{}: {} vertices, {} triangles in {:.2} s",
                self.output.display(),
                mesh.positions.len(),
                mesh.triangles.len(),
                begun.elapsed().as_secs_f64()
            );
        }
        Ok(())
    }

    /// The refusal of an isovalue that the bake has no light at.
    fn without_light(&self, e: &Error) -> Error {
        Error::invalid(
            &self.input,
            format!(
                "{e}; for a mesh without light, `isolume export` its array `value` as a volume, and extract from that"
            ),
        )
    }
}

/// The volume in units that tell its samples near an `isovalue` outside the sweep apart, which the sweep's own do not
/// in f32 where all is many times nearer to 0. `None` within the sweep, and where the volume has no such isovalue.
fn around(volume: &Volume, sweep: Sweep, isovalue: f64) -> Option<Field> {
    // So much wider than the rest of the data the numbers of the unit may not become.
    const NARROWEST: f64 = 1e-30;
    let (lo, hi) = (sweep.lo(), sweep.hi());
    if isovalue >= lo && isovalue <= hi {
        return None;
    }
    let width = hi - lo;
    let step = 0.5 * isovalue.abs().max(NARROWEST * width).min(width);
    Field::new(volume, Sweep::new(isovalue - step, isovalue + step).ok()?).ok()
}

/// The bake in a `.vti` or `.vtm`, if it is one; it takes no scene from `options`.
pub(super) fn open_bake(path: &Path, options: &SceneOptions) -> Result<Option<BakedVolume>> {
    let baked = match () {
        () if files::has_extension(path, "vtm") => BakedVolume::read(path).map(Some),
        () if files::has_extension(path, "vti") && !is_pattern(path) => BakedVolume::try_read(path),
        () => Ok(None),
    }?;
    match options.first_given().filter(|_| baked.is_some()) {
        Some(flag) => Err(Error::invalid(
            path,
            format!("{flag}: the bake holds its scene; leave the flag out, or bake the volume anew with it"),
        )),
        None => Ok(baked),
    }
}

/// A scene, and where it came from.
pub(super) struct Opened {
    pub(super) scene: Scene,
    /// The bake, if it is one.
    pub(super) baked: Option<BakedVolume>,
    /// Otherwise the volume.
    pub(super) volume: Option<Volume>,
}

/// The scene of a bake, volume or scene file, seen from the volume named `field` (the first if there is no name).
pub(super) fn open_scene(path: &Path, options: &SceneOptions, field: Option<&str>) -> Result<Opened> {
    if let Some(baked) = open_bake(path, options)? {
        let baked = if let Some(name) = field { baked.select(name).map_err(|e| e.in_file(path))? } else { baked };
        return Ok(Opened { scene: baked.scene.clone(), baked: Some(baked), volume: None });
    }
    let Loaded { scene, volume, companions, .. } = load(path, options)?;
    let number = field.map(|name| scene.field_named(name)).transpose().map_err(|e| e.in_file(path))?;
    let volume = std::iter::once(volume).chain(companions).nth(number.unwrap_or(0));
    Ok(Opened { scene: number.map_or_else(|| scene.clone(), |n| scene.seen_from(n)), baked: None, volume })
}
