//! The one error type. Every message names the file, the key or index, what was found and what to do.

use std::path::{Path, PathBuf};

/// What can go wrong. `Error` means a failure; accuracy is never called error in this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused to read or write `path`.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file, a key or an argument is wrong. The message is complete and names where.
    #[error("{0}")]
    Invalid(String),
    /// The input is well formed, but asks for something isolume does not do.
    #[error("{0}")]
    NotSupported(String),
    /// What went wrong, and the line and key of the scene file that asked for it.
    #[error("{place}: {source}")]
    At {
        /// Where it was asked for.
        place: String,
        /// What went wrong.
        source: Box<Error>,
    },
    /// Embree refused: a missing or too old library, or a failed build.
    #[error("Embree: {0}")]
    Embree(String),
    /// The user interrupted the work.
    #[error("interrupted; no unfinished output was written")]
    Interrupted,
    /// A check on results failed (`compare`, `selftest`).
    #[error("{0}")]
    Failed(String),
}

/// `Result` with [`Error`] unless another error is named.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An [`Error::Io`] at `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Error::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// An [`Error::Invalid`] that begins with the file's name.
    pub fn invalid(path: impl AsRef<Path>, message: impl std::fmt::Display) -> Self {
        Error::Invalid(format!("{}: {message}", path.as_ref().display()))
    }

    /// An [`Error::NotSupported`] that begins with the file's name.
    pub fn not_supported(path: impl AsRef<Path>, message: impl std::fmt::Display) -> Self {
        Error::NotSupported(format!("{}: {message}", path.as_ref().display()))
    }

    /// The same error with the file's name in front, for checks that do not know which file they serve.
    #[must_use]
    pub fn in_file(self, path: impl AsRef<Path>) -> Self {
        match self {
            Error::Invalid(message) => Error::invalid(path, message),
            Error::NotSupported(message) => Error::not_supported(path, message),
            other => other,
        }
    }

    /// The same error with `place` in front, which asked for what failed.
    #[must_use]
    pub fn at(self, place: impl std::fmt::Display) -> Self {
        match self {
            Error::Invalid(message) => Error::Invalid(format!("{place}: {message}")),
            Error::NotSupported(message) => Error::NotSupported(format!("{place}: {message}")),
            other => Error::At { place: place.to_string(), source: Box::new(other) },
        }
    }

    /// The exit code of the command line: 2 for bad usage or input (paths that cannot be read or written among it), 130
    /// when interrupted, 1 for the rest.
    pub fn exit_code(&self) -> u8 {
        use std::io::ErrorKind as K;
        match self {
            // Nobody asked for too much: the disk ran out.
            Error::Io { source, .. }
                if matches!(source.kind(), K::StorageFull | K::QuotaExceeded | K::FileTooLarge) =>
            {
                1
            }
            Error::Io { .. } | Error::Invalid(_) | Error::NotSupported(_) => 2,
            Error::At { source, .. } => source.exit_code(),
            Error::Interrupted => 130,
            Error::Embree(_) | Error::Failed(_) => 1,
        }
    }
}
