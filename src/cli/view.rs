//! `isolume view`: a bake as a page for any browser.

use super::{expect_extension, outputs};
use crate::error::Result;
use crate::export::bake_file::BakedVolume;
use crate::progress::{Progress, say, unless_interrupted};
use crate::scene_file::Inputs;
use crate::view;
use std::path::PathBuf;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The page needs WebGL2 and nothing else: no server, no network, no installation. Move the slider to sweep the isovalue,
drag to turn, scroll or pinch to come closer, press h for the keys. What to show first can stand behind the name:
  page.html#isovalue=80&shading=local&azimuth=30&elevation=20&zoom=1.5&exposure=1.2&tint=ffd0a0&clip=x,0.5&walls=0

Examples:
  isolume view head.vti -o head.html
  isolume view head.vti -o head.html --title \"A head, 15 to 200\"")]
pub(super) struct View {
    /// A bake (.vti)
    file: PathBuf,
    /// Output: .html
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The page's title (default: the bake's name)
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
}

impl View {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["html", "htm"])?;
        outputs([&*self.output], &Inputs::files([&*self.file]))?;
        let baked = BakedVolume::read(&self.file)?;
        unless_interrupted()?;
        if view::leaves_out(&baked.scene) {
            say!(
                "warning: context geometry is left out: {} polygons, and a page draws {}",
                baked.scene.polygons().len(),
                view::MOST_POLYGONS
            );
        }
        let name = || self.file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let title = self.title.clone().unwrap_or_else(name);
        let bytes = view::write(&self.output, &baked, &title).map_err(|e| e.in_file(&self.file))?;
        if progress.is_shown() {
            let [x, y, z] = baked.lattice().dims();
            say!("{}: {x}×{y}×{z} points in {:.1} MB; open it in a browser", self.output.display(), bytes as f64 / 1e6);
        }
        Ok(())
    }
}
