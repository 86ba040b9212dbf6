//! The filters of `replay --filter`.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::config::MapTreatment;

/// The filters of `replay --filter`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FilterKind {
    Mfgd,
    Mfgr,
    #[default]
    Mfgs,
    Mekfd,
    Mekfr,
    Mekfs,
    Iekfs,
}

impl FilterKind {
    pub const ALL: [Self; 7] =
        [Self::Mfgr, Self::Mfgd, Self::Mfgs, Self::Mekfr, Self::Mekfd, Self::Mekfs, Self::Iekfs];

    pub fn name(self) -> &'static str {
        match self {
            Self::Mfgd => "mfgd",
            Self::Mfgr => "mfgr",
            Self::Mfgs => "mfgs",
            Self::Mekfd => "mekfd",
            Self::Mekfr => "mekfr",
            Self::Mekfs => "mekfs",
            Self::Iekfs => "iekfs",
        }
    }

    pub fn map_treatment(self) -> MapTreatment {
        match self {
            Self::Mfgd | Self::Mekfd => MapTreatment::Fixed,
            Self::Mfgr | Self::Mekfr => MapTreatment::Uncertain,
            Self::Mfgs | Self::Mekfs | Self::Iekfs => MapTreatment::Correlated,
        }
    }
}

impl fmt::Display for FilterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for FilterKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|kind| kind.name() == text).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|kind| kind.name()).collect();
            format!("unknown filter `{text}`; there are: {}", names.join(", "))
        })
    }
}
