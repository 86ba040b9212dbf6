//! Faults as they come and go: what `faults.json` holds.

use serde::Serialize;

use super::{Fault, FaultConfig, Finding, Reaction, Verdict, explains, isolate, policy};
use crate::sensor::Stamp;

/// A fault from its begin to its end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Episode {
    /// Estimated begin, s.
    pub begin: f64,
    /// When it was named, s.
    pub named: f64,
    /// When it last was seen, s; of the last episodes of a log where it ends.
    pub end: f64,
    pub fault: Fault,
    /// Largest value of the test statistic, as a multiple of its threshold.
    pub statistic: f64,
    pub reaction: Reaction,
}

/// A fault that has just been named.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    pub fault: Fault,
    pub reaction: Reaction,
    pub since: Stamp,
    pub statistic: f64,
}

/// Names faults and keeps the record of them.
#[derive(Debug, Clone)]
pub struct FaultRecord {
    config: FaultConfig,
    /// Episodes that go on, with the time at which each was last seen.
    open: Vec<(Stamp, Episode)>,
    closed: Vec<Episode>,
    /// Confirmed, but suspected to be symptoms of something else; since when.
    held: Vec<(Stamp, Finding)>,
}

impl FaultRecord {
    pub fn new(config: &FaultConfig) -> Self {
        let config = config.clone();
        Self { config, open: Vec::new(), closed: Vec::new(), held: Vec::new() }
    }

    /// Episodes so far, those that go on last.
    pub fn episodes(&self) -> Vec<Episode> {
        self.closed.iter().copied().chain(self.open.iter().map(|(_, episode)| *episode)).collect()
    }

    /// Whether a fault of this kind goes on.
    pub fn is_open(&self, fault: &Fault) -> bool {
        self.open.iter().any(|(_, episode)| episode.fault.is_kind_of(fault))
    }

    /// Takes note of what the monitors say now; gives the fault that is named now, if any.
    pub fn observe(&mut self, at: Stamp, verdicts: &[Verdict]) -> Option<Decision> {
        for finding in verdicts.iter().filter_map(Verdict::confirmed) {
            self.prolong(at, finding);
        }
        self.close_quiet(at);
        for finding in verdicts.iter().filter_map(Verdict::confirmed) {
            let known = self.is_open(&finding.fault) || self.is_symptom(&finding.fault);
            let held = |held: &(Stamp, Finding)| held.1.fault.is_kind_of(&finding.fault);
            if !known && !self.held.iter().any(held) {
                self.held.push((at, *finding));
            }
        }
        let finding = self.isolated(at, verdicts)?;
        let Finding { fault, since, statistic } = finding;
        let reaction = policy(&fault);
        let (begin, now) = (since.seconds(), at.seconds());
        let episode = Episode { begin, named: now, end: now, fault, statistic, reaction };
        self.open.push((at, episode));
        self.held
            .retain(|(_, held)| !held.fault.is_kind_of(&fault) && !explains(&fault, &held.fault));
        Some(Decision { fault, reaction, since, statistic })
    }

    /// What is named of that which is held: a cause, or a symptom that has waited for one in vain.
    fn isolated(&self, at: Stamp, verdicts: &[Verdict]) -> Option<Finding> {
        let confirmed = || self.held.iter().map(|(_, finding)| Verdict::Confirmed(*finding));
        let suspected = verdicts.iter().filter(|v| matches!(v, Verdict::Suspected(_))).copied();
        let all: Vec<_> = confirmed().chain(suspected).collect();
        isolate(&all).or_else(|| {
            let waited = |(since, _): &(Stamp, Finding)| {
                at.seconds_since(*since) >= self.config.isolation_time
            };
            self.held.iter().any(waited).then(|| isolate(&confirmed().collect::<Vec<_>>()))?
        })
    }

    fn prolong(&mut self, at: Stamp, finding: &Finding) {
        let same = |(_, episode): &&mut (Stamp, Episode)| episode.fault.is_kind_of(&finding.fault);
        if let Some((last, episode)) = self.open.iter_mut().find(same) {
            *last = at.max(*last);
            episode.end = last.seconds();
            episode.statistic = episode.statistic.max(finding.statistic);
        }
    }

    /// Ends all that goes on: what comes now is by another clock.
    pub fn close(&mut self) {
        self.closed.extend(self.open.drain(..).map(|(_, episode)| episode));
        self.held.clear();
    }

    fn close_quiet(&mut self, at: Stamp) {
        let quiet = self.config.quiet_time;
        let over = |last: &Stamp| at.seconds_since(*last) > quiet;
        self.closed.extend(self.open.iter().filter(|(last, _)| over(last)).map(|(_, e)| *e));
        self.open.retain(|(last, _)| !over(last));
    }

    /// Whether a fault that goes on, or has just ended, explains this one.
    fn is_symptom(&self, fault: &Fault) -> bool {
        self.open.iter().any(|(_, episode)| explains(&episode.fault, fault))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Stamp {
        Stamp::default().offset_by(seconds)
    }

    fn confirmed(fault: Fault) -> Verdict {
        Verdict::Confirmed(Finding { fault, since: at(0.5), statistic: 1.2 })
    }

    fn suspected(fault: Fault) -> Verdict {
        Verdict::Suspected(Finding { fault, since: at(0.5), statistic: 0.5 })
    }

    fn record() -> FaultRecord {
        FaultRecord::new(&FaultConfig::default())
    }

    #[test]
    fn a_fault_is_named_once_an_episode() {
        let mut record = record();
        let named: Vec<_> = (0..100)
            .filter(|k| {
                let now = at(f64::from(*k) * 0.1);
                let on = (10..20).contains(k) || (25..30).contains(k) || *k == 70;
                let verdicts = if on { vec![confirmed(Fault::Darkness)] } else { vec![] };
                record.observe(now, &verdicts).is_some()
            })
            .collect();
        assert_eq!(named, [10, 70]);
        let [first, second] = record.episodes()[..] else { panic!("{:?}", record.episodes()) };
        assert_eq!((first.begin, first.named), (0.5, 1.0));
        assert!((first.end - 2.9).abs() < 1e-9);
        assert_eq!((first.reaction, second.end), (Reaction::Relocalise, 7.0));
    }

    #[test]
    fn a_symptom_waits_for_its_cause() {
        let jump = Fault::ClockJump { offset: 0.05 };
        let mut record = record();
        let both = [suspected(jump), confirmed(Fault::BiasStep)];
        assert_eq!(record.observe(at(1.0), &both), None);
        let named = record.observe(at(1.1), &[confirmed(jump)]).unwrap();
        assert_eq!((named.fault, named.reaction), (jump, Reaction::Retime));
        // It was a symptom, and is while the cause is fresh.
        assert_eq!(record.observe(at(1.6), &[confirmed(Fault::BiasStep)]), None);
        assert_eq!(record.observe(at(3.0), &[]), None);
        assert!(record.observe(at(3.1), &[confirmed(Fault::BiasStep)]).is_some());
    }

    #[test]
    fn a_symptom_whose_cause_is_never_confirmed_is_named_itself() {
        let jump = Fault::ClockJump { offset: 0.05 };
        let mut record = record();
        assert_eq!(record.observe(at(1.0), &[suspected(jump), confirmed(Fault::BiasStep)]), None);
        assert_eq!(record.observe(at(1.2), &[suspected(jump)]), None);
        assert_eq!(record.observe(at(1.5), &[suspected(jump)]).unwrap().fault, Fault::BiasStep);
    }
}
