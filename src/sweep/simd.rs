//! The hot loops in the widest instructions the machine has. One source serves AVX2 and plain code: the compiler
//! vectorises it over the sixteen lines of a pack; AVX-512 scans by hand, since its gathers are what the compiler does
//! not find. No fused multiply-adds: every instruction set gives the same bits.

use super::flats::{Ends, Flats};
use super::gather::{COSINES, accumulate_row, sum_cosines};
use super::grid::Planes;
use super::pack::{Pack, Plan, Way};

/// An instruction set that this machine was found to have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Isa(Kind);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Plain,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
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
            match self.0 {
                Kind::Plain => $inner($($arg),*),
                // SAFETY: an `Isa` of this kind is only made by `detect` after the machine was asked for exactly these
                // features.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx2 => unsafe { avx2($($arg),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                Kind::Avx512 => unsafe { avx512($($arg),*) },
            }
        }
    };
}

impl Isa {
    /// Plain code.
    #[cfg(test)]
    pub(super) const PLAIN: Self = Self(Kind::Plain);

    /// The widest that this machine has.
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                return Self(Kind::Avx512);
            }
            if is_x86_feature_detected!("avx2") {
                return Self(Kind::Avx2);
            }
        }
        Self(Kind::Plain)
    }

    dispatch!(read, Pack::read, (pack: &mut Pack, plan: &Plan, h: &[f32], b: &Planes, first: isize, q: isize) -> bool);
    dispatch!(end, Pack::end, (pack: &mut Pack, plan: &Plan, ends: &Ends, flats: &Flats, first: isize, q: isize));
    dispatch!(cosines, sum_cosines, (omega: &[[f32; 3]], n: [&[i16]; 3], sum: &mut [f32; COSINES]));
    dispatch!(accumulate, accumulate_row, (
        e: [&mut [f32]; 3], n: [&[i16]; 3], omega: [f32; 3], light: [[&[f32]; 6]; 2], line0: usize, fu: f32, fv: f32
    ));

    /// [`Pack::scan`].
    pub(super) fn scan(self, pack: &mut Pack, way: Way, out: &mut [Vec<f32>], place: (usize, usize)) {
        match self.0 {
            // SAFETY: `detect` made this kind on a machine with the features that `scan` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512::scan(pack, way, out, place) },
            _ => pack.scan(way, out, place),
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use super::super::pack::{LANES, OUTSIDE, Pack, Way};
    use std::arch::x86_64::*;

    /// `base[index]` in the lanes of `mask`, `old` in the others.
    ///
    /// # Safety
    /// Every index of a lane in `mask` is below the length of `base`.
    #[target_feature(enable = "avx512f")]
    #[inline]
    unsafe fn gather(base: &[f32], index: __m512i, mask: __mmask16, old: __m512) -> __m512 {
        // SAFETY: the caller keeps the indices inside `base`.
        unsafe { _mm512_mask_i32gather_ps::<4>(old, mask, index, base.as_ptr()) }
    }

    /// [`Pack::scan`] with a line per lane.
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "rows and slots of a pack")]
    pub(super) fn scan(pack: &mut Pack, way: Way, out: &mut [Vec<f32>], (width, start): (usize, usize)) {
        let Way { forward, strict, sign } = way;
        let rows = pack.h.len();
        let end = _mm512_set1_epi32(rows as i32);
        let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let default = _mm512_add_epi32(_mm512_add_epi32(lane, end), _mm512_set1_epi32(if forward { 0 } else { 16 }));
        let infinity = _mm512_set1_ps(f32::INFINITY);
        let outside = _mm512_set1_ps(OUTSIDE);
        let one = _mm512_set1_ps(1.0);
        let zero = _mm512_setzero_ps();
        // The sample that the next one finds first, its value, and what follows *it*.
        let (mut at, mut top) = (default, infinity);
        let (mut after, mut after_top) = (default, infinity);
        let (from, to) = pack.rows;
        let n = pack.isovalues;
        let last = _mm512_set1_ps((n - 1) as f32);
        for step in 0..to - from {
            let row = if forward { to - 1 - step } else { from + step };
            if !pack.cuts.is_empty() {
                let cut_row = if forward { row } else { row.wrapping_sub(1) };
                let cuts = pack.cuts.iter().filter(|c| c.row == cut_row);
                let mut close = |cut: &super::super::pack::Cut| {
                    let mask = 1 << cut.lane;
                    let slot = cut.slots[usize::from(!forward)] as i32;
                    at = _mm512_mask_add_epi32(at, mask, end, _mm512_set1_epi32(slot));
                    top = _mm512_mask_mov_ps(top, mask, infinity);
                };
                if forward { cuts.rev().for_each(&mut close) } else { cuts.for_each(&mut close) }
            }
            // SAFETY: a row is sixteen f32.
            let h = unsafe { _mm512_loadu_ps(pack.h[row].as_ptr()) };
            let out_of = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(h, outside);
            at = _mm512_mask_mov_epi32(at, out_of, default);
            top = _mm512_mask_mov_ps(top, out_of, infinity);
            let active = _mm512_cmp_ps_mask::<_CMP_ORD_Q>(h, h) & !out_of;
            let (mut j, mut t) = (at, top);
            let lower = |t: __m512| {
                if strict { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(t, h) } else { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(t, h) }
            };
            let mut pop = lower(t) & active;
            // What follows the newest sample is still in registers.
            j = _mm512_mask_mov_epi32(j, pop, after);
            t = _mm512_mask_mov_ps(t, pop, after_top);
            pop &= lower(t);
            while pop != 0 {
                let index = _mm512_add_epi32(_mm512_slli_epi32::<4>(j), lane);
                // SAFETY: a lane that pops has t below its own finite h, so j is no end (their t is ∞) but a row that
                // this scan has written: j < rows, and `next` and `h_next` hold rows · 16 numbers.
                unsafe {
                    j = _mm512_mask_i32gather_epi32::<4>(j, pop, index, pack.next.as_ptr().cast());
                    t = gather(pack.h_next.as_flattened(), index, pop, t);
                }
                pop &= lower(t);
            }
            // SAFETY: rows are sixteen numbers.
            unsafe {
                _mm512_storeu_si512(pack.next[row].as_mut_ptr().cast(), j);
                _mm512_storeu_ps(pack.h_next[row].as_mut_ptr(), t);
            }
            at = _mm512_mask_mov_epi32(at, active, _mm512_set1_epi32(row as i32));
            top = _mm512_mask_mov_ps(top, active, h);
            after = _mm512_mask_mov_epi32(after, active, j);
            after_top = _mm512_mask_mov_ps(after_top, active, t);
            if row == 0 || row == rows - 1 {
                continue;
            }
            let ended = _mm512_cmp_epi32_mask::<_MM_CMPINT_NLT>(j, end) & active;
            let hits = active & !ended;
            let mut light = [zero; 3];
            if hits != 0 {
                let near = _mm512_add_epi32(j, _mm512_set1_epi32(if forward { -1 } else { 1 }));
                let index = _mm512_add_epi32(_mm512_slli_epi32::<4>(j), lane);
                let near = _mm512_add_epi32(_mm512_slli_epi32::<4>(near), lane);
                // SAFETY: a hit's j is a row beyond this one in the order of the scan, so j and its neighbour towards
                // this row are both rows; every plane holds rows · 16 numbers.
                unsafe {
                    let h0 = gather(pack.h.as_flattened(), near, hits, zero);
                    let f = _mm512_div_ps(_mm512_sub_ps(h, h0), _mm512_sub_ps(t, h0));
                    let part = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(f, one);
                    let f = _mm512_mask_max_ps(one, part, f, zero);
                    let g = _mm512_sub_ps(one, f);
                    for c in 0..3 {
                        let b0 = gather(pack.b[c].as_flattened(), near, hits, zero);
                        let b1 = gather(pack.b[c].as_flattened(), index, hits, zero);
                        light[c] = _mm512_maskz_add_ps(hits, _mm512_mul_ps(g, b0), _mm512_mul_ps(f, b1));
                    }
                }
            }
            if ended != 0 && !pack.dark {
                let c = _mm512_mul_ps(h, _mm512_set1_ps(sign));
                let x = _mm512_sub_ps(_mm512_mul_ps(c, _mm512_set1_ps(n as f32)), _mm512_set1_ps(0.5));
                let x = _mm512_min_ps(_mm512_max_ps(x, zero), last);
                let i = _mm512_min_epi32(_mm512_cvttps_epi32(x), _mm512_set1_epi32(n as i32 - 2));
                let f = _mm512_sub_ps(x, _mm512_cvtepi32_ps(i));
                let g = _mm512_sub_ps(one, f);
                let slot = _mm512_sub_epi32(j, end);
                let base = _mm512_add_epi32(_mm512_mullo_epi32(slot, _mm512_set1_epi32(3 * n as i32)), i);
                for c in 0..3 {
                    let index = _mm512_add_epi32(base, _mm512_set1_epi32((c * n) as i32));
                    // SAFETY: slots are those of lanes (below 32) or of cuts, for all of which `end` has made a column of
                    // 3n numbers; i + 1 < n.
                    unsafe {
                        let a = gather(&pack.columns, index, ended, zero);
                        let b = gather(&pack.columns, _mm512_add_epi32(index, _mm512_set1_epi32(1)), ended, zero);
                        light[c] = _mm512_mask_add_ps(light[c], ended, _mm512_mul_ps(g, a), _mm512_mul_ps(f, b));
                    }
                }
            }
            for c in 0..3 {
                let to = &mut out[c][(row - 1) * width + start..][..LANES];
                // SAFETY: `to` is sixteen f32.
                unsafe { _mm512_storeu_ps(to.as_mut_ptr(), light[c]) };
            }
        }
    }
}
