//! Which children of a node a ray meets: the one question that is worth SIMD.

use super::Tile;

/// A ray as the walk sees it: in cells from a start in or on Ω, with direction components of at most 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    /// Start.
    pub(super) o: [f32; 3],
    /// 1 / direction; huge, but finite, along an axis whose planes the ray never crosses.
    pub(super) inv: [f32; 3],
    /// Axes along which the direction is negative, all bits of their two in a child's number: children are visited
    /// in ascending order of number ^ `flip`.
    pub(super) flip: u32,
    /// Where the ray ends.
    pub(super) end: f32,
    /// Ranges that hold the isovalue begin at this or below …
    pub(super) most_lo: u16,
    /// … and end at this or above.
    pub(super) least_hi: u16,
}

impl Line {
    /// Where the ray crosses a lattice plane. *The* expression: monotone in `plane`, and the same bits whichever block
    /// or cell asks, in every kernel.
    #[inline(always)]
    pub(super) fn time(&self, axis: usize, plane: f32) -> f32 {
        (plane - self.o[axis]) * self.inv[axis]
    }

    #[inline(always)]
    pub(super) fn negative(&self, axis: usize) -> bool {
        self.flip >> (2 * axis) & 1 == 1
    }
}

/// One way to compute it.
pub(super) trait Children: Copy {
    /// What depends on the ray only.
    type Ray;

    fn ray(self, line: &Line) -> Self::Ray;

    /// The children of the node of `tile`, whose first cell is `base` and whose children are `size` cells wide, that
    /// may hold the isovalue and whose closed box the ray meets at a time above 0, up to its end. Bit n stands for
    /// child n ^ flip, so that they are in the ray's order.
    fn children(self, line: &Line, ray: &Self::Ray, tile: &Tile, base: [i32; 4], size: f32) -> u64;

    /// Asks memory for what is read soon.
    #[inline(always)]
    fn prefetch<T>(self, _: &T) {}
}

/// Plain Rust, for every machine.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scalar;

impl Children for Scalar {
    type Ray = ();

    #[inline(always)]
    fn ray(self, _: &Line) {}

    #[inline]
    fn children(self, line: &Line, (): &(), tile: &Tile, base: [i32; 4], size: f32) -> u64 {
        let times: [[f32; 5]; 3] = std::array::from_fn(|a| {
            std::array::from_fn(|k| {
                let k = if line.negative(a) { 4 - k } else { k };
                line.time(a, base[a] as f32 + k as f32 * size)
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
}
