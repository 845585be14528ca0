//! A table that grows row by row: CSV on disk after each, so that an interrupted study goes on where it stopped.

use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Rows of text under named columns; the first `keys` columns tell rows apart.
pub struct Table {
    path: PathBuf,
    columns: Vec<&'static str>,
    keys: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Opens `path`, with the rows it holds if its columns are these; otherwise an empty table.
    ///
    /// # Errors
    /// `Io` if the file exists and cannot be read; `Invalid` if it holds other columns.
    pub fn open(path: PathBuf, columns: &[&'static str], keys: usize) -> Result<Self> {
        let mut table = Self { path, columns: columns.to_vec(), keys, rows: Vec::new() };
        if table.path.exists() {
            let text = std::fs::read_to_string(&table.path).map_err(|e| Error::io(&table.path, e))?;
            let mut lines = text.lines();
            let split = |l: &str| l.split(',').map(str::to_owned).collect::<Vec<_>>();
            if lines.next().map(split).is_none_or(|found| found != columns) {
                return Err(Error::invalid(&table.path, "holds other columns; move it away or choose another folder"));
            }
            table.rows = lines.map(split).filter(|r| r.len() == columns.len()).collect();
        }
        Ok(table)
    }

    /// Whether a row with these keys is there.
    pub fn has(&self, keys: &[String]) -> bool {
        self.rows.iter().any(|r| r[..self.keys] == *keys)
    }

    /// Adds a row and writes the file.
    ///
    /// # Errors
    /// `Io`.
    ///
    /// # Panics
    /// If the row has another number of values than there are columns.
    pub fn push(&mut self, row: Vec<String>) -> Result<()> {
        assert_eq!(row.len(), self.columns.len(), "a value per column");
        self.rows.push(row.into_iter().map(|v| v.replace([',', '\n'], " ")).collect());
        let mut text = self.columns.join(",");
        self.rows.iter().for_each(|r| {
            text.push('\n');
            text += &r.join(",");
        });
        text.push('\n');
        write_text(&self.path, &text)
    }

    /// All rows.
    pub fn rows(&self) -> &[Vec<String>] {
        &self.rows
    }

    /// A value as a number; NaN if it is none.
    pub fn number(&self, row: &[String], column: &str) -> f64 {
        let at = self.columns.iter().position(|c| *c == column);
        at.and_then(|i| row[i].parse().ok()).unwrap_or(f64::NAN)
    }

    /// A value as text.
    pub fn text<'a>(&self, row: &'a [String], column: &str) -> &'a str {
        self.columns.iter().position(|c| *c == column).map_or("", |i| &row[i])
    }

    /// The table as Markdown, under `heading`, with `notes` below.
    ///
    /// # Errors
    /// `Io`.
    pub fn write_markdown(&self, path: &Path, heading: &str, notes: &str) -> Result<()> {
        let mut text =
            format!("# {heading}\n\n| {} |\n|{}\n", self.columns.join(" | "), "---|".repeat(self.columns.len()));
        for row in &self.rows {
            writeln!(text, "| {} |", row.join(" | ")).expect("strings take all that is written");
        }
        write!(text, "\n{notes}\n").expect("strings take all that is written");
        write_text(path, &text)
    }
}

/// Writes a text file, whole or not at all.
pub(super) fn write_text(path: &Path, text: &str) -> Result<()> {
    let mut file = AtomicFile::create(path)?;
    let written = file.write_all(text.as_bytes());
    file.finish(written)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_goes_on_where_it_stopped() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        let open = || Table::open(path.clone(), &["name", "c", "error"], 2);
        let mut t = open().unwrap();
        t.push(vec!["a, b".into(), "1".into(), "0.5".into()]).unwrap();
        drop(t);
        let t = open().unwrap();
        assert!(t.has(&["a  b".into(), "1".into()]) && !t.has(&["a  b".into(), "2".into()]));
        assert_eq!(t.number(&t.rows()[0], "error"), 0.5);
        assert!(Table::open(path.clone(), &["other"], 1).is_err());
    }
}
