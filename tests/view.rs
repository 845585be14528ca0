//! `isolume view`: what the page holds, and what a browser makes of it.

#[path = "shared/folder.rs"]
mod folder;
#[path = "shared/program.rs"]
mod program;
#[path = "shared/skipped.rs"]
mod skipped;
#[path = "view/browser.rs"]
mod browser;

use base64::Engine;
use folder::Folder;
use glam::{DMat3, DVec3};
use isolume::export::bake_file::BakedVolume;
use isolume::export::picture::{Picture, srgb_decode, srgb_encode};
use isolume::isovalue_axis::IsovalueAxis;
use isolume::mask::Mask;
use isolume::view::{Payload, codec};
use isolume::volume::{Lattice, Samples, Volume};
use program::{isolume, ok};
use skipped::skipped;
use std::fs;
use std::io::Read;
use std::path::Path;

const QUICK: [&str; 9] =
    ["--photons", "20000", "--samples", "20000", "--gather", "16", "--wall-resolution", "16", "--quiet"];

/// A bake of the bumps, as `out.vti` in `dir`.
fn bake_bumps(dir: &Path, size: &str, extra: &[&str]) -> BakedVolume {
    ok(dir, &["generate", "bumps", "--size", size, "-o", "b.vti", "-q"]);
    let bake = ["bake", "b.vti", "--isovalues", "3.6", "95", "-o", "out.vti"];
    ok(dir, &[&bake[..], &QUICK, extra].concat());
    BakedVolume::read(&dir.join("out.vti")).unwrap()
}

/// The text of the page's element `id`.
fn element<'a>(page: &'a str, id: &str) -> &'a str {
    let rest = page.split_once(&format!("id=\"{id}\">")).unwrap().1;
    rest.split_once("</script>").unwrap().0
}

#[test]
fn the_page_holds_the_bake_and_nothing_from_elsewhere() {
    let dir = Folder::new();
    let dir = dir.path();
    let baked = bake_bumps(dir, "41", &["--sides", "both"]);
    ok(dir, &["view", "out.vti", "-o", "page.html", "--title", "</script><b>&", "-q"]);
    let page = fs::read_to_string(dir.join("page.html")).unwrap();
    for foreign in ["http:", "https:", "src=", "@import", "import(", "fetch(", "XMLHttpRequest"] {
        assert!(!page.contains(foreign), "the page is self-contained, but says {foreign}");
    }
    let description: serde_json::Value = serde_json::from_str(element(&page, "description")).unwrap();
    assert_eq!(description["title"], "</script><b>&");
    let packed = base64::engine::general_purpose::STANDARD
        .decode(page.split_once("class=\"data\">").unwrap().1.split_once("</script>").unwrap().0)
        .unwrap();
    let mut bytes = Vec::new();
    flate2::read::ZlibDecoder::new(&packed[..]).read_to_end(&mut bytes).unwrap();
    assert_eq!(description["length"], bytes.len());

    // Each array where the description says, with the bake's values in it.
    let n = baked.lattice().len();
    let plane = |offset: usize| {
        let mut last = 0u8;
        bytes[offset..offset + n]
            .iter()
            .map(|d| {
                last = last.wrapping_add(*d);
                last
            })
            .collect::<Vec<_>>()
    };
    let axis = IsovalueAxis::of([baked.scene.field.samples()]);
    assert_eq!(description["axis"], serde_json::to_value(axis).unwrap());
    let (mut code, mut worst) = (0u16, 0f64);
    for (i, &s) in baked.scene.field.samples().iter().enumerate() {
        code = code.wrapping_add(u16::from_be_bytes([bytes[i], bytes[n + i]]));
        let distance = (f64::from(s) - f64::from(s).clamp(0.0, 1.0)).abs();
        worst = worst.max((codec::decode(&axis, code) - f64::from(s)).abs() - 0.001 * distance);
    }
    assert!(worst <= 0.51 / 32_768.0, "isovalues are off by {worst}");
    let scale = description["scale"].as_f64().unwrap();
    assert!((1.0..=4.0).contains(&scale));
    let lights = description["lights"].as_array().unwrap();
    assert_eq!(lights.len(), 2, "both sides");
    for (light, (_, grid)) in lights.iter().zip(&baked.sides) {
        let offset = usize::try_from(light.as_u64().unwrap()).unwrap();
        for c in 0..3 {
            for (byte, radiance) in plane(offset + c * n).iter().zip(&grid.radiance) {
                let given = srgb_encode((f64::from(radiance[c]) * baked.exposure / scale) as f32);
                assert!((f32::from(*byte) - 255.0 * given).abs() < 0.51, "{byte} for {given}");
            }
        }
        let mask = plane(offset + 3 * n);
        assert!(mask.iter().zip(&grid.mask).all(|(b, m)| (*b == 0) == (*m == Mask::Empty)));
    }
    let walls = description["flats"].as_array().unwrap();
    assert_eq!(walls.len(), 6);
    // Of the luminaire only: the back of other walls, and of what is two polygons back to back, is not there.
    for (wall, polygon) in walls.iter().zip(baked.scene.polygons()) {
        assert_eq!(wall["opaqueBack"], polygon.opaque_back, "{}", polygon.name);
        assert_eq!(polygon.opaque_back, polygon.emission != DVec3::ZERO);
    }
    assert!(walls.iter().filter(|w| !w["texture"].is_null()).count() >= 5);
    // Real data: 181×217×181 in 40 MB are 5.6 bytes a point; two sides and the fixed parts stay below that here.
    assert!(page.len() < 60_000 + 56 * n / 10, "{} bytes for {n} points", page.len());
}

#[test]
fn what_is_no_bake_or_no_page_is_refused() {
    let dir = Folder::new();
    ok(dir.path(), &["generate", "bumps", "--size", "9", "-o", "b.vti", "-q"]);
    for (args, word) in [(["view", "b.vti", "-o", "p.html"], "is no bake"), (["view", "b.vti", "-o", "p.png"], ".html")]
    {
        let output = isolume(dir.path(), &args);
        assert_eq!(output.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&output.stderr).contains(word));
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left behind");
}

/// A picture as bytes, RGB from top to bottom.
struct Bytes {
    size: [usize; 2],
    rgb: Vec<[u8; 3]>,
}

impl Bytes {
    /// What `isolume render` draws.
    fn render(dir: &Path, args: &[&str]) -> Self {
        let fixed = ["render", "out.vti", "-o", "r.png", "--height", "240", "--samples", "16", "-q"];
        ok(dir, &[&fixed[..], args].concat());
        let file = fs::File::open(dir.join("r.png")).unwrap();
        let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        let rgb = bytes.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
        Self { size: [info.width as usize, info.height as usize], rgb }
    }

    /// What the browser read back, from bottom to top.
    fn posted(size: [usize; 2], bytes: &[u8]) -> Self {
        assert_eq!(bytes.len(), 4 * size[0] * size[1]);
        let rows = bytes.chunks_exact(4 * size[0]).rev();
        Self { size, rgb: rows.flat_map(|r| r.chunks_exact(4).map(|c| [c[0], c[1], c[2]])).collect() }
    }

    /// Mean difference and the share of pixels that differ by more than 2 % of white, away from edges, where one ray
    /// per pixel and sixteen must differ.
    fn differences(&self, other: &Self) -> (f64, f64, f64) {
        let [w, h] = self.size;
        assert_eq!(self.size, other.size);
        let apart = |a: [u8; 3], b: [u8; 3]| (0..3).map(|c| f64::from(a[c].abs_diff(b[c])) / 255.0).fold(0.0, f64::max);
        let (mut sum, mut count, mut beyond) = (0.0, 0.0, 0.0);
        for y in 1..h - 1 {
            for x in 1..w - 1 {
                let at = y * w + x;
                let edge =
                    |p: &Self| [at - 1, at + 1, at - w, at + w].iter().any(|&n| apart(p.rgb[at], p.rgb[n]) > 0.06);
                if edge(self) || edge(other) {
                    continue;
                }
                let d = apart(self.rgb[at], other.rgb[at]);
                sum += d;
                count += 1.0;
                beyond += f64::from(d > 0.02);
            }
        }
        (sum / count, beyond / count, count / (w * h) as f64)
    }
}

/// One view in both programs: what the page sets, and what `isolume render` is told.
struct View {
    name: &'static str,
    page: String,
    render: Vec<String>,
}

/// The page of the bake in `dir`.
fn page(dir: &Path) -> String {
    ok(dir, &["view", "out.vti", "-o", "page.html", "-q"]);
    fs::read_to_string(dir.join("page.html")).unwrap()
}

/// Compares views of the bake in `dir`, and returns everything else that its page posted.
fn compare(dir: &Path, program: &Path, views: &[View], driver: &str) -> Vec<(String, Vec<u8>)> {
    compare_with(&page(dir), dir, program, views, driver)
}

/// [`compare`], of a page that was changed.
fn compare_with(page: &str, dir: &Path, program: &Path, views: &[View], driver: &str) -> Vec<(String, Vec<u8>)> {
    let pictures: Vec<Bytes> =
        views.iter().map(|v| Bytes::render(dir, &v.render.iter().map(String::as_str).collect::<Vec<_>>())).collect();
    let mut script = "await isolume.ready;\n".to_owned();
    for (view, picture) in views.iter().zip(&pictures) {
        let [w, h] = picture.size;
        script += &format!("isolume.set({}); await post('{}', isolume.pixels({w}, {h}));\n", view.page, view.name);
    }
    let posted = browser::drive(program, page, &(script + driver), 240);
    let errors: Vec<_> = posted.iter().filter(|(n, _)| n == "error").map(|(_, b)| String::from_utf8_lossy(b)).collect();
    assert!(errors.is_empty(), "the page says: {errors:?}");
    for (view, picture) in views.iter().zip(&pictures) {
        let (_, bytes) = posted.iter().find(|(n, _)| n == view.name).expect("every view is posted");
        let shown = Bytes::posted(picture.size, bytes);
        let (mean, beyond, share) = picture.differences(&shown);
        println!(
            "{}: mean {:.2} %, {:.2} % of pixels beyond 2 %, {:.0} % compared",
            view.name,
            100.0 * mean,
            100.0 * beyond,
            100.0 * share
        );
        if let Some(folder) = std::env::var_os("ISOLUME_VIEW_PICTURES") {
            for (p, kind) in [(picture, "render"), (&shown, "page")] {
                let linear = p.rgb.iter().map(|c| c.map(|b| srgb_decode(f32::from(b) / 255.0)));
                let picture = Picture { width: p.size[0], height: p.size[1], rgb: linear.collect() };
                picture.write_png(Path::new(&folder).join(format!("{}-{kind}.png", view.name)), 1.0).unwrap();
            }
        }
        assert!(share > 0.6 && mean < 0.005 && beyond < 0.003, "{}", view.name);
    }
    posted
}

fn words(text: &str) -> Vec<String> {
    text.split_whitespace().map(str::to_owned).collect()
}

fn chromium() -> Option<std::path::PathBuf> {
    let found = browser::find();
    if found.is_none() {
        skipped("the page in a browser", "Chromium is neither on the path nor in ISOLUME_CHROMIUM");
    }
    found
}

#[test]
fn the_browser_shows_what_render_draws() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    bake_bumps(dir, "41", &[]);
    // The unit cube: half a diagonal is √3/2; the eye stands 1.8737 from the centre.
    let (azimuth, elevation) = (30f64.to_radians(), 20f64.to_radians());
    let forward = DVec3::new(azimuth.sin() * elevation.cos(), azimuth.cos() * elevation.cos(), -elevation.sin());
    let eye = DVec3::splat(0.5) - forward * (0.5 + 0.5 / 20f64.to_radians().tan());
    let unit = |v: f64| (v - 3.6) / (95.0 - 3.6);
    let view = |name, page: String, render: &str| View { name, page, render: words(render) };
    let views = [
        view("at-47", format!("{{ iso: {} }}", unit(47.0)), "--isovalue 47"),
        view("at-20", format!("{{ iso: {} }}", unit(20.0)), "--isovalue 20"),
        view("local", format!("{{ iso: {}, shading: 'local' }}", unit(47.0)), "--isovalue 47 --local"),
        view(
            "turned",
            format!("{{ iso: {}, shading: 'global', azimuth: 30, elevation: 20 }}", unit(47.0)),
            &format!("--isovalue 47 --eye {},{},{}", eye.x, eye.y, eye.z),
        ),
        view(
            "exposed",
            format!("{{ iso: {}, azimuth: 0, elevation: 0, exposure: 0.5 }}", unit(47.0)),
            "--isovalue 47 --exposure 0.5",
        ),
    ];
    let driver = "
        isolume.set({ exposure: 1, tint: [1, 1, 1], clip: '', iso: 0.4 });
        await post('before', isolume.pixels(240, 240));
        const slide = (id, value) => { const e = document.getElementById(id); e.value = value; e.dispatchEvent(new Event('input', { bubbles: true })); };
        slide('isovalue', 0.6);
        await post('after', isolume.pixels(240, 240));
        slide('tint', '#ff0000');
        await post('red', isolume.pixels(240, 240));
        isolume.set({ tint: [1, 1, 1], clip: '-y', cut: 0.45 });
        await post('clipped', isolume.pixels(240, 240));
        isolume.set({ clip: '', walls: false });
        await post('bare', isolume.pixels(240, 240));
        const key = (k) => document.getElementById('view').dispatchEvent(new KeyboardEvent('keydown', { key: k, bubbles: true }));
        const states = [];
        for (const k of [']', 'ArrowLeft', 'ArrowUp', '+', 'g', 'w', 'c', 'h', 'r']) { key(k); states.push(JSON.stringify(isolume.state)); }
        await post('keys', JSON.stringify(states));
        const canvas = document.getElementById('view');
        canvas.setPointerCapture = () => {};
        const finger = (type, id, x, y) => canvas.dispatchEvent(new PointerEvent(type, { pointerId: id, clientX: x, clientY: y, buttons: 1 }));
        finger('pointerdown', 1, 200, 200); finger('pointermove', 1, 220, 210);
        const dragged = { ...isolume.state };
        finger('pointerdown', 2, 300, 210); finger('pointermove', 2, 380, 210);
        const pinched = { ...isolume.state };
        finger('pointerup', 1, 0, 0); finger('pointerup', 2, 0, 0); finger('pointermove', 2, 0, 0);
        canvas.dispatchEvent(new WheelEvent('wheel', { deltaY: 100, cancelable: true }));
        await post('hands', JSON.stringify([dragged, pinched, isolume.state]));
        await post('milliseconds', String(isolume.time(5, 640, 480)));
        dispatchEvent(new Event('resize'));
        await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
    ";
    let posted = compare(dir, &program, &views, driver);
    let get = |name: &str| &posted.iter().find(|(n, _)| n == name).expect("posted").1;
    let changed =
        |a: &[u8], b: &[u8]| a.chunks(4).zip(b.chunks(4)).filter(|(p, q)| p != q).count() as f64 / (a.len() / 4) as f64;
    assert!(changed(get("before"), get("after")) > 0.1, "the slider changes the picture");
    assert!(
        get("red").chunks(4).all(|p| p[1] == 0 && p[2] == 0) && get("red").chunks(4).any(|p| p[0] > 50),
        "a red light"
    );
    assert!(changed(get("after"), get("clipped")) > 0.02, "the plane cuts");
    assert!(get("bare").chunks(4).filter(|p| p[..3] == [0, 0, 0]).count() > 240 * 240 / 10, "no walls");
    let states: Vec<String> = serde_json::from_slice(get("keys")).unwrap();
    // Every key changes the state but h, which shows the help, and r, which restores the first one.
    assert!(states.windows(2).enumerate().all(|(i, w)| (w[0] != w[1]) == (i != 6)), "{states:?}");
    let first: serde_json::Value = serde_json::from_str(states.last().unwrap()).unwrap();
    assert_eq!((first["iso"].as_f64(), first["zoom"].as_f64()), (Some(0.5), Some(1.0)));
    let hands: Vec<serde_json::Value> = serde_json::from_slice(get("hands")).unwrap();
    let number = |i: usize, key: &str| hands[i][key].as_f64().unwrap();
    assert!((number(0, "azimuth") - 7.0).abs() < 1e-9 && (number(0, "elevation") - 3.5).abs() < 1e-9, "{hands:?}");
    assert!((number(1, "zoom") - 2.0).abs() < 1e-9 && number(1, "azimuth") == number(0, "azimuth"), "{hands:?}");
    assert!(number(2, "zoom") < number(1, "zoom") && number(2, "azimuth") == number(1, "azimuth"), "{hands:?}");
    println!("{} ms per frame of 640×480", String::from_utf8_lossy(get("milliseconds")));
}

/// Labels: a box of 200 within one of 80 within one of 77 within 0. Samples equal to the isovalue belong to the solid,
/// also in textures of 16-bit floats, in which 77 rounds down; and exposures in the address are those of the slider.
#[test]
fn plateaus_at_the_isovalue_are_within() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::splat(1.0 / 16.0)).unwrap();
    let within = |o: usize, range: std::ops::Range<usize>| lattice.ijk(o).iter().all(|i| range.contains(i));
    let boxes = [(200, 6..10), (80, 4..13), (77, 3..14)];
    let label = |o: usize| boxes.iter().find(|(_, range)| within(o, range.clone())).map_or(0, |(label, _)| *label);
    let samples = (0..lattice.len()).map(label).collect();
    Volume::new("labels", lattice.clone(), Samples::U8(samples)).unwrap().write(dir.join("b.nrrd")).unwrap();
    let bake = ["bake", "b.nrrd", "--isovalues", "1", "201", "-o", "out.vti", "--engine", "photon"];
    ok(dir, &[&bake[..], &QUICK].concat());
    // 79 of 200 is no whole number of the page's steps, and rounds down.
    let view = |name, isovalue: u32| View {
        name,
        page: format!("{{ iso: {} }}", f64::from(isovalue - 1) / 200.0),
        render: words(&format!("--isovalue {isovalue}")),
    };
    let views = [view("at-77", 77), view("at-80", 80), view("at-200", 200)];
    let driver = "location.hash = '#exposure=0.05'; await new Promise((done) => setTimeout(done, 200));
        await post('exposure', String(isolume.state.exposure));";
    let posted = compare(dir, &program, &views, driver);
    assert!(posted.contains(&("exposure".into(), b"0.25".into())), "what is brighter is not stored");
    let hidden = "<head><script>{
            const own = WebGL2RenderingContext.prototype.getExtension;
            WebGL2RenderingContext.prototype.getExtension = function (name) {
                return name === 'OES_texture_float_linear' ? null : own.call(this, name);
            };
        }</script>";
    compare_with(&page(dir).replacen("<head>", hidden, 1), dir, &program, &views, "");
}

/// Anisotropic, oblique and flipped axes, closed by caps inside a box with a margin, both sides stored, far from the
/// origin: all that could be mixed up.
#[test]
fn axes_caps_and_sides_are_where_render_has_them() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let dims = [25, 17, 33];
    let axes = DMat3::from_cols(DVec3::new(0.0, 0.2, -1.0), DVec3::new(2.0, 0.0, 0.3), DVec3::new(0.1, -0.9, 0.0));
    let lattice = Lattice::new(dims, DVec3::new(1000.0, -2000.0, 500.0), axes).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let p = lattice.point(o) / DVec3::new(24.0, 16.0, 32.0);
        let bump = |m: DVec3, s: f64| (-(p - m).length_squared() / (2.0 * s * s)).exp();
        (100.0 * bump(DVec3::new(0.6, 0.15, 0.5), 0.2) + 80.0 * bump(DVec3::new(0.3, 0.7, 0.3), 0.12)) as f32
    });
    Volume::new("skew", lattice.clone(), Samples::F32(samples.collect())).unwrap().write(dir.join("b.nrrd")).unwrap();
    let bake = ["bake", "b.nrrd", "--isovalues", "5", "90", "-o", "out.vti", "--box", "cornell", "--margin", "0.1"];
    ok(dir, &[&bake[..], &QUICK, &["--boundary", "capped", "--sides", "both", "--outside", "higher"]].concat());
    let view = |name, shading: &str, extra: &str| View {
        name,
        page: format!("{{ iso: {}, shading: '{shading}' }}", (40.0 - 5.0) / 85.0),
        render: words(&format!("--isovalue 40 {extra}")),
    };
    let views = [view("skew", "global", ""), view("skew-local", "local", "--local")];
    compare(dir, &program, &views, "");
}

/// Solids that stand on the walls all around: within them walls show light of their own, or none.
#[test]
fn walls_within_solids_are_as_render_has_them() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([25; 3], DVec3::ZERO, DVec3::splat(1.0 / 24.0)).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let x = lattice.to_world(lattice.point(o));
        ((9.0 * x.x + 1.5 * x.y).sin() * (6.0 * x.y - 2.5 * x.z).cos() + (5.5 * x.z).sin()) as f32
    });
    Volume::new("waves", lattice.clone(), Samples::F32(samples.collect())).unwrap().write(dir.join("b.nrrd")).unwrap();
    let bake = ["bake", "b.nrrd", "--isovalues", "-2", "2", "-o", "out.vti"];
    // Nobody looks for light within solids if most is outside and only that is stored.
    for (sides, engine, outside) in
        [("both", "sweep", "higher"), ("both", "photon", "higher"), ("outside", "sweep", "lower")]
    {
        let asked = ["--engine", engine, "--sides", sides, "--outside", outside];
        ok(dir, &[&bake[..], &QUICK, &asked].concat());
        let stored = BakedVolume::read(&dir.join("out.vti")).unwrap().flats;
        let own = stored.iter().flatten().filter(|light| light.own().is_some()).count();
        assert_eq!(own > 3, sides == "both", "{engine}, {sides}: {own}");
        let name = if sides == "both" { "waves-both" } else { "waves-outside" };
        let views = [View { name, page: "{ iso: 0.45 }".to_owned(), render: words("--isovalue -0.2") }];
        compare(dir, &program, &views, "");
    }
}

/// Direct light that the page computes itself: on a skew volume with a finer grid, whose normals are those of the
/// volume, by a square above and a triangle in front.
#[test]
fn split_light_is_what_render_draws() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let axes = DMat3::from_cols(DVec3::new(0.0, 0.2, -1.0), DVec3::new(2.0, 0.0, 0.3), DVec3::new(0.1, -0.9, 0.0));
    let lattice = Lattice::new([11, 7, 13], DVec3::new(1000.0, -2000.0, 500.0), 2.0 * axes).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let p = lattice.point(o) / DVec3::new(10.0, 6.0, 12.0);
        let bump = |m: DVec3, s: f64| (-(p - m).length_squared() / (2.0 * s * s)).exp();
        (100.0 * bump(DVec3::new(0.6, 0.15, 0.5), 0.2) + 80.0 * bump(DVec3::new(0.3, 0.7, 0.3), 0.12)) as f32
    });
    Volume::new("skew", lattice.clone(), Samples::F32(samples.collect())).unwrap().write(dir.join("b.nrrd")).unwrap();
    let lamp = "newmtl lamp\nKd 0 0 0\nKe 1 6 9\n";
    fs::write(dir.join("lamp.mtl"), lamp).unwrap();
    // A triangle in front of the volume, facing it.
    let lamp = "mtllib lamp.mtl\nusemtl lamp\nv 1000 -2030 478\nv 1006 -2030 478\nv 1003 -2030 484\nf 1 3 2\n";
    fs::write(dir.join("lamp.obj"), lamp).unwrap();
    let scene = "isovalues = [5, 90]\n[volume]\nfile = \"b.nrrd\"\n[surface]\noutside = \"higher\"\nsides = \"both\"\n\
                 albedo = [{ isovalue = 5, colour = [0.9, 0.8, 0.7] }, { isovalue = 90, colour = [0.3, 0.4, 0.5] }]\n[box]\nmargin = 0.3\n[[context]]\nfile = \"lamp.obj\"\n\
                 [bake]\npreset = \"preview\"\ngrid = \"2x\"\nsplit = true\n";
    fs::write(dir.join("b.toml"), scene).unwrap();
    ok(dir, &["bake", "b.toml", "-o", "out.vti", "-q"]);
    let baked = BakedVolume::read(&dir.join("out.vti")).unwrap();
    let lights = baked.scene.luminaires().iter().map(|l| l.vertices().len());
    assert!(baked.sides.iter().all(|(_, grid)| grid.split.is_some()) && lights.collect::<Vec<_>>() == [4, 3, 3]);
    let view = |name, iso: f64, extra: &str| View {
        name,
        page: format!("{{ iso: {} }}", (iso - 5.0) / 85.0),
        render: words(&format!("--isovalue {iso} {extra}")),
    };
    compare(dir, &program, &[view("split-40", 40.0, ""), view("split-15", 15.0, "")], "");
    // What the page shows is not the grid's radiance.
    let whole = Bytes::render(dir, &["--isovalue", "40"]);
    ok(dir, &["bake", "b.toml", "-o", "out.vti", "-q", "--split=false"]);
    let without = Bytes::render(dir, &["--isovalue", "40"]);
    let differing = whole.rgb.iter().zip(&without.rgb).filter(|(a, b)| a != b).count();
    println!("{differing} pixels differ from those without");
    assert!(differing > 500);
}

/// Densities that fall by orders of magnitude, whose walls hold their isovalues along a bent axis: two level sets that
/// lie within a texel of an even one.
#[test]
fn walls_of_crowded_isovalues_are_as_bright_as_render_has_them() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([33; 3], DVec3::splat(-0.5), DVec3::splat(1.0 / 32.0)).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let x = lattice.to_world(lattice.point(o));
        (-15.0 * (x - DVec3::new(0.013, -0.02, -0.007)).length()).exp()
    });
    let volume = Volume::new("density", lattice.clone(), Samples::F64(samples.collect())).unwrap();
    volume.write(dir.join("b.nrrd")).unwrap();
    ok(
        dir,
        &[&["bake", "b.nrrd", "--isovalues", "0.001", "1", "-o", "out.vti", "--margin", "0.1"][..], &QUICK].concat(),
    );
    let texels = BakedVolume::read(&dir.join("out.vti")).unwrap().flats.into_iter().flatten();
    assert!(texels.map(|t| t.outside.axis).all(|axis| !axis.is_even() && axis.place(0.01) > 0.2));
    let views = [0.0015, 0.01].map(|isovalue: f64| View {
        name: if isovalue < 0.005 { "faint" } else { "dense" },
        page: format!("{{ iso: {} }}", (isovalue - 0.001) / 0.999),
        render: words(&format!("--isovalue {isovalue}")),
    });
    compare(dir, &program, &views, "");
}

/// Two blobs that only isovalues of some 10⁻⁵ of the sweep join: in even steps of a page there were two of these, and
/// what was drawn was another isosurface.
#[test]
fn isovalues_over_decades_are_where_render_has_them() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    let lattice = Lattice::aligned([40; 3], DVec3::splat(-0.5), DVec3::splat(1.0 / 39.0)).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let x = lattice.to_world(lattice.point(o));
        let blob = |centre: DVec3, steepness: f64| (-steepness * (x - centre).length()).exp();
        100.0 * (blob(DVec3::new(0.1, 0.05, -0.1), 28.0) + 0.7 * blob(DVec3::new(-0.15, -0.05, 0.1), 24.0))
    });
    let volume = Volume::new("density", lattice.clone(), Samples::F64(samples.collect())).unwrap();
    volume.write(dir.join("b.nrrd")).unwrap();
    ok(dir, &[&["bake", "b.nrrd", "--isovalues", "0.001", "100", "-o", "out.vti"][..], &QUICK].concat());
    let views = [("joined", 0.002), ("faint", 0.01), ("dense", 2.0)].map(|(name, isovalue): (_, f64)| View {
        name,
        page: format!("{{ iso: {}, shading: 'local' }}", (isovalue - 0.001) / 99.999),
        render: words(&format!("--isovalue {isovalue} --local")),
    });
    compare(dir, &program, &views, "");
}

/// Samples that are not finite were above every isovalue: their borders were drawn as surfaces, and as caps.
#[test]
fn gaps_are_open_where_render_has_them() {
    let Some(program) = chromium() else { return };
    let lattice = Lattice::aligned([25; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    for (names, boundary, gap) in [
        (["shell", "shell-local"], "open", 3),
        (["slab", "slab-local"], "open", 9),
        (["capped", "capped-local"], "capped", 3),
    ] {
        let dir = Folder::new();
        let dir = dir.path();
        let samples = (0..lattice.len()).map(|o| {
            let p = lattice.point(o);
            if p.y < f64::from(gap) { f64::NAN } else { 1.0 - (p / 12.0 - 1.0).length() }
        });
        let volume = Volume::new("ball", lattice.clone(), Samples::F64(samples.collect())).unwrap();
        volume.write(dir.join("b.nrrd")).unwrap();
        let bake = ["bake", "b.nrrd", "--isovalues", "-0.4", "0.9", "-o", "out.vti", "--margin", "0.1"];
        ok(dir, &[&bake[..], &QUICK, &["--boundary", boundary]].concat());
        let view = |name, shading: &str, extra: &str| View {
            name,
            page: format!("{{ iso: {}, shading: '{shading}' }}", (-0.2 + 0.4) / 1.3),
            render: words(&format!("--isovalue -0.2 {extra}")),
        };
        compare(dir, &program, &[view(names[0], "global", ""), view(names[1], "local", "--local")], "");
    }
}

#[test]
fn a_file_needs_no_server_and_writes_nothing_to_the_console() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    bake_bumps(dir, "21", &[]);
    ok(dir, &["view", "out.vti", "-o", "page.html", "-q"]);
    let address = format!("file://{}#isovalue=47&azimuth=20", dir.join("page.html").display());
    let output = browser::command(&program, &dir.join("profile"))
        .args(["--window-size=800,600", "--virtual-time-budget=20000", "--run-all-compositor-stages-before-draw"])
        .arg(format!("--screenshot={}", dir.join("shot.png").display()))
        .arg(address)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    // What Chromium says about its own software renderer is not the page's.
    let own = |l: &&str| l.contains("CONSOLE") && !l.contains("GL Driver Message") && !l.contains("software WebGL");
    let console: Vec<&str> = said.lines().filter(own).collect();
    assert!(console.is_empty(), "{console:?}");
    let file = fs::File::open(dir.join("shot.png")).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut bytes).unwrap();
    assert!(bytes.iter().filter(|b| **b > 60).count() > bytes.len() / 10, "the screenshot is not dark");
}

#[test]
fn without_webgl2_the_page_says_so() {
    let Some(program) = chromium() else { return };
    let dir = Folder::new();
    let dir = dir.path();
    bake_bumps(dir, "9", &[]);
    ok(dir, &["view", "out.vti", "-o", "page.html", "-q"]);
    let page = fs::read_to_string(dir.join("page.html")).unwrap();
    let without = "<body><script>HTMLCanvasElement.prototype.getContext = () => null;</script>";
    let driver = "await isolume.ready.catch(() => 0); const m = document.getElementById('message');
        await post('message', m.hidden ? '' : m.textContent);";
    let posted = browser::drive(&program, &page.replacen("<body>", without, 1), driver, 60);
    let (_, message) = posted.iter().find(|(name, _)| name == "message").unwrap();
    assert!(String::from_utf8_lossy(message).contains("needs WebGL2"), "{}", String::from_utf8_lossy(message));
}

#[test]
fn pages_are_a_function_of_the_bake() {
    let dir = Folder::new();
    let baked = bake_bumps(dir.path(), "13", &[]);
    let [a, b] = [0, 1].map(|_| Payload::new(&baked, "t").unwrap());
    assert_eq!((a.description.to_string(), &a.bytes), (b.description.to_string(), &b.bytes));
}
