//! Samples without a header, also gzipped (`….gz`): dimensions, type, byte order and placement come from the user.

use crate::error::{Error, Result};
use crate::files::{self, Packing, Section};
use crate::volume::{ElementType, Endian, Lattice, READ, Samples, Volume};
use glam::DVec3;
use std::path::Path;

/// How a raw file is laid out.
#[derive(Clone, Debug, PartialEq)]
pub struct RawLayout {
    /// Samples along x, y and z; x runs fastest.
    pub dims: [usize; 3],
    /// Type of a sample.
    pub element: ElementType,
    /// Byte order of a sample.
    pub endian: Endian,
    /// Bytes in front of the samples.
    pub header_bytes: u64,
    /// World distance of samples along each axis; negative where the axis is flipped.
    pub spacing: DVec3,
    /// World position of the first sample.
    pub origin: DVec3,
}

impl RawLayout {
    /// A little-endian layout without a header, spacing 1, origin 0.
    pub fn new(dims: [usize; 3], element: ElementType) -> Self {
        Self { dims, element, endian: Endian::Little, header_bytes: 0, spacing: DVec3::ONE, origin: DVec3::ZERO }
    }

    /// Reads a file, whose length must be exactly what the layout says; of a gzipped one, named `.gz`, the length of
    /// what is packed.
    ///
    /// # Errors
    /// `Io`; `Invalid` if the length differs, a gzip stream is damaged or the lattice is degenerate.
    pub fn read(&self, path: &Path) -> Result<Volume> {
        let lattice = Lattice::aligned(self.dims, self.origin, self.spacing).map_err(|e| e.in_file(path))?;
        let bytes = self.element.bytes(lattice.len());
        let [nx, ny, nz] = self.dims;
        let wanted = bytes.saturating_add(self.header_bytes);
        let extension = path.extension().map(|e| format!(".{}", e.to_string_lossy().to_ascii_lowercase()));
        let packing = if extension.as_deref() == Some(".gz") { files::gzip_or_plain(path, 0)? } else { Packing::Plain };
        let section = match packing {
            Packing::Plain => Section { start: self.header_bytes, packing, skip: 0 },
            _ => Section { start: 0, packing, skip: self.header_bytes },
        };
        // One more than wanted is too many, however many there are.
        let found = match packing {
            Packing::Plain => files::length(path)?,
            _ => files::count(path, section, wanted.saturating_add(1))?,
        };
        if let Some(e) = extension.filter(|e| found != wanted && READ.split([',', ' ']).any(|known| known == e)) {
            return Err(Error::invalid(
                path,
                format!(
                    "has {found} bytes instead of {wanted}: a {e} has a header that says its layout; leave --raw-… out"
                ),
            ));
        }
        if found != wanted {
            let unpacked = match packing {
                Packing::Plain => "",
                _ if found > wanted => " or more, unpacked",
                _ => ", unpacked",
            };
            return Err(Error::invalid(
                path,
                format!(
                    "has {found} bytes{unpacked}, but {} header bytes and {nx}×{ny}×{nz} samples of type {} are {wanted}; \
                     check the dimensions and the type",
                    self.header_bytes,
                    self.element.name()
                ),
            ));
        }
        let samples = Samples::from_vec(files::read_section(path, section, bytes)?, self.element, self.endian);
        Volume::new(path.display().to_string(), lattice, samples)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_must_match() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.raw");
        let mut bytes = vec![9; 5];
        bytes.extend((0..12u16).flat_map(|i| (i * 300).to_be_bytes()));
        std::fs::write(&path, &bytes).unwrap();
        let mut layout = RawLayout::new([3, 2, 2], ElementType::U16);
        let message = layout.read(&path).unwrap_err().to_string();
        assert!(message.contains("has 29 bytes") && message.contains("are 24"), "{message}");
        layout.header_bytes = 5;
        layout.endian = Endian::Big;
        layout.spacing = DVec3::new(1.0, -2.0, 3.0);
        layout.origin = DVec3::new(0.0, 7.0, 0.0);
        let v = layout.read(&path).unwrap();
        assert_eq!(v.samples(), &Samples::U16((0..12).map(|i| i * 300).collect()));
        assert_eq!(v.lattice.to_world(DVec3::ONE), DVec3::new(1.0, 5.0, 3.0));
        layout.dims = [10_000, 10_000, 10_000];
        assert!(matches!(layout.read(&path), Err(Error::Invalid(_))));
        layout.dims = [1, 4, 3];
        assert!(layout.read(&path).unwrap_err().to_string().contains("a.raw"));
    }

    #[test]
    fn packed_the_length_must_match_too() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.raw.gz");
        let bytes: Vec<u8> = (0..25).collect();
        let packed = files::gz(&bytes);
        std::fs::write(&path, &packed).unwrap();
        let mut layout = RawLayout::new([3, 2, 4], ElementType::U8);
        layout.header_bytes = 1;
        assert_eq!(layout.read(&path).unwrap().samples(), &Samples::U8(bytes[1..].to_vec()));
        for (dims, found) in [([3, 2, 3], "20 bytes or more, unpacked"), ([3, 2, 5], "25 bytes, unpacked")] {
            let message = RawLayout { dims, ..layout.clone() }.read(&path).unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
        }
        // Under another name these are samples.
        let plain = folder.path().join("a.raw");
        std::fs::write(&plain, &packed).unwrap();
        let mut layout = RawLayout::new([2, 2, 2], ElementType::U8);
        layout.header_bytes = packed.len() as u64 - 8;
        assert_eq!(layout.read(&plain).unwrap().samples(), &Samples::U8(packed[packed.len() - 8..].to_vec()));
        std::fs::write(&path, &packed[..packed.len() - 9]).unwrap();
        assert!(layout.read(&path).unwrap_err().to_string().contains("damaged"));
    }
}
