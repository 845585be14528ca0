//! The file of a checkpoint: magic, job, and blocks, each with its checksum. Whoever writes it holds its lock.

use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use crate::files;
use flate2::Crc;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufReader, BufWriter, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::Path;

pub(super) const MAGIC: &[u8] = b"isolume checkpoint 19\n";
/// What the magic of any version starts with.
pub(super) const ANY_MAGIC: &[u8] = b"isolume checkpoint ";

/// Stage and number of a block.
pub(super) type Key = (u32, u64);

/// A checkpoint's file, held against other writers.
#[derive(Debug)]
pub(super) struct Log {
    file: File,
    /// Where each block begins, and its bytes.
    pub(super) blocks: BTreeMap<Key, (u64, usize)>,
    /// Bytes of the file that are whole, and of those, bytes of blocks since replaced.
    pub(super) length: u64,
    dead: u64,
    /// Bytes that were damaged when it was opened, and what stood behind them.
    pub(super) damaged: u64,
}

/// What was read of a file, as [`Log`] has it.
struct Contents {
    job: String,
    blocks: BTreeMap<Key, (u64, usize)>,
    length: u64,
    dead: u64,
    damaged: u64,
}

/// Bytes before a block's own: stage, number, length, checksum of the block, checksum of these.
pub(super) const HEAD: usize = 28;

fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes);
    crc.sum()
}

fn head((stage, block): Key, bytes: &[u8]) -> [u8; HEAD] {
    let mut head = [0; HEAD];
    head[..4].copy_from_slice(&stage.to_le_bytes());
    head[4..12].copy_from_slice(&block.to_le_bytes());
    head[12..20].copy_from_slice(&(bytes.len() as u64).to_le_bytes());
    head[20..24].copy_from_slice(&checksum(bytes).to_le_bytes());
    let own = checksum(&head[..24]);
    head[24..].copy_from_slice(&own.to_le_bytes());
    head
}

/// Key, length and checksum of the block behind a head; `None` if that is damaged.
fn block(head: &[u8]) -> Option<(Key, u64, u32)> {
    let whole = small(&head[24..])? == checksum(&head[..24]);
    let key = (small(&head[..4])?, number(&head[4..12])?);
    whole.then_some((key, number(&head[12..20])?, small(&head[20..24])?))
}

/// At most `n` bytes: fewer at the end.
fn take(from: &mut impl Read, n: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    from.take(n).read_to_end(&mut bytes)?;
    Ok(bytes)
}

fn number(bytes: &[u8]) -> Option<u64> {
    bytes.try_into().map(u64::from_le_bytes).ok()
}

fn small(bytes: &[u8]) -> Option<u32> {
    bytes.try_into().map(u32::from_le_bytes).ok()
}

/// Holds `file`, of `path`, against other writers as long as it is open.
fn lock(file: &File, path: &Path) -> Result<()> {
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(Error::invalid(
            path,
            "another bake writes it; wait until that has ended, or give --checkpoint another name",
        )),
        // File systems without locks refuse in many ways. There the checksums of blocks have to do.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(()),
    }
}

/// The file at `path`, held against other writers.
///
/// # Errors
/// `Io`; `Invalid` if another one holds it.
pub(super) fn hold(path: &Path, how: &OpenOptions) -> Result<File> {
    loop {
        let file = how.open(path).map_err(|e| Error::io(path, e))?;
        lock(&file, path)?;
        // Who held it until now may have put another one in its place.
        if stands_at(&file, path) {
            return Ok(file);
        }
    }
}

/// Whether `path` names `file`, and not another that has since been put there.
#[cfg(unix)]
fn stands_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let number = |found: std::io::Result<std::fs::Metadata>| found.map(|m| (m.dev(), m.ino())).ok();
    number(file.metadata()) == number(std::fs::metadata(path))
}

#[cfg(not(unix))]
fn stands_at(_: &File, _: &Path) -> bool {
    true
}

/// What a file of the name of a checkpoint begins with.
pub(super) enum Beginning {
    /// The job of this version.
    Job(String),
    /// The magic of another version.
    AnotherVersion,
    /// The magic of this one, or a part of it, and nothing that can be read.
    Damage,
    /// Something else.
    Foreign,
}

/// Reads the beginning of a file.
pub(super) fn beginning(path: &Path) -> Result<Beginning> {
    let mut from = BufReader::new(files::open(path)?);
    let mut read = || -> std::io::Result<Beginning> {
        let magic = take(&mut from, MAGIC.len() as u64)?;
        Ok(match () {
            () if magic == MAGIC => job(&mut from)?.map_or(Beginning::Damage, Beginning::Job),
            () if !magic.starts_with(ANY_MAGIC) => Beginning::Foreign,
            () if MAGIC.starts_with(&magic) => Beginning::Damage,
            () => Beginning::AnotherVersion,
        })
    };
    read().map_err(|e| Error::io(path, e))
}

/// The job, which stands behind the magic; `None` if it is damaged.
fn job(from: &mut impl Read) -> std::io::Result<Option<String>> {
    let Some(count) = number(&take(from, 8)?) else { return Ok(None) };
    let job = take(from, count)?;
    if job.len() as u64 != count || small(&take(from, 4)?) != Some(checksum(&job)) {
        return Ok(None);
    }
    Ok(String::from_utf8(job).ok())
}

impl Log {
    /// Writes a file of the blocks of an older one that are not replaced, and of `new` ones.
    pub(super) fn create(path: &Path, job: &str, old: Option<&Self>, new: &BTreeMap<Key, Vec<u8>>) -> Result<Self> {
        let mut out = AtomicFile::create(path)?;
        // Held before it has the name by which others find it.
        let file = out.handle().map_err(|e| Error::io(path, e))?;
        lock(&file, path)?;
        let mut blocks = BTreeMap::new();
        let mut length = 0;
        let mut write = || -> std::io::Result<()> {
            let mut put = |bytes: &[u8]| -> std::io::Result<u64> {
                out.write_all(bytes)?;
                length += bytes.len() as u64;
                Ok(length)
            };
            put(MAGIC)?;
            put(&(job.len() as u64).to_le_bytes())?;
            put(job.as_bytes())?;
            put(&checksum(job.as_bytes()).to_le_bytes())?;
            for (&key, bytes) in new {
                let start = put(&head(key, bytes))?;
                put(bytes)?;
                blocks.insert(key, (start, bytes.len()));
            }
            for (&key, _) in old.into_iter().flat_map(|old| &old.blocks) {
                if new.contains_key(&key) {
                    continue;
                }
                if let Some(bytes) = old.map_or(Ok(None), |old| old.load(key))? {
                    let start = put(&head(key, &bytes))?;
                    put(&bytes)?;
                    blocks.insert(key, (start, bytes.len()));
                }
            }
            Ok(())
        };
        let written = write();
        let out = out.complete_if(written)?;
        // Not in place of one that another bake began meanwhile; an older one of this is held.
        let _replaced =
            (old.is_none() && path.exists()).then(|| hold(path, OpenOptions::new().read(true))).transpose()?;
        out.commit()?;
        Ok(Self { file, blocks, length, dead: 0, damaged: 0 })
    }

    /// The job of a file and its blocks up to the first that is damaged; `None` if its beginning is. A block that was
    /// written half, as killed processes leave it, is no damage.
    pub(super) fn open(path: &Path) -> Result<Option<(String, Self)>> {
        let file = hold(path, OpenOptions::new().read(true).write(true))?;
        let found = Self::scan(BufReader::with_capacity(1 << 20, &file)).map_err(|e| Error::io(path, e))?;
        Ok(found
            .map(|Contents { job, blocks, length, dead, damaged }| (job, Self { file, blocks, length, dead, damaged })))
    }

    /// Whether this is the file of that name.
    pub(super) fn stands_at(&self, path: &Path) -> bool {
        stands_at(&self.file, path)
    }

    /// What `from` holds up to its end or the first damage.
    fn scan(mut from: impl Read) -> std::io::Result<Option<Contents>> {
        if take(&mut from, MAGIC.len() as u64)? != MAGIC {
            return Ok(None);
        }
        let Some(job) = job(&mut from)? else { return Ok(None) };
        let length = (MAGIC.len() + 8 + job.len() + 4) as u64;
        let mut found = Contents { job, blocks: BTreeMap::new(), length, dead: 0, damaged: 0 };
        loop {
            let head = take(&mut from, HEAD as u64)?;
            if head.len() < HEAD {
                break;
            }
            let Some((key, count, sum)) = block(&head) else {
                found.damaged = HEAD as u64 + std::io::copy(&mut from, &mut std::io::sink())?;
                break;
            };
            let bytes = take(&mut from, count)?;
            if (bytes.len() as u64) < count {
                break;
            }
            if checksum(&bytes) != sum {
                found.damaged = HEAD as u64 + count + std::io::copy(&mut from, &mut std::io::sink())?;
                break;
            }
            let start = found.length + HEAD as u64;
            found.length = start + count;
            if let Some((_, before)) = found.blocks.insert(key, (start, bytes.len())) {
                found.dead += (HEAD + before) as u64;
            }
        }
        Ok(Some(found))
    }

    /// Bytes of blocks that are replaced once `new` ones are written.
    pub(super) fn dead_with(&self, new: &BTreeMap<Key, Vec<u8>>) -> u64 {
        let replaced = new.keys().filter_map(|key| self.blocks.get(key));
        self.dead + replaced.map(|(_, n)| (HEAD + n) as u64).sum::<u64>()
    }

    /// Adds blocks behind those that are there, or nothing if that fails.
    pub(super) fn append(&mut self, new: &BTreeMap<Key, Vec<u8>>) -> std::io::Result<()> {
        let write = || -> std::io::Result<()> {
            let mut file = &self.file;
            // What a killed process wrote half is behind.
            file.set_len(self.length)?;
            file.seek(SeekFrom::Start(self.length))?;
            let mut out = BufWriter::with_capacity(1 << 20, file);
            for (&key, bytes) in new {
                out.write_all(&head(key, bytes))?;
                out.write_all(bytes)?;
            }
            out.into_inner().map_err(std::io::IntoInnerError::into_error)?.sync_data()
        };
        if let Err(e) = write() {
            // If not even that succeeds, the next reader cuts it.
            let _ = self.file.set_len(self.length);
            return Err(e);
        }
        self.dead = self.dead_with(new);
        for (&key, bytes) in new {
            let start = self.length + HEAD as u64;
            self.length = start + bytes.len() as u64;
            self.blocks.insert(key, (start, bytes.len()));
        }
        Ok(())
    }

    /// A block, if there is one and it stands where it was written: where there are no locks, others may have written.
    pub(super) fn load(&self, key: Key) -> std::io::Result<Option<Vec<u8>>> {
        let Some(&(start, count)) = self.blocks.get(&key) else { return Ok(None) };
        let (mut found, mut bytes) = ([0; HEAD], vec![0; count]);
        let mut file = &self.file;
        file.seek(SeekFrom::Start(start - HEAD as u64))?;
        match file.read_exact(&mut found).and_then(|()| file.read_exact(&mut bytes)) {
            Err(e) if e.kind() == ErrorKind::UnexpectedEof => Ok(None),
            read => read.map(|()| (found == head(key, &bytes)).then_some(bytes)),
        }
    }
}
