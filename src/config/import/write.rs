//! The configuration file of an import.

use std::fmt::Write as _;

use super::{Import, ImportedValue};

impl Import {
    /// A configuration with what was found, each key with its origin; keys that no file has are left
    /// out and keep their defaults.
    pub fn to_toml(&self) -> String {
        let mut text = String::from("# Imported by `mfg-vio config import` from:\n");
        for file in &self.files {
            text += &format!("#   {}\n", file.display());
        }
        text += "# camera.imu_from_camera maps camera to IMU coordinates: p_imu = imu_from_camera p_camera.\n";
        text += "# camera.time_offset is added to camera stamps: t_imu = t_camera + time_offset.\n";
        for note in &self.notes {
            text += &format!("# {note}.\n");
        }
        let section = |name: &str, values: Vec<(&str, &ImportedValue)>| {
            let lines = values.into_iter().map(|(key, imported)| {
                let origin = imported.path.file_name().unwrap_or_default().to_string_lossy();
                format!("# {origin}: {}\n{key} = {}\n", imported.source, imported.value)
            });
            format!("\n[{name}]\n{}", lines.collect::<String>())
        };
        if let Some(stereo) = self.stereo() {
            text += &format!("\n[log]\n# The left and the right camera.\nstereo = [\n{stereo}]\n");
        }
        if !self.imu.is_empty() {
            text += &section("imu", self.imu.iter().map(|(k, v)| (*k, v)).collect());
        }
        if let Some(camera) = self.cameras.get(&0) {
            text += &section("camera", camera.iter().map(|(k, v)| (*k, v)).collect());
        }
        text
    }

    /// The first two cameras as inline tables, if both are mounted.
    fn stereo(&self) -> Option<String> {
        let mut text = String::new();
        for camera in 0..2 {
            let values = self.cameras.get(&camera)?;
            if !(values.contains_key("imu_from_camera") && values.contains_key("fx")) {
                return None;
            }
            let pairs: Vec<String> = values
                .iter()
                .map(|(key, imported)| format!("{key} = {}", imported.value))
                .collect();
            writeln!(text, "    {{ {} }},", pairs.join(", ")).ok()?;
        }
        Some(text)
    }
}
