//! Nuclear pasta: semi-classical molecular dynamics of nucleons at the density of a neutron star's inner crust.
//! \[Horowitz04\] Lengths in fm, energies in MeV, times in fm/c.

use super::molecular_dynamics::{MolecularDynamics, PairTerm, Schedule, spread_evenly};
use super::neighbours::SimulationBox;
use super::pair_potential::PairPotential;
use crate::error::{Error, Result};
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use glam::DVec3;

/// Strength of the short-range repulsion, MeV. \[Horowitz04\]
const A: f64 = 110.0;
/// Strength of the attraction, MeV. \[Horowitz04\]
const B: f64 = -26.0;
/// Its dependence on isospin, MeV: + between like nucleons, − between unlike. \[Horowitz04\]
const C: f64 = 24.0;
/// Square of the nuclear range, fm². \[Horowitz04\]
const LAMBDA: f64 = 1.25;
/// e², MeV fm.
const COULOMB: f64 = 1.44;
/// Screening length of the electron gas, fm. \[Horowitz04\]
const SCREENING: f64 = 10.0;
/// Mass of a nucleon, MeV/c².
const MASS: f64 = 939.0;

/// Cut-off of the nuclear force, fm: beyond it, it is below 10⁻³ MeV.
const NUCLEAR_CUTOFF: f64 = 5.5;
/// Cut-off of the screened Coulomb force, fm.
const COULOMB_CUTOFF: f64 = 20.0;
/// Skins of the neighbour lists, fm.
const SKINS: [f64; 2] = [1.5, 4.0];

/// The species number of protons.
pub const PROTON: u8 = 1;
/// The species number of neutrons.
pub const NEUTRON: u8 = 0;

/// Two nucleons closer than this, fm, belong to the same cluster.
pub const LINK: f64 = 2.5;

/// V = a e^(−r²/Λ) + (b ± c) e^(−r²/2Λ) and dV/dr, MeV and MeV/fm, r in fm. \[Horowitz04\]
pub fn nuclear(like: bool, r: f64) -> [f64; 2] {
    let wide = (-r * r / (2.0 * LAMBDA)).exp();
    let (core, tail) = (A * wide * wide, if like { B + C } else { B - C } * wide);
    [core + tail, -r / LAMBDA * (2.0 * core + tail)]
}

/// V = e²/r e^(−r/λ) between protons and dV/dr, MeV and MeV/fm, r in fm. \[Horowitz04\]
pub fn coulomb(r: f64) -> [f64; 2] {
    let v = COULOMB / r * (-r / SCREENING).exp();
    [v, -v * (1.0 / r + 1.0 / SCREENING)]
}

/// What to simulate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pasta {
    /// Protons and neutrons.
    pub nucleons: usize,
    /// Nucleons per fm³; nuclear matter has 0.16.
    pub density: f64,
    /// Share of protons, 0 to 1.
    pub proton_fraction: f64,
    /// Temperature to which the matter is cooled, MeV.
    pub temperature: f64,
    /// Steps of [`Pasta::DT`].
    pub steps: usize,
    /// Seed of positions, velocities and species.
    pub seed: u64,
}

impl Default for Pasta {
    fn default() -> Self {
        Self { nucleons: 6000, density: 0.04, proton_fraction: 0.3, temperature: 1.0, steps: 5000, seed: 1 }
    }
}

impl Pasta {
    /// Time of a step, fm/c.
    pub const DT: f64 = 2.0;
    /// Temperature from which the matter is cooled, MeV: it is a gas there.
    const HOT: f64 = 4.0;

    /// Checks the numbers.
    ///
    /// # Errors
    /// `Invalid` with the flag that is wrong.
    pub fn check(&self) -> Result<()> {
        let fail = |what: String| Err(Error::Invalid(what));
        if !(self.density > 0.0 && self.density <= 0.2) {
            return fail(format!("--density {}: from above 0 to 0.2 nucleons per fm³", self.density));
        }
        if !(0.0..=1.0).contains(&self.proton_fraction) {
            return fail(format!("--proton-fraction {}: 0 to 1", self.proton_fraction));
        }
        if !(self.temperature > 0.0 && self.temperature <= 100.0) {
            return fail(format!("--temperature {}: from above 0 to 100 MeV", self.temperature));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small count")]
        let least = ((2.0 * (NUCLEAR_CUTOFF + SKINS[0])).powi(3) * self.density).ceil() as usize + 1;
        if !(least..=1_000_000).contains(&self.nucleons) {
            return fail(format!(
                "--particles {}: {least} to 1000000 at this density, or the nuclear force would reach around the box",
                self.nucleons
            ));
        }
        Ok(())
    }

    /// The hot gas before cooling.
    pub fn gas(&self) -> MolecularDynamics {
        let edge = (self.nucleons as f64 / self.density).cbrt();
        let bounds = SimulationBox { size: DVec3::splat(edge), periodic: [true; 3] };
        let positions = spread_evenly(bounds.size, self.nucleons, self.seed);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share of a count")]
        let protons = (self.proton_fraction * self.nucleons as f64).round() as usize;
        let lot = |i: &usize| Rng::stream(self.seed, Stage::Simulation, (2 << 32) + *i as u64).bits();
        let mut order: Vec<usize> = (0..self.nucleons).collect();
        order.sort_by_key(|i| (lot(i), *i));
        let mut species = vec![NEUTRON; self.nucleons];
        order[..protons].iter().for_each(|&i| species[i] = PROTON);
        let potentials = [true, false].map(|like| PairPotential::new(NUCLEAR_CUTOFF, move |r| nuclear(like, r)));
        let nuclear = PairTerm::new(Vec::from(potentials), [[Some(0), Some(1)], [Some(1), Some(0)]], SKINS[0]);
        let cutoff = COULOMB_CUTOFF.min(0.5 * edge - SKINS[1]);
        let coulomb = PairPotential::new(cutoff, coulomb);
        let coulomb = PairTerm::new(vec![coulomb], [[None, None], [None, Some(0)]], SKINS[1]);
        let terms = vec![nuclear, coulomb];
        MolecularDynamics::new(bounds, positions, species, MASS, terms, None, (Self::HOT, self.seed))
    }

    /// Cools the gas until clusters have formed: three quarters of the steps down to the temperature, the rest at it.
    ///
    /// # Errors
    /// As [`Pasta::check`]; `Interrupted`.
    pub fn simulate(&self, progress: Progress) -> Result<MolecularDynamics> {
        self.check()?;
        let mut md = self.gas();
        let hold = self.steps / 4;
        let (from, to, dt) = (Self::HOT.max(self.temperature), self.temperature, Self::DT);
        let cool = Schedule { from, to, steps: self.steps - hold, dt };
        md.run(&[cool, Schedule { from: to, to, steps: hold, dt }], progress)?;
        Ok(md)
    }
}
