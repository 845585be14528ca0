//! `[[volume]]`: several volumes in one scene.

use super::{
    Albedo, BoundaryName, Loaded, OutsideName, RawOptions, ReadOptions, Rgb, SceneFile, SceneOptions, SidesName,
    Source, SurfaceOptions, VolumeSource, context, numbers, suggested, surface, surroundings,
};
use crate::error::{Error, Result};
use crate::field::{Field, Sweep};
use crate::flattened::MAX_POLYGONS;
use crate::isosurface;
use crate::polygon::Polygon;
use crate::scene::{Boundary, Member, Scene, Surface};
use crate::volume::{Lattice, Volume};
use glam::{DMat3, DVec3};
use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::path::{Path, PathBuf};

/// `[volume]`, or several `[[volume]]`.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant, reason = "one value per file")]
pub enum Volumes {
    /// One.
    One(VolumeSource),
    /// Several fields in one 4D scene.
    Several(Vec<VolumeEntry>),
}

impl Default for Volumes {
    fn default() -> Self {
        Volumes::One(VolumeSource::default())
    }
}

impl<'de> Deserialize<'de> for Volumes {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        // By hand, since an untagged enum would forget where an error stands.
        struct TableOrArray;
        impl<'de> Visitor<'de> for TableOrArray {
            type Value = Volumes;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a [volume] table or several [[volume]] tables")
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> std::result::Result<Volumes, A::Error> {
                VolumeSource::deserialize(MapAccessDeserializer::new(map)).map(Volumes::One)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, seq: A) -> std::result::Result<Volumes, A::Error> {
                Vec::deserialize(SeqAccessDeserializer::new(seq)).map(Volumes::Several)
            }
        }
        deserializer.deserialize_any(TableOrArray)
    }
}

/// One `[[volume]]`: where it comes from, its isovalues and its material. What is not set comes from the file's top
/// level and `[surface]`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct VolumeEntry {
    /// What to call it: part of the names of files.
    #[serde(default)]
    pub name: String,
    /// A volume file, relative to the scene file.
    pub file: Option<PathBuf>,
    /// How to read a headerless file.
    pub raw: Option<RawOptions>,
    /// The array of a VTK file that holds several.
    pub array: Option<String>,
    /// Name of a generator instead of a file.
    pub generator: Option<String>,
    /// Samples along each edge of a generated volume.
    pub size: Option<usize>,
    /// World distance between samples, instead of the file's.
    #[serde(default, deserialize_with = "numbers")]
    pub spacing: Option<[f64; 3]>,
    /// World position of the first sample, instead of the file's.
    #[serde(default, deserialize_with = "numbers")]
    pub origin: Option<[f64; 3]>,
    /// Factor of the world distances between samples.
    pub scale: Option<f64>,
    /// Its range, which the shared parameter sweeps.
    #[serde(default, deserialize_with = "numbers")]
    pub isovalues: Option<[f64; 2]>,
    /// Instead of a range, the isovalue at which it stands in every hyperplane.
    pub held: Option<f64>,
    /// Diffuse reflectance.
    pub albedo: Option<Albedo>,
    /// Emitted radiance.
    pub emission: Option<Rgb>,
    /// The side that is outside.
    pub outside: Option<OutsideName>,
    /// Sides to store.
    pub sides: Option<SidesName>,
    /// What the volume's faces do.
    pub boundary: Option<BoundaryName>,
}

impl VolumeEntry {
    /// The volume, where the table puts it.
    fn volume(&self, folder: &Path) -> Result<Volume> {
        let source = VolumeSource {
            file: self.file.clone(),
            raw: self.raw.clone(),
            array: self.array.clone(),
            spacing: self.spacing,
            origin: self.origin,
            generator: self.generator.clone(),
            size: self.size,
            ..VolumeSource::default()
        };
        let mut volume = source.load(folder, &ReadOptions::default())?;
        if let Some(scale) = self.scale {
            if !(scale > 0.0 && scale.is_finite()) {
                return Err(Error::Invalid(format!("scale {scale}: must be a factor above 0")));
            }
            let lattice = &volume.lattice;
            volume.lattice = Lattice::new(lattice.dims(), lattice.origin(), lattice.axes() * scale)?;
        }
        Ok(volume)
    }

    /// What the table says about the surface, `[surface]` in its gaps.
    fn surface(&self, file: &SceneFile, sweep: Sweep) -> Result<(Surface, Boundary)> {
        let own = SurfaceOptions {
            albedo: self.albedo.clone(),
            emission: self.emission,
            outside: self.outside,
            sides: self.sides,
            boundary: self.boundary,
        };
        surface(&file.surface, &own, sweep)
    }

    /// A field that takes part in the sweep.
    fn member(&self, volume: &Volume, file: &SceneFile) -> Result<Member> {
        let [lo, hi] = match self.isovalues.or(file.isovalues) {
            Some(range) => range,
            None => suggested(volume)?,
        };
        let sweep = Sweep::new(lo, hi)?;
        let field = Field::new(volume, sweep)?;
        let (surface, boundary) = self.surface(file, sweep)?;
        Ok(Member { name: self.name.clone(), field: field.into(), surface, boundary })
    }

    /// The isosurface of a volume that is held at `isovalue`, as triangles with two faces that stand in every
    /// hyperplane.
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    fn standing(&self, isovalue: f64, volume: &Volume, file: &SceneFile) -> Result<Vec<Polygon>> {
        if self.isovalues.is_some() {
            return Err(Error::Invalid("held and isovalues exclude each other".into()));
        }
        let Some((lo, hi)) = volume.range().filter(|(lo, hi)| (*lo..=*hi).contains(&isovalue) && lo < hi) else {
            return Err(Error::Invalid(format!("held = {isovalue}: the volume has no surface there")));
        };
        let sweep = Sweep::new(lo, hi)?;
        let field = Field::new(volume, sweep)?;
        let (surface, _) = self.surface(file, sweep)?;
        // What [surface] says of both is for those that sweep.
        if self.emission.is_some_and(|e| e.vector() != DVec3::ZERO) {
            return Err(Error::NotSupported(
                "emission: a surface that is held cannot emit light; use a luminaire".into(),
            ));
        }
        if self.boundary == Some(BoundaryName::Capped) {
            return Err(Error::NotSupported(
                "boundary: a surface that is held is not closed where its volume's faces cut it; give the volume a margin \
                 of samples outside the solid"
                    .into(),
            ));
        }
        surface.check_albedo(sweep)?;
        let lattice = field.lattice();
        let mesh = isosurface::extract(lattice.dims(), field.samples(), sweep.isovalue(isovalue))?;
        let most = MAX_POLYGONS as usize / 2;
        if mesh.triangles.len() > most {
            return Err(Error::NotSupported(format!(
                "held = {isovalue}: {} triangles, {most} at most; hold a coarser copy of the volume",
                mesh.triangles.len()
            )));
        }
        let albedo = surface.albedo.at(sweep.to_unit(isovalue));
        let world: Vec<DVec3> = mesh.vertices.iter().map(|&p| lattice.to_world(p)).collect();
        let mut polygons = Vec::new();
        for (n, t) in mesh.triangles.iter().enumerate() {
            let corners = t.map(|v| world[v as usize]).to_vec();
            // Nothing else can be wrong with a triangle here than that it has no area, and shows nothing.
            if let Ok(p) = Polygon::new(&format!("{}_{n}", self.name), corners, albedo, DVec3::ZERO) {
                polygons.extend(p.both_faces());
            }
        }
        Ok(polygons)
    }
}

/// Loads the volumes of a scene file and what surrounds them.
pub(super) fn load(
    entries: &[VolumeEntry],
    file: &SceneFile,
    input: &Path,
    source: Source,
    options: &SceneOptions,
) -> Result<Loaded> {
    let folder = input.parent().unwrap_or(Path::new(""));
    if let Some((flag, _)) = options.of_volume().into_iter().find(|f| f.1) {
        return Err(Error::invalid(
            input,
            format!("{flag}: the scene has several volumes; set it in their [[volume]] tables"),
        ));
    }
    let (mut volumes, mut members, mut standing) = (Vec::new(), Vec::new(), Vec::new());
    let (mut lattices, mut spaces) = (Vec::new(), Vec::new());
    for (n, entry) in entries.iter().enumerate() {
        let named = |e: Error| {
            let name = if entry.name.is_empty() { format!("{}", n + 1) } else { format!("'{}'", entry.name) };
            // Many messages begin with the key.
            let text = e.to_string();
            let key = text.split([' ', ':']).next().unwrap_or_default();
            let place = source.place(&["volume", &n.to_string(), key]);
            e.at(format_args!("{place}: volume {name}"))
        };
        let volume = entry.volume(folder).map_err(named)?;
        lattices.push(volume.lattice.clone());
        spaces.push((volume.name.clone(), volume.space));
        if let Some(isovalue) = entry.held {
            standing.extend(entry.standing(isovalue, &volume, file).map_err(named)?);
        } else {
            members.push(entry.member(&volume, file).map_err(named)?);
            volumes.push(volume);
        }
    }
    let mut volumes = volumes.into_iter();
    let Some(volume) = volumes.next() else {
        return Err(Error::invalid(input, "volume: there is none that takes part in the sweep; give one isovalues"));
    };
    let around = enclosing(members[0].field.lattice(), &lattices).map_err(|e| e.in_file(input))?;
    let mut polygons = surroundings(&file.surroundings, &options.surroundings, folder, &around)
        .map_err(|e| e.at(format_args!("{}: box", source.place(&["box", "kind"]))))?;
    polygons.extend(context(&file.context, folder, Some(&source))?);
    polygons.extend(standing);
    let scene =
        Scene::with_members(members, file.policy.unwrap_or_default(), polygons).map_err(|e| e.in_file(input))?;
    let (companions, bake) = (volumes.collect(), file.bake.clone());
    Ok(Loaded { volume, companions, spaces, scene, bake, source: Some(source) })
}

/// A lattice along the axes of the first whose Ω holds those of all; the first itself if that does.
fn enclosing(first: &Lattice, all: &[Lattice]) -> Result<Lattice> {
    let (mut lo, mut hi) = (DVec3::ZERO, first.far());
    for lattice in all {
        for corner in lattice.corners() {
            let p = first.to_index(lattice.to_world(corner));
            (lo, hi) = (lo.min(p), hi.max(p));
        }
    }
    // Rounding is no reason for another box.
    let slack = 1e-6 * first.far().max_element();
    if lo.min_element() >= -slack && (hi - first.far()).max_element() <= slack {
        return Ok(first.clone());
    }
    let (axes, size) = (first.axes(), hi - lo);
    let axes = DMat3::from_cols(axes.x_axis * size.x, axes.y_axis * size.y, axes.z_axis * size.z);
    Lattice::new([2; 3], first.to_world(lo), axes)
}

#[cfg(test)]
mod tests {
    use super::super::load as load_scene;
    use super::*;
    use crate::flattened::Side;
    use crate::scene::Policy;

    fn load_text(text: &str, options: &SceneOptions) -> Result<Loaded> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.toml");
        std::fs::write(&path, text).unwrap();
        load_scene(&path, options)
    }

    fn error_of(text: &str) -> String {
        load_text(text, &SceneOptions::default()).err().unwrap_or_else(|| panic!("accepted: {text}")).to_string()
    }

    const TWO: &str = "[surface]\nalbedo = 0.5\n[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 9\nisovalues = [10, 90]\n\
        [[volume]]\nname = \"b\"\ngenerator = \"sphere\"\nsize = 7\norigin = [0.5, 0.5, 0.8]\nscale = 0.5\n\
        isovalues = [0.01, 0.2]\nalbedo = [0.9, 0.1, 0.1]\noutside = \"higher\"\n";

    #[test]
    fn two_volumes_in_one_box() {
        let loaded = load_text(TWO, &SceneOptions::default()).unwrap();
        let scene = &loaded.scene;
        assert_eq!((scene.fields(), scene.policy(), loaded.companions.len()), (2, Policy::Joint, 1));
        let [a, b] = [0, 1].map(|n| scene.seen_from(n));
        assert_eq!((a.name.as_str(), a.surface.outside, b.surface.outside), ("a", Side::Lower, Side::Higher));
        assert_eq!((a.field.sweep().hi(), b.field.sweep().hi()), (90.0, 0.2));
        assert_eq!(a.surface.albedo.uniform(), Some(DVec3::splat(0.5)), "[surface] holds for all");
        // The box holds both: z to 1.3.
        assert!((scene.bounds()[0].length() < 1e-9) && (scene.bounds()[1] - DVec3::new(1.0, 1.0, 1.3)).length() < 1e-9);
        let x = DVec3::new(0.7, 0.6, 0.9);
        let companion = &scene.companions()[0];
        let p = companion.to_index(scene.lattice().to_world(scene.lattice().to_index(x)));
        let q = companion.to_index(scene.lattice().to_index(x));
        assert!((companion.member.field.lattice().to_world(q) - x).length() < 1e-12 && p != q);
        let independent = load_text(&format!("policy = \"independent\"\n{TWO}"), &SceneOptions::default()).unwrap();
        assert_eq!(independent.scene.policy(), Policy::Independent);
    }

    #[test]
    fn errors_name_the_volume() {
        let e = error_of("[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\ncolour = 3\n");
        assert!(
            e.contains("scene.toml:4: unknown key `colour` in [[volume]]; known: name") && !e.contains('\n'),
            "{e}"
        );
        let e = error_of(&TWO.replace("\"sphere\"", "\"spere\""));
        assert!(e.contains("volume 'b': generator `spere`"), "{e}");
        let e = error_of(&TWO.replace("name = \"b\"", "name = \"a\""));
        assert!(e.contains("scene.toml") && e.contains("'a' occurs twice"), "{e}");
        let e = error_of(&TWO.replace("name = \"b\"\n", ""));
        assert!(e.contains("volume 2") && e.contains("needs one"), "{e}");
        let e = error_of(&TWO.replace("scale = 0.5", "scale = 0"));
        assert!(e.contains("volume 'b': scale 0"), "{e}");
        let e = error_of("policy = \"joint\"\n[volume]\ngenerator = \"bumps\"\nsize = 5\n");
        assert!(e.contains("scene.toml:1: policy"), "{e}");
        let options = SceneOptions { isovalues: Some(vec![1.0, 2.0]), ..SceneOptions::default() };
        let e = load_text(TWO, &options).err().unwrap().to_string();
        assert!(e.contains("--isovalues") && e.contains("[[volume]]"), "{e}");
    }

    /// The ball of radius 0.15 about (0.65, 0.65, 0.95) as triangles in every hyperplane: area, two faces, colour.
    #[test]
    fn a_held_volume_stands_still() {
        let held = |isovalue: &str| {
            TWO.replace("isovalues = [0.01, 0.2]", &format!("held = {isovalue}")).replace("size = 7", "size = 17")
        };
        let scene = load_text(&held("0.09"), &SceneOptions::default()).unwrap().scene;
        assert_eq!((scene.fields(), scene.name.as_str()), (1, "a"));
        let of = |name: &'static str| scene.polygons().iter().filter(move |p| p.name.starts_with(name));
        let area: f64 = of("b_").map(Polygon::area).sum();
        let exact = 2.0 * 4.0 * std::f64::consts::PI * 0.15f64.powi(2);
        assert!((area / exact - 1.0).abs() < 0.02, "{area} {exact}");
        let centre = DVec3::new(0.75, 0.75, 1.05);
        assert!(of("b_").all(|p| p.vertices().iter().all(|v| ((*v - centre).length() - 0.15).abs() < 2e-3)));
        assert!(of("b_").all(|p| (p.albedo - DVec3::new(0.9, 0.1, 0.1)).length() < 1e-12));
        assert!(error_of(&held("3")).contains("volume 'b': held = 3"));
        assert!(error_of(&held("0.09\nemission = 1")).contains("emit"));
        assert!(error_of(&held("0.09\nboundary = \"capped\"")).contains("scene.toml:15: volume 'b': boundary: "));
        let shining = held("0.09").replace("albedo = 0.5", "albedo = 0.5\nemission = 1");
        assert!(load_text(&shining, &SceneOptions::default()).is_ok(), "what [surface] says is for the others");
        let bright = held("0.09").replace("albedo = [0.9, 0.1, 0.1]", "albedo = 1.5");
        assert!(error_of(&bright).contains("volume 'b': surface albedo [1.5, 1.5, 1.5]"), "{}", error_of(&bright));
        assert!(error_of(&held("0.09\nisovalues = [0, 1]")).contains("exclude"));
    }
}
