//! What cannot be right: one clear line, exit code 2, and nothing left behind.

use super::{Folder, QUICK, ok, refused, text};
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;

#[test]
fn bad_input_is_one_clear_line_and_leaves_nothing() {
    let dir = Folder::new();
    let dir = dir.path();
    refused(dir, &["bake", "nowhere.nii.gz", "-o", "out.vti"], &["nowhere.nii.gz"]);
    refused(dir, &["bake", "nowhere.xyz", "-o", "out.vti"], &["nowhere.xyz"]);

    // A gzip stream cut short.
    let lattice = Lattice::aligned([8, 8, 8], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let ramp = Samples::F32((0..512).map(|i| i as f32).collect());
    Volume::new("ramp", lattice.clone(), ramp).unwrap().write(dir.join("ramp.nrrd")).unwrap();
    let header = b"NRRD0004\ntype: float\ndimension: 3\nsizes: 8 8 8\nencoding: gzip\nendian: little\n\n";
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut gz, &[7; 2048]).unwrap();
    let packed = gz.finish().unwrap();
    fs::write(dir.join("cut.nrrd"), [&header[..], &packed[..packed.len() / 2]].concat()).unwrap();
    refused(dir, &["bake", "cut.nrrd", "-o", "out.vti"], &["cut.nrrd"]);

    // A header that promises 10¹² samples.
    let big = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 10000 10000 10000\nencoding: raw\nendian: little\n\nxx";
    fs::write(dir.join("big.nrrd"), big).unwrap();
    refused(dir, &["bake", "big.nrrd", "-o", "out.vti"], &["big.nrrd", "1000000000000"]);

    Volume::new("nan", lattice.clone(), Samples::F32(vec![f32::NAN; 512]))
        .unwrap()
        .write(dir.join("nan.nrrd"))
        .unwrap();
    refused(dir, &["bake", "nan.nrrd", "-o", "out.vti"], &["nan.nrrd", "finite"]);
    Volume::new("flat", lattice, Samples::F32(vec![3.0; 512])).unwrap().write(dir.join("flat.nrrd")).unwrap();
    refused(dir, &["bake", "flat.nrrd", "-o", "out.vti"], &["flat.nrrd", "isosurface"]);

    let ramp = ["bake", "ramp.nrrd", "-o", "out.vti"];
    let with = |extra: &[&'static str]| [&ramp[..], extra].concat();
    refused(dir, &with(&["--isovalues", "600", "700"]), &["outside the data", "0 … 511"]);
    refused(dir, &with(&["--isovalues", "7", "7"]), &["isovalues"]);
    // A number without a zero is one, too.
    refused(dir, &with(&["--isovalues", "-.5", "-.25"]), &["outside the data", "-0.5 … -0.25"]);
    refused(dir, &with(&["--albedo", "1.5"]), &["albedo"]);
    refused(dir, &with(&["--boundary", "capped"]), &["margin"]);
    refused(dir, &with(&["--gather", "9999999"]), &["gather"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "missing/folder/out.vti"], &["missing"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "out.png"], &["out.png", ".vti"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "out.nrrd"], &["out.nrrd", "isolume export"]);

    // Options of another mode.
    let reference = ["reference", "ramp.nrrd", "--isovalue", "200", "-o", "out.ply"];
    for option in ["--photons", "--photons-per-estimate"] {
        refused(dir, &[&reference[..], &[option, "9"]].concat(), &[option, "--integrator photon"]);
    }

    // Files of another kind, by what is wanted instead.
    fs::write(dir.join("s.toml"), "[volume]\ngenerator = \"bumps\"\n").unwrap();
    for file in ["ramp.nrrd", "s.toml"] {
        refused(dir, &["render", file, "--isovalue", "5", "-o", "out.png"], &[file, "no bake", "isolume bake"]);
        refused(dir, &["view", file, "-o", "out.html"], &[file, "no bake", "isolume bake"]);
    }
    refused(dir, &["info", "s.toml"], &["s.toml", "give that volume's file"]);
    refused(dir, &["export", "s.toml", "-o", "out.nrrd"], &["s.toml", "give that volume's file"]);
    refused(dir, &["flatland", "cut.nrrd", "-o", "out"], &["cut.nrrd", "scene file", ".toml"]);
    refused(dir, &["bake", "none_%03d.nrrd", "-o", "out.vti"], &["none_%03d.nrrd", "no file has such a name"]);
    refused(dir, &["bake", "ramp.nrrd", "-o", "out"], &["out: has no extension", ".vti"]);
    // Negative numbers are values, not options.
    refused(dir, &with(&["--margin", "-3"]), &["margin", "-3"]);
    refused(dir, &with(&["--tau", "-3"]), &["tau", "-3"]);
    let render = ["render", "nowhere.vti", "--isovalue", "5", "-o", "out.png", "--exposure", "-3"];
    refused(dir, &render, &["--exposure -3", "positive"]);

    // Before the file is opened, which is not there.
    for exposure in ["nan", "inf", "-inf", "-1", "0", "-0"] {
        for output in ["out.png", "out.exr"] {
            let exposure = format!("--exposure={exposure}");
            let render = ["render", "nowhere.vti", "--isovalue", "5", "-o", output, &exposure];
            refused(dir, &render, &["--exposure", "positive"]);
        }
    }

    // A thin slice is as wide as its box.
    let slice = Lattice::aligned([57, 2, 2], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let samples = Samples::F64((0..228).map(f64::from).collect());
    Volume::new("slice", slice.clone(), samples).unwrap().write(dir.join("slice.nrrd")).unwrap();
    let picture = ["render", "slice.nrrd", "--isovalue", "100.5", "-o", "out.png", "--local", "--samples", "1"];
    refused(dir, &picture, &["--height 600", "33600 pixels wide", "--width"]);
    ok(dir, &[&picture[..], &["--width", "16", "--height", "8", "-q"]].concat());
    fs::remove_file(dir.join("out.png")).unwrap();

    // EXR has no 64-bit floats.
    let far = |value: f64| {
        let samples = Samples::F64((0..228).map(|n| if n == 60 { value } else { f64::from(n) }).collect());
        Volume::new("far", slice.clone(), samples).unwrap().write(dir.join("far.nrrd")).unwrap();
    };
    far(-1e39);
    refused(dir, &["export", "far.nrrd", "-o", "out.exr"], &["out.exr", "[3, 1, 0]", "-1e39", ".nrrd"]);
    far(3e38);
    let said = text(&ok(dir, &["export", "far.nrrd", "-o", "out.exr"]).stderr);
    assert!(said.contains("57×2×2 × 1 f32") && !said.contains("warning"), "{said}");
    let offset = Samples::F64((0..228).map(|n| 1e9 + 1e-3 * f64::from(n)).collect());
    Volume::new("offset", slice.clone(), offset).unwrap().write(dir.join("offset.nrrd")).unwrap();
    let said = text(&ok(dir, &["export", "offset.nrrd", "-o", "out.exr"]).stderr);
    assert!(said.contains("warning: out.exr") && said.contains("too coarse"), "{said}");
    fs::remove_file(dir.join("out.exr")).unwrap();

    refused(dir, &["generate", "bumps", "--size", "100000", "-o", "out.vti"], &["100000", "2048"]);
    refused(dir, &with(&["--checkpoint-every=-1"]), &["--checkpoint-every", "0 or more"]);

    // More than any machine has.
    refused(dir, &["info", "ramp.nrrd", "--threads", "99999999"], &["--threads", "1024"]);
    let many = std::process::Command::new(env!("CARGO_BIN_EXE_isolume"))
        .args(["info", "ramp.nrrd"])
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", "5000")
        .output();
    let many = many.unwrap();
    let message = text(&many.stderr);
    assert!(many.status.code() == Some(2) && message.contains("RAYON_NUM_THREADS 5000: 1 to 1024"), "{message}");
    let huge = with(&["--grid", "100000,100000,100000", "-q"]);
    refused(dir, &huge, &["GB", "this machine has", "--grid"]);
    let dry = text(&ok(dir, &[&huge[..], &["--dry-run"]].concat()).stderr);
    assert!(dry.contains("warning: ") && dry.contains("this machine has") && dry.contains("time"), "{dry}");

    // A list of volumes that names itself.
    let list = "<VTKFile type=\"vtkMultiBlockDataSet\"><vtkMultiBlockDataSet><DataSet file=\"self.vtm\"/>\
                </vtkMultiBlockDataSet></VTKFile>";
    fs::write(dir.join("self.vtm"), list).unwrap();
    refused(dir, &["render", "self.vtm", "--isovalue", "5", "-o", "out.png"], &["self.vtm"]);

    // A luminaire without area, and a scene with an unknown key.
    fs::write(dir.join("l.mtl"), "newmtl lamp\nKe 1 1 1\n").unwrap();
    fs::write(dir.join("l.obj"), "mtllib l.mtl\nv 0 0 0\nv 1 1 1\nv 2 2 2\nusemtl lamp\nf 1 2 3\n").unwrap();
    refused(dir, &with(&["--box", "l.obj"]), &["l.obj", "face 1", "area"]);
    fs::write(dir.join("s.toml"), "[volume]\nfile = \"ramp.nrrd\"\n\n[surface]\nalbdo = 0.5\n").unwrap();
    refused(dir, &["bake", "s.toml", "-o", "out.vti"], &["s.toml:5", "albdo", "albedo"]);
}

/// An option that a scene file sets is named by its line, one that a flag sets is not.
#[test]
fn options_of_a_bake_out_of_range_are_named_where_they_are_set() {
    let dir = Folder::new();
    let dir = dir.path();
    let scene = "[volume]\ngenerator = \"bumps\"\nsize = 9\n[bake]\nlight-points = 17\ngather = 5\n";
    fs::write(dir.join("s.toml"), scene).unwrap();
    let bake = ["bake", "s.toml", "-o", "out.vti", "--engine", "sweep"];
    refused(dir, &bake, &["s.toml:5: light-points 17: must be a power of two"]);
    refused(dir, &[&bake[..], &["--light-points", "18"]].concat(), &["isolume: light-points 18: must be"]);
    refused(dir, &[&bake[..], &["--light-points", "16", "--bands", "0"]].concat(), &["isolume: bands 0: must be"]);
    refused(dir, &["bake", "s.toml", "-o", "out.vti", "--box", "cornel"], &["'cornel'", "did you mean `cornell`?"]);
}

/// Spacings, by name, before anything is made of them.
#[test]
fn spacings_out_of_range_are_named() {
    let dir = Folder::new();
    let dir = dir.path();
    fs::write(dir.join("r.raw"), (0..27).collect::<Vec<u8>>()).unwrap();
    let verbs: [&[&str]; 2] =
        [&["bake", "r.raw", "-o", "out.vti"], &["reference", "r.raw", "--isovalue", "9", "-o", "r.ply"]];
    for verb in verbs {
        for [spacing, named] in [
            ["1e-10,1,1e10", "spacing 1e-10, 1, 10000000000: "],
            ["1e-17,1,1", "spacing 1e-17, 1, 1: "],
            ["0,1,1", "spacing 0, 1, 1 "],
            ["1,1,1e17", "spacing 1, 1, 1e17: "],
        ] {
            let raw = ["--raw-dims", "3,3,3", "--raw-spacing", spacing];
            refused(dir, &[verb, &raw].concat(), &["r.raw: ", named]);
        }
    }
}

/// What is asked of a file of another kind, or with a number beyond use, is told what to do instead.
#[test]
fn messages_say_what_to_do_instead() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "sphere", "--size", "9", "-o", "b.npy", "-q"]);
    refused(dir, &["info", "b.npy", "--raw-dims", "9,9,9"], &["b.npy", ".npy has a header", "leave --raw-… out"]);
    for verb in [
        &["info", "rho_%04d.npy"][..],
        &["info", "rho_%04d.vti"],
        &["init", "rho_%04d.npy", "-o", "r.toml"],
        &["export", "rho_%04d.npy", "-o", "out.vti"],
        &["export", "rho_%d.vti", "-o", "out.vti"],
    ] {
        refused(dir, verb, &["rho_%", "takes one frame"]);
    }
    let outside = ["reference", "b.npy", "--isovalue", "0.0001", "-o", "r.ply", "--isovalues", "0.3,0.7"];
    refused(dir, &outside, &["--isovalue 0.0001: outside the sweep", "--isovalues"]);
    let bake = ["bake", "b.npy", "-o", "out.vti", "-q"];
    refused(dir, &[&bake[..], &["--tau", "inf"]].concat(), &["tau inf: must be above 0 and finite"]);
    refused(
        dir,
        &[&bake[..], &["--photons", "18446744073709551615"]].concat(),
        &["photons 18446744073709551615: must be at most"],
    );
    let trillion = [&bake[..], &["--photons", "1099511627776"]].concat();
    refused(dir, &trillion, &["this machine has", "lower --photons"]);
    refused(dir, &["bake", "b.npy", "-o", "nodir/x.vti"], &["nodir/x.vti: its folder nodir is missing"]);
    for name in ["q.npy", "q.exr"] {
        let export = ["export", "b.npy", "--space", "ras", "-o", name];
        refused(dir, &export, &[name, "--space ras", ".nrrd or .vti"]);
        assert!(!dir.join(name).exists());
    }
    for formula in ["linear:1e308,1e308,1e308", "linear:1e-320,0,0", "linear:1e39,0,0"] {
        refused(dir, &["generate", formula, "--size", "3", "-o", "out.vti"], &["linear", "infinite or all the same"]);
    }
    #[cfg(unix)]
    {
        assert!(std::process::Command::new("mkfifo").arg(dir.join("f.npy")).status().unwrap().success());
        refused(dir, &["info", "f.npy"], &["f.npy", "pipe"]);
        // Those that are read as a whole, too.
        for name in ["f.vti", "f.vtk", "f.toml"] {
            fs::rename(dir.join("f.npy"), dir.join(name)).unwrap();
            refused(dir, &["bake", name, "-o", "out.vti"], &[name, "pipe"]);
            fs::rename(dir.join(name), dir.join("f.npy")).unwrap();
        }
        for device in ["zero.vti", "zero.ply"] {
            std::os::unix::fs::symlink("/dev/zero", dir.join(device)).unwrap();
        }
        refused(dir, &["info", "zero.vti"], &["zero.vti", "device"]);
    }
}

/// Its photons would come from all isovalues of the sweep.
#[test]
fn photons_of_one_isosurface_that_emits_are_refused() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "12", "-o", "b.nrrd", "-q"]);
    let reference =
        ["reference", "b.nrrd", "--isovalue", "47", "-o", "r.ply", "-q", "--emission", "1", "--vertices", "9"];
    refused(dir, &[&reference[..], &["--integrator", "photon"]].concat(), &["--integrator path", "emit"]);
    ok(dir, &[&reference[..], &["--samples", "16"]].concat());
}

/// The surfaces are there, but between the grid's points; a volume without any is another matter.
#[test]
fn a_grid_that_is_too_coarse_is_told_from_a_constant_volume() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "20", "-o", "b.nrrd", "-q"]);
    for engine in ["sweep", "photon"] {
        let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--engine", engine];
        refused(dir, &[&bake[..], &["--grid", "2,2,2"]].concat(), &["too coarse", "--grid", "2×2×2"]);
        refused(dir, &[&bake[..], &["--grid", "2,2,2", "--dry-run"]].concat(), &["too coarse", "--grid", "2×2×2"]);
    }
    // 0 and 10, and what is not finite between them.
    let lattice = Lattice::aligned([8; 3], glam::DVec3::ZERO, glam::DVec3::ONE).unwrap();
    let halves = (0..512).map(|o| [0.0, 0.0, 0.0, f32::NAN, f32::NAN, 10.0, 10.0, 10.0][o % 8]).collect();
    Volume::new("halves", lattice, Samples::F32(halves)).unwrap().write(dir.join("h.nrrd")).unwrap();
    for grid in ["1x", "2x"] {
        let bake = ["bake", "h.nrrd", "--isovalues", "3", "4", "-o", "out.vti", "-q", "--grid", grid];
        refused(dir, &bake, &["constant", "other isovalues"]);
    }
}

/// MTL: one number is grey; what tobj would panic at is refused with its line.
#[test]
fn colours_of_an_mtl_are_one_number_or_three() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.nrrd", "-q"]);
    fs::write(dir.join("w.obj"), "mtllib w.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl w\nf 1 2 3\n").unwrap();
    fs::write(
        dir.join("s.toml"),
        "[volume]\nfile = \"b.nrrd\"\n[box]\nkind = \"none\"\n[[context]]\nfile = \"w.obj\"\n",
    )
    .unwrap();
    let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--dry-run", "--box", "w.obj"];
    let context = ["bake", "s.toml", "-o", "out.vti", "-q", "--dry-run"];
    for lines in
        ["Kd 0.7", "Ks 0", "Ka 0.2", "Tf 1", "Ke 2", "Kd 0.7\nKs 0\nKa 0.2\nTf 1\nKe 2", "Kd 0.1 0.2 0.3 # and more"]
    {
        fs::write(dir.join("w.mtl"), format!("newmtl w\n{lines}\n")).unwrap();
        ok(dir, &bake);
        ok(dir, &context);
    }
    for (line, found) in [
        ("Kd 0.7 0.7", "Kd 0.7 0.7"),
        ("Ks", "Ks"),
        ("Ka red", "Ka red"),
        ("Ke 1 2 x", "Ke 1 2 x"),
        ("Kd spectral red.rfl", "Kd spectral red.rfl"),
        ("Kd # 1 1 1", "Kd # 1 1 1"),
        ("Ns", "Ns"),
        ("illum x", "illum x"),
    ] {
        fs::write(dir.join("w.mtl"), format!("newmtl w\n\n  {line}\n")).unwrap();
        refused(dir, &bake, &["w.mtl:3: ", found]);
        refused(dir, &context, &["s.toml", "w.mtl:3: ", found]);
    }
}

/// Radiances are stored in 32 bits, and so are the squares that their standard errors come from.
#[test]
fn emissions_that_floats_cannot_square_are_refused() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.nrrd", "-q"]);
    let bake = ["bake", "b.nrrd", "--isovalues", "3.6", "95", "-o", "out.vti", "-q", "--dry-run"];
    let with = |extra: &[&'static str]| [&bake[..], extra].concat();
    let lamp = |emission: &str| {
        fs::write(dir.join("l.mtl"), format!("newmtl lamp\nKd 0 0 0\nKe {emission}\n")).unwrap();
        fs::write(dir.join("l.obj"), "mtllib l.mtl\nv 0 0 1\nv 1 0 1\nv 0 1 1\nusemtl lamp\nf 1 3 2\n").unwrap();
    };
    for fine in ["0 0 0", "1e-15 0 0", "1e18 1e18 1e18", "1e18 1e-30 0"] {
        lamp(fine);
        ok(dir, &with(&["--box", "l.obj"]));
    }
    for wrong in ["1e22 1e22 1e22", "1.1e18 1 1", "0 1e22 0", "9e-16 0 0", "1e-20 1e-20 1e-20", "-1 0 0"] {
        lamp(wrong);
        refused(dir, &with(&["--box", "l.obj"]), &["l.obj", "face 1", "emission", "1e-15", "1e18"]);
    }
    ok(dir, &with(&["--emission", "1e18"]));
    ok(dir, &with(&["--emission", "1e-15,0,0"]));
    for wrong in ["1e22", "1e-20", "0,0,2e18", "inf", "nan", "-1"] {
        let emission = format!("--emission={wrong}");
        refused(dir, &[&bake[..], &[&emission]].concat(), &["emission", "1e-15", "1e18"]);
    }
    fs::write(dir.join("s.toml"), "[volume]\nfile = \"b.nrrd\"\n[surface]\nemission = 1e22\n").unwrap();
    refused(dir, &["bake", "s.toml", "-o", "out.vti"], &["s.toml", "emission", "1e18"]);
}

/// What would change a bake's scene is refused where a bake is read: its light is that of the scene it holds.
#[test]
fn scene_flags_are_refused_where_the_input_is_a_bake() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    ok(dir, &[&["bake", "b.vti", "--isovalues", "30", "60", "-o", "lit.vti", "-q"], &QUICK[..]].concat());
    let verbs: [&[&str]; 5] = [
        &["reference", "--samples", "16", "--vertices", "5", "-o", "r.ply"],
        &["extract", "-o", "m.ply"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1", "--local"],
        &["render", "-o", "p.png", "--height", "8", "--samples", "1", "--reference"],
    ];
    for verb in verbs {
        let with = |extra: &[&'static str]| [verb, &["lit.vti", "-q"], extra].concat();
        for flags in [
            &["--isovalues", "49", "51"][..],
            &["--time", "1"],
            &["--albedo", "0"],
            &["--emission", "1"],
            &["--outside", "higher"],
            &["--sides", "both"],
            &["--boundary", "open"],
            &["--box", "none"],
            &["--margin", "0"],
            &["--raw-skip", "0"],
        ] {
            let named = if flags[0].starts_with("--raw") { "--raw-…" } else { flags[0] };
            let says = ["lit.vti", &format!("{named}: "), "the bake holds its scene"];
            refused(dir, &with(&[flags, &["--isovalue", "50"]].concat()), &says);
        }
        // No light is no light of 0.
        refused(dir, &with(&["--isovalue", "90"]), &["90", "outside the sweep", "30 … 60"]);
        ok(dir, &with(&["--isovalue", "50"]));
    }
    refused(dir, &["extract", "lit.vti", "-o", "m.ply", "--isovalue", "90"], &["lit.vti", "isolume export", "value"]);
    let capped = ["extract", "b.vti", "-o", "m.ply", "--isovalue", "50", "--boundary", "capped"];
    refused(dir, &capped, &["--boundary capped: the mesh is the surface alone"]);
    // The way that the message says, and a volume as it was.
    ok(dir, &["export", "lit.vti", "--array", "value", "-o", "value.vti", "-q"]);
    for volume in ["value.vti", "b.vti"] {
        ok(dir, &["extract", volume, "-o", "m.ply", "--isovalue", "90", "--outside", "higher", "-q"]);
    }
    assert!(!text(&fs::read(dir.join("m.ply")).unwrap()).contains("radiance"));
}

/// A sweep of which f32 tells no two places of a cell apart is refused before any light is computed, by trial runs,
/// too.
#[test]
fn a_sweep_that_is_too_thin_is_refused_beforehand() {
    let dir = Folder::new();
    let lattice = Lattice::aligned([20; 3], glam::DVec3::splat(-0.5), glam::DVec3::splat(1.0 / 19.0)).unwrap();
    let radius = |o: usize| lattice.to_world(lattice.point(o)).length();
    let samples = Samples::F64((0..lattice.len()).map(|o| 1.0 - radius(o)).collect());
    Volume::new("ball", lattice.clone(), samples).unwrap().write(dir.path().join("ball.nrrd")).unwrap();
    for engine in ["sweep", "photon"] {
        let bake = ["bake", "ball.nrrd", "-o", "out.vti", "--dry-run", "--engine", engine, "--isovalues", "0.7"];
        refused(dir.path(), &[&bake[..], &["0.7000000001"]].concat(), &["ball.nrrd", "too close together"]);
        ok(dir.path(), &[&bake[..], &["0.704"]].concat());
    }
}
