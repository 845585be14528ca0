//! The children of a node in sixteen lanes of AVX-512 or eight of AVX2, whichever the processor has. The only `unsafe`
//! outside `embree`, but for the kernels of sweeps.

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
            return kernel.children(line, &kernel.ray(line), tile, base, size);
        } else if let Some(kernel) = avx2::Avx2::of(self) {
            return kernel.children(line, &kernel.ray(line), tile, base, size);
        }
        Scalar.children(line, &(), tile, base, size)
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

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
