//! The children of a node in sixteen lanes of AVX-512 or eight of AVX2, whichever the processor has. The only `unsafe`
//! outside `embree`, but for the kernels of sweeps.

#![allow(unsafe_code, reason = "SIMD intrinsics, behind run-time detection")]

use super::Pyramid;
use super::kernel::Scalar;
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
#[cfg(test)]
use {super::Tile, super::kernel::Kernel, super::kernel::Line, glam::Vec4};

/// An instruction set that this machine was found to have.
#[derive(Clone, Copy, Debug)]
pub(super) struct Isa(Kind);

#[derive(Clone, Copy, Debug)]
enum Kind {
    Plain,
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Avx2),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Avx512),
}

impl Isa {
    /// Plain code.
    pub(super) const PLAIN: Self = Self(Kind::Plain);

    /// All that this machine has, from plain code to the widest.
    pub(super) fn found() -> Vec<Self> {
        #[allow(unused_mut, reason = "there may be no other")]
        let mut found = vec![Self::PLAIN];
        #[cfg(target_arch = "x86_64")]
        {
            found.extend(avx2::Avx2::detect().map(|kernel| Self(Kind::Avx2(kernel))));
            found.extend(avx512::Avx512::detect().map(|kernel| Self(Kind::Avx512(kernel))));
        }
        found
    }

    /// The widest.
    pub(super) fn detect() -> Self {
        Self::found().pop().unwrap_or(Self::PLAIN)
    }

    /// [`Pyramid::walk`] compiled for it.
    #[inline]
    pub(super) fn walk<const ANY: bool>(
        self,
        pyramid: &Pyramid,
        field: &Field,
        ray: &FlattenedRay,
        reach: f64,
    ) -> Option<FlattenedHit> {
        match self.0 {
            Kind::Plain => pyramid.walk::<ANY, _>(Scalar, field, ray, reach),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2(kernel) => kernel.walk::<ANY>(pyramid, field, ray, reach),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512(kernel) => kernel.walk::<ANY>(pyramid, field, ray, reach),
        }
    }

    /// [`Pyramid::walk16`] compiled for it.
    #[inline]
    pub(super) fn walk16<const ANY: bool>(
        self,
        pyramid: &Pyramid,
        field: &Field,
        active: u16,
        ray: impl Fn(usize) -> FlattenedRay,
        hits: &mut [Option<FlattenedHit>; 16],
    ) {
        match self.0 {
            Kind::Plain => pyramid.walk16::<ANY, _>(Scalar, field, active, ray, hits),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2(kernel) => kernel.walk16::<ANY>(pyramid, field, active, ray, hits),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512(kernel) => kernel.walk16::<ANY>(pyramid, field, active, ray, hits),
        }
    }

    /// [`Kernel::children`].
    #[cfg(test)]
    pub(super) fn children(self, line: &Line, tile: &Tile, base: Vec4, size: f32) -> u64 {
        match self.0 {
            Kind::Plain => Scalar.children(line, &(), tile, base, size),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2(kernel) => kernel.children(line, &kernel.ray(line), tile, base, size),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512(kernel) => kernel.children(line, &kernel.ray(line), tile, base, size),
        }
    }
}

/// Defines the walks of a kernel, compiled for its instruction set.
#[cfg(target_arch = "x86_64")]
macro_rules! walks {
    ($kernel:ident, $features:literal) => {
        impl $kernel {
            /// [`Pyramid::walk`] with this kernel.
            #[inline]
            pub(super) fn walk<const ANY: bool>(
                self,
                pyramid: &Pyramid,
                field: &Field,
                ray: &FlattenedRay,
                reach: f64,
            ) -> Option<FlattenedHit> {
                #[target_feature(enable = $features)]
                fn inner<const ANY: bool>(
                    kernel: $kernel,
                    pyramid: &Pyramid,
                    field: &Field,
                    ray: &FlattenedRay,
                    reach: f64,
                ) -> Option<FlattenedHit> {
                    pyramid.walk::<ANY, _>(kernel, field, ray, reach)
                }
                // SAFETY: `self` exists, so `detect` found the features.
                unsafe { inner::<ANY>(self, pyramid, field, ray, reach) }
            }

            /// [`Pyramid::walk16`] with this kernel.
            #[inline]
            pub(super) fn walk16<const ANY: bool>(
                self,
                pyramid: &Pyramid,
                field: &Field,
                active: u16,
                ray: impl Fn(usize) -> FlattenedRay,
                hits: &mut [Option<FlattenedHit>; 16],
            ) {
                #[target_feature(enable = $features)]
                fn inner<const ANY: bool>(
                    kernel: $kernel,
                    pyramid: &Pyramid,
                    field: &Field,
                    active: u16,
                    ray: impl Fn(usize) -> FlattenedRay,
                    hits: &mut [Option<FlattenedHit>; 16],
                ) {
                    pyramid.walk16::<ANY, _>(kernel, field, active, ray, hits);
                }
                // SAFETY: `self` exists, so `detect` found the features.
                unsafe { inner::<ANY>(self, pyramid, field, active, ray, hits) }
            }
        }
    };
}

/// AVX2: eight children at a time, as halves of two layers of the same y.
#[cfg(target_arch = "x86_64")]
mod avx2 {
    use crate::field::Field;
    use crate::flattened::{FlattenedHit, FlattenedRay};
    use crate::pyramid::kernel::{Kernel, Line, Piece};
    use crate::pyramid::{Pyramid, Tile};
    use glam::Vec4;
    use std::arch::x86_64::*;

    /// Proof that the processor has what `#[target_feature]` asks for below: made by [`Avx2::detect`] only.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx2(());

    /// What depends on the ray only.
    pub(in crate::pyramid) struct Ray {
        /// Plane numbers within a node before and behind its children along x and y, in the ray's order, twice.
        before: [__m256; 2],
        behind: [__m256; 2],
        /// Those before and behind layers 0, 2 (first half) and 1, 3 along z.
        layers: __m256,
        /// Positions within 16 children of the same z, in the ray's order, and of the words of two layers.
        order: __m256i,
        halves: __m256i,
        /// Where among a node's 64 the first half of the ray's children stands.
        first: usize,
        most_lo: __m256i,
        least_hi: __m256i,
    }

    /// By the direction: along the axis, against it.
    const BEFORE: [[f32; 8]; 2] = [[0., 1., 2., 3., 0., 1., 2., 3.], [4., 3., 2., 1., 4., 3., 2., 1.]];
    const BEHIND: [[f32; 8]; 2] = [[1., 2., 3., 4., 1., 2., 3., 4.], [3., 2., 1., 0., 3., 2., 1., 0.]];
    const LAYERS: [[f32; 8]; 2] = [[0., 2., 1., 3., 1., 3., 2., 4.], [4., 2., 3., 1., 3., 1., 2., 0.]];
    const HALVES: [[i32; 8]; 2] = [[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 0, 1, 2, 3]];
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
        pub(super) fn detect() -> Option<Self> {
            let all = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            all.then_some(Self(()))
        }
    }

    walks!(Avx2, "avx2,fma,bmi1,bmi2");

    impl Kernel for Avx2 {
        type Ray = Ray;
        type Corners = __m256;

        #[inline(always)]
        fn ray(self, line: &Line) -> Ray {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { ray(line) }
        }

        #[inline(always)]
        fn children(self, line: &Line, ray: &Ray, tile: &Tile, base: Vec4, size: f32) -> u64 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { children(line, ray, tile, base, size) }
        }

        #[inline(always)]
        fn corners(self, samples: &[f32], at: usize, [y, z]: [usize; 2]) -> __m256 {
            let s = &samples[at..at + z + y + 2];
            // SAFETY: `self` exists, so `detect` found the features; pairs of samples lie within `s`, and any bits are an f64.
            unsafe {
                let pair = |at: usize| s.as_ptr().add(at).cast::<f64>().read_unaligned();
                _mm256_castpd_ps(_mm256_setr_pd(pair(0), pair(y), pair(z), pair(z + y)))
            }
        }

        #[inline(always)]
        fn inside(self, corners: &__m256, c: f32) -> u8 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { mask(_mm256_cmp_ps::<_CMP_GE_OQ>(*corners, _mm256_set1_ps(c))) }
        }

        #[inline(always)]
        fn span(self, corners: &__m256, piece: &Piece) -> [f64; 8] {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { span(*corners, piece) }
        }

        #[inline(always)]
        fn at_least(self, values: &[f64; 8], c: f64) -> u8 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { at_least(values, c) }
        }

        #[inline(always)]
        fn outlined<T>(self, f: impl FnOnce() -> T) -> T {
            #[inline(never)]
            #[target_feature(enable = "avx2,fma,bmi1,bmi2")]
            fn inner<T>(f: impl FnOnce() -> T) -> T {
                f()
            }
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { inner(f) }
        }

        #[inline(always)]
        fn ask(self, address: *const u8) {
            // SAFETY: a hint, which reads nothing and faults nowhere.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(address.cast()) }
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
    fn ray(line: &Line) -> Ray {
        let back = [0, 1, 2].map(|a| usize::from(line.negative(a)));
        let number = |x: &[[f32; 8]; 2], a: usize| _mm256_castsi256_ps(load(&x[back[a]]));
        Ray {
            before: [number(&BEFORE, 0), number(&BEFORE, 1)],
            behind: [number(&BEHIND, 0), number(&BEHIND, 1)],
            layers: number(&LAYERS, 2),
            order: _mm256_xor_si256(load(&COUNT), _mm256_set1_epi8((line.flip & 15) as i8)),
            halves: load(&HALVES[back[2]]),
            first: 32 * back[2],
            most_lo: _mm256_set1_epi8(line.most_lo.cast_signed()),
            least_hi: _mm256_set1_epi8(line.least_hi.cast_signed()),
        }
    }

    #[inline]
    #[target_feature(enable = "avx2,fma,bmi1,bmi2")]
    fn children(line: &Line, ray: &Ray, tile: &Tile, base: Vec4, size: f32) -> u64 {
        // Line::time of all planes. `size` is a power of 2 and the numbers are small: planes are exact.
        let (size, base) = (_mm256_set1_ps(size), _mm256_set_m128(base.into(), base.into()));
        let corner =
            [_mm256_permute_ps::<0x00>(base), _mm256_permute_ps::<0x55>(base), _mm256_permute_ps::<0xaa>(base)];
        let o = [line.o.x, line.o.y, line.o.z].map(|x| _mm256_set1_ps(x));
        let inv = [line.inv.x, line.inv.y, line.inv.z].map(|x| _mm256_set1_ps(x));
        let times =
            |n: __m256, a: usize| _mm256_mul_ps(_mm256_sub_ps(_mm256_fmadd_ps(n, size, corner[a]), o[a]), inv[a]);
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
            let in_order = _mm256_permutevar8x32_epi32(_mm256_and_si256(begins, ends), ray.halves);
            _mm256_shuffle_epi8(in_order, ray.order)
        };
        let found = |path: __m256i, first: usize| {
            let both = _mm256_movemask_epi8(_mm256_and_si256(path, holds(first)));
            u64::from(both.cast_unsigned())
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
        let s = [_mm256_castps256_ps128(corners), _mm256_extractf128_ps::<1>(corners)].map(|s| _mm256_cvtps_pd(s));
        let s = s.map(|s| lerp(x, _mm256_permute_pd::<0x0>(s), _mm256_permute_pd::<0xf>(s)));
        let s = s.map(|s| lerp(y, _mm256_permute4x64_pd::<0x44>(s), _mm256_permute4x64_pd::<0xee>(s)));
        let mut values = [0.0; 8];
        // SAFETY: stores into the two halves of the array.
        unsafe {
            _mm256_storeu_pd(values.as_mut_ptr(), lerp(z[0], s[0], s[1]));
            _mm256_storeu_pd(values.as_mut_ptr().add(4), lerp(z[1], s[0], s[1]));
        }
        values
    }

    #[inline]
    #[target_feature(enable = "avx2,fma,bmi1,bmi2")]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "eight bits")]
    fn at_least(values: &[f64; 8], c: f64) -> u8 {
        // SAFETY: loads of the two halves of the array.
        let [near, far] = unsafe { [0, 4].map(|at| _mm256_loadu_pd(values.as_ptr().add(at))) };
        let bits = |x| _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_GE_OQ>(x, _mm256_set1_pd(c)));
        (bits(near) | bits(far) << 4) as u8
    }
}

/// AVX-512: sixteen children at a time, a layer.
#[cfg(target_arch = "x86_64")]
mod avx512 {
    use crate::field::Field;
    use crate::flattened::{FlattenedHit, FlattenedRay};
    use crate::pyramid::kernel::{Kernel, Line, Piece};
    use crate::pyramid::{Pyramid, Tile};
    use glam::Vec4;
    use std::arch::x86_64::*;

    /// Proof that the processor has what `#[target_feature]` asks for below: made by [`Avx512::detect`] only. Refers to [`Z`]:
    /// what the compiler knows it turns into two shuffles each.
    #[derive(Clone, Copy, Debug)]
    pub(super) struct Avx512(&'static [[i32; 16]; 5]);

    /// What depends on the ray only. Lanes 0–4 belong to the planes of x, 5–9 of y, 10–14 of z.
    pub(in crate::pyramid) struct Ray {
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
        pub(super) fn detect() -> Option<Self> {
            let all = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            all.then_some(Self(&Z))
        }
    }

    walks!(Avx512, "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2");

    impl Kernel for Avx512 {
        type Ray = Ray;
        type Corners = __m256;

        #[inline(always)]
        fn ray(self, line: &Line) -> Ray {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { ray(line) }
        }

        #[inline(always)]
        fn children(self, _: &Line, ray: &Ray, tile: &Tile, base: Vec4, size: f32) -> u64 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { children(self.0, ray, tile, base, size) }
        }

        #[inline(always)]
        fn corners(self, samples: &[f32], at: usize, [y, z]: [usize; 2]) -> __m256 {
            let s = &samples[at..at + z + y + 2];
            // SAFETY: `self` exists, so `detect` found the features; pairs of samples lie within `s`, and any bits are an f64.
            unsafe {
                let pair = |at: usize| s.as_ptr().add(at).cast::<f64>().read_unaligned();
                _mm256_castpd_ps(_mm256_setr_pd(pair(0), pair(y), pair(z), pair(z + y)))
            }
        }

        #[inline(always)]
        fn inside(self, corners: &__m256, c: f32) -> u8 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { _mm256_cmp_ps_mask::<_CMP_GE_OQ>(*corners, _mm256_set1_ps(c)) }
        }

        #[inline(always)]
        fn span(self, corners: &__m256, piece: &Piece) -> [f64; 8] {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { span(*corners, piece) }
        }

        #[inline(always)]
        fn at_least(self, values: &[f64; 8], c: f64) -> u8 {
            // SAFETY: `self` exists, so `detect` found the features; the load is of the array.
            unsafe { _mm512_cmp_pd_mask::<_CMP_GE_OQ>(_mm512_loadu_pd(values.as_ptr()), _mm512_set1_pd(c)) }
        }

        #[inline(always)]
        fn outlined<T>(self, f: impl FnOnce() -> T) -> T {
            #[inline(never)]
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
            fn inner<T>(f: impl FnOnce() -> T) -> T {
                f()
            }
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { inner(f) }
        }

        #[inline(always)]
        fn ask(self, address: *const u8) {
            // SAFETY: a hint, which reads nothing and faults nowhere.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(address.cast()) }
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
    fn ray(line: &Line) -> Ray {
        let per_axis = |v: Vec4| _mm512_permutexvar_ps(load(&AXES), _mm512_castps128_ps512(v.into()));
        let backward = (0..3).filter(|&a| line.negative(a)).fold(0, |m, a| m | 0x1f << (5 * a));
        let number = |x: &[f32; 16]| _mm512_castsi512_ps(load(x));
        Ray {
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
    fn children(lanes: &[[i32; 16]; 5], ray: &Ray, tile: &Tile, base: Vec4, size: f32) -> u64 {
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
}
