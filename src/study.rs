//! Studies: tables and plots of error and speed, resumable row by row. References are cached beside the tables.

mod curve;
mod datasets;
mod figure6;
mod strategies;
mod table;

pub use curve::curve;
pub use datasets::datasets;
pub use strategies::strategies;
pub use table::Table;

use crate::accuracy::{Accuracy, ReferenceMesh, compare};
use crate::bake::{Bake, BakeSettings, bake};
use crate::embree::{Device, SurfaceTracer};
use crate::error::{Error, Result};
use crate::export::ply;
use crate::progress::{Progress, processor_seconds};
use crate::reference::{ReferenceSettings, reference};
use crate::scene::Scene;
use crate::surface_mesh::SurfaceMesh;
use glam::DVec3;
use rayon::prelude::*;
use std::path::PathBuf;
use std::time::Instant;

/// A named scene.
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

    /// The isovalue reported first.
    pub fn main_isovalue(&self) -> f64 {
        self.isovalue.unwrap_or_else(|| self.at((47.0 - 3.6) / 91.4))
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
pub struct Study {
    /// Where tables, plots and cached references go.
    pub folder: PathBuf,
    /// Embree.
    pub device: Device,
    /// Where progress goes.
    pub progress: Progress,
    /// Small counts and few isovalues, to see that everything works.
    pub quick: bool,
}

impl Study {
    /// Makes the folder.
    ///
    /// # Errors
    /// `Io`.
    pub fn new(folder: PathBuf, device: Device, progress: Progress, quick: bool) -> Result<Self> {
        let references = folder.join("references");
        std::fs::create_dir_all(&references).map_err(|e| Error::io(&references, e))?;
        Ok(Self { folder, device, progress, quick })
    }

    fn say(&self, text: &str) {
        if self.progress == Progress::Shown {
            eprintln!("{text}");
        }
    }

    /// Two independent references on a fixed subset of the vertices of the isosurface at `isovalue` (source units), from
    /// the cache or computed; `None` if there is no surface.
    ///
    /// # Errors
    /// As `reference()`, or from reading the cache.
    pub fn references(&self, subject: &Subject, isovalue: f64, effort: Effort) -> Result<Option<Vec<ReferenceMesh>>> {
        let (vertices, samples) = match effort {
            _ if self.quick => (500, 128),
            Effort::Table => (4000, 1024),
            Effort::Curve => (1500, 512),
        };
        let scene = &subject.scene;
        let c = scene.field.sweep().isovalue(isovalue);
        let Ok(mesh) = SurfaceMesh::extract(scene, c, 1) else { return Ok(None) };
        let mut out = Vec::new();
        for seed in [101, 202] {
            let name = format!("{}-{isovalue:.4}-{vertices}x{samples}-{seed}.ply", subject.name);
            let path = self.folder.join("references").join(name);
            if !path.exists() {
                let settings =
                    ReferenceSettings { samples, vertices: Some(vertices), seed, ..ReferenceSettings::default() };
                let tracer = SurfaceTracer::new(&self.device, scene, c, 1)?;
                let count = vertices.min(mesh.local.len()) as u64 * u64::from(settings.batches);
                let stage = self.progress.stage(&format!("reference {isovalue:.1}"), count);
                let result = reference(scene, &tracer, &mesh, c, &settings, &|n| stage.tick(n));
                stage.end()?;
                result.write(&path, &mesh)?;
            }
            let mesh = ReferenceMesh::from_ply(&ply::read(&path)?).map_err(|e| e.in_file(&path))?;
            out.push(mesh);
        }
        Ok(Some(out))
    }

    /// A bake of `subject`, and the wall and processor seconds it took without loading and export.
    ///
    /// # Errors
    /// As [`bake`].
    pub fn bake(&self, subject: &Subject, settings: &BakeSettings) -> Result<(Bake, [f64; 2])> {
        let (begun, worked) = (Instant::now(), processor_seconds());
        let result = bake(&subject.scene, settings, &self.device, self.progress)?;
        Ok((result, [begun.elapsed().as_secs_f64(), processor_seconds() - worked]))
    }
}

/// The accuracy of a bake in memory against references of one isosurface.
///
/// # Errors
/// As [`compare`].
pub fn accuracy_of(bake: &Bake, references: &[ReferenceMesh]) -> Result<Accuracy> {
    let grid = &bake.sides[0].1;
    let texture: Vec<DVec3> = references[0]
        .positions
        .par_iter()
        .map(|&x| grid.interpolate(&bake.lattice, bake.lattice.to_index(x)))
        .collect();
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
