//! Which fault explains what the monitors found, and what is done about it.

use super::{Fault, Finding, Reaction, Verdict};

/// Which of two faults that are found at once is taken for the cause: the one of smaller rank.
///
/// First what is read off the messages themselves, then what the sensors' readings show by themselves, then
/// what is told from comparing sensors, last what is told from the estimate, which suffers from all others.
fn rank(fault: &Fault) -> u8 {
    match fault {
        Fault::ImuGap => 0,
        Fault::Stalled => 1,
        Fault::Repeated => 2,
        Fault::Jitter { .. } => 3,
        Fault::AccelUnit => 4,
        Fault::GyroScale => 5,
        Fault::ImuNoise => 6,
        Fault::Darkness => 7,
        Fault::Occlusion => 8,
        Fault::DynamicScene => 9,
        Fault::Dropped => 10,
        Fault::ClockJump { .. } => 11,
        Fault::Kidnapped => 12,
        Fault::BiasStep => 13,
        Fault::Divergence { .. } => 14,
    }
}

/// Whether what speaks for `symptom` may come of `cause`: the signature table of `docs/faults.md`.
pub fn explains(cause: &Fault, symptom: &Fault) -> bool {
    use Fault as F;
    let estimate = matches!(symptom, F::Kidnapped | F::BiasStep | F::Divergence { .. });
    let imu = matches!(symptom, F::GyroScale | F::ImuNoise | F::ClockJump { .. });
    let view = matches!(symptom, F::Occlusion | F::DynamicScene);
    let by_cause = match cause {
        // No readings, or none of the body: all that is compared with them contradicts.
        // Points are looked for at a wrong place, and what is found there agrees on some motion.
        F::ImuGap | F::AccelUnit | F::GyroScale | F::ImuNoise => {
            estimate || imu || matches!(symptom, F::DynamicScene)
        }
        // A jittering stamp is nearest to another message's, as if one were lost.
        F::Jitter { .. } => estimate || imu || matches!(symptom, F::Dropped),
        F::Darkness => estimate || view || matches!(symptom, F::ClockJump { .. }),
        F::Stalled => estimate || view,
        // What covers the view hides its points, and may move.
        F::Occlusion => estimate || view,
        // Images follow what moves, as if the body were turned.
        F::DynamicScene => estimate || matches!(symptom, F::GyroScale | F::ClockJump { .. }),
        F::Dropped => matches!(symptom, F::ClockJump { .. } | F::BiasStep),
        F::ClockJump { .. } => {
            estimate || matches!(symptom, F::GyroScale | F::Dropped | F::DynamicScene)
        }
        // The first image from elsewhere shows nothing of what was expected.
        F::Kidnapped => estimate || view || matches!(symptom, F::ClockJump { .. }),
        F::BiasStep => matches!(symptom, F::Divergence { .. }),
        F::Repeated | F::Divergence { .. } => false,
    };
    by_cause && !cause.is_kind_of(symptom)
}

/// The cause among what was found: the confirmed one of least rank that no other finding, confirmed or
/// suspected, explains; of two that explain each other the one of smaller rank.
pub fn isolate(verdicts: &[Verdict]) -> Option<Finding> {
    let findings = || verdicts.iter().filter_map(Verdict::finding);
    let is_symptom = |finding: &Finding| {
        findings().any(|other| {
            let (cause, symptom) = (&other.fault, &finding.fault);
            let mutual = explains(symptom, cause);
            explains(cause, symptom) && !(mutual && rank(symptom) < rank(cause))
        })
    };
    let confirmed = verdicts.iter().filter_map(Verdict::confirmed);
    confirmed.filter(|finding| !is_symptom(finding)).min_by_key(|f| rank(&f.fault)).copied()
}

/// What is done about a fault.
pub fn policy(fault: &Fault) -> Reaction {
    match fault {
        Fault::ImuGap | Fault::ImuNoise | Fault::BiasStep => Reaction::InflateImu,
        Fault::GyroScale => Reaction::ReplaceGyro,
        Fault::AccelUnit => Reaction::ReopenGravity,
        Fault::ClockJump { .. } | Fault::Jitter { .. } => Reaction::Retime,
        Fault::Darkness | Fault::Kidnapped => Reaction::Relocalise,
        Fault::Divergence { .. } => Reaction::Restart,
        Fault::Dropped
        | Fault::Repeated
        | Fault::Occlusion
        | Fault::DynamicScene
        | Fault::Stalled => Reaction::Tolerate,
    }
}

#[cfg(test)]
mod tests {
    use super::super::Divergence;
    use super::*;
    use crate::sensor::Stamp;

    fn all() -> [Fault; 15] {
        [
            Fault::ImuGap,
            Fault::ImuNoise,
            Fault::GyroScale,
            Fault::AccelUnit,
            Fault::ClockJump { offset: 0.05 },
            Fault::Jitter { sd: 0.002 },
            Fault::Darkness,
            Fault::BiasStep,
            Fault::Dropped,
            Fault::Repeated,
            Fault::Occlusion,
            Fault::DynamicScene,
            Fault::Kidnapped,
            Fault::Stalled,
            Fault::Divergence { by: Divergence::Innovation },
        ]
    }

    fn finding(fault: Fault) -> Finding {
        Finding { fault, since: Stamp::default(), statistic: 1.0 }
    }

    fn named(confirmed: &[Fault], suspected: &[Fault]) -> Option<&'static str> {
        let confirmed = confirmed.iter().map(|fault| Verdict::Confirmed(finding(*fault)));
        let suspected = suspected.iter().map(|fault| Verdict::Suspected(finding(*fault)));
        let verdicts: Vec<_> = confirmed.chain(suspected).collect();
        isolate(&verdicts).map(|finding| finding.fault.name())
    }

    #[test]
    fn of_several_confirmed_faults_one_is_always_named() {
        for first in all() {
            assert_eq!(named(&[first], &[]), Some(first.name()));
            for second in all() {
                let either = named(&[first, second], &[]).unwrap();
                assert!([first.name(), second.name()].contains(&either), "{first} {second}");
                assert_eq!(named(&[second, first], &[]), Some(either));
            }
        }
        assert!(named(&all(), &[]).is_some());
    }

    #[test]
    fn the_cause_is_named_and_not_its_symptoms() {
        let jump = Fault::ClockJump { offset: 0.05 };
        let innovation = Fault::Divergence { by: Divergence::Innovation };
        assert_eq!(named(&[innovation, Fault::BiasStep, jump], &[]), Some("clock-jump"));
        assert_eq!(named(&[Fault::ImuNoise], &[Fault::GyroScale]), None);
        assert_eq!(named(&[Fault::ImuNoise, Fault::GyroScale], &[]), Some("gyro-scale"));
        assert_eq!(named(&[Fault::Dropped, Fault::Jitter { sd: 0.002 }], &[]), Some("jitter"));
        assert_eq!(named(&[Fault::BiasStep], &[Fault::Darkness]), None);
        assert_eq!(named(&[Fault::Repeated], &[Fault::Darkness]), Some("repeated"));
    }

    #[test]
    fn nothing_explains_itself_and_names_are_distinct() {
        let faults = all();
        for fault in faults {
            assert!(!explains(&fault, &fault), "{fault}");
            let text = serde_json::to_value(fault).unwrap();
            assert_eq!(text["kind"], fault.name());
            assert_eq!(serde_json::from_value::<Fault>(text).unwrap(), fault);
        }
        let mut names: Vec<_> = faults.iter().map(Fault::name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), faults.len());
        let mut ranks: Vec<_> = faults.iter().map(rank).collect();
        ranks.sort_unstable();
        ranks.dedup();
        assert_eq!(ranks.len(), faults.len());
    }
}
