//! `make gallery`: the script, the scenes it uses and its page; tiny, and one figure at preview quality.

#[path = "shared/folder.rs"]
mod folder;

use folder::Folder;
use std::fs;
use std::path::Path;
use std::process::Command;

#[test]
fn two_figures_render_tiny() {
    let dir = Folder::new();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/gallery");
    let mut command = Command::new("python3");
    command.arg(script).arg(env!("CARGO_BIN_EXE_isolume")).arg(dir.path()).args(["--tiny", "--only", "1", "4"]);
    let output = command.output().expect("python3, which make deps needs too");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = fs::read_to_string(dir.path().join("README.md")).unwrap();
    let shown: Vec<&str> = page.split("](").skip(1).filter_map(|s| s.split(')').next()).collect();
    let pictures: Vec<&&str> = shown.iter().filter(|s| s.ends_with(".png")).collect();
    assert_eq!(pictures.len(), 7, "{page}");
    for name in pictures {
        let bytes = fs::read(dir.path().join(name)).unwrap();
        assert!(bytes.starts_with(b"\x89PNG") && bytes.len() > 300, "{name}");
    }
    // The contrast of the contact shadow: near is darker.
    let numbers: Vec<f64> = page.split("**").skip(1).step_by(2).filter_map(|n| n.parse().ok()).collect();
    assert!(matches!(numbers[..], [far, near] if near > far + 0.15), "{page}");
}

/// Mean of each channel over the middle of a picture, where the big bump is.
fn middle(path: &Path) -> [f64; 3] {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!((info.width, info.height, info.color_type), (360, 360, png::ColorType::Rgb));
    let mut sum = [0.0; 3];
    for (y, x) in (173..216).flat_map(|y| (162..198).map(move |x| (y, x))) {
        (0..3).for_each(|c| sum[c] += f64::from(bytes[(y * 360 + x) * 3 + c]));
    }
    sum
}

/// Albedo by isovalue at preview quality, as the page shows it: blue at 20, grey at 47, orange at 75.
#[test]
fn a_figure_renders_at_preview_quality() {
    let dir = Folder::new();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/gallery");
    let mut command = Command::new("python3");
    command.arg(script).arg(env!("CARGO_BIN_EXE_isolume")).arg(dir.path()).args(["--only", "colour"]);
    let output = command.output().expect("python3, which make deps needs too");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let redness = ["20", "47", "75"].map(|c| {
        let [red, _, blue] = middle(&dir.path().join(format!("coloured-{c}.png")));
        red / blue
    });
    assert!(redness[0] < 0.8 && (0.95..1.3).contains(&redness[1]) && redness[2] > 1.5, "{redness:?}");
}
