use anyhow::Context;
use clap::Args;
use nalgebra::{Rotation3, Vector3};
use serde::{Serialize, Serializer};

use super::terminal::print;
use mfg_vio::distribution::matrix_fisher::{MatrixFisher, Moments, s_from_d};
use mfg_vio::evaluation::Table;
use mfg_vio::so3::ProperSvd;

/// A matrix Fisher distribution at a glance: constant, moments, dispersion, observability.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  mfg-vio fisher 20 5 -1\n  mfg-vio fisher --moments 0.9 0.8 0.75"
)]
pub struct FisherArgs {
    /// Proper singular values of the parameter F = U S V^T: s1 >= s2 >= |s3|.
    #[arg(
        value_names = ["S1", "S2", "S3"],
        num_args = 3,
        allow_negative_numbers = true,
        required_unless_present = "moments",
        conflicts_with = "moments"
    )]
    s: Vec<f64>,
    /// Find S from the proper singular values of the mean E[R] (maximum likelihood).
    #[arg(long, value_names = ["D1", "D2", "D3"], num_args = 3, allow_negative_numbers = true)]
    moments: Option<Vec<f64>>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &FisherArgs) -> anyhow::Result<()> {
    let s = match &args.moments {
        Some(d) => s_from_d(&vector(d)).context("--moments")?,
        None => vector(&args.s),
    };
    let identity = Rotation3::identity();
    let fisher = MatrixFisher::from_svd(ProperSvd { u: identity, s, v: identity })?;
    let output = if args.json {
        serde_json::to_string(&Summary::of(fisher.moments()))?
    } else {
        text(&fisher)
    };
    print(&output)
}

fn vector(values: &[f64]) -> Vector3<f64> {
    Vector3::from_iterator(values.iter().copied())
}

/// The JSON object.
#[derive(Debug, Serialize)]
struct Summary {
    s: [f64; 3],
    log_c: f64,
    c_scaled: f64,
    first: [f64; 3],
    second: SecondMoments,
}

impl Summary {
    fn of(moments: &Moments) -> Self {
        Self {
            s: moments.singular_values().into(),
            log_c: moments.log_c(),
            c_scaled: moments.c_scaled(),
            first: moments.first().into(),
            second: SecondMoments::of(moments),
        }
    }
}

/// Rows and columns of the two factors, from 1.
const SECOND: [[usize; 4]; 12] = [
    [1, 1, 1, 1],
    [2, 2, 2, 2],
    [3, 3, 3, 3],
    [1, 1, 2, 2],
    [1, 1, 3, 3],
    [2, 2, 3, 3],
    [1, 2, 1, 2],
    [1, 2, 2, 1],
    [1, 3, 1, 3],
    [1, 3, 3, 1],
    [2, 3, 2, 3],
    [2, 3, 3, 2],
];

/// `E[Q_ij Q_kl]` of every pair that does not vanish, under names such as `Q12Q21`.
#[derive(Debug)]
struct SecondMoments([(String, f64); 12]);

impl SecondMoments {
    fn of(moments: &Moments) -> Self {
        Self(SECOND.map(|[i, j, k, l]| {
            let value = moments.second((i - 1, j - 1), (k - 1, l - 1));
            (format!("Q{i}{j}Q{k}{l}"), value)
        }))
    }
}

impl Serialize for SecondMoments {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(name, value)| (name, value)))
    }
}

fn text(fisher: &MatrixFisher) -> String {
    let moments = fisher.moments();
    let s = moments.singular_values();
    let mut facts = Table::new(["quantity", "value", ""]);
    let mut fact = |name: &str, value: String, remark: &str| {
        facts.push([name.to_owned(), value, remark.to_owned()]);
    };
    fact("log c(S)", digits(moments.log_c()), "");
    fact("c(S) exp(-tr S)", digits(moments.c_scaled()), "");
    fact("entropy", digits(fisher.entropy()), "nats; uniform: 0");
    let dispersion = fisher.angular_dispersion().to_degrees();
    fact("dispersion", digits(dispersion), "deg, root mean square angle from the mode");
    fact("observability", digits(fisher.observability()), "of 8, (d1 + d2)(d1 + d3)(d2 + d3)");

    let mut axes = Table::new(["axis", "s", "d = E[Qii]", "1 - d", "sd, deg", "dj + dk"]);
    let variances = fisher.rotation_covariance().diagonal();
    for i in 0..3 {
        axes.push([
            (i + 1).to_string(),
            digits(s[i]),
            digits(moments.first()[i]),
            digits(moments.complement()[i]),
            digits(variances[i].sqrt().to_degrees()),
            digits(fisher.observability_axes()[i]),
        ]);
    }

    let mut second = Table::new(["second moment", "value"]);
    for (name, value) in SecondMoments::of(moments).0 {
        let (first, other) = name.split_at(3);
        second.push([format!("E[{first} {other}]"), digits(value)]);
    }
    format!(
        "M(S), S = diag({}, {}, {}); mode: {}\n\n{}\n{}\n{}",
        s[0],
        s[1],
        s[2],
        mode(&s),
        facts.to_text(),
        axes.to_text(),
        second.to_text()
    )
}

/// Twelve significant digits.
fn digits(value: f64) -> String {
    if value != 0.0 && !(1e-3..1e9).contains(&value.abs()) {
        return format!("{value:.11e}");
    }
    let magnitude = if value == 0.0 { 0 } else { value.abs().log10().floor() as i32 };
    let decimals = (11 - magnitude).clamp(0, 14) as usize;
    format!("{value:.decimals$}")
}

/// Where the density of `Q = U^T R V` is largest.
fn mode(s: &Vector3<f64>) -> &'static str {
    match (s[1] + s[2] > 0.0, s[0] + s[2] > 0.0, s[0] > 0.0) {
        (true, ..) => "identity",
        (false, true, _) => "any turn about axis 1",
        (false, false, true) => "any turn about an axis orthogonal to axis 3",
        (false, false, false) => "none, the distribution is uniform",
    }
}
