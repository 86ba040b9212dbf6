"""Compares the orientation error of mfg-vio on BROAD with that of vqf, Madgwick and Mahony.

    cargo build --release --no-default-features
    tools/compare_broad --binary target/release/mfg-vio [--filter NAME ...] [TRIAL.hdf5 ...]

Errors are those of BROAD's authors: of the error quaternion `e = estimate reference^-1` in the
world, the whole angle (total), the part about the vertical (heading) and what remains
(inclination); root mean squares in degrees over the movement phase. The mean heading error is
taken out, since filters differ in what they call north. Every filter runs with one setting for
all trials: ours with its defaults, the others with those of the packages vqf and ahrs.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import ahrs
import numpy as np
import trial as broad
import vqf

ROOT = pathlib.Path(__file__).resolve().parents[2]
RIVALS = ("vqf", "Madgwick", "Mahony")
PARTS = ("total", "heading", "inclination")


def product(p, q):
    """Of quaternions w, x, y, z, row by row."""
    a, b, c, d = np.moveaxis(p, -1, 0)
    e, f, g, h = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        -1,
    )


def errors(estimate, trial):
    """RMS of total, heading and inclination error over the movement phase, degrees."""
    used = trial.movement & np.isfinite(trial.reference).all(1) & np.isfinite(estimate).all(1)
    inverse = trial.reference[used] * [1, -1, -1, -1]
    error = product(estimate[used], inverse)
    error /= np.linalg.norm(error, axis=1)[:, None]
    headings = 2 * np.arctan2(error[:, 3], error[:, 0])
    offset = np.angle(np.mean(np.exp(1j * headings)))
    w, x, y, z = product(np.array([np.cos(offset / 2), 0, 0, -np.sin(offset / 2)]), error).T
    angles = [
        2 * np.arccos(np.clip(np.abs(w), 0, 1)),
        2 * np.arctan2(np.abs(z), np.abs(w)),
        2 * np.arccos(np.clip(np.hypot(w, z), 0, 1)),
    ]
    return [float(np.degrees(np.sqrt(np.mean(angle**2)))) for angle in angles]


def ours(binary, name, trial):
    with tempfile.TemporaryDirectory() as folder:
        broad.write(trial, folder)
        log = pathlib.Path(folder) / "imu.csv"
        command = [binary, "attitude", log, "--filter", name, "--out", folder, "--json"]
        run = subprocess.run([str(a) for a in command], capture_output=True, text=True)
        if run.returncode != 0:
            sys.exit(f"{name} on {trial.name}: {run.stderr.strip()}")
        summary = json.loads(run.stdout)
        table = np.loadtxt(
            pathlib.Path(folder) / "attitude.csv", delimiter=",", skiprows=1, usecols=range(5)
        )
    estimate = np.full((len(trial.time), 4), np.nan)
    rows = np.rint(table[:, 0] * trial.rate).astype(int)
    estimate[rows] = table[:, [4, 1, 2, 3]]
    missing = int((trial.movement & ~np.isfinite(estimate).all(1)).sum())
    if missing:
        sys.exit(f"{name} on {trial.name}: no estimate at {missing} samples of the movement")
    print(
        f"{name} on {trial.name}: {summary['step_time_ns'] * 1e-3:.2f} us a sample, disturbed "
        f"{summary['disturbed_seconds']:.1f} s, at rest {summary['rest_seconds']:.1f} s",
        file=sys.stderr,
    )
    return estimate


def rival(name, gyr, acc, mag, rate):
    """Estimates (w, x, y, z) of another package's filter; without a magnetometer `mag` is None."""
    readings = {"gyr": gyr, "acc": acc, "mag": mag}
    readings = {k: np.ascontiguousarray(a) for k, a in readings.items() if a is not None}
    if name == "vqf":
        found = vqf.VQF(1 / rate).updateBatch(*readings.values())
        return found["quat6D" if mag is None else "quat9D"]
    return getattr(ahrs.filters, name)(frequency=rate, **readings).Q


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("trials", nargs="*", type=pathlib.Path, help="default: those of --data")
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/mfg-vio")
    parser.add_argument("--filter", action="append", help="repeatable [default: mfgba]")
    parser.add_argument("--data", type=pathlib.Path, default=ROOT / "../shared/data/broad")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    paths = arguments.trials or sorted(arguments.data.glob("*.hdf5"))
    if not paths:
        parser.error(f"no trials: {arguments.data} holds no .hdf5 file")
    if not arguments.binary.is_file():
        parser.error(f"{arguments.binary} is not there; build it or name it with --binary")
    names = arguments.filter or ["mfgba"]
    results = []
    for path in paths:
        trial = broad.read(path)
        estimates = {name: ours(arguments.binary, name, trial) for name in names}
        estimates |= {
            name: rival(name, trial.gyr, trial.acc, trial.mag, trial.rate) for name in RIVALS
        }
        for name, estimate in estimates.items():
            row = {"trial": trial.name, "filter": name}
            results.append(row | dict(zip(PARTS, errors(estimate, trial))))
    if arguments.json:
        print(json.dumps({"rows": results}))
    else:
        show(results, names)


def show(results, names):
    width = max(len(row["trial"]) for row in results)
    print(f"{'RMSE in degrees':{width}}  {'filter':9}" + "".join(f"{p:>13}" for p in PARTS))
    for row in results:
        numbers = "".join(f"{row[part]:13.2f}" for part in PARTS)
        print(f"{row['trial']:{width}}  {row['filter']:9}{numbers}")
    totals = {(row["trial"], row["filter"]): row["total"] for row in results}
    trials = sorted({row["trial"] for row in results})
    for name in names:
        for other in RIVALS:
            ratio = max(totals[trial, name] / totals[trial, other] for trial in trials)
            print(f"{name}: at most {ratio:.2f} times the total error of {other} on every trial")


if __name__ == "__main__":
    main()
