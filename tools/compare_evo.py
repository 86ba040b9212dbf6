#!/usr/bin/env python3
"""Run `mfg-vio evaluate` and evo side by side and print by how much they differ.

    python3 -m venv evo && evo/bin/pip install evo==1.38.1
    cargo build --release
    evo/bin/python tools/compare_evo.py [--binary target/release/mfg-vio] [--data ../shared/data]

evo is called through its Python functions; the numbers are those that `--save_results` writes.
Differences are relative, with a floor of 1e-12 (m or deg) under the numbers compared, since an
error of zero is 1e-16 in the one program and 1e-17 in the other. Exit code 1 above `--tolerance`.
"""

import argparse
import copy
import csv
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from evo.core.metrics import PoseRelation, Unit
from evo.main_ape import ape
from evo.main_rpe import rpe
from evo.tools import file_interface

RELATIONS = {"trans": PoseRelation.translation_part, "angle": PoseRelation.rotation_angle_deg}
ALIGNMENTS = {
    "se3": {"align": True},
    "sim3": {"align": True, "correct_scale": True},
    "origin": {"align_origin": True},
    "none": {},
}
DELTAS = [("1", "f"), ("10", "f"), ("0.5", "m"), ("2", "m"), ("10", "deg"), ("45", "deg")]
UNITS = {"f": Unit.frames, "m": Unit.meters, "deg": Unit.degrees}
STATISTICS = ["rmse", "mean", "median", "std", "min", "max", "sse"]
FLOOR = 1e-12
# All pairs by angle are quadratic, and minutes in evo, above so many poses.
MAX_QUADRATIC = 1000


def read(path):
    """As evo reads it, by the layout of the first line of numbers."""
    with open(path) as file:
        line = next(line for line in file if not line.startswith("#"))
    if "," in line:
        return file_interface.read_euroc_csv_trajectory(path)
    if len(line.split()) == 12:
        return file_interface.read_kitti_poses_file(path)
    return file_interface.read_tum_trajectory_file(path)


def pairs_of(data):
    vcu = data / "vcu_rvi"
    with open(vcu / "ape_reference_evo.csv") as file:
        for row in csv.DictReader(file):
            method, sequence = row["method"], row["sequence"]
            estimate = vcu / "results" / method / f"{sequence}_tum.csv"
            if estimate.exists():
                yield f"{method} {sequence}", vcu / "ground_truths" / f"{sequence}_gt.csv", estimate
            else:
                print(f"skipped: {estimate} is not there", file=sys.stderr)
    yield "fr2_desk", data / "evo/fr2_desk_groundtruth.txt", data / "evo/fr2_desk_ORB.txt"
    yield "V102", data / "evo/V102_groundtruth.csv", data / "evo/V102.txt"


def ours(binary, command, reference, estimate, *flags):
    arguments = [binary, "evaluate", command, reference, estimate, "--json", *flags]
    run = subprocess.run([str(a) for a in arguments], capture_output=True, text=True)
    return json.loads(run.stdout) if run.returncode == 0 else None


def difference(stats, answer):
    if stats is None or answer is None:
        return 0.0 if stats is None and answer is None else float("inf")
    return max(
        abs(stats[name] - answer[name]) / max(abs(stats[name]), FLOOR)
        if max(abs(stats[name]), abs(answer[name])) > FLOOR
        else 0.0
        for name in STATISTICS
    )


def evo_stats(function, reference, estimate, *arguments, **options):
    try:
        return function(
            copy.deepcopy(reference), copy.deepcopy(estimate), *arguments, **options
        ).stats
    except Exception as error:  # evo's way to say that a case has no answer
        print(f"evo: {error}", file=sys.stderr)
        return None


def compare(binary, reference_path, estimate_path, max_diff):
    """Yields (case, evo's statistics, our answer)."""
    reference, estimate = read(reference_path), read(estimate_path)
    if hasattr(reference, "timestamps"):
        reference, estimate = reference.sync_with(estimate, max_diff=float(max_diff))
    files = (reference_path, estimate_path)
    tolerance = ("--max-diff", max_diff)
    for relation, evo_relation in RELATIONS.items():
        by_relation = ("--relation", relation, *tolerance)
        for name, options in ALIGNMENTS.items():
            stats = evo_stats(ape, reference, estimate, evo_relation, **options)
            yield f"ape {relation} {name}", stats, ours(
                binary, "ape", *files, "--align", name, *by_relation
            )
        stats = evo_stats(ape, reference, estimate, evo_relation, align=True, n_to_align=100)
        yield f"ape {relation} se3 n=100", stats, ours(
            binary, "ape", *files, "--align", "se3", "--align-n", "100", *by_relation
        )
        for delta, unit in DELTAS:
            for every in (False, True):
                if every and unit == "deg" and reference.num_poses > MAX_QUADRATIC:
                    continue
                stats = evo_stats(
                    rpe, reference, estimate, evo_relation,
                    delta=float(delta), delta_unit=UNITS[unit], all_pairs=every,
                )  # fmt: skip
                flags = ("--delta", delta, "--unit", unit, *(["--all-pairs"] if every else []))
                kind = "all" if every else "consecutive"
                yield f"rpe {relation} {delta} {unit} {kind}", stats, ours(
                    binary, "rpe", *files, "--align", "none", *flags, *by_relation
                )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = pathlib.Path(__file__).resolve().parent.parent
    parser.add_argument("--binary", default=here / "target/release/mfg-vio", type=pathlib.Path)
    parser.add_argument("--data", default=here / "../shared/data", type=pathlib.Path)
    parser.add_argument("--max-diff", default="0.01")
    parser.add_argument("--tolerance", default=1e-9, type=float)
    parser.add_argument("--only", default="", help="pairs whose name contains this")
    arguments = parser.parse_args()

    worst = {}
    with tempfile.TemporaryDirectory() as scratch:
        pairs = [p for p in pairs_of(arguments.data) if arguments.only in p[0]]
        pairs += kitti_pairs(arguments.data, pathlib.Path(scratch), arguments.only)
        for name, reference, estimate in pairs:
            cases = compare(arguments.binary, reference, estimate, arguments.max_diff)
            for case, stats, answer in cases:
                found = difference(stats, answer)
                if found > arguments.tolerance:
                    print(f"{name}: {case}: evo {stats}, ours {answer and [answer[s] for s in STATISTICS]}")
                worst.setdefault(case, []).append((found, name))
            print(f"done: {name}", file=sys.stderr)
    print(f"{'case':34}{'pairs':>6}{'largest relative difference':>30}  at")
    for case, found in worst.items():
        largest, name = max(found)
        print(f"{case:34}{len(found):6}{largest:30.2e}  {name}")
    return int(any(max(found)[0] > arguments.tolerance for found in worst.values()))


def kitti_pairs(data, scratch, only):
    """fr2_desk's matched poses as KITTI matrices."""
    if only not in "fr2_desk as KITTI":
        return []
    paths = [data / "evo/fr2_desk_groundtruth.txt", data / "evo/fr2_desk_ORB.txt"]
    reference, estimate = (read(path) for path in paths)
    reference, estimate = reference.sync_with(estimate)
    for file, trajectory in (("reference", reference), ("estimate", estimate)):
        rows = [np.asarray(pose)[:3].flatten() for pose in trajectory.poses_se3]
        np.savetxt(scratch / file, rows, fmt="%.17e")
    return [("fr2_desk as KITTI", scratch / "reference", scratch / "estimate")]


if __name__ == "__main__":
    sys.exit(main())
