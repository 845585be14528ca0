//! Scenes: triangles and user geometry under one bounding volume hierarchy.

use super::abi::{Ray, Ray8, Ray16, RayHit, RayHit8, RayHit16, Valid16, raw};
use super::callbacks;
use super::device::Device;
use super::user::UserGeometry;
use crate::error::{Error, Result};
use std::ffi::c_void;
use std::fmt;
use std::marker::PhantomData;
use std::sync::Arc;

/// Coordinates beyond this make Embree drop a primitive without a word (its `FLT_LARGE`).
const LARGE: f32 = 1.844e18;

/// How much work goes into the hierarchy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Quality {
    /// Fast build.
    Low,
    /// Binned surface-area heuristic.
    #[default]
    Medium,
    /// With spatial splits for triangles; a few times slower to build.
    High,
}

impl Quality {
    fn raw(self) -> embree4_sys::RTCBuildQuality {
        match self {
            Quality::Low => embree4_sys::RTCBuildQuality::LOW,
            Quality::Medium => embree4_sys::RTCBuildQuality::MEDIUM,
            Quality::High => embree4_sys::RTCBuildQuality::HIGH,
        }
    }
}

/// Collects geometries; [`BvhBuilder::commit`] makes a [`Bvh`] of them.
///
/// ```
/// use isolume::embree::{Device, Ray, RayHit, BvhBuilder};
/// let device = Device::new(1)?;
/// let mut builder = BvhBuilder::new(&device)?;
/// let floor = builder.triangles(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], &[[0, 1, 2]], u32::MAX)?;
/// let bvh = builder.commit()?;
/// let mut rayhit = RayHit::new(Ray::new([0.25, 0.25, 2.0], [0.0, 0.0, -1.0], 0.0, f32::INFINITY));
/// bvh.intersect1(&mut rayhit);
/// assert!(rayhit.hit.geometry == floor && (rayhit.ray.tfar - 2.0).abs() < 1e-6);
/// # Ok::<(), isolume::error::Error>(())
/// ```
#[derive(Debug)]
pub struct BvhBuilder<'a> {
    bvh: Bvh<'a>,
    quality: Quality,
    robust: bool,
}

/// A committed bounding volume hierarchy, which Embree calls a scene. Any number of threads may query it at once.
///
/// It borrows (`'a`) or shares what its user geometries read, and keeps its [`Device`] alive.
pub struct Bvh<'a> {
    handle: embree4_sys::RTCScene,
    device: Device,
    /// Whether packets go to Embree in halves: it takes sixteen rays apart, one by one, where its own vectors are eight
    /// wide.
    halves: bool,
    /// What the callbacks of shared user geometries read: never touched, only kept.
    _shared: Vec<Arc<dyn UserGeometry + Send + 'a>>,
    /// The same for borrowed ones.
    _borrowed: PhantomData<&'a dyn UserGeometry>,
}

impl fmt::Debug for Bvh<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Bvh").field("handle", &self.handle).field("device", &self.device).finish_non_exhaustive()
    }
}

// SAFETY: the handle belongs to no thread. What its callbacks read is either borrowed, `&'a G` with `G: Sync`, or
// shared, `Arc<G>` with `G: Send + Sync`: both may move to another thread.
unsafe impl Send for Bvh<'_> {}
// SAFETY: `&Bvh` allows queries only, which Embree documents as safe to run concurrently on a committed scene; the
// callbacks that they run take `&G` with `G: Sync`. (`BvhBuilder`, which can change a scene, needs `&mut`.)
unsafe impl Sync for Bvh<'_> {}

impl Drop for Bvh<'_> {
    fn drop(&mut self) {
        // SAFETY: the handle came from rtcNewScene and is released once, here, before `_shared` and `device` go, and
        // within `'a`: no callback can run afterwards.
        unsafe { embree4_sys::rtcReleaseScene(self.handle) };
    }
}

/// One reference to a geometry; a scene that it was attached to holds another.
struct Geometry(embree4_sys::RTCGeometry);

impl Geometry {
    fn new(device: &Device, kind: embree4_sys::RTCGeometryType) -> Result<Self> {
        // SAFETY: the device is live.
        let handle = unsafe { embree4_sys::rtcNewGeometry(device.handle(), kind) };
        let geometry = (!handle.is_null()).then_some(Self(handle));
        device.check()?;
        geometry.ok_or_else(|| Error::Embree("no geometry could be made".into()))
    }
}

impl Drop for Geometry {
    fn drop(&mut self) {
        // SAFETY: the handle came from rtcNewGeometry and this reference is released once, here.
        unsafe { embree4_sys::rtcReleaseGeometry(self.0) };
    }
}

impl<'a> BvhBuilder<'a> {
    /// An empty scene: ROBUST, of medium quality.
    ///
    /// # Errors
    /// `Embree` if the library has no memory.
    pub fn new(device: &Device) -> Result<Self> {
        // SAFETY: the device is live.
        let handle = unsafe { embree4_sys::rtcNewScene(device.handle()) };
        if handle.is_null() {
            device.check()?;
            return Err(Error::Embree("no scene could be made".into()));
        }
        let halves = device.packet_width() == 8;
        let bvh = Bvh { handle, device: device.clone(), halves, _shared: Vec::new(), _borrowed: PhantomData };
        device.check()?;
        Ok(Self { bvh, quality: Quality::default(), robust: true })
    }

    /// Sets the build quality of the scene and of the geometries added from here on.
    #[must_use]
    pub fn quality(mut self, quality: Quality) -> Self {
        self.quality = quality;
        self
    }

    /// Sets whether triangles are watertight at their edges (Embree's ROBUST flag). It has no effect on user geometry.
    #[must_use]
    pub fn robust(mut self, robust: bool) -> Self {
        self.robust = robust;
        self
    }

    /// Adds triangles, copied. Rays see them if `mask` and theirs share a bit. Returns the geometry's number.
    ///
    /// No triangles at all is fine: the geometry is then never hit.
    ///
    /// # Errors
    /// `Invalid` if an index names no vertex, or a coordinate is NaN, infinite or beyond 1.844e18 (Embree would drop
    /// such triangles silently), or there are more than 2³² − 1 vertices or triangles; `Embree` if the library refuses.
    pub fn triangles(&mut self, vertices: &[[f32; 3]], indices: &[[u32; 3]], mask: u32) -> Result<u32> {
        if u32::try_from(vertices.len()).is_err() || u32::try_from(indices.len()).is_err() {
            return Err(Error::Invalid(format!(
                "{} triangles of {} vertices: Embree counts both in 32 bits",
                indices.len(),
                vertices.len()
            )));
        }
        if let Some((i, v)) = vertices.iter().enumerate().find(|(_, v)| !v.iter().all(|x| x.abs() < LARGE)) {
            return Err(Error::Invalid(format!("vertex {i} is {v:?}: coordinates must be finite and below {LARGE:e}")));
        }
        if let Some((i, t)) = indices.iter().enumerate().find(|(_, t)| t.iter().any(|&v| v as usize >= vertices.len()))
        {
            let n = vertices.len();
            return Err(Error::Invalid(format!("triangle {i} has the vertices {t:?}, but there are only {n}")));
        }
        let geometry = Geometry::new(&self.bvh.device, embree4_sys::RTCGeometryType::TRIANGLE)?;
        if !indices.is_empty() {
            self.fill(&geometry, embree4_sys::RTCBufferType::VERTEX, embree4_sys::RTCFormat::FLOAT3, vertices)?;
            self.fill(&geometry, embree4_sys::RTCBufferType::INDEX, embree4_sys::RTCFormat::UINT3, indices)?;
        }
        self.attach(geometry, mask)
    }

    /// Copies `items` into a new buffer of `geometry`.
    fn fill<T: Copy>(
        &self,
        geometry: &Geometry,
        buffer: embree4_sys::RTCBufferType,
        format: embree4_sys::RTCFormat,
        items: &[[T; 3]],
    ) -> Result<()> {
        const { assert!(size_of::<T>() == 4) };
        let stride = size_of::<[T; 3]>();
        // SAFETY: the geometry is live. Embree allocates `stride · len` bytes and owns them; for vertices it adds the
        // bytes up to the next multiple of 16 that its 16-byte loads of the last item read.
        let target = unsafe {
            embree4_sys::rtcSetNewGeometryBuffer(geometry.0, buffer, 0, format, stride as _, items.len() as _)
        };
        self.bvh.device.check()?;
        if target.is_null() {
            return Err(Error::Embree(format!("no buffer for {} items of {stride} bytes", items.len())));
        }
        // SAFETY: `target` has `stride · len` bytes (above), aligned to 16, and is fresh, so that it does not overlap
        // `items`; both hold three 4-byte values per item (const assert).
        unsafe { std::ptr::copy_nonoverlapping(items.as_ptr(), target.cast::<[T; 3]>(), items.len()) };
        Ok(())
    }

    /// Adds a user geometry, borrowed. Rays see it if `mask` and theirs share a bit. Returns the geometry's number.
    ///
    /// # Errors
    /// `Invalid` if a primitive's bounds are not finite, inverted, or beyond 1.844e18 (Embree would drop it silently);
    /// `Embree` if the library refuses.
    pub fn user<G: UserGeometry + 'a>(&mut self, geometry: &'a G, mask: u32) -> Result<u32> {
        // SAFETY: `Bvh<'a>` borrows `geometry` for `'a`, so the pointer outlives every callback.
        unsafe { self.register::<G>(geometry, mask) }
    }

    /// [`BvhBuilder::user`] for a geometry that the scene shares, so that it needs to borrow nothing.
    ///
    /// # Errors
    /// As [`BvhBuilder::user`].
    pub fn user_shared<G: UserGeometry + Send + 'a>(&mut self, geometry: Arc<G>, mask: u32) -> Result<u32> {
        let pointer = Arc::as_ptr(&geometry);
        // Kept first: should `register` fail half-way, the pointer is still good for the life of the scene.
        self.bvh._shared.push(geometry);
        // SAFETY: `_shared` keeps the Arc until `Bvh::drop` has released the scene, so the pointer outlives every
        // callback.
        unsafe { self.register::<G>(pointer, mask) }
    }

    /// Registers the callbacks of `G`: each is made for one type and stored beside the pointer to a value of that type,
    /// and no call per ray is indirect but Embree's own.
    ///
    /// # Safety
    /// `geometry` points to a `G` that lives, and is only shared, as long as the scene.
    unsafe fn register<G: UserGeometry>(&mut self, geometry: *const G, mask: u32) -> Result<u32> {
        // SAFETY: the caller's `geometry` is live and shared.
        let data = unsafe { &*geometry };
        let count = data.len();
        for prim in 0..count {
            let (lower, upper) = data.bounds(prim);
            if !(0..3).all(|a| lower[a] > -LARGE && lower[a] <= upper[a] && upper[a] < LARGE) {
                return Err(Error::Invalid(format!(
                    "user primitive {prim} has the bounds {lower:?} to {upper:?}: they must be finite, in order and below {LARGE:e}"
                )));
            }
        }
        let handle = Geometry::new(&self.bvh.device, embree4_sys::RTCGeometryType::USER)?;
        // SAFETY: the handle is live; the pointer is what the callbacks of the same `G` expect, and the caller
        // promises that it outlives the scene. Embree never writes through it, and neither do they.
        unsafe {
            embree4_sys::rtcSetGeometryUserPrimitiveCount(handle.0, count);
            embree4_sys::rtcSetGeometryUserData(handle.0, geometry.cast_mut().cast::<c_void>());
            embree4_sys::rtcSetGeometryBoundsFunction(handle.0, Some(callbacks::bounds::<G>), std::ptr::null_mut());
            embree4_sys::rtcSetGeometryIntersectFunction(handle.0, Some(callbacks::intersect::<G>));
            embree4_sys::rtcSetGeometryOccludedFunction(handle.0, Some(callbacks::occluded::<G>));
        }
        self.attach(handle, mask)
    }

    fn attach(&mut self, geometry: Geometry, mask: u32) -> Result<u32> {
        // SAFETY: scene and geometry are live; the scene takes its own reference to the geometry.
        let id = unsafe {
            embree4_sys::rtcSetGeometryMask(geometry.0, mask);
            embree4_sys::rtcSetGeometryBuildQuality(geometry.0, self.quality.raw());
            embree4_sys::rtcCommitGeometry(geometry.0);
            embree4_sys::rtcAttachGeometry(self.bvh.handle, geometry.0)
        };
        self.bvh.device.check()?;
        Ok(id)
    }

    /// Builds the hierarchy.
    ///
    /// # Errors
    /// `Embree` with what the library reported, such as a lack of memory.
    pub fn commit(self) -> Result<Bvh<'a>> {
        let flags =
            if self.robust { embree4_sys::RTCSceneFlags::ROBUST } else { embree4_sys::RTCSceneFlags::default() };
        // SAFETY: the scene is live and nobody else has its handle. Bounds callbacks run now, on Embree's threads
        // too: `G` is Sync.
        unsafe {
            embree4_sys::rtcSetSceneFlags(self.bvh.handle, flags);
            embree4_sys::rtcSetSceneBuildQuality(self.bvh.handle, self.quality.raw());
            embree4_sys::rtcCommitScene(self.bvh.handle);
        }
        self.bvh.device.check()?;
        Ok(self.bvh)
    }
}

impl Bvh<'_> {
    /// Finds the nearest hit of one ray: writes it, and its distance into the ray's `tfar`. A miss changes nothing.
    ///
    /// The ray must be finite but for `tfar`; otherwise what it hits is not specified.
    #[inline]
    pub fn intersect1(&self, rayhit: &mut RayHit) {
        // SAFETY: the scene is committed. `rayhit` is ours alone, 16-byte aligned and 96 bytes long, the most that
        // any Embree from 4.0 to 4.4 (`Device::new` checked the version) reads or writes. NULL arguments: the
        // defaults, by which user geometries run the callbacks they were registered with.
        unsafe { raw::rtcIntersect1(self.handle, rayhit, std::ptr::null_mut()) }
    }

    /// Whether anything is hit. If so the ray's `tfar` becomes −∞.
    ///
    /// The ray must be finite but for `tfar`; otherwise what it hits is not specified.
    #[inline]
    #[must_use]
    pub fn occluded1(&self, ray: &mut Ray) -> bool {
        // SAFETY: as in `intersect1`; a ray without hit has had 48 bytes in every Embree 4.
        unsafe { raw::rtcOccluded1(self.handle, ray, std::ptr::null_mut()) }
        ray.tfar == f32::NEG_INFINITY
    }

    /// [`Bvh::intersect1`] for the rays of `rayhit` that take part.
    #[inline]
    pub fn intersect16(&self, valid: &Valid16, rayhit: &mut RayHit16) {
        if self.halves {
            for n in 0..2 {
                let Some(valid) = valid.half(n) else { continue };
                let mut eight = RayHit8::half_of(rayhit, n);
                // SAFETY: as in `intersect1`, with 672 bytes; `valid` is eight lanes, 32-byte aligned as is `eight`.
                unsafe { raw::rtcIntersect8(valid, self.handle, &mut eight, std::ptr::null_mut()) }
                eight.put_back(rayhit, n);
            }
            return;
        }
        // SAFETY: as in `intersect1`, with 1344 bytes; both structs are 64-byte aligned by their types.
        unsafe { raw::rtcIntersect16(valid.as_ptr(), self.handle, rayhit, std::ptr::null_mut()) }
    }

    /// [`Bvh::occluded1`] for the rays that take part: `tfar` of the occluded ones becomes −∞.
    #[inline]
    pub fn occluded16(&self, valid: &Valid16, rays: &mut Ray16) {
        if self.halves {
            for n in 0..2 {
                let Some(valid) = valid.half(n) else { continue };
                let mut eight = Ray8::half_of(rays, n);
                // SAFETY: as in `intersect16`, with 384 bytes.
                unsafe { raw::rtcOccluded8(valid, self.handle, &mut eight, std::ptr::null_mut()) }
                eight.put_back(rays, n);
            }
            return;
        }
        // SAFETY: as in `intersect16`, with 768 bytes.
        unsafe { raw::rtcOccluded16(valid.as_ptr(), self.handle, rays, std::ptr::null_mut()) }
    }
}
