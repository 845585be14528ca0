use super::*;

const HEAD: &str = "# vtk DataFile Version 3.0\ntitle\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 3 2 2\n\
                    SPACING 0.5 1 2\nORIGIN 1 2 3\nPOINT_DATA 12\n";
const NUMBERS: &str = "0 1 2 3 4 5\n6 7 8 9 10 11\n";

fn ok(bytes: &[u8], element: ElementType) {
    let (lattice, samples) = parse(bytes, None).unwrap();
    assert_eq!(lattice.to_world(DVec3::ONE), DVec3::new(1.5, 3.0, 5.0));
    assert_eq!(samples.element_type(), element);
    assert!((0..12).all(|i| samples.get(i) == i as f64));
}

#[test]
fn text_and_big_endian_bytes() {
    ok(format!("{HEAD}SCALARS s int\nLOOKUP_TABLE default\n{NUMBERS}").as_bytes(), ElementType::I32);
    ok(format!("{HEAD}SCALARS s float 1\n{NUMBERS}").as_bytes(), ElementType::F32);
    let old = HEAD.replace("SPACING", "ASPECT_RATIO").replace("3.0", "1.0");
    ok(format!("{old}SCALARS s double\nLOOKUP_TABLE default\n{NUMBERS}").as_bytes(), ElementType::F64);
    for (kind, element) in [
        ("unsigned_char", ElementType::U8),
        ("short", ElementType::I16),
        ("unsigned_short", ElementType::U16),
        ("unsigned_int", ElementType::U32),
        ("vtktypeint64", ElementType::I64),
        ("float", ElementType::F32),
        ("double", ElementType::F64),
    ] {
        let data: Vec<u8> = (0..12u8)
            .flat_map(|i| match element {
                ElementType::F32 => f32::from(i).to_be_bytes().to_vec(),
                ElementType::F64 => f64::from(i).to_be_bytes().to_vec(),
                _ => [&[0; 7][..element.size() - 1], &[i]].concat(),
            })
            .collect();
        let head = HEAD.replace("ASCII", "BINARY");
        let scalars = format!("{head}SCALARS s {kind}\nLOOKUP_TABLE default\n");
        ok(&[scalars.as_bytes(), &data, b"\n"].concat(), element);
        // Behind vectors whose bytes look like lines.
        let behind =
            format!("{head}VECTORS v short\n{}\nSCALARS s {kind} 1\nLOOKUP_TABLE default\n", "\n\n".repeat(36));
        ok(&[behind.as_bytes(), &data, b"\n"].concat(), element);
        let field = format!("{head}FIELD FieldData 2\nv 3 12 short\n{}\nh 1 12 {kind}\n", "ab".repeat(36));
        ok(&[field.as_bytes(), &data, b"\nMETADATA\nINFORMATION 0\n\n"].concat(), element);
    }
}

/// As VTK writes them: a line each, or a length and the bytes.
#[test]
fn strings_in_a_field_are_passed_over() {
    let field = "FIELD FieldData 2\nname 1 3 string\n";
    let behind = format!("h 1 12 short\n{NUMBERS}");
    ok(format!("{HEAD}{field}a%20b\n\n7\n{behind}").as_bytes(), ElementType::I16);
    let head = HEAD.replace("ASCII", "BINARY");
    let long = [&[0x80 | 1, 44][..], &[b'\n'; 300]].concat();
    let huge = [&[0x40, 1, 0, 0][..], &[b'x'; 1 << 16]].concat();
    let strings = [&[0xc0 | 2][..], b"ab", &long, &huge].concat();
    let numbers: Vec<u8> = (0..12).flat_map(|i: i16| i.to_be_bytes()).collect();
    let bytes = [format!("{head}{field}").as_bytes(), &strings, b"\nh 1 12 short\n", &numbers].concat();
    ok(&bytes, ElementType::I16);
    let start = head.len() + field.len();
    for cut in [start, start + 1, start + 4, start + 200, start + 400] {
        assert!(
            matches!(parse(&bytes[..cut], None), Err(Error::Invalid(e)) if e.contains("strings promised")),
            "{cut}"
        );
    }
    // 2⁶² bytes.
    let endless = [&bytes[..start], &[0x3f; 8]].concat();
    assert!(parse(&endless, None).is_err());
}

#[test]
fn unsigned_char_scalars_as_vtk_writes_them() {
    let head = HEAD.replace("ASCII", "BINARY");
    let bytes: Vec<u8> = (0..12).collect();
    ok(&[format!("{head}COLOR_SCALARS s 1\n").as_bytes(), &bytes, b"\n"].concat(), ElementType::U8);
    let text: String = (0..12).map(|i| format!("{:.6} ", f64::from(i) / 255.0)).collect();
    ok(format!("{HEAD}COLOR_SCALARS s 1\n{text}\n").as_bytes(), ElementType::U8);
}

#[test]
fn arrays_in_front_are_passed_over() {
    let nine = "1 0 0 0 1 0 0 0 1\n".repeat(12);
    let three = "1 0 0\n".repeat(12);
    let two = "1 0\n".repeat(12);
    let text = format!(
        "{HEAD}NORMALS n float\n{three}TENSORS t float\n{nine}TEXTURE_COORDINATES c 2 float\n{two}COLOR_SCALARS rgb 3\n\
         {three}LOOKUP_TABLE mine 2\n0 0 0 1\n1 1 1 1\nSCALARS v float 2\nLOOKUP_TABLE default\n{two}METADATA\n\
         INFORMATION 0\n\nSCALARS s short\nLOOKUP_TABLE default\n{NUMBERS}"
    );
    ok(text.as_bytes(), ElementType::I16);
}

/// As of `.vti`: the one that is asked for, `value`, or the only one.
#[test]
fn of_several_field_arrays_one_is_meant() {
    let zeros = "0 ".repeat(12);
    let two = |a: &str, b: &str| format!("{HEAD}FIELD f 2\n{a} 1 12 short\n{zeros}\n{b} 1 12 int\n{NUMBERS}");
    ok(two("pressure", "value").as_bytes(), ElementType::I32);
    let refused = |array: Option<&str>, words: &str| {
        let message = parse(two("pressure", "%C2%B5%25x%22q%").as_bytes(), array).unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    };
    refused(None, "cannot tell which point data to use: `pressure`, `µ%x\"q%`. Name one with --array");
    refused(Some("u"), "has no point data `u` of one component; there are: `pressure`, `µ%x\"q%`");
    let named = parse(two("pressure", "%C2%B5%25x%22q%").as_bytes(), Some("µ%x\"q%")).unwrap();
    assert_eq!(named.1.element_type(), ElementType::I32);
    // Scalars are active whatever else there is.
    let scalars = format!("SCALARS s short\nLOOKUP_TABLE default\n{NUMBERS}");
    ok((two("pressure", "value") + &scalars).as_bytes(), ElementType::I16);
}

#[test]
fn bits_are_passed_over() {
    let scalars = format!("SCALARS s short\nLOOKUP_TABLE default\n{NUMBERS}");
    let text = "1 ".repeat(12);
    ok(format!("{HEAD}SCALARS b bit\nLOOKUP_TABLE default\n{text}\n{scalars}").as_bytes(), ElementType::I16);
    ok(format!("{HEAD}FIELD f 2\nb 1 12 bit\n{text}\nh 1 12 short\n{NUMBERS}").as_bytes(), ElementType::I16);
    let head = HEAD.replace("ASCII", "BINARY");
    let numbers: Vec<u8> = (0..12).flat_map(|i: i16| i.to_be_bytes()).collect();
    let named = format!("{HEAD}SCALARS b bit\nLOOKUP_TABLE default\n{text}\n{scalars}");
    let message = parse(named.as_bytes(), Some("b")).unwrap_err().to_string();
    assert!(message.contains("array `b` holds bits"), "{message}");
    let front = format!("{head}SCALARS b bit\nLOOKUP_TABLE default\n\n\nSCALARS s short\nLOOKUP_TABLE default\n");
    ok(&[front.as_bytes(), &numbers].concat(), ElementType::I16);
}

/// VTK's writer puts what belongs to cells in front of what belongs to points.
#[test]
fn cell_data_in_front_is_passed_over() {
    let kinds = [
        ("SCALARS c short 1\nLOOKUP_TABLE default\n", 2, 2),
        ("SCALARS c double 2\n", 4, 8),
        ("COLOR_SCALARS c 3\n", 6, 1),
        ("LOOKUP_TABLE c 5\n", 20, 1),
        ("VECTORS c float\n", 6, 4),
        ("NORMALS c double\n", 6, 8),
        ("TENSORS c float\n", 18, 4),
        ("TENSORS6 c float\n", 12, 4),
        ("TEXTURE_COORDINATES c 3 float\n", 6, 4),
        ("GLOBAL_IDS c vtkIdType\n", 2, 4),
        ("PEDIGREE_IDS c int\n", 2, 4),
        ("EDGE_FLAGS c unsigned_char\n", 2, 1),
        ("FIELD FieldData 1\nc 1 12 short\n", 12, 2),
    ];
    let samples: Vec<u8> = (0..12i16).flat_map(i16::to_be_bytes).collect();
    for binary in [false, true] {
        let head = if binary { HEAD.replace("ASCII", "BINARY") } else { HEAD.to_string() };
        let (head, points) =
            (head.replace("POINT_DATA 12", "CELL_DATA 2"), "POINT_DATA 12\nSCALARS s short\nLOOKUP_TABLE default\n");
        let mut all = Vec::new();
        let end: Vec<u8> = [points.as_bytes(), if binary { &samples } else { NUMBERS.as_bytes() }, b"\n"].concat();
        for (line, count, size) in kinds {
            // Bytes that look like lines.
            let values = if binary { "\n".repeat(count * size) } else { "1 ".repeat(count) };
            let one = format!("{line}{values}\nMETADATA\nINFORMATION 0\n\n");
            ok(&[head.as_bytes(), one.as_bytes(), &end].concat(), ElementType::I16);
            all.extend(one.into_bytes());
        }
        ok(&[head.as_bytes(), &all, &end].concat(), ElementType::I16);
    }
}

#[test]
fn keywords_are_the_same_in_any_case() {
    let bytes: Vec<u8> = (0..12i16).flat_map(i16::to_be_bytes).collect();
    for change in [str::to_ascii_lowercase, str::to_ascii_uppercase] {
        let (magic, rest) = HEAD.split_once('\n').unwrap();
        let head = format!("{magic}\n{}", change(rest));
        let in_bytes = format!("{magic}\n{}", change(&rest.replace("ASCII", "BINARY")));
        let scalars = change("SCALARS s short 1\nLOOKUP_TABLE default\n");
        ok(format!("{head}{scalars}{NUMBERS}").as_bytes(), ElementType::I16);
        ok(&[in_bytes.as_bytes(), scalars.as_bytes(), &bytes].concat(), ElementType::I16);
        let notes = change("FIELD f 2\na 3 1 float\n1 2 3\nMETADATA\nINFORMATION 0\n\nb 1 12 short\n");
        ok(format!("{head}{notes}{NUMBERS}").as_bytes(), ElementType::I16);
    }
}

#[test]
fn broken_files_are_refused() {
    let refused = |text: String, words: &str| {
        let message = parse(text.as_bytes(), None).unwrap_err().to_string();
        assert!(message.contains(words), "{words}: {message}");
    };
    let good = format!("{HEAD}SCALARS s int\nLOOKUP_TABLE default\n{NUMBERS}");
    refused(good.replace(" 11\n", "\n"), "11 found");
    refused(good.replace("ASCII", "BINARY"), "cut short");
    refused(good.replace("int", "bit"), "array `s` holds bits");
    refused(good.replace("int", "quad"), "`quad`");
    refused(good.replace(" 11\n", " x\n"), "`x`");
    refused(good.replace("POINT_DATA 12", "POINT_DATA 13"), "13");
    refused(format!("{HEAD}SCALARS s int\n0 1\n").replace("POINT_DATA 12", "CELL_DATA 2"), "cell data");
    refused(good.replace("POINT_DATA", "CELL_DATA"), "CELL_DATA 12 does not fit");
    refused(good.replace("3 2 2", "12 1 1"), "flatland");
    refused(good.replace("3 2 2", "9999999 9999999 9999999"), "too large");
    refused(good.replace("STRUCTURED_POINTS", "POLYDATA"), "POLYDATA");
    refused(good.replace("# vtk", "# vkt"), "no legacy VTK");
    refused(good.replace("SPACING 0.5 1", "SPACING 0.5"), "3 numbers");
    refused(HEAD.into(), "no point data");
    refused(good.replace("SCALARS s int", "VECTORS v int"), "cut short");
}
