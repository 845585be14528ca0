//! NIfTI-1 volumes: `.nii` and `.nii.gz`, in one file.
//!
//! The world is RAS millimetres (or whatever unit the file uses), exactly as the file gives it: x to the right,
//! y to the front, z up. Nothing is flipped to the LPS of DICOM and NRRD.

use crate::error::{Error, Result};
use crate::files::{self, Section};
use crate::volume::{ElementType, Endian, Lattice, Samples, Space, Volume, each_sample_type};
use glam::{DMat3, DQuat, DVec3, Vec4};
use nifti::{Endianness, NiftiHeader, NiftiType};
use rayon::prelude::*;
use std::path::Path;

/// Bytes of the header.
const HEADER: usize = 348;

/// Least offset of the samples: the header and its 4 extension bytes.
const DATA: f32 = 352.0;

/// Reads a 3D scalar volume. Samples keep the file's type, except where the header scales them: then they are F64,
/// `scl_slope · sample + scl_inter`. The sform places the lattice, else the qform, else `pixdim` alone.
///
/// # Errors
/// `Io`; `Invalid` for a broken header, too few bytes (known before they are allocated) or a damaged gzip stream;
/// `NotSupported` for NIfTI-2, header/image pairs, colours, complex numbers and more than three dimensions.
pub fn read(path: &Path) -> Result<Volume> {
    let packing = files::gzip_or_plain(path, 0)?;
    let head = files::read_head(path, Section { start: 0, packing, skip: 0 }, HEADER as u64)?;
    if head.len() < HEADER {
        return Err(Error::invalid(path, format!("{} bytes, but a NIfTI-1 header has {HEADER}", head.len())));
    }
    if head[..4] == 540i32.to_le_bytes() || head[..4] == 540i32.to_be_bytes() {
        return Err(Error::not_supported(path, "NIfTI-2 is not read; convert it to NIfTI-1"));
    }
    if &head[344..348] == b"ni1\0" {
        return Err(Error::not_supported(
            path,
            "the samples are in a separate .img file (magic `ni1`); convert it to a single .nii",
        ));
    }
    let header = NiftiHeader::from_reader(&head[..])
        .map_err(|e| Error::invalid(path, format!("is not a NIfTI-1 file with the magic `n+1`: {e}")))?;

    let dims = dims(path, &header)?;
    let element = element(path, &header)?;
    // Some writers leave it 0.
    if header.bitpix != 0 && header.bitpix as usize != 8 * element.size() {
        return Err(Error::invalid(
            path,
            format!(
                "bitpix is {}, but samples of datatype {} have {} bits",
                header.bitpix,
                header.datatype,
                8 * element.size()
            ),
        ));
    }
    let lattice = Lattice::new(dims, origin(&header), axes(&header)).map_err(|e| e.in_file(path))?;
    let skip = match header.vox_offset {
        0.0 => DATA,
        v if v >= DATA && v.is_finite() => v,
        v => {
            return Err(Error::invalid(path, format!("vox_offset is {v}; the samples start at byte {DATA} or later")));
        }
    };
    let promised = element.bytes(lattice.len());
    let bytes = files::read_section(path, Section { start: 0, packing, skip: skip as u64 }, promised)?;
    let endian = match header.endianness {
        Endianness::Little => Endian::Little,
        Endianness::Big => Endian::Big,
    };
    let samples = scaled(path, Samples::from_vec(bytes, element, endian), header.scl_slope, header.scl_inter)?;
    let volume = Volume::new(path.display().to_string(), lattice, samples)?;
    Ok(Volume { space: Space::RightAnteriorSuperior, ..volume })
}

/// The three dimensions; further ones must be 1.
fn dims(path: &Path, header: &NiftiHeader) -> Result<[usize; 3]> {
    let dim = header.dim().map_err(|e| Error::invalid(path, format!("dim is {:?}: {e}", header.dim)))?;
    if let Some(&bad) = dim.iter().find(|&&n| n > i16::MAX as u16) {
        return Err(Error::invalid(path, format!("dim is {dim:?}: {} is negative", bad as i16)));
    }
    if dim.len() < 3 || dim[3..].iter().any(|&n| n != 1) {
        return Err(Error::not_supported(
            path,
            format!("dim is {dim:?}: only 3D scalar volumes are read; extract one volume first"),
        ));
    }
    Ok([dim[0] as usize, dim[1] as usize, dim[2] as usize])
}

/// The element type of a `datatype`.
fn element(path: &Path, header: &NiftiHeader) -> Result<ElementType> {
    Ok(match header.data_type() {
        Ok(NiftiType::Uint8) => ElementType::U8,
        Ok(NiftiType::Int8) => ElementType::I8,
        Ok(NiftiType::Uint16) => ElementType::U16,
        Ok(NiftiType::Int16) => ElementType::I16,
        Ok(NiftiType::Uint32) => ElementType::U32,
        Ok(NiftiType::Int32) => ElementType::I32,
        Ok(NiftiType::Uint64) => ElementType::U64,
        Ok(NiftiType::Int64) => ElementType::I64,
        Ok(NiftiType::Float32) => ElementType::F32,
        Ok(NiftiType::Float64) => ElementType::F64,
        Ok(other) => {
            return Err(Error::not_supported(
                path,
                format!("datatype {} ({other:?}): only integers and floats of up to 64 bits are read", header.datatype),
            ));
        }
        Err(_) => return Err(Error::invalid(path, format!("datatype {} is unknown", header.datatype))),
    })
}

/// Applies the header's scaling, unless it is absent (slope 0 or not a number) or the identity.
fn scaled(path: &Path, samples: Samples, slope: f32, inter: f32) -> Result<Samples> {
    if slope == 0.0 || !slope.is_finite() || (slope == 1.0 && inter == 0.0) {
        return Ok(samples);
    }
    if !inter.is_finite() {
        return Err(Error::invalid(
            path,
            format!("scl_inter is {inter} while scl_slope is {slope}; it must be finite"),
        ));
    }
    let (slope, inter) = (slope as f64, inter as f64);
    #[allow(clippy::unnecessary_cast, reason = "the macro's f64 arm casts to itself")]
    let values = each_sample_type!(&samples, v => v.par_iter().map(|&s| s as f64 * slope + inter).collect());
    Ok(Samples::F64(values))
}

/// Spacing from `pixdim`; files without it hold 0.
fn spacing(header: &NiftiHeader) -> DVec3 {
    let step = |a: usize| if header.pixdim[a] == 0.0 { 1.0 } else { header.pixdim[a].abs() as f64 };
    DVec3::new(step(1), step(2), step(3))
}

/// World steps per index.
fn axes(header: &NiftiHeader) -> DMat3 {
    if header.sform_code > 0 {
        let row = |r: [f32; 4]| Vec4::from_array(r).truncate().as_dvec3();
        DMat3::from_cols(row(header.srow_x), row(header.srow_y), row(header.srow_z)).transpose()
    } else if header.qform_code > 0 {
        let v = DVec3::new(header.quatern_b as f64, header.quatern_c as f64, header.quatern_d as f64);
        // A half turn has a = 0; rounding in the file may make |v| exceed 1 there.
        let q = DQuat::from_xyzw(v.x, v.y, v.z, (1.0 - v.length_squared()).max(0.0).sqrt()).normalize();
        let handedness = if header.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
        DMat3::from_quat(q) * DMat3::from_diagonal(spacing(header) * DVec3::new(1.0, 1.0, handedness))
    } else {
        DMat3::from_diagonal(spacing(header))
    }
}

/// World position of the first sample.
fn origin(header: &NiftiHeader) -> DVec3 {
    if header.sform_code > 0 {
        DVec3::new(header.srow_x[3] as f64, header.srow_y[3] as f64, header.srow_z[3] as f64)
    } else if header.qform_code > 0 {
        DVec3::new(header.quatern_x as f64, header.quatern_y as f64, header.quatern_z as f64)
    } else {
        DVec3::ZERO
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A header of 3×2×2 samples of the datatype, all placement codes 0, to be patched.
    fn header(datatype: i16, big: bool) -> Vec<u8> {
        let mut h = vec![0; 352];
        let i16s: &[(usize, i16)] = &[(40, 3), (42, 3), (44, 2), (46, 2), (48, 1), (70, datatype)];
        put(&mut h, 0, &348i32.to_le_bytes(), big);
        for &(at, v) in i16s {
            put(&mut h, at, &v.to_le_bytes(), big);
        }
        for (at, v) in [(76, 1.0f32), (80, 2.0), (84, 3.0), (88, 4.0), (108, 352.0)] {
            put(&mut h, at, &v.to_le_bytes(), big);
        }
        h[344..348].copy_from_slice(b"n+1\0");
        h
    }

    fn put(h: &mut [u8], at: usize, le: &[u8], big: bool) {
        let mut b = le.to_vec();
        if big {
            b.reverse();
        }
        h[at..at + b.len()].copy_from_slice(&b);
    }

    fn put_f32(h: &mut [u8], at: usize, values: &[f32]) {
        for (i, v) in values.iter().enumerate() {
            put(h, at + 4 * i, &v.to_le_bytes(), false);
        }
    }

    fn read_bytes(bytes: &[u8]) -> Result<Volume> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.nii");
        std::fs::write(&path, bytes).unwrap();
        read(&path)
    }

    #[test]
    fn every_type_in_both_byte_orders() {
        let codes: [(i16, ElementType); 10] = [
            (2, ElementType::U8),
            (256, ElementType::I8),
            (512, ElementType::U16),
            (4, ElementType::I16),
            (768, ElementType::U32),
            (8, ElementType::I32),
            (1280, ElementType::U64),
            (1024, ElementType::I64),
            (16, ElementType::F32),
            (64, ElementType::F64),
        ];
        for (code, element) in codes {
            for big in [false, true] {
                let mut file = header(code, big);
                for i in 0..12u8 {
                    let mut b = match element {
                        ElementType::F32 => (i as f32 + 0.5).to_le_bytes().to_vec(),
                        ElementType::F64 => (i as f64 + 0.5).to_le_bytes().to_vec(),
                        _ => [&[i], &[0; 7][..element.size() - 1]].concat(),
                    };
                    if big {
                        b.reverse();
                    }
                    file.extend(b);
                }
                let half = if matches!(element, ElementType::F32 | ElementType::F64) { 0.5 } else { 0.0 };
                for bytes in [file.clone(), files::gz(&file)] {
                    let v = read_bytes(&bytes).unwrap();
                    assert_eq!(v.samples().element_type(), element);
                    assert_eq!(v.lattice.dims(), [3, 2, 2]);
                    assert!((0..12).all(|i| v.value(i) == i as f64 + half), "{element:?} {big}");
                    assert_eq!(v.lattice.spacing(), DVec3::new(2.0, 3.0, 4.0));
                    assert_eq!(v.lattice.origin(), DVec3::ZERO);
                }
            }
        }
    }

    #[test]
    fn sform_before_qform_before_pixdim() {
        let mut h = header(2, false);
        h.extend(0..12);
        // qform: a quarter turn about z (x → y, y → −x), third axis flipped by qfac.
        put(&mut h, 252, &1i16.to_le_bytes(), false);
        put_f32(&mut h, 256, &[0.0, 0.0, 0.5f32.sqrt(), 10.0, 20.0, 30.0]);
        put_f32(&mut h, 76, &[-1.0]);
        let q = read_bytes(&h).unwrap().lattice;
        let at = q.to_world(DVec3::new(1.0, 1.0, 1.0));
        assert!((at - DVec3::new(10.0 - 3.0, 20.0 + 2.0, 30.0 - 4.0)).length() < 1e-6, "{at}");
        // sform: oblique, first axis flipped.
        put(&mut h, 254, &2i16.to_le_bytes(), false);
        put_f32(&mut h, 280, &[-2.0, 0.5, 0.0, 90.0, 0.0, 1.0, 0.25, -7.0, 0.0, 0.0, 3.0, 5.0]);
        let s = read_bytes(&h).unwrap().lattice;
        assert_eq!(s.to_world(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(89.0, -4.25, 14.0));
        assert_eq!(s.to_index(DVec3::new(89.0, -4.25, 14.0)), DVec3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn scaling_only_where_it_does_something() {
        let mut h = header(2, false);
        h.extend(0..12);
        for identity in [[1.0, 0.0], [0.0, 5.0], [f32::NAN, 0.0]] {
            put_f32(&mut h, 112, &identity);
            assert_eq!(read_bytes(&h).unwrap().samples(), &Samples::U8((0..12).collect()));
        }
        put_f32(&mut h, 112, &[0.5, -3.0]);
        let v = read_bytes(&h).unwrap();
        assert_eq!(v.samples().element_type(), ElementType::F64);
        assert_eq!((v.value(0), v.value(11)), (-3.0, 2.5));
        put_f32(&mut h, 112, &[0.5, f32::INFINITY]);
        assert!(matches!(read_bytes(&h), Err(Error::Invalid(_))));
    }

    #[test]
    fn short_and_lying_files_are_refused() {
        let mut h = header(4, false);
        h.extend([0; 24]);
        assert!(read_bytes(&h).is_ok());
        assert!(matches!(read_bytes(&h[..h.len() - 1]), Err(Error::Invalid(_))));
        assert!(matches!(read_bytes(&files::gz(&h[..h.len() - 1])), Err(Error::Invalid(_))));
        let packed = files::gz(&h);
        for cut in [4, 9, 20] {
            assert!(matches!(read_bytes(&packed[..packed.len() - cut]), Err(Error::Invalid(_))), "{cut}");
        }
        assert!(matches!(read_bytes(&h[..200]), Err(Error::Invalid(_))));
        // 10¹² voxels.
        for at in [42, 44, 46] {
            put(&mut h, at, &10_000i16.to_le_bytes(), false);
        }
        for bytes in [h.clone(), files::gz(&h)] {
            let message = read_bytes(&bytes).unwrap_err().to_string();
            assert!(message.contains("promises 2000000000000 bytes"), "{message}");
        }
    }

    #[test]
    fn what_is_not_read_says_so() {
        let with = |at: usize, le: &[u8]| {
            let mut h = header(2, false);
            h.extend(0..12);
            put(&mut h, at, le, false);
            read_bytes(&h)
        };
        assert!(with(40, &4i16.to_le_bytes()).is_ok(), "a fourth dimension of 1");
        let mut rgb = header(2, false);
        put(&mut rgb, 40, &4i16.to_le_bytes(), false);
        put(&mut rgb, 48, &3i16.to_le_bytes(), false);
        assert!(matches!(read_bytes(&rgb), Err(Error::NotSupported(_))));
        assert!(matches!(with(70, &128i16.to_le_bytes()), Err(Error::NotSupported(_))));
        assert!(matches!(with(70, &77i16.to_le_bytes()), Err(Error::Invalid(_))));
        assert!(matches!(with(0, &540i32.to_le_bytes()), Err(Error::NotSupported(_))));
        assert!(matches!(with(344, b"ni1\0"), Err(Error::NotSupported(_))));
        assert!(matches!(with(344, b"what"), Err(Error::Invalid(_))));
        assert!(matches!(with(42, &(-3i16).to_le_bytes()), Err(Error::Invalid(_))));
        assert!(matches!(with(108, &(-1f32).to_le_bytes()), Err(Error::Invalid(_))));
    }
}
