//! Samples written as text, as NRRD and VTK do.

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{ElementType, Samples};
use std::path::Path;

/// [`parse`] of what a file holds from byte `start` on.
///
/// # Errors
/// `Io`; `Invalid` with what [`parse`] says.
pub(super) fn read(path: &Path, start: u64, element: ElementType, count: usize) -> Result<Samples> {
    let text = files::read(path)?;
    let start = usize::try_from(start).unwrap_or(usize::MAX).min(text.len());
    parse(&text[start..], element, count).map_err(|e| Error::invalid(path, e))
}

/// Parses exactly `count` numbers separated by white space or commas.
///
/// # Errors
/// A message without the file's name: a number that is none or does not fit the type, too few or too many numbers.
pub(crate) fn parse(text: &[u8], element: ElementType, count: usize) -> Result<Samples, String> {
    // One character and one separator per number: less text cannot hold the promise.
    if count > text.len() / 2 + 1 {
        return Err(format!("{count} numbers promised, but {} bytes of text cannot hold them", text.len()));
    }
    let text = std::str::from_utf8(text).map_err(|e| format!("the samples are not text: {e}"))?;
    let words = || text.split(|c: char| c.is_ascii_whitespace() || c == ',').filter(|w| !w.is_empty());
    // Counted before there is room for them.
    let found = words().take(count).count();
    if found < count {
        return Err(format!("{count} numbers promised, {found} found; the file is cut short"));
    }
    macro_rules! numbers {
        ($t:ty) => {{
            let mut values = Vec::<$t>::with_capacity(count);
            for word in words() {
                if values.len() == count {
                    return Err(format!("{count} numbers promised, more found: `{word}`"));
                }
                values.push(word.parse().map_err(|_| {
                    format!("sample {} is `{word}`, which is no number of type {}", values.len(), element.name())
                })?);
            }
            values
        }};
    }
    Ok(match element {
        ElementType::U8 => Samples::U8(numbers!(u8)),
        ElementType::I8 => Samples::I8(numbers!(i8)),
        ElementType::U16 => Samples::U16(numbers!(u16)),
        ElementType::I16 => Samples::I16(numbers!(i16)),
        ElementType::U32 => Samples::U32(numbers!(u32)),
        ElementType::I32 => Samples::I32(numbers!(i32)),
        ElementType::U64 => Samples::U64(numbers!(u64)),
        ElementType::I64 => Samples::I64(numbers!(i64)),
        ElementType::F32 => Samples::F32(numbers!(f32)),
        ElementType::F64 => Samples::F64(numbers!(f64)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_exact_and_counted() {
        assert_eq!(parse(b" 1\n-2, 3\t", ElementType::I16, 3).unwrap(), Samples::I16(vec![1, -2, 3]));
        let big = parse(b"18446744073709551615 0", ElementType::U64, 2).unwrap();
        assert_eq!(big, Samples::U64(vec![u64::MAX, 0]));
        let floats = parse(b"1e-3 -inf nan", ElementType::F64, 3).unwrap();
        assert_eq!((floats.get(0), floats.get(1)), (1e-3, f64::NEG_INFINITY));
        assert!(floats.get(2).is_nan());
        for bad in ["1 2", "1 2 3 4", "1 2 256", "1 2 -1", "1 2 x", "1 2 3.5"] {
            assert!(parse(bad.as_bytes(), ElementType::U8, 3).is_err(), "{bad}");
        }
        assert!(parse(b"1 2", ElementType::U8, 1_000_000_000_000).unwrap_err().contains("cannot hold"));
    }
}
