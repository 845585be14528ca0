//! AVX-512: sixteen children at a time, a layer.

use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
use crate::isa::{Isa, Kind};
use crate::pyramid::kernel::{Kernel, Line, Piece};
use crate::pyramid::{Pyramid, Tile};
use glam::Vec4;
use std::arch::x86_64::*;

/// Proof that the processor has what `#[target_feature]` asks for below: made by [`Avx512::of`] only, of an [`Isa`].
/// Refers to [`Z`]: what the compiler knows it turns into two shuffles each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512(&'static [[i32; 16]; 5]);

/// What depends on the ray only. Lanes 0–4 belong to the planes of x, 5–9 of y, 10–14 of z.
pub(in crate::pyramid) struct Constants {
    o: __m512,
    inv: __m512,
    /// Plane numbers within a node in the order in which the ray meets them.
    planes: __m512,
    end: __m512,
    /// Positions within 16 children of the same z, in the ray's order, and of pairs of halves of those.
    order: __m512i,
    layers: __m512i,
    most_lo: __m512i,
    least_hi: __m512i,
}

/// Which component of a point each lane takes.
const AXES: [i32; 16] = [0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 3];
const FORWARD: [f32; 16] = [0., 1., 2., 3., 4., 0., 1., 2., 3., 4., 0., 1., 2., 3., 4., 0.];
const BACKWARD: [f32; 16] = [4., 3., 2., 1., 0., 4., 3., 2., 1., 0., 4., 3., 2., 1., 0., 0.];
/// The lane of the plane before child (x, y), and behind it.
const X_IN: [i32; 16] = [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3];
const X_OUT: [i32; 16] = [1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4, 1, 2, 3, 4];
const Y_IN: [i32; 16] = [5, 5, 5, 5, 6, 6, 6, 6, 7, 7, 7, 7, 8, 8, 8, 8];
const Y_OUT: [i32; 16] = [6, 6, 6, 6, 7, 7, 7, 7, 8, 8, 8, 8, 9, 9, 9, 9];
const COUNT: [u8; 64] = {
    let mut count = [0; 64];
    let mut n = 0;
    while n < 64 {
        count[n] = n as u8 % 16;
        n += 1;
    }
    count
};
const EIGHT: [i64; 8] = [0, 1, 2, 3, 4, 5, 6, 7];
/// The lanes of the planes of z, all over.
static Z: [[i32; 16]; 5] = [[10; 16], [11; 16], [12; 16], [13; 16], [14; 16]];

impl Avx512 {
    /// The kernel of `isa`, if it is this one.
    #[inline]
    pub(super) fn of(isa: Isa) -> Option<Self> {
        (isa.kind() == Kind::Avx512).then_some(Self(&Z))
    }
}

walks!(Avx512, "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2");

impl Kernel for Avx512 {
    type Constants = Constants;

    shared!("avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2");

    #[inline(always)]
    fn constants(self, line: &Line) -> Constants {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { constants(line) }
    }

    #[inline(always)]
    fn children(self, _: &Line, ray: &Constants, tile: &Tile, base: Vec4, size: f32) -> u64 {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { children(self.0, ray, tile, base, size) }
    }

    #[inline(always)]
    fn inside(self, corners: &__m256, c: f32) -> u8 {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { _mm256_cmp_ps_mask::<_CMP_GE_OQ>(*corners, _mm256_set1_ps(c)) }
    }

    #[inline(always)]
    fn span(self, corners: &__m256, piece: &Piece) -> [f64; 8] {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { span(*corners, piece) }
    }

    #[inline(always)]
    fn at_least(self, values: &[f64; 8], c: f64) -> u8 {
        // SAFETY: `self` exists, so the machine has the features; the load is of the array.
        unsafe { _mm512_cmp_pd_mask::<_CMP_GE_OQ>(_mm512_loadu_pd(values.as_ptr()), _mm512_set1_pd(c)) }
    }
}

/// Sixteen words of 32 bits, or as much of others, from anywhere.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
fn load<T: Copy, const N: usize>(x: &[T; N]) -> __m512i {
    const { assert!(size_of::<[T; N]>() == 64) };
    // SAFETY: an unaligned load of the 64 bytes of the array, which hold integers or floats: no padding.
    unsafe { _mm512_loadu_si512(std::ptr::from_ref(x).cast()) }
}

#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
fn constants(line: &Line) -> Constants {
    let per_axis = |v: Vec4| _mm512_permutexvar_ps(load(&AXES), _mm512_castps128_ps512(v.into()));
    let backward = (0..3).filter(|&a| line.negative(a)).fold(0, |m, a| m | 0x1f << (5 * a));
    let number = |x: &[f32; 16]| _mm512_castsi512_ps(load(x));
    Constants {
        o: per_axis(line.o),
        inv: per_axis(line.inv),
        planes: _mm512_mask_blend_ps(backward, number(&FORWARD), number(&BACKWARD)),
        end: _mm512_set1_ps(line.end),
        order: _mm512_xor_si512(load(&COUNT), _mm512_set1_epi8((line.flip & 15) as i8)),
        layers: _mm512_xor_si512(load(&EIGHT), _mm512_set1_epi64(i64::from(line.flip >> 4) << 1)),
        most_lo: _mm512_set1_epi8(line.most_lo.cast_signed()),
        least_hi: _mm512_set1_epi8(line.least_hi.cast_signed()),
    }
}

#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
fn children(lanes: &[[i32; 16]; 5], ray: &Constants, tile: &Tile, base: Vec4, size: f32) -> u64 {
    // Line::time of all planes. `size` is a power of 2 and the numbers are small: planes are exact.
    let corner = _mm512_permutexvar_ps(load(&AXES), _mm512_castps128_ps512(base.into()));
    let planes = _mm512_fmadd_ps(ray.planes, _mm512_set1_ps(size), corner);
    let times = _mm512_mul_ps(_mm512_sub_ps(planes, ray.o), ray.inv);
    let pick = |lanes: &[i32; 16]| _mm512_permutexvar_ps(load(lanes), times);
    // Above 0 is from the smallest positive number on.
    let above = _mm512_castsi512_ps(_mm512_set1_epi32(1));
    let column_in = _mm512_max_ps(_mm512_max_ps(pick(&X_IN), pick(&Y_IN)), above);
    let column_out = _mm512_min_ps(_mm512_min_ps(pick(&X_OUT), pick(&Y_OUT)), ray.end);
    let z = [0, 1, 2, 3, 4].map(|k: usize| pick(&lanes[k]));
    let slab = |k: usize| {
        let (t_in, t_out) = (_mm512_max_ps(column_in, z[k]), _mm512_min_ps(column_out, z[k + 1]));
        u64::from(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(t_in, t_out)) << (16 * k)
    };
    let path = (slab(0) | slab(1)) | (slab(2) | slab(3));

    let in_order = |ranges| _mm512_permutexvar_epi64(ray.layers, _mm512_shuffle_epi8(load(ranges), ray.order));
    let begins = _mm512_cmple_epu8_mask(in_order(&tile.lo), ray.most_lo);
    path & _mm512_mask_cmpge_epu8_mask(begins, in_order(&tile.hi), ray.least_hi)
}

/// The coordinate along x, y and z that each lane takes, of begin (0–3) or end (4–7).
const ENDS: [[i64; 8]; 3] = [[0, 4, 0, 4, 0, 4, 0, 4], [1, 1, 5, 5, 1, 1, 5, 5], [2, 2, 2, 2, 6, 6, 6, 6]];

#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
fn span(corners: __m256, piece: &Piece) -> [f64; 8] {
    let (zero, one) = (_mm256_setzero_pd(), _mm256_set1_pd(1.0));
    // SAFETY: loads of arrays of four f64.
    let (o, d) = unsafe { (_mm256_loadu_pd(piece.o.as_ptr()), _mm256_loadu_pd(piece.d.as_ptr())) };
    let cell = _mm256_cvtps_pd(piece.cell.into());
    let far = _mm256_cvtps_pd(piece.far.into());
    let local = |t: f64, on: u8, face: __m256d| {
        let p = _mm256_sub_pd(_mm256_add_pd(o, _mm256_mul_pd(_mm256_set1_pd(t), d)), cell);
        _mm256_mask_blend_pd(on, _mm256_min_pd(_mm256_max_pd(p, zero), one), face)
    };
    let begin = local(piece.t[0], piece.on[0], _mm256_sub_pd(one, far));
    let end = local(piece.t[1], piece.on[1], far);
    let both = _mm512_insertf64x4::<1>(_mm512_castpd256_pd512(begin), end);
    let lerp = |axis: usize, a: __m512d, b: __m512d| {
        let u = _mm512_permutexvar_pd(load(&ENDS[axis]), both);
        let v = _mm512_sub_pd(_mm512_set1_pd(1.0), u);
        _mm512_add_pd(_mm512_mul_pd(v, a), _mm512_mul_pd(u, b))
    };
    let s = _mm512_cvtps_pd(corners);
    let s = lerp(0, _mm512_permute_pd::<0x00>(s), _mm512_permute_pd::<0xff>(s));
    let s = lerp(1, _mm512_permutex_pd::<0x44>(s), _mm512_permutex_pd::<0xee>(s));
    let s = lerp(2, _mm512_shuffle_f64x2::<0x44>(s, s), _mm512_shuffle_f64x2::<0xee>(s, s));
    let mut values = [0.0; 8];
    // SAFETY: a store into the array.
    unsafe { _mm512_storeu_pd(values.as_mut_ptr(), s) };
    values
}
