//! `isolume flatland`.

use crate::error::{Error, Result};
use crate::flatland::{PictureSettings, Solution, SolveSettings, Transport, World, load, write_pictures};
use crate::progress::{Progress, say};
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Writes flattened.png and .exr, waterlines.png and levelsets.svg; with --ordinary also ordinary.png and .exr, and
both.png with the two side by side; with --paths also paths.png.

Examples:
  isolume flatland scenes/flatland-bumps2.toml -o out
  isolume flatland scenes/flatland-bumps2.toml --ordinary --paths 60 -o out")]
pub(super) struct Flatland {
    /// Scene file of n = 2 (.toml)
    scene: PathBuf,
    /// Folder for the pictures; made if it does not exist
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Light the graph as an ordinary surface in R³ too, and put both pictures side by side
    #[arg(long)]
    ordinary: bool,
    /// Draw this many photons that leave the luminaire at half the sweep's height, at most 65536
    #[arg(long, default_value_t = 0, value_name = "N")]
    paths: u64,
    /// Pixels across one picture
    #[arg(long, default_value_t = 640, value_name = "PIXELS")]
    width: usize,
    /// Directions per point: noise falls, time rises
    #[arg(long, default_value_t = 128, value_name = "M")]
    gather: u32,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// More would cover the picture.
const MOST_PATHS: u64 = 1 << 16;

impl Flatland {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        if !(16..=8192).contains(&self.width) {
            return Err(Error::Invalid(format!("--width {}: 16 to 8192 pixels", self.width)));
        }
        if !(1..=1 << 16).contains(&self.gather) {
            return Err(Error::Invalid(format!("--gather {}: 1 to 65536 directions", self.gather)));
        }
        if self.paths > MOST_PATHS {
            return Err(Error::Invalid(format!("--paths {}: 0 to {MOST_PATHS} photons", self.paths)));
        }
        let scene = load(&self.scene)?;
        let (gaps, count) = (scene.field.non_finite(), scene.field.samples().len());
        if gaps > 0 {
            say!(
                "warning: {}: {gaps} of {count} samples are not finite; no curve passes the cells that touch them",
                self.scene.display()
            );
        }
        let device = super::device()?;
        let begun = Instant::now();
        let transports: &[Transport] =
            if self.ordinary { &[Transport::Flattened, Transport::Ordinary] } else { &[Transport::Flattened] };
        let world = |&transport: &Transport| World::new(&device, scene.clone(), transport);
        let all: Vec<World> =
            transports.iter().map(world).collect::<Result<_>>().map_err(|e| e.in_file(&self.scene))?;
        super::folder(&self.output)?;
        let mut worlds = Vec::new();
        for (world, transport) in all.into_iter().zip(transports) {
            // A sphere of directions needs more of them, and more of its luminaire, than a circle.
            let more = if *transport == Transport::Ordinary { 2 } else { 1 };
            let settings = SolveSettings {
                gather: self.gather * more,
                shadow: 16 * more * more,
                seed: self.seed,
                ..SolveSettings::default()
            };
            let solution = Solution::new(&world, &settings)?;
            if progress.is_shown() {
                say!(
                    "{transport:?}: {:.1} M rays, {} passes, {:.2} s so far",
                    solution.rays as f64 / 1e6,
                    solution.passes,
                    begun.elapsed().as_secs_f64()
                );
            }
            worlds.push((world, solution));
        }
        let settings =
            PictureSettings { width: self.width, gather: self.gather, paths: self.paths, ..PictureSettings::default() };
        let names = write_pictures(&self.output, &device, &worlds, &settings)?;
        if progress.is_shown() {
            let seconds = begun.elapsed().as_secs_f64();
            say!("{}: {} in {seconds:.2} s", self.output.display(), names.join(", "));
        }
        Ok(())
    }
}
