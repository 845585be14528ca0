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
