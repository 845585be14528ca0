//! Reading and writing whole files: no promise of a header is believed before the bytes are there, and no half
//! file ever stands under its final name.

use crate::atomic::AtomicFile;
use crate::error::{Error, Result};
use flate2::bufread::{GzDecoder, ZlibDecoder};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// What may be allocated on the word of a header alone, beyond twice the file's size.
const TRUSTED: u64 = 64 << 20;

/// DEFLATE cannot expand further than this (RFC 1951: 258 bytes from 2 bits).
const DEFLATE_LIMIT: u64 = 1032;

/// How a section is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    /// Not at all.
    Plain,
    /// One or several gzip members.
    Gzip,
    /// One zlib stream.
    Zlib,
}

impl Packing {
    /// What to call it in messages.
    fn name(self) -> &'static str {
        match self {
            Packing::Plain => "plain",
            Packing::Gzip => "gzip",
            Packing::Zlib => "zlib",
        }
    }
}

/// Where the samples of a file begin, and how they are packed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Section {
    /// Stored bytes before the section.
    pub(crate) start: u64,
    /// How the section is packed.
    pub(crate) packing: Packing,
    /// Bytes to pass over, after unpacking.
    pub(crate) skip: u64,
}

/// The extension of a path in lower case, empty without one.
pub(crate) fn extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

/// Whether a path has an `extension`, in whatever case.
pub(crate) fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
}

/// Opens a file for reading.
///
/// # Errors
/// `Io` with the path; `Invalid` for a pipe or a device, in which nothing can be found again.
pub(crate) fn open(path: &Path) -> Result<File> {
    let kind = std::fs::metadata(path).map_err(|e| Error::io(path, e))?.file_type();
    // Opened, a pipe would wait for its writer.
    if !kind.is_file() && !kind.is_dir() {
        return Err(Error::invalid(path, "is a pipe or a device, not a file; write its content to a file first"));
    }
    File::open(path).map_err(|e| Error::io(path, e))
}

/// Reads a whole file.
///
/// # Errors
/// As [`open`].
pub(crate) fn read(path: &Path) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    Ok(bytes)
}

/// Reads a whole text in UTF-8.
///
/// # Errors
/// As [`open`]; `Io` if it is none.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    let mut text = String::new();
    open(path)?.read_to_string(&mut text).map_err(|e| Error::io(path, e))?;
    Ok(text)
}

/// Length of a file in bytes.
///
/// # Errors
/// `Io` with the path.
pub(crate) fn length(path: &Path) -> Result<u64> {
    Ok(open(path)?.metadata().map_err(|e| Error::io(path, e))?.len())
}

/// Gzip if a file begins like one from byte `start` on, else plain.
///
/// # Errors
/// `Io` with the path.
pub(crate) fn gzip_or_plain(path: &Path, start: u64) -> Result<Packing> {
    let head = read_head(path, Section { start, packing: Packing::Plain, skip: 0 }, 2)?;
    Ok(if head == [0x1f, 0x8b] { Packing::Gzip } else { Packing::Plain })
}

/// Bytes of a file's length that may be held before it is known that there is as much to hold: twice as many + 64 MB.
pub(crate) fn trusted(length: u64) -> u64 {
    length.saturating_mul(2).saturating_add(TRUSTED)
}

/// Bytes that a section of so many stored ones may hold at most, unpacked.
pub(crate) fn most(packing: Packing, stored: u64) -> u64 {
    match packing {
        Packing::Plain => stored,
        Packing::Gzip | Packing::Zlib => stored.saturating_mul(DEFLATE_LIMIT),
    }
}

/// A section of a file, unpacked, as a stream.
///
/// # Errors
/// `Io` with the path. What reading returns is for [`damaged`].
pub(crate) fn stream(path: &Path, section: Section) -> Result<BufReader<Box<dyn Read>>> {
    Ok(BufReader::with_capacity(1 << 16, open_section(path, section)?))
}

/// What it means that reading from a [`stream`] failed: `Invalid` if its packing is damaged, else `Io`.
pub(crate) fn damaged(path: &Path, section: Section, source: std::io::Error) -> Error {
    use std::io::ErrorKind as K;
    match source.kind() {
        K::UnexpectedEof | K::InvalidData | K::InvalidInput if section.packing != Packing::Plain => {
            Error::invalid(path, format!("the {} stream is cut short or damaged ({source})", section.packing.name()))
        }
        _ => Error::io(path, source),
    }
}

/// Opens a section of a file, unpacked.
fn open_section(path: &Path, section: Section) -> Result<Box<dyn Read>> {
    let mut file = open(path)?;
    file.seek(SeekFrom::Start(section.start)).map_err(|e| Error::io(path, e))?;
    Ok(match section.packing {
        Packing::Plain => Box::new(file),
        Packing::Gzip => Box::new(Members(Some(GzDecoder::new(BufReader::new(file))))),
        Packing::Zlib => Box::new(ZlibDecoder::new(BufReader::new(file))),
    })
}

/// The gzip members of a stream one after the other. What follows the last one and is none, such as the zeros that fill
/// blocks of tapes, is let pass, as gzip and zlib do.
struct Members<R>(Option<GzDecoder<R>>);

impl<R: BufRead> Read for Members<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        while let Some(member) = &mut self.0 {
            match member.read(buffer)? {
                0 if !buffer.is_empty() => {
                    let mut rest = self.0.take().expect("a member").into_inner();
                    // The first byte of every member.
                    self.0 = (rest.fill_buf()?.first() == Some(&0x1f)).then(|| GzDecoder::new(rest));
                }
                n => return Ok(n),
            }
        }
        Ok(0)
    }
}

/// Reads at most the first `n` bytes of a section.
///
/// # Errors
/// `Io` with the path; `Invalid` if a packed stream is damaged within them.
pub(crate) fn read_head(path: &Path, section: Section, n: u64) -> Result<Vec<u8>> {
    let mut head = Vec::new();
    match open_section(path, section)?.take(section.skip + n).read_to_end(&mut head) {
        Ok(_) => Ok(head.split_off(head.len().min(section.skip as usize))),
        Err(e) => Err(broken(path, section, head.len() as u64, section.skip + n, e)),
    }
}

/// How many bytes there are from a section's start on, unpacked, skipped ones among them; `most` if there are more.
///
/// # Errors
/// `Io` with the path; `Invalid` if a packed stream is damaged.
pub(crate) fn count(path: &Path, section: Section, most: u64) -> Result<u64> {
    let mut reader = open_section(path, section)?.take(most);
    let mut counted = 0;
    let mut buffer = vec![0; 1 << 16];
    loop {
        match reader.read(&mut buffer) {
            Ok(0) => return Ok(counted),
            Ok(n) => counted += n as u64,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(broken(path, section, counted, most, e)),
        }
    }
}

/// Reads exactly the `promised` bytes of a section.
///
/// Before it is known that they exist, at most twice the file's size + 64 MB are held: a plain section is compared
/// with the file's length, a packed one is unpacked once without keeping it. A packed stream is read to its end, so
/// that its checksum is checked. Further bytes behind the promised ones are let pass.
///
/// # Errors
/// `Io` with the path; `Invalid` if the section holds less, or its packed stream breaks off or is damaged.
pub(crate) fn read_section(path: &Path, section: Section, promised: u64) -> Result<Vec<u8>> {
    let length = length(path)?;
    let stored = length.saturating_sub(section.start);
    let total = promised.saturating_add(section.skip);
    let most = most(section.packing, stored);
    if total > most {
        return Err(Error::invalid(
            path,
            format!(
                "the header promises {promised} bytes of samples from byte {} on, but the file's {length} bytes cannot \
                 hold more than {}; it is cut short or its header is wrong",
                section.start + section.skip,
                most.saturating_sub(section.skip)
            ),
        ));
    }
    if section.packing != Packing::Plain && total > trusted(length) {
        let counted = count(path, section, total)?;
        if counted < total {
            return Err(short(path, section, counted, total));
        }
    }

    let mut reader = open_section(path, section)?;
    let skipped = std::io::copy(&mut (&mut reader).take(section.skip), &mut std::io::sink())
        .map_err(|e| broken(path, section, 0, total, e))?;
    let mut bytes = Vec::with_capacity(promised as usize);
    if let Err(e) = (&mut reader).take(promised).read_to_end(&mut bytes) {
        return Err(broken(path, section, skipped + bytes.len() as u64, total, e));
    }
    if (bytes.len() as u64) < promised {
        return Err(short(path, section, skipped + bytes.len() as u64, total));
    }
    if section.packing != Packing::Plain {
        std::io::copy(&mut reader, &mut std::io::sink()).map_err(|e| broken(path, section, total, total, e))?;
    }
    Ok(bytes)
}

/// Parses XML of so few nodes that they fit into what is trusted, with tags and namespaces that take no time to speak
/// of: that grows with the square of a tag's attributes and of namespaces within each other.
///
/// # Errors
/// A message: what [`roxmltree::Document::parse`] says, or what there is too much of.
pub(crate) fn xml(text: &str) -> Result<roxmltree::Document<'_>, String> {
    /// Of about 80 bytes.
    const NODES: u32 = 1 << 18;
    /// Bytes of a tag, and namespaces of a document.
    const TAG: usize = 1 << 16;
    const NAMESPACES: usize = 1 << 12;
    if longest_tag(text) > TAG {
        return Err(format!("a tag is longer than {TAG} bytes"));
    }
    if text.matches("xmlns").nth(NAMESPACES).is_some() {
        return Err(format!("it declares more than {NAMESPACES} namespaces"));
    }
    let options = roxmltree::ParsingOptions { nodes_limit: NODES, ..Default::default() };
    roxmltree::Document::parse_with_options(text, options).map_err(|e| e.to_string())
}

/// Bytes of the longest tag of a text, none in comments and plain sections.
fn longest_tag(text: &str) -> usize {
    let (mut rest, mut longest) = (text, 0);
    while let Some(at) = rest.find('<') {
        rest = &rest[at..];
        let sections = [("<!--", "-->"), ("<![CDATA[", "]]>")];
        let end = match sections.iter().find(|(begin, _)| rest.starts_with(begin)) {
            Some((_, end)) => rest.find(end).unwrap_or(rest.len()),
            None => {
                // A `>` within a value ends nothing.
                let mut quote = None;
                let ends = |byte: u8| match quote {
                    Some(open) => {
                        quote = quote.filter(|_| byte != open);
                        false
                    }
                    None => {
                        quote = Some(byte).filter(|byte| matches!(byte, b'"' | b'\''));
                        byte == b'>'
                    }
                };
                let length = rest.bytes().position(ends).unwrap_or(rest.len());
                longest = longest.max(length);
                length
            }
        };
        rest = &rest[end..];
    }
    longest
}

/// The error of a section that ends too early.
fn short(path: &Path, section: Section, found: u64, total: u64) -> Error {
    let kind = if section.packing != Packing::Plain { "unpacked " } else { "" };
    Error::invalid(path, format!("{total} {kind}bytes promised, {found} found; it is cut short or its header is wrong"))
}

/// The error of a reader that failed: the packed stream's fault, or the system's.
fn broken(path: &Path, section: Section, found: u64, total: u64, source: std::io::Error) -> Error {
    match damaged(path, section, source) {
        Error::Invalid(message) => Error::Invalid(format!("{message} after {found} of {total} unpacked bytes")),
        error => error,
    }
}

/// Writes a file under a temporary name in the same folder and renames it when it is complete, so that `path` holds
/// either its old content or the whole new one, whenever the program is stopped.
///
/// # Errors
/// `Io` with the path, or what `write` returns; the temporary file is removed then.
pub(crate) fn write_atomically(path: &Path, write: impl FnOnce(&mut AtomicFile) -> std::io::Result<()>) -> Result<()> {
    completed(path, write)?.commit()
}

/// [`write_atomically`] of a text.
///
/// # Errors
/// `Io` with the path.
pub(crate) fn write_text(path: &Path, text: &str) -> Result<()> {
    write_atomically(path, |out| out.write_all(text.as_bytes()))
}

/// As [`write_atomically`], but the name is left to the caller.
///
/// # Errors
/// As [`write_atomically`].
pub(crate) fn completed(path: &Path, write: impl FnOnce(&mut AtomicFile) -> std::io::Result<()>) -> Result<AtomicFile> {
    let mut file = AtomicFile::create(path)?;
    let written = write(&mut file);
    file.complete_if(written)
}

/// Packed bytes, for the tests of readers.
#[cfg(test)]
pub(crate) fn gz(bytes: &[u8]) -> Vec<u8> {
    use std::io::Write;
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(bytes).expect("memory does not fail");
    packed.finish().expect("memory does not fail")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    #[test]
    fn sections_are_exact() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        std::fs::write(&path, [9, 9, 1, 2, 3, 4]).unwrap();
        let plain = Section { start: 2, packing: Packing::Plain, skip: 1 };
        assert_eq!(read_section(&path, plain, 3).unwrap(), [2, 3, 4]);
        assert_eq!(read_section(&path, plain, 2).unwrap(), [2, 3]);
        assert!(matches!(read_section(&path, plain, 4), Err(Error::Invalid(_))));

        let mut stored = vec![7];
        stored.extend(gz(&[1, 2, 3, 4]));
        std::fs::write(&path, &stored).unwrap();
        let packed = Section { start: 1, packing: Packing::Gzip, skip: 1 };
        assert_eq!(read_section(&path, packed, 3).unwrap(), [2, 3, 4]);
        assert_eq!(read_head(&path, packed, 2).unwrap(), [2, 3]);
        assert!(matches!(read_section(&path, packed, 4), Err(Error::Invalid(_))));
        // Further members, and what is none.
        let mut more = [&stored[..], &gz(&[5, 6])].concat();
        for behind in [&[][..], &[0; 512], b"\n"] {
            more.extend(behind);
            std::fs::write(&path, &more).unwrap();
            assert_eq!(read_section(&path, packed, 5).unwrap(), [2, 3, 4, 5, 6], "{} bytes behind", behind.len());
        }
        // A member that breaks off is none that is let pass.
        std::fs::write(&path, [&stored[..], &gz(&[5, 6])[..9]].concat()).unwrap();
        assert!(matches!(read_section(&path, packed, 3), Err(Error::Invalid(_))));
        // Cut inside the checksum: all samples are there, but nothing vouches for them.
        std::fs::write(&path, &stored[..stored.len() - 3]).unwrap();
        assert!(matches!(read_section(&path, packed, 3), Err(Error::Invalid(_))));
    }

    #[test]
    fn a_large_promise_is_checked_before_it_is_believed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        // 100 MB of zeros pack into 0.4 MB, so a promise of 300 MB passes DEFLATE's own limit and needs the count.
        std::fs::write(&path, gz(&vec![0; 100 << 20])).unwrap();
        let section = Section { start: 0, packing: Packing::Gzip, skip: 0 };
        let message = read_section(&path, section, 300 << 20).unwrap_err().to_string();
        assert!(message.contains("104857600 found"), "{message}");
        assert_eq!(read_section(&path, section, 100 << 20).unwrap().len(), 100 << 20);
        let message = read_section(&path, section, 1 << 40).unwrap_err().to_string();
        assert!(message.contains("cannot hold"), "{message}");
    }

    #[test]
    fn xml_takes_no_time_to_speak_of() {
        let attributes: String = (0..20_000).map(|n| format!(" a{n}='1'")).collect();
        assert!(xml(&format!("<a{attributes}/>")).unwrap_err().contains("longer than"));
        assert!(xml(&format!("<a z='>'{attributes}/>")).unwrap_err().contains("longer than"));
        let open: String = (0..5000).map(|n| format!("<b xmlns:a{n}='{n}'>")).collect();
        assert!(xml(&(open + &"</b>".repeat(5000))).unwrap_err().contains("namespaces"));
        let long = "x".repeat(1 << 17);
        let whole = format!(
            "<?xml version='1.0'?><a b='1'><!-- {long} > {long} < {long} --><![CDATA[{long} < {long}]]>{long}</a>"
        );
        assert!(xml(&whole).is_ok());
        assert!(xml("<a>").is_err());
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_temporary() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        write_atomically(&path, |w| w.write_all(b"old")).unwrap();
        let failed = write_atomically(&path, |w| {
            w.write_all(b"new")?;
            Err(std::io::Error::other("full"))
        });
        assert!(matches!(failed, Err(Error::Io { .. })));
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
