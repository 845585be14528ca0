//! `isolume reference`: one isosurface illuminated in ordinary 3D, per vertex with variance, or as a picture.

use super::extract::{Opened, open_scene};
use super::{device, expect_extension, outputs};
use crate::bake::whole_number;
use crate::embree::{Device, GraphTracer, SurfaceTracer};
use crate::error::{Error, Result};
use crate::export::picture::Picture;
use crate::progress::{Progress, say};
use crate::reference::{Integrator, Origin, Reference, ReferenceSettings, SurfaceMapSettings, path_picture, reference};
use crate::render::Camera;
use crate::scene::Scene;
use crate::scene_file::{Inputs, SceneOptions};
use crate::surface_mesh::{SurfaceMesh, unit_isovalue};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The PLY holds, per vertex, the outside's outgoing radiance `radiance_r/g/b`, the variance of that mean
`variance_r/g/b`, and `sampled`: 1 where it was computed, 0 elsewhere (--vertices). The subset is the same for every
seed, so that two references of different seeds can be compared with a bake without their own noise. A comment says what it
is of: isovalue, seed, samples, and a digest of material and box. Rays that `began inside` stood a rounding below the triangles
and were let out: of ten thousand one or two are normal.

Examples:
  isolume reference scene.toml --isovalue 47 -o ref.ply --vertices 4000
  isolume compare out.vti ref.ply")]
pub(super) struct ReferenceArgs {
    /// Volume, scene file (.toml), or bake (.vti, .vtm: its scene)
    input: PathBuf,
    /// The isosurface, in the volume's units
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    isovalue: f64,
    /// Of several volumes, the one to illuminate: its name (default: the first). The others stand at the same share of
    /// their own ranges
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Output: .ply
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// path: unbiased path tracing; photon: a photon map on the mesh and final gather
    #[arg(long, default_value = "path")]
    integrator: Integrator,
    /// Only a fixed random subset of N vertices
    #[arg(long, value_name = "N")]
    vertices: Option<usize>,
    /// Paths or gather rays per vertex, rounded up to a multiple of --batches
    #[arg(long, default_value_t = 1024, value_name = "N")]
    samples: u32,
    /// Independent batches that tell the variance
    #[arg(long, default_value_t = 16, value_name = "N")]
    batches: u32,
    /// With --integrator photon: photons over all batches (default: 16777216)
    #[arg(long, value_name = "N", value_parser = whole_number)]
    photons: Option<u64>,
    /// With --integrator photon: photons per irradiance estimate (default: 64)
    #[arg(long, value_name = "K")]
    photons_per_estimate: Option<usize>,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Cut every cell into R³ before extracting triangles
    #[arg(long, default_value_t = 1, value_name = "R")]
    refine: usize,
    /// Trace the trilinear surface itself instead of triangles
    #[arg(long)]
    trilinear: bool,
    /// Print vertices, rays and seconds as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    scene: SceneOptions,
}

impl ReferenceArgs {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["ply"])?;
        outputs([&*self.output], &Inputs::of(&self.input, &self.scene)?)?;
        if !(1..=1 << 20).contains(&self.samples) || !(2..=1024).contains(&self.batches) {
            return Err(Error::Invalid("--samples: 1 to 1048576; --batches: 2 to 1024".into()));
        }
        let out_of_range = self.photons_per_estimate.is_some_and(|k| !(2..=4096).contains(&k));
        if self.photons == Some(0) || out_of_range || self.vertices == Some(0) {
            return Err(Error::Invalid("--photons, --vertices: at least 1; --photons-per-estimate: 2 to 4096".into()));
        }
        if self.integrator == Integrator::Path && (self.photons.is_some() || self.photons_per_estimate.is_some()) {
            return Err(Error::Invalid("--photons, --photons-per-estimate: are for --integrator photon".into()));
        }
        let options = SceneOptions { wanted: Some(self.isovalue), ..self.scene.clone() };
        let Opened { scene, baked, volume } = open_scene(&self.input, &options, self.field.as_deref())?;
        let of_bake = baked.is_some();
        let space = volume.map(|v| v.space).or_else(|| baked.as_ref().map(|b| b.space));
        baked.map_or(Ok(()), |b| b.whole()).map_err(|e| e.in_file(&self.input))?;
        // Alone, if the scene's volumes give each other no light.
        let scene = scene.lit(scene.number());
        self.integrator.check(&scene)?;
        let isovalue = unit_isovalue(&scene.field, self.isovalue).map_err(|e| other_sweep(e, of_bake))?;
        let default = ReferenceSettings::default();
        let settings = ReferenceSettings {
            integrator: self.integrator,
            samples: self.samples,
            batches: self.batches,
            photons: self.photons.unwrap_or(default.photons),
            map: SurfaceMapSettings {
                photons: self.photons_per_estimate.unwrap_or(default.map.photons),
                ..default.map
            },
            vertices: self.vertices,
            seed: self.seed,
        };
        let begun = Instant::now();
        let (mesh, result, inside) = self.compute(&scene, isovalue, &settings, progress)?;
        let seconds = begun.elapsed().as_secs_f64();
        result.write(&self.output, &mesh, space, Origin::comment(&scene, self.isovalue, &settings))?;
        let count = result.sampled.iter().filter(|s| **s).count();
        if self.json {
            let numbers = serde_json::json!({
                "file": self.output.to_string_lossy(),
                "isovalue": self.isovalue,
                "vertices": mesh.local.len(),
                "sampled": count,
                "rays": result.rays,
                "inside_starts": inside,
                "seconds": seconds,
            });
            println!("{numbers:#}");
        } else if progress.is_shown() {
            say!(
                "{}: {count} of {} vertices in {seconds:.2} s ({:.0} vertices/s, {:.2} M rays/s), {inside} rays began inside",
                self.output.display(),
                mesh.local.len(),
                count as f64 / seconds,
                result.rays as f64 / seconds / 1e6
            );
        }
        Ok(())
    }

    /// Mesh and reference of one isosurface, and the rays that departed below its triangles.
    fn compute(
        &self,
        scene: &Scene,
        isovalue: f32,
        settings: &ReferenceSettings,
        progress: Progress,
    ) -> Result<(SurfaceMesh, Reference, u64)> {
        let device = device()?;
        let mesh = SurfaceMesh::extract(scene, isovalue, self.refine)?;
        let vertices = settings.vertices.unwrap_or(usize::MAX).min(mesh.local.len());
        let stage = progress.stage("reference", vertices as u64 * u64::from(settings.batches.max(2)));
        let tick = |n| stage.tick(n);
        let (result, inside) = if self.trilinear {
            let tracer = GraphTracer::new(&device, scene)?;
            (reference(scene, &tracer, &mesh, isovalue, settings, &tick)?, 0)
        } else {
            let tracer = SurfaceTracer::new(&device, scene, isovalue, self.refine)?;
            let result = reference(scene, &tracer, &mesh, isovalue, settings, &tick)?;
            let inside = tracer.inside_starts();
            (result, inside)
        };
        stage.end()?;
        Ok((mesh, result, inside))
    }
}

/// `error` of an isovalue outside the sweep, which may be another unless a bake holds it.
fn other_sweep(error: Error, of_bake: bool) -> Error {
    if of_bake { error } else { Error::Invalid(format!("{error}, or give a sweep that holds it with --isovalues")) }
}

/// A path-traced picture of the level set of `isovalue` (source units): of its triangles, or of the trilinear surface.
pub(super) fn picture(
    scene: &Scene,
    isovalue: f64,
    camera: &Camera,
    trilinear: bool,
    device: &Device,
    progress: Progress,
) -> Result<Picture> {
    let isovalue = unit_isovalue(&scene.field, isovalue)?;
    if trilinear {
        path_picture(scene, &GraphTracer::new(device, scene)?, isovalue, camera, progress)
    } else {
        path_picture(scene, &SurfaceTracer::new(device, scene, isovalue, 1)?, isovalue, camera, progress)
    }
}
