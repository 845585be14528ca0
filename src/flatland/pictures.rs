//! Figures 2 to 4 of BB09: the lit height field in perspective, waterlines, photons, and the level sets below.

use super::contour::level_curve;
use super::solution::lookup;
use super::{GraphSurface, HeightField, Landing, Receiver, Solution, Transport, World};
use crate::embree::Device;
use crate::error::Result;
use crate::export::picture::Picture;
use crate::files;
use crate::flattened::{FlattenedRay, Target};
use crate::progress::{interrupted, unless_interrupted};
use crate::rng::{Sobol, Stage};
use crate::tracer::Tracer;
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::fmt::Write as _;
use std::path::Path;

/// What to draw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PictureSettings {
    /// Pixels across one picture; it is 5 : 4.
    pub width: usize,
    /// Rays per pixel.
    pub samples: u32,
    /// Points of the drawn grid per cell and axis; half as many for indirect light.
    pub factor: usize,
    /// Gather directions per drawn point; twice as many when ordinary.
    pub gather: u32,
    /// Shadow rays per drawn point and luminaire; sixteen times as many when ordinary.
    pub shadow: u32,
    /// Level sets to draw.
    pub levels: usize,
    /// Photons to draw; 0: no such picture.
    pub paths: u64,
}

impl Default for PictureSettings {
    fn default() -> Self {
        Self { width: 640, samples: 16, factor: 4, gather: 128, shadow: 16, levels: 10, paths: 0 }
    }
}

/// Light of the graph's shown side on fine grids, and of the walls. All points of a grid share one set of directions:
/// what error is left is smooth over the surface instead of speckled.
struct Look<'a> {
    world: &'a World,
    solution: &'a Solution,
    direct: Raster,
    indirect: Raster,
    exposure: f64,
}

/// Light per albedo at `factor` points per cell and axis.
struct Raster {
    dims: [usize; 2],
    factor: f32,
    values: Vec<[f32; 3]>,
}

impl Raster {
    /// Nothing once someone has asked to stop.
    fn new(world: &World, factor: usize, light: impl Fn(&Receiver) -> DVec3 + Sync) -> Self {
        let dims = world.scene.field.dims().map(|n| (n - 1) * factor + 1);
        let values = (0..dims[0] * dims[1])
            .into_par_iter()
            .map(|o| {
                let p = DVec2::new((o % dims[0]) as f64, (o / dims[0]) as f64) / factor as f64;
                let receiver = (!interrupted()).then(|| world.graph_receiver(p, world.scene.outside)).flatten();
                receiver.map_or([f32::NAN; 3], |r| light(&r).as_vec3().to_array())
            })
            .collect();
        Self { dims, factor: factor as f32, values }
    }

    fn at(&self, x: f32, y: f32) -> DVec3 {
        lookup(&self.values, self.dims, [x * self.factor, y * self.factor])
    }
}

impl<'a> Look<'a> {
    fn new(world: &'a World, solution: &'a Solution, s: &PictureSettings) -> Self {
        // A sphere of directions needs more of them than a circle, and has softer shadows to spend them on.
        let more = if world.transport == Transport::Ordinary { 2 } else { 1 };
        let set = Sobol::set(solution.seed(), Stage::Direct, 0);
        let factor = (s.factor / more as usize).max(1);
        let direct = Raster::new(world, factor, |r| world.direct(r, s.shadow * more * more * more * more, &set));
        let indirect = Raster::new(world, (s.factor / 2).max(1), |r| world.gathered(r, solution, s.gather * more, 0));
        let mut look = Self { world, solution, direct, indirect, exposure: 1.0 };
        // The brightest fiftieth of the sweep's part of the graph may saturate.
        let field = &world.scene.field;
        let [nx, ny] = field.dims();
        let mut shown: Vec<f64> = (0..nx * ny)
            .filter(|&o| (0.0..=1.0).contains(&field.samples()[o]))
            .map(|o| look.radiance(Landing::Graph((o % nx) as f32, (o / nx) as f32, world.scene.outside)))
            .map(|rgb| rgb.max_element())
            .collect();
        shown.sort_by(f64::total_cmp);
        let bright = shown.get(shown.len() * 49 / 50).copied().unwrap_or(0.0);
        if bright > 0.0 {
            look.exposure = 1.0 / bright;
        }
        look
    }

    fn radiance(&self, landing: Landing) -> DVec3 {
        match landing {
            Landing::Graph(x, y, side) if side == self.world.scene.outside => {
                self.world.scene.albedo * (self.direct.at(x, y) + self.indirect.at(x, y))
            }
            other => self.solution.radiance(other),
        }
    }
}

/// A perspective view of a scene from beyond its luminaire, whose back wall is not seen from behind.
struct View<'a> {
    world: &'a World,
    geometry: &'a GraphSurface,
    eye: DVec3,
    /// Forward, right and down, the latter two per pixel.
    basis: [DVec3; 3],
    size: [usize; 2],
    seed: u64,
}

impl<'a> View<'a> {
    fn new(world: &'a World, geometry: &'a GraphSurface, width: usize, seed: u64) -> Self {
        let [lo, hi] = world.scene.field.bounds();
        let (size, height) = (hi - lo, world.scene.height);
        let unit = size.max_element();
        let up = world.scene.outside.facing(1.0);
        let middle = if up > 0.0 { 0.25 } else { 0.75 };
        let target = (lo + size * DVec2::new(0.5, 0.5)).extend(middle * height);
        let back = DVec3::new(0.0, 1.35, 1.85 * up);
        let pixels = [width, (width * 4).div_ceil(5)];
        let forward = -back.normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let down = forward.cross(right);
        let slope = f64::to_radians(15.5).tan();
        let scale = 2.0 * slope / pixels[1] as f64;
        // As far back as it takes to see all corners of the box.
        let slopes = [(right, slope * pixels[0] as f64 / pixels[1] as f64), (down, slope)];
        let mut distance = back.length() * unit;
        for corner in 0..8 {
            let at = |axis: u32| if corner >> axis & 1 == 0 { DVec3::ZERO } else { DVec3::AXES[axis as usize] };
            let p = lo.extend(0.0) + (at(0) + at(1) + at(2)) * size.extend(height) - target;
            for (axis, slope) in slopes {
                distance = distance.max(p.dot(axis).abs() / slope - p.dot(forward));
            }
        }
        let eye = target - distance * forward;
        let basis = [forward, right * scale, down * scale];
        Self { world, geometry, eye, basis, size: pixels, seed }
    }

    /// World direction through pixel coordinates.
    fn direction(&self, x: f64, y: f64) -> DVec3 {
        let [forward, right, down] = self.basis;
        forward + (x - 0.5 * self.size[0] as f64) * right + (y - 0.5 * self.size[1] as f64) * down
    }

    /// Pixel coordinates of a world point.
    fn project(&self, p: DVec3) -> Option<DVec2> {
        let [forward, right, down] = self.basis;
        let d = p - self.eye;
        let depth = d.dot(forward);
        let on = |axis: DVec3| d.dot(axis) / (depth * axis.length_squared());
        let centre = 0.5 * DVec2::new(self.size[0] as f64, self.size[1] as f64);
        (depth > 0.0).then(|| centre + DVec2::new(on(right), on(down)))
    }

    /// A ray of the view in the geometry's frame.
    fn ray(&self, direction: DVec3) -> FlattenedRay {
        let (field, height) = (&self.world.scene.field, self.world.scene.height);
        let origin = field.to_index(self.eye.truncate()).extend(self.eye.z / height);
        let d = (direction.truncate() / field.spacing()).extend(direction.z / height);
        FlattenedRay::free(origin.as_vec3(), d.as_vec3(), 0.0)
    }

    /// What is seen along a direction: where, and its height in units of the sweep. Backs of luminaires are not.
    fn see(&self, direction: DVec3) -> Seen {
        let mut ray = self.ray(direction);
        let segments = &self.world.scene.segments;
        let mut hit = self.geometry.intersect(&ray);
        if let Some(Target::Polygon(id)) = hit.map(|h| h.target)
            && segments[id as usize].emits()
        {
            if segments[id as usize].normal().dot(direction.truncate()) < 0.0 {
                return Seen::Luminaire(segments[id as usize].emission);
            }
            ray.target = Some(id);
            hit = self.geometry.intersect(&ray);
        }
        let Some(hit) = hit else { return Seen::Nothing };
        let p = ray.at(hit.t);
        match hit.target {
            Target::Surface(side) => Seen::Thing(Landing::Graph(p.x as f32, p.y as f32, side), p.z),
            Target::Polygon(id) => {
                let [a, b] = segments[id as usize].ends;
                let x = self.world.scene.field.to_world(p.truncate());
                let u = (x - a).dot(b - a) / (b - a).length_squared();
                Seen::Thing(Landing::Wall(id as u16, u.clamp(0.0, 1.0) as f32, p.z as f32), p.z)
            }
            Target::Cap(..) | Target::Companion(..) => Seen::Nothing,
        }
    }

    /// Averages `shade` over stratified rays per pixel; black once someone has asked to stop.
    fn draw(&self, samples: u32, shade: impl Fn(Seen) -> DVec3 + Sync) -> Picture {
        let [w, h] = self.size;
        let mut picture = Picture::new(w, h);
        picture.rgb.par_iter_mut().enumerate().for_each(|(o, pixel)| {
            if interrupted() {
                return;
            }
            let set = Sobol::set(self.seed, Stage::Picture, o as u64);
            let mut sum = DVec3::ZERO;
            for i in 0..samples {
                let [x, y] = set.point2(i, 0);
                sum += shade(self.see(self.direction((o % w) as f64 + x, (o / w) as f64 + y)));
            }
            *pixel = (sum / f64::from(samples)).as_vec3().to_array();
        });
        picture
    }

    /// Draws the visible parts of a line of the world over a picture of display values.
    fn line(&self, picture: &mut Picture, a: DVec3, b: DVec3, colour: DVec3, width: f64) {
        let (Some(pa), Some(pb)) = (self.project(a), self.project(b)) else { return };
        let steps = ((pb - pa).length() * 2.0).clamp(2.0, 4000.0) as usize;
        let [w, h] = self.size;
        for k in 0..=steps {
            let p = a.lerp(b, k as f64 / steps as f64);
            let mut ray = self.ray(p - self.eye);
            ray.reach = 0.997;
            // Luminaires and walls are glass to lines: they end there.
            if self.geometry.intersect(&ray).is_some_and(|hit| matches!(hit.target, Target::Surface(_))) {
                continue;
            }
            let Some(q) = self.project(p) else { continue };
            let (x, y) = (q.x.floor() as i64, q.y.floor() as i64);
            for (i, j) in (-2..=2).flat_map(|j| (-2..=2).map(move |i| (x + i, y + j))) {
                if i < 0 || j < 0 || i >= w as i64 || j >= h as i64 {
                    continue;
                }
                let distance = (DVec2::new(i as f64 + 0.5, j as f64 + 0.5) - q).length();
                // Steps overlap: each covers a little.
                let cover = (0.5 * width + 0.5 - distance).clamp(0.0, 1.0) * 0.35;
                let pixel = &mut picture.rgb[j as usize * w + i as usize];
                let old = DVec3::from_array(pixel.map(f64::from));
                *pixel = old.lerp(colour, cover).as_vec3().to_array();
            }
        }
    }
}

/// What a camera ray meets.
enum Seen {
    Nothing,
    Luminaire(DVec3),
    Thing(Landing, f64),
}

/// The paper around the box.
const BACKGROUND: DVec3 = DVec3::ONE;

/// Display values of a lit scene, with dark waterlines at `levels` (units of the sweep).
fn lit(view: &View, look: &Look, samples: u32, levels: &[f64], brightness: f64) -> Picture {
    let exposure = brightness * look.exposure;
    let field = &view.world.scene.field;
    let line = 0.0035 * (field.bounds()[1] - field.bounds()[0]).max_element();
    view.draw(samples, |seen| match seen {
        Seen::Nothing => BACKGROUND,
        Seen::Luminaire(emission) => emission,
        Seen::Thing(landing, s) => {
            // Clamped before averaging: bright edges stay smooth.
            let rgb = (look.radiance(landing) * exposure).min(DVec3::ONE);
            if let Landing::Graph(x, y, _) = landing {
                let g = field.gradient(DVec2::new(x.into(), y.into())).length() * view.world.scene.height;
                // Distance on the surface to the curve, by its slope.
                let near = |c: f64| (s - c).abs() * view.world.scene.height * (1.0 + g * g).sqrt() < 0.5 * line * g;
                if levels.iter().any(|&c| near(c)) {
                    return 0.15 * rgb;
                }
            }
            rgb
        }
    })
}

/// Pictures of one height in a row.
pub(super) fn side_by_side(pictures: &[Picture]) -> Picture {
    let gap = pictures[0].width / 40;
    let width = pictures.iter().map(|p| p.width).sum::<usize>() + gap * (pictures.len() - 1);
    let mut out = Picture::new(width, pictures[0].height);
    out.rgb.fill([1.0; 3]);
    let mut left = 0;
    for p in pictures {
        for y in 0..p.height {
            out.rgb[y * width + left..][..p.width].copy_from_slice(&p.rgb[y * p.width..][..p.width]);
        }
        left += p.width + gap;
    }
    out
}

/// Writes the pictures of solved worlds over one scene, the flattened one first, into `folder`:
/// `<transport>.png` and `.exr`, `waterlines.png`, `levelsets.svg`, `both.png` if there are two, and `paths.png` with
/// [`PictureSettings::paths`] photons. Returns the names.
///
/// # Errors
/// `Io`, `Embree`, `Interrupted`.
pub fn write_pictures(
    folder: &Path,
    device: &Device,
    worlds: &[(World, Solution)],
    settings: &PictureSettings,
) -> Result<Vec<String>> {
    let Some((first, solution)) = worlds.first() else { return Ok(Vec::new()) };
    // Walls reach down to a graph that dips a little below the sweep, else a slit would show.
    let lowest = first.scene.field.samples().iter().fold(0f32, |m, &s| m.min(s)).max(-0.1);
    let geometry = GraphSurface::with_heights(device, &first.scene, [f64::from(lowest), 1.0])?;
    let view = View::new(first, &geometry, settings.width, solution.seed());
    let levels: Vec<f64> = (0..settings.levels).map(|k| (k as f64 + 0.5) / settings.levels as f64).collect();
    let mut names = Vec::new();
    let mut both = Vec::new();
    let mut looks = Vec::new();
    for (world, solution) in worlds {
        let name = if world.transport == Transport::Flattened { "flattened" } else { "ordinary" };
        let look = Look::new(world, solution, settings);
        let linear = view.draw(settings.samples, |seen| match seen {
            Seen::Nothing => DVec3::ZERO,
            Seen::Luminaire(emission) => emission,
            Seen::Thing(landing, _) => look.radiance(landing),
        });
        let attributes = [
            ("isolume:transport".to_owned(), name.to_owned()),
            ("isolume:exposure".to_owned(), look.exposure.to_string()),
        ];
        unless_interrupted()?;
        linear.write_exr(folder.join(format!("{name}.exr")), &attributes)?;
        let shown = lit(&view, &look, settings.samples, &[], 1.0);
        unless_interrupted()?;
        shown.write_png(folder.join(format!("{name}.png")), 1.0)?;
        names.extend([format!("{name}.png"), format!("{name}.exr")]);
        both.push(shown);
        looks.push(look);
    }
    if both.len() > 1 {
        side_by_side(&both).write_png(folder.join("both.png"), 1.0)?;
        names.push("both.png".into());
    }
    let waterlines = lit(&view, &looks[0], settings.samples, &levels, 1.0);
    unless_interrupted()?;
    waterlines.write_png(folder.join("waterlines.png"), 1.0)?;
    write_svg(&folder.join("levelsets.svg"), &first.scene, &levels)?;
    names.extend(["waterlines.png".to_owned(), "levelsets.svg".to_owned()]);
    if settings.paths > 0 {
        let plane = 0.5;
        let mut pictures = Vec::new();
        for look in &looks {
            let waterline: &[f64] = if look.world.transport == Transport::Flattened { &[plane] } else { &[] };
            let mut picture = lit(&view, look, settings.samples, waterline, 0.6);
            draw_paths(&view, look.world, &mut picture, plane, settings.paths)?;
            pictures.push(picture);
        }
        unless_interrupted()?;
        side_by_side(&pictures).write_png(folder.join("paths.png"), 1.0)?;
        names.push("paths.png".into());
    }
    Ok(names)
}

/// Photons from the luminaire at one height: yellow, then the colour of what reflected them.
///
/// # Errors
/// `Interrupted`.
fn draw_paths(view: &View, world: &World, picture: &mut Picture, plane: f64, count: u64) -> Result<()> {
    for index in 0..count {
        unless_interrupted()?;
        let path = world.photon_path(view.seed, index, plane, 3);
        let mut colour = DVec3::new(1.0, 0.75, 0.05);
        for pair in path.windows(2) {
            view.line(picture, pair[0].position, pair[1].position, colour, 1.2);
            colour = match pair[1].landing {
                Landing::Dark => break,
                Landing::Graph(..) => DVec3::new(0.1, 0.3, 0.9),
                wall @ Landing::Wall(..) => world.albedo(wall) * 1.3,
            };
        }
    }
    Ok(())
}

/// The level sets in the plane with walls and luminaire. \[BB09 Fig. 2\]
fn write_svg(path: &Path, scene: &super::FlatScene, levels: &[f64]) -> Result<()> {
    let [lo, hi] = scene.field.bounds();
    let scale = 480.0 / (hi - lo).max_element();
    let at = |x: DVec2| [(x.x - lo.x) * scale + 20.0, (hi.y - x.y) * scale + 20.0];
    let size = (hi - lo) * scale + 40.0;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {:.0} {:.0}\" fill=\"none\" stroke-linecap=\"round\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n",
        size.x, size.y
    );
    for &c in levels {
        let _ = write!(svg, "<path stroke=\"#235\" stroke-width=\"1.2\" d=\"");
        for [a, b] in level_curve(&scene.field, c) {
            let ([ax, ay], [bx, by]) = (at(scene.field.to_world(a)), at(scene.field.to_world(b)));
            let _ = write!(svg, "M{ax:.1} {ay:.1}L{bx:.1} {by:.1}");
        }
        let _ = writeln!(svg, "\"><title>{}</title></path>", scene.field.sweep().from_unit(c));
    }
    for s in scene.segments.iter() {
        let ([ax, ay], [bx, by]) = (at(s.ends[0]), at(s.ends[1]));
        let colour = if s.emits() {
            "#fc3".to_owned()
        } else {
            let [r, g, b] =
                (s.albedo * 0.8).to_array().map(|v| (crate::export::picture::srgb_encode(v as f32) * 255.0) as u8);
            format!("#{r:02x}{g:02x}{b:02x}")
        };
        let width = if s.emits() { 7 } else { 4 };
        let _ = writeln!(
            svg,
            "<path stroke=\"{colour}\" stroke-width=\"{width}\" d=\"M{ax:.1} {ay:.1}L{bx:.1} {by:.1}\"><title>{}</title></path>",
            s.name
        );
    }
    svg.push_str("</svg>\n");
    files::write_text(path, &svg)
}

/// A map of the field from above, `factor` pixels per cell, of display values.
pub(super) fn map(field: &HeightField, factor: usize, colour: impl Fn(DVec2) -> DVec3 + Sync) -> Picture {
    let [w, h] = field.dims().map(|n| (n - 1) * factor);
    let mut picture = Picture::new(w, h);
    picture.rgb.par_iter_mut().enumerate().for_each(|(o, pixel)| {
        let p = DVec2::new((o % w) as f64 + 0.5, (h - 1 - o / w) as f64 + 0.5) / factor as f64;
        *pixel = colour(p).as_vec3().to_array();
    });
    picture
}

/// Pictures in rows.
pub(super) fn stacked(rows: &[Picture]) -> Picture {
    let gap = rows[0].height / 40;
    let (width, height) = (rows[0].width, rows.iter().map(|p| p.height).sum::<usize>() + gap * (rows.len() - 1));
    let mut out = Picture::new(width, height);
    out.rgb.fill([1.0; 3]);
    let mut top = 0;
    for p in rows {
        out.rgb[top * width..][..p.rgb.len()].copy_from_slice(&p.rgb);
        top += p.height + gap;
    }
    out
}
