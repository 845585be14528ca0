//! The hot loops in the widest instructions the machine has. One source serves all where the compiler vectorises it
//! over the sixteen lines of a pack; what takes its numbers from places that lanes compute is written by hand, for
//! AVX-512 and for AVX2. No fused multiply-adds: every instruction set gives the same bits.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(test)]
mod tests;

use super::accumulate::{Lines, accumulate_row};
use super::arrive::Walls;
use super::clearance::Clearance;
use super::ends::LineEnds;
use super::fans::march_row;
use super::flats::Flats;
use super::gather::{COSINES, sum_cosines};
use super::grid::Source;
use super::half::Half4;
use super::incoming::{Arrivals, Sink};
use super::pack::{Pack, Plan};
use super::receivers::Emitter;
use super::reflect::{RowJob, RowScratch, reflect_row};
use super::scan::{Light, ScanRule};
use super::segments::Segments;
use super::settling::Sums;
use crate::isa::{Isa, Kind};

/// Brings `x`, which is needed soon, into the cache.
#[inline(always)]
pub(super) fn prefetch<T>(x: &[T]) {
    #[cfg(target_arch = "x86_64")]
    for at in (0..size_of_val(x)).step_by(64) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: the address is inside `x`; a prefetch changes nothing.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(x.as_ptr().cast::<i8>().add(at)) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = x;
}

/// Whether all places below `length` are numbers that gathers, which take signed ones, find.
fn signed(length: usize) -> bool {
    i32::try_from(length).is_ok()
}

/// Defines a method of [`Isa`] that runs `$inner` compiled for its instruction set.
macro_rules! dispatch {
    ($name:ident, $inner:path, ($($arg:ident: $type:ty),*) $(-> $out:ty)?) => {
        #[allow(clippy::too_many_arguments, reason = "the caller's buffers")]
        #[inline]
        pub(super) fn $name(self, $($arg: $type),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
            #[allow(clippy::too_many_arguments, reason = "the caller's buffers")]
            fn avx512($($arg: $type),*) $(-> $out)? {
                $inner($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
            #[allow(clippy::too_many_arguments, reason = "the caller's buffers")]
            fn avx2($($arg: $type),*) $(-> $out)? {
                $inner($($arg),*)
            }
            match self.kind() {
                // SAFETY: an `Isa` of this kind exists, so the machine has at least these features.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx512 => unsafe { avx512($($arg),*) },
                _ => $inner($($arg),*),
            }
        }
    };
}

impl Isa {
    dispatch!(read, Pack::read, (pack: &mut Pack, plan: &Plan, source: &Source, first: isize, q: isize) -> bool);
    dispatch!(end, Pack::end, (pack: &mut Pack, plan: &Plan, ends: &LineEnds, flats: &Flats, first: isize, q: isize));
    dispatch!(look_through_gaps, Pack::look_through_gaps, (
        pack: &mut Pack, rule: ScanRule, light: Light, out: &mut [Vec<f32>], gaps: &mut [u16], place: (usize, usize)
    ));
    dispatch!(cosines, sum_cosines, (omega: &[[f32; 3]], n: &[u32], sum: &mut [f32; COSINES]));
    dispatch!(accumulate, accumulate_row, (
        lines: &Lines, normals: &[u32], e: &mut [&mut [f32]; 3], range: (usize, usize)
    ));
    dispatch!(report, Walls::through, (
        walls: &Walls, pack: &Pack, b: [&[Half4]; 2], first: isize, q: isize, out: &mut Arrivals
    ));
    dispatch!(receive_arrivals, Sink::receive, (sink: &mut Sink, number: usize, all: &Arrivals));
    dispatch!(receive, Emitter::receive, (
        emitter: &Emitter, ijk: [usize; 3], to: [f32; 3], normals: &[u32], sums: &mut [[f32; 2]]
    ));
    dispatch!(reflect, reflect_row, (
        job: &RowJob, s: usize, beside: [Option<usize>; 5], rows: &mut RowScratch, b: &mut [Half4]
    ) -> Sums);

    /// [`march_row`].
    pub(super) fn march(self, row: &[f32], place: [f32; 2], extrema: [&mut [f32]; 2], out: &mut [u8], turn: u8) {
        match self.kind() {
            // SAFETY: an `Isa` of this kind exists, so the machine has the features that `march` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512::march(row, place, extrema, out, turn) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::march(row, place, extrema, out, turn) },
            _ => march_row(row, place, 0, extrema, out, turn),
        }
    }

    /// [`Segments::march`].
    pub(super) fn extrema(self, h: &[f32], segments: &mut Segments, clearance: Option<&Clearance>) {
        match self.kind() {
            // SAFETY: an `Isa` of this kind exists, so the machine has the features that `extrema` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 if signed(h.len()) => unsafe { avx512::extrema(h, segments, clearance) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 if signed(h.len()) => unsafe { avx2::extrema(h, segments, clearance) },
            _ => segments.march(h, clearance),
        }
    }

    /// [`Pack::scan`].
    pub(super) fn scan(
        self,
        pack: &mut Pack,
        rule: ScanRule,
        light: Light,
        out: &mut [Vec<f32>],
        place: (usize, usize),
    ) {
        match self.kind() {
            _ if !(signed(light.b.len()) && signed(pack.ends() + light.flats.len())) => {
                pack.scan(rule, light, out, place)
            }
            // SAFETY: an `Isa` of this kind exists, so the machine has the features that `scan` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512::scan(pack, rule, light, out, place) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2 => unsafe { avx2::scan(pack, rule, light, out, place) },
            _ => pack.scan(rule, light, out, place),
        }
    }
}
