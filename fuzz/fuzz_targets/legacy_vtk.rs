#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| isolume_fuzz::open(bytes, "vtk"));
