//! How VTK packs an array into bytes: a length header, base64, zlib blocks.

use crate::error::{Error, Result};
use crate::volume::Endian;
use base64::{Engine, engine::general_purpose::STANDARD};
use flate2::read::ZlibDecoder;
use rayon::prelude::*;
use roxmltree::Node;
use std::borrow::Cow;
use std::io::Read;

/// Blocks unpacked at once: what a damaged file can make us allocate before it is found out.
const BATCH: usize = 64;

/// What may be allocated on the word of a header alone, beyond twice the packed size; what the program itself takes and
/// the file's own bytes leave of 64 MB.
const TRUSTED: usize = 16 << 20;

/// What the root element says about all arrays of a file.
pub(super) struct Encoding {
    pub(super) endian: Endian,
    /// Bytes of a header number: 4 or 8.
    word: usize,
    zlib: bool,
}

/// An array that begins here and ends somewhere before the slice does.
#[derive(Clone, Copy)]
pub(super) enum Packed<'a> {
    Raw(&'a [u8]),
    Base64(&'a [u8]),
}

impl Encoding {
    /// Reads the attributes of `<VTKFile>`.
    pub(super) fn of(root: Node) -> Result<Self> {
        let endian = match root.attribute("byte_order") {
            Some("LittleEndian") | None => Endian::Little,
            Some("BigEndian") => Endian::Big,
            Some(other) => {
                return Err(Error::Invalid(format!("byte_order is `{other}`; it must be LittleEndian or BigEndian")));
            }
        };
        let word = match root.attribute("header_type") {
            Some("UInt32") | None => 4,
            Some("UInt64") => 8,
            Some(other) => {
                return Err(Error::Invalid(format!("header_type is `{other}`; it must be UInt32 or UInt64")));
            }
        };
        let zlib = match root.attribute("compressor") {
            None | Some("") => false,
            Some("vtkZLibDataCompressor") => true,
            Some(other) => {
                return Err(Error::NotSupported(format!(
                    "compressor `{other}`; write the file with zlib or without compression"
                )));
            }
        };
        Ok(Self { endian, word, zlib })
    }

    /// Unpacks an array, which must have exactly `promised` bytes if that is known; and how many bytes it takes packed.
    pub(super) fn unpack(&self, packed: Packed, promised: Option<usize>) -> Result<(Vec<u8>, usize), String> {
        if self.zlib {
            return self.unpack_blocks(packed, promised);
        }
        let length = self.words(&packed.take(self.word)?)[0];
        check(length, promised)?;
        let end = length.checked_add(self.word).ok_or("its length header is not a length")?;
        Ok((packed.take(end)?[self.word..].to_vec(), end))
    }

    /// The header `[blocks, block size, size of a smaller last block or 0, compressed sizes …]`, then the blocks.
    fn unpack_blocks(&self, packed: Packed, promised: Option<usize>) -> Result<(Vec<u8>, usize), String> {
        let blocks = self.words(&packed.take(self.word)?)[0];
        if blocks == 0 {
            check(0, promised)?;
            return Ok((vec![], self.word));
        }
        let head = blocks.checked_add(3).and_then(|n| n.checked_mul(self.word)).ok_or("its block count is absurd")?;
        let words = self.words(&packed.take(head)?);
        let (block, last) = (words[1], if words[2] == 0 { words[1] } else { words[2] });
        let length = (blocks - 1).checked_mul(block).and_then(|n| n.checked_add(last));
        check(length.ok_or("its block sizes are absurd")?, promised)?;
        let sizes = &words[3..];
        let stored = sizes.iter().try_fold(head, |n, &s| n.checked_add(s)).ok_or("its block sizes are absurd")?;
        let bytes = packed.take(stored)?;

        let mut starts = Vec::with_capacity(blocks + 1);
        starts.push(head);
        for &size in sizes {
            starts.push(starts[starts.len() - 1] + size);
        }
        let total = (blocks - 1) * block + last;
        if total > TRUSTED + 2 * bytes.len() {
            // So much is not believed before it was seen: unpacked once without keeping it.
            for b in 0..blocks {
                let size = if b + 1 == blocks { last } else { block };
                let mut reader = ZlibDecoder::new(&bytes[starts[b]..starts[b + 1]]).take(size as u64 + 1);
                match std::io::copy(&mut reader, &mut std::io::sink()) {
                    Ok(n) if n == size as u64 => {}
                    Ok(n) => return Err(format!("zlib block {b} of {blocks}: {size} bytes promised, {n} found")),
                    Err(e) => return Err(format!("zlib block {b} of {blocks} is damaged: {e}")),
                }
            }
        }
        let mut out = Vec::new();
        for first in (0..blocks).step_by(BATCH) {
            let unpacked: Result<Vec<_>, String> = (first..blocks.min(first + BATCH))
                .into_par_iter()
                .map(|b| {
                    let size = if b + 1 == blocks { last } else { block };
                    let mut raw = Vec::new();
                    // One byte more than promised, to notice a block that holds more.
                    ZlibDecoder::new(&bytes[starts[b]..starts[b + 1]])
                        .take(size as u64 + 1)
                        .read_to_end(&mut raw)
                        .map_err(|e| format!("zlib block {b} of {blocks} is damaged: {e}"))?;
                    if raw.len() != size {
                        return Err(format!("zlib block {b} of {blocks} does not hold the {size} bytes promised"));
                    }
                    Ok(raw)
                })
                .collect();
            unpacked?.iter().for_each(|raw| out.extend_from_slice(raw));
        }
        Ok((out, stored))
    }

    /// Header numbers.
    fn words(&self, bytes: &[u8]) -> Vec<usize> {
        let number = |b: &[u8]| {
            let fold = |n: u64, &b: &u8| n << 8 | u64::from(b);
            let n = match self.endian {
                Endian::Little => b.iter().rev().fold(0, fold),
                Endian::Big => b.iter().fold(0, fold),
            };
            usize::try_from(n).unwrap_or(usize::MAX)
        };
        bytes.chunks_exact(self.word).map(number).collect()
    }
}

/// Compares a length header with what the array must have.
fn check(found: usize, promised: Option<usize>) -> Result<(), String> {
    match promised {
        Some(p) if p != found => Err(format!("its extent and type promise {p} bytes, its length header says {found}")),
        _ => Ok(()),
    }
}

impl<'a> Packed<'a> {
    /// The first `n` bytes.
    fn take(self, n: usize) -> Result<Cow<'a, [u8]>, String> {
        let short = |found: usize| format!("{n} bytes promised, {found} found; the file is cut short");
        match self {
            Packed::Raw(bytes) => bytes.get(..n).map(Cow::Borrowed).ok_or_else(|| short(bytes.len())),
            Packed::Base64(text) => {
                if n / 3 > text.len() / 4 {
                    return Err(short(text.len() / 4 * 3));
                }
                let bytes = decode_base64(text, n)?;
                if bytes.len() < n { Err(short(bytes.len())) } else { Ok(bytes.into()) }
            }
        }
    }
}

/// The first `n` bytes (or all, if fewer) of base64 text. VTK encodes a header and its data as two runs, each with
/// its own padding; they are joined here.
fn decode_base64(text: &[u8], n: usize) -> Result<Vec<u8>, String> {
    const RUN: usize = 1 << 16;
    let fault = |e: base64::DecodeError| format!("its base64 text is damaged: {e}");
    let mut out = Vec::new();
    let mut run = Vec::with_capacity(RUN);
    for &c in text.iter().filter(|c| !c.is_ascii_whitespace()) {
        run.push(c);
        let needed = (n - out.len().min(n)).div_ceil(3) * 4;
        if run.len() % 4 == 0 && (c == b'=' || run.len() == RUN || run.len() >= needed) {
            STANDARD.decode_vec(&run, &mut out).map_err(fault)?;
            run.clear();
            if out.len() >= n {
                break;
            }
        }
    }
    STANDARD.decode_vec(&run, &mut out).map_err(fault)?;
    out.truncate(n);
    Ok(out)
}
