//! Studies: tables and plots of error and speed, resumable row by row. References are cached beside the tables.

mod curve;
mod datasets;
mod figure6;
mod strategies;
mod table;

pub use curve::curve;
pub use datasets::datasets;
pub use strategies::strategies;
use table::Table;

use crate::accuracy::{Accuracy, ReferenceMesh, compare};
use crate::bake::{Bake, BakeOptions, BakeSettings, Engine, bake, digest, scene_job, settings_job};
use crate::embree::{Device, SurfaceTracer};
use crate::error::{Error, Result};
use crate::export::ply;
use crate::progress::{Clock, Progress, say};
use crate::reference::{Origin, ReferenceSettings, VERSION, reference};
use crate::scene::Scene;
use crate::surface_mesh::SurfaceMesh;
use crate::volume::generate::bumps;
use glam::DVec3;
use rayon::prelude::*;
use std::path::PathBuf;

/// A named scene.
#[derive(Debug)]
pub struct Subject {
    /// Name in tables and file names.
    pub name: String,
    /// The scene.
    pub scene: Scene,
    /// The isovalue reported first (source units); the sweep's part that is 47.0 of [3.6, 95] if `None`.
    pub isovalue: Option<f64>,
}

impl Subject {
    /// Source isovalue at a fraction of the sweep.
    pub fn at(&self, fraction: f64) -> f64 {
        self.scene.field.sweep().from_unit(fraction)
    }

    /// Those of some isovalues (source units, increasing) where a bake can be compared with references: there is a
    /// surface.
    ///
    /// # Errors
    /// `Invalid` if there is none, since no error is known then.
    fn with_surfaces(&self, isovalues: &[f64]) -> Result<Vec<f64>> {
        let sweep = self.scene.field.sweep();
        let there = |c: &f64| SurfaceMesh::extract(&self.scene, sweep.isovalue(*c), 1).is_ok();
        let there: Vec<f64> = isovalues.iter().copied().filter(there).collect();
        if let ([], [first, .., last] | [first @ last]) = (&there[..], isovalues) {
            return Err(Error::Invalid(format!(
                "'{}' has no surface at any isovalue at which bakes are compared ({} from {first:.4} to {last:.4}); narrow its \
                 isovalues to where it has surfaces",
                self.name,
                isovalues.len(),
            )));
        }
        Ok(there)
    }

    /// The isovalue reported first.
    pub fn main_isovalue(&self) -> f64 {
        self.isovalue.unwrap_or_else(|| self.at(bumps::fraction(bumps::TABLE[1])))
    }
}

/// How good a reference is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// 4000 vertices of 1024 paths: for the numbers of a table.
    Table,
    /// 1500 vertices of 512 paths: for a point of a curve.
    Curve,
}

/// What all studies share.
#[derive(Debug)]
pub struct Study<'a> {
    /// Where tables, plots and cached references go.
    pub folder: PathBuf,
    /// Embree.
    pub device: Device,
    /// Where progress goes.
    pub progress: Progress<'a>,
    /// Small counts and few isovalues, to see that everything works.
    pub quick: bool,
}

impl<'a> Study<'a> {
    /// Makes the folder.
    ///
    /// # Errors
    /// `Io`.
    pub fn new(folder: PathBuf, device: Device, progress: Progress<'a>, quick: bool) -> Result<Self> {
        let references = folder.join("references");
        std::fs::create_dir_all(&references).map_err(|e| Error::io(&references, e))?;
        Ok(Self { folder, device, progress, quick })
    }

    fn say(&self, text: &str) {
        if self.progress.is_shown() {
            say!("{text}");
        }
    }

    /// What determines the rows of each subject besides their keys, as tables' last columns have it: a digest of its
    /// scene, of what `base` sets for bakes by either engine, and of `quick`; and [`provenance`]. Rows of `table` that
    /// bear a subject's name must be of its digest, and all of this program and machine.
    ///
    /// # Errors
    /// `Invalid` if some are not, if two scenes that differ have one name, if neither engine takes what `base` sets, or
    /// if that is one of the options that the study `varies` itself.
    fn jobs(
        &self,
        table: &Table,
        subjects: &[Subject],
        base: &BakeOptions,
        varies: &[impl AsRef<str>],
    ) -> Result<Vec<[String; 2]>> {
        if let Some(option) = base.set().iter().find(|o| varies.iter().any(|v| v.as_ref() == *o)) {
            return Err(Error::Invalid(format!("--{option}: this study gives it values of its own; leave it out")));
        }
        let settings = [Engine::Photon, Engine::Sweep].map(|engine| BakeSettings::with_engine(base, engine));
        let settings = match settings {
            [Err(e), Err(_)] => return Err(e),
            // An engine that cannot do what is asked for leaves no rows.
            each => each.map(|s| s.map_or_else(|e| e.to_string(), |s| settings_job(&s))),
        };
        let job = |s: &Subject| digest(&format!("{}{}quick: {}", scene_job(&s.scene), settings.concat(), self.quick));
        let jobs: Vec<String> = subjects.iter().map(job).collect();
        for (n, (subject, job)) in subjects.iter().zip(&jobs).enumerate() {
            if subjects[..n].iter().zip(&jobs).any(|(s, j)| s.name == subject.name && j != job) {
                return Err(Error::Invalid(format!(
                    "two of the scenes are named '{}' and differ, which tables do not tell apart; study each in a folder of \
                     its own, or rename its file",
                    subject.name
                )));
            }
            table.expect(&subject.name, job)?;
        }
        let program = provenance(self);
        table.expect_program(&program)?;
        Ok(jobs.into_iter().map(|job| [job, program.clone()]).collect())
    }

    /// Two independent references on a fixed subset of the vertices of the isosurface at `isovalue` (source units),
    /// from the cache or computed. The cache tells them apart by scene, settings and isovalue.
    ///
    /// # Errors
    /// `Invalid` if there is no surface; as `reference()`, or from reading the cache.
    pub fn references(&self, subject: &Subject, isovalue: f64, effort: Effort) -> Result<Vec<ReferenceMesh>> {
        let (vertices, samples) = match effort {
            _ if self.quick => (500, 128),
            Effort::Table => (4000, 1024),
            Effort::Curve => (1500, 512),
        };
        let scene = &subject.scene;
        let c = scene.field.sweep().isovalue(isovalue);
        let mesh = SurfaceMesh::extract(scene, c, 1)?;
        let mut out = Vec::new();
        let (job, at) = (scene_job(scene), isovalue);
        for seed in [101, 202] {
            let settings =
                ReferenceSettings { samples, vertices: Some(vertices), seed, ..ReferenceSettings::default() };
            let isovalue = exactly(isovalue);
            let digest = digest(&format!("{job}{settings:?} at {isovalue}, version {VERSION}"));
            let name = format!("{}-{isovalue}-{vertices}x{samples}-{seed}-{digest}.ply", subject.name);
            let path = self.folder.join("references").join(name);
            if !path.exists() {
                let tracer = SurfaceTracer::new(&self.device, scene, c, 1)?;
                let count = vertices.min(mesh.local.len()) as u64 * u64::from(settings.batches);
                let stage = self.progress.stage(&format!("reference {isovalue}"), count);
                let result = reference(scene, &tracer, &mesh, c, &settings, &|n| stage.tick(n))?;
                stage.end()?;
                result.write(&path, &mesh, None, Origin::comment(scene, at, &settings))?;
            }
            let mesh = ReferenceMesh::from_ply(&ply::read(&path)?).map_err(|e| e.in_file(&path))?;
            out.push(mesh);
        }
        Ok(out)
    }

    /// A bake of `subject`, and the wall and processor seconds it took without loading and export.
    ///
    /// # Errors
    /// As [`bake`].
    pub fn bake(&self, subject: &Subject, settings: &BakeSettings) -> Result<(Bake, [f64; 2])> {
        let clock = Clock::start();
        let result = bake(&subject.scene, settings, &self.device, self.progress)?;
        Ok((result, clock.seconds()))
    }
}

/// An isovalue as tables and file names give it: with as many digits as no other number shares.
fn exactly(isovalue: f64) -> String {
    format!("{isovalue:?}")
}

/// The accuracy of a bake of `scene` in memory against references of one isosurface: of what the bake shows there, a
/// split one's direct light included.
///
/// # Errors
/// As [`compare`].
pub fn accuracy_of(scene: &Scene, bake: &Bake, references: &[ReferenceMesh]) -> Result<Accuracy> {
    let (side, grid) = &bake.sides[0];
    let shown = |&x: &DVec3| grid.radiance_at(scene, &bake.lattice, scene.lattice().to_index(x), *side);
    let texture: Vec<DVec3> = references[0].positions.par_iter().map(shown).collect();
    Ok(compare(&texture, references, bake.exposure)?.0)
}

/// What every table says about the machine and the program.
fn provenance(study: &Study) -> String {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpu
        .lines()
        .find_map(|l| l.strip_prefix("model name"))
        .map_or("unknown CPU", |l| l.trim_start_matches([' ', '\t', ':']));
    format!(
        "isolume {} ({}), Embree {}, {} threads, {}, {cpu}{}",
        env!("CARGO_PKG_VERSION"),
        env!("ISOLUME_COMMIT"),
        study.device.version(),
        rayon::current_num_threads(),
        crate::isa::Isa::current().name(),
        if study.quick { ", --quick" } else { "" }
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::Preset;
    use crate::export::bake_file::BakedVolume;
    use crate::field::Field;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::Samples;
    use crate::volume::generate::Generator;

    /// Bumps whose values are small: isovalues that four digits after the point do not tell apart.
    pub(super) fn subject(albedo: f64) -> Subject {
        let bumps = Generator::from_name("bumps").unwrap().sample([8; 3]).unwrap();
        let values = (0..bumps.lattice.len()).map(|o| 1e-6 * bumps.value(o) as f32).collect();
        let field = Field::made(bumps.lattice, Samples::F32(values), 3.6e-6, 95e-6);
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let surface = Surface { albedo: DVec3::splat(albedo).into(), ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, walls).unwrap();
        Subject { name: "s".into(), scene, isovalue: None }
    }

    #[test]
    fn split_bakes_are_measured_as_they_are_shown() {
        let dir = tempfile::tempdir().unwrap();
        let study = Study::new(dir.path().into(), Device::new(1).unwrap(), Progress::Quiet, true).unwrap();
        let subject = subject(0.5);
        let references = study.references(&subject, 47e-6, Effort::Table).unwrap();
        let options = BakeOptions {
            engine: Some(Engine::Sweep),
            preset: Some(Preset::Preview),
            split: Some(true),
            ..BakeOptions::default()
        };
        let settings = BakeSettings::new(&options, &subject.scene).unwrap();
        let bake = study.bake(&subject, &settings).unwrap().0;
        let found = accuracy_of(&subject.scene, &bake, &references).unwrap();
        let baked = BakedVolume::new(subject.scene.clone(), bake);
        let (side, grid) = &baked.sides[0];
        let of = |light: &dyn Fn(DVec3) -> DVec3| {
            let there = references[0].positions.iter().map(|&x| light(baked.lattice().to_index(x)));
            compare(&there.collect::<Vec<_>>(), &references, baked.exposure).unwrap().0.percent_rms
        };
        assert_eq!(found.percent_rms, of(&|p| baked.radiance(*side, p).unwrap()));
        assert_ne!(found.percent_rms, of(&|p| grid.interpolate(baked.lattice(), p)));
    }

    #[test]
    fn references_are_of_the_scene_and_the_isovalue_that_are_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let new = || Study::new(dir.path().into(), Device::new(1).unwrap(), Progress::Quiet, true).unwrap();
        let study = new();
        let of = |study: &Study, subject: &Subject, isovalue: f64| {
            study.references(subject, isovalue, Effort::Table).unwrap().swap_remove(0)
        };
        let (dark, bright) = (subject(0.1), subject(0.9));
        let at_47 = of(&study, &dark, 47e-6);
        assert!(of(&study, &dark, 46e-6).positions != at_47.positions, "another isovalue has another surface");
        let other = of(&study, &bright, 47e-6);
        assert!(
            other.positions == at_47.positions && other.radiance != at_47.radiance,
            "another scene has another light"
        );
        let files = || std::fs::read_dir(dir.path().join("references")).unwrap().count();
        assert_eq!(files(), 6);
        assert!(of(&new(), &dark, 47e-6).radiance == at_47.radiance);
        assert_eq!(files(), 6, "what is there is taken up");
    }
}
