//! Stacks of pictures (`.tif`, `.tiff`, and one such in a `.zip`), a page per slice: ImageJ's, OME's and plain ones.
//!
//! Sample (i, j, k) is column i, row j from the top, page k; rows run downwards, so y does too, as in ImageJ and ITK.

mod directories;
mod ome;
mod place;
mod tiles;

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume};
use glam::DVec3;
use place::Place;
use rayon::prelude::*;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;
use tiff::decoder::{ChunkType, Decoder, DecodingResult, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError, TiffResult};

/// A text longer than this is not read for a spacing.
const TEXT_LIMIT: usize = 16 << 20;

/// Reads all pages as one volume: grey, integers of 8 to 64 bits or floats (16-bit ones stored as f32), not packed or
/// by LZW, Deflate or PackBits.
///
/// World units are the spacing's: `spacing=` and the resolution of ImageJ; micrometres from `PhysicalSizeX`, `Y` and
/// `Z` of OME, whose units are converted (units without a length, such as `pixel`, are kept if all axes have the same).
/// Otherwise, and where a step is missing, it is 1; the resolution of other programs is one of paper and is left aside.
/// Origin 0.
///
/// # Errors
/// `Io`; `Invalid` for broken or truncated pages, and for OME's steps in units that do not go together; `NotSupported`
/// for pages that differ, for colours, series of channels or times, other numbers or orders of pages than OME's text
/// tells, and for pages that are stored mirrored or turned (upside down is read).
pub fn read(path: &Path) -> Result<Volume> {
    if files::has_extension(path, "zip") {
        decode(Cursor::new(unzip(path)?), path)
    } else {
        decode(BufReader::new(files::open(path)?), path)
    }
}

/// The only TIFF in a zip archive, unpacked.
fn unzip(path: &Path) -> Result<Vec<u8>> {
    let broken = |e: zip::result::ZipError| Error::invalid(path, format!("is no zip archive that can be read: {e}"));
    let mut archive = zip::ZipArchive::new(BufReader::new(files::open(path)?)).map_err(broken)?;
    let mut names = Vec::new();
    for name in archive.file_names() {
        let name = name.map_err(broken)?.into_owned();
        let lower = name.to_ascii_lowercase();
        // macOS adds shadows of the files.
        if (lower.ends_with(".tif") || lower.ends_with(".tiff")) && !lower.starts_with("__macosx") {
            names.push(name);
        }
    }
    let [name] = &names[..] else {
        return Err(Error::not_supported(path, format!("holds {} TIFF files; it must hold one", names.len())));
    };
    let mut unpack = |out: &mut dyn Write| {
        let mut entry = archive.by_name(name).map_err(broken)?;
        let promised = entry.size();
        // At its end the checksum is compared.
        match std::io::copy(&mut entry.by_ref().take(promised.saturating_add(1)), out) {
            Ok(n) if n == promised => Ok(promised),
            Ok(n) => Err(Error::invalid(path, format!("`{name}`: {promised} bytes promised, {n} found"))),
            Err(e) if e.kind() == std::io::ErrorKind::Unsupported => {
                Err(Error::not_supported(path, format!("`{name}`: {e}; zip it with Deflate")))
            }
            Err(e) => Err(Error::invalid(path, format!("`{name}` is cut short or damaged: {e}"))),
        }
    };
    // Nothing is kept before it is known that all of it is there.
    let promised = unpack(&mut std::io::sink())?;
    let mut bytes = Vec::with_capacity(usize::try_from(promised).unwrap_or(usize::MAX));
    unpack(&mut bytes)?;
    Ok(bytes)
}

/// Samples of the pages read so far, as native bytes.
struct Pages {
    element: ElementType,
    size: (u32, u32),
    rows: Rows,
    bytes: Vec<u8>,
    count: usize,
}

/// In which order a page stores its rows.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Rows {
    FromTop,
    FromBottom,
}

/// Why a page is not read.
enum Refusal {
    Decoder(TiffError),
    Invalid(String),
    NotSupported(String),
}

impl From<TiffError> for Refusal {
    fn from(e: TiffError) -> Self {
        Self::Decoder(e)
    }
}

impl Refusal {
    /// As the error of a file's page.
    fn of(self, path: &Path, page: usize) -> Error {
        use std::io::ErrorKind as K;
        match self {
            // What the system refused is named as such; a file that ends early is not.
            Self::Decoder(TiffError::IoError(e)) => match e.kind() {
                K::UnexpectedEof | K::InvalidData | K::InvalidInput => {
                    Error::invalid(path, format!("page {page}: the file is cut short or damaged"))
                }
                _ => Error::io(path, e),
            },
            Self::Decoder(TiffError::UnsupportedError(e)) => Error::not_supported(path, format!("page {page}: {e}")),
            Self::Decoder(e) => Error::invalid(path, format!("page {page}: {e}")),
            Self::Invalid(message) => Error::invalid(path, format!("page {page} {message}")),
            Self::NotSupported(message) => Error::not_supported(path, format!("page {page} {message}")),
        }
    }
}

fn decode<R: Read + Seek>(mut reader: R, path: &Path) -> Result<Volume> {
    let io = |e| Error::io(path, e);
    let length = reader.seek(SeekFrom::End(0)).map_err(io)?;
    if let Some((tag, count)) = directories::excessive(&mut reader, files::trusted(length)) {
        let message = format!("tag {tag} promises {count} values, but the file has {length} bytes; it is damaged");
        return Err(Error::invalid(path, message));
    }
    reader.rewind().map_err(io)?;
    let first = |e: TiffError| Refusal::from(e).of(path, 0);
    let mut decoder = Decoder::new(&mut reader).map_err(first)?.with_limits(limits(length, 0));
    let place = Place::of(&mut decoder).map_err(|message| Error::invalid(path, message))?;
    let starts = decoder.find_tag_unsigned_vec::<u64>(Tag::StripOffsets).map_err(first)?;
    let order = decoder.byte_order();
    let mut page = 0;
    let mut pages = read_pages(decoder, length, &mut page).map_err(|refusal| refusal.of(path, page))?;
    let samples = u64::from(pages.size.0) * u64::from(pages.size.1);
    place.check(pages.count, samples).map_err(|message| Error::not_supported(path, message))?;
    let (element, (width, height)) = (pages.element, pages.size);
    let mut endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };
    // ImageJ writes stacks beyond 4 GB as one page with all samples behind it.
    if pages.count == 1
        && place.images > 1
        && let Some(&start) = starts.iter().flatten().next()
    {
        let promised = (pages.bytes.len() as u64).saturating_mul(place.images as u64);
        let held = length.saturating_sub(start);
        if promised > held {
            let images = place.images;
            return Err(Error::invalid(
                path,
                format!("{images} images of {promised} bytes in all promised, {held} found; it is cut short"),
            ));
        }
        pages.bytes.resize(promised as usize, 0);
        reader.seek(SeekFrom::Start(start)).and_then(|_| reader.read_exact(&mut pages.bytes)).map_err(io)?;
        pages.count = place.images;
        endian = if order == tiff::tags::ByteOrder::BigEndian { Endian::Big } else { Endian::Little };
    }
    let dims = [width as usize, height as usize, pages.count];
    if pages.rows == Rows::FromBottom {
        let row = dims[0] * element.size();
        pages.bytes.par_chunks_exact_mut(row * dims[1]).for_each(|page| {
            let (above, below) = page.split_at_mut(dims[1] / 2 * row);
            let below = below.chunks_exact_mut(row).rev();
            above.chunks_exact_mut(row).zip(below).for_each(|(a, b)| a.swap_with_slice(b));
        });
    }
    let lattice = Lattice::aligned(dims, DVec3::ZERO, place.spacing).map_err(|e| e.in_file(path))?;
    let samples = place.calibrated(Samples::from_vec(pages.bytes, element, endian));
    let samples = samples.map_err(|message| Error::not_supported(path, message))?;
    Volume::new(path.display().to_string(), lattice, samples)
}

/// What a file of so many bytes may make the decoder hold, with `page` bytes for a page that is known to be there.
fn limits(length: u64, page: usize) -> Limits {
    let trusted = usize::try_from(files::trusted(length)).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = trusted.max(page);
    limits.intermediate_buffer_size = trusted;
    limits.ifd_value_size = TEXT_LIMIT;
    limits
}

/// All pages of a file of so many bytes; counts in `page`.
fn read_pages<R: Read + Seek>(mut decoder: Decoder<R>, length: u64, page: &mut usize) -> Result<Pages, Refusal> {
    let trusted = usize::try_from(files::trusted(length)).unwrap_or(usize::MAX);
    let mut pages: Option<Pages> = None;
    let mut stored = 0;
    loop {
        let (color, size) = (decoder.colortype()?, decoder.dimensions()?);
        if !matches!(color, ColorType::Gray(bits) if bits >= 8) {
            let message = format!("holds {color:?} samples; convert it to grey of 8 bits or more");
            return Err(Refusal::NotSupported(message));
        }
        let rows = rows(&mut decoder)?;
        // Pages that share their bytes would grow without end.
        let of_page = stored_bytes(&mut decoder)?;
        stored = of_page.saturating_add(stored);
        let held = pages.as_ref().map_or(0, |p| p.bytes.len());
        let wanted = decoder.image_buffer_layout()?.len;
        let plain = decoder.find_tag_unsigned::<u16>(Tag::Compression)?.unwrap_or(1) == 1;
        if stored > length || (plain && of_page < wanted as u64) {
            return Err(Refusal::Invalid(format!(
                "has {wanted} bytes of samples and promises {of_page} stored ones, with the pages before it {stored}, but \
                 the file has {length}; it is cut short or damaged"
            )));
        }
        let image = match tiles::unpacked(&mut decoder)? {
            Some(whole) => Decoder::new(Cursor::new(whole))?.with_limits(Limits::unlimited()).read_image()?,
            None => {
                if wanted > trusted - held.min(trusted) {
                    // Unpacked once without keeping it.
                    for chunk in 0..chunks(&mut decoder)? {
                        decoder.read_chunk(chunk)?;
                    }
                    decoder = decoder.with_limits(limits(length, wanted));
                }
                decoder.read_image()?
            }
        };
        let (element, mut bytes) = page_bytes(image);
        if decoder.find_tag_unsigned::<u16>(Tag::PhotometricInterpretation)? == Some(0) {
            if !matches!(element, ElementType::U8 | ElementType::U16 | ElementType::U32 | ElementType::U64) {
                let message = format!("shows 0 as white, in {}; save it with 0 as black", element.name());
                return Err(Refusal::NotSupported(message));
            }
            // That is how it is shown. What was measured stands in the file: the decoder's inversion is undone.
            bytes.iter_mut().for_each(|b| *b = !*b);
        }
        decoder = decoder.with_limits(limits(length, 0));
        match &mut pages {
            None => pages = Some(Pages { element, size, rows, bytes, count: 1 }),
            Some(p) if (p.element, p.size, p.rows) == (element, size, rows) => {
                p.bytes.extend_from_slice(&bytes);
                p.count += 1;
            }
            Some(p) => {
                let alike = |(w, h), element: ElementType, rows| {
                    let from = if rows == Rows::FromBottom { ", from the bottom" } else { "" };
                    format!("{w}×{h} of {}{from}", element.name())
                };
                let (own, first) = (alike(size, element, rows), alike(p.size, p.element, p.rows));
                return Err(Refusal::NotSupported(format!(
                    "is {own}, page 0 {first}; the pages of a volume are alike (leave thumbnails out)"
                )));
            }
        }
        if !decoder.more_images() {
            return Ok(pages.expect("there is a first page"));
        }
        decoder.next_image()?;
        *page += 1;
    }
}

/// How a page stores its rows; refuses bits and columns that run backward, which the decoder does not look at.
fn rows<R: Read + Seek>(decoder: &mut Decoder<R>) -> Result<Rows, Refusal> {
    if let Some(order) = decoder.find_tag_unsigned::<u16>(Tag::FillOrder)?.filter(|order| *order != 1) {
        return Err(Refusal::NotSupported(format!(
            "stores the bits of each byte from the lowest (FillOrder {order}); save it anew with FillOrder 1"
        )));
    }
    match decoder.find_tag_unsigned::<u16>(Tag::Orientation)?.unwrap_or(1) {
        // What is no orientation is none, as libtiff has it.
        0 | 1 | 9.. => Ok(Rows::FromTop),
        4 => Ok(Rows::FromBottom),
        turned => Err(Refusal::NotSupported(format!(
            "is stored mirrored or turned (Orientation {turned}); save it anew with rows from the top (1)"
        ))),
    }
}

/// Bytes that the strips or tiles of a page take in the file.
fn stored_bytes<R: Read + Seek>(decoder: &mut Decoder<R>) -> TiffResult<u64> {
    let tag = match decoder.get_chunk_type() {
        ChunkType::Strip => Tag::StripByteCounts,
        ChunkType::Tile => Tag::TileByteCounts,
    };
    let counts = decoder.find_tag_unsigned_vec::<u64>(tag)?.unwrap_or_default();
    Ok(counts.into_iter().fold(0, u64::saturating_add))
}

/// Strips or tiles of a page.
fn chunks<R: Read + Seek>(decoder: &mut Decoder<R>) -> TiffResult<u32> {
    match decoder.get_chunk_type() {
        ChunkType::Strip => decoder.strip_count(),
        ChunkType::Tile => decoder.tile_count(),
    }
}

/// A decoded page as native bytes.
fn page_bytes(mut page: DecodingResult) -> (ElementType, Vec<u8>) {
    use ElementType as T;
    let element = match &page {
        DecodingResult::U8(_) => T::U8,
        DecodingResult::I8(_) => T::I8,
        DecodingResult::U16(_) => T::U16,
        DecodingResult::I16(_) => T::I16,
        DecodingResult::U32(_) => T::U32,
        DecodingResult::I32(_) => T::I32,
        DecodingResult::U64(_) => T::U64,
        DecodingResult::I64(_) => T::I64,
        DecodingResult::F32(_) | DecodingResult::F16(_) => T::F32,
        DecodingResult::F64(_) => T::F64,
    };
    let bytes = match page {
        DecodingResult::U8(v) => v,
        DecodingResult::F16(v) => v.into_iter().flat_map(|h| h.to_f32().to_ne_bytes()).collect(),
        _ => page.as_buffer(0).as_bytes().to_vec(),
    };
    (element, bytes)
}

#[cfg(test)]
mod tests;
