//! Gaussian cube files (`.cube`, `.cub`, each also gzipped): a density or potential around a molecule.
//!
//! World units are the file's: bohr, or ångström where it counts its samples by negative numbers. The file runs z
//! fastest; here x does, as everywhere.

use crate::error::{Error, Result};
use crate::files::{self, Section};
use crate::volume::{Lattice, Samples, Volume};
use glam::{DMat3, DVec3};
use std::io::{BufRead, Read};
use std::path::Path;

/// A line of the header longer than this is none, nor a number.
const LINE_LIMIT: u64 = 1 << 16;
const WORD_LIMIT: usize = 64;

/// Reads a cube of one value per point.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, or too few or too many values (known before they are allocated); `NotSupported`
/// for several orbitals or values per point.
pub fn read(path: &Path) -> Result<Volume> {
    let text = Text { path, section: Section { start: 0, packing: files::gzip_or_plain(path, 0)?, skip: 0 } };
    let (lattice, mut reader) = text.header()?;
    let [_, ny, nz] = lattice.dims();
    let count = lattice.len();
    let length = files::length(path)?;
    // One character and one separator per number: less text cannot hold the promise.
    if count as u64 > files::most(text.section.packing, length) / 2 + 1 {
        let message = format!("{count} values promised, but {length} bytes cannot hold them");
        return Err(Error::invalid(path, message));
    }
    if count as u64 * 8 > files::trusted(length) {
        let found = text.values(&mut reader, count, |_, _| Ok(()))?;
        text.complete(count, found)?;
        (_, reader) = text.header()?;
    }
    let mut samples = vec![0.0; count];
    let found = text.values(&mut reader, count, |n, word| {
        let short = Some(word).filter(|w| w.len() < WORD_LIMIT);
        let value = short.and_then(|w| std::str::from_utf8(w).ok()).and_then(real).ok_or_else(|| {
            Error::invalid(path, format!("value {n} is `{}`, no number", String::from_utf8_lossy(word)))
        })?;
        samples[lattice.offset(n / (ny * nz), n / nz % ny, n % nz)] = value;
        Ok(())
    })?;
    text.complete(count, found)?;
    Volume::new(path.display().to_string(), lattice, Samples::F64(samples))
}

/// A file of text that is never held as a whole.
#[derive(Clone, Copy)]
struct Text<'a> {
    path: &'a Path,
    section: Section,
}

impl Text<'_> {
    /// The next line, without what is no text.
    fn line(&self, reader: &mut impl BufRead) -> Result<String> {
        let mut line = Vec::new();
        let read = reader.by_ref().take(LINE_LIMIT).read_until(b'\n', &mut line);
        read.map_err(|e| files::damaged(self.path, self.section, e))?;
        if line.len() as u64 == LINE_LIMIT {
            return Err(Error::invalid(self.path, format!("a line of the header is longer than {LINE_LIMIT} bytes")));
        }
        Ok(String::from_utf8_lossy(&line).into_owned())
    }

    /// Calls `visit` with the number and the characters (the first 64 of them) of the next `count` words; returns how
    /// many there are, but looks for one more only.
    fn values(
        &self,
        reader: &mut impl BufRead,
        count: usize,
        mut visit: impl FnMut(usize, &[u8]) -> Result<()>,
    ) -> Result<usize> {
        let (mut found, mut word) = (0, Vec::with_capacity(WORD_LIMIT));
        loop {
            let bytes = match reader.fill_buf() {
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
                bytes => bytes.map_err(|e| files::damaged(self.path, self.section, e))?,
            };
            let (end, length) = (bytes.is_empty(), bytes.len());
            for &b in if end { &b"\n"[..] } else { bytes } {
                if !b.is_ascii_whitespace() {
                    if word.len() < WORD_LIMIT {
                        word.push(b);
                    }
                } else if !word.is_empty() {
                    if found == count {
                        return Ok(found + 1);
                    }
                    visit(found, &word)?;
                    found += 1;
                    word.clear();
                }
            }
            if end {
                return Ok(found);
            }
            reader.consume(length);
        }
    }

    fn complete(&self, count: usize, found: usize) -> Result<()> {
        if found == count {
            return Ok(());
        }
        let found = if found > count { format!("more than {count}") } else { found.to_string() };
        let message = format!("{count} values promised, {found} found; it is cut short or damaged");
        Err(Error::invalid(self.path, message))
    }

    /// The lattice, and the stream where the values begin.
    fn header(&self) -> Result<(Lattice, impl BufRead + use<>)> {
        let path = self.path;
        let mut reader = files::stream(path, self.section)?;
        // Two lines of comment stand in front.
        let mut number = 2;
        for _ in 0..number {
            self.line(&mut reader)?;
        }
        let mut numbers = |what: &str, least: usize| -> Result<Vec<f64>> {
            number += 1;
            let line = self.line(&mut reader)?;
            let values: Option<Vec<f64>> = line.split_ascii_whitespace().map(real).collect();
            values.filter(|v| v.len() >= least).ok_or_else(|| {
                let shown: String = line.trim_end().chars().take(80).collect();
                Error::invalid(path, format!("line {number} is `{shown}`; it must hold {least} numbers: {what}"))
            })
        };
        let head = numbers("the number of atoms and the origin", 4)?;
        let rows = [1, 2, 3].map(|a| numbers(&format!("the samples along axis {a} and their step"), 4));
        let [x, y, z] = rows;
        let rows = [x?, y?, z?];
        let whole = |v: f64, what: &str| {
            let n = v.abs();
            if n.fract() == 0.0 && n < 1e9 {
                Ok(n as usize)
            } else {
                Err(Error::invalid(path, format!("{what} is {v}; it must be a whole number")))
            }
        };
        let dims = [whole(rows[0][0], "axis 1")?, whole(rows[1][0], "axis 2")?, whole(rows[2][0], "axis 3")?];
        if rows.iter().any(|r| (r[0] < 0.0) != (rows[0][0] < 0.0)) {
            return Err(Error::invalid(
                path,
                "counts samples by positive and negative numbers: bohr along one axis and ångström along another",
            ));
        }
        let column = |a: usize| DVec3::from_slice(&rows[a][1..4]);
        let axes = DMat3::from_cols(column(0), column(1), column(2));
        let lattice = Lattice::new(dims, DVec3::from_slice(&head[1..4]), axes).map_err(|e| e.in_file(path))?;
        let several = |n: f64| {
            let message = format!("holds {n} values per point; write one of them with `cubegen` or Multiwfn");
            Error::not_supported(path, message)
        };
        if head.len() > 4 && head[4] != 1.0 {
            return Err(several(head[4]));
        }
        let atoms = whole(head[0], "the number of atoms")?;
        for _ in 0..atoms {
            numbers("an atom's number, charge and position", 5)?;
        }
        if head[0] < 0.0 {
            // Orbitals: how many, and their names.
            let ids = numbers("the number of orbitals and their numbers", 2)?;
            if ids[0] != 1.0 {
                return Err(several(ids[0]));
            }
        }
        Ok((lattice, reader))
    }
}

/// A number as Fortran writes it: `1.0E-3`, `1.0D-3`, and `1.0-100` where the exponent has three digits.
fn real(word: &str) -> Option<f64> {
    if let Ok(v) = word.parse() {
        return Some(v);
    }
    let word = word.replace(['d', 'D'], "e");
    if let Ok(v) = word.parse() {
        return Some(v);
    }
    let sign = word.rfind(['+', '-']).filter(|&at| at > 0 && word.as_bytes()[at - 1].is_ascii_digit())?;
    format!("{}e{}", &word[..sign], &word[sign..]).parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(head: &str, counts: [i32; 3], values: usize) -> String {
        let [x, y, z] = counts;
        let data: String =
            (0..values).map(|i| format!(" {:.5E}{}", i as f64, if i % 6 == 5 { "\n" } else { "" })).collect();
        format!("one\ntwo\n{head}\n{x} 0.5 0 0\n{y} 0 1.0 0.25\n{z} 0 0 2\n1 1.0 0 0 0\n{data}\n")
    }

    fn open(text: &str) -> Result<Volume> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.cube");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn z_runs_fastest_in_the_file() {
        let v = open(&cube("1 -1.5 2 3", [2, 3, 4], 24)).unwrap();
        assert_eq!(v.lattice.dims(), [2, 3, 4]);
        assert_eq!(v.lattice.to_world(DVec3::ONE), DVec3::new(-1.0, 3.0, 5.25));
        for (i, j, k) in [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 2, 3)] {
            assert_eq!(v.value(v.lattice.offset(i, j, k)), ((i * 3 + j) * 4 + k) as f64);
        }
        // In ångström, with NVal, and as one orbital.
        assert_eq!(open(&cube("1 0 0 0 1", [-2, -3, -4], 24)).unwrap().lattice.dims(), [2, 3, 4]);
        let orbital = cube("-1 0 0 0", [2, 3, 4], 24).replace("1 1.0 0 0 0\n", "1 1.0 0 0 0\n1 21\n");
        assert_eq!(open(&orbital).unwrap().value(1), 12.0);
    }

    #[test]
    fn fortran_numbers() {
        for (word, value) in [("1.5D-3", 1.5e-3), ("-2.5d2", -250.0), ("0.34889-100", 0.348_89e-100), ("7", 7.0)] {
            assert_eq!(real(word), Some(value));
        }
        for word in ["x", "1.0-", "-", "1e5e5", "1.0-x"] {
            assert_eq!(real(word), None, "{word}");
        }
    }

    #[test]
    fn broken_files_are_refused() {
        let refused = |text: String, words: &str| {
            let message = open(&text).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("a.cube"), "{words}: {message}");
        };
        refused(cube("1 0 0 0", [2, 3, 4], 23), "23 found");
        refused(cube("1 0 0 0", [2, 3, 4], 25), "more than 24 found");
        refused(cube("1 0 0 0", [1000, 1000, 1000], 24), "cannot hold");
        refused(cube("1 0 0 0", [1, 3, 4], 12), "flatland");
        refused(cube("1 0 0", [2, 3, 4], 24), "line 3");
        refused(cube("1.5 0 0 0", [2, 3, 4], 24), "whole number");
        refused(cube("1 0 0 0", [2, -3, 4], 24), "bohr");
        refused(cube("1 0 0 0 2", [2, 3, 4], 48), "2 values per point");
        let orbitals = cube("-1 0 0 0", [2, 3, 4], 48).replace("1 1.0 0 0 0\n", "1 1.0 0 0 0\n2 21 22\n");
        refused(orbitals, "2 values per point");
        refused(cube("1 0 0 0", [2, 3, 4], 24).replace("5.00000E0", "five"), "`five`");
        refused("one\ntwo\n".into(), "atoms");
        refused("x".repeat(70_000), "longer than");
        refused(cube("1 0 0 0", [2, 3, 4], 24).replace("5.00000E0", &"5".repeat(100_000)), "no number");
    }
}
