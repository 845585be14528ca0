//! `isolume study`: measurements that fill tables, one subcommand each.

use crate::error::Result;
use crate::flatland::study::{StudySettings, flatland};
use crate::progress::Progress;
use std::path::PathBuf;

#[derive(clap::Args, Debug)]
pub(super) struct Study {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Debug)]
enum What {
    /// n = 2: samples on level sets against uniform ones, from 10³ to 10⁶ (BB09's 7.4 % and 2.2 %)
    Flatland(Flatland),
}

#[derive(clap::Args, Debug)]
struct Flatland {
    /// Folder for study.csv, study.md, study.svg and figure5.png; made if it does not exist
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// The largest number of samples
    #[arg(long, default_value_t = 1_000_000, value_name = "N")]
    most: u64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

impl Study {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        match self.what {
            What::Flatland(v) => {
                super::folder(&v.output)?;
                let settings = StudySettings { most: v.most, seed: v.seed, ..StudySettings::default() };
                flatland(&v.output, &super::device()?, &settings, progress)
            }
        }
    }
}
