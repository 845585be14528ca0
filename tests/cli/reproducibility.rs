//! The same bits, whatever the machine has.

use super::{Folder, QUICK, isolume, ok, refused, text};
use isolume::volume::Samples;
use isolume::volume::vti::VtiFile;
use std::fs;

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "17", "-o", "b.vti", "-q"]);
    let grids: Vec<Vec<f32>> = ["1", "2", "7", "16"]
        .iter()
        .map(|threads| {
            let mut bake = vec!["bake", "b.vti", "-o", "t.vti", "--isovalues", "3.6", "95", "--threads", threads, "-q"];
            bake.extend(QUICK);
            ok(dir, &bake);
            let file = VtiFile::read(&dir.join("t.vti")).unwrap();
            let walls = file.field_data.iter().filter(|a| a.name.starts_with("wall_"));
            let arrays = file.point_data.iter().filter(|a| a.name != "mask").chain(walls);
            arrays
                .flat_map(|a| match &a.samples {
                    Samples::F32(v) => v.clone(),
                    _ => panic!("{} is not f32", a.name),
                })
                .collect()
        })
        .collect();
    let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    assert!(grids[0].iter().any(|&x| x > 0.0));
    for other in &grids[1..] {
        assert_eq!(bits(&grids[0]), bits(other));
    }
}

/// Every kernel gives the same bits; what the machine lacks is refused before any work.
#[test]
fn every_instruction_set_bakes_the_same_light() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "21", "-o", "b.nrrd", "--quiet"]);
    // A lamp within the volume cuts lines.
    fs::write(dir.join("lamp.mtl"), "newmtl lamp\nKd 0 0 0\nKe 5 5 5\nnewmtl floor\nKd 0.5 0.6 0.7\n").unwrap();
    let corners = "v 0.2 0.2 0.62\nv 0.2 0.45 0.62\nv 0.45 0.45 0.62\nv 0.45 0.2 0.62\n";
    let floor = "v 0 0 -0.1\nv 1 0 -0.1\nv 1 1 -0.1\nv 0 1 -0.1\nusemtl floor\nf 5 6 7 8\n";
    fs::write(dir.join("lamp.obj"), format!("mtllib lamp.mtl\n{corners}usemtl lamp\nf 1 2 3 4\n{floor}")).unwrap();
    let scene = "[volume]\nfile = \"b.nrrd\"\n[surface]\nsides = \"both\"\n[box]\nkind = \"lamp.obj\"\n";
    fs::write(dir.join("lamp.toml"), scene).unwrap();
    let found = isolume::isa::Isa::found();
    for (input, engine) in [("b.nrrd", "sweep"), ("lamp.toml", "sweep"), ("b.nrrd", "photon")] {
        let effort: &[&str] =
            if engine == "sweep" { &["--directions", "16", "--light-points", "4"] } else { &["--photons", "4000"] };
        let light = |isa: &str| {
            let mut args = vec!["bake", input, "--isovalues", "3.6", "95", "-o", "out.vti", "--engine", engine];
            args.extend(effort);
            args.extend(["--isa", isa, "--report", "r.json", "--quiet"]);
            ok(dir, &args);
            let report: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("r.json")).unwrap()).unwrap();
            assert_eq!(report["isa"], isa);
            let file = VtiFile::read(&dir.join("out.vti")).unwrap();
            fs::remove_file(dir.join("out.vti")).unwrap();
            let walls = file.field_data.into_iter().filter(|a| a.name.starts_with("wall_"));
            let light = file.point_data.into_iter().filter(|a| a.name.starts_with("radiance")).chain(walls);
            light.map(|a| format!("{:?}", a.samples)).collect::<String>()
        };
        let plain = light("plain");
        assert!(plain.len() > 20_000, "{} letters are no light", plain.len());
        for isa in &found[1..] {
            assert!(light(isa.name()) == plain, "{input}, {engine}: {} is not plain", isa.name());
        }
    }
    for name in isolume::isa::Isa::NAMES.into_iter().skip(found.len()) {
        refused(dir, &["bake", "b.nrrd", "-o", "out.vti", "--isa", name], &[name, "this machine has plain"]);
    }
    let output = isolume(dir, &["bake", "b.nrrd", "-o", "out.vti", "--isa", "sse9"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("avx512"), "{}", text(&output.stderr));
}
