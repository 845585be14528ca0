//! A grid as an OpenEXR of several layers, one per slice: for compositing programs and for pipelines that read EXR.

use super::picture::{EXR, from_exr};
use crate::error::{Error, Result};
use crate::files;
use crate::volume::vti::SamplesRef;
use crate::volume::{ElementType, Lattice};
use exr::meta::attribute::{AttributeValue, Text};
use exr::prelude::WritableImage;
use exr::prelude::{
    AnyChannel, AnyChannels, FlatSamples, Image, ImageAttributes, IntegerBounds, Layer, LayerAttributes,
};
use std::path::Path;

/// What files hold, whatever they are made from.
pub const ELEMENT: ElementType = ElementType::F32;

/// Writes one layer per slice along the third axis, `z0000`, `z0001` …, each nx × ny pixels of 32-bit floats (scan
/// lines, ZIP), with the channels `R`, `G`, `B` for three components and `Y` for one. Row j of a layer is sample j: the
/// first row, which viewers show on top, is the one at the lattice's origin. The values are written as they are,
/// rounded to [`ELEMENT`].
///
/// Each layer's text attributes `isolume:origin` (world position of sample (0, 0, 0)) and `isolume:axes` (the three
/// steps, one axis after the other) place the pixels.
///
/// # Errors
/// `Invalid` if the count is not the lattice's samples × `components`, for other component counts than 1 and 3, or for
/// a number that 32-bit floats do not reach; `Io`.
pub fn write(path: &Path, lattice: &Lattice, components: usize, values: SamplesRef<'_>) -> Result<()> {
    values.check(lattice, components).map_err(|e| Error::invalid(path, e))?;
    let names: &[&str] = match components {
        1 => &["Y"],
        3 => &["R", "G", "B"],
        n => return Err(Error::invalid(path, format!("arrays of {n} components: EXR slices hold 1 or 3"))),
    };
    if let SamplesRef::F64(values) = values
        && let Some(n) = values.iter().position(|x| x.is_finite() && x.abs() > f64::from(f32::MAX))
    {
        let (place, value) = (lattice.ijk(n / components), values[n]);
        let message = format!(
            "the value at sample {place:?} is {value:e}, and EXR holds 32-bit floats; write .nrrd, .npy or .vti"
        );
        return Err(Error::invalid(path, message));
    }
    let [nx, ny, nz] = lattice.dims();
    let text = |s: &str| Text::from_slice_unchecked(s.as_bytes());
    let numbers = |v: &[f64]| v.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let places = [("origin", lattice.origin().to_array().to_vec()), ("axes", lattice.axes().to_cols_array().to_vec())];
    let layers: Vec<_> = (0..nz)
        .map(|k| {
            let channels = names.iter().enumerate().map(|(c, name)| {
                let slice = (0..nx * ny).map(|i| values.get_f32((k * nx * ny + i) * components + c)).collect();
                AnyChannel::new(*name, FlatSamples::F32(slice))
            });
            let mut attributes = LayerAttributes::named(&*format!("z{k:04}"));
            for (name, value) in &places {
                let name = text(&format!("isolume:{name}"));
                attributes.other.insert(name, AttributeValue::Text(text(&numbers(value))));
            }
            Layer::new((nx, ny), attributes, EXR, AnyChannels::sort(channels.collect()))
        })
        .collect();
    let attributes = ImageAttributes::new(IntegerBounds::from_dimensions((nx, ny)));
    // On this thread: the crate would start a thread pool of its own beside rayon's.
    let image = Image::from_layers(attributes, layers);
    files::write_atomically(path, |file| image.write().non_parallel().to_buffered(file).map_err(from_exr))
}

/// Whether [`ELEMENT`] is too coarse for what 64-bit values, or 32-bit integers, differ by, as it is for small
/// differences on a large offset.
pub fn are_coarse(values: SamplesRef<'_>) -> bool {
    if !matches!(
        values,
        SamplesRef::F64(_) | SamplesRef::I64(_) | SamplesRef::U64(_) | SamplesRef::I32(_) | SamplesRef::U32(_)
    ) {
        return false;
    }
    let finite = (0..values.len()).map(|i| values.get_f64(i)).filter(|x| x.is_finite());
    let [lo, hi] = finite.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], x| [lo.min(x), hi.max(x)]);
    super::coarse_in_f32(lo.abs().max(hi.abs()), hi - lo)
}
