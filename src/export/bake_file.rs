//! The bake as one `.vti`: the volume, its illumination, the box's light and every setting, for viewers and for
//! `render`, `compare` and `view`. Of several volumes, a `.vti` each and a `.vtm` that names them.

mod arrays;
mod description;

use super::multi_block;
use super::picture::srgb_encode;
use crate::atomic::AtomicFile;
use crate::bake::Bake;
use crate::digits::span;
use crate::error::{Error, Result};
use crate::field::{Field, FieldRows, Sweep};
use crate::files;
use crate::flat::{self, FlatLight, Within};
use crate::flattened::Side;
use crate::illumination_grid::{GridSize, IlluminationGrid};
use crate::scene::{Boundary, Member, Policy, Scene, Surface};
use crate::volume::vti::{self, VtiFile, VtiWriter};
use crate::volume::{Lattice, Samples, Space, Volume};
use arrays::Arrays;
use description::{DESCRIPTION, Description, PolygonDescription, TextureDescription};
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// Name of the array that holds the radiance of all context geometry.
const CONTEXT: &str = "context";

/// What a bake is, without its light.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BakeSummary {
    /// Ends of the sweep, in source units.
    pub isovalues: [f64; 2],
    /// The side that is outside.
    pub outside: Side,
    /// Whether the inside has light too.
    pub both_sides: bool,
    /// Whether isosurfaces are closed at the volume's faces.
    pub capped: bool,
    /// Walls and luminaires.
    pub polygons: usize,
    /// The report, as written.
    pub report: serde_json::Value,
}

impl BakeSummary {
    /// What a file says of its illumination; `None` if it has none.
    ///
    /// # Errors
    /// `Invalid` if that cannot be read.
    pub fn of(file: &VtiFile) -> Result<Option<Self>> {
        let found = Description::of(file)?;
        Ok(found.map(|d| {
            let Description { isovalues, outside, both_sides, capped, report, .. } = d;
            Self { isovalues, outside, both_sides, capped, polygons: d.polygons.len(), report }
        }))
    }

    /// Lines of a key and what it says, in columns as those of a volume's statistics.
    pub fn to_text(&self) -> String {
        let sides = if self.both_sides { "both sides".into() } else { format!("the {} side", self.outside.name()) };
        let ends = if self.capped { "capped" } else { "open" };
        let said = |pointer: &str| match self.report.pointer(pointer) {
            None => "unknown".into(),
            Some(serde_json::Value::String(s)) => s.clone(),
            Some(other) => other.to_string(),
        };
        let [preset, engine, grid, seed] =
            ["preset", "engine", "grid", "seed"].map(|s| said(&format!("/settings/{s}")));
        let seconds = self.report.pointer("/seconds/total").and_then(serde_json::Value::as_f64);
        let seconds = seconds.map_or("unknown".into(), |s| format!("{s:.1}"));
        format!(
            "{:<18}isovalues {} on {sides}, {ends}, {} polygons\n\
             {:<18}preset {preset}, engine {engine}, grid {grid}, seed {seed}: {seconds} s on {} threads\n",
            "illumination",
            span(self.isovalues.into()),
            self.polygons,
            "baked with",
            said("/threads"),
        )
    }
}

/// Suffix of the arrays of stored side number `i`: the outside has none.
fn suffix(i: usize) -> &'static str {
    if i == 0 { "" } else { "_inside" }
}

/// Writes the bakes of a scene's fields: one as `.vti` ([`write()`]); several as `.vtm` at `path` and beside it a
/// `.vti` for each, `NAME-FIELD.vti`, which stands for itself and also holds `s`, the parameter that the fields share:
/// a contour of it in all blocks shows all fields of one hyperplane. All are complete before the first has its name, so
/// that what fails leaves the old set.
///
/// # Errors
/// `Io`.
pub fn write_fields(path: &Path, scene: &Scene, volumes: &[&Volume], bakes: &[Bake]) -> Result<()> {
    if let ([volume], [bake]) = (volumes, bakes) {
        return write(path, scene, volume, bake);
    }
    let (mut parts, mut files) = (Vec::new(), Vec::new());
    for (n, (volume, bake)) in volumes.iter().zip(bakes).enumerate() {
        let lit = scene.seen_from(n);
        let file = field_file(path, &lit.name);
        files.push(completed(&file, &lit, volume, bake)?);
        parts.push((lit.name, file.file_name().unwrap_or_default().to_string_lossy().into_owned()));
    }
    files.push(multi_block::completed(path, &parts)?);
    files.into_iter().try_for_each(AtomicFile::commit)
}

/// Where the field named `name` of the bake at `path` goes.
pub fn field_file(path: &Path, name: &str) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}-{name}.vti"))
}

/// Writes a bake. Point data: `value` (source units, active scalars; in f64 where f32 is too coarse for the sweep, or
/// does not hold all samples), `radiance` (linear RGB), `rgb` (exposed, clamped, sRGB-encoded), `std_error` (of
/// luminance), `mask` ([`Mask`](crate::mask::Mask)), of a split bake `indirect` and `visible`
/// ([`Split`](crate::split::Split)); with both sides also `radiance_inside` and so on. Field data: `wall_<name>`
/// radiance over (u, v, isovalue), `wall_<name>_inside` where something else is known to be seen from within solids,
/// `context` the same of all context geometry (each wall's one or two after each other), exposure, every number of the
/// report, and all of it as JSON.
///
/// # Errors
/// `Io` if the file cannot be written.
pub fn write(path: &Path, scene: &Scene, volume: &Volume, bake: &Bake) -> Result<()> {
    completed(path, scene, volume, bake)?.commit()
}

/// As [`write()`], but the file's name is left to the caller.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn completed(path: &Path, scene: &Scene, volume: &Volume, bake: &Bake) -> Result<AtomicFile> {
    let report = serde_json::to_value(&bake.report).expect("the report is plain data");
    let lattice = &bake.lattice;
    let own = lattice == &volume.lattice;
    let sweep = scene.field.sweep();
    let rows = FieldRows::new(&scene.field, lattice);
    let value = |o: usize| if own { volume.value(o) } else { sweep.from_unit(rows.value(lattice.ijk(o))) };
    let exposure = bake.exposure as f32;
    let (textures, texels) = textures(scene, &bake.flats);
    let description = Description {
        isovalues: [sweep.lo(), sweep.hi()],
        exposure: bake.exposure,
        albedo: scene.surface.albedo.clone(),
        emission: scene.surface.emission,
        outside: scene.surface.outside,
        both_sides: scene.surface.both_sides,
        capped: scene.is_capped(),
        polygons: scene
            .polygons()
            .iter()
            .map(|p| PolygonDescription {
                name: p.name.clone(),
                vertices: p.vertices().to_vec(),
                albedo: p.albedo,
                emission: p.emission,
                other_face: p.other_face,
            })
            .collect(),
        textures,
        report: report.clone(),
        volume: scene.name.clone(),
        independent: scene.policy() == Policy::Independent,
    };
    let json = serde_json::to_string(&description).expect("the description is plain data");

    let range = [sweep.lo(), sweep.hi()];
    let mut numbers = Vec::new();
    flatten("", &report, &mut numbers);
    let constants: Vec<(String, Samples)> = numbers
        .into_iter()
        .chain([("exposure".to_owned(), vec![bake.exposure]), ("isovalues".to_owned(), range.to_vec())])
        .map(|(name, v)| (name, Samples::F64(v)))
        .collect();
    let doubles: Option<Vec<f64>> = (coarse(&sweep) || beyond_f32(volume))
        .then(|| (0..lattice.len()).into_par_iter().with_min_len(1 << 12).map(value).collect());
    let mut writer = VtiWriter::new(lattice);
    writer = match &doubles {
        Some(doubles) => writer.point_data("value", 1, &doubles[..]),
        None => writer.computed("value", 1, |o| value(o) as f32),
    };
    writer = writer.active_scalars("value");
    if scene.fields() > 1 {
        writer = writer.computed("s", 1, |o| sweep.isovalue(value(o)));
    }
    for (i, (_, grid)) in bake.sides.iter().enumerate() {
        let s = suffix(i);
        let radiance = grid.radiance.as_flattened();
        for (name, part) in grid.split.iter().flat_map(|s| [("indirect", &s.indirect), ("visible", &s.visible)]) {
            writer = writer.point_data(&format!("{name}{s}"), 3, part.as_flattened());
        }
        writer = writer
            .point_data(&format!("radiance{s}"), 3, radiance)
            .computed(&format!("rgb{s}"), 3, move |i| srgb_encode((radiance[i] * exposure).clamp(0.0, 1.0)))
            .point_data(&format!("std_error{s}"), 1, &grid.std_error[..])
            .computed_bytes(&format!("mask{s}"), 1, |o| grid.mask[o] as u8);
    }
    for (name, data) in &texels {
        writer = writer.field_data(name, 3, &data[..]);
    }
    for (name, samples) in &constants {
        writer = writer.field_data(name, 1, samples);
    }
    writer.field_string(vti::SPACE, volume.space.name()).field_string(DESCRIPTION, &json).complete(path)
}

/// Arrays of colours by name.
type Colours<'a> = Vec<(String, Cow<'a, [f32]>)>;

/// Where the file holds what of the flats' light, and the arrays that it is in.
fn textures<'a>(scene: &Scene, flats: &'a [Option<FlatLight>]) -> (Vec<TextureDescription>, Colours<'a>) {
    let mut textures = Vec::new();
    let mut texels = Colours::new();
    // Much context geometry would be as many arrays.
    let mut context = Vec::new();
    let flats = flats.iter().enumerate().filter_map(|(n, light)| Some((n, light.as_ref()?)));
    let flats = flats.flat_map(|(n, light)| light.textures().enumerate().map(move |(i, t)| (n, light, i, t)));
    for (n, light, i, t) in flats {
        let (mut array, start) = match scene.polygons().get(n) {
            Some(p) if p.other_face != 0 => (CONTEXT.to_owned(), context.len() / 3),
            // The description says the names as XML gives them back.
            _ => (format!("wall_{}{}", flat_name(scene, n).replace(vti::is_foreign, "_"), suffix(i)), 0),
        };
        // Names in OBJ files may repeat, and one may be what another becomes here.
        while array != CONTEXT && texels.iter().any(|t| t.0 == array) {
            array = format!("{array}_{n}");
        }
        if array == CONTEXT {
            context.extend_from_slice(t.texels.as_flattened());
        } else {
            texels.push((array.clone(), Cow::Borrowed(t.texels.as_flattened())));
        }
        textures.push(TextureDescription {
            flat: n,
            array,
            dims: t.dims,
            middle: t.axis.middle(),
            start,
            inside: i > 0,
            outside_only: light.within == Within::Unknown,
        });
    }
    if !context.is_empty() {
        texels.push((CONTEXT.to_owned(), Cow::Owned(context)));
    }
    (textures, texels)
}

/// Whether f32 tells a sweep's isovalues apart too coarsely, as with a large offset or among its smallest numbers.
fn coarse(sweep: &Sweep) -> bool {
    super::coarse_in_f32(sweep.lo().abs().max(sweep.hi().abs()), sweep.hi() - sweep.lo())
}

/// Whether samples are numbers, but not in f32.
fn beyond_f32(volume: &Volume) -> bool {
    let Samples::F64(samples) = volume.samples() else { return false };
    samples.par_iter().any(|x| x.is_finite() && x.abs() > f64::from(f32::MAX))
}

/// Every number of a JSON tree by its dotted path.
fn flatten(prefix: &str, value: &serde_json::Value, out: &mut Vec<(String, Vec<f64>)>) {
    match value {
        serde_json::Value::Object(map) => {
            for (key, v) in map {
                flatten(&if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") }, v, out);
            }
        }
        serde_json::Value::Number(n) => out.push((prefix.to_owned(), vec![n.as_f64().unwrap_or(f64::NAN)])),
        serde_json::Value::Array(items) if !items.is_empty() && items.iter().all(serde_json::Value::is_number) => {
            out.push((prefix.to_owned(), items.iter().filter_map(serde_json::Value::as_f64).collect()));
        }
        _ => {}
    }
}

fn flat_name(scene: &Scene, n: usize) -> String {
    match scene.polygons().get(n) {
        Some(p) => p.name.clone(),
        None => format!("cap_{}", n - scene.polygons().len()),
    }
}

/// The grid's size, as a report says it.
fn grid_size(report: &serde_json::Value) -> Option<GridSize> {
    report.pointer("/settings/grid")?.as_str()?.parse().ok()
}

/// A bake read back.
#[derive(Clone, Debug)]
pub struct BakedVolume {
    /// The stored volume as a scene: its level sets on the grid's lattice, and the box.
    pub scene: Scene,
    /// One grid per stored side, the outside first.
    pub sides: Vec<(Side, IlluminationGrid)>,
    /// The flats' radiance, by flat number.
    pub flats: Vec<Option<FlatLight>>,
    /// Display exposure.
    pub exposure: f64,
    /// What the world's axes mean.
    pub space: Space,
    /// The report, as written.
    pub report: serde_json::Value,
    /// The bakes of the scene's companions, in their order, each as if it stood alone.
    pub companions: Vec<BakedVolume>,
    /// Whether the fields gave each other no light.
    independent: bool,
    /// Whether other fields gave it light that are not here.
    among_others: bool,
}

/// The light of each of `count` flats, where `textures` tell of it.
fn flats(textures: &[TextureDescription], count: usize, arrays: &Arrays) -> Result<Vec<Option<FlatLight>>> {
    let mut flats: Vec<Option<FlatLight>> = vec![None; count];
    let mut read: Option<(&str, Vec<[f32; 3]>)> = None;
    for t in textures {
        let slot = flats.get_mut(t.flat).ok_or_else(|| t.wrong(format!("there are {count} flats")))?;
        let texels = match &read {
            Some((name, texels)) if *name == t.array => texels,
            _ => &read.insert((&t.array, arrays.colours(&t.array)?)).1,
        };
        let texture = t.of(texels)?;
        match slot {
            None if !t.inside => {
                let within = if t.outside_only { Within::Unknown } else { Within::Same };
                *slot = Some(FlatLight { outside: texture, within });
            }
            Some(light) if t.inside && light.own().is_none() => light.within = Within::Own(texture),
            None => return Err(t.wrong("none before it is of the flat's outside")),
            Some(_) => return Err(t.wrong("another one is of the same flat")),
        }
    }
    Ok(flats)
}

/// Whether a file is a bake, whole or damaged.
pub fn is_bake(file: &VtiFile) -> bool {
    Description::text(file).is_some()
}

impl BakedVolume {
    /// A bake of `scene` (of several fields, of [`Scene::lit`] by it) as if it were written and read.
    pub fn new(scene: Scene, bake: Bake) -> Self {
        let scene = if *scene.lattice() == bake.lattice { scene } else { scene.resampled(&bake.lattice) };
        let report = serde_json::to_value(&bake.report).expect("the report is plain data");
        let (sides, flats, exposure) = (bake.sides, bake.flats, bake.exposure);
        Self {
            scene,
            sides,
            flats,
            exposure,
            space: Space::default(),
            report,
            companions: Vec::new(),
            independent: false,
            among_others: false,
        }
    }

    /// Refuses to light its scene anew if others lit it that are in another file.
    ///
    /// # Errors
    /// `NotSupported` in that case.
    pub fn whole(&self) -> Result<()> {
        if self.among_others {
            return Err(Error::NotSupported(
                "is one of several volumes that light each other, and does not hold the others; name the .vtm and, by \
                 --field, this one"
                    .into(),
            ));
        }
        Ok(())
    }

    /// Reads a bake; a `.vtm` with all its fields, seen from the first.
    ///
    /// # Errors
    /// `Io`; `Invalid` if the file is no bake or is damaged.
    pub fn read(path: &Path) -> Result<Self> {
        if files::has_extension(path, "vtm") {
            let fields = multi_block::read(path)?.iter().map(|file| Self::one(file)).collect::<Result<Vec<_>>>()?;
            let job = |bake: &Self| bake.report.get("job").cloned();
            if fields.iter().any(|bake| job(bake) != job(&fields[0])) {
                return Err(Error::invalid(path, "names files of different bakes; bake anew"));
            }
            return Self::seen_from(fields, 0).map_err(|e| e.in_file(path));
        }
        if !files::has_extension(path, "vti") {
            std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
            if files::has_extension(path, "pvd") {
                return Err(Error::invalid(path, "is a series of bakes; name one of its .vti"));
            }
            return Err(Error::invalid(path, "is no bake (.vti, .vtm); make one with `isolume bake`"));
        }
        Self::one(path)
    }

    /// The bake of one field.
    fn one(path: &Path) -> Result<Self> {
        Self::try_read(path)?
            .ok_or_else(|| Error::invalid(path, "is no bake: it holds no illumination; make one with `isolume bake`"))
    }

    /// As [`BakedVolume::read`], but `None` if the file is a `.vti` without illumination.
    ///
    /// # Errors
    /// `Io`; `Invalid` if the file is damaged.
    pub fn try_read(path: &Path) -> Result<Option<Self>> {
        let bytes = files::read(path)?;
        // Of a volume that is none, however many arrays it has, no array is needed.
        let parse = || match Description::of(&VtiFile::parse_fields(&bytes)?)? {
            Some(description) => Ok(Some((VtiFile::parse(&bytes)?, description))),
            None => Ok(None),
        };
        let Some((file, description)) = parse().map_err(|e: Error| e.in_file(path))? else { return Ok(None) };
        drop(bytes);
        Self::from_parts(path, file, description).map(Some).map_err(|e| e.in_file(path))
    }

    fn from_parts(path: &Path, file: VtiFile, d: Description) -> Result<Self> {
        let (points, arrays, space) = (file.lattice.len(), Arrays(&file.point_data), file.space());
        let surface = Surface { albedo: d.albedo, emission: d.emission, outside: d.outside, both_sides: d.both_sides };
        let sides = surface.stored_sides().into_iter().enumerate();
        let sides = sides.map(|(i, side)| Ok((side, arrays.grid(suffix(i), points)?))).collect::<Result<Vec<_>>>()?;
        let volume = Volume::new(path.display().to_string(), file.lattice, arrays.values(points)?)?;
        let mut field = Field::new(&volume, Sweep::new(d.isovalues[0], d.isovalues[1])?)?;
        // Light is for the normals of the volume that was baked.
        if let Some(GridSize::Factors(factors)) = grid_size(&d.report).filter(|size| *size != GridSize::OWN)
            && let Some(coarse) = field.coarsened(factors)
        {
            field = field.with_normals_of(coarse);
        }
        let boundary = if d.capped { Boundary::Capped } else { Boundary::Open };
        let member = Member { name: d.volume, field: field.into(), surface, boundary };
        let polygons = d.polygons.into_iter().map(PolygonDescription::polygon).collect::<Result<Vec<_>>>()?;
        let scene = Scene::with_members(vec![member], Policy::Joint, polygons)?;
        Ok(Self {
            flats: flats(&d.textures, flat::count(&scene), &Arrays(&file.field_data))?,
            scene,
            sides,
            exposure: d.exposure,
            space,
            report: d.report,
            companions: Vec::new(),
            independent: d.independent,
            // Such bakes hold the parameter that their fields share.
            among_others: !d.independent && arrays.holds("s"),
        })
    }

    /// Single bakes of one scene put together, seen from number `own`.
    fn seen_from(mut fields: Vec<Self>, own: usize) -> Result<Self> {
        let members = fields.iter().flat_map(|b| b.scene.members()).collect();
        let independent = fields.iter().any(|b| b.independent);
        let policy = if independent { Policy::Independent } else { Policy::Joint };
        let polygons = fields[0].scene.polygons().to_vec();
        let scene = Scene::with_members(members, policy, polygons)?.seen_from(own);
        let mut this = fields.remove(own);
        (this.scene, this.companions, this.among_others) = (scene, fields, false);
        Ok(this)
    }

    /// The same bake seen from the field named `name`, with its grid.
    ///
    /// # Errors
    /// `Invalid` with the names there are.
    pub fn select(mut self, name: &str) -> Result<Self> {
        let own = self.scene.field_named(name)?;
        if own == self.scene.number() {
            return Ok(self);
        }
        let mut fields = std::mem::take(&mut self.companions);
        let number = self.scene.number();
        let alone = self.scene.members().swap_remove(number);
        self.scene = Scene::with_members(vec![alone], Policy::Joint, self.scene.polygons().to_vec())?;
        fields.insert(number, self);
        Self::seen_from(fields, own)
    }

    /// Whether its grid has all points of the volume, and so its samples.
    pub fn holds_samples(&self) -> bool {
        matches!(grid_size(&self.report), Some(GridSize::Factors(_)))
    }

    /// The grid's lattice.
    pub fn lattice(&self) -> &Lattice {
        self.scene.lattice()
    }

    /// The scene that was lit, with its volumes on their own lattices again if the grid is a whole number of times as
    /// fine along each axis. `None` if it has other points: the volume's samples, and with them its normals, are not
    /// kept then.
    ///
    /// # Errors
    /// `Invalid` if the file says nothing of its grid.
    pub fn source(&self) -> Result<Option<Scene>> {
        let Some(size) = grid_size(&self.report) else {
            return Err(Error::Invalid("its report names no grid; bake anew".into()));
        };
        let GridSize::Factors(factors) = size else { return Ok(None) };
        if size == GridSize::OWN {
            return Ok(Some(self.scene.lit(self.scene.number())));
        }
        let coarse = |m: Member| Some(Member { field: m.field.coarsened(factors)?.into(), ..m });
        let Some(members) = self.scene.members().into_iter().map(coarse).collect() else { return Ok(None) };
        let scene = Scene::with_members(members, self.scene.policy(), self.scene.polygons().to_vec())?;
        Ok(Some(scene.lit(self.scene.number())))
    }

    /// The grid of a side; `None` if that is not stored.
    pub fn grid(&self, side: Side) -> Option<&IlluminationGrid> {
        self.sides.iter().find(|(s, _)| *s == side).map(|(_, grid)| grid)
    }

    /// Radiance of `side` at local `p`: trilinear over the points of the cell that hold something, as a 3D texture
    /// would give it; of a bake that is split, with direct light of the very place. `None` if the side is not stored.
    pub fn radiance(&self, side: Side, p: DVec3) -> Option<DVec3> {
        Some(self.grid(side)?.radiance_at(&self.scene, self.lattice(), p, side))
    }

    /// [`BakedVolume::radiance`] at a point of the world, of the isosurface through it; `None` outside the volume, too,
    /// and where the bake holds nothing.
    pub fn radiance_at(&self, side: Side, world: DVec3) -> Option<DVec3> {
        let grid = self.grid(side)?;
        let p = Some(self.lattice().to_index(world)).filter(|p| self.lattice().holds(*p))?;
        grid.known_at(&self.scene, self.lattice(), p, side)
    }
}

#[cfg(test)]
mod tests;
