//! The command line: verbs, flags, and what they print. No physics here.

mod bake;
mod compare;
mod documentation;
mod export;
mod extract;
mod flatland;
mod generate;
mod init;
mod reference;
mod selftest;
mod study;
mod view;

use crate::embree::Device;
use crate::error::{Error, Result};
use crate::export::bake_file::{BakeSummary, BakedVolume};
use crate::field::Shortest;
use crate::isa::Isa;
use crate::progress::{self, Progress, say};
use crate::render::{Camera, Rendered, Shading, render};
use crate::scene::{Policy, Scene};
use crate::scene_file::{self, Inputs, RawOptions, SceneOptions, load};
use crate::volume::Volume;
use crate::volume::statistics::VolumeStatistics;
use crate::volume::vti::VtiFile;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use glam::DVec3;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Global illumination for every isosurface of a volume at once.
#[derive(Parser, Debug)]
#[command(
    version,
    about,
    max_term_width = 100,
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
    Render(Render),
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
    raw: RawOptions,
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The picture holds the walls too. A .png is exposed so that a surface at the box's centre that faces the luminaire is white; an
.exr holds linear radiance and every setting. Parts of the surface that show their inside are black unless the bake stored it
(--sides both).

Examples:
  isolume render lit.vti --isovalue 80 -o lit.png
  isolume render lit.vti --isovalue 80 -o local.png --local            the same view as other tools would light it
  isolume render lit.vti --isovalue 80 -o side.exr --eye 90,-300,120 --target 90,108,90
  isolume render lit.vti --isovalue 80 -o truth.png --reference --samples 256")]
struct Render {
    /// A bake (.vti, .vtm); with --reference or --local also a volume or scene file
    file: PathBuf,
    /// The isosurface to draw, in the volume's units
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    isovalue: f64,
    /// Of several volumes, the one that --isovalue speaks of: its name (default: the first). The others are drawn at
    /// the same share of their own ranges
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Output: .png (exposed, sRGB) or .exr (linear radiance)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Plain local shading of the same view, for comparison
    #[arg(long)]
    local: bool,
    /// Path-trace the isosurface's triangles instead of using the bake's light
    #[arg(long, conflicts_with = "local")]
    reference: bool,
    /// Path-trace the trilinear surface itself instead of triangles, caps included
    #[arg(long, requires = "reference")]
    trilinear: bool,
    /// Pixels from top to bottom
    #[arg(long, default_value_t = 600, value_name = "PIXELS")]
    height: usize,
    /// Pixels across (default: by the box's aspect)
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
    /// Rays per pixel
    #[arg(long, default_value_t = 16, value_name = "N")]
    samples: u32,
    /// Camera position in the world (default: in front of the box)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    eye: Option<Vec<f64>>,
    /// Point the camera looks at (default: the box's centre if --eye is given)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    target: Option<Vec<f64>>,
    /// Up direction (default: 0,0,1)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    up: Option<Vec<f64>>,
    /// Vertical field of view in degrees
    #[arg(long, default_value_t = 40.0, value_name = "DEGREES")]
    fov: f64,
    /// Brightness: multiplies the bake's exposure
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    exposure: f64,
    #[command(flatten)]
    scene: SceneOptions,
}

/// More are of no use to any machine, and take long to start.
const MOST_THREADS: usize = 1024;

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
        let matches = with_negative_numbers(Self::command()).get_matches();
        Self::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
    }

    /// Runs the verb.
    ///
    /// # Errors
    /// Whatever the verb meets; [`Error::exit_code`] says how the process should end.
    pub fn run(self) -> Result<()> {
        if let Some(threads) = self.threads {
            if !(1..=MOST_THREADS).contains(&threads) {
                return Err(Error::Invalid(format!("--threads {threads}: 1 to {MOST_THREADS}")));
            }
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build_global()
                .map_err(|e| Error::Failed(format!("cannot start {threads} threads: {e}")))?;
        }
        if let Some(name) = &self.isa {
            Isa::from_name(name)?.choose();
        }
        // A second signal ends the process at once.
        let _ = ctrlc::set_handler(|| {
            if progress::interrupted() {
                std::process::exit(130);
            }
            progress::interrupt();
        });
        let progress = if self.quiet { Progress::Quiet } else { Progress::Shown };
        match self.verb {
            Verb::Info(v) => v.run(),
            Verb::Init(v) => v.run(progress),
            Verb::Generate(v) => v.run(progress),
            Verb::Bake(v) => v.run(progress),
            Verb::Render(v) => v.run(progress),
            Verb::View(v) => v.run(progress),
            Verb::Extract(v) => v.run(progress),
            Verb::Export(v) => v.run(progress),
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

/// Fails now if `path` could not be written later.
fn writable(path: &Path) -> Result<()> {
    crate::atomic::AtomicFile::create(path).map(drop)
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

fn expect_extension(path: &Path, known: &[&str]) -> Result<()> {
    let found = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
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
        let vti = !self.raw.given() && self.file.extension().is_some_and(|e| e.eq_ignore_ascii_case("vti"));
        let (volume, bake) = if vti {
            let file = VtiFile::read(&self.file)?;
            // Whatever it says of itself, its samples can be examined.
            let bake = BakeSummary::of(&file).unwrap_or_else(|e| {
                say!("warning: {}", e.in_file(&self.file));
                None
            });
            (Volume::of_vti(&self.file, file)?, bake)
        } else {
            (export::open(&self.file, &self.raw)?, None)
        };
        let statistics = VolumeStatistics::of(&volume);
        if self.json {
            let mut all = serde_json::to_value(&statistics).expect("statistics are plain data");
            if let Some(bake) = bake {
                all["bake"] = serde_json::to_value(bake).expect("a summary is plain data");
            }
            println!("{all:#}");
        } else {
            print!("{}{}", statistics.to_text(), bake.map_or_else(String::new, |b| b.to_text()));
        }
        Ok(())
    }
}

fn triple(values: Option<&Vec<f64>>, name: &str) -> Result<Option<DVec3>> {
    match values.map(Vec::as_slice) {
        None => Ok(None),
        Some(&[x, y, z]) => Ok(Some(DVec3::new(x, y, z))),
        Some(v) => Err(Error::Invalid(format!("--{name}: needs three numbers X,Y,Z, found {}", v.len()))),
    }
}

/// The isovalue of a scene's first volume where the one named `name` has `isovalue`.
fn first_isovalue(scene: &Scene, name: &str, isovalue: f64) -> Result<f64> {
    let member = scene.members().swap_remove(scene.field_named(name)?);
    let sweep = member.field.sweep();
    if !(sweep.lo()..=sweep.hi()).contains(&isovalue) {
        let isovalue = Shortest(isovalue);
        return Err(Error::Invalid(format!("--isovalue {isovalue}: outside the range of '{name}', {sweep}")));
    }
    Ok(scene.field.sweep().from_unit(sweep.to_unit(isovalue)))
}

impl Render {
    fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["png", "exr"])?;
        outputs([&*self.output], &Inputs::of(&self.file, &self.scene)?)?;
        let begun = Instant::now();
        if !(1..=16384).contains(&self.height) || self.width.is_some_and(|w| !(1..=16384).contains(&w)) {
            return Err(Error::Invalid("--height, --width: 1 to 16384 pixels".into()));
        }
        if !(1..=1 << 16).contains(&self.samples) {
            return Err(Error::Invalid("--samples: 1 to 65536 rays per pixel".into()));
        }
        if !(self.exposure > 0.0 && self.exposure.is_finite()) {
            return Err(Error::Invalid(format!("--exposure {}: must be a positive finite number", self.exposure)));
        }
        let baked = match extract::open_bake(&self.file, &self.scene)? {
            None if !self.reference && !self.local => Some(BakedVolume::read(&self.file)?),
            found => found,
        };
        let loaded = match baked {
            Some(_) => None,
            None => Some(load(&self.file, &self.scene)?.scene),
        };
        let scene = baked.as_ref().map(|b| &b.scene).or(loaded.as_ref()).expect("one of the two was read");
        let isovalue = match &self.field {
            None => self.isovalue,
            Some(name) => first_isovalue(scene, name, self.isovalue).map_err(|e| e.in_file(&self.file))?,
        };
        let mut camera = Camera::facing(scene, self.height);
        camera.fov = self.fov;
        if let Some(width) = self.width {
            camera.size[0] = width;
        }
        if let Some(up) = triple(self.up.as_ref(), "up")? {
            camera.up = up;
        }
        let [lo, hi] = scene.bounds();
        if let Some(eye) = triple(self.eye.as_ref(), "eye")? {
            (camera.eye, camera.target) = (eye, 0.5 * (lo + hi));
        }
        if let Some(target) = triple(self.target.as_ref(), "target")? {
            camera.target = target;
        }
        let exposure = baked.as_ref().map_or_else(|| scene.exposure(), |b| b.exposure);
        let exr = self.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"));
        #[allow(clippy::cast_possible_truncation, reason = "a brightness")]
        let brightness = (exposure * self.exposure) as f32;
        let storable = exr || (brightness > 0.0 && brightness.is_finite());
        if !storable {
            return Err(Error::Invalid(format!(
                "--exposure {:?}: times {exposure:?}, the exposure of {}, it is no brightness that a .png can have; give \
                 another",
                self.exposure,
                self.file.display()
            )));
        }
        if self.reference && scene.fields() > 1 && scene.policy() == Policy::Independent {
            return Err(Error::not_supported(
                &self.file,
                "policy = \"independent\": paths see all volumes; a picture of one needs a scene of one",
            ));
        }
        let rendered = if self.reference {
            baked.as_ref().map_or(Ok(()), BakedVolume::whole).map_err(|e| e.in_file(&self.file))?;
            let picture =
                reference::picture(scene, isovalue, &camera, self.samples, self.trilinear, &device()?, progress)?;
            Rendered { picture, unbaked: 0.0 }
        } else {
            let shading = match &baked {
                Some(baked) if !self.local => Shading::Baked(baked),
                _ => Shading::Local(exposure),
            };
            render(scene, isovalue, &camera, shading, self.samples, &device()?, progress)?
        };
        let exposure = exposure * self.exposure;
        if exr {
            let shading = match () {
                () if self.trilinear => "path traced, trilinear",
                () if self.reference => "path traced",
                () if self.local || baked.is_none() => "local",
                () => "baked",
            };
            let vector = |v: DVec3| format!("{:?},{:?},{:?}", v.x, v.y, v.z);
            let attributes = [
                ("isolume".to_owned(), format!("{} ({})", env!("CARGO_PKG_VERSION"), env!("ISOLUME_COMMIT"))),
                ("source".to_owned(), self.file.display().to_string()),
                ("isovalue".to_owned(), self.isovalue.to_string()),
                ("field".to_owned(), self.field.clone().unwrap_or_else(|| scene.name.clone())),
                ("shading".to_owned(), shading.to_owned()),
                ("eye".to_owned(), vector(camera.eye)),
                ("target".to_owned(), vector(camera.target)),
                ("up".to_owned(), vector(camera.up)),
                ("fov".to_owned(), camera.fov.to_string()),
                ("exposure".to_owned(), exposure.to_string()),
                ("samplesPerPixel".to_owned(), self.samples.to_string()),
                ("renderTimeSeconds".to_owned(), begun.elapsed().as_secs_f64().to_string()),
                ("report".to_owned(), baked.as_ref().map_or_else(|| "null".into(), |b| b.report.to_string())),
            ];
            rendered.picture.write_exr(&self.output, &attributes)?;
        } else {
            rendered.picture.write_png(&self.output, brightness)?;
        }
        if progress == Progress::Shown {
            let seconds = begun.elapsed().as_secs_f64();
            say!("{}: {}×{} in {seconds:.2} s", self.output.display(), camera.size[0], camera.size[1]);
        }
        if rendered.unbaked > 0.001 {
            say!(
                "warning: {:.1} % of the picture shows the surface's inside, which was not baked; use --sides both",
                100.0 * rendered.unbaked
            );
        }
        Ok(())
    }
}
