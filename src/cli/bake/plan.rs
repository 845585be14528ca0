//! What a bake is to do, settled and checked before its work.

use super::warnings::warnings;
use crate::bake::{BakeOptions, BakeSettings, Engine, MemoryEstimate, TimeEstimate, supported};
use crate::cli::device;
use crate::embree::Device;
use crate::error::Result;
use crate::isa::Isa;
use crate::progress::{Progress, say};
use crate::scene::Scene;
use crate::scene_file::Loaded;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A scene, how it is baked, and what that takes.
pub(super) struct Plan {
    pub(super) loaded: Loaded,
    pub(super) settings: BakeSettings,
    pub(super) device: Device,
    /// What flags and scene file asked for.
    options: BakeOptions,
    memory: MemoryEstimate,
}

impl Plan {
    /// Decides how `loaded` is baked: by `flags`, and by its scene file where they leave something open. If it is to
    /// take `most` bytes, isovalues are cut into bands, and photons serve where sweeps need more unless the engine was
    /// named.
    ///
    /// # Errors
    /// `Invalid` for options that contradict each other or the scene, and if it needs more than `most`; `NotSupported`
    /// for what the engine cannot light; `Embree`.
    pub(super) fn new(
        loaded: Loaded,
        input: &Path,
        flags: &BakeOptions,
        most: Option<u64>,
        progress: Progress,
    ) -> Result<Self> {
        let options = flags.clone().or(&loaded.bake);
        let settings = BakeSettings::new(&options, &loaded.scene).map_err(|e| loaded.blame_bake(flags, e))?;
        supported(&loaded.scene, &settings).map_err(|e| e.in_file(input))?;
        if progress.is_shown() {
            introduce(&loaded.scene, input);
        }
        let device = device()?;
        let (settings, memory) = fit(&loaded, &options, settings, &device, most)?;
        Ok(Self { loaded, settings, device, options, memory })
    }

    pub(super) fn scene(&self) -> &Scene {
        &self.loaded.scene
    }

    /// Refuses a bake of several times this machine's memory.
    ///
    /// # Errors
    /// `Invalid` with both.
    pub(super) fn check_machine(&self) -> Result<()> {
        self.memory.check_machine(self.settings.engine)
    }

    /// Prints what a user may not expect, but for what has been `said`; of one `frame` of many, perhaps.
    ///
    /// # Errors
    /// As [`warnings`].
    pub(super) fn warn(&self, said: &mut BTreeSet<String>, frame: bool) -> Result<()> {
        for warning in warnings(&self.loaded, &self.options, &self.settings, frame)? {
            if said.insert(warning.clone()) {
                say!("warning: {warning}");
            }
        }
        Ok(())
    }

    /// Says by what engine it is done, and in what memory.
    pub(super) fn announce(&self) {
        let engine = match self.settings.engine {
            Engine::Sweep => "sweep: every isovalue at once",
            Engine::Photon => "photon: exact rays",
        };
        say!("{:>14}  {engine}", "engine");
        say!("{:>14}  {}", "memory", self.memory);
        if self.settings.bands > 1 {
            say!("{:>14}  {} of isovalues, one after another", "bands", self.settings.bands);
        }
    }

    /// What a dry run prints: memory, and time, of which a small part is tried.
    ///
    /// # Errors
    /// As [`TimeEstimate::new`].
    pub(super) fn estimates(&self) -> Result<serde_json::Value> {
        let time = TimeEstimate::new(self.scene(), &self.settings, &self.device)?;
        say!("{:>14}  {time}", "time");
        Ok(serde_json::json!({
            "settings": self.settings,
            "bytes": self.memory.stages.iter().copied().collect::<BTreeMap<_, _>>(),
            "peak_bytes": self.memory.peak(),
            "seconds": time.stages.iter().copied().collect::<BTreeMap<_, _>>(),
            "total_seconds": time.total(),
        }))
    }
}

/// Says of each volume what it is.
fn introduce(scene: &Scene, input: &Path) {
    let members = scene.members();
    for member in &members {
        let ([nx, ny, nz], sweep) = (member.field.lattice().dims(), member.field.sweep());
        say!(
            "{}{}: {nx}×{ny}×{nz}, isovalues {sweep}, {} luminaire(s), {} threads, {}",
            input.display(),
            if members.len() > 1 { format!(" '{}'", member.name) } else { String::new() },
            scene.luminaires().len(),
            rayon::current_num_threads(),
            Isa::current().name()
        );
    }
}

/// The settings that fit into `most` bytes, with their estimate.
fn fit(
    loaded: &Loaded,
    options: &BakeOptions,
    settings: BakeSettings,
    device: &Device,
    most: Option<u64>,
) -> Result<(BakeSettings, MemoryEstimate)> {
    let (scene, volumes) = (&loaded.scene, loaded.volumes());
    let Some(most) = most else {
        let memory = MemoryEstimate::new(scene, &volumes, &settings, device)?;
        return Ok((settings, memory));
    };
    let within = |settings: BakeSettings| -> Result<_> {
        let (bands, memory) = MemoryEstimate::within(most, scene, &volumes, &settings, device)?;
        Ok((BakeSettings { bands, ..settings }, memory))
    };
    let mut fitted = within(settings)?;
    let (settings, memory) = &fitted;
    if memory.peak() > most && settings.engine == Engine::Sweep && options.leaves_engine() {
        let photon = BakeSettings::with_engine(options, Engine::Photon)?;
        let photon = within(BakeSettings { grid: settings.grid, ..photon })?;
        // If neither fits, the one that needs less is worth hearing of.
        if photon.1.peak() < memory.peak() {
            fitted = photon;
        }
    }
    let (settings, memory) = &fitted;
    memory.check(most, settings.engine, settings.bands)?;
    Ok(fitted)
}
