//! Pictures: linear RGB in memory, PNG for the eye, EXR for numbers.

use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use crate::files;
use exr::meta::attribute::{AttributeValue, Text};
use exr::prelude::WritableImage;
use exr::prelude::{Blocks, Compression, Encoding, Image, Layer, LayerAttributes, LineOrder, SpecificChannels, Vec2};
use rayon::prelude::*;
use std::path::Path;

/// How EXR files are packed.
pub(super) const EXR: Encoding =
    Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order: LineOrder::Increasing };

/// What went wrong while an EXR file was written.
pub(super) fn from_exr(error: exr::error::Error) -> std::io::Error {
    match error {
        exr::error::Error::Io(e) => e,
        e => std::io::Error::other(e),
    }
}

/// A picture in linear RGB, rows from top to bottom, pixels from left to right.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width` × `height` pixels, linear.
    pub rgb: Vec<[f32; 3]>,
}

/// Linear light to the sRGB encoding of IEC 61966-2-1, both in [0, 1]. Values beyond are clamped; NaN gives 0.
pub fn srgb_encode(linear: f32) -> f32 {
    let v = if linear.is_nan() { 0.0 } else { f64::from(linear).clamp(0.0, 1.0) };
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    encoded as f32
}

/// The linear light of an sRGB-encoded value in [0, 1]: the inverse of [`srgb_encode`].
pub fn srgb_decode(encoded: f32) -> f32 {
    let v = f64::from(encoded);
    let linear = if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    linear as f32
}

/// Attributes that say how an EXR file is laid out, or that the writer sets.
const RESERVED: [&str; 17] = [
    "channels",
    "chunkCount",
    "compression",
    "dataWindow",
    "displayWindow",
    "lineOrder",
    "maxSamplesPerPixel",
    "multiView",
    "name",
    "pixelAspectRatio",
    "preview",
    "screenWindowCenter",
    "screenWindowWidth",
    "tiles",
    "type",
    "version",
    "view",
];

impl Picture {
    /// A black picture.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: vec![[0.0; 3]; width * height] }
    }

    /// The picture as sRGB bytes: linear × `exposure`, clamped to [0, 1], encoded, rounded to nearest.
    pub fn to_srgb8(&self, exposure: f32) -> Vec<u8> {
        self.rgb.par_iter().flat_map_iter(|p| p.map(|v| (srgb_encode(v * exposure) * 255.0).round() as u8)).collect()
    }

    /// Writes an 8-bit sRGB PNG of [`Picture::to_srgb8`], with the exposure in a text chunk `isolume:exposure`.
    ///
    /// # Errors
    /// `Invalid` for an empty picture, a wrong number of pixels, or an exposure that is not positive and finite; `Io`.
    pub fn write_png(&self, path: impl AsRef<Path>, exposure: f32) -> Result<()> {
        let path = path.as_ref();
        let (width, height) = self.check(path)?;
        if !exposure.is_finite() || exposure <= 0.0 {
            return Err(Error::invalid(path, format!("exposure {exposure}: it must be positive and finite")));
        }
        let write = |out: &mut AtomicFile| -> std::result::Result<(), png::EncodingError> {
            let mut encoder = png::Encoder::new(out, width, height);
            encoder.set_color(png::ColorType::Rgb);
            encoder.set_depth(png::BitDepth::Eight);
            encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
            encoder.add_text_chunk("isolume:exposure".into(), exposure.to_string())?;
            let mut writer = encoder.write_header()?;
            writer.write_image_data(&self.to_srgb8(exposure))?;
            writer.finish()
        };
        files::write_atomically(path, |out| {
            write(out).map_err(|e| match e {
                png::EncodingError::IoError(e) => e,
                e => std::io::Error::other(e),
            })
        })
    }

    /// Writes a 32-bit float EXR of the linear values (scan lines, ZIP, channels B G R), with custom string attributes
    /// (name, value), values in UTF-8. The order of the attributes in the file is not fixed, so its bytes are not
    /// either.
    ///
    /// # Errors
    /// `Invalid` for an empty picture, a wrong number of pixels, or an attribute whose name is not 1–255 ASCII
    /// characters, is used twice or belongs to the format; `Io`.
    pub fn write_exr(&self, path: impl AsRef<Path>, attributes: &[(String, String)]) -> Result<()> {
        let path = path.as_ref();
        self.check(path)?;
        let mut own = LayerAttributes::default();
        for (name, value) in attributes {
            let word = (1..256).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_graphic() || b == b' ');
            // Not Text::from: that would store Latin-1, and panic beyond it. OpenEXR's strings are UTF-8 by convention.
            let text = |s: &str| Text::from_slice_unchecked(s.as_bytes());
            if !word
                || RESERVED.contains(&name.as_str())
                || own.other.insert(text(name), AttributeValue::Text(text(value))).is_some()
            {
                return Err(Error::invalid(
                    path,
                    format!(
                        "attribute {name:?}: names must be 1–255 ASCII characters, differ, and be none of the format"
                    ),
                ));
            }
        }
        let finite = |v: f32| if v.is_nan() { 0.0 } else { v };
        let pixel = |at: Vec2<usize>| {
            let [r, g, b] = self.rgb[at.y() * self.width + at.x()].map(finite);
            (r, g, b)
        };
        let layer = Layer::new((self.width, self.height), own, EXR, SpecificChannels::rgb(pixel));
        // On this thread: the crate would start a thread pool of its own beside rayon's.
        files::write_atomically(path, |out| {
            Image::from_layer(layer).write().non_parallel().to_buffered(out).map_err(from_exr)
        })
    }

    /// The size as PNG counts it, if there is a picture.
    fn check(&self, path: &Path) -> Result<(u32, u32)> {
        let Self { width, height, rgb } = self;
        if width.checked_mul(*height) != Some(rgb.len()) || rgb.is_empty() {
            return Err(Error::invalid(path, format!("picture of {width}×{height} with {} pixels", rgb.len())));
        }
        // Both formats count to 2³¹ − 1.
        match (i32::try_from(*width), i32::try_from(*height)) {
            (Ok(w), Ok(h)) => Ok((w.unsigned_abs(), h.unsigned_abs())),
            _ => Err(Error::not_supported(path, format!("picture of {width}×{height}: too large"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use exr::prelude::{ReadChannels, ReadLayers};
    use std::fs::File;
    use std::io::BufReader;

    fn example() -> Picture {
        let mut picture = Picture::new(5, 3);
        for (i, p) in picture.rgb.iter_mut().enumerate() {
            *p = [i as f32 / 14.0, 0.5 - i as f32, 1e-3 * i as f32];
        }
        picture.rgb[4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
        picture
    }

    #[test]
    fn srgb_is_the_standard() {
        // Values of the two branches, from their definition; 0.214041 is the linear value of mid-grey 0.5.
        for (linear, encoded) in
            [(0.0, 0.0), (0.003, 0.03876), (0.0031308, 0.040_449_94), (0.214_041_14, 0.5), (1.0, 1.0)]
        {
            assert!((srgb_encode(linear) - encoded).abs() < 1e-6, "{linear}: {}", srgb_encode(linear));
        }
        assert_eq!([-1.0, 7.0, f32::NAN, f32::INFINITY].map(srgb_encode), [0.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn png_holds_the_encoded_values() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.png");
        let picture = example();
        assert_eq!(picture.rgb.iter().filter(|p| p.iter().any(|v| v.is_nan())).count(), 1);
        picture.write_png(&path, 0.5).unwrap();
        let mut reader = png::Decoder::new(BufReader::new(File::open(&path).unwrap())).read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        assert_eq!((info.width, info.height, info.color_type), (5, 3, png::ColorType::Rgb));
        assert_eq!(reader.info().srgb, Some(png::SrgbRenderingIntent::Perceptual));
        let text = &reader.info().uncompressed_latin1_text[0];
        assert_eq!((text.keyword.as_str(), text.text.as_str()), ("isolume:exposure", "0.5"));
        assert_eq!(bytes[..3], [0, 137, 0], "0.25 linear is 0.5371 encoded, 136.96 of 255");
        assert_eq!(bytes[12..15], [0, 255, 0], "NaN, ∞, −∞");
        assert_eq!(bytes[42..], [188, 0, 20], "0.5 is 187.52; 0.007 is 20.01");
    }

    #[test]
    fn exr_holds_the_linear_values_and_the_attributes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.exr");
        let long = "a name of more than thirty-one characters".to_string();
        let attributes = [("isolume:isovalue".to_string(), "47.85".to_string()), (long.clone(), "ρ = ¾".to_string())];
        let picture = example();
        picture.write_exr(&path, &attributes).unwrap();
        let image = exr::prelude::read()
            .no_deep_data()
            .largest_resolution_level()
            .rgb_channels(
                |size, _| Picture::new(size.width(), size.height()),
                |picture: &mut Picture, at, (r, g, b): (f32, f32, f32)| {
                    let width = picture.width;
                    picture.rgb[at.y() * width + at.x()] = [r, g, b];
                },
            )
            .first_valid_layer()
            .all_attributes()
            .from_file(&path)
            .unwrap();
        let mut expected = picture;
        expected.rgb[4][0] = 0.0;
        assert_eq!(image.layer_data.channel_data.pixels, expected);
        for (name, value) in &attributes {
            let Some(AttributeValue::Text(text)) = image.layer_data.attributes.other.get(&Text::from(name.as_str()))
            else {
                panic!("no attribute {name}");
            };
            assert_eq!(text.as_slice(), value.as_bytes());
        }
        for bad in ["", "channels", "ρ", "a\0b"] {
            let refused = expected.write_exr(&path, &[(bad.to_string(), String::new())]).unwrap_err();
            assert!(refused.to_string().contains("attribute"), "{bad}");
        }
        assert!(expected.write_exr(&path, &[(long.clone(), "1".into()), (long, "2".into())]).is_err());
    }

    #[test]
    fn wrong_pictures_are_refused_before_a_file_appears() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p");
        let short = Picture { width: 3, height: 2, rgb: vec![[0.0; 3]; 5] };
        assert!(short.write_png(&path, 1.0).unwrap_err().to_string().contains("3×2 with 5 pixels"));
        assert!(short.write_exr(&path, &[]).is_err());
        assert!(Picture::new(0, 3).write_exr(&path, &[]).is_err());
        for exposure in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(Picture::new(1, 1).write_png(&path, exposure).unwrap_err().to_string().contains("exposure"));
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
