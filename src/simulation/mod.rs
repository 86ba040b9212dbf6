//! Worlds, motions and sensors.
