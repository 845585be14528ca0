//! Electron-microscopy maps in MRC2014 or CCP4 form (`.mrc`, `.map`, `.ccp4`, `.rec`, each also gzipped).
//! \[MRC2014\]
//!
//! World units are the file's, ångström. Columns, rows and sections stay the lattice's axes in memory order; `MAPC`,
//! `MAPR` and `MAPS` say along which crystal axes they run, so that the world's x, y and z are right for every storage
//! order.

use crate::error::{Error, Result};
use crate::files::{self, Packing, Section};
use crate::volume::{ElementType, Endian, Lattice, Samples, Volume};
use glam::{DMat3, DVec3};
use std::path::Path;

/// Bytes of the header proper, before the extended one.
const HEADER: usize = 1024;

/// Marks files of IMOD, whose 8-bit samples may be unsigned.
const IMOD_STAMP: i32 = 1_146_047_817;

/// Space groups from here on are those of one of several volumes, and MZ (word 10) is how many sections it has.
const VOLUME_STACK: i32 = 401;

/// The header's words, numbered from 1 as \[MRC2014\] does.
struct Header<'a> {
    path: &'a Path,
    bytes: [u8; HEADER],
    endian: Endian,
}

/// Reads a map. Modes 0 (8-bit), 1 (16-bit), 2 (float), 6 (unsigned 16-bit) and 12 (half, stored as float).
///
/// The first sample stands at `ORIGIN` (words 50–52); where that is 0, at the cell's grid point `NXSTART`, `NYSTART`,
/// `NZSTART`, as ChimeraX has it. A spacing of 1 is taken where the cell or its sampling is 0.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, too few bytes (known before they are allocated) or a damaged gzip stream;
/// `NotSupported` for complex and other modes, and for several volumes.
pub fn read(path: &Path) -> Result<Volume> {
    let packing = files::gzip_or_plain(path, 0)?;
    let header = Header::read(path, packing)?;
    let dims = [header.count(1)?, header.count(2)?, header.count(3)?];
    let (space_group, sections) = (header.int(23), header.int(10));
    if space_group >= VOLUME_STACK && sections > 0 && (sections as usize) < dims[2] {
        let (all, one) = (dims[2], sections);
        return Err(Error::not_supported(
            path,
            format!(
                "holds several volumes (ISPG, word 23, is {space_group}: {all} sections, {one} to a volume); save one of them"
            ),
        ));
    }
    let lattice = header.lattice(dims)?;
    let unsigned = header.int(39) == IMOD_STAMP && header.int(40) & 1 == 0;
    let (element, half) = match header.int(4) {
        0 if unsigned => (ElementType::U8, false),
        0 => (ElementType::I8, false),
        1 => (ElementType::I16, false),
        2 => (ElementType::F32, false),
        6 => (ElementType::U16, false),
        12 => (ElementType::U16, true),
        mode => {
            return Err(Error::not_supported(
                path,
                format!("MODE (word 4) is {mode}; 0, 1, 2, 6 and 12 are read: convert the map to 32-bit float"),
            ));
        }
    };
    let extended = u64::try_from(header.int(24))
        .map_err(|_| Error::invalid(path, format!("NSYMBT (word 24) is {}; it is a length", header.int(24))))?;
    let section = Section { start: 0, packing, skip: HEADER as u64 + extended };
    let promised = element.bytes(lattice.len());
    let samples = Samples::from_vec(files::read_section(path, section, promised)?, element, header.endian);
    let samples = match samples {
        Samples::U16(v) if half => Samples::from_halves(&v),
        samples => samples,
    };
    Volume::new(path.display().to_string(), lattice, samples)
}

impl<'a> Header<'a> {
    fn read(path: &'a Path, packing: Packing) -> Result<Self> {
        let head = files::read_head(path, Section { start: 0, packing, skip: 0 }, HEADER as u64)?;
        let found = head.len();
        let bytes: [u8; HEADER] = head.try_into().map_err(|_| {
            Error::invalid(path, format!("{HEADER} bytes of header promised, {found} found; it is no MRC map"))
        })?;
        let mut header = Self { path, bytes, endian: Endian::Little };
        // The machine stamp (word 54); writers that leave it out are told apart by MAPC, MAPR, MAPS, which are 1, 2, 3.
        header.endian = match header.bytes[212..214] {
            [0x44, 0x44 | 0x41] => Endian::Little,
            [0x11, 0x11] => Endian::Big,
            _ if header.axis_order().is_some() => Endian::Little,
            _ => Endian::Big,
        };
        if header.axis_order().is_none() {
            return Err(Error::invalid(
                path,
                format!(
                    "MAPC, MAPR, MAPS (words 17–19) are {}, {}, {}; they must be 1, 2 and 3 in some order, so it is no \
                     MRC map",
                    header.int(17),
                    header.int(18),
                    header.int(19)
                ),
            ));
        }
        Ok(header)
    }

    fn word(&self, n: usize) -> [u8; 4] {
        let at = 4 * (n - 1);
        *self.bytes[at..].first_chunk().expect("words lie within the header")
    }

    fn int(&self, n: usize) -> i32 {
        match self.endian {
            Endian::Little => i32::from_le_bytes(self.word(n)),
            Endian::Big => i32::from_be_bytes(self.word(n)),
        }
    }

    fn float(&self, n: usize) -> f64 {
        f64::from(match self.endian {
            Endian::Little => f32::from_le_bytes(self.word(n)),
            Endian::Big => f32::from_be_bytes(self.word(n)),
        })
    }

    fn floats(&self, first: usize) -> DVec3 {
        DVec3::new(self.float(first), self.float(first + 1), self.float(first + 2))
    }

    fn count(&self, n: usize) -> Result<usize> {
        usize::try_from(self.int(n)).map_err(|_| {
            let name = ["NX", "NY", "NZ"][n - 1];
            Error::invalid(self.path, format!("{name} (word {n}) is {}; it must be positive", self.int(n)))
        })
    }

    /// The crystal axes (0, 1, 2) of columns, rows and sections. Old writers leave all three 0.
    fn axis_order(&self) -> Option<[usize; 3]> {
        let order = [self.int(17), self.int(18), self.int(19)];
        if order == [0; 3] {
            return Some([0, 1, 2]);
        }
        let axes = order.map(|a| usize::try_from(a).ok()?.checked_sub(1));
        let axes = [axes[0]?, axes[1]?, axes[2]?];
        (0..3).all(|a| axes.contains(&a)).then_some(axes)
    }

    fn lattice(&self, dims: [usize; 3]) -> Result<Lattice> {
        let order = self.axis_order().expect("checked on reading");
        let (lengths, angles) = (self.floats(11), self.floats(14));
        // World steps of one sampling interval along each crystal axis.
        let mut steps = cell_axes(angles).unwrap_or(DMat3::IDENTITY);
        for axis in 0..3 {
            let (length, intervals) = (lengths[axis], f64::from(self.int(8 + axis)));
            let step = if length > 0.0 && intervals > 0.0 { length / intervals } else { 1.0 };
            *steps.col_mut(axis) *= step;
        }
        let mut start = DVec3::ZERO;
        for (column, axis) in order.into_iter().enumerate() {
            start[axis] = f64::from(self.int(5 + column));
        }
        let origin = self.floats(50);
        let origin = if origin == DVec3::ZERO || !origin.is_finite() { steps * start } else { origin };
        let axes = DMat3::from_cols(steps.col(order[0]), steps.col(order[1]), steps.col(order[2]));
        Lattice::new(dims, origin, axes).map_err(|e| e.in_file(self.path))
    }
}

/// Unit vectors of a cell's axes: a along x, b in the plane z = 0; angles α, β, γ in degrees. `None` if they make no
/// cell.
fn cell_axes(angles: DVec3) -> Option<DMat3> {
    if angles.to_array().iter().any(|a| !(*a > 0.0 && *a < 180.0)) {
        return None;
    }
    // Exactly 0 for the right angles of nearly every map.
    let cosine = angles.to_array().map(|a| if a == 90.0 { 0.0 } else { a.to_radians().cos() });
    let [alpha, beta, gamma] = cosine;
    let sine = (1.0 - gamma * gamma).sqrt();
    let y = (alpha - beta * gamma) / sine;
    let z = 1.0 - beta * beta - y * y;
    (z > 0.0).then(|| DMat3::from_cols(DVec3::X, DVec3::new(gamma, sine, 0.0), DVec3::new(beta, y, z.sqrt())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A header of 3×2×2 samples in the given mode, everything else as the words say.
    fn map(mode: i32, words: &[(usize, i32)], floats: &[(usize, f32)], big: bool) -> Vec<u8> {
        let mut bytes = vec![0; HEADER];
        let mut put = |n: usize, b: [u8; 4]| bytes[4 * (n - 1)..4 * n].copy_from_slice(&b);
        let int = |v: i32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        let float = |v: f32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
        for (n, v) in [(1, 3), (2, 2), (3, 2), (4, mode), (8, 3), (9, 2), (10, 2), (17, 1), (18, 2), (19, 3)] {
            put(n, int(v));
        }
        for (n, v) in [(11, 6.0), (12, 6.0), (13, 8.0), (14, 90.0), (15, 90.0), (16, 90.0)] {
            put(n, float(v));
        }
        put(53, *b"MAP ");
        put(54, if big { [0x11, 0x11, 0, 0] } else { [0x44, 0x44, 0, 0] });
        words.iter().for_each(|&(n, v)| put(n, int(v)));
        floats.iter().for_each(|&(n, v)| put(n, float(v)));
        bytes
    }

    fn open(bytes: &[u8]) -> Result<Volume> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mrc");
        std::fs::write(&path, bytes).unwrap();
        read(&path)
    }

    #[test]
    fn modes_in_both_byte_orders() {
        for big in [false, true] {
            let wide = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
            let real = |v: f32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
            let all = |f: &dyn Fn(u8) -> Vec<u8>| (0..12).flat_map(f).collect::<Vec<u8>>();
            for (mode, element, data) in [
                (0, ElementType::I8, all(&|i| vec![i.wrapping_neg()])),
                (1, ElementType::I16, all(&|i| wide(u16::from(i).wrapping_neg()).to_vec())),
                (2, ElementType::F32, all(&|i| real(-f32::from(i)).to_vec())),
                (6, ElementType::U16, all(&|i| wide(65_535 - u16::from(i)).to_vec())),
                (12, ElementType::F32, all(&|i| wide(half::f16::from_f32(-f32::from(i)).to_bits()).to_vec())),
            ] {
                let v = open(&[map(mode, &[(24, 5)], &[], big), vec![9; 5], data].concat()).unwrap();
                assert_eq!(v.samples().element_type(), element);
                let base = if mode == 6 { 65_535.0 } else { 0.0 };
                assert!((0..12).all(|i| v.value(i) == base - i as f64), "mode {mode}, big-endian {big}");
            }
            // Without a machine stamp.
            let bytes = map(0, &[(54, 0)], &[], big);
            assert_eq!(open(&[bytes, vec![1; 12]].concat()).unwrap().lattice.dims(), [3, 2, 2]);
        }
        let imod = open(&[map(0, &[(39, IMOD_STAMP), (40, 0)], &[], false), vec![200; 12]].concat()).unwrap();
        assert_eq!(imod.value(3), 200.0);
    }

    #[test]
    fn axes_are_crystal_axes() {
        // Columns along z, rows along x, sections along y: NX is the count of columns, MX of intervals along x.
        let words = [(17, 3), (18, 1), (19, 2), (5, 10), (6, 20), (7, 30), (8, 2), (9, 3), (10, 4)];
        let cell = [(11, 6.0), (12, 12.0), (13, 8.0)];
        let l = open(&[map(0, &words, &cell, true), vec![0; 12]].concat()).unwrap().lattice;
        assert_eq!(l.to_world(DVec3::ZERO), DVec3::new(60.0, 120.0, 20.0));
        assert_eq!(l.to_world(DVec3::new(1.0, 10.0, 100.0)), DVec3::new(90.0, 520.0, 22.0));
        // ORIGIN counts in world axes and stands above NSTART.
        let placed = [&cell[..], &[(50, 1.5), (52, -2.0)]].concat();
        let l = open(&[map(0, &words, &placed, true), vec![0; 12]].concat()).unwrap().lattice;
        assert_eq!(l.origin(), DVec3::new(1.5, 0.0, -2.0));
        // A monoclinic cell: β between x and z.
        let l = open(&[map(0, &[], &[(15, 120.0)], false), vec![0; 12]].concat()).unwrap().lattice;
        let c = l.to_world(DVec3::Z);
        assert!((c - DVec3::new(-2.0, 0.0, 12.0_f64.sqrt())).length() < 1e-12, "{c}");
        // No cell: one unit per sample.
        let l = open(&[map(0, &[(8, 0)], &[(12, 0.0), (14, 0.0)], false), vec![0; 12]].concat()).unwrap().lattice;
        assert_eq!(l.spacing(), DVec3::new(1.0, 1.0, 4.0));
    }

    #[test]
    fn broken_files_are_refused() {
        let refused = |bytes: &[u8], words: &str| {
            let message = open(bytes).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("a.mrc"), "{words}: {message}");
        };
        let whole = [map(2, &[], &[], false), vec![0; 48]].concat();
        assert!(open(&whole).is_ok());
        refused(&whole[..whole.len() - 1], "48 bytes");
        refused(&whole[..500], "500 found");
        refused(&[map(4, &[], &[], false), vec![0; 96]].concat(), "MODE");
        refused(&[map(0, &[(17, 2)], &[], false), vec![0; 12]].concat(), "MAPC");
        refused(&[map(0, &[(1, -3)], &[], false), vec![0; 12]].concat(), "NX");
        refused(&[map(0, &[(1, 100_000), (2, 100_000)], &[], false), vec![0; 12]].concat(), "cannot hold");
        refused(&[map(0, &[(24, -1)], &[], false), vec![0; 12]].concat(), "NSYMBT");
        refused(&[map(0, &[(3, 1)], &[], false), vec![0; 6]].concat(), "flatland");
        // Two volumes of a section each; not one of two.
        let stack = |sections: i32| [map(0, &[(23, 401), (10, sections)], &[], false), vec![0; 12]].concat();
        refused(&stack(1), "several volumes (ISPG, word 23, is 401: 2 sections, 1 to a volume)");
        assert!(open(&stack(2)).is_ok());
    }
}
