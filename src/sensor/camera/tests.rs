use nalgebra::{Point2, Vector3};
use proptest::prelude::*;

use super::*;

/// A model with its coefficients.
type Lens = (CameraModel, &'static [f64]);

const RADTAN: Lens = (CameraModel::RadialTangential, &[-0.283, 0.0739, 0.00019, 1.76e-05, 0.01]);
const RATIONAL: Lens = (CameraModel::Rational, &[0.52, -2.6, 0.0008, -0.0003, 1.4, 0.4, -2.4, 1.3]);
const KB4: Lens = (
    CameraModel::Equidistant,
    &[0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182],
);
const DOUBLE_SPHERE: Lens = (CameraModel::DoubleSphere, &[-0.2996, 0.5941]);
const MEI: Lens = (CameraModel::Omnidirectional, &[1.62, -0.12, 0.031, 0.0011, -0.0006]);

const ALL: [Lens; 5] = [RADTAN, RATIONAL, KB4, DOUBLE_SPHERE, MEI];

/// Points (camera coordinates, m) and their pixels, from `tools/camera_golden.py`: OpenCV's
/// `calib3d`, `fisheye` and `omnidir`; the papers' formulas where it has none.
const GOLDEN: [(Lens, [f64; 3], [f64; 2]); 37] = [
    (RADTAN, [0.1, -0.2, 1.5], [267.58345601690957, 231.59553265043226]),
    (RADTAN, [-0.7, 0.4, 1.2], [155.96847025385267, 313.4635228030069]),
    (RADTAN, [0.9, 0.8, 1.9], [336.2666831892948, 329.2065685413097]),
    (RADTAN, [0.0, 0.0, 2.0], [254.9317, 256.8974]),
    (RADTAN, [0.3, -1.0, 2.2], [279.4114096407506, 175.31128442644086]),
    (RATIONAL, [0.1, -0.2, 1.5], [267.6915591212196, 231.37922538366925]),
    (RATIONAL, [-0.7, 0.4, 1.2], [140.297418834312, 322.4551048167393]),
    (RATIONAL, [0.9, 0.8, 1.9], [347.7713533765197, 339.50110986029483]),
    (RATIONAL, [0.0, 0.0, 2.0], [254.9317, 256.8974]),
    (RATIONAL, [0.3, -1.0, 2.2], [281.41764002479795, 168.60473544192197]),
    (KB4, [0.1, -0.2, 1.5], [267.571495368239, 231.61849758116938]),
    (KB4, [-0.7, 0.4, 1.2], [156.71763517786172, 313.0181946459124]),
    (KB4, [0.9, 0.8, 1.9], [335.65237721603427, 328.6471594112234]),
    (KB4, [0.0, 0.0, 2.0], [254.9317, 256.8974]),
    (KB4, [0.3, -1.0, 2.2], [279.26412541025735, 175.79152372595695]),
    (KB4, [2.0, 0.5, 0.1], [534.7853628703019, 326.8589107399904]),
    (KB4, [-1.0, 2.0, 0.3], [132.67485529441512, 501.40443174454794]),
    (KB4, [1.5, -0.5, -0.2], [556.4538290701956, 156.39276027779534]),
    (KB4, [-0.4, -1.1, -0.3], [139.72255863658513, -59.91911217246474]),
    (DOUBLE_SPHERE, [0.1, -0.2, 1.5], [272.9539867881928, 220.85380785232278]),
    (DOUBLE_SPHERE, [-0.7, 0.4, 1.2], [117.44202230065859, 335.4607909162689]),
    (DOUBLE_SPHERE, [0.9, 0.8, 1.9], [368.11378309991796, 357.5009567608829]),
    (DOUBLE_SPHERE, [0.0, 0.0, 2.0], [254.9317, 256.8974]),
    (DOUBLE_SPHERE, [0.3, -1.0, 2.2], [289.2756186011691, 142.42078840590873]),
    (DOUBLE_SPHERE, [2.0, 0.5, 0.1], [617.8404869813158, 347.6221264074476]),
    (DOUBLE_SPHERE, [-1.0, 2.0, 0.3], [95.05039289573435, 576.6513076494481]),
    (DOUBLE_SPHERE, [1.5, -0.5, -0.2], [638.4420569353489, 129.0640951199193]),
    (DOUBLE_SPHERE, [-0.4, -1.1, -0.3], [110.84735265435434, -139.32376651924972]),
    (MEI, [0.1, -0.2, 1.5], [259.7553295431109, 247.25034260341621]),
    (MEI, [-0.7, 0.4, 1.2], [217.39623543283062, 278.3531443179845]),
    (MEI, [0.9, 0.8, 1.9], [285.7591780111321, 284.31357133094446]),
    (MEI, [0.0, 0.0, 2.0], [254.9317, 256.8974]),
    (MEI, [0.3, -1.0, 2.2], [264.2161208921421, 225.94521162409347]),
    (MEI, [2.0, 0.5, 0.1], [361.43683485487327, 283.6085117829343]),
    (MEI, [-1.0, 2.0, 0.3], [208.23686735603656, 350.27841761158453]),
    (MEI, [1.5, -0.5, -0.2], [369.36971773935716, 218.82817259037148]),
    (MEI, [-0.4, -1.1, -0.3], [211.2417225791918, 137.01513815627882]),
];

fn camera((model, distortion): Lens) -> Camera {
    let config = CameraConfig {
        model,
        fx: 190.9785,
        fy: 190.9733,
        cx: 254.9317,
        cy: 256.8974,
        distortion: distortion.to_vec(),
        ..CameraConfig::default()
    };
    Camera::new(&config).unwrap()
}

#[test]
fn pixels_are_those_of_other_implementations() {
    for (lens, point, pixel) in GOLDEN {
        let (camera, point) = (camera(lens), Vector3::from(point));
        let found = camera.project(&point).unwrap();
        let expected = Point2::from(pixel);
        assert!((found - expected).norm() < 1e-9, "{lens:?} {point}: {found} for {expected}");
        let back = camera.bearing(expected).unwrap();
        assert!(sine(&back, &point) < 1e-12, "{lens:?} {point}: back to {back:?}");
    }
}

/// Sine of the angle between two directions; an angle by its cosine is not known well enough.
fn sine(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.normalize().cross(&b.normalize()).norm()
}

/// Whether a pixel is where an image may be: polynomials leave it for millions of pixels.
fn is_near(pixel: &Point2<f64>) -> bool {
    pixel.coords.amax() < 2000.0
}

/// A direction up to `angle` (rad) off the axis.
fn direction(angle: f64) -> impl Strategy<Value = Vector3<f64>> {
    (0.0..angle, 0.0..std::f64::consts::TAU).prop_map(|(off, around)| {
        let (s, c) = off.sin_cos();
        Vector3::new(s * around.cos(), s * around.sin(), c)
    })
}

proptest! {
    #[test]
    fn bearings_are_imaged_where_they_were_seen(
        which in 0..5_usize, ray in direction(2.2), distance in 0.1..20.0f64,
    ) {
        let camera = camera(ALL[which]);
        if let Some(pixel) = camera.project(&(ray * distance)).filter(is_near) {
            let bearing = camera.bearing(pixel).unwrap();
            // Near the rim of the image circle a direction is known less well than its pixel.
            let (_, jacobian) = camera.project_with_jacobian(&ray).unwrap();
            let off = camera.project(&bearing).unwrap() - pixel;
            prop_assert!(off.norm() < 1e-8);
            let resolution = jacobian.svd(false, false).singular_values.min();
            prop_assert!(sine(&bearing, &ray) < 1e-10 * (1.0 + 190.0 / resolution), "{bearing:?}");
        }
    }

    #[test]
    fn pixels_are_seen_where_their_bearings_are_imaged(
        which in 0..5_usize, u in -200.0..700.0f64, v in -200.0..700.0f64,
    ) {
        let camera = camera(ALL[which]);
        if let Some(bearing) = camera.bearing(Point2::new(u, v)) {
            prop_assert!((bearing.norm() - 1.0).abs() < 1e-12);
            if let Some(pixel) = camera.project(&bearing) {
                prop_assert!((pixel - Point2::new(u, v)).norm() < 1e-7, "{pixel}");
            }
        }
    }

    #[test]
    fn jacobians_are_those_of_differences(
        which in 0..5_usize, ray in direction(1.9), distance in 0.3..10.0f64,
    ) {
        const H: f64 = 1e-6;
        let camera = camera(ALL[which]);
        let point = ray * distance;
        let Some((pixel, jacobian)) =
            camera.project_with_jacobian(&point).filter(|(pixel, _)| is_near(pixel))
        else {
            return Ok(());
        };
        prop_assert!((pixel - camera.project(&point).unwrap()).norm() < 1e-9);
        for axis in 0..3 {
            let step = Vector3::ith(axis, H * distance);
            let ends = (camera.project(&(point + step)), camera.project(&(point - step)));
            let (Some(after), Some(before)) = ends else { return Ok(()) };
            let difference = (after - before) / (2.0 * H * distance);
            let error = (jacobian.column(axis) - difference).norm();
            prop_assert!(error < 1e-5 * (jacobian.norm() + 1.0), "{error} {jacobian}");
        }
    }

    /// Points at a depth, of both kinds, against central differences by the pixel.
    #[test]
    fn points_move_with_their_pixels(
        which in 0..5_usize, range: bool, depth in 0.3..8.0f64,
        u in 150.0..350.0f64, v in 150.0..350.0f64,
    ) {
        const H: f64 = 1e-4;
        let along = if range { DepthAlong::Ray } else { DepthAlong::Axis };
        let camera = camera(ALL[which]).with_depth(along);
        let at = |du: f64, dv: f64| camera.unproject(Point2::new(u + du, v + dv), depth);
        // Near 90 degrees what has a given `z` runs away.
        let Some(point) = at(0.0, 0.0).filter(|p| range || p.z > 0.3 * p.norm()) else {
            return Ok(());
        };
        prop_assert!((camera.depth_of(&point) - depth).abs() < 1e-9 * depth);
        let (along_u, along_v) = match (at(H, 0.0), at(-H, 0.0), at(0.0, H), at(0.0, -H)) {
            (Some(a), Some(b), Some(c), Some(d)) => ((a - b) / (2.0 * H), (c - d) / (2.0 * H)),
            _ => return Ok(()),
        };
        let across = camera.across(&(point / depth), depth).unwrap();
        prop_assert!((across.column(0) - along_u).norm() < 1e-6 * across.norm());
        prop_assert!((across.column(1) - along_v).norm() < 1e-6 * across.norm());
    }
}

#[test]
fn wide_lenses_see_beyond_90_degrees_and_narrow_ones_do_not() {
    let beyond = Vector3::new(1.0, 0.3, -0.1);
    for (lens, sees) in ALL.into_iter().zip([false, false, true, true, true]) {
        let camera = camera(lens);
        assert_eq!(camera.project(&beyond).is_some(), sees, "{lens:?}");
        assert_eq!(camera.measures_range(), sees);
        // Nothing sees what is straight behind it, or what is nowhere.
        for nothing in [-Vector3::z(), Vector3::zeros(), Vector3::repeat(f64::NAN)] {
            assert_eq!(camera.project(&nothing), None, "{lens:?} {nothing}");
            assert!(camera.project_with_jacobian(&nothing).is_none(), "{lens:?} {nothing}");
        }
        assert!(camera.bearing(Point2::new(f64::NAN, 0.0)).is_none(), "{lens:?}");
    }
}

/// Without a limit a barrel images what is far off the axis a second time, near the centre.
#[test]
fn distortion_does_not_fold_back() {
    let barrel = camera((CameraModel::RadialTangential, &[-0.3, 0.0, 0.0, 0.0]));
    // x (1 - 0.3 x^2) grows up to 1 / sqrt(0.9).
    let rim = 0.9_f64.sqrt().recip();
    assert!(barrel.project(&Vector3::new(rim - 1e-6, 0.0, 1.0)).is_some());
    assert!(barrel.project(&Vector3::new(rim + 1e-6, 0.0, 1.0)).is_none());
    assert!(barrel.bearing(Point2::new(600.0, 256.0)).is_none());
}

#[test]
fn coefficients_of_zero_are_a_pinhole() {
    let plain = camera((CameraModel::RadialTangential, &[0.0; 5]));
    assert!(plain.is_pinhole());
    let point = Vector3::new(0.4, -0.3, 1.7);
    assert_eq!(plain.project(&point), plain.intrinsics().project(&point));
    let pixel = Point2::new(17.0, 30.0);
    assert_eq!(plain.unproject(pixel, 1.7), Some(plain.intrinsics().unproject(pixel, 1.7)));
}

#[test]
fn impossible_calibrations_name_their_key() {
    let valid = CameraConfig::default();
    let lens = |model, distortion: &[f64]| CameraConfig {
        model,
        distortion: distortion.to_vec(),
        ..valid.clone()
    };
    for (config, words) in [
        (CameraConfig { fx: 0.0, ..valid.clone() }, ["fx", "positive"]),
        (CameraConfig { cy: f64::NAN, ..valid.clone() }, ["cy", "finite"]),
        (lens(CameraModel::Equidistant, &[0.1; 5]), ["5 numbers", "k1 k2 k3 k4"]),
        (lens(CameraModel::RadialTangential, &[0.1; 8]), ["radial-tangential", "[k3]"]),
        (lens(CameraModel::DoubleSphere, &[0.1, 1.2]), ["1.2", "alpha"]),
        (lens(CameraModel::Omnidirectional, &[-0.1, 0.0, 0.0, 0.0, 0.0]), ["-0.1", "xi"]),
        (lens(CameraModel::Rational, &[f64::INFINITY; 8]), ["distortion", "finite"]),
    ] {
        let error = Camera::new(&config).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
    }
}

#[test]
fn models_have_the_names_that_configurations_use() {
    for model in CameraModel::ALL {
        assert_eq!(serde_json::to_value(model).unwrap(), model.name());
    }
}
