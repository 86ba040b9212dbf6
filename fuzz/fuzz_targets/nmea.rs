//! Files of NMEA sentences, whose checksums are made right: few inputs would guess them.
#![no_main]

use mfg_vio::dataset::{NavigationTopics, read_navigation};
use mfg_vio::inertial::ImuConfig;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let signed = |body: &[u8]| {
        let sum = body.iter().fold(0, |sum, byte| sum ^ byte);
        [b"$".as_slice(), body, format!("*{sum:02X}\n").as_bytes()].concat()
    };
    let text: Vec<u8> = bytes.split(|byte| *byte == b'\n').flat_map(signed).collect();
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), [b"$GPGGA,".as_slice(), b"\n", &text].concat()).expect("a file");
    let _ = read_navigation(file.path(), &NavigationTopics::default(), &ImuConfig::default());
});
