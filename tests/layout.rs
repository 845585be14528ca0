//! The structure that the design promises: pipeline order, the unsafe fence, no machine's paths, comments as wide as
//! code.

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
        for (n, line) in body.lines().enumerate().filter(|(_, l)| !l.trim_start().starts_with("//")) {
            for used in line.split("crate::").skip(1) {
                let name: String = used.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                if let Some(at) = order.iter().position(|m| *m == name)
                    && at > own
                {
                    wrong.push(format!(
                        "{}:{}: {module} uses {name}, which stands below it",
                        relative.display(),
                        n + 1
                    ));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn unsafe_stays_behind_its_fence() {
    let mut files = Vec::new();
    rust_files(&root().join("src"), &mut files);
    for file in files {
        let name = file.display().to_string().replace('\\', "/");
        // Vector kernels, measured to pay, stand in modules of that name.
        if name.contains("/src/embree") || name.contains("/simd.rs") || name.contains("/simd/") {
            continue;
        }
        let text = fs::read_to_string(&file).unwrap();
        for (n, line) in text.lines().enumerate() {
            let code = line.split("//").next().unwrap();
            let fenced = code.contains("unsafe_code") || code.contains("unsafe_op");
            assert!(fenced || !code.contains("unsafe "), "{name}:{}: {line}", n + 1);
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
