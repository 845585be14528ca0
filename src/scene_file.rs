//! Scene files (TOML), and how a volume, a scene file and flags become a [`Scene`].

mod fault;
mod frames;
mod inputs;
mod keys;
mod reading;
mod several;
mod surface;

pub(crate) use fault::parse as parse_toml;
pub use frames::load_series;
pub use inputs::Inputs;
pub(crate) use inputs::same;
pub use reading::{PlaceOptions, RawOptions, ReadOptions};
pub use several::{VolumeEntry, Volumes};
use surface::surface;
pub use surface::{Albedo, BoundaryName, ColourStop, OutsideName, Rgb, SidesName, SurfaceOptions};

use crate::bake::BakeOptions;
use crate::error::{Error, Result};
use crate::field::{Field, Sweep};
use crate::files;
use crate::polygon::Polygon;
use crate::scene::{Placement, Policy, Scene, check_edges, check_spacing, cornell_box, read_context, read_obj};
use crate::volume::statistics::VolumeStatistics;
use crate::volume::{Lattice, Space, Volume};
use clap::ArgAction;
use glam::DVec3;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// A scene file: what [`Scene`] needs and how to bake it. Flags of the same names override it.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct SceneFile {
    /// The volume, or several.
    pub volume: Volumes,
    /// How several volumes share light (default joint).
    pub policy: Option<Policy>,
    /// The sweep [lo, hi] in source units; a suggestion from the data if absent.
    #[serde(default, deserialize_with = "numbers")]
    pub isovalues: Option<[f64; 2]>,
    /// Material and sides.
    #[serde(default)]
    pub surface: SurfaceOptions,
    /// Walls and luminaires.
    #[serde(default, rename = "box")]
    pub surroundings: BoxOptions,
    /// Other things in the scene.
    #[serde(default)]
    pub context: Vec<ContextOptions>,
    /// How to bake.
    #[serde(default)]
    pub bake: BakeOptions,
}

/// A list of exactly `N` numbers, since by themselves arrays leave out what is too much.
pub(crate) fn numbers<'de, D, const N: usize>(deserializer: D) -> std::result::Result<Option<[f64; N]>, D::Error>
where
    D: serde::Deserializer<'de>,
{
    let fail = |found: &str| serde::de::Error::custom(format!("needs {N} numbers, found {found}"));
    let values = toml::Value::deserialize(deserializer)?;
    let list = values.as_array().ok_or_else(|| fail(&values.to_string()))?;
    let number = |v: &toml::Value| v.as_float().or_else(|| v.as_integer().map(|n| n as f64));
    let numbers: Option<Vec<f64>> = list.iter().map(number).collect();
    let numbers = numbers.ok_or_else(|| fail(&values.to_string()))?;
    numbers.try_into().map(Some).map_err(|_| fail(&list.len().to_string()))
}

/// `[[context]]`: polygons beside the box, seen from both sides.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct ContextOptions {
    /// An OBJ file, relative to the scene file.
    pub file: PathBuf,
    /// Instead of the materials' albedo.
    pub albedo: Option<Rgb>,
    /// Instead of the materials' emission.
    pub emission: Option<Rgb>,
    /// Factor of the coordinates.
    pub scale: Option<f64>,
    /// Degrees about x, y and z.
    #[serde(default, deserialize_with = "numbers")]
    pub rotate: Option<[f64; 3]>,
    /// Shift, world units.
    #[serde(default, deserialize_with = "numbers")]
    pub translate: Option<[f64; 3]>,
}

impl ContextOptions {
    fn polygons(&self, folder: &Path) -> Result<Vec<Polygon>> {
        let default = Placement::default();
        let placement = Placement {
            albedo: self.albedo.map(Rgb::vector),
            emission: self.emission.map(Rgb::vector),
            scale: self.scale.unwrap_or(default.scale),
            rotate: self.rotate.map_or(default.rotate, DVec3::from_array),
            translate: self.translate.map_or(default.translate, DVec3::from_array),
        };
        read_context(&folder.join(&self.file), &placement)
    }
}

/// `[volume]`: a file or a generator.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct VolumeSource {
    /// A volume file, relative to the scene file, or the pattern of a series: `rho_%04d.vti`.
    pub file: Option<PathBuf>,
    /// The files of a series instead.
    pub files: Option<Vec<PathBuf>>,
    /// When each file of a series is.
    pub times: Option<Vec<f64>>,
    /// How to read a headerless file.
    pub raw: Option<RawOptions>,
    /// The array of a VTK file that holds several.
    pub array: Option<String>,
    /// World distance between samples, instead of the file's.
    #[serde(default, deserialize_with = "numbers")]
    pub spacing: Option<[f64; 3]>,
    /// World position of the first sample, instead of the file's.
    #[serde(default, deserialize_with = "numbers")]
    pub origin: Option<[f64; 3]>,
    /// Name of a generator instead of a file.
    pub generator: Option<String>,
    /// Samples along each edge of a generated volume.
    pub size: Option<usize>,
}

impl VolumeSource {
    /// That no key means nothing beside another.
    fn check(&self) -> Result<()> {
        let fail = |what: &str| Err(Error::Invalid(what.into()));
        match (&self.file, &self.files, &self.generator) {
            (Some(_), Some(_), _) => fail("[volume] needs either file or files"),
            (_, Some(_), Some(_)) => fail("[volume] needs either files or generator"),
            (Some(_), _, Some(_)) => fail("[volume] needs either file or generator"),
            (.., None) if self.size.is_some() => fail("size is for a generator: a file has the samples that it has"),
            (.., Some(_)) if self.raw.is_some() => fail("raw is for a file, a generated volume has no layout"),
            (.., Some(_)) if self.array.is_some() => fail("array is for a file, a generated volume has one"),
            _ => Ok(()),
        }
    }
}

/// `[box]`, and the flags of the same names.
#[derive(Clone, Debug, Default, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct BoxOptions {
    /// Surroundings: cornell (default), none, or an OBJ file with walls and luminaires
    #[arg(long = "box", value_name = "BOX")]
    pub kind: Option<String>,
    /// Gap between the volume and the Cornell box, as a fraction of the volume's edges (default 0)
    #[arg(long, value_name = "FRACTION")]
    pub margin: Option<f64>,
}

/// What flags say about a scene; they override its file.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct SceneOptions {
    /// The sweep: lowest and highest isovalue, in the volume's units (default: suggested from the data)
    // Given twice it would be four numbers, of which nobody asks for any.
    #[arg(long, num_args = 2, value_names = ["LO", "HI"], allow_negative_numbers = true, action = ArgAction::Set)]
    pub isovalues: Option<Vec<f64>>,
    /// An isovalue that a suggested sweep is widened to hold.
    #[arg(skip)]
    pub wanted: Option<f64>,
    /// The moment of a series of volumes; between two of its frames, their blend
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub time: Option<f64>,
    #[command(flatten)]
    #[allow(missing_docs, reason = "a doc comment would become the group's help")]
    pub surface: SurfaceOptions,
    #[command(flatten)]
    #[allow(missing_docs, reason = "a doc comment would become the group's help")]
    pub surroundings: BoxOptions,
    #[command(flatten)]
    #[allow(missing_docs, reason = "a doc comment would become the group's help")]
    pub read: ReadOptions,
}

impl SceneOptions {
    /// Flags that speak of one volume, and whether they are given.
    fn of_volume(&self) -> [(&'static str, bool); 11] {
        let s = &self.surface;
        [
            ("--time", self.time.is_some()),
            ("--isovalues", self.isovalues.is_some()),
            ("--albedo", s.albedo.is_some()),
            ("--emission", s.emission.is_some()),
            ("--outside", s.outside.is_some()),
            ("--sides", s.sides.is_some()),
            ("--boundary", s.boundary.is_some()),
            ("--array", self.read.array.is_some()),
            ("--spacing", self.read.place.spacing.is_some()),
            ("--origin", self.read.place.origin.is_some()),
            ("--raw-…", self.read.raw.given()),
        ]
    }

    /// A suggested sweep, widened to hold what it must.
    fn widened(&self, [lo, hi]: [f64; 2]) -> [f64; 2] {
        self.wanted.filter(|c| c.is_finite()).map_or([lo, hi], |c| [lo.min(c), hi.max(c)])
    }

    /// The first flag that is given, if any.
    pub fn first_given(&self) -> Option<&'static str> {
        let around = [("--box", self.surroundings.kind.is_some()), ("--margin", self.surroundings.margin.is_some())];
        self.of_volume().into_iter().chain(around).find(|f| f.1).map(|f| f.0)
    }
}

/// A scene ready to bake, and the volume it came from.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// The volume in source units; of several, the first.
    pub volume: Volume,
    /// The other volumes, in the order of the scene's fields.
    pub companions: Vec<Volume>,
    /// Each file's name and what its world's axes mean, those that only stand in the scene among them.
    pub spaces: Vec<(String, Space)>,
    /// The scene.
    pub scene: Scene,
    /// The file's `[bake]` table.
    pub bake: BakeOptions,
    source: Option<Source>,
}

impl Loaded {
    /// All volumes, in the order of the scene's fields.
    #[must_use]
    pub fn volumes(&self) -> Vec<&Volume> {
        [&self.volume].into_iter().chain(&self.companions).collect()
    }

    /// `error` about an option of the bake, at the line of the file that sets it if none of `flags` does.
    #[must_use]
    pub fn blame_bake(&self, flags: &BakeOptions, error: Error) -> Error {
        let key = error.to_string().split([' ', ':']).next().unwrap_or_default().to_owned();
        match &self.source {
            Some(source) if self.bake.set().contains(&key) && !flags.set().contains(&key) => {
                error.in_file(source.place(&["bake", &key]))
            }
            _ => error,
        }
    }
}

impl SceneFile {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// `Io`; `Invalid` with file, line and key.
    pub fn read(path: &Path) -> Result<Self> {
        Source::read(path).and_then(|source| source.parse())
    }
}

/// A scene file's text, for messages that name the line of a key.
#[derive(Clone, Debug)]
struct Source {
    path: PathBuf,
    text: String,
}

impl Source {
    fn read(path: &Path) -> Result<Self> {
        let text = files::read_text(path)?;
        Ok(Self { path: path.to_path_buf(), text })
    }

    fn parse(&self) -> Result<SceneFile> {
        parse_toml(&self.path, &self.text)
    }

    /// The file, and the line of the key at `path`, or of the last on the way that is there.
    fn place(&self, path: &[&str]) -> String {
        let line = |at: usize| format!(":{}", self.text[..at].matches('\n').count() + 1);
        format!("{}{}", self.path.display(), keys::find(&self.text, path).map_or(String::new(), line))
    }
}

/// `error` as the fault of the key at `path` of `source`, if there is one, at the line where it stands.
fn blame(source: Option<&Source>, path: &[&str], error: Error) -> Error {
    let Some(source) = source else { return error };
    error.at(format_args!("{}: {}", source.place(path), path.last().unwrap_or(&"")))
}

/// Loads a volume, or a scene file (`.toml`), with flags laid over it.
///
/// # Errors
/// `Io`, `Invalid` or `NotSupported`; messages name the file and what is wrong in it.
pub fn load(input: &Path, options: &SceneOptions) -> Result<Loaded> {
    let (source, file, folder) = parse(input)?;
    let single = match &file.volume {
        Volumes::One(single) => single,
        Volumes::Several(entries) => {
            // Only a scene file lists several.
            let source = source.ok_or_else(|| Error::invalid(input, "is no scene file"))?;
            return several::load(entries, &file, input, source, options);
        }
    };
    // What a flag brought is the flag's fault, the rest its key's.
    let blame = |path: &'static [&'static str], flag: bool| {
        let source = source.as_ref().filter(|_| !flag);
        move |e: Error| self::blame(source, path, e)
    };
    if file.policy.is_some() {
        return Err(blame(&["policy"], false)(Error::Invalid(
            "there is only one volume; list several as [[volume]]".into(),
        )));
    }
    let key = single.key();
    let series = single.series(&folder).map_err(blame(key, false))?;
    let read = |path: &Path| single.read(path, &options.read);
    let volume = match (&series, options.time) {
        (Some(series), time) => frames::moment(series, time, input, read).map_err(blame(key, true))?,
        (None, None) => {
            let flags = options.read != ReadOptions::default();
            single.load(&folder, &options.read).map_err(|e| blame(single.key_of(&e), flags)(e))?
        }
        (None, Some(time)) => {
            return Err(Error::invalid(input, format!("is a single volume: --time {time} chooses of a series")));
        }
    };
    let isovalues = match (options.isovalues.as_deref(), file.isovalues, &series) {
        (Some(&[lo, hi]), ..) => [lo, hi],
        (Some(other), ..) => {
            return Err(Error::Invalid(format!("--isovalues: two numbers, the lower first; found {}", other.len())));
        }
        (_, Some(range), _) => range,
        (.., Some(series)) => series
            .check(read)?
            .map(|sweep| options.widened(sweep))
            .ok_or_else(|| Error::invalid(input, "no frame suggests a sweep; choose one with --isovalues"))?,
        _ => options.widened(suggested(&volume)?),
    };
    let given = options.isovalues.is_some() || file.isovalues.is_none();
    let sweep = Sweep::new(isovalues[0], isovalues[1]).map_err(blame(&["isovalues"], given))?;
    let field = Field::new(&volume, sweep).map_err(blame(&["isovalues"], given))?;
    let boxed = options.surroundings.kind.is_some() || options.surroundings.margin.is_some();
    let of_volume = |e: Error| e.in_file(&volume.name);
    check_spacing(field.lattice()).map_err(of_volume)?;
    let key: &[&str] = if file.surroundings.kind.is_some() { &["box", "kind"] } else { &["box", "margin"] };
    if kind(&file.surroundings, &options.surroundings) == CORNELL {
        check_edges(field.lattice()).map_err(of_volume)?;
    }
    let around = surroundings(&file.surroundings, &options.surroundings, &folder, field.lattice());
    let mut polygons = around.map_err(blame(key, boxed))?;
    polygons.extend(context(&file.context, &folder, source.as_ref())?);
    let by_flag = [options.surface.albedo.is_some(), options.surface.emission.is_some()];
    let (surface, boundary) =
        surface(&file.surface, &options.surface, sweep).map_err(blame(&["surface", "albedo"], by_flag[0]))?;
    let in_scene = |key: &'static str, flag: bool| {
        let place =
            source.as_ref().map(|s| if flag { input.display().to_string() } else { s.place(&["surface", key]) });
        |e: Error| match place {
            Some(place) => e.in_file(place),
            None => e,
        }
    };
    surface.check_albedo(sweep).map_err(in_scene("albedo", by_flag[0]))?;
    surface.check_emission().map_err(in_scene("emission", by_flag[1]))?;
    let scene = Scene::new(field, surface, boundary, polygons).map_err(in_scene("", true))?;
    let spaces = vec![(volume.name.clone(), volume.space)];
    Ok(Loaded { volume, companions: Vec::new(), spaces, scene, bake: file.bake, source })
}

/// Polygons of all context geometry.
fn context(entries: &[ContextOptions], folder: &Path, source: Option<&Source>) -> Result<Vec<Polygon>> {
    let polygons = entries
        .iter()
        .enumerate()
        .map(|(n, c)| c.polygons(folder).map_err(|e| blame(source, &["context", &n.to_string(), "file"], e)));
    Ok(polygons.collect::<Result<Vec<_>>>()?.concat())
}

/// The sweep that the data suggest.
fn suggested(volume: &Volume) -> Result<[f64; 2]> {
    let statistics = VolumeStatistics::of(volume);
    statistics.sweep.ok_or_else(|| Error::invalid(&volume.name, statistics.without_sweep().unwrap_or_default()))
}

/// The scene file that `input` is or stands for, its text if it is one, and where its paths begin.
fn parse(input: &Path) -> Result<(Option<Source>, SceneFile, PathBuf)> {
    if files::has_extension(input, "toml") {
        let source = Source::read(input)?;
        let file = source.parse()?;
        return Ok((Some(source), file, input.parent().unwrap_or(Path::new("")).to_path_buf()));
    }
    let volume = VolumeSource { file: Some(input.to_path_buf()), ..VolumeSource::default() };
    Ok((None, SceneFile { volume: Volumes::One(volume), ..SceneFile::default() }, PathBuf::new()))
}

/// The box around a volume unless another is named.
const CORNELL: &str = "cornell";

/// What kind of box is asked for: flags win.
fn kind<'a>(file: &'a BoxOptions, flags: &'a BoxOptions) -> &'a str {
    flags.kind.as_deref().or(file.kind.as_deref()).unwrap_or(CORNELL)
}

fn surroundings(file: &BoxOptions, flags: &BoxOptions, folder: &Path, lattice: &Lattice) -> Result<Vec<Polygon>> {
    let margin = flags.margin.or(file.margin);
    // A path in a scene file is relative to it, one in a flag to the working folder.
    let folder = if flags.kind.is_some() { Path::new("") } else { folder };
    let kind = kind(file, flags);
    match kind {
        CORNELL => cornell_box(lattice, margin.unwrap_or(0.0)),
        _ if margin.is_some() => Err(Error::Invalid(format!("box margin: only the Cornell box has one, not '{kind}'"))),
        "none" => Ok(Vec::new()),
        path => {
            let file = folder.join(path);
            match fault::nearest(path, &[CORNELL, "none"]).filter(|_| !file.exists()) {
                Some(meant) => Err(Error::Invalid(format!("'{path}' is no file; did you mean `{meant}`?"))),
                None => read_obj(&file),
            }
        }
    }
}

#[cfg(test)]
mod tests;
