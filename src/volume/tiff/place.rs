//! What a stack's texts say of it: ImageJ's lines, OME's XML, tifffile's JSON.

use super::ome;
use crate::files;
use crate::volume::Samples;
use glam::DVec3;
use rayon::prelude::*;
use std::io::{Read, Seek};
use tiff::decoder::Decoder;
use tiff::decoder::ifd::Value;
use tiff::tags::Tag;

/// What the texts of a file's first page say about the stack.
#[derive(Debug, PartialEq)]
pub(super) struct Place {
    /// Steps between samples.
    pub(super) spacing: DVec3,
    /// Images in ImageJ's words, which may stand behind a single page.
    pub(super) images: usize,
    /// Slices in OME's words.
    slices: Option<usize>,
    channels: usize,
    frames: usize,
    /// What OME says against the order of the pages.
    disorder: Option<String>,
    /// The extents of tifffile's array, slowest first.
    shape: Option<Vec<u64>>,
    /// What ImageJ takes integers of 8 and 16 bits for: a number and a multiple of theirs, or another function of its
    /// own.
    calibration: Result<[f64; 2], String>,
}

/// Samples that stand for themselves.
const IDENTITY: [f64; 2] = [0.0, 1.0];

impl Place {
    /// From the first page's tags; texts that are missing or not understood leave the defaults.
    /// The error is a message without the file's name.
    pub(super) fn of<R: Read + Seek>(decoder: &mut Decoder<R>) -> Result<Self, String> {
        let mut place = Self {
            spacing: DVec3::ONE,
            images: 1,
            slices: None,
            channels: 1,
            frames: 1,
            disorder: None,
            shape: None,
            calibration: Ok(IDENTITY),
        };
        let text = decoder.get_tag(Tag::ImageDescription).and_then(Value::into_string).unwrap_or_default();
        let text = text.trim_start_matches('\u{feff}').trim_start();
        if let Some(lines) = text.strip_prefix("ImageJ=") {
            let steps = [Tag::XResolution, Tag::YResolution].map(|tag| match decoder.get_tag(tag) {
                // Samples per unit.
                Ok(Value::Rational(n, d)) if n > 0 && d > 0 => f64::from(d) / f64::from(n),
                _ => 1.0,
            });
            place.imagej(lines, steps);
        } else if text.starts_with('<') && ["<OME", ":OME"].iter().any(|tag| text.contains(tag)) {
            place.ome(text)?;
        } else if text.starts_with('{')
            && let Ok(json) = serde_json::from_str::<serde_json::Value>(text.trim_end_matches('\0'))
        {
            place.shape =
                json["shape"].as_array().and_then(|shape| shape.iter().map(serde_json::Value::as_u64).collect());
        }
        Ok(place)
    }

    fn imagej(&mut self, lines: &str, [x, y]: [f64; 2]) {
        let value = |key: &str| lines.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix('='));
        let count = |key: &str| value(key).and_then(|v| v.trim().parse().ok()).unwrap_or(1);
        let z = value("spacing").and_then(|v| v.trim().parse::<f64>().ok()).filter(|v| v.is_finite() && *v != 0.0);
        // ImageJ writes a negative step for a stack that was made from the far end.
        self.spacing = DVec3::new(x, y, z.unwrap_or(1.0).abs());
        (self.images, self.channels, self.frames) = (count("images"), count("channels"), count("frames"));
        let number = |key: &str| value(key).and_then(|v| v.trim().parse::<f64>().ok());
        self.calibration = match value("cf").map(str::trim) {
            None | Some("20") => Ok(IDENTITY),
            // A straight line; so it keeps signed samples, too.
            Some("0") => {
                let line = number("c0").zip(number("c1")).map(|(c0, c1)| [c0, c1]);
                Ok(line.filter(|line| line.iter().all(|c| c.is_finite()) && line[1] != 0.0).unwrap_or(IDENTITY))
            }
            Some(function) => Err(function.to_owned()),
        };
    }

    /// What ImageJ shows of samples. The error is a message without the file's name.
    pub(super) fn calibrated(&self, samples: Samples) -> Result<Samples, String> {
        match (samples, &self.calibration) {
            (samples @ (Samples::U8(_) | Samples::U16(_)), Ok(line)) => Ok(match (samples, line) {
                (samples, &IDENTITY) => samples,
                // Less 32768: the highest bit turned.
                (Samples::U16(v), [-32768.0, 1.0]) => {
                    Samples::I16(v.into_iter().map(|u| (u ^ 0x8000).cast_signed()).collect())
                }
                (samples, [c0, c1]) => {
                    Samples::F64((0..samples.len()).into_par_iter().map(|i| c0 + c1 * samples.get(i)).collect())
                }
            }),
            (Samples::U8(_) | Samples::U16(_), Err(function)) => Err(format!(
                "ImageJ calibrates its samples by function {function}, which is no straight line; save it as a 32-bit \
                 stack there, which holds calibrated values"
            )),
            (samples, _) => Ok(samples),
        }
    }

    fn ome(&mut self, text: &str) -> Result<(), String> {
        let document =
            files::xml(text.trim_end_matches('\0')).map_err(|e| format!("OME's text is not readable: {e}"))?;
        if document.root_element().tag_name().name() != "OME" {
            return Ok(());
        }
        let Some(pixels) = document.descendants().find(|n| n.tag_name().name() == "Pixels") else { return Ok(()) };
        let count = |key: &str| pixels.attribute(key).and_then(|v| v.parse().ok()).unwrap_or(1);
        self.spacing = ome::spacing(pixels)?;
        self.disorder = ome::check_order(pixels).err();
        (self.channels, self.frames) = (count("SizeC"), count("SizeT"));
        self.slices = pixels.attribute("SizeZ").and_then(|v| v.parse().ok());
        Ok(())
    }

    /// Whether so many pages of so many samples are a volume by these texts. The error is a message without the file's
    /// name.
    pub(super) fn check(&self, pages: usize, samples: u64) -> Result<(), String> {
        let Self { images, channels, frames, slices, ref disorder, .. } = *self;
        if channels > 1 || frames > 1 {
            return Err(format!("holds {channels} channels and {frames} times; save one of them as a stack"));
        }
        if let Some(disorder) = disorder {
            return Err(disorder.clone());
        }
        if pages > 1 && images > 1 && pages != images {
            return Err(format!(
                "ImageJ's text tells of {images} images, but there are {pages} pages; it is cut short, or no stack"
            ));
        }
        if let Some(shape) = &self.shape {
            let told = shape.iter().fold(1, |n: u64, &extent| n.saturating_mul(extent));
            let axes = shape.iter().filter(|n| **n > 1).count();
            // Pages that were written one by one tell of themselves.
            let page = axes <= 2 && told == samples;
            if !page && (axes > 3 || told != samples.saturating_mul(pages as u64)) {
                return Err(format!(
                    "its text tells of an array of shape {shape:?}, and there are {pages} pages: one volume of three axes \
                     is read; save one of them as a stack"
                ));
            }
        }
        match slices {
            Some(slices) if slices != pages => Err(format!(
                "OME's text tells of {slices} slices, but there are {pages} pages: images of several volumes, or parts of \
                 one; save it anew as a stack"
            )),
            _ => Ok(()),
        }
    }
}
