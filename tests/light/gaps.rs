//! Samples that are not finite: the cells around them hold no surface, those beside them hold theirs.

use crate::support::{at_nodes, bumps, run};
use glam::DVec3;
use isolume::bake::{BakeSettings, Engine};
use isolume::field::{Field, Sweep};
use isolume::illumination_grid::GridSize;
use isolume::mask::Mask;
use isolume::scene::{Boundary, Scene, Surface};
use isolume::volume::{Lattice, Samples, Volume};

/// The bumps with a ball of samples missing where many surfaces pass; or the same with all axes of the lattice turned
/// round.
fn bumps_with_a_gap(turned: bool) -> Scene {
    const N: usize = 24;
    let lattice = Lattice::aligned([N; 3], DVec3::ZERO, DVec3::splat(1.0 / (N - 1) as f64)).unwrap();
    let whole = bumps(lattice.clone());
    let sweep = whole.field.sweep();
    let value = |o: usize| {
        let place = DVec3::from_array(lattice.ijk(o).map(|i| i as f64));
        let gap = (place - DVec3::new(12.0, 11.0, 10.0)).length() < 3.5;
        if gap { f64::NAN } else { sweep.from_unit(f64::from(whole.field.samples()[o])) }
    };
    let mut samples: Vec<f64> = (0..lattice.len()).map(value).collect();
    let mut lattice = lattice;
    if turned {
        samples.reverse();
        lattice = Lattice::new([N; 3], DVec3::ONE, -lattice.axes()).unwrap();
    }
    let volume = Volume::new("gap", lattice, Samples::F64(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(sweep.lo(), sweep.hi()).unwrap()).unwrap();
    Scene::new(field, Surface::default(), Boundary::Open, whole.polygons().to_vec()).unwrap()
}

/// Whether some cell that holds a place has finite samples only, and whether some has not.
fn cells(field: &Field, p: DVec3) -> [bool; 2] {
    let dims = field.lattice().dims();
    let around = |a: usize| (0..dims[a] - 1).filter(move |&c| (c as f64..=(c + 1) as f64).contains(&p[a]));
    let mut found = [false; 2];
    for (x, y, z) in around(2).flat_map(|z| around(1).flat_map(move |y| around(0).map(move |x| (x, y, z)))) {
        found[usize::from(!field.corners([x, y, z]).iter().all(|s| s.is_finite()))] = true;
    }
    found
}

/// Points on the border of a gap hold light of their own level set, whichever side of it they lie on: the same as with
/// axes turned round, which puts what is missing on their other side.
#[test]
fn points_beside_a_gap_are_lit_on_all_its_sides() {
    let [scene, turned] = [false, true].map(bumps_with_a_gap);
    for (grid, engine) in [(1, Engine::Photon), (2, Engine::Photon), (1, Engine::Sweep), (2, Engine::Sweep)] {
        let settings = BakeSettings { grid: GridSize::Factor(grid), engine, ..at_nodes(1) };
        let [one, other] = [&scene, &turned].map(|scene| run(scene, &settings));
        let name = format!("{engine:?}, {grid}x");
        for report in [&one.report, &other.report] {
            assert_eq!((report.samples_without_gradient, report.non_finite), (0, 0), "{name}");
        }
        assert_eq!((one.report.masked, one.report.filled), (other.report.masked, other.report.filled), "{name}");
        let (a, b) = (&one.sides[0].1, &other.sides[0].1);
        let scale = scene.lattice().far() / one.lattice.far();
        let (mut squares, mut light, mut count) = (0.0, 0.0, 0);
        for o in 0..one.lattice.len() {
            let p = DVec3::from_array(one.lattice.ijk(o).map(|i| i as f64)) * scale;
            let turned = one.lattice.len() - 1 - o;
            assert_eq!(a.mask[o], b.mask[turned], "{name}: {p}");
            let value = scene.field.value(p);
            let [finite, gap] = cells(&scene.field, p);
            assert_eq!(value.is_finite(), finite, "{name}: {p}");
            if gap && (0.0..=1.0).contains(&value) {
                assert_eq!(a.mask[o], Mask::Valid, "{name}: {p}");
                assert!(a.std_error[o].is_finite() && b.std_error[turned].is_finite(), "{name}: {p}");
                let [x, y] = [a.radiance[o], b.radiance[turned]].map(|rgb| f64::from(rgb[1]));
                (squares, light, count) = (squares + (x - y).powi(2), light + y * y, count + 1);
            }
        }
        let apart = (squares / light).sqrt();
        println!("{name}: {count} points, {:.2} % apart", 100.0 * apart);
        // Lines tell less of where a gap begins than exact rays: 11 % apart.
        let limit = if engine == Engine::Photon { 0.03 } else { 0.15 };
        assert!(count > 300 && apart < limit, "{name}: {count} points, {apart}");
    }
}
