//! What points have of level sets, sixteen at a time.

use super::slots::{Along, LANES, Slot};
use glam::{Mat3, Vec3};

/// What is known at a point, gradients by index.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub h: f32,
    pub slope: Vec3,
    /// See [`receiver_gradient`](crate::field::Field::receiver_gradient).
    pub receiver: Vec3,
}

pub(super) type Lanes = [f32; LANES];

/// Some points of a row, and what they stand for along x.
#[derive(Default)]
pub(super) struct Block {
    pub len: usize,
    pub h: Lanes,
    pub slope: [Lanes; 3],
    pub receiver: [Lanes; 3],
    pub offset: Lanes,
    pub centre: Lanes,
    pub width: Lanes,
    pub cell: [usize; LANES],
}

/// What a block's points have of level sets.
pub(super) struct Shares {
    /// h in the middle of what each stands for, and how far it goes to either side.
    pub h: Lanes,
    pub spread: Lanes,
    /// |∇h|, times the width along x; 0 if no level set of the sweep passes, or none that faces anywhere.
    pub weight: Lanes,
    pub normal: [Lanes; 3],
}

/// As many of a list from `first` on.
#[inline(always)]
fn lanes<T>(of: &[T], first: usize) -> &[T; LANES] {
    of[first..].first_chunk().expect("lists are longer than rows of nodes")
}

impl Block {
    /// Adds a point of a cell of the grid.
    pub(super) fn push(&mut self, point: &Point, x: &Slot, cell: usize) {
        let n = self.len;
        self.h[n] = point.h;
        for a in 0..3 {
            (self.slope[a][n], self.receiver[a][n]) = (point.slope[a], point.receiver[a]);
        }
        (self.offset[n], self.centre[n], self.width[n], self.cell[n]) = (x.offset, x.centre, x.width, cell);
        self.len += 1;
    }

    /// Becomes the points beside `len` nodes from `first` on. `nodes`: h, ∂h/∂y, ∂h/∂z and the receiver gradient there,
    /// each behind a place that no node has and with [`LANES`] more.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn read(&mut self, nodes: &[Vec<f32>; 6], along: &Along, first: usize, len: usize) {
        const NEXT: f32 = Slot::BESIDE as f32;
        self.len = len;
        // A point lies between its node and the one before or after that: this one's. Mostly all lie on the same side.
        let beyond = |before: &Lanes, after: &Lanes| match along.all_up {
            Some(true) => *after,
            Some(false) => *before,
            None => {
                let mut beyond = *before;
                for n in (0..LANES).filter(|&n| along.up[first + n]) {
                    beyond[n] = after[n];
                }
                beyond
            }
        };
        let [sx, sy, sz] = &mut self.slope;
        let [rx, ry, rz] = &mut self.receiver;
        for (to, of) in [&mut self.h, sy, sz, rx, ry, rz].into_iter().zip(nodes) {
            let (near, next) = (lanes(of, first + 1), beyond(lanes(of, first), lanes(of, first + 2)));
            // An array of its own, which nothing else can be: else no vectors.
            let mut between = [0.0; LANES];
            for n in 0..LANES {
                between[n] = (1.0 - NEXT) * near[n] + NEXT * next[n];
            }
            *to = between;
        }
        let h = &nodes[0];
        let (before, near, after) = (lanes(h, first), lanes(h, first + 1), lanes(h, first + 2));
        let (mut falls, mut rises) = ([0.0; LANES], [0.0; LANES]);
        for n in 0..LANES {
            (falls[n], rises[n]) = (near[n] - before[n], after[n] - near[n]);
        }
        *sx = beyond(&falls, &rises);
        self.offset = *lanes(&along.offset, first);
        self.centre = *lanes(&along.centre, first);
        self.width = *lanes(&along.width, first);
        self.cell = *lanes(&along.cell, first);
    }

    /// What its points have, across from them slots y and z; `to_world`: of gradients by index.
    #[inline(always)]
    pub(super) fn shares(&self, [y, z]: [&Slot; 2], to_world: &Mat3) -> Shares {
        let mut shares =
            Shares { h: [0.0; LANES], spread: [0.0; LANES], weight: [0.0; LANES], normal: [[0.0; LANES]; 3] };
        for n in 0..LANES {
            let slope = Vec3::from_array(self.slope.each_ref().map(|s| s[n]));
            let receiver = Vec3::from_array(self.receiver.each_ref().map(|r| r[n]));
            let h = self.h[n] + slope.dot(Vec3::new(self.offset[n], y.offset, z.offset));
            let spread = 0.5 * (slope * Vec3::new(self.width[n], y.width, z.width)).abs().element_sum();
            // Squares of steep slopes are too large.
            let (steep, most) = (slope.abs().max_element(), receiver.abs().max_element());
            let weight = self.width[n] * steep * (*to_world * (slope * (1.0 / steep))).length();
            let normal = *to_world * -(receiver * (1.0 / most));
            let length = normal.length();
            let passed = (h + spread >= 0.0) & (h - spread <= 1.0);
            let known = (weight > 0.0) & (weight < f32::INFINITY) & (length > 0.0) & (length < f32::INFINITY);
            (shares.h[n], shares.spread[n]) = (h, spread);
            shares.weight[n] = if passed & known { weight } else { 0.0 };
            let normal = normal * (1.0 / length);
            (0..3).for_each(|a| shares.normal[a][n] = normal[a]);
        }
        shares
    }
}
