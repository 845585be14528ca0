//! Tiles packed by LZW, unpacked whole.
//!
//! The decoder reads tiles that reach beyond the picture row by row, and takes a row that ends where a code does for
//! the end of the file (image-tiff, issue 395). So such pages are given to it with their tiles unpacked.

use std::io::{Read, Seek, SeekFrom};
use tiff::decoder::{ChunkType, Decoder};
use tiff::tags::{ByteOrder, CompressionMethod, Tag};
use tiff::{TiffError, TiffResult};
use weezl::decode::Decoder as Lzw;
use weezl::{BitOrder, LzwStatus};

/// What of a page's directory says how its samples stand in its tiles.
const KEPT: [Tag; 9] = [
    Tag::ImageWidth,
    Tag::ImageLength,
    Tag::BitsPerSample,
    Tag::PhotometricInterpretation,
    Tag::SamplesPerPixel,
    Tag::Predictor,
    Tag::TileWidth,
    Tag::TileLength,
    Tag::SampleFormat,
];

/// The page on which `decoder` stands, of one grey sample per pixel, as a BigTIFF of its own whose tiles are not
/// packed; `None` if they are not packed by LZW. Holds no more than there is.
///
/// # Errors
/// Of reading, with `UnexpectedEof` if a tile holds less than it should; `InvalidData` for what is not LZW.
pub(super) fn unpacked<R: Read + Seek>(decoder: &mut Decoder<R>) -> TiffResult<Option<Vec<u8>>> {
    let packing = decoder.find_tag_unsigned::<u16>(Tag::Compression)?.unwrap_or(1);
    if decoder.get_chunk_type() != ChunkType::Tile || packing != CompressionMethod::LZW.to_u16() {
        return Ok(None);
    }
    let numbers =
        |decoder: &mut Decoder<R>, tag| decoder.find_tag_unsigned_vec::<u64>(tag).map(Option::unwrap_or_default);
    let (starts, lengths) = (numbers(decoder, Tag::TileOffsets)?, numbers(decoder, Tag::TileByteCounts)?);
    let bits = decoder.find_tag_unsigned::<u64>(Tag::BitsPerSample)?.unwrap_or(1);
    let (width, height) = decoder.chunk_dimensions();
    let tile = (u64::from(width) * bits).div_ceil(8).saturating_mul(u64::from(height));

    let mut page = Page::new(decoder.byte_order());
    let mut begins = Vec::new();
    for (start, length) in starts.into_iter().zip(lengths) {
        begins.push(page.bytes.len() as u64);
        let mut packed = Vec::new();
        let reader = decoder.inner();
        reader.seek(SeekFrom::Start(start))?;
        reader.take(length).read_to_end(&mut packed)?;
        page.unpack(&packed, tile)?;
    }
    let mut entries = Vec::new();
    for tag in KEPT {
        entries.extend(decoder.find_tag_unsigned::<u64>(tag)?.map(|value| (tag, vec![value])));
    }
    entries.push((Tag::Compression, vec![1]));
    entries.push((Tag::TileByteCounts, vec![tile; begins.len()]));
    entries.push((Tag::TileOffsets, begins));
    Ok(Some(page.finish(entries)))
}

/// A BigTIFF with one page.
struct Page {
    order: ByteOrder,
    bytes: Vec<u8>,
}

impl Page {
    fn new(order: ByteOrder) -> Self {
        let mut page = Self { order, bytes: Vec::new() };
        page.bytes.extend(if order == ByteOrder::LittleEndian { b"II" } else { b"MM" });
        page.shorts([43, 8, 0]);
        // Where the directory stands.
        page.longs([0]);
        page
    }

    fn shorts<const N: usize>(&mut self, values: [u16; N]) {
        let little = self.order == ByteOrder::LittleEndian;
        self.bytes.extend(values.iter().flat_map(|v| if little { v.to_le_bytes() } else { v.to_be_bytes() }));
    }

    fn longs(&mut self, values: impl IntoIterator<Item = u64>) {
        let little = self.order == ByteOrder::LittleEndian;
        self.bytes.extend(values.into_iter().flat_map(|v| if little { v.to_le_bytes() } else { v.to_be_bytes() }));
    }

    /// Appends a tile of so many bytes. What stands behind it is not unpacked.
    fn unpack(&mut self, mut packed: &[u8], tile: u64) -> TiffResult<()> {
        let mut lzw = Lzw::with_tiff_size_switch(BitOrder::Msb, 8);
        let (mut missing, mut buffer) = (tile, [0; 1 << 14]);
        while missing > 0 {
            let room = usize::try_from(missing).unwrap_or(usize::MAX).min(buffer.len());
            let done = lzw.decode_bytes(packed, &mut buffer[..room]);
            self.bytes.extend_from_slice(&buffer[..done.consumed_out]);
            packed = &packed[done.consumed_in..];
            missing -= done.consumed_out as u64;
            let kind = match done.status {
                _ if missing == 0 => break,
                Ok(LzwStatus::Ok) => continue,
                Ok(_) => std::io::ErrorKind::UnexpectedEof,
                Err(_) => std::io::ErrorKind::InvalidData,
            };
            return Err(TiffError::IoError(std::io::Error::new(kind, "a tile packed by LZW is damaged")));
        }
        Ok(())
    }

    /// The file with its directory, and the numbers that do not fit in there before it.
    fn finish(mut self, mut entries: Vec<(Tag, Vec<u64>)>) -> Vec<u8> {
        /// 64-bit numbers.
        const LONG8: u16 = 16;
        entries.sort_by_key(|(tag, _)| tag.to_u16());
        for (_, values) in &mut entries {
            if let count @ 2.. = values.len() {
                let at = self.bytes.len() as u64;
                self.longs(std::mem::replace(values, vec![at]));
                values.resize(count, 0);
            }
        }
        let directory = self.bytes.len();
        self.longs([entries.len() as u64]);
        for (tag, values) in entries {
            self.shorts([tag.to_u16(), LONG8]);
            self.longs([values.len() as u64, values.first().copied().unwrap_or_default()]);
        }
        self.longs([0]);
        let mut at = Self { order: self.order, bytes: Vec::new() };
        at.longs([directory as u64]);
        self.bytes[8..16].copy_from_slice(&at.bytes);
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};
    use crate::volume::tiff::decode;
    use std::io::Cursor;
    use std::path::Path;
    use weezl::encode::Encoder;

    const SIZE: [usize; 2] = [50, 33];
    const TILE: [usize; 2] = [16, 32];

    /// Samples that no code packs well, so that codes end anywhere in rows; one page, in tiles of which the last of
    /// each row and column reach beyond it.
    fn page(order: ByteOrder, seed: u64, cut: usize) -> (Vec<u8>, Vec<u16>) {
        let mut rng = Rng::stream(seed, Stage::Test, 0);
        let samples: Vec<u16> = (0..SIZE[0] * SIZE[1]).map(|_| (rng.bits() >> 48) as u16).collect();
        let mut page = Page::new(order);
        let (mut starts, mut lengths) = (Vec::new(), Vec::new());
        for (y, x) in (0..SIZE[1]).step_by(TILE[1]).flat_map(|y| (0..SIZE[0]).step_by(TILE[0]).map(move |x| (y, x))) {
            let mut tile = Page { order, bytes: Vec::new() };
            for (dy, dx) in (0..TILE[1]).flat_map(|dy| (0..TILE[0]).map(move |dx| (dy, dx))) {
                let inside = y + dy < SIZE[1] && x + dx < SIZE[0];
                tile.shorts([if inside { samples[(y + dy) * SIZE[0] + x + dx] } else { 7 }]);
            }
            let packed = Encoder::with_tiff_size_switch(BitOrder::Msb, 8).encode(&tile.bytes).unwrap();
            starts.push(page.bytes.len() as u64);
            lengths.push((packed.len() - cut) as u64);
            page.bytes.extend(packed);
        }
        let numbers = [
            (Tag::ImageWidth, SIZE[0] as u64),
            (Tag::ImageLength, SIZE[1] as u64),
            (Tag::BitsPerSample, 16),
            (Tag::Compression, 5),
            (Tag::PhotometricInterpretation, 1),
            (Tag::TileWidth, TILE[0] as u64),
            (Tag::TileLength, TILE[1] as u64),
        ];
        let mut entries: Vec<(Tag, Vec<u64>)> = numbers.map(|(tag, value)| (tag, vec![value])).to_vec();
        entries.extend([(Tag::TileOffsets, starts), (Tag::TileByteCounts, lengths)]);
        (page.finish(entries), samples)
    }

    #[test]
    fn tiles_reach_beyond_the_picture() {
        for (order, seed) in [ByteOrder::LittleEndian, ByteOrder::BigEndian].iter().zip(1..) {
            let (bytes, samples) = page(*order, seed, 0);
            let mut decoder = Decoder::new(Cursor::new(&bytes)).unwrap();
            let whole = unpacked(&mut decoder).unwrap().unwrap();
            let mut decoder = Decoder::new(Cursor::new(whole)).unwrap();
            assert!(unpacked(&mut decoder).unwrap().is_none(), "a page that is not packed");
            let found = page_of(decoder);
            assert!(found == samples, "{order:?}");
            assert!(
                bytes.len() > 2000
                    && decode(Cursor::new(&bytes), Path::new("a.tif")).is_err_and(|e| {
                        // One page is no volume, but it was read.
                        e.to_string().contains("flatland")
                    })
            );
            let damaged = decode(Cursor::new(&page(*order, seed, 40).0), Path::new("a.tif")).unwrap_err().to_string();
            assert!(damaged.contains("page 0: the file is cut short or damaged"), "{damaged}");
        }
    }

    /// Of a long run behind a small tile nothing is held; a stream that is no LZW is damaged.
    #[test]
    fn tiles_hold_what_they_should() {
        let run = Encoder::with_tiff_size_switch(BitOrder::Msb, 8).encode(&vec![5; 1 << 22]).unwrap();
        let mut page = Page::new(ByteOrder::LittleEndian);
        let header = page.bytes.len();
        page.unpack(&run, 100_000).unwrap();
        assert!(page.bytes[header..] == vec![5; 100_000] && page.bytes.capacity() < 1 << 20);
        // The longest code there is, of which nothing is known yet.
        let wrong = page.unpack(&[0xff; 64], 100).unwrap_err();
        assert!(matches!(wrong, TiffError::IoError(e) if e.kind() == std::io::ErrorKind::InvalidData));
    }

    fn page_of<R: Read + Seek>(mut decoder: Decoder<R>) -> Vec<u16> {
        match decoder.read_image().unwrap() {
            tiff::decoder::DecodingResult::U16(samples) => samples,
            _ => panic!("another type"),
        }
    }
}
