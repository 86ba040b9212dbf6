#!/usr/bin/env python3
"""Convert a trial of the BROAD benchmark (HDF5) to CSV.

    tools/broad/trial.py 02_undisturbed_slow_rotation_B.hdf5 OUT_DIR

OUT_DIR receives `imu.csv`, which `mfg-vio attitude` reads (s, rad/s, m/s^2, tesla), and
`reference.csv`: time, quaternion of the optical reference (x, y, z, w; empty where the markers
were lost) and whether the sample belongs to the movement phase. Needs h5py and numpy.
"""

import argparse
import dataclasses
import pathlib

import h5py
import numpy as np


@dataclasses.dataclass
class Trial:
    """One recording. Arrays have one row a sample."""

    name: str
    rate: float  # Hz
    time: np.ndarray  # s
    gyr: np.ndarray  # rad/s
    acc: np.ndarray  # m/s^2
    mag: np.ndarray  # microtesla
    reference: np.ndarray  # quaternion w, x, y, z of world_from_body, world ENU; NaN where lost
    movement: np.ndarray  # bool


def read(path):
    path = pathlib.Path(path)
    with h5py.File(path) as file:
        rate = float(file.attrs["sampling_rate"])
        names = ("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "movement")
        gyr, acc, mag, reference, movement = (file[name][()] for name in names)
    time = np.arange(len(gyr)) / rate
    return Trial(path.stem, rate, time, gyr, acc, mag, reference, movement)


def write(trial, directory):
    directory = pathlib.Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    imu = np.column_stack([trial.time, trial.gyr, trial.acc, trial.mag * 1e-6])
    header = "t,gx,gy,gz,ax,ay,az,mx,my,mz"
    formats = ["%.9f"] + ["%.9g"] * 9
    np.savetxt(directory / "imu.csv", imu, formats, ",", header=header, comments="")
    with open(directory / "reference.csv", "w") as file:
        file.write("time,qx,qy,qz,qw,movement\n")
        for time, (w, x, y, z), moves in zip(trial.time, trial.reference, trial.movement):
            numbers = ["" if np.isnan(q) else f"{q:.9f}" for q in (x, y, z, w)]
            file.write(",".join([f"{time:.9f}", *numbers, str(int(moves))]) + "\n")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("trial", type=pathlib.Path)
    parser.add_argument("directory", type=pathlib.Path)
    arguments = parser.parse_args()
    write(read(arguments.trial), arguments.directory)


if __name__ == "__main__":
    main()
