//! Scene files (TOML), and how a volume, a scene file and flags become a [`Scene`].

mod fault;
mod frames;
mod inputs;
mod several;
mod surface;

pub use fault::fault;
pub use frames::load_series;
pub use inputs::Inputs;
pub(crate) use inputs::same;
pub use several::{PolicyName, VolumeEntry, Volumes};
use surface::surface;
pub use surface::{Albedo, BoundaryName, ColourStop, OutsideName, Rgb, SidesName, SurfaceOptions};

use crate::bake::BakeOptions;
use crate::error::{Error, Result};
use crate::field::{Field, Sweep};
use crate::polygon::Polygon;
use crate::scene::{Placement, Scene, cornell_box, read_context, read_obj};
use crate::volume::generate::Generator;
use crate::volume::raw::RawLayout;
use crate::volume::statistics::VolumeStatistics;
use crate::volume::{ElementType, Endian, Lattice, Volume};
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
    pub policy: Option<PolicyName>,
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
    let values = Vec::<f64>::deserialize(deserializer)?;
    let found = values.len();
    values.try_into().map(Some).map_err(|_| serde::de::Error::custom(format!("needs {N} numbers, found {found}")))
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
            _ => Ok(()),
        }
    }
}

/// The layout of a headerless file.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct RawOptions {
    /// Samples of a headerless file along x, y, z (x fastest)
    #[arg(long = "raw-dims", value_name = "NX,NY,NZ", value_delimiter = ',')]
    pub dims: Option<Vec<usize>>,
    /// Sample type of a headerless file: u8, i8, u16 … f32, f64
    #[arg(long = "raw-type", value_name = "TYPE")]
    #[serde(rename = "type")]
    pub element: Option<String>,
    /// Byte order of a headerless file: little (default) or big
    #[arg(long = "raw-endian", value_name = "ORDER")]
    pub endian: Option<String>,
    /// World distance between samples of a headerless file, negative where an axis is flipped (default: 1,1,1)
    #[arg(long = "raw-spacing", value_name = "DX,DY,DZ", value_delimiter = ',', allow_hyphen_values = true)]
    pub spacing: Option<Vec<f64>>,
    /// World position of the first sample of a headerless file (default: 0,0,0)
    #[arg(long = "raw-origin", value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    pub origin: Option<Vec<f64>>,
    /// Bytes to skip at the start of a headerless file (default: 0)
    #[arg(long = "raw-skip", value_name = "BYTES")]
    pub skip: Option<u64>,
}

impl RawOptions {
    /// The layout.
    ///
    /// # Errors
    /// `Invalid` with the key that is missing or wrong.
    pub fn layout(&self, path: &Path) -> Result<RawLayout> {
        let fail = |what: &str| Error::invalid(path, format!("raw layout: {what}"));
        let triple = |v: &Option<Vec<f64>>, name: &str| match v.as_deref() {
            None => Ok(None),
            Some(&[x, y, z]) => Ok(Some(DVec3::new(x, y, z))),
            Some(v) => Err(fail(&format!("{name} needs three numbers, found {}", v.len()))),
        };
        let dims = match self.dims.as_deref() {
            Some(&[x, y, z]) => [x, y, z],
            Some(v) => return Err(fail(&format!("dims needs three counts, found {}", v.len()))),
            None => return Err(fail("dims is missing; give the samples along x, y, z")),
        };
        let name = self.element.as_deref().unwrap_or("u8");
        let element = ElementType::from_name(name).ok_or_else(|| {
            fail(&format!("type '{name}' is unknown; use u8, i8, u16, i16, u32, i32, u64, i64, f32 or f64"))
        })?;
        let mut layout = RawLayout::new(dims, element);
        layout.endian = match self.endian.as_deref() {
            None | Some("little") => Endian::Little,
            Some("big") => Endian::Big,
            Some(other) => return Err(fail(&format!("endian '{other}' is neither little nor big"))),
        };
        layout.spacing = triple(&self.spacing, "spacing")?.unwrap_or(DVec3::ONE);
        layout.origin = triple(&self.origin, "origin")?.unwrap_or(DVec3::ZERO);
        layout.header_bytes = self.skip.unwrap_or(0);
        Ok(layout)
    }

    /// Whether anything of it is set.
    pub fn given(&self) -> bool {
        *self != Self::default()
    }

    /// What is not given here comes from `other`.
    fn or(&self, other: Option<&Self>) -> Self {
        let (this, other) = (self.clone(), other.cloned().unwrap_or_default());
        Self {
            dims: this.dims.or(other.dims),
            element: this.element.or(other.element),
            endian: this.endian.or(other.endian),
            spacing: this.spacing.or(other.spacing),
            origin: this.origin.or(other.origin),
            skip: this.skip.or(other.skip),
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
    pub raw: RawOptions,
}

impl SceneOptions {
    /// Flags that speak of one volume, and whether they are given.
    fn of_volume(&self) -> [(&'static str, bool); 8] {
        let s = &self.surface;
        [
            ("--time", self.time.is_some()),
            ("--isovalues", self.isovalues.is_some()),
            ("--albedo", s.albedo.is_some()),
            ("--emission", s.emission.is_some()),
            ("--outside", s.outside.is_some()),
            ("--sides", s.sides.is_some()),
            ("--boundary", s.boundary.is_some()),
            ("--raw-…", self.raw.given()),
        ]
    }

    /// The first flag that is given, if any.
    pub fn first_given(&self) -> Option<&'static str> {
        let around = [("--box", self.surroundings.kind.is_some()), ("--margin", self.surroundings.margin.is_some())];
        self.of_volume().into_iter().chain(around).find(|f| f.1).map(|f| f.0)
    }
}

/// A scene ready to bake, and the volume it came from.
pub struct Loaded {
    /// The volume in source units; of several, the first.
    pub volume: Volume,
    /// The other volumes, in the order of the scene's fields.
    pub companions: Vec<Volume>,
    /// The scene.
    pub scene: Scene,
    /// The file's `[bake]` table.
    pub bake: BakeOptions,
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
struct Source {
    path: PathBuf,
    text: String,
}

impl Source {
    fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
        Ok(Self { path: path.to_path_buf(), text })
    }

    fn parse(&self) -> Result<SceneFile> {
        toml::from_str(&self.text).map_err(|e| fault(&self.path, &self.text, &e))
    }

    /// `error` as the fault of `key`, at the line where it stands.
    fn blame(&self, key: &str, error: &Error) -> Error {
        let names_key =
            |l: &str| l.trim_start().strip_prefix(key).is_some_and(|rest| rest.trim_start().starts_with('='));
        let line = self.text.lines().position(names_key).map_or(String::new(), |n| format!(":{}", n + 1));
        Error::Invalid(format!("{}{line}: {key}: {error}", self.path.display()))
    }
}

/// Loads a volume, or a scene file (`.toml`), with flags laid over it.
///
/// # Errors
/// `Io`, `Invalid` or `NotSupported`; messages name the file and what is wrong in it.
pub fn load(input: &Path, options: &SceneOptions) -> Result<Loaded> {
    let (source, file, folder) = parse(input)?;
    let is_scene = source.is_some();
    let single = match &file.volume {
        Volumes::One(single) => single,
        Volumes::Several(entries) => return several::load(entries, &file, input, options),
    };
    // What a flag brought is the flag's fault, the rest its key's.
    let blame = |key: &'static str, flag: bool| {
        let source = source.as_ref().filter(|_| !flag);
        move |e: Error| source.map_or_else(|| Error::Invalid(e.to_string()), |s| s.blame(key, &e))
    };
    if file.policy.is_some() {
        return Err(blame("policy", false)(Error::Invalid(
            "there is only one volume; list several as [[volume]]".into(),
        )));
    }
    let key = single.key();
    let series = single.series(&folder).map_err(blame(key, false))?;
    let read = |path: &Path| frames::read_volume(path, single, &options.raw);
    let volume = match (&series, options.time) {
        (Some(series), time) => frames::moment(series, time, input, read).map_err(blame(key, true))?,
        (None, None) => load_volume(single, &folder, &options.raw).map_err(blame(key, false))?,
        (None, Some(time)) => {
            return Err(Error::invalid(input, format!("is a single volume: --time {time} chooses of a series")));
        }
    };
    let isovalues = match (options.isovalues.as_deref(), file.isovalues, &series) {
        (Some(&[lo, hi]), ..) => [lo, hi],
        (_, Some(range), _) => range,
        (.., Some(series)) => series
            .check(read)?
            .ok_or_else(|| Error::invalid(input, "no frame suggests a sweep; choose one with --isovalues"))?,
        _ => suggested(&volume)?,
    };
    let given = options.isovalues.is_some() || file.isovalues.is_none();
    let sweep = Sweep::new(isovalues[0], isovalues[1]).map_err(blame("isovalues", given))?;
    let field = Field::new(&volume, sweep).map_err(blame("isovalues", given))?;
    let boxed = options.surroundings.kind.is_some() || options.surroundings.margin.is_some();
    let key = if file.surroundings.kind.is_some() { "kind" } else { "margin" };
    let mut polygons =
        surroundings(&file.surroundings, &options.surroundings, &folder, field.lattice()).map_err(blame(key, boxed))?;
    polygons.extend(context(&file.context, &folder).map_err(blame("[[context]]", false))?);
    let flag = options.surface.albedo.is_some();
    let (surface, boundary) = surface(&file.surface, &options.surface, sweep).map_err(blame("albedo", flag))?;
    let scene =
        Scene::new(field, surface, boundary, polygons).map_err(|e| if is_scene { e.in_file(input) } else { e })?;
    Ok(Loaded { volume, companions: Vec::new(), scene, bake: file.bake })
}

/// Polygons of all context geometry.
fn context(entries: &[ContextOptions], folder: &Path) -> Result<Vec<Polygon>> {
    Ok(entries.iter().map(|c| c.polygons(folder)).collect::<Result<Vec<_>>>()?.concat())
}

/// The sweep that the data suggest.
fn suggested(volume: &Volume) -> Result<[f64; 2]> {
    let statistics = VolumeStatistics::of(volume);
    statistics.sweep.ok_or_else(|| Error::invalid(&volume.name, statistics.without_sweep().unwrap_or_default()))
}

/// The scene file that `input` is or stands for, its text if it is one, and where its paths begin.
fn parse(input: &Path) -> Result<(Option<Source>, SceneFile, PathBuf)> {
    if input.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml")) {
        let source = Source::read(input)?;
        let file = source.parse()?;
        return Ok((Some(source), file, input.parent().unwrap_or(Path::new("")).to_path_buf()));
    }
    let volume = VolumeSource { file: Some(input.to_path_buf()), ..VolumeSource::default() };
    Ok((None, SceneFile { volume: Volumes::One(volume), ..SceneFile::default() }, PathBuf::new()))
}

fn load_volume(source: &VolumeSource, folder: &Path, raw: &RawOptions) -> Result<Volume> {
    source.check()?;
    if source.generator.is_some() && raw.given() {
        return Err(Error::Invalid("--raw-…: a generated volume has no file with a layout".into()));
    }
    match (&source.file, &source.generator) {
        (Some(file), None) => frames::read_volume(&folder.join(file), source, raw),
        (None, Some(name)) => Generator::from_name(name)?.sample([source.size.unwrap_or(101); 3]),
        _ => Err(Error::Invalid("[volume] needs either file or generator".into())),
    }
}

fn surroundings(file: &BoxOptions, flags: &BoxOptions, folder: &Path, lattice: &Lattice) -> Result<Vec<Polygon>> {
    let margin = flags.margin.or(file.margin);
    // A path in a scene file is relative to it, one in a flag to the working folder.
    let (kind, folder) = match (&flags.kind, &file.kind) {
        (Some(kind), _) => (kind.as_str(), Path::new("")),
        (None, Some(kind)) => (kind.as_str(), folder),
        (None, None) => ("cornell", folder),
    };
    match kind {
        "cornell" => cornell_box(lattice, margin.unwrap_or(0.0)),
        _ if margin.is_some() => Err(Error::Invalid(format!("box margin: only the Cornell box has one, not '{kind}'"))),
        "none" => Ok(Vec::new()),
        path => read_obj(&folder.join(path)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flattened::Side;
    use crate::scene::Boundary;

    fn error_of(text: &str) -> String {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.toml");
        std::fs::write(&path, text).unwrap();
        match load(&path, &SceneOptions::default()) {
            Ok(_) => panic!("accepted: {text}"),
            Err(e) => e.to_string(),
        }
    }

    #[test]
    fn a_whole_scene() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.toml");
        let text = "isovalues = [3.6, 95]\n[volume]\ngenerator = \"bumps\"\nsize = 17\n[surface]\nalbedo = [0.1, 0.2, 0.3]\n\
                    outside = \"higher\"\nsides = \"both\"\nboundary = \"capped\"\n[box]\nmargin = 0.1\n[bake]\ngather = 0\n\
                    grid = \"2x\"\npreset = \"preview\"\n";
        std::fs::write(&path, text).unwrap();
        let loaded = load(&path, &SceneOptions::default()).unwrap();
        assert_eq!(loaded.scene.surface.albedo.uniform(), Some(DVec3::new(0.1, 0.2, 0.3)));
        assert_eq!((loaded.scene.surface.outside, loaded.scene.surface.both_sides), (Side::Higher, true));
        assert_eq!((loaded.scene.boundary, loaded.bake.gather_rays), (Boundary::Capped, Some(0)));
        assert_eq!(loaded.scene.field.sweep().hi(), 95.0);
        let options = SceneOptions { isovalues: Some(vec![10.0, 20.0]), ..SceneOptions::default() };
        assert_eq!(load(&path, &options).unwrap().scene.field.sweep().lo(), 10.0, "flags win");
    }

    #[test]
    fn volumes_without_a_suggestion_are_told_why() {
        let of = |samples: Vec<f64>| {
            let lattice = Lattice::aligned([2; 3], DVec3::ZERO, DVec3::ONE).unwrap();
            let volume = Volume::new("v", lattice, crate::volume::Samples::F64(samples)).unwrap();
            suggested(&volume).unwrap_err().to_string()
        };
        assert!(of(vec![2.5; 8]).contains("v: every sample is 2.5"));
        assert!(of(vec![f64::NAN; 8]).contains("finite"));
        let wide = of([-1.5e308, 1.5e308].repeat(4));
        let words = ["v: ", "-1.5e308", " 1.5e308", "--isovalues"];
        assert!(words.iter().all(|w| wide.contains(w)) && !wide.contains("every"), "{wide}");
    }

    #[test]
    fn colours_by_isovalue() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.toml");
        let text = "isovalues = [10, 90]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n[surface]\nalbedo = [\n  \
                    { isovalue = 50, colour = 0.5 },\n  { isovalue = 30, colour = [0.1, 0.2, 0.3] },\n]\n";
        std::fs::write(&path, text).unwrap();
        let albedo = |options: &SceneOptions| load(&path, options).unwrap().scene.surface.albedo;
        let by_isovalue = albedo(&SceneOptions::default());
        assert_eq!(by_isovalue.at(0.0), DVec3::new(0.1, 0.2, 0.3));
        assert!(by_isovalue.at(0.375).abs_diff_eq(DVec3::new(0.3, 0.35, 0.4), 1e-12), "halfway");
        let grey = SurfaceOptions { albedo: Some("0.2".parse().unwrap()), ..SurfaceOptions::default() };
        let options = SceneOptions { surface: grey, ..SceneOptions::default() };
        assert_eq!(albedo(&options).uniform(), Some(DVec3::splat(0.2)), "flags win");
        let of = |albedo: &str| {
            error_of(&format!("[volume]\ngenerator = \"bumps\"\nsize = 9\n[surface]\nalbedo = {albedo}\n"))
        };
        for (albedo, says) in [
            ("[0.1, 0.2]", "list of { isovalue, colour }"),
            ("\"red\"", "list of { isovalue, colour }"),
            ("[{ isovalue = 3, color = 0.5 }]", "did you mean `colour`?"),
            ("[{ isovalue = 3, colour = 0.5 }, { isovalue = 3, colour = 0.6 }]", "different"),
            ("[{ isovalue = 3, colour = 1.5 }]", "[0, 1]"),
        ] {
            let e = of(albedo);
            assert!(e.contains("scene.toml:") && e.contains(says) && !e.contains('\n'), "{albedo}: {e}");
        }
    }

    #[test]
    fn errors_name_file_line_and_key() {
        let e = error_of("[volume]\ngenerator = \"bumps\"\ncolour = 3\n");
        assert!(e.contains("scene.toml:3: unknown key `colour` in [volume]; known: file") && !e.contains('\n'), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\n[surface]\noutside = \"heigher\"\n");
        assert!(e.contains("scene.toml:4: unknown value `heigher` in [surface]; did you mean `higher`?"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\n[foo]\nx = 1\n");
        assert!(e.contains("scene.toml:3: unknown key `foo`; known: volume"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\n[volume.foo]\nx = 1\n");
        assert!(e.contains("scene.toml:3: unknown key `foo` in [volume]; known: file"), "{e}");
        let e = error_of("isovalue = [1, 2]\n[volume]\ngenerator = \"bumps\"\n");
        assert!(e.contains("scene.toml:1: unknown key `isovalue`; did you mean `isovalues`?"), "{e}");
        let e = error_of("isovalues = [5, 5]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n");
        assert!(e.contains("scene.toml:1: isovalues"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\n[[context]]\nfile = \"a.obj\"\nscal = 3\n");
        assert!(e.contains("scene.toml:5: unknown key `scal` in [[context]]; did you mean `scale`?"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[[context]]\nfile = \"nowhere.obj\"\n");
        assert!(e.contains("scene.toml: [[context]]") && e.contains("nowhere.obj"), "{e}");
        let e = error_of("[volume]\nfile = \"nowhere.vti\"\n");
        assert!(e.contains("scene.toml:2: file") && e.contains("nowhere.vti"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[box]\nmargin = -1.0\n");
        assert!(e.contains("scene.toml:5: margin"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[box]\nmargin = 1001\n");
        assert!(e.contains("scene.toml:5: margin") && e.contains("1000"), "{e}");
        let e = error_of("isovalues = [10, 20, 30]\n[volume]\ngenerator = \"bumps\"\n");
        assert!(e.contains("scene.toml:1") && e.contains("needs 2 numbers, found 3"), "{e}");
        for emission in ["\"red\"", "[1, 2]"] {
            let e = error_of(&format!("[volume]\ngenerator = \"bumps\"\n[surface]\nemission = {emission}\n"));
            assert!(e.contains("scene.toml:4") && e.contains("a number, or three"), "{e}");
        }
        assert!(error_of("[volume]\n").contains("file or generator"));
        let e = error_of("[volume]\nfiles = [\"a.vti\", \"b.vti\"]\ngenerator = \"bumps\"\n");
        assert!(e.contains("scene.toml:2: files") && e.contains("files or generator"), "{e}");
        assert!(error_of("[volume]\nfile = \"a.vti\"\nsize = 9\n").contains("size is for a generator"));
        let e = error_of("[volume]\ngenerator = \"bumps\"\nraw = { dims = [2, 2, 2], type = \"u8\" }\n");
        assert!(e.contains("raw is for a file"), "{e}");
        let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 100000\n");
        assert!(e.contains("100000") && e.contains("2048"), "{e}");
        let e = error_of("isovalues = [200, 300]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n");
        assert!(e.contains("outside the data"), "{e}");
    }
}
