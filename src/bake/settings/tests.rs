use super::*;

/// More directions than 32 bits count were none at all.
#[test]
fn directions_and_points_have_a_most() {
    let fails = |directions, light_points| {
        let o = BakeOptions { directions: Some(directions), light_points: Some(light_points), ..Default::default() };
        BakeSettings::with_engine(&o, Engine::Sweep).err().map(|e| e.to_string())
    };
    assert_eq!(fails(1 << 20, 1 << 16), None);
    assert!(
        fails(1 << 32, 64).is_some_and(|e| e.contains("directions 4294967296: must be a power of two, 8 to 1048576"))
    );
    assert!(
        fails(64, 1 << 33)
            .is_some_and(|e| e.contains("light-points 8589934592: must be a power of two, at most 65536"))
    );
}

/// Estimates of as many bytes would fit no 64 bits.
#[test]
fn photons_and_samples_have_a_most() {
    let fails = |photons, samples| {
        let o = BakeOptions { photons, samples, ..Default::default() };
        BakeSettings::with_engine(&o, Engine::Photon).err().map(|e| e.to_string())
    };
    assert_eq!(fails(Some(1 << 40), Some(1 << 40)), None);
    let most = 1u64 << 62;
    assert!(fails(None, Some(0)).is_some_and(|e| e.contains("samples 0: must be 1 to 1099511627776")));
    assert!(fails(None, Some(most)).is_some_and(|e| e.contains("samples 4611686018427387904: must be 1 to")));
    assert!(fails(Some(most), None).is_some_and(|e| e.contains("photons 4611686018427387904: must be at most")));
}

#[test]
fn options_without_effect_are_named() {
    let idle = |o: &BakeOptions, engine| o.idle(&BakeSettings::with_engine(o, engine).unwrap()).join("; ");
    let all = BakeOptions {
        directions: Some(64),
        photons: Some(1000),
        samples: Some(1000),
        strategy: Some(StrategyName::Nodes),
        gather_rays: Some(0),
        smoothing: Some(true),
        tau: Some(0.1),
        ..BakeOptions::default()
    };
    assert_eq!(
        idle(&all, Engine::Sweep),
        "photons, samples, strategy, smoothing have no effect with engine = \"sweep\""
    );
    let photon = "directions has no effect with engine = \"photon\"; samples has no effect with strategy = \"nodes\" \
                  (uniform, level-set and planes scatter samples); smoothing has no effect with fewer than 2 gather rays";
    assert_eq!(idle(&all, Engine::Photon), photon);
    let scattered = BakeOptions { samples: Some(10), neighbours: Some(8), ..BakeOptions::default() };
    assert_eq!(idle(&scattered, Engine::Photon), "");
    let smoothed = BakeOptions { smoothing: Some(true), ..scattered };
    assert_eq!(idle(&smoothed, Engine::Photon), "smoothing has no effect with scattered samples");
    let smoothed = BakeOptions { smoothing: Some(true), ..BakeOptions::default() };
    assert_eq!(idle(&smoothed, Engine::Photon), "");
}

#[test]
fn counts_may_have_exponents() {
    for (text, n) in [("12", 12), ("1e6", 1_000_000), ("2.5e3", 2500), ("0", 0), ("18446744073709551615", u64::MAX)] {
        assert_eq!(whole_number(text), Ok(n), "{text}");
    }
    for text in ["", "1.5", "-1", "-1e3", "1e16", "nan", "inf", "1e"] {
        assert!(whole_number(text).is_err(), "{text}");
    }
}
