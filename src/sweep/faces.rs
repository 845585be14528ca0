//! Nodes on Ω's sides along u and v, beside which lines are on one side only.

use super::directions::Layout;
use super::flats::Flats;
use super::grid::Geometry;
use super::half::{Half4, colour, encode};
use super::pack::{LANES, Pack};
use super::scan::Light;
use crate::flattened::Side;
use crate::polygon::Polygon;
use crate::scene::{ON, Scene};
use glam::DVec3;
use rayon::prelude::*;

/// What a row of lines ends on: per direction (+, −) the place of each line's end in [`super::flats::Flats::packed`].
pub(super) type RowEnds = [Vec<u32>; 2];

/// The end of a line that a luminaire cuts in Ω.
const CUT: u32 = u32::MAX;

/// Notes what the lines of a pack end on, the first of which is line `start` of its row.
pub(super) fn note(pack: &Pack, ends: &mut RowEnds, start: usize) {
    for (ends, lasts) in ends.iter_mut().zip(&pack.lasts) {
        let ends = &mut ends[start..start + LANES];
        ends.copy_from_slice(lasts);
        pack.cuts.iter().for_each(|cut| ends[cut.lane] = CUT);
    }
}

/// By how many lines the cell of lines around node `j` of `n` is to be moved into Ω: on Ω's faces the light is linear
/// beyond the last two lines. 0 if there is only one.
pub(super) fn inwards(j: usize, n: usize) -> isize {
    match j {
        _ if n == 2 => 0,
        0 => 1,
        j if j == n - 1 => -1,
        _ => 0,
    }
}

/// The two lines along u that node `i` of `nu` takes its light from, and the weights of the second of them and of the
/// row of lines before. `line0` is the line just beyond node 0, `[fu, fv]` are the weights of a node with lines on both
/// sides. A node on a side of Ω has both within, the nearer one first: light is extrapolated from them (`extrapolates`;
/// weights then leave 0 … 1) or clamped.
#[inline(always)]
pub(super) fn lines_around(
    (i, nu): (usize, usize),
    line0: usize,
    [fu, fv]: [f32; 2],
    extrapolates: bool,
) -> ([usize; 2], [f32; 2]) {
    let (lines, f) = match i {
        _ if nu == 2 => ([line0, line0], 0.0),
        0 => ([line0, line0 + 1], -fu),
        i if i == nu - 1 => ([line0 + nu - 2, line0 + nu - 3], fu - 1.0),
        i => ([line0 + i, line0 + i - 1], fu),
    };
    (lines, if extrapolates { [f, fv] } else { [f, fv].map(|f| f.clamp(0.0, 1.0)) })
}

/// Whether node `j` of `n` is on a side.
pub(super) fn on_side(j: usize, n: usize) -> bool {
    j == 0 || j == n - 1
}

/// Whether lines leave Ω by the side that node `j` of `n` is on towards +τ (true) or −τ.
fn leaves(j: usize, n: usize, slope: f64) -> Option<bool> {
    match j {
        _ if slope == 0.0 => None,
        0 => Some(slope < 0.0),
        j if j == n - 1 => Some(slope > 0.0),
        _ => None,
    }
}

/// No wall.
const NONE: u16 = u16::MAX;

/// What lit nodes on Ω's faces touch: per face, which is 2 · axis, + 1 for the far one, and node of it the number of a
/// wall that reflects, or [`NONE`]; nothing of faces that no wall touches.
pub(super) struct FaceWalls<'a> {
    scene: &'a Scene,
    walls: [Vec<u16>; 6],
}

/// Radiance of the walls that nodes on Ω's faces touch.
pub(super) struct FaceWallLight<'a> {
    face_walls: &'a FaceWalls<'a>,
    radiance: [Vec<Half4>; 6],
}

/// The axes of a face across `axis`.
fn across(axis: usize) -> [usize; 2] {
    [usize::from(axis == 0), if axis == 2 { 1 } else { 2 }]
}

/// Where node `ijk` is in a face of `axis`.
fn place(dims: [usize; 3], axis: usize, ijk: [usize; 3]) -> usize {
    let [b, c] = across(axis);
    ijk[b] + ijk[c] * dims[b]
}

/// The number of node `at` of a face.
fn node(dims: [usize; 3], face: usize, at: usize) -> [usize; 3] {
    let axis = face / 2;
    let [b, c] = across(axis);
    let mut ijk = [0; 3];
    (ijk[axis], ijk[b], ijk[c]) = (face % 2 * (dims[axis] - 1), at % dims[b], at / dims[b]);
    ijk
}

impl<'a> FaceWalls<'a> {
    #[allow(clippy::cast_possible_truncation, reason = "fewer than 2¹⁶ polygons")]
    pub(super) fn new(scene: &'a Scene, geometry: &Geometry, flats: &Flats) -> Self {
        let (lattice, dims) = (scene.lattice(), geometry.dims);
        let near = ON * lattice.spacing().min_element();
        let walls = std::array::from_fn(|face| {
            let on_face = |x: &DVec3| {
                let x = lattice.to_index(*x)[face / 2];
                (x - (face % 2 * (dims[face / 2] - 1)) as f64).abs() < ON
            };
            let inwards = |p: &Polygon| p.height(lattice.to_world(0.5 * lattice.far())) > 0.0;
            let touch = |p: &Polygon| p.vertices().iter().all(on_face) && inwards(p);
            let all = scene.polygons().iter().enumerate();
            let walls: Vec<_> = all.filter(|(i, p)| flats.textures[*i].is_some() && touch(p)).collect();
            if walls.is_empty() {
                return Vec::new();
            }
            let nodes = dims[0] * dims[1] * dims[2] / dims[face / 2];
            let wall = |at: usize| {
                let [i, j, k] = node(dims, face, at);
                let lit = geometry.lit(lattice.offset(i, j, k));
                let x = lattice.to_world(DVec3::new(i as f64, j as f64, k as f64));
                // Behind a luminaire that covers the wall it is not the wall that is seen.
                let wall = walls.iter().find(|(_, p)| lit && p.is_nearer(x, near) && !scene.covers(x));
                wall.map_or(NONE, |(number, _)| *number as u16)
            };
            (0..nodes).into_par_iter().map(wall).collect()
        });
        Self { scene, walls }
    }

    /// What `side` of the level sets sees there now, times the scale that [`Flats::packed`] has.
    #[allow(clippy::cast_possible_truncation, reason = "texture coordinates")]
    pub(super) fn now(&self, geometry: &Geometry, flats: &Flats, side: Side) -> FaceWallLight<'_> {
        let (lattice, dims) = (self.scene.lattice(), geometry.dims);
        let stands =
            Light { b: &[], back: &[], flats: &flats.packed, isovalues: flats.isovalues, axis: &flats.axis, across: 0 };
        let radiance = std::array::from_fn(|face| {
            let shown = |(at, &number): (usize, &u16)| {
                let Some(wall) = self.scene.polygons().get(usize::from(number)) else { return Half4::default() };
                let [i, j, k] = node(dims, face, at);
                let c = geometry.h[lattice.offset(i, j, k)];
                let uv = wall.texture(lattice.to_world(DVec3::new(i as f64, j as f64, k as f64)));
                let texels = flats.texels(flats.number(u32::from(number), side), uv.map(|x| x.clamp(0.0, 1.0) as f32));
                let shows = texels.into_iter().flatten().map(|(start, w)| stands.end(start, c).map(|b| w * b));
                let [r, g, b] = shows.fold([0.0; 3], |sum, b| std::array::from_fn(|c| sum[c] + b[c]));
                [encode(r), encode(g), encode(b), 0]
            };
            self.walls[face].par_iter().enumerate().map(shown).collect()
        });
        FaceWallLight { face_walls: self, radiance }
    }
}

impl FaceWallLight<'_> {
    /// Radiance of the wall that node `ijk` touches with the side of `axis`.
    #[inline]
    fn at(&self, axis: usize, ijk: [usize; 3]) -> Option<[f32; 3]> {
        let face = 2 * axis + usize::from(ijk[axis] > 0);
        let at = place(self.face_walls.scene.lattice().dims(), axis, ijk);
        let wall = *self.face_walls.walls[face].get(at)?;
        (wall != NONE).then(|| colour(self.radiance[face][at]))
    }
}

/// What two rows of lines bring to nodes on sides, of a row of nodes in a slice.
pub(super) struct Sides<'a> {
    pub layout: Layout,
    /// Which row along v it is, in which slice.
    pub row: [usize; 2],
    /// The lines' steps along u and v.
    pub slope: [f64; 2],
    /// This row of lines and the one before: \[channel\]\[line\], and what they end on.
    pub light: [[&'a [f32]; 3]; 2],
    pub ends: [&'a RowEnds; 2],
    /// The line just beyond node 0, −1 of which is missing, and weights, as [`super::accumulate`] has them.
    pub line0: usize,
    pub weights: [f32; 2],
    /// As [`lines_around`].
    pub extrapolates: bool,
    pub stands: Light<'a>,
    pub wall_light: &'a FaceWallLight<'a>,
}

impl Sides<'_> {
    /// Radiance that comes to node `i` on isovalue `c` from +τ (`forward`) or −τ. What is beyond the side that the node
    /// is on is a wall that stands there, or what the nearest line ends on; for the rest, the light that lines bring
    /// goes on linearly, or is that of the nearest ones.
    pub(super) fn radiance(&self, i: usize, c: f32, forward: bool) -> [f32; 3] {
        let [nu, nv, _] = self.layout.dims;
        let [j, k] = self.row;
        let ([near, far], [f, fv]) = lines_around((i, nu), self.line0, self.weights, self.extrapolates);
        let sides = [leaves(i, nu, self.slope[0]), leaves(j, nv, self.slope[1])];
        if let Some(side) = sides.iter().position(|side| *side == Some(forward)) {
            let axes = self.layout.axes;
            let mut ijk = [0; 3];
            (ijk[axes[0]], ijk[axes[1]], ijk[axes[2]]) = (i, j, k);
            if let Some(radiance) = self.wall_light.at(axes[side], ijk) {
                return radiance;
            }
            let nearest = if f > 0.5 { far } else { near };
            let end = self.ends[usize::from(fv > 0.5)][usize::from(!forward)][nearest];
            if end != CUT {
                return self.stands.end(end as usize, c);
            }
        }
        std::array::from_fn(|c| {
            let [this, before] = self.light.map(|light| (1.0 - f) * light[c][near] + f * light[c][far]);
            (1.0 - fv) * this + fv * before
        })
    }
}
