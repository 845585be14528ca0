//! The structure that the design promises: pipeline order, the unsafe fence, no machine's paths, no long files,
//! comments as wide as code.

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Every Rust file under `folder`.
fn rust_files(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// Names that stand behind `crate::`, alone or in braces, and their lines; comments left out.
fn modules_used(text: &str) -> Vec<(usize, String)> {
    let code: Vec<&str> = text.lines().map(|l| if l.trim_start().starts_with("//") { "" } else { l }).collect();
    let code = code.join("\n");
    let mut used = Vec::new();
    for (at, path) in code.match_indices("crate::") {
        let begins = at + path.len();
        let mut depth = 0usize;
        let mut name: Option<usize> = None;
        for (n, c) in code[begins..].char_indices().map(|(n, c)| (begins + n, c)).chain([(code.len(), '\n')]) {
            let word = c.is_alphanumeric() || c == '_';
            if let Some(from) = name.filter(|_| !word) {
                used.push((1 + code[..from].matches('\n').count(), code[from..n].to_owned()));
                name = None;
            }
            // The first name of the path, or of each in the outer braces.
            let first = n == begins || depth == 1 && code[..n].trim_end().ends_with(['{', ',']);
            match c {
                '{' if n == begins || depth > 0 => depth += 1,
                '}' => depth = depth.saturating_sub(1),
                _ if word && first => name = Some(n),
                _ => {}
            }
            if depth == 0 && name.is_none() {
                break;
            }
        }
    }
    used
}

#[test]
fn modules_are_found_in_braces_too() {
    let text = "use crate::field::{Field, mask};\nuse crate::{\n    bake::{Bake, cli},\n    study as s, view,\n};\n\
        // crate::sweep\nfn f(x: crate::warp) -> $crate::volume::Samples {}";
    let found = modules_used(text);
    let expected = [(1, "field"), (3, "bake"), (4, "study"), (4, "view"), (7, "warp"), (7, "volume")];
    assert_eq!(found, expected.map(|(line, name)| (line, name.to_owned())));
}

#[test]
fn a_file_uses_only_what_stands_above_it() {
    let src = root().join("src");
    let lib = fs::read_to_string(src.join("lib.rs")).unwrap();
    let order: Vec<&str> =
        lib.lines().filter_map(|l| l.trim_start_matches("pub ").strip_prefix("mod ")?.strip_suffix(';')).collect();
    assert!(order.len() > 20, "the modules of lib.rs: {order:?}");
    let mut files = Vec::new();
    rust_files(&src, &mut files);
    let mut wrong = Vec::new();
    for file in files {
        let relative = file.strip_prefix(&src).unwrap();
        let module = relative.iter().next().unwrap().to_str().unwrap().trim_end_matches(".rs");
        let Some(own) = order.iter().position(|m| *m == module) else {
            assert!(["lib", "main"].contains(&module), "{module} is not in lib.rs");
            continue;
        };
        // Unit tests may look anywhere.
        let text = fs::read_to_string(&file).unwrap();
        let body = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
        if file.file_stem().is_some_and(|s| s.to_str().unwrap().ends_with("tests")) {
            continue;
        }
        for (line, name) in modules_used(body) {
            if order.iter().position(|m| *m == name).is_some_and(|at| at > own) {
                wrong.push(format!("{}:{line}: {module} uses {name}, which stands below it", relative.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Whether a file below `src` may hold what is unsafe: the bindings of Embree, and vector kernels, measured to pay,
/// which stand in modules of that name.
fn is_fenced(relative: &Path) -> bool {
    let named = |part: &std::ffi::OsStr, name: &str| Path::new(part).file_stem().is_some_and(|stem| stem == name);
    relative.iter().next().is_some_and(|first| named(first, "embree"))
        || relative.iter().any(|part| named(part, "simd"))
}

#[test]
fn the_fence_stands_around_embree_and_simd() {
    for inside in ["embree.rs", "embree/abi.rs", "sweep/simd.rs", "pyramid/simd/avx2.rs"] {
        assert!(is_fenced(Path::new(inside)), "{inside}");
    }
    for outside in ["field.rs", "embree_like.rs", "sweep/embree.rs", "sweep/simd_like/a.rs"] {
        assert!(!is_fenced(Path::new(outside)), "{outside}");
    }
}

#[test]
fn unsafe_stays_behind_its_fence() {
    let src = root().join("src");
    let mut files = Vec::new();
    rust_files(&src, &mut files);
    // Wherever the checkout stands.
    for file in files.iter().filter(|f| !is_fenced(f.strip_prefix(&src).unwrap())) {
        let text = fs::read_to_string(file).unwrap();
        for (n, line) in text.lines().enumerate() {
            let code = line.split("//").next().unwrap();
            let fenced = code.contains("unsafe_code") || code.contains("unsafe_op");
            let is_unsafe = code.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == "unsafe");
            assert!(fenced || !is_unsafe, "{}:{}: {line}", file.display(), n + 1);
        }
    }
}

/// Files past 500 lines justify themselves.
#[test]
fn no_file_passes_600_lines() {
    let mut files = Vec::new();
    ["src", "tests", "benches"].iter().for_each(|folder| rust_files(&root().join(folder), &mut files));
    for file in files {
        let lines = fs::read_to_string(&file).unwrap().lines().count();
        assert!(lines <= 600, "{} has {lines} lines", file.display());
    }
}

/// Every file of the checkout that is text; of a package without git the Rust files.
fn texts() -> Vec<(PathBuf, String)> {
    let git = std::process::Command::new("git").args(["ls-files", "-z"]).current_dir(root()).output();
    let listed = git.ok().filter(|listed| listed.status.success() && !listed.stdout.is_empty());
    let files = match listed {
        Some(listed) => {
            String::from_utf8_lossy(&listed.stdout).split_terminator('\0').map(|f| root().join(f)).collect()
        }
        None => {
            let mut files = Vec::new();
            ["src", "tests", "benches"].iter().for_each(|folder| rust_files(&root().join(folder), &mut files));
            files
        }
    };
    files.into_iter().filter_map(|file| Some((file.clone(), fs::read_to_string(file).ok()?))).collect()
}

/// Homes and temporary folders of those who wrote it.
#[test]
fn no_path_of_a_machine_is_told() {
    let homes = ["home", "root", "Users", "tmp", "work"].map(|home| format!("/{home}/"));
    let texts = texts();
    assert!(texts.len() > 300, "{}", texts.len());
    for (file, text) in texts {
        for (n, line) in text.lines().enumerate() {
            let told = homes.iter().find(|home| {
                line.match_indices(home.as_str()).any(|(at, _)| !line[..at].ends_with(|c: char| c.is_alphanumeric()))
            });
            assert!(told.is_none(), "{}:{}: {line}", file.display(), n + 1);
        }
    }
}

/// The formatter minds code only.
#[test]
fn comments_are_no_wider_than_code() {
    let rustfmt = fs::read_to_string(root().join("rustfmt.toml")).unwrap();
    let width: usize = rustfmt.lines().find_map(|l| l.strip_prefix("max_width = ")).unwrap().parse().unwrap();
    let mut files = vec![root().join("build.rs")];
    ["src", "tests", "benches"].iter().for_each(|folder| rust_files(&root().join(folder), &mut files));
    let mut wrong = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        let wide = |l: &str| l.trim_start().starts_with("//") && l.chars().count() > width;
        wrong.extend(
            text.lines().enumerate().filter(|l| wide(l.1)).map(|(n, _)| format!("{}:{}", file.display(), n + 1)),
        );
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn scenes_that_ship_are_described() {
    let table = fs::read_to_string(root().join("scenes/README.md")).unwrap();
    for entry in fs::read_dir(root().join("scenes")).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        assert!(name == "README.md" || table.contains(&name), "scenes/README.md does not mention {name}");
    }
}
