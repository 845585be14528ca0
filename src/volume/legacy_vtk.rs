//! Legacy VTK files (`.vtk`) of structured points, ascii or binary. \[VTK\]

use crate::error::{Error, Result};
use crate::files;
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume, ascii};
use glam::DVec3;
use std::path::Path;

/// Reads the first one-component scalars of the point data (unsigned char ones may be called `COLOR_SCALARS`), or else
/// the first one-component array of its `FIELD` data; of either the one called `array`, if a name is given.
///
/// `ASPECT_RATIO`, the keyword of version 1, means the same as `SPACING`; a missing spacing is 1. `long` has 64 bits.
/// Cell data in front of the point data, where VTK's writer puts them, are passed over. Keywords and types may have any
/// case, as in VTK.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, or arrays cut short; `NotSupported` for other data sets and for cell data
/// alone.
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
    element: ElementType,
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
        let element = element(kind)
            .ok_or_else(|| Error::NotSupported(format!("array `{name}` has type `{kind}`, which is not read")))?;
        let rest = &self.bytes[self.at..];
        let length = if self.binary {
            count.checked_mul(element.size()).filter(|&n| n <= rest.len()).ok_or(rest.len() / element.size())
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
        if self.binary {
            return Ok(Samples::from_bytes(array.values, array.element, Endian::Big));
        }
        ascii::parse(array.values, array.element, array.count).map_err(Error::Invalid)
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

/// The first scalars of the points, or else the first fitting array of their `FIELD`; those called `name`, if it is
/// given.
fn attributes(
    cursor: &mut Cursor,
    lattice: &Lattice,
    (mut section, mut tuples): Part,
    name: Option<&str>,
) -> Result<Samples> {
    // VTK's writer puts %20 for a blank in a name.
    let named = |word: &str| name.is_none_or(|name| name == word.replace("%20", " "));
    let mut field: Option<Array> = None;
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
                if wanted(n) && named(word(1)?) {
                    return cursor.samples(&array);
                }
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
                    if wanted(n) && named(&own) && array.count == tuples && field.is_none() {
                        field = Some(array);
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
    match field {
        Some(array) => cursor.samples(&array),
        None => match name {
            Some(name) => invalid(format!("has no point data `{name}` of one component")),
            None => Err(cells()),
        },
    }
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
mod tests {
    use super::*;

    const HEAD: &str = "# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 3 2 2\n\
                        SPACING 0.5 1 2\nORIGIN 1 2 3\nPOINT_DATA 12\n";
    const NUMBERS: &str = "0 1 2 3 4 5\n6 7 8 9 10 11\n";

    fn ok(bytes: &[u8], element: ElementType) {
        let (lattice, samples) = parse(bytes, None).unwrap();
        assert_eq!(lattice.to_world(DVec3::ONE), DVec3::new(1.5, 3.0, 5.0));
        assert_eq!(samples.element_type(), element);
        assert!((0..12).all(|i| samples.get(i) == i as f64));
    }

    #[test]
    fn text_and_big_endian_bytes() {
        ok(format!("{HEAD}SCALARS s int\nLOOKUP_TABLE default\n{NUMBERS}").as_bytes(), ElementType::I32);
        ok(format!("{HEAD}SCALARS s float 1\n{NUMBERS}").as_bytes(), ElementType::F32);
        let old = HEAD.replace("SPACING", "ASPECT_RATIO").replace("3.0", "1.0");
        ok(format!("{old}SCALARS s double\nLOOKUP_TABLE default\n{NUMBERS}").as_bytes(), ElementType::F64);
        for (kind, element) in [
            ("unsigned_char", ElementType::U8),
            ("short", ElementType::I16),
            ("unsigned_short", ElementType::U16),
            ("unsigned_int", ElementType::U32),
            ("vtktypeint64", ElementType::I64),
            ("float", ElementType::F32),
            ("double", ElementType::F64),
        ] {
            let data: Vec<u8> = (0..12u8)
                .flat_map(|i| match element {
                    ElementType::F32 => f32::from(i).to_be_bytes().to_vec(),
                    ElementType::F64 => f64::from(i).to_be_bytes().to_vec(),
                    _ => [&[0; 7][..element.size() - 1], &[i]].concat(),
                })
                .collect();
            let head = HEAD.replace("ASCII", "BINARY");
            let scalars = format!("{head}SCALARS s {kind}\nLOOKUP_TABLE default\n");
            ok(&[scalars.as_bytes(), &data, b"\n"].concat(), element);
            // Behind vectors whose bytes look like lines.
            let behind =
                format!("{head}VECTORS v short\n{}\nSCALARS s {kind} 1\nLOOKUP_TABLE default\n", "\n\n".repeat(36));
            ok(&[behind.as_bytes(), &data, b"\n"].concat(), element);
            let field = format!("{head}FIELD FieldData 2\nv 3 12 short\n{}\nh 1 12 {kind}\n", "ab".repeat(36));
            ok(&[field.as_bytes(), &data, b"\nMETADATA\nINFORMATION 0\n\n"].concat(), element);
        }
    }

    /// As VTK writes them: a line each, or a length and the bytes.
    #[test]
    fn strings_in_a_field_are_passed_over() {
        let field = "FIELD FieldData 2\nname 1 3 string\n";
        let behind = format!("h 1 12 short\n{NUMBERS}");
        ok(format!("{HEAD}{field}a%20b\n\n7\n{behind}").as_bytes(), ElementType::I16);
        let head = HEAD.replace("ASCII", "BINARY");
        let long = [&[0x80 | 1, 44][..], &[b'\n'; 300]].concat();
        let huge = [&[0x40, 1, 0, 0][..], &[b'x'; 1 << 16]].concat();
        let strings = [&[0xc0 | 2][..], b"ab", &long, &huge].concat();
        let numbers: Vec<u8> = (0..12).flat_map(|i: i16| i.to_be_bytes()).collect();
        let bytes = [format!("{head}{field}").as_bytes(), &strings, b"\nh 1 12 short\n", &numbers].concat();
        ok(&bytes, ElementType::I16);
        let start = head.len() + field.len();
        for cut in [start, start + 1, start + 4, start + 200, start + 400] {
            assert!(
                matches!(parse(&bytes[..cut], None), Err(Error::Invalid(e)) if e.contains("strings promised")),
                "{cut}"
            );
        }
        // 2⁶² bytes.
        let endless = [&bytes[..start], &[0x3f; 8]].concat();
        assert!(parse(&endless, None).is_err());
    }

    #[test]
    fn unsigned_char_scalars_as_vtk_writes_them() {
        let head = HEAD.replace("ASCII", "BINARY");
        let bytes: Vec<u8> = (0..12).collect();
        ok(&[format!("{head}COLOR_SCALARS s 1\n").as_bytes(), &bytes, b"\n"].concat(), ElementType::U8);
        let text: String = (0..12).map(|i| format!("{:.6} ", f64::from(i) / 255.0)).collect();
        ok(format!("{HEAD}COLOR_SCALARS s 1\n{text}\n").as_bytes(), ElementType::U8);
    }

    #[test]
    fn arrays_in_front_are_passed_over() {
        let nine = "1 0 0 0 1 0 0 0 1\n".repeat(12);
        let three = "1 0 0\n".repeat(12);
        let two = "1 0\n".repeat(12);
        let text = format!(
            "{HEAD}NORMALS n float\n{three}TENSORS t float\n{nine}TEXTURE_COORDINATES c 2 float\n{two}COLOR_SCALARS rgb 3\n\
             {three}LOOKUP_TABLE mine 2\n0 0 0 1\n1 1 1 1\nSCALARS v float 2\nLOOKUP_TABLE default\n{two}METADATA\n\
             INFORMATION 0\n\nSCALARS s short\nLOOKUP_TABLE default\n{NUMBERS}"
        );
        ok(text.as_bytes(), ElementType::I16);
    }

    /// VTK's writer puts what belongs to cells in front of what belongs to points.
    #[test]
    fn cell_data_in_front_is_passed_over() {
        let kinds = [
            ("SCALARS c short 1\nLOOKUP_TABLE default\n", 2, 2),
            ("SCALARS c double 2\n", 4, 8),
            ("COLOR_SCALARS c 3\n", 6, 1),
            ("LOOKUP_TABLE c 5\n", 20, 1),
            ("VECTORS c float\n", 6, 4),
            ("NORMALS c double\n", 6, 8),
            ("TENSORS c float\n", 18, 4),
            ("TENSORS6 c float\n", 12, 4),
            ("TEXTURE_COORDINATES c 3 float\n", 6, 4),
            ("GLOBAL_IDS c vtkIdType\n", 2, 4),
            ("PEDIGREE_IDS c int\n", 2, 4),
            ("EDGE_FLAGS c unsigned_char\n", 2, 1),
            ("FIELD FieldData 1\nc 1 12 short\n", 12, 2),
        ];
        let samples: Vec<u8> = (0..12i16).flat_map(i16::to_be_bytes).collect();
        for binary in [false, true] {
            let head = if binary { HEAD.replace("ASCII", "BINARY") } else { HEAD.to_string() };
            let (head, points) = (
                head.replace("POINT_DATA 12", "CELL_DATA 2"),
                "POINT_DATA 12\nSCALARS s short\nLOOKUP_TABLE default\n",
            );
            let mut all = Vec::new();
            let end: Vec<u8> = [points.as_bytes(), if binary { &samples } else { NUMBERS.as_bytes() }, b"\n"].concat();
            for (line, count, size) in kinds {
                // Bytes that look like lines.
                let values = if binary { "\n".repeat(count * size) } else { "1 ".repeat(count) };
                let one = format!("{line}{values}\nMETADATA\nINFORMATION 0\n\n");
                ok(&[head.as_bytes(), one.as_bytes(), &end].concat(), ElementType::I16);
                all.extend(one.into_bytes());
            }
            ok(&[head.as_bytes(), &all, &end].concat(), ElementType::I16);
        }
    }

    #[test]
    fn keywords_are_the_same_in_any_case() {
        let bytes: Vec<u8> = (0..12i16).flat_map(i16::to_be_bytes).collect();
        for change in [str::to_ascii_lowercase, str::to_ascii_uppercase] {
            let (magic, rest) = HEAD.split_once('\n').unwrap();
            let head = format!("{magic}\n{}", change(rest));
            let in_bytes = format!("{magic}\n{}", change(&rest.replace("ASCII", "BINARY")));
            let scalars = change("SCALARS s short 1\nLOOKUP_TABLE default\n");
            ok(format!("{head}{scalars}{NUMBERS}").as_bytes(), ElementType::I16);
            ok(&[in_bytes.as_bytes(), scalars.as_bytes(), &bytes].concat(), ElementType::I16);
            let notes = change("FIELD f 2\na 3 1 float\n1 2 3\nMETADATA\nINFORMATION 0\n\nb 1 12 short\n");
            ok(format!("{head}{notes}{NUMBERS}").as_bytes(), ElementType::I16);
        }
    }

    #[test]
    fn broken_files_are_refused() {
        let refused = |text: String, words: &str| {
            let message = parse(text.as_bytes(), None).unwrap_err().to_string();
            assert!(message.contains(words), "{words}: {message}");
        };
        let good = format!("{HEAD}SCALARS s int\nLOOKUP_TABLE default\n{NUMBERS}");
        refused(good.replace(" 11\n", "\n"), "11 found");
        refused(good.replace("ASCII", "BINARY"), "cut short");
        refused(good.replace("int", "bit"), "`bit`");
        refused(good.replace(" 11\n", " x\n"), "`x`");
        refused(good.replace("POINT_DATA 12", "POINT_DATA 13"), "13");
        refused(format!("{HEAD}SCALARS s int\n0 1\n").replace("POINT_DATA 12", "CELL_DATA 2"), "cell data");
        refused(good.replace("POINT_DATA", "CELL_DATA"), "CELL_DATA 12 does not fit");
        refused(good.replace("3 2 2", "12 1 1"), "flatland");
        refused(good.replace("3 2 2", "9999999 9999999 9999999"), "too large");
        refused(good.replace("STRUCTURED_POINTS", "POLYDATA"), "POLYDATA");
        refused(good.replace("# vtk", "# vkt"), "no legacy VTK");
        refused(good.replace("SPACING 0.5 1", "SPACING 0.5"), "3 numbers");
        refused(HEAD.into(), "no point data");
        refused(good.replace("SCALARS s int", "VECTORS v int"), "cut short");
    }
}
