//! `isolume compare`: a bake against one or two references of an isosurface, or all of its isosurfaces against paths.

use super::final_gather::{FinalGatherOptions, light};
use super::{check_exposure, device, expect_extension, outputs};
use crate::accuracy::{Accuracy, ReferenceMesh, Shown, Survey, SurveySettings, belongs, compare, survey};
use crate::digits::brief_span;
use crate::embree::GraphTracer;
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::export::{Mesh, ply};
use crate::final_gather::{FinalGather, FinalGatherSettings};
use crate::illumination_grid::GridSize;
use crate::progress::{Progress, say};
use crate::reference::{self, Origin};
use crate::scene_file::Inputs;
use crate::volume::Space;
use glam::DVec3;
use std::path::PathBuf;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Without references, all isosurfaces of the sweep are looked at: as many random points for each isovalue, over each isosurface
evenly by area, against two independent sets of paths, whose noise cancels but where colours reach white, which few paths make
darker; and points of the grid, which interpolation has no part in. If those are much better, a finer --grid helps; if not,
more directions, light points, photons or rays do.

Colours are linear radiance × π / (largest albedo × E0), clamped to [0, 1]; percent_rms = 100 sqrt(mean |difference|²) over the
reference's vertices, the squared Euclidean norm over three channels (BB09's printed formula leaves the square out).
A reference that is of no isosurface of the bake's volume and sweep is refused; one of another material or box is warned of.
One reference adds its own noise to the result (noise_floor); two of different seeds do not. Vertices of an isosurface stand
on edges of the lattice, where interpolation errs least: references with --refine 3 or more say what its area shows.

Examples:
  isolume compare out.vti
  isolume compare out.vti --gather-rays 64             what render and extract show with that
  isolume compare out.vti ref.ply --json
  isolume compare out.vti ref1.ply ref2.ply -o error.ply")]
pub(super) struct Compare {
    /// A bake (.vti; without references also .vtm)
    bake: PathBuf,
    /// One or two references of the same isosurface (.ply)
    #[arg(num_args = 1..=2, value_name = "REF")]
    references: Vec<PathBuf>,
    /// Without references: points on isosurfaces
    #[arg(long, value_name = "N", default_value_t = SurveySettings::default().points, conflicts_with = "references")]
    points: usize,
    /// Without references: paths of each of a point's two estimates
    #[arg(long, value_name = "N", default_value_t = SurveySettings::default().paths, conflicts_with = "references")]
    paths: u32,
    /// Without references: seed of points and paths
    #[arg(long, default_value_t = SurveySettings::default().seed, conflicts_with = "references")]
    seed: u64,
    /// Without references, of several volumes: the one to look at, by its name (default: the first)
    #[arg(long, value_name = "NAME", conflicts_with = "references")]
    field: Option<String>,
    /// Brightness: multiplies the bake's exposure; colours are compared as displayed, 0 to 1
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    exposure: f64,
    #[command(flatten)]
    rays: FinalGatherOptions,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// With references: write the mesh coloured by the error, the references' noise included: `error` per vertex, and
    /// colours from black (0) over red to white (10 %)
    #[arg(short, long, value_name = "FILE", requires = "references")]
    output: Option<PathBuf>,
}

impl Compare {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let rays = self.rays.settings()?;
        check_exposure(self.exposure)?;
        if self.references.is_empty() {
            return self.everywhere(rays, progress);
        }
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
        let exact = baked.holds_samples();
        let origins: Vec<Origin> = files.iter().map(|file| Origin::from_comments(&file.comments)).collect();
        for ((reference, origin), path) in references.iter().zip(&origins).zip(&self.references) {
            belongs(&reference.positions, origin.isovalue, &baked.scene.field, exact).map_err(|e| e.in_file(path))?;
            if origin.of_bake {
                say!(
                    "warning: {}: holds the light of a bake (isolume extract), not of a reference; it is taken for exact",
                    path.display()
                );
            }
            let another = |c| origin.light.as_ref().is_some_and(|known| *known != reference::light(&baked.scene, c));
            if origin.isovalue.is_some_and(another) {
                say!(
                    "warning: {}: was made of another material or box than {}; the difference counts as error",
                    path.display(),
                    self.bake.display()
                );
            }
        }
        if let [a, b] = &origins[..]
            && let Some(seed) = a.seed.filter(|seed| b.seed == Some(*seed))
        {
            return Err(Error::Invalid(format!(
                "both references are of seed {seed}: they share random numbers, and their noise may not cancel; give one another --seed"
            )));
        }
        let first = &references[0];
        // Rays cost, and nobody looks at the others.
        let sampled = |v: &usize| references.iter().all(|r| r.sampled.get(*v) == Some(&true));
        let chosen: Vec<usize> = (0..first.positions.len()).filter(sampled).collect();
        let positions: Vec<DVec3> = chosen.iter().map(|&v| first.positions[v]).collect();
        let found = light(&baked, rays, &positions, progress).map_err(|e| e.in_file(&self.bake))?;
        let mut colours = vec![DVec3::ZERO; first.positions.len()];
        chosen.into_iter().zip(found.radiance).for_each(|(v, light)| colours[v] = light);
        let (accuracy, errors) = compare(&colours, &references, baked.exposure * self.exposure)?;
        warn_of_clamped(accuracy.clamped, "vertices");
        if self.json {
            println!("{}", serde_json::to_string_pretty(&accuracy).expect("the numbers are plain data"));
        } else {
            print!("{}", text(&accuracy));
        }
        if let Some(output) = &self.output {
            write_errors(output, &references[0], baked.space, &errors)?;
            if progress.is_shown() {
                say!("{}: error-coloured mesh", output.display());
            }
        }
        Ok(())
    }

    /// All isosurfaces of the bake against paths.
    fn everywhere(&self, rays: Option<FinalGatherSettings>, progress: Progress) -> Result<()> {
        if !(1..=1 << 20).contains(&self.points) || !(1..=1 << 20).contains(&self.paths) {
            return Err(Error::Invalid("--points, --paths: 1 to 1048576".into()));
        }
        let in_file = |e: Error| e.in_file(&self.bake);
        let baked = BakedVolume::read(&self.bake)?;
        let baked = match &self.field {
            Some(name) => baked.select(name).map_err(in_file)?,
            None => baked,
        };
        baked.whole().map_err(in_file)?;
        rays.map_or(Ok(()), |rays| rays.check(&baked)).map_err(in_file)?;
        let own = baked.source().map_err(in_file)?;
        if own.is_none() {
            say!(
                "warning: {}: its grid is not a whole number of times as fine as the volume, which it does not hold; paths see \
                 normals of the grid, not of the volume",
                self.bake.display()
            );
        }
        let scene = own.unwrap_or_else(|| baked.scene.lit(baked.scene.number()));
        let side = scene.surface.outside;
        let Some(grid) = baked.grid(side) else {
            return Err(Error::invalid(&self.bake, "does not hold the surface's outside"));
        };
        let settings = SurveySettings { points: self.points, paths: self.paths, seed: self.seed };
        let device = device()?;
        let tracer = GraphTracer::new(&device, &scene)?;
        // On the grid's lattice, which may be finer.
        let within = rays.map(|_| GraphTracer::new(&device, &baked.scene)).transpose()?;
        let gather = rays.zip(within.as_ref()).map(|(rays, tracer)| FinalGather::new(&baked, tracer, rays));
        let gather = gather.transpose().map_err(in_file)?;
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let radiance = |p: DVec3, index| {
            let isovalue = || baked.scene.field.value(p) as f32;
            let light = gather
                .as_ref()
                .map_or_else(|| baked.radiance(side, p), |g| Some(g.outside(p, isovalue(), index)?.mean));
            light.expect("the outside is stored")
        };
        let stage = progress.stage("paths", 2 * self.points as u64);
        let exposure = baked.exposure * self.exposure;
        let shown = Shown { grid, lattice: baked.lattice(), radiance: &radiance, exposure };
        let found = survey(&scene, &tracer, shown, &settings, &|n| stage.tick(n));
        stage.end()?;
        let found = found.map_err(in_file)?;
        warn_of_clamped(found.clamped, "points");
        if self.json {
            println!("{}", serde_json::to_string_pretty(&found).expect("the numbers are plain data"));
        } else {
            // Along long voxels first.
            let long = baked.lattice() == scene.lattice() && GridSize::Cubic.of(baked.lattice()) != GridSize::OWN;
            let finer = if long { "--grid cubic" } else { "a finer --grid" };
            // Scattered samples cannot be split.
            let nodes = baked.report.pointer("/settings/strategy").is_some_and(|s| s == "nodes");
            let advice = rays.is_none().then_some((finer, grid.split.is_none() && nodes));
            print!("{}", everywhere(&found, advice));
        }
        Ok(())
    }
}

/// Says that much of what was compared shows no error, as of surfaces that shine more than is displayed.
fn warn_of_clamped(share: f64, of: &str) {
    // Beside lamps some always are.
    if share > 0.25 {
        say!(
            "warning: {:.0} % of the {of} are too bright to be displayed, by the bake and by what it is compared with: their \
             error counts as 0; --exposure 0.1 shows it, say",
            100.0 * share
        );
    }
}

/// A percentage from which the noise of what it is compared with has been taken off.
fn found(percent: f64) -> String {
    if percent > 0.0 { format!("{percent:8.3}") } else { format!("{:>8}", "< noise") }
}

/// A survey's numbers, a line each; and, with what is `finer` and whether the bake can be split, how to lower what
/// interpolation costs.
fn everywhere(s: &Survey, advice: Option<(&str, bool)>) -> String {
    let interval = |[lo, hi]: [f64; 2]| format!("(95 % confidence {lo:.3} … {hi:.3})");
    let parts: String = s
        .parts
        .iter()
        .filter(|p| p.points > 0)
        .map(|p| {
            let span = brief_span(p.isovalues);
            format!("  isovalues        {}   ({span}; {} points)\n", found(p.percent_rms), p.points)
        })
        .collect();
    let at_points = match s.percent_rms_grid_points.zip(s.confidence_grid_points) {
        Some((percent, confidence)) => format!("{}   {}", found(percent), interval(confidence)),
        None => format!("{:>8}   (none holds light of its own level set)", "–"),
    };
    let texture = match s.percent_rms_texture == s.percent_rms {
        true => String::new(),
        false => {
            let alone = found(s.percent_rms_texture);
            format!("  radiance alone   {alone}   (as a 3D texture, direct light included)\n")
        }
    };
    let between = s.percent_rms_grid_points.is_some_and(|at| 2.0 * at.powi(2) < s.percent_rms.powi(2));
    let advice = advice.filter(|_| between).map_or_else(String::new, |(finer, can_split)| {
        let splitting = if can_split { ", and --split in pictures, meshes and pages" } else { "" };
        format!(
            "most of it lies between grid points: {finer} lowers it{splitting}; render and extract end it by \
             --gather-rays 64\n"
        )
    });
    format!(
        "percent RMS       {}   {}\n{texture}  per channel, /√3 {}\n{parts}at grid points    {at_points}\n\
         bias              {:+8.3}\npoints            {:8}   (2 × {} paths each; {} left out{})\n{advice}",
        found(s.percent_rms),
        interval(s.confidence),
        found(s.percent_rms_sqrt3),
        s.bias,
        s.points,
        s.paths,
        s.left_out,
        few(s.points).map_or_else(String::new, |few| format!("; {few}"))
    )
}

/// The numbers, a line each.
fn text(a: &Accuracy) -> String {
    let [lo, hi] = a.confidence;
    let noise = if a.references == 2 { "cancelled by two references" } else { "included" };
    // Of references without noise, such as those of black surfaces, 0 is an answer.
    let shown = |percent: f64| if a.noise_floor > 0.0 { found(percent) } else { format!("{percent:8.3}") };
    format!(
        "percent RMS       {}   (95 % confidence {lo:.3} … {hi:.3}; reference noise {noise})\n\
         without noise     {}\n  per channel, /√3 {}\n  area-weighted    {}\n  lit vertices     {}   ({:.1} % of vertices)\n\
         noise floor       {:8.3}\nmean              {:8.3}   (reference noise included)\nmax               {:8.3}   (the same)\n\
         bias              {:+8.3}\nvertices          {:8}{}\nexposure          {:8.4}\n",
        shown(a.percent_rms),
        shown(a.percent_rms_without_noise),
        shown(a.percent_rms_sqrt3),
        shown(a.percent_rms_area),
        if a.lit > 0.0 { shown(a.percent_rms_lit) } else { format!("{:>8}", "–") },
        100.0 * a.lit,
        a.noise_floor,
        a.mean,
        a.max,
        a.bias,
        a.vertices,
        few(a.vertices).map_or_else(String::new, |few| format!("   ({few})")),
        a.exposure
    )
}

/// What is to be said of an interval from so few points: their squares are skewed, and of 200 of them the 95 % interval
/// holds the error in 83 % of all cases, of 40 in 63 %.
fn few(points: usize) -> Option<&'static str> {
    (points < 1000).then_some("too few for such an interval: it is wider")
}

#[allow(clippy::cast_possible_truncation, reason = "files hold f32")]
fn write_errors(path: &std::path::Path, mesh: &ReferenceMesh, space: Space, errors: &[f64]) -> Result<()> {
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
        colours: Some(&colours),
        properties: &properties,
        space: Some(space),
        ..Mesh::default()
    };
    ply::write(path, &mesh)
}
