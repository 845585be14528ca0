//! Tests of the simulations: potentials against hand numbers, forces against energies, conservation, clusters.

use super::fluid::{self, Fluid};
use super::molecular_dynamics::{MolecularDynamics, Schedule, spread_evenly};
use super::neighbours::clusters;
use super::pasta::{self, Pasta};
use crate::progress::Progress;
use glam::DVec3;

fn small_pasta() -> Pasta {
    Pasta { nucleons: 600, density: 0.05, ..Pasta::default() }
}

fn small_fluid() -> Fluid {
    Fluid { atoms: 700, ..Fluid::default() }
}

/// Both systems, past the order they start with, so that particles meet.
fn mixed() -> [(&'static str, MolecularDynamics, f64); 2] {
    let mut systems = [("pasta", small_pasta().gas(), Pasta::DT), ("fluid", small_fluid().gas(), Fluid::DT)];
    for (_, md, dt) in &mut systems {
        let t = md.temperature();
        md.run(&[Schedule { from: t, to: 0.5 * t, steps: 300, dt: *dt }], Progress::Quiet).unwrap();
    }
    systems
}

#[test]
fn pair_potentials_are_those_of_the_papers() {
    // By hand: e^−0.8 = 0.449329, e^−0.4 = 0.670320; e^−3.2 = 0.040762, e^−1.6 = 0.201897.
    for (like, r, v) in
        [(true, 1.0, 48.085_55), (false, 1.0, 15.910_18), (true, 2.0, 4.080_05), (false, 2.0, -5.610_98)]
    {
        assert!((pasta::nuclear(like, r)[0] - v).abs() < 1e-5, "{like} {r}: {}", pasta::nuclear(like, r)[0]);
    }
    assert!((pasta::coulomb(2.0)[0] - 0.589_486).abs() < 1e-6);
    assert_eq!(fluid::lennard_jones(1.0)[0], 0.0);
    let [v, d] = fluid::lennard_jones(2.0f64.powf(1.0 / 6.0));
    assert!((v + 1.0).abs() < 1e-12 && d.abs() < 1e-12, "the well is 1 deep: {v} {d}");
    let [v, d] = fluid::wall(0.4f64.powf(1.0 / 6.0));
    assert!((v + 3.0 * 10.0f64.sqrt() / 3.0).abs() < 1e-12 && d.abs() < 1e-12, "√10/3 of its strength: {v} {d}");
    type Potential = fn(f64) -> [f64; 2];
    let slopes: [(&str, Potential); 6] = [
        ("like", |r| pasta::nuclear(true, r)),
        ("unlike", |r| pasta::nuclear(false, r)),
        ("coulomb", pasta::coulomb),
        ("lennard-jones", fluid::lennard_jones),
        ("wall", fluid::wall),
        ("rim", fluid::rim),
    ];
    for (name, f) in slopes {
        for r in [0.8, 1.0, 1.3, 2.2, 4.0] {
            let numeric = (f(r + 1e-5)[0] - f(r - 1e-5)[0]) / 2e-5;
            let slope = f(r)[1];
            assert!((numeric - slope).abs() < 1e-7 * slope.abs().max(1.0), "{name} {r}: {numeric} {slope}");
        }
    }
}

/// Energy of all pairs by the formulas, without table, list or cell.
fn all_pairs(md: &MolecularDynamics, name: &str) -> f64 {
    let shifted = |f: &dyn Fn(f64) -> [f64; 2], cut: f64, r: f64| {
        let [end, slope] = f(cut);
        if r < cut { f(r)[0] - end - (r - cut) * slope } else { 0.0 }
    };
    let size = md.bounds.size;
    let mut energy = 0.0;
    for i in 0..md.positions.len() {
        for j in 0..i {
            let mut d = md.positions[i] - md.positions[j];
            for a in (0..3).filter(|&a| md.bounds.periodic[a]) {
                d[a] -= size[a] * (d[a] / size[a]).round();
            }
            let (r, pair) = (d.length(), (md.species[i], md.species[j]));
            if name == "fluid" {
                energy += shifted(&fluid::lennard_jones, 2.5, r);
                continue;
            }
            energy += shifted(&|r| pasta::nuclear(pair.0 == pair.1, r), 5.5, r);
            if pair == (pasta::PROTON, pasta::PROTON) {
                energy += shifted(&pasta::coulomb, 20.0f64.min(0.5 * size.x - 4.0), r);
            }
        }
        if name == "fluid" {
            for a in 0..3 {
                let (x, of) = (md.positions[i][a], if a == 0 { fluid::wall } else { fluid::rim });
                energy += of(x)[0] + of(size[a] - x)[0];
            }
        }
    }
    energy
}

#[test]
fn cell_lists_sum_what_all_pairs_sum() {
    for (name, md, _) in mixed() {
        let (lists, pairs) = (md.potential_energy(), all_pairs(&md, name));
        assert!((lists - pairs).abs() < 1e-6 * pairs.abs().max(1.0), "{name}: {lists} {pairs}");
    }
}

#[test]
fn forces_are_the_energys_gradient() {
    for (name, mut md, _) in mixed() {
        let start = md.positions.clone();
        let forces: Vec<DVec3> = md.forces().collect();
        for i in [0, 17, 333, 599] {
            for a in 0..3 {
                let mut energy = |step: f64| {
                    let mut moved = start.clone();
                    moved[i][a] += step;
                    md.place(moved);
                    md.potential_energy()
                };
                let numeric = -(energy(1e-4) - energy(-1e-4)) / 2e-4;
                let force = forces[i][a];
                assert!((numeric - force).abs() < 1e-6 * forces[i].length().max(1.0), "{name} {i}: {numeric} {force}");
            }
        }
    }
}

/// At the very step that volumes are made with.
#[test]
fn energy_and_momentum_are_conserved() {
    for (name, mut md, dt) in mixed() {
        // Means over windows: velocity Verlet's energy oscillates about a conserved one.
        const WINDOW: usize = 200;
        let window = |md: &mut MolecularDynamics| {
            let mut sum = 0.0;
            for _ in 0..WINDOW {
                md.step(dt);
                sum += md.kinetic_energy() + md.potential_energy();
            }
            sum / WINDOW as f64
        };
        let p = md.momentum();
        let before = window(&mut md);
        let steps = 2000;
        (0..steps).for_each(|_| md.step(dt));
        let after = window(&mut md);
        let particles = md.positions.len() as f64;
        let per_time = (after - before) / particles / ((steps + WINDOW) as f64 * dt);
        let of_run = (after - before) / md.kinetic_energy();
        println!("{name}: {per_time:e} per particle and time, {of_run:e} of the kinetic energy in {steps} steps");
        assert!(of_run.abs() < 1e-3, "{name}: {of_run:e} of the kinetic energy in {steps} steps");
        // The fluid's walls take momentum.
        let lost = if name == "fluid" { DVec3::ZERO } else { md.momentum() - p };
        let scale: f64 = md.velocities.iter().map(|v| v.length()).sum();
        assert!(lost.length() < 1e-9 * scale, "{name}: {lost}");
    }
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let pasta = Pasta { steps: 60, ..small_pasta() };
        let fluid = Fluid { steps: 60, ..small_fluid() };
        pool.install(|| {
            let (p, f) = (pasta.simulate(Progress::Quiet).unwrap(), fluid.simulate(Progress::Quiet).unwrap());
            p.positions.iter().chain(&f.positions).map(|x| x.to_array().map(f64::to_bits)).collect::<Vec<_>>()
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(5));
    let other = Pasta { steps: 60, seed: 2, ..small_pasta() }.simulate(Progress::Quiet).unwrap();
    assert_ne!(other.positions[0].x.to_bits(), one[0][0], "the seed matters");
}

#[test]
fn nucleons_cluster_when_cooled() {
    // Dilute, so that clusters stay apart.
    let pasta = Pasta { nucleons: 600, density: 0.015, proton_fraction: 0.4, steps: 1500, ..Pasta::default() };
    let (gas, cold) = (pasta.gas(), pasta.simulate(Progress::Quiet).unwrap());
    assert!((cold.temperature() - 1.0).abs() < 0.1, "{} MeV", cold.temperature());
    let protons = cold.species.iter().filter(|&&s| s == pasta::PROTON).count();
    assert_eq!(protons, 240);
    let shares = [&gas, &cold].map(|md| {
        let sizes = clusters(&md.bounds, &md.positions, pasta::LINK);
        sizes.iter().filter(|&&s| s >= 10).sum::<usize>() as f64 / 600.0
    });
    assert!(shares[0] < 0.2 && shares[1] > 0.6, "nucleons in clusters of 10 or more: {shares:?}");
}

#[test]
fn the_liquid_wets_the_walls() {
    let fluid = Fluid { atoms: 700, density: 0.12, steps: 3000, ..Fluid::default() };
    let md = fluid.simulate(Progress::Quiet).unwrap();
    let edge = md.bounds.size.x;
    let wet = |md: &MolecularDynamics| {
        let near = md.positions.iter().filter(|x| x.x.min(edge - x.x) < 1.5).count() as f64;
        near / (700.0 * 3.0 / edge)
    };
    let inside = |x: &DVec3| x.min_element() > 0.4 && x.max_element() < edge - 0.4;
    assert!(md.positions.iter().all(inside), "no atom is in a wall");
    let (before, after) = (wet(&fluid.gas()), wet(&md));
    let rims = md.positions.iter().filter(|x| x.y.min(edge - x.y) < 1.5).count() as f64 / (700.0 * 3.0 / edge);
    assert!(rims < 0.5 * after, "the rims stay dry: {rims} {after}");
    assert!(before < 1.0 && after > 1.5, "density at the walls over the mean: {before} {after}");
}

#[test]
fn particles_begin_apart() {
    for n in [27, 100, 343, 999] {
        let size = DVec3::new(9.0, 11.0, 10.0);
        let x = spread_evenly(size, n, 1);
        assert!(x.iter().all(|x| x.cmpge(DVec3::ZERO).all() && x.cmplt(size).all()));
        let edge = (990.0 / n as f64).cbrt();
        let least = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| x[i].distance(x[j]));
        assert!(least.fold(f64::INFINITY, f64::min) > 0.4 * edge, "{n}");
    }
}

#[test]
fn impossible_numbers_are_refused() {
    let d = Pasta::default();
    for (bad, word) in [
        (Pasta { density: 0.0, ..d }, "--density"),
        (Pasta { proton_fraction: 1.5, ..d }, "--proton-fraction"),
        (Pasta { temperature: f64::NAN, ..d }, "--temperature"),
        (Pasta { nucleons: 50, ..d }, "--particles"),
    ] {
        assert!(bad.simulate(Progress::Quiet).err().unwrap().to_string().contains(word));
    }
    let d = Fluid::default();
    for (bad, word) in [
        (Fluid { density: 2.0, ..d }, "--density"),
        (Fluid { temperature: -1.0, ..d }, "--temperature"),
        (Fluid { atoms: 9, ..d }, "--particles"),
    ] {
        assert!(bad.simulate(Progress::Quiet).err().unwrap().to_string().contains(word));
    }
}
