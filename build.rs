//! Finds Embree 4, links it, and generates the ray and hit structs from `wrapper/embree_abi.h`.
//!
//! Where Embree is looked for, in this order: `EMBREE_DIR` (an installation prefix, or the folder of the library), an
//! installed Embree 4 (pkg-config, then the usual folders), and `third_party/embree`, which `make deps` fills.
//! Its headers are not needed.

use std::env;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=wrapper/embree_abi.h");
    println!("cargo:rerun-if-env-changed=EMBREE_DIR");
    println!("cargo:rerun-if-env-changed=PKG_CONFIG_PATH");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets CARGO_MANIFEST_DIR"));
    println!("cargo:rustc-env=ISOLUME_COMMIT={}", commit(&root).unwrap_or_else(|| "unknown".into()));
    if let Err(message) = find_embree(&root).and_then(|library| link(&library, &out)).and_then(|()| bindings(&out)) {
        println!("cargo::error={message}");
    }
}

/// The short hash of the commit, and one of the sources if they are not the commit's: checkpoints of another program
/// are refused by it. Nothing in a package without git, or one that lies inside a foreign repository.
fn commit(root: &Path) -> Option<String> {
    let git = |args: &[&str]| {
        let output = Command::new("git").arg("-C").arg(root).args(args).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_string())
    };
    if Path::new(&git(&["rev-parse", "--show-toplevel"])?).canonicalize().ok()? != root.canonicalize().ok()? {
        return None;
    }
    // HEAD names the branch and changes with a checkout; its log changes with every commit. Cargo would rerun always
    // for a path that does not exist.
    for name in ["HEAD", "logs/HEAD"] {
        let path = root.join(git(&["rev-parse", "--git-path", name])?);
        if path.exists() {
            println!("cargo:rerun-if-changed={}", path.display());
        }
    }
    let commit = git(&["rev-parse", "--short", "HEAD"])?;
    let parts = ["build.rs", "src", "wrapper", "Cargo.toml", "Cargo.lock"];
    parts.iter().for_each(|part| println!("cargo:rerun-if-changed={part}"));
    let changed = git(&[&["--no-optional-locks", "status", "--porcelain", "--"], &parts[..]].concat())?;
    if changed.is_empty() {
        return Some(commit);
    }
    let mut hasher = DefaultHasher::new();
    parts.iter().for_each(|part| hash(root, Path::new(part), &mut hasher));
    Some(format!("{commit}+{:08x}", hasher.finish() >> 32))
}

/// Hashes a file, or all of a folder, with its path.
fn hash(root: &Path, path: &Path, hasher: &mut DefaultHasher) {
    if let Ok(entries) = root.join(path).read_dir() {
        let mut entries: Vec<PathBuf> = entries.flatten().map(|entry| path.join(entry.file_name())).collect();
        entries.sort();
        entries.iter().for_each(|entry| hash(root, entry, hasher));
    } else {
        (path, std::fs::read(root.join(path)).ok()).hash(hasher);
    }
}

/// The library file to link.
fn find_embree(root: &Path) -> Result<PathBuf, String> {
    if let Some(dir) = env::var_os("EMBREE_DIR").filter(|dir| !dir.is_empty()) {
        let dir = PathBuf::from(dir);
        return folders(&dir).iter().find_map(|folder| library_in(folder)).ok_or_else(|| {
            format!("EMBREE_DIR={} holds no Embree 4 library ({}); point it at an Embree 4 installation or at the folder of its library, or unset it and run `make deps`", dir.display(), expected_name())
        });
    }
    let mut places = pkg_config();
    for prefix in ["/usr/local", "/usr", "/opt/homebrew", "/opt/local"] {
        places.extend(folders(Path::new(prefix)));
    }
    let third_party = root.join("third_party").join("embree");
    places.extend(folders(&third_party));
    places.iter().find_map(|folder| library_in(folder)).ok_or_else(|| {
        format!("Embree 4 was not found ({} in EMBREE_DIR, the system's library folders or third_party/embree): run `make deps`, or install Embree 4 and set EMBREE_DIR to its prefix", expected_name())
    })
}

/// Where a prefix keeps its libraries, itself included; `embreex.libs` is the PyPI wheel's name for it.
fn folders(prefix: &Path) -> Vec<PathBuf> {
    let multiarch = match env::var("CARGO_CFG_TARGET_ARCH").as_deref() {
        Ok("aarch64") => "lib/aarch64-linux-gnu",
        _ => "lib/x86_64-linux-gnu",
    };
    let mut folders = vec![prefix.to_path_buf()];
    folders.extend([multiarch, "lib64", "lib", "embreex.libs"].map(|sub| prefix.join(sub)));
    folders
}

/// The folder that pkg-config knows, if any.
fn pkg_config() -> Vec<PathBuf> {
    let mut places = Vec::new();
    for package in ["embree4", "embree"] {
        let ask = |argument: &str| Command::new("pkg-config").args([argument, package]).output().ok();
        if !ask("--atleast-version=4.0").is_some_and(|output| output.status.success()) {
            continue;
        }
        if let Some(output) = ask("--variable=libdir") {
            let folder = String::from_utf8_lossy(&output.stdout).trim().to_string();
            if !folder.is_empty() {
                places.push(PathBuf::from(folder));
            }
        }
    }
    places
}

fn target_os() -> String {
    env::var("CARGO_CFG_TARGET_OS").unwrap_or_default()
}

fn expected_name() -> &'static str {
    match target_os().as_str() {
        "windows" => "embree4.lib",
        "macos" => "libembree4*.dylib",
        _ => "libembree4*.so*",
    }
}

/// The Embree 4 library in `folder`, the shortest name first: `libembree4.so`, `libembree4.so.4`, and the hashed
/// `libembree4-4aef3270.so.4` of a Python wheel are all the same thing.
fn library_in(folder: &Path) -> Option<PathBuf> {
    let matches = |name: &str| match target_os().as_str() {
        "windows" => name == "embree4.lib",
        "macos" => name.starts_with("libembree4") && name.ends_with(".dylib"),
        _ => name.strip_prefix("libembree4").and_then(|rest| rest.split_once(".so")).is_some_and(|(tag, version)| {
            (tag.is_empty() || tag.starts_with('-')) && version.chars().all(|c| c == '.' || c.is_ascii_digit())
        }),
    };
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .ok()?
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| matches(name))
        .collect();
    names.sort_by_key(|name| (name.len(), name.clone()));
    let library = folder.join(names.first()?);
    library.exists().then_some(library)
}

/// Links `library` and makes every binary, test, bench and example of this package find it again at run time. Cargo
/// hands link arguments to a package's own binaries only: build scripts of those that depend on it are told the folder,
/// as `DEP_ISOLUME_EMBREE`.
fn link(library: &Path, out: &Path) -> Result<(), String> {
    let library = library.canonicalize().map_err(|e| format!("{}: {e}", library.display()))?;
    let folder = library.parent().expect("a file has a folder");
    println!("cargo:rerun-if-changed={}", library.display());
    println!("cargo::metadata=embree={}", folder.display());
    // embree4-sys asks the linker for -lembree4: give the library that name, whatever its own is.
    #[cfg(unix)]
    {
        let extension = if target_os() == "macos" { "dylib" } else { "so" };
        let name = out.join(format!("libembree4.{extension}"));
        let failed = |e: std::io::Error| format!("{}: {e}", name.display());
        if name.symlink_metadata().is_ok() {
            std::fs::remove_file(&name).map_err(failed)?;
        }
        std::os::unix::fs::symlink(&library, &name).map_err(failed)?;
        println!("cargo:rustc-link-search=native={}", out.display());
        println!("cargo:rustc-link-arg=-Wl,-rpath,{}", folder.display());
    }
    #[cfg(not(unix))]
    {
        let _ = out;
        println!("cargo:rustc-link-search=native={}", folder.display());
    }
    Ok(())
}

/// Generates `embree_abi.rs`.
fn bindings(out: &Path) -> Result<(), String> {
    // bindgen panics when there is no libclang.
    let generated = std::panic::catch_unwind(|| {
        bindgen::Builder::default()
            .header("wrapper/embree_abi.h")
            .rust_edition(bindgen::RustEdition::Edition2024)
            .allowlist_file("wrapper/embree_abi.h")
            .blocklist_type("RTCDeviceTy|RTCSceneTy")
            .blocklist_type("u?int[0-9]+_t")
            .raw_line("use embree4_sys::{RTCDeviceTy, RTCSceneTy};")
            .generate()
    });
    match generated {
        Ok(Ok(bindings)) => bindings
            .write_to_file(out.join("embree_abi.rs"))
            .map_err(|e| format!("{}: {e}", out.join("embree_abi.rs").display())),
        Ok(Err(e)) => Err(format!("wrapper/embree_abi.h: {e}")),
        Err(_) => Err("bindgen needs libclang and could not load it: run `make deps`, or install libclang (apt-get install libclang-dev) or set LIBCLANG_PATH to its folder".into()),
    }
}
