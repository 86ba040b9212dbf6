//! What explains that the turns which images see are not those that the gyroscope feels.

use nalgebra::Vector3;

use super::Turn;

/// What explains the residuals `r = seen - felt` of the frames since a contradiction began.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Cause {
    /// `r = 0`: there was none.
    Nothing,
    /// `r(k) = e`, `r(k+1) = -e`: one attitude was wrong.
    WrongAttitude,
    /// `r(k) = e` and nothing after it: the body was turned unseen.
    Impulse,
    /// `r = -b T`: the bias has changed by `b` (rad/s).
    Bias(Vector3<f64>),
    /// `felt = c seen`: the gyroscope reads `c` times the turn.
    Scale(f64),
    /// `r = t (rate(k) - rate(k-1))`: the stamps are off by `t` (s).
    Clock(f64),
    /// `r` of any size: noise, or images that show something else.
    Anything,
}

/// A cause and how well it explains the residuals: `-2 ln` likelihood, with `ln(3 n)` for each of its
/// parameters (Schwarz 1978).
pub(super) type Explained = (Cause, f64);

/// The turns since a contradiction began, each with the variance of a component of its residual.
#[derive(Debug, Clone)]
pub(super) struct Contradiction {
    pub turns: Vec<(Turn, f64)>,
    /// Deviation of the gyroscope's bias, rad/s.
    pub gyro_bias_sd: f64,
}

impl Contradiction {
    /// `|r|^2 / v` that is surprising (chi-square, 3 degrees of freedom: 1e-8).
    pub const SURPRISING: f64 = 40.0;
    /// Most that one frame may count against a cause.
    pub const MOST: f64 = 60.0;
    /// A scale that calibration leaves open is no fault: twice, or half.
    const LEAST_SCALE: f64 = 2.0;
    /// Change of the bias that is a fault, in deviations of its prior.
    const LEAST_BIAS: f64 = 3.0;
    /// A turn of the body that is one, rad.
    const LEAST_IMPULSE: f64 = 0.05;
    /// A clock that is off by less does little harm, s.
    const LEAST_OFFSET: f64 = 0.01;

    /// All explanations, the best one first.
    pub fn explain(&self) -> [Explained; 7] {
        let mut explained = [
            (Cause::Nothing, self.cost(0, |_, turn| turn.residual())),
            self.wrong_attitude(),
            self.impulse(),
            self.biased(),
            self.scaled(),
            self.mistimed(),
            self.anything(),
        ];
        explained.sort_by(|a, b| a.1.total_cmp(&b.1));
        explained
    }

    fn parameter(&self) -> f64 {
        (3.0 * self.turns.len() as f64).ln()
    }

    /// Of what is left of the residuals by a cause with so many parameters.
    pub fn cost(&self, parameters: u32, left: impl Fn(usize, &Turn) -> Vector3<f64>) -> f64 {
        let squares =
            self.turns.iter().enumerate().map(|(k, (turn, variance))| {
                (left(k, turn).norm_squared() / variance).min(Self::MOST)
            });
        squares.sum::<f64>() + f64::from(parameters) * self.parameter()
    }

    /// The same of a cause that has to explain every frame: what leaves one surprising is no cause. One that
    /// `lasts` may have begun in the course of the first.
    fn full_cost(
        &self,
        lasts: bool,
        parameters: u32,
        left: impl Fn(usize, &Turn) -> Vector3<f64>,
    ) -> f64 {
        let frames = self.turns.iter().enumerate().skip(usize::from(lasts));
        let surprises = frames.filter(|(k, (turn, variance))| {
            left(*k, turn).norm_squared() > Self::SURPRISING * variance
        });
        if surprises.count() > 0 { f64::INFINITY } else { self.cost(parameters, left) }
    }

    fn wrong_attitude(&self) -> Explained {
        let residual =
            |k: usize| self.turns.get(k).map_or_else(Vector3::zeros, |(t, _)| t.residual());
        let costs = (0..self.turns.len()).map(|wrong| {
            let error = 0.5 * (residual(wrong) - residual(wrong + 1));
            self.cost(3, |k, turn| match k {
                _ if k == wrong => turn.residual() - error,
                _ if k == wrong + 1 => turn.residual() + error,
                _ => turn.residual(),
            })
        });
        (Cause::WrongAttitude, costs.fold(f64::INFINITY, f64::min))
    }

    fn impulse(&self) -> Explained {
        let large = |k: &usize| self.turns[*k].0.residual().norm() > Self::LEAST_IMPULSE;
        let costs = (0..self.turns.len()).filter(large).map(|hit| {
            self.full_cost(
                false,
                3,
                |k, turn| if k == hit { Vector3::zeros() } else { turn.residual() },
            )
        });
        (Cause::Impulse, costs.fold(f64::INFINITY, f64::min))
    }

    fn biased(&self) -> Explained {
        let (mut total, mut weight) = (Vector3::zeros(), 0.0);
        for (turn, variance) in &self.turns {
            total -= turn.residual() * (turn.seconds / variance);
            weight += turn.seconds.powi(2) / variance;
        }
        let bias: Vector3<f64> = total / weight;
        let cost = match bias.norm() > Self::LEAST_BIAS * self.gyro_bias_sd {
            true => self.full_cost(true, 3, |_, turn| turn.residual() + bias * turn.seconds),
            false => f64::INFINITY,
        };
        (Cause::Bias(bias), cost)
    }

    /// The errors are those of the turns seen where `c > 1`, and of the readings where it is not.
    fn scaled(&self) -> Explained {
        let sum = |of: fn(&Turn) -> f64| self.turns.iter().map(|(turn, _)| of(turn)).sum::<f64>();
        let (both, seen, felt) = (
            sum(|t| t.seen.dot(&t.felt)),
            sum(|t| t.seen.norm_squared()),
            sum(|t| t.felt.norm_squared()),
        );
        let scale = if felt > seen { felt / both } else { both / seen };
        let wrong = !(1.0 / Self::LEAST_SCALE..Self::LEAST_SCALE).contains(&scale);
        if !(wrong && scale > 0.0) {
            return (Cause::Scale(scale), f64::INFINITY);
        }
        let cost = match scale > 1.0 {
            true => self.full_cost(true, 1, |_, turn| turn.seen - turn.felt / scale),
            // A bias is not scaled with the readings that it was learned from.
            false => {
                self.full_cost(true, 1, |_, turn| (turn.felt - scale * turn.seen) / scale.max(0.05))
            }
        };
        (Cause::Scale(scale), cost)
    }

    fn mistimed(&self) -> Explained {
        let (mut along, mut weight) = (0.0, 0.0);
        for (turn, variance) in &self.turns {
            along += turn.residual().dot(&turn.rate_change) / variance;
            weight += turn.rate_change.norm_squared() / variance;
        }
        let offset = if weight > 0.0 { along / weight } else { 0.0 };
        let cost = match offset.abs() > Self::LEAST_OFFSET {
            true => self.full_cost(true, 1, |_, turn| turn.residual() - turn.rate_change * offset),
            false => f64::INFINITY,
        };
        (Cause::Clock(offset), cost)
    }

    fn anything(&self) -> Explained {
        let components = 3.0 * self.turns.len() as f64;
        let square = |(turn, variance): &(Turn, f64)| turn.residual().norm_squared() / variance;
        let mean = self.turns.iter().map(square).sum::<f64>() / components;
        (Cause::Anything, components * (1.0 + mean.max(1.0).ln()) + self.parameter())
    }
}
