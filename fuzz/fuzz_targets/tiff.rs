#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| isolume_fuzz::open(bytes, if bytes.starts_with(b"PK") { "tif.zip" } else { "tif" }));
