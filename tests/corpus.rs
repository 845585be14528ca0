//! Volumes that lie: the committed corpus (`scripts/make-corpus` writes it) through every reader. Never a panic, never
//! success with samples that the file does not hold, never much memory on the word of a header.
//!
//! A format joins by its files in `tests/corpus`: `good-…` must open, `bad-…` must be refused.

use isolume::error::{Error, Result};
use isolume::rng::{Rng, Stage};
use isolume::volume::raw::RawLayout;
use isolume::volume::{ElementType, Volume};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn corpus() -> Vec<(PathBuf, String)> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/corpus");
    let mut files: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .map(|p| (p.clone(), p.file_name().unwrap().to_str().unwrap().to_owned()))
        .collect();
    files.sort();
    assert!(files.len() > 220, "only {} files", files.len());
    files
}

/// Opens by extension; a headerless file by the layout in its name.
fn open(path: &Path, name: &str) -> Result<Volume> {
    if !name.ends_with(".raw") {
        return Volume::open(path);
    }
    let mut parts = name.split(['-', '.']).skip(1);
    let dims: Vec<usize> = parts.next().unwrap().split('x').map(|n| n.parse().unwrap()).collect();
    let element = ElementType::from_name(parts.next().unwrap()).unwrap();
    RawLayout::new([dims[0], dims[1], dims[2]], element).read(path)
}

/// Formats that the corpus covers.
fn extensions() -> Vec<String> {
    let mut all: Vec<String> = corpus().iter().map(|(_, n)| n.split_once('.').unwrap().1.to_owned()).collect();
    all.sort();
    all.dedup();
    all
}

#[test]
fn good_files_open_and_bad_ones_are_refused() {
    for (path, name) in corpus() {
        let found = open(&path, &name);
        match name.split(['-', '.']).next().unwrap() {
            "good" => {
                let volume = found.unwrap_or_else(|e| panic!("{name}: {e}"));
                assert_eq!(volume.lattice.dims(), [3, 4, 2], "{name}");
                assert!((0..24).all(|i| volume.value(i) == (7 * i % 23 + 1) as f64), "{name}: {:?}", volume.samples());
            }
            "bad" => {
                let error = found.map(|v| v.lattice.dims()).expect_err(&name);
                let refused = matches!(error, Error::Invalid(_) | Error::NotSupported(_) | Error::Io { .. });
                let text = error.to_string();
                assert!(refused && error.exit_code() == 2 && !text.contains('\n'), "{name}: {text}");
            }
            other => panic!("{name} begins with {other}, not good or bad"),
        }
    }
    let formats = "nii nii.gz nrrd nhdr mha mhd mrc mrc.gz cube cube.gz vti vtk npy tif tif.zip raw";
    for format in formats.split(' ') {
        assert!(extensions().iter().any(|e| e == format), "no corpus for .{format}");
    }
}

#[test]
fn every_cut_and_many_flipped_bits_of_good_files_are_survived() {
    // Thousands of files: in memory where that is to be had.
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.unwrap();
    let (mut cuts, mut flips, mut opened) = (0, 0, 0);
    for (path, name) in corpus().into_iter().filter(|(_, n)| n.starts_with("good")) {
        let bytes = fs::read(&path).unwrap();
        let whole = open(&path, &name).unwrap();
        let target = folder.path().join(&name);
        for n in 0..bytes.len() {
            fs::write(&target, &bytes[..n]).unwrap();
            cuts += 1;
            // What is missing may be a closing tag or a newline, never a sample.
            if let Ok(volume) = open(&target, &name) {
                assert_eq!((volume.samples(), &volume.lattice), (whole.samples(), &whole.lattice), "{name} cut at {n}");
            }
        }
        for i in 0..2000 {
            let mut rng = Rng::stream(4, Stage::Test, i);
            let mut bad = bytes.clone();
            for _ in 0..1 + rng.bits() % 4 {
                let at = (rng.bits() % bad.len() as u64) as usize;
                bad[at] = if rng.bits() & 1 == 0 { bad[at] ^ 1 << (rng.bits() % 8) } else { rng.bits() as u8 };
            }
            fs::write(&target, bad).unwrap();
            flips += 1;
            opened += u32::from(open(&target, &name).is_ok_and(|v| v.samples().len() == v.lattice.len()));
        }
        // A detached header must not find it.
        fs::remove_file(target).unwrap();
    }
    println!("{cuts} cuts, {flips} damaged copies, of which {opened} open");
}

/// The whole program may take 2 × the file + 64 MB beyond what it takes for a small good file.
#[cfg(target_os = "linux")]
#[test]
fn little_memory_is_taken_on_the_word_of_a_header() {
    /// The program without a volume: libraries' data, stacks, allocator.
    const PROGRAM: u64 = 24 << 20;
    let limited = |path: &Path, name: &str, limit: u64| {
        let script = format!("ulimit -d {}; exec \"$0\" \"$@\"", limit >> 10);
        let mut command = Command::new("sh");
        command.args(["-c", &script, env!("CARGO_BIN_EXE_isolume"), "info", "--threads", "1"]).arg(path);
        if name.ends_with(".raw") {
            let mut parts = name.split(['-', '.']).skip(1);
            let dims = parts.next().unwrap().replace('x', ",");
            command.args(["--raw-dims", &dims, "--raw-type", parts.next().unwrap()]);
        }
        command.output().unwrap()
    };
    for (path, name) in corpus() {
        let length = fs::metadata(&path).unwrap().len();
        let output = limited(&path, &name, PROGRAM + 2 * length + (64 << 20));
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        let expected = if name.starts_with("good") { 0 } else { 2 };
        assert_eq!(output.status.code(), Some(expected), "{name}: {text}");
        assert!(expected == 0 || text.lines().count() == 1, "{name}: {text}");
    }
    // The limit limits: a file that honestly holds 100 MB cannot be read within it.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("large-512x512x400-u8.raw");
    fs::write(&path, vec![1u8; 512 * 512 * 400]).unwrap();
    assert_ne!(limited(&path, "large-512x512x400-u8.raw", PROGRAM + (64 << 20)).status.code(), Some(0));
}
