//! Files that appear only when they are complete.

use crate::error::{Error, Result};
use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// Bytes of a file's name that its temporary one repeats, to be told by: names may have 255 in all, or fewer.
const MOST_STEM: usize = 80;

/// As many links one after another as Linux follows.
const MOST_LINKS: usize = 40;

/// A file under a temporary name beside its own; [`AtomicFile::commit`] renames it.
///
/// Whoever reads the file's own name sees the old content or the complete new one, never a part. Dropped without
/// commit, the temporary file is removed and the old content stays; only a killed process leaves it behind (hidden,
/// named `.<name>.<machine>-<process>-<count>.tmp`, of long names the beginning). A symbolic link is followed: the file
/// it names is replaced, or made, not the link. What is replaced hands its mode on.
#[derive(Debug)]
pub struct AtomicFile {
    /// `None` once closed.
    file: Option<BufWriter<File>>,
    temporary: PathBuf,
    target: PathBuf,
}

impl AtomicFile {
    /// Opens a temporary file beside `path`: an unwritable folder shows now, before hours of work.
    ///
    /// # Errors
    /// `Io` if the folder cannot be written; `Invalid` if it is missing, `path` has no file name or names something
    /// other than a regular file (a folder, a device), which a rename would replace, or a file that nobody may write.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let path = path.as_ref();
        let old = match fs::metadata(path) {
            Ok(found) => Some(found),
            Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => None,
            // Such as a name that is too long, of which a temporary one says nothing.
            Err(e) => return Err(Error::io(path, e)),
        };
        match &old {
            Some(found) if !found.is_file() => {
                let what = if found.is_dir() { "a folder" } else { "no regular file" };
                return Err(Error::invalid(path, format!("is {what}; give the name of a file to write")));
            }
            // A rename would not ask.
            Some(found) if found.permissions().readonly() => {
                return Err(Error::invalid(path, "is read-only; make it writable, or name another file to write"));
            }
            _ => {}
        }
        let target = resolved(path).map_err(|e| Error::io(path, e))?;
        let Some(name) = target.file_name() else {
            return Err(Error::invalid(path, "has no file name; give the name of a file to write"));
        };
        // A name of its own per process and call, and create_new: two writers never share a temporary file.
        loop {
            let (machine, process) = (machine().unwrap_or_default(), std::process::id());
            let count = COUNT.fetch_add(1, Ordering::Relaxed);
            let temporary = target.with_file_name(format!(".{}.{machine}-{process}-{count}.tmp", stem(name)));
            match OpenOptions::new().read(true).write(true).create_new(true).open(&temporary) {
                Ok(file) => {
                    if let Some(old) = &old {
                        take_over(&file, old);
                    }
                    return Ok(Self { file: Some(BufWriter::new(file)), temporary, target });
                }
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {} // left by a killed process of the same number
                Err(e) if e.kind() == io::ErrorKind::NotFound => {
                    let folder = target.parent().unwrap_or(Path::new("")).display();
                    return Err(Error::invalid(
                        path,
                        format!("its folder {folder} is missing; make it, or name another"),
                    ));
                }
                Err(e) => return Err(Error::io(path, e)),
            }
        }
    }

    /// Flushes to the disk and closes: what is missing is the name. Of files that belong together all are completed
    /// before the first is committed.
    ///
    /// # Errors
    /// `Io`, for example on a full disk; the temporary file is then removed and the old content stays.
    pub fn complete(mut self) -> Result<Self> {
        let mut finish = || -> io::Result<()> {
            let file = self.open()?;
            file.flush()?;
            // Without this a power cut soon after could leave the new name with the content of nothing.
            file.get_ref().sync_all()
        };
        let finished = finish();
        self.close();
        finished.map_err(|e| Error::io(&self.target, e))?;
        Ok(self)
    }

    /// Completes the file unless it is, and gives it its name.
    ///
    /// # Errors
    /// As [`AtomicFile::complete`].
    pub fn commit(self) -> Result<()> {
        // Closed by `complete` alone, which gives no file back that is not whole.
        let mut file = if self.file.is_some() { self.complete()? } else { self };
        fs::rename(&file.temporary, &file.target).map_err(|e| Error::io(&file.target, e))?;
        file.temporary.clear();
        sync_folder(&file.target);
        Ok(())
    }

    /// The file once more, for reading and writing: it stays open when this is closed, and has its name once this has
    /// been committed.
    pub(crate) fn handle(&mut self) -> io::Result<File> {
        self.open()?.get_ref().try_clone()
    }

    /// Completes what `written` says was written well; its failure becomes an [`Error::Io`] at the file.
    pub(crate) fn complete_if(self, written: io::Result<()>) -> Result<Self> {
        written.map_err(|e| Error::io(&self.target, e))?;
        self.complete()
    }

    fn open(&mut self) -> io::Result<&mut BufWriter<File>> {
        self.file.as_mut().ok_or_else(|| io::Error::other("the file is closed"))
    }

    /// Closes without writing what is still buffered: all of it is written, or the file is about to be removed.
    fn close(&mut self) {
        self.file.take().map(BufWriter::into_parts);
    }
}

/// Gives `file` the mode of the file that it is to replace, at once: nobody else reads what is private meanwhile.
#[cfg(unix)]
fn take_over(file: &File, old: &fs::Metadata) {
    use std::os::unix::fs::PermissionsExt;
    // File systems without modes refuse, and have nothing to keep.
    let _ = file.set_permissions(fs::Permissions::from_mode(old.permissions().mode() & 0o777));
}

#[cfg(not(unix))]
fn take_over(_: &File, _: &fs::Metadata) {}

/// Writes to the disk which names the folder of `path` holds: until then a power cut could take the new one back, when
/// what it was made from may be deleted already.
#[cfg(unix)]
fn sync_folder(path: &Path) {
    // Some folders cannot be read and some file systems refuse; the file is whole and in its place all the same.
    let _ = File::open(folder_of(path)).and_then(|folder| folder.sync_all());
}

#[cfg(not(unix))]
fn sync_folder(_: &Path) {}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// What a temporary file's name says of that of its target.
fn stem(name: &OsStr) -> String {
    let mut stem = name.to_string_lossy().into_owned();
    let end = (0..=MOST_STEM.min(stem.len())).rfind(|&n| stem.is_char_boundary(n)).unwrap_or(0);
    stem.truncate(end);
    stem
}

/// Where process numbers mean the same processes: a boot of a machine, and in it a namespace (a container). `None`
/// where the system does not say.
fn machine() -> Option<String> {
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    let space = fs::read_link("/proc/self/ns/pid").ok()?;
    let digits = |text: &str| text.chars().filter(char::is_ascii_alphanumeric).collect::<String>();
    Some(digits(boot.trim().rsplit('-').next()?) + &digits(space.to_str()?.strip_prefix("pid:")?))
}

/// The file that writing `path` would replace or make.
fn resolved(path: &Path) -> io::Result<PathBuf> {
    if path.exists() { fs::canonicalize(path) } else { followed(path) }
}

/// What `path` names, or would if it were there: through symbolic links that lead to nothing yet.
pub(crate) fn followed(path: &Path) -> io::Result<PathBuf> {
    let mut named = path.to_path_buf();
    for _ in 0..MOST_LINKS {
        match fs::read_link(&named) {
            // From the folder of the link, unless it says from the root.
            Ok(next) => named = named.parent().unwrap_or(Path::new("")).join(next),
            Err(_) => return Ok(named),
        }
    }
    Err(io::Error::other("is a symbolic link that leads to itself"))
}

/// Removes the temporary files of `path` whose processes are gone. Those of other machines, which may share the folder,
/// stay: whether their processes live is not known here.
pub(crate) fn remove_orphans(path: &Path) {
    // Temporary files stand beside what a link leads to.
    let Ok(path) = resolved(path) else { return };
    let (Some(name), Some(machine)) = (path.file_name(), machine()) else { return };
    let own = format!(".{}.{machine}-", stem(name));
    for entry in fs::read_dir(folder_of(&path)).into_iter().flatten().flatten() {
        let owner = entry.file_name().to_str().and_then(|n| {
            let (process, count) = n.strip_prefix(&own)?.strip_suffix(".tmp")?.split_once('-')?;
            count.parse::<u32>().is_ok().then_some(process)?.parse::<u32>().ok()
        });
        if owner.is_some_and(|process| !Path::new("/proc").join(process.to_string()).exists()) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.open()?.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.open()?.flush()
    }
}

impl Seek for AtomicFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.open()?.seek(to)
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        self.close();
        if !self.temporary.as_os_str().is_empty() {
            // Nobody is left to tell, and a stray temporary file does no harm.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::OsString;

    fn entries(folder: &Path) -> Vec<OsString> {
        let mut names: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        names
    }

    #[test]
    fn old_content_stays_until_commit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        fs::write(&path, "old").unwrap();
        let mut file = AtomicFile::create(&path).unwrap();
        file.write_all(b"newer").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(entries(folder.path()).len(), 2);
        file.commit().unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert_eq!(entries(folder.path()), ["a.bin"]);
    }

    #[test]
    fn dropped_files_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = AtomicFile::create(folder.path().join("a.bin")).unwrap();
        file.write_all(b"half").unwrap();
        let second = AtomicFile::create(folder.path().join("a.bin")).unwrap();
        assert_eq!(entries(folder.path()).len(), 2, "two writers, two files");
        drop((file, second));
        assert!(entries(folder.path()).is_empty());
    }

    #[test]
    fn wrong_targets_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let message = |path: &Path| AtomicFile::create(path).unwrap_err().to_string();
        assert!(message(folder.path()).contains("is a folder"));
        assert!(message(&folder.path().join("none").join("a.ply")).contains("none"));
        assert!(message(Path::new("")).contains("no file name"));
        #[cfg(unix)]
        assert!(message(Path::new("/dev/null")).contains("no regular file"));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn only_orphans_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let inside = |name: &str| folder.path().join(name);
        // No process has number 0, and ours lives.
        let [orphan, other] = ["a.bin", "b.bin"].map(|name| {
            let temporary = AtomicFile::create(inside(name)).unwrap().temporary.clone();
            let ours = temporary.file_name().unwrap().to_str().unwrap().to_owned();
            let at = ours.rfind(&format!("{}-", std::process::id())).unwrap();
            inside(&(ours[..at].to_owned() + "0-1.tmp"))
        });
        let living = AtomicFile::create(inside("a.bin")).unwrap();
        // Of other machines: their processes are not listed here.
        for name in [".a.bin.0-1.tmp", ".a.bin.0123456789abf0000001-0-1.tmp", ".a.bin.0-x.tmp", "a.bin"] {
            fs::write(inside(name), "x").unwrap();
        }
        [&orphan, &other].iter().for_each(|path| fs::write(path, "x").unwrap());
        remove_orphans(&inside("a.bin"));
        assert_eq!(entries(folder.path()).len(), 6);
        assert!(!orphan.exists() && living.temporary.exists() && other.exists());
        // By way of a link from elsewhere.
        let elsewhere = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink(inside("b.bin"), elsewhere.path().join("link")).unwrap();
        remove_orphans(&elsewhere.path().join("link"));
        assert!(!other.exists());
    }

    #[test]
    fn names_as_long_as_they_may_be_are_written() {
        let folder = tempfile::tempdir().unwrap();
        // Of letters of two bytes, cut anywhere.
        for name in ["n".repeat(255), "é".repeat(127), "né".repeat(85)] {
            let path = folder.path().join(name);
            let mut file = AtomicFile::create(&path).unwrap();
            file.write_all(b"new").unwrap();
            assert!(file.temporary.to_str().is_some());
            file.commit().unwrap();
            assert_eq!(fs::read(&path).unwrap(), b"new");
        }
        // One more, and what is known at the end must be known at the beginning.
        assert!(matches!(AtomicFile::create(folder.path().join("n".repeat(256))), Err(Error::Io { .. })));
    }

    #[cfg(unix)]
    #[test]
    fn modes_are_kept_and_read_only_files_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        fs::write(&path, "old").unwrap();
        let set = |mode| fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        for kept in [0o600, 0o640, 0o666] {
            set(kept);
            let file = AtomicFile::create(&path).unwrap();
            assert_eq!(mode(&file.temporary), kept, "from the beginning");
            file.commit().unwrap();
            assert_eq!(mode(&path), kept);
        }
        fs::write(&path, "precious").unwrap();
        set(0o444);
        let message = AtomicFile::create(&path).unwrap_err().to_string();
        assert!(message.contains("a.bin: is read-only"), "{message}");
        assert_eq!((entries(folder.path()).len(), fs::read(&path).unwrap()), (1, b"precious".to_vec()));
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link"));
        fs::write(&real, "old").unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        let mut file = AtomicFile::create(&link).unwrap();
        file.write_all(b"new").unwrap();
        file.commit().unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read(&real).unwrap(), b"new");
    }

    #[cfg(unix)]
    #[test]
    fn links_that_lead_to_nothing_yet_are_followed() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let inside = |name: &str| folder.path().join(name);
        fs::create_dir(inside("deep")).unwrap();
        // Relative to the folder of the link, not to that of the process; the second by way of the first.
        symlink("deep/nothere", inside("link")).unwrap();
        symlink(inside("link"), inside("deep/second")).unwrap();
        for (link, content) in [("link", "new"), ("deep/second", "newer")] {
            let mut file = AtomicFile::create(inside(link)).unwrap();
            file.write_all(content.as_bytes()).unwrap();
            assert_eq!(entries(folder.path()), ["deep", "link"], "the temporary file is beside the one it becomes");
            file.commit().unwrap();
            assert!(fs::symlink_metadata(inside(link)).unwrap().is_symlink());
            assert_eq!(fs::read_to_string(inside("deep/nothere")).unwrap(), content);
            fs::remove_file(inside("deep/nothere")).unwrap();
        }
        symlink("nowhere/a", inside("lost")).unwrap();
        assert!(AtomicFile::create(inside("lost")).unwrap_err().to_string().contains("lost"));
        symlink("round", inside("round")).unwrap();
        assert!(AtomicFile::create(inside("round")).unwrap_err().to_string().contains("round"));
    }
}
