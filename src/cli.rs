//! The command line: verbs, flags, and what they print. No physics here.

mod bake;
mod compare;
mod documentation;
mod export;
mod extract;
mod final_gather;
mod flatland;
mod generate;
mod init;
mod reference;
mod render;
mod selftest;
mod signals;
mod study;
mod view;

use crate::atomic;
use crate::embree::Device;
use crate::error::{Error, Result};
use crate::export::bake_file::BakeSummary;
use crate::files;
use crate::isa::Isa;
use crate::progress::{Progress, say, unless_interrupted};
use crate::scene_file::{self, Inputs, ReadOptions};
use crate::series::is_pattern;
use crate::volume::Volume;
use crate::volume::statistics::VolumeStatistics;
use crate::volume::vti::VtiFile;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Global illumination for every isosurface of a volume at once.
#[derive(Parser, Debug)]
#[command(
    version,
    about,
    max_term_width = 132,
    after_help = "\
Examples:
  isolume info head.nii.gz                               what a volume holds, and a suggested sweep
  isolume bake head.nii.gz --isovalues 15 200 -o head.vti   illuminate every isosurface from 15 to 200
  isolume render head.vti --isovalue 80 -o head.png      a picture of one of them
  isolume view head.vti -o head.html                     a web page with a slider over all of them
  isolume extract head.vti --isovalue 80 -o head.ply     the same as a mesh with its light
  isolume export head.vti --array rgb -o head.nrrd       the light as a volume for 3D Slicer; .npy for Python
  isolume generate bumps -o bumps.vti                    a volume to play with
  isolume init head.nii.gz -o head.toml                  a scene file to edit: material, box, quality

`isolume help VERB` shows the verb's flags and more examples.

Exit codes: 0 done, 1 failed, 2 wrong usage or input, 130 interrupted."
)]
pub struct Cli {
    /// Worker threads (default: all cores)
    #[arg(long, global = true, value_name = "N")]
    threads: Option<usize>,
    /// Instruction set of the vector kernels, at most (default: the widest that the machine has)
    #[arg(long, global = true, value_name = "SET", value_parser = clap::builder::PossibleValuesParser::new(Isa::NAMES))]
    isa: Option<String>,
    /// No progress and no summary, only warnings and errors
    #[arg(long, short, global = true)]
    quiet: bool,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand, Debug)]
#[allow(clippy::large_enum_variant, reason = "one value per process")]
enum Verb {
    /// Print what a volume holds: lattice, type, range, percentiles, histogram, a suggested sweep; how a bake was made
    Info(Info),
    /// Write a commented scene file for a volume, with a suggested sweep
    Init(init::Init),
    /// Make a volume from a formula, or simulate one
    Generate(generate::Generate),
    /// Illuminate every isosurface of a volume or scene and write one file that holds both
    Bake(bake::Bake),
    /// Draw an isosurface of a bake inside its box
    Render(render::Render),
    /// Make a web page of a bake: sweep the isovalue with a slider, turn it with the mouse
    View(view::View),
    /// Take one isosurface away as a mesh, with a bake's light on its vertices
    Extract(extract::Extract),
    /// Write one array of a bake, or a volume, in another format: .nrrd, .npy, .exr or .vti
    Export(export::Export),
    /// Illuminate one isosurface in ordinary 3D, per vertex with variance: what bakes are measured against
    Reference(reference::ReferenceArgs),
    /// Measure a bake against references
    Compare(compare::Compare),
    /// n = 2: pictures of light on a height field, in horizontal planes and as an ordinary surface
    Flatland(flatland::Flatland),
    /// Measure: tables and plots
    Study(study::Study),
    /// Run the hard cases on this machine and print one table
    Selftest(selftest::SelfTest),
    /// Print completions for a shell
    Completions(documentation::Completions),
    /// Write manual pages, one per verb
    Man(documentation::ManualPages),
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The suggested sweep leaves out background and noise; it is what `bake` takes if it is told nothing else.

Examples:
  isolume info head.nii.gz
  isolume info head.nii.gz --json                        the same for scripts
  isolume info lit.vti                                   a bake: also its isovalues and settings
  isolume info scan.raw --raw-dims 305,224,14 --raw-type u8")]
struct Info {
    /// Volume: NIfTI, NRRD, MetaImage, MRC/CCP4, cube, VTK (bakes, too), NumPy, TIFF stack, or a headerless file with
    /// --raw-dims
    file: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    read: ReadOptions,
}

/// More are of no use to any machine, and take long to start.
const MOST_THREADS: usize = 1024;

/// The arguments as clap knows them: `-.5` as `-0.5`, and the two numbers of `--isovalues` apart, which other lists
/// have commas between.
fn spelt_out(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let is_number = |text: &str| text.parse::<f64>().is_ok();
    let mut all: Vec<OsString> = Vec::new();
    const SWEEP: &str = "--isovalues";
    for argument in arguments {
        let text = argument.to_str().unwrap_or_default();
        let joined = text.strip_prefix(SWEEP).and_then(|rest| rest.strip_prefix('='));
        let apart = all.last().is_some_and(|before| before == SWEEP).then_some(text);
        let numbers = joined.or(apart).and_then(|text| text.split_once(',')).map(|(lo, hi)| (lo.trim(), hi.trim()));
        match numbers.filter(|(lo, hi)| is_number(lo) && is_number(hi)) {
            Some((lo, hi)) => {
                all.extend(joined.map(|_| SWEEP.into()));
                all.extend([lo.into(), hi.into()]);
            }
            None => all.push(argument),
        }
    }
    for argument in &mut all {
        if let Some(rest) = argument.to_str().filter(|text| is_number(text)).and_then(|text| text.strip_prefix("-.")) {
            *argument = format!("-0.{rest}").into();
        }
    }
    all
}

/// The command, whose options all take negative numbers: a value out of its range is better named than an unknown
/// option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let numbers = |arg: clap::Arg| {
        let option = !arg.is_positional() && arg.get_action().takes_values();
        if option { arg.allow_negative_numbers(true) } else { arg }
    };
    command.mut_args(numbers).mut_subcommands(with_negative_numbers)
}

impl Cli {
    /// From the arguments of the process, which ends here if they are wrong or ask for help.
    pub fn from_arguments() -> Self {
        let matches = with_negative_numbers(Self::command()).get_matches_from(spelt_out(std::env::args_os()));
        Self::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
    }

    /// Runs the verb.
    ///
    /// # Errors
    /// Whatever the verb meets; [`Error::exit_code`] says how the process should end.
    pub fn run(self) -> Result<()> {
        // rayon would take any number from its variable.
        let variable = || std::env::var("RAYON_NUM_THREADS").ok()?.parse().ok().filter(|n| *n > MOST_THREADS);
        if let Some(threads) = self.threads.or_else(variable) {
            if !(1..=MOST_THREADS).contains(&threads) {
                let name = if self.threads.is_some() { "--threads" } else { "RAYON_NUM_THREADS" };
                return Err(Error::Invalid(format!("{name} {threads}: 1 to {MOST_THREADS}")));
            }
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build_global()
                .map_err(|e| Error::Failed(format!("cannot start {threads} threads: {e}")))?;
        }
        if let Some(name) = &self.isa {
            Isa::from_name(name)?.choose();
        }
        signals::heed();
        let progress = if self.quiet { Progress::Quiet } else { Progress::Shown };
        // Of what takes no time to speak of: what came meanwhile is to end a shell's loop, too.
        let brief = |done: Result<()>| done.and_then(|()| unless_interrupted());
        match self.verb {
            Verb::Info(v) => brief(v.run()),
            Verb::Init(v) => brief(v.run(progress)),
            Verb::Generate(v) => brief(v.run(progress)),
            Verb::Bake(v) => v.run(progress),
            Verb::Render(v) => v.run(progress),
            Verb::View(v) => brief(v.run(progress)),
            Verb::Extract(v) => v.run(progress),
            Verb::Export(v) => brief(v.run(progress)),
            Verb::Reference(v) => v.run(progress),
            Verb::Compare(v) => v.run(progress),
            Verb::Flatland(v) => v.run(progress),
            Verb::Study(v) => v.run(progress),
            Verb::Selftest(v) => v.run(progress),
            Verb::Completions(v) => v.run(),
            Verb::Man(v) => v.run(progress),
        }
    }
}

/// Fails now if `path` could not be written later; what was left of it by processes that were killed goes.
fn writable(path: &Path) -> Result<()> {
    atomic::remove_orphans(path);
    atomic::AtomicFile::create(path).map(drop)
}

/// Fails now if one of `outputs` could not be written later, is another of them, or would take the place of one of
/// `inputs`.
fn outputs<P: AsRef<Path>>(outputs: impl IntoIterator<Item = P>, inputs: &Inputs) -> Result<()> {
    let outputs: Vec<P> = outputs.into_iter().collect();
    for (n, output) in outputs.iter().map(AsRef::as_ref).enumerate() {
        inputs.spare(output)?;
        if outputs[..n].iter().any(|other| scene_file::same(other.as_ref(), output)) {
            return Err(Error::invalid(output, "is to be two outputs at once; give each a name of its own"));
        }
        writable(output)?;
    }
    Ok(())
}

/// Makes an output folder, and fails now if nothing could be written there.
fn folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(|e| Error::io(path, e))?;
    writable(&path.join("probe"))
}

/// Fails if `path` is the pattern of a series, for verbs that take one volume.
fn one_frame(path: &Path) -> Result<()> {
    if !is_pattern(path) {
        return Ok(());
    }
    Err(Error::invalid(
        path,
        "is the pattern of a series, of which this verb takes one frame: name its file (bake, extract, render and reference \
         take patterns)",
    ))
}

/// Fails if an `--exposure` is no brightness.
fn check_exposure(exposure: f64) -> Result<()> {
    if exposure > 0.0 && exposure.is_finite() {
        return Ok(());
    }
    Err(Error::Invalid(format!("--exposure {exposure}: must be a positive finite number")))
}

fn expect_extension(path: &Path, known: &[&str]) -> Result<()> {
    let found = files::extension(path);
    if known.contains(&found.as_str()) {
        return Ok(());
    }
    let what = if found.is_empty() { "has no extension".into() } else { format!("cannot write '.{found}'") };
    Err(Error::invalid(path, format!("{what}; name a file that ends in .{}", known.join(" or ."))))
}

fn device() -> Result<Device> {
    // Embree builds with its own threads: as many as ours, so that the two pools never fight.
    Device::new(rayon::current_num_threads())
}

impl Info {
    fn run(self) -> Result<()> {
        one_frame(&self.file)?;
        let vti = !self.read.raw.given() && files::has_extension(&self.file, "vti");
        let mut array = None;
        let (volume, bake) = if vti {
            let file = VtiFile::read(&self.file)?;
            // Whatever it says of itself, its samples can be examined.
            let bake = BakeSummary::of(&file).unwrap_or_else(|e| {
                say!("warning: {}", e.in_file(&self.file));
                None
            });
            if let Ok((name, all)) = file.scalars(self.read.array.as_deref())
                && all.len() > 1
            {
                array = Some(format!("`{name}` of `{}`; --array names another", all.join("`, `")));
            }
            let mut volume = Volume::of_vti(&self.file, file, self.read.array.as_deref())?;
            volume.lattice = self.read.place.of(volume.lattice, &self.file)?;
            (volume, bake)
        } else {
            (self.read.open(&self.file)?, None)
        };
        let statistics = VolumeStatistics::of(&volume);
        if self.json {
            let mut all = serde_json::to_value(&statistics).expect("statistics are plain data");
            if let Some(bake) = bake {
                all["bake"] = serde_json::to_value(bake).expect("a summary is plain data");
            }
            println!("{all:#}");
        } else {
            print!("{}", statistics.to_text());
            // A bake's arrays are its own.
            match (bake, array) {
                (Some(bake), _) => print!("{}", bake.to_text()),
                (None, Some(array)) => println!("{:<18}{array}", "array"),
                (None, None) => {}
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Cli, spelt_out};
    use clap::CommandFactory;

    /// No two options of a verb share a name.
    #[test]
    fn verbs_are_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn numbers_are_spelt_out() {
        let spelt = |arguments: &[&str]| spelt_out(arguments.iter().map(Into::into)).join(" ".as_ref());
        for (arguments, expected) in [
            (&["--eye", "-.5,1,2"][..], "--eye -.5,1,2"),
            (&["--isovalues", "-.5", "3"], "--isovalues -0.5 3"),
            (&["--isovalues", "-500,.5"], "--isovalues -500 .5"),
            (&["--isovalues", "-.5,5"], "--isovalues -0.5 5"),
            (&["--isovalues=5, 15", "-q"], "--isovalues 5 15 -q"),
            (&["--isovalues", "a,5"], "--isovalues a,5"),
            (&["--origin", "1,2"], "--origin 1,2"),
        ] {
            assert_eq!(spelt(arguments), expected, "{arguments:?}");
        }
    }
}
