//! The passes of one replicate: few directions until light has settled, then more.
//!
//! In bright closed rooms that is not enough. What few directions bring too much, by a share δ, each bounce brings
//! again: the level of the light is off by δ / (1 − r), of which r² are left after two later passes. There the defect
//! of few directions is corrected \[Stetter78\]: x₁ being the light, it settles again as x = D + (T − T₁) x₁ + T₁ x,
//! where T₁ is a pass with few directions and T one with all that the replicates' last passes have together. What is
//! off then is of second order: (1 − T₁)⁻¹ (T − T₁) (x₁ − x).

use super::directions::{self, Shear};
use super::faces::FaceWalls;
use super::flats::Flats;
use super::gather::{Bounce, Pass};
use super::planes::{HalfPlanes, NodeLight, Planes};
use super::reflect::{Reflected, SHARPENING};
use super::settling::{Settling, Sums};
use super::state::{Passes, State};
use super::{Run, SweepSettings};
use crate::flat;
use crate::rng::Stage;
use crate::scene::Scene;
use std::sync::Mutex;

/// Passes with few directions take this share of the full number.
const COARSE: usize = 8;
/// Fewest directions of a coarse pass.
const LEAST: usize = 16;
/// Passes after the light has settled, each with twice the directions of the one before. The last one counts: one set
/// of twice the directions errs less than the mean of two.
const LATE: usize = 2;
/// Coarse passes until light has settled, as a rule; only estimates of time rely on it.
const SETTLING: usize = 8;
/// The level of light is corrected where r is greater, and some albedo.
const BRIGHT: f64 = 0.78;
/// So many times the target may be missing before.
const EARLY: f64 = 8.0;
/// Bounces that must be allowed for it.
const ROOM: usize = 32;

/// What a pass is for.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    /// One of a number of bounces that is given.
    Given,
    /// Few directions, until light has settled.
    Coarse,
    /// Few directions and all, whose difference corrects the level.
    Level,
    /// More directions, after light has settled.
    Late,
}

/// Whether anything reflects so much that the level of light is corrected, should light settle as slowly.
pub(crate) fn bright(scene: &Scene) -> bool {
    let flats = (0..flat::count(scene)).filter_map(|number| flat::flat(scene, number));
    let flats = flats.map(|flat| flat.albedo.greatest().max_element());
    flats.fold(scene.surface.albedo.greatest().max_element(), f64::max) > BRIGHT
}

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

    /// The passes that take them.
    pub(crate) fn expected_passes(&self) -> usize {
        let replicates = self.replicates.max(1);
        if self.settles() { SETTLING + LATE + replicates - 1 } else { replicates * self.max_bounces }
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
        let (light, mut sums) = if late > 0 {
            let share = 1.0 / state.done() as f32;
            flats.take(&state.flats, share);
            let light = (NodeLight::Half(&state.total.light), share);
            self.reflected(flats, &[direct, light], Reflected::default(), None, SHARPENING)
        } else {
            flats.reflect_direct();
            self.reflected(flats, &[direct], Reflected::default(), None, SHARPENING)
        };
        let black = self.black();
        sums.take(&flats.light(black), black);
        Passes {
            light,
            before: Reflected::default(),
            settling: Settling::new(sums.light),
            corrected: false,
            defect: Vec::new(),
            late,
            bounce: 0,
        }
    }

    /// Whether a replicate starts from the light of those before instead of from luminaires alone: then its last pass
    /// is all it needs. What replicates share in this way are the bounces before their last, which the last one
    /// averages over the sphere.
    fn warm(&self, state: &State) -> bool {
        state.done() > 0 && self.settings.settles()
    }

    /// What the next pass is for.
    fn kind(&self, now: &Passes) -> Kind {
        let s = self.settings;
        if !s.settles() {
            return Kind::Given;
        }
        let slow = s.max_bounces >= ROOM && now.settling.slowest() > BRIGHT;
        let level = !now.corrected && slow && bright(self.scene);
        if level && now.late == 1 && now.bounce + 2 * LATE < s.max_bounces {
            return Kind::Level;
        }
        // Light goes on to settle after the level: half of the bounces are left to that, and what is missing before
        // hardly matters.
        let (most, target) = if level { (s.max_bounces / 2, EARLY * s.target) } else { (s.max_bounces, s.target) };
        let more = if now.corrected { 1 } else { LATE };
        let settled = now.settling.missing(more).is_some_and(|m| m < target);
        if now.late > 0 || settled || now.bounce + LATE >= most { Kind::Late } else { Kind::Coarse }
    }

    /// The lines of the next pass, of replicate `number`.
    fn lines(&self, kind: Kind, now: &Passes, number: usize) -> Vec<Shear> {
        let s = self.settings;
        let replicates = s.replicates.max(1);
        let clamped = |directions: usize| directions.max(LEAST).min(s.directions);
        // Coarse passes share their directions: then nothing but bounces changes the mean from one to the next. What
        // counts are parts of one set, a part per replicate.
        let (index, directions, part) = match kind {
            Kind::Given => (now.bounce as u64 + 1, s.directions, (number, replicates)),
            Kind::Coarse => (1 << 32 | number as u64, clamped(s.directions / COARSE), (0, 1)),
            Kind::Level => (1, s.directions * replicates, (0, 1)),
            Kind::Late => {
                ((LATE - now.late) as u64, clamped(s.directions >> (LATE - 1 - now.late)), (number, replicates))
            }
        };
        directions::lines(self.scene.lattice(), Stage::Sweep.key(s.seed, index), directions, part)
    }

    /// Bounces: coarse passes until what is missing is known and small, then finer ones. Goes on behind the passes of
    /// `from`, whose light the flats hold. Returns the indirect irradiance per side; `None` if `progress` stopped it.
    pub(super) fn replicate(
        &self,
        state: &mut State,
        from: Option<Passes>,
        flats: &mut Flats,
        progress: &dyn Fn(f64) -> bool,
    ) -> Option<Vec<Planes>> {
        let s = self.settings;
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
            face_walls: FaceWalls::new(self.scene, self.geometry, flats),
            sides: self.sides,
            isa: self.isa,
            pool: self.pool,
            workspaces: Mutex::default(),
        };
        while now.bounce < s.max_bounces {
            if self.saved.due() {
                self.saved.save(0, || state.bytes(Some(&now), flats));
            }
            match self.pass(&pass, state, &mut now, flats, progress) {
                Some(received) if now.late == LATE || now.bounce == s.max_bounces => {
                    indirect = received;
                    break;
                }
                Some(received) => self.pool.keep(received.into_iter().flatten()),
                None => {
                    self.saved.save(0, || state.bytes(Some(&now), flats));
                    return None;
                }
            }
        }
        state.see(&now);
        Some(indirect)
    }

    /// One pass, and what nodes and flats reflect of it unless it is the last. Returns what nodes received; `None` if
    /// `progress` stopped it: then it can be repeated.
    fn pass(
        &self,
        pass: &Pass,
        state: &mut State,
        now: &mut Passes,
        flats: &mut Flats,
        progress: &dyn Fn(f64) -> bool,
    ) -> Option<Vec<Planes>> {
        let s = self.settings;
        let kind = self.kind(now);
        if kind == Kind::Late && now.corrected {
            now.late = LATE - 1;
            now.defect = Vec::new();
            flats.no_defect();
        }
        let lines = self.lines(kind, now, state.done());
        let few = if kind == Kind::Level { self.lines(Kind::Coarse, now, state.done()) } else { Vec::new() };
        let more = if kind == Kind::Late && now.late + 1 == LATE { 0.0 } else { 3.0 };
        let total = (few.len() + lines.len()) * self.sides.len();
        let bounce = now.bounce + 1;
        let mut family = 0;
        let mut ask = || {
            family += 1;
            let passes = bounce as f64 - 1.0 + f64::from(family) / total as f64;
            progress(passes / (bounce as f64 + more))
        };
        let by_few = if few.is_empty() {
            None
        } else {
            let received = self.bounce(pass, &now.light, (&few, false), flats, &mut ask)?;
            let nodes: Vec<_> = received.iter().map(|e| HalfPlanes::new(e, 1.0, None)).collect();
            self.pool.keep(received.into_iter().flatten());
            Some((nodes, flats.indirect()))
        };
        // What goes on linearly may grow from bounce to bounce where light is rough, and what is nearest cannot: until
        // light has settled, that does.
        let extrapolates = kind != Kind::Coarse;
        let received = self.bounce(pass, &now.light, (&lines, extrapolates), flats, &mut ask)?;
        now.bounce = bounce;
        state.counts.families += total as u64;
        state.counts.gather_rays += state.counts.valid * total as u64;
        if kind == Kind::Level {
            now.settling.again();
        }
        let omega = now.settling.omega();
        let settling = if matches!(kind, Kind::Coarse | Kind::Level) {
            Some((omega, flats.settle(omega, self.black())))
        } else {
            now.late += usize::from(kind == Kind::Late);
            now.settling.since += 1;
            flats.reflect();
            None
        };
        if now.late == LATE || bounce == s.max_bounces {
            return Some(received);
        }
        self.reflect(state, now, flats, &received, settling);
        if let Some((nodes, flats_by_few)) = by_few {
            // (T − T₁) x₁. [Stetter78]
            now.defect = nodes.into_iter().zip(&received).map(|(few, all)| few.short_of(all)).collect();
            flats.correct(flats_by_few);
            (now.corrected, now.late) = (true, 0);
        }
        Some(received)
    }

    /// Irradiance of each side's nodes by one bounce along all `lines`, beyond whose last ones it `extrapolates`
    /// linearly or not; the flats hold what they received. `None` if `ask` stopped it.
    fn bounce(
        &self,
        pass: &Pass,
        light: &Reflected,
        (lines, extrapolates): (&[Shear], bool),
        flats: &mut Flats,
        ask: &mut dyn FnMut() -> bool,
    ) -> Option<Vec<Planes>> {
        let bounce = Bounce { lines, extrapolates, light, flats };
        let mut incoming = flats.open();
        let sides = 0..self.sides.len();
        let received = sides.map(|n| pass.gather(&bounce, n, &mut incoming, ask)).collect::<Option<_>>()?;
        flats.close(&incoming);
        Some(received)
    }

    /// What nodes and flats reflect of direct light and what nodes `received`; while light settles, mixed with the
    /// bounces before by Chebyshev's ω, beside which stands what the pass changed on flats.
    fn reflect(
        &self,
        state: &State,
        now: &mut Passes,
        flats: &mut Flats,
        received: &[Planes],
        settling: Option<([f32; 3], Sums)>,
    ) {
        let mut light = vec![(NodeLight::Half(&state.total.direct), 1.0), (NodeLight::Full(received), 1.0)];
        if !now.defect.is_empty() {
            light.push((NodeLight::Signed(&now.defect), 1.0));
        }
        if let Some((omega, on_flats)) = settling {
            let memory = std::mem::take(&mut now.before);
            // Where light is rough, along few directions, sharpening may make each bounce brighter than the last.
            let sharpening = if now.settling.grows() { 0.0 } else { SHARPENING };
            let relaxed = Some((&now.light, omega));
            let (reflected, mut sums) = self.reflected(flats, &light, memory, relaxed, sharpening);
            sums.take(&on_flats, self.black());
            now.before = std::mem::replace(&mut now.light, reflected);
            now.settling.push(sums);
        } else {
            now.before = Reflected::default();
            let memory = std::mem::take(&mut now.light);
            now.light = self.reflected(flats, &light, memory, None, SHARPENING).0;
        }
    }
}
