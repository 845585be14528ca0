//! BB09's n = 2 experiment: radiance samples on level sets against samples anywhere, by the error of the grid that is
//! interpolated from them. \[BB09 §2.2, Fig. 5\]

use super::contour::level_curve;
use super::pictures::{map, side_by_side, stacked};
use super::solution::lookup;
use super::{FlatScene, HeightField, Solution, SolveSettings, Transport, World};
use crate::embree::Device;
use crate::error::{Error, Result};
use crate::field::Sweep;
use crate::files;
use crate::nearest::{Neighbours, PointGrid};
use crate::progress::{Progress, say};
use crate::rng::{Rng, Sobol, Stage};
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

/// What to measure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StudySettings {
    /// The largest number of samples.
    pub most: u64,
    /// Samples of the field along an edge.
    pub size: usize,
    /// Level sets of that strategy.
    pub levels: usize,
    /// Samples blended per grid point.
    pub neighbours: usize,
    /// Gather directions per sample.
    pub gather: u32,
    /// Directions per point of the converged solution.
    pub reference_gather: u32,
    /// Seed.
    pub seed: u64,
}

impl Default for StudySettings {
    fn default() -> Self {
        Self { most: 1_000_000, size: 101, levels: 10, neighbours: 8, gather: 64, reference_gather: 1024, seed: 1 }
    }
}

impl StudySettings {
    /// # Errors
    /// `Invalid` if fewer samples are allowed than the study begins with.
    pub fn check(&self) -> Result<()> {
        if !(COUNTS[0]..=COUNTS[COUNTS.len() - 1]).contains(&self.most) {
            return Err(Error::Invalid(format!("--most {}: the study goes from 1000 to 1000000 samples", self.most)));
        }
        Ok(())
    }
}

/// Where samples stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Placement {
    /// Uniform by length over level sets in the middles of equal slices of the sweep.
    LevelSets,
    /// Uniform over the field's part inside the sweep.
    Uniform,
}

impl Placement {
    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Placement::LevelSets => "level-set",
            Placement::Uniform => "uniform",
        }
    }
}

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Where the samples stood.
    pub placement: Placement,
    /// How many.
    pub samples: u64,
    /// 100 √(mean over grid points of |rgb − rgb_ref|²), rgb clamped to [0, 1].
    pub percent_rms: f64,
    /// Wall seconds of sampling and interpolation.
    pub seconds: f64,
}

/// A world with its converged radiance at the grid's points.
#[derive(Debug)]
pub struct Bench {
    world: World,
    solution: Solution,
    reference: Vec<Option<DVec3>>,
    settings: StudySettings,
}

impl Bench {
    /// The `bumps2` scene of the tables, solved.
    ///
    /// # Errors
    /// `Embree`, `Interrupted`.
    pub fn new(device: &Device, settings: &StudySettings) -> Result<Self> {
        let field = HeightField::generate("bumps2", settings.size, Sweep::new(3.6, 95.0)?)?;
        let walls = FlatScene::default_box(&field)?;
        let scene = FlatScene::new(field, DVec3::splat(0.75), crate::flattened::Side::Lower, 1.0, walls)?;
        let world = World::new(device, scene, Transport::Flattened)?;
        let solve =
            SolveSettings { factor: 2, gather: 256, shadow: 32, seed: settings.seed, ..SolveSettings::default() };
        let solution = Solution::new(&world, &solve)?;
        let mut bench = Self { world, solution, reference: Vec::new(), settings: *settings };
        let field = &bench.world.scene.field;
        let [nx, ny] = field.dims();
        bench.reference = (0..nx * ny)
            .into_par_iter()
            .map(|o| {
                let p = DVec2::new((o % nx) as f64, (o / nx) as f64);
                // A stream of its own: samples at the same place must not share its noise.
                let inside = (0.0..=1.0).contains(&field.value(p));
                inside.then(|| bench.radiance(p, 64, settings.reference_gather, 1 << 40 | o as u64)).flatten()
            })
            .collect();
        Ok(bench)
    }

    /// Grid points with a reference: on the sweep and with a normal.
    pub fn points(&self) -> usize {
        self.reference.iter().flatten().count()
    }

    fn radiance(&self, p: DVec2, shadow: u32, gather: u32, key: u64) -> Option<DVec3> {
        let world = &self.world;
        let receiver = world.graph_receiver(p, world.scene.outside)?;
        let [direct, indirect] = world.reflected(&receiver, &self.solution, shadow, gather, key);
        Some(world.scene.albedo * (direct + indirect))
    }

    /// `count` positions in index coordinates.
    pub fn positions(&self, placement: Placement, count: u64) -> Vec<DVec2> {
        let field = &self.world.scene.field;
        let seed = self.settings.seed;
        match placement {
            Placement::Uniform => {
                let set = Sobol::set(seed, Stage::Sample, 0);
                (0..u32::MAX)
                    .map(|i| DVec2::from_array(set.point2(i, 0)) * field.far())
                    .filter(|&p| (0.0..=1.0).contains(&field.value(p)))
                    .take(count as usize)
                    .collect()
            }
            Placement::LevelSets => {
                let n = self.settings.levels;
                let curves: Vec<[DVec2; 2]> =
                    (0..n).flat_map(|k| level_curve(field, (k as f64 + 0.5) / n as f64)).collect();
                let mut ends = Vec::with_capacity(curves.len());
                let mut total = 0.0;
                for [a, b] in &curves {
                    total += ((*b - *a) * field.spacing()).length();
                    ends.push(total);
                }
                (0..count)
                    .map(|i| {
                        let mut rng = Rng::stream(seed, Stage::Sample, i);
                        let x = (i as f64 + rng.unit()) / count as f64 * total;
                        let [a, b] = curves[ends.partition_point(|&e| e <= x).min(curves.len() - 1)];
                        a.lerp(b, rng.unit())
                    })
                    .collect()
            }
        }
    }

    /// Samples, interpolates onto the grid, compares. Also gives the positions and the grid's radiance.
    ///
    /// # Errors
    /// `Interrupted`.
    pub fn measure(&self, placement: Placement, count: u64) -> Result<(Measured, Vec<DVec2>, Vec<DVec3>)> {
        let begun = Instant::now();
        let positions = self.positions(placement, count);
        let samples: Vec<(DVec2, DVec3)> = positions
            .par_iter()
            .enumerate()
            .filter_map(|(i, &p)| Some((p, self.radiance(p, 12, self.settings.gather, i as u64)?)))
            .collect();
        crate::progress::unless_interrupted()?;
        let grid = self.shepard(&samples);
        let seconds = begun.elapsed().as_secs_f64();
        let exposure = self.world.exposure();
        let shown = |rgb: DVec3| (rgb * exposure).clamp(DVec3::ZERO, DVec3::ONE);
        let sum: f64 = grid
            .iter()
            .zip(&self.reference)
            .filter_map(|(&rgb, reference)| Some((shown(rgb) - shown((*reference)?)).length_squared()))
            .sum();
        let percent_rms = 100.0 * (sum / self.points() as f64).sqrt();
        Ok((Measured { placement, samples: count, percent_rms, seconds }, positions, grid))
    }

    /// Modified Shepard interpolation onto the grid's points, as for n = 3: the nearest samples weighted
    /// ((R − d)/(R d))², R the distance of the farthest. \[Shepard68; FN80\]
    fn shepard(&self, samples: &[(DVec2, DVec3)]) -> Vec<DVec3> {
        let field = &self.world.scene.field;
        let points: Vec<Vec3> = samples.iter().map(|(p, _)| (*p * field.spacing()).extend(0.0).as_vec3()).collect();
        let sorted = PointGrid::new(&points, 2.0);
        let [nx, ny] = field.dims();
        (0..nx * ny)
            .into_par_iter()
            .map_init(Neighbours::default, |found, o| {
                let p = DVec2::new((o % nx) as f64, (o / nx) as f64) * field.spacing();
                sorted.nearest(p.extend(0.0).as_vec3(), self.settings.neighbours, f32::INFINITY, |_| true, found);
                let radius = found.found().iter().fold(0f32, |r, e| r.max(e.0)).sqrt() * 1.0001;
                let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
                for &(d2, slot) in found.found() {
                    let d = f64::from(d2.sqrt().max(1e-9));
                    let w = ((f64::from(radius) - d) / (f64::from(radius) * d)).max(1e-12).powi(2);
                    sum += w * samples[sorted.numbers()[slot as usize] as usize].1;
                    weight += w;
                }
                if weight > 0.0 { sum / weight } else { DVec3::ZERO }
            })
            .collect()
    }
}

/// Numbers of samples.
const COUNTS: [u64; 6] = [1000, 3000, 10_000, 20_000, 100_000, 1_000_000];

/// Samples of BB09's Figure 5.
const FIGURE5: u64 = 20_000;

/// Runs the study and writes `study.csv`, `study.md`, `study.svg` and, if it comes to so many samples, `figure5.png`
/// into `folder`.
///
/// # Errors
/// `Io`, `Embree`, `Interrupted`; `Invalid` if fewer than 1000 samples are allowed, or more than 10⁶.
pub fn flatland(folder: &Path, device: &Device, settings: &StudySettings, progress: Progress) -> Result<()> {
    settings.check()?;
    let begun = Instant::now();
    let bench = Bench::new(device, settings)?;
    let solved = begun.elapsed().as_secs_f64();
    let mut table = Vec::new();
    let mut rows = Vec::new();
    for placement in [Placement::LevelSets, Placement::Uniform] {
        for count in COUNTS.into_iter().filter(|&n| n <= settings.most) {
            let (measured, positions, grid) = bench.measure(placement, count)?;
            if progress.is_shown() {
                let (name, n) = (placement.name(), measured.samples);
                say!("{name:>14}  {n:>8} samples: {:.2} % in {:.2} s", measured.percent_rms, measured.seconds);
            }
            if count == FIGURE5 {
                rows.push(figure5(&bench, &positions, &grid));
            }
            table.push(measured);
        }
    }
    let mut csv = "strategy,samples,percent_rms,seconds\n".to_owned();
    for m in &table {
        let _ = writeln!(csv, "{},{},{:.4},{:.4}", m.placement.name(), m.samples, m.percent_rms, m.seconds);
    }
    files::write_text(&folder.join("study.csv"), &csv)?;
    files::write_text(&folder.join("study.svg"), &plot(&table))?;
    let mut text = markdown(&bench, &table, solved, device);
    let mut figure = "";
    if !rows.is_empty() {
        stacked(&rows).write_png(folder.join("figure5.png"), 1.0)?;
        text += "\n![samples and grids: level sets above, uniform below](figure5.png)\n";
        figure = ", figure5.png";
    }
    files::write_text(&folder.join("study.md"), &text)?;
    if progress.is_shown() {
        say!("{}: study.csv, study.md, study.svg{figure}", folder.display());
    }
    Ok(())
}

/// Samples as dots of the grid's radiance there, and the grid made from them.
fn figure5(bench: &Bench, positions: &[DVec2], grid: &[DVec3]) -> crate::export::picture::Picture {
    const FACTOR: usize = 5;
    /// A blue that no light of the box has.
    const OFF_SWEEP: DVec3 = DVec3::new(0.08, 0.12, 0.25);
    let field = &bench.world.scene.field;
    let exposure = 0.8 * bench.world.exposure();
    let values: Vec<[f32; 3]> = grid.iter().map(|c| c.as_vec3().to_array()).collect();
    let dims = field.dims();
    let colour = |p: DVec2| lookup(&values, dims, [p.x as f32, p.y as f32]) * exposure;
    let inside = |p: DVec2| (0.0..=1.0).contains(&field.value(p));
    let mut dots = map(field, FACTOR, |_| OFF_SWEEP);
    for &p in positions {
        let (x, y) = ((p.x * FACTOR as f64) as usize, (p.y * FACTOR as f64) as usize);
        let (x, y) = (x.min(dots.width - 1), dots.height - 1 - y.min(dots.height - 1));
        let at = y * dots.width + x;
        dots.rgb[at] = colour(p).as_vec3().to_array();
    }
    let interpolated = map(field, FACTOR, |p| if inside(p) { colour(p) } else { OFF_SWEEP });
    side_by_side(&[dots, interpolated])
}

/// The paper's numbers at 20 000 samples.
fn published(placement: Placement) -> f64 {
    match placement {
        Placement::LevelSets => 7.4,
        Placement::Uniform => 2.2,
    }
}

fn markdown(bench: &Bench, table: &[Measured], solved: f64, device: &Device) -> String {
    let s = &bench.settings;
    let at = |placement, samples| table.iter().find(|m| m.placement == placement && m.samples == samples);
    let mut text = format!(
        "# n = 2: where to put radiance samples\n\n\
         `bumps2`, {0}×{0} samples, sweep 3.6 … 95, flattened light; {1} neighbours blended by Shepard's method onto the\n\
         {0}×{0} grid; error over the {2} grid points on the sweep against a converged solution, as 100 √(mean |Δrgb|²), rgb\n\
         clamped to [0, 1] at exposure {3:.4}.\n\n",
        s.size,
        s.neighbours,
        bench.points(),
        bench.world.exposure()
    );
    if let (Some(a), Some(b)) = (at(Placement::LevelSets, 20_000), at(Placement::Uniform, 20_000)) {
        let _ = write!(
            text,
            "| 20 000 samples | BB09 | isolume |\n|---|---|---|\n| {} level sets | {} % | {:.2} % |\n| uniform | {} % | {:.2} % |\n\
             | ratio | {:.1} | {:.1} |\n\n",
            s.levels,
            published(Placement::LevelSets),
            a.percent_rms,
            published(Placement::Uniform),
            b.percent_rms,
            published(Placement::LevelSets) / published(Placement::Uniform),
            a.percent_rms / b.percent_rms
        );
    }
    text.push_str("| samples | level sets, % | seconds | uniform, % | seconds |\n|---:|---:|---:|---:|---:|\n");
    for m in table.iter().filter(|m| m.placement == Placement::LevelSets) {
        if let Some(u) = at(Placement::Uniform, m.samples) {
            let _ = writeln!(
                text,
                "| {} | {:.2} | {:.2} | {:.2} | {:.2} |",
                m.samples, m.percent_rms, m.seconds, u.percent_rms, u.seconds
            );
        }
    }
    let _ = write!(
        text,
        "\nSolution and reference: {solved:.1} s. {} gather directions per sample, {} for the reference; seed {}. {} threads, \
         Embree {}, commit {}.\n\n![error against samples](study.svg)\n",
        s.gather,
        s.reference_gather,
        s.seed,
        rayon::current_num_threads(),
        device.version(),
        env!("ISOLUME_COMMIT")
    );
    text
}

/// Error against samples, both axes logarithmic, with the paper's two points.
fn plot(table: &[Measured]) -> String {
    let x = |n: f64| 60.0 + (n.log10() - 3.0) / 3.0 * 400.0;
    let y = |e: f64| 20.0 + (1.5 - e.max(0.1).log10()) / 2.5 * 300.0;
    let mut svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 500 370\" font-family=\"sans-serif\" \
                   font-size=\"12\">\n<rect width=\"500\" height=\"370\" fill=\"#fff\"/>\n"
        .to_owned();
    for (n, label) in [(1e3, "10³"), (1e4, "10⁴"), (1e5, "10⁵"), (1e6, "10⁶")] {
        let at = x(n);
        let _ = writeln!(
            svg,
            "<path d=\"M{at:.1} 20V320\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"336\" text-anchor=\"middle\">{label}</text>"
        );
    }
    for e in [0.1, 0.3, 1.0, 3.0, 10.0, 30.0] {
        let at = y(e);
        let _ = writeln!(
            svg,
            "<path d=\"M60 {at:.1}H460\" stroke=\"#ddd\"/><text x=\"54\" y=\"{:.1}\" text-anchor=\"end\">{e}</text>",
            at + 4.0
        );
    }
    svg.push_str("<text x=\"260\" y=\"358\" text-anchor=\"middle\">samples</text>\n");
    svg.push_str("<text transform=\"translate(18 170) rotate(-90)\" text-anchor=\"middle\">RMS error, %</text>\n");
    for (placement, colour) in [(Placement::LevelSets, "#c33"), (Placement::Uniform, "#26a")] {
        let points: Vec<(f64, f64)> = table
            .iter()
            .filter(|m| m.placement == placement)
            .map(|m| (x(m.samples as f64), y(m.percent_rms)))
            .collect();
        let path: Vec<String> = points.iter().map(|(a, b)| format!("{a:.1} {b:.1}")).collect();
        let _ = writeln!(svg, "<path d=\"M{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>", path.join("L"));
        for (a, b) in points {
            let _ = writeln!(svg, "<circle cx=\"{a:.1}\" cy=\"{b:.1}\" r=\"3\" fill=\"{colour}\"/>");
        }
        let (a, b) = (x(20_000.0), y(published(placement)));
        let _ = writeln!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"8\" height=\"8\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"/>",
            a - 4.0,
            b - 4.0
        );
    }
    svg.push_str(
        "<text x=\"330\" y=\"36\" fill=\"#c33\">on level sets</text><text x=\"330\" y=\"52\" fill=\"#26a\">uniform</text>\
         <text x=\"330\" y=\"68\" fill=\"#555\">squares: BB09</text>\n</svg>\n",
    );
    svg
}
