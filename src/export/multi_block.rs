//! VTK multi-block files (`.vtm`): names and files of the parts that belong together. \[VTK\]

use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use crate::files;
use crate::volume::vti::escape;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// A `.vtm` that names `parts`, (name, file beside it); the file's own name is left to the caller.
///
/// # Errors
/// `Io`.
pub(super) fn completed(path: &Path, parts: &[(String, String)]) -> Result<AtomicFile> {
    let mut text = String::from(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"vtkMultiBlockDataSet\" version=\"1.0\" byte_order=\"LittleEndian\">\n  \
         <vtkMultiBlockDataSet>\n",
    );
    for (n, (name, file)) in parts.iter().enumerate() {
        let (name, file) = (escape(name), escape(file));
        let _ = writeln!(text, "    <DataSet index=\"{n}\" name=\"{name}\" file=\"{file}\"/>");
    }
    text.push_str("  </vtkMultiBlockDataSet>\n</VTKFile>\n");
    files::completed(path, |out| out.write_all(text.as_bytes()))
}

/// The files that a `.vtm` names, beside it or where it says.
///
/// # Errors
/// `Io`; `Invalid` if it is none or names nothing.
pub fn read(path: &Path) -> Result<Vec<PathBuf>> {
    let text = files::read_text(path)?;
    let document = files::xml(&text).map_err(|e| Error::invalid(path, format!("its XML is not read: {e}")))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let parts = document.descendants().filter(|n| n.has_tag_name("DataSet"));
    let files: Vec<PathBuf> = parts.filter_map(|n| Some(folder.join(n.attribute("file")?))).collect();
    if files.is_empty() {
        return Err(Error::invalid(path, "names no files; make it with `isolume bake` of a scene of several volumes"));
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_survive() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a&b.vtm");
        let parts = [("one".to_owned(), "a&b-one.vti".to_owned()), ("two".to_owned(), "a\"b<.vti".to_owned())];
        completed(&path, &parts).and_then(AtomicFile::commit).unwrap();
        assert_eq!(read(&path).unwrap(), parts.map(|p| dir.path().join(p.1)));
        std::fs::write(&path, "<VTKFile/>").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("names no files"));
        std::fs::write(&path, "no XML").unwrap();
        assert!(read(&path).is_err());
    }
}
