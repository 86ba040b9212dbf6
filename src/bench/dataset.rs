//! What is known of each data set.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use super::recipe::Recipe;
use crate::filter::FilterKind;
use crate::filter::attitude::AttitudeFilterKind;
use crate::filter::gnss::GnssFilterKind;

/// The data sets that can be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Dataset {
    /// Two grey cameras and an IMU on a flying robot; truth begins seconds after the images.
    Euroc,
    /// The same with its left camera alone.
    EurocMono,
    /// Two fisheye cameras and an IMU, held in the hand; truth where there is motion capture.
    TumVi,
    /// RGB-D and IMU; x-up worlds, truth by another clock, and in corridors only at both ends.
    VcuRvi,
    /// RGB-D with gyroscope and accelerometer apart, on a wheeled robot.
    Openloris,
    /// RGB-D without gyroscope.
    TumRgbd,
    /// RGB-D without stamps.
    SevenScenes,
    /// IMU and magnetometer.
    Broad,
    /// IMU and GNSS positions.
    KittiImuGps,
    /// Rendered on demand; see [`RECIPES`](super::RECIPES).
    Sim,
}

/// Whether truth and sensors share a clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    Shared,
    /// Truth is by a clock of its own, a constant apart: found from angular speeds.
    Apart,
}

/// What a run reads.
#[derive(Debug, Clone)]
pub enum Source {
    /// A log of images, with a truth file where the log does not hold it.
    Log { log: PathBuf, truth: Option<PathBuf> },
    /// A scene that is rendered, one log a seed, along a trajectory where one is given.
    Recipe { recipe: Recipe, trajectory: Option<PathBuf> },
    /// Tables of inertial and magnetic data and of reference attitudes.
    Attitude { imu: PathBuf, reference: PathBuf },
    /// Tables of IMU samples and of GNSS positions.
    Navigation { imu: PathBuf, gps: PathBuf },
}

/// One recording as it is run and judged.
#[derive(Debug, Clone)]
pub struct Sequence {
    pub name: String,
    pub source: Source,
    pub clock: Clock,
    /// Whether one camera is all that may be used: a run that takes depth or a second one fails.
    pub one_camera: bool,
    /// `SECTION.KEY=VALUE` that this recording needs, before those of the command line.
    pub settings: Vec<String>,
    /// Spans, s after the first message, in which something is wrong that should be named: a
    /// warning elsewhere is a false alarm.
    pub disturbed: Vec<[f64; 2]>,
}

impl Dataset {
    pub const ALL: [Self; 10] = [
        Self::Euroc,
        Self::EurocMono,
        Self::TumVi,
        Self::VcuRvi,
        Self::Openloris,
        Self::TumRgbd,
        Self::SevenScenes,
        Self::Broad,
        Self::KittiImuGps,
        Self::Sim,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::Euroc => "euroc",
            Self::EurocMono => "euroc-mono",
            Self::TumVi => "tum-vi",
            Self::VcuRvi => "vcu-rvi",
            Self::Openloris => "openloris",
            Self::TumRgbd => "tum-rgbd",
            Self::SevenScenes => "seven-scenes",
            Self::Broad => "broad",
            Self::KittiImuGps => "kitti-imu-gps",
            Self::Sim => "sim",
        }
    }

    /// What lies under the folder of a complete copy.
    pub fn expected(self) -> &'static str {
        match self {
            Self::Euroc | Self::EurocMono => {
                "folders such as MH_01_easy/mav0, or bags such as V1_01_easy.bag"
            }
            Self::TumVi => "folders such as dataset-room1_512_16/mav0, or bags of these names",
            Self::VcuRvi => "bags such as lab_simple1.bag and ground_truths/lab_simple1_gt.csv",
            Self::Openloris => "folders such as office1-1 with color.txt and sensors.yaml",
            Self::TumRgbd => "folders such as rgbd_dataset_freiburg1_xyz with rgb.txt",
            Self::SevenScenes => "folders such as chess/seq-01 with frame-000000.color.png",
            Self::Broad => {
                "folders with imu.csv and reference.csv, made of the HDF5 files by tools/convert_broad"
            }
            Self::KittiImuGps => "KittiEquivBiasedImu.txt and KittiGps_converted.txt",
            Self::Sim => "nothing, or trajectories (TUM format) to move along",
        }
    }

    /// Names of the sequences that the data set has; empty where any folder will do.
    pub fn sequences(self) -> Vec<&'static str> {
        match self {
            Self::Euroc | Self::EurocMono => EUROC.to_vec(),
            Self::TumVi => TUM_VI.to_vec(),
            Self::VcuRvi => VCU_RVI.to_vec(),
            Self::Openloris => OPENLORIS.to_vec(),
            Self::KittiImuGps => vec!["drive"],
            Self::Sim => super::RECIPES.iter().map(|recipe| recipe.name).collect(),
            Self::TumRgbd | Self::SevenScenes | Self::Broad => Vec::new(),
        }
    }

    /// Filters that can be run on it, the default one first.
    pub fn filters(self) -> Vec<&'static str> {
        let default_first = |default: &'static str, all: Vec<&'static str>| {
            let others = all.into_iter().filter(move |name| *name != default);
            std::iter::once(default).chain(others).collect()
        };
        match self {
            Self::Broad => default_first(
                AttitudeFilterKind::Mfgba.name(),
                AttitudeFilterKind::ALL.map(AttitudeFilterKind::name).to_vec(),
            ),
            Self::KittiImuGps => default_first(
                GnssFilterKind::Mfgi.name(),
                [GnssFilterKind::Mfgi, GnssFilterKind::Mfgb, GnssFilterKind::Mekf]
                    .map(GnssFilterKind::name)
                    .to_vec(),
            ),
            _ => default_first(
                FilterKind::default().name(),
                FilterKind::ALL.map(FilterKind::name).to_vec(),
            ),
        }
    }

    /// What the reader of its figures must know.
    pub fn notes(self) -> &'static [&'static str] {
        match self {
            Self::Euroc | Self::EurocMono => &[
                "Truth begins seconds after the images; coverage is the share of the truth.",
                "The orientation of V1_01_easy's official truth is known to be off by degrees: its \
                 attitude error and attitude NEES say nothing of the estimate.",
                "Published figures of OKVIS2 are after position and yaw alignment, ours and the \
                 others after SE(3).",
            ],
            Self::TumVi => &[
                "Outside the rooms truth covers only begin and end; coverage is the share of the \
                 truth.",
            ],
            Self::VcuRvi => &[
                "Truth is by a clock of its own; the constant offset is found from angular speeds, \
                 here and in the published figures.",
                "The truth's world is x-up and its vertical not known: for NEES whole first poses \
                 are put on each other.",
                "In corridors and halls truth covers only begin and end; coverage is the share of \
                 the truth.",
                "Sequences `dynamic` are numbered as the truth files are, not as the authors' \
                 scripts.",
            ],
            Self::TumRgbd => &["There is no gyroscope: a constant-velocity model takes its place."],
            Self::SevenScenes => {
                &["There are no stamps (30 Hz are assumed) and no IMU; truth is KinectFusion's."]
            }
            Self::Openloris => &["The wheeled robot starts at rest more often than not."],
            Self::Broad => {
                &["Attitude error over the movement phase after taking out the mean heading error."]
            }
            Self::KittiImuGps => {
                &["Errors are those at fixes withheld for 30 s, from 60 s on again every 100 s."]
            }
            Self::Sim => {
                &["Each seed has a room, noise and biases of its own, and truth is exact."]
            }
        }
    }
}

impl fmt::Display for Dataset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Dataset {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|dataset| dataset.name() == text).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|dataset| dataset.name()).collect();
            format!("unknown data set `{text}`; there are: {}", names.join(", "))
        })
    }
}

const EUROC: [&str; 11] = [
    "MH_01_easy",
    "MH_02_easy",
    "MH_03_medium",
    "MH_04_difficult",
    "MH_05_difficult",
    "V1_01_easy",
    "V1_02_medium",
    "V1_03_difficult",
    "V2_01_easy",
    "V2_02_medium",
    "V2_03_difficult",
];

const TUM_VI: [&str; 28] = [
    "room1",
    "room2",
    "room3",
    "room4",
    "room5",
    "room6",
    "corridor1",
    "corridor2",
    "corridor3",
    "corridor4",
    "corridor5",
    "magistrale1",
    "magistrale2",
    "magistrale3",
    "magistrale4",
    "magistrale5",
    "magistrale6",
    "outdoors1",
    "outdoors2",
    "outdoors3",
    "outdoors4",
    "outdoors5",
    "outdoors6",
    "outdoors7",
    "outdoors8",
    "slides1",
    "slides2",
    "slides3",
];

const VCU_RVI: [&str; 39] = [
    "lab_simple1",
    "lab_simple2",
    "lab_simple3",
    "lab_motion1",
    "lab_motion2",
    "lab_motion3",
    "lab_motion4",
    "lab_motion5",
    "lab_motion6",
    "lab_light1",
    "lab_light2",
    "lab_light3",
    "lab_light4",
    "lab_light5",
    "lab_light6",
    "lab_dynamic1",
    "lab_dynamic2",
    "lab_dynamic3",
    "lab_dynamic4",
    "lab_dynamic5",
    "lab_manual1",
    "lab_manual2",
    "lab_manual3",
    "lab_bumper1",
    "lab_bumper2",
    "lab_bumper3",
    "lab_bumper4",
    "lab_bumper5",
    "corridor1",
    "corridor2",
    "corridor3",
    "corridor4",
    "corridor_manual1",
    "corridor_manual2",
    "corridor_bumper1",
    "corridor_bumper2",
    "hall1",
    "hall2",
    "hall3",
];

const OPENLORIS: [&str; 22] = [
    "cafe1-1",
    "cafe1-2",
    "corridor1-1",
    "corridor1-2",
    "corridor1-3",
    "corridor1-4",
    "corridor1-5",
    "home1-1",
    "home1-2",
    "home1-3",
    "home1-4",
    "home1-5",
    "market1-1",
    "market1-2",
    "market1-3",
    "office1-1",
    "office1-2",
    "office1-3",
    "office1-4",
    "office1-5",
    "office1-6",
    "office1-7",
];
