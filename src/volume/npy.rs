//! NumPy arrays (`.npy`, also gzipped). \[NPY\]
//!
//! x runs fastest in memory, whichever way the array is indexed: a C-ordered array has the shape (nz, ny, nx) and is
//! indexed `a[z, y, x]` (as scikit-image, tifffile, SimpleITK and napari do), a Fortran-ordered one has the shape
//! (nx, ny, nz) and is indexed `a[x, y, z]` (as nibabel and pynrrd do). The format holds no place in the world: spacing
//! 1, origin 0.

use crate::error::{Error, Result};
use crate::files::{self, Section};
use crate::volume::vti::SamplesRef;
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume};
use glam::DVec3;
use std::io::Write;
use std::path::Path;

/// What a header says.
#[derive(Debug, PartialEq)]
struct Header {
    element: ElementType,
    /// 16-bit floats, stored here as `U16`.
    half: bool,
    endian: Endian,
    fortran: bool,
    shape: Vec<usize>,
}

/// Reads an array of three axes, or of more where all others are of length 1. Integers of 8 to 64 bits, booleans (as
/// u8), and floats of 16 (stored as f32), 32 and 64 bits, in either byte order.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, too few bytes (known before they are allocated) or a damaged gzip stream;
/// `NotSupported` for other shapes and types.
pub fn read(path: &Path) -> Result<Volume> {
    let packing = files::gzip_or_plain(path, 0)?;
    let behind = |skip| Section { start: 0, packing, skip };
    let head = files::read_head(path, behind(0), 12)?;
    let wrong = |message: &str| Error::invalid(path, message);
    if !head.starts_with(b"\x93NUMPY") || head.len() < 12 {
        return Err(wrong("does not begin like a NumPy array; it is no .npy file"));
    }
    // Version 1 has a length of 2 bytes, 2 and 3 of 4.
    let (length, from) = match head[6] {
        1 => (u64::from(u16::from_le_bytes([head[8], head[9]])), 10),
        2 | 3 => (u64::from(u32::from_le_bytes([head[8], head[9], head[10], head[11]])), 12),
        version => return Err(Error::not_supported(path, format!("version {version} of .npy; 1 to 3 are read"))),
    };
    let text = files::read_head(path, behind(from), length.min(1 << 20))?;
    let text = String::from_utf8_lossy(&text);
    let header = parse_header(&text).map_err(|e| e.in_file(path))?;
    // Axes of length 1 mean nothing; of what is left, the fastest is x.
    let mut dims = header.shape.clone();
    if dims.len() > 3 {
        dims.retain(|&n| n != 1);
    }
    if !header.fortran {
        dims.reverse();
    }
    let dims: [usize; 3] = dims.try_into().map_err(|_| {
        Error::not_supported(
            path,
            format!(
                "shape {:?}: one value per point of three axes is read; save one component, and give 2D fields to \
                 `isolume flatland` as .png, .nrrd or .vti",
                header.shape
            ),
        )
    })?;
    let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).map_err(|e| e.in_file(path))?;
    let promised = header.element.bytes(lattice.len());
    let bytes = files::read_section(path, behind(from + length), promised)?;
    let samples = match Samples::from_vec(bytes, header.element, header.endian) {
        Samples::U16(v) if header.half => Samples::from_halves(&v),
        samples => samples,
    };
    Volume::new(path.display().to_string(), lattice, samples)
}

/// What a `descr` calls a type, behind the byte order: the letter of its name and its bytes.
fn descr_of(element: ElementType) -> String {
    format!("{}{}", &element.name()[..1], element.size())
}

/// The Python dictionary `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4, 5), }`.
fn parse_header(text: &str) -> Result<Header> {
    let shown: String = text.trim_end().chars().take(120).map(|c| if c.is_control() { ' ' } else { c }).collect();
    let value = |key: &str| {
        let at = ["'", "\""].iter().find_map(|q| {
            let quoted = format!("{q}{key}{q}");
            text.find(&quoted).map(|at| at + quoted.len())
        });
        let rest = at.and_then(|at| text[at..].trim_start().strip_prefix(':'));
        rest.map(str::trim_start).ok_or_else(|| Error::Invalid(format!("the header has no key '{key}': {shown}")))
    };
    let descr = value("descr")?;
    let quoted = |q: char| descr.strip_prefix(q).and_then(|d| d.split(q).next());
    let Some(descr) = quoted('\'').or_else(|| quoted('"')) else {
        return Err(Error::NotSupported("is an array of records; save one plain field of it".into()));
    };
    let (order, kind) = match descr.as_bytes() {
        [order @ (b'<' | b'>' | b'|' | b'='), ..] => (*order, &descr[1..]),
        _ => (b'|', descr),
    };
    let half = kind == "f2";
    let element = match kind {
        "b1" => Some(ElementType::U8),
        "f2" => Some(ElementType::U16),
        _ => ElementType::ALL.into_iter().find(|&e| descr_of(e) == kind),
    };
    let element = element.ok_or_else(|| {
        Error::NotSupported(format!(
            "descr '{descr}': integers, booleans and floats of 16 to 64 bits are read; convert it with .astype('f4')"
        ))
    })?;
    let fortran = match value("fortran_order")? {
        v if v.starts_with("True") => true,
        v if v.starts_with("False") => false,
        _ => return Err(Error::Invalid(format!("fortran_order is neither True nor False: {shown}"))),
    };
    let shape = value("shape")?;
    let inside = shape.strip_prefix('(').and_then(|s| s.split(')').next());
    let shape: Option<Vec<usize>> = inside.and_then(|s| {
        s.split(',')
            .map(str::trim)
            .filter(|w| !w.is_empty())
            .map(|w| w.strip_suffix('L').unwrap_or(w).parse().ok())
            .collect()
    });
    let shape = shape.ok_or_else(|| Error::Invalid(format!("shape is no tuple of numbers: {shown}")))?;
    Ok(Header { element, half, endian: if order == b'>' { Endian::Big } else { Endian::Little }, fortran, shape })
}

/// Writes values on a lattice: C order, little-endian, shape (nz, ny, nx) for one component and (nz, ny, nx,
/// components) for more. The file appears under its name only when it is complete.
///
/// # Errors
/// `Invalid` if the count is not the lattice's samples × `components`; `Io`.
pub fn write(path: &Path, lattice: &Lattice, components: usize, values: SamplesRef<'_>) -> Result<()> {
    values.check(lattice, components).map_err(|e| Error::invalid(path, e))?;
    let element = values.element_type();
    let order = if element.size() == 1 { '|' } else { '<' };
    let [nx, ny, nz] = lattice.dims();
    let shape =
        if components == 1 { format!("({nz}, {ny}, {nx})") } else { format!("({nz}, {ny}, {nx}, {components})") };
    let mut head = format!("{{'descr': '{order}{}', 'fortran_order': False, 'shape': {shape}, }}", descr_of(element));
    // The samples begin at a multiple of 64 bytes.
    let length = (10 + head.len() + 1).next_multiple_of(64) - 10;
    head.extend(std::iter::repeat_n(' ', length - 1 - head.len()));
    head.push('\n');
    files::write_atomically(path, |out| {
        out.write_all(b"\x93NUMPY\x01\x00")?;
        out.write_all(&(length as u16).to_le_bytes())?;
        out.write_all(head.as_bytes())?;
        values.write_le(out)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(version: u8, dict: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0x93, b'N', b'U', b'M', b'P', b'Y', version, 0];
        match version {
            1 => bytes.extend((dict.len() as u16).to_le_bytes()),
            _ => bytes.extend((dict.len() as u32).to_le_bytes()),
        }
        [&bytes[..], dict.as_bytes(), data].concat()
    }

    fn open(bytes: &[u8]) -> Result<Volume> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        std::fs::write(&path, bytes).unwrap();
        read(&path)
    }

    fn dict(descr: &str, fortran: &str, shape: &str) -> String {
        format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}\n")
    }

    #[test]
    fn x_is_the_fastest_axis() {
        let data: Vec<u8> = (0..24).collect();
        for (fortran, shape) in [("False", "(4, 3, 2)"), ("True", "(2, 3, 4)"), ("False", "(1, 4L, 3L, 2L)")] {
            for version in 1..=3 {
                let v = open(&npy(version, &dict("|u1", fortran, shape), &data)).unwrap();
                assert_eq!(v.lattice.dims(), [2, 3, 4], "{shape}");
                assert_eq!(v.value(v.lattice.offset(1, 2, 3)), 23.0);
                assert_eq!(v.value(v.lattice.offset(1, 0, 0)), 1.0);
            }
        }
    }

    #[test]
    fn types_and_byte_orders() {
        for (kind, element) in [
            ("i1", ElementType::I8),
            ("b1", ElementType::U8),
            ("u2", ElementType::U16),
            ("i4", ElementType::I32),
            ("u8", ElementType::U64),
            ("f2", ElementType::F32),
            ("f4", ElementType::F32),
            ("f8", ElementType::F64),
        ] {
            for order in ["<", ">"] {
                let data: Vec<u8> = (0..8u8)
                    .flat_map(|i| {
                        let mut b = match kind {
                            "f2" => half::f16::from(i).to_le_bytes().to_vec(),
                            "f4" => f32::from(i).to_le_bytes().to_vec(),
                            "f8" => f64::from(i).to_le_bytes().to_vec(),
                            _ => [&[i], &[0; 7][..element.size() - 1]].concat(),
                        };
                        if order == ">" {
                            b.reverse();
                        }
                        b
                    })
                    .collect();
                let v = open(&npy(1, &dict(&format!("{order}{kind}"), "False", "(2, 2, 2)"), &data)).unwrap();
                assert_eq!(v.samples().element_type(), element);
                assert!((0..8).all(|i| v.value(i) == i as f64), "{order}{kind}");
            }
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        let lattice = Lattice::aligned([2, 3, 4], DVec3::ZERO, DVec3::ONE).unwrap();
        let values = Samples::F32((0..24).map(|i| i as f32 / 7.0).collect());
        write(&path, &lattice, 1, (&values).into()).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().len() % 64, 24 * 4 % 64);
        let v = read(&path).unwrap();
        assert_eq!((v.lattice.clone(), v.samples()), (lattice.clone(), &values));
        assert!(write(&path, &lattice, 3, (&values).into()).is_err());
    }

    #[test]
    fn a_packed_array_is_the_same_array() {
        let bytes = npy(1, &dict("<u2", "False", "(2, 2, 2)"), &(0..16).collect::<Vec<u8>>());
        let packed = files::gz(&bytes);
        assert_eq!(open(&packed).unwrap().samples(), open(&bytes).unwrap().samples());
        assert!(open(&packed[..packed.len() - 8]).unwrap_err().to_string().contains("damaged"));
    }

    #[test]
    fn broken_files_are_refused() {
        let good = dict("<f4", "False", "(2, 2, 2)");
        let refused = |bytes: &[u8], words: &str| {
            let message = open(bytes).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("a.npy"), "{words}: {message}");
        };
        assert!(open(&npy(1, &good, &[0; 32])).is_ok());
        refused(&npy(1, &good, &[0; 31]), "32 bytes");
        refused(&npy(1, &good[..30], &[]), "fortran_order");
        refused(&npy(1, &dict("<f4", "False", "(2, 2, 2, 3)"), &[0; 96]), "component");
        refused(&npy(1, &dict("<f4", "False", "(2, 2)"), &[0; 16]), "flatland");
        refused(&npy(1, &dict("<f4", "False", "(2, 2, 1)"), &[0; 16]), "flatland");
        refused(&npy(1, &dict("<c8", "False", "(2, 2, 2)"), &[0; 64]), "<c8");
        refused(&npy(1, &dict("<f4", "False", "(90000, 90000, 2)"), &[0; 64]), "cannot hold");
        refused(&npy(1, &dict("<f4", "Maybe", "(2, 2, 2)"), &[0; 32]), "fortran_order");
        refused(&npy(1, &good.replace("'<f4'", "[('x', '<f4')]"), &[0; 32]), "records");
        refused(&npy(9, &good, &[0; 32]), "version 9");
        refused(b"NUMPY", "no .npy");
    }
}
