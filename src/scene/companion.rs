//! Several fields in one scene: each hyperplane holds one level set of every field, at the same sweep parameter.
//!
//! A scene is *seen from* one of its fields: that field's index space is the local frame, so that rays and samples of
//! it have the same bits as in a scene of its own. The others are its companions, with an affine map from the local
//! frame to their index spaces; t is the same number in all of them.

use super::{Boundary, Scene, Surface, outward_normal};
use crate::error::{Error, Result};
use crate::field::Field;
use crate::flattened::{Departure, FlattenedRay, MAX_COMPANIONS, Side, Target, face_of, split_face};
use crate::polygon::Polygon;
use crate::volume::Lattice;
use glam::{DMat3, DVec3};
use std::sync::Arc;

/// Whether fields light each other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Policy {
    /// All fields stand in one 4D scene: they shadow and light each other.
    #[default]
    Joint,
    /// Each field sees walls and luminaires only, as if it were baked alone.
    Independent,
}

/// What one volume brings into a scene.
#[derive(Clone, Debug)]
pub struct Member {
    /// Its name, for files and messages; empty if the scene has no other field.
    pub name: String,
    /// h, its lattice and its own range of isovalues, mapped to the shared parameter s ∈ [0, 1].
    pub field: Arc<Field>,
    /// Material and sides.
    pub surface: Surface,
    /// What the faces of its Ω do.
    pub boundary: Boundary,
}

/// Another field of a scene, from the point of view of the scene's own.
#[derive(Clone, Debug)]
pub struct Companion {
    /// What it is.
    pub member: Member,
    /// Its number among all fields.
    pub number: usize,
    /// Its own number in targets and departures.
    index: u8,
    forth: (DMat3, DVec3),
    back: DMat3,
    /// Whether both index spaces are one.
    same: bool,
}

impl Companion {
    /// A companion of a scene whose own field stands on `lattice`.
    fn new(member: Member, number: usize, index: u8, lattice: &Lattice) -> Self {
        let forth = between(lattice, member.field.lattice());
        let same = forth == (DMat3::IDENTITY, DVec3::ZERO) && lattice.dims() == member.field.lattice().dims();
        Self { member, number, index, forth, back: forth.0.inverse(), same }
    }

    /// Index coordinates in its lattice of local `p` of the scene.
    #[inline]
    pub fn to_index(&self, p: DVec3) -> DVec3 {
        self.forth.0 * p + self.forth.1
    }

    /// The inverse of [`Companion::to_index`].
    #[inline]
    pub fn to_local(&self, q: DVec3) -> DVec3 {
        self.back * (q - self.forth.1)
    }

    /// Whether the map between the two index spaces is a reflection, which turns triangles around.
    pub fn flips(&self) -> bool {
        self.back.determinant() < 0.0
    }

    /// The ray in its index space, as its own scene would trace it.
    #[inline(always)]
    pub fn ray_to_index(&self, ray: &FlattenedRay) -> FlattenedRay {
        let departure = match ray.departure {
            Departure::Companion(n, side) if n == self.index => Departure::Surface(side),
            Departure::Cap(face, side) if split_face(face).0 == Some(self.index) => {
                Departure::Cap(split_face(face).1, side)
            }
            _ => Departure::Free,
        };
        if self.same {
            return FlattenedRay { departure, ..*ray };
        }
        FlattenedRay {
            origin: self.to_index(ray.origin.as_dvec3()).as_vec3(),
            direction: (self.forth.0 * ray.direction.as_dvec3()).as_vec3(),
            departure,
            ..*ray
        }
    }

    /// What a ray of [`Companion::ray_to_index`] met, as the scene calls it.
    #[inline]
    pub fn target(&self, target: Target) -> Target {
        match target {
            Target::Surface(side) => Target::Companion(self.index, side),
            Target::Cap(face, side) => Target::Cap(face_of(self.index, face), side),
            other => other,
        }
    }

    /// The same for a scene whose own field stands on `lattice`.
    pub(super) fn seen_on(&self, lattice: &Lattice) -> Self {
        Self::new(self.member.clone(), self.number, self.index, lattice)
    }

    /// Whether it stands on the very lattice of the scene's own field.
    pub fn shares_lattice(&self) -> bool {
        self.same
    }

    /// The corners of its Ω in the scene's local frame.
    pub fn corners(&self) -> [DVec3; 8] {
        self.member.field.lattice().corners().map(|p| self.to_local(p))
    }
}

/// One of a scene's fields at a place of the scene.
#[derive(Clone, Copy, Debug)]
pub struct FieldAt<'a> {
    /// Its number among all fields.
    pub number: usize,
    /// h.
    pub field: &'a Field,
    /// Material and sides of its level sets.
    pub surface: &'a Surface,
    /// The place in its index space.
    pub place: DVec3,
}

impl FieldAt<'_> {
    /// Unit normal of `side` of its level set there, in the world; `None` where ∇h vanishes.
    #[inline]
    pub fn normal(&self, side: Side) -> Option<DVec3> {
        Some(side.facing(self.field.falling_normal(self.place)?))
    }
}

impl Scene {
    /// The scene's own field, or that of a companion, at local `p`.
    #[inline]
    pub fn field_at(&self, companion: Option<u8>, p: DVec3) -> FieldAt<'_> {
        match companion.map(|n| &self.companions()[usize::from(n)]) {
            None => FieldAt { number: self.number(), field: &self.field, surface: &self.surface, place: p },
            Some(c) => {
                let Member { field, surface, .. } = &c.member;
                FieldAt { number: c.number, field, surface, place: c.to_index(p) }
            }
        }
    }
}

/// The map from index space of `own` to that of `other`. What is an integer but for rounding becomes one, so that
/// lattices that share planes share them exactly.
fn between(own: &Lattice, other: &Lattice) -> (DMat3, DVec3) {
    let snap = |v: DVec3| DVec3::select((v - v.round()).abs().cmplt(DVec3::splat(1e-9)), v.round(), v);
    let column = |a: usize| snap(other.direction_to_index(own.axes().col(a)));
    (DMat3::from_cols(column(0), column(1), column(2)), snap(other.to_index(own.origin())))
}

impl Scene {
    /// Puts a scene of several fields together, seen from the first.
    ///
    /// # Errors
    /// As [`Scene::new`], for each field; `Invalid` without fields, with too many, or with names that are missing or
    /// occur twice.
    pub fn with_members(members: Vec<Member>, policy: Policy, polygons: Vec<Polygon>) -> Result<Self> {
        if members.is_empty() || members.len() > 1 + usize::from(MAX_COMPANIONS) {
            return Err(Error::Invalid(format!("{} volumes: 1 to {} are possible", members.len(), 1 + MAX_COMPANIONS)));
        }
        for (n, m) in members.iter().enumerate().filter(|_| members.len() > 1) {
            let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
            if m.name.is_empty() || !m.name.chars().all(plain) {
                return Err(Error::Invalid(format!(
                    "volume {}: name '{}': every volume of a scene needs one, of letters, digits, '-', '_' and '.', since \
                     it becomes part of a file's name",
                    n + 1,
                    m.name
                )));
            }
            if members[..n].iter().any(|o| o.name == m.name) {
                return Err(Error::Invalid(format!("volume name '{}' occurs twice", m.name)));
            }
        }
        Self::seen(members, 0, policy, polygons)
    }

    /// The scene from the point of view of field `own`.
    fn seen(mut members: Vec<Member>, own: usize, policy: Policy, polygons: Vec<Polygon>) -> Result<Self> {
        let all = members.len();
        let Member { name, field, surface, boundary } = members.remove(own);
        let mut scene = Self::new(field, surface, boundary, polygons)?;
        (scene.name, scene.number, scene.policy) = (name, own, policy);
        let numbers = (0..all).filter(|&n| n != own);
        for (index, (member, number)) in (0u8..).zip(members.into_iter().zip(numbers)) {
            super::check(&member.surface, member.boundary, &member.field, &scene.polygons)?;
            let companion = Companion::new(member, number, index, scene.field.lattice());
            for p in companion.corners() {
                let x = scene.lattice().to_world(p);
                let [lo, hi] = &mut scene.interior;
                (*lo, *hi) = (lo.min(x), hi.max(x));
            }
            scene.companions.push(companion);
        }
        scene.reference_irradiance = scene.find_reference_irradiance();
        Ok(scene)
    }

    /// The number of this scene's own field among all.
    pub fn number(&self) -> usize {
        self.number
    }

    /// The other fields, by rising number.
    pub fn companions(&self) -> &[Companion] {
        &self.companions
    }

    /// Number of fields.
    pub fn fields(&self) -> usize {
        1 + self.companions.len()
    }

    /// Whether fields light each other.
    pub fn policy(&self) -> Policy {
        self.policy
    }

    /// All fields by number, the scene's own among them. Samples are shared, not copied.
    pub fn members(&self) -> Vec<Member> {
        let own = Member {
            name: self.name.clone(),
            field: self.field.clone(),
            surface: self.surface.clone(),
            boundary: self.boundary,
        };
        let mut all: Vec<Member> = self.companions.iter().map(|c| c.member.clone()).collect();
        all.insert(self.number, own);
        all
    }

    /// The names of two fields that light each other and whose caps lie in the same faces (to a millionth of them):
    /// where both are solid there, neither lies before the other.
    pub fn coplanar_caps(&self) -> Option<[String; 2]> {
        let frame = |m: &Member| {
            let (lattice, far) = (m.field.lattice(), m.field.lattice().far());
            let axes = lattice.axes();
            [lattice.origin(), axes.x_axis * far.x, axes.y_axis * far.y, axes.z_axis * far.z]
        };
        let same = |a: &Member, b: &Member| {
            let (a, b) = (frame(a), frame(b));
            let size = a[1..].iter().map(|e| e.length()).fold(0.0, f64::max);
            a.iter().zip(&b).all(|(a, b)| (*a - *b).length() <= 1e-6 * size)
        };
        let mut capped = self.members();
        capped.retain(|m| m.boundary == Boundary::Capped && self.policy == Policy::Joint);
        capped.iter().enumerate().find_map(|(n, a)| {
            let other = capped[..n].iter().find(|b| same(a, b))?;
            Some([other.name.clone(), a.name.clone()])
        })
    }

    /// The same scene from the point of view of field `number`.
    #[must_use]
    pub fn seen_from(&self, number: usize) -> Self {
        Self::seen(self.members(), number, self.policy, self.polygons.clone()).expect("it was checked when it was made")
    }

    /// The scene in which the light of field `number` is computed: seen from it, and without the others if the policy
    /// says so.
    #[must_use]
    pub fn lit(&self, number: usize) -> Self {
        if self.policy == Policy::Joint {
            return self.seen_from(number);
        }
        let member = self.members().swap_remove(number);
        Self::seen(vec![member], 0, self.policy, self.polygons.clone()).expect("it was checked when it was made")
    }

    /// The number of the field named `name`.
    ///
    /// # Errors
    /// `Invalid` with the names there are.
    pub fn field_named(&self, name: &str) -> Result<usize> {
        let members = self.members();
        members.iter().position(|m| m.name == name).ok_or_else(|| {
            let names: Vec<&str> = members.iter().map(|m| m.name.as_str()).filter(|n| !n.is_empty()).collect();
            Error::Invalid(match names[..] {
                [] => format!("--field {name}: there is only one volume, and it has no name"),
                _ => format!("--field {name}: there is no such volume; there are {}", names.join(", ")),
            })
        })
    }

    /// The lattice whose face this is, the number of its field, and the face in [0, 6).
    #[inline]
    fn face(&self, face: u8) -> (&Lattice, usize, u8) {
        match split_face(face) {
            (None, face) => (self.lattice(), self.number, face),
            (Some(n), face) => {
                let c = &self.companions[usize::from(n)];
                (c.member.field.lattice(), c.number, face)
            }
        }
    }

    /// World normal of a face of Ω ([`face_of`]), pointing out of Ω.
    pub fn face_normal(&self, face: u8) -> DVec3 {
        let (lattice, _, face) = self.face(face);
        outward_normal(lattice, usize::from(face % 3), face >= 3)
    }

    /// Material of a face of Ω, if it is a cap.
    #[inline]
    pub fn face_surface(&self, face: u8) -> &Surface {
        split_face(face).0.map_or(&self.surface, |n| &self.companions[usize::from(n)].member.surface)
    }

    /// The number of a face among all faces of all fields: 6 · field + axis + 3 · far end, from any point of view.
    #[inline]
    pub fn face_number(&self, face: u8) -> usize {
        let (_, number, face) = self.face(face);
        6 * number + usize::from(face)
    }

    /// The inverse of [`Scene::face_number`], with the field's lattice, material and boundary.
    pub fn numbered_face(&self, number: usize) -> (u8, &Lattice, &Surface, Boundary) {
        #[allow(clippy::cast_possible_truncation, reason = "there are few fields")]
        let (field, face) = (number / 6, (number % 6) as u8);
        match self.companions.iter().find(|c| c.number == field) {
            None => (face, self.lattice(), &self.surface, self.boundary),
            Some(c) => (face_of(c.index, face), c.member.field.lattice(), &c.member.surface, c.member.boundary),
        }
    }

    /// Index coordinates, in the lattice whose face this is, of local `p`.
    #[inline]
    pub fn to_face_index(&self, face: u8, p: DVec3) -> (DVec3, &Lattice) {
        match split_face(face).0 {
            None => (p, self.lattice()),
            Some(n) => {
                let c = &self.companions[usize::from(n)];
                (c.to_index(p), c.member.field.lattice())
            }
        }
    }
}
