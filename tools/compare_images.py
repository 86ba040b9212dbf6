#!/usr/bin/env python3
"""Plot statistics of images and of their ORB matches, one color a log.

    python3 -m venv logs && logs/bin/pip install mcap==1.6.0 mcap-ros2-support==0.6.0 numpy matplotlib
    target/debug/mfg-vio simulate --config datasets/lab-motion.toml --duration 9 --out lab.mcap
    logs/bin/python tools/compare_images.py lab.mcap ../shared/data/tum_fr1_rpy --out statistics.png

Left: distribution of the brightness gradient (central differences). Right: cumulative distributions
over the frames of a replay of the features a frame, of the part of them that matches a map point,
and of the part of the matches that agrees on one pose.
"""

import argparse
import csv
import pathlib
import subprocess
import tempfile

import matplotlib
import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

# One image in this many is looked at.
STRIDE = 10
BINS = np.geomspace(0.5, 200, 60)


def gradients(log):
    """Histogram over BINS of the gradient's magnitude, grey levels a pixel."""
    counts, pixels = np.zeros(len(BINS) - 1), 0
    with open(log, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        images = reader.iter_decoded_messages(topics=["/cam0/color"])
        for number, (_, _, _, image) in enumerate(images):
            if number % STRIDE:
                continue
            grey = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, -1).mean(2)
            slope = np.hypot(*(0.5 * (a - b) for a, b in [
                (grey[1:-1, 2:], grey[1:-1, :-2]), (grey[2:, 1:-1], grey[:-2, 1:-1])]))
            counts += np.histogram(slope, BINS)[0]
            pixels += slope.size
    return counts / pixels / np.diff(np.log(BINS))


def matches(binary, log, folder):
    run([binary, "replay", log, "--out", folder, "--no-recording"])
    with open(folder / "state.csv") as file:
        rows = list(csv.DictReader(file))
    column = lambda name: np.array([float(row[name]) for row in rows])
    features, matched, inliers = column("features"), column("matches"), column("inliers")
    return {
        "features a frame": features,
        "matches / features": matched / np.maximum(features, 1),
        "inliers / matches": inliers / np.maximum(matched, 1),
    }


def run(command):
    subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=pathlib.Path)
    parser.add_argument("--binary", default="target/debug/mfg-vio", type=pathlib.Path)
    parser.add_argument("--out", default="statistics.png", type=pathlib.Path)
    arguments = parser.parse_args()
    binary = arguments.binary.resolve()
    figure, axes = plt.subplots(1, 4, figsize=(17, 4))
    for log in arguments.logs:
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            converted = folder / "log.mcap"
            run([binary, "convert", log, converted])
            density = gradients(converted)
            axes[0].loglog(np.sqrt(BINS[1:] * BINS[:-1]), density, label=log.name)
            statistics = matches(binary, log, folder)
        print(f"{log.name}: mass of gradients above 10: "
              f"{np.sum((density * np.diff(np.log(BINS)))[BINS[:-1] > 10]):.3f}")
        for axis, (what, values) in zip(axes[1:], statistics.items()):
            axis.plot(np.sort(values), np.linspace(0, 1, len(values)), label=log.name)
            axis.set_xlabel(what)
            print(f"  {what}: median {np.median(values):.3f}")
    axes[0].set_xlabel("gradient, grey levels a pixel")
    axes[0].set_ylabel("density by logarithm")
    axes[1].set_ylabel("part of the frames")
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(arguments.out, dpi=110)
    print(arguments.out)


if __name__ == "__main__":
    main()
