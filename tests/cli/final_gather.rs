//! `--shadow-rays` and `--gather-rays`: light where one looks, by rays into a bake, beside path tracing.

use super::{Folder, ok, refused, text};
use exr::prelude::read_all_flat_layers_from_file;
use glam::DVec3;
use isolume::export::ply;
use isolume::volume::{Lattice, Samples, Volume};
use std::path::Path;

/// Linear RGB of a small picture.
fn draw(dir: &Path, more: &[&str]) -> Vec<f32> {
    ok(dir, &[&["render", "-o", "p.exr", "--height", "40", "-q"], more].concat());
    let image = read_all_flat_layers_from_file(dir.join("p.exr")).unwrap();
    let channels = &image.layer_data[0].channel_data.list;
    let colours = ["R", "G", "B"].map(|name| channels.iter().find(|c| c.name.to_string() == name).unwrap());
    colours.iter().flat_map(|c| c.sample_data.values_as_f32()).collect()
}

/// 100 √⟨(a − r₁)(a − r₂)⟩ over √⟨r₁ r₂⟩, pixels brighter than white left out.
fn percent_off(picture: &[f32], truth: &[Vec<f32>; 2]) -> f64 {
    let white = 2.0 * truth[0].iter().sum::<f32>() / truth[0].len() as f32;
    let (mut off, mut all) = (0.0, 0.0);
    for ((&a, &r), &s) in picture.iter().zip(&truth[0]).zip(&truth[1]) {
        if a.max(r).max(s) < white {
            (off, all) = (off + f64::from((a - r) * (a - s)), all + f64::from(r * s));
        }
    }
    100.0 * (off.max(0.0) / all).sqrt()
}

const BUMPS: &str = "isovalues = [3.6, 95]\n[volume]\ngenerator = \"bumps\"\nsize = 17\n";

const TWO: &str = "[[volume]]\nname = \"bumps\"\ngenerator = \"bumps\"\nsize = 17\nisovalues = [3.6, 95]\n\
     [[volume]]\nname = \"ball\"\ngenerator = \"sphere\"\nsize = 13\norigin = [0.05, 0.15, 0.01]\nscale = 0.3\n\
     isovalues = [0.02, 0.2]\nalbedo = [0.8, 0.12, 0.1]\noutside = \"higher\"\n";

/// Solids that are open or capped, glow, and stand beside others: pictures by rays are nearer to path traced ones than
/// those of the light that is stored.
#[test]
fn pictures_by_rays_are_as_paths_have_them() {
    let dir = Folder::new();
    let dir = dir.path();
    // Its solid ends in a cap towards the camera, with a hole.
    let lattice = Lattice::aligned([13; 3], DVec3::ZERO, DVec3::splat(1.0 / 12.0)).unwrap();
    let falling = (0..lattice.len()).map(|o| {
        let x = lattice.to_world(lattice.point(o));
        1.0 - x.y - 1.5 * (0.35 - x.with_y(0.5).distance(DVec3::splat(0.5))).max(0.0)
    });
    let volume = Volume::new("falling", lattice.clone(), Samples::F64(falling.collect())).unwrap();
    volume.write(dir.join("falling.vti")).unwrap();
    let capped = "isovalues = [0.1, 0.9]\n[volume]\nfile = \"falling.vti\"\n[surface]\nboundary = \"capped\"\n\
                  sides = \"both\"\n[box]\nmargin = 0.3\n";
    let glowing = "[surface]\nalbedo = [{ isovalue = 0, colour = [0.9, 0.2, 0.2] }, { isovalue = 100, colour = 0.5 }]\n\
                   emission = [0.0, 0.3, 0.1]\n";
    let scenes = [
        ("open", BUMPS.to_owned(), "lit.vti", "30"),
        ("capped", capped.to_owned(), "lit.vti", "0.7"),
        ("glowing", [BUMPS, glowing].concat(), "lit.vti", "30"),
        ("two", TWO.to_owned(), "lit.vtm", "30"),
    ];
    for (name, scene, file, isovalue) in scenes {
        std::fs::write(dir.join("s.toml"), scene).unwrap();
        ok(dir, &["bake", "s.toml", "-o", file, "--preset", "preview", "-q"]);
        let isovalue = ["--isovalue", isovalue];
        // Paths are told apart by their direction: two pictures that see the same, with noise of their own.
        let truth = ["40", "40.00001"].map(|fov| {
            let paths = ["--reference", "--trilinear", "--samples", "400", "--fov", fov];
            draw(dir, &[&[file][..], &isovalue, &paths].concat())
        });
        let bake = [&[file][..], &isovalue, &["--samples", "64"]].concat();
        let stored = percent_off(&draw(dir, &bake), &truth);
        let rays = [&bake[..], &["--gather-rays", "32", "--shadow-rays", "16"]].concat();
        let found = percent_off(&draw(dir, &rays), &truth);
        println!("{name}: {stored:.2} % as stored, {found:.2} by rays");
        assert!(found < 0.7 * stored && found < 2.5, "{name}: {stored} {found}");
    }
}

/// Meshes by rays, of a bake that is split or not: as good, the more rays the better, and the same on any number of
/// threads; nearer to paths than by shadow rays alone, and these than the stored light.
#[test]
fn meshes_by_rays_are_nearer_to_paths() {
    let dir = Folder::new();
    let dir = dir.path();
    std::fs::write(dir.join("s.toml"), BUMPS).unwrap();
    ok(dir, &["bake", "s.toml", "-o", "whole.vti", "--preset", "preview", "-q"]);
    ok(dir, &["bake", "s.toml", "-o", "split.vti", "--preset", "preview", "--split", "-q"]);
    let off = |file: &str, rays: &[&str]| {
        let given = ["compare", file, "--points", "1500", "--paths", "64", "--json", "-q"];
        let found = ok(dir, &[&given[..], rays].concat()).stdout;
        let found: serde_json::Value = serde_json::from_slice(&found).unwrap();
        ["percent_rms", "percent_rms_texture"].map(|name| found[name].as_f64().unwrap())
    };
    let gather = |n: &'static str| ["--gather-rays", n, "--shadow-rays", n];
    let [texture, same] = off("whole.vti", &[]);
    let [split, radiance] = off("split.vti", &[]);
    let [shadows, _] = off("split.vti", &["--shadow-rays", "128"]);
    assert!(texture == same && texture == radiance && shadows < split && split < 0.8 * texture);
    for file in ["whole.vti", "split.vti"] {
        let [[few, _], [many, radiance]] = ["32", "512"].map(|n| off(file, &gather(n)));
        println!("{file}: texture {texture}, split {split}, shadow rays {shadows}, 32 rays {few}, 512 {many}");
        assert!(few < shadows && many < 0.6 * few && many < 0.15 * texture && radiance == texture);
    }
    let made = |n: u64, more: &[&str]| {
        let (given, number) =
            (["extract", "whole.vti", "--isovalue", "30", "-o", "m.ply", "--json", "-q"], n.to_string());
        let more = [&["--gather-rays", &number], more].concat();
        let said: serde_json::Value =
            serde_json::from_slice(&ok(dir, &[&given[..], &more[..]].concat()).stdout).unwrap();
        let (rays, vertices) = (said["rays"].as_u64().unwrap(), said["vertices"].as_u64().unwrap());
        assert!(rays >= n * vertices && rays < 12 * n * vertices, "{said}");
        (rays, std::fs::read(dir.join("m.ply")).unwrap())
    };
    assert!(made(16, &[]) == made(16, &["--threads", "1"]) && made(16, &[]) != made(16, &["--shadow-rays", "8"]));
    let noise = |n: u64| {
        made(n, &[]);
        let mesh = ply::read(dir.join("m.ply")).unwrap();
        let sum = |name: &str| mesh.property(name).unwrap().iter().sum::<f64>();
        sum("std_error") / sum("radiance_g")
    };
    let [few, more] = [16, 256].map(noise);
    println!("standard error of 16 rays {few}, of 256 {more}");
    assert!(few > 3.0 * more && few < 0.3 && more > 0.002, "{few} {more}");
    // The same points of a mesh, against references.
    let paths = ["reference", "whole.vti", "--isovalue", "30", "--samples", "256", "--vertices", "800", "-q"];
    for (seed, file) in [("1", "r1.ply"), ("2", "r2.ply")] {
        ok(dir, &[&paths[..], &["--trilinear", "--seed", seed, "-o", file]].concat());
    }
    let [stored, found] = [&[][..], &gather("256")].map(|rays| {
        let given = ["compare", "whole.vti", "r1.ply", "r2.ply", "--json", "-q"];
        let said = ok(dir, &[&given[..], rays].concat()).stdout;
        serde_json::from_slice::<serde_json::Value>(&said).unwrap()["percent_rms"].as_f64().unwrap()
    });
    println!("one isosurface: {stored} as stored, {found} by rays");
    assert!(found < 0.3 * stored, "{stored} {found}");
}

#[test]
fn rays_need_a_bake_that_has_use_for_them() {
    let dir = Folder::new();
    let dir = dir.path();
    std::fs::write(dir.join("s.toml"), BUMPS).unwrap();
    ok(dir, &["bake", "s.toml", "-o", "lit.vti", "--preset", "preview", "-q"]);
    let mesh = ["--isovalue", "30", "-o", "m.ply"];
    refused(dir, &[&["extract", "s.toml"], &mesh[..], &["--gather-rays", "8"]].concat(), &["s.toml", "is no bake"]);
    refused(dir, &[&["extract", "lit.vti"], &mesh[..], &["--shadow-rays", "8"]].concat(), &["lit.vti", "--split"]);
    refused(dir, &["compare", "lit.vti", "--shadow-rays", "8"], &["lit.vti", "--split"]);
    for (flag, number) in [("--shadow-rays", "0"), ("--gather-rays", "0"), ("--gather-rays", "2000000")] {
        let given = ["render", "lit.vti", "--isovalue", "30", "-o", "p.png", flag, number];
        refused(dir, &given, &[flag, "1 to 1048576"]);
    }
    for other in [&["--gather-rays", "8"][..], &["--trilinear"]] {
        let given = [&["render", "lit.vti", "--isovalue", "30", "-o", "p.png", "--local"], other].concat();
        let output = super::isolume(dir, &given);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2));
        assert!(said.contains("--local") && said.contains(other[0]), "{said}");
    }
    // What others lit needs them, and what they did not must not see them.
    for (policy, file, words) in
        [("joint", "two-ball.vti", "name the .vtm"), ("independent", "two.vtm", "name the .vti")]
    {
        std::fs::write(dir.join("two.toml"), format!("policy = \"{policy}\"\n{TWO}")).unwrap();
        ok(dir, &["bake", "two.toml", "-o", "two.vtm", "--preset", "preview", "-q"]);
        let given = ["render", file, "--isovalue", "0.1", "-o", "p.png", "--gather-rays", "8"];
        refused(dir, &given, &[file, words]);
    }
}
