//! The hot loops in the widest instructions the machine has. One source serves AVX2 and plain code: the compiler
//! vectorises it over the sixteen lines of a pack; AVX-512 scans by hand, since its gathers are what the compiler does
//! not find. No fused multiply-adds: every instruction set gives the same bits.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

#[cfg(target_arch = "x86_64")]
mod avx512;

use super::ends::Ends;
use super::fans::march_row;
use super::flats::Flats;
use super::gather::{COSINES, accumulate_row, sum_cosines};
use super::grid::Source;
use super::pack::{Light, Pack, Plan, Way};
use super::segments::Segments;

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

    dispatch!(read, Pack::read, (pack: &mut Pack, plan: &Plan, source: &Source, first: isize, q: isize) -> bool);
    dispatch!(end, Pack::end, (pack: &mut Pack, plan: &Plan, ends: &Ends, flats: &Flats, first: isize, q: isize));
    dispatch!(cosines, sum_cosines, (omega: &[[f32; 3]], n: &[u32], sum: &mut [f32; COSINES]));
    dispatch!(accumulate, accumulate_row, (
        e: [&mut [f32]; 3], n: &[u32], omega: [f32; 3], light: [[&[f32]; 3]; 2], line0: usize,
        f: [f32; 2], range: (usize, usize)
    ));

    /// [`march_row`].
    pub(super) fn march(self, row: &[f32], place: [f32; 2], most: &mut [f32], least: &mut [f32], out: &mut [u8]) {
        match self.0 {
            // SAFETY: `detect` made this kind on a machine with the features that `march` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512::march(row, place, most, least, out) },
            _ => march_row(row, place, most, least, out),
        }
    }

    /// [`Segments::march`].
    pub(super) fn extrema(self, h: &[f32], segments: &mut Segments) {
        match self.0 {
            // SAFETY: `detect` made this kind on a machine with the features that `extrema` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 if i32::try_from(h.len()).is_ok() => unsafe { avx512::extrema(h, segments) },
            _ => segments.march(h),
        }
    }

    /// [`Pack::scan`].
    pub(super) fn scan(self, pack: &mut Pack, way: Way, light: Light, out: &mut [Vec<f32>], place: (usize, usize)) {
        match self.0 {
            // SAFETY: `detect` made this kind on a machine with the features that `scan` enables.
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512 => unsafe { avx512::scan(pack, way, light, out, place) },
            _ => pack.scan(way, light, out, place),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::rng::{Rng, Stage};
    use crate::sweep::half::Half4;
    use crate::sweep::half::{decode, encode};
    use crate::sweep::pack::{ASLEEP, LANES, OUTSIDE};
    use crate::volume::{Lattice, Samples, Volume};
    use glam::DVec3;

    /// A pack of noise with plateaus, gaps, rows that were not read, ends outside and cuts.
    fn noise(seed: u64) -> Pack {
        let mut rng = Rng::stream(seed, Stage::Test, 0);
        let rows = 50;
        let mut pack = Pack::with_rows(rows);
        for row in 0..rows {
            if row % 11 != 7 {
                pack.awake.push(row as u32);
            }
            for lane in 0..LANES {
                let x = (rng.unit() * 12.0).floor() as f32 / 12.0;
                let out = row < lane % 5 || row + lane % 3 >= rows;
                let kind = rng.unit();
                pack.h[row][lane] = if out {
                    OUTSIDE
                } else if kind < 0.03 {
                    f32::NAN
                } else if row % 11 == 7 {
                    ASLEEP
                } else {
                    x
                };
                pack.node[row][lane] = (rng.unit() * 30.0) as u32;
            }
        }
        pack.lasts = std::array::from_fn(|_| std::array::from_fn(|_| (rng.unit() * 17.0) as u32));
        pack.cuts = (0..2)
            .map(|i| super::super::pack::Cut { row: 17 + i, lane: 3, places: [3 + 2 * i as u32, 4 + 2 * i as u32] })
            .collect();
        pack
    }

    /// Numbers for thirty nodes, or five ends over four isovalues and more.
    fn random(seed: u64) -> Vec<Half4> {
        let mut rng = Rng::stream(seed, Stage::Test, 0);
        (0..30).map(|_| std::array::from_fn(|_| encode(rng.unit() as f32))).collect()
    }

    #[test]
    fn every_instruction_set_scans_to_the_same_bits() {
        for seed in 0..20 {
            for way in 0..4 {
                let way = Way { strict: way & 2 == 2, sign: if way & 1 == 1 { 1.0 } else { -1.0 } };
                let scan = |isa: Isa| {
                    let mut out = vec![vec![0f32; 48 * LANES]; 3];
                    let light = Light { b: &random(9), flats: &random(10), isovalues: 4 };
                    isa.scan(&mut noise(seed), way, light, &mut out, (LANES, 0));
                    out.iter().flatten().map(|x| x.to_bits()).collect::<Vec<_>>()
                };
                assert_eq!(scan(Isa::PLAIN), scan(Isa::detect()), "{way:?}");
            }
        }
    }

    #[test]
    fn every_instruction_set_marches_to_the_same_bits() {
        let mut rng = Rng::stream(5, Stage::Test, 0);
        for count in [1, 15, 16, 17, 100] {
            let mut row: Vec<f32> = (0..40).map(|_| rng.unit() as f32).collect();
            row[13] = f32::NAN;
            let start: Vec<f32> = (0..count).map(|_| rng.unit() as f32).collect();
            let run = |isa: Isa| {
                let (mut most, mut least, mut out) = (start.clone(), start.clone(), vec![9u8; count]);
                isa.march(&row, [-0.3, 0.371], &mut most, &mut least, &mut out);
                (most.iter().chain(&least).map(|x| x.to_bits()).collect::<Vec<_>>(), out)
            };
            assert_eq!(run(Isa::PLAIN), run(Isa::detect()), "{count} lines");
        }
    }

    #[test]
    fn every_instruction_set_finds_the_same_extrema() {
        let mut rng = Rng::stream(6, Stage::Test, 0);
        let lattice = Lattice::aligned([9, 14, 11], DVec3::ZERO, DVec3::ONE).unwrap();
        let mut samples: Vec<f64> = (0..lattice.len()).map(|_| rng.unit()).collect();
        samples[700] = f64::NAN;
        let volume = Volume::new("noise", lattice, Samples::F64(samples)).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
        for _ in 0..200 {
            let mut segments = Segments::NONE;
            // Partly outside; the last lanes stay empty.
            let mut point = || DVec3::new(rng.unit(), rng.unit(), rng.unit()) * 20.0 - 4.0;
            (0..13).for_each(|lane| segments.set(lane, &field, point(), point()));
            let run = |isa: Isa| {
                let mut segments = segments.clone();
                isa.extrema(field.samples(), &mut segments);
                [segments.least, segments.most].map(|x| x.map(f32::to_bits))
            };
            assert_eq!(run(Isa::PLAIN), run(Isa::detect()));
        }
    }

    #[test]
    fn scans_find_the_next_greater_value() {
        // Against looking at every later sample: [BSV93] is only a faster way to do that.
        let mut pack = noise(7);
        pack.cuts.clear();
        let reference = noise(7);
        let mut out = vec![vec![0f32; 48 * LANES]; 3];
        let b = random(9);
        let light = Light { b: &b, flats: &random(10), isovalues: 4 };
        Isa::detect().scan(&mut pack, Way { strict: false, sign: 1.0 }, light, &mut out, (LANES, 0));
        let mut found = [0; 2];
        let h = |row: usize, lane: usize| reference.h[row][lane];
        for lane in 0..LANES {
            for row in (1..49).filter(|r| r % 11 != 7) {
                let value = h(row, lane);
                let forward = h((row + 1).min(48), lane) < h((row - 1).max(1), lane);
                let next = if forward {
                    (row + 1..50).find(|&r| h(r, lane) >= value)
                } else {
                    (0..row).rev().find(|&r| h(r, lane) >= value)
                };
                if let (true, Some(r)) = (value.is_finite(), next) {
                    let before = if forward { r - 1 } else { r + 1 };
                    let h0 = h(before, lane);
                    let first = !h0.is_nan() && (value - h0) < 0.5 * (h(r, lane) - h0);
                    let node = reference.node[if first { before } else { r }][lane];
                    let expected = decode(b[node as usize][1]);
                    assert_eq!(out[1][(row - 1) * LANES + lane], expected, "lane {lane} row {row}");
                    found[usize::from(forward)] += 1;
                }
            }
        }
        assert!(found[0] > 200 && found[1] > 200, "{found:?}");
    }
}
