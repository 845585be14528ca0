//! How far a bake is from references: percent RMS as BB09 measured it. \[BB09 §3\]
//!
//! Colours are linear, rgb = L π / (ρ_max E₀) clamped to [0, 1]. BB09 print the squared vertex error as |Δ|, without
//! the square; read as a squared Euclidean norm, `percent_rms = 100 √⟨|rgb_tex − rgb_ref|²⟩` is what this crate
//! reports, and that / √3, the RMS per channel, beside it.

mod belongs;
mod clamped;
mod floor;
mod survey;

pub use belongs::belongs;
use clamped::clamped_variance;
pub use floor::InterpolationFloor;
pub use survey::{Part, Shown, Survey, SurveySettings, survey};

use crate::error::{Error, Result};
use crate::export::ply::{PlyMesh, RADIANCE, SAMPLED, VARIANCE};
use crate::surface_mesh::vertex_areas;
use glam::DVec3;
use serde::Serialize;

/// A reference as compared: one isosurface, radiance and its variance at the sampled vertices.
#[derive(Clone, Debug, Default)]
pub struct ReferenceMesh {
    /// Vertices, world.
    pub positions: Vec<DVec3>,
    /// Triangles.
    pub triangles: Vec<[u32; 3]>,
    /// Linear outgoing radiance.
    pub radiance: Vec<DVec3>,
    /// Variance of the radiance as a mean, if it is known.
    pub variance: Option<Vec<DVec3>>,
    /// Whether a vertex takes part.
    pub sampled: Vec<bool>,
}

impl ReferenceMesh {
    /// From the properties that `isolume reference` writes; all vertices sampled where that is missing.
    ///
    /// # Errors
    /// `Invalid` if positions or radiance are missing, or if anything is no finite number.
    pub fn from_ply(mesh: &PlyMesh) -> Result<Self> {
        let triple = |names| -> Option<Vec<DVec3>> {
            let values = mesh.triple(names)?;
            Some(values.into_iter().map(DVec3::from_array).collect())
        };
        let missing = |what: &str| Error::Invalid(format!("has no {what}; make it with `isolume reference`"));
        let radiance =
            triple(RADIANCE).ok_or_else(|| missing("vertex properties radiance_r, radiance_g, radiance_b"))?;
        let flags = mesh.property(SAMPLED).map_or_else(|| vec![1.0; radiance.len()], <[f64]>::to_vec);
        finite([SAMPLED], flags.iter().map(|&flag| [flag]))?;
        let read = Self {
            positions: triple(POSITION).ok_or_else(|| missing("positions"))?,
            triangles: mesh.triangles.clone(),
            variance: triple(VARIANCE),
            sampled: flags.into_iter().map(|flag| flag > 0.0).collect(),
            radiance,
        };
        read.check()?;
        Ok(read)
    }

    /// Refuses what is no reference: every vertex has its numbers, all of them finite, and triangles have vertices.
    fn check(&self) -> Result<()> {
        let n = self.positions.len();
        let variance = self.variance.as_deref();
        for (what, found) in [
            ("radiance", self.radiance.len()),
            ("variance", variance.map_or(n, <[DVec3]>::len)),
            ("sampled", self.sampled.len()),
        ] {
            if found != n {
                return Err(Error::Invalid(format!(
                    "has {n} vertices, but {found} values of {what}; give one to each"
                )));
            }
        }
        if let Some(t) = self.triangles.iter().position(|t| t.iter().any(|&v| v as usize >= n)) {
            let corners = self.triangles[t];
            return Err(Error::Invalid(format!("triangle {t} has vertices {corners:?}, but there are only {n}")));
        }
        finite(POSITION, self.positions.iter().map(DVec3::to_array))?;
        finite(RADIANCE, self.radiance.iter().map(DVec3::to_array))?;
        finite(VARIANCE, variance.unwrap_or_default().iter().map(DVec3::to_array))
    }
}

/// The vertex properties of positions.
const POSITION: [&str; 3] = ["x", "y", "z"];

/// Refuses values that are no finite numbers: clamped to what is displayed they would be black.
fn finite<const N: usize>(names: [&str; N], values: impl Iterator<Item = [f64; N]>) -> Result<()> {
    for (v, found) in values.enumerate() {
        if let Some(c) = found.iter().position(|x| !x.is_finite()) {
            return Err(Error::Invalid(format!(
                "{} of vertex {v} is {}, no finite number; make it anew",
                names[c], found[c]
            )));
        }
    }
    Ok(())
}

/// A bake's distance from its reference. Percentages are of the display range [0, 1].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Accuracy {
    /// Vertices that took part.
    pub vertices: usize,
    /// References: 1, or 2 whose noise cancels.
    pub references: usize,
    /// 100 √⟨|Δ|²⟩. With two references ⟨(t − r₁)·(t − r₂)⟩ stands for ⟨|Δ|²⟩, 0 where that is negative.
    pub percent_rms: f64,
    /// The same per channel: / √3.
    pub percent_rms_sqrt3: f64,
    /// The same, vertices weighted by their area.
    pub percent_rms_area: f64,
    /// The same over vertices whose reference exceeds 0.02 in some channel; 0 without any.
    pub percent_rms_lit: f64,
    /// Share of such vertices.
    pub lit: f64,
    /// Share of the vertices that are as bright as can be displayed in all channels, by the bake and by the references:
    /// no error is seen there.
    pub clamped: f64,
    /// 95 % confidence interval of `percent_rms`, from the scatter over vertices (as if they were independent);
    /// of a single one, up to infinity.
    pub confidence: [f64; 2],
    /// What a perfect bake would show against one reference: 100 √⟨Σ variance⟩ of clamped rgb, as if the reference's
    /// noise were Gaussian around what it holds.
    pub noise_floor: f64,
    /// One reference: √(percent_rms² − noise_floor²), 0 where that is negative. Two: `percent_rms`.
    pub percent_rms_without_noise: f64,
    /// 100 ⟨|Δ|⟩, against the mean of the references.
    pub mean: f64,
    /// 100 max |Δ|, against the mean of the references.
    pub max: f64,
    /// 100 ⟨t − r⟩ over channels: the sign of the error.
    pub bias: f64,
    /// rgb = radiance × this.
    pub exposure: f64,
}

/// Rgb above which a vertex counts as lit.
const LIT: f64 = 0.02;

/// Linear radiance to clamped display rgb.
#[inline]
pub fn display(radiance: DVec3, exposure: f64) -> DVec3 {
    (radiance * exposure).clamp(DVec3::ZERO, DVec3::ONE)
}

/// Variance of the displayed rgb of vertex `v`, summed over channels.
fn noise(reference: &ReferenceMesh, v: usize, exposure: f64) -> f64 {
    let Some(variance) = &reference.variance else { return 0.0 };
    let (mean, variance) = (reference.radiance[v] * exposure, variance[v] * exposure * exposure);
    (0..3).map(|c| clamped_variance(mean[c], variance[c])).sum()
}

/// Compares `texture` (linear radiance at the vertices) with one or two references on the same mesh. Returns the
/// numbers and |Δ| per vertex against the references' mean (0 where not sampled).
///
/// # Errors
/// `Invalid` without references, with more than two, or without common vertices, if meshes differ, or if something is
/// missing or no finite number.
pub fn compare(texture: &[DVec3], references: &[ReferenceMesh], exposure: f64) -> Result<(Accuracy, Vec<f64>)> {
    let Some(first) = references.first() else {
        return Err(Error::Invalid("no reference given".into()));
    };
    if references.len() > 2 {
        return Err(Error::Invalid(format!("{} references given: noise cancels between two", references.len())));
    }
    references.iter().try_for_each(ReferenceMesh::check)?;
    let n = first.positions.len();
    if texture.len() != n {
        return Err(Error::Invalid(format!(
            "{} colours were given to compare with a mesh of {n} vertices",
            texture.len()
        )));
    }
    finite(["red", "green", "blue"], texture.iter().map(DVec3::to_array))?;
    for other in &references[1..] {
        let same = other.positions.len() == n
            && other.triangles == first.triangles
            && other.positions.iter().zip(&first.positions).all(|(a, b)| a == b);
        if !same {
            return Err(Error::Invalid(
                "the references are of different meshes; make both of the same scene, isovalue and --refine".into(),
            ));
        }
    }
    let black = |r: &ReferenceMesh| r.radiance.iter().all(|&rgb| rgb == DVec3::ZERO);
    if references.len() == 2 && references.iter().all(black) {
        return Err(Error::Invalid(
            "both references are black: none of their paths brought light, so that there is no noise that two could cancel; \
             compare with one of them"
                .into(),
        ));
    }
    // Without noise the same is what is to be expected.
    let exact = |r: &ReferenceMesh| r.variance.as_ref().is_some_and(|v| v.iter().all(|&v| v == DVec3::ZERO));
    let noisy = !references.iter().all(exact);
    if references.len() == 2 && noisy && first.radiance == references[1].radiance {
        return Err(Error::Invalid("the two references are the same; give the second another --seed".into()));
    }
    let areas = vertex_areas(&first.positions, &first.triangles);
    let chosen: Vec<usize> = (0..n).filter(|&v| references.iter().all(|r| r.sampled[v])).collect();
    if chosen.is_empty() {
        return Err(Error::Invalid("no vertex is sampled in all references".into()));
    }
    let count = references.len() as f64;
    let mut per_vertex = vec![0.0; n];
    let (mut sum, mut squares, mut area_sum, mut area, mut lit_sum, mut lit) = (0.0, 0.0, 0.0, 0.0, 0.0, 0usize);
    let mut clamped = 0usize;
    let mut out = Accuracy { vertices: chosen.len(), references: references.len(), exposure, ..Accuracy::default() };
    for &v in &chosen {
        let t = display(texture[v], exposure);
        let r: Vec<DVec3> = references.iter().map(|r| display(r.radiance[v], exposure)).collect();
        let mean = r.iter().sum::<DVec3>() / count;
        let square = if let [a, b] = r[..] { (t - a).dot(t - b) } else { (t - mean).length_squared() };
        sum += square;
        squares += square * square;
        area_sum += square * areas[v];
        area += areas[v];
        if mean.max_element() > LIT {
            (lit_sum, lit) = (lit_sum + square, lit + 1);
        }
        let distance = (t - mean).length();
        per_vertex[v] = distance;
        clamped += usize::from(t == DVec3::ONE && r.iter().all(|&r| r == DVec3::ONE));
        out.mean += distance;
        out.max = out.max.max(100.0 * distance);
        out.bias += (t - mean).element_sum() / 3.0;
        out.noise_floor += references.iter().map(|r| noise(r, v, exposure)).sum::<f64>() / count;
    }
    let vertices = chosen.len() as f64;
    let square = sum / vertices;
    // A single vertex says nothing about how others scatter.
    let deviation = match chosen.len() {
        0 | 1 => f64::INFINITY,
        _ => ((squares / vertices - square * square).max(0.0) / (vertices - 1.0)).sqrt(),
    };
    out.percent_rms = percent(square);
    out.percent_rms_sqrt3 = out.percent_rms / 3f64.sqrt();
    out.percent_rms_area = if area > 0.0 { percent(area_sum / area) } else { 0.0 };
    out.percent_rms_lit = if lit > 0 { percent(lit_sum / lit as f64) } else { 0.0 };
    out.lit = lit as f64 / vertices;
    out.clamped = clamped as f64 / vertices;
    out.confidence = [percent(square - 1.96 * deviation), percent(square + 1.96 * deviation)];
    let floor = out.noise_floor / vertices;
    out.noise_floor = percent(floor);
    out.percent_rms_without_noise = if references.len() == 1 { percent(square - floor) } else { out.percent_rms };
    out.mean *= 100.0 / vertices;
    out.bias *= 100.0 / vertices;
    Ok((out, per_vertex))
}

/// Percent RMS of a mean square, which may be an estimate below 0.
pub(crate) fn percent(square: f64) -> f64 {
    100.0 * square.max(0.0).sqrt()
}
