//! Colours of what leaves a bake, worked out again from its radiance.

use super::{Folder, QUICK, ok};
use exr::prelude::{AttributeValue, MetaData, Text};
use glam::DVec3;
use isolume::export::ply;
use isolume::volume::vti::VtiFile;
use isolume::volume::{Lattice, Samples, Volume};
use std::fs;
use std::path::Path;

/// IEC 61966-2-1, on [0, 1].
fn srgb(linear: f64) -> f64 {
    let x = linear.clamp(0.0, 1.0);
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }
}

fn bake(dir: &Path, generator: &str, range: [&str; 2]) {
    ok(dir, &["generate", generator, "--size", "11", "-o", "b.vti", "-q"]);
    let mut args = vec!["bake", "b.vti", "-o", "lit.vti", "-q", "--isovalues", range[0], range[1]];
    args.extend(QUICK);
    ok(dir, &args);
}

fn floats(file: &VtiFile, name: &str) -> Vec<f32> {
    let found = file.point_data.iter().find(|a| a.name == name).unwrap();
    let Samples::F32(values) = &found.samples else { panic!("{name} is f32") };
    values.clone()
}

fn exposure(file: &VtiFile) -> f64 {
    let found = file.field_data.iter().find(|a| a.name == "exposure").unwrap();
    found.samples.get(0)
}

/// 8-bit RGB of a picture and its width.
pub(crate) fn pixels(path: &Path) -> (Vec<[u8; 3]>, usize) {
    let mut reader = png::Decoder::new(std::io::BufReader::new(fs::File::open(path).unwrap())).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    (bytes.as_chunks().0.to_vec(), info.width as usize)
}

#[test]
fn colours_are_exposed_and_encoded_radiance() {
    let dir = Folder::new();
    let dir = dir.path();
    bake(dir, "bumps", ["3.6", "95"]);
    let file = VtiFile::read(&dir.join("lit.vti")).unwrap();
    let exposure = exposure(&file);
    let (radiance, rgb) = (floats(&file, "radiance"), floats(&file, "rgb"));
    let mut grey = 0;
    for (radiance, rgb) in radiance.iter().zip(&rgb) {
        let expected = srgb(f64::from(*radiance) * exposure);
        assert!((f64::from(*rgb) - expected).abs() < 1e-5, "{radiance}: {rgb}, not {expected}");
        grey += usize::from((0.2..0.8).contains(&expected));
    }
    assert!(grey > 300, "{grey} that would differ unencoded");

    ok(dir, &["extract", "lit.vti", "--isovalue", "47", "-o", "m.ply", "-q"]);
    let mesh = ply::read(dir.join("m.ply")).unwrap();
    let linear = mesh.triple(["radiance_r", "radiance_g", "radiance_b"]).unwrap();
    let bytes = mesh.triple(["red", "green", "blue"]).unwrap();
    for (linear, bytes) in linear.iter().flatten().zip(bytes.iter().flatten()) {
        let expected = 255.0 * srgb(linear * exposure);
        assert!((bytes - expected).abs() < 0.501, "{linear}: {bytes}, not {expected}");
    }
}

/// Light is inside of the sphere, the lower side: normals point to its centre, and triangles turn that way.
#[test]
fn triangles_and_normals_face_outside() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "sphere", "--size", "11", "-o", "b.vti", "-q"]);
    for (side, sign) in [("lower", -1.0), ("higher", 1.0)] {
        let scene = format!("isovalues = [0.01, 0.2]\n[volume]\nfile = \"b.vti\"\n[surface]\noutside = \"{side}\"\n");
        fs::write(dir.join("s.toml"), scene).unwrap();
        ok(dir, &["extract", "s.toml", "--isovalue", "0.1", "-o", "m.ply", "-q"]);
        let mesh = ply::read(dir.join("m.ply")).unwrap();
        let vectors = |names| mesh.triple(names).unwrap().into_iter().map(DVec3::from).collect::<Vec<_>>();
        let (x, n) = (vectors(["x", "y", "z"]), vectors(["nx", "ny", "nz"]));
        assert!(x.iter().zip(&n).all(|(x, n)| n.dot((x - 0.5).normalize()) * sign > 0.9), "{side}");
        let mut turned = 0;
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|v| x[v as usize]);
            let cross = (b - a).cross(c - a);
            // Slivers may turn either way by rounding.
            if cross.length() > 1e-6 {
                assert!(cross.dot(n[t[0] as usize]) > 0.0, "{side}: {t:?}");
                turned += 1;
            }
        }
        assert!(turned > 100, "{turned} of {}", mesh.triangles.len());
    }
}

#[test]
fn the_box_stands_in_the_picture_as_it_is() {
    let dir = Folder::new();
    let dir = dir.path();
    bake(dir, "bumps", ["3.6", "95"]);
    for (name, more) in [("lit.png", &[][..]), ("local.png", &["--local"])] {
        let args = ["render", "lit.vti", "--isovalue", "90", "--height", "60", "--samples", "16", "-q", "-o", name];
        ok(dir, &[&args[..], more].concat());
        let (rgb, width) = pixels(&dir.join(name));
        assert_eq!((width, rgb.len()), (60, 3600));
        let at = |x: usize, y: usize| rgb[y * width + x].map(i32::from);
        let ([r, g, _], [s, h, _]) = (at(4, 30), at(55, 30));
        assert!(r > g + 40, "{name}: red on the left, {r} {g}");
        assert!(h > s + 20, "{name}: green on the right, {s} {h}");
        // The lamp, under the middle of the ceiling, is the brightest.
        let brightest = |rows: std::ops::Range<usize>| {
            rows.flat_map(|y| (0..width).map(move |x| (x, y))).filter(|&(x, y)| at(x, y) == [255; 3]).count()
        };
        assert!(brightest(0..20) > 20, "{name}: {}", brightest(0..20));
        assert!(brightest(0..20) > 10 * brightest(40..60), "{name}");
    }
}

/// A plane that fills the picture, seen from the front: ρ (0.15 + 0.85 cos) at every pixel.
#[test]
fn local_shading_is_a_headlight_and_a_constant() {
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
    let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[1] as f32 / 8.0).collect();
    Volume::new("plane", lattice, Samples::F32(samples)).unwrap().write(dir.join("p.vti")).unwrap();
    let scene = ["--isovalues", "0.1", "0.9", "--isovalue", "0.25", "--albedo", "0.6"];
    let picture = ["--local", "--height", "40", "--samples", "16", "-o", "p.png", "-q"];
    ok(dir, &[&["render", "p.vti"], &scene[..], &picture].concat());
    let (rgb, width) = pixels(&dir.join("p.png"));
    for (x, y) in [(20, 20), (20, 9), (9, 9), (30, 30)] {
        let tangent = |i: usize| (2.0 * (i as f64 + 0.5) / 40.0 - 1.0) * f64::to_radians(20.0).tan();
        let cosine = 1.0 / (1.0 + tangent(x).powi(2) + tangent(y).powi(2)).sqrt();
        let expected = 255.0 * srgb(0.6 * (0.15 + 0.85 * cosine));
        let found = rgb[y * width + x].map(f64::from);
        assert!(found.iter().all(|f| (f - expected).abs() < 1.0), "{x} {y}: {found:?}, not {expected}");
    }
}

/// Exposure of an .exr is what makes its radiance the .png; its attributes are all that made it.
#[test]
fn an_exr_says_what_made_it() {
    let dir = Folder::new();
    let dir = dir.path();
    bake(dir, "bumps", ["3.6", "95"]);
    let own = exposure(&VtiFile::read(&dir.join("lit.vti")).unwrap());
    let attributes = |args: &[&str]| {
        let common = ["render", "-o", "a.exr", "--height", "20", "--samples", "3", "--exposure", "0.5", "-q"];
        ok(dir, &[&common, args].concat());
        let header = MetaData::read_from_file(dir.join("a.exr"), false).unwrap().headers.swap_remove(0);
        move |name: &str| match header.own_attributes.other.get(&Text::from(name)) {
            Some(AttributeValue::Text(value)) => String::from_utf8(value.as_slice().to_vec()).unwrap(),
            found => panic!("{name}: {found:?}"),
        }
    };
    let lit = ["lit.vti", "--isovalue", "47"];
    let found = attributes(&lit);
    let close = |text: String, x: f64| assert!((text.parse::<f64>().unwrap() / x - 1.0).abs() < 1e-6, "{text} {x}");
    close(found("exposure"), 0.5 * own);
    assert_eq!(
        ["isovalue", "samplesPerPixel", "shading", "field", "up"].map(found),
        ["47", "3", "baked", "", "0.0,0.0,1.0"]
    );
    let camera = ["--eye", "2,-3,0.5", "--target", "0.5,0.25,0.5", "--up", "0,1,1", "--fov", "25", "--local"];
    let found = attributes(&[&lit[..], &camera].concat());
    assert_eq!(["shading", "eye", "target"].map(&found), ["local", "2.0,-3.0,0.5", "0.5,0.25,0.5"]);
    assert_eq!(["up", "fov"].map(&found), ["0.0,1.0,1.0", "25"]);
    let found = attributes(&[&lit[..], &["--reference", "--trilinear"]].concat());
    assert_eq!(found("shading"), "path traced, trilinear");

    let two = "[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 9\nisovalues = [10, 90]\n\
        [[volume]]\nname = \"b\"\ngenerator = \"sphere\"\nsize = 9\nisovalues = [0.02, 0.2]\n";
    fs::write(dir.join("two.toml"), two).unwrap();
    let found = attributes(&["two.toml", "--local", "--isovalue", "0.11", "--field", "b"]);
    assert_eq!(["field", "isovalue"].map(&found), ["b", "0.11"]);
    assert_eq!(attributes(&["two.toml", "--local", "--isovalue", "50"])("field"), "a");
}

/// At 10 the isosurface shadows walls up to their edges, where the linear functions between texels go on below 0.
#[test]
fn pictures_hold_no_negative_light() {
    let dir = Folder::new();
    let dir = dir.path();
    ok(dir, &["generate", "bumps", "--size", "11", "-o", "b.vti", "-q"]);
    let bake =
        ["bake", "b.vti", "-o", "lit.vti", "-q", "--isovalues", "3.6", "95", "--engine", "photon", "--bounces", "0"];
    ok(dir, &[&bake[..], &QUICK].concat());
    ok(dir, &["render", "lit.vti", "--isovalue", "10", "--height", "60", "--samples", "4", "-o", "p.exr", "-q"]);
    let image = exr::prelude::read_all_flat_layers_from_file(dir.join("p.exr")).unwrap();
    let values = image.layer_data[0].channel_data.list.iter().flat_map(|c| c.sample_data.values_as_f32());
    let values: Vec<f32> = values.collect();
    assert_eq!(values.iter().find(|v| **v < 0.0), None);
}
