//! The interpolation floor: what a lattice can hold at all, whatever fills it.

use super::{Accuracy, ReferenceMesh, compare, display, percent};
use crate::brdf::reflected;
use crate::direct::{Receiver, direct_irradiance};
use crate::error::{Error, Result};
use crate::illumination_grid::GridSize;
use crate::mask::stand_ins;
use crate::reference::{PathTracer, subset};
use crate::rng::Stage;
use crate::scene::Scene;
use crate::surface_mesh::SurfaceMesh;
use crate::tracer::Tracer;
use glam::DVec3;
use rayon::prelude::*;

/// The interpolation floor of one isosurface: exact light at the points of a grid, interpolated linearly.
#[derive(Clone, Copy, Debug)]
pub struct InterpolationFloor<'a, T> {
    /// The scene.
    pub scene: &'a Scene,
    /// Its tracer.
    pub tracer: &'a T,
    /// The isosurface.
    pub mesh: &'a SurfaceMesh,
    /// The grid.
    pub grid: GridSize,
}

impl<T: Tracer> InterpolationFloor<'_, T> {
    /// Direct light, against exact direct light at (a fixed subset of) the vertices of the isosurface, which is that of
    /// `isovalue` (units of the sweep). "Exact" is the closed form times the visible share of `shadow_rays`
    /// low-discrepancy points.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points or no vertex has a normal.
    pub fn direct(&self, isovalue: f32, shadow_rays: u32, vertices: Option<usize>) -> Result<Accuracy> {
        let Self { scene, tracer, mesh, .. } = *self;
        let direct = |r: &Receiver, index: u64| {
            let e = direct_irradiance(scene, tracer, r, shadow_rays, Stage::Direct.key(0, index)).mean;
            reflected(scene.surface.albedo.at(f64::from(r.isovalue)), e)
        };
        let chosen = subset(mesh.local.len(), vertices);
        let interpolated = self.through_grid(&chosen, &direct)?;
        let n = mesh.local.len();
        let (mut texture, mut radiance, mut sampled) = (vec![DVec3::ZERO; n], vec![DVec3::ZERO; n], vec![false; n]);
        let exact: Vec<Option<DVec3>> = chosen
            .par_iter()
            .map(|&v| {
                Some(direct(
                    &Receiver::on_level_set(scene, mesh.local[v], isovalue, scene.surface.outside)?,
                    !(v as u64),
                ))
            })
            .collect();
        for ((&v, exact), through) in chosen.iter().zip(exact).zip(interpolated) {
            if let (Some(exact), Some(through)) = (exact, through) {
                (texture[v], radiance[v], sampled[v]) = (through, exact, true);
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

    /// All light: path-traced radiance at the grid's points (`paths` each), against two independent references on the
    /// same vertices; percent RMS. Two independent sets of paths at the points make ⟨(t₁ − r₁)·(t₂ − r₂)⟩ free of the
    /// noise of both sides. 0 where that is negative.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points.
    pub fn total(&self, references: &[ReferenceMesh], paths: u32, vertices: usize) -> Result<f64> {
        let Self { scene, tracer, mesh, .. } = *self;
        let [a, b] = references else {
            return Err(Error::Invalid("the floor of all light needs two references".into()));
        };
        let mut chosen: Vec<usize> = (0..mesh.local.len()).filter(|&v| a.sampled[v] && b.sampled[v]).collect();
        let keep = subset(chosen.len(), Some(vertices));
        chosen = keep.into_iter().map(|i| chosen[i]).collect();
        let texture = |seed: u64| {
            let value = |r: &Receiver, index: u64| {
                PathTracer::new(scene, tracer).outgoing(r, paths, Stage::Path.key(seed, index))
            };
            self.through_grid(&chosen, &value)
        };
        let (first, second) = (texture(1_000_001)?, texture(1_000_002)?);
        let exposure = scene.exposure();
        let (mut sum, mut count) = (0.0, 0.0);
        for ((&v, t), u) in chosen.iter().zip(first).zip(second) {
            let (Some(t), Some(u)) = (t, u) else { continue };
            let d = |t: DVec3, r: &ReferenceMesh| display(t, exposure) - display(r.radiance[v], exposure);
            sum += d(t, a).dot(d(u, b));
            count += 1.0;
        }
        Ok(percent(sum / f64::max(count, 1.0)))
    }

    /// Radiance at the vertices `chosen` as the grid gives it if its points hold `value(receiver, index)`. Only points
    /// that the vertices' cells touch are asked for; those without a level set of their own are filled from their
    /// surroundings, by means where bakes fit. `None` where no point of a cell holds anything.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points.
    fn through_grid(
        &self,
        chosen: &[usize],
        value: &(dyn Fn(&Receiver, u64) -> DVec3 + Sync),
    ) -> Result<Vec<Option<DVec3>>> {
        let Self { scene, mesh, .. } = *self;
        let lattice = self.grid.lattice(scene.lattice())?;
        let scale = lattice.far() / scene.lattice().far();
        let around = |v: usize| lattice.around(mesh.local[v] * scale);
        let mut points: Vec<usize> = chosen.iter().flat_map(|&v| around(v).map(|(o, _)| o)).collect();
        points.sort_unstable();
        points.dedup();
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let held: Vec<Option<DVec3>> = points
            .par_iter()
            .map(|&o| {
                let (mut sum, mut count) = (DVec3::ZERO, 0.0);
                for (i, p) in stand_ins::<2>(&scene.field, &lattice, o, 0).into_iter().flatten().enumerate() {
                    if let Some(r) =
                        Receiver::on_level_set(scene, p, scene.field.value(p) as f32, scene.surface.outside)
                    {
                        (sum, count) = (sum + value(&r, (o * 2 + i) as u64), count + 1.0);
                    }
                }
                (count > 0.0).then(|| sum / count)
            })
            .collect();
        let at = |&v: &usize| {
            let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
            for (o, w) in around(v) {
                let slot = points.binary_search(&o).expect("all corners are listed");
                if let Some(value) = held[slot] {
                    (sum, weight) = (sum + w * value, weight + w);
                }
            }
            (weight > 0.0).then(|| sum / weight)
        };
        Ok(chosen.iter().map(at).collect())
    }
}
