//! ROS 2 bags in SQLite.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| mfg_vio_fuzz::file(b"SQLite format 3\0", bytes));
