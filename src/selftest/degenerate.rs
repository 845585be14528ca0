//! Degenerate input: every one gives a defined result or a clear error, no output holds a NaN, and counts are kept.

use super::{Case, Tally};
use crate::bake::{Bake, BakeOptions, BakeSettings, Engine, bake};
use crate::embree::{Device, GraphTracer};
use crate::error::{Error, Result};
use crate::field::{Field, Sweep};
use crate::flat::FlatLight;
use crate::flattened::FlattenedRay;
use crate::mask::Mask;
use crate::polygon::Polygon;
use crate::progress::Progress;
use crate::scene::{Boundary, Scene, Surface, cornell_box};
use crate::surface_mesh::{SurfaceMesh, unit_isovalue};
use crate::tracer::Tracer;
use crate::volume::generate::Generator;
use crate::volume::{Lattice, Samples, Volume};
use glam::{DVec3, Vec3};

type Outcome = std::result::Result<(), String>;

/// What is expected of a bake.
enum Expect {
    /// Light somewhere.
    Light,
    /// A finished bake, whatever its light.
    Any,
    /// A finished bake, all black.
    Black,
    /// A finished bake; so many voxels that are not finite.
    NonFinite(u64),
    /// An `Invalid` whose message holds this.
    Refusal(&'static str),
}

struct Input {
    name: &'static str,
    dims: [usize; 3],
    sweep: [f64; 2],
    h: Box<dyn Fn([usize; 3], DVec3) -> f64>,
    surface: Surface,
    boundary: Boundary,
    margin: f64,
    walls: Walls,
    expect: Expect,
}

enum Walls {
    Box,
    None,
    /// A luminaire of this centre (unit coordinates) and half edge, facing down, and nothing else.
    Luminaire(DVec3, f64),
    /// The same with the box's walls.
    BoxAndLuminaire(DVec3, f64),
}

fn bumps(_: [usize; 3], x: DVec3) -> f64 {
    Generator::Bumps.value(x)
}

fn input(name: &'static str) -> Input {
    Input {
        name,
        dims: [12; 3],
        sweep: [3.6, 95.0],
        h: Box::new(bumps),
        surface: Surface::default(),
        boundary: Boundary::Open,
        margin: 0.0,
        walls: Walls::Box,
        expect: Expect::Light,
    }
}

/// The inputs. Each one is baked by both engines.
fn inputs() -> Vec<Input> {
    let with = |name, h: fn([usize; 3], DVec3) -> f64| Input { h: Box::new(h), ..input(name) };
    let albedo = |a: f64| Surface { albedo: DVec3::splat(a).into(), ..Surface::default() };
    let inside = DVec3::new(0.5, 0.5, 0.38);
    vec![
        input("plain bumps"),
        Input { expect: Expect::Refusal("outside the data"), ..with("constant volume", |_, _| 1.0) },
        Input {
            sweep: [0.0, 2.0],
            expect: Expect::Refusal("constant"),
            ..with("constant volume inside the sweep", |_, _| 1.0)
        },
        Input { dims: [12, 12, 2], ..input("one cell thick in z") },
        Input {
            dims: [2, 12, 12],
            ..with("one cell thick in x", |_, x| bumps([0; 3], DVec3::new(0.3 + 0.4 * x.x, x.y, x.z)))
        },
        Input { dims: [12, 12, 1], expect: Expect::Refusal("at least 2"), ..input("one sample thick") },
        Input {
            dims: [2; 3],
            sweep: [0.0, 1.0],
            ..with("2×2×2", |[i, j, k], _| [0.1, 0.9, 0.4, 0.2, 0.8, 0.3, 0.6, 0.5][i + 2 * j + 4 * k])
        },
        Input {
            expect: Expect::NonFinite(1),
            ..with("one NaN", |ijk, x| if ijk == [5, 6, 4] { f64::NAN } else { bumps(ijk, x) })
        },
        Input {
            expect: Expect::NonFinite(2),
            ..with("+∞ and −∞", |ijk, x| match ijk {
                [5, 6, 4] => f64::INFINITY,
                [6, 5, 7] => f64::NEG_INFINITY,
                _ => bumps(ijk, x),
            })
        },
        Input {
            expect: Expect::NonFinite(12 * 12 * 4),
            ..with("a third of NaN", |ijk, x| if ijk[2] < 4 { f64::NAN } else { bumps(ijk, x) })
        },
        Input { expect: Expect::Refusal("is finite"), ..with("all NaN", |_, _| f64::NAN) },
        Input { expect: Expect::Refusal("is finite"), ..with("all ∞", |_, _| f64::INFINITY) },
        Input {
            sweep: [0.0, 1.0],
            ..with("values −1e30 … 1e30", |[i, j, k], x| if (i + j + k) % 5 == 0 { 1e30 * (x.x - 0.5) } else { x.z })
        },
        Input { sweep: [500.0, 600.0], expect: Expect::Refusal("outside the data"), ..input("sweep beyond the data") },
        Input { sweep: [-1000.0, 1000.0], ..input("sweep wider than the data") },
        Input { sweep: [0.0, 33.0], ..with("sweep of exactly the data's range", |[i, j, k], _| (i + j + k) as f64) },
        Input {
            sweep: [33.0, 40.0],
            expect: Expect::Refusal("outside the data"),
            ..with("sweep that begins at the greatest value", |[i, j, k], _| (i + j + k) as f64)
        },
        Input {
            sweep: [-7.0, 0.0],
            expect: Expect::Refusal("outside the data"),
            ..with("sweep that ends at the least value", |[i, j, k], _| (i + j + k) as f64)
        },
        Input { sweep: [47.0, 47.0 + 1e-9], expect: Expect::Refusal("no grid point"), ..input("sweep of width 1e-9") },
        with("step edge and plateaus", |_, x| if x.x > 0.4 { 95.0 } else { 0.0 }),
        Input { walls: Walls::None, expect: Expect::Black, ..input("no walls, no luminaire") },
        Input { walls: Walls::Luminaire(DVec3::new(0.5, 0.5, 0.999), 0.2), ..input("a luminaire and no walls") },
        Input { walls: Walls::Luminaire(inside, 0.05), expect: Expect::Any, ..input("luminaire inside the solid") },
        Input { walls: Walls::Luminaire(DVec3::new(0.5, 0.5, 0.6), 0.3), ..input("luminaire that level sets cut") },
        Input {
            sweep: [0.0, 1.0],
            surface: Surface { outside: crate::flattened::Side::Higher, ..Surface::default() },
            walls: Walls::Luminaire(DVec3::new(0.5, 0.5, 6.0 / 11.0), 0.25),
            ..with("luminaire that touches a level set", |_, x| x.z)
        },
        Input { walls: Walls::BoxAndLuminaire(DVec3::new(0.5, 0.5, 1.0), 0.2), ..input("luminaire in the ceiling") },
        Input {
            walls: Walls::BoxAndLuminaire(DVec3::new(0.5, 0.5, 0.5), 0.5),
            ..input("luminaire touching all walls")
        },
        // On so coarse a lattice h is 91 there, and level sets above that would see it.
        Input {
            sweep: [3.6, 80.0],
            walls: Walls::Luminaire(inside, 0.001),
            expect: Expect::Black,
            ..input("tiny luminaire inside")
        },
        Input { surface: albedo(0.0), expect: Expect::Black, ..input("albedo 0") },
        Input { surface: albedo(1.0), ..input("albedo 1") },
        // Light in a closed ball that reflects all of it: paths end by their cap only.
        Input {
            surface: albedo(1.0),
            sweep: [0.01, 0.2],
            walls: Walls::Luminaire(DVec3::splat(0.5), 0.02),
            ..with("albedo 1, light in a closed ball", |_, x| (x - 0.5).length_squared())
        },
        Input {
            surface: Surface { outside: crate::flattened::Side::Higher, both_sides: true, ..Surface::default() },
            // Bumps upside down: what is higher is what light reaches.
            ..with("both sides, outside higher", |i, x| 98.6 - bumps(i, x))
        },
        // Nothing lights the inside of bumps.
        Input {
            surface: Surface { outside: crate::flattened::Side::Higher, both_sides: true, ..Surface::default() },
            expect: Expect::Any,
            ..input("both sides, outside within solids")
        },
        Input { boundary: Boundary::Capped, margin: 0.2, ..input("capped") },
        Input { boundary: Boundary::Capped, expect: Expect::Refusal("margin"), ..input("capped without a margin") },
    ]
}

fn scene(input: &Input) -> Result<Scene> {
    let spacing = DVec3::from_array(input.dims.map(|n| 1.0 / (n.max(2) - 1) as f64));
    let lattice = Lattice::aligned(input.dims, DVec3::ZERO, spacing)?;
    let samples = (0..lattice.len())
        .map(|o| {
            let ijk = lattice.ijk(o);
            (input.h)(ijk, lattice.to_world(DVec3::from_array(ijk.map(|i| i as f64))))
        })
        .collect();
    let volume = Volume::new(input.name, lattice, Samples::F64(samples))?;
    let field = Field::new(&volume, Sweep::new(input.sweep[0], input.sweep[1])?)?;
    let lamp = |centre: DVec3, half: f64| {
        let v = [(-1., -1.), (-1., 1.), (1., 1.), (1., -1.)].map(|(x, y)| centre + half * DVec3::new(x, y, 0.0));
        Polygon::new("lamp", v.to_vec(), DVec3::ZERO, DVec3::ONE)
    };
    let polygons = match input.walls {
        Walls::None => Vec::new(),
        Walls::Box => cornell_box(field.lattice(), input.margin)?,
        Walls::Luminaire(centre, half) => vec![lamp(centre, half)?],
        Walls::BoxAndLuminaire(centre, half) => {
            let walls = cornell_box(field.lattice(), input.margin)?;
            let mut all: Vec<_> = walls.into_iter().filter(|p| p.emission == DVec3::ZERO).collect();
            all.push(lamp(centre, half)?);
            all
        }
    };
    Scene::new(field, input.surface.clone(), input.boundary, polygons)
}

/// Every number of a bake that a viewer would read.
fn numbers(bake: &Bake) -> impl Iterator<Item = f32> {
    let grids = bake.sides.iter().flat_map(|(_, g)| g.radiance.as_flattened().iter().chain(&g.std_error));
    let flats = bake.flats.iter().flatten().flat_map(FlatLight::textures).flat_map(|t| t.texels.as_flattened());
    grids.chain(flats).copied()
}

fn judge(input: &Input, engine: Engine, device: &Device) -> Outcome {
    let options = BakeOptions {
        photons: Some(1 << 12),
        gather_rays: Some(8),
        shadow_rays: Some(8),
        directions: Some(32),
        light_points: Some(8),
        wall_resolution: Some(8),
        ..BakeOptions::default()
    };
    let settings = BakeSettings::with_engine(&options, engine).map_err(|e| e.to_string())?;
    let result = scene(input).and_then(|scene| bake(&scene, &settings, device, Progress::Quiet));
    let bake = match (result, &input.expect) {
        (Ok(bake), Expect::Refusal(_)) => return Err(format!("was baked: {} points", bake.lattice.len())),
        (Ok(bake), _) => bake,
        (Err(Error::Invalid(message)), Expect::Refusal(words)) if message.contains(words) => return Ok(()),
        (Err(e), _) => return Err(format!("refused: {e}")),
    };
    let bad = numbers(&bake).filter(|x| !x.is_finite()).count();
    if bad > 0 || bake.report.non_finite > 0 {
        return Err(format!("{bad} numbers are not finite, {} were cleared", bake.report.non_finite));
    }
    if numbers(&bake).any(|x| x < 0.0) {
        return Err("negative radiance".into());
    }
    let report = serde_json::to_value(&bake.report).map_err(|e| e.to_string())?;
    // JSON has no NaN: it becomes null. Settings may be null where the preset decides.
    let null =
        report.as_object().into_iter().flatten().find(|(k, v)| *k != "settings" && v.to_string().contains("null"));
    if let Some((key, value)) = null {
        return Err(format!("the report's {key} is {value}"));
    }
    let lit = bake.sides[0].1.radiance.as_flattened().iter().any(|&x| x > 0.0);
    let masks = &bake.sides[0].1.mask;
    let wrong = match input.expect {
        Expect::Any => false,
        Expect::Light => !lit,
        Expect::Black => lit,
        Expect::NonFinite(n) => !lit || bake.report.non_finite_voxels != n,
        Expect::Refusal(_) => true,
    };
    let masked = masks.iter().filter(|&&m| m != Mask::Valid).count() as u64;
    if wrong || masked != bake.report.masked {
        return Err(format!(
            "light: {lit}, {} voxels not finite, {} masked of {masked}",
            bake.report.non_finite_voxels, bake.report.masked
        ));
    }
    Ok(())
}

/// Isovalues at, just inside and just outside the ends of data and sweep.
fn bounds() -> std::result::Result<u64, String> {
    let mut trials = 0;
    let text = |e: Error| e.to_string();
    let volume = Generator::Bumps.sample([9; 3]).map_err(text)?;
    let (min, max) = volume.range().ok_or("no range")?;
    let field = Field::new(&volume, Sweep::new(min, max).map_err(text)?).map_err(text)?;
    let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).map_err(text)?;
    let device = Device::new(1).map_err(text)?;
    let tracer = GraphTracer::new(&device, &scene).map_err(text)?;
    for (c, inside) in [
        (min, true),
        (max, true),
        (min.next_up(), true),
        (max.next_down(), true),
        (min.next_down(), false),
        (max.next_up(), false),
        (f64::NAN, false),
        (f64::INFINITY, false),
        (f64::NEG_INFINITY, false),
    ] {
        trials += 1;
        let unit = unit_isovalue(&scene.field, c);
        if unit.is_ok() != inside {
            return Err(format!("isovalue {c} of [{min}, {max}]: {unit:?}"));
        }
        // A mesh, or a clear refusal where the set has no surface: above everything, or all inside.
        if let Ok(unit) = unit {
            match SurfaceMesh::extract(&scene, unit, 1) {
                Ok(mesh)
                    if mesh.positions.iter().all(|x| x.is_finite()) && mesh.normals.iter().all(|n| n.is_finite()) => {}
                Err(Error::Invalid(_)) => {}
                other => return Err(format!("isovalue {c}: {:?}", other.map(|m| m.positions.len()))),
            }
        }
    }
    // Rays at any isovalue, also ones that no sweep allows.
    for c in
        [0.0, -0.0, 1.0, -1e-30, 1.0f32.next_up(), 1e30, -1e30, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, f32::NAN]
    {
        for d in [Vec3::X, Vec3::new(0.3, -0.4, 0.5), Vec3::ZERO, Vec3::splat(f32::NAN), Vec3::new(1e38, 1e-38, 0.0)] {
            for o in [Vec3::splat(4.0), Vec3::ZERO, Vec3::splat(8.0), Vec3::splat(-1e30), Vec3::splat(f32::NAN)] {
                trials += 1;
                let ray = FlattenedRay::free(o, d, c);
                let hit = tracer.intersect(&ray);
                if hit.is_some() != tracer.occluded(&ray) || hit.is_some_and(|h| !(h.t >= 0.0)) {
                    return Err(format!("{ray:?} found {hit:?}"));
                }
            }
        }
    }
    Ok(trials)
}

/// All degenerate inputs.
///
/// # Errors
/// None of its own; whatever goes wrong is a failure of a case.
pub fn cases(device: &Device) -> Result<Vec<Case>> {
    let mut cases = Vec::new();
    for base in inputs() {
        let mut tally = Tally::default();
        for (n, engine) in [Engine::Photon, Engine::Sweep].into_iter().enumerate() {
            let outcome = judge(&base, engine, device).map(|()| 0.0).map_err(|e| format!("{engine:?} engine: {e}"));
            tally.push(n as u64, outcome);
        }
        let note = match base.expect {
            Expect::Light => "light, all finite",
            Expect::Any => "all finite",
            Expect::Black => "black, all finite",
            Expect::NonFinite(_) => "counted, masked, all finite",
            Expect::Refusal(_) => "a clear error",
        };
        cases.push(tally.case("degenerate", base.name, None, note));
    }
    let mut tally = Tally::default();
    match bounds() {
        Ok(trials) => tally.trials = trials,
        Err(e) => tally.push(0, Err(e)),
    }
    cases.push(tally.case("degenerate", "isovalues and rays at and beyond the bounds", None, "defined"));
    Ok(cases)
}
