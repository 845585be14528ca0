//! `isolume completions` and `isolume man`: what the command line says about itself, for shells and readers.

use super::Cli;
use crate::error::{Error, Result};
use crate::files;
use crate::progress::{Progress, say};
use clap::CommandFactory;
use std::io::Write;
use std::path::{Path, PathBuf};

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The folders of these files must be there.

Examples:
  isolume completions bash > ~/.local/share/bash-completion/completions/isolume
  isolume completions zsh > ~/.zfunc/_isolume
  isolume completions fish > ~/.config/fish/completions/isolume.fish")]
pub(super) struct Completions {
    /// The shell
    shell: clap_complete::Shell,
}

impl Completions {
    pub(super) fn run(self) -> Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut Cli::command(), "isolume", &mut script);
        // A reader that has seen enough is no failure.
        match std::io::stdout().write_all(&script) {
            Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("standard output", e)),
            _ => Ok(()),
        }
    }
}

#[derive(clap::Args, Debug)]
#[command(after_help = "\
Examples:
  isolume man -o ~/.local/share/man/man1                 then: man isolume-bake")]
pub(super) struct ManualPages {
    /// Folder for isolume.1, isolume-bake.1 and so on; made if it does not exist
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

impl ManualPages {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        super::folder(&self.output)?;
        let mut root = Cli::command().name("isolume");
        root.build();
        let count = write_pages(&self.output, &root, "isolume")?;
        if progress.is_shown() {
            say!("{}: {count} manual pages", self.output.display());
        }
        Ok(())
    }
}

/// The page of `command` and those of its verbs; how many.
fn write_pages(folder: &Path, command: &clap::Command, name: &str) -> Result<usize> {
    let path = folder.join(format!("{name}.1"));
    let page = clap_mangen::Man::new(command.clone().name(name.to_owned()).bin_name(name.replace('-', " ")));
    let mut text = Vec::new();
    page.render(&mut text).map_err(|e| Error::io(&path, e))?;
    let text = with_examples(&String::from_utf8_lossy(&text));
    files::write_atomically(&path, |out| out.write_all(text.as_bytes()))?;
    let mut count = 1;
    for verb in command.get_subcommands().filter(|v| v.get_name() != "help") {
        count += write_pages(folder, verb, &format!("{name}-{}", verb.get_name()))?;
    }
    Ok(count)
}

/// A page whose examples have a heading, and keep their lines: those of a paragraph are filled.
fn with_examples(page: &str) -> String {
    let Some((before, after)) = page.split_once("\nExamples:\n") else { return page.to_owned() };
    let before =
        before.strip_suffix("\n.SH EXTRA").map_or_else(|| before.replace(".SH EXTRA", ".SH NOTES"), str::to_owned);
    let end = after.find("\n.SH ").unwrap_or(after.len());
    let (examples, rest) = after.split_at(end);
    format!("{before}\n.SH EXAMPLES\n.nf\n{}\n.fi{}\n", examples.trim_end(), rest.trim_end())
}
