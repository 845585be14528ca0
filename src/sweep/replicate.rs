//! The passes of one replicate: few directions until light has settled, then more.

use super::flats::Flats;
use super::gather::Pass;
use super::planes::{NodeLight, Planes};
use super::reflect::Reflected;
use super::settling::Settling;
use super::state::{Passes, State};
use super::{Run, SweepSettings, directions};
use std::sync::Mutex;

/// Passes with few directions take this share of the full number.
const COARSE: usize = 8;
/// Fewest directions of a coarse pass.
const LEAST: usize = 16;
/// Passes after the light has settled, each with twice the directions of the one before. The last one counts: one set of
/// twice the directions errs less than the mean of two.
const LATE: usize = 2;
/// Coarse passes until light has settled, as a rule; only estimates of time rely on it.
const SETTLING: usize = 8;
impl SweepSettings {
    /// Directions of all passes together, if light settles as fast as it does as a rule.
    pub(crate) fn expected_directions(&self) -> usize {
        let replicates = self.replicates.max(1);
        if !self.settles() {
            return replicates * self.max_bounces * self.directions;
        }
        let coarse = (self.directions / COARSE).max(LEAST).min(self.directions);
        let late = (0..LATE).map(|n| self.directions >> n).sum::<usize>();
        SETTLING * coarse + late + (replicates - 1) * self.directions
    }

    /// Whether bounces go on until what is left out is small, not to a small number.
    fn settles(&self) -> bool {
        self.max_bounces >= 6
    }
}

impl Run<'_> {
    /// What nodes and flats reflect before the first pass of a replicate.
    fn begin(&self, state: &State, flats: &mut Flats) -> Passes {
        let late = if self.warm(state) { LATE - 1 } else { 0 };
        let direct = (NodeLight::Half(&state.total.direct), 1.0);
        let (light, sums) = if late > 0 {
            let share = 1.0 / state.done as f32;
            flats.take(&state.flats, share);
            let light = (NodeLight::Half(&state.total.light), share);
            self.mirror.reflect(flats, &[direct, light], Reflected::default(), None)
        } else {
            flats.reflect_direct();
            self.mirror.reflect(flats, &[direct], Reflected::default(), None)
        };
        Passes { light, before: Reflected::default(), settling: Settling::new(sums.light), late, bounce: 0 }
    }

    /// Whether a replicate starts from the light of those before instead of from luminaires alone: then its last pass is all
    /// it needs. What replicates share in this way are the bounces before their last, which the last one averages over the
    /// sphere.
    fn warm(&self, state: &State) -> bool {
        state.done > 0 && self.settings.settles() && state.total.sides().len() == self.sides.len()
    }

    /// Bounces: coarse passes until what is missing is known and small, then finer ones. Goes on behind the passes of `from`, whose
    /// light the flats hold. Returns the indirect irradiance per side, and false if `progress` stopped it.
    pub(super) fn replicate(
        &self,
        state: &mut State,
        from: Option<Passes>,
        flats: &mut Flats,
        progress: &dyn Fn(f64) -> bool,
    ) -> (Vec<Planes>, bool) {
        let s = self.settings;
        let number = state.done as u64;
        if from.is_none() && self.saved.due() {
            self.saved.save(0, || state.bytes(None, flats));
        }
        if let Some(passes) = &from {
            flats.pack(passes.light.unit);
        }
        let mut now = from.unwrap_or_else(|| self.begin(state, flats));
        let mut indirect = Vec::new();
        let pass = Pass {
            scene: self.scene,
            geometry: self.geometry,
            standing: self.slits.standing(),
            primary: self.sides[0],
            isa: self.isa,
            spare: self.spare,
            workspaces: Mutex::default(),
        };
        let fixed = !self.settings.settles();
        while now.bounce < s.max_bounces {
            if self.saved.due() {
                self.saved.save(0, || state.bytes(Some(&now), flats));
            }
            let settled = now.late > 0 || now.settling.missing(LATE).is_some_and(|m| m < s.target);
            let bounce = now.bounce + 1;
            let late = settled || bounce + LATE > s.max_bounces;
            let directions = match () {
                () if fixed => s.directions,
                () if late => s.directions >> (LATE - 1 - now.late),
                () => (s.directions / COARSE).max(LEAST),
            };
            let directions = directions.max(LEAST).min(s.directions);
            // Coarse passes share their directions: then nothing but bounces changes the mean from one to the next. What
            // counts are parts of one set, a part per replicate.
            let (set, part) = match () {
                () if fixed => (bounce as u64, (state.done, s.replicates.max(1))),
                () if late => ((LATE - now.late) as u64, (state.done, s.replicates.max(1))),
                () => (1 << 32 | number, (0, 1)),
            };
            let lines = directions::lines(self.scene.lattice(), (s.seed, set), directions, part);
            let mut incoming = flats.open();
            let mut family = 0;
            let more = if now.late + 1 == LATE { 0.0 } else { 3.0 };
            let total = lines.len() * self.sides.len();
            let mut ask = || {
                family += 1;
                let passes = bounce as f64 - 1.0 + f64::from(family) / total as f64;
                progress(passes / (bounce as f64 + more))
            };
            let mut stopped = false;
            for (&side, b) in self.sides.iter().zip(&now.light.b) {
                let (e, complete) = pass.gather(side, &lines, b, now.light.unit, flats, &mut incoming, &mut ask);
                stopped |= !complete;
                indirect.push(e);
            }
            if stopped {
                // Half a pass is not kept, and may be as large as what is.
                self.spare.keep(indirect.drain(..).flatten());
                self.saved.save(0, || state.bytes(Some(&now), flats));
                state.see(&now);
                return (Vec::new(), false);
            }
            flats.close(&incoming);
            now.bounce = bounce;
            state.counts.families += total as u64;
            state.counts.gather_rays += state.counts.valid * total as u64;
            now.late += usize::from(late && !fixed);
            let settles = !fixed && !late;
            let omega = now.settling.omega();
            if settles {
                flats.settle(omega);
            } else {
                now.settling.since += 1;
                flats.reflect(true);
            }
            if now.late == LATE || bounce == s.max_bounces {
                break;
            }
            let light = [(NodeLight::Half(&state.total.direct), 1.0), (NodeLight::Full(&indirect), 1.0)];
            if settles {
                let memory = std::mem::take(&mut now.before);
                let (reflected, sums) = self.mirror.reflect(flats, &light, memory, Some((&now.light, omega)));
                now.before = std::mem::replace(&mut now.light, reflected);
                now.settling.push(sums);
            } else {
                now.before = Reflected::default();
                let memory = std::mem::take(&mut now.light);
                now.light = self.mirror.reflect(flats, &light, memory, None).0;
            }
            self.spare.keep(indirect.drain(..).flatten());
        }
        state.see(&now);
        (indirect, true)
    }
}
