//! MCAP files.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| mfg_vio_fuzz::file(b"\x89MCAP0\r\n", bytes));
