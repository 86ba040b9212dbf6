//! Camera calibrations as OpenCV's samples and ROS's `camera_calibration` write them: a matrix and
//! coefficients, without a mounting.

use super::document::Document;
use super::{Import, ImportError};
use crate::sensor::CameraModel;

const MATRIX: [&str; 5] = ["camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M1"];
const COEFFICIENTS: [&str; 7] = [
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "distortion",
    "D",
    "D1",
];
const MODELS: &str = "plumb_bob, radial-tangential, rational_polynomial, equidistant and fisheye";

pub(super) fn is(document: &Document) -> bool {
    MATRIX.iter().any(|key| document.has(key))
}

pub(super) fn read(
    document: &Document,
    camera: usize,
    import: &mut Import,
) -> Result<(), ImportError> {
    let first = |keys: &[&'static str]| keys.iter().copied().find(|key| document.has(key));
    let Some(matrix) = first(&MATRIX) else { return Ok(()) };
    let [fx, skew, cx, _, fy, cy, ..]: [f64; 9] = document.list(matrix)?;
    let path = document.path.display();
    if skew != 0.0 {
        import.note(format!("{path}: the skew of `{matrix}` has no key here; left out"));
    }
    let key = first(&COEFFICIENTS).unwrap_or(COEFFICIENTS[0]);
    let mut coefficients = document.numbers(key)?.unwrap_or_default();
    let model = model(document, coefficients.len(), import)?;
    if model == CameraModel::Omnidirectional {
        coefficients.insert(0, document.required("xi")?);
    }
    if coefficients.len() > 8 {
        let rest = coefficients.split_off(8);
        if rest.iter().any(|k| *k != 0.0) {
            import.note(format!(
                "{path}: thin prism and tilt coefficients have no key here; left out"
            ));
        }
    }
    let sources = ["distortion_model", matrix, key];
    import.lens(camera, document, sources, model, [fx, fy, cx, cy], coefficients)
}

fn model(
    document: &Document,
    coefficients: usize,
    import: &mut Import,
) -> Result<CameraModel, ImportError> {
    let fisheye = document.number("fisheye_model")?.is_some_and(|flag| flag != 0.0);
    if document.has("xi") {
        return Ok(CameraModel::Omnidirectional);
    }
    let (key, name) = ["distortion_model", "camera_model", "model"]
        .iter()
        .find_map(|key| Some((*key, document.text(key)?)))
        .unwrap_or(("distortion_model", if fisheye { "fisheye" } else { "" }));
    match name {
        "equidistant" | "fisheye" | "kannala_brandt" => Ok(CameraModel::Equidistant),
        "rational_polynomial" => Ok(CameraModel::Rational),
        "plumb_bob" | "radtan" | "radial-tangential" | "pinhole" => {
            Ok(CameraModel::RadialTangential)
        }
        "" if coefficients >= 8 => Ok(CameraModel::Rational),
        "" => {
            if coefficients == 4 {
                import.note(format!(
                    "{}: 4 coefficients without a model are taken for k1 k2 p1 p2; for a fisheye \
                     calibration set camera.model = \"equidistant\"",
                    document.path.display()
                ));
            }
            Ok(CameraModel::RadialTangential)
        }
        _ => Err(document.unsupported(key, MODELS)),
    }
}
