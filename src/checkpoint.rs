//! Checkpoints of long work: finished blocks of its long stages, in one file that is always whole.
//!
//! A stage is cut into numbered blocks whose bits depend on nothing but the job. Finished ones are appended to the file
//! every now and then and leave memory; each has a checksum, and what a killed process wrote half is cut off by the
//! next. A file that is mostly blocks since replaced is written anew under a temporary name. Who resumes gets the same
//! bits, since blocks are either read back whole or computed anew.

mod log;

use crate::atomic;
use crate::error::{Error, Result};
use crate::progress::say;
use log::{Beginning, Key, Log};
use std::collections::BTreeMap;
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Bytes that may wait to be written beside the largest block, however long ago the last writing was. The largest was
/// whole in memory anyway.
pub const MOST_WAITING: usize = 128 << 20;

/// Writing may take this share of the time.
const WRITING_SHARE: u32 = 20;

/// Between writing, at most: a year, since the end of time can be computed from now.
const LONGEST: Duration = Duration::from_secs(365 * 24 * 60 * 60);

/// A checkpoint of one job. From resuming or the first writing on its file is held against others (by an advisory lock,
/// where the file system has locks) until the checkpoint is dropped.
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
    /// Blocks that wait to be written.
    waiting: BTreeMap<Key, Vec<u8>>,
    waiting_bytes: usize,
    /// The file, once it holds anything of this job.
    log: Option<Log>,
    /// Whether the file holds what another run left.
    resumed: bool,
    due: Instant,
    warned: bool,
}

/// What the file of a checkpoint holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Held {
    /// There is none.
    Nothing,
    /// This job.
    This,
    /// Another job.
    Another,
    /// The job of another version, which this one cannot read.
    AnotherVersion,
    /// Nothing that can be read.
    Damage,
}

/// What a checkpoint, if there is one, keeps of one stage of its job.
#[derive(Clone, Copy, Debug)]
pub struct Saved<'a> {
    checkpoint: Option<&'a Checkpoint>,
    number: u32,
    /// The number in the stage of what is block 0 here.
    first: usize,
}

impl Saved<'_> {
    /// Of a stage that nobody saves.
    pub const NOWHERE: Saved<'static> = Saved { checkpoint: None, number: 0, first: 0 };

    /// The same stage, its blocks counted from number `first` of it on.
    #[must_use]
    pub fn starting_at(self, first: usize) -> Self {
        Self { first: self.first + first, ..self }
    }

    fn key(&self, block: usize) -> Key {
        (self.number, (self.first + block) as u64)
    }

    /// A finished block, if it was saved with exactly `length` bytes.
    pub fn load(&self, block: usize, length: usize) -> Option<Vec<u8>> {
        let state = self.checkpoint?.state.lock().ok()?;
        state.load(self.key(block)).filter(|b| b.len() == length)
    }

    /// What `parse` makes of a saved block, if there is one.
    pub fn read<T>(&self, block: usize, parse: impl FnOnce(&[u8]) -> T) -> Option<T> {
        let state = self.checkpoint?.state.lock().ok()?;
        state.load(self.key(block)).map(|bytes| parse(&bytes))
    }

    /// Whether the file is to be written as soon as something is saved: the time to save what is large.
    pub fn due(&self) -> bool {
        self.checkpoint.is_some_and(|c| c.state.lock().is_ok_and(|s| Instant::now() >= s.due))
    }

    /// Keeps a finished block, in place of an earlier one; `bytes` is asked for only if there is a checkpoint.
    pub fn save(&self, block: usize, bytes: impl FnOnce() -> Vec<u8>) {
        if let Some(checkpoint) = self.checkpoint {
            let key = self.key(block);
            // Never both: a block may be as large as the work itself. The file holds the earlier one.
            if let Ok(mut state) = checkpoint.state.lock() {
                state.drop_waiting(key);
            }
            checkpoint.put(key, bytes());
        }
    }
}

impl Checkpoint {
    /// A new checkpoint, without a file until `every` (a year at most) has passed (or [`Checkpoint::save`] is called).
    /// `job` says what determines the blocks' bits, in lines of `key: value`.
    ///
    /// # Errors
    /// `Invalid` if there is a file at `path` that is no checkpoint, which is not to be overwritten, or that another
    /// checkpoint holds.
    pub fn new(path: &Path, job: String, every: Duration) -> Result<Self> {
        if path.exists() {
            if matches!(log::beginning(path)?, Beginning::Foreign) {
                return Err(Error::invalid(path, "exists and is no checkpoint; give --checkpoint another name"));
            }
            // Only to know: what is there may have to stay as it is.
            log::hold(path, OpenOptions::new().read(true))?;
        }
        let every = every.min(LONGEST);
        let due = Instant::now() + every;
        let state = State { waiting: BTreeMap::new(), waiting_bytes: 0, log: None, resumed: false, due, warned: false };
        Ok(Self { path: path.to_path_buf(), job, every, state: Mutex::new(state) })
    }

    /// Reads the blocks that an interrupted run of the same job left, up to the first that is damaged. False if there
    /// is no file. Half-written files of killed runs are removed.
    ///
    /// # Errors
    /// `Io`; `Invalid` if another checkpoint holds the file, if its beginning is damaged, or if it is of another
    /// version or of another job; the message names the first difference.
    pub fn resume(&self) -> Result<bool> {
        atomic::remove_orphans(&self.path);
        if !self.path.exists() {
            return Ok(false);
        }
        if self.held()? == Held::AnotherVersion {
            return Err(Error::invalid(
                &self.path,
                "is the checkpoint of another version of isolume; go on with that, or delete it and start without --resume",
            ));
        }
        let (job, log) = Log::open(&self.path)?.ok_or_else(|| {
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
            (state.log, state.resumed) = (Some(log), true);
        }
        Ok(true)
    }

    /// What the file holds, by its beginning.
    ///
    /// # Errors
    /// `Io`.
    pub fn held(&self) -> Result<Held> {
        if !self.path.exists() {
            return Ok(Held::Nothing);
        }
        Ok(match log::beginning(&self.path)? {
            Beginning::Job(job) if job == self.job => Held::This,
            Beginning::Job(_) => Held::Another,
            Beginning::AnotherVersion => Held::AnotherVersion,
            Beginning::Damage | Beginning::Foreign => Held::Damage,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stage `number` of the job.
    pub fn stage(&self, number: u32) -> Saved<'_> {
        Saved { checkpoint: Some(self), number, first: 0 }
    }

    /// Blocks held.
    pub fn blocks(&self) -> usize {
        self.state.lock().map_or(0, |s| {
            let written = s.log.as_ref().map_or(0, |log| log.blocks.len());
            let again = |key: &&Key| s.log.as_ref().is_some_and(|log| log.blocks.contains_key(key));
            written + s.waiting.len() - s.waiting.keys().filter(again).count()
        })
    }

    /// Bytes of the file that [`Checkpoint::resume`] found damaged, with all that stood behind them.
    pub fn damaged(&self) -> u64 {
        self.state.lock().map_or(0, |s| s.log.as_ref().map_or(0, |log| log.damaged))
    }

    fn put(&self, key: Key, bytes: Vec<u8>) {
        let Ok(mut state) = self.state.lock() else { return };
        state.drop_waiting(key);
        state.waiting_bytes += bytes.len();
        state.waiting.insert(key, bytes);
        if Instant::now() < state.due && !state.full() {
            return;
        }
        // A full disk ends no work: the result may still find room, or another checkpoint may.
        if let Err(e) = self.write(&mut state) {
            // What can be computed again is not worth the memory.
            if state.full() {
                (state.waiting, state.waiting_bytes) = (BTreeMap::new(), 0);
            }
            if !state.warned {
                state.warned = true;
                say!("warning: no checkpoint could be written: {e}");
            }
        }
    }

    /// Writes what is finished. True if the file holds it.
    ///
    /// # Errors
    /// `Io`, for example on a full disk; `Invalid` if another checkpoint holds the file. The last checkpoint stays.
    pub fn save(&self) -> Result<bool> {
        match self.state.lock() {
            Ok(mut state) => {
                if !state.waiting.is_empty() {
                    self.write(&mut state)?;
                }
                Ok(state.log.is_some())
            }
            Err(_) => Ok(false),
        }
    }

    fn write(&self, state: &mut State) -> Result<()> {
        let begun = Instant::now();
        let written = match &mut state.log {
            Some(log) if 2 * log.dead_with(&state.waiting) <= log.length => {
                log.append(&state.waiting).map_err(|e| Error::io(&self.path, e))
            }
            log => Log::create(&self.path, &self.job, log.as_ref(), &state.waiting).map(|new| *log = Some(new)),
        };
        state.due = Instant::now() + self.every.max(begun.elapsed() * WRITING_SHARE);
        written?;
        (state.waiting, state.waiting_bytes) = (BTreeMap::new(), 0);
        Ok(())
    }

    /// Deletes the file: the job is done.
    pub fn remove(&self) {
        self.remove_if(|_| true);
    }

    /// Deletes the file unless an earlier run began it: nothing of this run is worth going on with.
    pub fn discard(&self) {
        self.remove_if(|state| !state.resumed);
    }

    fn remove_if(&self, chosen: impl FnOnce(&State) -> bool) {
        let ours = |s: &State| s.log.as_ref().is_some_and(|log| log.stands_at(&self.path));
        if self.state.lock().is_ok_and(|s| ours(&s) && chosen(&s)) {
            // It does no harm if it stays.
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl State {
    fn drop_waiting(&mut self, key: Key) {
        if let Some(bytes) = self.waiting.remove(&key) {
            self.waiting_bytes -= bytes.len();
        }
    }

    /// Whether so much waits that it is written before it is due.
    fn full(&self) -> bool {
        let largest = self.waiting.values().map(Vec::len).max().unwrap_or(0);
        self.waiting_bytes - largest >= MOST_WAITING
    }

    fn load(&self, key: Key) -> Option<Vec<u8>> {
        self.waiting.get(&key).cloned().or_else(|| self.log.as_ref()?.load(key).ok()?)
    }
}

#[cfg(test)]
mod tests {
    use super::log::{ANY_MAGIC, HEAD, MAGIC};
    use super::*;

    fn job(n: u32) -> String {
        format!("commit: x\nphotons: {n}\n")
    }

    #[test]
    fn blocks_come_back_whole_and_only_to_the_same_job() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        // Never.
        let first = Checkpoint::new(&path, job(1), Duration::MAX).unwrap();
        assert!(!first.resume().unwrap(), "there is none yet");
        first.stage(1).save(7, || vec![1, 2, 3]);
        first.stage(2).save(7, || vec![4]);
        assert!(!path.exists(), "not due yet");
        assert!(first.save().unwrap());
        drop(first);
        let again = Checkpoint::new(&path, job(1), Duration::ZERO).unwrap();
        assert!(again.resume().unwrap());
        assert_eq!(again.stage(1).load(7, 3), Some(vec![1, 2, 3]));
        assert_eq!(again.stage(1).starting_at(5).load(2, 3), Some(vec![1, 2, 3]));
        assert_eq!(
            (again.stage(1).load(7, 4), again.stage(1).load(8, 3), Saved::NOWHERE.load(7, 3)),
            (None, None, None)
        );
        // Due at once: written with each block.
        again.stage(3).save(0, || vec![9]);
        drop(again);
        let message = Checkpoint::new(&path, job(2), Duration::ZERO).unwrap().resume().unwrap_err().to_string();
        assert!(message.contains("photons: 1") && message.contains("photons: 2"), "{message}");
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
    fn what_a_file_holds_is_told_by_its_beginning() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let open = |n| Checkpoint::new(&path, job(n), Duration::ZERO).unwrap();
        assert_eq!(open(1).held().unwrap(), Held::Nothing);
        let saved = open(1);
        saved.stage(1).save(0, || vec![3]);
        saved.save().unwrap();
        drop(saved);
        assert_eq!([1, 2].map(|n| open(n).held().unwrap()), [Held::This, Held::Another]);
        let bytes = std::fs::read(&path).unwrap();
        for n in ANY_MAGIC.len()..MAGIC.len() + 8 + job(1).len() + 4 {
            std::fs::write(&path, &bytes[..n]).unwrap();
            assert_eq!(open(1).held().unwrap(), Held::Damage, "cut at {n}");
        }
        for version in ["1", "8", "15", "150"] {
            std::fs::write(&path, format!("isolume checkpoint {version}\n of whatever")).unwrap();
            assert_eq!(open(1).held().unwrap(), Held::AnotherVersion, "{version}");
            let message = open(1).resume().unwrap_err().to_string();
            assert!(message.contains("of another version"), "{message}");
        }
    }

    /// What an open checkpoint holds.
    fn held(c: &Checkpoint) -> BTreeMap<Key, Vec<u8>> {
        let state = c.state.lock().unwrap();
        let keys = state.log.iter().flat_map(|l| l.blocks.keys()).chain(state.waiting.keys());
        keys.map(|&k| (k, state.load(k).unwrap())).collect()
    }

    #[test]
    fn damage_and_a_missing_end_cost_only_the_blocks_from_there_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let first = Checkpoint::new(&path, job(1), Duration::ZERO).unwrap();
        // Written one by one: the first creates the file, the others are appended.
        for n in 0..3 {
            first.stage(1).save(n, || vec![5; 40 - n]);
            first.save().unwrap();
        }
        let whole = held(&first);
        assert_eq!(whole.len(), 3);
        drop(first);
        let bytes = std::fs::read(&path).unwrap();
        let resumed = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let c = Checkpoint::new(&path, job(1), Duration::ZERO).ok()?;
            c.resume().ok().map(|_| c)
        };
        assert_eq!(held(&resumed(&bytes).unwrap()), whole);
        let start = MAGIC.len() + 8 + job(1).len() + 4;
        let ends: Vec<usize> = (0..=3).map(|n| start + (0..n).map(|b| HEAD + 40 - b).sum::<usize>()).collect();
        assert_eq!(ends[3], bytes.len());
        for n in 0..bytes.len() {
            let cut = resumed(&bytes[..n]);
            if n < start {
                assert!(cut.is_none(), "cut at {n}");
            } else {
                let cut = cut.unwrap();
                let left = ends.iter().filter(|&&e| e <= n).count() - 1;
                assert_eq!(held(&cut), whole.clone().into_iter().take(left).collect(), "cut at {n}");
                // What is appended then stands behind the last whole block.
                cut.stage(2).save(9, || vec![1, 2]);
                cut.save().unwrap();
                drop(cut);
                let after = held(&resumed(&std::fs::read(&path).unwrap()).unwrap());
                assert_eq!((after.len(), after.get(&(2, 9))), (left + 1, Some(&vec![1, 2])));
            }
            let mut bad = bytes.clone();
            bad[n] ^= 0x10;
            let Some(bad) = resumed(&bad) else {
                assert!(n < start, "bit of byte {n}");
                continue;
            };
            let left = ends.iter().filter(|&&e| e <= n).count() - 1;
            assert_eq!(held(&bad), whole.clone().into_iter().take(left).collect(), "bit of byte {n}");
            assert_eq!(bad.damaged(), (bytes.len() - ends[left]) as u64, "bit of byte {n}");
        }
        // What some file systems leave when the power fails.
        let padded = resumed(&[&bytes[..], &[0; 4096]].concat()).unwrap();
        assert_eq!((held(&padded), padded.damaged()), (whole, 4096));
    }

    #[test]
    fn a_file_is_written_by_one_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let open = || Checkpoint::new(&path, job(1), Duration::MAX);
        let (first, second, third) = (open().unwrap(), open().unwrap(), open().unwrap());
        let save = |c: &Checkpoint, n: u8| {
            c.stage(1).save(0, || vec![n; 40]);
            c.save()
        };
        assert!(save(&first, 1).unwrap());
        // Later ones, those that were there before its file was, and those of another job.
        let refused = [open().map(|_| false), second.resume(), save(&third, 3), save(&third, 4)];
        for message in refused.map(|r| r.unwrap_err().to_string()) {
            assert!(message.contains("a.checkpoint") && message.contains("another bake writes it"), "{message}");
        }
        // Rewritten now and then, the file is another one of the same name.
        for n in 0..10 {
            assert!(save(&first, n).unwrap());
            assert!(open().is_err() && second.resume().is_err());
        }
        third.remove();
        assert_eq!(first.stage(1).load(0, 40), Some(vec![9; 40]));
        drop(first);
        assert!(second.resume().unwrap());
        assert_eq!(second.stage(1).load(0, 40), Some(vec![9; 40]));
        assert!(open().is_err());
    }

    /// As on file systems that know no locks.
    #[test]
    fn what_others_wrote_into_the_file_is_no_block_of_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let c = Checkpoint::new(&path, job(1), Duration::MAX).unwrap();
        (0..3).for_each(|n| c.stage(1).save(n, || vec![n as u8; 40]));
        c.save().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let start = MAGIC.len() + 8 + job(1).len() + 4;
        // The same blocks in another order, all of them whole.
        let mut turned = bytes.clone();
        turned[start..].rotate_left(HEAD + 40);
        std::fs::write(&path, &turned).unwrap();
        assert!((0..3).all(|n| c.stage(1).load(n, 40).is_none()));
        for n in 0..HEAD + 40 {
            let mut bad = bytes.clone();
            bad[start + n] ^= 0x10;
            std::fs::write(&path, &bad).unwrap();
            assert_eq!((c.stage(1).load(0, 40), c.stage(1).load(1, 40)), (None, Some(vec![1; 40])), "byte {n}");
        }
        std::fs::write(&path, &bytes[..start + HEAD + 39]).unwrap();
        assert!((0..3).all(|n| c.stage(1).load(n, 40).is_none()));
        // None of it goes into the next file.
        c.stage(1).save(2, || vec![7; 400]);
        c.stage(1).save(1, || vec![8; 400]);
        c.save().unwrap();
        assert_eq!((c.stage(1).load(0, 40), c.stage(1).load(1, 400)), (None, Some(vec![8; 400])));
        drop(c);
        let next = Checkpoint::new(&path, job(1), Duration::MAX).unwrap();
        assert!(next.resume().unwrap());
        assert_eq!(next.blocks(), 2);
    }

    #[test]
    fn blocks_leave_memory_and_replaced_ones_leave_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.checkpoint");
        let c = Checkpoint::new(&path, job(1), Duration::ZERO).unwrap();
        for n in 0..100u8 {
            c.stage(1).save(0, || vec![n; 10_000]);
            c.save().unwrap();
            assert!(c.state.lock().unwrap().waiting.is_empty());
            assert!(std::fs::metadata(&path).unwrap().len() < 31_000);
            assert_eq!(c.stage(1).load(0, 10_000), Some(vec![n; 10_000]));
        }
        assert_eq!(c.blocks(), 1);
        // Not due, but too much to hold.
        let c = Checkpoint::new(&folder.path().join("b"), job(1), Duration::from_secs(3600)).unwrap();
        c.stage(1).save(0, || vec![1; MOST_WAITING + 1]);
        c.stage(1).save(1, || vec![2; MOST_WAITING / 2]);
        assert!(!c.path().exists(), "the largest block waits whatever its size, others beside it");
        c.stage(1).save(2, || vec![3; MOST_WAITING / 2]);
        assert!(c.path().exists() && c.state.lock().unwrap().waiting_bytes == 0);
        assert_eq!(c.stage(1).read(2, |b| (b.len(), b[7])), Some((MOST_WAITING / 2, 3)));
    }
}
