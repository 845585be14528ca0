//! Checkpoints of long work: finished blocks of its long stages, in one file that is always whole.
//!
//! A stage is cut into numbered blocks whose bits depend on nothing but the job. Finished ones are kept in memory and
//! written together every now and then, under a temporary name that replaces the old file only when it is complete: a
//! process that is killed at any time leaves the last checkpoint intact. Who resumes gets the same bits, since blocks are
//! either read back whole or computed anew.

use crate::atomic;
use crate::error::{Error, Result};
use crate::files;
use flate2::Crc;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

const MAGIC: &[u8] = b"isolume checkpoint 1\n";

/// Writing may take this share of the time.
const WRITING_SHARE: u32 = 20;

/// A checkpoint of one job.
#[derive(Debug)]
pub struct Checkpoint {
    path: PathBuf,
    /// What the job is, as `key: value` lines: only an equal job resumes it.
    job: String,
    every: Duration,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    blocks: BTreeMap<(u32, u64), Vec<u8>>,
    /// Whether there are blocks that the file does not hold.
    dirty: bool,
    due: Instant,
    written: bool,
    warned: bool,
}

/// One stage of a job, with its checkpoint if there is one.
#[derive(Clone, Copy, Debug)]
pub struct Stage<'a> {
    checkpoint: Option<&'a Checkpoint>,
    number: u32,
}

impl Stage<'_> {
    /// A stage that nobody saves.
    pub const UNSAVED: Stage<'static> = Stage { checkpoint: None, number: 0 };

    /// A finished block, if it was saved with exactly `length` bytes.
    pub fn load(&self, block: usize, length: usize) -> Option<Vec<u8>> {
        let state = self.checkpoint?.state.lock().ok()?;
        state.blocks.get(&(self.number, block as u64)).filter(|b| b.len() == length).cloned()
    }

    /// What `parse` makes of a saved block, if there is one.
    pub fn read<T>(&self, block: usize, parse: impl FnOnce(&[u8]) -> T) -> Option<T> {
        let state = self.checkpoint?.state.lock().ok()?;
        state.blocks.get(&(self.number, block as u64)).map(|bytes| parse(bytes))
    }

    /// Whether the file is to be written as soon as something is saved: the time to save what is large.
    pub fn due(&self) -> bool {
        self.checkpoint.is_some_and(|c| c.state.lock().is_ok_and(|s| Instant::now() >= s.due))
    }

    /// Keeps a finished block, in place of an earlier one; `bytes` is asked for only if there is a checkpoint.
    pub fn save(&self, block: usize, bytes: impl FnOnce() -> Vec<u8>) {
        if let Some(checkpoint) = self.checkpoint {
            let key = (self.number, block as u64);
            // Never both: a block may be as large as the work itself. The file holds the earlier one.
            if let Ok(mut state) = checkpoint.state.lock() {
                state.blocks.remove(&key);
            }
            checkpoint.put(key, bytes());
        }
    }
}

impl Checkpoint {
    /// A new checkpoint, without a file until `every` has passed (or [`Checkpoint::save`] is called). `job` says what
    /// determines the blocks' bits, in lines of `key: value`.
    ///
    /// # Errors
    /// `Invalid` if there is a file at `path` that is no checkpoint: it is not to be overwritten.
    pub fn new(path: &Path, job: String, every: Duration) -> Result<Self> {
        if path.exists() {
            let mut head = Vec::new();
            let read = files::open(path)?.take(MAGIC.len() as u64).read_to_end(&mut head);
            read.map_err(|e| Error::io(path, e))?;
            if head != MAGIC {
                return Err(Error::invalid(path, "exists and is no checkpoint; give --checkpoint another name"));
            }
        }
        let due = Instant::now() + every;
        let state = State { blocks: BTreeMap::new(), dirty: false, due, written: false, warned: false };
        Ok(Self { path: path.to_path_buf(), job, every, state: Mutex::new(state) })
    }

    /// Reads the blocks that an interrupted run of the same job left. False if there is no file. Half-written files of killed
    /// runs are removed.
    ///
    /// # Errors
    /// `Io`; `Invalid` if the file is damaged or of another job; the message names the first difference.
    pub fn resume(&self) -> Result<bool> {
        atomic::remove_orphans(&self.path);
        if !self.path.exists() {
            return Ok(false);
        }
        let bytes = files::read(&self.path)?;
        let (job, blocks) = decode(&bytes).ok_or_else(|| {
            Error::invalid(&self.path, "is no checkpoint or is damaged; delete it and start without --resume")
        })?;
        if job != self.job {
            let differs = job.lines().zip(self.job.lines()).find(|(a, b)| a != b);
            let (theirs, ours) = differs.unwrap_or(("another program", "this one"));
            return Err(Error::invalid(
                &self.path,
                format!(
                    "is the checkpoint of another bake: it has `{theirs}`, this one `{ours}`; give the same settings, or \
                     delete it and start without --resume"
                ),
            ));
        }
        if let Ok(mut state) = self.state.lock() {
            state.blocks = blocks;
            state.written = true;
        }
        Ok(true)
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stage `number` of the job.
    pub fn stage(&self, number: u32) -> Stage<'_> {
        Stage { checkpoint: Some(self), number }
    }

    /// Blocks held.
    pub fn blocks(&self) -> usize {
        self.state.lock().map_or(0, |s| s.blocks.len())
    }

    fn put(&self, key: (u32, u64), bytes: Vec<u8>) {
        let Ok(mut state) = self.state.lock() else { return };
        state.blocks.insert(key, bytes);
        state.dirty = true;
        if Instant::now() < state.due {
            return;
        }
        // A full disk ends no work: the result may still find room, or another checkpoint may.
        if let Err(e) = self.write(&mut state)
            && !state.warned
        {
            state.warned = true;
            eprintln!("warning: no checkpoint could be written: {e}");
        }
    }

    /// Writes what is finished. True if the file holds it.
    ///
    /// # Errors
    /// `Io`, for example on a full disk; the last checkpoint stays.
    pub fn save(&self) -> Result<bool> {
        match self.state.lock() {
            Ok(mut state) => {
                if state.dirty {
                    self.write(&mut state)?;
                }
                Ok(state.written)
            }
            Err(_) => Ok(false),
        }
    }

    fn write(&self, state: &mut State) -> Result<()> {
        let begun = Instant::now();
        let written = files::write_atomically(&self.path, |out| encode(out, &self.job, &state.blocks));
        state.due = Instant::now() + self.every.max(begun.elapsed() * WRITING_SHARE);
        written?;
        (state.dirty, state.written) = (false, true);
        Ok(())
    }

    /// Deletes the file: the job is done.
    pub fn remove(&self) {
        if self.state.lock().is_ok_and(|s| s.written) {
            // It does no harm if it stays.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Writes and sums.
struct Summed<W> {
    out: W,
    crc: Crc,
}

impl<W: Write> Summed<W> {
    fn put(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.crc.update(bytes);
        self.out.write_all(bytes)
    }
}

fn encode(out: impl Write, job: &str, blocks: &BTreeMap<(u32, u64), Vec<u8>>) -> std::io::Result<()> {
    let mut out = Summed { out, crc: Crc::new() };
    out.put(MAGIC)?;
    out.put(&(job.len() as u64).to_le_bytes())?;
    out.put(job.as_bytes())?;
    for ((stage, block), bytes) in blocks {
        out.put(&stage.to_le_bytes())?;
        out.put(&block.to_le_bytes())?;
        out.put(&(bytes.len() as u64).to_le_bytes())?;
        out.put(bytes)?;
    }
    let sum = out.crc.sum();
    out.out.write_all(&sum.to_le_bytes())
}

/// `None` if anything is wrong.
#[allow(clippy::type_complexity, reason = "a pair")]
fn decode(bytes: &[u8]) -> Option<(String, BTreeMap<(u32, u64), Vec<u8>>)> {
    let (body, sum) = bytes.split_last_chunk::<4>().filter(|(body, _)| body.starts_with(MAGIC))?;
    let mut crc = Crc::new();
    crc.update(body);
    if crc.sum() != u32::from_le_bytes(*sum) {
        return None;
    }
    let mut rest = &body[MAGIC.len()..];
    let mut take = |n: usize| -> Option<&[u8]> {
        let (head, tail) = rest.split_at_checked(n)?;
        rest = tail;
        Some(head)
    };
    let length = u64::from_le_bytes(take(8)?.try_into().ok()?);
    let job = String::from_utf8(take(usize::try_from(length).ok()?)?.to_vec()).ok()?;
    let mut blocks = BTreeMap::new();
    while let Some(stage) = take(4) {
        let stage = u32::from_le_bytes(stage.try_into().ok()?);
        let block = u64::from_le_bytes(take(8)?.try_into().ok()?);
        let length = u64::from_le_bytes(take(8)?.try_into().ok()?);
        blocks.insert((stage, block), take(usize::try_from(length).ok()?)?.to_vec());
    }
    Some((job, blocks))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(n: u32) -> String {
        format!("commit: x\nphotons: {n}\n")
    }

    #[test]
    fn blocks_come_back_whole_and_only_to_the_same_job() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let first = Checkpoint::new(&path, job(1), Duration::from_secs(3600)).unwrap();
        assert!(!first.resume().unwrap(), "there is none yet");
        first.stage(1).save(7, || vec![1, 2, 3]);
        first.stage(2).save(7, || vec![4]);
        assert!(!path.exists(), "not due yet");
        assert!(first.save().unwrap());
        let again = Checkpoint::new(&path, job(1), Duration::ZERO).unwrap();
        assert!(again.resume().unwrap());
        assert_eq!(again.stage(1).load(7, 3), Some(vec![1, 2, 3]));
        assert_eq!(
            (again.stage(1).load(7, 4), again.stage(1).load(8, 3), Stage::UNSAVED.load(7, 3)),
            (None, None, None)
        );
        let message = Checkpoint::new(&path, job(2), Duration::ZERO).unwrap().resume().unwrap_err().to_string();
        assert!(message.contains("photons: 1") && message.contains("photons: 2"), "{message}");
        // Due at once: written with each block.
        again.stage(3).save(0, || vec![9]);
        let third = Checkpoint::new(&path, job(1), Duration::ZERO).unwrap();
        assert!(third.resume().unwrap() && third.blocks() == 3);
        std::fs::write(folder.path().join("data.nrrd"), "precious data that is longer than a magic word").unwrap();
        let message =
            Checkpoint::new(&folder.path().join("data.nrrd"), job(1), Duration::ZERO).unwrap_err().to_string();
        assert!(message.contains("no checkpoint"), "{message}");
        third.remove();
        assert!(!path.exists());
    }

    #[test]
    fn any_damage_is_seen() {
        let mut bytes = Vec::new();
        let blocks = BTreeMap::from([((1, 0), vec![5; 40]), ((1, 1), vec![])]);
        encode(&mut bytes, &job(1), &blocks).unwrap();
        assert_eq!(decode(&bytes), Some((job(1), blocks)));
        for n in 0..bytes.len() {
            assert_eq!(decode(&bytes[..n]), None, "cut at {n}");
            let mut bad = bytes.clone();
            bad[n] ^= 0x10;
            assert_eq!(decode(&bad), None, "bit of byte {n}");
        }
    }
}
