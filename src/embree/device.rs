//! The library: one device, its version, its errors.

use super::abi::raw;
use crate::error::{Error, Result};
use crate::isa::{Isa, Kind};
use std::ffi::{CStr, CString, c_char, c_void};
use std::sync::{Arc, Mutex, PoisonError};

/// Embree, opened. Cheap to clone: clones share one device, and scenes keep theirs alive.
#[derive(Clone, Debug)]
pub struct Device(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    handle: embree4_sys::RTCDevice,
    /// Filled by the error callback. In its own `Arc` because its address is what the callback was given.
    errors: Arc<Mutex<Vec<String>>>,
}

// SAFETY: `handle` is only used through Embree's API, whose device functions are documented as thread-safe and whose
// reference count is atomic; nothing in it belongs to the thread that made it. `errors` is Send.
unsafe impl Send for Inner {}
// SAFETY: as for Send; `&Inner` gives access to thread-safe device functions and to a Mutex.
unsafe impl Sync for Inner {}

impl Device {
    /// Opens Embree with `threads` threads for building scenes (0: one per core). Queries run on their callers'
    /// threads.
    ///
    /// It uses the widest vectors that the processor has, or at most those of [`Isa::chosen`].
    ///
    /// The library shares its threads between the devices of a process: the largest number among those alive counts.
    ///
    /// # Errors
    /// `Embree` if the library is not a 4.x, or lacks triangles, user geometry or ray masks, or cannot start (an
    /// unknown CPU, no memory).
    pub fn new(threads: usize) -> Result<Self> {
        let threads = if threads == 0 { String::new() } else { format!("threads={threads},") };
        // Embree's own names; plain code is what every x86-64 has.
        let isa = match Isa::chosen().map(Isa::kind) {
            None => "",
            Some(Kind::Plain) => "max_isa=sse2",
            Some(Kind::Avx2) => "max_isa=avx2",
            Some(Kind::Avx512) => "max_isa=avx512",
        };
        let device = Self::with_config(&(threads + isa))?;
        check_version(device.property(embree4_sys::RTCDeviceProperty::VERSION))?;
        for (property, what) in [
            (embree4_sys::RTCDeviceProperty::TRIANGLE_GEOMETRY_SUPPORTED, "triangles"),
            (embree4_sys::RTCDeviceProperty::USER_GEOMETRY_SUPPORTED, "user geometry"),
            (embree4_sys::RTCDeviceProperty::RAY_MASK_SUPPORTED, "ray masks"),
        ] {
            if device.property(property) == 0 {
                return Err(Error::Embree(format!(
                    "this library ({}) was built without {what}; install another build, or run `make deps`",
                    device.version()
                )));
            }
        }
        Ok(device)
    }

    fn with_config(config: &str) -> Result<Self> {
        let config = CString::new(config).map_err(|e| Error::Embree(format!("configuration {config:?}: {e}")))?;
        // SAFETY: `config` is NUL-terminated and lives beyond the call, which copies it.
        let handle = unsafe { embree4_sys::rtcNewDevice(config.as_ptr()) };
        if handle.is_null() {
            // SAFETY: a null device asks for this thread's last error, which is how rtcNewDevice reports.
            let code = unsafe { raw::rtcGetDeviceError(std::ptr::null_mut()) };
            return Err(Error::Embree(format!("no device with configuration {config:?}: {}", describe(code, ""))));
        }
        let errors = Arc::new(Mutex::new(Vec::new()));
        let user = Arc::as_ptr(&errors).cast_mut().cast::<c_void>();
        // SAFETY: `handle` is live. The callback reads `user` as the `Mutex<Vec<String>>` it is; `Inner` owns it
        // beside the handle, and `Inner::drop` releases the device first, so the pointer outlives every callback.
        unsafe { raw::rtcSetDeviceErrorFunction(handle, Some(collect_error), user) };
        Ok(Self(Arc::new(Inner { handle, errors })))
    }

    /// The version of the library that is loaded, such as `4.4.0`.
    #[must_use]
    pub fn version(&self) -> String {
        version_text(self.property(embree4_sys::RTCDeviceProperty::VERSION))
    }

    /// How many rays a packet has that Embree's own kernels trace side by side: 16, 8, 4, or 1.
    pub(super) fn packet_width(&self) -> usize {
        let widths = [
            (16, embree4_sys::RTCDeviceProperty::NATIVE_RAY16_SUPPORTED),
            (8, embree4_sys::RTCDeviceProperty::NATIVE_RAY8_SUPPORTED),
            (4, embree4_sys::RTCDeviceProperty::NATIVE_RAY4_SUPPORTED),
        ];
        widths.into_iter().find(|(_, native)| self.property(*native) != 0).map_or(1, |(width, _)| width)
    }

    fn property(&self, property: embree4_sys::RTCDeviceProperty) -> isize {
        // SAFETY: the handle is live as long as `self`.
        let value = unsafe { embree4_sys::rtcGetDeviceProperty(self.0.handle, property) };
        value as isize
    }

    pub(super) fn handle(&self) -> embree4_sys::RTCDevice {
        self.0.handle
    }

    /// `Err` with everything that Embree has reported since the last call, on any thread that uses this device.
    pub(super) fn check(&self) -> Result<()> {
        let errors = std::mem::take(&mut *self.0.errors.lock().unwrap_or_else(PoisonError::into_inner));
        if errors.is_empty() { Ok(()) } else { Err(Error::Embree(errors.join("; "))) }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: the handle came from rtcNewDevice and is released once, here. Scenes and geometries hold a `Device`,
        // so all of theirs are gone.
        unsafe { embree4_sys::rtcReleaseDevice(self.handle) };
    }
}

/// Embree's error callback: puts the message where [`Device::check`] finds it.
///
/// # Safety
/// `user` points to a live `Mutex<Vec<String>>`, and `message` is null or NUL-terminated.
unsafe extern "C" fn collect_error(user: *mut c_void, code: u32, message: *const c_char) {
    // SAFETY: `Device::with_config` registered this function with that pointer and keeps it alive (see there).
    let errors = unsafe { &*user.cast::<Mutex<Vec<String>>>() };
    let message = if message.is_null() {
        String::new()
    } else {
        // SAFETY: not null, and Embree passes a C string that lives during the call.
        unsafe { CStr::from_ptr(message) }.to_string_lossy().into_owned()
    };
    // No panic here: it would have to cross C.
    errors.lock().unwrap_or_else(PoisonError::into_inner).push(describe(code, &message));
}

fn describe(code: u32, message: &str) -> String {
    let name = match code {
        0 => "no error reported",
        2 => "invalid argument",
        3 => "invalid operation",
        4 => "out of memory",
        5 => "unsupported CPU",
        6 => "cancelled",
        _ => "unknown error",
    };
    if message.is_empty() { format!("{name} (code {code})") } else { format!("{name} (code {code}): {message}") }
}

/// 4.0 ≤ version < 5: the range whose layout `abi` is right for.
fn check_version(version: isize) -> Result<()> {
    if (40000..50000).contains(&version) {
        return Ok(());
    }
    Err(Error::Embree(format!(
        "found version {}, but isolume needs 4.x; install Embree 4 or set EMBREE_DIR, then build again",
        version_text(version)
    )))
}

fn version_text(version: isize) -> String {
    format!("{}.{}.{}", version / 10000, version / 100 % 100, version % 100)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_outside_4_are_refused() {
        for good in [40000, 40200, 40303, 40400, 49999] {
            assert!(check_version(good).is_ok(), "{good}");
        }
        for bad in [0, 21707, 31305, 39999, 50000] {
            let message = check_version(bad).unwrap_err().to_string();
            assert!(message.contains(&version_text(bad)) && message.contains("4.x"), "{message}");
        }
        assert_eq!(version_text(40303), "4.3.3");
    }

    #[test]
    fn what_embree_reports_becomes_an_error_once() {
        let device = Device::new(1).unwrap();
        device.check().unwrap();
        // SAFETY: device and geometry are live. A primitive count is an invalid operation on triangles, and Embree
        // answers misuse of that kind by its error callback alone.
        unsafe {
            let geometry = embree4_sys::rtcNewGeometry(device.handle(), embree4_sys::RTCGeometryType::TRIANGLE);
            embree4_sys::rtcSetGeometryUserPrimitiveCount(geometry, 1);
            embree4_sys::rtcReleaseGeometry(geometry);
        }
        let message = device.check().unwrap_err().to_string();
        assert!(message.starts_with("Embree: invalid operation (code 3): "), "{message}");
        device.check().unwrap();
    }

    #[test]
    fn a_device_that_cannot_start_is_an_error() {
        let message = Device::with_config("threads=1\0").unwrap_err().to_string();
        assert!(message.contains("configuration"), "{message}");
    }
}
