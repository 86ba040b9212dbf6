//! Visual-inertial odometry whose beliefs about attitude live on SO(3) itself.
//!
//! The modules are layers: each uses only those above it in the table of `ARCHITECTURE.md`.
//! Conventions, once for all of them: `a_from_b` maps coordinates of frame `b` to frame `a`;
//! the world's z axis points up; the body is the IMU; the camera looks along its z axis with
//! x to the right and y down; SI units throughout; `measured = true + bias + noise`.

pub mod alignment;
#[cfg(feature = "vision")]
pub mod bench;
pub mod config;
pub mod dataset;
mod dialect;
pub mod distribution;
pub mod evaluation;
pub mod experiment;
pub mod fault;
pub mod filter;
pub mod inertial;
pub mod map;
pub mod odometry;
pub mod output;
pub mod replay;
pub mod sensor;
pub mod simulation;
pub mod so3;
pub mod tracking;
pub mod viewer;
pub mod vision;
