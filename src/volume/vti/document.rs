//! A VTK XML document whose arrays are appended: raw, 64-bit headers, zlib blocks. The arrays are borrowed and never
//! copied whole. \[VTK\]

use super::SamplesRef;
use super::writer::Values;
use crate::atomic::AtomicFile;
use crate::error::Result;
use crate::files;
use crate::volume::ElementType;
use rayon::prelude::*;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

/// Unpacked bytes of a block.
pub(super) const BLOCK: usize = 1 << 20;

/// Blocks packed at once: a writer holds two batches, one raw and packed, one packed.
const BATCH: usize = 16;

/// Text and arrays of a document, in order. The same content gives the same bytes, for every number of threads.
pub(crate) struct Document<'a> {
    text: String,
    /// Where in the text each array's offset is to be filled in.
    slots: Vec<usize>,
    arrays: Vec<Values<'a>>,
}

impl<'a> Document<'a> {
    /// The begin of a file of one of VTK's data sets.
    pub(crate) fn new(kind: &str) -> Self {
        let text = format!(
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"{kind}\" version=\"1.0\" byte_order=\"LittleEndian\" \
             header_type=\"UInt64\" compressor=\"vtkZLibDataCompressor\">\n"
        );
        Self { text, slots: vec![], arrays: vec![] }
    }

    /// Adds XML as it is.
    pub(crate) fn text(&mut self, text: &str) {
        self.text += text;
    }

    /// Adds a text of field data as VTK writes it: signed character codes.
    pub(crate) fn string(&mut self, name: &str, text: &str) {
        let codes: Vec<String> = text.bytes().map(|c| (c as i8).to_string()).collect();
        self.text += &format!(
            "      <Array type=\"String\" Name=\"{}\" NumberOfTuples=\"1\" format=\"ascii\">\n        {} 0\n      </Array>\n",
            escape(name),
            codes.join(" ")
        );
    }

    /// Adds a `<DataArray>`, with further attributes after a space each.
    pub(crate) fn array(&mut self, name: &str, components: usize, samples: SamplesRef<'a>, attributes: &str) {
        self.values(name, components, Values::Stored(samples), attributes);
    }

    /// As [`Document::array`], of values that may be computed when they are written.
    pub(super) fn values(&mut self, name: &str, components: usize, samples: Values<'a>, attributes: &str) {
        let (kind, name) = (vtk_type(samples.element_type()), escape(name));
        self.text += &format!(
            "      <DataArray type=\"{kind}\" Name=\"{name}\"{attributes} NumberOfComponents=\"{components}\" \
             format=\"appended\" offset=\""
        );
        self.slots.push(self.text.len());
        self.arrays.push(samples);
        // Room for any 64-bit offset and the closing quote; XML ignores the spaces that stay.
        self.text += &format!("{:21}/>\n", "");
    }

    /// Writes the file; it appears under its name only when it is complete. No array may be empty: VTK 9.7's reader was
    /// seen to crash on one.
    ///
    /// # Errors
    /// `Io`.
    pub(crate) fn write(self, path: &Path) -> Result<()> {
        self.complete(path)?.commit()
    }

    /// As [`Document::write`], but the file's name is left to the caller.
    ///
    /// # Errors
    /// `Io`.
    pub(super) fn complete(mut self, path: &Path) -> Result<AtomicFile> {
        self.text("  <AppendedData encoding=\"raw\">\n   _");
        files::completed(path, |out| {
            out.write_all(self.text.as_bytes())?;
            let data = self.text.len() as u64;
            let mut offsets = Vec::with_capacity(self.slots.len());
            let mut end = data;
            for samples in &self.arrays {
                offsets.push(end - data);
                // The sizes of the packed blocks stand before them, but are known after.
                let length = samples.len() * samples.element_type().size();
                let blocks = length.div_ceil(BLOCK);
                let mut header = vec![blocks as u64, BLOCK as u64, (length % BLOCK) as u64];
                let start = end;
                end += 8 * (header.len() + blocks) as u64;
                out.seek(SeekFrom::Start(end))?;
                let pack = |first: usize| -> std::io::Result<Vec<Vec<u8>>> {
                    (first.min(blocks)..blocks.min(first + BATCH)).into_par_iter().map(|b| samples.pack(b)).collect()
                };
                let mut packed = pack(0)?;
                for next in (BATCH..blocks + BATCH).step_by(BATCH) {
                    for block in &packed {
                        header.push(block.len() as u64);
                        end += block.len() as u64;
                    }
                    // The next batch is packed while this one is written.
                    let write = || packed.iter().try_for_each(|block| out.write_all(block));
                    let (written, behind) = rayon::join(write, || pack(next));
                    written?;
                    packed = behind?;
                }
                out.seek(SeekFrom::Start(start))?;
                out.write_all(&header.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<_>>())?;
                out.seek(SeekFrom::Start(end))?;
            }
            out.write_all(b"\n  </AppendedData>\n</VTKFile>\n")?;
            for (slot, offset) in self.slots.iter().zip(offsets) {
                out.seek(SeekFrom::Start(*slot as u64))?;
                write!(out, "{offset}\"")?;
            }
            Ok(())
        })
    }
}

/// VTK's name of a type.
fn vtk_type(element: ElementType) -> &'static str {
    match element {
        ElementType::U8 => "UInt8",
        ElementType::I8 => "Int8",
        ElementType::U16 => "UInt16",
        ElementType::I16 => "Int16",
        ElementType::U32 => "UInt32",
        ElementType::I32 => "Int32",
        ElementType::U64 => "UInt64",
        ElementType::I64 => "Int64",
        ElementType::F32 => "Float32",
        ElementType::F64 => "Float64",
    }
}

/// Whether XML cannot hold a character in an attribute as it is.
pub(crate) fn is_foreign(c: char) -> bool {
    c < ' ' || matches!(c, '\u{fffe}' | '\u{ffff}')
}

/// Text for an XML attribute; what [`is_foreign`] becomes a space.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            c if is_foreign(c) => out.push(' '),
            c => out.push(c),
        }
    }
    out
}
