//! A field at the points of a lattice over Ω, a row along x at a time: in which cell a point lies and where is found
//! once for each axis instead of once for each point.

use super::Field;
use crate::volume::Lattice;
use glam::DVec3;

/// The rows of one lattice.
#[derive(Debug)]
pub struct FieldRows<'a> {
    field: &'a Field,
    places: Places,
    /// The field whose nodes have receiver gradients, and the places in it; `None` if its nodes are the lattice's
    /// points.
    normals: (&'a Field, Option<Places>),
}

/// Cell and place in it, [0, 1], of every point along an axis.
type Places = [Vec<(usize, f64)>; 3];

/// Room for the receiver gradients of a row.
#[derive(Debug, Default)]
pub struct GradientRow {
    /// Of the nodes around the row, in index space: interpolated across it.
    nodes: Vec<DVec3>,
    points: Vec<DVec3>,
}

impl<'a> FieldRows<'a> {
    /// The rows of `lattice`, which spans the Ω of `field`.
    pub fn new(field: &'a Field, lattice: &Lattice) -> Self {
        let normals = field.coarse.as_deref().unwrap_or(field);
        let apart = normals.lattice != *lattice;
        Self { field, places: places(field, lattice), normals: (normals, apart.then(|| places(normals, lattice))) }
    }

    /// [`Field::value`] of a point.
    #[inline(always)]
    pub fn value(&self, point: [usize; 3]) -> f64 {
        let [(i, u), (j, v), (k, w)] = [0, 1, 2].map(|a| self.places[a][point[a]]);
        self.field.value_in([i, j, k], DVec3::new(u, v, w))
    }

    /// [`Self::value`] of the points of row (`j`, `k`), in their order, rounded to f32; `to` takes one for each.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub fn values(&self, j: usize, k: usize, to: &mut [f32]) {
        to.iter_mut().enumerate().for_each(|(i, to)| *to = self.value([i, j, k]) as f32);
    }

    /// [`Field::receiver_gradient`] of the points of row (`j`, `k`), in their order, up to rounding.
    pub fn gradients<'r>(&self, j: usize, k: usize, row: &'r mut GradientRow) -> &'r [DVec3] {
        let (normals, places) = (self.normals.0, &self.normals.1);
        row.points.clear();
        let Some([along, y, z]) = places else {
            row.points.extend((0..self.places[0].len()).map(|i| normals.node_gradient([i, j, k])));
            return &row.points;
        };
        let ((j, v), (k, w)) = (y[j], z[k]);
        let across = [
            (j, k, (1.0 - v) * (1.0 - w)),
            (j + 1, k, v * (1.0 - w)),
            (j, k + 1, (1.0 - v) * w),
            (j + 1, k + 1, v * w),
        ];
        row.nodes.clear();
        row.nodes.resize(normals.lattice.dims()[0], DVec3::ZERO);
        for (j, k, weight) in across.into_iter().filter(|a| a.2 != 0.0) {
            for (i, sum) in row.nodes.iter_mut().enumerate() {
                *sum += weight * normals.node_differences([i, j, k]);
            }
        }
        let nodes = &row.nodes;
        let points =
            along.iter().map(|&(i, u)| normals.lattice.gradient_to_world((1.0 - u) * nodes[i] + u * nodes[i + 1]));
        row.points.extend(points);
        &row.points
    }
}

fn places(field: &Field, lattice: &Lattice) -> Places {
    let scale = field.lattice.far() / lattice.far();
    let same = field.lattice == *lattice;
    [0, 1, 2].map(|a| {
        let place = |i: usize| {
            let x = if same { i as f64 } else { i as f64 * scale[a] };
            let (cell, local) = field.locate(DVec3::AXES[a] * x);
            (cell[a], local[a])
        };
        (0..lattice.dims()[a]).map(place).collect()
    })
}
