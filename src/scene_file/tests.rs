use super::*;
use crate::flattened::Side;
use crate::scene::Boundary;

fn error_of(text: &str) -> String {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    match load(&path, &SceneOptions::default()) {
        Ok(_) => panic!("accepted: {text}"),
        Err(e) => e.to_string(),
    }
}

#[test]
fn a_whole_scene() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.toml");
    let text = "isovalues = [3.6, 95]\n[volume]\ngenerator = \"bumps\"\nsize = 17\n[surface]\nalbedo = [0.1, 0.2, 0.3]\n\
                outside = \"higher\"\nsides = \"both\"\nboundary = \"capped\"\n[box]\nmargin = 0.1\n[bake]\ngather = 0\n\
                grid = \"2x\"\npreset = \"preview\"\n";
    std::fs::write(&path, text).unwrap();
    let loaded = load(&path, &SceneOptions::default()).unwrap();
    assert_eq!(loaded.scene.surface.albedo.uniform(), Some(DVec3::new(0.1, 0.2, 0.3)));
    assert_eq!((loaded.scene.surface.outside, loaded.scene.surface.both_sides), (Side::Higher, true));
    assert_eq!((loaded.scene.boundary, loaded.bake.gather_rays), (Boundary::Capped, Some(0)));
    assert_eq!(loaded.scene.field.sweep().hi(), 95.0);
    let options = SceneOptions { isovalues: Some(vec![10.0, 20.0]), ..SceneOptions::default() };
    assert_eq!(load(&path, &options).unwrap().scene.field.sweep().lo(), 10.0, "flags win");
    let options = SceneOptions { isovalues: Some(vec![10.0]), ..SceneOptions::default() };
    assert!(load(&path, &options).unwrap_err().to_string().contains("two numbers"));
}

#[test]
fn volumes_without_a_suggestion_are_told_why() {
    let of = |samples: Vec<f64>| {
        let lattice = Lattice::aligned([2; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let volume = Volume::new("v", lattice, crate::volume::Samples::F64(samples)).unwrap();
        suggested(&volume).unwrap_err().to_string()
    };
    assert!(of(vec![2.5; 8]).contains("v: every sample is 2.5"));
    assert!(of(vec![f64::NAN; 8]).contains("finite"));
    let wide = of([-1.5e308, 1.5e308].repeat(4));
    let words = ["v: ", "-1.5e308", " 1.5e308", "--isovalues"];
    assert!(words.iter().all(|w| wide.contains(w)) && !wide.contains("every"), "{wide}");
}

#[test]
fn colours_by_isovalue() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.toml");
    let text = "isovalues = [10, 90]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n[surface]\nalbedo = [\n  \
                { isovalue = 50, colour = 0.5 },\n  { isovalue = 30, colour = [0.1, 0.2, 0.3] },\n]\n";
    std::fs::write(&path, text).unwrap();
    let albedo = |options: &SceneOptions| load(&path, options).unwrap().scene.surface.albedo;
    let by_isovalue = albedo(&SceneOptions::default());
    assert_eq!(by_isovalue.at(0.0), DVec3::new(0.1, 0.2, 0.3));
    assert!(by_isovalue.at(0.375).abs_diff_eq(DVec3::new(0.3, 0.35, 0.4), 1e-12), "halfway");
    let grey = SurfaceOptions { albedo: Some("0.2".parse().unwrap()), ..SurfaceOptions::default() };
    let options = SceneOptions { surface: grey, ..SceneOptions::default() };
    assert_eq!(albedo(&options).uniform(), Some(DVec3::splat(0.2)), "flags win");
    let of =
        |albedo: &str| error_of(&format!("[volume]\ngenerator = \"bumps\"\nsize = 9\n[surface]\nalbedo = {albedo}\n"));
    for (albedo, says) in [
        ("[0.1, 0.2]", "list of { isovalue, colour }"),
        ("\"red\"", "list of { isovalue, colour }"),
        ("[{ isovalue = 3, color = 0.5 }]", "did you mean `colour`?"),
        ("[{ isovalue = 3, colour = 0.5 }, { isovalue = 3, colour = 0.6 }]", "different"),
        ("[{ isovalue = 3, colour = 1.5 }]", "[0, 1]"),
    ] {
        let e = of(albedo);
        assert!(e.contains("scene.toml:") && e.contains(says) && !e.contains('\n'), "{albedo}: {e}");
    }
}

#[test]
fn errors_name_file_line_and_key() {
    let e = error_of("[volume]\ngenerator = \"bumps\"\ncolour = 3\n");
    assert!(e.contains("scene.toml:3: unknown key `colour` in [volume]; known: file") && !e.contains('\n'), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\n[surface]\noutside = \"heigher\"\n");
    assert!(e.contains("scene.toml:4: unknown value `heigher` in [surface]; did you mean `higher`?"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\n[foo]\nx = 1\n");
    assert!(e.contains("scene.toml:3: unknown key `foo`; known: volume"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\n[volume.foo]\nx = 1\n");
    assert!(e.contains("scene.toml:3: unknown key `foo` in [volume]; known: file"), "{e}");
    for (text, words) in [
        ("[volume]\nsize = 9\n size = 10\n", "scene.toml:3: size is there already"),
        (
            "[volume]\nsize = 9\n[volume]\nsize = 9\n",
            "scene.toml:3: [volume] is there already; of several volumes each",
        ),
        ("[volume]\nsize = 9\n[[volume]]\nsize = 9\n", "scene.toml:3: [volume] is there already; of several"),
        ("[box]\n[volume]\n [box]\n", "scene.toml:3: [box] is there already"),
    ] {
        let e = error_of(text);
        assert!(e.contains(words) && !e.contains('\n'), "{e}");
    }
    let e = error_of("isovalue = [1, 2]\n[volume]\ngenerator = \"bumps\"\n");
    assert!(e.contains("scene.toml:1: unknown key `isovalue`; did you mean `isovalues`?"), "{e}");
    let e = error_of("isovalues = [5, 5]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n");
    assert!(e.contains("scene.toml:1: isovalues"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\n[[context]]\nfile = \"a.obj\"\nscal = 3\n");
    assert!(e.contains("scene.toml:5: unknown key `scal` in [[context]]; did you mean `scale`?"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[[context]]\nfile = \"nowhere.obj\"\n");
    assert!(e.contains("scene.toml:5: file: ") && e.contains("nowhere.obj"), "{e}");
    let e = error_of("[volume]\nfile = \"nowhere.vti\"\n");
    assert!(e.contains("scene.toml:2: file") && e.contains("nowhere.vti"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[box]\nmargin = -1.0\n");
    assert!(e.contains("scene.toml:5: margin"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 9\n[box]\nmargin = 1001\n");
    assert!(e.contains("scene.toml:5: margin") && e.contains("1000"), "{e}");
    let e = error_of("isovalues = [10, 20, 30]\n[volume]\ngenerator = \"bumps\"\n");
    assert!(e.contains("scene.toml:1") && e.contains("needs 2 numbers, found 3"), "{e}");
    for emission in ["\"red\"", "[1, 2]"] {
        let e = error_of(&format!("[volume]\ngenerator = \"bumps\"\n[surface]\nemission = {emission}\n"));
        assert!(e.contains("scene.toml:4") && e.contains("a number, or three"), "{e}");
    }
    assert!(error_of("[volume]\n").contains("file or generator"));
    let e = error_of("[volume]\nfiles = [\"a.vti\", \"b.vti\"]\ngenerator = \"bumps\"\n");
    assert!(e.contains("scene.toml:2: files") && e.contains("files or generator"), "{e}");
    assert!(error_of("[volume]\nfile = \"a.vti\"\nsize = 9\n").contains("size is for a generator"));
    let e = error_of("[volume]\ngenerator = \"bumps\"\nraw = { dims = [2, 2, 2], type = \"u8\" }\n");
    assert!(e.contains("raw is for a file"), "{e}");
    let e = error_of("[volume]\ngenerator = \"bumps\"\nsize = 100000\n");
    assert!(e.contains("100000") && e.contains("2048"), "{e}");
    let e = error_of("isovalues = [200, 300]\n[volume]\ngenerator = \"bumps\"\nsize = 9\n");
    assert!(e.contains("outside the data"), "{e}");
}

/// Of keys of the same name, that of the table that is wrong.
#[test]
fn errors_cite_the_key_of_their_own_table() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("ok.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    let path = dir.path().join("scene.toml");
    let error_of = |text: &str| {
        std::fs::write(&path, text).unwrap();
        load(&path, &SceneOptions::default()).err().unwrap_or_else(|| panic!("accepted: {text}")).to_string()
    };
    let bumps = "[volume]\ngenerator = \"bumps\"\nsize = 9\n";
    for (text, says) in [
        ("[[context]]\nfile = \"ok.obj\"\n[volume]\nfile = \"missing.vti\"\n".to_owned(), "scene.toml:4: file: "),
        (format!("[[context]]\nfile = \"ok.obj\"\n[[context]]\nfile = \"b.obj\"\n{bumps}"), "scene.toml:4: file: "),
        (
            format!("[[context]]\nfile = \"ok.obj\"\nalbedo = 0.1\n{bumps}[surface]\nalbedo = 2\n"),
            "scene.toml:8: surface albedo",
        ),
        (format!("{bumps}[surface]\nemission = -1\n"), "scene.toml:5: surface emission"),
        (
            format!("{bumps}[box]\nkind = \"cornel\"\n"),
            "scene.toml:5: kind: 'cornel' is no file; did you mean `cornell`?",
        ),
        (
            format!(
                "isovalues = [0.1, 0.9]\n{bumps}[surface]\nalbedo = [{{ isovalue = 0.6, colour = 1.5 }}, {{ isovalue = 0.2, colour = 0 }}]\n"
            ),
            "scene.toml:6: surface albedo [1.5, 1.5, 1.5] at isovalue 0.6: every channel",
        ),
        (
            "[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 5\n[[volume]]\nname = \"b\"\ngenerator = \"bumps\"\nsize = 5\nscale = 0\n".to_owned(),
            "scene.toml:9: volume 'b': scale 0",
        ),
    ] {
        let e = error_of(&text);
        assert!(e.contains(says) && !e.contains('\n'), "{text}: {e}");
    }
}

#[test]
fn values_of_another_type_are_named_with_what_their_key_takes() {
    let of = |line: &str| error_of(&format!("[volume]\ngenerator = \"bumps\"\nsize = 9\n{line}\n"));
    for (line, says) in [
        ("[surface]\nsides = true", "scene.toml:5: sides: needs \"outside\", \"both\"; found true"),
        ("[surface]\noutside = 1", "scene.toml:5: outside: needs \"lower\", \"higher\"; found 1"),
        ("[surface]\nalbedo = \"red\"", "scene.toml:5: albedo: a colour is one number or"),
        ("[bake]\ngrid = 2", "scene.toml:5: grid: needs a factor from 1x to"),
        ("[bake]\ngrid = \"2\"", "scene.toml:5: grid: '2' is no grid size; write a factor"),
        ("[bake]\nseed = 1.5", "scene.toml:5: seed: needs a whole number, 0 or more; found 1.5"),
        ("[bake]\nphotons = -1", "scene.toml:5: photons: needs a whole number, 0 or more; found -1"),
        ("[bake]\nbounces = 70000", "scene.toml:5: bounces: needs a whole number, 0 to 65535; found 70000"),
        ("[bake]\ntau = \"small\"", "scene.toml:5: tau: needs a number; found \"small\""),
        ("[bake]\nsmoothing = \"yes\"", "scene.toml:5: smoothing: needs true or false; found \"yes\""),
        (
            "[context]\nfile = \"a.obj\"",
            "scene.toml:4: context: needs a list of tables: write [[context]]; found a table",
        ),
        ("[[context]]\nfile = 3", "scene.toml:5: file: needs a path in quotes; found 3"),
        ("[[context]]\nfile = \"a\"\nrotate = [1, 2]", "scene.toml:6: rotate: needs 3 numbers, found 2"),
        ("[[context]]\nfile = \"a\"\nrotate = 7", "scene.toml:6: rotate: needs 3 numbers, found 7"),
        ("[box]\nkind = 3", "scene.toml:5: kind: needs text in quotes; found 3"),
    ] {
        let e = of(line);
        assert!(e.contains(says) && !e.contains('\n'), "{line}: {e}");
    }
    for (text, says) in [
        ("[volume]\nfile = 3\n", "scene.toml:2: file: needs a path in quotes; found 3"),
        (
            "[volume]\ngenerator = \"bumps\"\nsize = -1\n",
            "scene.toml:3: size: needs a whole number, 0 or more; found -1",
        ),
        ("isovalues = [0.5]\n[volume]\ngenerator = \"bumps\"\n", "scene.toml:1: isovalues: needs 2 numbers, found 1"),
        ("[[volume]]\nname = \"a\"\norigin = [1, 2]\n", "scene.toml:3: origin: needs 3 numbers, found 2"),
    ] {
        let e = error_of(text);
        assert!(e.contains(says) && !e.contains('\n'), "{text}: {e}");
    }
}
