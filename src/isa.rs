//! Instruction sets that vector kernels are compiled for: what this machine has, and which of it is used.

mod simd;

pub(crate) use simd::Work;

use crate::error::{Error, Result};
use std::sync::atomic::{AtomicU8, Ordering};

/// An instruction set that this machine was found to have: no value exists of any other, so that having one proves that
/// code compiled for it may run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Isa(Kind);

/// From what every machine has to the widest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "only plain code is found there"))]
pub(crate) enum Kind {
    Plain,
    Avx2,
    Avx512,
}

/// 0: nothing was chosen; else a [`Kind`] plus 1.
static CHOSEN: AtomicU8 = AtomicU8::new(0);

impl Isa {
    /// What the compiler makes of plain code for any machine.
    pub const PLAIN: Self = Self(Kind::Plain);

    /// Names of all there are, whether or not this machine has them.
    pub const NAMES: [&str; 3] = ["plain", "avx2", "avx512"];

    /// All that this machine has, from plain code to the widest. `avx2` comes with FMA, F16C and BMI 1 and 2, `avx512`
    /// is F, BW, DQ and VL with these.
    #[must_use]
    pub fn found() -> Vec<Self> {
        #[allow(unused_mut, reason = "there may be no other")]
        let mut found = vec![Self::PLAIN];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("f16c")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
        {
            found.push(Self(Kind::Avx2));
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                found.push(Self(Kind::Avx512));
            }
        }
        found
    }

    /// What this process was told to use, if it was.
    #[must_use]
    pub fn chosen() -> Option<Self> {
        match CHOSEN.load(Ordering::Relaxed) {
            1 => Some(Self::PLAIN),
            // Stored by `choose`, from values that existed.
            2 => Some(Self(Kind::Avx2)),
            3 => Some(Self(Kind::Avx512)),
            _ => None,
        }
    }

    /// What was chosen, or else the widest that this machine has.
    #[must_use]
    pub fn current() -> Self {
        Self::chosen().or_else(|| Self::found().pop()).unwrap_or(Self::PLAIN)
    }

    /// Uses this one from now on, for scenes and sweeps that are built later; Embree, opened later, is told not to
    /// exceed it.
    pub fn choose(self) {
        CHOSEN.store(self.0 as u8 + 1, Ordering::Relaxed);
    }

    /// One of [`Isa::NAMES`].
    ///
    /// # Errors
    /// `Invalid` if there is none of that name, or this machine does not have it.
    pub fn from_name(name: &str) -> Result<Self> {
        let found = Self::found();
        found.iter().copied().find(|isa| isa.name() == name).ok_or_else(|| {
            let names: Vec<_> = found.iter().map(|isa| isa.name()).collect();
            Error::Invalid(format!("instruction set '{name}': this machine has {}", names.join(", ")))
        })
    }

    /// Its name in [`Isa::NAMES`].
    #[must_use]
    pub fn name(self) -> &'static str {
        Self::NAMES[self.0 as usize]
    }

    pub(crate) fn kind(self) -> Kind {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_to_what_the_machine_has() {
        let found = Isa::found();
        assert_eq!(found[0], Isa::PLAIN);
        for isa in &found {
            assert_eq!(Isa::from_name(isa.name()).unwrap(), *isa);
        }
        for name in Isa::NAMES.into_iter().filter(|name| found.iter().all(|isa| isa.name() != *name)).chain(["sse9"]) {
            let message = Isa::from_name(name).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("this machine has plain"), "{message}");
        }
    }
}
