//! `isolume compare`: a bake against one or two references of an isosurface.

use super::{expect_extension, outputs};
use crate::accuracy::{Accuracy, ReferenceMesh, belongs, compare};
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::export::{Mesh, ply};
use crate::progress::{Progress, say};
use crate::reference::{Origin, light};
use crate::scene_file::Inputs;
use crate::surface_mesh::texture;
use std::path::PathBuf;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Colours are linear radiance × π / (largest albedo × E0), clamped to [0, 1]; percent_rms = 100 sqrt(mean |difference|²) over the
reference's vertices, the squared Euclidean norm over three channels (BB09's printed formula leaves the square out).
A reference that is of no isosurface of the bake's volume and sweep is refused; one of another material or box is warned of.
One reference adds its own noise to the result (noise_floor); two of different seeds do not.

Examples:
  isolume compare out.vti ref.ply --json
  isolume compare out.vti ref1.ply ref2.ply -o error.ply")]
pub(super) struct Compare {
    /// A bake (.vti)
    bake: PathBuf,
    /// One or two references of the same isosurface (.ply)
    #[arg(required = true, num_args = 1..=2, value_name = "REF")]
    references: Vec<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Write the mesh coloured by the error: `error` per vertex, and colours from black (0) over red to white (10 %)
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

impl Compare {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        if let Some(output) = &self.output {
            expect_extension(output, &["ply"])?;
            outputs([&**output], &Inputs::files(self.references.iter().chain([&self.bake]).map(PathBuf::as_path)))?;
        }
        let files = self.references.iter().map(ply::read).collect::<Result<Vec<_>>>()?;
        let read = files.iter().zip(&self.references);
        let references = read
            .map(|(file, path)| ReferenceMesh::from_ply(file).map_err(|e| e.in_file(path)))
            .collect::<Result<Vec<_>>>()?;
        let baked = BakedVolume::read(&self.bake)?;
        if baked.scene.fields() > 1 {
            return Err(Error::not_supported(&self.bake, "holds several volumes; name the .vti of one of them"));
        }
        for ((reference, file), path) in references.iter().zip(&files).zip(&self.references) {
            let origin = Origin::from_comments(&file.comments);
            belongs(&reference.positions, origin.isovalue, &baked.scene.field).map_err(|e| e.in_file(path))?;
            let another = |c| origin.light.is_some_and(|known| known != light(&baked.scene, c));
            if origin.isovalue.is_some_and(another) {
                say!(
                    "warning: {}: was made of another material or box than {}; the difference counts as error",
                    path.display(),
                    self.bake.display()
                );
            }
        }
        let colours = texture(&baked, &references[0].positions).map_err(|e| e.in_file(&self.bake))?;
        let (accuracy, errors) = compare(&colours, &references, baked.exposure)?;
        if self.json {
            println!("{}", serde_json::to_string_pretty(&accuracy).expect("the numbers are plain data"));
        } else {
            print!("{}", text(&accuracy));
        }
        if let Some(output) = &self.output {
            write_errors(output, &references[0], &errors)?;
            if progress == Progress::Shown {
                say!("{}: error-coloured mesh", output.display());
            }
        }
        Ok(())
    }
}

/// The numbers, a line each.
fn text(a: &Accuracy) -> String {
    let [lo, hi] = a.confidence;
    let noise = if a.references == 2 { "cancelled by two references" } else { "included" };
    format!(
        "percent RMS       {:8.3}   (95 % confidence {lo:.3} … {hi:.3}; reference noise {noise})\n\
         without noise     {:8.3}\n  per channel, /√3 {:8.3}\n  area-weighted    {:8.3}\n  lit vertices     {:8.3}   ({:.1} % of vertices)\n\
         noise floor       {:8.3}\nmean              {:8.3}\nmax               {:8.3}\nbias              {:+8.3}\n\
         vertices          {:8}\nexposure          {:8.4}\n",
        a.percent_rms,
        a.percent_rms_without_noise,
        a.percent_rms_sqrt3,
        a.percent_rms_area,
        a.percent_rms_lit,
        100.0 * a.lit,
        a.noise_floor,
        a.mean,
        a.max,
        a.bias,
        a.vertices,
        a.exposure
    )
}

#[allow(clippy::cast_possible_truncation, reason = "files hold f32")]
fn write_errors(path: &std::path::Path, mesh: &ReferenceMesh, errors: &[f64]) -> Result<()> {
    let values: Vec<f32> = errors.iter().map(|&e| e as f32).collect();
    // Black, red, yellow, white at 0, ⅓, ⅔ and 1 of 10 %; unsampled vertices grey.
    let ramp = |e: f64, k: f64| (30.0 * e - k).clamp(0.0, 1.0) as f32;
    let colours: Vec<[f32; 3]> = errors
        .iter()
        .zip(&mesh.sampled)
        .map(|(&e, &s)| if s { [ramp(e, 0.0), ramp(e, 1.0), ramp(e, 2.0)] } else { [0.375; 3] })
        .collect();
    let properties = [("error", &values[..])];
    let mesh = Mesh {
        positions: &mesh.positions,
        triangles: &mesh.triangles,
        normals: None,
        colours: Some(&colours),
        properties: &properties,
    };
    ply::write(path, &mesh)
}
