//! `isolume study`: the tables and plots of the documentation.

use super::device;
use crate::bake::BakeOptions;
use crate::error::{Error, Result};
use crate::progress::Progress;
use crate::scene_file::{SceneOptions, load};
use crate::study::{Study, Subject, curve, datasets, strategies};
use std::path::{Path, PathBuf};

/// What to study.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Kind {
    /// BB09's table: sampling strategies over the sweep.
    Strategies,
    /// Error, floor and seconds of each data set.
    Datasets,
    /// Error against wall seconds over photons, samples and gather rays.
    Curve,
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Writes CSV, Markdown and SVG into DIR; rows that are there are kept, so that an interrupted study goes on where it
stopped. References are cached in DIR/references.

Examples:
  isolume study strategies scenes/cornell-bumps.toml -o results
  isolume study datasets scenes/cornell-bumps.toml --data data -o results")]
pub(super) struct StudyArgs {
    /// What to study
    kind: Kind,
    /// Scene files or volumes
    #[arg(required_unless_present = "data", value_name = "SCENE")]
    scenes: Vec<PathBuf>,
    /// Folder for tables, plots and references
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Folder with ch2.nii.gz and neuron.mha: adds those that are there
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Small counts and few isovalues, to see that everything works
    #[arg(long)]
    quick: bool,
    #[command(flatten)]
    bake: BakeOptions,
}

/// Data sets of BB09's kinds by file name, with sweep and main isovalue.
const DATA: [(&str, &str, [f64; 2], f64); 2] =
    [("brain", "ch2.nii.gz", [15.0, 200.0], 80.0), ("neuron", "neuron.mha", [20.0, 200.0], 60.0)];

impl StudyArgs {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let mut subjects = Vec::new();
        for path in &self.scenes {
            let loaded = load(path, &SceneOptions::default())?;
            subjects.push(Subject { name: stem(path), scene: loaded.scene, isovalue: None });
        }
        if let Some(folder) = &self.data {
            for (name, file, isovalues, main) in DATA {
                let path = folder.join(file);
                if path.exists() {
                    let options = SceneOptions { isovalues: Some(isovalues.to_vec()), ..SceneOptions::default() };
                    let scene = load(&path, &options)?.scene;
                    subjects.push(Subject { name: name.into(), scene, isovalue: Some(main) });
                }
            }
        }
        if subjects.is_empty() {
            return Err(Error::Invalid("--data: the folder holds neither ch2.nii.gz nor neuron.mha".into()));
        }
        let study = Study::new(self.output, device()?, progress, self.quick)?;
        match self.kind {
            Kind::Strategies => strategies(&study, &subjects, &self.bake),
            Kind::Datasets => datasets(&study, &subjects, &self.bake),
            Kind::Curve => curve(&study, &subjects, &self.bake),
        }
    }
}

fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(|| "scene".into(), |s| s.to_string_lossy().into_owned())
}
