//! A bake as one HTML file that needs no network: the page marches rays through the volume's 3D texture (WebGL2) and
//! colours what they meet by the illumination grid, while a slider sweeps the isovalue.

pub mod codec;

use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::files;
use crate::flat::{self, FlatLight, FlatTexture, Within};
use crate::flattened::Side;
use crate::isovalue_axis::IsovalueAxis;
use crate::mask::Mask;
use crate::polygon::Polygon;
use crate::render::Camera;
use crate::scene::Scene;
use crate::split::{MOST_VISIBLE, Split};
use base64::Engine;
use flate2::{Compression, write::ZlibEncoder};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

/// Bins of the histogram under the slider, over the sweep's axis.
const BINS: usize = 256;

/// The most points that a page may hold: what browsers and graphics memory bear (8 bytes each on the card).
const MOST_POINTS: usize = 1 << 27;

/// What a page is made of, before it is packed.
#[derive(Debug)]
pub struct Payload {
    /// Scene, camera, histogram, and where each array lies in `bytes`.
    pub description: Value,
    /// The arrays, one after another: see [`codec`].
    pub bytes: Vec<u8>,
}

/// Coordinates of the page: the scene's bounds moved to the origin and scaled to a half diagonal of 1, since graphics
/// cards know 32-bit floats only.
struct Frame {
    centre: DVec3,
    size: f64,
}

impl Frame {
    fn point(&self, x: DVec3) -> Value {
        self.vector(x - self.centre)
    }

    fn vector(&self, v: DVec3) -> Value {
        json!((v / self.size).to_array())
    }
}

impl Payload {
    /// Collects what the page needs of a bake.
    ///
    /// # Errors
    /// `NotSupported` for more than 2²⁷ points.
    #[allow(clippy::cast_possible_truncation, reason = "colours are f32")]
    pub fn new(baked: &BakedVolume, title: &str) -> Result<Self> {
        let scene = &baked.scene;
        if scene.fields() > 1 {
            return Err(Error::NotSupported("holds several volumes; name the .vti of one of them".into()));
        }
        let lattice = scene.lattice();
        if lattice.len() > MOST_POINTS {
            let [x, y, z] = lattice.dims();
            return Err(Error::NotSupported(format!(
                "{x}×{y}×{z} points are too many for a browser ({MOST_POINTS} at most); bake with a smaller --grid"
            )));
        }
        let [lo, hi] = scene.bounds();
        let frame = Frame { centre: 0.5 * (lo + hi), size: 0.5 * (hi - lo).length() };
        // Colours are stored up to `scale` times the display's white, so that lower exposures have something to show.
        let brightest = |colours: &[[f32; 3]]| colours.as_flattened().par_iter().copied().reduce(|| 0.0, f32::max);
        let most = baked.sides.iter().map(|(_, g)| brightest(&g.radiance));
        let most = most
            .chain(baked.flats.iter().flatten().flat_map(FlatLight::textures).map(|t| brightest(&t.texels)))
            .fold(0.0, f32::max);
        let scale = (f64::from(most) * baked.exposure).clamp(1.0, 4.0);
        let factor = (baked.exposure / scale) as f32;

        let mut bytes = Vec::new();
        let samples = scene.field.samples();
        let axis = IsovalueAxis::of([samples]);
        let codes: Vec<u16> = samples.par_iter().map(|&s| codec::encode(&axis, s)).collect();
        codec::append_codes(&mut bytes, &codes);
        drop(codes);
        let luminaires = luminaires(baked, &frame);
        let (mut lights, mut visible) = (Vec::new(), Vec::new());
        for (_, grid) in &baked.sides {
            lights.push(bytes.len());
            let split = grid.split.as_ref().filter(|_| !luminaires.is_empty());
            codec::append_colours(&mut bytes, split.map_or(&grid.radiance, |split| &split.indirect), factor);
            codec::append_plane(&mut bytes, grid.mask.iter().map(|&m| if m == Mask::Empty { 0 } else { 255 }));
            if let Some(Split { visible: shares, .. }) = split {
                visible.push(bytes.len());
                codec::append_colours(&mut bytes, shares, 1.0 / MOST_VISIBLE);
            }
        }
        let flats: Vec<Value> = (0..flat::count(scene))
            .filter(|&n| !leaves_out(scene) || scene.polygons().get(n).is_none_or(|p| p.other_face == 0))
            .filter_map(|n| describe_flat(baked, &frame, n, factor, &mut bytes))
            .collect();
        let axes = lattice.axes();
        let sweep = scene.field.sweep();
        let camera = Camera::facing(scene, 1000);
        let description = json!({
            "title": title,
            "isovalues": [sweep.lo(), sweep.hi()],
            "scale": scale,
            "dims": lattice.dims(),
            "axes": [frame.vector(axes.x_axis), frame.vector(axes.y_axis), frame.vector(axes.z_axis)],
            "inverse": (DMat3::from_cols(axes.x_axis, axes.y_axis, axes.z_axis).inverse() * frame.size).to_cols_array(),
            "origin": frame.point(lattice.origin()),
            "bounds": [frame.point(lo), frame.point(hi)],
            "world": { "bounds": [lo.to_array(), hi.to_array()] },
            "camera": { "eye": frame.point(camera.eye), "fov": camera.fov },
            "outside_lower": scene.surface.outside == Side::Lower,
            "capped": scene.is_capped(),
            "albedo": scene.surface.albedo.stops(),
            "lights": lights,
            "split": {
                "visible": visible,
                "most": MOST_VISIBLE,
                "luminaires": luminaires,
                // A finer grid's normals are those of the volume.
                "steps": normal_steps(scene),
            },
            "flats": flats,
            "axis": axis,
            "histogram": histogram(&axis, samples),
            "length": bytes.len(),
        });
        Ok(Self { description, bytes })
    }

    /// The page as text.
    pub fn to_html(&self) -> String {
        self.html(PART)
    }

    /// The page whose data come in parts of `part` characters, which each can be decoded by itself.
    fn html(&self, part: usize) -> String {
        let mut packed = ZlibEncoder::new(Vec::new(), Compression::new(7));
        let packed = packed.write_all(&self.bytes).and_then(|()| packed.finish()).expect("memory does not fail");
        let mut data = String::new();
        for bytes in packed.chunks(part / 4 * 3) {
            data.push_str("<script type=\"text/plain\" class=\"data\">");
            base64::engine::general_purpose::STANDARD.encode_string(bytes, &mut data);
            data.push_str("</script>\n");
        }
        // Inside a script element, only a tag could end the text.
        let description = self.description.to_string().replace('<', "\\u003c");
        let (head, rest) = include_str!("view/page.html").split_once("@description@").expect("the page's own mark");
        let (middle, rest) = rest.split_once("@data@").expect("the page's own mark");
        let (before, tail) = rest.split_once("@script@").expect("the page's own mark");
        let script = [include_str!("view/shaders.js"), include_str!("view/viewer.js")].concat();
        [head, &description, middle, &data, before, &script, tail].concat()
    }
}

/// Characters of one part of the data: browsers' strings end at 2²⁹ or 2³⁰.
const PART: usize = 1 << 27;

/// Polygons that a page draws at most, each by itself.
pub const MOST_POLYGONS: usize = 2048;

/// Whether a page leaves context geometry out, because there is too much.
pub fn leaves_out(scene: &Scene) -> bool {
    scene.polygons().len() > MOST_POLYGONS
}

/// A wall, luminaire or cap for the page, its texture appended to `bytes`; `None` for caps of an open boundary.
fn describe_flat(baked: &BakedVolume, frame: &Frame, n: usize, factor: f32, bytes: &mut Vec<u8>) -> Option<Value> {
    let scene = &baked.scene;
    let f = flat::flat(scene, n)?;
    let polygon = scene.polygons().get(n);
    let corner = f.at([0.0, 0.0]);
    let (e, g) = (f.at([1.0, 0.0]) - corner, f.at([0.0, 1.0]) - corner);
    let vertices =
        polygon.map_or_else(|| vec![corner, corner + e, corner + e + g, corner + g], |p| p.vertices().to_vec());
    // (u, v) = (du · (x − corner), dv · (x − corner)): the dual vectors of two edges that need not be perpendicular.
    let dual = |a: DVec3, b: DVec3| {
        let across = a - b * (a.dot(b) / b.dot(b));
        (across / across.dot(across) * frame.size).to_array()
    };
    let mut texture = |t: &FlatTexture| {
        let offset = bytes.len();
        codec::append_colours(bytes, &t.texels, factor);
        json!({ "offset": offset, "dims": t.dims, "axis": t.axis })
    };
    let light = baked.flats[n].as_ref();
    let outside = light.map(|light| texture(&light.outside));
    let within = light.and_then(FlatLight::own).map(texture);
    let emission = polygon.map_or(DVec3::ZERO, |p| p.emission * baked.exposure);
    Some(json!({
        "name": polygon.map_or("cap", |p| p.name.as_str()),
        "cap": polygon.is_none(),
        "vertices": vertices.into_iter().map(|v| frame.point(v)).collect::<Vec<_>>(),
        "normal": f.normal.to_array(),
        "albedo": f.albedo.stops(),
        "emission": emission.to_array(),
        "opaqueBack": polygon.is_some_and(|p| p.opaque_back),
        "corner": frame.point(corner),
        "du": dual(e, g),
        "dv": dual(g, e),
        "texture": outside,
        "within": within,
        "outsideOnly": light.is_some_and(|light| light.within == Within::Unknown),
    }))
}

/// Luminaires, and corners of them, from which a page computes direct light at most; of more it shows the radiance of
/// the grid's points.
const MOST_LUMINAIRES: usize = 8;
const MOST_CORNERS: usize = 64;

/// What direct light of a split bake is computed from; none where the page takes radiance instead.
fn luminaires(baked: &BakedVolume, frame: &Frame) -> Vec<Value> {
    let scene = &baked.scene;
    let all = scene.luminaires();
    let corners: usize = all.iter().map(|l| l.vertices().len()).sum();
    let split = baked.sides.iter().all(|(_, grid)| grid.split.is_some());
    if !split || all.len() > MOST_LUMINAIRES || corners > MOST_CORNERS {
        return Vec::new();
    }
    let describe = |l: &Polygon| {
        json!({
            "corners": l.vertices().iter().map(|&v| frame.point(v)).collect::<Vec<_>>(),
            "normal": l.normal().to_array(),
            "power": (l.emission * baked.exposure).to_array(),
        })
    };
    all.iter().map(describe).collect()
}

/// Points of the grid between the samples that normals come from, along each axis.
fn normal_steps(scene: &Scene) -> [f64; 3] {
    (scene.lattice().far() / scene.field.normals_from().lattice().far()).to_array()
}

/// Samples per bin of the sweep's axis.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in [0, BINS]")]
fn histogram(axis: &IsovalueAxis, samples: &[f32]) -> Vec<u64> {
    let mut bins = vec![0; BINS];
    for &s in samples.iter().filter(|s| (0.0..=1.0).contains(*s)) {
        bins[((axis.place(s) * BINS as f32) as usize).min(BINS - 1)] += 1;
    }
    bins
}

/// Writes the page of a bake; returns its size in bytes.
///
/// # Errors
/// `NotSupported` for a bake too large for browsers; `Io`.
pub fn write(path: &Path, baked: &BakedVolume, title: &str) -> Result<usize> {
    let html = Payload::new(baked, title)?.to_html();
    files::write_text(path, &html)?;
    Ok(html.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_short_and_make_up_the_whole() {
        let bytes: Vec<u8> = (0..5000u64).map(|n| (n * n % 251) as u8).collect();
        let payload = Payload { description: json!({}), bytes };
        let html = payload.html(64);
        let parts: Vec<&str> =
            html.split("class=\"data\">").skip(1).map(|part| part.split_once("</script>").unwrap().0).collect();
        assert!(parts.len() > 5 && parts.iter().all(|p| p.len() <= 64), "{}", parts.len());
        let decoded = |part: &&str| base64::engine::general_purpose::STANDARD.decode(part).unwrap();
        let packed: Vec<u8> = parts.iter().flat_map(decoded).collect();
        let mut found = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::ZlibDecoder::new(&packed[..]), &mut found).unwrap();
        assert!(found == payload.bytes);
    }
}
