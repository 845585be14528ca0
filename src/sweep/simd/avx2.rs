//! AVX2, sixteen lines as two times eight lanes: what the compiler does not find in the plain code. Masks are vectors,
//! all ones in a lane that is meant. Gathers cost as much as loads one by one here, or more, so that lines which lie
//! close together are permuted out of what two loads bring.

use crate::isovalue_axis::IsovalueAxis;
use crate::sweep::clearance::Clearance;
use crate::sweep::fans::{HIGHER, LOWER, SAMPLED, march_row};
use crate::sweep::half::Half4;
use crate::sweep::pack::{LANES, OUTSIDE, Pack};
use crate::sweep::scan::{Light, ScanRule};
use crate::sweep::segments::Segments;
use std::arch::x86_64::*;

/// Lanes of a vector.
const HALF: usize = LANES / 2;

/// [`Pack::scan`] with a line per lane.
#[target_feature(enable = "avx2,f16c")]
pub(super) fn scan(pack: &mut Pack, rule: ScanRule, light: Light, out: &mut [Vec<f32>], place: (usize, usize)) {
    if rule.strict {
        link::<true, true>(pack);
        link::<true, false>(pack);
    } else {
        link::<false, true>(pack);
        link::<false, false>(pack);
    }
    look(pack, rule, light, out, place);
}

/// Half of sixteen numbers.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn floats(x: &[f32; LANES], half: usize) -> __m256 {
    // SAFETY: eight of sixteen numbers: `half` is 0 or 1, which the index asserts.
    unsafe { _mm256_loadu_ps(x[half * HALF..][..HALF].as_ptr()) }
}

/// As above.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn ints<T: Copy>(x: &[T; LANES], half: usize) -> __m256i {
    const { assert!(size_of::<T>() == 4) };
    // SAFETY: as above; callers keep integers of 32 bits there.
    unsafe { _mm256_loadu_si256(x[half * HALF..][..HALF].as_ptr().cast()) }
}

/// `b` where `mask` is set, else `a`.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn choose(a: __m256i, b: __m256i, mask: __m256) -> __m256i {
    _mm256_castps_si256(_mm256_blendv_ps(_mm256_castsi256_ps(a), _mm256_castsi256_ps(b), mask))
}

/// Neither NaN nor infinite.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn finite(x: __m256) -> __m256 {
    let size = _mm256_andnot_ps(_mm256_set1_ps(-0.0), x);
    _mm256_cmp_ps::<_CMP_LT_OQ>(size, _mm256_set1_ps(f32::INFINITY))
}

/// The first eight numbers; 0 for those there are not.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn first_of(x: &[f32]) -> __m256 {
    // SAFETY: eight numbers, or as many as the mask has.
    unsafe {
        if x.len() >= HALF { _mm256_loadu_ps(x.as_ptr()) } else { _mm256_maskload_ps(x.as_ptr(), up_to(x.len())) }
    }
}

/// The first `count` lanes.
#[target_feature(enable = "avx2,f16c")]
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "lanes")]
fn up_to(count: usize) -> __m256i {
    _mm256_cmpgt_epi32(_mm256_set1_epi32(count.min(HALF) as i32), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7))
}

/// [`super::march_row`], of steps of at most one sample, which those of fans are, eight at a time.
#[target_feature(enable = "avx2,f16c")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a row")]
#[allow(clippy::cast_sign_loss, reason = "clamped to the row")]
pub(super) fn march(row: &[f32], [u0, du]: [f32; 2], [most, least]: [&mut [f32]; 2], out: &mut [u8], turn: u8) {
    let count = out.len();
    assert!(most.len() == count && least.len() == count && row.len() >= 2);
    assert!(super::signed(row.len()));
    let last = row.len() as i32 - 2;
    let end = _mm256_set1_ps(row.len() as f32);
    let lane = _mm256_setr_ps(0., 1., 2., 3., 4., 5., 6., 7.);
    let [sampled, lower, higher] =
        [SAMPLED | turn, LOWER, HIGHER].map(|b| _mm256_castsi256_ps(_mm256_set1_epi32(i32::from(b))));
    // The first bytes of words, of both halves.
    let bytes = _mm256_set1_epi32(0x0c08_0400);
    for start in (0..count).step_by(HALF) {
        let n = _mm256_add_ps(lane, _mm256_set1_ps(start as f32));
        let u = _mm256_add_ps(_mm256_set1_ps(u0), _mm256_mul_ps(n, _mm256_set1_ps(du)));
        let u = _mm256_max_ps(u, _mm256_setzero_ps());
        // Of what is beyond all integers the conversion would make the least.
        let i = _mm256_min_epi32(_mm256_cvttps_epi32(_mm256_min_ps(u, end)), _mm256_set1_epi32(last));
        let first = _mm256_extract_epi32::<0>(i).clamp(0, last);
        let among = _mm256_sub_epi32(i, _mm256_set1_epi32(first));
        if _mm256_testz_si256(among, _mm256_set1_epi32(!7)) == 0 {
            march_row(row, [u0, du], start, [most, least], out, turn);
            return;
        }
        let samples = &row[first as usize..];
        let a = _mm256_permutevar8x32_ps(first_of(samples), among);
        let b = _mm256_permutevar8x32_ps(first_of(&samples[1..]), among);
        let f = _mm256_sub_ps(u, _mm256_cvtepi32_ps(i));
        let x = _mm256_add_ps(a, _mm256_mul_ps(f, _mm256_sub_ps(b, a)));
        let (most, least, out) = (&mut most[start..], &mut least[start..], &mut out[start..]);
        let (m, l) = (first_of(most), first_of(least));
        let there = _mm256_cmp_ps::<_CMP_ORD_Q>(x, x);
        let above = _mm256_cmp_ps::<_CMP_GT_OQ>(x, m);
        let below = _mm256_cmp_ps::<_CMP_LE_OQ>(x, l);
        let (m, l) = (_mm256_blendv_ps(m, x, above), _mm256_blendv_ps(l, x, below));
        let seen = _mm256_or_ps(_mm256_and_ps(above, lower), _mm256_and_ps(below, higher));
        let seen = _mm256_or_ps(seen, _mm256_and_ps(there, sampled));
        let seen = _mm256_shuffle_epi8(_mm256_castps_si256(seen), bytes);
        let seen = _mm_unpacklo_epi32(_mm256_castsi256_si128(seen), _mm256_extracti128_si256::<1>(seen));
        // SAFETY: stores of eight numbers, or of as many as there are, and of the eight bytes of an array.
        unsafe {
            if let Some(out) = out.first_chunk_mut::<HALF>() {
                _mm256_storeu_ps(most.as_mut_ptr(), m);
                _mm256_storeu_ps(least.as_mut_ptr(), l);
                _mm_storel_epi64(out.as_mut_ptr().cast(), seen);
            } else {
                _mm256_maskstore_ps(most.as_mut_ptr(), up_to(out.len()), m);
                _mm256_maskstore_ps(least.as_mut_ptr(), up_to(out.len()), l);
                let mut bytes = [0; HALF];
                _mm_storel_epi64(bytes.as_mut_ptr().cast(), seen);
                out.copy_from_slice(&bytes[..out.len()]);
            }
        }
    }
}

/// [`Segments::march`] for less than 2³¹ samples.
#[target_feature(enable = "avx2,f16c")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "less than 2³¹ samples")]
pub(super) fn extrema(h: &[f32], s: &mut Segments, clearance: Option<&Clearance>) {
    if h.is_empty() {
        return;
    }
    let greatest = _mm256_set1_epi32(h.len() as i32 - 1);
    for half in 0..2 {
        let (start, slope) = (s.start.each_ref(), s.slope.each_ref());
        let (start, slope) = (start.map(|x| floats(x, half)), slope.map(|x| floats(x, half)));
        let (last, stride) = (s.last.each_ref().map(|x| ints(x, half)), s.stride.each_ref().map(|x| ints(x, half)));
        let (first, count, way) = (ints(&s.first, half), ints(&s.count, half), ints(&s.way, half));
        let enough = s.enough.each_ref().map(|x| floats(x, half));
        let (mut least, mut most) = (floats(&s.least, half), floats(&s.most, half));
        let (zero, one) = (_mm256_setzero_ps(), _mm256_set1_ps(1.0));
        let blocks = s.blocks.each_ref().map(|x| ints(x, half));
        let last_block = _mm256_set1_epi32(clearance.map_or(0, |c| c.slices.len() - 4) as i32);
        let (mut k, mut left) = (first, count);
        loop {
            let found = _mm256_or_ps(
                _mm256_cmp_ps::<_CMP_LT_OQ>(least, enough[0]),
                _mm256_cmp_ps::<_CMP_GE_OQ>(most, enough[1]),
            );
            let wanted =
                _mm256_andnot_si256(_mm256_castps_si256(found), _mm256_cmpgt_epi32(left, _mm256_setzero_si256()));
            if _mm256_testz_si256(wanted, wanted) == 1 {
                break;
            }
            let slice = _mm256_cvtepi32_ps(k);
            let place = |i: usize| {
                let x = _mm256_max_ps(_mm256_add_ps(start[i], _mm256_mul_ps(slice, slope[i])), zero);
                let cell = _mm256_min_epi32(_mm256_cvttps_epi32(x), last[i]);
                (cell, _mm256_min_ps(_mm256_sub_ps(x, _mm256_cvtepi32_ps(cell)), one))
            };
            let ((i, f), (j, g)) = (place(0), place(1));
            let at = _mm256_add_epi32(_mm256_mullo_epi32(i, stride[0]), _mm256_mullo_epi32(j, stride[1]));
            let at = _mm256_add_epi32(at, _mm256_mullo_epi32(k, stride[2]));
            let beside = _mm256_add_epi32(at, stride[0]);
            let (over, opposite) = (_mm256_add_epi32(at, stride[1]), _mm256_add_epi32(beside, stride[1]));
            let exists = |at| _mm256_cmpeq_epi32(_mm256_min_epu32(at, greatest), at);
            let mask = _mm256_and_si256(
                _mm256_and_si256(wanted, exists(at)),
                _mm256_and_si256(exists(beside), _mm256_and_si256(exists(over), exists(opposite))),
            );
            let mask = _mm256_castsi256_ps(mask);
            // SAFETY: in lanes of the mask all four places, as unsigned numbers, are below the length of `h`, which is
            // below 2³¹.
            let [a, b, c, d] = unsafe {
                let sample = |at| _mm256_mask_i32gather_ps::<4>(zero, h.as_ptr(), at, mask);
                [sample(at), sample(beside), sample(over), sample(opposite)]
            };
            let near = _mm256_add_ps(a, _mm256_mul_ps(f, _mm256_sub_ps(b, a)));
            let far = _mm256_add_ps(c, _mm256_mul_ps(f, _mm256_sub_ps(d, c)));
            let value = _mm256_add_ps(near, _mm256_mul_ps(g, _mm256_sub_ps(far, near)));
            // Of NaN and a number min and max return the second, the number.
            least = _mm256_blendv_ps(least, _mm256_min_ps(value, least), mask);
            most = _mm256_blendv_ps(most, _mm256_max_ps(value, most), mask);
            let Some(clearance) = clearance else {
                (k, left) = (_mm256_add_epi32(k, way), _mm256_sub_epi32(left, _mm256_set1_epi32(1)));
                continue;
            };
            let [bi, bj, bk] = [i, j, k].map(|x| _mm256_srli_epi32::<{ Clearance::SHIFT as i32 }>(x));
            let block = _mm256_add_epi32(_mm256_mullo_epi32(bi, blocks[0]), _mm256_mullo_epi32(bj, blocks[1]));
            let block = _mm256_add_epi32(block, _mm256_mullo_epi32(bk, blocks[2]));
            let block = _mm256_min_epu32(block, last_block);
            // SAFETY: words of four bytes from places of at most four less than the length.
            let slices = unsafe { _mm256_i32gather_epi32::<1>(clearance.slices.as_ptr().cast(), block) };
            let slices = _mm256_and_si256(slices, _mm256_set1_epi32(0xff));
            (k, left) = (_mm256_add_epi32(k, _mm256_mullo_epi32(way, slices)), _mm256_sub_epi32(left, slices));
        }
        // SAFETY: eight of sixteen numbers each.
        unsafe {
            _mm256_storeu_ps(s.least[half * HALF..][..HALF].as_mut_ptr(), least);
            _mm256_storeu_ps(s.most[half * HALF..][..HALF].as_mut_ptr(), most);
        }
    }
}

/// [`Pack::link`].
#[target_feature(enable = "avx2,f16c")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a pack")]
fn link<const STRICT: bool, const FORWARD: bool>(pack: &mut Pack) {
    let d = usize::from(!FORWARD);
    let lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    let lasts: [u32; LANES] = std::array::from_fn(|lane| pack.last(lane, FORWARD));
    let default = [ints(&lasts, 0), ints(&lasts, 1)];
    let infinity = _mm256_set1_ps(f32::INFINITY);
    let outside = _mm256_set1_ps(OUTSIDE);
    // The sample that the next one finds first, its value, and what follows *it*.
    let (mut at, mut top) = (default, [infinity; 2]);
    let (mut after, mut after_top) = (default, [infinity; 2]);
    let count = pack.awake.len();
    for step in 0..count {
        let row = pack.awake[if FORWARD { count - 1 - step } else { step }] as usize;
        if !pack.cuts.is_empty() {
            pack.close(row, FORWARD, |closed, place| {
                let half = closed / HALF % 2;
                let this = _mm256_cmpeq_epi32(lane, _mm256_set1_epi32((closed % HALF) as i32));
                let this = _mm256_castsi256_ps(this);
                at[half] = choose(at[half], _mm256_set1_epi32(place as i32), this);
                top[half] = _mm256_blendv_ps(top[half], infinity, this);
            });
        }
        for half in 0..2 {
            let h = floats(&pack.h[row], half);
            let out_of = _mm256_cmp_ps::<_CMP_EQ_OQ>(h, outside);
            let active = finite(h);
            let mut j = choose(at[half], default[half], out_of);
            let mut t = _mm256_blendv_ps(top[half], infinity, out_of);
            let (newest, newest_top) = (j, t);
            let lower = |t: __m256| {
                if STRICT { _mm256_cmp_ps::<_CMP_LE_OQ>(t, h) } else { _mm256_cmp_ps::<_CMP_LT_OQ>(t, h) }
            };
            let mut pop = _mm256_and_ps(lower(t), active);
            // What follows the newest sample is still in registers.
            j = choose(j, after[half], pop);
            t = _mm256_blendv_ps(t, after_top[half], pop);
            pop = _mm256_and_ps(pop, lower(t));
            while _mm256_movemask_ps(pop) != 0 {
                // SAFETY: a lane that pops has t at most its own h, which `active` says is finite, so j is no end
                // (their t is ∞) but a sample that this scan has linked, and `next` and `h_next` hold a number for
                // each.
                unsafe {
                    t = _mm256_mask_i32gather_ps::<4>(t, pack.h_next[d].as_ptr().cast(), j, pop);
                    let mask = _mm256_castps_si256(pop);
                    j = _mm256_mask_i32gather_epi32::<4>(j, pack.next[d].as_ptr().cast(), j, mask);
                }
                pop = _mm256_and_ps(pop, lower(t));
            }
            let (next, h_next) = (&mut pack.next[d][row], &mut pack.h_next[d][row]);
            // SAFETY: eight of sixteen numbers each.
            unsafe {
                _mm256_storeu_si256(next[half * HALF..][..HALF].as_mut_ptr().cast(), j);
                _mm256_storeu_ps(h_next[half * HALF..][..HALF].as_mut_ptr(), t);
            }
            let here = _mm256_add_epi32(_mm256_set1_epi32((row * LANES + half * HALF) as i32), lane);
            at[half] = choose(newest, here, active);
            top[half] = _mm256_blendv_ps(newest_top, h, active);
            after[half] = choose(after[half], j, active);
            after_top[half] = _mm256_blendv_ps(after_top[half], t, active);
        }
    }
}

/// What the rays of half a row meet.
#[derive(Clone, Copy)]
struct Met {
    row: usize,
    /// Lanes that meet level sets, and of which nodes they read B; 0 in the others.
    hits: __m256,
    nodes: [u32; HALF],
    /// Lanes that meet ends, and the first of the two isovalues that they read, in [`Light::flats`]; 0 in the others.
    ended: __m256,
    flats: [u32; HALF],
    /// How far between these.
    f: __m256,
}

/// How many rows ahead of reading light memory is asked for it.
const AHEAD: usize = 8;

/// The places in lanes of a mask, 0 in others. Asks memory for what stands there.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn ask(base: &[Half4], places: __m256i, mask: __m256) -> [u32; HALF] {
    let mut at = [0u32; HALF];
    // SAFETY: the array is eight numbers.
    unsafe { _mm256_storeu_si256(at.as_mut_ptr().cast(), _mm256_and_si256(places, _mm256_castps_si256(mask))) };
    for at in at {
        // A hint, which reads nothing and faults nowhere.
        _mm_prefetch::<_MM_HINT_T0>(base.as_ptr().wrapping_add(at as usize).cast());
    }
    at
}

/// [`Pack::look`]. Light comes from anywhere: what a row meets is found some rows before it is read.
#[target_feature(enable = "avx2,f16c")]
fn look(pack: &Pack, rule: ScanRule, light: Light, out: &mut [Vec<f32>], (width, start): (usize, usize)) {
    // Row 0 is none.
    let none = _mm256_setzero_ps();
    let none = Met { row: 0, hits: none, nodes: [0; HALF], ended: none, flats: [0; HALF], f: none };
    let mut ring = [[none; 2]; AHEAD];
    for n in 0..pack.awake.len() + AHEAD {
        let here = &mut ring[n % AHEAD];
        for (half, met) in here.iter_mut().enumerate().filter(|(_, met)| met.row > 0) {
            let rgb = read(light, met);
            for c in 0..3 {
                let to = &mut out[c][(met.row - 1) * width + start + half * HALF..][..HALF];
                // SAFETY: `to` is eight f32.
                unsafe { _mm256_storeu_ps(to.as_mut_ptr(), rgb[c]) };
            }
            met.row = 0;
        }
        // Entry and exit points are no slices.
        if let Some(row) = pack.awake.get(n).map(|&row| row as usize).filter(|&row| row != 0 && row != pack.h.len() - 1)
        {
            for (half, met) in here.iter_mut().enumerate() {
                meet(pack, rule, light, (row, half), met);
            }
        }
    }
}

/// [`IsovalueAxis::place`] of eight isovalues.
#[target_feature(enable = "avx2")]
#[inline]
fn place(axis: &IsovalueAxis, c: __m256) -> __m256 {
    let c = _mm256_min_ps(_mm256_max_ps(c, _mm256_setzero_ps()), _mm256_set1_ps(1.0));
    let u = _mm256_add_ps(_mm256_set1_ps(axis.from), _mm256_mul_ps(_mm256_set1_ps(axis.slope), c));
    let rise = _mm256_sub_epi32(_mm256_castps_si256(u), _mm256_set1_epi32(axis.first));
    let rise = _mm256_mul_ps(_mm256_set1_ps(axis.scale), _mm256_cvtepi32_ps(rise));
    _mm256_add_ps(_mm256_mul_ps(_mm256_set1_ps(axis.even), c), rise)
}

/// What the downhill rays of half a row meet; asks memory for it.
#[target_feature(enable = "avx2,f16c")]
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a pack")]
fn meet(pack: &Pack, rule: ScanRule, light: Light, (row, side): (usize, usize), met: &mut Met) {
    let (rows, n) = (pack.h.len(), light.isovalues);
    let ends = _mm256_set1_epi32(pack.ends() as i32);
    let (zero, half) = (_mm256_setzero_ps(), _mm256_set1_ps(0.5));
    let zeros = _mm256_setzero_si256();
    let (back, on) = (_mm256_set1_epi32(-(LANES as i32)), _mm256_set1_epi32(LANES as i32));
    let h = floats(&pack.h[row], side);
    let (after, before) = (&pack.h[(row + 1).min(rows - 2)], &pack.h[(row - 1).max(1)]);
    let forward = _mm256_cmp_ps::<_CMP_LT_OQ>(floats(after, side), floats(before, side));
    let active = finite(h);
    let j = choose(ints(&pack.next[1][row], side), ints(&pack.next[0][row], side), forward);
    let t = _mm256_blendv_ps(floats(&pack.h_next[1][row], side), floats(&pack.h_next[0][row], side), forward);
    let sample = _mm256_castsi256_ps(_mm256_cmpgt_epi32(ends, j));
    let (hits, ended) = (_mm256_and_ps(active, sample), _mm256_andnot_ps(sample, active));
    (met.row, met.hits, met.ended) = (row, hits, ended);
    if _mm256_movemask_ps(hits) != 0 {
        let near = _mm256_add_epi32(j, choose(on, back, forward));
        // SAFETY: a hit's j is a sample in a row beyond this one in the order of the scan, so its neighbour towards
        // this row is a sample too.
        let nodes = unsafe {
            let h0 = _mm256_mask_i32gather_ps::<4>(zero, pack.h.as_ptr().cast(), near, hits);
            let (above, step) = (_mm256_sub_ps(h, h0), _mm256_sub_ps(t, h0));
            let first = _mm256_cmp_ps::<_CMP_LT_OQ>(above, _mm256_mul_ps(half, step));
            let mask = _mm256_castps_si256(hits);
            _mm256_mask_i32gather_epi32::<4>(zeros, pack.node.as_ptr().cast(), choose(j, near, first), mask)
        };
        met.nodes = ask(light.b, nodes, hits);
    }
    if _mm256_movemask_ps(ended) != 0 {
        let c = _mm256_mul_ps(h, _mm256_set1_ps(rule.sign));
        let x = _mm256_sub_ps(_mm256_mul_ps(place(light.axis, c), _mm256_set1_ps(n as f32)), half);
        let x = _mm256_min_ps(_mm256_max_ps(x, zero), _mm256_set1_ps((n - 1) as f32));
        let i = _mm256_min_epi32(_mm256_cvttps_epi32(x), _mm256_set1_epi32(n as i32 - 2));
        met.f = _mm256_sub_ps(x, _mm256_cvtepi32_ps(i));
        met.flats = ask(light.flats, _mm256_add_epi32(_mm256_sub_epi32(j, ends), i), ended);
    }
}

/// Radiance at eight places.
///
/// # Safety
/// Every place is below the length of `base`.
#[target_feature(enable = "avx2,f16c")]
#[inline]
unsafe fn fetch(base: &[Half4], places: &[u32; HALF]) -> [__m256; 3] {
    let four = |lane: usize| {
        // SAFETY: the caller keeps the places inside `base`, whose elements are eight bytes.
        unsafe {
            let one = |lane: usize| _mm_loadl_epi64(base.as_ptr().add(places[lane] as usize).cast());
            _mm256_cvtph_ps(_mm_unpacklo_epi64(one(lane), one(lane + 4)))
        }
    };
    let (a, b, c, d) = (four(0), four(1), four(2), four(3));
    let (rg, rg2) = (_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d));
    let (blue, blue2) = (_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d));
    [_mm256_shuffle_ps::<0x44>(rg, rg2), _mm256_shuffle_ps::<0xee>(rg, rg2), _mm256_shuffle_ps::<0x44>(blue, blue2)]
}

/// The radiance there.
#[target_feature(enable = "avx2,f16c")]
#[inline]
fn read(light: Light, met: &Met) -> [__m256; 3] {
    let mut rgb = [_mm256_setzero_ps(); 3];
    if _mm256_movemask_ps(met.hits) != 0 {
        // SAFETY: `node` holds nodes of the lattice only, since `choose` clamps and `side` names one, and `b` has the B
        // of all; the others read the first.
        rgb = unsafe { fetch(light.b, &met.nodes) }.map(|x| _mm256_and_ps(x, met.hits));
    }
    if _mm256_movemask_ps(met.ended) != 0 {
        let g = _mm256_sub_ps(_mm256_set1_ps(1.0), met.f);
        // SAFETY: ends are places of n ≥ 2 numbers in `flats`, of which i + 1 < n; the others read the first two.
        let (x, y) = unsafe { (fetch(light.flats, &met.flats), fetch(light.flats, &met.flats.map(|at| at + 1))) };
        for c in 0..3 {
            let end = _mm256_add_ps(_mm256_mul_ps(g, x[c]), _mm256_mul_ps(met.f, y[c]));
            rgb[c] = _mm256_blendv_ps(rgb[c], end, met.ended);
        }
    }
    rgb
}
