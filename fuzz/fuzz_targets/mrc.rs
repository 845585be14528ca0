#![no_main]

// Gzip is told by its magic, whatever the extension.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| isolume_fuzz::open(bytes, "mrc"));
