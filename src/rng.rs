//! Random numbers by index: every number is a function of (seed, stage, index, position in the stream), so a result
//! never depends on how many threads made it. Independent streams for photons; Owen-scrambled Sobol points for
//! everything that is averaged.

use glam::DVec3;

/// What a stream is used for: streams of different stages never share numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Stage {
    /// Photon emission and scattering; the index is the photon.
    Photon = 1,
    /// Positions of radiance samples; the index is the sample.
    Sample = 2,
    /// Points on luminaires; the index is the receiver.
    Direct = 3,
    /// Final gather directions; the index is the receiver.
    Gather = 4,
    /// Pictures; the index is the pixel.
    Picture = 5,
    /// Quadrature of a photon kernel's footprint.
    Footprint = 6,
    /// Direct light of the radiance cache; the index is the node or texel.
    Cache = 7,
    /// Paths of the reference; the index is the vertex.
    Path = 8,
    /// Directions and offsets of sweeps.
    Sweep = 9,
    /// Simulations behind generated volumes.
    Simulation = 10,
    /// Tests and self-tests.
    Test = 11,
    /// Errors that are sent through a fit to see what becomes of them.
    Noise = 12,
}

impl Stage {
    /// The key of index `index` under `seed`.
    #[inline]
    pub const fn key(self, seed: u64, index: u64) -> Key {
        Key { seed, stage: self, index }
    }
}

/// What random numbers belong to: equal keys give equal numbers, all others independent ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key {
    /// Chosen by the user.
    pub seed: u64,
    /// What the numbers are for.
    pub stage: Stage,
    /// Which photon, receiver, pixel … they are for.
    pub index: u64,
}

impl Key {
    /// The stream of independent numbers of this key.
    #[inline]
    pub fn stream(self) -> Rng {
        Rng { state: self.hash() }
    }

    /// The stream of ray or path `n` < 2²⁰ of this key; indices below 2⁴⁴ keep theirs apart.
    #[inline]
    pub fn nth(self, n: u32) -> Rng {
        Self { index: self.index << 20 ^ u64::from(n), ..self }.stream()
    }

    /// The point set of this key.
    #[inline]
    pub fn set(self) -> Sobol {
        let k = self.hash();
        #[allow(clippy::cast_possible_truncation, reason = "folds 64 bits to 32")]
        Sobol { seed: (k ^ (k >> 32)) as u32 }
    }

    #[inline]
    fn hash(self) -> u64 {
        let seed = mix(self.seed.wrapping_add(GOLDEN));
        mix(mix(seed ^ (self.stage as u64).wrapping_mul(GOLDEN)).wrapping_add(self.index))
    }
}

/// The finaliser of SplitMix64: a bijection in which every input bit moves every output bit. \[Steele14\]
#[inline]
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// `key` with the bits of a point folded in, for streams that belong to places or directions.
#[inline]
pub fn folded(key: u64, x: DVec3) -> u64 {
    x.to_array().iter().fold(key, |k, x| (k ^ x.to_bits()).wrapping_mul(GOLDEN))
}

/// A stream of independent numbers, SplitMix64 keyed by (seed, stage, index). \[Steele14\]
#[derive(Clone, Debug)]
pub struct Rng {
    state: u64,
}

impl Rng {
    /// The stream of one index of one stage. Equal arguments give equal streams.
    #[inline]
    pub fn stream(seed: u64, stage: Stage, index: u64) -> Self {
        stage.key(seed, index).stream()
    }

    /// 64 random bits.
    #[inline]
    pub fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(GOLDEN);
        mix(self.state)
    }

    /// Uniform in [0, 1), 53 bits.
    #[inline]
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Two independent uniforms in [0, 1).
    #[inline]
    pub fn unit2(&mut self) -> [f64; 2] {
        [self.unit(), self.unit()]
    }

    /// A standard normal number (Box–Muller). \[BM58\]
    pub fn normal(&mut self) -> f64 {
        let [u, v] = self.unit2();
        (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }
}

/// Dimensions of [`Sobol`].
pub const SOBOL_DIMENSIONS: usize = 7;

/// Direction numbers as byte tables: point = XOR of four table entries. Dimension 0 is van der Corput's, the others
/// come from the primitive polynomials and initial numbers of \[JoeKuo08\].
static DIRECTIONS: [[[u32; 256]; 4]; SOBOL_DIMENSIONS] = direction_tables();

const fn direction_tables() -> [[[u32; 256]; 4]; SOBOL_DIMENSIONS] {
    // (degree s, coefficients a, initial m_1 … m_s)
    let polynomials: [(u32, u32, [u32; 4]); SOBOL_DIMENSIONS] = [
        (0, 0, [0, 0, 0, 0]),
        (1, 0, [1, 0, 0, 0]),
        (2, 1, [1, 3, 0, 0]),
        (3, 1, [1, 3, 1, 0]),
        (3, 2, [1, 1, 1, 0]),
        (4, 1, [1, 1, 3, 3]),
        (4, 4, [1, 3, 5, 13]),
    ];
    let mut tables = [[[0u32; 256]; 4]; SOBOL_DIMENSIONS];
    let mut d = 0;
    while d < SOBOL_DIMENSIONS {
        let (s, a, m) = polynomials[d];
        let mut v = [0u32; 32];
        let mut i = 0;
        while i < 32 {
            if s == 0 {
                v[i] = 1 << (31 - i);
            } else if (i as u32) < s {
                v[i] = m[i] << (31 - i);
            } else {
                let s = s as usize;
                v[i] = v[i - s] ^ (v[i - s] >> s);
                let mut k = 1;
                while k < s {
                    if (a >> (s - 1 - k)) & 1 == 1 {
                        v[i] ^= v[i - k];
                    }
                    k += 1;
                }
            }
            i += 1;
        }
        let mut byte = 0;
        while byte < 4 {
            let mut n = 0;
            while n < 256 {
                let mut bit = 0;
                while bit < 8 {
                    if (n >> bit) & 1 == 1 {
                        tables[d][byte][n] ^= v[8 * byte + bit];
                    }
                    bit += 1;
                }
                n += 1;
            }
            byte += 1;
        }
        d += 1;
    }
    tables
}

/// The first 2³² points of the Sobol sequence, Owen-scrambled by hashing \[Burley20\], with the index shuffled the same
/// way, so that two sets with different seeds are independent and every power-of-two prefix is stratified.
#[derive(Clone, Copy, Debug)]
pub struct Sobol {
    seed: u32,
}

impl Sobol {
    /// The point set of one receiver: (seed, stage, index) as for [`Rng::stream`].
    #[inline]
    pub fn set(seed: u64, stage: Stage, index: u64) -> Self {
        stage.key(seed, index).set()
    }

    /// Coordinates `dimension` and `dimension + 1` of point `index`, uniform in [0, 1).
    #[inline]
    pub fn point2(&self, index: u32, dimension: usize) -> [f64; 2] {
        [self.coordinate(index, dimension), self.coordinate(index, dimension + 1)]
    }

    /// One coordinate of point `index`, uniform in [0, 1); `dimension` < [`SOBOL_DIMENSIONS`].
    #[inline]
    pub fn coordinate(&self, index: u32, dimension: usize) -> f64 {
        let n = scramble(index, self.seed);
        let t = &DIRECTIONS[dimension];
        let x = t[0][(n & 255) as usize]
            ^ t[1][(n >> 8 & 255) as usize]
            ^ t[2][(n >> 16 & 255) as usize]
            ^ t[3][(n >> 24) as usize];
        #[allow(clippy::cast_possible_truncation, reason = "folds 64 bits to 32")]
        let seed = mix((u64::from(self.seed) << 8) | (dimension as u64 + 1)) as u32;
        // 2⁻³³ centres the point in its cell, so that 0 and 1 are never drawn.
        f64::from(scramble(x, seed)) * (1.0 / 4_294_967_296.0) + 0.5 / 4_294_967_296.0
    }
}

/// Nested uniform (Owen) scrambling: bit k is flipped by a hash of the bits above it. The Laine–Karras hash with
/// Vegdahl's constants. \[Burley20\]
#[inline]
fn scramble(x: u32, seed: u32) -> u32 {
    let mut x = x.reverse_bits();
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^= x.wrapping_mul(0x53a2_2864);
    x.reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn every_power_of_two_prefix_is_stratified_in_every_dimension() {
        for set in 0..8 {
            let sobol = Sobol::set(set, Stage::Test, 17);
            for d in 0..SOBOL_DIMENSIONS {
                for m in [1u32, 4, 64, 4096] {
                    let strata: HashSet<u32> = (0..m).map(|i| (sobol.coordinate(i, d) * f64::from(m)) as u32).collect();
                    assert_eq!(strata.len(), m as usize, "dimension {d}, {m} points");
                }
            }
        }
    }

    #[test]
    fn the_first_two_dimensions_form_a_zero_two_net() {
        let sobol = Sobol::set(3, Stage::Test, 5);
        for (a, b) in [(1u32, 256u32), (2, 128), (16, 16), (64, 4)] {
            let strata: HashSet<(u32, u32)> = (0..256)
                .map(|i| {
                    let [x, y] = sobol.point2(i, 0);
                    ((x * f64::from(a)) as u32, (y * f64::from(b)) as u32)
                })
                .collect();
            assert_eq!(strata.len(), 256, "{a}×{b}");
        }
    }

    #[test]
    fn a_million_points_are_distinct() {
        // The crate that repeats after 65 536 points is why this is ours.
        let sobol = Sobol::set(1, Stage::Test, 1);
        let distinct: HashSet<u64> = (0..1_000_000).map(|i| sobol.coordinate(i, 3).to_bits()).collect();
        assert_eq!(distinct.len(), 1_000_000);
    }

    #[test]
    fn streams_are_reproducible_and_uncorrelated() {
        let draw = |seed, stage, index| Rng::stream(seed, stage, index).unit();
        assert_eq!(draw(1, Stage::Photon, 9).to_bits(), draw(1, Stage::Photon, 9).to_bits());
        // Neighbouring indices, stages and seeds: mean product of centred pairs within 5σ of 0 (σ = 1/12/√n).
        let n = 100_000u32;
        type Pair = fn(u64) -> (f64, f64);
        let pairs: [(&str, Pair); 3] = [
            ("index", |i| (Rng::stream(1, Stage::Photon, i).unit(), Rng::stream(1, Stage::Photon, i + 1).unit())),
            ("stage", |i| (Rng::stream(1, Stage::Photon, i).unit(), Rng::stream(1, Stage::Sample, i).unit())),
            ("seed", |i| (Rng::stream(1, Stage::Photon, i).unit(), Rng::stream(2, Stage::Photon, i).unit())),
        ];
        for (what, pair) in pairs {
            let sum: f64 = (0..u64::from(n))
                .map(|i| {
                    let (a, b) = pair(i);
                    (a - 0.5) * (b - 0.5)
                })
                .sum();
            let z = sum / (f64::from(n).sqrt() / 12.0);
            assert!(z.abs() < 5.0, "{what}: z = {z}");
        }
    }
}
