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
example:
  tools/compare_peers --filters mfgr,mekfr --out peers-out ../shared/data/tum_fr1_rpy
"""
PEERS = ("orb-pnp", "open3d-hybrid")
COLUMNS = ("log", "estimator", "APE RMSE [m]", "matched", "frames", "lost", "ms/frame")


def names(text):
    return [name for name in text.split(",") if name]


def peer_names(text):
    for name in names(text):
        if name not in PEERS:
            raise argparse.ArgumentTypeError(f"no peer '{name}', there are {', '.join(PEERS)}")
    return names(text)


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
    parser.add_argument("--threads", type=int, default=1, metavar="N",
                        help="threads of each estimator (default: %(default)s)")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="one JSON object instead of the table")
    form.add_argument("--markdown", action="store_true", help="the table in Markdown")
    return parser.parse_args()


def cells(row):
    if row.error:
        return (row.log, row.estimator, "failed", "-", "-", "-", "-")
    return (row.log, row.estimator, f"{row.ape_rmse_m:.4f}", str(row.matched), str(row.frames),
            str(row.lost), f"{row.ms_per_frame:.1f}")


def print_table(rows, markdown):
    lines = [COLUMNS, *map(cells, rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(COLUMNS))]
    aligned = [[cell.ljust(width) if i < 2 else cell.rjust(width)
                for i, (cell, width) in enumerate(zip(line, widths))] for line in lines]
    if markdown:
        aligned.insert(1, ["-" * width if i < 2 else "-" * (width - 1) + ":"
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
    else:
        print_table(rows, arguments.markdown)
    sys.exit(any(row.error for row in rows))


if __name__ == "__main__":
    main()
