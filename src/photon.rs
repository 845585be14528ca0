//! Photons in the flattened scene: emission over luminaires and isovalues, scattering inside one hyperplane, energy
//! kept to the last bit. \[BB09 §2.3; Jensen01\]

mod emitter;

use crate::error::{Error, Result};
use crate::flat;
use crate::flattened::{FlattenedRay, Side, Target};
use crate::isovalue_axis::IsovalueAxis;
use crate::landing::{Landing, MOST_LANDINGS, landing};
use crate::progress::Tick;
use crate::rng::{Rng, Stage};
use crate::scene::Scene;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use emitter::{Emitter, Flight, power_of_one};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::ops::AddAssign;

/// A photon that landed on a level set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePhoton {
    /// Where, in the index space of the field.
    pub position: Vec3,
    /// Height c of its hyperplane, [0, 1].
    pub isovalue: f32,
    /// Power × isovalue per channel, before reflection.
    pub power: Vec3,
    /// Cosine of its arrival to the receiver normal over that to the level set's own, over the share of light from
    /// everywhere that arrives above both, at most 4: times `power` it is what the receiver normal would have taken up.
    /// \[Veach96\]
    pub foreshortening: f32,
    /// The number of the field whose level set it is.
    pub field: u8,
    /// Reflections before this landing, 255 if more: 0 is direct light of a luminaire. Light of emitting level sets
    /// starts at 1, since no receiver counts it apart.
    pub bounces: u8,
    /// The side it landed on.
    pub side: Side,
    /// The [`octant`] of the receiver normal towards falling h; 0 where there is none.
    pub octant: u8,
}

impl SurfacePhoton {
    /// The photon of `flight` at `position` of field number `field`, where its receiver normal towards `side` and its
    /// gradient are these.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; there are few fields")]
    fn landed(
        flight: &Flight,
        bounces: u16,
        (field, side): (usize, Side),
        position: Vec3,
        normal: Option<DVec3>,
        gradient: DVec3,
    ) -> Self {
        let falling = normal.map_or(DVec3::ZERO, |n| side.facing(n));
        Self {
            position,
            isovalue: flight.isovalue,
            power: flight.power.as_vec3(),
            foreshortening: foreshortening(normal, gradient, flight.direction),
            field: field as u8,
            bounces: bounces.min(u16::from(u8::MAX)) as u8,
            side,
            octant: octant(falling.as_vec3()),
        }
    }
}

/// The octant of a direction: a bit per negative coordinate, x lowest.
#[inline]
pub fn octant(n: Vec3) -> u8 {
    n.cmplt(Vec3::ZERO).bitmask() as u8
}

/// A photon that landed on a textured flat: a polygon or a cap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlatPhoton {
    /// Which: polygons first, then six caps of each field.
    pub flat: u32,
    /// Texture coordinates and isovalue, [0, 1]³.
    pub uvc: [f32; 3],
    /// Power × isovalue per channel, before reflection.
    pub power: Vec3,
    /// Reflections before this landing.
    pub bounces: u16,
}

/// Isovalue bins of the energy balance.
pub const ENERGY_BINS: usize = 16;

/// Where emitted power × isovalue went, summed over channels: emitted = absorbed + escaped + terminated.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    /// Emitted.
    pub emitted: f64,
    /// Absorbed by surfaces (roulette losses included).
    pub absorbed: f64,
    /// Left the scene.
    pub escaped: f64,
    /// Cut off by the bounce limit, or landed where ∇h vanishes.
    pub terminated: f64,
}

impl Energy {
    /// |emitted − absorbed − escaped − terminated| / emitted; 0 if nothing was emitted.
    pub fn imbalance(&self) -> f64 {
        if self.emitted == 0.0 {
            return 0.0;
        }
        (self.emitted - self.absorbed - self.escaped - self.terminated).abs() / self.emitted
    }
}

impl AddAssign for Energy {
    fn add_assign(&mut self, o: Self) {
        self.emitted += o.emitted;
        self.absorbed += o.absorbed;
        self.escaped += o.escaped;
        self.terminated += o.terminated;
    }
}

/// What tracing photons gave.
#[derive(Clone, Debug, Default)]
pub struct Photons {
    /// Landings on level sets.
    pub surface: Vec<SurfacePhoton>,
    /// Landings on polygons and caps.
    pub flat: Vec<FlatPhoton>,
    /// Energy per isovalue bin.
    pub energy: [Energy; ENERGY_BINS],
    /// Photons emitted.
    pub emitted: u64,
    /// Rays traced.
    pub rays: u64,
    /// Landings where ∇h vanishes, or where nothing is lit, which ended their paths.
    pub flat_gradient: u64,
}

impl Photons {
    fn append(&mut self, part: &Self) {
        self.surface.extend_from_slice(&part.surface);
        self.flat.extend_from_slice(&part.flat);
        self.emitted += part.emitted;
        self.rays += part.rays;
        self.flat_gradient += part.flat_gradient;
        self.energy.iter_mut().zip(part.energy).for_each(|(a, b)| *a += b);
    }

    /// Keeps what `photon` brings to `target` at local position `x`, but for flats that reflect nothing.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; there are few flats")]
    fn store(
        &mut self,
        scene: &Scene,
        (photon, bounces): (&Flight, u16),
        (target, x): (Target, DVec3),
        landed: Option<&Landing>,
    ) {
        // Where a receiver will look: f32.
        let position = x.as_vec3().as_dvec3();
        let normal = landed.map(|l| l.receiver.normal);
        let (flat, [u, v]) = match target {
            Target::Surface(side) | Target::Companion(_, side) => {
                let at = scene.field_at(target.companion(), position);
                let place = at.place.as_vec3();
                let gradient = at.field.gradient(place.as_dvec3());
                let field = (at.number, side);
                return self.surface.push(SurfacePhoton::landed(photon, bounces, field, place, normal, gradient));
            }
            // The texture of a cap is its outer side's.
            Target::Cap(_, Side::Higher) => return,
            Target::Cap(face, Side::Lower) => (flat::cap(scene, face) as u32, flat::face_texture(scene, face, x)),
            Target::Polygon(_) if landed.is_none_or(|l| l.albedo == DVec3::ZERO) => return,
            Target::Polygon(id) => (id, scene.polygons()[id as usize].texture(scene.lattice().to_world(x))),
        };
        let uvc = [u as f32, v as f32, photon.isovalue];
        self.flat.push(FlatPhoton { flat, uvc, power: photon.power.as_vec3(), bounces });
    }

    /// The energy of all bins.
    pub fn total_energy(&self) -> Energy {
        let mut total = Energy::default();
        self.energy.iter().for_each(|&e| total += e);
        total
    }

    /// Landings of all kinds.
    pub fn stored(&self) -> u64 {
        (self.surface.len() + self.flat.len()) as u64
    }
}

/// How photons are traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotonSettings {
    /// Photons to emit.
    pub count: u64,
    /// Reflections after which a path is cut; `u16::MAX` leaves it to Russian roulette.
    pub max_bounces: u16,
    /// Seed of the run.
    pub seed: u64,
    /// Photons of luminaires are emitted evenly along this axis, each with as much more power as there are fewer.
    pub axis: IsovalueAxis,
    /// Emit the photons of luminaires at this isovalue instead of over the whole sweep: the ordinary 3D photon map of
    /// one level set. Level sets that emit are not for it: theirs come from all of the sweep.
    pub fixed_isovalue: Option<f32>,
}

/// Photons per task: fixed, so that sums are made in the same order on any number of threads.
const CHUNK: u64 = 1 << 14;
/// Chunks whose parts are joined at once.
const ROUND: usize = 32;

/// What power of a photon f32 holds to a hundredth or two, whatever its density in isovalue makes of it.
const POWERS: std::ops::RangeInclusive<f64> = 1e-43..=1e36;

/// Whether f32 holds the power of `count` photons, which is that of lengths squared times emission.
///
/// # Errors
/// `Invalid` if it does not.
pub fn check_power(scene: &Scene, count: u64) -> Result<()> {
    let power = power_of_one(scene, count);
    if power == 0.0 || POWERS.contains(&power) {
        return Ok(());
    }
    Err(Error::Invalid(format!(
        "photons of power {power:.0e} (emission times area) do not fit 32-bit floats; choose another unit of length or \
         of emission"
    )))
}

/// Emits and traces `settings.count` photons. `tick` is called with the number of photons done, from any thread;
/// returning false stops the work early with what is done.
pub fn trace_photons<T: Tracer>(scene: &Scene, tracer: &T, settings: &PhotonSettings, tick: Tick) -> Photons {
    let photons = PhotonTracer { emitter: Emitter::new(scene, settings), tracer };
    if !photons.emitter.shines() || settings.count == 0 {
        return Photons::default();
    }
    let mut all = Photons::default();
    let chunks = settings.count.div_ceil(CHUNK) as usize;
    let trace = |round: usize| -> Vec<Photons> {
        (round.min(chunks)..chunks.min(round + ROUND))
            .into_par_iter()
            .with_max_len(1)
            .map(|chunk| {
                let mut out = Photons::default();
                let range = chunk as u64 * CHUNK..((chunk as u64 + 1) * CHUNK).min(settings.count);
                let n = range.end - range.start;
                if tick(0) {
                    range.for_each(|i| photons.trace(i, &mut out));
                    tick(n);
                }
                out
            })
            .collect()
    };
    // Joined round by round, while the next one is traced: all of it and two rounds' parts are held, never everything
    // twice.
    let mut parts = trace(0);
    for next in (ROUND..chunks + ROUND).step_by(ROUND) {
        let ((), traced) = rayon::join(|| parts.iter().for_each(|part| all.append(part)), || trace(next));
        parts = traced;
    }
    all
}

/// Traces single photons.
struct PhotonTracer<'a, T> {
    emitter: Emitter<'a>,
    tracer: &'a T,
}

impl<T: Tracer> PhotonTracer<'_, T> {
    /// Emits photon `index` and follows it to its end; `out` keeps what it brings where it lands.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "bins of [0, 1]")]
    fn trace(&self, index: u64, out: &mut Photons) {
        let scene = self.emitter.scene;
        let mut rng = Rng::stream(self.emitter.settings.seed, Stage::Photon, index);
        out.emitted += 1;
        let Some(mut photon) = self.emitter.emit(index) else { return };
        let bin = ((photon.isovalue * ENERGY_BINS as f32) as usize).min(ENERGY_BINS - 1);
        out.energy[bin].emitted += photon.power.element_sum();
        let first = photon.bounces;
        for bounces in first..=MOST_LANDINGS {
            let ray = scene.ray(photon.origin, photon.direction, photon.isovalue, photon.departure);
            let ray = FlattenedRay { with_light: true, ..ray };
            out.rays += 1;
            let Some(hit) = self.tracer.intersect(&ray) else {
                out.energy[bin].escaped += photon.power.element_sum();
                return;
            };
            let landed = landing(scene, &ray, hit);
            out.store(scene, (&photon, bounces), (hit.target, ray.at(hit.t)), landed.as_ref());
            let energy = &mut out.energy[bin];
            let Some(Landing { receiver, albedo, .. }) = landed else {
                out.flat_gradient += 1;
                energy.terminated += photon.power.element_sum();
                return;
            };
            // Russian roulette keeps the largest channel's power. [Arvo90]
            let reflected = photon.power * albedo;
            let survival = (reflected.max_element() / photon.power.max_element()).min(1.0);
            if rng.unit() >= survival {
                energy.absorbed += photon.power.element_sum();
                return;
            }
            let next = reflected / survival;
            energy.absorbed += (photon.power - next).element_sum();
            if bounces - first >= self.emitter.settings.max_bounces || bounces == MOST_LANDINGS {
                energy.terminated += next.element_sum();
                return;
            }
            let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
            photon =
                Flight { origin: receiver.position, direction, departure: receiver.departure, power: next, ..photon };
        }
    }
}

/// See [`SurfacePhoton::foreshortening`]; 1 where there is no normal.
///
/// What the receiver normal would take up from below the level set itself never arrives as photons. It is made up for
/// as if light came alike from everywhere, so that this is 1 on average there: the hemispheres of normals at an angle θ
/// share (1 + cos θ)/2 of what either takes up.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn foreshortening(receiver: Option<DVec3>, gradient: DVec3, direction: DVec3) -> f32 {
    let Some(n) = receiver else { return 1.0 };
    let own = gradient.normalize_or_zero();
    let own = if own.dot(direction) > 0.0 { -own } else { own };
    let share = 0.5 * (1.0 + n.dot(own));
    let [receiver, own] = [n, own].map(|n| (-direction.dot(n)).max(0.0));
    // Unbounded it is unbiased, but a grazing photon may weigh as much as all others.
    (receiver / (own * share).max(1e-6)).min(4.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flattened::Departure;
    use crate::rng::Sobol;
    use crate::warp::{Frame, cosine_hemisphere};

    /// Light from everywhere, as an inclined receiver normal takes it up. With σ = (1 + cos θ)/2, the bound at 4 costs
    /// (1/π) ∫ dφ (sin θ cos φ/σ)²/(8 − 2 cos θ/σ) = sin²θ/(16σ² − 4σ cos θ) over the φ that face it.
    #[test]
    fn even_light_is_taken_up_whole_by_inclined_normals() {
        let own = DVec3::new(0.3, -0.2, 0.9).normalize();
        let frame = Frame::new(own);
        for angle in [0.0f64, 0.2, 0.5] {
            let receiver = frame.to_world(DVec3::new(angle.sin(), 0.0, angle.cos()));
            let set = Sobol::set(1, Stage::Test, 0);
            let count = 1 << 16;
            let mean = (0..count)
                .map(|i| frame.to_world(cosine_hemisphere(set.point2(i, 0))))
                .map(|d| f64::from(foreshortening(Some(receiver), -3.0 * own, -d)))
                .sum::<f64>()
                / f64::from(count);
            let share = 0.5 * (1.0 + angle.cos());
            let expected = 1.0 - angle.sin().powi(2) / (16.0 * share * share - 4.0 * share * angle.cos());
            assert!((mean - expected).abs() < 5e-4, "{angle}: {mean}, {expected}");
        }
    }

    /// A photon of many reflections is no first landing.
    #[test]
    fn bounces_are_counted_up_to_255() {
        let flight = Flight {
            origin: Vec3::ZERO,
            direction: DVec3::NEG_Z,
            isovalue: 0.5,
            departure: Departure::Free,
            power: DVec3::ONE,
            bounces: 0,
        };
        let landed = |n: u16| {
            SurfacePhoton::landed(&flight, n, (0, Side::Lower), Vec3::ZERO, Some(DVec3::Z), DVec3::NEG_Z).bounces
        };
        assert_eq!([0, 1, 254, 255, 256, 257, u16::MAX].map(landed), [0, 1, 254, 255, 255, 255, 255]);
    }
}
