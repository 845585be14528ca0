//! What a reference was made of, as its file says it.

use super::{Integrator, ReferenceSettings};
use crate::bake::digest;
use crate::scene::Scene;

/// How the comment begins that holds it.
const MARK: &str = "isolume reference";
/// How that of an isosurface with a bake's light begins.
const OF_BAKE: &str = "isolume extract";

/// What a reference was made of; what a file leaves out is `None`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Origin {
    /// The isosurface, source units.
    pub isovalue: Option<f64>,
    /// Digest of material and box at that isovalue, as [`light`].
    pub light: Option<String>,
    /// Seed of its random numbers.
    pub seed: Option<u64>,
    /// Whether the light is a bake's.
    pub of_bake: bool,
}

impl Origin {
    /// The comment for the reference of `scene` at `isovalue` (source units).
    pub fn comment(scene: &Scene, isovalue: f64, settings: &ReferenceSettings) -> String {
        let integrator = match settings.integrator {
            Integrator::Path => "path",
            Integrator::Photon => "photon",
        };
        let (seed, samples, light) = (settings.seed, settings.taken(), light(scene, isovalue));
        format!("{MARK} isovalue={isovalue:?} seed={seed} samples={samples} integrator={integrator} light={light}")
    }

    /// The comment for an isosurface (source units) with a bake's light.
    pub fn comment_of_bake(isovalue: f64) -> String {
        format!("{OF_BAKE} isovalue={isovalue:?}")
    }

    /// From the comments of a file, which other programs and older versions leave out.
    pub fn from_comments(comments: &[String]) -> Self {
        let marked = |c: &String| c.strip_prefix(MARK).or_else(|| c.strip_prefix(OF_BAKE)).map(str::to_owned);
        let marked: Vec<String> = comments.iter().filter_map(marked).collect();
        let words = || marked.iter().flat_map(|c| c.split_ascii_whitespace());
        let value = |key: &str| words().find_map(|w| w.strip_prefix(key)?.strip_prefix('='));
        let isovalue = value("isovalue").and_then(|v| v.parse().ok()).filter(|c: &f64| c.is_finite());
        let of_bake = comments.iter().any(|c| c.starts_with(OF_BAKE));
        let seed = value("seed").and_then(|v| v.parse().ok());
        Self { isovalue, light: value("light").map(str::to_owned), seed, of_bake }
    }
}

/// Digest of what lights the isosurface at `isovalue` (source units) and of its own material: all that a bake of any
/// grid and sweep holds, too. Companions' material, which it does not hold, is left out.
#[allow(clippy::cast_possible_truncation, reason = "bakes hold numbers to the last digit but one")]
pub fn light(scene: &Scene, isovalue: f64) -> String {
    let surface = &scene.surface;
    let albedo = surface.albedo.at(scene.field.sweep().to_unit(isovalue));
    let mut text = format!("{:?} {:?}", surface.outside, scene.boundary);
    let of_polygons = scene.polygons().iter().flat_map(|p| p.vertices().iter().copied().chain([p.albedo, p.emission]));
    for v in [albedo, surface.emission].into_iter().chain(of_polygons) {
        v.to_array().iter().for_each(|&x| text.push_str(&format!(" {:08x}", (x as f32).to_bits())));
    }
    digest(&text)
}
