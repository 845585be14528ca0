//! The file of a checkpoint: magic, job, and blocks, each with its checksum.

use crate::error::{Error, Result};
use crate::files;
use flate2::Crc;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

pub(super) const MAGIC: &[u8] = b"isolume checkpoint 16\n";
/// What the magic of any version starts with.
pub(super) const ANY_MAGIC: &[u8] = b"isolume checkpoint ";

/// Stage and number of a block.
pub(super) type Key = (u32, u64);

/// A checkpoint's file.
#[derive(Debug)]
pub(super) struct Log {
    file: File,
    /// Where each block begins, and its bytes.
    pub(super) blocks: BTreeMap<Key, (u64, usize)>,
    /// Bytes of the file that are whole, and of those, bytes of blocks since replaced.
    pub(super) length: u64,
    dead: u64,
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
        let mut blocks = BTreeMap::new();
        let mut length = 0;
        files::write_atomically(path, |out| {
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
        })?;
        let file = OpenOptions::new().read(true).write(true).open(path).map_err(|e| Error::io(path, e))?;
        Ok(Self { file, blocks, length, dead: 0 })
    }

    /// The job of a file and its blocks; `None` if anything is wrong but an end that is missing.
    pub(super) fn open(path: &Path) -> Result<Option<(String, Self)>> {
        let file = OpenOptions::new().read(true).write(true).open(path).map_err(|e| Error::io(path, e))?;
        let found = Self::scan(BufReader::with_capacity(1 << 20, &file)).map_err(|e| Error::io(path, e))?;
        Ok(found.map(|(job, blocks, length, dead)| (job, Self { file, blocks, length, dead })))
    }

    /// The job, where the blocks are, the bytes that are whole and those of blocks since replaced.
    #[allow(clippy::type_complexity, reason = "the parts of a log")]
    fn scan(mut from: impl Read) -> std::io::Result<Option<(String, BTreeMap<Key, (u64, usize)>, u64, u64)>> {
        if take(&mut from, MAGIC.len() as u64)? != MAGIC {
            return Ok(None);
        }
        let Some(job) = job(&mut from)? else { return Ok(None) };
        let mut length = (MAGIC.len() + 8 + job.len() + 4) as u64;
        let (mut blocks, mut dead) = (BTreeMap::new(), 0);
        loop {
            let head = take(&mut from, HEAD as u64)?;
            if head.len() < HEAD {
                break;
            }
            if small(&head[24..]) != Some(checksum(&head[..24])) {
                return Ok(None);
            }
            let (Some(stage), Some(block), Some(count), sum) =
                (small(&head[..4]), number(&head[4..12]), number(&head[12..20]), small(&head[20..24]))
            else {
                return Ok(None);
            };
            let bytes = take(&mut from, count)?;
            if (bytes.len() as u64) < count {
                break;
            }
            if Some(checksum(&bytes)) != sum {
                return Ok(None);
            }
            let start = length + HEAD as u64;
            length = start + count;
            if let Some((_, before)) = blocks.insert((stage, block), (start, bytes.len())) {
                dead += (HEAD + before) as u64;
            }
        }
        Ok(Some((job, blocks, length, dead)))
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

    /// A block, if there is one.
    pub(super) fn load(&self, key: Key) -> std::io::Result<Option<Vec<u8>>> {
        let Some(&(start, count)) = self.blocks.get(&key) else { return Ok(None) };
        let mut bytes = vec![0; count];
        let mut file = &self.file;
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(&mut bytes)?;
        Ok(Some(bytes))
    }
}
