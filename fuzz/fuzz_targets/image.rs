//! Images of every encoding: the input is the encoding's number, width, height, and then what the
//! message holds.
#![no_main]

use mfg_vio_fuzz::{Body, one_message};

const RAW: [&str; 12] = [
    "rgb8", "bgra8", "mono16", "rgb16", "bayer_rggb8", "bayer_gbrg16", "yuv422", "yuv422_yuy2", "nv12",
    "nv21", "16UC1", "32FC1",
];
const COMPRESSED: [&str; 6] = [
    "jpeg",
    "png",
    "16UC1; compressedDepth png",
    "16UC1; compressedDepth rvl",
    "32FC1; compressedDepth rvl",
    "32FC1; compressedDepth png",
];

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let [kind, width, height, data @ ..] = bytes else { return };
    let kind = usize::from(*kind) % (RAW.len() + COMPRESSED.len());
    if let Some(format) = kind.checked_sub(RAW.len()).map(|kind| COMPRESSED[kind]) {
        return one_message("sensor_msgs/msg/CompressedImage", Body::new().text(format).bytes(data));
    }
    let size = [*height, *width].map(|side| u32::from(side));
    let body = Body::new().number(size[0]).number(size[1]).text(RAW[kind]).byte(0).number(0);
    one_message("sensor_msgs/msg/Image", body.bytes(data));
});
