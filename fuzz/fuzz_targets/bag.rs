//! ROS 1 bags.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| mfg_vio_fuzz::file(b"#ROSBAG V2.0\n", bytes));
