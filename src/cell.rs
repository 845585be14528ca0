//! One hexahedron of the graph: 8 samples, the cubic along a ray, and signs on its faces that neighbours share.

use crate::cubic::Cubic;
use crate::field::trilinear;
use glam::DVec3;

/// The 8 samples of a cell; bit a of the position says which end along axis a.
#[derive(Clone, Copy, Debug)]
pub struct Cell {
    /// Samples in units of the sweep.
    pub s: [f32; 8],
}

impl Cell {
    /// Which corners are inside, bit by bit: h ≥ c. The cell holds a piece of L(h, c) if some are and some are not; a
    /// NaN counts as outside, and the caller keeps cells with NaN away.
    #[inline(always)]
    pub fn inside(&self, c: f32) -> u8 {
        let [a, b, d, e, f, g, h, i] = self.s.map(|s| u8::from(s >= c));
        a | b << 1 | d << 2 | e << 3 | f << 4 | g << 5 | h << 6 | i << 7
    }

    /// h at cell-local `p` in [0, 1]³; exact at the corners.
    #[inline(always)]
    pub fn value(&self, p: DVec3) -> f64 {
        trilinear(&self.s.map(f64::from), p)
    }

    /// dh/dt at cell-local `p` along `d`. Each difference is weighted by what it counts for there.
    #[inline(always)]
    pub fn slope(&self, p: DVec3, d: DVec3) -> f64 {
        let s = self.s.map(f64::from);
        let along = |a: usize, b: usize, u: f64, c: usize, v: f64| {
            let rise = |o: usize| s[o + a] - s[o];
            lerp(lerp(rise(0), rise(b), u), lerp(rise(c), rise(b + c), u), v)
        };
        d.x * along(1, 2, p.y, 4, p.z) + d.y * along(2, 1, p.x, 4, p.z) + d.z * along(4, 1, p.x, 2, p.y)
    }

    /// h − c along p + t d as a cubic in t, by 37-operation coefficients: h = P(x,y) + z Q(x,y), each restricted to the
    /// ray. \[HSEAM22, after Parker99\]
    #[inline(always)]
    pub fn cubic(&self, c: f64, p: DVec3, d: DVec3) -> Cubic {
        let s = self.s.map(f64::from);
        // P = k0 + k1 x + k2 y + k3 xy on the face z = 0, Q likewise is the rise to z = 1.
        let (k0, k1, k2) = (s[0], s[1] - s[0], s[2] - s[0]);
        let k3 = s[3] - s[2] - k1;
        let (k4, a) = (s[4] - s[0], s[5] - s[4]);
        let k5 = a - k1;
        let k6 = s[6] - s[4] - k2;
        let k7 = s[7] - s[6] - a - k3;
        let (m0, m1, m2) = (p.x * p.y, d.x * d.y, p.x * d.y + p.y * d.x);
        let (p0, p1, p2) = ((k0 - c) + k1 * p.x + k2 * p.y + k3 * m0, k1 * d.x + k2 * d.y + k3 * m2, k3 * m1);
        let (q0, q1, q2) = (k4 + k5 * p.x + k6 * p.y + k7 * m0, k5 * d.x + k6 * d.y + k7 * m2, k7 * m1);
        Cubic { c: [p0 + p.z * q0, p1 + p.z * q1 + d.z * q0, p2 + p.z * q2 + d.z * q1, d.z * q2] }
    }

    /// Whether h ≥ c at (u, v) on the face across `axis` at its near (`far` = false) or far end; u and v run along the
    /// next two axes in cyclic order. Bit for bit the same from both cells that share the face: it uses the face's own
    /// corners only, and equal signs of all four decide without arithmetic. The same bits as [`Cell::value`] on the
    /// face.
    #[inline(always)]
    pub fn face_inside(&self, axis: usize, far: bool, c: f64, u: f64, v: f64) -> bool {
        let (b, d) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
        let base = usize::from(far) << axis;
        let [s00, s10, s01, s11] = [0, b, d, b + d].map(|o| f64::from(self.s[base + o]));
        let count = u8::from(s00 >= c) + u8::from(s10 >= c) + u8::from(s01 >= c) + u8::from(s11 >= c);
        match count {
            0 => false,
            4 => true,
            // In the order of [`Cell::value`]: x, y, z.
            _ if axis == 1 => lerp(lerp(s00, s01, v), lerp(s10, s11, v), u) >= c,
            _ => lerp(lerp(s00, s10, u), lerp(s01, s11, u), v) >= c,
        }
    }
}

/// a to b by weights: a corner that does not count (u = 0 or 1) leaves no rounding behind, however large it is.
#[inline(always)]
fn lerp(a: f64, b: f64, u: f64) -> f64 {
    (1.0 - u) * a + u * b
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    fn random_cell(rng: &mut Rng) -> Cell {
        Cell { s: std::array::from_fn(|_| rng.unit() as f32) }
    }

    #[test]
    fn the_cubic_is_h_along_the_ray() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        for _ in 0..10_000 {
            let cell = random_cell(&mut rng);
            let p = DVec3::new(rng.unit(), rng.unit(), rng.unit());
            let d = DVec3::new(rng.unit() - 0.5, rng.unit() - 0.5, rng.unit() - 0.5);
            let cubic = cell.cubic(0.4, p, d);
            for t in [0.0, 0.3, 1.0] {
                assert!((cubic.value(t) - (cell.value(p + d * t) - 0.4)).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn neighbours_agree_on_shared_faces() {
        let mut rng = Rng::stream(1, Stage::Test, 1);
        for round in 0..100_000 {
            let axis = round % 3;
            let (a, mut b) = (random_cell(&mut rng), random_cell(&mut rng));
            for corner in 0..8usize {
                if corner >> axis & 1 == 0 {
                    b.s[corner] = a.s[corner | 1 << axis];
                }
            }
            let (u, v) = (rng.unit(), rng.unit());
            // c on a corner, on the face's own interpolated value, or anywhere.
            let c = match round % 5 {
                0 => f64::from(a.s[1 << axis]),
                1 => b.value(match axis {
                    0 => DVec3::new(0.0, u, v),
                    1 => DVec3::new(v, 0.0, u),
                    _ => DVec3::new(u, v, 0.0),
                }),
                _ => rng.unit(),
            };
            assert_eq!(a.face_inside(axis, true, c, u, v), b.face_inside(axis, false, c, u, v));
        }
    }

    #[test]
    fn a_huge_corner_far_away_does_not_touch_the_sign() {
        let cell = Cell { s: [1e30, 0.5, 1e30, 0.25, 1e30, 0.5, -1e30, 0.25] };
        assert_eq!(cell.value(DVec3::X), 0.5);
        assert_eq!(cell.value(DVec3::new(1.0, 0.5, 0.25)), 0.375);
        assert_eq!(cell.slope(DVec3::new(1.0, 0.5, 0.25), DVec3::new(0.0, 2.0, 1.0)), -0.5);
        // Faces across y and z, at the edges where x = 1.
        for (v, c, inside) in [(0.0, 0.5, true), (0.0, 0.6, false), (1.0, 0.25, true), (1.0, 0.3, false)] {
            assert_eq!(cell.face_inside(2, false, c, 1.0, v), inside, "z, {v} {c}");
        }
        for (c, inside) in [(0.5, true), (0.6, false)] {
            assert_eq!(cell.face_inside(1, false, c, 0.5, 1.0), inside, "y, {c}");
        }
    }

    #[test]
    fn the_slope_is_the_cubics() {
        let mut rng = Rng::stream(1, Stage::Test, 2);
        for _ in 0..1000 {
            let cell = random_cell(&mut rng);
            let p = DVec3::new(rng.unit(), rng.unit(), rng.unit());
            let d = DVec3::new(rng.unit() - 0.5, rng.unit() - 0.5, rng.unit() - 0.5);
            assert!((cell.slope(p, d) - cell.cubic(0.4, p, d).c[1]).abs() < 1e-14);
        }
    }

    #[test]
    fn inside_includes_equality() {
        let mut cell = Cell { s: [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0] };
        assert_eq!([0.0, 0.5, 1.0, 1.5].map(|c| cell.inside(c)), [0xff, 0xf0, 0xf0, 0]);
        cell.s[3] = 2.0;
        cell.s[4] = f32::NAN;
        assert_eq!(cell.inside(0.5), 0xe8);
    }
}
