//! Plain code compiled for an instruction set.

#![allow(unsafe_code, reason = "calls of code for instruction sets that were found")]

use super::Isa;
#[cfg(target_arch = "x86_64")]
use super::Kind;

/// Work that instruction sets differ in.
pub(crate) trait Work {
    type Output;

    /// Does it. Implementations, and what is to be vectorised in them, are `#[inline(always)]`: only code that is
    /// inlined here is compiled for the instruction set; functions that are called, and closures that the standard
    /// library calls (`map`, `from_fn`), may not be.
    fn work(self) -> Self::Output;
}

impl Isa {
    /// Does `work` in code compiled for this instruction set. No multiplication and addition becomes one, so that every
    /// set gives the same bits.
    #[inline]
    pub(crate) fn run<W: Work>(self, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
        fn avx512<W: Work>(work: W) -> W::Output {
            work.work()
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,bmi1,bmi2")]
        fn avx2<W: Work>(work: W) -> W::Output {
            work.work()
        }
        match self.0 {
            // SAFETY: an `Isa` of this kind exists, so the machine has these features.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512(work) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2(work) },
            _ => work.work(),
        }
    }
}
