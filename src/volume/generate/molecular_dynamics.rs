//! Classical molecular dynamics: velocity Verlet over pair potentials and an external field.
//!
//! Each particle sums the forces on it by itself, in the order of its neighbour list: twice the arithmetic of Newton's
//! third law, but the same bits for any number of threads, and pairs still cancel exactly before summation rounds.
//!
//! Without rescaling, at the steps that volumes are made with (2 fm/c; 0.005 Lennard-Jones times), energy drifts by
//! −1.2·10⁻⁷ MeV per nucleon and fm/c, and by −3.4·10⁻⁶ ε per atom and Lennard-Jones time: 3·10⁻⁴ and 4·10⁻⁵ of the
//! kinetic energy in 4000 steps.

use super::neighbours::{SimulationBox, neighbours};
use super::pair_potential::PairPotential;
use crate::error::Result;
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use glam::DVec3;
use rayon::prelude::*;

/// A force between pairs of particles: which potential acts between which two species.
#[derive(Debug)]
pub struct PairTerm {
    potentials: Vec<PairPotential>,
    /// Index of the potential between two species.
    between: [[Option<usize>; 2]; 2],
    /// How much farther than the cut-off lists reach, so that they serve several steps.
    skin: f64,
    cutoff: f64,
    lists: Vec<Vec<u32>>,
    /// Positions for which the lists were made.
    listed: Vec<DVec3>,
}

impl PairTerm {
    /// `between[a][b]` is the index of the potential between species a and b, `skin` > 0 a length.
    pub fn new(potentials: Vec<PairPotential>, between: [[Option<usize>; 2]; 2], skin: f64) -> Self {
        let cutoff = potentials.iter().map(PairPotential::cutoff).fold(0.0, f64::max);
        Self { potentials, between, skin, cutoff, lists: vec![], listed: vec![] }
    }

    /// How far the lists reach: at most half a period of the box.
    pub fn reach(&self) -> f64 {
        self.cutoff + self.skin
    }
}

/// Energy and force of an external field at a point.
pub type ExternalField = Box<dyn Fn(DVec3) -> (f64, DVec3) + Send + Sync>;

/// Particles in motion. Units are the caller's; the temperature is an energy (Boltzmann's constant is 1).
#[allow(missing_debug_implementations, reason = "holds a function")]
pub struct MolecularDynamics {
    /// The box.
    pub bounds: SimulationBox,
    /// Positions; along periodic axes within a little more than [0, size).
    pub positions: Vec<DVec3>,
    /// Velocities.
    pub velocities: Vec<DVec3>,
    /// Species of each particle: 0 or 1.
    pub species: Vec<u8>,
    mass: f64,
    terms: Vec<PairTerm>,
    field: Option<ExternalField>,
    forces: Vec<(f64, DVec3)>,
}

/// How the temperature of a run goes: linearly from `from` to `to` in `steps` steps of length `dt`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Temperature at the beginning.
    pub from: f64,
    /// Temperature at the end.
    pub to: f64,
    /// Steps.
    pub steps: usize,
    /// Time of a step.
    pub dt: f64,
}

/// Steps between two rescalings of the velocities.
const RESCALE: usize = 10;

impl MolecularDynamics {
    /// Particles at `positions` with Maxwell–Boltzmann velocities at `temperature`, their total momentum 0.
    pub fn new(
        bounds: SimulationBox,
        positions: Vec<DVec3>,
        species: Vec<u8>,
        mass: f64,
        terms: Vec<PairTerm>,
        field: Option<ExternalField>,
        (temperature, seed): (f64, u64),
    ) -> Self {
        let speed = (temperature / mass).sqrt();
        let velocity = |i| {
            let mut rng = Rng::stream(seed, Stage::Simulation, i);
            DVec3::new(rng.normal(), rng.normal(), rng.normal()) * speed
        };
        let mut velocities: Vec<DVec3> = (0..positions.len() as u64).map(velocity).collect();
        let mean = velocities.iter().sum::<DVec3>() / positions.len() as f64;
        velocities.iter_mut().for_each(|v| *v -= mean);
        let mut md = Self { bounds, positions, velocities, species, mass, terms, field, forces: vec![] };
        md.update_forces();
        md
    }

    /// Renews the neighbour lists that particles may have outrun.
    fn update_lists(&mut self) {
        let bounds = self.bounds;
        let outrun = |term: &PairTerm| {
            term.listed.is_empty()
                || self
                    .positions
                    .iter()
                    .zip(&term.listed)
                    .any(|(&x, &y)| bounds.nearest_image(x - y).length_squared() > 0.25 * term.skin * term.skin)
        };
        let stale: Vec<usize> = (0..self.terms.len()).filter(|&t| outrun(&self.terms[t])).collect();
        if stale.is_empty() {
            return;
        }
        self.positions.iter_mut().for_each(|x| *x = bounds.wrap(*x));
        for t in stale {
            let term = &mut self.terms[t];
            let acts = |i: &u32| term.between[usize::from(self.species[*i as usize])].iter().any(Option::is_some);
            #[allow(clippy::cast_possible_truncation, reason = "particles are counted in u32")]
            let members: Vec<u32> = (0..self.positions.len() as u32).filter(acts).collect();
            term.lists = neighbours(&bounds, &self.positions, &members, term.reach());
            term.listed.clone_from(&self.positions);
        }
    }

    fn update_forces(&mut self) {
        self.update_lists();
        let (positions, species, bounds) = (&self.positions, &self.species, &self.bounds);
        let on = |i: usize| {
            let x = positions[i];
            let (mut energy, mut force) = self.field.as_ref().map_or((0.0, DVec3::ZERO), |field| field(x));
            for term in &self.terms {
                let between = &term.between[usize::from(species[i])];
                let cutoff2 = term.cutoff * term.cutoff;
                for &j in &term.lists[i] {
                    let d = bounds.nearest_image(x - positions[j as usize]);
                    let squared = d.length_squared();
                    if squared < cutoff2
                        && let Some(p) = between[usize::from(species[j as usize])]
                    {
                        let [v, f] = term.potentials[p].at(squared);
                        energy += 0.5 * v;
                        force += d * f;
                    }
                }
            }
            (energy, force)
        };
        let forces = (0..positions.len()).into_par_iter().with_min_len(64).map(on).collect();
        self.forces = forces;
    }

    /// One step of velocity Verlet. \[AT17 Code 3.1\]
    pub fn step(&mut self, dt: f64) {
        let half = 0.5 * dt / self.mass;
        for ((x, v), (_, f)) in self.positions.iter_mut().zip(&mut self.velocities).zip(&self.forces) {
            *v += *f * half;
            *x += *v * dt;
        }
        self.update_forces();
        for (v, (_, f)) in self.velocities.iter_mut().zip(&self.forces) {
            *v += *f * half;
        }
    }

    /// Moves the particles to `positions`, at most a skin from where they are, without time passing.
    pub fn place(&mut self, positions: Vec<DVec3>) {
        self.positions = positions;
        self.update_forces();
    }

    /// Force on each particle.
    pub fn forces(&self) -> impl Iterator<Item = DVec3> {
        self.forces.iter().map(|(_, f)| *f)
    }

    /// Kinetic energy.
    pub fn kinetic_energy(&self) -> f64 {
        0.5 * self.mass * self.velocities.iter().map(|v| v.length_squared()).sum::<f64>()
    }

    /// Potential energy of the pairs and in the field.
    #[cfg(test)]
    pub(super) fn potential_energy(&self) -> f64 {
        self.forces.iter().map(|(e, _)| e).sum()
    }

    /// Temperature: kinetic energy per half degree of freedom, the total momentum's three left out.
    pub fn temperature(&self) -> f64 {
        2.0 * self.kinetic_energy() / (3.0 * self.positions.len() as f64 - 3.0)
    }

    /// Total momentum.
    #[cfg(test)]
    pub(super) fn momentum(&self) -> DVec3 {
        self.mass * self.velocities.iter().sum::<DVec3>()
    }

    /// Scales all velocities so that the temperature is `temperature`.
    pub fn rescale(&mut self, temperature: f64) {
        let factor = (temperature / self.temperature()).sqrt();
        self.velocities.iter_mut().for_each(|v| *v *= factor);
    }

    /// Runs through the schedules, one after another, rescaling velocities as they say.
    ///
    /// # Errors
    /// `Interrupted`.
    pub fn run(&mut self, schedules: &[Schedule], progress: Progress) -> Result<()> {
        let stage = progress.stage("dynamics", schedules.iter().map(|s| s.steps as u64).sum());
        'all: for s in schedules {
            for n in 0..s.steps {
                if !stage.tick(1) {
                    break 'all;
                }
                self.step(s.dt);
                if n % RESCALE == 0 {
                    self.rescale(s.from + (s.to - s.from) * n as f64 / s.steps as f64);
                }
            }
        }
        stage.end().map(drop)
    }
}

/// `n` points spread evenly over a box of this size: sites of a cubic lattice, each moved by up to a tenth of its edge.
pub fn spread_evenly(size: DVec3, n: usize, seed: u64) -> Vec<DVec3> {
    let edge = (size.x * size.y * size.z / n as f64).cbrt();
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small count")]
    let counts = size.to_array().map(|s| (s / edge).ceil().max(1.0) as usize);
    let sites: usize = counts.iter().product();
    let edges = size / DVec3::from_array(counts.map(|c| c as f64));
    let at = |i: usize| {
        let site = i * sites / n;
        let mut rng = Rng::stream(seed, Stage::Simulation, (1 << 32) + i as u64);
        let [x, y, z] = [site % counts[0], site / counts[0] % counts[1], site / (counts[0] * counts[1])];
        let jitter = DVec3::new(rng.unit(), rng.unit(), rng.unit()) - 0.5;
        (DVec3::new(x as f64, y as f64, z as f64) + 0.5 + 0.2 * jitter) * edges
    };
    (0..n).map(at).collect()
}
