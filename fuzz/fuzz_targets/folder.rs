//! TUM RGB-D folders: the input, cut at zero bytes, is the three lists and then the image that
//! every line of them may name as `a`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let mut parts = bytes.splitn(4, |byte| *byte == 0);
    for name in ["rgb.txt", "depth.txt", "groundtruth.txt", "a"] {
        let part = parts.next().unwrap_or_default();
        std::fs::write(folder.path().join(name), part).expect("a temporary file");
    }
    mfg_vio_fuzz::read(folder.path());
});
