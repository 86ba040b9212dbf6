"""Compares the orientation error of mfg-vio with that of vqf, Madgwick and Mahony on simulated drives.

    cargo build --release --no-default-features
    tools/compare_drives --binary target/release/mfg-vio [--seeds N] [--filter NAME]

A cell is a motion under a condition (see drives.py); its error is the root mean square over its
seeds, from 5 s on, of the total error without its mean heading. Every filter has one setting for
all: ours its defaults, the others those of the packages. They are built for a fixed rate, so that
they are given gaps filled in by straight lines; ours is given what was delivered. NEES is that of
the attitude per degree of freedom under the covariance that we report; without a magnetometer, of
the inclination.
"""

import argparse
import concurrent.futures
import json
import pathlib
import subprocess
import sys
import tempfile
import types

import drives
import numpy as np
from compare import RIVALS, ROOT, errors, rival
from scipy.spatial.transform import Rotation

BEGIN = 5.0  # s
COVARIANCE = [f"rotation_cov_{axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]


def error(estimate, drive):
    used = drive.kept & (drive.time >= BEGIN)
    return errors(estimate, types.SimpleNamespace(movement=used, reference=drive.reference))[0]


def filled(drive):
    """What rivals are given: gyroscope, accelerometer and magnetometer without gaps."""

    def fill(readings):
        known = drive.time[drive.kept]
        columns = [np.interp(drive.time, known, column) for column in readings[drive.kept].T]
        return np.stack(columns, 1)

    return [None if a is None else fill(a) for a in (drive.gyr, drive.acc, drive.mag)]


def ours(binary, name, drive):
    """Estimates (w, x, y, z) and covariances of the body-frame rotation vector; NaN where none."""
    columns = [a[drive.kept] for a in (drive.gyr, drive.acc, drive.mag) if a is not None]
    header = "t,gx,gy,gz,ax,ay,az" + ("" if drive.mag is None else ",mx,my,mz")
    table = np.column_stack([drive.time[drive.kept], *columns])
    with tempfile.TemporaryDirectory() as folder:
        log = pathlib.Path(folder) / "imu.csv"
        np.savetxt(log, table, "%.9g", ",", header=header, comments="")
        command = [binary, "attitude", log, "--filter", name, "--out", folder, "--json"]
        run = subprocess.run([str(a) for a in command], capture_output=True, text=True)
        if run.returncode != 0:
            sys.exit(f"{name} on {drive.name}: {run.stderr.strip()}")
        result = np.genfromtxt(pathlib.Path(folder) / "attitude.csv", delimiter=",", names=True)
    rows = np.rint(result["time"] * drive.rate).astype(int)
    estimate = np.full((len(drive.time), 4), np.nan)
    estimate[rows] = np.stack([result[q] for q in ("qw", "qx", "qy", "qz")], 1)
    covariance = np.full((len(drive.time), 3, 3), np.nan)
    upper = np.stack([result[name] for name in COVARIANCE], 1)
    covariance[rows] = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return estimate, covariance


def nees(estimate, covariance, drive):
    used = drive.kept & (drive.time >= BEGIN) & np.isfinite(estimate).all(1)
    found = Rotation.from_quat(estimate[used][:, [1, 2, 3, 0]])
    truth = Rotation.from_quat(drive.reference[used][:, [1, 2, 3, 0]])
    deviation = (found.inv() * truth).as_rotvec()
    covariance = covariance[used]
    if drive.mag is None:
        level = np.stack([found.inv().apply(axis) for axis in np.eye(3)[:2]], 1)
        deviation = np.einsum("nij,nj->ni", level, deviation)
        covariance = np.einsum("nij,njk,nlk->nil", level, covariance, level)
    whitened = np.einsum("ni,nij,nj->n", deviation, np.linalg.inv(covariance), deviation)
    return float(np.mean(whitened) / deviation.shape[1])


def one(binary, name, motion, condition, seed):
    drive = drives.simulate(motion, condition, seed)
    estimate, covariance = ours(binary, name, drive)
    readings = filled(drive)
    row = {"motion": motion, "condition": condition, "seed": seed, name: error(estimate, drive)}
    row |= {other: error(rival(other, *readings, drive.rate), drive) for other in RIVALS}
    return row | {"nees": nees(estimate, covariance, drive)}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--binary", type=pathlib.Path, default=ROOT / "target/release/mfg-vio")
    parser.add_argument("--filter", default="mfgba")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--motion", choices=drives.MOTIONS, help="only this one")
    parser.add_argument("--condition", choices=drives.CONDITIONS, help="only this one")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead")
    arguments = parser.parse_args()
    if not arguments.binary.is_file():
        parser.error(f"{arguments.binary} is not there; build it or name it with --binary")
    cells = [
        (motion, condition)
        for motion, condition in drives.cells()
        if arguments.motion in (None, motion) and arguments.condition in (None, condition)
    ]
    work = [(*cell, seed) for cell in cells for seed in range(arguments.seeds)]
    with concurrent.futures.ProcessPoolExecutor(arguments.jobs) as pool:
        rows = list(
            pool.map(one, *zip(*[(arguments.binary, arguments.filter, *task) for task in work]))
        )
    if arguments.json:
        print(json.dumps({"filter": arguments.filter, "rows": rows}))
    else:
        show(rows, cells, arguments.filter)


def show(rows, cells, name):
    filters = (name, *RIVALS)
    print(f"{'RMSE in degrees':22}" + "".join(f"{f:>10}" for f in filters) + "  to best  NEES")
    table, ratios = [], []
    for cell in cells:
        mine = [row for row in rows if (row["motion"], row["condition"]) == cell]
        rms = [float(np.sqrt(np.mean([row[f] ** 2 for row in mine]))) for f in filters]
        ratio = rms[0] / min(rms[1:])
        table.append(rms)
        ratios.append(ratio)
        consistency = np.mean([row["nees"] for row in mine])
        numbers = "".join(f"{x:10.2f}" for x in rms)
        print(f"{'/'.join(cell):22}{numbers}{ratio:9.2f}{consistency:6.2f}")
    print(f"{'mean':22}" + "".join(f"{x:10.2f}" for x in np.mean(table, 0)))
    won = sum(ratio <= 1 for ratio in ratios)
    print(f"{name} is best in {won} of {len(cells)} cells, at most {max(ratios):.2f} times the best")


if __name__ == "__main__":
    main()
