//! Where lines end: on walls, on luminaires inside Ω, and on the backs of both.

#![allow(clippy::needless_range_loop, reason = "closures are not compiled for the wider instruction set")]

use super::directions::Shear;
use super::flats::{Flats, Stop};
use super::pack::LANES;
use crate::flattened::Side;
use crate::scene::Scene;
use glam::DVec3;

/// a + b p + c q.
type Affine = [f64; 3];

#[inline]
fn at(f: &Affine, p: f64, q: f64) -> f64 {
    f[0] + f[1] * p + f[2] * q
}

/// A polygon met by the parallel lines of one family: everything is affine in the line's numbers (p, q).
struct Met {
    number: u32,
    /// Its texture.
    flat: u32,
    tau: Affine,
    uv: [Affine; 2],
    /// Inside is where none of these is below −slack.
    edges: Vec<Affine>,
    slack: f64,
    /// Whether its front faces lines that run towards +τ.
    front_plus: bool,
    opaque_back: bool,
    other_face: i32,
    standing: Standing,
    reflects: bool,
}

/// Where a polygon stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Standing {
    pub place: Place,
    /// The wall closely behind it, of which it covers a part.
    pub covers: Option<u32>,
}

/// Where a polygon stands in the volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Place {
    /// Outside Ω or on its faces.
    Outside,
    /// Inside Ω: a luminaire that cuts lines.
    Inside,
    /// So closely before nodes that these show what is in front of it.
    Slit,
}

/// Finds what the lines of one family end on.
pub(super) struct LineEnds {
    met: Vec<Met>,
}

impl LineEnds {
    /// As `side` of the level sets sees them.
    pub(super) fn new(scene: &Scene, (flats, side): (&Flats, Side), shear: &Shear, standing: &[Standing]) -> Self {
        let lattice = scene.lattice();
        let [u, v, a] = shear.layout.axes;
        let [e, f, g] = [u, v, a].map(|x| lattice.axes().col(x));
        let step = shear.slope[0] * e + shear.slope[1] * f + g;
        let start = lattice.origin() + shear.offset[0] * e + shear.offset[1] * f;
        let met = scene
            .polygons()
            .iter()
            .enumerate()
            .filter_map(|(i, p)| {
                let n = p.normal();
                let along = n.dot(step);
                if along.abs() < 1e-9 * step.length() {
                    return None;
                }
                let v = p.vertices();
                let tau = [n.dot(v[0] - start) / along, -n.dot(e) / along, -n.dot(f) / along];
                let point = |p: f64, q: f64| start + p * e + q * f + at(&tau, p, q) * step;
                let affine = |h: &dyn Fn(DVec3) -> f64| {
                    let o = h(point(0.0, 0.0));
                    [o, h(point(1.0, 0.0)) - o, h(point(0.0, 1.0)) - o]
                };
                let size = v.iter().map(|&x| (x - v[0]).length()).fold(0.0, f64::max);
                let edges = (0..v.len())
                    .map(|k| {
                        let (x0, x1) = (v[k], v[(k + 1) % v.len()]);
                        let normal = n.cross(x1 - x0).normalize();
                        affine(&|x| normal.dot(x - x0))
                    })
                    .collect();
                let number = u32::try_from(i).expect("scenes hold fewer than 2¹⁶ polygons");
                Some(Met {
                    number,
                    flat: flats.number(number, side),
                    tau,
                    uv: [affine(&|x| p.texture(x)[0]), affine(&|x| p.texture(x)[1])],
                    edges,
                    slack: 1e-9 * size,
                    front_plus: along < 0.0,
                    opaque_back: p.opaque_back,
                    other_face: p.other_face,
                    standing: standing[i],
                    reflects: flats.textures[i].is_some(),
                })
            })
            .collect();
        Self { met }
    }

    /// Whether lines may be cut inside Ω.
    pub(super) fn cut(&self) -> bool {
        self.met.iter().any(|m| m.standing.place != Place::Outside)
    }

    /// What line (p, q) meets first beyond `from`, towards +τ (`forward`) or −τ; polygon `except` does not
    /// count, nor its other face.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "texture coordinates")]
    pub(super) fn stop(&self, p: f64, q: f64, from: f64, forward: bool, except: Option<u32>) -> Option<Stop> {
        let mut best: Option<(f64, &Met)> = None;
        for m in &self.met {
            let excepted = |e| e == m.number || e == m.number.wrapping_add_signed(m.other_face);
            if (m.front_plus != forward && !m.opaque_back) || except.is_some_and(excepted) {
                continue;
            }
            let tau = at(&m.tau, p, q);
            // 1e-6 of a slice: a wall in Ω's face stands where the line leaves Ω, to rounding.
            let beyond = if forward { tau - from } else { from - tau };
            if !(beyond >= -1e-6) || best.is_some_and(|(t, _)| if forward { t <= tau } else { t >= tau }) {
                continue;
            }
            if m.edges.iter().all(|e| at(e, p, q) >= -m.slack) {
                best = Some((tau, m));
            }
        }
        best.map(|(tau, m)| m.stop(p, q, tau, forward))
    }

    /// [`LineEnds::stop`] of lines first + 0 … 15 of row q from `from`, with their place in [`Flats::packed`].
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "texture coordinates")]
    pub(super) fn stops(
        &self,
        flats: &Flats,
        (first, q): (f64, f64),
        from: &[f64; LANES],
        forward: bool,
        random: &[f32; LANES],
        places: &mut [u32; LANES],
    ) {
        let mut best = [if forward { f64::INFINITY } else { f64::NEG_INFINITY }; LANES];
        let mut which = [u32::MAX; LANES];
        let sign = if forward { 1.0 } else { -1.0 };
        for (number, m) in self.met.iter().enumerate() {
            if m.front_plus != forward && !m.opaque_back {
                continue;
            }
            let (t0, dt) = (at(&m.tau, first, q), m.tau[1]);
            let mut tau = [0f64; LANES];
            let mut slack = [f64::INFINITY; LANES];
            for l in 0..LANES {
                tau[l] = t0 + l as f64 * dt;
            }
            for e in &m.edges {
                let (e0, de) = (at(e, first, q), e[1]);
                for l in 0..LANES {
                    slack[l] = slack[l].min(e0 + l as f64 * de);
                }
            }
            for l in 0..LANES {
                // 1e-6 of a slice, as in `stop`.
                let beyond = (sign * (tau[l] - from[l]) >= -1e-6) & (sign * tau[l] < sign * best[l]);
                let ok = beyond & (slack[l] >= -m.slack);
                best[l] = if ok { tau[l] } else { best[l] };
                which[l] = if ok { number as u32 } else { which[l] };
            }
        }
        *places = [0; LANES];
        for (number, m) in self.met.iter().enumerate() {
            if m.front_plus != forward || !m.reflects || !which.contains(&(number as u32)) {
                continue;
            }
            let mut uv = [[0f32; LANES]; 2];
            for a in 0..2 {
                for l in 0..LANES {
                    uv[a][l] = at(&m.uv[a], first + l as f64, q).clamp(0.0, 1.0) as f32;
                }
            }
            let there = flats.places(m.flat, &uv, random);
            for l in 0..LANES {
                places[l] = if which[l] == number as u32 { there[l] } else { places[l] };
            }
        }
    }

    /// Every reflecting front that line (p, q) meets, and whether it looks towards +τ.
    #[inline(always)]
    pub(super) fn fronts(&self, p: f64, q: f64) -> impl Iterator<Item = (Stop, bool)> {
        let met = move |m: &&Met| m.reflects && m.edges.iter().all(|e| at(e, p, q) >= -m.slack);
        self.met.iter().filter(met).map(move |m| (m.stop(p, q, at(&m.tau, p, q), m.front_plus), !m.front_plus))
    }

    /// The luminaires that cut line (p, q) between `from` and `to`, in order of τ: how each looks from before and
    /// behind, and the τ behind whose slice it cuts. Surfaces between a luminaire and the last slice in front of it are
    /// read at the one behind if that is nearer, and shows what is in front.
    pub(super) fn cuts(&self, p: f64, q: f64, from: f64, to: f64, out: &mut Vec<(f64, [Stop; 2])>) {
        out.clear();
        for m in self.met.iter().filter(|m| m.standing.place != Place::Outside) {
            let tau = at(&m.tau, p, q);
            if tau > from + 1e-6 && tau < to - 1e-6 && m.edges.iter().all(|e| at(e, p, q) >= -m.slack) {
                let at = match m.standing.place {
                    Place::Slit if m.front_plus => tau + 0.5,
                    Place::Slit => tau - 0.5,
                    _ => tau,
                };
                out.push((at, [m.stop(p, q, tau, true), m.stop(p, q, tau, false)]));
            }
        }
        out.sort_by(|a, b| a.1[0].tau.total_cmp(&b.1[0].tau));
    }
}

impl Met {
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "texture coordinates")]
    fn stop(&self, p: f64, q: f64, tau: f64, forward: bool) -> Stop {
        let front = self.front_plus == forward;
        let uv = [0, 1].map(|a| at(&self.uv[a], p, q).clamp(0.0, 1.0) as f32);
        let covers = if front { None } else { self.standing.covers };
        Stop { tau, polygon: self.number, flat: (front && self.reflects).then_some(self.flat), uv, covers }
    }
}

/// Polygons that reach into the interior of Ω (by more than 1e-6 of a cell).
pub(super) fn inside(scene: &Scene) -> Vec<bool> {
    let far = scene.lattice().far();
    scene
        .polygons()
        .iter()
        .map(|p| {
            let mut points: Vec<DVec3> = p.vertices().iter().map(|&x| scene.lattice().to_index(x)).collect();
            for a in 0..3 {
                for (sign, plane) in [(1.0, 1e-6), (-1.0, -(far[a] - 1e-6))] {
                    let height = |x: DVec3| sign * x[a] - plane;
                    let mut kept = Vec::new();
                    for (i, &x) in points.iter().enumerate() {
                        let y = points[(i + 1) % points.len()];
                        let (hx, hy) = (height(x), height(y));
                        if hx > 0.0 {
                            kept.push(x);
                        }
                        if (hx > 0.0) != (hy > 0.0) {
                            kept.push(x + (y - x) * (hx / (hx - hy)));
                        }
                    }
                    points = kept;
                }
            }
            points.len() >= 3
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::polygon::Polygon;
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::sweep::pack::Plan;
    use crate::volume::generate::Generator;

    /// Sixteen lines at a time against one, from outside Ω and from inside; and what they read of four texels against
    /// their mean.
    #[test]
    fn lines_together_end_where_each_does() {
        let volume = Generator::from_name("bumps").and_then(|g| g.sample([12; 3])).unwrap();
        let field = Field::new(&volume, Sweep::new(3.6, 95.0).unwrap()).unwrap();
        let mut walls = cornell_box(field.lattice(), 0.1).unwrap();
        // Some whose backs stop lines, too.
        walls.iter_mut().step_by(2).for_each(|w| w.opaque_back = true);
        let scene = crate::scene::Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let mut flats = Flats::new(&scene, &[Side::Lower], 8, 5);
        let mut rng = Rng::stream(5, Stage::Test, 0);
        for t in flats.textures.iter_mut().flatten() {
            t.radiance.iter_mut().for_each(|b| *b = rng.unit() as f32);
        }
        flats.pack(1.0);
        let standing = vec![Standing { place: Place::Outside, covers: None }; scene.polygons().len()];
        let (mut black, mut lit, mut worst) = (0, 0, 0f64);
        for _ in 0..40 {
            let omega = crate::warp::sphere(rng.unit2());
            let plan = Plan::new(Shear::new(scene.lattice(), omega, rng.unit2()), 1.0);
            let ends = LineEnds::new(&scene, (&flats, Side::Lower), &plan.shear, &standing);
            let (first, q) = ((rng.unit() * 12.0).floor() - 8.0, (rng.unit() * 12.0).floor());
            let random: [f32; LANES] = std::array::from_fn(|_| rng.unit() as f32);
            for forward in [true, false] {
                let from: [f64; LANES] = std::array::from_fn(|_| 14.0 * rng.unit() - 1.0);
                let mut places = [7; LANES];
                ends.stops(&flats, (first, q), &from, forward, &random, &mut places);
                for l in 0..LANES {
                    let stop = ends.stop(first + l as f64, q, from[l], forward, None);
                    assert_eq!(places[l], flats.place(stop, random[l]), "{omega} {first} + {l}, {q}: {stop:?}");
                    let Some(stop) = stop.filter(|s| s.flat.is_some()) else {
                        assert_eq!(places[l], 0);
                        black += 1;
                        continue;
                    };
                    lit += 1;
                    let mut column = [0f32; 15];
                    flats.textures[stop.flat.unwrap() as usize].as_ref().unwrap().column(stop.uv, &mut column);
                    let draws = 2000;
                    let red = (0..draws).map(|i| {
                        let place = flats.place(Some(stop), (i as f32 + 0.5) / draws as f32);
                        f64::from(crate::sweep::half::decode(flats.packed[place as usize + 2][0]))
                    });
                    worst = worst.max((red.sum::<f64>() / f64::from(draws) - f64::from(column[2])).abs());
                }
            }
        }
        println!("{lit} lines end on walls, {black} on nothing; the mean of texels is off by at most {worst:.1e}");
        // Steps of 1 / draws, and halves.
        assert!(black > 20 && lit > 200 && worst < 2e-3);
    }

    /// A luminaire within the volume cuts the lines that pass through it, and shows its front to those that come from
    /// there; the wall that it covers is seen from behind only.
    #[test]
    fn luminaires_cut_lines_within_their_edges() {
        let volume = Generator::from_name("bumps").and_then(|g| g.sample([12; 3])).unwrap();
        let field = Field::new(&volume, Sweep::new(3.6, 95.0).unwrap()).unwrap();
        let (middle, half) = (DVec3::new(5.2, 5.7, 5.5), 2.0);
        let corners = [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)]
            .map(|(x, y)| field.lattice().to_world(middle + half * DVec3::new(x, y, 0.0)));
        let lamp = Polygon::new("lamp", corners.to_vec(), DVec3::ONE, DVec3::ONE).unwrap();
        let down = lamp.normal().z < 0.0;
        let scene = crate::scene::Scene::new(field, Surface::default(), Boundary::Open, vec![lamp]).unwrap();
        let flats = Flats::new(&scene, &[Side::Lower], 8, 5);
        let standing = [Standing { place: Place::Inside, covers: Some(7) }];
        let mut rng = Rng::stream(6, Stage::Test, 0);
        let (mut through, mut beside, mut out) = (0, 0, Vec::new());
        for _ in 0..400 {
            let shear = Shear::new(scene.lattice(), crate::warp::sphere(rng.unit2()), rng.unit2());
            let ends = LineEnds::new(&scene, (&flats, Side::Lower), &shear, &standing);
            let axes = shear.layout.axes;
            for _ in 0..50 {
                let [p, q] = [(); 2].map(|()| (24.0 * rng.unit() - 12.0).floor());
                let place = |tau: f64| {
                    let mut x = DVec3::ZERO;
                    x[axes[0]] = p + shear.offset[0] + shear.slope[0] * tau;
                    x[axes[1]] = q + shear.offset[1] + shear.slope[1] * tau;
                    x[axes[2]] = tau;
                    x
                };
                // Where it passes the luminaire's plane.
                let rise = place(1.0).z - place(0.0).z;
                let tau = (middle.z - place(0.0).z) / rise;
                let off = (place(tau) - middle).abs();
                let farthest = off.x.max(off.y) - half;
                if farthest.abs() < 1e-6 || !(1e-3..=10.999).contains(&tau) {
                    continue;
                }
                ends.cuts(p, q, 0.0, 11.0, &mut out);
                if farthest > 0.0 {
                    assert!(out.is_empty(), "{farthest} beside: {out:?}");
                    beside += 1;
                    continue;
                }
                let [(at, [before, behind])] = out[..] else { panic!("{out:?}") };
                assert!((at - tau).abs() < 1e-9);
                // From before it looks towards +τ.
                let front_first = (rise > 0.0) == down;
                let (front, back) = if front_first { (before, behind) } else { (behind, before) };
                assert_eq!((front.covers, back.covers), (None, Some(7)));
                assert!(front.flat.is_some() && back.flat.is_none());
                through += 1;
            }
        }
        assert!(through > 200 && beside > 2000, "{through}, {beside}");
    }
}
