//! The interpolation floor: what a lattice can hold at all, whatever fills it.

use super::{Accuracy, ReferenceMesh, compare};
use crate::brdf::reflected;
use crate::direct::direct_irradiance;
use crate::error::Result;
use crate::illumination_grid::GridSize;
use crate::mask::stand_ins;
use crate::reference::{receiver, subset};
use crate::rng::Stage;
use crate::scene::Scene;
use crate::surface_mesh::SurfaceMesh;
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::DVec3;
use rayon::prelude::*;

/// Exact direct light at the points of a grid `factor` times as fine as the volume's, interpolated linearly, against
/// exact direct light at (a fixed subset of) the vertices of the isosurface at `isovalue` (units of the sweep). "Exact" is
/// the closed form times the visible share of `shadow_rays` low-discrepancy points. Only points that the vertices'
/// cells touch are computed; points without a level set of their own are filled from their surroundings as bakes do.
///
/// # Errors
/// `Invalid` if the grid has too many points or no vertex has a normal.
pub fn interpolation_floor<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    mesh: &SurfaceMesh,
    isovalue: f32,
    factor: usize,
    shadow_rays: u32,
    vertices: Option<usize>,
) -> Result<Accuracy> {
    let side = scene.surface.outside;
    let lattice = GridSize::Factor(factor).lattice(scene.lattice())?;
    let direct = |p: DVec3, c: f32, index: u64| {
        let r = receiver(scene, p, c, side)?;
        let e = direct_irradiance(scene, tracer, &r, shadow_rays, (0, Stage::Direct, index)).mean;
        Some(reflected(scene.surface.albedo, e))
    };
    let chosen = subset(mesh.local.len(), vertices);
    let at_vertices: Vec<Option<DVec3>> =
        chosen.par_iter().map(|&v| direct(mesh.local[v], isovalue, v as u64)).collect();

    let scale = lattice.far() / scene.lattice().far();
    let mut points: Vec<usize> =
        chosen.iter().flat_map(|&v| corners(&lattice, mesh.local[v] * scale).map(|(o, _)| o)).collect();
    points.sort_unstable();
    points.dedup();
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    let at_points: Vec<Option<DVec3>> = points
        .par_iter()
        .map(|&o| {
            let (mut sum, mut count) = (DVec3::ZERO, 0.0);
            for (i, p) in stand_ins(&scene.field, &lattice, o, 0).into_iter().flatten().enumerate() {
                if let Some(value) = direct(p, scene.field.value(p) as f32, (o * 2 + i) as u64) {
                    (sum, count) = (sum + value, count + 1.0);
                }
            }
            (count > 0.0).then(|| sum / count)
        })
        .collect();

    let n = mesh.local.len();
    let (mut texture, mut radiance, mut sampled) = (vec![DVec3::ZERO; n], vec![DVec3::ZERO; n], vec![false; n]);
    for (&v, exact) in chosen.iter().zip(at_vertices) {
        let Some(exact) = exact else { continue };
        let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
        for (o, w) in corners(&lattice, mesh.local[v] * scale) {
            let slot = points.binary_search(&o).expect("all corners are listed");
            if let Some(value) = at_points[slot] {
                (sum, weight) = (sum + w * value, weight + w);
            }
        }
        if weight > 0.0 {
            (texture[v], radiance[v], sampled[v]) = (sum / weight, exact, true);
        }
    }
    let reference = ReferenceMesh {
        positions: mesh.positions.clone(),
        triangles: mesh.triangles.clone(),
        variance: vec![DVec3::ZERO; n],
        radiance,
        sampled,
    };
    Ok(compare(&texture, &[reference], scene.exposure())?.0)
}

/// The eight lattice points around index coordinates `p`, with their linear weights.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside the lattice")]
fn corners(lattice: &Lattice, p: DVec3) -> [(usize, f64); 8] {
    let far = lattice.far();
    let p = p.clamp(DVec3::ZERO, far);
    let base = p.floor().min(far - 1.0);
    let u = p - base;
    std::array::from_fn(|n| {
        let bit = [n & 1, n >> 1 & 1, n >> 2];
        let w = (0..3).map(|a| if bit[a] == 1 { u[a] } else { 1.0 - u[a] }).product();
        let at: [usize; 3] = std::array::from_fn(|a| base[a] as usize + bit[a]);
        (lattice.offset(at[0], at[1], at[2]), w)
    })
}
