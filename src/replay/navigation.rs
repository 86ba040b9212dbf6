use std::path::Path;

use super::ReplayError;
use super::outputs::{OutputFile, belief_columns, belief_fields, trajectory_line};
use crate::filter::gnss::{FixUse, NavigationStep};

/// `trajectory.tum` and `state.csv` of an IMU-GNSS run, written line by line, so that an
/// interrupted run leaves valid files.
pub struct NavigationOutputs {
    trajectory: OutputFile,
    state: OutputFile,
}

impl NavigationOutputs {
    /// Creates `directory` and the files in it.
    pub fn create(directory: &Path) -> Result<Self, ReplayError> {
        std::fs::create_dir_all(directory)
            .map_err(|source| ReplayError::Write { path: directory.to_owned(), source })?;
        let trajectory = OutputFile::create(directory.join("trajectory.tum"))?;
        let mut state = OutputFile::create(directory.join("state.csv"))?;
        let mut columns = belief_columns();
        let fix = ["heading_sd", "fix", "nis", "residual_x", "residual_y", "residual_z"];
        columns.extend(fix.map(str::to_owned));
        // Mean of the last normalised innovations squared, and whether the belief agrees with it.
        columns.extend(["nis_window", "consistent"].map(str::to_owned));
        state.line(&columns.join(","))?;
        Ok(Self { trajectory, state })
    }

    /// Writes a line to each file; the columns of a fix stay empty where there is none.
    pub fn step(&mut self, step: &NavigationStep) -> Result<(), ReplayError> {
        let state = &step.belief.state;
        self.trajectory.line(&trajectory_line(step.stamp, &state.world_from_body))?;
        let covariance = &step.belief.covariance;
        let mut fields = belief_fields(step.stamp, state, covariance, step.concentration);
        fields.push(format!("{:.9e}", step.heading_sd()));
        match &step.fix {
            Some(fix) => {
                let fate = match fix.fate {
                    FixUse::Used => "used",
                    FixUse::Rejected => "rejected",
                    FixUse::Outage(_) => "outage",
                };
                fields.push(fate.to_owned());
                fields.push(format!("{:.9e}", fix.innovation.nis));
                fields.extend(fix.innovation.residual.iter().map(|r| format!("{r:.9e}")));
            }
            None => fields.extend(vec![String::new(); 5]),
        }
        match &step.consistency {
            Some(consistency) => {
                fields.push(format!("{:.9e}", consistency.mean));
                fields.push(u8::from(consistency.holds()).to_string());
            }
            None => fields.extend(vec![String::new(); 2]),
        }
        self.state.line(&fields.join(","))
    }

    pub fn finish(self) -> Result<(), ReplayError> {
        self.trajectory.finish()?;
        self.state.finish()
    }
}
