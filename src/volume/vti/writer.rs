//! Writes `.vti`, with appended zlib blocks.

use super::document::{BLOCK, Document, escape};
use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use crate::volume::{ElementType, Lattice, Samples};
use flate2::{Compression, write::ZlibEncoder};
use std::io::Write;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

/// Borrowed values of one of the types VTK knows.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs, reason = "the variants are the element types")]
pub enum SamplesRef<'a> {
    U8(&'a [u8]),
    I8(&'a [i8]),
    U16(&'a [u16]),
    I16(&'a [i16]),
    U32(&'a [u32]),
    I32(&'a [i32]),
    U64(&'a [u64]),
    I64(&'a [i64]),
    F32(&'a [f32]),
    F64(&'a [f64]),
}

/// Runs `$body` with `$v` bound to the slice, and the same for conversions into [`SamplesRef`].
macro_rules! each_type {
    ($samples:expr, $v:ident => $body:expr) => {
        match $samples {
            SamplesRef::U8($v) => $body,
            SamplesRef::I8($v) => $body,
            SamplesRef::U16($v) => $body,
            SamplesRef::I16($v) => $body,
            SamplesRef::U32($v) => $body,
            SamplesRef::I32($v) => $body,
            SamplesRef::U64($v) => $body,
            SamplesRef::I64($v) => $body,
            SamplesRef::F32($v) => $body,
            SamplesRef::F64($v) => $body,
        }
    };
}

macro_rules! conversions {
    ($($variant:ident $t:ty),*) => {
        $(impl<'a> From<&'a [$t]> for SamplesRef<'a> {
            fn from(v: &'a [$t]) -> Self {
                SamplesRef::$variant(v)
            }
        })*

        impl<'a> From<&'a Samples> for SamplesRef<'a> {
            fn from(samples: &'a Samples) -> Self {
                match samples {
                    $(Samples::$variant(v) => SamplesRef::$variant(v),)*
                }
            }
        }

        impl SamplesRef<'_> {
            /// The element type.
            pub fn element_type(&self) -> ElementType {
                match self {
                    $(SamplesRef::$variant(_) => ElementType::$variant,)*
                }
            }
        }
    };
}

conversions!(U8 u8, I8 i8, U16 u16, I16 i16, U32 u32, I32 i32, U64 u64, I64 i64, F32 f32, F64 f64);

impl SamplesRef<'_> {
    /// Number of values.
    pub fn len(&self) -> usize {
        each_type!(self, v => v.len())
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Value `i` as f32.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, reason = "that is what is asked for")]
    #[allow(clippy::unnecessary_cast, reason = "the macro's f32 arm casts to itself")]
    pub(crate) fn get_f32(&self, i: usize) -> f32 {
        each_type!(self, v => v[i] as f32)
    }

    /// Value `i` as f64.
    #[allow(clippy::cast_precision_loss, clippy::cast_lossless, reason = "64-bit integers are rounded")]
    #[allow(clippy::unnecessary_cast, reason = "the macro's f64 arm casts to itself")]
    pub(crate) fn get_f64(&self, i: usize) -> f64 {
        each_type!(self, v => v[i] as f64)
    }

    /// Whether there are `components` values per sample of a lattice; says so if not.
    pub(crate) fn check(&self, lattice: &Lattice, components: usize) -> Result<(), String> {
        let wanted = lattice.len().checked_mul(components);
        if wanted == Some(self.len()) && components > 0 {
            return Ok(());
        }
        let ([nx, ny, nz], n) = (lattice.dims(), self.len());
        Err(format!("{n} values for {nx}×{ny}×{nz} samples of {components} components"))
    }

    /// Writes all values, little-endian.
    pub(crate) fn write_le(&self, out: &mut impl Write) -> std::io::Result<()> {
        each_type!(self, v => v.iter().try_for_each(|s| out.write_all(&s.to_le_bytes())))
    }

    /// Values of a range, little-endian.
    fn raw(&self, range: Range<usize>) -> Vec<u8> {
        each_type!(self, v => v[range].iter().flat_map(|s| s.to_le_bytes()).collect())
    }
}

/// Values that are there, or computed when they are written, so that nobody holds them all.
#[derive(Clone)]
pub(super) enum Values<'a> {
    Stored(SamplesRef<'a>),
    F32(usize, Arc<dyn Fn(usize) -> f32 + Send + Sync + 'a>),
    U8(usize, Arc<dyn Fn(usize) -> u8 + Send + Sync + 'a>),
}

impl Values<'_> {
    pub(super) fn element_type(&self) -> ElementType {
        match self {
            Values::Stored(v) => v.element_type(),
            Values::F32(..) => ElementType::F32,
            Values::U8(..) => ElementType::U8,
        }
    }

    pub(super) fn len(&self) -> usize {
        match self {
            Values::Stored(v) => v.len(),
            Values::F32(n, _) | Values::U8(n, _) => *n,
        }
    }

    /// Block `b`, little-endian and packed.
    pub(super) fn pack(&self, b: usize) -> std::io::Result<Vec<u8>> {
        let per = BLOCK / self.element_type().size();
        let range = b * per..self.len().min((b + 1) * per);
        let raw: Vec<u8> = match self {
            Values::Stored(v) => v.raw(range),
            Values::F32(_, of) => range.flat_map(|i| of(i).to_le_bytes()).collect(),
            Values::U8(_, of) => range.map(|i| of(i)).collect(),
        };
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::fast());
        encoder.write_all(&raw)?;
        encoder.finish()
    }
}

struct Array<'a> {
    name: String,
    components: usize,
    samples: Values<'a>,
}

/// Collects what a `.vti` file is to hold, and writes it.
///
/// The same content gives the same bytes, for every number of threads. VTK, ParaView, PyVista and
/// [`super::VtiFile`] read it.
#[allow(missing_debug_implementations, reason = "holds functions")]
pub struct VtiWriter<'a> {
    lattice: &'a Lattice,
    point_data: Vec<Array<'a>>,
    field_data: Vec<Array<'a>>,
    field_strings: Vec<(String, String)>,
    active_scalars: Option<String>,
}

impl<'a> VtiWriter<'a> {
    /// A file without arrays.
    pub fn new(lattice: &'a Lattice) -> Self {
        Self { lattice, point_data: vec![], field_data: vec![], field_strings: vec![], active_scalars: None }
    }

    /// Adds an array with `components` values per lattice sample, components fastest.
    #[must_use]
    pub fn point_data(mut self, name: &str, components: usize, samples: impl Into<SamplesRef<'a>>) -> Self {
        self.point_data.push(Array { name: name.into(), components, samples: Values::Stored(samples.into()) });
        self
    }

    /// As [`VtiWriter::point_data`] of 32-bit floats, computed from their numbers when they are written.
    #[must_use]
    pub fn computed(mut self, name: &str, components: usize, of: impl Fn(usize) -> f32 + Send + Sync + 'a) -> Self {
        let samples = Values::F32(components * self.lattice.len(), Arc::new(of));
        self.point_data.push(Array { name: name.into(), components, samples });
        self
    }

    /// As [`VtiWriter::computed`], of bytes.
    #[must_use]
    pub fn computed_bytes(
        mut self,
        name: &str,
        components: usize,
        of: impl Fn(usize) -> u8 + Send + Sync + 'a,
    ) -> Self {
        let samples = Values::U8(components * self.lattice.len(), Arc::new(of));
        self.point_data.push(Array { name: name.into(), components, samples });
        self
    }

    /// Marks the point data that viewers colour by and [`crate::volume::Volume::open`] reads.
    #[must_use]
    pub fn active_scalars(mut self, name: &str) -> Self {
        self.active_scalars = Some(name.into());
        self
    }

    /// Adds a numeric array about the whole file, `components` values per tuple.
    #[must_use]
    pub fn field_data(mut self, name: &str, components: usize, samples: impl Into<SamplesRef<'a>>) -> Self {
        self.field_data.push(Array { name: name.into(), components, samples: Values::Stored(samples.into()) });
        self
    }

    /// Adds a text about the whole file.
    #[must_use]
    pub fn field_string(mut self, name: &str, text: &str) -> Self {
        self.field_strings.push((name.into(), text.into()));
        self
    }

    /// Writes the file; it appears under its name only when it is complete.
    ///
    /// # Errors
    /// `Invalid` if an array's length is not its components times the lattice's samples (of field data: a multiple of
    /// its components), if an array is empty, if the active scalars are none of the arrays, or if a text holds a 0
    /// character; `Io`.
    pub fn write(&self, path: &Path) -> Result<()> {
        self.complete(path)?.commit()
    }

    /// As [`VtiWriter::write`], but the file's name is left to the caller.
    ///
    /// # Errors
    /// As [`VtiWriter::write`].
    pub(crate) fn complete(&self, path: &Path) -> Result<AtomicFile> {
        self.check().map_err(|message| Error::invalid(path, message))?;
        let document = self.document();
        document.complete(path)
    }

    fn check(&self) -> Result<(), String> {
        // VTK 9.7's reader was seen to crash on an array without values.
        if let Some(a) = self.field_data.iter().chain(&self.point_data).find(|a| a.samples.len() == 0) {
            return Err(format!("array `{}` has no values, which VTK cannot read; leave it out", a.name));
        }
        for a in &self.point_data {
            if Some(a.samples.len()) != self.lattice.len().checked_mul(a.components) {
                return Err(format!(
                    "point data `{}` has {} values, but {} samples of {} components need {}",
                    a.name,
                    a.samples.len(),
                    self.lattice.len(),
                    a.components,
                    self.lattice.len().saturating_mul(a.components)
                ));
            }
        }
        for a in &self.field_data {
            if a.components == 0 || !a.samples.len().is_multiple_of(a.components) {
                let (name, n, c) = (&a.name, a.samples.len(), a.components);
                return Err(format!("field data `{name}` has {n} values, which are no tuples of {c} components"));
            }
        }
        if let Some(name) = self.active_scalars.as_ref().filter(|s| self.point_data.iter().all(|a| a.name != **s)) {
            return Err(format!("the active scalars `{name}` are none of the point data"));
        }
        match self.field_strings.iter().find(|(_, text)| text.contains('\0')) {
            Some((name, _)) => Err(format!("field text `{name}` holds a 0 character, which ends texts in VTK")),
            None => Ok(()),
        }
    }

    fn document(&self) -> Document<'_> {
        let l = self.lattice;
        let cells = l.cells();
        let extent = format!("0 {} 0 {} 0 {}", cells[0], cells[1], cells[2]);
        let (origin, spacing, axes) = (l.origin(), l.spacing(), l.axes());
        let diagonal = glam::DMat3::from_diagonal(spacing);
        let mut direction = String::new();
        if axes != diagonal {
            // Column a is the unit vector of axis a; VTK stores rows.
            let d = axes * glam::DMat3::from_diagonal(spacing.recip());
            let rows = d.transpose().to_cols_array().map(|v| v.to_string());
            direction = format!(" Direction=\"{}\"", rows.join(" "));
        }
        let mut d = Document::new("ImageData");
        d.text(&format!(
            "  <ImageData WholeExtent=\"{extent}\" Origin=\"{} {} {}\" Spacing=\"{} {} {}\"{direction}>\n    <FieldData>\n",
            origin.x, origin.y, origin.z, spacing.x, spacing.y, spacing.z
        ));
        for a in &self.field_data {
            let tuples = format!(" NumberOfTuples=\"{}\"", a.samples.len() / a.components);
            d.values(&a.name, a.components, a.samples.clone(), &tuples);
        }
        for (name, text) in &self.field_strings {
            d.string(name, text);
        }
        let scalars = self.active_scalars.as_ref().map(|s| format!(" Scalars=\"{}\"", escape(s))).unwrap_or_default();
        d.text(&format!("    </FieldData>\n    <Piece Extent=\"{extent}\">\n      <PointData{scalars}>\n"));
        for a in &self.point_data {
            d.values(&a.name, a.components, a.samples.clone(), "");
        }
        d.text("      </PointData>\n      <CellData/>\n    </Piece>\n  </ImageData>\n");
        d
    }
}
