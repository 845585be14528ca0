//! A table that grows row by row: CSV on disk after each, so that an interrupted study goes on where it stopped.

use crate::error::{Error, Result};
use crate::files;
use std::borrow::Cow;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Rows of text under named columns; the first `keys` columns tell rows apart, the last two are the digest of their
/// job, and what made them.
#[derive(Debug)]
pub(super) struct Table {
    path: PathBuf,
    columns: Vec<&'static str>,
    keys: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Opens `path`, with the rows it holds if its columns are these; otherwise an empty table.
    ///
    /// # Errors
    /// `Io` if the file exists and cannot be read; `Invalid` if it holds other columns, or a row of more or fewer.
    pub(super) fn open(path: PathBuf, columns: &[&'static str], keys: usize) -> Result<Self> {
        let mut table = Self { path, columns: columns.to_vec(), keys, rows: Vec::new() };
        if table.path.exists() {
            let text = std::fs::read_to_string(&table.path).map_err(|e| Error::io(&table.path, e))?;
            let mut rows = records(&text).into_iter();
            if rows.next().is_none_or(|found| found != columns) {
                return Err(Error::invalid(&table.path, "holds other columns; move it away or choose another folder"));
            }
            table.rows = rows.collect();
            if let Some((n, row)) = table.rows.iter().enumerate().find(|(_, row)| row.len() != columns.len()) {
                return Err(Error::invalid(
                    &table.path,
                    format!("row {}: {} values for {} columns; mend or remove it", n + 1, row.len(), columns.len()),
                ));
            }
        }
        Ok(table)
    }

    /// Whether a row with these keys is there.
    pub(super) fn has(&self, keys: &[String]) -> bool {
        self.rows.iter().any(|r| r[..self.keys] == *keys)
    }

    /// Refuses rows of `scene` (the first column) that another job left: their last column but one is not `job`.
    ///
    /// # Errors
    /// `Invalid`.
    pub(super) fn expect(&self, scene: &str, job: &str) -> Result<()> {
        let of_another = |r: &&Vec<String>| r[0] == scene && r[r.len() - 2] != job;
        match self.rows.iter().find(of_another) {
            None => Ok(()),
            Some(row) => Err(Error::invalid(
                &self.path,
                format!(
                    "holds rows of '{scene}' that are of another scene, volume or settings (job {}, this one is {job}); \
                     choose another folder, or move the table away",
                    row[row.len() - 2]
                ),
            )),
        }
    }

    /// Refuses rows that something other than `program` made: figures of two programs or machines are not for one
    /// table.
    ///
    /// # Errors
    /// `Invalid`.
    pub(super) fn expect_program(&self, program: &str) -> Result<()> {
        match self.rows.iter().filter_map(|r| r.last()).find(|found| *found != program) {
            None => Ok(()),
            Some(found) => Err(Error::invalid(
                &self.path,
                format!(
                    "holds rows made by `{found}`, this is `{program}`; choose another folder, or move the table away"
                ),
            )),
        }
    }

    /// Adds a row and writes the file.
    ///
    /// # Errors
    /// `Io`.
    ///
    /// # Panics
    /// If the row has another number of values than there are columns.
    pub(super) fn push(&mut self, row: Vec<String>) -> Result<()> {
        assert_eq!(row.len(), self.columns.len(), "a value per column");
        self.rows.push(row);
        let mut text = self.columns.join(",") + "\n";
        for row in &self.rows {
            text += &row.iter().map(|v| quoted(v)).collect::<Vec<_>>().join(",");
            text.push('\n');
        }
        files::write_text(&self.path, &text)
    }

    /// All rows.
    pub(super) fn rows(&self) -> &[Vec<String>] {
        &self.rows
    }

    /// A value as a number; NaN if it is none.
    pub(super) fn number(&self, row: &[String], column: &str) -> f64 {
        let at = self.columns.iter().position(|c| *c == column);
        at.and_then(|i| row[i].parse().ok()).unwrap_or(f64::NAN)
    }

    /// The table as Markdown, under `heading`, with `notes` below, which say what made all rows.
    ///
    /// # Errors
    /// `Io`.
    pub(super) fn write_markdown(&self, path: &Path, heading: &str, notes: &str) -> Result<()> {
        let shown = self.columns.len() - 1;
        let mut text = format!("# {heading}\n\n| {} |\n|{}\n", self.columns[..shown].join(" | "), "---|".repeat(shown));
        for row in &self.rows {
            // A bar would end the cell.
            let cells: Vec<String> = row[..shown].iter().map(|cell| cell.replace('|', "\\|")).collect();
            writeln!(text, "| {} |", cells.join(" | ")).expect("strings take all that is written");
        }
        write!(text, "\n{notes}\n").expect("strings take all that is written");
        files::write_text(path, &text)
    }
}

/// A value as CSV: quoted where it holds what would end it.
fn quoted(value: &str) -> Cow<'_, str> {
    if value.contains([',', '"', '\n', '\r']) {
        return Cow::Owned(format!("\"{}\"", value.replace('"', "\"\"")));
    }
    Cow::Borrowed(value)
}

/// The records of a CSV file, the inverse of [`quoted`].
fn records(text: &str) -> Vec<Vec<String>> {
    let mut records = Vec::new();
    let mut record = vec![String::new()];
    let mut quote = false;
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        let value = record.last_mut().expect("a record has a value");
        match letter {
            // Two of them stand for one.
            '"' if quote && letters.next_if_eq(&'"').is_some() => value.push('"'),
            '"' => quote = !quote,
            ',' if !quote => record.push(String::new()),
            '\n' if !quote => records.push(std::mem::replace(&mut record, vec![String::new()])),
            '\r' if !quote => {}
            letter => value.push(letter),
        }
    }
    if record != [""] {
        records.push(record);
    }
    records
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_goes_on_where_it_stopped() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        let open = || Table::open(path.clone(), &["name", "c", "error", "job", "program"], 2);
        let mut t = open().unwrap();
        let names = ["a, b", "a  b", "say \"a\", or b", "", "two\r\nlines\n", "plain"];
        for name in names {
            assert!(!t.has(&[name.into(), "1".into()]), "{name:?}");
            t.push(["", "1", "0.5", "j", "p"].map(|v| if v.is_empty() { name } else { v }.into()).to_vec()).unwrap();
        }
        let before = std::fs::read_to_string(&path).unwrap();
        assert!(before.ends_with("\nplain,1,0.5,j,p\n"), "{before}");
        drop(t);
        let mut t = open().unwrap();
        for (row, name) in t.rows().iter().zip(names) {
            assert_eq!(row[0], name);
            assert!(t.has(&[name.into(), "1".into()]) && !t.has(&[name.into(), "2".into()]), "{name:?}");
        }
        assert_eq!(t.rows().len(), names.len());
        assert_eq!(t.number(&t.rows()[0], "error"), 0.5);
        t.push(["last", "1", "0.5", "j", "p"].map(String::from).to_vec()).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), before + "last,1,0.5,j,p\n");
        assert!(Table::open(path.clone(), &["other"], 1).is_err());
        assert!(t.expect("last", "j").is_ok() && t.expect("none", "k").is_ok() && t.expect_program("p").is_ok());
        assert!(t.expect("last", "k").unwrap_err().to_string().contains("(job j, this one is k)"));
        assert!(t.expect_program("q").unwrap_err().to_string().contains("made by `p`, this is `q`"));
        t.push(["a|b", "1", "0.5", "j", "p"].map(String::from).to_vec()).unwrap();
        let (shown, notes) = (dir.path().join("t.md"), "made by p");
        t.write_markdown(&shown, "t", notes).unwrap();
        let shown = std::fs::read_to_string(shown).unwrap();
        assert!(shown.contains("| error | job |\n|---|---|---|---|\n") && shown.contains("| last | 1 | 0.5 | j |\n"));
        assert!(shown.contains("| a\\|b | 1 | 0.5 | j |\n"), "{shown}");
        // A row that was edited is not lost with the next one.
        std::fs::write(&path, std::fs::read_to_string(&path).unwrap() + "short,1\n").unwrap();
        assert!(open().err().unwrap().to_string().contains("row 9: 2 values for 5 columns"));
    }
}
