//! Headers of text lines, each a field with its value, as NRRD and MetaImage put in front of samples or into a file of
//! their own.

use crate::error::{Error, Result};
use crate::files;
use std::collections::HashMap;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A header longer than this is not one.
const LIMIT: u64 = 1 << 20;

/// The fields of a header and where it ends.
pub(super) struct Header<'a> {
    pub(super) path: &'a Path,
    fields: HashMap<String, String>,
    /// Bytes up to and with the last line.
    pub(super) length: u64,
}

/// What a line says.
pub(super) enum Line {
    /// A field and its value.
    Field(String, String),
    /// The field that ends the header.
    Last(String, String),
    /// Nothing that is kept.
    Nothing,
    /// The header's end.
    End,
}

impl<'a> Header<'a> {
    /// Reads up to the line that `line`, given its number from 1 on and its text without its end, says is the last, or
    /// to the end of the file. What is no text becomes U+FFFD.
    ///
    /// # Errors
    /// `Io`; `Invalid` if there is no end within 1 MB; what `line` returns.
    pub(super) fn read(path: &'a Path, mut line: impl FnMut(usize, &str) -> Result<Line>) -> Result<Self> {
        let mut reader = BufReader::new(files::open(path)?.take(LIMIT));
        let mut header = Self { path, fields: HashMap::new(), length: 0 };
        let mut bytes = Vec::new();
        for number in 1.. {
            bytes.clear();
            header.length += reader.read_until(b'\n', &mut bytes).map_err(|e| Error::io(path, e))? as u64;
            if bytes.is_empty() {
                break;
            }
            match line(number, String::from_utf8_lossy(&bytes).trim_end_matches(['\r', '\n']))? {
                Line::Field(key, value) => drop(header.fields.insert(key, value)),
                Line::Last(key, value) => {
                    header.fields.insert(key, value);
                    return Ok(header);
                }
                Line::Nothing => {}
                Line::End => return Ok(header),
            }
        }
        if header.length >= LIMIT {
            return Err(Error::invalid(path, format!("the header does not end within {LIMIT} bytes")));
        }
        Ok(header)
    }

    /// The value of a field that may be missing.
    pub(super) fn get(&self, key: &str) -> Option<&str> {
        self.fields.get(key).map(String::as_str)
    }

    /// The value of a field.
    ///
    /// # Errors
    /// `Invalid` if it is missing.
    pub(super) fn need(&self, key: &str) -> Result<&str> {
        self.get(key).ok_or_else(|| Error::invalid(self.path, format!("the header has no field `{key}`")))
    }

    /// The error of a field that is not as `wanted`.
    pub(super) fn wrong(&self, key: &str, wanted: &str) -> Error {
        Error::invalid(self.path, format!("field `{key}` is `{}`; {wanted}", self.get(key).unwrap_or("")))
    }

    /// The `count` numbers of a field, `None` if it is missing.
    ///
    /// # Errors
    /// `Invalid` if it holds anything else.
    pub(super) fn numbers<T: FromStr>(&self, key: &str, count: usize) -> Result<Option<Vec<T>>> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let numbers: Option<Vec<T>> = value.split_whitespace().map(|w| w.parse().ok()).collect();
        let numbers = numbers.filter(|n| n.len() == count);
        numbers.map(Some).ok_or_else(|| self.wrong(key, &format!("it must hold {count} numbers")))
    }

    /// The file that a field names, beside this one.
    ///
    /// # Errors
    /// `NotSupported` for a list or pattern of several files.
    pub(super) fn beside(&self, key: &str, name: &str) -> Result<PathBuf> {
        if name.starts_with("LIST") || name.contains('%') {
            return Err(Error::not_supported(
                self.path,
                format!("{key} `{name}`: samples split over several files are not read; join them"),
            ));
        }
        Ok(self.path.parent().map_or_else(|| PathBuf::from(name), |p| p.join(name)))
    }
}

/// Bytes between `start` and the samples where these, `promised` bytes, are the end of the file.
///
/// # Errors
/// `Io`; `Invalid` if there are fewer.
pub(super) fn before_last(path: &Path, start: u64, promised: u64) -> Result<u64> {
    let stored = files::length(path)?.saturating_sub(start);
    let short = || Error::invalid(path, format!("{promised} bytes of samples promised, {stored} found"));
    stored.checked_sub(promised).ok_or_else(short)
}
