//! What all targets share: the bytes become a file, since readers check promises against a file's length, and what
//! reading it takes is counted.

use cap::Cap;
use isolume::error::Result;
use isolume::volume::Volume;
use std::alloc::System;
use std::path::{Path, PathBuf};

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// A file of this process with the given bytes and extension.
pub fn file(bytes: &[u8], extension: &str) -> PathBuf {
    let folder = if Path::new("/dev/shm").is_dir() { "/dev/shm".into() } else { std::env::temp_dir() };
    let path = folder.join(format!("isolume-fuzz-{}.{extension}", std::process::id()));
    std::fs::write(&path, bytes).expect("room for a small file");
    path
}

/// Opens the bytes as a volume of this extension; what opens must hold as many samples as it says.
pub fn open(bytes: &[u8], extension: &str) {
    let path = file(bytes, extension);
    if let Some(volume) = counted(&path, bytes.len(), || Volume::open(&path)) {
        assert_eq!(volume.samples().len(), volume.lattice.len());
    }
    let _ = std::fs::remove_file(path);
}

/// What `read` makes of a file of `length` bytes. A refusal must not have taken more than 2 × the file + 64 MB; a volume may
/// take what it holds beyond that, three times while it is unpacked and converted.
pub fn counted(path: &Path, length: usize, read: impl FnOnce() -> Result<Volume>) -> Option<Volume> {
    let before = ALLOCATOR.allocated();
    let peak = ALLOCATOR.max_allocated();
    let volume = read().ok();
    let held = volume.as_ref().map_or(0, |v| v.samples().len() * v.samples().element_type().size());
    let most = before + 2 * length + (64 << 20) + 3 * held;
    // The peak is one of the whole process: what did not raise it is told by none.
    let now = ALLOCATOR.max_allocated();
    assert!(now <= peak.max(most), "{}: {} bytes were taken", path.display(), now - before);
    volume
}
