//! A Lennard-Jones fluid quenched in a closed slit pore whose two wide walls it wets. \[AT17\] Reduced units: the
//! fluid's σ, ε and m are 1.

use super::molecular_dynamics::{MolecularDynamics, PairTerm, Schedule, spread_evenly};
use super::neighbours::SimulationBox;
use super::pair_potential::PairPotential;
use crate::error::{Error, Result};
use crate::progress::Progress;
use glam::DVec3;

/// Cut-off of the pair potential, σ. With shifted force the critical temperature is lower than the full potential's
/// 1.3.
const CUTOFF: f64 = 2.5;
/// Skin of the neighbour lists, σ.
const SKIN: f64 = 0.4;
/// Strength of the walls, ε: the well at 0.858 σ is 1.05 of it deep, enough for the liquid to spread over them.
const WALL: f64 = 3.0;

/// Least distance of the walls, σ.
const LEAST_EDGE: f64 = 6.0;

/// Two atoms closer than this, σ, belong to the same cluster. \[Stillinger63\]
pub const LINK: f64 = 1.5;

/// V = 4(r⁻¹² − r⁻⁶) and dV/dr. \[AT17 Code 1.2\]
pub fn lennard_jones(r: f64) -> [f64; 2] {
    let s = r.powi(-6);
    [4.0 * s * (s - 1.0), -24.0 * s * (2.0 * s - 1.0) / r]
}

/// V = ε_w (2/15 z⁻⁹ − z⁻³) at a distance z from a wall, and dV/dz: a half-space of Lennard-Jones atoms. \[Steele73\]
pub fn wall(z: f64) -> [f64; 2] {
    let s = z.powi(-3);
    [WALL * s * (2.0 / 15.0 * s * s - 1.0), WALL * s * (3.0 - 1.2 * s * s) / z]
}

/// The repelling part of [`wall`]: a wall that is not wetted.
pub fn rim(z: f64) -> [f64; 2] {
    let v = WALL * 2.0 / 15.0 * z.powi(-9);
    [v, -9.0 * v / z]
}

/// What to simulate: a cube whose faces x = 0 and x = edge are attracting walls. The other four repel, so that whatever
/// condenses is whole: nothing is cut at the faces of the volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fluid {
    /// Atoms.
    pub atoms: usize,
    /// Atoms per σ³ of the pore.
    pub density: f64,
    /// Temperature after the quench, ε.
    pub temperature: f64,
    /// Steps of [`Fluid::DT`].
    pub steps: usize,
    /// Seed of positions and velocities.
    pub seed: u64,
}

impl Default for Fluid {
    fn default() -> Self {
        Self { atoms: 7000, density: 0.1, temperature: 0.7, steps: 12_000, seed: 1 }
    }
}

impl Fluid {
    /// Time of a step, σ√(m/ε).
    pub const DT: f64 = 0.005;
    /// Temperature of the gas before the quench, ε.
    const HOT: f64 = 1.5;

    /// Checks the numbers.
    ///
    /// # Errors
    /// `Invalid` with the flag that is wrong.
    pub fn check(&self) -> Result<()> {
        let fail = |what: String| Err(Error::Invalid(what));
        if !(self.density > 0.0 && self.density <= 0.8) {
            return fail(format!("--density {}: from above 0 to 0.8 atoms per σ³", self.density));
        }
        if !(self.temperature > 0.0 && self.temperature <= 10.0) {
            return fail(format!("--temperature {}: from above 0 to 10 ε", self.temperature));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small count")]
        let least = (LEAST_EDGE.powi(3) * self.density).ceil() as usize + 1;
        if !(least..=1_000_000).contains(&self.atoms) {
            return fail(format!(
                "--particles {}: {least} to 1000000 at this density, or the walls would meet",
                self.atoms
            ));
        }
        Ok(())
    }

    /// The hot gas before the quench.
    pub fn gas(&self) -> MolecularDynamics {
        let edge = (self.atoms as f64 / self.density).cbrt();
        let bounds = SimulationBox { size: DVec3::splat(edge), periodic: [false; 3] };
        // None starts in a wall.
        let inner = bounds.size - 2.0;
        let positions = spread_evenly(inner, self.atoms, self.seed).into_iter().map(|x| x + 1.0).collect();
        let walls = move |x: DVec3| {
            let (mut energy, mut force) = (0.0, DVec3::ZERO);
            for a in 0..3 {
                let of = if a == 0 { wall } else { rim };
                let ([low, rise], [high, fall]) = (of(x[a]), of(edge - x[a]));
                energy += low + high;
                force[a] = fall - rise;
            }
            (energy, force)
        };
        let pairs =
            PairTerm::new(vec![PairPotential::new(CUTOFF, lennard_jones)], [[Some(0), None], [None, None]], SKIN);
        let species = vec![0; self.atoms];
        let start = (Self::HOT, self.seed);
        MolecularDynamics::new(bounds, positions, species, 1.0, vec![pairs], Some(Box::new(walls)), start)
    }

    /// Mixes the gas for an eighth of the steps, then holds it at the temperature: it condenses onto the walls and into
    /// droplets.
    ///
    /// # Errors
    /// As [`Fluid::check`]; `Interrupted`.
    pub fn simulate(&self, progress: Progress) -> Result<MolecularDynamics> {
        self.check()?;
        let mut md = self.gas();
        let (hot, to, dt) = (Self::HOT.max(self.temperature), self.temperature, Self::DT);
        let mix = self.steps / 8;
        md.run(
            &[Schedule { from: hot, to: hot, steps: mix, dt }, Schedule { from: to, to, steps: self.steps - mix, dt }],
            progress,
        )?;
        Ok(md)
    }
}
