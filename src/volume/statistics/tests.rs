use super::*;
use crate::volume::Lattice;
use crate::volume::generate::Generator;
use glam::DVec3;

fn volume(dims: [usize; 3], samples: Samples) -> Volume {
    Volume::new("test", Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap(), samples).unwrap()
}

#[test]
fn counts_and_percentiles_are_exact_in_every_type() {
    // 0 … 99 once each and a hundred more of 7.
    let values: Vec<i32> = (0..100).chain([7; 100]).collect();
    let dims = [10, 10, 2];
    let all = [
        Samples::U8(values.iter().map(|&v| v as u8).collect()),
        Samples::I8(values.iter().map(|&v| v as i8).collect()),
        Samples::U16(values.iter().map(|&v| v as u16).collect()),
        Samples::I16(values.iter().map(|&v| v as i16).collect()),
        Samples::U32(values.iter().map(|&v| v as u32).collect()),
        Samples::I32(values.clone()),
        Samples::U64(values.iter().map(|&v| v as u64).collect()),
        Samples::I64(values.iter().map(|&v| v as i64).collect()),
        Samples::F32(values.iter().map(|&v| v as f32).collect()),
        Samples::F64(values.iter().map(|&v| v as f64).collect()),
    ];
    for samples in all {
        let s = VolumeStatistics::of(&volume(dims, samples));
        assert_eq!((s.range, s.samples, s.non_finite), (Some([0.0, 99.0]), 200, 0));
        assert_eq!(s.percentiles, Some([1.0, 7.0, 79.0, 97.0, 99.0]), "{}", s.element_type);
        assert_eq!((s.commonest, s.commonest_share), (Some(7.0), Some(101.0 / 200.0)));
        let histogram = s.histogram.unwrap();
        assert_eq!((histogram.len(), histogram.iter().sum::<u64>()), (BINS, 200));
        // 7/99·64 = 4.5.
        assert_eq!((histogram[0], histogram[4], histogram[63]), (2, 101, 2));
    }
}

#[test]
fn signed_and_negative_values_keep_their_order() {
    for samples in [
        Samples::F32(vec![-2.0, -1.0, -0.0, 0.0, 1.0, 2.0, 2.5, -7.5]),
        Samples::F64(vec![-2.0, -1.0, -0.0, 0.0, 1.0, 2.0, 2.5, -7.5]),
    ] {
        let s = VolumeStatistics::of(&volume([2, 2, 2], samples));
        assert_eq!((s.range, s.commonest), (Some([-7.5, 2.5]), Some(0.0)));
        assert_eq!(s.percentiles.unwrap()[1], 0.0);
    }
    let s = VolumeStatistics::of(&volume([2, 2, 2], Samples::I16(vec![-300, -300, 5, 6, 7, 8, 9, 10])));
    assert_eq!((s.range, s.commonest), (Some([-300.0, 10.0]), Some(-300.0)));
}

#[test]
fn flat_samples_are_counted_with_one_sided_ends() {
    // h = 0 0 0 1 along x: differences 0, 0, ½, 1.
    let h: Vec<u8> = (0..16).map(|i| u8::from(i % 4 == 3)).collect();
    let s = VolumeStatistics::of(&volume([4, 2, 2], Samples::U8(h)));
    assert_eq!(s.flat, 8);
}

#[test]
fn what_is_not_finite_is_counted_and_left_out() {
    let mut h = vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    h.extend((3..64).map(|i| i as f32));
    let s = VolumeStatistics::of(&volume([4, 4, 4], Samples::F32(h)));
    assert_eq!((s.non_finite, s.range), (3, Some([3.0, 63.0])));
    assert!(s.to_text().contains("3 (4.688 %)"), "{s}");
    let nothing = VolumeStatistics::of(&volume([2, 2, 2], Samples::F64(vec![f64::NAN; 8])));
    assert_eq!((nothing.non_finite, nothing.range, nothing.sweep), (8, None, None));
    assert!(nothing.to_text().contains("no isosurface"));
    let constant = VolumeStatistics::of(&volume([2, 2, 2], Samples::U8(vec![5; 8])));
    assert_eq!((constant.flat, constant.range, constant.sweep), (8, Some([5.0, 5.0]), None));
    let extreme = VolumeStatistics::of(&volume([2, 2, 2], Samples::F64([-f64::MAX, f64::MAX].repeat(4))));
    assert_eq!((extreme.range, extreme.sweep), (Some([-f64::MAX, f64::MAX]), None));
}

#[test]
fn the_sweep_does_not_depend_on_the_unit() {
    let ball = |unit: f64| {
        let sample = |o: usize| {
            let [i, j, k] = [o % 17, o / 17 % 17, o / 289].map(|i| i as f64 - 8.0);
            unit * (-(i * i + j * j + k * k) / 18.0).exp()
        };
        volume([17; 3], Samples::F64((0..17 * 17 * 17).map(sample).collect()))
    };
    let one = VolumeStatistics::of(&ball(1.0)).sweep.unwrap();
    for unit in [1e-300, 1e-200, 1e200, 1e300] {
        let s = VolumeStatistics::of(&ball(unit));
        let [lo, hi] = s.sweep.unwrap_or_else(|| panic!("no sweep in units of {unit}"));
        assert!((lo / unit - one[0]).abs() < 1e-9 && (hi / unit - one[1]).abs() < 1e-9, "{unit}: {lo} {hi}, {one:?}");
        let text = s.sweep.unwrap().map(|v| format!("{v:e}"));
        assert!(text.iter().all(|t| t.len() < 10), "ends are short decimals: {text:?}");
    }
}

#[test]
fn nothing_untrue_is_said_where_nothing_is_suggested() {
    // No two neighbours are finite.
    let holes = (0..64).map(|o: usize| if (o + o / 4 + o / 16).is_multiple_of(2) { o as f64 } else { f64::NAN });
    for samples in [[-f64::MAX, f64::MAX].repeat(32), holes.collect()] {
        let s = VolumeStatistics::of(&volume([4; 3], Samples::F64(samples)));
        let text = s.to_text();
        assert!(s.sweep.is_none() && text.contains("--isovalues") && !text.contains("no isosurface"), "{text}");
    }
}

/// What stands in the data and where it stands, however many digits that has.
#[test]
fn numbers_are_not_rounded_into_others() {
    let samples = (0..64).map(|o| if o < 40 { 123_456_789 } else { u32::MAX }).collect();
    let mut volume = volume([4; 3], Samples::U32(samples));
    let origin = DVec3::new(456_789.25, 4_567_891.5, -1_234.567_8);
    volume.lattice = Lattice::aligned([4; 3], origin, DVec3::splat(12.5)).unwrap();
    let text = VolumeStatistics::of(&volume).to_text();
    for words in ["123456789 … 4294967295", "123456789, 62.5", "456789.25  4567891.5  -1234.57"] {
        assert!(text.contains(words), "{words}: {text}");
    }
}

#[test]
fn the_sweep_of_a_smooth_field_is_nearly_all_of_it() {
    let s = VolumeStatistics::of(&Generator::Bumps.sample([51; 3]).unwrap());
    let [lo, hi] = s.sweep.unwrap();
    assert!((1.0..8.0).contains(&lo) && (80.0..98.0).contains(&hi), "{lo} {hi}");
}

/// A ball of 200 with a soft rim, in noise of 0 … `noise`.
fn noisy_ball(noise: u32, invert: bool) -> Samples {
    let n = 48;
    let samples = (0..n * n * n).map(|o: usize| {
        let [i, j, k] = [o % n, o / n % n, o / (n * n)].map(|i| i as f64 - 23.5);
        let ball = 200.0 * ((16.0 - (i * i + j * j + k * k).sqrt()) / 4.0).clamp(0.0, 1.0);
        let hash = ((o as u32).wrapping_mul(0x9e37_79b9) ^ 0x85eb_ca6b).wrapping_mul(0xc2b2_ae35);
        let v = ball + ((hash >> 8) % (noise + 1)) as f64;
        (if invert { 255.0 - v } else { v }) as u8
    });
    Samples::U8(samples.collect())
}

#[test]
fn the_sweep_leaves_out_noise_on_either_end() {
    let of = |noise, invert| VolumeStatistics::of(&volume([48; 3], noisy_ball(noise, invert))).sweep.unwrap();
    let quiet = of(0, false);
    assert!(quiet[0] > 0.0 && quiet[0] <= 20.0 && (180.0..200.0).contains(&quiet[1]), "{quiet:?}");
    let noisy = of(40, false);
    assert!((25.0..70.0).contains(&noisy[0]) && (180.0..240.0).contains(&noisy[1]), "{noisy:?}");
    let inverted = of(40, true);
    assert!((185.0..230.0).contains(&inverted[1]) && inverted[0] > 15.0 && inverted[0] < 75.0, "{inverted:?}");
}

#[test]
fn the_result_does_not_depend_on_threads() {
    let v = Generator::from_name("two-cylinders").unwrap().sample([33, 34, 35]).unwrap();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let three = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    assert_eq!(one.install(|| VolumeStatistics::of(&v)), three.install(|| VolumeStatistics::of(&v)));
}

#[test]
fn json_has_the_same_facts() {
    let s = VolumeStatistics::of(&volume([2, 2, 2], Samples::U8((0..8).collect())));
    let json = serde_json::to_value(&s).unwrap();
    assert_eq!(json["range"], serde_json::json!([0.0, 7.0]));
    assert_eq!(json["element_type"], "u8");
    assert_eq!(json["histogram"].as_array().unwrap().len(), BINS);
}

/// Neighbours among the integers from 2⁶⁰ on are 256 apart as floats.
#[test]
fn integers_that_floats_do_not_hold_are_counted() {
    let near = |offset: i64| Samples::I64((0..8).map(|k| offset + k).collect());
    let all = VolumeStatistics::of(&volume([2, 2, 2], near((1 << 60) + 1)));
    assert_eq!((all.rounded, all.sweep), (8, None));
    let text = all.to_text();
    assert!(text.contains("8 (100.000 %)") && text.contains("apart") && text.contains("subtract"), "{text}");
    assert!(!text.contains("every sample") && !text.contains("no isosurface"), "{text}");
    // 2⁵³ + 1, + 3, + 5 and + 7 are no floats.
    let some = VolumeStatistics::of(&volume([2, 2, 2], near(1 << 53)));
    assert!(some.rounded == 4 && some.sweep.is_some() && some.to_text().contains("4 (50.000 %)"), "{some}");
    for samples in [near(-(1 << 53) - 7), Samples::I64(vec![i64::MAX; 8]), Samples::U64(vec![u64::MAX; 8])] {
        assert!(VolumeStatistics::of(&volume([2, 2, 2], samples)).rounded >= 3);
    }
    let held = [near(0), near((1 << 53) - 8), Samples::I64(vec![i64::MIN; 8]), Samples::F64(vec![1e300; 8])];
    for samples in held {
        assert_eq!(VolumeStatistics::of(&volume([2, 2, 2], samples)).rounded, 0);
    }
}

/// Marks for missing samples, at either end, in floats and integers; not a background, however common, nor two values.
#[test]
fn marks_for_missing_samples_suggest_no_sweep() {
    let ramp = |mark: f64, scale: f64| -> Samples {
        Samples::F64((0..1000).map(|i| if i % 4 == 0 { mark } else { scale * f64::from(i % 10 + i / 100) }).collect())
    };
    for (samples, fill) in [
        (ramp(-1e30, 1.0), Some(-1e30)),
        (ramp(1e20, 1e3), Some(1e20)),
        (ramp(-9999.0, 5.0), Some(-9999.0)),
        (ramp(f64::MAX, 1.0), Some(f64::MAX)),
        (ramp(-1000.0, 100.0), None),
        (ramp(0.0, 1.0), None),
        (Samples::U8((0..1000).map(|i| u8::from(i % 3 > 0)).collect()), None),
        (Samples::I16((0..1000).map(|i| if i % 2 == 0 { -32768 } else { i % 7 }).collect()), Some(-32768.0)),
    ] {
        let s = VolumeStatistics::of(&volume([10; 3], samples));
        assert_eq!((s.fill, s.sweep.is_none()), (fill, fill.is_some()), "{s:?}");
        assert_eq!(s.without_sweep().is_some_and(|why| why.contains("as if these were missing")), fill.is_some());
    }
}
