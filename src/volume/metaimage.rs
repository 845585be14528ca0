//! MetaImage volumes, attached (`.mha`) and detached (`.mhd` with a data file), as ITK, VTK and 3D Slicer write them.
//!
//! Row a of `TransformMatrix` is the world direction of axis a, `Offset` the position of the first sample, both in the
//! file's own world (ITK's left-posterior-superior): they are taken as numbers and not turned.

use crate::error::{Error, Result};
use crate::files::{self, Packing, Section};
use crate::volume::header::{Header, Line, before_last};
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume, ascii};
use glam::{DMat3, DVec3};
use std::path::{Path, PathBuf};

/// The key that ends the header.
const DATA_FILE: &str = "ElementDataFile";

/// The file that a header names for its samples.
pub(crate) fn data_file(path: &Path) -> Option<PathBuf> {
    let header = Fields::read(path).ok()?;
    let name = header.get(DATA_FILE).filter(|name| !name.eq_ignore_ascii_case("LOCAL"))?;
    header.beside(DATA_FILE, name).ok()
}

/// The fields of a MetaImage header.
struct Fields<'a>(Header<'a>);

impl<'a> std::ops::Deref for Fields<'a> {
    type Target = Header<'a>;

    fn deref(&self) -> &Header<'a> {
        &self.0
    }
}

/// Reads a 3D scalar volume. Samples keep the file's type.
///
/// Binary (either byte order), zlib or ascii samples, behind the header or in one file beside it. `Position` and
/// `Origin` stand for `Offset`, `Rotation` and `Orientation` for `TransformMatrix`; without `ElementSpacing`,
/// `ElementSize` gives the spacing, and 1 without both.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, too few bytes (known before they are allocated) or a damaged stream;
/// `NotSupported` for several channels, other dimensions and samples split over several files.
pub fn read(path: &Path) -> Result<Volume> {
    let header = Fields::read(path)?;
    let lattice = header.lattice()?;
    let element = header.element()?;
    let samples = header.samples(lattice.len(), element)?;
    Volume::new(path.display().to_string(), lattice, samples)
}

impl<'a> Fields<'a> {
    /// Reads the lines up to `ElementDataFile`.
    fn read(path: &'a Path) -> Result<Self> {
        let header = Header::read(path, |number, text| {
            let text = text.trim();
            if text.is_empty() {
                return Ok(Line::Nothing);
            }
            let Some((key, value)) = text.split_once(['=', ':']).map(|(k, v)| (k.trim(), v.trim())) else {
                let shown: String = text.chars().take(40).flat_map(char::escape_debug).collect();
                return Err(Error::invalid(path, format!("line {number}, `{shown}`, is no `key = value`")));
            };
            let (last, key, value) = (key == DATA_FILE, key.to_string(), value.to_string());
            Ok(if last { Line::Last(key, value) } else { Line::Field(key, value) })
        })?;
        if header.get(DATA_FILE).is_none() {
            let message = format!("the header has no field `{DATA_FILE}`, which must end it");
            return Err(Error::invalid(path, message));
        }
        Ok(Self(header))
    }

    /// The first of several names of a field that is there.
    fn first(&self, keys: &[&'static str]) -> Option<&'static str> {
        keys.iter().copied().find(|key| self.get(key).is_some())
    }

    /// `count` numbers of the first of several fields that is there.
    fn any<T: std::str::FromStr>(&self, keys: &[&'static str], count: usize) -> Result<Option<Vec<T>>> {
        self.first(keys).map_or(Ok(None), |key| self.numbers(key, count))
    }

    /// A yes or no, `false` if the field is missing. MetaIO looks at the first letter only.
    fn flag(&self, keys: &[&'static str]) -> Result<bool> {
        match self.first(keys) {
            None => Ok(false),
            Some(key) => match self.need(key)?.chars().next().map(|c| c.to_ascii_lowercase()) {
                Some('t' | 'y' | '1') => Ok(true),
                Some('f' | 'n' | '0') => Ok(false),
                _ => Err(self.wrong(key, "it must be True or False")),
            },
        }
    }

    fn lattice(&self) -> Result<Lattice> {
        let n: Option<Vec<usize>> = self.numbers("NDims", 1)?;
        match n.as_deref() {
            Some([3]) => {}
            Some([n]) => {
                return Err(Error::not_supported(
                    self.path,
                    format!(
                        "NDims = {n}: only 3D scalar volumes are read; a 2D field goes to `isolume flatland`, as .png, .nrrd or .vti"
                    ),
                ));
            }
            _ => return Err(Error::invalid(self.path, "the header has no field `NDims`, so it is no MetaImage")),
        }
        let dims: Vec<usize> = self
            .numbers("DimSize", 3)?
            .ok_or_else(|| Error::invalid(self.path, "the header has no field `DimSize`"))?;
        let vector = |keys: &[&'static str], missing: DVec3| -> Result<DVec3> {
            Ok(self.any(keys, 3)?.map_or(missing, |v| DVec3::from_slice(&v)))
        };
        let spacing = vector(&["ElementSpacing", "ElementSize"], DVec3::ONE)?;
        let origin = vector(&["Offset", "Position", "Origin"], DVec3::ZERO)?;
        let rows: Option<Vec<f64>> = self.any(&["TransformMatrix", "Rotation", "Orientation"], 9)?;
        let directions = rows.map_or(DMat3::IDENTITY, |r| DMat3::from_cols_slice(&r));
        Lattice::new([dims[0], dims[1], dims[2]], origin, directions * DMat3::from_diagonal(spacing))
            .map_err(|e| e.in_file(self.path))
    }

    fn element(&self) -> Result<ElementType> {
        if let Some(value) = self.get("ElementNumberOfChannels")
            && value != "1"
        {
            return Err(Error::not_supported(
                self.path,
                format!("ElementNumberOfChannels = {value}: colours and vectors are not read; extract one channel"),
            ));
        }
        Ok(match self.need("ElementType")? {
            "MET_CHAR" => ElementType::I8,
            "MET_UCHAR" | "MET_ASCII_CHAR" => ElementType::U8,
            "MET_SHORT" => ElementType::I16,
            "MET_USHORT" => ElementType::U16,
            // MetaIO's long has 32 bits on every machine.
            "MET_INT" | "MET_LONG" => ElementType::I32,
            "MET_UINT" | "MET_ULONG" => ElementType::U32,
            "MET_LONG_LONG" => ElementType::I64,
            "MET_ULONG_LONG" => ElementType::U64,
            "MET_FLOAT" => ElementType::F32,
            "MET_DOUBLE" => ElementType::F64,
            other => {
                return Err(Error::not_supported(
                    self.path,
                    format!("ElementType = {other}: integers of 8 to 64 bits, MET_FLOAT and MET_DOUBLE are read"),
                ));
            }
        })
    }

    fn samples(&self, count: usize, element: ElementType) -> Result<Samples> {
        let name = self.need(DATA_FILE)?;
        // Where they begin if nothing else is said.
        let (path, behind) = match name {
            "LOCAL" | "Local" | "local" => (self.path.to_path_buf(), self.length),
            _ => (self.beside(DATA_FILE, name)?, 0),
        };
        let promised = element.bytes(count);
        let compressed = self.flag(&["CompressedData"])?;
        let skip: i64 = self.numbers("HeaderSize", 1)?.map_or(0, |v| v[0]);
        let start = match u64::try_from(skip) {
            Ok(0) => behind,
            // Counted from where the file begins, whichever it is.
            Ok(bytes) if bytes >= behind => bytes,
            Ok(_) => return Err(self.wrong("HeaderSize", &format!("the header alone has {behind} bytes"))),
            // −1: the samples are the end of the file.
            Err(_) if skip == -1 && !compressed => before_last(&path, 0, promised)?,
            Err(_) => {
                let wanted = "it must not be negative (−1 is for samples that are not compressed)";
                return Err(self.wrong("HeaderSize", wanted));
            }
        };
        let packing = if compressed {
            // MetaIO writes zlib and reads gzip as well.
            match files::gzip_or_plain(&path, start)? {
                Packing::Plain => Packing::Zlib,
                gzip => gzip,
            }
        } else {
            Packing::Plain
        };
        if self.get("BinaryData").is_some() && !self.flag(&["BinaryData"])? {
            return ascii::read(&path, start, element, count);
        }
        let msb = self.flag(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"])?;
        let bytes = files::read_section(&path, Section { start, packing, skip: 0 }, promised)?;
        Ok(Samples::from_vec(bytes, element, if msb { Endian::Big } else { Endian::Little }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::{Compression, write::ZlibEncoder};
    use std::io::Write;

    const TWELVE: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];

    fn read_with(header: &str, data: &[u8], beside: Option<&[u8]>) -> Result<Volume> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mhd");
        std::fs::write(&path, [header.as_bytes(), data].concat()).unwrap();
        if let Some(bytes) = beside {
            std::fs::write(folder.path().join("d.raw"), bytes).unwrap();
        }
        read(&path)
    }

    fn zlib(bytes: &[u8]) -> Vec<u8> {
        let mut e = ZlibEncoder::new(Vec::new(), Compression::fast());
        e.write_all(bytes).unwrap();
        e.finish().unwrap()
    }

    fn header(extra: &str, file: &str) -> String {
        format!(
            "ObjectType = Image\nNDims = 3\n{extra}DimSize = 3 2 2\nElementType = MET_UCHAR\nElementDataFile = {file}\n"
        )
    }

    #[test]
    fn encodings_hold_the_same_samples() {
        let expected = Samples::U8(TWELVE.to_vec());
        let same = |v: Result<Volume>| assert_eq!(v.unwrap().samples(), &expected);
        same(read_with(&header("", "LOCAL"), &TWELVE, None));
        same(read_with(&header("BinaryData = True\r\n", "LOCAL"), &TWELVE, None));
        same(read_with(&header("CompressedData = True\n", "LOCAL"), &zlib(&TWELVE), None));
        same(read_with(&header("CompressedData = True\n", "d.raw"), &[], Some(&zlib(&TWELVE))));
        same(read_with(&header("BinaryData = False\n", "LOCAL"), b"0 1 2 3 4 5\n6 7 8 9 10 11\n", None));
        let behind = [&[9, 9, 9], &TWELVE[..]].concat();
        same(read_with(&header("HeaderSize = 3\n", "d.raw"), &[], Some(&behind)));
        same(read_with(&header("HeaderSize = -1\n", "d.raw"), &[], Some(&behind)));
    }

    #[test]
    fn byte_orders_and_types() {
        for (name, element) in [
            ("MET_SHORT", ElementType::I16),
            ("MET_USHORT", ElementType::U16),
            ("MET_LONG", ElementType::I32),
            ("MET_UINT", ElementType::U32),
            ("MET_LONG_LONG", ElementType::I64),
            ("MET_FLOAT", ElementType::F32),
            ("MET_DOUBLE", ElementType::F64),
        ] {
            for key in ["BinaryDataByteOrderMSB", "ElementByteOrderMSB"] {
                for msb in [true, false] {
                    let data: Vec<u8> = (0..12u8)
                        .flat_map(|i| {
                            let mut b = match element {
                                ElementType::F32 => f32::from(i).to_be_bytes().to_vec(),
                                ElementType::F64 => f64::from(i).to_be_bytes().to_vec(),
                                _ => [&[0; 7][..element.size() - 1], &[i]].concat(),
                            };
                            if !msb {
                                b.reverse();
                            }
                            b
                        })
                        .collect();
                    let flag = format!("{key} = {}\n", if msb { "True" } else { "False" });
                    let v = read_with(&header(&flag, "LOCAL").replace("MET_UCHAR", name), &data, None).unwrap();
                    assert_eq!(v.samples().element_type(), element);
                    assert!((0..12).all(|i| v.value(i) == i as f64), "{name} {flag}");
                }
            }
        }
    }

    #[test]
    fn rows_of_the_matrix_are_axes() {
        let place = "TransformMatrix = 0 1 0 -1 0 0 0 0 1\nOffset = 90 -7 5\nElementSpacing = 2 3 4\n";
        let l = read_with(&header(place, "LOCAL"), &TWELVE, None).unwrap().lattice;
        // Axis 0 runs along +y, axis 1 along −x.
        assert_eq!(l.to_world(DVec3::new(1.0, 0.0, 0.0)), DVec3::new(90.0, -5.0, 5.0));
        assert_eq!(l.to_world(DVec3::new(0.0, 1.0, 1.0)), DVec3::new(87.0, -7.0, 9.0));
        let other = "Orientation = 1 0 0 0 1 0 0 0 -1\nPosition = 1 2 3\nElementSize = 0.5 1 2\n";
        let l = read_with(&header(other, "LOCAL"), &TWELVE, None).unwrap().lattice;
        assert_eq!(l.to_world(DVec3::ONE), DVec3::new(1.5, 3.0, 1.0));
    }

    #[test]
    fn broken_files_are_refused() {
        let refused = |header: &str, data: &[u8], words: &str| {
            let message = read_with(header, data, None).unwrap_err().to_string();
            assert!(message.contains(words) && !message.contains('\n'), "{words}: {message}");
        };
        refused(&header("", "LOCAL"), &TWELVE[..11], "11");
        let packed = zlib(&TWELVE);
        for cut in 1..packed.len() {
            let e = read_with(&header("CompressedData = True\n", "LOCAL"), &packed[..packed.len() - cut], None);
            assert!(matches!(e, Err(Error::Invalid(_))), "{cut}");
        }
        refused(&header("", "LOCAL").replace("3 2 2", "10000 10000 10000"), &TWELVE, "cannot hold");
        refused(&header("", "LOCAL").replace("3 2 2", "12 1 1"), &TWELVE, "flatland");
        refused(&header("", "LOCAL").replace("NDims = 3", "NDims = 2"), &TWELVE, "NDims = 2");
        refused(&header("ElementNumberOfChannels = 3\n", "LOCAL"), &TWELVE, "channel");
        refused(&header("", "LOCAL").replace("MET_UCHAR", "MET_NONE"), &TWELVE, "MET_NONE");
        refused(&header("", "slice%03d.raw"), &[], "join them");
        refused(&header("", "d.raw"), &[], "d.raw");
        refused("NDims = 3\nrubbish\n", &[], "line 2");
        refused("NDims = 3\n", &[], "ElementDataFile");
        refused(&header("Offset = 1 2\n", "LOCAL"), &TWELVE, "`Offset` is `1 2`");
    }
}
