//! What is worth SIMD: which children of a node a ray meets, and h along the piece of a ray in a cell.

use super::Tile;
use glam::Vec4;

/// A ray as the walk sees it: in cells from a start in or on Ω, with direction components of at most 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    /// Start, and direction.
    pub(super) start: Vec4,
    pub(super) d: Vec4,
    /// Where planes are crossed from: the start, but the middle of its cell along an axis whose planes the ray never
    /// crosses.
    pub(super) o: Vec4,
    /// 1 / direction; huge, but finite, along such an axis.
    pub(super) inv: Vec4,
    /// The end of a cell, 0 or 1, by which the ray leaves it.
    pub(super) far: Vec4,
    /// Axes along which the direction is negative, all bits of their two in a child's number: children are visited
    /// in ascending order of number ^ `flip`.
    pub(super) flip: u32,
    /// Where the ray ends.
    pub(super) end: f32,
    /// Ranges that hold the isovalue begin at this or below …
    pub(super) most_lo: u8,
    /// … and end at this or above.
    pub(super) least_hi: u8,
}

impl Line {
    /// Where the ray crosses a lattice plane. *The* expression: monotone in `plane`, and the same bits whichever block
    /// or cell asks, in every kernel.
    #[inline(always)]
    pub(super) fn time(&self, axis: usize, plane: f32) -> f32 {
        (plane - self.o[axis]) * self.inv[axis]
    }

    /// [`Line::time`] of a plane of each axis.
    #[inline(always)]
    pub(super) fn times(&self, planes: Vec4) -> Vec4 {
        (planes - self.o) * self.inv
    }

    #[inline(always)]
    pub(super) fn negative(&self, axis: usize) -> bool {
        self.flip >> (2 * axis) & 1 == 1
    }
}

/// The piece of a ray in a cell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece<'a> {
    /// The ray, in f64.
    pub(super) o: &'a [f64; 4],
    pub(super) d: &'a [f64; 4],
    /// [`Line::far`].
    pub(super) far: Vec4,
    /// The cell's first corner.
    pub(super) cell: Vec4,
    /// Where the piece begins and ends.
    pub(super) t: [f64; 2],
    /// The axis, as a bit, of the face on which it begins and ends: there the coordinate is exact.
    pub(super) on: [u8; 2],
}

/// One way to compute it. All ways give the same bits.
pub(super) trait Kernel: Copy {
    /// What of a ray [`Kernel::children`] asks for again and again.
    type Constants;
    /// The 8 samples of a cell, as in [`crate::cell::Cell`].
    type Corners: Copy;

    fn constants(self, line: &Line) -> Self::Constants;

    /// The children of the node of `tile`, whose first cell is `base` and whose children are `size` cells wide, that
    /// may hold the isovalue and whose closed box the ray meets at a time above 0, up to its end. Bit n stands for
    /// child n ^ flip, so that they are in the ray's order.
    fn children(self, line: &Line, ray: &Self::Constants, tile: &Tile, base: Vec4, size: f32) -> u64;

    /// The samples at `at`, one step along x, y or z further, and so on.
    fn corners(self, samples: &[f32], at: usize, steps: [usize; 2]) -> Self::Corners;

    /// [`crate::cell::Cell::inside`].
    fn inside(self, corners: &Self::Corners, c: f32) -> u8;

    /// Whether h − c is surely of one sign at the corners of the box from `begin` to `end`, local coordinates whose
    /// error, times six, is below `slack`. A quick look: false says nothing.
    #[inline(always)]
    fn clear(self, _corners: &Self::Corners, _c: f32, _begin: Vec4, _end: Vec4, _slack: f32) -> bool {
        false
    }

    /// h at the corners of the box that the piece spans: bit a of the position says whose coordinate along axis a
    /// counts, that of its begin or of its end. So the first is h at its begin and the last h at its end, and h along
    /// it is a cubic whose Bernstein coefficients are the first, the means of 1, 2, 4 and of 3, 5, 6, and the last. Of
    /// a face it uses the face's own corners only, and the bits are the same from both sides.
    fn span(self, corners: &Self::Corners, piece: &Piece) -> [f64; 8];

    /// Which of `values` are at least `c`, bit by bit.
    fn at_least(self, values: &[f64; 8], c: f64) -> u8;

    /// Asks memory for what may be read soon, if there is anything at this address.
    #[inline(always)]
    fn ask(self, _: *const u8) {}

    /// Asks memory for all of what is read soon.
    #[inline(always)]
    fn prefetch<T>(self, x: &T) {
        for line in 0..size_of::<T>().div_ceil(64) {
            self.ask(std::ptr::from_ref(x).cast::<u8>().wrapping_add(64 * line));
        }
    }

    /// Calls `f` as a function of its own, compiled for the same processor.
    fn outlined<T>(self, f: impl FnOnce() -> T) -> T;
}

/// Plain Rust, for every machine.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scalar;

impl Kernel for Scalar {
    type Constants = ();
    type Corners = [f32; 8];

    #[inline(always)]
    fn constants(self, _: &Line) {}

    #[inline(never)]
    fn outlined<T>(self, f: impl FnOnce() -> T) -> T {
        f()
    }

    #[inline]
    fn children(self, line: &Line, (): &(), tile: &Tile, base: Vec4, size: f32) -> u64 {
        let times: [[f32; 5]; 3] = std::array::from_fn(|a| {
            std::array::from_fn(|k| {
                let k = if line.negative(a) { 4 - k } else { k };
                line.time(a, base[a] + k as f32 * size)
            })
        });
        let meets = |a: usize, k: usize, t: (f32, f32)| (t.0.max(times[a][k]), t.1.min(times[a][k + 1]));
        let mut found = 0;
        let all = (f32::from_bits(1), line.end);
        for z in 0..4 {
            let in_z = meets(2, z, all);
            for y in 0..if in_z.0 <= in_z.1 { 4 } else { 0 } {
                let in_y = meets(1, y, in_z);
                for x in 0..if in_y.0 <= in_y.1 { 4 } else { 0 } {
                    let in_x = meets(0, x, in_y);
                    let n = x + 4 * y + 16 * z;
                    let child = n ^ line.flip as usize;
                    let holds = tile.lo[child] <= line.most_lo && tile.hi[child] >= line.least_hi;
                    found |= u64::from(in_x.0 <= in_x.1 && holds) << n;
                }
            }
        }
        found
    }

    #[inline(always)]
    fn corners(self, samples: &[f32], at: usize, [y, z]: [usize; 2]) -> [f32; 8] {
        // One bound for all: the last corner's.
        let s = &samples[at..at + z + y + 2];
        [s[0], s[1], s[y], s[y + 1], s[z], s[z + 1], s[z + y], s[z + y + 1]]
    }

    #[inline(always)]
    fn inside(self, corners: &[f32; 8], c: f32) -> u8 {
        crate::cell::Cell { s: *corners }.inside(c)
    }

    #[inline(always)]
    #[allow(clippy::manual_clamp, reason = "NaN becomes 0, as it does with SIMD")]
    fn span(self, corners: &[f32; 8], piece: &Piece) -> [f64; 8] {
        // Local coordinates of begin and end.
        let [begin, end] = [0, 1].map(|e| {
            [0, 1, 2].map(|a| {
                let far = f64::from(piece.far[a]);
                if piece.on[e] >> a & 1 == 1 {
                    if e == 1 { far } else { 1.0 - far }
                } else {
                    ((piece.o[a] + piece.t[e] * piece.d[a]) - f64::from(piece.cell[a])).max(0.0).min(1.0)
                }
            })
        });
        // Axis by axis the corners of the cell give way to those of the box.
        let mut s = corners.map(f64::from);
        for (a, (begin, end)) in begin.into_iter().zip(end).enumerate() {
            s = std::array::from_fn(|n| {
                let (near, u) = (n & !(1 << a), if n >> a & 1 == 1 { end } else { begin });
                (1.0 - u) * s[near] + u * s[near | 1 << a]
            });
        }
        s
    }

    #[inline(always)]
    fn at_least(self, values: &[f64; 8], c: f64) -> u8 {
        values.iter().enumerate().fold(0, |bits, (n, &v)| bits | u8::from(v >= c) << n)
    }
}
