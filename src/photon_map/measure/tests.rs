use super::*;
use crate::field::Sweep;
use crate::rng::{Rng, Stage};
use crate::volume::{Lattice, Samples, Volume};
use glam::DMat3;

fn field(lattice: Lattice, mut h: impl FnMut([usize; 3]) -> f64) -> Field {
    let samples = (0..lattice.len()).map(|o| h(lattice.ijk(o))).collect();
    let volume = Volume::new("test", lattice, Samples::F64(samples)).unwrap();
    Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap()
}

fn oblique(dims: [usize; 3]) -> Lattice {
    let axes = DMat3::from_cols(DVec3::new(-0.5, 0.1, 0.0), DVec3::new(0.2, 0.7, 0.0), DVec3::new(0.0, 0.3, 2.0));
    Lattice::new(dims, DVec3::new(10.0, -3.0, 1e3), axes).unwrap()
}

#[test]
fn rows_read_what_points_read() {
    let mut rng = Rng::stream(3, Stage::Test, 0);
    let noise = field(oblique([9, 7, 8]), |_| rng.unit());
    for factor in [1, 2, 3] {
        let cells = Cells::new([factor; 3], noise.lattice().dims());
        let points = Points::new(&noise, &cells, 0.1);
        let slots = |axis: usize| points.across[axis - 1].iter().flatten();
        let (mut nodes, mut block, mut compared) = (Default::default(), Block::default(), 0);
        for (y, z) in slots(2).flat_map(|z| slots(1).map(move |y| (y, z))) {
            assert!(points.regular(y.cell, z.cell) && points.reach(y, z) == Some([0, 9]));
            let along = points.along.iter().flat_map(|a| a.slots.iter().flatten().map(move |x| (a, x)));
            for (range, (along, x)) in along.flat_map(|x| [[0, 9], [2, 7]].map(|r| (r, x))) {
                if x.cell < range[0] || x.cell + 1 >= range[1] {
                    continue;
                }
                points.read_nodes([y, z], range, &mut nodes);
                block.read(&nodes, along, x.node, 1);
                let slow = points.point(DVec3::new(x.at, y.at, z.at)).unwrap();
                let [slope, receiver] = [block.slope, block.receiver].map(|lanes| Vec3::from(lanes.map(|l| l[0])));
                let gradients = [(slope, slow.slope), (receiver, slow.receiver)];
                let far = gradients.iter().map(|(a, b)| (*a - *b).abs().max_element()).fold(0.0, f32::max);
                let far = (block.h[0] - slow.h).abs().max(far);
                assert!(far < 1e-5, "{factor}: {x:?} {y:?} {z:?}: {slope} {receiver} {slow:?}");
                compared += 1;
            }
        }
        assert!(compared >= 8 * 6 * 7, "{compared}");
    }
}

#[test]
fn the_measure_of_a_ramp_is_its_slope_times_its_volume() {
    let dims = [13, 11, 12];
    let cases = (0..3).flat_map(|axis| [1, 2, 3, 5].map(|factor| (axis, factor)));
    for ((axis, factor), begin) in cases.flat_map(|case| [3.0, 3.3, 3.55, 3.8, 4.05].map(|begin| (case, begin))) {
        for falling in [false, true] {
            let lattice = oblique(dims);
            let axes = lattice.axes();
            // Runs along one axis, from outside the sweep through all of it.
            let ramp = field(lattice, |ijk| {
                let h = (ijk[axis] as f64 - begin) / 5.1;
                if falling { 1.0 - h } else { h }
            });
            let slope = ramp.lattice().gradient_to_world(DVec3::AXES[axis]).length() / 5.1;
            let across: f64 = (0..3).filter(|&a| a != axis).map(|a| (dims[a] - 1) as f64).product();
            let expected = slope * across * 5.1 * axes.determinant().abs();
            let (starts, found) = bins(&ramp, &Cells::new([factor; 3], dims), 0.1);
            assert_eq!(*starts.last().unwrap() as usize, found.len());
            let measure: f64 = found.iter().map(|b| f64::from(b.measure)).sum();
            let error = measure / expected - 1.0;
            // A quarter of a voxel at either end is all that eight points of a tangent leave open.
            assert!(error.abs() < 0.05, "axis {axis}, factor {factor}, from {begin}, {falling}: {error}");
            assert!(found.iter().all(|b| (0.0..=1.0).contains(&b.isovalue) && (b.normal.length() - 1.0).abs() < 1e-5));
            // The mean place is the middle, to half of what is left open.
            let mean = found.iter().map(|b| f64::from(b.centroid[axis]) * f64::from(b.measure)).sum::<f64>();
            let place = mean / measure * factor as f64 - 0.5;
            let within = if factor < 3 { 0.13 } else { 0.26 };
            assert!((place - begin - 2.55).abs() < within, "axis {axis}, factor {factor}, from {begin}: {place}");
        }
    }
}

#[test]
fn every_instruction_set_finds_the_same_bins() {
    let dims = [37, 7, 8];
    let mut rng = Rng::stream(6, Stage::Test, 0);
    let noise = field(oblique(dims), |_| 1.4 * rng.unit() - 0.2);
    for factor in [1, 2, 3] {
        let cells = Cells::new([factor; 3], dims);
        let points = Points::new(&noise, &cells, 0.1);
        let rows = |isa: Isa| -> Vec<(Vec<u32>, Vec<Bin>)> {
            let row = &mut Row::default();
            let mut bins =
                |n| isa.run(RowOfBins { points: &points, place: [n % cells.dims[1], n / cells.dims[1]], row });
            (0..cells.dims[1] * cells.dims[2]).map(&mut bins).collect()
        };
        let expected = rows(Isa::PLAIN);
        assert!(expected.iter().map(|(_, bins)| bins.len()).sum::<usize>() > 60);
        for isa in Isa::found() {
            // Numbers are written so that no two are alike.
            assert_eq!(format!("{:?}", rows(isa)), format!("{expected:?}"), "{}", isa.name());
        }
    }
}

/// Against all points one by one, on balls that bulge towards all sides, beside a sample that is no number, and
/// within Ω's faces.
#[test]
fn rows_and_ranges_leave_nothing_out() {
    let dims = [15, 14, 16];
    for (bulge, hole, factor) in [1.0, -1.0]
        .into_iter()
        .flat_map(|bulge| [false, true].map(|hole| (bulge, hole)))
        .flat_map(|(bulge, hole)| [[1; 3], [3; 3], [1, 3, 4], [16; 3]].map(|factor| (bulge, hole, factor)))
    {
        let ball = field(oblique(dims), |[i, j, k]| {
            let r = (DVec3::new(i as f64, j as f64, k as f64) - DVec3::new(6.3, 7.1, 8.4)).length();
            let here = hole && [i, j, k] == [9, 7, 8];
            if here { f64::NAN } else { 0.5 + bulge * (0.4 - 0.2 * (r - 2.0)) }
        });
        let cells = Cells::new(factor, dims);
        let points = Points::new(&ball, &cells, 0.1);
        let (_, found) = bins(&ball, &cells, 0.1);
        let mut row = Row { parts: vec![[Part::default(); 8]; cells.dims[0]], ..Row::default() };
        let slots = |axis: usize| points.across[axis - 1].iter().flatten();
        for (y, z) in slots(2).flat_map(|z| slots(1).map(move |y| (y, z))) {
            points.add_points([y, z], [0, dims[0]], &mut row);
        }
        for n in 0..8 {
            let expected: f64 = row.parts.iter().map(|parts| parts[n].normal.w).sum();
            let measure: f64 = found.iter().filter(|b| usize::from(b.octant) == n).map(|b| f64::from(b.measure)).sum();
            assert!(expected > 0.0);
            assert!((measure / expected - 1.0).abs() < 1e-5, "{bulge} {hole} {factor:?} {n}: {measure} {expected}");
        }
    }
}

/// The mean of |∇h| over noise is the same whatever the cells: points that lie at nodes find it half as large
/// again.
#[test]
fn noise_has_the_same_measure_in_cells_of_any_size() {
    let dims = [24, 22, 26];
    let mut rng = Rng::stream(5, Stage::Test, 0);
    let noise = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |_| 0.4 + 0.2 * rng.unit());
    // ∫ |∇h| dV by 6³ points a cell.
    let mut expected = 0.0;
    let fine = |axis: usize| (0..6 * (dims[axis] - 1)).map(|n| (n as f64 + 0.5) / 6.0);
    for (y, z) in fine(2).flat_map(|z| fine(1).map(move |y| (y, z))) {
        expected += fine(0).map(|x| noise.value_and_gradient(DVec3::new(x, y, z)).1.length()).sum::<f64>() / 216.0;
    }
    for factor in [1, 2, 3, 5, 30] {
        let (_, found) = bins(&noise, &Cells::new([factor; 3], dims), 0.1);
        let measure = found.iter().map(|b| f64::from(b.measure)).sum::<f64>();
        assert!((measure / expected - 1.0).abs() < 0.03, "{factor}: {measure} {expected}");
    }
}

/// Waves over a sweep of a thousandth of a voxel's rise: their measure is the area of their surface, and few of the
/// cells that the surface passes lack a bin, where photons would be lost.
#[test]
fn thin_sweeps_have_the_measure_of_their_surface() {
    let lattice = Lattice::aligned([18; 3], DVec3::ZERO, DVec3::ONE).unwrap();
    let wave = |[i, j, k]: [usize; 3]| {
        let [i, j, k] = [i, j, k].map(|n| n as f64);
        (0.35 * i).sin() + (0.25 * j + 1.0).cos() + 0.3 * k - 2.0
    };
    for factor in [1, 2, 4] {
        let of = |width: f64| {
            let thin = field(lattice.clone(), |ijk| wave(ijk) / width);
            let (starts, found) = bins(&thin, &Cells::new([factor; 3], [18; 3]), 0.1);
            let passed = starts.windows(2).filter(|w| w[0] < w[1]).count();
            assert!(found.iter().all(|b| (0.0..=1.0).contains(&b.isovalue)));
            let measure = found.iter().map(|b| f64::from(b.measure)).sum::<f64>();
            // Isovalues in a bin differ by all of the sweep.
            let reach = found.iter().map(|b| f64::from(b.measure * b.reach)).sum::<f64>() / measure;
            assert!(width > 0.01 || reach > 0.45, "{factor}, {width}: {reach}");
            (measure, passed as f64)
        };
        let (area, cells) = of(0.03);
        for width in [1e-3, 1e-5] {
            let (measure, passed) = of(width);
            assert!((measure / area - 1.0).abs() < 0.01, "{factor}, {width}: {measure} for {area}");
            assert!(passed > 0.9 * cells, "{factor}, {width}: {passed} cells for {cells}");
        }
    }
}

#[test]
fn slopes_as_large_as_fill_values_have_a_measure() {
    let dims = [9, 9, 9];
    let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
    let cells = Cells::new([1; 3], dims);
    // From the fill value down to 1/8 within the last rounding before node 1: all level sets above stand there, 7/8
    // of the sweep on 64 faces, or all of it where h is rounded.
    let filled = field(lattice, |ijk| if ijk[0] == 0 { 1e20 } else { ijk[0] as f64 / 8.0 });
    let measure = |at: f32| -> f64 {
        let (_, found) = bins(&filled, &cells, 0.1);
        let in_layer = |b: &&Bin| (b.centroid.x - 0.5 - at).abs() < 0.3;
        found.iter().filter(in_layer).map(|b| f64::from(b.measure)).sum()
    };
    assert!((59.9..68.1).contains(&measure(1.0)), "{}", measure(1.0));
    assert!((measure(4.0) - 8.0).abs() < 0.01, "{}", measure(4.0));
}

#[test]
fn samples_that_are_no_numbers_cost_their_cells_only() {
    let dims = [9, 9, 9];
    let whole = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |ijk| ijk[0] as f64 / 8.0);
    let holed = field(Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), |ijk| {
        if ijk == [4, 4, 4] { f64::NAN } else { ijk[0] as f64 / 8.0 }
    });
    let cells = Cells::new([1; 3], dims);
    let total = |field: &Field| bins(field, &cells, 0.1).1.iter().map(|b| f64::from(b.measure)).sum::<f64>();
    // Eight cells of 8³.
    assert!((total(&whole) - total(&holed) - 1.0).abs() < 1e-4, "{} {}", total(&whole), total(&holed));
}
