//! The children of a node in sixteen lanes: AVX-512, where the processor has it. The only `unsafe` outside `embree`.

#![allow(unsafe_code, reason = "SIMD intrinsics, behind run-time detection")]

#[cfg(target_arch = "x86_64")]
pub(super) use x86::Avx512;

#[cfg(not(target_arch = "x86_64"))]
pub(super) use other::Avx512;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use crate::field::Field;
    use crate::flattened::{FlattenedHit, FlattenedRay};
    use crate::pyramid::children::{Children, Line};
    use crate::pyramid::{Pyramid, Tile};
    use std::arch::x86_64::*;

    /// Proof that the processor has what `#[target_feature]` asks for below: made by [`Avx512::detect`] only.
    #[derive(Clone, Copy, Debug)]
    pub(in crate::pyramid) struct Avx512(());

    /// What depends on the ray only. Lanes 0–4 belong to the planes of x, 5–9 of y, 10–14 of z.
    pub(in crate::pyramid) struct Ray {
        o: __m512,
        inv: __m512,
        /// Plane numbers within a node in the order in which the ray meets them.
        planes: __m512,
        end: __m512,
        /// Positions in half a tile, in the ray's order.
        order: __m512i,
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
    const COUNT: [u16; 32] = [
        0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29,
        30, 31,
    ];

    impl Avx512 {
        pub(in crate::pyramid) fn detect() -> Option<Self> {
            let all = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2");
            all.then_some(Self(()))
        }

        /// [`Pyramid::walk`] with this kernel, compiled for this processor.
        #[inline]
        pub(in crate::pyramid) fn walk<const ANY: bool>(
            self,
            pyramid: &Pyramid,
            field: &Field,
            ray: &FlattenedRay,
            reach: f64,
        ) -> Option<FlattenedHit> {
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
            fn inner<const ANY: bool>(
                kernel: Avx512,
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
    }

    impl Avx512 {
        /// [`Pyramid::walk16`] with this kernel, compiled for this processor.
        #[inline]
        pub(in crate::pyramid) fn walk16<const ANY: bool>(
            self,
            pyramid: &Pyramid,
            field: &Field,
            active: u16,
            ray: impl Fn(usize) -> FlattenedRay,
            hits: &mut [Option<FlattenedHit>; 16],
        ) {
            #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
            fn inner<const ANY: bool>(
                kernel: Avx512,
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

    impl Children for Avx512 {
        type Ray = Ray;

        #[inline(always)]
        fn ray(self, line: &Line) -> Ray {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { ray(line) }
        }

        #[inline(always)]
        fn children(self, line: &Line, ray: &Ray, tile: &Tile, base: [i32; 4], size: f32) -> u64 {
            // SAFETY: `self` exists, so `detect` found the features.
            unsafe { children(line.flip, ray, tile, base, size) }
        }

        #[inline(always)]
        fn prefetch<T>(self, x: &T) {
            for line in 0..size_of::<T>().div_ceil(64) {
                // SAFETY: a hint, which reads nothing, for an address within `x`.
                unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(x).cast::<i8>().add(64 * line)) }
            }
        }
    }

    /// Sixteen words of 32 bits, or 32 of 16, from anywhere.
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
        let [ox, oy, oz] = line.o;
        let [ix, iy, iz] = line.inv;
        let per_axis = |v: __m128| _mm512_permutexvar_ps(load(&AXES), _mm512_castps128_ps512(v));
        let backward = (0..3).filter(|&a| line.negative(a)).fold(0, |m, a| m | 0x1f << (5 * a));
        let number = |x: &[f32; 16]| _mm512_castsi512_ps(load(x));
        Ray {
            o: per_axis(_mm_setr_ps(ox, oy, oz, 0.0)),
            inv: per_axis(_mm_setr_ps(ix, iy, iz, 0.0)),
            planes: _mm512_mask_blend_ps(backward, number(&FORWARD), number(&BACKWARD)),
            end: _mm512_set1_ps(line.end),
            order: _mm512_xor_si512(load(&COUNT), _mm512_set1_epi16((line.flip & 31) as i16)),
            most_lo: _mm512_set1_epi16(line.most_lo.cast_signed()),
            least_hi: _mm512_set1_epi16(line.least_hi.cast_signed()),
        }
    }

    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,bmi1,bmi2")]
    fn children(flip: u32, ray: &Ray, tile: &Tile, base: [i32; 4], size: f32) -> u64 {
        // Line::time of all planes. `size` is a power of 2 and the numbers are small: planes are exact.
        let corner = _mm512_castps128_ps512(_mm_cvtepi32_ps(_mm_setr_epi32(base[0], base[1], base[2], base[3])));
        let corner = _mm512_permutexvar_ps(load(&AXES), corner);
        let planes = _mm512_add_ps(corner, _mm512_mul_ps(ray.planes, _mm512_set1_ps(size)));
        let times = _mm512_mul_ps(_mm512_sub_ps(planes, ray.o), ray.inv);
        let pick = |lanes: &[i32; 16]| _mm512_permutexvar_ps(load(lanes), times);
        // Above 0 is from the smallest positive number on.
        let above = _mm512_castsi512_ps(_mm512_set1_epi32(1));
        let column_in = _mm512_max_ps(_mm512_max_ps(pick(&X_IN), pick(&Y_IN)), above);
        let column_out = _mm512_min_ps(_mm512_min_ps(pick(&X_OUT), pick(&Y_OUT)), ray.end);
        let z = [10, 11, 12, 13, 14].map(|lane| _mm512_permutexvar_ps(_mm512_set1_epi32(lane), times));
        let slab = |k: usize| {
            let (t_in, t_out) = (_mm512_max_ps(column_in, z[k]), _mm512_min_ps(column_out, z[k + 1]));
            u64::from(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(t_in, t_out)) << (16 * k)
        };
        let path = (slab(0) | slab(1)) | (slab(2) | slab(3));

        // Bit 5 of `flip` swaps the halves of the tile, the lower bits act within both.
        let half = |ranges: &[u16; 64], second: bool| {
            let (halves, rest) = ranges.as_chunks::<32>();
            debug_assert!(rest.is_empty());
            _mm512_permutexvar_epi16(ray.order, load(&halves[(flip >> 5 & 1) as usize ^ usize::from(second)]))
        };
        let holds = |second: bool| {
            let begins = _mm512_cmple_epu16_mask(half(&tile.lo, second), ray.most_lo);
            u64::from(_mm512_mask_cmpge_epu16_mask(begins, half(&tile.hi, second), ray.least_hi))
        };
        path & (holds(false) | holds(true) << 32)
    }
}

#[cfg(not(target_arch = "x86_64"))]
mod other {
    use crate::field::Field;
    use crate::flattened::{FlattenedHit, FlattenedRay};
    use crate::pyramid::Pyramid;

    /// Not on this processor.
    #[derive(Clone, Copy, Debug)]
    pub(in crate::pyramid) enum Avx512 {}

    impl Avx512 {
        pub(in crate::pyramid) fn detect() -> Option<Self> {
            None
        }

        pub(in crate::pyramid) fn walk<const ANY: bool>(
            self,
            _: &Pyramid,
            _: &Field,
            _: &FlattenedRay,
            _: f64,
        ) -> Option<FlattenedHit> {
            match self {}
        }

        pub(in crate::pyramid) fn walk16<const ANY: bool>(
            self,
            _: &Pyramid,
            _: &Field,
            _: u16,
            _: impl Fn(usize) -> FlattenedRay,
            _: &mut [Option<FlattenedHit>; 16],
        ) {
            match self {}
        }
    }
}
