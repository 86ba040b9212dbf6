//! Allan deviations of an IMU.

use super::plot::{Curve, CurvePanel, Figure, Panel, Scale};
use crate::inertial::identification::{AxisNoise, ImuNoise, InertialSensor};

/// Allan deviations of both sensors over the averaging time, with the fitted model.
pub fn noise_figure(noise: &ImuNoise) -> Figure {
    let panel = |sensor: InertialSensor| {
        Panel::Curves(CurvePanel {
            title: format!("{sensor:?}"),
            x_label: "averaging time (s)".to_owned(),
            y_label: format!("Allan deviation ({})", sensor.unit()),
            curves: noise.of(sensor).flat_map(curves).collect(),
            x_scale: Scale::Logarithmic,
            y_scale: Scale::Logarithmic,
            ..CurvePanel::default()
        })
    };
    Figure {
        title: format!("IMU noise over {:.0} s at rest", noise.rest.seconds()),
        panels: vec![panel(InertialSensor::Gyroscope), panel(InertialSensor::Accelerometer)],
        columns: 2,
    }
}

fn curves(axis: &AxisNoise) -> [Curve; 2] {
    let points = axis.allan.iter().zip(&axis.model);
    let measured = points.clone().map(|(point, _)| [point.tau, point.deviation]).collect();
    let model = points.map(|(point, model)| [point.tau, *model]).collect();
    [
        Curve { name: axis.axis.to_string(), points: measured },
        Curve { name: format!("{} model", axis.axis), points: model },
    ]
}
