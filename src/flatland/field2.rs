//! h₂: samples on a rectangle, bilinear in every cell, in units of the sweep.

use crate::digits::span;
use crate::error::{Error, Result};
use crate::field::Sweep;
use crate::files;
use crate::volume::Volume;
use crate::volume::plane::Plane;
use glam::DVec2;
use std::io::BufReader;
use std::path::Path;

/// `bumps2`: peak, centre, width. A large bump behind two small ones that stand near the luminaire.
const BUMPS2: [(f64, DVec2, f64); 3] =
    [(100.0, DVec2::new(0.50, 0.38), 0.16), (80.0, DVec2::new(0.34, 0.74), 0.05), (80.0, DVec2::new(0.62, 0.76), 0.05)];

/// A height field. Positions are index coordinates of its samples, clamped to the rectangle; x runs fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct HeightField {
    dims: [usize; 2],
    origin: DVec2,
    spacing: DVec2,
    sweep: Sweep,
    samples: Vec<f32>,
}

impl HeightField {
    /// Maps source values to units of the sweep and stores f32; non-finite values become NaN, and the cells that touch
    /// one hold no curve and no surface.
    ///
    /// # Errors
    /// `Invalid` for fewer than 2×2 samples, a wrong count, a spacing that is not positive, or values that do not reach
    /// into the sweep or do not fit f32 in its units.
    pub fn new(dims: [usize; 2], origin: DVec2, spacing: DVec2, values: &[f64], sweep: Sweep) -> Result<Self> {
        let fail = |what: String| Err(Error::Invalid(what));
        let [nx, ny] = dims;
        if nx < 2 || ny < 2 || nx.checked_mul(ny) != Some(values.len()) {
            return fail(format!("height field of {nx}×{ny} with {} values: it needs 2×2 or more", values.len()));
        }
        if !(origin.is_finite() && spacing.cmpgt(DVec2::ZERO).all() && spacing.is_finite()) {
            return fail(format!("height field at {origin} spaced by {spacing}: the spacing must be positive"));
        }
        let finite = || values.iter().copied().filter(|v| v.is_finite());
        let (min, max) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
        if !(min < sweep.hi() && max > sweep.lo()) {
            return fail(format!(
                "isovalues {sweep} lie outside the data, which span {}; choose isovalues inside",
                span((min, max))
            ));
        }
        let samples: Vec<f32> =
            values.iter().map(|&v| if v.is_finite() { sweep.isovalue(v) } else { f32::NAN }).collect();
        if samples.iter().any(|s| s.is_infinite()) {
            return fail(format!(
                "data {} in units of the sweep do not fit 32-bit floats; widen the sweep",
                span((min, max))
            ));
        }
        Ok(Self { dims, origin, spacing, sweep, samples })
    }

    /// Samples `f` on [0, 1]², vertex-centred, `size` samples along each edge.
    ///
    /// # Errors
    /// As [`HeightField::new`].
    pub fn sample(size: usize, sweep: Sweep, f: impl Fn(DVec2) -> f64) -> Result<Self> {
        let n = size.max(2);
        let along = |i: usize| i as f64 / (n - 1) as f64;
        let values: Vec<f64> = (0..n * n).map(|o| f(DVec2::new(along(o % n), along(o / n)))).collect();
        Self::new([n, n], DVec2::ZERO, DVec2::splat(1.0 / (n - 1) as f64), &values, sweep)
    }

    /// The `bumps2` of the tables at x ∈ [0, 1]².
    pub fn bumps2(x: DVec2) -> f64 {
        BUMPS2.iter().map(|&(peak, m, s)| peak * (-(x - m).length_squared() / (2.0 * s * s)).exp()).sum()
    }

    /// A generator by name: `bumps2`, or `ramp` (h = y).
    ///
    /// # Errors
    /// `Invalid` with the list of names, and as [`HeightField::new`].
    pub fn generate(name: &str, size: usize, sweep: Sweep) -> Result<Self> {
        if !(2..=1 << 14).contains(&size) {
            return Err(Error::Invalid(format!("size {size}: 2 to 16384 samples along an edge")));
        }
        match name {
            "bumps2" => Self::sample(size, sweep, Self::bumps2),
            "ramp" => Self::sample(size, sweep, |x| x.y),
            _ => Err(Error::Invalid(format!("generator `{name}`: known are bumps2 and ramp"))),
        }
    }

    /// Reads a grey PNG (8 or 16 bits, values as stored, the longer edge of length 1, the top row at the largest y), a
    /// flat field as [`Plane::open`] finds it (its axes are x and y, with its spacing, from 0 on), or one slice of a
    /// volume that is a single cell thick along some axis (its first two samples deep; in world units).
    ///
    /// `sweep` of `None` takes the least and greatest value.
    ///
    /// # Errors
    /// `Io`, `Invalid` or `NotSupported` with the file's name.
    pub fn open(path: &Path, sweep: Option<Sweep>) -> Result<Self> {
        let (dims, origin, spacing, values) = if files::has_extension(path, "png") {
            read_png(path)?
        } else if let Some(plane) = Plane::open(path)? {
            let values = (0..plane.samples.len()).map(|o| plane.samples.get(o)).collect();
            (plane.dims, DVec2::ZERO, DVec2::from_array(plane.spacing), values)
        } else {
            thin_slice(&Volume::open(path)?)?
        };
        let sweep = match sweep {
            Some(sweep) => sweep,
            None => {
                let finite = || values.iter().copied().filter(|v| v.is_finite());
                Sweep::new(finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max))
                    .map_err(|_| Error::invalid(path, "all values are the same: there is no level set"))?
            }
        };
        Self::new(dims, origin, spacing, &values, sweep).map_err(|e| e.in_file(path))
    }

    /// Samples along x and y.
    pub fn dims(&self) -> [usize; 2] {
        self.dims
    }

    /// World distance between samples.
    pub fn spacing(&self) -> DVec2 {
        self.spacing
    }

    /// The sweep, [0, 1] here.
    pub fn sweep(&self) -> Sweep {
        self.sweep
    }

    /// Samples that are not finite: the cells that touch them hold nothing.
    pub fn non_finite(&self) -> usize {
        self.samples.iter().filter(|s| s.is_nan()).count()
    }

    /// Samples in units of the sweep.
    pub fn samples(&self) -> &[f32] {
        &self.samples
    }

    /// Index coordinates of the far corner.
    pub fn far(&self) -> DVec2 {
        DVec2::from_array(self.dims.map(|n| (n - 1) as f64))
    }

    /// World corners of the rectangle.
    pub fn bounds(&self) -> [DVec2; 2] {
        [self.origin, self.to_world(self.far())]
    }

    /// Index to world coordinates.
    #[inline]
    pub fn to_world(&self, p: DVec2) -> DVec2 {
        self.origin + self.spacing * p
    }

    /// World to index coordinates.
    #[inline]
    pub fn to_index(&self, x: DVec2) -> DVec2 {
        (x - self.origin) / self.spacing
    }

    /// The cell that holds `p`, and `p` inside it in [0, 1]².
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the rectangle")]
    pub fn locate(&self, p: DVec2) -> ([usize; 2], DVec2) {
        let cell: [usize; 2] = std::array::from_fn(|a| (p[a].max(0.0) as usize).min(self.dims[a] - 2));
        let local = (p - DVec2::from_array(cell.map(|i| i as f64))).clamp(DVec2::ZERO, DVec2::ONE);
        (cell, local)
    }

    /// The 4 samples of a cell: x first.
    #[inline]
    pub fn corners(&self, [i, j]: [usize; 2]) -> [f32; 4] {
        let s = &self.samples[j * self.dims[0] + i..];
        let y = self.dims[0];
        [s[0], s[1], s[y], s[y + 1]]
    }

    /// h at `p`, bilinear.
    #[inline]
    pub fn value(&self, p: DVec2) -> f64 {
        let (cell, u) = self.locate(p);
        bilinear(self.corners(cell).map(f64::from), u)
    }

    /// ∇h of the bilinear cell at `p`, per world unit.
    pub fn gradient(&self, p: DVec2) -> DVec2 {
        let (cell, u) = self.locate(p);
        let s = self.corners(cell).map(f64::from);
        let gx = s[1] - s[0] + u.y * (s[3] - s[2] - s[1] + s[0]);
        let gy = s[2] - s[0] + u.x * (s[3] - s[1] - s[2] + s[0]);
        DVec2::new(gx, gy) / self.spacing
    }

    /// Central differences at a sample, one-sided at the border and beside non-finite samples, per world unit.
    pub fn node_gradient(&self, ij: [usize; 2]) -> DVec2 {
        let at = ij[1] * self.dims[0] + ij[0];
        let stride = [1, self.dims[0]];
        let finite = |o: usize| self.samples[o].is_finite().then(|| f64::from(self.samples[o]));
        let g: [f64; 2] = std::array::from_fn(|a| {
            let before = if ij[a] > 0 { finite(at - stride[a]) } else { None };
            let after = if ij[a] + 1 < self.dims[a] { finite(at + stride[a]) } else { None };
            match (before, finite(at), after) {
                (Some(b), _, Some(c)) => 0.5 * (c - b),
                (Some(b), Some(h), None) => h - b,
                (None, Some(h), Some(c)) => c - h,
                _ => 0.0,
            }
        });
        DVec2::from_array(g) / self.spacing
    }

    /// The receiver gradient: central differences at the samples, interpolated, per world unit. Its direction is the
    /// normal of every cosine, as in three dimensions.
    pub fn receiver_gradient(&self, p: DVec2) -> DVec2 {
        let ([i, j], u) = self.locate(p);
        let g = |x, y| self.node_gradient([i + x, j + y]);
        let (low, high) = (g(0, 0).lerp(g(1, 0), u.x), g(0, 1).lerp(g(1, 1), u.x));
        low.lerp(high, u.y)
    }
}

/// Bilinear interpolation of four values.
#[inline]
pub(super) fn bilinear(s: [f64; 4], u: DVec2) -> f64 {
    let (low, high) = (s[0] + u.x * (s[1] - s[0]), s[2] + u.x * (s[3] - s[2]));
    low + u.y * (high - low)
}

type Raster = ([usize; 2], DVec2, DVec2, Vec<f64>);

fn read_png(path: &Path) -> Result<Raster> {
    let broken = |e: png::DecodingError| Error::invalid(path, format!("not a readable PNG: {e}"));
    let file = files::open(path)?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(broken)?;
    let size = reader.output_buffer_size().ok_or_else(|| Error::invalid(path, "too large for this machine"))?;
    let mut bytes = vec![0; size];
    let info = reader.next_frame(&mut bytes).map_err(broken)?;
    let channels = match info.color_type {
        png::ColorType::Grayscale => 1,
        png::ColorType::GrayscaleAlpha => 2,
        other => return Err(Error::not_supported(path, format!("a {other:?} picture; convert it to grey"))),
    };
    let wide = info.bit_depth == png::BitDepth::Sixteen;
    let (nx, ny) = (info.width as usize, info.height as usize);
    let value = |x: usize, y: usize| {
        let at = y * info.line_size + x * channels * if wide { 2 } else { 1 };
        if wide { f64::from(u16::from_be_bytes([bytes[at], bytes[at + 1]])) } else { f64::from(bytes[at]) }
    };
    let values = (0..nx * ny).map(|o| value(o % nx, ny - 1 - o / nx)).collect();
    let step = 1.0 / (nx.max(ny).max(2) - 1) as f64;
    Ok(([nx, ny], DVec2::ZERO, DVec2::splat(step), values))
}

fn thin_slice(volume: &Volume) -> Result<Raster> {
    let lattice = &volume.lattice;
    let dims = lattice.dims();
    let Some(thin) = (0..3).rev().find(|&a| dims[a] == 2) else {
        let [x, y, z] = dims;
        return Err(Error::NotSupported(format!(
            "{}: {x}×{y}×{z} samples; a height field is one sample thick along one axis (.nrrd or .vti), or two: cut out a slice",
            volume.name
        )));
    };
    let [a, b] = match thin {
        0 => [1, 2],
        1 => [0, 2],
        _ => [0, 1],
    };
    let at = |i: usize, j: usize| {
        let mut ijk = [0; 3];
        (ijk[a], ijk[b]) = (i, j);
        volume.value(lattice.offset(ijk[0], ijk[1], ijk[2]))
    };
    let values = (0..dims[a] * dims[b]).map(|o| at(o % dims[a], o / dims[a])).collect();
    let spacing = lattice.spacing();
    Ok(([dims[a], dims[b]], DVec2::ZERO, DVec2::new(spacing[a], spacing[b]), values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_world_gradients() {
        let values: Vec<f64> = (0..12).map(|o| 0.1 * f64::from(o % 4) - 0.05 * f64::from(o / 4)).collect();
        let f = HeightField::new(
            [4, 3],
            DVec2::new(5.0, -2.0),
            DVec2::new(0.5, 2.0),
            &values,
            Sweep::new(0.0, 1.0).unwrap(),
        )
        .unwrap();
        for p in [DVec2::new(0.0, 0.0), DVec2::new(1.3, 0.7), DVec2::new(3.0, 2.0)] {
            let expected = DVec2::new(0.2, -0.025);
            assert!((f.gradient(p) - expected).length() < 1e-6);
            assert!((f.receiver_gradient(p) - expected).length() < 1e-6);
            assert!((f.value(p) - (0.1 * p.x - 0.05 * p.y)).abs() < 1e-6);
        }
        assert_eq!(f.to_index(f.to_world(DVec2::new(1.5, 0.25))), DVec2::new(1.5, 0.25));
    }

    #[test]
    fn grey_pictures_stand_upright() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.png");
        let mut encoder = png::Encoder::new(std::fs::File::create(&path).unwrap(), 3, 2);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.write_header().unwrap().write_image_data(&[10, 20, 30, 40, 50, 60]).unwrap();
        let f = HeightField::open(&path, None).unwrap();
        assert_eq!(f.dims(), [3, 2]);
        assert_eq!(f.bounds()[1], DVec2::new(1.0, 0.5));
        assert!((f.sweep().from_unit(f.value(DVec2::ZERO)) - 40.0).abs() < 1e-4, "the bottom left");
        let wrong = HeightField::open(&path, Some(Sweep::new(100.0, 200.0).unwrap())).unwrap_err().to_string();
        assert!(wrong.contains("p.png") && wrong.contains("outside"), "{wrong}");
    }

    #[test]
    fn flat_nrrd_and_vti_are_fields() {
        let folder = tempfile::tempdir().unwrap();
        let check = |name: &str, file: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, file).unwrap();
            let f = HeightField::open(&path, None).unwrap();
            assert_eq!((f.dims(), f.spacing()), ([3, 2], DVec2::new(0.5, 2.0)), "{name}");
            assert!((f.sweep().from_unit(f.value(DVec2::new(1.0, 1.0))) - 4.0).abs() < 1e-5, "{name}");
        };
        let nrrd = |place: &str| format!("NRRD0004\ntype: uchar\nencoding: ascii\n{place}\n\n0 1 2\n3 4 5\n");
        check("a.nrrd", nrrd("dimension: 2\nsizes: 3 2\nspacings: 0.5 2").as_bytes());
        let oblique = "dimension: 2\nsizes: 3 2\nspace dimension: 2\nspace directions: (0.3,-0.4) (2,0)";
        check("b.nrrd", nrrd(oblique).as_bytes());
        check("c.nrrd", nrrd("dimension: 3\nsizes: 3 2 1\nspace directions: (0.5,0,0) (0,2,0) (0,0,1)").as_bytes());
        let vti = |extent: &str, spacing: &str| {
            format!(
                "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"{extent}\" Spacing=\"{spacing}\"><Piece \
                 Extent=\"{extent}\"><PointData><DataArray type=\"Int16\" Name=\"h\" format=\"ascii\">0 1 2 3 4 5\
                 </DataArray></PointData></Piece></ImageData></VTKFile>"
            )
        };
        check("a.vti", vti("0 2 0 1 7 7", "0.5 2 1").as_bytes());
        check("b.vti", vti("0 0 1 3 0 1", "9 0.5 2").as_bytes());
        for (name, file) in [("thin.nrrd", nrrd("dimension: 2\nsizes: 6 1")), ("thin.vti", vti("0 5 0 0 0 0", "1 1 1"))]
        {
            let path = folder.path().join(name);
            std::fs::write(&path, file).unwrap();
            let message = HeightField::open(&path, None).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("no rectangle"), "{message}");
        }
    }

    #[test]
    fn unknown_generators_and_empty_sweeps() {
        let sweep = Sweep::new(3.6, 95.0).unwrap();
        assert!(HeightField::generate("bumps", 9, sweep).unwrap_err().to_string().contains("bumps2"));
        assert!(HeightField::generate("bumps2", 1, sweep).is_err());
        assert!((HeightField::bumps2(DVec2::new(0.5, 0.38)) - 100.0).abs() < 1e-3);
    }
}
