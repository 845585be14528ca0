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

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
