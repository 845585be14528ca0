//! What a stack's texts say of it: ImageJ's lines, OME's XML.

use super::ome;
use crate::files;
use glam::DVec3;
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
    /// Whether 16-bit samples stand for themselves − 32768.
    pub(super) signed: bool,
}

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
            signed: false,
        };
        let text = decoder.get_tag(Tag::ImageDescription).and_then(Value::into_string).unwrap_or_default();
        if let Some(lines) = text.strip_prefix("ImageJ=") {
            let steps = [Tag::XResolution, Tag::YResolution].map(|tag| match decoder.get_tag(tag) {
                // Samples per unit.
                Ok(Value::Rational(n, d)) if n > 0 && d > 0 => f64::from(d) / f64::from(n),
                _ => 1.0,
            });
            place.imagej(lines, steps);
        } else if text.contains("<OME") {
            place.ome(&text)?;
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
        // So ImageJ keeps signed ones: unsigned, with a straight line (function 0) that turns them back.
        let number = |key: &str| value(key).and_then(|v| v.trim().parse::<f64>().ok());
        self.signed = [("cf", 0.0), ("c0", -32768.0), ("c1", 1.0)].iter().all(|&(key, v)| number(key) == Some(v));
    }

    fn ome(&mut self, text: &str) -> Result<(), String> {
        let Ok(document) = files::xml(text.trim_end_matches('\0')) else { return Ok(()) };
        let Some(pixels) = document.descendants().find(|n| n.tag_name().name() == "Pixels") else { return Ok(()) };
        let count = |key: &str| pixels.attribute(key).and_then(|v| v.parse().ok()).unwrap_or(1);
        self.spacing = ome::spacing(pixels)?;
        self.disorder = ome::check_order(pixels).err();
        (self.channels, self.frames) = (count("SizeC"), count("SizeT"));
        self.slices = pixels.attribute("SizeZ").and_then(|v| v.parse().ok());
        Ok(())
    }

    /// Whether so many pages are a volume by these texts. The error is a message without the file's name.
    pub(super) fn check(&self, pages: usize) -> Result<(), String> {
        let Self { channels, frames, slices, ref disorder, .. } = *self;
        if channels > 1 || frames > 1 {
            return Err(format!("holds {channels} channels and {frames} times; save one of them as a stack"));
        }
        if let Some(disorder) = disorder {
            return Err(disorder.clone());
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
