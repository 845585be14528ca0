//! How a volume's file is read: what it does not say, or says wrongly.

use super::VolumeSource;
use crate::error::{Error, Result};
use crate::volume::generate::Generator;
use crate::volume::raw::RawLayout;
use crate::volume::{ElementType, Endian, Lattice, Volume};
use glam::{DMat3, DVec3};
use serde::Deserialize;
use std::path::Path;

/// Keys of `[volume]` about its file, and the flags of the same names.
#[derive(Clone, Debug, Default, PartialEq, clap::Args)]
pub struct ReadOptions {
    /// The array of a VTK file that holds several (default: its active scalars, `value`, or the only one)
    #[arg(long, value_name = "NAME")]
    pub array: Option<String>,
    #[command(flatten)]
    #[allow(missing_docs, reason = "a doc comment would become the group's help")]
    pub place: PlaceOptions,
    #[command(flatten)]
    #[allow(missing_docs, reason = "a doc comment would become the group's help")]
    pub raw: RawOptions,
}

/// Where samples stand, instead of where their file says.
#[derive(Clone, Debug, Default, PartialEq, clap::Args)]
pub struct PlaceOptions {
    /// World distance between samples along x, y and z, negative to turn an axis round (default: as the file says, or
    /// 1)
    #[arg(long, value_name = "DX,DY,DZ", value_delimiter = ',', allow_hyphen_values = true)]
    pub spacing: Option<Vec<f64>>,
    /// World position of the first sample (default: as the file says, or 0,0,0)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    pub origin: Option<Vec<f64>>,
}

impl ReadOptions {
    /// Opens a volume: by its layout if that is given, else by its extension.
    ///
    /// # Errors
    /// As [`RawOptions::layout`], [`RawLayout::read`] and [`Volume::open_array`]; `Invalid` for a place that is none.
    pub fn open(&self, path: &Path) -> Result<Volume> {
        let mut volume = match &self.array {
            Some(array) if self.raw.given() => {
                return Err(Error::invalid(path, format!("--array {array}: a headerless file holds one array")));
            }
            array if !self.raw.given() => Volume::open_array(path, array.as_deref())?,
            _ => self.raw.layout(path)?.read(path)?,
        };
        volume.lattice = self.place.of(volume.lattice, path)?;
        Ok(volume)
    }

    /// What is not given here comes from the keys of `[volume]`.
    fn or(&self, source: &VolumeSource) -> Self {
        let place = |flag: &Option<Vec<f64>>, key: Option<[f64; 3]>| flag.clone().or(key.map(Vec::from));
        Self {
            array: self.array.clone().or_else(|| source.array.clone()),
            place: PlaceOptions {
                spacing: place(&self.place.spacing, source.spacing),
                origin: place(&self.place.origin, source.origin),
            },
            raw: self.raw.or(source.raw.as_ref()),
        }
    }
}

impl VolumeSource {
    /// Reads a file of this source, of whose keys flags win.
    pub(super) fn read(&self, path: &Path, flags: &ReadOptions) -> Result<Volume> {
        flags.or(self).open(path)
    }

    /// The path of the key that an error of its one volume is about.
    pub(super) fn key_of(&self, error: &Error) -> &'static [&'static str] {
        let text = error.to_string();
        let about = |words: &[&str]| words.iter().any(|word| text.contains(word));
        match self {
            Self { array: Some(_), .. } if about(&["point data", "named arrays"]) => &["volume", "array"],
            Self { spacing: Some(_), .. } if about(&["lattice", "axes", "spacing"]) => &["volume", "spacing"],
            Self { origin: Some(_), .. } if about(&["lattice", "origin"]) => &["volume", "origin"],
            _ => self.key(),
        }
    }

    /// Its one volume.
    pub(super) fn load(&self, folder: &Path, flags: &ReadOptions) -> Result<Volume> {
        self.check()?;
        match (&self.file, &self.generator) {
            (Some(file), None) => self.read(&folder.join(file), flags),
            (None, Some(_)) if flags.raw.given() || flags.array.is_some() => {
                let flag = if flags.array.is_some() { "--array" } else { "--raw-…" };
                Err(Error::Invalid(format!("{flag}: a generated volume has no file")))
            }
            (None, Some(name)) => {
                let mut volume = Generator::from_name(name)?.sample([self.size.unwrap_or(101); 3])?;
                volume.lattice = flags.or(self).place.of(volume.lattice, Path::new(name))?;
                Ok(volume)
            }
            _ => Err(Error::Invalid("[volume] needs either file or generator".into())),
        }
    }
}

impl PlaceOptions {
    /// Whether anything is set.
    pub fn given(&self) -> bool {
        *self != Self::default()
    }

    /// A lattice where this says; the directions of its axes stay, but for signs.
    ///
    /// # Errors
    /// `Invalid` for other than three numbers, and for a lattice that is none.
    pub fn of(&self, lattice: Lattice, path: &Path) -> Result<Lattice> {
        if !self.given() {
            return Ok(lattice);
        }
        let (axes, now) = (lattice.axes(), lattice.spacing());
        let origin = triple(&self.origin, "origin", path)?.unwrap_or(lattice.origin());
        let axes = triple(&self.spacing, "spacing", path)?.map_or(axes, |spacing| {
            let [x, y, z] = [0, 1, 2].map(|a| axes.col(a) / now[a] * spacing[a]);
            DMat3::from_cols(x, y, z)
        });
        Lattice::new(lattice.dims(), origin, axes).map_err(|e| e.in_file(path))
    }
}

fn triple(numbers: &Option<Vec<f64>>, name: &str, path: &Path) -> Result<Option<DVec3>> {
    match numbers.as_deref() {
        None => Ok(None),
        Some(&[x, y, z]) => Ok(Some(DVec3::new(x, y, z))),
        Some(v) => Err(Error::invalid(path, format!("{name} needs three numbers, found {}", v.len()))),
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
    #[arg(
        id = "raw-spacing",
        long = "raw-spacing",
        value_name = "DX,DY,DZ",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
    pub spacing: Option<Vec<f64>>,
    /// World position of the first sample of a headerless file (default: 0,0,0)
    #[arg(
        id = "raw-origin",
        long = "raw-origin",
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true
    )]
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
        let dims = match self.dims.as_deref() {
            Some(&[x, y, z]) => [x, y, z],
            Some(v) => return Err(fail(&format!("dims needs three counts, found {}", v.len()))),
            None if self.element.is_none() && self.endian.is_none() && self.skip.is_none() => {
                return Err(fail("spacing and origin alone; of files with a header --spacing and --origin say them"));
            }
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
        layout.spacing = triple(&self.spacing, "raw layout: spacing", path)?.unwrap_or(DVec3::ONE);
        layout.origin = triple(&self.origin, "raw layout: origin", path)?.unwrap_or(DVec3::ZERO);
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
