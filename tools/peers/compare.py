"""Compares mfg-vio with frame-to-frame RGB-D odometry over logs; run through tools/compare_peers."""

import argparse
import json
import os
import sys
from pathlib import Path

DESCRIPTION = """\
Runs RGB-D odometry over logs and prints one table of the absolute position error (RMSE of evo
after SE(3) alignment), the frames, and the wall time per frame with the reading of the log.

A LOG is a TUM RGB-D folder, a 7-Scenes folder, or a ROS 1 bag of the VCU-RVI kind with the truth
beside it: NAME_gt.tum of the IMU, and optionally NAME_gt_cam.tum of the camera.

peers (each from the previous frame alone, poses chained):
  orb-pnp        OpenCV: 1000 ORB features, cross-checked Hamming matches, depth of the previous
                 frame, solvePnPRansac; key points corrected for the lens
  open3d-hybrid  Open3D: compute_rgbd_odometry with the hybrid (color and depth) term;
                 lens distortion ignored
"""
EXAMPLE = """\
examples:
  tools/compare_peers --filters mfgr,mekfr --out peers-out ../shared/data/tum_fr1_rpy
  tools/compare_peers --grid --filters mfgs,mfgr,mfgd,mekfs,mekfr,mekfd --seeds 3 LOG...   # as in the README
"""
# APE RMSE (m) by log of an estimator that this tool does not run: monocular, given the true start.
GIVEN = {
    "openvins (given)": {
        "bumper1": 0.0122, "simple1": 0.0192, "motion1": 0.0406, "corridor1": 0.0241,
    },
}
PEERS = ("orb-pnp", "open3d-hybrid")
COLUMNS = ("log", "estimator", "APE RMSE [m]", "matched", "frames", "lost", "ms/frame")


def names(text):
    return [name for name in text.split(",") if name]


def peer_names(text):
    for name in names(text):
        if name not in PEERS:
            raise argparse.ArgumentTypeError(f"no peer '{name}', there are {', '.join(PEERS)}")
    return names(text)


def positive(text):
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not at least 1")
    return int(text)


def parse_arguments():
    parser = argparse.ArgumentParser(
        prog="tools/compare_peers", description=DESCRIPTION, epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", metavar="LOG", type=Path)
    parser.add_argument("--peers", type=peer_names, default=list(PEERS), metavar="LIST",
                        help="peers to run, comma separated ('' for none; default: all)")
    parser.add_argument("--filters", type=names, default=[], metavar="LIST",
                        help="filters of mfg-vio to run beside them (default: none)")
    parser.add_argument("--binary", type=Path, metavar="FILE",
                        help="the mfg-vio to run (default: the release build of this tree)")
    parser.add_argument("--out", type=Path, default=Path("peers-out"), metavar="DIR",
                        help="trajectories go to DIR/LOG/ESTIMATOR (default: %(default)s)")
    parser.add_argument("--seeds", type=positive, default=1, metavar="N",
                        help="mean of each filter over the seeds 1 to N (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, metavar="N",
                        help="threads of each estimator (default: %(default)s)")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    form.add_argument("--markdown", action="store_true", help="the table in Markdown")
    form.add_argument("--grid", action="store_true",
                      help="position errors alone in Markdown, one row a log and one column an "
                           "estimator, beside the given ones of OpenVINS, which is not run")
    return parser.parse_args()


def cells(row):
    if row.error:
        return (row.log, row.estimator, "failed", "-", "-", "-", "-")
    return (row.log, row.estimator, f"{row.ape_rmse_m:.4f}", str(row.matched), str(row.frames),
            str(row.lost), f"{row.ms_per_frame:.1f}")


def grid(rows):
    """Header and lines of position errors: a row a log, a column an estimator."""
    errors = {(row.log, row.estimator): "failed" if row.error else f"{row.ape_rmse_m:.4f}"
              for row in rows}
    logs = list(dict.fromkeys(row.log for row in rows))
    for estimator, given in GIVEN.items():
        errors |= {(log, estimator): f"{given[log]:.4f}" for log in logs if log in given}
    estimators = list(dict.fromkeys(estimator for _, estimator in errors))
    lines = [(log, *(errors.get((log, estimator), "-") for estimator in estimators))
             for log in logs]
    return [("log", *estimators), *lines]


def print_table(lines, names, markdown):
    """The first line is the header, the first `names` columns are text."""
    widths = [max(map(len, column)) for column in zip(*lines)]
    aligned = [[cell.ljust(width) if i < names else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(line, widths))] for line in lines]
    if markdown:
        aligned.insert(1, ["-" * width if i < names else "-" * (width - 1) + ":"
                           for i, width in enumerate(widths)])
    for line in aligned:
        print("| " + " | ".join(line) + " |" if markdown else "  ".join(line).rstrip())


def main():
    arguments = parse_arguments()
    # Read by the libraries when they are loaded, and by mfg-vio's OpenCV.
    for variable in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = str(arguments.threads)
    import runs  # only now: --help works without the Python environment, and threads are set

    try:
        rows = runs.compare(arguments)
    except runs.UsageError as error:
        sys.exit(f"compare_peers: {error}")
    if arguments.json:
        print(json.dumps(runs.summary(rows), indent=2))
    elif arguments.grid:
        print_table(grid(rows), 1, markdown=True)
    else:
        print_table([COLUMNS, *map(cells, rows)], 2, arguments.markdown)
    sys.exit(any(row.error for row in rows))


if __name__ == "__main__":
    main()
