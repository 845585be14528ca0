//! Planes of light, a number each per node that [`LitRows`] keeps: memory for them, and their kept form in half
//! precision; and h in another order.

use super::half::{decode, encode, scale};
use ::half::bf16;
use rayon::prelude::*;
use std::sync::Mutex;

/// Red, green and blue, a plane each, so that neighbouring lines load neighbouring numbers.
pub(super) type Planes = [Vec<f32>; 3];

/// The same of numbers that may be negative, to 2⁻⁹ of each: the bits of [`bf16`].
pub(super) type SignedPlanes = [Vec<u16>; 3];

/// Nodes that a thread takes at a time.
const CHUNK: usize = 1 << 14;

/// Planes to be used again: taking memory from the system and giving it back costs more than a pass over it, and memory
/// that is read before it is written twice as much, with all threads waiting.
#[derive(Default)]
pub(super) struct PlanePool {
    planes: Mutex<Vec<Vec<f32>>>,
}

impl PlanePool {
    /// Black planes of `n` nodes.
    pub(super) fn black(&self, n: usize) -> Planes {
        std::array::from_fn(|_| self.plane(n))
    }

    /// A black plane of `n` nodes.
    pub(super) fn plane(&self, n: usize) -> Vec<f32> {
        match self.planes.lock().expect("no thread panics").pop() {
            Some(mut plane) if plane.len() == n => {
                plane.par_chunks_mut(CHUNK).for_each(|chunk| chunk.fill(0.0));
                plane
            }
            _ => (0..n).into_par_iter().with_min_len(CHUNK).map(|_| 0.0).collect(),
        }
    }

    /// The same memory as other numbers, all 0.
    pub(super) fn numbers(&self, n: usize) -> Vec<u32> {
        bytemuck::allocation::cast_vec(self.plane(n))
    }

    /// Takes planes that are no longer needed.
    pub(super) fn keep(&self, planes: impl IntoIterator<Item = Vec<f32>>) {
        self.planes.lock().expect("no thread panics").extend(planes);
    }

    /// Takes back what [`Self::numbers`] gave.
    pub(super) fn keep_numbers(&self, numbers: Vec<u32>) {
        self.keep([bytemuck::allocation::cast_vec(numbers)]);
    }

    /// Gives all back to the system.
    pub(super) fn clear(&self) {
        self.planes.lock().expect("no thread panics").clear();
    }
}

/// Light that is kept: to 2⁻¹² of each number, or 2⁻²⁹ of the greatest one where that is more.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct HalfPlanes {
    /// Red, green and blue, times `unit`.
    pub planes: [Vec<u16>; 3],
    /// A power of two.
    pub unit: f32,
}

impl HalfPlanes {
    /// `factor` times `light`, and what was in `old`, of the same form.
    pub(super) fn new(light: &Planes, factor: f32, old: Option<Self>) -> Self {
        let most = factor * light.iter().map(|p| greatest(p)).fold(0.0, f32::max);
        let greatest_of = |old: &Self| (0..3).map(|c| old.greatest(c)).fold(0.0, f32::max);
        let before = old.as_ref().map_or([0.0, 1.0], |old| [greatest_of(old), old.unit]);
        let unit = scale(most + before[0]);
        let (add, keep) = (unit * factor, unit / before[1]);
        let mut planes = old.map_or_else(|| std::array::from_fn(|c| vec![0; light[c].len()]), |old| old.planes);
        for (half, light) in planes.iter_mut().zip(light) {
            half.par_chunks_mut(CHUNK).zip(light.par_chunks(CHUNK)).for_each(|(half, light)| {
                // Memory that stays black is never touched.
                if light.iter().any(|x| *x != 0.0) || half.iter().any(|h| *h != 0) {
                    half.iter_mut().zip(light).for_each(|(h, x)| *h = encode(add * x + keep * decode(*h)));
                }
            });
        }
        Self { planes, unit }
    }

    /// The light at a place in one channel.
    #[inline(always)]
    pub(super) fn at(&self, c: usize, place: usize) -> f32 {
        decode(self.planes[c][place]) / self.unit
    }

    /// The light at a place.
    #[inline(always)]
    pub(super) fn all(&self, place: usize) -> [f32; 3] {
        std::array::from_fn(|c| self.at(c, place))
    }

    /// `light` less this, in its memory.
    pub(super) fn short_of(self, light: &Planes) -> SignedPlanes {
        let mut planes = self.planes;
        for (half, light) in planes.iter_mut().zip(light) {
            half.par_chunks_mut(CHUNK).zip(light.par_chunks(CHUNK)).for_each(|(half, light)| {
                if light.iter().any(|x| *x != 0.0) || half.iter().any(|h| *h != 0) {
                    let short = |h: u16, x: f32| bf16::from_f32(x - decode(h) / self.unit).to_bits();
                    half.iter_mut().zip(light).for_each(|(h, x)| *h = short(*h, *x));
                }
            });
        }
        planes
    }

    /// The greatest number of a channel.
    fn greatest(&self, c: usize) -> f32 {
        let most = self.planes[c].par_chunks(CHUNK).map(|x| x.iter().fold(0, |m, x| m.max(*x))).max();
        decode(most.unwrap_or(0)) / self.unit
    }
}

/// A number of [`SignedPlanes`].
#[inline(always)]
fn signed(x: u16) -> f32 {
    f32::from_bits(u32::from(x) << 16)
}

/// Light of every node of the sides, as it is gathered or as it is kept.
#[derive(Clone, Copy)]
pub(super) enum NodeLight<'a> {
    Full(&'a [Planes]),
    Half(&'a [HalfPlanes]),
    Signed(&'a [SignedPlanes]),
}

impl NodeLight<'_> {
    /// How many sides.
    pub(super) fn sides(self) -> usize {
        match self {
            Self::Full(sides) => sides.len(),
            Self::Half(sides) => sides.len(),
            Self::Signed(sides) => sides.len(),
        }
    }

    /// The greatest number of a side in one channel.
    pub(super) fn greatest(self, side: usize, c: usize) -> f32 {
        match self {
            Self::Full(sides) => greatest(&sides[side][c]),
            Self::Half(sides) => sides[side].greatest(c),
            Self::Signed(sides) => {
                let most = |x: &[u16]| x.iter().fold(0.0, |m, x| signed(*x).max(m));
                sides[side][c].par_chunks(CHUNK).map(most).reduce(|| 0.0, f32::max)
            }
        }
    }

    /// Adds `factor` times the light from place `first` of planes on to `to`.
    #[inline(always)]
    pub(super) fn add(self, (side, c): (usize, usize), factor: f32, first: usize, to: &mut [f32]) {
        match self {
            Self::Full(sides) => {
                let from = &sides[side][c][first..][..to.len()];
                to.iter_mut().zip(from).for_each(|(t, x)| *t += factor * x);
            }
            Self::Half(sides) => {
                let from = &sides[side].planes[c][first..][..to.len()];
                let factor = factor / sides[side].unit;
                to.iter_mut().zip(from).for_each(|(t, x)| *t += factor * decode(*x));
            }
            Self::Signed(sides) => {
                let from = &sides[side][c][first..][..to.len()];
                to.iter_mut().zip(from).for_each(|(t, x)| *t += factor * signed(*x));
            }
        }
    }
}

/// The greatest of numbers that are not negative.
fn greatest(plane: &[f32]) -> f32 {
    // Their bits compare as they do, and integers in vectors.
    let most = |x: &[f32]| x.iter().fold(0, |m, x| x.to_bits().max(m));
    f32::from_bits(plane.par_chunks(1 << 14).map(most).max().unwrap_or(0))
}

/// Columns of x are moved this many at a time: a cache line of f32.
const STRIP: usize = 16;

/// x, y, z order to y, z, x.
pub(super) fn transposed(from: &[f32], dims: [usize; 3]) -> Vec<f32> {
    let [nx, ny, nz] = dims;
    let mut to = vec![0.0; from.len()];
    to.par_chunks_mut(STRIP * ny * nz).enumerate().for_each(|(strip, out)| {
        let x0 = strip * STRIP;
        let width = STRIP.min(nx - x0);
        for (row, line) in from.chunks_exact(nx).enumerate() {
            // Row (y, z) in memory order has number z·ny + y in both orders.
            for (x, &value) in line[x0..x0 + width].iter().enumerate() {
                out[x * ny * nz + row] = value;
            }
        }
    });
    to
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    fn random(n: usize, greatest: f64, seed: u64) -> Planes {
        let mut rng = Rng::stream(seed, Stage::Test, 0);
        let mut number = || if rng.unit() < 0.2 { 0.0 } else { (greatest * rng.unit()) as f32 };
        std::array::from_fn(|_| (0..n).map(|_| number()).collect())
    }

    /// Sums of light that grows and shrinks by orders of magnitude, against the same in full precision.
    #[test]
    fn what_is_kept_sums_up() {
        let n = 3 * CHUNK + 17;
        let (mut kept, mut sum) = (None, vec![[0f64; 3]; n]);
        let mut most = 0f64;
        for (seed, greatest) in [1.0, 1e-3, 40.0, 3.0].into_iter().enumerate() {
            let new = random(n, greatest, seed as u64);
            for (i, sum) in sum.iter_mut().enumerate() {
                (0..3).for_each(|c| sum[c] += 0.5 * f64::from(new[c][i]));
            }
            kept = Some(HalfPlanes::new(&new, 0.5, kept));
            most += greatest;
        }
        let kept = kept.unwrap();
        let mut back = vec![1.0; n];
        NodeLight::Half(std::slice::from_ref(&kept)).add((0, 1), 2.0, 0, &mut back);
        for (i, sum) in sum.iter().enumerate() {
            for c in 0..3 {
                let error = (f64::from(kept.at(c, i)) - sum[c]).abs();
                // One rounding each.
                assert!(error <= 4.0 * (sum[c] * 0.5f64.powi(12)).max(most * 0.5f64.powi(29)), "{sum:?}");
            }
            assert!((f64::from(back[i]) - 1.0 - 2.0 * sum[1]).abs() < 1e-2 * (1.0 + sum[1]));
        }
    }

    /// What is short of a light makes it up.
    #[test]
    fn what_is_short_adds_up() {
        let n = CHUNK + 5;
        let (few, all) = (random(n, 2.0, 1), random(n, 3.0, 2));
        let kept = HalfPlanes::new(&few, 1.0, None);
        let short = [kept.clone().short_of(&all)];
        let mut sum = vec![0.0; n];
        NodeLight::Half(&[kept]).add((0, 2), 1.0, 0, &mut sum);
        NodeLight::Signed(&short).add((0, 2), 1.0, 0, &mut sum);
        let mut most = 0f32;
        for ((sum, all), few) in sum.iter().zip(&all[2]).zip(&few[2]) {
            let rounding = (all - few).abs() / 256.0 + few / 2048.0;
            assert!((sum - all).abs() <= rounding, "{sum} {all}");
            most = most.max(all - few);
        }
        let said = NodeLight::Signed(&short).greatest(0, 2);
        assert!((said / most - 1.0).abs() < 0.01 && most > 2.9, "{said} {most}");
    }

    #[test]
    fn memory_is_black_again() {
        let pool = PlanePool::default();
        let mut numbers = pool.numbers(70);
        numbers.fill(7);
        pool.keep_numbers(numbers);
        assert_eq!(pool.plane(70), vec![0.0; 70]);
        // Of another size it is of no use.
        pool.keep([vec![3.0; 70]]);
        assert_eq!(pool.plane(5), vec![0.0; 5]);
    }
}
