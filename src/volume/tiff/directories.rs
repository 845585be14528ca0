//! The directories of a TIFF, before a decoder that believes their counts sees them.

use std::collections::HashSet;
use std::io::{Read, Result, Seek, SeekFrom};

/// What a decoder takes per value of a tag that it reads.
const VALUE: u64 = 32;

/// Private tags, which no decoder of pages reads, begin here.
const PRIVATE: u16 = 32_768;

/// Little- or big-endian numbers.
struct Words<'a, R> {
    reader: &'a mut R,
    big_endian: bool,
}

impl<R: Read> Words<'_, R> {
    fn word<const N: usize>(&mut self) -> Result<u64> {
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes)?;
        let fold = |n: u64, &b: &u8| n << 8 | u64::from(b);
        Ok(if self.big_endian { bytes.iter().fold(0, fold) } else { bytes.iter().rev().fold(0, fold) })
    }
}

/// The first tag in any directory whose values would take more than `trusted` bytes, and how many it promises.
/// Directories that end early or form a ring are the decoder's to complain about.
pub(super) fn excessive<R: Read + Seek>(reader: &mut R, trusted: u64) -> Option<(u16, u64)> {
    reader.rewind().ok()?;
    let mut order = [0; 2];
    reader.read_exact(&mut order).ok()?;
    let mut words = Words { reader, big_endian: &order == b"MM" };
    // Offsets and counts of 4 bytes, or of 8 behind two more words.
    let large = match words.word::<2>().ok()? {
        42 => false,
        43 => words.word::<4>().is_ok(),
        _ => return None,
    };
    let long = |words: &mut Words<R>| if large { words.word::<8>() } else { words.word::<4>() };
    let mut at = long(&mut words).ok()?;
    let mut seen = HashSet::new();
    while at != 0 && seen.insert(at) {
        words.reader.seek(SeekFrom::Start(at)).ok()?;
        let entries = if large { words.word::<8>() } else { words.word::<2>() }.ok()?;
        for _ in 0..entries {
            let tag = u16::try_from(words.word::<2>().ok()?).ok()?;
            let _kind = words.word::<2>().ok()?;
            let count = long(&mut words).ok()?;
            let _value = long(&mut words).ok()?;
            if tag < PRIVATE && count > trusted / VALUE {
                return Some((tag, count));
            }
        }
        at = long(&mut words).ok()?;
    }
    None
}
