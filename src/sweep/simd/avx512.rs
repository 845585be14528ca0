//! AVX-512, sixteen lines in sixteen lanes: what the compiler does not find in the plain code.

use crate::isovalue_axis::IsovalueAxis;
use crate::sweep::clearance::Clearance;
use crate::sweep::fans::{HIGHER, LOWER, SAMPLED};
use crate::sweep::half::Half4;
use crate::sweep::pack::{LANES, OUTSIDE, Pack};
use crate::sweep::scan::{Light, ScanRule};
use crate::sweep::segments::Segments;
use std::arch::x86_64::*;

/// [`Pack::scan`] with a line per lane.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
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

/// [`super::march_row`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a row")]
pub(super) fn march(row: &[f32], [u0, du]: [f32; 2], [most, least]: [&mut [f32]; 2], out: &mut [u8], turn: u8) {
    let count = out.len();
    assert!(most.len() == count && least.len() == count && row.len() >= 2);
    assert!(super::signed(row.len()));
    let last = _mm512_set1_epi32(row.len() as i32 - 2);
    let end = _mm512_set1_ps(row.len() as f32);
    let (u0, du) = (_mm512_set1_ps(u0), _mm512_set1_ps(du));
    let zero = _mm512_setzero_ps();
    let lane = _mm512_setr_ps(0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.);
    let [sampled, lower, higher] = [SAMPLED | turn, LOWER, HIGHER].map(|b| _mm_set1_epi8(b as i8));
    for start in (0..count).step_by(LANES) {
        let mask: __mmask16 = if count - start >= LANES { u16::MAX } else { (1 << (count - start)) - 1 };
        let n = _mm512_add_ps(lane, _mm512_set1_ps(start as f32));
        let u = _mm512_max_ps(_mm512_add_ps(u0, _mm512_mul_ps(n, du)), zero);
        // Of what is beyond all integers the conversion would make the least.
        let i = _mm512_min_epi32(_mm512_cvttps_epi32(_mm512_min_ps(u, end)), last);
        // SAFETY: u is 0 or more, 0 for NaN, so 0 ≤ i ≤ row.len() − 2 in every lane of the mask; the others are not
        // touched, nor are most, least and out beyond `count`, their common length.
        unsafe {
            let a = _mm512_mask_i32gather_ps::<4>(zero, mask, i, row.as_ptr());
            let b = _mm512_mask_i32gather_ps::<4>(zero, mask, i, row.as_ptr().add(1));
            let f = _mm512_sub_ps(u, _mm512_cvtepi32_ps(i));
            let x = _mm512_add_ps(a, _mm512_mul_ps(f, _mm512_sub_ps(b, a)));
            let m = _mm512_maskz_loadu_ps(mask, most.as_ptr().add(start));
            let l = _mm512_maskz_loadu_ps(mask, least.as_ptr().add(start));
            let there = _mm512_cmp_ps_mask::<_CMP_ORD_Q>(x, x) & mask;
            let above = _mm512_mask_cmp_ps_mask::<_CMP_GT_OQ>(there, x, m);
            let below = _mm512_mask_cmp_ps_mask::<_CMP_LE_OQ>(there, x, l);
            _mm512_mask_storeu_ps(most.as_mut_ptr().add(start), above, x);
            _mm512_mask_storeu_ps(least.as_mut_ptr().add(start), below, x);
            let seen = _mm_maskz_mov_epi8(there, sampled);
            let seen = _mm_or_si128(seen, _mm_maskz_mov_epi8(above, lower));
            let seen = _mm_or_si128(seen, _mm_maskz_mov_epi8(below, higher));
            _mm_mask_storeu_epi8(out.as_mut_ptr().cast::<i8>().add(start), mask, seen);
        }
    }
}

/// [`Segments::march`] for less than 2³¹ samples.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "less than 2³¹ samples")]
pub(super) fn extrema(h: &[f32], s: &mut Segments, clearance: Option<&Clearance>) {
    // SAFETY: sixteen numbers each.
    let floats = |x: &[f32; LANES]| unsafe { _mm512_loadu_ps(x.as_ptr()) };
    // SAFETY: as above.
    let ints = |x: &[i32; LANES]| unsafe { _mm512_loadu_si512(x.as_ptr().cast()) };
    let (start, slope) = ([floats(&s.start[0]), floats(&s.start[1])], [floats(&s.slope[0]), floats(&s.slope[1])]);
    let (last, stride) = ([ints(&s.last[0]), ints(&s.last[1])], [ints(&s.stride[0]), ints(&s.stride[1])]);
    let (first, count, across) = (ints(&s.first), ints(&s.count), ints(&s.stride[2]));
    let (way, enough) = (ints(&s.way), [floats(&s.enough[0]), floats(&s.enough[1])]);
    let (mut least, mut most) = (floats(&s.least), floats(&s.most));
    let (zero, one) = (_mm512_setzero_ps(), _mm512_set1_ps(1.0));
    let end = _mm512_set1_epi32(h.len() as i32);
    let blocks = s.blocks.each_ref().map(ints);
    let last_block = _mm512_set1_epi32(clearance.map_or(0, |c| c.slices.len() - 4) as i32);
    let (mut k, mut left) = (first, count);
    loop {
        let wanted = _mm512_cmp_epi32_mask::<_MM_CMPINT_NLE>(left, _mm512_setzero_si512())
            & !(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(least, enough[0]) | _mm512_cmp_ps_mask::<_CMP_GE_OQ>(most, enough[1]));
        if wanted == 0 {
            break;
        }
        let slice = _mm512_cvtepi32_ps(k);
        let place = |i: usize| {
            let x = _mm512_max_ps(_mm512_add_ps(start[i], _mm512_mul_ps(slice, slope[i])), zero);
            let cell = _mm512_min_epi32(_mm512_cvttps_epi32(x), last[i]);
            (cell, _mm512_min_ps(_mm512_sub_ps(x, _mm512_cvtepi32_ps(cell)), one))
        };
        let ((i, f), (j, g)) = (place(0), place(1));
        let at = _mm512_add_epi32(_mm512_mullo_epi32(i, stride[0]), _mm512_mullo_epi32(j, stride[1]));
        let at = _mm512_add_epi32(at, _mm512_mullo_epi32(k, across));
        let beside = _mm512_add_epi32(at, stride[0]);
        let [over, opposite] = [at, beside].map(|x| _mm512_add_epi32(x, stride[1]));
        let exists = |at| _mm512_cmp_epu32_mask::<_MM_CMPINT_LT>(at, end);
        let mask = wanted & exists(at) & exists(beside) & exists(over) & exists(opposite);
        // SAFETY: in lanes of the mask all four places, as unsigned numbers, are below the length of `h`, which is
        // below 2³¹.
        let [a, b, c, d] = unsafe {
            let sample = |at| _mm512_mask_i32gather_ps::<4>(zero, mask, at, h.as_ptr());
            [sample(at), sample(beside), sample(over), sample(opposite)]
        };
        let near = _mm512_add_ps(a, _mm512_mul_ps(f, _mm512_sub_ps(b, a)));
        let far = _mm512_add_ps(c, _mm512_mul_ps(f, _mm512_sub_ps(d, c)));
        let value = _mm512_add_ps(near, _mm512_mul_ps(g, _mm512_sub_ps(far, near)));
        // Comparisons pass over NaN.
        let lower = _mm512_mask_cmp_ps_mask::<_CMP_LT_OQ>(mask, value, least);
        let higher = _mm512_mask_cmp_ps_mask::<_CMP_GT_OQ>(mask, value, most);
        least = _mm512_mask_mov_ps(least, lower, value);
        most = _mm512_mask_mov_ps(most, higher, value);
        let Some(clearance) = clearance else {
            (k, left) = (_mm512_add_epi32(k, way), _mm512_sub_epi32(left, _mm512_set1_epi32(1)));
            continue;
        };
        let [bi, bj, bk] = [i, j, k].map(|x| _mm512_srli_epi32::<{ Clearance::SHIFT }>(x));
        let block = _mm512_add_epi32(_mm512_mullo_epi32(bi, blocks[0]), _mm512_mullo_epi32(bj, blocks[1]));
        let block = _mm512_add_epi32(block, _mm512_mullo_epi32(bk, blocks[2]));
        let block = _mm512_min_epu32(block, last_block);
        // SAFETY: words of four bytes from places of at most four less than the length.
        let slices = unsafe { _mm512_i32gather_epi32::<1>(block, clearance.slices.as_ptr().cast()) };
        let slices = _mm512_and_si512(slices, _mm512_set1_epi32(0xff));
        (k, left) = (_mm512_add_epi32(k, _mm512_mullo_epi32(way, slices)), _mm512_sub_epi32(left, slices));
    }
    // SAFETY: sixteen numbers each.
    unsafe {
        _mm512_storeu_ps(s.least.as_mut_ptr(), least);
        _mm512_storeu_ps(s.most.as_mut_ptr(), most);
    }
}

/// [`Pack::link`].
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a pack")]
fn link<const STRICT: bool, const FORWARD: bool>(pack: &mut Pack) {
    let d = usize::from(!FORWARD);
    let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    let lasts: [u32; LANES] = std::array::from_fn(|lane| pack.last(lane, FORWARD));
    // SAFETY: sixteen numbers.
    let default = unsafe { _mm512_loadu_si512(lasts.as_ptr().cast()) };
    let infinity = _mm512_set1_ps(f32::INFINITY);
    let outside = _mm512_set1_ps(OUTSIDE);
    // The sample that the next one finds first, its value, and what follows *it*.
    let (mut at, mut top) = (default, infinity);
    let (mut after, mut after_top) = (default, infinity);
    let count = pack.awake.len();
    for step in 0..count {
        let row = pack.awake[if FORWARD { count - 1 - step } else { step }] as usize;
        if !pack.cuts.is_empty() {
            pack.close(row, FORWARD, |lane, place| {
                let mask = 1 << lane;
                at = _mm512_mask_mov_epi32(at, mask, _mm512_set1_epi32(place as i32));
                top = _mm512_mask_mov_ps(top, mask, infinity);
            });
        }
        // SAFETY: a row is sixteen f32.
        let h = unsafe { _mm512_loadu_ps(pack.h[row].as_ptr()) };
        let out_of = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(h, outside);
        at = _mm512_mask_mov_epi32(at, out_of, default);
        top = _mm512_mask_mov_ps(top, out_of, infinity);
        // Neither NaN nor infinite.
        let active = !_mm512_fpclass_ps_mask::<0x99>(h);
        let (mut j, mut t) = (at, top);
        let lower = |t: __m512| {
            if STRICT { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(t, h) } else { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(t, h) }
        };
        let mut pop = lower(t) & active;
        // What follows the newest sample is still in registers.
        j = _mm512_mask_mov_epi32(j, pop, after);
        t = _mm512_mask_mov_ps(t, pop, after_top);
        pop &= lower(t);
        while pop != 0 {
            // SAFETY: a lane that pops has t at most its own h, which `active` says is finite, so j is no end (their t
            // is ∞) but a sample that this scan has linked, and `next` and `h_next` hold a number for each.
            unsafe {
                t = _mm512_mask_i32gather_ps::<4>(t, pop, j, pack.h_next[d].as_ptr().cast());
                j = _mm512_mask_i32gather_epi32::<4>(j, pop, j, pack.next[d].as_ptr().cast());
            }
            pop &= lower(t);
        }
        // SAFETY: rows are sixteen numbers.
        unsafe {
            _mm512_storeu_si512(pack.next[d][row].as_mut_ptr().cast(), j);
            _mm512_storeu_ps(pack.h_next[d][row].as_mut_ptr(), t);
        }
        let here = _mm512_add_epi32(_mm512_set1_epi32((row * LANES) as i32), lane);
        at = _mm512_mask_mov_epi32(at, active, here);
        top = _mm512_mask_mov_ps(top, active, h);
        after = _mm512_mask_mov_epi32(after, active, j);
        after_top = _mm512_mask_mov_ps(after_top, active, t);
    }
}

/// The words of sixteen halves times four, as three vectors of f32.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
fn colours(low: __m512i, high: __m512i, [rg, b]: [__m512i; 2]) -> [__m512; 3] {
    let x = _mm512_permutex2var_epi16(low, rg, high);
    let y = _mm512_permutex2var_epi16(low, b, high);
    [
        _mm512_cvtph_ps(_mm512_castsi512_si256(x)),
        _mm512_cvtph_ps(_mm512_extracti64x4_epi64::<1>(x)),
        _mm512_cvtph_ps(_mm512_castsi512_si256(y)),
    ]
}

/// Radiance at sixteen places.
///
/// # Safety
/// Every place of a lane in `mask` is below the length of `base`.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
unsafe fn fetch(base: &[Half4], place: __m512i, mask: __mmask16, order: [__m512i; 2]) -> [__m512; 3] {
    let zero = _mm512_setzero_si512();
    let (low, high) = (_mm512_castsi512_si256(place), _mm512_extracti64x4_epi64::<1>(place));
    // SAFETY: the caller keeps the places inside `base`, whose elements are eight bytes.
    unsafe {
        let low = _mm512_mask_i32gather_epi64::<8>(zero, mask as u8, low, base.as_ptr().cast());
        let high = _mm512_mask_i32gather_epi64::<8>(zero, (mask >> 8) as u8, high, base.as_ptr().cast());
        colours(low, high, order)
    }
}

/// What the rays of a row meet.
#[derive(Clone, Copy)]
struct Met {
    row: usize,
    /// Lanes that meet level sets, and of which nodes they read B.
    hits: __mmask16,
    nodes: __m512i,
    /// Lanes that meet ends, and the first of the two isovalues that they read, in [`Light::flats`].
    ended: __mmask16,
    flats: __m512i,
    /// How far between these.
    f: __m512,
}

/// How many rows ahead of reading light memory is asked for it.
const AHEAD: usize = 8;

/// Asks memory for what stands at the places of a mask.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
fn ask(base: &[Half4], places: __m512i, mask: __mmask16) {
    let mut at = [0u32; LANES];
    // SAFETY: the array is sixteen numbers.
    unsafe { _mm512_storeu_si512(at.as_mut_ptr().cast(), _mm512_maskz_mov_epi32(mask, places)) };
    for at in at {
        // A hint, which reads nothing and faults nowhere.
        _mm_prefetch::<_MM_HINT_T0>(base.as_ptr().wrapping_add(at as usize).cast());
    }
}

/// [`Pack::look`]. Light comes from anywhere: what a row meets is found some rows before it is read.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a pack")]
fn look(pack: &Pack, rule: ScanRule, light: Light, out: &mut [Vec<f32>], (width, start): (usize, usize)) {
    let word = |w: i16| {
        let mut order = [0i16; 32];
        for (i, o) in order.iter_mut().enumerate() {
            *o = 4 * (i as i16 % 16) + w + i as i16 / 16;
        }
        // SAFETY: 64 bytes.
        unsafe { _mm512_loadu_si512(order.as_ptr().cast()) }
    };
    let order = [word(0), word(2)];
    let mut ring = [const { None }; AHEAD];
    for n in 0..pack.awake.len() + AHEAD {
        let read_now: Option<Met> = ring[n % AHEAD].take();
        ring[n % AHEAD] = match pack.awake.get(n) {
            // Entry and exit points are no slices.
            Some(&row) if row != 0 && row as usize != pack.h.len() - 1 => Some(meet(pack, rule, light, row as usize)),
            _ => None,
        };
        let Some(met) = read_now else { continue };
        let rgb = read(light, &met, order);
        for c in 0..3 {
            let to = &mut out[c][(met.row - 1) * width + start..][..LANES];
            // SAFETY: `to` is sixteen f32.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), rgb[c]) };
        }
    }
}

/// [`IsovalueAxis::place`] of sixteen isovalues.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
fn place(axis: &IsovalueAxis, c: __m512) -> __m512 {
    let c = _mm512_min_ps(_mm512_max_ps(c, _mm512_setzero_ps()), _mm512_set1_ps(1.0));
    let u = _mm512_add_ps(_mm512_set1_ps(axis.from), _mm512_mul_ps(_mm512_set1_ps(axis.slope), c));
    let rise = _mm512_sub_epi32(_mm512_castps_si512(u), _mm512_set1_epi32(axis.first));
    let rise = _mm512_mul_ps(_mm512_set1_ps(axis.scale), _mm512_cvtepi32_ps(rise));
    _mm512_add_ps(_mm512_mul_ps(_mm512_set1_ps(axis.even), c), rise)
}

/// What the downhill rays of a row meet; asks memory for it.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "places in a pack")]
fn meet(pack: &Pack, rule: ScanRule, light: Light, row: usize) -> Met {
    let (rows, n) = (pack.h.len(), light.isovalues);
    let ends = _mm512_set1_epi32(pack.ends() as i32);
    let (zero, half) = (_mm512_setzero_ps(), _mm512_set1_ps(0.5));
    let zeros = _mm512_setzero_si512();
    let (back, on) = (_mm512_set1_epi32(-(LANES as i32)), _mm512_set1_epi32(LANES as i32));
    let load = |x: &[f32; LANES]| {
        // SAFETY: a row is sixteen f32.
        unsafe { _mm512_loadu_ps(x.as_ptr()) }
    };
    let links = |x: &[u32; LANES]| {
        // SAFETY: as above.
        unsafe { _mm512_loadu_si512(x.as_ptr().cast()) }
    };
    let h = load(&pack.h[row]);
    let (after, before) = (&pack.h[(row + 1).min(rows - 2)], &pack.h[(row - 1).max(1)]);
    let forward = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(load(after), load(before));
    let active = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(_mm512_abs_ps(h), _mm512_set1_ps(f32::INFINITY));
    let j = _mm512_mask_mov_epi32(links(&pack.next[1][row]), forward, links(&pack.next[0][row]));
    let t = _mm512_mask_mov_ps(load(&pack.h_next[1][row]), forward, load(&pack.h_next[0][row]));
    let ended = _mm512_cmp_epi32_mask::<_MM_CMPINT_NLT>(j, ends) & active;
    let hits = active & !ended;
    let mut met = Met { row, hits, nodes: zeros, ended, flats: zeros, f: zero };
    if hits != 0 {
        let near = _mm512_add_epi32(j, _mm512_mask_mov_epi32(on, forward, back));
        // SAFETY: a hit's j is a sample in a row beyond this one in the order of the scan, so its neighbour towards
        // this row is a sample too.
        met.nodes = unsafe {
            let h0 = _mm512_mask_i32gather_ps::<4>(zero, hits, near, pack.h.as_ptr().cast());
            let (above, step) = (_mm512_sub_ps(h, h0), _mm512_sub_ps(t, h0));
            let first = _mm512_mask_cmp_ps_mask::<_CMP_LT_OQ>(hits, above, _mm512_mul_ps(half, step));
            let at = _mm512_mask_mov_epi32(j, first, near);
            _mm512_mask_i32gather_epi32::<4>(zeros, hits, at, pack.node.as_ptr().cast())
        };
        ask(light.b, met.nodes, hits);
    }
    if ended != 0 {
        let c = _mm512_mul_ps(h, _mm512_set1_ps(rule.sign));
        let x = _mm512_sub_ps(_mm512_mul_ps(place(light.axis, c), _mm512_set1_ps(n as f32)), half);
        let x = _mm512_min_ps(_mm512_max_ps(x, zero), _mm512_set1_ps((n - 1) as f32));
        let i = _mm512_min_epi32(_mm512_cvttps_epi32(x), _mm512_set1_epi32(n as i32 - 2));
        met.f = _mm512_sub_ps(x, _mm512_cvtepi32_ps(i));
        met.flats = _mm512_add_epi32(_mm512_sub_epi32(j, ends), i);
        ask(light.flats, met.flats, ended);
    }
    met
}

/// The radiance there.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
#[inline]
fn read(light: Light, met: &Met, order: [__m512i; 2]) -> [__m512; 3] {
    let mut rgb = [_mm512_setzero_ps(); 3];
    if met.hits != 0 {
        // SAFETY: `node` holds nodes of the lattice only, since `choose` clamps and `side` names one, and `b` has the B
        // of all.
        rgb = unsafe { fetch(light.b, met.nodes, met.hits, order) };
    }
    if met.ended != 0 {
        let g = _mm512_sub_ps(_mm512_set1_ps(1.0), met.f);
        // SAFETY: ends are places of n numbers in `flats`, of which i + 1 < n.
        let (x, y) = unsafe {
            let next = _mm512_add_epi32(met.flats, _mm512_set1_epi32(1));
            (fetch(light.flats, met.flats, met.ended, order), fetch(light.flats, next, met.ended, order))
        };
        for c in 0..3 {
            rgb[c] = _mm512_mask_add_ps(rgb[c], met.ended, _mm512_mul_ps(g, x[c]), _mm512_mul_ps(met.f, y[c]));
        }
    }
    rgb
}
