//! χ² of photon emission and of radiance samples. Both draw from Sobol points, which fill bins more evenly than
//! chance: p near 1 is right, p near 0 is wrong.

use crate::support::*;
use glam::DVec3;
use isolume::field::Field;
use isolume::flattened::Side;
use isolume::photon::PhotonSettings;
use isolume::sampling::{Strategy, positions};
use isolume::stats::{chi_square_p, sidak};
use std::f64::consts::TAU;

/// p of counts against equal shares.
fn even(counts: &[u32]) -> f64 {
    let expected = f64::from(counts.iter().sum::<u32>()) / counts.len() as f64;
    let statistic = counts.iter().map(|&n| (f64::from(n) - expected).powi(2) / expected).sum();
    chi_square_p(statistic, counts.len() - 1)
}

fn bin(x: f64, n: usize) -> usize {
    ((x * n as f64) as usize).min(n - 1)
}

#[test]
fn samplers_agree_with_their_densities() {
    let mut family: Vec<(&str, f64)> = Vec::new();

    // A tiny lamp in the centre of spheres: where a photon lands is the direction it left in. Cosine-distributed: cos²
    // θ and φ are uniform; the isovalue is, too. The lamp's size blurs directions by 1e-3.
    let cavity = field(lattice([33; 3], DVec3::NEG_ONE, DVec3::ONE), 0.25, 0.95, |x| x.length_squared());
    let lamp = rectangle("lamp", DVec3::ZERO, 5e-4 * DVec3::X, 5e-4 * DVec3::Y, 0.0, 1.0);
    let cavity = scene(cavity, grey(0.0, Side::Lower), vec![lamp]);
    let got = photons(&cavity, &PhotonSettings { max_bounces: 0, ..emission(200_000, 11) });
    assert!(got.surface.iter().all(|p| p.side == Side::Lower), "nothing gets out of a closed cavity");
    assert_eq!(got.surface.len(), 200_000);
    let mut counts = vec![0u32; 6 * 12 * 8];
    for p in &got.surface {
        let d = cavity.lattice().to_world(p.position.as_dvec3()).normalize();
        let phi = (d.y.atan2(d.x) / TAU + 1.0) % 1.0;
        counts[(bin(d.z * d.z, 6) * 12 + bin(phi, 12)) * 8 + bin(f64::from(p.isovalue), 8)] += 1;
    }
    family.push(("emission over direction × isovalue", even(&counts)));

    // Two lamps of different shape (one no parallelogram) a hair in front of a wall each: where a photon lands is where
    // it left. 1e-4 of the size apart, so a bin's border blurs by as much.
    let dummy = |lo, hi| field(lattice([3; 3], lo, hi), 0.0, 1.0, |x| x.z - 10.0);
    let field = dummy(DVec3::splat(10.2), DVec3::splat(10.8));
    let square = rectangle("square", 1e-4 * DVec3::Z, DVec3::Y, DVec3::X, 0.0, 1.0);
    let corners = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0)].map(|(x, y)| DVec3::new(x + 4.0, y, 1e-4));
    let triangle =
        isolume::polygon::Polygon::new("triangle", corners.to_vec(), DVec3::ZERO, DVec3::splat(3.0)).unwrap();
    let wall = rectangle("wall", DVec3::ZERO, DVec3::new(8.0, 0.0, 0.0), DVec3::new(0.0, 8.0, 0.0), 0.5, 0.0);
    let plates = scene(field, grey(0.5, Side::Lower), vec![square, triangle, wall]);
    let got = photons(&plates, &PhotonSettings { max_bounces: 0, ..emission(400_000, 12) });
    let (mut on_square, mut on_triangle) = (vec![0u32; 8 * 8 * 4], vec![0u32; 8 * 8 * 4]);
    for p in got.flat.iter().filter(|p| p.flat == 2 && p.bounces == 0) {
        let x = plates.polygons()[2].at([f64::from(p.uvc[0]), f64::from(p.uvc[1])]);
        let c = bin(f64::from(p.uvc[2]), 4);
        if x.x < 2.0 {
            on_square[(bin(0.5 * (x.x + 1.0), 8) * 8 + bin(0.5 * (x.y + 1.0), 8)) * 4 + c] += 1;
        } else {
            // Area coordinates: from the corner at (−1, −1), 1 − (1 − a)² with a + b ≤ 1 the share left of a.
            let (a, b) = (0.5 * (x.x - 3.0), 0.5 * (x.y + 1.0));
            on_triangle[(bin(1.0 - (1.0 - a).powi(2), 8) * 8 + bin(b / (1.0 - a), 8)) * 4 + c] += 1;
        }
    }
    family.push(("emission over a square × isovalue", even(&on_square)));
    family.push(("emission over a triangle × isovalue", even(&on_triangle)));
    // Shares by power: 4 · 1 against 2 · 3, the same in every channel.
    let n = [&on_square, &on_triangle].map(|c| f64::from(c.iter().sum::<u32>()));
    let z2 = (n[0] / (n[0] + n[1]) - 0.4).powi(2) * (n[0] + n[1]) / 0.24;
    family.push(("emission over luminaires", chi_square_p(z2, 1)));

    // Strategies. Uniform over Ω is uniform over the sweep's part of Ω.
    let all: Field = crate::support::field(lattice([5, 9, 3], DVec3::ZERO, DVec3::ONE), 0.0, 1.0, |x| x.y);
    let mut counts = vec![0u32; 8 * 8 * 8];
    for p in positions(&all, &Strategy::Uniform, 200_000, 13).unwrap() {
        let x = p.as_dvec3() / all.lattice().far();
        counts[(bin(x.x, 8) * 8 + bin(x.y, 8)) * 8 + bin(x.z, 8)] += 1;
    }
    family.push(("uniform", even(&counts)));
    let part: Field = crate::support::field(lattice([5, 9, 3], DVec3::ZERO, DVec3::ONE), 0.25, 0.75, |x| x.y);
    let mut counts = vec![0u32; 8 * 8 * 8];
    for p in positions(&part, &Strategy::Uniform, 200_000, 13).unwrap() {
        let x = p.as_dvec3() / part.lattice().far();
        assert!((0.25..=0.75).contains(&x.y));
        counts[(bin(x.x, 8) * 8 + bin(2.0 * x.y - 0.5, 8)) * 8 + bin(x.z, 8)] += 1;
    }
    family.push(("uniform on the sweep", even(&counts)));
    // Diagonal planes: by area. Of each the squares of 1/16 that lie in Ω as a whole, in the shadow on z = 0.
    let mut counts = vec![0u32; 5 * 16 * 16];
    for p in positions(&all, &Strategy::Planes(5), 400_000, 15).unwrap() {
        let x = p.as_dvec3() / all.lattice().far();
        let plane = 5.0 * x.element_sum() / 3.0 - 0.5;
        assert!((plane - plane.round()).abs() < 1e-5);
        counts[(plane.round() as usize * 16 + bin(x.x, 16)) * 16 + bin(x.y, 16)] += 1;
    }
    let whole = |n: &usize| {
        let (sum, x, y) = (3.0 * ((n / 256) as f64 + 0.5) / 5.0, (n / 16 % 16) as f64, (n % 16) as f64);
        let [z0, z1] = [0.0, 2.0].map(|corner| sum - (x + y + corner) / 16.0);
        z1 >= 0.0 && z0 <= 1.0
    };
    let counts: Vec<u32> = (0..counts.len()).filter(whole).map(|n| counts[n]).collect();
    family.push(("planes", even(&counts)));
    // Level sets: by area. Planes y = .3 and y = .7 of a box twice as wide as deep.
    let mut counts = vec![0u32; 2 * 16 * 8];
    for p in positions(&all, &Strategy::LevelSets(vec![0.3, 0.7]), 200_000, 14).unwrap() {
        let x = p.as_dvec3() / all.lattice().far();
        assert!((x.y - 0.3).abs().min((x.y - 0.7).abs()) < 1e-6);
        counts[(usize::from(x.y > 0.5) * 16 + bin(x.x, 16)) * 8 + bin(x.z, 8)] += 1;
    }
    family.push(("level sets", even(&counts)));

    let level = sidak(1e-3, family.len());
    family.iter().for_each(|(what, p)| println!("{what}: p = {p:.4} (level {level:.1e})"));
    assert!(family.iter().all(|(_, p)| *p > level));
}
