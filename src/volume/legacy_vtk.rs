//! Legacy VTK files (`.vtk`) of structured points, ascii or binary. \[VTK\]

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume, ascii};
use glam::DVec3;
use std::path::Path;

/// Reads the first one-component scalars of the point data (unsigned char ones may be called `COLOR_SCALARS`), or else
/// of the one-component arrays of its `FIELD` data the one called `value` or the only one; of either the one called
/// `array`, if a name is given.
///
/// `ASPECT_RATIO`, the keyword of version 1, means the same as `SPACING`; a missing spacing is 1. `long` has 64 bits.
/// Cell data in front of the point data, where VTK's writer puts them, are passed over. Keywords and types may have any
/// case, as in VTK.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, arrays cut short, or several that could be meant, with their names;
/// `NotSupported` for other data sets and for cell data alone.
pub fn read(path: &Path, array: Option<&str>) -> Result<Volume> {
    let bytes = files::read(path)?;
    let (lattice, samples) = parse(&bytes, array).map_err(|e| e.in_file(path))?;
    Volume::new(path.display().to_string(), lattice, samples)
}

/// Where reading stands in the bytes of a file.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    binary: bool,
}

fn invalid<T>(message: String) -> Result<T> {
    Err(Error::Invalid(message))
}

/// An array's samples are decoded only if they are the ones wanted.
struct Array<'a> {
    /// `None` for bits, which are no samples.
    element: Option<ElementType>,
    values: &'a [u8],
    count: usize,
}

impl<'a> Cursor<'a> {
    /// The next line, without its end; `None` at the end of the file.
    fn line(&mut self) -> Option<String> {
        let rest = self.bytes.get(self.at..).filter(|r| !r.is_empty())?;
        let end = rest.iter().position(|&b| b == b'\n');
        self.at += end.map_or(rest.len(), |e| e + 1);
        Some(String::from_utf8_lossy(&rest[..end.unwrap_or(rest.len())]).trim().to_string())
    }

    /// The words of the next line that holds any.
    fn words(&mut self) -> Option<Vec<String>> {
        loop {
            let words: Vec<String> = self.line()?.split_ascii_whitespace().map(str::to_string).collect();
            if !words.is_empty() {
                return Some(words);
            }
        }
    }

    /// Passes over what `METADATA` says of an array, up to an empty line.
    fn skip_notes(&mut self) {
        while self.line().is_some_and(|l| !l.is_empty()) {}
    }

    /// The values that begin here: exactly `count` words of text, or their bytes.
    fn array(&mut self, name: &str, kind: &str, count: usize) -> Result<Array<'a>> {
        let element = element(kind);
        if element.is_none() && !kind.eq_ignore_ascii_case("bit") {
            return Err(Error::NotSupported(format!("array `{name}` has type `{kind}`, which is not read")));
        }
        let rest = &self.bytes[self.at..];
        let length = if self.binary {
            let bits = element.map_or(1, |element| 8 * element.size());
            let wanted = count.checked_mul(bits).map(|n| n.div_ceil(8)).filter(|&n| n <= rest.len());
            wanted.ok_or(rest.len().saturating_mul(8) / bits)
        } else {
            text_length(rest, count)
        };
        let length = length.or_else(|found| {
            invalid(format!("array `{name}`: {count} values promised, {found} found; the file is cut short"))
        })?;
        self.at += length;
        Ok(Array { element, values: &rest[..length], count })
    }

    /// Passes over strings: a line each in text, else a length in 1, 2, 4 or 8 bytes, as its two highest bits say, and
    /// the bytes.
    fn pass_over_strings(&mut self, name: &str, count: usize) -> Result<()> {
        for found in 0..count {
            let rest = &self.bytes[self.at..];
            let length = if self.binary {
                let size = rest.first().map_or(usize::MAX, |first| 8 >> (first >> 6));
                rest.get(..size).and_then(|bytes| {
                    let all = bytes.iter().fold(0u64, |n, b| n << 8 | u64::from(*b));
                    let length = all & (u64::MAX >> (66 - 8 * size));
                    usize::try_from(length).ok()?.checked_add(size).filter(|n| *n <= rest.len())
                })
            } else {
                rest.iter().position(|b| *b == b'\n').map(|end| end + 1)
            };
            let Some(length) = length else {
                return invalid(format!(
                    "array `{name}`: {count} strings promised, {found} found; the file is cut short"
                ));
            };
            self.at += length;
        }
        Ok(())
    }

    fn samples(&self, array: &Array) -> Result<Samples> {
        let element = array.element.ok_or_else(|| Error::NotSupported("the array holds bits, no samples".into()))?;
        if self.binary {
            return Ok(Samples::from_bytes(array.values, element, Endian::Big));
        }
        ascii::parse(array.values, element, array.count).map_err(Error::Invalid)
    }
}

/// Bytes that `count` words take, or how many words there are.
fn text_length(text: &[u8], count: usize) -> Result<usize, usize> {
    let (mut at, mut found) = (0, 0);
    while found < count {
        let Some(begin) = text[at..].iter().position(|b| !b.is_ascii_whitespace()) else { return Err(found) };
        let word = &text[at + begin..];
        at += begin + word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
        found += 1;
    }
    Ok(at)
}

fn element(kind: &str) -> Option<ElementType> {
    Some(match kind.to_ascii_lowercase().as_str() {
        "char" | "signed_char" => ElementType::I8,
        "unsigned_char" => ElementType::U8,
        "short" => ElementType::I16,
        "unsigned_short" => ElementType::U16,
        "int" => ElementType::I32,
        "unsigned_int" => ElementType::U32,
        "long" | "vtktypeint64" => ElementType::I64,
        "unsigned_long" | "vtktypeuint64" => ElementType::U64,
        "float" => ElementType::F32,
        "double" => ElementType::F64,
        // Written with 32 bits, whatever VTK holds in memory.
        "vtkidtype" => ElementType::I32,
        _ => return None,
    })
}

fn numbers<T: std::str::FromStr, const N: usize>(words: &[String]) -> Result<[T; N]> {
    let values: Option<Vec<T>> = words[1..].iter().map(|w| w.parse().ok()).collect();
    values
        .and_then(|v| v.try_into().ok())
        .ok_or_else(|| Error::Invalid(format!("`{}`: the keyword must be followed by {N} numbers", words.join(" "))))
}

/// Component count of an attribute's last words; 1 if it is not there.
fn components(words: &[String], at: usize) -> Result<usize> {
    match words.get(at) {
        None => Ok(1),
        Some(w) => w.parse().or_else(|_| invalid(format!("`{}`: `{w}` is no number of components", words.join(" ")))),
    }
}

/// What the attributes that follow belong to.
#[derive(Clone, Copy, PartialEq)]
enum Section {
    Points,
    Cells,
}

impl Section {
    fn keyword(self) -> &'static str {
        match self {
            Section::Points => "POINT_DATA",
            Section::Cells => "CELL_DATA",
        }
    }

    /// Fails unless there is a tuple for each point or cell.
    fn check(self, tuples: usize, lattice: &Lattice) -> Result<()> {
        let (wanted, what) = match self {
            Section::Points => (lattice.len(), "points"),
            Section::Cells => (lattice.cells().iter().product(), "cells"),
        };
        if tuples == wanted {
            return Ok(());
        }
        let (keyword, dims) = (self.keyword(), lattice.dims());
        invalid(format!("{keyword} {tuples} does not fit DIMENSIONS {dims:?}, which make {wanted} {what}"))
    }
}

fn parse(bytes: &[u8], array: Option<&str>) -> Result<(Lattice, Samples)> {
    let mut cursor = Cursor { bytes, at: 0, binary: false };
    begin(&mut cursor)?;
    let (lattice, part) = geometry(&mut cursor)?;
    let samples = attributes(&mut cursor, &lattice, part, array)?;
    Ok((lattice, samples))
}

/// Reads up to the kind of data set, which must be one of points in a lattice.
fn begin(cursor: &mut Cursor) -> Result<()> {
    if !cursor.line().is_some_and(|l| l.starts_with("# vtk DataFile Version")) {
        return invalid("does not begin with `# vtk DataFile Version`, so it is no legacy VTK file".into());
    }
    let _title = cursor.line();
    cursor.binary = match cursor.words().as_deref() {
        Some([word]) if word.eq_ignore_ascii_case("binary") => true,
        Some([word]) if word.eq_ignore_ascii_case("ascii") => false,
        other => return invalid(format!("line 3 is {other:?}; it must be ASCII or BINARY")),
    };
    let dataset = cursor.words().unwrap_or_default();
    if dataset.first().is_none_or(|w| !w.eq_ignore_ascii_case("DATASET")) || dataset.len() != 2 {
        return invalid(format!("`{}`: it must be DATASET and a type", dataset.join(" ")));
    }
    if !dataset[1].eq_ignore_ascii_case("STRUCTURED_POINTS") {
        let kind = &dataset[1];
        return Err(Error::NotSupported(format!(
            "holds a {kind}; only STRUCTURED_POINTS are read (resample it to an image)"
        )));
    }
    Ok(())
}

/// What attributes belong to, and how many tuples each has.
type Part = (Section, usize);

/// The lattice, and what the first attributes belong to.
fn geometry(cursor: &mut Cursor) -> Result<(Lattice, Part)> {
    let (mut dims, mut spacing, mut origin): (Option<[usize; 3]>, [f64; 3], [f64; 3]) = (None, [1.0; 3], [0.0; 3]);
    let (section, tuples) = loop {
        let Some(words) = cursor.words() else { return invalid("has no POINT_DATA".into()) };
        match words[0].to_ascii_uppercase().as_str() {
            "DIMENSIONS" => dims = Some(numbers(&words)?),
            "SPACING" | "ASPECT_RATIO" => spacing = numbers(&words)?,
            "ORIGIN" => origin = numbers(&words)?,
            "FIELD" => skip_field(cursor, &words)?,
            "METADATA" => cursor.skip_notes(),
            "POINT_DATA" => break (Section::Points, numbers::<usize, 1>(&words)?[0]),
            "CELL_DATA" => break (Section::Cells, numbers::<usize, 1>(&words)?[0]),
            _ => return invalid(format!("`{}`: no keyword of STRUCTURED_POINTS", words.join(" "))),
        }
    };
    let dims = dims.ok_or_else(|| Error::Invalid("has no DIMENSIONS".into()))?;
    let lattice = Lattice::aligned(dims, DVec3::from_array(origin), DVec3::from_array(spacing))?;
    section.check(tuples, &lattice)?;
    Ok((lattice, (section, tuples)))
}

/// The first scalars of the points, or else the array of their `FIELD` that fits; those called `name`, if it is given.
fn attributes(
    cursor: &mut Cursor,
    lattice: &Lattice,
    (mut section, mut tuples): Part,
    name: Option<&str>,
) -> Result<Samples> {
    let named = |word: &str| name.is_none_or(|name| name == decoded(word));
    // Names of arrays that are not meant, and whether they could be: bits cannot.
    let mut others: Vec<(String, bool)> = Vec::new();
    let mut fields: Vec<(String, Array)> = Vec::new();
    while let Some(words) = cursor.words() {
        let count = |n: usize| {
            tuples.checked_mul(n).ok_or_else(|| Error::Invalid(format!("{n} components do not fit the memory")))
        };
        let wanted = |n: usize| n == 1 && section == Section::Points;
        let key = words[0].to_ascii_uppercase();
        let word = |at: usize| {
            words.get(at).ok_or_else(|| Error::Invalid(format!("`{}`: too few words behind {key}", words.join(" "))))
        };
        let mut pass_over = |n: usize| cursor.array(word(1)?, word(2)?, count(n)?).map(drop);
        match key.as_str() {
            "SCALARS" => {
                let n = components(&words, 3)?;
                let before = cursor.at;
                if cursor.words().is_none_or(|w| !w[0].eq_ignore_ascii_case("LOOKUP_TABLE")) {
                    cursor.at = before;
                }
                let array = cursor.array(word(1)?, word(2)?, count(n)?)?;
                if wanted(n) && named(word(1)?) && array.element.is_some() {
                    return cursor.samples(&array);
                }
                others.extend(wanted(n).then(|| (decoded(&words[1]), array.element.is_some())));
            }
            // A table of colours, 4 per entry.
            "LOOKUP_TABLE" => {
                let entries = components(&words, 2)?.saturating_mul(4);
                cursor.array(word(1)?, if cursor.binary { "unsigned_char" } else { "float" }, entries)?;
            }
            // VTK's writer calls unsigned char scalars so: bytes, or text in units of 255.
            "COLOR_SCALARS" => {
                let n = components(&words, 2)?;
                let array = cursor.array(word(1)?, if cursor.binary { "unsigned_char" } else { "float" }, count(n)?)?;
                if wanted(n) && named(word(1)?) {
                    let samples = match cursor.samples(&array)? {
                        Samples::F32(v) => Samples::U8(v.into_iter().map(|v| (v * 255.0).round() as u8).collect()),
                        samples => samples,
                    };
                    return Ok(samples);
                }
                others.extend(wanted(n).then(|| (decoded(&words[1]), true)));
            }
            "VECTORS" | "NORMALS" => pass_over(3)?,
            "TENSORS" => pass_over(9)?,
            "TENSORS6" => pass_over(6)?,
            // Numbers and marks of the points or cells are no samples.
            "GLOBAL_IDS" | "PEDIGREE_IDS" | "EDGE_FLAGS" => pass_over(1)?,
            "TEXTURE_COORDINATES" => {
                let n = components(&words, 2)?;
                cursor.array(word(1)?, word(3)?, count(n)?)?;
            }
            "FIELD" => {
                for _ in 0..components(&words, 2)? {
                    let Some((own, array, n)) = field_array(cursor)? else { continue };
                    if wanted(n) && array.count == tuples {
                        match array.element {
                            Some(_) => fields.push((decoded(&own), array)),
                            None => others.push((decoded(&own), false)),
                        }
                    }
                }
            }
            "METADATA" => cursor.skip_notes(),
            "POINT_DATA" if section == Section::Cells => {
                (section, tuples) = (Section::Points, numbers::<usize, 1>(&words)?[0]);
                section.check(tuples, lattice)?;
            }
            "CELL_DATA" if section == Section::Points => break,
            _ => return invalid(format!("`{}`: no keyword of {}", words.join(" "), section.keyword())),
        }
    }
    let chosen = match name {
        Some(name) => fields.iter().find(|(own, _)| own == name),
        None => {
            fields.iter().find(|(own, _)| own == "value").or(if let [only] = &fields[..] { Some(only) } else { None })
        }
    };
    if let Some((_, array)) = chosen {
        return cursor.samples(array);
    }
    let meant = |(own, read): &&(String, bool)| !read && name.is_none_or(|name| name == own);
    if let Some((own, _)) = others.iter().find(meant).filter(|_| name.is_some() || fields.is_empty()) {
        return Err(Error::NotSupported(format!("array `{own}` holds bits, which are no samples")));
    }
    let read = others.iter().filter(|(_, read)| *read).map(|(own, _)| own).chain(fields.iter().map(|(own, _)| own));
    let all: Vec<String> = read.map(|own| format!("`{own}`")).collect();
    match name {
        None if all.is_empty() => Err(cells()),
        None => invalid(format!(
            "cannot tell which point data to use: {}. Name one with --array, or as array in [volume]",
            all.join(", ")
        )),
        Some(name) => {
            let all = if all.is_empty() { "none".to_owned() } else { all.join(", ") };
            invalid(format!("has no point data `{name}` of one component; there are: {all}"))
        }
    }
}

/// A name as it was before VTK wrote `%XX` for bytes that are no letters.
fn decoded(name: &str) -> String {
    let mut parts = name.split('%');
    let mut bytes = parts.next().unwrap_or_default().as_bytes().to_vec();
    for part in parts {
        let code = part.get(..2).filter(|hex| hex.bytes().all(|b| b.is_ascii_hexdigit()));
        match code.and_then(|hex| u8::from_str_radix(hex, 16).ok()) {
            Some(code) => bytes.extend([&[code], &part.as_bytes()[2..]].concat()),
            None => bytes.extend([b"%", part.as_bytes()].concat()),
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

fn cells() -> Error {
    Error::NotSupported(
        "has no point data of one component (cell data are not read: convert them to point data)".into(),
    )
}

/// One array of a `FIELD`, its name and components; `None` of what holds no numbers.
fn field_array<'a>(cursor: &mut Cursor<'a>) -> Result<Option<(String, Array<'a>, usize)>> {
    let mut words = cursor.words().unwrap_or_default();
    // Behind each array there may be notes about it.
    if words.first().is_some_and(|w| w.eq_ignore_ascii_case("METADATA")) {
        cursor.skip_notes();
        words = cursor.words().unwrap_or_default();
    }
    let number = |at: usize| words.get(at).and_then(|w| w.parse::<usize>().ok());
    let (Some(n), Some(tuples), Some(kind)) = (number(1), number(2), words.get(3)) else {
        return invalid(format!(
            "`{}`: an array of a FIELD begins with name, components, tuples, type",
            words.join(" ")
        ));
    };
    let count = n.checked_mul(tuples).ok_or_else(|| Error::Invalid(format!("{n} × {tuples} values are too many")))?;
    if kind.eq_ignore_ascii_case("string") {
        return cursor.pass_over_strings(&words[0], count).map(|()| None);
    }
    let array = cursor.array(&words[0], kind, count)?;
    Ok(Some((words.swap_remove(0), array, n)))
}

fn skip_field(cursor: &mut Cursor, words: &[String]) -> Result<()> {
    for _ in 0..components(words, 2)? {
        field_array(cursor)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
