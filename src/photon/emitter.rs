//! What emits photons: luminaires, and level sets.

use super::PhotonSettings;
use crate::cell::Cell;
use crate::field::Field;
use crate::flattened::{Departure, Side};
use crate::rng::{Rng, Sobol, Stage};
use crate::scene::Scene;
use crate::warp::{Frame, cosine_hemisphere};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;

/// One source of photons with its total power × isovalue per channel.
enum Source<'a> {
    /// A luminaire, by polygon number.
    Luminaire(u32, DVec3),
    /// The emitting level sets of a field.
    Field(Emitting<'a>, DVec3),
}

impl Source<'_> {
    fn power(&self) -> DVec3 {
        match self {
            Source::Luminaire(_, p) | Source::Field(_, p) => *p,
        }
    }
}

/// The level sets of a field, as what emits.
struct Emitting<'a> {
    /// Its number.
    number: usize,
    field: &'a Field,
    /// The cells that the sweep passes, however small its part of them: places all over Ω would find few.
    cells: Vec<usize>,
    /// What a photon's place counts for, in the mean.
    mean: f64,
}

/// Places that tell [`Emitting::mean`], which only balances sources: the first number of them that finds any.
const PILOTS: [u32; 2] = [1 << 12, 1 << 20];

impl<'a> Emitting<'a> {
    fn new(number: usize, field: &'a Field) -> Self {
        let mut this = Self { number, field, cells: field.cells_on_sweep(), mean: 0.0 };
        let set = Sobol::set(0, Stage::Photon, 0);
        let sum = |pilots| (0..pilots).filter_map(|i| this.place(&set, i)).map(|(_, weight)| weight).sum::<f64>();
        let mut means = PILOTS.into_iter().map(|pilots| sum(pilots) / f64::from(pilots));
        this.mean = means.find(|mean| *mean > 0.0).unwrap_or(0.0);
        this
    }

    /// A place on a level set of the sweep and what it counts for: the |∇h| there times the share of a line through its
    /// cell that is in the sweep. Even over that; the line runs along the axis that h changes along most at the cell's
    /// middle. `None` where the line misses the sweep.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a cell of the list")]
    fn place(&self, set: &Sobol, i: u32) -> Option<(DVec3, f64)> {
        let number = (set.coordinate(i, 0) * self.cells.len() as f64) as usize;
        let corner = self.field.cell_corner(*self.cells.get(number)?);
        let cell = Cell { s: self.field.corners(corner) };
        let middle = DVec3::splat(0.5);
        let rise = DVec3::AXES.map(|axis| cell.slope(middle, axis).abs());
        let axis = (0..3).max_by(|&a, &b| rise[a].total_cmp(&rise[b]))?;
        let [v, w] = set.point2(i, 1);
        let mut p = DVec3::ZERO;
        (p[(axis + 1) % 3], p[(axis + 2) % 3]) = (v, w);
        // Along an axis h is linear.
        let h0 = cell.value(p);
        let rise = cell.value(p + DVec3::AXES[axis]) - h0;
        let [from, to] = match rise == 0.0 {
            true if (0.0..=1.0).contains(&h0) => [0.0, 1.0],
            true => return None,
            false => {
                let [a, b] = [-h0 / rise, (1.0 - h0) / rise].map(|t| t.clamp(0.0, 1.0));
                [a.min(b), a.max(b)]
            }
        };
        // NaN: samples are missing.
        if !(to > from) {
            return None;
        }
        p[axis] = from + (to - from) * set.coordinate(i, 6);
        let p = DVec3::from_array(corner.map(|i| i as f64)) + p;
        Some((p, self.field.gradient(p).length() * (to - from)))
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
fn sources(scene: &Scene) -> Vec<Source<'_>> {
    let mut sources: Vec<Source> =
        (0..).zip(scene.luminaires()).map(|(l, p)| Source::Luminaire(l, PI * p.area() * p.emission)).collect();
    let own = (scene.number(), &*scene.field, scene.surface.emission);
    let others = scene.companions().iter().map(|c| (c.number, &*c.member.field, c.member.surface.emission));
    let mut fields: Vec<_> =
        std::iter::once(own).chain(others).filter(|(.., emission)| *emission != DVec3::ZERO).collect();
    fields.sort_by_key(|(number, ..)| *number);
    for (number, field, emission) in fields {
        // Both sides emit π L_e |∇h| per volume.
        let emitting = Emitting::new(number, field);
        let volume = field.lattice().cell_volume() * emitting.cells.len() as f64;
        let power = 2.0 * PI * emission * volume * emitting.mean;
        if power != DVec3::ZERO {
            sources.push(Source::Field(emitting, power));
        }
    }
    sources
}

/// Emits the photons of a scene.
pub(super) struct Emitter<'a> {
    pub scene: &'a Scene,
    pub settings: &'a PhotonSettings,
    sources: Vec<Source<'a>>,
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
            Source::Field(ref emitting, _) => {
                // Half of the photons leave into each side; the low bits of an independent stream decide.
                let lower = Rng::stream(self.settings.seed, Stage::Photon, !index).bits() & 1 == 0;
                self.by_field(emitting, if lower { Side::Lower } else { Side::Higher }, &drawn)
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

    /// From `side` of the level sets of a field; `None` where they have no normal.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; companions are few")]
    fn by_field(&self, emitting: &Emitting, side: Side, drawn: &Drawn) -> Option<Flight> {
        let &Drawn { ref set, i, direction, power } = drawn;
        let Emitting { number, field, mean, .. } = *emitting;
        // By the field's own lattice, from whatever field the scene is seen.
        let companion = self.scene.companions().iter().position(|c| c.number == number);
        let (place, weight) = emitting.place(set, i)?;
        // On a plateau beside a slope there is a normal, and nothing to emit.
        if weight == 0.0 {
            return None;
        }
        let origin = place.as_vec3();
        let falling = field.falling_normal(origin.as_dvec3())?;
        let normal = side.facing(falling);
        // In f32 the place may have left a thin sweep.
        let isovalue = field.value(origin.as_dvec3()).clamp(0.0, 1.0) as f32;
        let (origin, departure) = match companion {
            Some(n) => {
                let place = self.scene.companions()[n].to_local(origin.as_dvec3());
                (place.as_vec3(), Departure::Companion(n as u8, side))
            }
            None => (origin, Departure::Surface(side)),
        };
        Some(Flight {
            origin,
            direction: Frame::new(normal).to_world(direction),
            isovalue,
            departure,
            power: power * (weight / mean),
            bounces: 1,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::volume::{Lattice, Samples, Volume};

    /// Spheres: ∫ |∇h| dV is their area however thin the sweep is, and about as many places are found on them.
    #[test]
    fn sweeps_of_any_width_are_found_and_weighed() {
        let lattice = Lattice::aligned([24; 3], DVec3::ZERO, DVec3::splat(1.0 / 23.0)).unwrap();
        let at = |o: usize| lattice.to_world(lattice.point(o));
        let samples = (0..lattice.len()).map(|o| at(o).distance(DVec3::splat(0.5)) as f32).collect();
        let volume = Volume::new("distance", lattice.clone(), Samples::F32(samples)).unwrap();
        for width in [0.1, 1e-2, 1e-4, 1e-5] {
            let sweep = Sweep::new(0.35, 0.35 + width).unwrap();
            let field = Field::new(&volume, sweep).unwrap();
            let emitting = Emitting::new(0, &field);
            let set = Sobol::set(7, Stage::Test, 0);
            let found: Vec<(DVec3, f64)> = (0..1 << 16).filter_map(|i| emitting.place(&set, i)).collect();
            let volume = lattice.cell_volume() * emitting.cells.len() as f64 / 65536.0;
            let area = volume * found.iter().map(|f| f.1).sum::<f64>();
            let (r0, r1) = (0.35f64, 0.35 + width);
            let mean = 4.0 * PI * (r1.powi(3) - r0.powi(3)) / (3.0 * width);
            println!("{width}: {} of 65536 places, area {area}, of spheres {mean}", found.len());
            assert!((area / mean - 1.0).abs() < 0.015, "{width}: {area} {mean}");
            assert!((emitting.mean * 65536.0 * volume / area - 1.0).abs() < 0.05, "pilots");
            assert!(found.len() > 65536 * 2 / 5, "{width}: {} places", found.len());
            let off = found.iter().map(|(p, _)| field.value(*p)).filter(|h| !(-1e-6..=1.0 + 1e-6).contains(h)).count();
            assert_eq!(off, 0);
        }
    }

    /// Where the background has the isovalue that the sweep begins with, and only few cells hold level sets.
    #[test]
    fn a_background_at_the_sweeps_end_does_not_emit() {
        let n = 96;
        let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let ball = |o: usize| (2.0 - lattice.point(o).distance(DVec3::splat(7.0))).max(0.0) as f32;
        let samples = (0..lattice.len()).map(ball).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 2.0);
        let emitting = Emitting::new(0, &field);
        assert!((20..200).contains(&emitting.cells.len()), "{} cells", emitting.cells.len());
        let set = Sobol::set(7, Stage::Test, 0);
        let found = (0..4096).filter_map(|i| emitting.place(&set, i)).count();
        assert!(emitting.mean > 0.0 && found > 4096 / 4, "{} {found}", emitting.mean);
    }
}
