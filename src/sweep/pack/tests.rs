use super::*;
use crate::volume::Lattice;
use glam::DVec3;

/// Oblique lines, and such as are parallel to one or two pairs of sides, some of them outside.
#[test]
fn spans_are_where_lines_lie_in_omega() {
    let dims = [6, 9, 7];
    let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
    let far = dims.map(|n| n as f64 - 1.0);
    let (mut within, mut missed) = (0, 0);
    for (i, omega) in
        [[0.4, -0.7, 1.0], [-0.9, 0.2, -1.0], [0.0, 0.6, 1.0], [0.3, 0.0, 1.0], [0.0, 0.0, 1.0]].into_iter().enumerate()
    {
        let shear = Shear::new(&lattice, DVec3::from_array(omega), [0.3, 0.11 * i as f64]);
        let plan = Plan::new(shear, 1.0);
        for q in -9..16 {
            let spans = plan.spans(-5.0, f64::from(q));
            for lane in 0..LANES {
                let (p, q) = (lane as f64 - 5.0, f64::from(q));
                let span = spans.map(|s| s[lane]);
                for step in -20..160 {
                    let tau = 0.05 * f64::from(step) + 1e-3;
                    let x =
                        [p + shear.offset[0] + shear.slope[0] * tau, q + shear.offset[1] + shear.slope[1] * tau, tau];
                    let inside = x.iter().zip(far).all(|(x, far)| *x >= 0.0 && *x <= far);
                    let count = if inside { &mut within } else { &mut missed };
                    *count += 1;
                    assert_eq!((span[0]..=span[1]).contains(&tau), inside, "{omega:?} {p} {q} {tau}: {span:?}");
                }
            }
        }
    }
    assert!(within > 1000 && missed > 1000);
}

/// Of the nodes around a sample those of its isovalue are read, and where all are as near to it, by their weights.
#[test]
fn nodes_that_stand_for_samples_are_on_their_level_set() {
    let slope =
        |g: [f32; 2]| -> [Lanes; 4] { std::array::from_fn(|n| [g[0] * (n % 2) as f32 + g[1] * (n / 2) as f32; LANES]) };
    let mut rng = crate::rng::Rng::stream(2, crate::rng::Stage::Test, 0);
    let mut pack = Pack::with_rows(3);
    // Mean offset of the node from the sample along u and v, and mean square of how far off its isovalue is.
    let mut offsets = |g: [f32; 2], sign: f32, count: u32| {
        let rows = slope(g);
        let (mut mean, mut square) = ([0.0; 2], 0.0);
        for _ in 0..count {
            let [fu, fv] = rng.unit2().map(|f| f as f32);
            let weight = [(1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv];
            let rows = rows.each_ref();
            pack.take(&weight, sign, rows, 1, (0, LANES));
            pack.choose(&weight, sign, rows, (1000, [1, 10, 5000]), rng.unit() as f32, 1);
            for (l, node) in pack.node[1].iter().enumerate() {
                let n = *node as usize - 1000 - l;
                let off = [(n % 10) as f32 - fu, (n / 10) as f32 - fv];
                mean = [0, 1].map(|a| mean[a] + f64::from(off[a]));
                square += f64::from(g[0] * off[0] + g[1] * off[1]).powi(2);
            }
        }
        let all = f64::from(count * LANES as u32);
        (mean.map(|m| m / all), square / all)
    };
    // Bilinear weights alone have a mean square of (g₀² + g₁²) / 6.
    for (g, sign, most) in
        [([0.3, 0.0], 1.0, 0.09 / 9.0), ([0.3, 0.2], -1.0, 0.13 / 20.0), ([2e-6, -2e-6], 1.0, 8e-12 / 15.0)]
    {
        let (mean, square) = offsets(g, sign, 20_000);
        println!("{g:?}: offsets {mean:?}, mean square {square:e} of at most {most:e}");
        assert!(mean.iter().all(|m| m.abs() < 0.015), "{g:?}: {mean:?}");
        assert!(square < most, "{g:?}: {square:e}");
    }
    // A flat row: weights decide.
    let mut count = [0; 4];
    for n in 0..40_000u32 {
        let flat = [[0.25; LANES]; 4];
        pack.take(&[0.4, 0.3, 0.2, 0.1], 1.0, flat.each_ref(), 1, (0, LANES));
        pack.choose(&[0.4, 0.3, 0.2, 0.1], 1.0, flat.each_ref(), (0, [1, 100, 5000]), n as f32 / 40_000.0, 1);
        let n = pack.node[1][0] as usize;
        count[n % 100 + n / 100 * 2] += 1;
    }
    assert_eq!(count.map(|n| (n + 50) / 100), [160, 120, 80, 40]);
    // What is too large to be squared, or no number, is far away.
    for far in [f32::MAX, f32::INFINITY, f32::NAN] {
        let rows = [[0.5; LANES], [far; LANES], [0.5; LANES], [-1e30; LANES]];
        pack.h[1] = [0.5; LANES];
        pack.choose(&[0.25; 4], 1.0, rows.each_ref(), (0, [1, 100, 5000]), 0.9, 1);
        assert_eq!(pack.node[1][0], 100, "{far}");
    }
    // On a flat edge of a cell, amid it: what weighs nothing is never read.
    let rows = [[0.5; LANES], [0.7; LANES], [0.5; LANES], [0.7; LANES]];
    for n in 0..100u8 {
        pack.choose(&[0.5, 0.0, 0.5, 0.0], 1.0, rows.each_ref(), (0, [1, 100, 5000]), f32::from(n) / 100.0, 1);
        assert_eq!(pack.node[1][0], if n < 50 { 0 } else { 100 }, "{n}");
    }
}
