"""Simulated recordings of an IMU and a magnetometer with what real ones are plagued by.

A drive is a motion under a condition; every sensor has white noise, residual bias, scale, axes and
iron, a delayed magnetometer and a field that varies from place to place, drawn anew for each seed
with the spread that calibrated sensors of consumer grade have. Data sheets are the source: noise
of gyroscopes 0.005 to 0.015 deg/s/sqrt(Hz), of accelerometers 100 to 250 ug/sqrt(Hz); scale and
axes to 0.5 %; 0.03 m/s^2 of accelerometer bias; iron to 2 %, soft iron to 1 % of the field.
"""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

RATE = 100.0  # Hz
SECONDS = 180.0
GRAVITY = 9.81
FIELD = 48.0 * np.array([0.0, 0.4, -0.9165])  # world ENU, microtesla

MOTIONS = ("sway", "hand", "fast", "carried", "car")
CONDITIONS = (
    "plain",
    "bias-1",
    "bias-2.5",
    "bias-4",
    "bias-8",
    "drift",
    "gaps",
    "clipped",
    "iron",
    "six-axis",
    "moving-start",
)


@dataclasses.dataclass
class Drive:
    """One recording. Arrays have one row a sample; the rows of `kept` were delivered."""

    name: str
    rate: float  # Hz
    time: np.ndarray  # s
    gyr: np.ndarray  # rad/s, mean since the sample before
    acc: np.ndarray  # m/s^2
    mag: np.ndarray | None  # microtesla
    reference: np.ndarray  # quaternion w, x, y, z of world_from_body, world ENU
    kept: np.ndarray  # bool


def cells():
    """Motions with the conditions that mean something for them."""
    quick = ("hand", "fast")
    return [(m, c) for m in MOTIONS for c in CONDITIONS if c != "clipped" or m in quick]


def simulate(motion, condition, seed):
    rng = np.random.default_rng([seed, MOTIONS.index(motion), CONDITIONS.index(condition)])
    time = np.arange(int(SECONDS * RATE)) / RATE
    begins = 0.0 if condition == "moving-start" else rng.uniform(2.0, 5.0)
    attitude, acceleration = MOVERS[motion](time, begins, rng)
    force = attitude.inv().apply(acceleration + [0, 0, GRAVITY])
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE
    rate = np.vstack([turns[:1], turns])
    gyr = measured(rate, rng, scale=0.005, bias=0.0, noise=np.radians(rng.uniform(0.005, 0.015)))
    gyr += gyro_bias(condition, time, rng)
    acc = measured(force, rng, scale=0.004, bias=0.03, noise=9.81e-6 * rng.uniform(100, 250))
    mag = None
    if condition != "six-axis":
        mag = magnetometer(attitude, rate, time, motion, condition, rng)
    if condition == "clipped":
        limit = np.quantile(np.abs(rate).max(1), 0.97)
        gyr = np.clip(gyr, -limit, limit)
    kept = delivered(condition, time, rng)
    reference = attitude.as_quat()[:, [3, 0, 1, 2]]
    name = f"{motion}/{condition}/{seed}"
    return Drive(name, RATE, time, gyr, acc, mag, reference, kept)


def measured(true, rng, scale, bias, noise):
    """With errors of scale, axes and bias, and white noise of a density."""
    matrix = np.eye(3) + rng.normal(0, scale, (3, 3))
    white = rng.normal(0, noise * np.sqrt(RATE), true.shape)
    return true @ matrix.T + rng.normal(0, bias, 3) + white


def gyro_bias(condition, time, rng):
    size = float(condition[5:]) if condition.startswith("bias-") else rng.uniform(0.1, 0.4)
    direction = rng.normal(size=3)
    bias = np.radians(size) * direction / np.linalg.norm(direction)
    # Bias instability: 3e-4 deg/s/sqrt(s); warming up: 0.3 deg/s in a minute or two.
    walk = np.cumsum(rng.normal(0, np.radians(3e-4) / np.sqrt(RATE), (len(time), 3)), 0)
    if condition == "drift":
        slope = rng.normal(0, np.radians(0.3), 3)
        walk += slope * -np.expm1(-time / rng.uniform(30, 120))[:, None]
        walk += np.cumsum(rng.normal(0, np.radians(5e-3) / np.sqrt(RATE), (len(time), 3)), 0)
    return bias + walk


def magnetometer(attitude, rate, time, motion, condition, rng):
    place = {"sway": 0.005, "hand": 0.015, "fast": 0.015, "carried": 0.03, "car": 0.03}[motion]
    correlation = {"car": 4.0}.get(motion, 2.0)
    varying = gaussian_filter1d(rng.normal(size=(len(time), 3)), correlation * RATE, axis=0)
    varying *= place / varying.std()
    still = np.linalg.norm(rate, axis=1) < 1e-9
    varying[still] = varying[np.argmin(still)]
    field = np.linalg.norm(FIELD) * varying + FIELD
    soft = np.eye(3) + rng.normal(0, 0.01, (3, 3))
    mag = attitude.inv().apply(field) @ soft.T + rng.normal(0, 0.02, 3) * 48.0
    late = rng.uniform(0.0, 0.015)
    mag = np.stack([np.interp(time - late, time, mag[:, i]) for i in range(3)], 1)
    if condition == "iron":
        direction = rng.normal(size=3)
        iron = rng.uniform(0.2, 1.5) * 48.0 * direction / np.linalg.norm(direction)
        mag[(time > 0.4 * SECONDS) & (time < 0.8 * SECONDS)] += iron
    return mag + rng.normal(0, 0.4, mag.shape)


def delivered(condition, time, rng):
    kept = np.ones(len(time), bool)
    if condition == "gaps":
        at = 12.0
        while at < SECONDS - 5:
            length = 10 ** rng.uniform(-1, np.log10(2.0))
            kept[(time > at) & (time < at + length)] = False
            at += length + rng.uniform(5, 15)
    return kept


def waves(time, begins, rng, band, deviation, count=8):
    """A sum of sinusoids of random frequencies in `band` (Hz, even in their logarithm), its
    standard deviation given, that grows out of rest, and its second derivative."""
    rad = 2 * np.pi * np.exp(rng.uniform(*np.log(band), count))
    phase = rng.uniform(0, 2 * np.pi, count)
    size = deviation * np.sqrt(2 / count)
    value = size * np.sin(np.outer(time, rad) + phase).sum(1)
    ramp = np.clip((time - begins) / 2, 0, 1) if begins > 0 else np.ones(len(time))
    value *= ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    return value, np.gradient(np.gradient(value, time), time)


def moved(angle_band, angles, place_band, place):
    """A mover with random turns (rad: yaw, pitch, roll) and shifts (m)."""

    def mover(time, begins, rng):
        euler = [waves(time, begins, rng, angle_band, a)[0] for a in angles]
        first = [rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5), rng.uniform(-1, 1)]
        attitude = Rotation.from_euler("ZYX", np.stack(euler, 1) + first)
        shifts = [waves(time, begins, rng, place_band, place)[1] for _ in range(3)]
        return attitude, np.stack(shifts, 1)

    return mover


def carried(time, begins, rng):
    """Walked about with: slow turns to anywhere, steps, and pauses of some seconds."""
    moving = np.zeros(len(time))
    at = begins
    while at < SECONDS:
        length = rng.uniform(10, 30)
        moving[(time >= at) & (time < at + length)] = 1.0
        at += length + rng.uniform(1, 6)
    smooth = gaussian_filter1d(moving, 0.3 * RATE)
    smooth[moving == 0] *= smooth[moving == 0] > 1e-3
    rates = gaussian_filter1d(rng.normal(size=(len(time), 3)), 0.5 * RATE, axis=0)
    rates *= np.radians([30, 30, 60]) / rates.std(0) * smooth[:, None]
    attitude = integrated(Rotation.from_rotvec(rng.normal(0, 0.5, 3)), rates)
    step = 2 * np.pi * rng.uniform(1.6, 2.1) * time
    bounce = np.stack([np.sin(step / 2), np.sin(step / 2 + 1), np.sin(step)], 1) * [1, 1, 2.5]
    speed = gaussian_filter1d(rng.normal(size=(len(time), 3)) * [1, 1, 0.2], 1.0 * RATE, axis=0)
    speed *= 0.8 / speed[:, 0].std() * smooth[:, None]
    return attitude, bounce * smooth[:, None] + np.gradient(speed, 1 / RATE, axis=0)


def integrated(first, rates):
    """Attitudes along body rates, rad/s."""
    steps = Rotation.from_rotvec(rates / RATE).as_quat()
    quaternions = np.empty((len(rates), 4))
    q = first.as_quat()
    for k, (x, y, z, w) in enumerate(steps):
        a, b, c, d = q
        q = np.array(
            [
                d * x + a * w + b * z - c * y,
                d * y - a * z + b * w + c * x,
                d * z + a * y - b * x + c * w,
                d * w - a * x - b * y - c * z,
            ]
        )
        q /= np.linalg.norm(q)
        quaternions[k] = q
    return Rotation.from_quat(quaternions)


def car(time, begins, rng):
    """Town and country: accelerations and curves that last seconds, and stops at lights."""
    acceleration, lateral, speed, at = np.zeros(len(time)), np.zeros(len(time)), 0.0, begins
    if begins == 0.0:
        speed = 10.0
    speeds = np.zeros(len(time))
    while at < SECONDS:
        goal = rng.choice([0.0, 8.0, 14.0, 22.0]) * rng.uniform(0.8, 1.2)
        change = rng.uniform(1.0, 2.8)
        length = abs(goal - speed) / change
        changes = (time >= at) & (time < at + length)
        acceleration[changes] = np.sign(goal - speed) * change
        at, speed = at + length, goal
        keeps = rng.uniform(3, 8) if goal == 0.0 else rng.uniform(4, 15)
        if goal > 0 and rng.uniform() < 0.7:
            begin = at + rng.uniform(0, 1)
            end = min(begin + rng.uniform(2, 12), at + keeps)
            lateral[(time >= begin) & (time < end)] = rng.choice([-1, 1]) * rng.uniform(0.5, 3.0)
        at += keeps
    acceleration = gaussian_filter1d(acceleration, 0.3 * RATE)
    lateral = gaussian_filter1d(lateral, 0.3 * RATE)
    start = 10.0 if begins == 0.0 else 0.0
    speeds = np.maximum(start + np.cumsum(acceleration) / RATE, 0.0)
    moves = np.clip(speeds / 2, 0, 1)
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(lateral / np.maximum(speeds, 3.0)) / RATE
    slope = gaussian_filter1d(rng.normal(size=len(time)), 5 * RATE)
    slope = np.cumsum(slope / slope.std() * np.radians(0.5) * moves) / RATE
    slope = np.radians(4) * np.tanh(slope / np.radians(4))
    shake = [waves(time, 0, rng, (0.8, 3.0), np.radians(0.4))[0] * moves for _ in range(2)]
    pitch = -slope - np.radians(0.6) * acceleration + shake[0]
    roll = np.radians(1.2) * lateral + shake[1]
    mounting = Rotation.from_rotvec(rng.normal(0, 0.3, 3))
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1)) * mounting
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
    left = np.stack([-np.sin(yaw), np.cos(yaw), 0 * yaw], 1)
    vibration = gaussian_filter1d(rng.normal(size=(len(time), 3)), 1.0, axis=0)
    vibration *= 0.6 / vibration.std() * (0.1 + 0.9 * moves[:, None])
    curve = lateral * speeds / np.maximum(speeds, 3.0)
    return attitude, ahead * acceleration[:, None] + left * curve[:, None] + vibration


MOVERS = {
    "sway": moved((0.1, 0.5), np.radians([4, 4, 4]), (0.1, 0.5), 0.05),
    "hand": moved((0.05, 0.5), np.radians([80, 25, 40]), (0.2, 1.5), 0.08),
    "fast": moved((0.1, 1.2), np.radians([90, 30, 60]), (0.3, 2.5), 0.08),
    "carried": carried,
    "car": car,
}
