//! `isolume study`: measurements that fill tables, one subcommand each.

use crate::bake::BakeOptions;
use crate::error::{Error, Result};
use crate::flatland::study::{StudySettings, flatland};
use crate::progress::{Progress, say};
use crate::scene_file::{SceneOptions, load, load_series};
use crate::study::{self, Subject};
use std::path::{Path, PathBuf};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  isolume study flatland -o results
  isolume study strategies scenes/cornell-bumps.toml -o results --quick
  isolume study curve scenes/cornell-bumps.toml -o results --limit 60")]
pub(super) struct Study {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Debug)]
enum What {
    /// n = 2: samples on level sets against uniform ones, from 10³ to 10⁶ (BB09's 7.4 % and 2.2 %)
    Flatland(Flatland),
    /// BB09's table: sampling strategies at 10⁶ and 10⁷ samples over the sweep
    Strategies(SceneStudy),
    /// Error, interpolation floor and seconds of each data set
    Datasets(SceneStudy),
    /// Error against wall seconds over directions, luminaire points, photons, samples and gather rays
    Curve(Curve),
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  isolume study flatland -o results
  isolume study flatland -o results --most 100000        a minute instead of many")]
struct Flatland {
    /// Folder for study.csv, study.md, study.svg and figure5.png; made if it does not exist
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// The largest number of samples, of 1000, 3000, 10000, 20000, 100000 and 1000000
    #[arg(long, default_value_t = 1_000_000, value_name = "N")]
    most: u64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Writes CSV, Markdown and SVG into DIR; rows that are there are kept, so that an interrupted study goes on where it
stopped. They must be of the same scene and settings: others need a folder of their own. References are cached in
DIR/references. Options that a study gives values of its own are refused, and a scene's [bake] is left aside. Of several
volumes the first is measured.

Examples:
  isolume study strategies scenes/cornell-bumps.toml -o results
  isolume study datasets scenes/cornell-bumps.toml --data data -o results")]
struct SceneStudy {
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

#[derive(clap::Args, Debug)]
struct Curve {
    /// Leave out ways that are estimated to take longer for one bake
    #[arg(long, value_name = "SECONDS")]
    limit: Option<f64>,
    #[command(flatten)]
    study: SceneStudy,
}

/// Data sets of BB09's kinds by file name, with sweep and main isovalue.
const DATA: [(&str, &str, [f64; 2], f64); 2] =
    [("brain", "ch2.nii.gz", [15.0, 200.0], 80.0), ("neuron", "neuron.mha", [20.0, 200.0], 60.0)];

impl Study {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        match self.what {
            What::Strategies(v) => v.run(study::strategies, progress),
            What::Datasets(v) => v.run(study::datasets, progress),
            What::Curve(Curve { limit: Some(limit), .. }) if !(limit >= 0.0) => {
                Err(Error::Invalid(format!("--limit {limit}: must be 0 seconds or more")))
            }
            What::Curve(v) => v.study.run(|s, subjects, base| study::curve(s, subjects, base, v.limit), progress),
            What::Flatland(v) => {
                let settings = StudySettings { most: v.most, seed: v.seed, ..StudySettings::default() };
                settings.check()?;
                super::folder(&v.output)?;
                flatland(&v.output, &super::device()?, &settings, progress)
            }
        }
    }
}

impl SceneStudy {
    /// Loads the scenes and runs `table` on them.
    fn run(
        &self,
        table: impl Fn(&study::Study, &[Subject], &BakeOptions) -> Result<()>,
        progress: Progress,
    ) -> Result<()> {
        let mut subjects = Vec::new();
        for path in &self.scenes {
            if load_series(path, &SceneOptions::default())?.is_some() {
                return Err(Error::not_supported(
                    path,
                    "is a series: studies take single volumes; name one of its files",
                ));
            }
            let loaded = load(path, &SceneOptions::default())?;
            let set = loaded.bake.set();
            if !set.is_empty() {
                say!(
                    "warning: {}: its [bake] is left aside ({}); give what a study may be told as flags",
                    path.display(),
                    set.join(", ")
                );
            }
            // Of several volumes the first, alone if they give each other no light.
            let scene = loaded.scene.lit(loaded.scene.number());
            subjects.push(Subject { name: stem(path), scene, isovalue: None });
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
        let study = study::Study::new(self.output.clone(), super::device()?, progress, self.quick)?;
        table(&study, &subjects, &self.bake)
    }
}

fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(|| "scene".into(), |s| s.to_string_lossy().into_owned())
}
