//! AVX2: eight children at a time, as halves of two layers of the same y.

use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
use crate::isa::{Isa, Kind};
use crate::pyramid::kernel::{Kernel, Line, Piece};
use crate::pyramid::{Pyramid, Tile};
use glam::Vec4;
use std::arch::x86_64::*;

/// Proof that the processor has what `#[target_feature]` asks for below: made by [`Avx2::of`] only, of an [`Isa`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2(());

/// What depends on the ray only.
pub(in crate::pyramid) struct Constants {
    /// Plane numbers within a node before and behind its children along x and y, in the ray's order, twice.
    before: [__m256; 2],
    behind: [__m256; 2],
    /// Those before and behind the first two layers along z in memory's order, each in a half, then the last two.
    layers: __m256,
    /// Positions within 16 children of the same z, in the ray's order.
    order: __m256i,
    /// Where among a node's 64 the first half of the ray's children stands.
    first: usize,
    /// By how many bits layers of a half stand out of the ray's order: they are in memory's.
    turn: u32,
    most_lo: __m256i,
    least_hi: __m256i,
}

/// By the direction: along the axis, against it.
const BEFORE: [[f32; 8]; 2] = [[0., 1., 2., 3., 0., 1., 2., 3.], [4., 3., 2., 1., 4., 3., 2., 1.]];
const BEHIND: [[f32; 8]; 2] = [[1., 2., 3., 4., 1., 2., 3., 4.], [3., 2., 1., 0., 3., 2., 1., 0.]];
const LAYERS: [[f32; 8]; 2] = [[0., 2., 1., 3., 1., 3., 2., 4.], [3., 1., 2., 0., 4., 2., 3., 1.]];
const COUNT: [i8; 32] = {
    let mut count = [0; 32];
    let mut n = 0;
    while n < 32 {
        count[n] = n as i8 % 16;
        n += 1;
    }
    count
};

impl Avx2 {
    /// The kernel of `isa`, if it is this one.
    #[inline]
    pub(super) fn of(isa: Isa) -> Option<Self> {
        (isa.kind() == Kind::Avx2).then_some(Self(()))
    }
}

walks!(Avx2, "avx2,fma,bmi1,bmi2");

impl Kernel for Avx2 {
    type Constants = Constants;

    shared!("avx2,fma,bmi1,bmi2");

    #[inline(always)]
    fn constants(self, line: &Line) -> Constants {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { constants(line) }
    }

    #[inline(always)]
    fn children(self, line: &Line, ray: &Constants, tile: &Tile, base: Vec4, size: f32) -> u64 {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { children(line, ray, tile, base, size) }
    }

    #[inline(always)]
    fn inside(self, corners: &__m256, c: f32) -> u8 {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { mask(_mm256_cmp_ps::<_CMP_GE_OQ>(*corners, _mm256_set1_ps(c))) }
    }

    #[inline(always)]
    fn span(self, corners: &__m256, piece: &Piece) -> [f64; 8] {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { span(*corners, piece) }
    }

    #[inline(always)]
    fn at_least(self, values: &[f64; 8], c: f64) -> u8 {
        // SAFETY: `self` exists, so the machine has the features.
        unsafe { at_least(values, c) }
    }
}

/// 32 bytes from anywhere.
#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
fn load<T: Copy, const N: usize>(x: &[T; N]) -> __m256i {
    const { assert!(size_of::<[T; N]>() == 32) };
    // SAFETY: an unaligned load of the 32 bytes of the array, which hold integers or floats: no padding.
    unsafe { _mm256_loadu_si256(std::ptr::from_ref(x).cast()) }
}

/// The signs of eight f32.
#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "eight bits")]
fn mask(x: __m256) -> u8 {
    _mm256_movemask_ps(x) as u8
}

#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
fn constants(line: &Line) -> Constants {
    let back = [0, 1, 2].map(|a| usize::from(line.negative(a)));
    let number = |x: &[[f32; 8]; 2], a: usize| _mm256_castsi256_ps(load(&x[back[a]]));
    Constants {
        before: [number(&BEFORE, 0), number(&BEFORE, 1)],
        behind: [number(&BEHIND, 0), number(&BEHIND, 1)],
        layers: number(&LAYERS, 2),
        order: _mm256_xor_si256(load(&COUNT), _mm256_set1_epi8((line.flip & 15) as i8)),
        first: 32 * back[2],
        turn: 16 * u32::from(line.negative(2)),
        most_lo: _mm256_set1_epi8(line.most_lo.cast_signed()),
        least_hi: _mm256_set1_epi8(line.least_hi.cast_signed()),
    }
}

#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
fn children(line: &Line, ray: &Constants, tile: &Tile, base: Vec4, size: f32) -> u64 {
    // Line::time of all planes. `size` is a power of 2 and the numbers are small: planes are exact.
    let (size, base) = (_mm256_set1_ps(size), _mm256_set_m128(base.into(), base.into()));
    let corner = [_mm256_permute_ps::<0x00>(base), _mm256_permute_ps::<0x55>(base), _mm256_permute_ps::<0xaa>(base)];
    let o = [_mm256_set1_ps(line.o.x), _mm256_set1_ps(line.o.y), _mm256_set1_ps(line.o.z)];
    let inv = [_mm256_set1_ps(line.inv.x), _mm256_set1_ps(line.inv.y), _mm256_set1_ps(line.inv.z)];
    let times = |n: __m256, a: usize| _mm256_mul_ps(_mm256_sub_ps(_mm256_fmadd_ps(n, size, corner[a]), o[a]), inv[a]);
    // Above 0 is from the smallest positive number on.
    let above = _mm256_castsi256_ps(_mm256_set1_epi32(1));
    let x_in = _mm256_max_ps(times(ray.before[0], 0), above);
    let x_out = _mm256_min_ps(times(ray.behind[0], 0), _mm256_set1_ps(line.end));
    let (y_in, y_out) = (times(ray.before[1], 1), times(ray.behind[1], 1));
    let z = times(ray.layers, 2);
    let y_in = [
        _mm256_permute_ps::<0x00>(y_in),
        _mm256_permute_ps::<0x55>(y_in),
        _mm256_permute_ps::<0xaa>(y_in),
        _mm256_permute_ps::<0xff>(y_in),
    ];
    let y_out = [y_in[1], y_in[2], y_in[3], _mm256_permute_ps::<0xff>(y_out)];
    // Two layers along z, 32 children: all ones where the path meets a child.
    let path = |z_in: __m256, z_out: __m256| {
        let (t_in, t_out) = (_mm256_max_ps(x_in, z_in), _mm256_min_ps(x_out, z_out));
        let row = |y: usize| {
            let (t_in, t_out) = (_mm256_max_ps(t_in, y_in[y]), _mm256_min_ps(t_out, y_out[y]));
            _mm256_castps_si256(_mm256_cmp_ps::<_CMP_LE_OQ>(t_in, t_out))
        };
        _mm256_packs_epi16(_mm256_packs_epi32(row(0), row(1)), _mm256_packs_epi32(row(2), row(3)))
    };
    let near = path(_mm256_permute_ps::<0x00>(z), _mm256_permute_ps::<0xaa>(z));
    let far = path(_mm256_permute_ps::<0x55>(z), _mm256_permute_ps::<0xff>(z));

    let holds = |first: usize| {
        // SAFETY: `first` is 0 or 32, as `ray` set it, and ranges are 64 bytes each.
        let (lo, hi) = unsafe {
            let half = |x: &[u8; 64]| _mm256_loadu_si256(x.as_ptr().add(first).cast());
            (half(&tile.lo), half(&tile.hi))
        };
        let begins = _mm256_cmpeq_epi8(_mm256_min_epu8(lo, ray.most_lo), lo);
        let ends = _mm256_cmpeq_epi8(_mm256_max_epu8(hi, ray.least_hi), hi);
        _mm256_shuffle_epi8(_mm256_and_si256(begins, ends), ray.order)
    };
    let found = |path: __m256i, first: usize| {
        let both = _mm256_movemask_epi8(_mm256_and_si256(path, holds(first)));
        u64::from(both.cast_unsigned().rotate_left(ray.turn))
    };
    found(near, ray.first) | found(far, ray.first ^ 32) << 32
}

/// Which of [`Piece::on`] are set, as all ones.
#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
fn on(axes: u8) -> __m256d {
    let bits = _mm256_setr_epi64x(1, 2, 4, 8);
    let set = _mm256_and_si256(_mm256_set1_epi64x(i64::from(axes)), bits);
    _mm256_castsi256_pd(_mm256_cmpeq_epi64(set, bits))
}

#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
fn span(corners: __m256, piece: &Piece) -> [f64; 8] {
    let (zero, one) = (_mm256_setzero_pd(), _mm256_set1_pd(1.0));
    // SAFETY: loads of arrays of four f64.
    let (o, d) = unsafe { (_mm256_loadu_pd(piece.o.as_ptr()), _mm256_loadu_pd(piece.d.as_ptr())) };
    let cell = _mm256_cvtps_pd(piece.cell.into());
    let far = _mm256_cvtps_pd(piece.far.into());
    let local = |t: f64, axes: u8, face: __m256d| {
        let p = _mm256_sub_pd(_mm256_add_pd(o, _mm256_mul_pd(_mm256_set1_pd(t), d)), cell);
        _mm256_blendv_pd(_mm256_min_pd(_mm256_max_pd(p, zero), one), face, on(axes))
    };
    let begin = local(piece.t[0], piece.on[0], _mm256_sub_pd(one, far));
    let end = local(piece.t[1], piece.on[1], far);
    let lerp = |u: __m256d, a: __m256d, b: __m256d| {
        _mm256_add_pd(_mm256_mul_pd(_mm256_sub_pd(one, u), a), _mm256_mul_pd(u, b))
    };
    // (x, x′, z, z′) and (y, y′, …) of begin and end.
    let (xz, y) = (_mm256_unpacklo_pd(begin, end), _mm256_unpackhi_pd(begin, end));
    let x = _mm256_permute4x64_pd::<0x44>(xz);
    let y = _mm256_permute4x64_pd::<0x50>(y);
    let z = [_mm256_permute4x64_pd::<0xaa>(xz), _mm256_permute4x64_pd::<0xff>(xz)];
    // Axis by axis the corners of the cell give way to those of the box, near and far along z.
    let (near, far) = (_mm256_castps256_ps128(corners), _mm256_extractf128_ps::<1>(corners));
    let (near, far) = (_mm256_cvtps_pd(near), _mm256_cvtps_pd(far));
    let along_x = |s: __m256d| lerp(x, _mm256_permute_pd::<0x0>(s), _mm256_permute_pd::<0xf>(s));
    let (near, far) = (along_x(near), along_x(far));
    let along_y = |s: __m256d| lerp(y, _mm256_permute4x64_pd::<0x44>(s), _mm256_permute4x64_pd::<0xee>(s));
    let (near, far) = (along_y(near), along_y(far));
    let mut values = [0.0; 8];
    // SAFETY: stores into the two halves of the array.
    unsafe {
        _mm256_storeu_pd(values.as_mut_ptr(), lerp(z[0], near, far));
        _mm256_storeu_pd(values.as_mut_ptr().add(4), lerp(z[1], near, far));
    }
    values
}

#[inline]
#[target_feature(enable = "avx2,fma,bmi1,bmi2")]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "eight bits")]
fn at_least(values: &[f64; 8], c: f64) -> u8 {
    // SAFETY: loads of the two halves of the array.
    let (near, far) = unsafe { (_mm256_loadu_pd(values.as_ptr()), _mm256_loadu_pd(values.as_ptr().add(4))) };
    let bits = |x| _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_GE_OQ>(x, _mm256_set1_pd(c)));
    (bits(near) | bits(far) << 4) as u8
}
