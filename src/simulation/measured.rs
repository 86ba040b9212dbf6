//! A measured IMU in place of the simulated one, along the trajectory that was measured with it.

use std::collections::VecDeque;

use nalgebra::Vector3;

use crate::sensor::{ImuSample, Stamp, TruthPose};

/// Samples of an IMU (SI units) on the clock of a trajectory.
#[derive(Debug, Clone, Default)]
pub struct MeasuredImu {
    samples: VecDeque<ImuSample>,
}

/// Why a measured IMU does not go with a trajectory.
#[derive(Debug, thiserror::Error)]
pub enum MeasuredImuError {
    #[error(
        "the IMU ({}) does not cover the trajectory ({:.3} s to {:.3} s): they must be on one clock",
        .imu.map_or("no samples".to_owned(), |[from, to]| format!("{from:.3} s to {to:.3} s")),
        .trajectory[0], .trajectory[1]
    )]
    Uncovered { imu: Option<[f64; 2]>, trajectory: [f64; 2] },
    #[error("a measured IMU goes with the trajectory that it was measured on: give --trajectory")]
    NoTrajectory,
    #[error("the IMU's mean force along the trajectory has no direction: nothing tells what is up")]
    NoGravity,
}

impl MeasuredImu {
    /// Samples in order of their stamps.
    pub fn new(samples: Vec<ImuSample>) -> Self {
        Self { samples: samples.into() }
    }

    /// Direction of up in the world of `poses` (of the IMU): its mean force there, as accelerations
    /// average out.
    pub(super) fn up(&self, poses: &[TruthPose]) -> Result<Vector3<f64>, MeasuredImuError> {
        let mut sum = Vector3::zeros();
        for sample in &self.samples {
            let after = poses.partition_point(|pose| pose.stamp < sample.stamp);
            // The nearest later pose turns the force well enough.
            if let (true, Some(pose)) = (after > 0, poses.get(after)) {
                sum += pose.world_from_body.rotation * sample.specific_force;
            }
        }
        sum.try_normalize(1e-6).ok_or(MeasuredImuError::NoGravity)
    }

    /// Leaves out what is before `start` and after `end`.
    pub(super) fn cut(&mut self, start: Stamp, end: Stamp) -> Result<(), MeasuredImuError> {
        let ends = self.samples.front().zip(self.samples.back());
        let covers = ends.is_some_and(|(first, last)| first.stamp <= start && last.stamp >= end);
        if !covers {
            return Err(MeasuredImuError::Uncovered {
                imu: ends.map(|(first, last)| [first.stamp.seconds(), last.stamp.seconds()]),
                trajectory: [start.seconds(), end.seconds()],
            });
        }
        self.samples.retain(|sample| sample.stamp >= start && sample.stamp <= end);
        Ok(())
    }

    /// Stamp of the next sample.
    pub(super) fn next_stamp(&self) -> Option<Stamp> {
        self.samples.front().map(|sample| sample.stamp)
    }

    pub(super) fn take(&mut self) -> Option<ImuSample> {
        self.samples.pop_front()
    }
}
