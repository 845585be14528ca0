//! The interpolation floor: what a lattice can hold at all, whatever fills it.

use super::{ReferenceMesh, display, percent};
use crate::brdf::reflected;
use crate::direct::Receiver;
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
    /// Direct light at the grid's points against direct light at (a fixed subset of) the vertices of the isosurface,
    /// which is that of `isovalue` (units of the sweep), `shadow_rays` each; percent RMS. Two independent sets of rays
    /// on both sides make it free of their noise, as in [`InterpolationFloor::total`].
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points or no vertex has a normal.
    pub fn direct(&self, isovalue: f32, shadow_rays: u32, vertices: Option<usize>) -> Result<f64> {
        let Self { scene, tracer, mesh, .. } = *self;
        let chosen = subset(mesh.local.len(), vertices);
        let direct = |seed: u64, r: &Receiver, index: u64| {
            let e = PathTracer::new(scene, tracer).direct(r, shadow_rays, Stage::Direct.key(seed, index));
            reflected(scene.surface.albedo.at(f64::from(r.isovalue)), e)
        };
        let both = [1_000_001, 1_000_002].map(|seed| {
            let through = self.through_grid(&chosen, &|r, index| direct(seed, r, index))?;
            let exact = chosen.par_iter().map(|&v| {
                let receiver = Receiver::on_level_set(scene, mesh.local[v], isovalue, scene.surface.outside)?;
                // Indices beyond those of any grid's points.
                Some(direct(seed, &receiver, 1 << 40 | v as u64))
            });
            let exact: Vec<Option<DVec3>> = exact.collect();
            Ok(through.into_iter().zip(exact).map(|(through, exact)| through.zip(exact)).collect())
        });
        let [first, second] = both;
        self.without_noise(first?, second?)
    }

    /// All light: path-traced radiance at the grid's points (`paths` each), against two independent references on the
    /// same vertices; percent RMS. Two independent sets of paths at the points make ⟨(t₁ − r₁)·(t₂ − r₂)⟩ free of the
    /// noise of both sides. 0 where that is negative.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points or no vertex is sampled.
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
        let against = |seed: u64, reference: &ReferenceMesh| -> Result<Vec<_>> {
            let through = texture(seed)?;
            Ok(chosen.iter().zip(through).map(|(&v, t)| Some((t?, reference.radiance[v]))).collect())
        };
        self.without_noise(against(1_000_001, a)?, against(1_000_002, b)?)
    }

    /// Percent RMS by pairs of light through the grid and exact light at the same vertices, two of each that know
    /// nothing of each other.
    ///
    /// # Errors
    /// `Invalid` if there are none.
    fn without_noise(&self, first: Vec<Option<(DVec3, DVec3)>>, second: Vec<Option<(DVec3, DVec3)>>) -> Result<f64> {
        let exposure = self.scene.exposure();
        let off = |(t, r): (DVec3, DVec3)| display(t, exposure) - display(r, exposure);
        let products = first.into_iter().zip(second).filter_map(|(a, b)| Some(off(a?).dot(off(b?))));
        let (sum, count) = products.fold((0.0, 0usize), |(sum, count), product| (sum + product, count + 1));
        if count == 0 {
            return Err(Error::Invalid("no vertex has light, of its own and through the grid".into()));
        }
        Ok(percent(sum / count as f64))
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
