use super::*;
use glam::DVec3;

#[test]
fn files_are_told_apart_by_their_extension() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let lattice = Lattice::aligned([2, 3, 2], DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.5, 1.0, 4.0)).unwrap();
    let volume = Volume::new("made", lattice, Samples::I16((0..12).map(|i| i * 100 - 500).collect())).unwrap();
    for name in ["a.VTI", "b.nrrd"] {
        volume.write(at(name)).unwrap();
        let read = Volume::open(at(name)).unwrap();
        assert_eq!((&read.lattice, read.samples()), (&volume.lattice, volume.samples()));
    }
    let turned = Volume { space: Space::RightAnteriorSuperior, ..volume.clone() };
    for name in ["a.vti", "b.nrrd"] {
        turned.write(at(name)).unwrap();
        assert_eq!(Volume::open(at(name)).unwrap().space, turned.space, "{name}");
    }
    // Other programs may call something else so.
    vti::VtiWriter::new(&volume.lattice)
        .point_data("value", 1, volume.samples())
        .field_string("space", "outer")
        .write(&at("a.vti"))
        .unwrap();
    assert_eq!(Volume::open(at("a.vti")).unwrap().space, Space::default());
    assert!(matches!(volume.write(at("c.png")), Err(Error::NotSupported(_))));
    assert!(!at("c.png").exists());
    std::fs::write(at("d.xyz"), []).unwrap();
    let message = Volume::open(at("d.xyz")).unwrap_err().to_string();
    assert!(message.contains("d.xyz") && message.contains(".nii, "), "{message}");
    assert!(matches!(Volume::open(at("none.vti")), Err(Error::Io { .. })));
    std::fs::write(at("e.raw"), []).unwrap();
    assert!(Volume::open(at("e.raw")).unwrap_err().to_string().contains("no header"));
    for name in [
        "f.nii",
        "f.nii.gz",
        "f.nhdr",
        "f.mha",
        "f.mhd",
        "f.mrc",
        "f.MAP",
        "f.map.gz",
        "f.ccp4",
        "f.rec",
        "f.cube",
        "f.cube.gz",
        "f.vti",
        "f.vtk",
        "f.npy",
        "f.npy.gz",
        "f.tif",
        "f.tiff",
        "f.tif.zip",
    ] {
        std::fs::write(at(name), []).unwrap();
        let message = Volume::open(at(name)).unwrap_err().to_string();
        assert!(message.contains(name) && !message.contains("extension"), "{message}");
    }
}

#[test]
fn no_axis_is_longer_than_32_bit_floats_number() {
    let along = |n: usize| Lattice::aligned([2, n, 2], DVec3::ZERO, DVec3::ONE);
    assert!(along(1 << 23).is_ok());
    let message = along((1 << 23) + 1).unwrap_err().to_string();
    assert!(message.contains("8388609 samples along an axis"), "{message}");
}
