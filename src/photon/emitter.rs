//! What emits photons: luminaires, and level sets.

use super::PhotonSettings;
use crate::flattened::{Departure, Side};
use crate::rng::{Rng, Sobol, Stage};
use crate::scene::Scene;
use crate::warp::{Frame, cosine_hemisphere};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;

/// One source of photons with its total power × isovalue per channel.
enum Source {
    /// A luminaire, by polygon number.
    Luminaire(u32, DVec3),
    /// The emitting level sets of a field, by its number.
    Field(usize, DVec3),
}

impl Source {
    fn power(&self) -> DVec3 {
        match self {
            Source::Luminaire(_, p) | Source::Field(_, p) => *p,
        }
    }
}

/// A photon about to fly.
pub(super) struct Flight {
    pub origin: Vec3,
    pub direction: DVec3,
    pub isovalue: f32,
    pub departure: Departure,
    pub power: DVec3,
    /// What the first landing counts as.
    pub bounces: u16,
}

/// Luminaires at flux Φ = π L_e A per hyperplane (times the sweep's length 1), and the level sets if they emit.
fn sources(scene: &Scene) -> Vec<Source> {
    let mut sources: Vec<Source> =
        (0..).zip(scene.luminaires()).map(|(l, p)| Source::Luminaire(l, PI * p.area() * p.emission)).collect();
    for (number, member) in scene.members().iter().enumerate().filter(|(_, m)| m.surface.emission != DVec3::ZERO) {
        // Both sides emit π L_e |∇h| per volume; |∇h| multiplies the single photon. The mean slope of the sweep across
        // Ω's diagonal only balances this source against luminaires.
        let lattice = member.field.lattice();
        let diagonal = lattice.diagonal();
        sources.push(Source::Field(number, 2.0 * PI * member.surface.emission * lattice.world_volume() / diagonal));
    }
    sources
}

/// Emits the photons of a scene.
pub(super) struct Emitter<'a> {
    pub scene: &'a Scene,
    pub settings: &'a PhotonSettings,
    sources: Vec<Source>,
    /// [`total`] of them.
    power: f64,
}

/// What is drawn for a photon: the point `i` of `set`, the direction in the frame of the normal that it leaves along,
/// and the power of as much of its source as it stands for.
struct Drawn {
    set: Sobol,
    i: u32,
    direction: DVec3,
    power: DVec3,
}

/// Power of all sources, by their brightest channel.
fn total(sources: &[Source]) -> f64 {
    sources.iter().map(|s| s.power().max_element()).sum()
}

/// Power of one of `count` photons, by its brightest channel.
pub(super) fn power_of_one(scene: &Scene, count: u64) -> f64 {
    total(&sources(scene)) / count.max(1) as f64
}

impl<'a> Emitter<'a> {
    pub(super) fn new(scene: &'a Scene, settings: &'a PhotonSettings) -> Self {
        let sources = sources(scene);
        let power = total(&sources);
        Self { scene, settings, sources, power }
    }

    /// Whether there is anything to emit.
    pub(super) fn shines(&self) -> bool {
        self.power > 0.0
    }

    /// Photon `index`: source by power, point uniform over the area, direction by the cosine, isovalue along the
    /// axis. All from one scrambled Sobol point, so that any power-of-two prefix is stratified in isovalue, source,
    /// place and direction.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; indices below 2³²")]
    pub(super) fn emit(&self, index: u64) -> Option<Flight> {
        let set = Sobol::set(self.settings.seed, Stage::Photon, index >> 32);
        let i = index as u32;
        let mut pick = set.coordinate(i, 5) * self.power;
        let last = self.sources.len() - 1;
        let source = self
            .sources
            .iter()
            .enumerate()
            .find(|(k, s)| {
                pick -= s.power().max_element();
                pick < 0.0 || *k == last
            })
            .map(|(_, s)| s)?;
        let probability = source.power().max_element() / self.power;
        let power = source.power() / (probability * self.settings.count as f64);
        let drawn = Drawn { direction: cosine_hemisphere(set.point2(i, 3)), set, i, power };
        match *source {
            Source::Luminaire(id, _) => Some(self.by_luminaire(id, &drawn)),
            Source::Field(number, _) => {
                // Half of the photons leave into each side; the low bits of an independent stream decide.
                let lower = Rng::stream(self.settings.seed, Stage::Photon, !index).bits() & 1 == 0;
                self.by_field(number, if lower { Side::Lower } else { Side::Higher }, &drawn)
            }
        }
    }

    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn by_luminaire(&self, id: u32, &Drawn { ref set, i, direction, power }: &Drawn) -> Flight {
        let drawn = || self.settings.axis.isovalue(set.coordinate(i, 0)) as f32;
        let isovalue = self.settings.fixed_isovalue.unwrap_or_else(drawn);
        let density = if self.settings.fixed_isovalue.is_none() { self.settings.axis.density(isovalue) } else { 1.0 };
        let p = &self.scene.polygons()[id as usize];
        let y = p.sample(set.point2(i, 1));
        Flight {
            origin: self.scene.lattice().to_index(y).as_vec3(),
            direction: Frame::new(p.normal()).to_world(direction),
            isovalue,
            departure: Departure::Polygon(id),
            power: power / f64::from(density),
            bounces: 0,
        }
    }

    /// From `side` of the level sets of field `number`; `None` where they are outside the sweep, or have no normal.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; companions are few")]
    fn by_field(&self, number: usize, side: Side, &Drawn { ref set, i, direction, power }: &Drawn) -> Option<Flight> {
        // By the field's own lattice, from whatever field the scene is seen.
        let companion = self.scene.companions().iter().position(|c| c.number == number);
        let other = companion.map(|n| &self.scene.companions()[n]);
        let field = other.map_or(&self.scene.field, |c| &c.member.field);
        let lattice = field.lattice();
        let [v, w] = set.point2(i, 1);
        let origin = (lattice.far() * DVec3::new(set.coordinate(i, 0), v, w)).as_vec3();
        let h = field.value(origin.as_dvec3());
        if !(0.0..=1.0).contains(&h) {
            return None;
        }
        let falling = field.falling_normal(origin.as_dvec3())?;
        let normal = side.facing(falling);
        let diagonal = lattice.diagonal();
        // On a plateau beside a slope there is a normal, and nothing to emit.
        let power = power * field.gradient(origin.as_dvec3()).length() * diagonal;
        if power == DVec3::ZERO {
            return None;
        }
        let (origin, departure) = match (companion, other) {
            (Some(n), Some(c)) => (c.to_local(origin.as_dvec3()).as_vec3(), Departure::Companion(n as u8, side)),
            _ => (origin, Departure::Surface(side)),
        };
        Some(Flight {
            origin,
            direction: Frame::new(normal).to_world(direction),
            isovalue: h as f32,
            departure,
            power,
            bounces: 1,
        })
    }
}
