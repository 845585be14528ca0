//! What one hyperplane contains: the level set, walls, luminaires; and the Cornell box that fits itself around any
//! volume.

mod companion;
mod cover;
mod mtl;
mod obj;

pub use companion::{Companion, FieldAt, Member, Policy};
pub(crate) use cover::{ON, SLIT, value_on, voxel_along};
pub use obj::{Placement, read_context, read_obj};

use crate::digits::{Shortest, brief_within};
use crate::emission;
use crate::error::{Error, Result};
use crate::field::{Field, Sweep};
use crate::flattened::{Departure, FlattenedRay, MAX_POLYGONS, MAX_TARGETS, Side};
use crate::luminaire::unoccluded;
use crate::polygon::Polygon;
use crate::reflectance::Reflectance;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use std::ops::RangeInclusive;
use std::sync::Arc;

/// Widths of cells whose areas fit 32-bit floats, photon by photon.
const WIDTHS: RangeInclusive<f64> = 1e-16..=1e16;

/// Edges of a box whose walls have an area, in parts of the longest.
const THINNEST: f64 = 1e-11;

/// What the faces of Ω do to a level set that runs into them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Boundary {
    /// They cut it open, as extraction tools do.
    Open,
    /// They close it: outside Ω counts as below every isovalue.
    Capped,
}

/// The isosurfaces' material and sides.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// Diffuse reflectance per channel on both sides, [0, 1], by isovalue.
    pub albedo: Reflectance,
    /// Emitted radiance per channel, from both sides; 0 for ordinary surfaces.
    pub emission: DVec3,
    /// The side whose radiance is stored first.
    pub outside: Side,
    /// Whether the other side is stored too.
    pub both_sides: bool,
}

impl Default for Surface {
    fn default() -> Self {
        Self { albedo: DVec3::splat(0.75).into(), emission: DVec3::ZERO, outside: Side::Lower, both_sides: false }
    }
}

impl Surface {
    /// The sides whose radiance is stored.
    pub fn stored_sides(&self) -> Vec<Side> {
        if self.both_sides { vec![self.outside, self.outside.opposite()] } else { vec![self.outside] }
    }

    /// Whether surfaces reflect no more than they receive.
    ///
    /// # Errors
    /// `Invalid` for an albedo outside [0, 1], with the isovalue of `sweep`.
    pub(crate) fn check_albedo(&self, sweep: Sweep) -> Result<()> {
        let stops = self.albedo.stops();
        for (s, albedo) in stops {
            if !(albedo.cmpge(DVec3::ZERO).all() && albedo.cmple(DVec3::ONE).all()) {
                let isovalue = brief_within(sweep.from_unit(*s), [sweep.lo(), sweep.hi()]);
                let at = if stops.len() > 1 { format!(" at isovalue {isovalue}") } else { String::new() };
                return Err(Error::Invalid(format!("surface albedo {albedo}{at}: every channel must lie in [0, 1]")));
            }
        }
        Ok(())
    }

    /// Whether f32 holds what surfaces emit.
    ///
    /// # Errors
    /// `Invalid` for an emission out of range.
    pub(crate) fn check_emission(&self) -> Result<()> {
        emission::check(self.emission).map_err(|e| Error::Invalid(format!("surface {e}")))
    }
}

/// A scene: {graph of h, walls × I, luminaires × I}. \[BB09 §2.3\]
#[derive(Clone, Debug)]
pub struct Scene {
    /// h, its lattice and the sweep.
    pub field: Arc<Field>,
    /// Material and sides of the isosurfaces.
    pub surface: Surface,
    /// What Ω's faces do.
    pub boundary: Boundary,
    /// The name of its field; empty if there is no other.
    pub name: String,
    number: usize,
    companions: Vec<Companion>,
    policy: Policy,
    polygons: Vec<Polygon>,
    /// How many of them emit; these come first.
    emitting: usize,
    interior: [DVec3; 2],
    reference_irradiance: f64,
}

/// Whether light can be computed with cells of a lattice's spacing.
///
/// # Errors
/// `Invalid` if a cell is narrower or wider than 10⁻¹⁶ to 10¹⁶.
pub(crate) fn check_spacing(lattice: &Lattice) -> Result<()> {
    let spacing = lattice.spacing();
    if WIDTHS.contains(&spacing.min_element()) && WIDTHS.contains(&spacing.max_element()) {
        return Ok(());
    }
    let [x, y, z] = spacing.to_array().map(Shortest);
    Err(Error::Invalid(format!(
        "spacing {x}, {y}, {z}: cells must be {:e} to {:e} wide; give lengths in another unit: light does not depend on it",
        WIDTHS.start(),
        WIDTHS.end()
    )))
}

/// Whether a field can stand among `polygons`.
fn check(surface: &Surface, boundary: Boundary, field: &Field, polygons: &[Polygon]) -> Result<()> {
    let lattice = field.lattice();
    check_spacing(lattice)?;
    surface.check_albedo(field.sweep())?;
    surface.check_emission()?;
    polygons.iter().try_for_each(Polygon::check)?;
    if boundary == Boundary::Capped {
        // A cap is a surface of its own: a wall in the same plane would hide it or be hidden.
        let far = lattice.far();
        for p in polygons {
            let local: Vec<DVec3> = p.vertices().iter().map(|&x| lattice.to_index(x)).collect();
            for a in 0..3 {
                for plane in [0.0, far[a]] {
                    if local.iter().all(|v| (v[a] - plane).abs() < 1e-6 * far[a]) {
                        return Err(Error::Invalid(format!(
                            "boundary = \"capped\": polygon '{}' lies in a face of the volume; give the box a margin",
                            p.name
                        )));
                    }
                }
            }
        }
    }
    Ok(())
}

impl Scene {
    /// Puts a scene together; polygons that emit are its luminaires. Luminaires are numbered first; those that lie in
    /// the plane of a wall are hung before it, by a twentieth of a voxel.
    ///
    /// # Errors
    /// `Invalid` for an albedo outside [0, 1], an emission out of range, too many polygons, capped faces that touch a
    /// wall, or cells narrower than 10⁻¹⁶ or wider than 10¹⁶.
    pub fn new(
        field: impl Into<Arc<Field>>,
        surface: Surface,
        boundary: Boundary,
        polygons: Vec<Polygon>,
    ) -> Result<Self> {
        let field = field.into();
        let mut polygons = polygons;
        // Whatever was made to emit, or no longer to.
        for p in polygons.iter_mut().filter(|p| p.other_face == 0) {
            p.opaque_back = p.emission != DVec3::ZERO;
        }
        let (mut polygons, walls): (Vec<_>, Vec<_>) = polygons.into_iter().partition(|p| p.emission != DVec3::ZERO);
        let count = polygons.len();
        polygons.extend(walls);
        let lattice = field.lattice();
        check(&surface, boundary, &field, &polygons)?;
        if count > MAX_TARGETS as usize || polygons.len() > MAX_POLYGONS as usize {
            return Err(Error::Invalid(format!(
                "{count} luminaires among {} polygons: at most {MAX_TARGETS} among {MAX_POLYGONS} are possible",
                polygons.len()
            )));
        }
        cover::hang(&mut polygons, count, lattice);
        let mut lo = DVec3::INFINITY;
        let mut hi = DVec3::NEG_INFINITY;
        let corners = lattice.corners().map(|p| lattice.to_world(p));
        for x in corners.into_iter().chain(polygons.iter().flat_map(|p| p.vertices().iter().copied())) {
            (lo, hi) = (lo.min(x), hi.max(x));
        }
        let mut scene = Self {
            field,
            surface,
            boundary,
            name: String::new(),
            number: 0,
            companions: Vec::new(),
            policy: Policy::default(),
            polygons,
            emitting: count,
            interior: [lo, hi],
            reference_irradiance: 0.0,
        };
        scene.reference_irradiance = scene.find_reference_irradiance();
        Ok(scene)
    }

    /// Whether all that can be changed in a scene is still in range.
    ///
    /// # Errors
    /// As [`Scene::new`].
    pub(crate) fn check(&self) -> Result<()> {
        check(&self.surface, self.boundary, &self.field, &self.polygons)
    }

    /// The same scene with its field on another lattice over the same Ω ([`Field::resampled`]).
    #[must_use]
    pub fn resampled(&self, lattice: &Lattice) -> Self {
        let field = Arc::new(self.field.resampled(lattice));
        let companions = self.companions.iter().map(|c| c.seen_on(lattice)).collect();
        Self { field, companions, ..self.clone() }
    }

    /// Walls and luminaires; luminaires come first.
    pub fn polygons(&self) -> &[Polygon] {
        &self.polygons
    }

    /// The polygons that emit, in the order of their numbers.
    pub fn luminaires(&self) -> &[Polygon] {
        &self.polygons[..self.emitting]
    }

    /// World bounds of everything.
    pub fn bounds(&self) -> [DVec3; 2] {
        self.interior
    }

    /// Whether caps close Ω's faces.
    #[inline]
    pub fn is_capped(&self) -> bool {
        self.boundary == Boundary::Capped
    }

    /// Bounds of Ω and of all polygons, in units of voxels.
    pub fn local_bounds(&self) -> [DVec3; 2] {
        let bounds = [DVec3::ZERO, self.lattice().far()];
        let vertices = self.polygons.iter().flat_map(|p| p.vertices()).map(|&x| self.lattice().to_index(x));
        vertices.fold(bounds, |[lo, hi], p| [lo.min(p), hi.max(p)])
    }

    /// Whether polygons leave room around Ω.
    pub fn has_margin(&self) -> bool {
        let [lo, hi] = self.local_bounds();
        lo.min(self.lattice().far() - hi).min_element() < -1e-6
    }

    /// The lattice, whose index coordinates are the local frame.
    pub fn lattice(&self) -> &Lattice {
        self.field.lattice()
    }

    /// Unit normal of `side` of the level set through local `p`, in the world; `None` where ∇h vanishes.
    #[inline]
    pub fn normal(&self, p: DVec3, side: Side) -> Option<DVec3> {
        let n = self.field.falling_normal(p)?;
        Some(side.facing(n))
    }

    /// A ray from local `origin` along the world direction `direction`; t counts in lengths of it.
    #[inline]
    pub fn ray(&self, origin: Vec3, direction: DVec3, isovalue: f32, departure: Departure) -> FlattenedRay {
        let direction = self.lattice().direction_to_index(direction).as_vec3();
        FlattenedRay { departure, ..FlattenedRay::free(origin, direction, isovalue) }
    }

    /// Whether rays that leave so start within a solid: on a level set, to the side that is not its outside.
    #[inline]
    pub fn leaves_within(&self, departure: Departure) -> bool {
        match departure {
            Departure::Surface(side) => side != self.surface.outside,
            Departure::Companion(n, side) => side != self.companions[usize::from(n)].member.surface.outside,
            Departure::Free | Departure::Polygon(_) | Departure::Cap(..) => false,
        }
    }

    /// Whether `ray` is at `t` in a solid, of any field that is lit with this one, or where one touches the wall that
    /// it meets there. On the level set itself it is not: of a background at its isovalue walls are seen.
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    pub fn solid_holds(&self, ray: &FlattenedRay, t: f32) -> bool {
        let (p, c) = (ray.at(t), ray.isovalue);
        let rounding = 16.0 * f64::from(f32::EPSILON) * p.abs().max(ray.origin.as_dvec3().abs()).max_element().max(1.0);
        let holds = |field: &Field, p: DVec3, slack: f64, outside: Side| {
            // NaN beside samples that are not finite: nothing is there.
            let h = field.lattice().nearest(p, slack).map_or(f32::NAN, |p| field.value(p) as f32);
            if outside == Side::Lower { h > c } else { h < c }
        };
        // Those that are not lit together do not see each other.
        let companions = if self.policy == Policy::Joint { &self.companions[..] } else { &[] };
        holds(&self.field, p, rounding, self.surface.outside)
            || companions.iter().any(|companion| {
                let q = companion.to_index(p);
                let slack = (companion.to_index(p + rounding) - q).abs().max_element();
                holds(&companion.member.field, q, slack, companion.member.surface.outside)
            })
    }

    /// Whether `ray` comes towards the front of polygon `id`. The back of a luminaire is black.
    #[inline]
    pub fn sees_front(&self, ray: &FlattenedRay, id: u32) -> bool {
        (self.lattice().axes() * ray.direction.as_dvec3()).dot(self.polygons[id as usize].normal()) < 0.0
    }

    /// E₀: the unoccluded irradiance of a patch at the centre of the (first) volume that faces the strongest luminaire;
    /// the largest channel of the sum over all luminaires. 0 without luminaires.
    pub fn reference_irradiance(&self) -> f64 {
        self.reference_irradiance
    }

    fn find_reference_irradiance(&self) -> f64 {
        let first = self.companions.iter().find(|c| c.number == 0).map_or(self.lattice(), |c| c.member.field.lattice());
        let centre = first.to_world(0.5 * first.far());
        let flux = |p: &Polygon| p.emission.max_element() * p.area();
        let lights = self.luminaires();
        let Some(strongest) = lights.iter().max_by(|a, b| flux(a).total_cmp(&flux(b))) else { return 0.0 };
        let aim = strongest.middle() - centre;
        let Some(n) = aim.try_normalize() else { return 0.0 };
        lights.iter().map(|p| p.emission * unoccluded(p, centre, n)).sum::<DVec3>().max_element()
    }

    /// Display exposure: rgb = radiance × π / (ρ_max E₀), ρ_max over all channels and the sweep; 1 where that is
    /// undefined.
    pub fn exposure(&self) -> f64 {
        let brightest = self.companions.iter().map(|c| c.member.surface.albedo.greatest().max_element());
        let brightest = brightest.fold(self.surface.albedo.greatest().max_element(), f64::max);
        let scale = brightest * self.reference_irradiance() / std::f64::consts::PI;
        if scale > 0.0 { 1.0 / scale } else { 1.0 }
    }
}

/// Outward unit normal of the face of Ω across lattice axis `axis` at its near or far end.
fn outward_normal(lattice: &Lattice, axis: usize, far: bool) -> DVec3 {
    let axes = lattice.axes();
    let n = axes.col((axis + 1) % 3).cross(axes.col((axis + 2) % 3)).normalize();
    if (n.dot(axes.col(axis)) > 0.0) == far { n } else { -n }
}

/// The lattice axis nearest each world axis, and whether it points the same way: the unique best permutation.
pub fn nearest_axes(lattice: &Lattice) -> [(usize, bool); 3] {
    let normal = |axis: usize| outward_normal(lattice, axis, true);
    let permutations = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let score = |p: &[usize; 3]| (0..3).map(|w| normal(p[w])[w].abs()).sum::<f64>();
    let best = permutations.into_iter().max_by(|a, b| score(a).total_cmp(&score(b))).expect("six permutations");
    std::array::from_fn(|w| (best[w], normal(best[w])[w] > 0.0))
}

/// The largest margin of a box: farther off, f32 coordinates of rays are coarser than voxels.
const MOST_MARGIN: f64 = 1000.0;

/// Whether the walls of a box around a lattice have an area.
///
/// # Errors
/// `Invalid` if its edges differ by a factor of 10¹¹.
pub(crate) fn check_edges(lattice: &Lattice) -> Result<()> {
    let edges = lattice.spacing() * lattice.far();
    if edges.min_element() > THINNEST * edges.max_element() {
        return Ok(());
    }
    let [x, y, z] = lattice.spacing().to_array().map(Shortest);
    Err(Error::Invalid(format!(
        "spacing {x}, {y}, {z}: the volume is so thin that the walls of a box around it have no area; its edges may differ \
         by a factor of {:e}",
        1.0 / THINNEST
    )))
}

/// The default scene's polygons: a Cornell box that coincides with Ω's faces, grown by `margin` × Ω's edge on every
/// side. x_min red, x_max green, floor, ceiling and y_max white, y_min open; a square luminaire of radiance 1 and side
/// 0.4 · min(Lx, Ly), 0.001 Lz under the ceiling. x, y, z are the world axes nearest the lattice's.
///
/// # Errors
/// `Invalid` for a margin that is no number from 0 to 1000, and for volumes too thin for walls.
pub fn cornell_box(lattice: &Lattice, margin: f64) -> Result<Vec<Polygon>> {
    if !(0.0..=MOST_MARGIN).contains(&margin) {
        return Err(Error::Invalid(format!(
            "box margin {}: must be a fraction of the volume's edges, 0 to {MOST_MARGIN}",
            Shortest(margin)
        )));
    }
    check_edges(lattice)?;
    let nearest = nearest_axes(lattice);
    let far = lattice.far();
    // Box coordinates along world-like axes, 0 … 1 from min to max face.
    let corner = |x: f64, y: f64, z: f64| {
        let mut p = DVec3::ZERO;
        for (w, t) in [x, y, z].into_iter().enumerate() {
            let (axis, same) = nearest[w];
            let s = if same { t } else { 1.0 - t };
            p[axis] = (s * (1.0 + 2.0 * margin) - margin) * far[axis];
        }
        lattice.to_world(p)
    };
    let length = |w: usize| lattice.axes().col(nearest[w].0).length() * far[nearest[w].0] * (1.0 + 2.0 * margin);
    let (red, green) = (DVec3::new(0.63, 0.065, 0.05), DVec3::new(0.14, 0.45, 0.091));
    let white = DVec3::new(0.725, 0.71, 0.68);
    let (lx, ly, lz) = (length(0), length(1), length(2));
    let inside = corner(0.5, 0.5, 0.5);
    let facing_in = |name: &str, v: [DVec3; 4], albedo: DVec3, emission: DVec3| {
        let mut v = v.to_vec();
        if (v[1] - v[0]).cross(v[3] - v[0]).dot(inside - v[0]) < 0.0 {
            v.reverse();
        }
        Polygon::new(name, v, albedo, emission)
    };
    let ceiling = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| corner(x, y, 1.0));
    let down = {
        let n = (ceiling[1] - ceiling[0]).cross(ceiling[3] - ceiling[0]).normalize();
        if n.dot(inside - ceiling[0]) < 0.0 { -n } else { n }
    };
    let s = (ceiling[1] - ceiling[0]).normalize();
    let t = down.cross(s);
    let half = 0.2 * lx.min(ly);
    let centre = corner(0.5, 0.5, 1.0) + 0.001 * lz * down;
    let square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(a, b)| centre + half * (a * s + b * t));
    let none = DVec3::ZERO;
    [
        facing_in("luminaire", square, none, DVec3::ONE),
        facing_in("x_min", [(0., 0.), (1., 0.), (1., 1.), (0., 1.)].map(|(y, z)| corner(0., y, z)), red, none),
        facing_in("x_max", [(0., 0.), (1., 0.), (1., 1.), (0., 1.)].map(|(y, z)| corner(1., y, z)), green, none),
        facing_in("z_min", [(0., 0.), (1., 0.), (1., 1.), (0., 1.)].map(|(x, y)| corner(x, y, 0.)), white, none),
        facing_in("z_max", ceiling, white, none),
        facing_in("y_max", [(0., 0.), (1., 0.), (1., 1.), (0., 1.)].map(|(x, z)| corner(x, 1., z)), white, none),
    ]
    .into_iter()
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::volume::Samples;
    use glam::DMat3;

    fn scene_on(lattice: Lattice, margin: f64, boundary: Boundary) -> Result<Scene> {
        let samples = (0..lattice.len()).map(|i| i as f32).collect();
        let last = (lattice.len() - 1) as f64;
        let field = Field::made(lattice, Samples::F32(samples), 0.0, last);
        let polygons = cornell_box(field.lattice(), margin)?;
        Scene::new(field, Surface::default(), boundary, polygons)
    }

    #[test]
    fn the_default_box_of_a_cube() {
        let lattice = Lattice::aligned([11, 11, 11], DVec3::ZERO, DVec3::splat(0.1)).unwrap();
        let scene = scene_on(lattice, 0.0, Boundary::Open).unwrap();
        assert!((scene.reference_irradiance() - 0.53002).abs() < 1e-5, "{}", scene.reference_irradiance());
        let named = |n: &str| scene.polygons().iter().find(|p| p.name == n).unwrap();
        assert_eq!(scene.luminaires().iter().map(|p| p.name.as_str()).collect::<Vec<_>>(), ["luminaire"]);
        assert!((named("luminaire").area() - 0.16).abs() < 1e-12);
        for (name, normal) in [
            ("x_min", DVec3::X),
            ("x_max", -DVec3::X),
            ("y_max", -DVec3::Y),
            ("z_min", DVec3::Z),
            ("z_max", -DVec3::Z),
            ("luminaire", -DVec3::Z),
        ] {
            assert!((named(name).normal() - normal).length() < 1e-12, "{name} faces {}", named(name).normal());
        }
    }

    #[test]
    fn flipped_and_permuted_axes_keep_world_names() {
        // Lattice axis 0 runs along −z, 1 along x, 2 along −y.
        let axes = DMat3::from_cols(-DVec3::Z, DVec3::X, -DVec3::Y);
        let lattice = Lattice::new([5, 6, 7], DVec3::new(1.0, 2.0, 3.0), axes).unwrap();
        assert_eq!(nearest_axes(&lattice), [(1, true), (2, false), (0, false)]);
        let scene = scene_on(lattice, 0.0, Boundary::Open).unwrap();
        let red = scene.polygons().iter().find(|p| p.name == "x_min").unwrap();
        assert!((red.normal() - DVec3::X).length() < 1e-12);
        assert!(red.vertices().iter().all(|v| (v.x - 1.0).abs() < 1e-12));
        let ceiling = scene.polygons().iter().find(|p| p.name == "z_max").unwrap();
        assert!(ceiling.vertices().iter().all(|v| (v.z - 3.0).abs() < 1e-12));
    }

    #[test]
    fn caps_need_a_margin() {
        let lattice = || Lattice::aligned([4, 4, 4], DVec3::ZERO, DVec3::ONE).unwrap();
        assert!(scene_on(lattice(), 0.0, Boundary::Capped).unwrap_err().to_string().contains("margin"));
        assert!(scene_on(lattice(), 0.1, Boundary::Capped).is_ok());
        assert!(scene_on(lattice(), -0.1, Boundary::Open).is_err());
    }
}
