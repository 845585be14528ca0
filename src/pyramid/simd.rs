//! The children of a node in sixteen lanes of AVX-512 or eight of AVX2, whichever the processor has.

#![allow(unsafe_code, reason = "SIMD intrinsics, behind run-time detection")]

use super::Pyramid;
use super::kernel::Scalar;
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
use crate::isa::Isa;
#[cfg(test)]
use {super::Tile, super::kernel::Kernel, super::kernel::Line, glam::Vec4};

impl Isa {
    /// [`Pyramid::walk`] compiled for it.
    #[inline]
    pub(super) fn walk<const ANY: bool>(
        self,
        pyramid: &Pyramid,
        field: &Field,
        ray: &FlattenedRay,
        reach: f64,
    ) -> Option<FlattenedHit> {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = avx512::Avx512::of(self) {
            return kernel.walk::<ANY>(pyramid, field, ray, reach);
        } else if let Some(kernel) = avx2::Avx2::of(self) {
            return kernel.walk::<ANY>(pyramid, field, ray, reach);
        }
        pyramid.walk::<ANY, _>(Scalar, field, ray, reach)
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
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = avx512::Avx512::of(self) {
            return kernel.walk16::<ANY>(pyramid, field, active, ray, hits);
        } else if let Some(kernel) = avx2::Avx2::of(self) {
            return kernel.walk16::<ANY>(pyramid, field, active, ray, hits);
        }
        pyramid.walk16::<ANY, _>(Scalar, field, active, ray, hits);
    }

    /// [`Kernel::children`].
    #[cfg(test)]
    pub(super) fn children(self, line: &Line, tile: &Tile, base: Vec4, size: f32) -> u64 {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = avx512::Avx512::of(self) {
            return kernel.children(line, &kernel.constants(line), tile, base, size);
        } else if let Some(kernel) = avx2::Avx2::of(self) {
            return kernel.children(line, &kernel.constants(line), tile, base, size);
        }
        Scalar.children(line, &(), tile, base, size)
    }

    /// [`Kernel::clear`].
    #[cfg(test)]
    pub(super) fn clear(self, corners: &[f32; 8], c: f32, [begin, end]: [Vec4; 2], slack: f32) -> bool {
        #[cfg(target_arch = "x86_64")]
        if let Some(kernel) = avx512::Avx512::of(self) {
            return kernel.clear(&kernel.corners(corners, 0, [2, 4]), c, begin, end, slack);
        } else if let Some(kernel) = avx2::Avx2::of(self) {
            return kernel.clear(&kernel.corners(corners, 0, [2, 4]), c, begin, end, slack);
        }
        Scalar.clear(corners, c, begin, end, slack)
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
                // SAFETY: `self` exists, so the machine has the features.
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
                // SAFETY: `self` exists, so the machine has the features.
                unsafe { inner::<ANY>(self, pyramid, field, active, ray, hits) }
            }
        }
    };
}

/// Defines what all kernels of [`Kernel`] here have in common; all have AVX2.
///
/// [`Kernel`]: super::kernel::Kernel
#[cfg(target_arch = "x86_64")]
macro_rules! shared {
    ($features:literal) => {
        type Corners = __m256;

        #[inline(always)]
        fn corners(self, samples: &[f32], at: usize, [y, z]: [usize; 2]) -> __m256 {
            let s = &samples[at..at + z + y + 2];
            // SAFETY: `self` exists, so the machine has the features; pairs of samples lie within `s`, and any bits are
            // an f64.
            unsafe {
                let pair = |at: usize| s.as_ptr().add(at).cast::<f64>().read_unaligned();
                _mm256_castpd_ps(_mm256_setr_pd(pair(0), pair(y), pair(z), pair(z + y)))
            }
        }

        #[inline(always)]
        fn clear(self, corners: &__m256, c: f32, begin: Vec4, end: Vec4, slack: f32) -> bool {
            #[inline]
            #[target_feature(enable = $features)]
            fn inner(corners: __m256, c: f32, begin: Vec4, end: Vec4, slack: f32) -> bool {
                let h = _mm256_sub_ps(corners, _mm256_set1_ps(c));
                // max |h − c|, all over.
                let most = _mm256_andnot_ps(_mm256_set1_ps(-0.0), h);
                let most = _mm256_max_ps(most, _mm256_permute2f128_ps::<1>(most, most));
                let most = _mm256_max_ps(most, _mm256_permute_ps::<0x4e>(most));
                let most = _mm256_max_ps(most, _mm256_permute_ps::<0xb1>(most));
                // `c` itself is rounded by less than a millionth.
                let margin = _mm256_fmadd_ps(most, _mm256_set1_ps(slack), _mm256_set1_ps(c.abs() * 1e-6));
                // (x, x′, x, x′), (y, y, y′, y′), and z, z′ in the halves.
                let (begin, end) = (__m128::from(begin), __m128::from(end));
                let xy = _mm_unpacklo_ps(begin, end);
                let x = _mm256_set_m128(_mm_movelh_ps(xy, xy), _mm_movelh_ps(xy, xy));
                let y = _mm_permute_ps::<0xfa>(xy);
                let y = _mm256_set_m128(y, y);
                let z = _mm256_permute_ps::<0xaa>(_mm256_set_m128(end, begin));
                let lerp = |u: __m256, a: __m256, b: __m256| _mm256_fmadd_ps(u, _mm256_sub_ps(b, a), a);
                let h = lerp(x, _mm256_moveldup_ps(h), _mm256_movehdup_ps(h));
                let h = lerp(y, _mm256_permute_ps::<0x44>(h), _mm256_permute_ps::<0xee>(h));
                let h = lerp(z, _mm256_permute2f128_ps::<0x00>(h, h), _mm256_permute2f128_ps::<0x11>(h, h));
                // Between the greatest below and the least above are those that are near; NaN is.
                let above = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(h, margin));
                let below =
                    _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(h, _mm256_xor_ps(margin, _mm256_set1_ps(-0.0))));
                (above == 0xff) | (below == 0xff)
            }
            // SAFETY: `self` exists, so the machine has the features.
            unsafe { inner(*corners, c, begin, end, slack) }
        }

        #[inline(always)]
        fn outlined<T>(self, f: impl FnOnce() -> T) -> T {
            #[inline(never)]
            #[target_feature(enable = $features)]
            fn inner<T>(f: impl FnOnce() -> T) -> T {
                f()
            }
            // SAFETY: `self` exists, so the machine has the features.
            unsafe { inner(f) }
        }

        #[inline(always)]
        fn ask(self, address: *const u8) {
            // SAFETY: a hint, which reads nothing and faults nowhere.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(address.cast()) }
        }
    };
}

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
