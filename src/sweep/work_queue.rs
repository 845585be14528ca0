//! Consecutive numbers shared out among threads: each has a run of its own, and one that is done takes the farther half
//! of what is left of the longest. So neighbours mostly meet the same thread, and none waits for long.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Numbers still to be taken.
pub(super) struct WorkQueue {
    left: Vec<AtomicU64>,
}

#[inline]
fn packed(run: &Range<u32>) -> u64 {
    u64::from(run.start) << 32 | u64::from(run.end)
}

#[inline]
#[allow(clippy::cast_possible_truncation, reason = "its halves")]
fn unpacked(run: u64) -> Range<u32> {
    (run >> 32) as u32..run as u32
}

impl WorkQueue {
    /// The numbers below `count` (less than 2³²), in as many runs as there are threads.
    #[allow(clippy::cast_possible_truncation, reason = "as promised")]
    pub(super) fn new(count: usize, threads: usize) -> Self {
        let bound = |t: usize| (count * t / threads) as u32;
        Self { left: (0..threads).map(|t| AtomicU64::new(packed(&(bound(t)..bound(t + 1))))).collect() }
    }

    /// The next number for thread `own`, which no other gets; `None` if all are taken.
    pub(super) fn next(&self, own: usize) -> Option<usize> {
        loop {
            // Runs of the same bounds never come back, so that an exchange that succeeds changes what was read.
            let exchange = |place: &AtomicU64, now: u64, run: &Range<u32>| {
                place.compare_exchange(now, packed(run), Ordering::Relaxed, Ordering::Relaxed).is_ok()
            };
            let now = self.left[own].load(Ordering::Relaxed);
            let run = unpacked(now);
            if !run.is_empty() {
                if exchange(&self.left[own], now, &(run.start + 1..run.end)) {
                    return Some(run.start as usize);
                }
                continue;
            }
            let longest = self.left.iter().map(|place| (place, place.load(Ordering::Relaxed)));
            let (victim, now) = longest.max_by_key(|(_, now)| unpacked(*now).len())?;
            let run = unpacked(now);
            if run.is_empty() {
                return None;
            }
            let middle = run.end - run.len().div_ceil(2) as u32;
            if exchange(victim, now, &(run.start..middle)) {
                self.left[own].store(packed(&(middle..run.end)), Ordering::Relaxed);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::time::Duration;

    #[test]
    fn alone_a_thread_gets_its_own_run_first_and_all_in_the_end() {
        let queue = WorkQueue::new(10, 2);
        let mut all: Vec<usize> = std::iter::from_fn(|| queue.next(1)).collect();
        assert_eq!(all[..5], [5, 6, 7, 8, 9]);
        all.sort_unstable();
        assert_eq!(all, (0..10).collect::<Vec<_>>());
        assert_eq!(WorkQueue::new(0, 3).next(2), None);
    }

    #[test]
    fn every_number_is_taken_once_however_long_each_takes() {
        for threads in [2, 3, 8] {
            let queue = WorkQueue::new(1000, threads);
            let taken = Mutex::new(Vec::new());
            std::thread::scope(|scope| {
                for t in 0..threads {
                    let (queue, taken) = (&queue, &taken);
                    scope.spawn(move || {
                        while let Some(n) = queue.next(t) {
                            // The first numbers take longest.
                            if n < 20 {
                                std::thread::sleep(Duration::from_millis(1));
                            }
                            taken.lock().unwrap().push(n);
                        }
                    });
                }
            });
            let mut taken = taken.into_inner().unwrap();
            taken.sort_unstable();
            assert_eq!(taken, (0..1000).collect::<Vec<_>>());
        }
    }
}
