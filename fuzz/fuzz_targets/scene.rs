//! Scene files: whatever is accepted has values that a simulation can use.
#![no_main]

use mfg_vio::simulation::SceneConfig;

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(scene) = SceneConfig::from_toml(text) {
        let _ = scene.validate();
    }
});
