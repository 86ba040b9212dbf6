"""Runs the peers and mfg-vio over logs, and takes every trajectory with the same evo call."""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import evo
import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

import logs
import odometry

MAX_DIFF = 0.01  # s, of the stamps of truth and estimate


class UsageError(Exception):
    """Nothing can be compared."""


@dataclasses.dataclass
class Row:
    log: str
    estimator: str
    ape_rmse_m: float | None = None
    matched: int | None = None  # poses with truth
    frames: int | None = None  # poses of the estimate
    lost: int | None = None  # frames at which a peer stood still for want of a motion
    ms_per_frame: float | None = None  # wall time, with the reading of the log
    trajectory: str | None = None
    error: str | None = None


def ape_rmse(truth, estimate):
    """RMSE of the position after SE(3) alignment, m, and the number of matched poses."""
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=MAX_DIFF)
    estimate.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    return ape.get_statistic(metrics.StatisticsType.rmse), truth.num_poses


def run_peer(name, log, folder, threads):
    start = time.perf_counter()
    peer = odometry.PEERS[name](log.camera, threads)
    pose, poses, stamps, lost = np.eye(4), [], [], 0
    for frame in log.frames():
        previous_from_current = peer.step(frame)
        if previous_from_current is not None:
            pose = pose @ previous_from_current
        elif poses:
            lost += 1
        poses.append(pose)
        stamps.append(frame.stamp)
    if not poses:
        raise logs.LogError(f"{log.path}: no frame with color and depth")
    seconds = time.perf_counter() - start

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.tum"
    estimate = PoseTrajectory3D(poses_se3=poses, timestamps=np.array(stamps))
    file_interface.write_tum_trajectory_file(path, estimate)
    rmse, matched = ape_rmse(log.camera_truth(), estimate)
    return Row(log.name, name, rmse, matched, len(poses), lost, 1e3 * seconds / len(poses), str(path))


def run_ours(binary, name, log, folder, threads, seeds):
    """Means over the seeds of RANSAC; the trajectory of the first."""
    rows = [run_seed(binary, name, log, folder, threads, seed) for seed in range(1, seeds + 1)]
    failed = [row for row in rows if row.error]
    if failed:
        return failed[0]
    means = {key: float(np.mean([getattr(row, key) for row in rows]))
             for key in ("ape_rmse_m", "ms_per_frame")}
    return dataclasses.replace(rows[0], **means)


def run_seed(binary, name, log, folder, threads, seed):
    estimator = f"mfg-vio {name}"
    out = folder / (f"mfg-vio-{name}" if seed == 1 else f"mfg-vio-{name}-{seed}")
    command = [binary, "replay", log.path, "--filter", name, "--seed", str(seed), "--out", out,
               "--threads", str(threads)]
    start = time.perf_counter()
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                          stderr=subprocess.PIPE, text=True, check=False)
    seconds = time.perf_counter() - start
    if done.returncode != 0:
        return Row(log.name, estimator, error=done.stderr.strip() or f"exit {done.returncode}")
    path = out / "trajectory.tum"
    estimate = file_interface.read_tum_trajectory_file(path)
    frames = estimate.num_poses
    rmse, matched = ape_rmse(log.body_truth(), estimate)
    return Row(log.name, estimator, rmse, matched, frames, 0, 1e3 * seconds / frames, str(path))


def release_binary():
    root = Path(__file__).resolve().parents[2]
    metadata = subprocess.run(["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=root,
                              stdout=subprocess.PIPE, check=True).stdout
    return Path(json.loads(metadata)["target_directory"], "release", "mfg-vio")


def compare(arguments):
    try:
        all_logs = [logs.open_log(path) for path in arguments.logs]
    except logs.LogError as error:
        raise UsageError(error) from error
    binary = None
    if arguments.filters:
        binary = (arguments.binary or release_binary()).resolve()
        if not binary.is_file():
            raise UsageError(f"{binary}: not there; run `cargo build --release` or give --binary")

    rows = []
    for log in all_logs:
        folder = arguments.out / log.name
        runs = [(name, lambda name=name: run_peer(name, log, folder, arguments.threads))
                for name in arguments.peers]
        runs += [(f"mfg-vio {name}",
                  lambda name=name: run_ours(binary, name, log, folder, arguments.threads,
                                             arguments.seeds))
                 for name in arguments.filters]
        for estimator, run in runs:
            print(f"compare_peers: {log.name}: {estimator}", file=sys.stderr, flush=True)
            rows.append(attempt(log.name, estimator, run))
            if rows[-1].error:
                print(f"compare_peers: {log.name}: {estimator}: {rows[-1].error}", file=sys.stderr)
    return rows


def attempt(log, estimator, run):
    """One failing estimator or unreadable truth must not cost the other rows."""
    try:
        return run()
    except (logs.LogError, OSError, file_interface.FileInterfaceException, sync.SyncException) as error:
        return Row(log, estimator, error=str(error))


def summary(rows):
    return {"metric": "APE translation RMSE", "alignment": "se3", "max_diff_s": MAX_DIFF,
            "evo": evo.__version__, "rows": [dataclasses.asdict(row) for row in rows]}
