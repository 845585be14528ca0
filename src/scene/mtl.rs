//! Material libraries of OBJ files, checked and completed line by line before tobj reads them.

use crate::error::{Error, Result};
use crate::files;
use std::path::Path;

/// Statements of a colour.
const COLOURS: [&str; 4] = ["Ka", "Kd", "Ks", "Ke"];

/// The text of the library at `path`, such that tobj takes it: a colour of one number gets its other two, which are the
/// same.
///
/// # Errors
/// `Io`; `Invalid` with file and line for what is malformed.
pub(super) fn text(path: &Path) -> Result<String> {
    let source = files::read_text(path)?;
    let mut text = String::with_capacity(source.len());
    for (n, line) in source.lines().enumerate() {
        let line = line.trim();
        let fail = |what: &str| Error::Invalid(format!("{}:{}: `{line}`: {what}", path.display(), n + 1));
        let mut words = line.split_whitespace();
        if let Some(key) = words.next().filter(|key| COLOURS.contains(key)) {
            // What may follow three numbers is nobody's concern.
            let numbers: Vec<&str> = words.take_while(|w| !w.starts_with('#')).take(3).collect();
            let all = numbers.iter().all(|w| w.parse::<f64>().is_ok());
            let [r, g, b] = match numbers[..] {
                [grey] if all => [grey; 3],
                [r, g, b] if all => [r, g, b],
                _ => return Err(fail("a colour is one number, or three")),
            };
            text.push_str(&format!("{key} {r} {g} {b}"));
        } else if let Err(e) = tobj::load_mtl_buf(&mut line.as_bytes()) {
            return Err(fail(&e.to_string()));
        } else {
            text.push_str(line);
        }
        text.push('\n');
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_completed_and_other_lines_are_as_they_were() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mtl");
        let read = |content: &str| {
            std::fs::write(&path, content).unwrap();
            text(&path).map_err(|e| e.to_string())
        };
        let lines = "# all\n newmtl a b\r\nKd 0.7\nKe 1 2 3\nKs .5 # grey\nTf 1\nNs 10\nmap_Kd a.png\nKd 1 0 0 9\n";
        let completed =
            "# all\nnewmtl a b\nKd 0.7 0.7 0.7\nKe 1 2 3\nKs .5 .5 .5\nTf 1\nNs 10\nmap_Kd a.png\nKd 1 0 0\n";
        assert_eq!(read(lines).unwrap(), completed);
        for wrong in
            ["Kd", "Kd 1 2", "Ka x", "Ks 1 2 x", "Ke spectral a.rfl", "Kd # 1", "newmtl", "Ni", "d x", "map_Kd"]
        {
            let e = read(&format!("newmtl a\n\t{wrong}\nKd 1\n")).unwrap_err();
            assert!(e.contains(&format!("a.mtl:2: `{wrong}`: ")), "{wrong}: {e}");
        }
    }
}
