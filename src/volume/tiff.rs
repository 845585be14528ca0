//! Stacks of pictures (`.tif`, `.tiff`, and one such in a `.zip`), a page per slice: ImageJ's, OME's and plain ones.
//!
//! Sample (i, j, k) is column i, row j from the top, page k; rows run downwards, so y does too, as in ImageJ and ITK.

mod directories;
mod ome;

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume};
use glam::DVec3;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;
use tiff::decoder::ifd::Value;
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
/// `Io`; `Invalid` for broken or truncated pages, for pages that differ, and for OME's steps in units that do not go
/// together; `NotSupported` for colours and series of channels or times.
pub fn read(path: &Path) -> Result<Volume> {
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip")) {
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
    bytes: Vec<u8>,
    count: usize,
}

fn decode<R: Read + Seek>(mut reader: R, path: &Path) -> Result<Volume> {
    let io = |e| Error::io(path, e);
    let length = reader.seek(SeekFrom::End(0)).map_err(io)?;
    if let Some((tag, count)) = directories::excessive(&mut reader, files::trusted(length)) {
        let message = format!("tag {tag} promises {count} values, but the file has {length} bytes; it is damaged");
        return Err(Error::invalid(path, message));
    }
    reader.rewind().map_err(io)?;
    let trusted = usize::try_from(files::trusted(length)).unwrap_or(usize::MAX);
    let mut limits = Limits::default();
    limits.decoding_buffer_size = trusted;
    limits.intermediate_buffer_size = trusted;
    limits.ifd_value_size = TEXT_LIMIT;

    let mut page = 0;
    let decoded = (|| -> TiffResult<_> {
        let mut decoder = Decoder::new(&mut reader)?.with_limits(limits.clone());
        let place = match Place::of(&mut decoder) {
            Ok(place) => place,
            Err(message) => return Ok(Err(Error::invalid(path, message))),
        };
        let start = decoder.find_tag_unsigned_vec::<u64>(Tag::StripOffsets)?.and_then(|o| o.first().copied());
        let order = decoder.byte_order();
        let mut pages: Option<Pages> = None;
        let mut stored = 0;
        loop {
            let (color, size) = (decoder.colortype()?, decoder.dimensions()?);
            if !matches!(color, ColorType::Gray(bits) if bits >= 8) {
                let message = format!("page {page} holds {color:?} samples; convert it to grey of 8 bits or more");
                return Ok(Err(Error::not_supported(path, message)));
            }
            // Pages that share their bytes would grow without end.
            let of_page = stored_bytes(&mut decoder)?;
            stored = of_page.saturating_add(stored);
            let held = pages.as_ref().map_or(0, |p| p.bytes.len());
            let wanted = decoder.image_buffer_layout()?.len;
            let plain = decoder.find_tag_unsigned::<u16>(Tag::Compression)?.unwrap_or(1) == 1;
            if stored > length || (plain && of_page < wanted as u64) {
                return Ok(Err(Error::invalid(
                    path,
                    format!(
                        "page {page} has {wanted} bytes of samples and promises {of_page} stored ones, with the pages before                          it {stored}, but the file has {length}; it is cut short or damaged"
                    ),
                )));
            }
            if wanted > trusted - held.min(trusted) {
                // Unpacked once without keeping it.
                for chunk in 0..chunks(&mut decoder)? {
                    decoder.read_chunk(chunk)?;
                }
                limits.decoding_buffer_size = wanted.max(trusted);
                decoder = decoder.with_limits(limits.clone());
            }
            let white_is_zero = decoder.find_tag_unsigned::<u16>(Tag::PhotometricInterpretation)? == Some(0);
            let (element, mut bytes) = page_bytes(decoder.read_image()?);
            if white_is_zero {
                if !matches!(element, ElementType::U8 | ElementType::U16 | ElementType::U32 | ElementType::U64) {
                    let message =
                        format!("page {page} shows 0 as white, in {}; save it with 0 as black", element.name());
                    return Ok(Err(Error::not_supported(path, message)));
                }
                // That is how it is shown. What was measured stands in the file: the decoder's inversion is undone.
                bytes.iter_mut().for_each(|b| *b = !*b);
            }
            limits.decoding_buffer_size = trusted;
            decoder = decoder.with_limits(limits.clone());
            match &mut pages {
                None => pages = Some(Pages { element, size, bytes, count: 1 }),
                Some(p) if (p.element, p.size) == (element, size) => {
                    p.bytes.extend_from_slice(&bytes);
                    p.count += 1;
                }
                Some(p) => {
                    let ((w, h), (nw, nh), kind) = (p.size, size, (p.element.name(), element.name()));
                    let message = format!(
                        "page {page} is {nw}×{nh} of {}, page 0 {w}×{h} of {}; the pages of a volume are alike (leave \
                         thumbnails out)",
                        kind.1, kind.0
                    );
                    return Ok(Err(Error::not_supported(path, message)));
                }
            }
            if !decoder.more_images() {
                break;
            }
            decoder.next_image()?;
            page += 1;
        }
        Ok(Ok((pages.expect("there is a first page"), place, start, order)))
    })();
    let (mut pages, place, start, order) = match decoded {
        Ok(Ok(all)) => all,
        Ok(Err(error)) => return Err(error),
        // What the system refused is named as such; a file that ends early is not.
        Err(TiffError::IoError(e)) if e.kind() != std::io::ErrorKind::UnexpectedEof => return Err(io(e)),
        Err(TiffError::IoError(_)) => return Err(Error::invalid(path, format!("page {page}: the file is cut short"))),
        Err(TiffError::UnsupportedError(e)) => return Err(Error::not_supported(path, format!("page {page}: {e}"))),
        Err(e) => return Err(Error::invalid(path, format!("page {page}: {e}"))),
    };
    if place.channels * place.frames > 1 {
        return Err(Error::not_supported(
            path,
            format!("holds {} channels and {} times; save one of them as a stack", place.channels, place.frames),
        ));
    }
    let (element, (width, height)) = (pages.element, pages.size);
    let mut endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };
    // ImageJ writes stacks beyond 4 GB as one page with all samples behind it.
    if pages.count == 1
        && place.images > 1
        && let Some(start) = start
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
    let lattice = Lattice::aligned(dims, DVec3::ZERO, place.spacing).map_err(|e| e.in_file(path))?;
    Volume::new(path.display().to_string(), lattice, Samples::from_vec(pages.bytes, element, endian))
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

/// What a file's texts say about the stack.
#[derive(Debug, PartialEq)]
struct Place {
    spacing: DVec3,
    images: usize,
    channels: usize,
    frames: usize,
}

impl Place {
    /// From the first page's tags; texts that are missing or not understood leave the defaults.
    /// The error is a message without the file's name.
    fn of<R: Read + Seek>(decoder: &mut Decoder<R>) -> Result<Self, String> {
        let mut place = Self { spacing: DVec3::ONE, images: 1, channels: 1, frames: 1 };
        let text = decoder.get_tag(Tag::ImageDescription).and_then(Value::into_string).unwrap_or_default();
        if let Some(lines) = text.strip_prefix("ImageJ=") {
            let steps = [Tag::XResolution, Tag::YResolution].map(|tag| match decoder.get_tag(tag) {
                // Samples per unit.
                Ok(Value::Rational(n, d)) if n > 0 && d > 0 => f64::from(d) / f64::from(n),
                _ => 1.0,
            });
            place.imagej(lines, steps);
        } else if text.contains("<OME") {
            place.ome(&text)?;
        }
        Ok(place)
    }

    fn imagej(&mut self, lines: &str, [x, y]: [f64; 2]) {
        let value = |key: &str| lines.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix('='));
        let count = |key: &str| value(key).and_then(|v| v.trim().parse().ok()).unwrap_or(1);
        let z = value("spacing").and_then(|v| v.trim().parse::<f64>().ok()).filter(|v| v.is_finite() && *v != 0.0);
        // ImageJ writes a negative step for a stack that was made from the far end.
        self.spacing = DVec3::new(x, y, z.unwrap_or(1.0).abs());
        (self.images, self.channels, self.frames) = (count("images"), count("channels"), count("frames"));
    }

    fn ome(&mut self, text: &str) -> Result<(), String> {
        let Ok(document) = files::xml(text.trim_end_matches('\0')) else { return Ok(()) };
        let Some(pixels) = document.descendants().find(|n| n.tag_name().name() == "Pixels") else { return Ok(()) };
        let count = |key: &str| pixels.attribute(key).and_then(|v| v.parse().ok()).unwrap_or(1);
        self.spacing = ome::spacing(pixels)?;
        (self.channels, self.frames) = (count("SizeC"), count("SizeT"));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;
    use tiff::encoder::colortype::{self, ColorType as Colour};
    use tiff::encoder::{Rational, TiffEncoder, TiffValue};

    /// Pages of 3×2 samples that count up.
    fn stack<C: Colour>(pages: usize, description: &str, sample: impl Fn(usize) -> C::Inner) -> Vec<u8>
    where
        [C::Inner]: TiffValue,
    {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        for page in 0..pages {
            let mut image = encoder.new_image::<C>(3, 2).unwrap();
            if page == 0 && !description.is_empty() {
                image.encoder().write_tag(Tag::ImageDescription, description).unwrap();
                image.x_resolution(Rational { n: 4, d: 1 });
                image.y_resolution(Rational { n: 5, d: 2 });
            }
            let data: Vec<C::Inner> = (0..6).map(|i| sample(6 * page + i)).collect();
            image.write_data(&data).unwrap();
        }
        bytes.into_inner()
    }

    fn open(bytes: &[u8]) -> Result<Volume> {
        decode(Cursor::new(bytes), Path::new("a.tif"))
    }

    fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
        let mut w = zip::ZipWriter::new(Cursor::new(Vec::new()));
        for (name, bytes) in files {
            w.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
            w.write_all(bytes).unwrap();
        }
        w.finish().unwrap().into_inner()
    }

    /// Shown inverted or not, samples are what the file holds.
    #[test]
    fn white_as_zero_changes_no_sample() {
        // Entry 262 of a directory: one 16-bit number.
        let entry = |value: u8| [6, 1, 3, 0, 1, 0, 0, 0, value, 0, 0, 0];
        let inverted = |mut bytes: Vec<u8>| {
            let at = |bytes: &[u8]| bytes.windows(12).position(|w| w == entry(1));
            let mut pages = 0;
            while let Some(at) = at(&bytes) {
                bytes[at..at + 12].copy_from_slice(&entry(0));
                pages += 1;
            }
            assert_eq!(pages, 2);
            bytes
        };
        let sample = |i: usize| (10 * i) as u8;
        for bytes in [
            stack::<colortype::Gray8>(2, "", sample),
            stack::<colortype::Gray16>(2, "", |i| u16::from(sample(i))),
            stack::<colortype::Gray32>(2, "", |i| u32::from(sample(i))),
        ] {
            let v = open(&inverted(bytes)).unwrap();
            assert!((0..12).all(|i| v.value(i) == f64::from(sample(i))), "{:?}", v.samples().element_type());
        }
        let floats = inverted(stack::<colortype::Gray32Float>(2, "", |i| i as f32));
        assert!(open(&floats).unwrap_err().to_string().contains("a.tif: page 0 shows 0 as white"));
    }

    #[test]
    fn pages_are_slices_of_every_type() {
        let check = |bytes: Vec<u8>, element: ElementType| {
            let v = open(&bytes).unwrap();
            assert_eq!((v.lattice.dims(), v.samples().element_type()), ([3, 2, 2], element));
            assert!((0..12).all(|i| v.value(i) == 10.0 * i as f64), "{element:?}");
            assert_eq!(v.lattice.spacing(), DVec3::ONE);
            for cut in [1, bytes.len() / 2, bytes.len() - 9] {
                assert!(open(&bytes[..bytes.len() - cut]).is_err(), "{element:?} without its last {cut} bytes");
            }
        };
        check(stack::<colortype::Gray8>(2, "", |i| 10 * i as u8), ElementType::U8);
        check(stack::<colortype::Gray16>(2, "", |i| 10 * i as u16), ElementType::U16);
        check(stack::<colortype::Gray32>(2, "", |i| 10 * i as u32), ElementType::U32);
        check(stack::<colortype::GrayI16>(2, "", |i| 10 * i as i16), ElementType::I16);
        check(stack::<colortype::Gray32Float>(2, "", |i| 10.0 * i as f32), ElementType::F32);
        check(stack::<colortype::Gray64Float>(2, "", |i| 10.0 * i as f64), ElementType::F64);
    }

    #[test]
    fn imagej_and_ome_say_where() {
        let gray = |pages, text: &str| stack::<colortype::Gray8>(pages, text, |i| i as u8);
        let v = open(&gray(2, "ImageJ=1.53f\nimages=2\nslices=2\nunit=micron\nspacing=1.5\n")).unwrap();
        assert_eq!(v.lattice.spacing(), DVec3::new(0.25, 0.4, 1.5));
        let ome = "<?xml version='1.0'?><OME xmlns='o'><Image><Pixels SizeC='1' SizeT='1' SizeZ='2' PhysicalSizeX='0.5' \
                   PhysicalSizeZ='2'/></Image></OME>";
        assert_eq!(open(&gray(2, ome)).unwrap().lattice.spacing(), DVec3::new(0.5, 1.0, 2.0));
        // Another program's resolution is one of paper.
        assert_eq!(open(&gray(2, "made by hand")).unwrap().lattice.spacing(), DVec3::ONE);
        for text in ["ImageJ=1\nimages=2\nchannels=2\n", &ome.replace("SizeT='1'", "SizeT='2'")] {
            assert!(open(&gray(2, text)).unwrap_err().to_string().contains("channels"), "{text}");
        }
    }

    #[test]
    fn ome_steps_have_units() {
        let of = |units: &str| {
            let text = format!(
                "<OME><Image><Pixels PhysicalSizeX='0.5' PhysicalSizeY='0.5' PhysicalSizeZ='2000' \
                 {units}/></Image></OME>"
            );
            open(&stack::<colortype::Gray8>(2, &text, |i| i as u8)).map(|v| v.lattice.spacing())
        };
        let z = "PhysicalSizeZUnit='nm'";
        assert_eq!(of(z).unwrap(), DVec3::new(0.5, 0.5, 2.0));
        assert_eq!(of(&format!("{z} PhysicalSizeXUnit='&#xb5;m'")).unwrap(), DVec3::new(0.5, 0.5, 2.0));
        let message = of("PhysicalSizeZUnit='pixel'").unwrap_err().to_string();
        assert!(message.contains("a.tif") && message.contains("PhysicalSizeZUnit is `pixel`"), "{message}");
    }

    /// As ImageJ writes stacks beyond 4 GB: one page of 3×2 16-bit samples, the other images behind its strip.
    fn one_page(big: bool, images: usize, samples: u16) -> Vec<u8> {
        let text = format!("ImageJ=1.53f\nimages={images}\nslices={images}\n\0");
        let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        let long = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        let data = 8 + 2 + 10 * 12 + 4;
        let start = data + text.len() as u32;
        let mut bytes = if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() };
        bytes.extend(long(8));
        bytes.extend(short(10));
        for (tag, kind, count, value) in [
            (256, 3, 1, 3),
            (257, 3, 1, 2),
            (258, 3, 1, 16),
            (259, 3, 1, 1),
            (262, 3, 1, 1),
            (270, 2, text.len() as u32, data),
            (273, 4, 1, start),
            (277, 3, 1, 1),
            (278, 3, 1, 2),
            (279, 4, 1, 12),
        ] {
            bytes.extend(short(tag));
            bytes.extend(short(kind));
            bytes.extend(long(count));
            match kind {
                3 => bytes.extend([short(value as u16), [0; 2]].concat()),
                _ => bytes.extend(long(value)),
            }
        }
        bytes.extend(long(0));
        bytes.extend(text.as_bytes());
        (0..samples).for_each(|i| bytes.extend(short(300 * i)));
        bytes
    }

    #[test]
    fn one_page_with_the_stack_behind_it() {
        for big in [false, true] {
            let v = open(&one_page(big, 3, 18)).unwrap();
            assert_eq!(v.samples(), &Samples::U16((0..18).map(|i| 300 * i).collect()));
            assert_eq!(v.lattice.dims(), [3, 2, 3]);
            assert!(open(&one_page(big, 3, 17)).unwrap_err().to_string().contains("cut short"));
            assert!(open(&one_page(big, usize::MAX, 17)).unwrap_err().to_string().contains("cut short"));
        }
    }

    #[test]
    fn one_stack_in_a_zip() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tif.zip");
        let tif = stack::<colortype::Gray8>(2, "", |i| i as u8);
        let bytes = zip(&[("notes.txt", b"x"), ("in/s.TIF", &tif), ("__MACOSX/._s.tif", b"y")]);
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path).unwrap().samples(), &Samples::U8((0..12).collect()));
        std::fs::write(&path, zip(&[("a.tif", &tif), ("b.tif", &tif)])).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("2 TIFF files"));
        let mut damaged = bytes.clone();
        let at = bytes.windows(8).position(|w| w == b"in/s.TIF").unwrap() + 20;
        damaged[at] ^= 0x55;
        std::fs::write(&path, &damaged).unwrap();
        assert!(matches!(read(&path), Err(Error::Invalid(_))));
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("zip"));
    }

    #[test]
    fn what_is_no_grey_stack_is_refused() {
        let refused = |bytes: Vec<u8>, words: &str| {
            let message = open(&bytes).unwrap_err().to_string();
            assert!(message.contains(words) && message.starts_with("a.tif: "), "{words}: {message}");
        };
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        encoder.write_image::<colortype::Gray8>(3, 2, &[0; 6]).unwrap();
        encoder.write_image::<colortype::Gray8>(2, 2, &[0; 4]).unwrap();
        refused(bytes.into_inner(), "page 1 is 2×2");
        let mut bytes = Cursor::new(Vec::new());
        TiffEncoder::new(&mut bytes).unwrap().write_image::<colortype::RGB8>(3, 2, &[0; 18]).unwrap();
        refused(bytes.into_inner(), "RGB");
        refused(stack::<colortype::Gray8>(1, "", |i| i as u8), "flatland");
        refused(b"II*\0rubbish".to_vec(), "page 0");
    }
}
