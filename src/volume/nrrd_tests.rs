use super::*;

/// Reads a hand-made file, with others beside it.
fn read_with(file: &[u8], others: &[(&str, &[u8])]) -> Result<Volume> {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in others {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    let path = folder.path().join("a.nrrd");
    std::fs::write(&path, file).unwrap();
    read(&path)
}

fn read_one(header: &str, data: &[u8]) -> Result<Volume> {
    read_with(&[header.as_bytes(), data].concat(), &[])
}

const U8: &str = "type: uchar\ndimension: 3\nsizes: 3 2 2\n";
const TWELVE: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];

#[test]
fn encodings_hold_the_same_samples() {
    let expected = Samples::U8(TWELVE.to_vec());
    for version in 1..=5 {
        let raw = read_one(&format!("NRRD000{version}\r\n{U8}# note: x\nkey:=value\nencoding: raw\n\n"), &TWELVE);
        assert_eq!(raw.unwrap().samples(), &expected);
    }
    let gzip = read_one(&format!("NRRD0004\n{U8}encoding: gzip\n\n"), &files::gz(&TWELVE)).unwrap();
    assert_eq!(gzip.samples(), &expected);
    assert_eq!(gzip.lattice.dims(), [3, 2, 2]);
    assert_eq!(gzip.lattice.axes(), DMat3::IDENTITY);
    let text = read_one(&format!("NRRD0004\n{U8}encoding: ascii\n\n"), b"0 1 2 3 4 5\n6 7 8 9 10 11\n").unwrap();
    assert_eq!(text.samples(), &expected);
}

#[test]
fn types_and_byte_orders() {
    for (names, element) in [
        ("int8", ElementType::I8),
        ("unsigned short", ElementType::U16),
        ("short", ElementType::I16),
        ("uint", ElementType::U32),
        ("int32_t", ElementType::I32),
        ("ulonglong", ElementType::U64),
        ("long long int", ElementType::I64),
        ("float", ElementType::F32),
        ("double", ElementType::F64),
    ] {
        for endian in ["little", "big"] {
            let data: Vec<u8> = (0..12u8)
                .flat_map(|i| {
                    let mut b = match element {
                        ElementType::F32 => (i as f32).to_le_bytes().to_vec(),
                        ElementType::F64 => (i as f64).to_le_bytes().to_vec(),
                        _ => [&[i], &[0; 7][..element.size() - 1]].concat(),
                    };
                    if endian == "big" {
                        b.reverse();
                    }
                    b
                })
                .collect();
            let header =
                format!("NRRD0004\ntype: {names}\ndimension: 3\nsizes: 3 2 2\nendian: {endian}\nencoding: raw\n\n");
            let v = read_one(&header, &data).unwrap();
            assert_eq!(v.samples().element_type(), element);
            assert!((0..12).all(|i| v.value(i) == i as f64), "{names} {endian}");
        }
    }
    let no_endian = "NRRD0004\ntype: short\ndimension: 3\nsizes: 3 2 2\nencoding: raw\n\n";
    assert!(read_one(no_endian, &[0; 24]).unwrap_err().to_string().contains("endian"));
}

#[test]
fn detached_files_and_skips() {
    let expected = Samples::U8(TWELVE.to_vec());
    let behind = [b"one\ntwo\nxyz", &TWELVE[..]].concat();
    let header = |extra: &str| format!("NRRD0004\n{U8}data file: ./d.raw\n{extra}");
    let get = |extra: &str, data: &[u8]| read_with(header(extra).as_bytes(), &[("d.raw", data)]);
    assert_eq!(get("encoding: raw\nline skip: 2\nbyte skip: 3\n", &behind).unwrap().samples(), &expected);
    assert_eq!(get("encoding: raw\nbyteskip: -1", &behind).unwrap().samples(), &expected);
    let packed = [b"one\n", &files::gz(&[&[9, 9], &TWELVE[..]].concat())[..]].concat();
    assert_eq!(get("encoding: gz\nline skip: 1\nbyte skip: 2\n", &packed).unwrap().samples(), &expected);
    assert_eq!(get("encoding: text\nline skip: 1\n", b"head\n0 1 2 3 4 5 6 7 8 9 10 11").unwrap().samples(), &expected);
    assert!(matches!(get("encoding: raw\nline skip: 9\n", &behind), Err(Error::Invalid(_))));
    assert!(matches!(get("encoding: raw\nbyte skip: 12\n", &behind), Err(Error::Invalid(_))));
    assert!(matches!(get("encoding: gzip\nbyte skip: -1\n", &packed), Err(Error::Invalid(_))));
    let missing = read_with(header("encoding: raw\n").as_bytes(), &[]).unwrap_err();
    assert!(matches!(&missing, Error::Io { path, .. } if path.ends_with("d.raw")), "{missing}");
    let list = format!("NRRD0004\n{U8}encoding: raw\ndata file: LIST\na.raw\nb.raw\n");
    let message = read_one(&list, &TWELVE).unwrap_err().to_string();
    assert!(message.contains("`LIST`: samples split over several files are not read"), "{message}");
}

#[test]
fn the_world_is_the_files_own() {
    let raw = "encoding: raw\n\n";
    let oblique = format!(
        "NRRD0004\n{U8}space: left-posterior-superior\nspace directions: (-2,0.5,0) (0, 1, 0.25) (0,0,3)\n\
         space origin: (90,-7,5)\n{raw}"
    );
    let l = read_one(&oblique, &TWELVE).unwrap().lattice;
    assert_eq!(l.to_world(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(88.0, -4.5, 14.5));

    // What is known of an axis is an end, and the step.
    let ends = |centers: &str| {
        let text = format!("NRRD0004\n{U8}spacings: 0.5 2 3\naxis maxs: 1 NaN 5\ncenterings: {centers}\n{raw}");
        read_one(&text, &TWELVE).unwrap().lattice.origin()
    };
    assert_eq!(ends("node node node"), DVec3::new(0.0, 0.0, 2.0));
    assert_eq!(ends("Cell cell CELL"), DVec3::new(-0.25, 0.0, 0.5));

    let spaced = format!("NRRD0001\n{U8}spacings: 0.5 2 NaN\naxis mins: -1 10 NaN\n{raw}");
    let l = read_one(&spaced, &TWELVE).unwrap().lattice;
    assert_eq!((l.origin(), l.spacing()), (DVec3::new(-0.75, 11.0, 0.0), DVec3::new(0.5, 2.0, 1.0)));
    // As pynrrd writes what it is given.
    let stands = format!("NRRD0004\n{U8}space: LPS\nspacings: 1 1 2\nspace origin: (10,20,30)\n{raw}");
    let l = read_one(&stands, &TWELVE).unwrap().lattice;
    assert_eq!((l.origin(), l.spacing()), (DVec3::new(10.0, 20.0, 30.0), DVec3::new(1.0, 1.0, 2.0)));
    let twice = read_one(&format!("NRRD0004\n{U8}sizes: 2 3 2\n{raw}"), &TWELVE).unwrap_err().to_string();
    assert!(twice.contains("line 5: field `sizes` is there twice"), "{twice}");

    let ends = format!("NRRD0001\n{U8}axis mins: 0 0 0\naxis maxs: 3 3 3\ncenterings: cell node node\n{raw}");
    let l = read_one(&ends, &TWELVE).unwrap().lattice;
    assert_eq!((l.origin(), l.spacing()), (DVec3::new(0.5, 0.0, 0.0), DVec3::new(1.0, 3.0, 3.0)));

    let flat = format!("NRRD0004\n{U8}space directions: (1,0,0) (2,0,0) (0,0,1)\n{raw}");
    assert!(read_one(&flat, &TWELVE).unwrap_err().to_string().contains("linearly independent"));
    let none = format!("NRRD0004\n{U8}space directions: none (2,0,0) (0,0,1)\n{raw}");
    assert!(matches!(read_one(&none, &TWELVE), Err(Error::Invalid(_))));
}

#[test]
fn only_a_vector_of_one_is_a_scalar() {
    let header = |sizes: &str, n: usize| {
        format!(
            "NRRD0004\ntype: uchar\ndimension: {n}\nsizes: {sizes}\nkinds: vector domain domain domain\n\
             space directions: none (2,0,0) (0,3,0) (0,0,4)\nencoding: raw\n\n"
        )
    };
    let v = read_one(&header("1 3 2 2", 4), &TWELVE).unwrap();
    assert_eq!((v.lattice.dims(), v.lattice.spacing()), ([3, 2, 2], DVec3::new(2.0, 3.0, 4.0)));
    assert!(matches!(read_one(&header("3 2 2 2", 4), &[0; 24]), Err(Error::NotSupported(_))));
    assert!(matches!(read_one(&header("6 2", 2), &TWELVE), Err(Error::NotSupported(_))));
    assert!(matches!(read_one(&header("3 2", 4), &TWELVE), Err(Error::Invalid(_))));
    assert!(matches!(read_one(&header("3 2 -2 1", 4), &TWELVE), Err(Error::Invalid(_))));
}

#[test]
fn an_axis_of_vectors_is_none_of_space() {
    let pictures = |sizes: &str, kinds: &str, more: &str| {
        let n = sizes.split(' ').count();
        format!("NRRD0004\ntype: uchar\ndimension: {n}\nsizes: {sizes}\nkinds: {kinds}\n{more}encoding: raw\n\n")
    };
    let refused = |sizes: &str, kinds: &str, more: &str, words: [&str; 2]| {
        let error = read_one(&pictures(sizes, kinds, more), &[0; 48]).unwrap_err();
        let message = error.to_string();
        assert!(matches!(error, Error::NotSupported(_)), "{sizes} {kinds} {more}: {message}");
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    };
    for more in [
        "",
        "space dimension: 2\nspace directions: none (1,0) (0,1)\n",
        "space: RAS\nspace directions: none (1,0,0) (0,1,0)\n",
        "space: RAS\nspace directions: (0,0,1) (1,0,0) (0,1,0)\n",
    ] {
        refused("3 4 2", "RGB-color domain domain", more, ["axis 0", "RGB-color"]);
    }
    refused("4 2 3", "space space rgb-COLOR", "", ["axis 2", "rgb-COLOR"]);
    refused("2 4 2", "list space space", "", ["axis 0", "list"]);
    refused("3 4 2 1", "vector domain domain domain", "", ["axis 0", "vector"]);
    for (sizes, kinds) in [
        ("3 2 2", "domain space time"),
        ("3 2 2", "??? none domain"),
        ("3 2 2", "domain"),
        ("3 2 2 1", "domain domain domain stub"),
        ("1 3 2 2", "vector domain domain domain"),
    ] {
        let v = read_one(&pictures(sizes, kinds, ""), &TWELVE).unwrap();
        assert_eq!((v.lattice.dims(), v.samples()), ([3, 2, 2], &Samples::U8(TWELVE.to_vec())), "{sizes} {kinds}");
    }
    // As flat fields likewise.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    let plane = |sizes: &str, kinds: &str| {
        std::fs::write(&path, [pictures(sizes, kinds, "").as_bytes(), &[0; 48]].concat()).unwrap();
        read_plane(&path)
    };
    assert_eq!(plane("1 3 4", "scalar domain domain").unwrap().unwrap().dims, [3, 4]);
    assert!(matches!(plane("2 4", "complex domain"), Err(Error::NotSupported(_))));
    assert!(matches!(plane("3 4 2", "RGB-color domain domain"), Err(Error::NotSupported(_))));
}

#[test]
fn short_lying_and_unknown_files_are_refused() {
    let raw = format!("NRRD0004\n{U8}encoding: raw\n\n");
    assert!(matches!(read_one(&raw, &TWELVE[..11]), Err(Error::Invalid(_))));
    let packed = files::gz(&TWELVE);
    let gzip = format!("NRRD0004\n{U8}encoding: gzip\n\n");
    for cut in 1..packed.len() {
        assert!(matches!(read_one(&gzip, &packed[..packed.len() - cut]), Err(Error::Invalid(_))), "{cut}");
    }
    for encoding in ["raw", "gzip", "ascii"] {
        let lie = format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 10000 10000 10000\nencoding: {encoding}\n\n");
        let message = read_one(&lie, &packed).unwrap_err().to_string();
        assert!(message.contains("cannot hold"), "{message}");
    }
    assert!(matches!(read_one("NOTRRD\n", &[]), Err(Error::Invalid(_))));
    assert!(matches!(read_one("NRRD0009\n\n", &[]), Err(Error::NotSupported(_))));
    assert!(matches!(read_one("NRRD0004\ngarbage\n\n", &[]), Err(Error::Invalid(_))));
    assert!(matches!(read_one(&raw.replace("raw", "bzip2"), &TWELVE), Err(Error::NotSupported(_))));
    assert!(matches!(read_one(&raw.replace("uchar", "block"), &TWELVE), Err(Error::NotSupported(_))));
    assert!(read_one(&raw.replace("sizes", "size"), &TWELVE).unwrap_err().to_string().contains("`sizes`"));
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    let axes = DMat3::from_cols_array(&[-0.1, 0.2, 0.0, 0.0, 1.0 / 3.0, 0.0, 0.0, 0.5, 7.0]);
    let lattice = Lattice::new([3, 2, 2], DVec3::new(1e6, -0.1, 1e-9), axes).unwrap();
    let samples = Samples::F32((0..12).map(|i| i as f32 / 7.0).collect());
    let mut volume = Volume::new(path.display().to_string(), lattice, samples).unwrap();
    for space in [Space::RightAnteriorSuperior, Space::Unnamed] {
        volume.space = space;
        write(&path, &volume.lattice, space, 1, volume.samples().into(), &[("note", "a\\b\nc")]).unwrap();
        assert_eq!(read(&path).unwrap(), volume);
    }
    let other = read_one(&format!("NRRD0004\n{U8}space: 3D-right-handed\nencoding: raw\n\n"), &TWELVE).unwrap();
    assert_eq!(other.space, Space::Unnamed);
}
