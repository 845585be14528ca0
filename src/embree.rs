//! Embree 4 behind a safe fence. All `unsafe` of this crate is in the files of this module, but for vectors' intrinsics
//! (`isa`, and the SIMD modules of the pyramid and of sweeps).
//!
//! Three layers: `abi`, the structs that are handed to the library, generated from `wrapper/embree_abi.h`; [`Device`],
//! the library itself and its errors; [`Bvh`], a committed set of triangles and of user geometries that borrows or
//! shares whatever its callbacks read.
//!
//! Wrapped: `rtcNewDevice`, `rtcReleaseDevice`, `rtcGetDeviceProperty`, `rtcGetDeviceError`,
//! `rtcSetDeviceErrorFunction`, `rtcNewScene`, `rtcReleaseScene`, `rtcCommitScene`, `rtcSetSceneFlags`,
//! `rtcSetSceneBuildQuality`, `rtcNewGeometry`, `rtcReleaseGeometry`, `rtcCommitGeometry`, `rtcAttachGeometry`,
//! `rtcSetGeometryMask`, `rtcSetNewGeometryBuffer`, `rtcSetGeometryBuildQuality`, `rtcSetGeometryUserData`,
//! `rtcSetGeometryUserPrimitiveCount`, `rtcSetGeometryBoundsFunction`, `rtcSetGeometryIntersectFunction`,
//! `rtcSetGeometryOccludedFunction`, `rtcIntersect1`, `rtcOccluded1`, `rtcIntersect8`, `rtcOccluded8`,
//! `rtcIntersect16`, `rtcOccluded16`.
//!
//! Never wrapped: `RTCRayQueryContext` and the argument structs that hold one (the size of the context depends on the
//! library's version), and `rtcGetGeometry*` inside callbacks (slow since 4.0).

mod abi;
mod device;
mod user;
mod callbacks;
mod bvh;
mod extrusions;
mod hexahedra;
mod triangles;

pub use abi::{Hit, Hit16, INVALID_ID, Ray, Ray16, RayHit, RayHit16, Valid16};
pub use bvh::{Bvh, BvhBuilder, Quality};
pub use device::Device;
pub(crate) use extrusions::{embree_ray, flattened_ray, padded};
pub use hexahedra::{GraphTracer, pyramids};
pub use triangles::SurfaceTracer;
pub use user::{UserGeometry, UserHit, UserHits16};
