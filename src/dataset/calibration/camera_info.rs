//! Intrinsics of `sensor_msgs/CameraInfo`.
//!
//! `K` belongs to the full resolution; a region of interest is cut out of the full image, and what
//! is left is binned (the message's definition). `P` belongs to the rectified image, which has no
//! distortion.

use crate::dataset::message::Fields;
use crate::dataset::pixels::Rejection;

/// What the message tells, as it stands.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::dataset) struct CameraInfo {
    pub frame: String,
    pub size: (u32, u32),
    pub model: String,
    pub distortion: Vec<f64>,
    /// fx, fy, cx, cy of the full image as taken.
    pub intrinsic: [f64; 4],
    /// The same of the rectified image; zeros where there is none.
    pub projection: [f64; 4],
    /// `-fx' baseline` of the second of two rectified cameras, pixel m.
    pub baseline_term: f64,
    pub binning: (u32, u32),
    /// Left, top, width and height of the region of interest in the full image; zeros: all of it.
    pub region: [u32; 4],
}

/// The camera that took images of a certain size.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::dataset) struct Intrinsics {
    /// fx, fy, cx, cy, pixels.
    pub pinhole: [f64; 4],
    pub model: Model,
    pub coefficients: Vec<f64>,
    /// How it was made of what the message says, where that is not plain.
    pub note: Option<String>,
}

/// Families of distortion that `distortion_model` names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::dataset) enum Model {
    RadialTangential,
    Rational,
    Equidistant,
    DoubleSphere,
    Omnidirectional,
}

impl Model {
    /// Its name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::RadialTangential => "radial-tangential",
            Self::Rational => "rational",
            Self::Equidistant => "equidistant",
            Self::DoubleSphere => "double-sphere",
            Self::Omnidirectional => "omnidirectional",
        }
    }
}

/// Most distortion coefficients that a message may claim to have.
const MOST_COEFFICIENTS: u32 = 64;

pub(in crate::dataset) fn camera_info(mut fields: Fields) -> Result<CameraInfo, Rejection> {
    let (_, frame) = fields.header_and_frame()?;
    let (height, width) = (fields.u32()?, fields.u32()?);
    let model = fields.text()?.to_owned();
    let count = fields.u32()?;
    if count > MOST_COEFFICIENTS {
        return Err(Rejection::new("absurd size", format!("{count} distortion coefficients")));
    }
    let distortion = (0..count).map(|_| fields.f64()).collect::<Result<_, _>>()?;
    let k: [f64; 9] = fields.f64s()?;
    let _rectification: [f64; 9] = fields.f64s()?;
    let p: [f64; 12] = fields.f64s()?;
    let binning = (fields.u32()?, fields.u32()?);
    let [left, top, region_height, region_width] =
        [fields.u32()?, fields.u32()?, fields.u32()?, fields.u32()?];
    Ok(CameraInfo {
        frame: frame.to_owned(),
        size: (width, height),
        model,
        distortion,
        intrinsic: [k[0], k[4], k[2], k[5]],
        projection: [p[0], p[5], p[2], p[6]],
        baseline_term: p[3],
        binning,
        region: [left, top, region_width, region_height],
    })
}

impl CameraInfo {
    /// How far the second of two rectified cameras is to the right of the first, m, where the
    /// message tells it.
    pub fn baseline(&self) -> Option<f64> {
        let baseline = -self.baseline_term / self.projection[0];
        (baseline > 0.0 && baseline.is_finite()).then_some(baseline)
    }

    /// The camera that took images of `size`; `rectified` if distortion was taken out of them. An
    /// error says what is wrong with the message.
    pub fn intrinsics(
        &self,
        size: Option<(u32, u32)>,
        rectified: bool,
    ) -> Result<Intrinsics, String> {
        let use_projection = rectified && self.projection[0] > 0.0;
        let full = if use_projection { self.projection } else { self.intrinsic };
        let usable = full.iter().all(|x| x.is_finite()) && full[0] > 0.0 && full[1] > 0.0;
        if !usable {
            return Err("is not calibrated: its focal lengths are zero".to_owned());
        }
        let (model, coefficients) = match use_projection {
            true => (Model::RadialTangential, Vec::new()),
            false => self.distortion()?,
        };
        let (pinhole, note) = self.resized(full, size)?;
        Ok(Intrinsics { pinhole, model, coefficients, note })
    }

    fn distortion(&self) -> Result<(Model, Vec<f64>), String> {
        let d = &self.distortion;
        if !d.iter().all(|x| x.is_finite()) {
            return Err("has a distortion that is not finite".to_owned());
        }
        let used = d.iter().rposition(|x| *x != 0.0).map_or(0, |last| last + 1);
        let model = match self.model.as_str() {
            // These are no pinholes without coefficients either.
            "equidistant" | "fisheye" | "kannala_brandt" | "kannala_brandt4" | "KB4"
                if used <= 4 =>
            {
                Model::Equidistant
            }
            "double-sphere" if used <= 2 => Model::DoubleSphere,
            "omnidirectional" if used <= 5 => Model::Omnidirectional,
            _ if used == 0 => Model::RadialTangential,
            "plumb_bob" | "rational_polynomial" | "radtan" | "radial-tangential" | ""
                if used <= 5 =>
            {
                Model::RadialTangential
            }
            "plumb_bob" | "rational_polynomial" if used <= 8 => Model::Rational,
            name => return Err(format!("has a distortion `{name}` of {used} coefficients")),
        };
        let wanted = match model {
            Model::RadialTangential if used == 0 => 0,
            Model::RadialTangential | Model::Omnidirectional => 5,
            Model::Rational => 8,
            Model::Equidistant => 4,
            Model::DoubleSphere => 2,
        };
        Ok((model, (0..wanted).map(|k| d.get(k).copied().unwrap_or(0.0)).collect()))
    }

    /// `full` (fx, fy, cx, cy) for images of `size`: cut and binned as the message says, or scaled.
    fn resized(
        &self,
        full: [f64; 4],
        size: Option<(u32, u32)>,
    ) -> Result<([f64; 4], Option<String>), String> {
        let bins = (self.binning.0.max(1), self.binning.1.max(1));
        let [left, top, width, height] = match self.region {
            [_, _, 0, _] | [_, _, _, 0] => [0, 0, self.size.0, self.size.1],
            region => region,
        };
        let as_told = (width / bins.0, height / bins.1);
        let size = size.unwrap_or(as_told);
        let shrunk = |factors: (f64, f64)| {
            let [fx, fy, cx, cy] = full;
            // The centre of the top left pixel is (0, 0), its corner (-0.5, -0.5).
            let centre = |c: f64, start: u32, by: f64| (c - f64::from(start) + 0.5) / by - 0.5;
            let (cx, cy) = (centre(cx, left, factors.0), centre(cy, top, factors.1));
            [fx / factors.0, fy / factors.1, cx, cy]
        };
        if size == as_told {
            let is_plain = bins == (1, 1) && (left, top) == (0, 0);
            let note = format!(
                "K cut to the region at ({left}, {top}) and binned by {}x{}",
                bins.0, bins.1
            );
            let factors = (f64::from(bins.0), f64::from(bins.1));
            return Ok((shrunk(factors), (!is_plain).then_some(note)));
        }
        if size == self.size || self.size == (0, 0) {
            let note = "binning and region of interest are not applied: K fits the image's size";
            return Ok((full, (self.size != (0, 0)).then(|| note.to_owned())));
        }
        let (x, y) = (
            f64::from(as_told.0) / f64::from(size.0.max(1)),
            f64::from(as_told.1) / f64::from(size.1.max(1)),
        );
        // The rounding of a side to whole pixels.
        let tolerance = 1.0 / f64::from(size.0.min(size.1).max(1));
        if as_told.0 > 0 && as_told.1 > 0 && (x / y - 1.0).abs() < tolerance {
            let factors = (x * f64::from(bins.0), y * f64::from(bins.1));
            let note = format!(
                "scaled from {}x{} to the {}x{} pixels of the images",
                as_told.0, as_told.1, size.0, size.1
            );
            return Ok((shrunk(factors), Some(note)));
        }
        Err(format!(
            "is for images of {}x{} pixels, these have {}x{}",
            as_told.0, as_told.1, size.0, size.1
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info() -> CameraInfo {
        CameraInfo {
            frame: "cam".to_owned(),
            size: (1280, 720),
            model: "plumb_bob".to_owned(),
            distortion: vec![0.1, -0.2, 0.001, 0.002, 0.0],
            intrinsic: [900.0, 901.0, 640.0, 360.0],
            projection: [880.0, 880.0, 630.0, 350.0],
            ..CameraInfo::default()
        }
    }

    #[test]
    fn a_plain_message_is_taken_as_it_stands() {
        let found = info().intrinsics(Some((1280, 720)), false).unwrap();
        assert_eq!(found.pinhole, [900.0, 901.0, 640.0, 360.0]);
        assert_eq!(found.model, Model::RadialTangential);
        assert_eq!(found.coefficients, [0.1, -0.2, 0.001, 0.002, 0.0]);
        assert_eq!(found.note, None);
        let rectified = info().intrinsics(Some((1280, 720)), true).unwrap();
        assert_eq!(
            (rectified.pinhole, rectified.coefficients.len()),
            ([880.0, 880.0, 630.0, 350.0], 0)
        );
    }

    /// A pixel of the binned image is the mean of a block: a ray hits both at the same place.
    #[test]
    fn region_and_binning_keep_the_rays() {
        let cut = CameraInfo { binning: (2, 2), region: [100, 60, 1000, 600], ..info() };
        let found = cut.intrinsics(Some((500, 300)), false).unwrap();
        let [fx, _, cx, _] = found.pinhole;
        for column in [0.0, 77.0, 499.0] {
            // Its block begins at full column 100 + 2 column and is two wide.
            let full = 100.0 + 2.0 * column + 0.5;
            assert!(((column - cx) / fx - (full - 640.0) / 900.0).abs() < 1e-12);
        }
        assert!(found.note.is_some());
        // A driver that gives K of the binned image and leaves the binning in.
        let odd = CameraInfo { binning: (2, 2), ..info() };
        assert_eq!(odd.intrinsics(Some((1280, 720)), false).unwrap().pinhole[0], 900.0);
    }

    #[test]
    fn resized_images_scale_and_squeezed_ones_are_refused() {
        let half = info().intrinsics(Some((640, 360)), false).unwrap();
        assert_eq!((half.pinhole[0], half.pinhole[2]), (450.0, 319.75));
        let error = info().intrinsics(Some((640, 480)), false).unwrap_err();
        assert!(error.contains("1280x720") && error.contains("640x480"), "{error}");
    }

    #[test]
    fn distortions_are_told_apart() {
        let of = |model: &str, d: &[f64]| {
            let info = CameraInfo { model: model.to_owned(), distortion: d.to_vec(), ..info() };
            info.intrinsics(None, false).map(|found| (found.model, found.coefficients.len()))
        };
        assert_eq!(of("rational_polynomial", &[0.0; 8]), Ok((Model::RadialTangential, 0)));
        let eight = [0.1, 0.2, 0.0, 0.0, 0.3, 0.1, 0.2, 0.3];
        assert_eq!(of("rational_polynomial", &eight), Ok((Model::Rational, 8)));
        assert_eq!(of("equidistant", &[0.1, 0.0, 0.0, 0.0]), Ok((Model::Equidistant, 4)));
        assert_eq!(of("equidistant", &[0.0; 4]), Ok((Model::Equidistant, 4)));
        assert_eq!(of("double-sphere", &[-0.2, 0.6]), Ok((Model::DoubleSphere, 2)));
        assert_eq!(of("plumb_bob", &[0.1, 0.0, 0.0, 0.0]), Ok((Model::RadialTangential, 5)));
        assert!(of("thin_prism", &[0.1]).unwrap_err().contains("thin_prism"));
        let zero = CameraInfo { intrinsic: [0.0; 4], ..info() };
        assert!(zero.intrinsics(None, false).unwrap_err().contains("not calibrated"));
    }
}
