//! Flattened rays and hits: a ray of R⁴ that never leaves its hyperplane h = c. \[BB09 §2.3\]
//!
//! Space is the *local frame*: index coordinates of the scene's lattice. It keeps f32 fine-grained wherever the data
//! stand in the world, and t is the same number in every affine frame.

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// Which side of a level set: the side where h < c or the one where h ≥ c.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// Where h < c; a surface's normal on this side points along −∇h.
    Lower,
    /// Where h ≥ c; the normal points along ∇h.
    Higher,
}

impl Side {
    /// The lower side, then the higher one.
    pub const BOTH: [Self; 2] = [Self::Lower, Self::Higher];

    /// The other side.
    #[inline]
    pub fn opposite(self) -> Self {
        match self {
            Side::Lower => Side::Higher,
            Side::Higher => Side::Lower,
        }
    }

    /// `lower` or `higher`, as files and options call it.
    pub fn name(self) -> &'static str {
        match self {
            Side::Lower => "lower",
            Side::Higher => "higher",
        }
    }

    /// The normal on this side, given the one on the lower side, or the other way around.
    #[inline]
    pub fn facing<N: std::ops::Neg<Output = N>>(self, lower: N) -> N {
        if self == Side::Lower { lower } else { -lower }
    }

    /// 0 for lower, 1 for higher: an index into pairs.
    #[inline]
    pub fn index(self) -> usize {
        usize::from(self == Side::Higher)
    }
}

/// What a ray starts on, and therefore must not find at t = 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Departure {
    /// Nothing: a point of space.
    Free,
    /// The level set itself, leaving into `Side`. The ray's isovalue is then h at its origin, in f64, and the known
    /// root t = 0 is divided out: no epsilon. A direction that goes to the other side meets the surface at t = 0.
    Surface(Side),
    /// A polygon of the scene, by number.
    Polygon(u32),
    /// A cap, by face, leaving into `Side`. The origin counts as on the face whatever its f32 coordinates.
    Cap(u8, Side),
    /// The level set of companion number n ([`crate::scene::Companion`]), leaving into `Side`: as `Surface` for that
    /// field.
    Companion(u8, Side),
}

/// A ray confined to the hyperplane at height `isovalue`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlattenedRay {
    /// Start, local frame.
    pub origin: Vec3,
    /// Direction, local frame; t counts in its lengths (world units if it stands for a unit world vector).
    pub direction: Vec3,
    /// The hyperplane's height c in units of the sweep, [0, 1].
    pub isovalue: f32,
    /// Hits beyond this t do not count; may be infinite.
    pub reach: f32,
    /// What the ray starts on.
    pub departure: Departure,
    /// The polygon the ray ends on, which must not block it.
    pub target: Option<u32>,
    /// Whether light runs along it, as from a luminaire, instead of against it, as to an eye. What has one face only
    /// stops light that comes from behind, which whoever sees that face does not see. (In three dimensions: flatland's
    /// walls stand around all.)
    pub with_light: bool,
}

/// What a ray starts and ends on, and which way light runs: as in [`FlattenedRay`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "as in the ray")]
pub struct Ends {
    pub departure: Departure,
    pub target: Option<u32>,
    pub with_light: bool,
}

/// A face of Ω as caps and departures number it: axis + 3 · far end; of companion n's Ω: 6 (n + 1) more.
#[inline]
pub fn face_of(companion: u8, face: u8) -> u8 {
    face + 6 * (companion + 1)
}

/// The companion whose face this is, `None` for the scene's own, and the face in [0, 6).
#[inline]
pub fn split_face(face: u8) -> (Option<u8>, u8) {
    ((face / 6).checked_sub(1), face % 6)
}

/// Polygons that can be a ray's departure: numbers below this.
pub const MAX_POLYGONS: u32 = 1 << 16;
/// Polygons that can be a ray's target: numbers below this.
pub const MAX_TARGETS: u32 = (1 << 12) - 1;
/// Fields beside a scene's own that rays can tell apart: numbers below this.
pub const MAX_COMPANIONS: u8 = 30;

impl FlattenedRay {
    /// A ray from a point of space, of infinite reach.
    pub fn free(origin: Vec3, direction: Vec3, isovalue: f32) -> Self {
        let (departure, target, with_light) = (Departure::Free, None, false);
        Self { origin, direction, isovalue, reach: f32::INFINITY, departure, target, with_light }
    }

    /// Its ends.
    #[inline]
    pub fn ends(&self) -> Ends {
        Ends { departure: self.departure, target: self.target, with_light: self.with_light }
    }

    /// Its ends in 32 bits, for the spare word of an Embree ray: 2 bits of kind, 17 of polygon, of side and face, or of
    /// side and companion + 1, 1 of which way light runs, 12 of target + 1.
    #[inline]
    pub fn pack_ends(&self) -> u32 {
        let departure = match self.departure {
            Departure::Free => 0,
            Departure::Surface(Side::Lower) => 1,
            Departure::Surface(Side::Higher) => 1 | 1 << 2,
            Departure::Companion(n, side) => 1 | ((u32::from(n) + 1) << 1 | side.index() as u32) << 2,
            Departure::Polygon(id) => 2 | id << 2,
            Departure::Cap(face, side) => 3 | (u32::from(face) << 1 | side.index() as u32) << 2,
        };
        departure | u32::from(self.with_light) << 19 | self.target.map_or(0, |id| id + 1) << 20
    }

    /// The inverse of [`FlattenedRay::pack_ends`].
    #[inline]
    pub fn unpack_ends(bits: u32) -> Ends {
        let payload = bits >> 2 & 0x1_ffff;
        let side = if payload & 1 == 0 { Side::Lower } else { Side::Higher };
        #[allow(clippy::cast_possible_truncation, reason = "packed from bytes")]
        let number = (payload >> 1) as u8;
        let departure = match bits & 3 {
            0 => Departure::Free,
            1 if number == 0 => Departure::Surface(side),
            1 => Departure::Companion(number - 1, side),
            2 => Departure::Polygon(payload),
            _ => Departure::Cap(number, side),
        };
        Ends { departure, target: (bits >> 20).checked_sub(1), with_light: bits >> 19 & 1 == 1 }
    }

    /// The point at `t`, evaluated in f64.
    #[inline]
    pub fn at(&self, t: f32) -> DVec3 {
        self.origin.as_dvec3() + self.direction.as_dvec3() * f64::from(t)
    }
}

/// What a flattened ray met.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The level set, from `Side`.
    Surface(Side),
    /// A face of Ω with h ≥ c behind it, seen from outside or inside ([`crate::scene::Boundary::Capped`] only): the
    /// face ([`face_of`]), and the side it was met from.
    Cap(u8, Side),
    /// A polygon's front, or a luminaire's back.
    Polygon(u32),
    /// The level set of companion number n, from `Side`.
    Companion(u8, Side),
}

impl Target {
    /// The companion whose level set it is; `None` for the scene's own, and for what is no level set.
    #[inline]
    pub fn companion(self) -> Option<u8> {
        if let Self::Companion(n, _) = self { Some(n) } else { None }
    }
}

/// The nearest hit of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlattenedHit {
    /// Distance in lengths of the ray's direction; 0 ≤ t ≤ reach.
    pub t: f32,
    /// What was met.
    pub target: Target,
}

/// A place on what stands in a hyperplane, and whence it is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// What stands there.
    pub target: Target,
    /// Whether it is seen from within a solid, where flats have light of their own.
    pub within: bool,
    /// Local frame.
    pub position: DVec3,
    /// The hyperplane, in units of the sweep.
    pub isovalue: f32,
}

/// Where a ray enters Ω.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Entry {
    pub t: f64,
    /// The axis of the face that it comes through; `None` if it starts in Ω.
    pub axis: Option<usize>,
}

/// Where a ray from `o` along `d`, with `inv` = 1/`d`, enters Ω of so many `cells`, within its reach: slab by slab. A
/// component 0 (or −0) never crosses a plane: its slab holds the whole line or nothing of it. `None` for no direction.
#[inline(always)]
pub(crate) fn enter<const N: usize>(
    cells: [usize; N],
    o: [f64; N],
    d: [f64; N],
    inv: [f64; N],
    reach: f64,
) -> Option<Entry> {
    let (mut t, mut t_out, mut axis) = (0f64, reach, None);
    if !(0..N).all(|a| o[a] >= 0.0 && o[a] <= cells[a] as f64) {
        for a in 0..N {
            let far = cells[a] as f64;
            if d[a] == 0.0 {
                if !(o[a] >= 0.0 && o[a] <= far) {
                    return None;
                }
                continue;
            }
            let (near_plane, far_plane) = if d[a] > 0.0 { (0.0, far) } else { (far, 0.0) };
            let t0 = (near_plane - o[a]) * inv[a];
            if t0 > t {
                (t, axis) = (t0, Some(a));
            }
            t_out = t_out.min((far_plane - o[a]) * inv[a]);
        }
    }
    let moves = d.iter().fold(0.0, |most, x| x.abs().max(most)) != 0.0;
    (t <= t_out && moves).then_some(Entry { t, axis })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_survive_packing() {
        let departures = [
            Departure::Free,
            Departure::Surface(Side::Lower),
            Departure::Surface(Side::Higher),
            Departure::Polygon(0),
            Departure::Polygon(MAX_POLYGONS - 1),
            Departure::Cap(0, Side::Higher),
            Departure::Cap(5, Side::Lower),
            Departure::Cap(face_of(MAX_COMPANIONS - 1, 5), Side::Higher),
            Departure::Companion(0, Side::Lower),
            Departure::Companion(MAX_COMPANIONS - 1, Side::Higher),
        ];
        for departure in departures {
            for target in [None, Some(0), Some(7), Some(MAX_TARGETS - 1)] {
                for with_light in [false, true] {
                    let free = FlattenedRay::free(Vec3::ZERO, Vec3::X, 0.5);
                    let ray = FlattenedRay { departure, target, with_light, ..free };
                    assert_eq!(FlattenedRay::unpack_ends(ray.pack_ends()), ray.ends());
                }
            }
        }
    }

    #[test]
    fn faces_keep_whose_they_are() {
        for face in 0..6 {
            assert_eq!(split_face(face), (None, face));
            for n in 0..MAX_COMPANIONS {
                assert_eq!(split_face(face_of(n, face)), (Some(n), face));
            }
        }
    }

    #[test]
    fn rays_enter_through_the_nearest_face_that_all_slabs_share() {
        let of = |o: [f64; 2], d: [f64; 2], reach| enter([4, 2], o, d, d.map(|x| 1.0 / x), reach);
        let at = |t, axis| Some(Entry { t, axis });
        assert_eq!(of([1.0, 1.0], [1.0, 0.0], 9.0), at(0.0, None));
        assert_eq!(of([-2.0, 1.0], [1.0, 0.0], 9.0), at(2.0, Some(0)));
        assert_eq!(of([-2.0, 3.0], [1.0, -1.0], 9.0), at(2.0, Some(0)));
        assert_eq!(of([-1.0, 4.0], [1.0, -1.0], 9.0), at(2.0, Some(1)));
        // Beside it, away from it, too far, along it outside, nowhere.
        for (o, d, reach) in [
            ([-3.0, 1.0], [1.0, 1.0], 9.0),
            ([-2.0, 1.0], [-1.0, 0.0], 9.0),
            ([-2.0, 1.0], [1.0, 0.0], 1.5),
            ([1.0, 2.5], [1.0, 0.0], 9.0),
            ([1.0, 1.0], [0.0, 0.0], 9.0),
        ] {
            assert_eq!(of(o, d, reach), None, "{o:?} {d:?}");
        }
    }
}
