use super::*;
use base64::{Engine, engine::general_purpose::STANDARD};
use flate2::{Compression, write::ZlibEncoder};
use std::io::Write;

/// Written by VTK 9.7: extent 1..2 × 0..1 × 3..4, `h` = 0 … 7, field `note` = "hé", "xy", `t` = 2.5.
const VTK_INLINE: &str = r#"<?xml version="1.0"?>
<VTKFile type="ImageData" version="0.1" byte_order="LittleEndian" header_type="UInt32" compressor="vtkZLibDataCompressor">
  <ImageData WholeExtent="1 2 0 1 3 4" Origin="0 0 0" Spacing="1 1 1" Direction="1 0 0 0 1 0 0 0 1">
    <FieldData>
      <Array type="String" Name="note" NumberOfTuples="2" format="binary">
        AQAAAACAAAAHAAAADwAAAA==eJzLOLySoaKSAQANGALG
      </Array>
      <DataArray type="Float64" Name="t" NumberOfTuples="1" format="binary" RangeMin="2.5" RangeMax="2.5">
        AQAAAACAAAAIAAAADQAAAA==eJxjYAABFgcAAFAARQ==
      </DataArray>
    </FieldData>
  <Piece Extent="1 2 0 1 3 4">
    <PointData Scalars="h">
      <DataArray type="Float32" Name="h" format="binary" RangeMin="0" RangeMax="7">
        AQAAAACAAAAgAAAAHQAAAA==eJxjYACBBnsg4QBEQNwAxAuA+AAQP3AAADvHBUA=
      </DataArray>
    </PointData>
    <CellData>
    </CellData>
  </Piece>
  </ImageData>
</VTKFile>
"#;

/// A file of 2×2×2 samples, its arrays and its end to be given.
fn file(attributes: &str, arrays: &str, end: &[u8]) -> Vec<u8> {
    let head = format!(
        "<VTKFile type=\"ImageData\" {attributes}><ImageData WholeExtent=\"0 1 0 1 0 1\">\
         <Piece Extent=\"0 1 0 1 0 1\"><PointData>{arrays}</PointData></Piece></ImageData>"
    );
    [head.as_bytes(), end, b"</VTKFile>"].concat()
}

fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut e = ZlibEncoder::new(Vec::new(), Compression::fast());
    e.write_all(bytes).unwrap();
    e.finish().unwrap()
}

fn appended(encoding: &str, data: &[u8]) -> Vec<u8> {
    let tag = format!("<AppendedData encoding=\"{encoding}\">\n _");
    [tag.as_bytes(), data, b"\n</AppendedData>"].concat()
}

const ARRAY: &str = "<DataArray type=\"UInt16\" Name=\"h\" format=\"appended\" offset=\"0\"/>";

#[test]
fn reads_what_vtk_writes() {
    let expected = Samples::F32((0..8).map(|i| i as f32).collect());
    let start = VTK_INLINE.find("    <FieldData>").unwrap();
    let ascii = VTK_INLINE[..start].to_string()
        + r#"<FieldData>
      <Array type="String" Name="note" NumberOfTuples="2" format="ascii"> 104 -61 -87 0 120 121 0 </Array>
      <DataArray type="Float64" Name="t" NumberOfTuples="1" format="ascii"> 2.5 </DataArray>
    </FieldData>
    <Piece Extent="1 2 0 1 3 4"><PointData Scalars="h">
      <DataArray type="Float32" Name="h" format="ascii"> <!-- by hand --> 0 1 2 3 4 5
        6 7 </DataArray></PointData></Piece></ImageData></VTKFile>"#;
    let appended = VTK_INLINE[..start].to_string()
        + r#"<FieldData>
      <Array type="String" Name="note" NumberOfTuples="2" format="appended" offset="0"                   />
      <DataArray type="Float64" Name="t" NumberOfTuples="1" format="appended" offset="44"                  >
      </DataArray>
    </FieldData>
    <Piece Extent="1 2 0 1 3 4"                                          ><PointData Scalars="h">
      <DataArray type="Float32" Name="h" format="appended" RangeMin="0" offset="88" /></PointData></Piece>
  </ImageData>
  <AppendedData encoding="base64">
   _AQAAAACAAAAHAAAADwAAAA==eJzLOLySoaKSAQANGALGAQAAAACAAAAIAAAADQAAAA==eJxjYAABFgcAAFAARQ==AQAAAACAAAAgAAAAHQAAAA==eJxjYACBBnsg4QBEQNwAxAuA+AAQP3AAADvHBUA=
  </AppendedData>
</VTKFile>
"#;
    for text in [VTK_INLINE, &ascii, &appended] {
        let f = VtiFile::parse(text.as_bytes()).unwrap();
        assert_eq!(f.point_data, [VtiArray { name: "h".into(), components: 1, samples: expected.clone() }]);
        assert_eq!(f.field_strings, [("note".into(), "hé".into()), ("note".into(), "xy".into())]);
        assert_eq!(f.field_data[0].samples, Samples::F64(vec![2.5]));
        assert_eq!(f.active_scalars.as_deref(), Some("h"));
        assert_eq!(f.lattice.origin(), DVec3::new(1.0, 0.0, 3.0));
    }
}

#[test]
fn every_packing_and_byte_order() {
    let values: Vec<u16> = (0..8).map(|i| i * 1000 + 7).collect();
    for big in [false, true] {
        let raw: Vec<u8> = values.iter().flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect();
        for word in [4, 8] {
            let words = |numbers: &[usize]| -> Vec<u8> {
                let one = |&n: &usize| {
                    let bytes = (n as u64).to_be_bytes()[8 - word..].to_vec();
                    if big { bytes } else { bytes.into_iter().rev().collect() }
                };
                numbers.iter().flat_map(one).collect()
            };
            let order = if big { "BigEndian" } else { "LittleEndian" };
            let mut attributes = format!("byte_order=\"{order}\" header_type=\"UInt{}\"", word * 8);
            let inline = ARRAY.replace("appended\" offset=\"0\"/>", "binary\">");

            let stored = [words(&[16]), raw.clone()].concat();
            let text = STANDARD.encode(&stored);
            let mut files = vec![
                file(&attributes, ARRAY, &appended("raw", &stored)),
                file(&attributes, ARRAY, &appended("base64", text.as_bytes())),
                file(&attributes, &format!("{inline}{text}</DataArray>"), b""),
            ];
            attributes += " compressor=\"vtkZLibDataCompressor\"";
            // Blocks of 6 bytes leave a smaller last one of 4; blocks of 8 leave none.
            for (block, last) in [(6, 4), (8, 0)] {
                let blocks: Vec<Vec<u8>> = raw.chunks(block).map(zlib).collect();
                let mut numbers = vec![blocks.len(), block, last];
                numbers.extend(blocks.iter().map(Vec::len));
                let (head, body) = (words(&numbers), blocks.concat());
                let text = STANDARD.encode(&head) + &STANDARD.encode(&body);
                files.push(file(&attributes, ARRAY, &appended("raw", &[head, body].concat())));
                files.push(file(&attributes, ARRAY, &appended("base64", text.as_bytes())));
                files.push(file(&attributes, &format!("{inline}{text}</DataArray>"), b""));
            }
            for (i, f) in files.iter().enumerate() {
                let read = VtiFile::parse(f).unwrap_or_else(|e| panic!("{order} {word} {i}: {e}"));
                assert_eq!(read.point_data[0].samples, Samples::U16(values.clone()), "{order} {word} {i}");
            }
        }
    }
}

#[test]
fn oblique_flipped_and_shifted_lattices() {
    let text = "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"-1 1 2 3 0 1\" Origin=\"10 20 30\" \
                Spacing=\"2 3 4\" Direction=\"0 -1 0 1 0 0 0 0.5 -1\"><Piece Extent=\"-1 1 2 3 0 1\">\
                </Piece></ImageData></VTKFile>";
    let l = VtiFile::parse(text.as_bytes()).unwrap().lattice;
    assert_eq!(l.dims(), [3, 2, 2]);
    // Row-major: axis 0 is (0,1,0)·2, axis 1 (−1,0,.5)·3, axis 2 (0,0,−1)·4.
    assert_eq!(l.axes().x_axis, DVec3::new(0.0, 2.0, 0.0));
    assert_eq!(l.axes().y_axis, DVec3::new(-3.0, 0.0, 1.5));
    assert_eq!(l.axes().z_axis, DVec3::new(0.0, 0.0, -4.0));
    assert_eq!(l.origin(), DVec3::new(10.0 - 6.0, 20.0 - 2.0, 30.0 + 3.0));
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vti");
    // Three blocks and a bit of f32 RGB, so that blocks and their order matter.
    let dims = [83, 61, 59];
    let axes = DMat3::from_cols_array(&[-0.1, 0.2, 0.0, 0.0, 1.0 / 3.0, 0.0, 0.0, 0.5, 7.0]);
    let lattice = Lattice::new(dims, DVec3::new(1e6, -0.1, 1e-9), axes).unwrap();
    let rgb: Vec<f32> = (0..lattice.len() * 3).map(|i| (i as f32 * 0.37).sin()).collect();
    let mask: Vec<u8> = (0..lattice.len()).map(|i| (i % 251) as u8).collect();
    let writer = VtiWriter::new(&lattice)
        .point_data("a \"<&>\" b", 3, &rgb[..])
        .point_data("mask", 1, &mask[..])
        .active_scalars("mask")
        .field_data("range", 2, &[0.1f64, 0.9][..])
        .field_string("note", "h³ → ∞")
        .field_string("empty", "");
    writer.write(&path).unwrap();
    let f = VtiFile::read(&path).unwrap();
    assert_eq!(
        f.point_data[0],
        VtiArray { name: "a \"<&>\" b".into(), components: 3, samples: Samples::F32(rgb.clone()) }
    );
    assert_eq!(f.point_data[1].samples, Samples::U8(mask.clone()));
    assert_eq!(
        f.field_data[0],
        VtiArray { name: "range".into(), components: 2, samples: Samples::F64(vec![0.1, 0.9]) }
    );
    assert_eq!(f.field_strings, [("note".into(), "h³ → ∞".into()), ("empty".into(), String::new())]);
    assert_eq!(f.active_scalars.as_deref(), Some("mask"));
    assert_eq!((f.lattice.dims(), f.lattice.origin()), (dims, lattice.origin()));
    assert!(f.lattice.axes().abs_diff_eq(axes, 1e-14));
    let first = std::fs::read(&path).unwrap();
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| writer.write(&path)).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), first);

    assert!(VtiWriter::new(&lattice).point_data("a", 1, &[1.0f32][..]).write(&path).is_err());
    assert!(VtiWriter::new(&lattice).active_scalars("a").write(&path).is_err());
    assert!(VtiWriter::new(&lattice).field_data("a", 2, &[1u8][..]).write(&path).is_err());
    assert!(VtiWriter::new(&lattice).field_data("a", 1, &[] as &[u64]).write(&path).is_err());
    assert!(VtiWriter::new(&lattice).field_string("a", "x\0y").write(&path).is_err());
    assert_eq!(std::fs::read(&path).unwrap(), first);
}

#[test]
fn the_scalars_are_chosen_by_rule() {
    let array = |name: &str, components, value| VtiArray {
        name: name.into(),
        components,
        samples: Samples::U8(vec![value; 8 * components]),
    };
    let choose = |active: Option<&str>, point_data: Vec<VtiArray>| {
        let lattice = Lattice::aligned([2; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let active_scalars = active.map(str::to_string);
        let file = VtiFile { lattice, point_data, field_data: vec![], field_strings: vec![], active_scalars };
        file.into_scalars(None).map(|(_, s)| s.get(0))
    };
    let all = || vec![array("rgb", 3, 1), array("a", 1, 2), array("value", 1, 3)];
    assert_eq!(choose(Some("a"), all()).unwrap(), 2.0);
    assert_eq!(choose(None, all()).unwrap(), 3.0);
    assert_eq!(choose(Some("rgb"), all()[..2].to_vec()).unwrap(), 2.0);
    let message = choose(None, vec![array("a", 1, 1), array("b", 1, 1)]).unwrap_err().to_string();
    assert!(message.contains("`a` (1 components), `b` (1 components)"), "{message}");
    assert!(choose(None, vec![array("rgb", 3, 1)]).is_err());
}

#[test]
fn short_and_lying_files_are_refused() {
    let attributes = "header_type=\"UInt64\" compressor=\"vtkZLibDataCompressor\"";
    let block = zlib(&[5; 16]);
    let packed = |numbers: &[u64], body: &[u8]| {
        let head: Vec<u8> = numbers.iter().flat_map(|n| n.to_le_bytes()).collect();
        VtiFile::parse(&file(attributes, ARRAY, &appended("raw", &[&head[..], body].concat())))
    };
    let n = block.len() as u64;
    assert!(packed(&[1, 16, 0, n], &block).is_ok());
    for (numbers, body) in [
        (&[1, 16, 0, n - 1][..], &block[..]),               // the block cut
        (&[1, 16, 0, n + 100], &block),                     // more than the file
        (&[1, 15, 0, n], &block),                           // not what the extent promises
        (&[2, 8, 0, n, n], &[&block[..], &block].concat()), // blocks that hold more than promised
        (&[1, 16, 0, n], &[0; 30]),                         // no zlib
        (&[1 << 40, 16, 0, n], &block),
        (&[u64::MAX, u64::MAX, 0, n], &block),
        (&[1, 16, 0, u64::MAX - 7], &block),
        (&[0], &block),
    ] {
        assert!(matches!(packed(numbers, body), Err(Error::Invalid(_))), "{numbers:?}");
    }
    let huge = String::from_utf8(file(attributes, ARRAY, b"")).unwrap().replace("0 1 0 1 0 1", "0 9999 0 9999 0 9999");
    assert!(matches!(VtiFile::parse(huge.as_bytes()), Err(Error::Invalid(_))));

    // Cut anywhere up to the end of the last array, none of these may pass or panic.
    let raw = file("", ARRAY, &appended("raw", &[&16u32.to_le_bytes()[..], &[7; 16]].concat()));
    let end = raw.len() - "\n</AppendedData></VTKFile>".len();
    for whole in [&raw[..end], &VTK_INLINE.as_bytes()[..VTK_INLINE.len() - "</VTKFile>\n".len()]] {
        for cut in 0..whole.len() {
            assert!(VtiFile::parse(&whole[..cut]).is_err(), "{cut} of {}", whole.len());
        }
    }
    assert!(VtiFile::parse(&raw[..end]).is_ok(), "all samples are there");
}

/// However many arrays there are, a volume is one of them.
#[test]
fn only_the_scalars_are_unpacked() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vti");
    let array = |name: &str, offset: usize| {
        ARRAY.replace("\"h\"", &format!("\"{name}\"")).replace("\"0\"", &format!("\"{offset}\""))
    };
    let read = |arrays: &str, name: Option<&str>| {
        let data = appended("raw", &[&16u32.to_le_bytes()[..], &[7; 16]].concat());
        std::fs::write(&path, file("", arrays, &data)).unwrap();
        VtiFile::read_scalars(&path, name).and_then(|file| file.into_scalars(name)).map(|(_, samples)| samples.get(0))
    };
    let bits = "<DataArray type=\"Bit\" Name=\"bits\" format=\"ascii\">1 0</DataArray>";
    let arrays = array("value", 0) + &array("damaged", 900) + bits;
    assert_eq!(read(&arrays, None).unwrap(), f64::from(0x0707));
    assert_eq!(read(&arrays, Some("value")).unwrap(), f64::from(0x0707));
    assert!(read(&arrays, Some("damaged")).unwrap_err().to_string().contains("offset \"900\""));
    assert!(matches!(read(&arrays, Some("bits")), Err(Error::NotSupported(_))));
    assert!(matches!(read(&bits.repeat(2), None), Err(Error::NotSupported(_))));
    assert!(read(&(array("a", 0) + &array("b", 0)), None).unwrap_err().to_string().contains("cannot tell"));
    assert!(VtiFile::read(&path).is_ok());
}

/// Arrays of the same bytes would take a thousand times as much memory as their file.
#[test]
fn arrays_that_share_their_bytes_are_refused() {
    let data = appended("raw", &[&4096u32.to_le_bytes()[..], &[7; 4096]].concat());
    let array = "<DataArray type=\"Float64\" Name=\"a\" NumberOfComponents=\"64\" format=\"appended\" offset=\"0\"/>";
    assert!(VtiFile::parse(&file("", array, &data)).is_ok());
    let message = VtiFile::parse(&file("", &array.repeat(2), &data)).unwrap_err().to_string();
    assert!(message.contains("arrays that share theirs"), "{message}");
}

#[test]
fn what_is_not_read_says_so() {
    let change = |from: &str, to: &str| VtiFile::parse(VTK_INLINE.replace(from, to).as_bytes());
    assert!(matches!(change("type=\"ImageData\"", "type=\"PolyData\""), Err(Error::NotSupported(_))));
    assert!(matches!(change("vtkZLib", "vtkLZMA"), Err(Error::NotSupported(_))));
    assert!(matches!(change("\"Float32\"", "\"Bit\""), Err(Error::NotSupported(_))));
    // Beside what is read, and not the one that is meant, it may be there.
    let flags = "<DataArray type=\"Bit\" Name=\"flags\" format=\"ascii\">1 0</DataArray>";
    let both = |meant: &str| change("</PointData>", &format!("{flags}</PointData>")).map(|f| (f, meant.len()));
    assert_eq!(both("").unwrap().0.point_data.len(), 1);
    let meant = VTK_INLINE.replace("</PointData>", &format!("{flags}</PointData>"));
    let at = meant.find("<PointData").unwrap() + "<PointData".len();
    let end = at + meant[at..].find('>').unwrap();
    let meant = format!("{} Scalars=\"flags\"{}", &meant[..at], &meant[end..]);
    assert!(matches!(VtiFile::parse(meant.as_bytes()), Err(Error::NotSupported(_))));
    assert!(matches!(change("</Piece>", "</Piece><Piece/>"), Err(Error::NotSupported(_))));
    assert!(matches!(change("WholeExtent=\"1 2", "WholeExtent=\"0 2"), Err(Error::NotSupported(_))));
    assert!(matches!(change("header_type=\"UInt32\"", "header_type=\"UInt8\""), Err(Error::Invalid(_))));
    assert!(matches!(change("Spacing=\"1 1 1\"", "Spacing=\"1 1\""), Err(Error::Invalid(_))));
    assert!(matches!(change("Spacing=\"1 1 1\"", "Spacing=\"1 1 0\""), Err(Error::Invalid(_))));
    assert!(matches!(change("1 2 0 1 3 4", "2 1 0 1 3 4"), Err(Error::Invalid(_))));
}
