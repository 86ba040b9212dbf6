//! Published figures, by sequence: position RMSE in m.

use std::collections::BTreeMap;

use super::dataset::Dataset;

/// The figures of one estimator on one data set.
#[derive(Debug, Clone, Copy)]
pub struct Published {
    pub estimator: &'static str,
    pub source: &'static str,
    /// Position RMSE in the order of [`Dataset::sequences`]; shorter where the rest is not given.
    figures: &'static [Option<f64>],
}

impl Published {
    pub fn figure(&self, dataset: Dataset, sequence: &str) -> Option<f64> {
        let index = dataset.sequences().iter().position(|name| *name == sequence)?;
        self.figures.get(index).copied().flatten()
    }
}

/// The estimators that have published figures on a data set.
pub fn published(dataset: Dataset) -> &'static [Published] {
    match dataset {
        Dataset::Euroc => &EUROC_STEREO,
        Dataset::EurocMono => &EUROC_MONO,
        Dataset::TumVi => &TUM_VI,
        Dataset::VcuRvi => &VCU_RVI,
        _ => &[],
    }
}

/// The figures on one sequence by estimator.
pub fn of_sequence(dataset: Dataset, sequence: &str) -> BTreeMap<String, f64> {
    let figure = |row: &Published| Some((row.estimator.to_owned(), row.figure(dataset, sequence)?));
    published(dataset).iter().filter_map(figure).collect()
}

const N: Option<f64> = None;
const fn s(value: f64) -> Option<f64> {
    Some(value)
}

const EUROC_STEREO: [Published; 6] = [
    Published {
        estimator: "OKVIS2",
        source: "Leutenegger, arXiv 2202.09199, table I, VIO (position and yaw alignment)",
        figures: &[
            s(0.057),
            s(0.044),
            s(0.082),
            s(0.189),
            s(0.141),
            s(0.043),
            s(0.037),
            s(0.036),
            s(0.044),
            s(0.044),
            s(0.063),
        ],
    },
    Published {
        estimator: "Basalt",
        source: "Usenko et al., Visual-Inertial Mapping with Non-Linear Factor Recovery, RA-L 2020",
        figures: &[
            s(0.07),
            s(0.06),
            s(0.07),
            s(0.13),
            s(0.11),
            s(0.04),
            s(0.05),
            s(0.10),
            s(0.04),
            s(0.05),
            N,
        ],
    },
    Published {
        estimator: "OpenVINS",
        source: "stereo, quoted by others; the primary table was not checked",
        figures: &[
            s(0.091),
            s(0.124),
            s(0.138),
            s(0.166),
            s(0.243),
            s(0.055),
            s(0.057),
            s(0.060),
            s(0.059),
            s(0.045),
            s(0.103),
        ],
    },
    Published {
        estimator: "VINS-Fusion",
        source: "stereo, quoted by others; the primary table was not checked",
        figures: &[
            s(0.166),
            s(0.152),
            s(0.125),
            s(0.280),
            s(0.284),
            s(0.076),
            s(0.069),
            s(0.114),
            s(0.066),
            s(0.091),
            s(0.096),
        ],
    },
    Published {
        estimator: "OKVIS2 (loops)",
        source: "Leutenegger, arXiv 2202.09199, table I, causal, with loop closure",
        figures: &[
            s(0.044),
            s(0.036),
            s(0.050),
            s(0.089),
            s(0.112),
            s(0.037),
            s(0.021),
            s(0.035),
            s(0.036),
            s(0.024),
            s(0.045),
        ],
    },
    Published {
        estimator: "ORB-SLAM3 (loops)",
        source: "Campos et al., arXiv 2007.11898, table II, median of 10, with loop closure",
        figures: &[
            s(0.036),
            s(0.033),
            s(0.035),
            s(0.051),
            s(0.082),
            s(0.038),
            s(0.014),
            s(0.024),
            s(0.032),
            s(0.014),
            s(0.024),
        ],
    },
];

const EUROC_MONO: [Published; 4] = [
    Published {
        estimator: "DM-VIO",
        source: "von Stumberg and Cremers, DM-VIO: Delayed Marginalization Visual-Inertial Odometry, RA-L 2022",
        figures: &[
            N,
            s(0.044),
            s(0.097),
            s(0.102),
            s(0.096),
            s(0.048),
            s(0.045),
            s(0.069),
            s(0.029),
            s(0.050),
            s(0.114),
        ],
    },
    Published {
        estimator: "XRSLAM SF-VIO",
        source: "XRSLAM, docs/en/benchmark.md",
        figures: &[
            s(0.109),
            s(0.147),
            s(0.131),
            s(0.189),
            s(0.240),
            s(0.056),
            s(0.101),
            s(0.134),
            s(0.066),
            s(0.089),
            s(0.122),
        ],
    },
    Published {
        estimator: "OpenVINS",
        source: "mono, as given in XRSLAM, docs/en/benchmark.md",
        figures: &[
            s(0.111),
            s(0.287),
            s(0.181),
            s(0.182),
            s(0.365),
            s(0.059),
            s(0.084),
            s(0.075),
            s(0.086),
            s(0.074),
            s(0.145),
        ],
    },
    Published {
        estimator: "VINS-Fusion",
        source: "mono, as given in XRSLAM, docs/en/benchmark.md",
        figures: &[
            s(0.149),
            s(0.110),
            s(0.168),
            s(0.221),
            s(0.310),
            s(0.071),
            s(0.282),
            s(0.170),
            s(0.166),
            s(0.386),
            s(0.190),
        ],
    },
];

const TUM_VI: [Published; 5] = [
    Published {
        estimator: "OKVIS",
        source: "Schubert et al., The TUM VI Benchmark, IROS 2018",
        figures: &[s(0.06), s(0.11), s(0.07), s(0.03), s(0.07), s(0.04)],
    },
    Published {
        estimator: "Basalt",
        source: "Usenko et al., RA-L 2020",
        figures: &[s(0.09), s(0.07), s(0.13), s(0.05), s(0.13), s(0.02)],
    },
    Published {
        estimator: "VINS-Mono",
        source: "Schubert et al., IROS 2018",
        figures: &[s(0.07), s(0.07), s(0.11), s(0.04), s(0.20), s(0.08)],
    },
    Published {
        estimator: "ROVIO",
        source: "Schubert et al., IROS 2018",
        figures: &[s(0.16), s(0.33), s(0.15), s(0.09), s(0.12), s(0.05)],
    },
    Published {
        estimator: "ORB-SLAM3 (loops)",
        source: "Campos et al., arXiv 2007.11898, with loop closure",
        figures: &[s(0.008), s(0.012), s(0.011), s(0.008), s(0.010), s(0.006)],
    },
];

const VCU_SOURCE: &str = "trajectories that the authors of VCU-RVI published (IROS 2020), SE(3) \
                          alignment, best constant clock offset";

/// simple 1-3, motion 1-6, light 1-6, dynamic 1-5, manual 1-3, bumper 1-5, corridor 1-4, four more
/// of the corridor, hall 1-3.
const VCU_RVI: [Published; 3] = [
    Published {
        estimator: "DUI-VIO",
        source: VCU_SOURCE,
        figures: &[
            s(0.085),
            s(0.065),
            s(0.048), // simple
            s(0.287),
            s(0.377),
            s(0.218),
            s(0.351),
            s(0.226),
            s(0.273), // motion
            N,
            N,
            s(0.236),
            s(0.118),
            s(0.612),
            s(1.03), // light
            s(0.185),
            s(0.134),
            s(0.272),
            N,
            s(0.128), // dynamic
            s(0.112),
            s(0.152),
            s(0.074), // manual
            N,
            s(0.310),
            N,
            N,
            s(0.183), // bumper
            s(1.74),
            s(1.45),
            s(2.28),
            s(1.11), // corridor
            N,
            N,
            N,
            N,
            s(1.37),
            s(1.64), // corridor manual, bumper; hall
        ],
    },
    Published {
        estimator: "VINS-RGBD",
        source: VCU_SOURCE,
        figures: &[
            s(0.097),
            s(0.064),
            s(0.052), // simple
            s(0.310),
            s(0.407),
            s(0.192),
            s(0.320),
            s(0.270),
            s(0.289), // motion
            N,
            s(0.238),
            N,
            s(0.086),
            s(0.681),
            N, // light
            s(0.166),
            s(0.191),
            s(0.302),
            N,
            s(0.137), // dynamic
            s(0.514),
            s(0.169),
            N, // manual
            N,
            N,
            N,
            N,
            N, // bumper
            s(2.25),
            s(0.85),
            s(3.23),
            s(0.98), // corridor
            N,
            N,
            N,
            N,
            s(1.46),
            s(3.93), // corridor manual, bumper; hall
        ],
    },
    Published {
        estimator: "VINS-Mono",
        source: VCU_SOURCE,
        figures: &[
            s(0.090),
            s(0.079),
            s(0.095), // simple
            s(0.253),
            s(0.428),
            s(0.222),
            s(0.363),
            s(0.237),
            s(0.275), // motion
            N,
            s(0.274),
            s(0.241),
            s(0.142),
            N,
            s(0.750), // light
            s(0.207),
            s(0.363),
            s(0.402),
            N,
            s(0.361), // dynamic
            N,
            s(0.248),
            s(0.401), // manual
            N,
            s(0.387),
            N,
            N,
            N, // bumper
            s(2.05),
            s(0.77),
            s(1.86),
            s(2.15), // corridor
            N,
            N,
            N,
            N,
            s(2.41),
            s(6.26), // corridor manual, bumper; hall
        ],
    },
];

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use crate::evaluation::{
        ApeOptions, AssociationOptions, ape, best_clock_offset, estimate_clock_offset,
        read_trajectory,
    };

    #[test]
    fn figures_stand_beside_their_sequences() {
        let figure = |dataset, estimator: &str, sequence| {
            of_sequence(dataset, sequence).get(estimator).copied()
        };
        assert_eq!(figure(Dataset::Euroc, "OKVIS2", "V1_01_easy"), Some(0.043));
        assert_eq!(figure(Dataset::Euroc, "Basalt", "V2_03_difficult"), None);
        assert_eq!(figure(Dataset::EurocMono, "DM-VIO", "V2_03_difficult"), Some(0.114));
        assert_eq!(figure(Dataset::TumVi, "ROVIO", "room6"), Some(0.05));
        assert_eq!(figure(Dataset::VcuRvi, "DUI-VIO", "lab_dynamic5"), Some(0.128));
        assert_eq!(figure(Dataset::VcuRvi, "DUI-VIO", "lab_bumper5"), Some(0.183));
        assert_eq!(figure(Dataset::VcuRvi, "VINS-RGBD", "corridor4"), Some(0.98));
        assert_eq!(figure(Dataset::VcuRvi, "VINS-Mono", "hall2"), Some(6.26));
        assert!(of_sequence(Dataset::VcuRvi, "hall3").is_empty());
        assert!(of_sequence(Dataset::Sim, "lab-simple").is_empty());
    }

    /// The means that the sources print.
    #[test]
    fn the_means_are_those_printed() {
        let mean = |row: &Published| {
            let figures: Vec<f64> = row.figures.iter().flatten().copied().collect();
            figures.iter().sum::<f64>() / figures.len() as f64
        };
        let printed = [0.071, 0.072, 0.104, 0.138, 0.048, 0.035];
        for (row, printed) in EUROC_STEREO.iter().zip(printed) {
            assert!((mean(row) - printed).abs() < 7e-4, "{} {}", row.estimator, mean(row));
        }
        // Of three digits, some of them cut off rather than rounded.
        for (row, printed) in EUROC_MONO.iter().zip([0.069, 0.125, 0.150, 0.202]) {
            assert!((mean(row) - printed).abs() < 1e-3, "{} {}", row.estimator, mean(row));
        }
    }

    /// The evaluator on the trajectories from which the figures of VCU-RVI come: within 5 mm in the
    /// lab and 3 % in corridors and halls, besides the last digit that is printed.
    #[test]
    fn figures_of_vcu_rvi_are_those_of_the_published_trajectories() {
        let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
        let data = std::env::var_os("MFG_VIO_DATA").map_or(default, PathBuf::from).join("vcu_rvi");
        if !data.exists() {
            eprintln!("SKIPPED: {} is absent (set MFG_VIO_DATA)", data.display());
            return;
        }
        let read = |path: &Path| read_trajectory(path).unwrap().trajectory;
        let mut compared = 0;
        for row in &VCU_RVI {
            for name in Dataset::VcuRvi.sequences() {
                let folder = data.join("results").join(row.estimator.to_lowercase());
                let estimate = folder.join(format!("{name}_tum.csv"));
                let reference = data.join("ground_truths").join(format!("{name}_gt.csv"));
                let printed = row.figure(Dataset::VcuRvi, name);
                let (Some(printed), true) = (printed, estimate.exists()) else { continue };
                let (reference, estimate) = (read(&reference), read(&estimate));
                let offset = estimate_clock_offset(&reference, &estimate)
                    .unwrap_or_else(|error| panic!("{} {name}: {error}", row.estimator))
                    .seconds;
                let options = ApeOptions::default();
                let offset = best_clock_offset(&reference, &estimate, offset, &options).unwrap();
                let association = AssociationOptions { time_offset: offset, ..options.association };
                let options = ApeOptions { association, ..options };
                let error = ape(&reference, &estimate, &options).unwrap().statistics.rmse;
                let (limit, digit) = match name.starts_with("lab") {
                    true => (0.005, 0.0005),
                    false => (0.03 * printed, 0.005),
                };
                let difference = (error - printed).abs();
                let place = format!("{} {name}: {error} at {offset}", row.estimator);
                assert!(difference <= limit + digit, "{place}, printed {printed}");
                compared += 1;
            }
        }
        assert!(compared >= 30, "{compared}");
    }
}
