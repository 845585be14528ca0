//! `isolume generate`: volumes from formulas and from simulations.

use super::{expect_extension, writable};
use crate::error::{Error, Result};
use crate::progress::{Progress, say, unless_interrupted};
use crate::series::suffixed;
use crate::volume::Volume;
use crate::volume::generate::fluid::{self, Fluid};
use crate::volume::generate::molecular_dynamics::MolecularDynamics;
use crate::volume::generate::neighbours::clusters;
use crate::volume::generate::number_density::number_density;
use crate::volume::generate::pasta::{self, Pasta};
use crate::volume::generate::{Generator, SIMULATED};
use glam::DVec3;
use std::path::{Path, PathBuf};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Simulations run for a minute or two; the same seed gives the same file on any number of threads.
  pasta  nucleons of a neutron star's crust; densities in nucleons/fm³ over a periodic cube, world in fm
  fluid  a Lennard-Jones liquid: droplets in a slit pore, a film on its walls x_min and x_max; reduced units

Examples:
  isolume generate bumps -o bumps.vti
  isolume generate pasta --species both -o pasta.vti     writes pasta-proton.vti and pasta-neutron.vti
  isolume generate fluid -o fluid.vti")]
pub(super) struct Generate {
    /// A formula: bumps, sphere, linear[:a,b,c], xyz, two-cylinders[:gap]; or a simulation: pasta, fluid
    kind: String,
    /// Samples along each edge (default: 101, fluid 120)
    #[arg(long, value_name = "N")]
    size: Option<usize>,
    /// Output: .vti, .nrrd or .npy
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    simulation: SimulationOptions,
}

/// What simulations take, and formulas do not.
#[derive(clap::Args, Debug, Default, PartialEq)]
#[command(next_help_heading = "Simulations")]
struct SimulationOptions {
    /// pasta: the nucleons to count; both writes two files, FILE-proton and FILE-neutron (default: total)
    #[arg(long)]
    species: Option<Species>,
    /// Seed of all random numbers (default: 1)
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Particles (default: 6000, fluid 7000)
    #[arg(long, value_name = "N")]
    particles: Option<usize>,
    /// Particles per unit of volume (default: 0.04 per fm³, fluid 0.1 per σ³)
    #[arg(long, value_name = "N")]
    density: Option<f64>,
    /// pasta: protons per nucleon (default: 0.3)
    #[arg(long, value_name = "SHARE")]
    proton_fraction: Option<f64>,
    /// Temperature at the end (default: 1 MeV, fluid 0.7 ε)
    #[arg(long, value_name = "T")]
    temperature: Option<f64>,
    /// Time steps (default: 5000, fluid 12000)
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Standard deviation of the Gaussian that spreads each particle (default: 1.5 fm, fluid 1 σ)
    #[arg(long, value_name = "LENGTH")]
    spread: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Species {
    Total,
    Proton,
    Neutron,
    Both,
}

impl Generate {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["vti", "nrrd", "npy"])?;
        match self.kind.as_str() {
            "pasta" => self.pasta(progress),
            "fluid" => self.fluid(progress),
            _ => self.formula(progress),
        }
    }

    fn formula(&self, progress: Progress) -> Result<()> {
        let generator = Generator::from_name(&self.kind)?;
        if self.simulation != SimulationOptions::default() {
            return Err(Error::Invalid(format!(
                "generate {}: a formula takes --size only; the other flags are for {}",
                self.kind,
                SIMULATED.join(" and ")
            )));
        }
        writable(&self.output)?;
        let volume = generator.sample([self.size.unwrap_or(Generator::DIMS[0]); 3])?;
        unless_interrupted()?;
        volume.write(&self.output)?;
        if progress.is_shown() {
            say!("{}: {} of {} samples", self.output.display(), generator.name(), volume.samples().len());
        }
        Ok(())
    }

    fn pasta(&self, progress: Progress) -> Result<()> {
        let o = &self.simulation;
        let default = Pasta::default();
        let pasta = Pasta {
            nucleons: o.particles.unwrap_or(default.nucleons),
            density: o.density.unwrap_or(default.density),
            proton_fraction: o.proton_fraction.unwrap_or(default.proton_fraction),
            temperature: o.temperature.unwrap_or(default.temperature),
            steps: o.steps.unwrap_or(default.steps),
            seed: o.seed.unwrap_or(default.seed),
        };
        pasta.check()?;
        let (sigma, size) = (self.spread(1.5)?, self.samples(101)?);
        let files: Vec<(PathBuf, &str, &[u8])> = match o.species.unwrap_or(Species::Total) {
            Species::Total => vec![(self.output.clone(), "nucleon", &[pasta::PROTON, pasta::NEUTRON])],
            Species::Proton => vec![(self.output.clone(), "proton", &[pasta::PROTON])],
            Species::Neutron => vec![(self.output.clone(), "neutron", &[pasta::NEUTRON])],
            Species::Both => vec![
                (suffixed(&self.output, "-proton"), "proton", &[pasta::PROTON]),
                (suffixed(&self.output, "-neutron"), "neutron", &[pasta::NEUTRON]),
            ],
        };
        for (path, ..) in &files {
            writable(path)?;
        }
        let md = pasta.simulate(progress)?;
        self.summary(&md, pasta::LINK, "MeV", progress);
        let command = format!(
            "isolume generate pasta --size {size} --seed {} --particles {} --density {} --proton-fraction {} \
             --temperature {} --steps {} --spread {sigma}",
            pasta.seed, pasta.nucleons, pasta.density, pasta.proton_fraction, pasta.temperature, pasta.steps
        );
        for (path, name, species) in files {
            let points = points(&md, species);
            let volume = number_density(name, &md.bounds, &points, sigma, [size; 3])?;
            write(&path, &volume, &format!("{name} density, 1/fm³, in a world of fm"), &command, progress)?;
        }
        Ok(())
    }

    fn fluid(&self, progress: Progress) -> Result<()> {
        let o = &self.simulation;
        if o.species.is_some() || o.proton_fraction.is_some() {
            return Err(Error::Invalid("generate fluid: --species and --proton-fraction are for pasta".into()));
        }
        let default = Fluid::default();
        let fluid = Fluid {
            atoms: o.particles.unwrap_or(default.atoms),
            density: o.density.unwrap_or(default.density),
            temperature: o.temperature.unwrap_or(default.temperature),
            steps: o.steps.unwrap_or(default.steps),
            seed: o.seed.unwrap_or(default.seed),
        };
        fluid.check()?;
        let (sigma, size) = (self.spread(1.0)?, self.samples(120)?);
        writable(&self.output)?;
        let md = fluid.simulate(progress)?;
        self.summary(&md, fluid::LINK, "ε", progress);
        let volume = number_density("fluid", &md.bounds, &md.positions, sigma, [size; 3])?;
        let command = format!(
            "isolume generate fluid --size {size} --seed {} --particles {} --density {} --temperature {} --steps {} \
             --spread {sigma}",
            fluid.seed, fluid.atoms, fluid.density, fluid.temperature, fluid.steps
        );
        write(&self.output, &volume, "fluid density, 1/σ³, in a world of σ", &command, progress)
    }

    fn spread(&self, default: f64) -> Result<f64> {
        let sigma = self.simulation.spread.unwrap_or(default);
        if (0.05..=10.0).contains(&sigma) {
            return Ok(sigma);
        }
        Err(Error::Invalid(format!("--spread {sigma}: 0.05 to 10")))
    }

    /// Samples per edge, checked before minutes of work.
    fn samples(&self, default: usize) -> Result<usize> {
        let size = self.size.unwrap_or(default);
        if (2..=Generator::MOST).contains(&size) {
            return Ok(size);
        }
        Err(Error::Invalid(format!("--size {size}: 2 to {} samples along each edge of a simulation", Generator::MOST)))
    }

    fn summary(&self, md: &MolecularDynamics, link: f64, unit: &str, progress: Progress) {
        if progress.is_shown() {
            let sizes = clusters(&md.bounds, &md.positions, link);
            say!(
                "{:>14}  {} particles at {:.2} {unit}: {} clusters of 10 or more, the greatest of {}",
                self.kind,
                md.positions.len(),
                md.temperature(),
                sizes.iter().filter(|&&s| s >= 10).count(),
                sizes[0]
            );
        }
    }
}

/// The positions of some species.
fn points(md: &MolecularDynamics, species: &[u8]) -> Vec<DVec3> {
    md.positions.iter().zip(&md.species).filter(|(_, s)| species.contains(s)).map(|(x, _)| *x).collect()
}

/// Writes a simulated volume with what it is and how to make it again.
fn write(path: &Path, volume: &Volume, content: &str, command: &str, progress: Progress) -> Result<()> {
    let notes = [
        ("content".to_owned(), content.to_owned()),
        ("generator".to_owned(), command.to_owned()),
        // "isolume" is where a bake describes itself.
        ("version".to_owned(), format!("isolume {} ({})", env!("CARGO_PKG_VERSION"), env!("ISOLUME_COMMIT"))),
    ];
    volume.write_with_notes(path, &notes)?;
    if progress.is_shown()
        && let Some((lo, hi)) = volume.range()
    {
        say!("{}: {} density, {lo:.4} … {hi:.4}", path.display(), volume.name);
    }
    Ok(())
}
