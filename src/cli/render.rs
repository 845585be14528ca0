//! `isolume render`: a picture of one isosurface.

use super::extract::open_bake;
use super::final_gather::FinalGatherOptions;
use super::reference::picture;
use super::{check_exposure, device, expect_extension, outputs};
use crate::digits::Shortest;
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::files;
use crate::final_gather::FinalGatherSettings;
use crate::progress::{Progress, say};
use crate::render::{Camera, Rendered, Shading, render};
use crate::scene::{Policy, Scene};
use crate::scene_file::{Inputs, SceneOptions, load};
use glam::DVec3;
use std::path::PathBuf;
use std::time::Instant;

#[derive(clap::Args, Debug)]
#[command(after_help = "\
The picture holds the walls too. A .png is exposed so that a surface at the box's centre that faces the luminaire is white; an
.exr holds linear radiance and every setting. Parts of the surface that show their inside are black unless the bake stored it
(--sides both).

Examples:
  isolume render lit.vti --isovalue 80 -o lit.png
  isolume render lit.vti --isovalue 80 -o local.png --local            the same view as other tools would light it
  isolume render lit.vti --isovalue 80 -o side.exr --eye 90,-300,120 --target 90,108,90
  isolume render lit.vti --isovalue 80 -o exact.png --gather-rays 16             nearly as by paths, without their noise
  isolume render lit.vti --isovalue 80 -o truth.png --reference --samples 256")]
pub(super) struct Render {
    /// A bake (.vti, .vtm); with --reference or --local also a volume or scene file
    file: PathBuf,
    /// The isosurface to draw, in the volume's units
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    isovalue: f64,
    /// Of several volumes, the one that --isovalue speaks of: its name (default: the first). The others are drawn at
    /// the same share of their own ranges
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Output: .png (exposed, sRGB) or .exr (linear radiance)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Plain local shading of the same view, for comparison
    #[arg(long, conflicts_with_all = ["shadow_rays", "gather_rays", "trilinear"])]
    local: bool,
    /// Path-trace the isosurface's triangles instead of using the bake's light
    #[arg(long, conflicts_with_all = ["local", "shadow_rays", "gather_rays"])]
    reference: bool,
    /// With --reference: path-trace the trilinear surface itself instead of triangles, caps included
    #[arg(long, requires = "reference")]
    trilinear: bool,
    /// Pixels from top to bottom
    #[arg(long, default_value_t = 600, value_name = "PIXELS")]
    height: usize,
    /// Pixels across (default: by the box's aspect)
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,
    /// Rays per pixel
    #[arg(long, default_value_t = 16, value_name = "N")]
    samples: u32,
    /// Camera position in the world (default: in front of the box)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    eye: Option<Vec<f64>>,
    /// Point the camera looks at (default: the box's centre if --eye is given)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    target: Option<Vec<f64>>,
    /// Up direction (default: 0,0,1)
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    up: Option<Vec<f64>>,
    /// Vertical field of view in degrees
    #[arg(long, default_value_t = 40.0, value_name = "DEGREES")]
    fov: f64,
    /// Brightness: multiplies the bake's exposure
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    exposure: f64,
    #[command(flatten)]
    rays: FinalGatherOptions,
    #[command(flatten)]
    scene: SceneOptions,
}

fn triple(values: Option<&Vec<f64>>, name: &str) -> Result<Option<DVec3>> {
    match values.map(Vec::as_slice) {
        None => Ok(None),
        Some(&[x, y, z]) => Ok(Some(DVec3::new(x, y, z))),
        Some(v) => Err(Error::Invalid(format!("--{name}: needs three numbers X,Y,Z, found {}", v.len()))),
    }
}

/// The isovalue of a scene's first volume where the one named `name` has `isovalue`.
fn first_isovalue(scene: &Scene, name: &str, isovalue: f64) -> Result<f64> {
    let member = scene.members().swap_remove(scene.field_named(name)?);
    let sweep = member.field.sweep();
    if !(sweep.lo()..=sweep.hi()).contains(&isovalue) {
        let isovalue = Shortest(isovalue);
        return Err(Error::Invalid(format!("--isovalue {isovalue}: outside the range of '{name}', {sweep}")));
    }
    Ok(scene.field.sweep().from_unit(sweep.to_unit(isovalue)))
}

/// What a picture is drawn of.
enum Source {
    Bake(BakedVolume),
    Unbaked(Scene),
}

impl Source {
    fn scene(&self) -> &Scene {
        match self {
            Self::Bake(baked) => &baked.scene,
            Self::Unbaked(scene) => scene,
        }
    }

    fn baked(&self) -> Option<&BakedVolume> {
        match self {
            Self::Bake(baked) => Some(baked),
            Self::Unbaked(_) => None,
        }
    }

    /// What radiance is multiplied by to be shown.
    fn exposure(&self) -> f64 {
        match self {
            Self::Bake(baked) => baked.exposure,
            Self::Unbaked(scene) => scene.exposure(),
        }
    }
}

impl Render {
    pub(super) fn run(self, progress: Progress) -> Result<()> {
        expect_extension(&self.output, &["png", "exr"])?;
        outputs([&*self.output], &Inputs::of(&self.file, &self.scene)?)?;
        let begun = Instant::now();
        self.check_numbers()?;
        let gather = self.rays.settings()?;
        let source = self.read(gather)?;
        let scene = source.scene();
        let isovalue = match &self.field {
            None => self.isovalue,
            Some(name) => first_isovalue(scene, name, self.isovalue).map_err(|e| e.in_file(&self.file))?,
        };
        let camera = self.camera(scene)?;
        let exposure = source.exposure() * self.exposure;
        let exr = files::has_extension(&self.output, "exr");
        #[allow(clippy::cast_possible_truncation, reason = "a brightness")]
        let brightness = exposure as f32;
        let storable = exr || (brightness > 0.0 && brightness.is_finite());
        if !storable {
            return Err(Error::Invalid(format!(
                "--exposure {:?}: times {:?}, the exposure of {}, it is no brightness that a .png can have; give another",
                self.exposure,
                source.exposure(),
                self.file.display()
            )));
        }
        let rendered = self.draw(&source, isovalue, &camera, gather, progress)?;
        if exr {
            let mut attributes = self.attributes(&source, &camera, gather);
            attributes.push(("renderTimeSeconds".into(), begun.elapsed().as_secs_f64().to_string()));
            rendered.picture.write_exr(&self.output, &attributes)?;
        } else {
            rendered.picture.write_png(&self.output, brightness)?;
        }
        if progress.is_shown() {
            let seconds = begun.elapsed().as_secs_f64();
            let rays = gather.map_or_else(String::new, |_| format!(", {:.1} M rays", rendered.rays as f64 / 1e6));
            say!("{}: {}×{} in {seconds:.2} s{rays}", self.output.display(), camera.size[0], camera.size[1]);
        }
        if rendered.unbaked > 0.001 {
            say!(
                "warning: {:.1} % of the picture shows the surface's inside, which was not baked; use --sides both",
                100.0 * rendered.unbaked
            );
        }
        Ok(())
    }

    fn check_numbers(&self) -> Result<()> {
        let pixels = 1..=Camera::MOST;
        if !pixels.contains(&self.height) || self.width.is_some_and(|w| !pixels.contains(&w)) {
            return Err(Error::Invalid(format!("--height, --width: 1 to {} pixels", Camera::MOST)));
        }
        if !(1..=1 << 16).contains(&self.samples) {
            return Err(Error::Invalid("--samples: 1 to 65536 rays per pixel".into()));
        }
        check_exposure(self.exposure)
    }

    fn read(&self, gather: Option<FinalGatherSettings>) -> Result<Source> {
        let baked = match open_bake(&self.file, &self.scene)? {
            None if !self.reference && !self.local => Some(BakedVolume::read(&self.file)?),
            found => found,
        };
        let Some(baked) = baked else {
            let options = SceneOptions { wanted: Some(self.isovalue), ..self.scene.clone() };
            return Ok(Source::Unbaked(load(&self.file, &options)?.scene));
        };
        gather.map_or(Ok(()), |g| g.check(&baked)).map_err(|e| e.in_file(&self.file))?;
        Ok(Source::Bake(baked))
    }

    fn camera(&self, scene: &Scene) -> Result<Camera> {
        let mut camera = Camera::facing(scene, self.height);
        (camera.fov, camera.samples) = (self.fov, self.samples);
        if let Some(width) = self.width {
            camera.size[0] = width;
        }
        let [width, height] = camera.size;
        if !(1..=Camera::MOST).contains(&width) {
            return Err(Error::Invalid(format!(
                "--height {height}: of the box's proportions the picture would be {width} pixels wide, more than {}; give \
                 --width, or lower --height",
                Camera::MOST
            )));
        }
        if let Some(up) = triple(self.up.as_ref(), "up")? {
            camera.up = up;
        }
        let [lo, hi] = scene.bounds();
        if let Some(eye) = triple(self.eye.as_ref(), "eye")? {
            (camera.eye, camera.target) = (eye, 0.5 * (lo + hi));
        }
        if let Some(target) = triple(self.target.as_ref(), "target")? {
            camera.target = target;
        }
        Ok(camera)
    }

    fn draw(
        &self,
        source: &Source,
        isovalue: f64,
        camera: &Camera,
        gather: Option<FinalGatherSettings>,
        progress: Progress,
    ) -> Result<Rendered> {
        let scene = source.scene();
        if !self.reference {
            let shading = match source {
                Source::Bake(baked) if !self.local => Shading::Baked(baked, gather),
                _ => Shading::Local(source.exposure()),
            };
            return render(scene, isovalue, camera, shading, &device()?, progress);
        }
        if scene.fields() > 1 && scene.policy() == Policy::Independent {
            return Err(Error::not_supported(
                &self.file,
                "policy = \"independent\": paths see all volumes; a picture of one needs a scene of one",
            ));
        }
        source.baked().map_or(Ok(()), BakedVolume::whole).map_err(|e| e.in_file(&self.file))?;
        let picture = picture(scene, isovalue, camera, self.trilinear, &device()?, progress)?;
        Ok(Rendered { picture, unbaked: 0.0, rays: 0 })
    }

    /// What an .exr says of itself.
    fn attributes(
        &self,
        source: &Source,
        camera: &Camera,
        gather: Option<FinalGatherSettings>,
    ) -> Vec<(String, String)> {
        let baked = source.baked();
        let shading = match () {
            () if self.trilinear => "path traced, trilinear",
            () if self.reference => "path traced",
            () if self.local || baked.is_none() => "local",
            () if gather.is_some() => "baked, by rays",
            () => "baked",
        };
        let vector = |v: DVec3| format!("{:?},{:?},{:?}", v.x, v.y, v.z);
        [
            ("isolume", format!("{} ({})", env!("CARGO_PKG_VERSION"), env!("ISOLUME_COMMIT"))),
            ("source", self.file.display().to_string()),
            ("isovalue", self.isovalue.to_string()),
            ("field", self.field.clone().unwrap_or_else(|| source.scene().name.clone())),
            ("shading", shading.to_owned()),
            ("eye", vector(camera.eye)),
            ("target", vector(camera.target)),
            ("up", vector(camera.up)),
            ("fov", camera.fov.to_string()),
            ("exposure", (source.exposure() * self.exposure).to_string()),
            ("samplesPerPixel", self.samples.to_string()),
            ("report", baked.map_or_else(|| "null".into(), |b| b.report.to_string())),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }
}
