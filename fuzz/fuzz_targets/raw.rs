#![no_main]

use isolume::volume::raw::RawLayout;
use isolume::volume::{ElementType, Endian};

// The first 10 bytes are the layout: dimensions of up to 16 bits, type and byte order, bytes to skip.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some((head, samples)) = bytes.split_first_chunk::<10>() else { return };
    let dims = [0, 1, 2].map(|a| usize::from(u16::from_le_bytes([head[2 * a], head[2 * a + 1]])));
    use ElementType as T;
    let types = [T::U8, T::I8, T::U16, T::I16, T::U32, T::I32, T::U64, T::I64, T::F32, T::F64];
    let mut layout = RawLayout::new(dims, types[usize::from(head[6]) % types.len()]);
    layout.endian = if head[7] & 1 == 0 { Endian::Little } else { Endian::Big };
    layout.header_bytes = u64::from(u16::from_le_bytes([head[8], head[9]]));
    let path = isolume_fuzz::file(samples, "raw");
    if let Some(volume) = isolume_fuzz::counted(&path, samples.len(), || layout.read(&path)) {
        assert_eq!(volume.samples().len() * volume.samples().element_type().size() + usize::from(u16::from_le_bytes([head[8], head[9]])), samples.len());
    }
    let _ = std::fs::remove_file(path);
});
