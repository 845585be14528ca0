//! The files that a scene is read from: nothing that is made of them may take their place.

use super::{SceneOptions, VolumeSource, Volumes, parse};
use crate::atomic::followed;
use crate::error::{Error, Result};
use crate::files;
use crate::series;
use crate::volume::{metaimage, nrrd};
use std::path::{Path, PathBuf};

/// Files that are read, and patterns of files.
#[derive(Clone, Debug, Default)]
pub struct Inputs {
    files: Vec<PathBuf>,
    patterns: Vec<PathBuf>,
}

impl Inputs {
    /// What is read for `input`, a volume, a bake, or a scene file with all that it names.
    ///
    /// # Errors
    /// `Io` and `Invalid` of a scene file.
    pub fn of(input: &Path, options: &SceneOptions) -> Result<Self> {
        let (_, file, folder) = parse(input)?;
        let mut inputs = Self { files: vec![input.to_path_buf()], patterns: Vec::new() };
        match &file.volume {
            Volumes::One(VolumeSource { file, files, .. }) => {
                let files = files.iter().flatten().chain(file);
                files.for_each(|file| inputs.add(folder.join(file)));
            }
            Volumes::Several(entries) => {
                entries.iter().filter_map(|e| e.file.as_ref()).for_each(|file| inputs.add(folder.join(file)));
            }
        }
        let flag = options.surroundings.kind.as_ref().map(PathBuf::from);
        inputs.files.extend(flag.or_else(|| file.surroundings.kind.as_ref().map(|kind| folder.join(kind))));
        inputs.files.extend(file.context.iter().map(|c| folder.join(&c.file)));
        Ok(inputs.with_data_files())
    }

    /// These files, as they are.
    pub fn files<'p>(files: impl IntoIterator<Item = &'p Path>) -> Self {
        Self { files: files.into_iter().map(Path::to_path_buf).collect(), patterns: Vec::new() }.with_data_files()
    }

    /// And the samples of those that are only headers.
    fn with_data_files(mut self) -> Self {
        let frames = self.patterns.iter().flat_map(|pattern| {
            let folder = pattern.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let found = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
            found.filter(|file| series::number(pattern, file).is_some())
        });
        let headers = self.files.iter().cloned().chain(frames);
        let samples: Vec<PathBuf> = headers.filter_map(|file| data_file(&file)).collect();
        self.files.extend(samples);
        self
    }

    /// A volume's file, or the pattern of a series.
    fn add(&mut self, file: PathBuf) {
        if series::is_pattern(&file) {
            self.patterns.push(file);
        } else {
            self.files.push(file);
        }
    }

    /// That writing `output` leaves all of them as they are, and a series without another frame.
    ///
    /// # Errors
    /// `Invalid` with both names.
    pub fn spare(&self, output: &Path) -> Result<()> {
        let name = output.display();
        if let Some(input) = self.files.iter().find(|input| same(input, output)) {
            return Err(Error::invalid(
                input,
                format!("is an input, and '{name}' would take its place; name another output"),
            ));
        }
        let frame = |pattern: &&PathBuf| {
            let folder = |path: &Path| identity(path).and_then(|path| path.parent().map(Path::to_path_buf));
            series::number(pattern, output).is_some() && folder(pattern) == folder(output)
        };
        match self.patterns.iter().find(frame) {
            None => Ok(()),
            Some(pattern) => Err(Error::invalid(
                pattern,
                format!("is the pattern of the input, and '{name}' would be a frame of it; name another output"),
            )),
        }
    }
}

/// The file that holds the samples of `path`, if that is a header that names one.
fn data_file(path: &Path) -> Option<PathBuf> {
    match files::extension(path).as_str() {
        "nhdr" | "nrrd" => nrrd::data_file(path),
        "mhd" | "mha" => metaimage::data_file(path),
        _ => None,
    }
}

/// Whether two paths name one file.
pub(crate) fn same(a: &Path, b: &Path) -> bool {
    identity(a).is_some_and(|a| identity(b).is_some_and(|b| a == b))
}

/// What a path names, links followed, those that lead to nothing yet among them; `None` if its folder is not there.
fn identity(path: &Path) -> Option<PathBuf> {
    std::fs::canonicalize(path).ok().or_else(|| {
        let path = followed(path).ok()?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        Some(std::fs::canonicalize(folder).ok()?.join(path.file_name()?))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_a_scene_names_is_an_input() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let scene = at("scene.toml");
        let text = "[volume]\nfile = \"a.vti\"\n[box]\nkind = \"room.obj\"\n[[context]]\nfile = \"table.obj\"\n";
        std::fs::write(&scene, text).unwrap();
        std::fs::create_dir(at("sub")).unwrap();
        let inputs = Inputs::of(&scene, &SceneOptions::default()).unwrap();
        for name in ["scene.toml", "a.vti", "room.obj", "table.obj", "sub/../a.vti"] {
            let message = inputs.spare(&at(name)).unwrap_err().to_string();
            assert!(message.contains("is an input") && message.contains(name), "{message}");
        }
        assert!(
            ["b.vti", "a.vti.checkpoint", "sub/a.vti", "room.ply"].iter().all(|name| inputs.spare(&at(name)).is_ok())
        );
        // A flag's box is read instead of the file's.
        let mut options = SceneOptions::default();
        options.surroundings.kind = Some(at("flag.obj").display().to_string());
        let inputs = Inputs::of(&scene, &options).unwrap();
        assert!(inputs.spare(&at("flag.obj")).is_err() && inputs.spare(&at("room.obj")).is_ok());
        let text = "[[volume]]\nname = \"a\"\nfile = \"a.vti\"\n[[volume]]\nname = \"b\"\nfile = \"b.vti\"\n";
        std::fs::write(&scene, text).unwrap();
        let inputs = Inputs::of(&scene, &SceneOptions::default()).unwrap();
        assert!(inputs.spare(&at("b.vti")).is_err() && inputs.spare(&at("c.vti")).is_ok());
    }

    #[test]
    fn no_output_joins_a_series() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let inputs = Inputs::of(&at("rho_%04d.vti"), &SceneOptions::default()).unwrap();
        for name in ["rho_0000.vti", "rho_0017.vti", "rho_12345.vti"] {
            let message = inputs.spare(&at(name)).unwrap_err().to_string();
            assert!(message.contains("would be a frame"), "{name}: {message}");
        }
        std::fs::create_dir(at("sub")).unwrap();
        for name in ["rho_1.vti", "lit_0000.vti", "rho_0000.pvd", "sub/rho_0000.vti"] {
            assert!(inputs.spare(&at(name)).is_ok(), "{name}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_are_what_they_lead_to() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("a.vti"), "").unwrap();
        std::os::unix::fs::symlink(at("a.vti"), at("link.vti")).unwrap();
        assert!(Inputs::files([&*at("a.vti")]).spare(&at("link.vti")).is_err());
        assert!(Inputs::files([&*at("link.vti")]).spare(&at("a.vti")).is_err());
        // Where nothing is yet, too.
        std::os::unix::fs::symlink("b.vti", at("ahead.vti")).unwrap();
        assert!(same(&at("ahead.vti"), &at("b.vti")) && !same(&at("ahead.vti"), &at("c.vti")));
    }

    #[test]
    fn samples_behind_a_header_are_an_input() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("a.nhdr"), "NRRD0004\ndata file: a.npy\n").unwrap();
        std::fs::write(at("b.mhd"), "NDims = 3\nElementDataFile = b.npy\n").unwrap();
        std::fs::write(at("c.mha"), "NDims = 3\nElementDataFile = LOCAL\n").unwrap();
        std::fs::write(at("scene.toml"), "[volume]\nfile = \"a.nhdr\"\n").unwrap();
        let spared = |input: &str, output: &str| Inputs::files([&*at(input)]).spare(&at(output)).is_ok();
        assert!(!spared("a.nhdr", "a.npy") && spared("a.nhdr", "b.npy"));
        assert!(!spared("b.mhd", "b.npy") && spared("c.mha", "LOCAL"));
        let of = |input: &str| Inputs::of(&at(input), &SceneOptions::default()).unwrap();
        assert!(of("scene.toml").spare(&at("a.npy")).is_err());
        std::fs::write(at("f_7.nhdr"), "NRRD0004\ndata file: seventh.npy\n").unwrap();
        assert!(of("f_%d.nhdr").spare(&at("seventh.npy")).is_err() && of("f_%d.nhdr").spare(&at("a.npy")).is_ok());
    }
}
