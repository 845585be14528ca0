//! `isolume bake`: from a volume or scene to the file that holds it with its light.

mod plan;
mod warnings;

use super::{expect_extension, outputs};
use crate::bake::{BakeOptions, BakeReport, Engine, bake_fields, digest, job};
use crate::checkpoint::{Checkpoint, Held};
use crate::error::{Error, Result};
use crate::export::bake_file::{self, BakedVolume};
use crate::field::Sweep;
use crate::files;
use crate::progress::{Clock, Progress, say};
use crate::scene::{Policy, Scene};
use crate::scene_file::{Inputs, SceneOptions, load, load_series};
use crate::series::{Series, write_collection};
use crate::volume::vti::is_foreign;
use plan::Plan;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
The result holds point data `value` (contour on it), `rgb` (colour by it, without lighting and without a colour map),
`radiance` (linear), `std_error` and `mask`, the walls' light as field data, and every setting.

Examples:
  isolume bake ch2.nii.gz --isovalues 15 200 -o head.vti --report head.json
  isolume bake scene.toml -o out.vti --preset preview
  isolume bake two-fields.toml -o two.vtm                several volumes: two.vtm, which names a .vti for each
  isolume bake scan.raw --raw-dims 305,224,14 --raw-spacing 0.24,0.24,1 -o scan.vti
  isolume bake 'rho_%04d.vti' -o lit.vti                 a series in time: lit_0000.vti … and lit.pvd for ParaView
  isolume bake 'rho_%04d.vti' --time 3.5 -o lit.vti      one moment of it
  isolume bake big.nrrd -o big.vti --resume              go on where an interrupted bake stopped
  isolume bake big.nrrd -o big.vti --max-memory 8G --dry-run   what it would take")]
pub(super) struct Bake {
    /// Volume, or scene file (.toml)
    input: PathBuf,
    /// Output: .vti; of a scene of several volumes .vtm, with a .vti for each beside it
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Write seconds, rays, counts and settings as JSON; of a series NAME_0000.json … for NAME.json
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Print the same JSON, of a series a list of its frames'; with --dry-run the estimates
    #[arg(long)]
    json: bool,
    /// Where progress is kept until the bake is done (default: OUTPUT.checkpoint)
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,
    /// Seconds between checkpoints; shorter bakes write none
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0)]
    checkpoint_every: f64,
    /// Go on where an interrupted bake of the same settings stopped, and leave a finished one as it is; from the
    /// beginning if there is neither
    #[arg(long)]
    resume: bool,
    /// The estimated memory is to be at most this, such as 8G or 500M (powers of
    /// 1024: 8G is 8.6 GB): by the photon engine if sweeps need more, its
    /// isovalues cut into bands; refuse a bake that still needs more
    #[arg(long, value_name = "BYTES", value_parser = bytes)]
    max_memory: Option<u64>,
    /// Print what memory and time it would take, check everything, and stop before the work; nothing is written
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    scene: SceneOptions,
    #[command(flatten)]
    bake: BakeOptions,
}

impl Bake {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        let begun = Clock::start();
        let found = files::extension(&self.output);
        if ["nrrd", "npy", "exr"].contains(&found.as_str()) {
            return Err(Error::invalid(
                &self.output,
                "cannot hold a bake with its walls and settings; bake to a .vti, and `isolume export` writes its arrays",
            ));
        }
        expect_extension(&self.output, &["vti", "vtm"])?;
        self.every()?;
        let inputs = Inputs::of(&self.input, &self.scene)?;
        let series = if self.scene.time.is_none() { load_series(&self.input, &self.scene)? } else { None };
        let Some(series) = series else {
            outputs(self.outputs(), &inputs)?;
            let (_, json) = self.one(begun, progress, true, &mut BTreeSet::new())?;
            self.print(&json);
            return Ok(());
        };
        // Frames are of one volume.
        expect_extension(&self.output, &["vti"])?;
        self.check_name("the .pvd, which names the frames,")?;
        let frames: Vec<Self> = (0..series.times().len()).map(|n| self.frame(n)).collect();
        let collection = self.output.with_extension("pvd");
        outputs(frames.iter().flat_map(Self::outputs).chain([collection]), &inputs)?;
        self.frames(&series, frames, progress)
    }

    /// What it writes, but for the files of several volumes.
    fn outputs(&self) -> impl Iterator<Item = PathBuf> {
        [Some(self.output.clone()), self.report.clone(), Some(self.checkpoint_path())].into_iter().flatten()
    }

    /// The time between checkpoints.
    fn every(&self) -> Result<Duration> {
        Duration::try_from_secs_f64(self.checkpoint_every).map_err(|_| {
            Error::Invalid(format!("--checkpoint-every {}: must be seconds, 0 or more", self.checkpoint_every))
        })
    }

    fn checkpoint_path(&self) -> PathBuf {
        self.checkpoint.clone().unwrap_or_else(|| {
            let mut name = self.output.as_os_str().to_owned();
            name.push(".checkpoint");
            name.into()
        })
    }

    /// The bake of frame `n` of a series.
    fn frame(&self, n: usize) -> Self {
        let numbered = |path: &PathBuf| Series::numbered(path, n);
        Self {
            output: numbered(&self.output),
            report: self.report.as_ref().map(numbered),
            checkpoint: self.checkpoint.as_ref().map(numbered),
            ..self.clone()
        }
    }

    /// Every frame of a series, with the same sweep and seed, and the collection of those that are done.
    fn frames(&self, series: &Series, frames: Vec<Self>, progress: Progress) -> Result<()> {
        let mut scene = self.scene.clone();
        let (mut done, mut reports, mut said) = (Vec::new(), Vec::new(), BTreeSet::new());
        for (n, (&time, frame)) in series.times().iter().zip(frames).enumerate() {
            if progress.is_shown() {
                say!("{:>14}  {} of {}, time {time}", "frame", n + 1, series.times().len());
            }
            scene.time = Some(time);
            let frame = Self { scene: scene.clone(), ..frame };
            let (sweep, json) = frame.one(Clock::start(), progress, n == 0, &mut said)?;
            scene.isovalues = Some(vec![sweep.lo(), sweep.hi()]);
            if self.dry_run {
                self.print(&json);
                say!("{:>14}  that for each of {} frames", "series", series.times().len());
                return Ok(());
            }
            done.push((time, frame.output));
            reports.push(json);
            write_collection(&self.output.with_extension("pvd"), &done)?;
        }
        self.print(&reports.into());
        if progress.is_shown() {
            say!("{:>14}  {}", "written", self.output.with_extension("pvd").display());
        }
        Ok(())
    }

    /// Writes the report, if that is wanted.
    fn hand_out(&self, report: &serde_json::Value) -> Result<()> {
        let Some(path) = &self.report else { return Ok(()) };
        files::write_atomically(path, |out| Ok(serde_json::to_writer_pretty(out, report)?))
    }

    /// Prints reports or estimates, if that is wanted.
    fn print(&self, json: &serde_json::Value) {
        if self.json {
            println!("{json:#}");
        }
    }

    /// One bake, `first` unless others of its series went before, without the warnings that were `said` before; its
    /// sweep, and what there is to print about it.
    fn one(
        &self,
        begun: Clock,
        progress: Progress,
        first: bool,
        said: &mut BTreeSet<String>,
    ) -> Result<(Sweep, serde_json::Value)> {
        let loaded = load(&self.input, &self.scene)?;
        let load = begun.seconds();
        self.check_volumes(&loaded.scene)?;
        let plan = Plan::new(loaded, &self.input, &self.bake, self.max_memory, progress)?;
        let sweep = plan.scene().field.sweep();
        // A trial run may be for another machine.
        let fits = plan.check_machine();
        let unfit = if self.dry_run { fits.err() } else { fits.map(|()| None)? };
        plan.warn(said, self.scene.time.is_some())?;
        if progress.is_shown() || self.dry_run {
            plan.announce();
        }
        if self.dry_run {
            if let Some(e) = unfit {
                say!("warning: {e}");
            }
            return Ok((sweep, plan.estimates()?));
        }
        let json = match self.begin(&plan, first, progress)? {
            Begun::Whole(report) => {
                self.hand_out(&report)?;
                report
            }
            Begun::At(checkpoint) => {
                let reports = self.work(&plan, &checkpoint, (begun, load), progress)?;
                let json = self.in_one(plan.scene(), &reports);
                self.hand_out(&json)?;
                if progress.is_shown() {
                    self.summarise(plan.scene(), &reports);
                }
                warn_of_unsettled(&reports);
                json
            }
        };
        Ok((sweep, json))
    }

    /// Refuses a name that the XML of `index` cannot hold.
    fn check_name(&self, index: &str) -> Result<()> {
        let name = self.output.file_name().unwrap_or_default();
        if name.to_str().is_none_or(|name| name.contains(is_foreign)) {
            return Err(Error::Invalid(format!(
                "{:?} holds what {index} cannot: use Unicode without line breaks",
                self.output
            )));
        }
        Ok(())
    }

    /// Refuses an output that is for another number of volumes, and one that could not be written.
    fn check_volumes(&self, scene: &Scene) -> Result<()> {
        let extension = files::extension(&self.output);
        match (scene.fields(), extension.as_str()) {
            (1, "vtm") => {
                Err(Error::invalid(&self.output, "is for several volumes that sweep, the scene has one; name a .vti"))
            }
            (n @ 2.., "vti") => Err(Error::invalid(
                &self.output,
                format!(
                    "holds one volume, the scene has {n}; name a .vtm, which ParaView opens as one, and a .vti for each \
                     volume is written beside it"
                ),
            )),
            (1, _) => Ok(()),
            _ => {
                self.check_name("the .vtm, which names the volumes' files,")?;
                outputs(self.outputs().chain(self.field_files(scene)), &Inputs::of(&self.input, &self.scene)?)
            }
        }
    }

    /// The files of several volumes.
    fn field_files(&self, scene: &Scene) -> Vec<PathBuf> {
        scene.members().iter().map(|m| bake_file::field_file(&self.output, &m.name)).collect()
    }

    /// The reports as one, with what was baked: of several volumes, each by its name.
    fn in_one<R: Serialize>(&self, scene: &Scene, reports: &[R]) -> serde_json::Value {
        let members = scene.members();
        let files = if members.len() > 1 { self.field_files(scene) } else { vec![self.output.clone()] };
        let mut all = members.iter().zip(files).zip(reports).map(|((member, file), report)| {
            let mut json = serde_json::to_value(report).expect("the report is plain data");
            let sweep = member.field.sweep();
            json["input"] = self.input.to_string_lossy().into();
            json["output"] = file.to_string_lossy().into();
            json["isovalues"] = [sweep.lo(), sweep.hi()].into();
            (member.name.to_owned(), json)
        });
        match reports {
            [_] => all.next().map(|(_, json)| json).unwrap_or_default(),
            _ => all.collect::<serde_json::Map<_, _>>().into(),
        }
    }

    /// Where the work begins: with --resume at what is done.
    fn begin(&self, plan: &Plan, first: bool, progress: Progress) -> Result<Begun> {
        let job = job(plan.scene(), &plan.settings, &plan.device.version());
        let digest = digest(&job);
        let checkpoint = Checkpoint::new(&self.checkpoint_path(), job, self.every()?)?;
        let there = self.resume.then(|| BakedVolume::read(&self.output).ok()).flatten();
        let same = |bake: &BakedVolume| bake.report.get("job").and_then(|j| j.as_str()) == Some(&digest);
        let another = match there {
            Some(bake) if same(&bake) => {
                if progress.is_shown() {
                    say!("{:>14}  {} is complete", "resumed", self.output.display());
                }
                // It was killed on its last step.
                if checkpoint.held()? == Held::This && checkpoint.resume()? {
                    checkpoint.remove();
                }
                let reports: Vec<_> = [&bake].into_iter().chain(&bake.companions).map(|b| &b.report).collect();
                return Ok(Begun::Whole(self.in_one(plan.scene(), &reports)));
            }
            found => found.is_some(),
        };
        // A bake that was begun has a checkpoint, or of a series the first frame; unless it ended before its first.
        if first && another && checkpoint.held()? == Held::Nothing {
            return Err(Error::invalid(
                &self.output,
                "is a bake of other settings or of another version, which --resume cannot go on with; give its settings, \
                 or leave --resume out to replace it",
            ));
        }
        self.take_up(&checkpoint, progress)?;
        Ok(Begun::At(checkpoint))
    }

    /// Bakes and writes; if that fails, what is finished is kept. The whole of it began, and loading took, as told.
    fn work(
        &self,
        plan: &Plan,
        checkpoint: &Checkpoint,
        (begun, load): (Clock, [f64; 2]),
        progress: Progress,
    ) -> Result<Vec<BakeReport>> {
        let work = || -> Result<_> {
            let mut bakes = bake_fields(plan.scene(), &plan.settings, &plan.device, progress, Some(checkpoint))?;
            let export = Clock::start();
            for bake in &mut bakes {
                [bake.report.seconds.load, bake.report.processor_seconds.load] = load;
                [bake.report.seconds.total, bake.report.processor_seconds.total] = begun.seconds();
            }
            bake_file::write_fields(&self.output, plan.scene(), &plan.loaded.volumes(), &bakes)?;
            Ok((bakes, export))
        };
        let (bakes, export) = work().inspect_err(|e| keep(checkpoint, e))?;
        checkpoint.remove();
        let mut reports: Vec<BakeReport> = bakes.into_iter().map(|b| b.report).collect();
        for report in &mut reports {
            [report.seconds.export, report.processor_seconds.export] = export.seconds();
            [report.seconds.total, report.processor_seconds.total] = begun.seconds();
        }
        Ok(reports)
    }

    /// What was done, for people.
    fn summarise(&self, scene: &Scene, reports: &[BakeReport]) {
        let r = &reports[0];
        // Fields that light each other share rays and counts.
        let runs = if scene.policy() == Policy::Joint { &reports[..1] } else { reports };
        let sum = |of: fn(&BakeReport) -> u64| runs.iter().map(of).sum::<u64>();
        let work = match r.settings.engine {
            Engine::Sweep => format!("{} queries along lines, {} rays", sum(|r| r.sweep_queries), sum(|r| r.rays)),
            Engine::Photon => format!(
                "{} rays, {} photons stored, {} samples",
                sum(|r| r.rays),
                sum(|r| r.photons.stored),
                sum(|r| r.samples)
            ),
        };
        // Of a resumed bake it is not known.
        let rate = r.rays_per_second / 1e6;
        let rate = if rate.is_finite() { format!(" ({rate:.1} M/s)") } else { String::new() };
        say!("{:>14}  {:.2} s: {work}{rate}", "total", r.seconds.total);
        let each = |of: fn(&BakeReport) -> u64| reports.iter().map(of).sum::<u64>();
        say!(
            "{:>14}  {} masked ({} filled), {} gather misses, {} without gradient, {} not finite",
            "counts",
            each(|r| r.masked),
            each(|r| r.filled),
            sum(|r| r.misses),
            sum(|r| r.samples_without_gradient),
            each(|r| r.non_finite + r.non_finite_voxels)
        );
        say!("{:>14}  {}", "written", self.output.display());
        for member in scene.members().iter().filter(|_| reports.len() > 1) {
            say!("{:>14}  {}", "", bake_file::field_file(&self.output, &member.name).display());
        }
    }

    /// Takes up what an interrupted run left in the checkpoint, if that is wanted, or says that it is there.
    fn take_up(&self, checkpoint: &Checkpoint, progress: Progress) -> Result<()> {
        let path = checkpoint.path();
        let say = |label: &str, what: String| {
            if progress.is_shown() {
                say!("{label:>14}  {what}");
            }
        };
        if !self.resume {
            let held = match checkpoint.held()? {
                Held::Nothing => None,
                Held::This => Some("an unfinished bake; --resume would go on with it"),
                Held::Another => Some("an unfinished bake of other settings, which this one will replace"),
                Held::AnotherVersion => Some("an unfinished bake of another version, which this one will replace"),
                Held::Damage => Some("nothing that can be resumed; this bake will replace it"),
            };
            if let Some(what) = held {
                say("note", format!("{} holds {what}", path.display()));
            }
            return Ok(());
        }
        if checkpoint.resume()? {
            say("resumed", format!("{} finished blocks from {}", checkpoint.blocks(), path.display()));
            if checkpoint.damaged() > 0 {
                say!(
                    "warning: the last {} bytes of {} are damaged; what they held is computed again",
                    checkpoint.damaged(),
                    path.display()
                );
            }
        } else {
            say("resumed", format!("nothing: there is no {}; starting from the beginning", path.display()));
        }
        Ok(())
    }
}

/// What a bake finds when it begins.
enum Begun {
    /// The output, made before: its report.
    Whole(serde_json::Value),
    /// What was kept of it, or nothing.
    At(Checkpoint),
}

/// The share of indirect light that may be missing without a word: five times what sweeps settle for.
const UNSETTLED: f64 = 0.02;

fn warn_of_unsettled(reports: &[BakeReport]) {
    if let Some(r) = reports.iter().find(|r| r.unsettled > UNSETTLED) {
        say!(
            "warning: light has not settled in {} bounces: {:.0} % of what is reflected may be missing; use --engine photon, \
             or smaller albedos",
            r.sweep_bounces,
            100.0 * r.unsettled
        );
    }
}

/// Saves what is finished and says so, unless the same command would fail with the same `error` again.
fn keep(checkpoint: &Checkpoint, error: &Error) {
    // Files could be read and written before the work: if they no longer can, that may pass.
    if matches!(error, Error::Invalid(_) | Error::NotSupported(_)) {
        return checkpoint.discard();
    }
    match checkpoint.save() {
        Ok(true) => {
            say!("progress is kept in {}; the same command with --resume goes on", checkpoint.path().display())
        }
        Ok(false) => {}
        Err(e) => say!("warning: the last progress could not be kept: {e}"),
    }
}

/// A number of bytes with an optional K, M, G or T (powers of 1024).
fn bytes(text: &str) -> std::result::Result<u64, String> {
    let upper = text.to_ascii_uppercase();
    let upper = upper.strip_suffix('B').unwrap_or(&upper);
    let upper = upper.strip_suffix('I').unwrap_or(upper);
    let (number, shift) = match upper.chars().last() {
        Some('K') => (&upper[..upper.len() - 1], 10),
        Some('M') => (&upper[..upper.len() - 1], 20),
        Some('G') => (&upper[..upper.len() - 1], 30),
        Some('T') => (&upper[..upper.len() - 1], 40),
        _ => (upper, 0),
    };
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "positive and below 2⁶⁴ by the check")]
    match number.trim().parse::<f64>() {
        Ok(n) if n > 0.0 && n < 2f64.powi(63 - shift) => Ok((n * 2f64.powi(shift)) as u64),
        _ => Err(format!("'{text}' is no size; write bytes, or a number with K, M, G or T, such as 8G")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units() {
        for (text, n) in
            [("1000", 1000), ("8G", 8 << 30), ("1.5k", 1536), ("500M", 500 << 20), ("2GiB", 2 << 30), ("1tb", 1 << 40)]
        {
            assert_eq!(bytes(text), Ok(n), "{text}");
        }
        for bad in ["", "G", "-1G", "x", "1e30", "nan", "0"] {
            assert!(bytes(bad).is_err(), "{bad}");
        }
    }
}
