/* The rays and hits that are handed to Embree, and the functions for which embree4-sys 0.0.12 is unsafe as declared.
 *
 * embree4-sys carries Embree's 4.2 headers. Since 4.3 a hit ends with instPrimID, so that the library writes 4 bytes
 * (8 or 16 times 4 for a packet) behind the 80-byte RTCRayHit (640-byte RTCRayHit8, 1280-byte RTCRayHit16) of those headers. The structs below
 * have the 4.2 layout plus room for what 4.3 and later write: they are right for every Embree from 4.0 to 4.4.
 * RTCRayQueryContext grew as well: none is ever built, every query passes NULL arguments.
 *
 * build.rs generates Rust from this file; src/embree/abi.rs asserts every size and offset.
 */
#pragma once

#include <stdint.h>

/// A ray: `RTCRay` of Embree 4, 48 bytes.
///
/// Embree reads `org`, `dir`, `tnear`, `tfar` and `mask`, and writes `tfar`: the distance of the nearest hit
/// (`intersect1`), or −∞ when something is in the way (`occluded1`). Distances are in units of `dir`, which need not
/// be normalised.
struct Ray {
  /// Origin.
  float org[3];
  /// Start of the segment, at least 0.
  float tnear;
  /// Direction.
  float dir[3];
  /// Free 32 bits for the caller: Embree's ray time, which nothing reads without motion blur.
  uint32_t time;
  /// End of the segment.
  float tfar;
  /// A geometry is seen if its mask and this one share a bit.
  uint32_t mask;
  /// Free 32 bits for the caller.
  uint32_t id;
  /// Reserved by Embree: 0.
  uint32_t flags;
} __attribute__((aligned(16)));

/// A hit: `RTCHit` of Embree 4.2 (32 bytes) plus 16 spare bytes, of which Embree 4.3 and later write the first four.
struct Hit {
  /// Normal, not normalised.
  float normal[3];
  /// First surface coordinate.
  float u;
  /// Second surface coordinate.
  float v;
  /// The primitive within its geometry.
  uint32_t prim;
  /// The geometry: the number that the scene's builder returned; `INVALID_ID` for a miss.
  uint32_t geometry;
  /// Embree's instance id: always `INVALID_ID`, there are no instances.
  uint32_t instance;
  /// Room for `instPrimID` and padding. No meaning here.
  uint32_t spare[4];
};

/// A ray and its nearest hit: `RTCRayHit` of Embree 4.2 plus 16 spare bytes, 96 bytes in all.
struct RayHit {
  /// The ray. Its `tfar` becomes the distance of the hit.
  struct Ray ray;
  /// The hit. `geometry` stays `INVALID_ID` when there is none.
  struct Hit hit;
} __attribute__((aligned(16)));

/// Eight rays: `RTCRay8` of Embree 4, 384 bytes. Fields as in `Ray16`.
struct Ray8 {
  float org[3][8];
  float tnear[8];
  float dir[3][8];
  uint32_t time[8];
  float tfar[8];
  uint32_t mask[8];
  uint32_t id[8];
  uint32_t flags[8];
} __attribute__((aligned(32)));

/// Eight hits: `RTCHit8` of Embree 4.2 (256 bytes) plus 32 spare bytes. Fields as in `Hit16`.
struct Hit8 {
  float normal[3][8];
  float u[8];
  float v[8];
  uint32_t prim[8];
  uint32_t geometry[8];
  uint32_t instance[8];
  uint32_t spare[8];
};

/// Eight rays and their nearest hits: `RTCRayHit8` of Embree 4.2 plus 32 spare bytes, 672 bytes in all.
struct RayHit8 {
  struct Ray8 ray;
  struct Hit8 hit;
} __attribute__((aligned(32)));

/// Sixteen rays, one field after the other: `RTCRay16` of Embree 4, 768 bytes. Fields as in `Ray`.
struct Ray16 {
  /// Origins: x of all rays, then y, then z.
  float org[3][16];
  /// Starts of the segments.
  float tnear[16];
  /// Directions: x of all rays, then y, then z.
  float dir[3][16];
  /// Free 32 bits per ray.
  uint32_t time[16];
  /// Ends of the segments.
  float tfar[16];
  /// Masks.
  uint32_t mask[16];
  /// Free 32 bits per ray.
  uint32_t id[16];
  /// Reserved by Embree: 0.
  uint32_t flags[16];
} __attribute__((aligned(64)));

/// Sixteen hits: `RTCHit16` of Embree 4.2 (512 bytes) plus 64 spare bytes. Fields as in `Hit`.
struct Hit16 {
  /// Normals: x of all hits, then y, then z.
  float normal[3][16];
  /// First surface coordinates.
  float u[16];
  /// Second surface coordinates.
  float v[16];
  /// Primitives.
  uint32_t prim[16];
  /// Geometries, `INVALID_ID` for a miss.
  uint32_t geometry[16];
  /// Instances, always `INVALID_ID`.
  uint32_t instance[16];
  /// Room for `instPrimID`. No meaning here.
  uint32_t spare[16];
};

/// Sixteen rays and their nearest hits: `RTCRayHit16` of Embree 4.2 plus 64 spare bytes, 1344 bytes in all.
struct RayHit16 {
  /// The rays.
  struct Ray16 ray;
  /// The hits.
  struct Hit16 hit;
} __attribute__((aligned(64)));

/// `RTCError`, `RTCErrorFunction` and their users with the code as a number: embree4-sys declares a Rust enum of the
/// 4.2 codes, and a code that a later library adds would be undefined behaviour before anyone could look at it.
typedef void (*ErrorFunction)(void *user, uint32_t code, const char *message);

struct RTCDeviceTy;
struct RTCSceneTy;
uint32_t rtcGetDeviceError(struct RTCDeviceTy *device);
void rtcSetDeviceErrorFunction(struct RTCDeviceTy *device, ErrorFunction function, void *user);
void rtcIntersect1(struct RTCSceneTy *scene, struct RayHit *rayhit, void *args);
void rtcOccluded1(struct RTCSceneTy *scene, struct Ray *ray, void *args);
void rtcIntersect8(const int *valid, struct RTCSceneTy *scene, struct RayHit8 *rayhit, void *args);
void rtcOccluded8(const int *valid, struct RTCSceneTy *scene, struct Ray8 *ray, void *args);
void rtcIntersect16(const int *valid, struct RTCSceneTy *scene, struct RayHit16 *rayhit, void *args);
void rtcOccluded16(const int *valid, struct RTCSceneTy *scene, struct Ray16 *ray, void *args);
