use super::*;
use crate::polygon::Polygon;
use serde_json::{Value, json};

/// Reads a bake of 3³ points and one wall, whose description is `changed`.
fn read(changed: impl FnOnce(&mut Value)) -> Result<BakedVolume> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vti");
    let lattice = Lattice::aligned([3; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let mut description = json!({
        "isovalues": [0.5, 1.5], "exposure": 1.0, "albedo": [0.5, 0.5, 0.5], "emission": [0.0, 0.0, 0.0],
        "outside": "lower", "both_sides": false, "capped": false,
        "polygons": [{
            "name": "a", "albedo": [0.5, 0.5, 0.5], "emission": [0.0, 0.0, 0.0],
            "vertices": [[0.0, 0.0, -1.0], [2.0, 0.0, -1.0], [2.0, 2.0, -1.0], [0.0, 2.0, -1.0]],
        }],
        "textures": [{ "flat": 0, "array": "wall_a", "dims": [2, 2, 2] }],
        "report": {},
    });
    changed(&mut description);
    let mut nan = [0.125f32; 24];
    nan[20] = f32::NAN;
    let writer = VtiWriter::new(&lattice)
        .computed("value", 1, |o| (o % 3) as f32)
        .computed("radiance", 3, |_| 0.25)
        .computed("std_error", 1, |_| 0.0)
        .computed_bytes("mask", 1, |_| 1)
        .field_data("wall_a", 3, &[0.125f32; 24][..])
        .field_data("twice", 3, &[0.125f32; 24][..])
        .field_data("twice", 3, &[0.25f32; 24][..])
        .field_data("broken", 1, &[0.125f32; 25][..])
        .field_data("nan", 3, &nan[..])
        .field_string(DESCRIPTION, &description.to_string());
    writer.write(&path).unwrap();
    BakedVolume::read(&path)
}

#[test]
fn descriptions_that_do_not_hold_are_refused() {
    let read_back = read(|_| ()).unwrap();
    assert_eq!(read_back.flats[0].as_ref().unwrap().outside.lookup([0.5; 3]), DVec3::splat(0.125));
    let huge = 1u64 << 32;
    for (key, value, what) in [
        ("dims", json!([0, 8, 8]), "dims"),
        ("dims", json!([2, 2, 0]), "dims"),
        ("dims", json!([huge, huge, 1]), "dims"),
        ("dims", json!([huge, huge, huge]), "dims"),
        ("dims", json!([2, 2, 3]), "8 colours"),
        ("dims", json!([2, -2, 2]), "-2"),
        ("start", json!(1), "8 colours"),
        ("start", json!(u64::MAX), "8 colours"),
        ("flat", json!(7), "flat 7"),
        ("flat", json!(u64::MAX), "flat"),
        ("array", json!("wall_b"), "wall_b"),
        ("array", json!("twice"), "twice"),
        ("array", json!("broken"), "broken"),
        ("array", json!("nan"), "'nan' holds the colour [0.125, 0.125, NaN] at 6"),
    ] {
        let found = read(|d| d["textures"][0][key] = value.clone());
        let Err(error) = found else { panic!("{key} = {value} is accepted") };
        let message = error.to_string();
        assert!(matches!(error, Error::Invalid(_)) && message.contains("a.vti"), "{key} = {value}: {message}");
        assert!(message.contains(what), "{key} = {value}: {message}");
        assert!(!["dims", "8 colours", "flat 7"].contains(&what) || message.contains("wall_a"), "{message}");
    }
    // One flat has one texture.
    let Err(error) = read(|d| {
        let again = d["textures"][0].clone();
        d["textures"].as_array_mut().unwrap().push(again);
    }) else {
        panic!("two textures of one flat are accepted")
    };
    assert!(error.to_string().contains("flat 0"), "{error}");
    // What is seen from within solids follows what is seen from outside.
    let inside = |first: bool| {
        read(|d| {
            let mut again = d["textures"][0].clone();
            again["inside"] = json!(true);
            let textures = d["textures"].as_array_mut().unwrap();
            textures.insert(usize::from(!first), again);
        })
    };
    let light = inside(false).unwrap().flats.swap_remove(0).unwrap();
    assert_eq!(light.own(), Some(&light.outside));
    // Of files from before, one for all.
    assert_eq!(read_back.flats[0].as_ref().unwrap().within, Within::Same);
    let outside_only = read(|d| d["textures"][0]["outside_only"] = json!(true)).unwrap();
    assert_eq!(outside_only.flats[0].as_ref().unwrap().within, Within::Unknown);
    assert!(inside(true).err().unwrap().to_string().contains("flat 0"));
    // Caps, which open volumes do not have, count among the flats.
    for flat in 1..7 {
        let found = read(|d| d["textures"][0]["flat"] = json!(flat));
        assert!(found.is_ok(), "{flat}: {:?}", found.err());
    }
}

#[test]
fn sides_are_told_by_their_names() {
    let outside = |name: &str| read(|d| d["outside"] = json!(name)).map(|b| b.scene.surface.outside);
    assert_eq!(outside("lower").unwrap(), Side::Lower);
    assert_eq!(outside("higher").unwrap(), Side::Higher);
    for name in ["Higher", "upper", ""] {
        let message = outside(name).unwrap_err().to_string();
        assert!(message.contains("a.vti") && message.contains("higher"), "{name}: {message}");
    }
}

/// Names in OBJ files repeat, and one may be what another is given for it: each wall shows its own light.
#[test]
fn every_wall_has_an_array_of_its_own() {
    let lattice = Lattice::aligned([3; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let field = Field::made(lattice, Samples::F32((0..27).map(|o| (o % 3) as f32).collect()), 0.5, 1.5);
    let corners = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
    let wall = |(n, name)| {
        let vertices = corners.map(|[x, y]| DVec3::new(x, y, -1.0 - n as f64)).to_vec();
        Polygon::new(name, vertices, DVec3::splat(0.5), DVec3::ZERO).unwrap()
    };
    let names = ["a_2", "a", "a", "a", "a_inside", "b", "b"];
    let scene =
        Scene::new(field, Surface::default(), Boundary::Open, names.into_iter().enumerate().map(wall).collect())
            .unwrap();
    let texture = |n: f32| crate::flat::FlatTexture {
        dims: [1; 3],
        axis: crate::isovalue_axis::IsovalueAxis::EVEN,
        texels: vec![[n; 3]],
    };
    // Of the second one each side has its own light.
    let light = |n: usize| {
        let within = if n == 1 { Within::Own(texture(n as f32 + 0.5)) } else { Within::Same };
        Some(FlatLight { outside: texture(n as f32), within })
    };
    let flats: Vec<_> = (0..names.len()).map(light).collect();
    let (found, texels) = textures(&scene, &flats);
    assert_eq!(found.len(), names.len() + 1);
    for t in &found {
        let held: Vec<_> = texels.iter().filter(|(name, _)| *name == t.array).collect();
        assert_eq!(held.len(), 1, "{}: {found:?}", t.array);
        let expected = if t.inside { t.flat as f32 + 0.5 } else { t.flat as f32 };
        assert_eq!(held[0].1[0], expected, "{}", t.array);
    }
}
