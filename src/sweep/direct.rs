//! Direct light: the running maximum of h along fans of lines from low-discrepancy points of the luminaires. One line
//! answers for every isovalue it meets: a sample is lit on its own level set iff it exceeds everything before it.

mod near;
mod staircases;
mod texels;

use super::blockers::Blockers;
use super::clearance::Clearance;
use super::fans::Fans;
use super::flats::Flats;
use super::grid::Geometry;
use super::open_share::OpenShare;
use super::planes::{PlanePool, Planes};
use super::points::Points;
use super::receivers::Emitter;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::luminaire::unoccluded;
use crate::polygon::Polygon;
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::DVec3;
use rayon::prelude::*;

/// Rows of nodes that a thread takes at a time, at least.
const ROWS: usize = 8;

/// How far segments to flats may step: from the lower side what is below the sweep hides nothing, however far below.
/// `None` where flats are seen from inside solids, too.
pub(super) fn clearance(scene: &Scene, geometry: &Geometry, sides: &[Side]) -> Option<Clearance> {
    let inside = sides.contains(&Side::Higher) && !scene.is_capped();
    (!inside).then(|| Clearance::new(geometry))
}

/// Luminaires are no farther away in the unit of length that nodes see them in.
const MOST_UNITS: f64 = 1e6;

/// The unit of length in which nodes see a luminaire: fourth powers of the world's lengths do not fit f32, nor those of
/// distances of more than 10⁹ voxels.
fn unit(lattice: &Lattice, light: &Polygon) -> f64 {
    let centre = lattice.to_world(0.5 * lattice.far());
    let farthest = light.vertices().iter().map(|v| v.distance(centre)).fold(0.0, f64::max);
    lattice.unit().max(farthest / MOST_UNITS)
}

/// How one replicate finds direct light.
pub(super) struct Direct<'a> {
    pub scene: &'a Scene,
    pub geometry: &'a Geometry<'a>,
    /// As [`clearance`] has it.
    pub clearance: Option<&'a Clearance>,
    pub sides: &'a [Side],
    pub points: Points,
    pub isa: Isa,
    pub pool: &'a PlanePool,
}

/// Σ V g and Σ g of every side at every place of planes, over points of a luminaire; whatever factor all g of one have.
type Sums = Vec<[f32; 2]>;

impl Direct<'_> {
    /// Direct irradiance of every node, one set of planes per side; that of the flats is added to theirs at the end.
    /// `tick` is asked before every point; `None` if it stopped the work.
    pub(super) fn light(&self, flats: &mut Flats, tick: &mut dyn FnMut() -> bool) -> Option<Vec<Planes>> {
        let mut planes: Vec<Planes> = self.sides.iter().map(|_| self.pool.black(self.geometry.places())).collect();
        let corners = self.scene.lattice().corners().map(|p| self.scene.lattice().to_world(p));
        let lights = (0..).zip(self.scene.luminaires());
        let shares: Vec<OpenShare> = lights.clone().map(|light| self.points.open_share(self.scene, light)).collect();
        for ((number, light), open) in lights.zip(&shares) {
            let blockers = Blockers::new(self.scene, number, &corners);
            let mut sums = self.seen((number, light), &blockers, tick)?;
            if !open.whole() {
                self.correct(open, &mut sums);
            }
            self.look_from_near(number, &blockers, &mut sums);
            self.add(light, &sums, &mut planes);
        }
        for (number, open) in (0..).zip(&shares) {
            self.light_flats(flats, number, open);
        }
        Some(planes)
    }

    /// What nodes see of a luminaire's points along fans of lines; `None` if `tick` stopped it.
    #[allow(clippy::cast_possible_truncation, reason = "samples are f32")]
    fn seen(
        &self,
        (number, light): (u32, &Polygon),
        blockers: &Blockers,
        tick: &mut dyn FnMut() -> bool,
    ) -> Option<Sums> {
        let (scene, geometry, sides) = (self.scene, self.geometry, self.sides);
        let (lit, lattice) = (geometry.lit_rows(), scene.lattice());
        let [_, ny, _] = geometry.dims;
        // 0 gives no light to a side that nobody asks for.
        let wanted = Side::BOTH.map(|s| f32::from(sides.contains(&s)));
        let place = Side::BOTH.map(|s| sides.iter().position(|x| *x == s).unwrap_or(0));
        let unit = unit(lattice, light);
        let per = sides.len();
        let mut sums = vec![[0f32; 2]; per * lit.len()];
        let mut fans = Fans::default();
        for &world in &self.points.on(light, number) {
            if !tick() {
                return None;
            }
            let y = lattice.to_index(world);
            let inside = (0..3).all(|a| y[a] >= 0.0 && y[a] <= lattice.far()[a]);
            let start = if inside { scene.field.value(y) as f32 } else { f32::NAN };
            let start = match start.is_nan() {
                false => [start; 2],
                // Caps let no light into solids.
                true if !inside && scene.is_capped() => [f32::NEG_INFINITY; 2],
                true => [f32::NEG_INFINITY, f32::INFINITY],
            };
            fans.march((geometry, self.isa, sides), y, start);
            // The unit falls out.
            let emitter = Emitter {
                fans: &fans,
                number,
                blockers,
                facing: light.normal().as_vec3().to_array(),
                step: (lattice.axes().x_axis / unit).as_vec3().to_array(),
                wanted,
                place,
            };
            let rows = lit.split(&mut sums, per).into_par_iter().enumerate().with_max_len(32);
            rows.filter(|(_, sums)| !sums.is_empty()).for_each(|(row, sums)| {
                let (j, k) = (row % ny, row / ny);
                let (first, run) = lit.run(row);
                let begin = DVec3::new(0.0, j as f64, k as f64);
                let to = ((world - lattice.to_world(begin)) / unit).as_vec3().to_array();
                geometry.lit_vectors(row, |a, b| {
                    let sums = &mut sums[per * (a - first)..per * (b - first)];
                    let normals = &geometry.normals[run.clone()][a - first..b - first];
                    self.isa.receive(&emitter, [a, j, k], to, normals, sums);
                });
            });
        }
        Some(sums)
    }

    /// Corrects what is seen for what the points misjudge of the luminaire's open share.
    #[allow(clippy::cast_possible_truncation, reason = "sums are f32")]
    fn correct(&self, open: &OpenShare, sums: &mut Sums) {
        let (lit, per) = (self.geometry.lit_rows(), self.sides.len());
        let nx = self.geometry.dims[0];
        let rows = lit.split(sums, per).into_par_iter().enumerate().with_min_len(ROWS);
        rows.for_each(|(row, sums)| {
            let (first, _) = lit.run(row);
            self.geometry.lit_nodes(row, |i| {
                for (side, sum) in self.sides.iter().zip(&mut sums[(i - first) * per..]) {
                    if sum[0] > 0.0 {
                        sum[0] *= open.correction(*side, self.geometry.h[row * nx + i]) as f32;
                    }
                }
            });
        });
    }

    /// Adds the irradiance of a luminaire: what there is of it without anything in between, times what is seen.
    fn add(&self, light: &Polygon, sums: &Sums, planes: &mut [Planes]) {
        let (lit, lattice) = (self.geometry.lit_rows(), self.scene.lattice());
        let ([nx, ny, _], per) = (self.geometry.dims, self.sides.len());
        for (s, (side, planes)) in self.sides.iter().zip(planes).enumerate() {
            let rows: (Vec<_>, Vec<_>, Vec<_>) = planes.each_mut().map(|plane| lit.split(plane, 1)).into();
            rows.into_par_iter().enumerate().with_min_len(ROWS).for_each(|(row, (r, g, b))| {
                let [y, z] = [row % ny, row / ny].map(|x| x as f64);
                let (first, run) = lit.run(row);
                self.geometry.lit_nodes(row, |i| {
                    let (at, place) = (row * nx + i, i - first);
                    let [seen, all] = sums[(run.start + place) * per + s];
                    if seen > 0.0 {
                        let normal = self.geometry.normal(at).expect("only nodes with a normal were lit");
                        let normal = side.facing(normal);
                        let e = unoccluded(light, lattice.to_world(DVec3::new(i as f64, y, z)), normal);
                        let e = (light.emission * (e * f64::from((seen / all).min(1.0)))).as_vec3();
                        (r[place], g[place], b[place]) = (r[place] + e.x, g[place] + e.y, b[place] + e.z);
                    }
                });
            });
        }
    }
}
