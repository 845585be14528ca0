//! All light of a scene by iteration: radiance at the field's samples and in wall texels, each gathering from the
//! others over fixed stratified directions until nothing changes.

use super::{Landing, Receiver, World};
use crate::error::Result;
use crate::flattened::Side;
use crate::progress::{interrupted, unless_interrupted};
use crate::rng::{Sobol, Stage};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// How finely to solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolveSettings {
    /// Points of the radiance grid per cell and axis.
    pub factor: usize,
    /// Directions per point.
    pub gather: u32,
    /// Shadow rays per point and luminaire.
    pub shadow: u32,
    /// Texels along a wall.
    pub wall: usize,
    /// Texels along the height.
    pub heights: usize,
    /// Seed.
    pub seed: u64,
}

impl Default for SolveSettings {
    fn default() -> Self {
        Self { factor: 1, gather: 128, shadow: 16, wall: 96, heights: 64, seed: 1 }
    }
}

/// Radiance that leaves the graph and the walls. Reflected only: luminaires count 0.
#[derive(Clone, Debug)]
pub struct Solution {
    dims: [usize; 2],
    factor: f32,
    /// Per side, at the grid's points; NaN where there is no normal. Empty where no ray ever asks.
    graph: [Vec<[f32; 3]>; 2],
    /// Per segment; empty for luminaires.
    walls: Vec<Vec<[f32; 3]>>,
    wall: usize,
    heights: usize,
    seed: u64,
    /// Reflections that were summed until nothing changed.
    pub passes: usize,
    /// Rays traced, without shadow rays' bisections.
    pub rays: u64,
}

/// A point of the solution: its light sources, and where its directions land.
struct Row {
    albedo: DVec3,
    direct: DVec3,
    landings: Vec<Landing>,
}

/// Passes after which the light of albedo 0.95 has decayed to 1e-6.
const MAX_PASSES: usize = 300;

impl Solution {
    /// Solves; converged to 1e-5 of the largest radiance.
    ///
    /// # Errors
    /// `Interrupted`.
    pub fn new(world: &World, settings: &SolveSettings) -> Result<Self> {
        let field = &world.scene.field;
        let dims = field.dims().map(|n| (n - 1) * settings.factor + 1);
        let count = dims[0] * dims[1];
        let mut solution = Self {
            dims,
            factor: settings.factor as f32,
            graph: [Vec::new(), Vec::new()],
            walls: vec![Vec::new(); world.scene.segments.len()],
            wall: settings.wall,
            heights: settings.heights,
            seed: settings.seed,
            passes: 0,
            rays: 0,
        };
        let outside = world.scene.outside;
        let graph_rows = |side: Side| -> Vec<Option<Row>> {
            (0..count)
                .into_par_iter()
                .map(|o| {
                    let receiver = world.graph_receiver(solution.at(o), side)?;
                    let key = (o * 2 + side.index()) as u64;
                    Some(row(world, settings, &receiver, world.scene.albedo, key))
                })
                .collect()
        };
        let mut graph = [Vec::new(), Vec::new()];
        graph[outside.index()] = graph_rows(outside);
        let texels = settings.wall * settings.heights;
        let walls: Vec<Vec<Row>> = (0u32..)
            .zip(world.scene.segments.iter())
            .map(|(id, segment)| {
                if segment.emits() {
                    return Vec::new();
                }
                (0..texels)
                    .into_par_iter()
                    .map(|t| {
                        let u = ((t % settings.wall) as f64 + 0.5) / settings.wall as f64;
                        // The ends of the sweep are texels themselves: surfaces near them interpolate, never
                        // extrapolate.
                        let s = (t / settings.wall) as f64 / (settings.heights - 1).max(1) as f64;
                        let key = (u64::from(id) + 1) << 40 | t as u64;
                        row(world, settings, &world.wall_receiver(id, u, s), segment.albedo, key)
                    })
                    .collect()
            })
            .collect();
        unless_interrupted()?;
        // The other side of the graph matters only if light gets there.
        let other = outside.opposite();
        let meets_other = |r: &Row| r.landings.iter().any(|l| matches!(l, Landing::Graph(_, _, s) if *s == other));
        if graph[outside.index()].par_iter().flatten().any(meets_other) {
            graph[other.index()] = graph_rows(other);
            unless_interrupted()?;
        }
        let points: usize = graph.iter().map(Vec::len).chain(walls.iter().map(Vec::len)).sum();
        solution.rays = points as u64 * u64::from(settings.gather + settings.shadow);

        // Jacobi: every pass adds one reflection.
        loop {
            let radiance = |r: &Row| {
                let sum: DVec3 = r.landings.iter().map(|&l| solution.radiance(l)).sum();
                (r.albedo * (r.direct + sum / settings.gather.max(1) as f64)).as_vec3().to_array()
            };
            let next_graph: [Vec<[f32; 3]>; 2] = std::array::from_fn(|k| {
                graph[k].par_iter().map(|r| r.as_ref().map_or([f32::NAN; 3], radiance)).collect()
            });
            let next_walls: Vec<Vec<[f32; 3]>> =
                walls.iter().map(|rows| rows.par_iter().map(radiance).collect()).collect();
            let all = |graph: &[Vec<[f32; 3]>; 2], walls: &[Vec<[f32; 3]>]| -> Vec<[f32; 3]> {
                graph.iter().chain(walls).flatten().copied().filter(|p| !p[0].is_nan()).collect()
            };
            let (before, after) = (all(&solution.graph, &solution.walls), all(&next_graph, &next_walls));
            let most = after.iter().flatten().fold(0f32, |m, &x| m.max(x));
            let change = if before.len() == after.len() {
                before.iter().flatten().zip(after.iter().flatten()).fold(0f32, |m, (a, b)| m.max((a - b).abs()))
            } else {
                most
            };
            (solution.graph, solution.walls) = (next_graph, next_walls);
            solution.passes += 1;
            if !(change > 1e-5 * most) || solution.passes == MAX_PASSES {
                return Ok(solution);
            }
            unless_interrupted()?;
        }
    }

    /// Index coordinates of grid point `o`.
    fn at(&self, o: usize) -> DVec2 {
        DVec2::new((o % self.dims[0]) as f64, (o / self.dims[0]) as f64) / f64::from(self.factor)
    }

    /// The seed that it was made from.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Points of the radiance grid along x and y.
    pub fn dims(&self) -> [usize; 2] {
        self.dims
    }

    /// Radiance at the grid's points on `side`, x fastest; NaN where the graph has no normal. Empty for a side that no
    /// light reaches.
    pub fn graph(&self, side: Side) -> &[[f32; 3]] {
        &self.graph[side.index()]
    }

    /// Radiance that leaves a landing, bilinear; points without normal are left out. Beyond the sweep's ends a wall
    /// looks as at the end.
    #[inline]
    pub fn radiance(&self, landing: Landing) -> DVec3 {
        match landing {
            Landing::Dark => DVec3::ZERO,
            Landing::Graph(x, y, side) => {
                lookup(&self.graph[side.index()], self.dims, [x * self.factor, y * self.factor])
            }
            Landing::Wall(id, u, s) => {
                let at = [u * self.wall as f32 - 0.5, s * (self.heights - 1) as f32];
                lookup(&self.walls[usize::from(id)], [self.wall, self.heights], at)
            }
        }
    }
}

/// Nothing once someone has asked to stop.
fn row(world: &World, settings: &SolveSettings, receiver: &Receiver, albedo: DVec3, key: u64) -> Row {
    if interrupted() {
        return Row { albedo, direct: DVec3::ZERO, landings: Vec::new() };
    }
    let set = Sobol::set(settings.seed, Stage::Cache, key);
    let landings =
        (0..settings.gather).map(|i| world.trace(receiver, world.direction(receiver, set.point2(i, 0)))).collect();
    let direct = world.direct(receiver, settings.shadow, &Sobol::set(settings.seed, Stage::Direct, key));
    Row { albedo, direct, landings }
}

/// Bilinear lookup clamped to the raster, NaN left out.
#[inline]
pub(super) fn lookup(values: &[[f32; 3]], [nx, ny]: [usize; 2], at: [f32; 2]) -> DVec3 {
    if values.is_empty() {
        return DVec3::ZERO;
    }
    let axis = |x: f32, n: usize| {
        let x = x.clamp(0.0, (n - 1) as f32);
        let i = (x as usize).min(n.saturating_sub(2));
        (i, x - i as f32)
    };
    let ((i, fx), (j, fy)) = (axis(at[0], nx), axis(at[1], ny));
    let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
    for (di, dj) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let w = f64::from(if di == 1 { fx } else { 1.0 - fx } * if dj == 1 { fy } else { 1.0 - fy });
        let v = values[(j + dj).min(ny - 1) * nx + (i + di).min(nx - 1)];
        if w > 0.0 && !v[0].is_nan() {
            sum += w * DVec3::from_array(v.map(f64::from));
            weight += w;
        }
    }
    if weight > 0.0 { sum / weight } else { DVec3::ZERO }
}
