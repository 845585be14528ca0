use super::*;
use std::io::Write;
use tiff::encoder::colortype::{self, ColorType as Colour};
use tiff::encoder::{Rational, TiffEncoder, TiffValue};

/// Pages of 3×2 samples that count up.
fn stack<C: Colour>(pages: usize, description: &str, sample: impl Fn(usize) -> C::Inner) -> Vec<u8>
where
    [C::Inner]: TiffValue,
{
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
    for page in 0..pages {
        let mut image = encoder.new_image::<C>(3, 2).unwrap();
        if page == 0 && !description.is_empty() {
            image.encoder().write_tag(Tag::ImageDescription, description).unwrap();
            image.x_resolution(Rational { n: 4, d: 1 });
            image.y_resolution(Rational { n: 5, d: 2 });
        }
        let data: Vec<C::Inner> = (0..6).map(|i| sample(6 * page + i)).collect();
        image.write_data(&data).unwrap();
    }
    bytes.into_inner()
}

fn open(bytes: &[u8]) -> Result<Volume> {
    decode(Cursor::new(bytes), Path::new("a.tif"))
}

fn zip(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut w = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        w.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        w.write_all(bytes).unwrap();
    }
    w.finish().unwrap().into_inner()
}

/// Shown inverted or not, samples are what the file holds.
#[test]
fn white_as_zero_changes_no_sample() {
    // Entry 262 of a directory: one 16-bit number.
    let entry = |value: u8| [6, 1, 3, 0, 1, 0, 0, 0, value, 0, 0, 0];
    let inverted = |mut bytes: Vec<u8>| {
        let at = |bytes: &[u8]| bytes.windows(12).position(|w| w == entry(1));
        let mut pages = 0;
        while let Some(at) = at(&bytes) {
            bytes[at..at + 12].copy_from_slice(&entry(0));
            pages += 1;
        }
        assert_eq!(pages, 2);
        bytes
    };
    let sample = |i: usize| (10 * i) as u8;
    for bytes in [
        stack::<colortype::Gray8>(2, "", sample),
        stack::<colortype::Gray16>(2, "", |i| u16::from(sample(i))),
        stack::<colortype::Gray32>(2, "", |i| u32::from(sample(i))),
    ] {
        let v = open(&inverted(bytes)).unwrap();
        assert!((0..12).all(|i| v.value(i) == f64::from(sample(i))), "{:?}", v.samples().element_type());
    }
    let floats = inverted(stack::<colortype::Gray32Float>(2, "", |i| i as f32));
    assert!(open(&floats).unwrap_err().to_string().contains("a.tif: page 0 shows 0 as white"));
}

#[test]
fn pages_are_slices_of_every_type() {
    let check = |bytes: Vec<u8>, element: ElementType| {
        let v = open(&bytes).unwrap();
        assert_eq!((v.lattice.dims(), v.samples().element_type()), ([3, 2, 2], element));
        assert!((0..12).all(|i| v.value(i) == 10.0 * i as f64), "{element:?}");
        assert_eq!(v.lattice.spacing(), DVec3::ONE);
        for cut in [1, bytes.len() / 2, bytes.len() - 9] {
            assert!(open(&bytes[..bytes.len() - cut]).is_err(), "{element:?} without its last {cut} bytes");
        }
    };
    check(stack::<colortype::Gray8>(2, "", |i| 10 * i as u8), ElementType::U8);
    check(stack::<colortype::Gray16>(2, "", |i| 10 * i as u16), ElementType::U16);
    check(stack::<colortype::Gray32>(2, "", |i| 10 * i as u32), ElementType::U32);
    check(stack::<colortype::GrayI16>(2, "", |i| 10 * i as i16), ElementType::I16);
    check(stack::<colortype::Gray32Float>(2, "", |i| 10.0 * i as f32), ElementType::F32);
    check(stack::<colortype::Gray64Float>(2, "", |i| 10.0 * i as f64), ElementType::F64);
}

#[test]
fn imagej_and_ome_say_where() {
    let gray = |pages, text: &str| stack::<colortype::Gray8>(pages, text, |i| i as u8);
    let v = open(&gray(2, "ImageJ=1.53f\nimages=2\nslices=2\nunit=micron\nspacing=1.5\n")).unwrap();
    assert_eq!(v.lattice.spacing(), DVec3::new(0.25, 0.4, 1.5));
    let ome = "<?xml version='1.0'?><OME xmlns='o'><Image><Pixels SizeC='1' SizeT='1' SizeZ='2' PhysicalSizeX='0.5' \
               PhysicalSizeZ='2'/></Image></OME>";
    assert_eq!(open(&gray(2, ome)).unwrap().lattice.spacing(), DVec3::new(0.5, 1.0, 2.0));
    // Another program's resolution is one of paper.
    assert_eq!(open(&gray(2, "made by hand")).unwrap().lattice.spacing(), DVec3::ONE);
    for text in ["ImageJ=1\nimages=2\nchannels=2\n", &ome.replace("SizeT='1'", "SizeT='2'")] {
        assert!(open(&gray(2, text)).unwrap_err().to_string().contains("channels"), "{text}");
    }
}

#[test]
fn ome_steps_have_units() {
    let of = |units: &str| {
        let text = format!(
            "<OME><Image><Pixels PhysicalSizeX='0.5' PhysicalSizeY='0.5' PhysicalSizeZ='2000' \
             {units}/></Image></OME>"
        );
        open(&stack::<colortype::Gray8>(2, &text, |i| i as u8)).map(|v| v.lattice.spacing())
    };
    let z = "PhysicalSizeZUnit='nm'";
    assert_eq!(of(z).unwrap(), DVec3::new(0.5, 0.5, 2.0));
    assert_eq!(of(&format!("{z} PhysicalSizeXUnit='&#xb5;m'")).unwrap(), DVec3::new(0.5, 0.5, 2.0));
    let message = of("PhysicalSizeZUnit='pixel'").unwrap_err().to_string();
    assert!(message.contains("a.tif") && message.contains("PhysicalSizeZUnit is `pixel`"), "{message}");
}

/// As ImageJ writes stacks beyond 4 GB: one page of 3×2 16-bit samples, the other images behind its strip.
fn one_page(big: bool, images: usize, samples: u16) -> Vec<u8> {
    let text = format!("ImageJ=1.53f\nimages={images}\nslices={images}\n\0");
    let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() };
    let long = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
    let data = 8 + 2 + 10 * 12 + 4;
    let start = data + text.len() as u32;
    let mut bytes = if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() };
    bytes.extend(long(8));
    bytes.extend(short(10));
    for (tag, kind, count, value) in [
        (256, 3, 1, 3),
        (257, 3, 1, 2),
        (258, 3, 1, 16),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (270, 2, text.len() as u32, data),
        (273, 4, 1, start),
        (277, 3, 1, 1),
        (278, 3, 1, 2),
        (279, 4, 1, 12),
    ] {
        bytes.extend(short(tag));
        bytes.extend(short(kind));
        bytes.extend(long(count));
        match kind {
            3 => bytes.extend([short(value as u16), [0; 2]].concat()),
            _ => bytes.extend(long(value)),
        }
    }
    bytes.extend(long(0));
    bytes.extend(text.as_bytes());
    (0..samples).for_each(|i| bytes.extend(short(300 * i)));
    bytes
}

#[test]
fn one_page_with_the_stack_behind_it() {
    for big in [false, true] {
        let v = open(&one_page(big, 3, 18)).unwrap();
        assert_eq!(v.samples(), &Samples::U16((0..18).map(|i| 300 * i).collect()));
        assert_eq!(v.lattice.dims(), [3, 2, 3]);
        assert!(open(&one_page(big, 3, 17)).unwrap_err().to_string().contains("cut short"));
        assert!(open(&one_page(big, usize::MAX, 17)).unwrap_err().to_string().contains("cut short"));
    }
}

#[test]
fn one_stack_in_a_zip() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.tif.zip");
    let tif = stack::<colortype::Gray8>(2, "", |i| i as u8);
    let bytes = zip(&[("notes.txt", b"x"), ("in/s.TIF", &tif), ("__MACOSX/._s.tif", b"y")]);
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(read(&path).unwrap().samples(), &Samples::U8((0..12).collect()));
    std::fs::write(&path, zip(&[("a.tif", &tif), ("b.tif", &tif)])).unwrap();
    assert!(read(&path).unwrap_err().to_string().contains("2 TIFF files"));
    let mut damaged = bytes.clone();
    let at = bytes.windows(8).position(|w| w == b"in/s.TIF").unwrap() + 20;
    damaged[at] ^= 0x55;
    std::fs::write(&path, &damaged).unwrap();
    assert!(matches!(read(&path), Err(Error::Invalid(_))));
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(read(&path).unwrap_err().to_string().contains("zip"));
}

#[test]
fn what_is_no_grey_stack_is_refused() {
    let refused = |bytes: Vec<u8>, words: &str| {
        let message = open(&bytes).unwrap_err().to_string();
        assert!(message.contains(words) && message.starts_with("a.tif: "), "{words}: {message}");
    };
    let mut bytes = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<colortype::Gray8>(3, 2, &[0; 6]).unwrap();
    encoder.write_image::<colortype::Gray8>(2, 2, &[0; 4]).unwrap();
    refused(bytes.into_inner(), "page 1 is 2×2");
    let mut bytes = Cursor::new(Vec::new());
    TiffEncoder::new(&mut bytes).unwrap().write_image::<colortype::RGB8>(3, 2, &[0; 18]).unwrap();
    refused(bytes.into_inner(), "RGB");
    refused(stack::<colortype::Gray8>(1, "", |i| i as u8), "flatland");
    refused(b"II*\0rubbish".to_vec(), "page 0");
}

/// Replaces the entries of a tag with one 16-bit number in all directories, by another tag and number.
fn retagged(mut bytes: Vec<u8>, [tag, value]: [u8; 2], [new_tag, new]: [u8; 2]) -> Vec<u8> {
    let entry = |tag: u8, value: u8| [tag, 1, 3, 0, 1, 0, 0, 0, value, 0, 0, 0];
    while let Some(at) = bytes.windows(12).position(|w| w == entry(tag, value)) {
        bytes[at..at + 12].copy_from_slice(&entry(new_tag, new));
    }
    bytes
}

/// Rows from the bottom are turned round; what the decoder does not look at is refused.
#[test]
fn pages_are_stored_in_directions() {
    // SamplesPerPixel, 277, is 1 where it is missing.
    let turned = |tag: u8, value: u8| retagged(stack::<colortype::Gray8>(2, "", |i| i as u8), [21, 1], [tag, value]);
    let orientation = |value: u8| open(&turned(18, value));
    let rows = |v: &Volume| (0..12).map(|i| v.value(i)).collect::<Vec<_>>();
    assert_eq!(rows(&orientation(1).unwrap()), (0..12).map(f64::from).collect::<Vec<_>>());
    assert_eq!(rows(&orientation(4).unwrap()), [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8].map(f64::from));
    for value in [2, 3, 5, 6, 7, 8] {
        let message = orientation(value).unwrap_err().to_string();
        assert!(message.contains(&format!("page 0 is stored mirrored or turned (Orientation {value})")), "{message}");
    }
    assert!(open(&turned(10, 1)).is_ok());
    assert!(open(&turned(10, 2)).unwrap_err().to_string().contains("FillOrder 2"));
}

#[test]
fn imagej_keeps_signed_samples_unsigned() {
    let text = "ImageJ=1.53f\nimages=2\nslices=2\ncf=0\nc0=-32768.0\nc1=1.0\n";
    let of = |text: &str| open(&stack::<colortype::Gray16>(2, text, |i| 5000 * i as u16)).unwrap();
    assert!((0..12).all(|i| of(text).value(i) == 5000.0 * i as f64 - 32768.0));
    assert_eq!(of(text).samples().element_type(), ElementType::I16);
    for other in ["cf=20\n", "", "cf=0\nc0=0.0\nc1=1.0\n"] {
        let other = text.replace("cf=0\nc0=-32768.0\nc1=1.0\n", other);
        assert_eq!(of(&other).samples().element_type(), ElementType::U16, "{other}");
    }
}

/// Any straight line, of integers of 8 and 16 bits; no other function.
#[test]
fn imagej_calibrates_samples() {
    let text = "ImageJ=1.53f\nimages=2\nslices=2\ncf=0\nc0=-1024.0\nc1=0.5\n";
    let short = open(&stack::<colortype::Gray16>(2, text, |i| 5000 * i as u16)).unwrap();
    let byte = open(&stack::<colortype::Gray8>(2, text, |i| i as u8)).unwrap();
    let float = open(&stack::<colortype::Gray32Float>(2, text, |i| i as f32)).unwrap();
    for i in 0..12 {
        let n = i as f64;
        assert_eq!([short.value(i), byte.value(i), float.value(i)], [2500.0 * n - 1024.0, 0.5 * n - 1024.0, n]);
    }
    let curve = text.replace("cf=0", "cf=3");
    let refused = open(&stack::<colortype::Gray8>(2, &curve, |i| i as u8)).unwrap_err().to_string();
    assert!(refused.contains("a.tif") && refused.contains("function 3"), "{refused}");
    assert!(open(&stack::<colortype::Gray32Float>(2, &curve, |i| i as f32)).is_ok());
}

/// tifffile's text tells the shape of the array: pages of several axes are no stack.
#[test]
fn tifffile_says_of_what_shape_it_is() {
    let of = |pages: usize, text: &str| open(&stack::<colortype::Gray8>(pages, text, |i| i as u8));
    for shape in ["[4, 2, 3]", "[1, 4, 2, 3]", "[4, 2, 3, 1]"] {
        assert_eq!(of(4, &format!("{{\"shape\": {shape}}}")).unwrap().lattice.dims(), [3, 2, 4], "{shape}");
    }
    // Pages that were written one by one.
    assert_eq!(of(4, "{\"shape\": [2, 3]}").unwrap().lattice.dims(), [3, 2, 4]);
    // Channels or times, two arrays in one file, one page with others behind it.
    for (pages, shape) in
        [(4, "[2, 2, 2, 3], \"axes\": \"TZYX\""), (4, "[2, 2, 3]"), (2, "[4, 2, 3], \"truncated\": true")]
    {
        let message = of(pages, &format!("{{\"shape\": {shape}}}")).unwrap_err().to_string();
        assert!(message.contains("a.tif") && message.contains("of shape ["), "{message}");
    }
    assert!(of(2, "{\"other\": 1}").is_ok());
}

#[test]
fn texts_that_do_not_fit_are_refused() {
    let of = |text: &str| open(&stack::<colortype::Gray8>(2, text, |i| i as u8)).map_err(|e| e.to_string());
    assert!(of("ImageJ=1.53f\nimages=3\nslices=3\n").unwrap_err().contains("3 images, but there are 2 pages"));
    let named = "<ome:OME xmlns:ome='o'><ome:Image><ome:Pixels SizeC='2' SizeZ='1'/></ome:Image></ome:OME>";
    assert!(of(named).unwrap_err().contains("2 channels"));
    assert!(of(&named.replace("</ome:Image>", "")).unwrap_err().contains("not readable"));
    // Behind a byte-order mark, which the encoder does not write.
    let mut marked = stack::<colortype::Gray8>(2, &format!("~~~{named}"), |i| i as u8);
    let at = marked.windows(3).position(|w| w == b"~~~").unwrap();
    marked[at..at + 3].copy_from_slice("\u{feff}".as_bytes());
    assert!(open(&marked).unwrap_err().to_string().contains("2 channels"));
    // No business of OME's.
    for text in ["<note>made for the OME</note>", "<b>SOMETHING & more", "<sample 12> HOME position"] {
        assert!(of(text).is_ok(), "{text}");
    }
}

/// Pages are OME's slices in order, and all of them.
#[test]
fn ome_says_which_page_is_which_slice() {
    let of = |inside: &str| {
        let text = format!("<OME><Image><Pixels SizeC='1' SizeT='1' {inside}</Pixels></Image></OME>");
        open(&stack::<colortype::Gray8>(2, &text, |i| i as u8)).map(|v| v.lattice.dims()[2]).map_err(|e| e.to_string())
    };
    let data = "SizeZ='2'><TiffData IFD='0' FirstZ='0'/><TiffData IFD='1' FirstZ='1' PlaneCount='1'/>";
    for whole in ["SizeZ='2'>", "SizeZ='2'><TiffData/>", data, ">"] {
        assert_eq!(of(whole), Ok(2), "{whole}");
    }
    assert!(of("SizeZ='3'>").unwrap_err().contains("3 slices, but there are 2 pages"));
    let swapped = data.replace("FirstZ='0'", "FirstZ='9'").replace("FirstZ='1'", "FirstZ='0'").replace('9', "1");
    assert!(of(&swapped).unwrap_err().contains("page 0 is slice 1"));
    // A plane of each channel, as Bio-Formats tells of them.
    let channels = "<OME><Image><Pixels SizeC='2' SizeT='1' SizeZ='1'><TiffData IFD='1' FirstC='1' FirstZ='0'/></Pixels>\
                    </Image></OME>";
    let message = open(&stack::<colortype::Gray8>(2, channels, |i| i as u8)).unwrap_err();
    assert!(matches!(&message, Error::NotSupported(m) if m.contains("2 channels")), "{message}");
}

#[test]
fn counts_of_channels_do_not_wrap() {
    let text = format!("ImageJ=1\nchannels={0}\nframes={0}\n", usize::MAX);
    assert!(open(&stack::<colortype::Gray8>(2, &text, |i| i as u8)).unwrap_err().to_string().contains("channels"));
}
