//! What all targets share: the bytes become a file, since readers check promises against a file's length.

use isolume::volume::Volume;
use std::path::PathBuf;

/// A file of this process with the given bytes and extension.
pub fn file(bytes: &[u8], extension: &str) -> PathBuf {
    let folder = if std::path::Path::new("/dev/shm").is_dir() { "/dev/shm".into() } else { std::env::temp_dir() };
    let path = folder.join(format!("isolume-fuzz-{}.{extension}", std::process::id()));
    std::fs::write(&path, bytes).expect("room for a small file");
    path
}

/// Opens the bytes as a volume of this extension; what opens must hold as many samples as it says.
pub fn open(bytes: &[u8], extension: &str) {
    let path = file(bytes, extension);
    if let Ok(volume) = Volume::open(&path) {
        assert_eq!(volume.samples().len(), volume.lattice.len());
    }
    let _ = std::fs::remove_file(path);
}
