//! VTK XML image data (`.vti`): any point data and field data, reader and writer.
//!
//! The lattice's axes are VTK's `Direction` · diag(`Spacing`), and its origin is where the first sample of the extent
//! stands, wherever the extent starts.

mod codec;
mod document;
mod writer;

pub(crate) use document::{Document as XmlDocument, escape, is_foreign};
pub use writer::{SamplesRef, VtiWriter};

use crate::error::{Error, Result};
use crate::files;
use crate::volume::plane::Plane;
use crate::volume::{ElementType, Lattice, Samples, Space, ascii};
use codec::Encoding;
use glam::{DMat3, DVec3};
use roxmltree::Node;
use std::cell::Cell;
use std::path::Path;

/// Name of the field string that holds the [`Space`], as isolume writes it.
pub const SPACE: &str = "space";

/// A named array of a file. Sample t of component c is element `t · components + c`.
#[derive(Clone, Debug, PartialEq)]
pub struct VtiArray {
    /// The array's name.
    pub name: String,
    /// Values per sample: 1 for scalars, 3 for vectors and colours.
    pub components: usize,
    /// The values, components fastest, then x, y, z.
    pub samples: Samples,
}

/// All that isolume reads from a `.vti` file. Cell data are left out.
#[derive(Clone, Debug, PartialEq)]
pub struct VtiFile {
    /// Where the samples stand.
    pub lattice: Lattice,
    /// Arrays with one tuple per sample.
    pub point_data: Vec<VtiArray>,
    /// Numeric arrays about the whole file.
    pub field_data: Vec<VtiArray>,
    /// Texts about the whole file; an array of several strings gives one pair each.
    pub field_strings: Vec<(String, String)>,
    /// The point data's `Scalars` attribute.
    pub active_scalars: Option<String>,
}

/// Which point data are read.
#[derive(Clone, Copy)]
enum Wanted<'a> {
    All,
    None,
    /// The scalars of that name, or those to render: [`VtiFile::into_scalars`].
    Scalars(Option<&'a str>),
}

impl VtiFile {
    /// Reads a file of one piece: ascii, inline base64, appended raw or base64; plain or zlib; either byte order.
    ///
    /// # Errors
    /// `Io`; `Invalid` for broken XML or arrays, or fewer bytes than promised (memory grows with the bytes that are
    /// there, not with the promise); `NotSupported` for several pieces, other compressors and other data sets.
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&files::read(path)?).map_err(|e| e.in_file(path))
    }

    /// [`VtiFile::read`] of one point array only, that of [`VtiFile::into_scalars`], however many there are.
    ///
    /// # Errors
    /// As [`VtiFile::read`] and [`VtiFile::into_scalars`].
    pub fn read_scalars(path: &Path, array: Option<&str>) -> Result<Self> {
        Self::parse_some(&files::read(path)?, Wanted::Scalars(array)).map_err(|e| e.in_file(path))
    }

    /// The scalars to render: those called `array`, if a name is given; else the active ones, else an array named
    /// `value`, else the only one of 1 component.
    ///
    /// # Errors
    /// `Invalid` with the list of arrays.
    pub fn into_scalars(self, array: Option<&str>) -> Result<(Lattice, Samples)> {
        let Self { lattice, point_data, active_scalars, .. } = self;
        Ok((lattice, scalars(point_data, array, active_scalars.as_deref())?))
    }

    /// The name of what [`VtiFile::into_scalars`] gives, and the names of all point data of one component.
    ///
    /// # Errors
    /// As [`VtiFile::into_scalars`].
    pub fn scalars(&self, array: Option<&str>) -> Result<(&str, Vec<&str>)> {
        let chosen = chosen(&names(&self.point_data), array, self.active_scalars.as_deref())?;
        let all = self.point_data.iter().filter(|a| a.components == 1).map(|a| &*a.name);
        Ok((&self.point_data[chosen].name, all.collect()))
    }

    /// What the file says that the world's axes mean; the default if it says nothing that is understood.
    pub fn space(&self) -> Space {
        let text = self.field_strings.iter().find(|(key, _)| key == SPACE);
        text.and_then(|(_, text)| Space::from_name(text)).unwrap_or_default()
    }

    /// Reads the bytes of a file.
    ///
    /// # Errors
    /// As [`VtiFile::read`], without the file's name.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        Self::parse_some(bytes, Wanted::All)
    }

    /// [`VtiFile::parse`] without point data.
    ///
    /// # Errors
    /// As [`VtiFile::parse`].
    pub(crate) fn parse_fields(bytes: &[u8]) -> Result<Self> {
        Self::parse_some(bytes, Wanted::None)
    }

    fn parse_some(bytes: &[u8], wanted: Wanted) -> Result<Self> {
        let place = |p: Placement| {
            let lattice = Lattice::new(p.dims, p.origin, p.axes)?;
            let points = lattice.len();
            Ok((lattice, points))
        };
        let (lattice, arrays) = Arrays::parse(bytes, wanted, place)?;
        let Arrays { point_data, field_data, field_strings, active_scalars } = arrays;
        Ok(Self { lattice, point_data, field_data, field_strings, active_scalars })
    }
}

/// Reads an image of one sample along one axis; `None` if it is a volume.
///
/// # Errors
/// As [`VtiFile::read`] and [`VtiFile::into_scalars`].
pub fn read_plane(path: &Path) -> Result<Option<Plane>> {
    // A volume is left unread.
    let flat = |p: Placement| match Plane::long_axes(&p.dims)? {
        Some(axes) => {
            let dims = axes.map(|a| p.dims[a]);
            let points = dims[0].checked_mul(dims[1]);
            let points = points.ok_or_else(|| Error::Invalid(format!("{dims:?} samples are too many")))?;
            Ok((Some((dims, axes.map(|a| p.axes.col(a).length()))), points))
        }
        None => Ok((None, 0)),
    };
    let read = || -> Result<Option<Plane>> {
        let (place, arrays) = Arrays::parse(&files::read(path)?, Wanted::Scalars(None), flat)?;
        let Some((dims, spacing)) = place else { return Ok(None) };
        Ok(Some(Plane { dims, spacing, samples: scalars(arrays.point_data, None, arrays.active_scalars.as_deref())? }))
    };
    read().map_err(|e| e.in_file(path))
}

/// The scalars to render, see [`VtiFile::into_scalars`].
fn scalars(mut point_data: Vec<VtiArray>, array: Option<&str>, active: Option<&str>) -> Result<Samples> {
    let chosen = chosen(&names(&point_data), array, active)?;
    Ok(point_data.swap_remove(chosen).samples)
}

/// What arrays are called, and their components.
fn names(point_data: &[VtiArray]) -> Vec<(&str, usize)> {
    point_data.iter().map(|a| (&*a.name, a.components)).collect()
}

/// Which of the arrays of such names and components these are.
fn chosen(point_data: &[(&str, usize)], array: Option<&str>, active: Option<&str>) -> Result<usize> {
    let mut scalars = (0..point_data.len()).filter(|&n| point_data[n].1 == 1);
    let named = |name: &str| scalars.clone().find(|&n| point_data[n].0 == name);
    let found = match array {
        Some(array) => named(array),
        None => active.and_then(named).or_else(|| named("value")).or_else(|| {
            let first = scalars.next();
            first.filter(|_| scalars.next().is_none())
        }),
    };
    found.ok_or_else(|| {
        let list: Vec<String> =
            point_data.iter().map(|(name, components)| format!("`{name}` ({components} components)")).collect();
        let list = if list.is_empty() { "there are none".to_string() } else { list.join(", ") };
        Error::Invalid(match array {
            Some(array) => format!("has no point data `{array}` of 1 component; there are: {list}"),
            None => format!(
                "cannot tell which point data to use: {list}. Name a 1-component array with --array, or as array in \
                 [volume] (cell data are not read: convert them to point data)"
            ),
        })
    })
}

/// Where an image's samples stand.
struct Placement {
    dims: [usize; 3],
    origin: DVec3,
    axes: DMat3,
}

/// What a file holds besides its placement.
struct Arrays {
    point_data: Vec<VtiArray>,
    field_data: Vec<VtiArray>,
    field_strings: Vec<(String, String)>,
    active_scalars: Option<String>,
}

impl Arrays {
    /// Reads the bytes of a file. `place` makes what it needs of the placement and says how many points there are; of
    /// none, the arrays are left unread.
    fn parse<T>(
        bytes: &[u8],
        wanted: Wanted,
        place: impl FnOnce(Placement) -> Result<(T, usize)>,
    ) -> Result<(T, Self)> {
        let (text, appended) = split_appended(bytes)?;
        let document = files::xml(&text).map_err(|e| Error::Invalid(format!("its XML is not read: {e}")))?;
        let root = document.root_element();
        if root.tag_name().name() != "VTKFile" || root.attribute("type") != Some("ImageData") {
            return Err(Error::NotSupported(format!(
                "holds <{} type=\"{}\">; only VTKFile ImageData is read (resample other data sets to an image)",
                root.tag_name().name(),
                root.attribute("type").unwrap_or("")
            )));
        }
        let reader = Reader { encoding: Encoding::of(root)?, appended, length: bytes.len(), taken: Cell::new(0) };
        let image = child(root, "ImageData")?;
        let mut pieces = image.children().filter(|n| n.has_tag_name("Piece"));
        let piece = pieces.next().ok_or_else(|| Error::Invalid("has no <Piece>".into()))?;
        if pieces.next().is_some() {
            return Err(Error::NotSupported("has several pieces; write it as one (serial) file".into()));
        }
        let extent: [i64; 6] = numbers(piece, "Extent")?;
        let whole: [i64; 6] = match image.attribute("WholeExtent") {
            Some(_) => numbers(image, "WholeExtent")?,
            None => extent,
        };
        if extent != whole {
            return Err(Error::NotSupported(format!("the piece {extent:?} covers only part of the image {whole:?}")));
        }
        let (place, count) = place(placement(image, extent)?)?;

        let mut file = Self { point_data: vec![], field_data: vec![], field_strings: vec![], active_scalars: None };
        if count == 0 {
            return Ok((place, file));
        }
        if let Some(points) = piece.children().find(|n| n.has_tag_name("PointData")) {
            file.active_scalars = points.attribute("Scalars").filter(|s| !s.is_empty()).map(str::to_string);
            let mut fault = None;
            let mut nodes: Vec<Node> = points.children().filter(|n| n.has_tag_name("DataArray")).collect();
            match wanted {
                Wanted::All => {}
                Wanted::None => nodes.clear(),
                Wanted::Scalars(array) => nodes = vec![chosen_node(&nodes, array, file.active_scalars.as_deref())?],
            }
            for node in nodes {
                match reader.array(node, count) {
                    Ok(array) => file.point_data.push(array),
                    // Of a type that is not read: unless nothing else is there or it is the one meant, let it be.
                    Err(e @ Error::NotSupported(_))
                        if fault.is_none() || file.active_scalars.as_deref() == Some(name(node)) =>
                    {
                        fault = Some((name(node), e));
                    }
                    Err(Error::NotSupported(_)) => {}
                    Err(e) => return Err(e),
                }
            }
            if let Some((name, e)) = fault
                && (file.point_data.is_empty() || file.active_scalars.as_deref() == Some(name))
            {
                return Err(e);
            }
        }
        let fields = root.descendants().filter(|n| n.has_tag_name("FieldData")).flat_map(|n| n.children());
        for node in fields.filter(|n| n.has_tag_name("DataArray") || n.has_tag_name("Array")) {
            // What does not say how much it holds is another program's.
            let tuples = node.attribute("NumberOfTuples").and_then(|t| t.trim().parse().ok());
            let Some(tuples) = tuples else { continue };
            if node.attribute("type") == Some("String") {
                let texts = reader.strings(node, tuples)?;
                file.field_strings.extend(texts.into_iter().map(|t| (name(node).to_string(), t)));
                continue;
            }
            match reader.array(node, tuples) {
                Ok(array) => file.field_data.push(array),
                Err(Error::NotSupported(_)) => {}
                Err(e) => return Err(e),
            }
        }
        Ok((place, file))
    }
}

/// Splits off the appended data, which need not be XML: the document without them, and the bytes behind their `_`.
fn split_appended(bytes: &[u8]) -> Result<(std::borrow::Cow<'_, str>, &[u8])> {
    const TAG: &[u8] = b"<AppendedData";
    let at = bytes.windows(TAG.len()).position(|w| w == TAG);
    let text = std::str::from_utf8(&bytes[..at.unwrap_or(bytes.len())])
        .map_err(|e| Error::Invalid(format!("is no UTF-8 XML text: {e}")))?;
    let text = text.trim_start_matches('\u{feff}');
    let Some(at) = at else { return Ok((text.into(), &[])) };
    let end = bytes[at..].iter().position(|&b| b == b'>').map(|e| at + e + 1);
    let mark = end.and_then(|end| bytes[end..].iter().position(|&b| b == b'_').map(|m| (end, end + m + 1)));
    let Some((end, data)) = mark else {
        return Err(Error::Invalid(
            "<AppendedData> does not hold a `_` followed by data; the file is cut short".into(),
        ));
    };
    let tag = String::from_utf8_lossy(&bytes[at..end]);
    Ok((format!("{text}{tag}</AppendedData></VTKFile>").into(), &bytes[data..]))
}

fn child<'a, 'i>(node: Node<'a, 'i>, tag: &str) -> Result<Node<'a, 'i>> {
    node.children()
        .find(|n| n.has_tag_name(tag))
        .ok_or_else(|| Error::Invalid(format!("<{}> has no <{tag}>", node.tag_name().name())))
}

fn name<'a>(node: Node<'a, '_>) -> &'a str {
    node.attribute("Name").unwrap_or("")
}

/// What stands in an element, behind comments.
fn text<'a>(node: Node<'a, '_>) -> &'a str {
    let mut texts = node.children().filter(|child| child.is_text()).filter_map(|child| child.text());
    texts.find(|text| !text.trim().is_empty()).unwrap_or("")
}

/// The numbers of an attribute.
fn numbers<T: std::str::FromStr, const N: usize>(node: Node, key: &str) -> Result<[T; N]> {
    let text = node.attribute(key).unwrap_or("");
    let values: Option<Vec<T>> = text.split_ascii_whitespace().map(|w| w.parse().ok()).collect();
    values.and_then(|v| v.try_into().ok()).ok_or_else(|| {
        Error::Invalid(format!("<{}> has {key}=\"{text}\"; it must hold {N} numbers", node.tag_name().name()))
    })
}

/// Where the samples of an image's extent stand.
fn placement(image: Node, extent: [i64; 6]) -> Result<Placement> {
    let vector = |key: &str, missing: DVec3| {
        if image.has_attribute(key) { numbers(image, key).map(DVec3::from_array) } else { Ok(missing) }
    };
    let spacing = vector("Spacing", DVec3::ONE)?;
    let direction = match image.attribute("Direction") {
        // The file has it by rows.
        Some(_) => DMat3::from_cols_array(&numbers(image, "Direction")?).transpose(),
        None => DMat3::IDENTITY,
    };
    let axes = direction * DMat3::from_diagonal(spacing);
    let first = DVec3::new(extent[0] as f64, extent[2] as f64, extent[4] as f64);
    let mut dims = [0; 3];
    for (a, n) in dims.iter_mut().enumerate() {
        *n = (extent[2 * a + 1].checked_sub(extent[2 * a]))
            .and_then(|n| usize::try_from(n.checked_add(1)?).ok())
            .ok_or_else(|| Error::Invalid(format!("Extent {extent:?}: a last index stands before its first")))?;
    }
    Ok(Placement { dims, origin: vector("Origin", DVec3::ZERO)? + axes * first, axes })
}

/// What all arrays of a file need.
struct Reader<'a> {
    encoding: Encoding,
    /// The bytes behind the `_`.
    appended: &'a [u8],
    /// Bytes of the file, and how many of them the arrays so far have taken.
    length: usize,
    taken: Cell<usize>,
}

/// The error of an array.
fn fault(node: Node, message: &str) -> Error {
    Error::Invalid(format!("array `{}`: {message}", name(node)))
}

fn components(node: Node) -> Result<usize> {
    let Some(n) = node.attribute("NumberOfComponents") else { return Ok(1) };
    n.trim().parse().map_err(|_| fault(node, &format!("NumberOfComponents is `{n}`")))
}

/// An array's type, of those that are read.
fn element(node: Node) -> Result<ElementType> {
    Ok(match node.attribute("type").unwrap_or("") {
        "Int8" => ElementType::I8,
        "UInt8" => ElementType::U8,
        "Int16" => ElementType::I16,
        "UInt16" => ElementType::U16,
        "Int32" => ElementType::I32,
        "UInt32" => ElementType::U32,
        "Int64" => ElementType::I64,
        "UInt64" => ElementType::U64,
        "Float32" => ElementType::F32,
        "Float64" => ElementType::F64,
        other => {
            return Err(Error::NotSupported(format!(
                "array `{}` has type `{other}`; Int8 … UInt64, Float32 and Float64 are read",
                name(node)
            )));
        }
    })
}

/// The one of point data that [`VtiFile::into_scalars`] means. Arrays of types that are not read do not count, unless
/// they are meant by their name or there are no others.
fn chosen_node<'a, 'i>(nodes: &[Node<'a, 'i>], array: Option<&str>, active: Option<&str>) -> Result<Node<'a, 'i>> {
    let read: Vec<Node> = nodes.iter().copied().filter(|node| element(*node).is_ok()).collect();
    let meant = nodes.iter().find(|node| array.or(active) == Some(name(**node)));
    if let Some(node) = meant.or_else(|| nodes.first().filter(|_| read.is_empty())) {
        element(*node)?;
    }
    let names: Vec<(&str, usize)> =
        read.iter().map(|node| Ok((name(*node), components(*node)?))).collect::<Result<_>>()?;
    Ok(read[chosen(&names, array, active)?])
}

impl Reader<'_> {
    /// A numeric array of so many tuples.
    fn array(&self, node: Node, tuples: usize) -> Result<VtiArray> {
        let fault = |message: String| fault(node, &message);
        let (components, element) = (components(node)?, element(node)?);
        let count = tuples.checked_mul(components).filter(|n| n.checked_mul(element.size()).is_some());
        let count = count.ok_or_else(|| fault(format!("{tuples} tuples of {components} do not fit the memory")))?;
        let samples = match self.bytes(node).map_err(fault)? {
            Stored::Text(text) => ascii::parse(text.as_bytes(), element, count).map_err(fault)?,
            Stored::Packed(packed) => {
                let bytes = self.unpack(packed, Some(count * element.size())).map_err(fault)?;
                Samples::from_vec(bytes, element, self.encoding.endian)
            }
        };
        Ok(VtiArray { name: name(node).to_string(), components, samples })
    }

    /// An array of 0-terminated strings, which VTK writes as their character codes.
    fn strings(&self, node: Node, tuples: usize) -> Result<Vec<String>> {
        let fault = |message: String| Error::Invalid(format!("field array `{}`: {message}", name(node)));
        let codes: Vec<u8> = match self.bytes(node).map_err(fault)? {
            // VTK writes characters beyond 127 as negative numbers; readers of it may meet either form.
            Stored::Text(text) => text
                .split_ascii_whitespace()
                .map(|w| w.parse::<i16>().ok().filter(|c| (-128..256).contains(c)).map(|c| c as u8))
                .collect::<Option<_>>()
                .ok_or_else(|| fault("its text is no list of character codes".into()))?,
            Stored::Packed(packed) => self.unpack(packed, None).map_err(fault)?,
        };
        let mut texts: Vec<String> =
            codes.split(|&c| c == 0).map(|s| String::from_utf8_lossy(s).into_owned()).collect();
        // What stands behind the last 0 is no string.
        texts.pop();
        if texts.len() != tuples {
            return Err(fault(format!("{tuples} strings promised, {} found", texts.len())));
        }
        Ok(texts)
    }

    /// An array's bytes. Arrays that share those of the file would grow without end.
    fn unpack(&self, packed: codec::Packed, promised: Option<usize>) -> Result<Vec<u8>, String> {
        let (bytes, taken) = self.encoding.unpack(packed, promised)?;
        self.taken.set(self.taken.get().saturating_add(taken));
        if self.taken.get() > self.length {
            let (taken, length) = (self.taken.get(), self.length);
            return Err(format!(
                "takes, with those before it, {taken} bytes of a file of {length}; arrays that share theirs are not read"
            ));
        }
        Ok(bytes)
    }

    /// Where an array's values stand.
    fn bytes<'a>(&'a self, node: Node<'a, '_>) -> Result<Stored<'a>, String> {
        match node.attribute("format").unwrap_or("ascii") {
            "ascii" => Ok(Stored::Text(text(node))),
            "binary" => Ok(Stored::Packed(codec::Packed::Base64(text(node).as_bytes()))),
            "appended" => {
                let offset = node.attribute("offset").unwrap_or("");
                let at = offset.trim().parse::<usize>().ok().filter(|&at| at < self.appended.len());
                let data = at.map(|at| &self.appended[at..]).ok_or_else(|| {
                    format!("offset \"{offset}\" is not within the {} bytes of appended data", self.appended.len())
                })?;
                match node.document().descendants().find(|n| n.has_tag_name("AppendedData")) {
                    Some(n) if n.attribute("encoding") == Some("raw") => Ok(Stored::Packed(codec::Packed::Raw(data))),
                    // The closing tag's `<` ends the text.
                    _ => {
                        let end = data.iter().position(|&b| b == b'<').unwrap_or(data.len());
                        Ok(Stored::Packed(codec::Packed::Base64(&data[..end])))
                    }
                }
            }
            other => Err(format!("format `{other}` is none of ascii, binary and appended")),
        }
    }
}

/// An array's values as they are stored.
enum Stored<'a> {
    Text(&'a str),
    Packed(codec::Packed<'a>),
}

#[cfg(test)]
#[path = "vti/tests.rs"]
mod tests;
