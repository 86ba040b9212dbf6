#!/usr/bin/env python3
"""Make the corpus from which the fuzz targets start: small logs, whole, cut and with flipped bits.

    logs/bin/python fuzz/corpus.py [--binary target/debug/mfg-vio]    # packages: tools/check_logs.py
    cargo +nightly fuzz run bag -- -max_total_time=600 -rss_limit_mb=2048

Writes to fuzz/corpus/{bag,database,folder,image,layout,mcap,nmea,scene}. Without a nightly toolchain `RUSTC_BOOTSTRAP=1` does.
"""

import argparse
import pathlib
import random
import sqlite3
import struct
import subprocess
import sys
import tempfile
import zlib

ROOT = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT.parent / "tools"))
import check_logs  # noqa: E402


def png(depth, color_type, pixel):
    """The file of an image of one pixel."""
    def chunk(name, data):
        body = name + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))
    head = struct.pack(">IIBBBBB", 1, 1, depth, color_type, 0, 0, 0)
    data = zlib.compress(b"\0" + pixel)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def variants(data, rng):
    """The whole, cuts at random places, and copies with a few flipped bits."""
    yield data
    for _ in range(12):
        yield data[: rng.randrange(len(data))]
    for _ in range(24):
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        yield bytes(damaged)


def write(target, seeds):
    folder = ROOT / "corpus" / target
    folder.mkdir(parents=True, exist_ok=True)
    rng = random.Random(1)
    count = 0
    for seed in seeds:
        for variant in variants(seed, rng):
            (folder / f"{count:04}").write_bytes(variant)
            count += 1
    print(f"{folder}: {count} files")


def bags(folder):
    for compression in [None, "BZ2", "LZ4"]:
        path = folder / f"{compression}.bag"
        check_logs.write_bag(path, compression)
        yield path


def database():
    """A ROS 2 bag with one message."""
    path = pathlib.Path(tempfile.mkdtemp()) / "log.db3"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        connection.execute("INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu', 'cdr')")
        connection.execute("INSERT INTO messages VALUES (1, 1, 5, ?)", (bytes([0, 1]) + bytes(338),))
    connection.close()
    return path.read_bytes()


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", default="target/debug/mfg-vio", type=pathlib.Path)
    binary = parser.parse_args().binary.resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        logs = list(bags(folder))
        write("bag", [log.read_bytes() for log in logs])
        converted = folder / "converted.mcap"
        subprocess.run([binary, "convert", logs[0], converted], check=True)
        scene, simulated = folder / "scene.toml", folder / "simulated.mcap"
        scene.write_text(check_logs.SCENE.replace("1.0", "0.1").replace("= 64", "= 16"))
        subprocess.run([binary, "simulate", "--config", scene, "--out", simulated], check=True)
        write("mcap", [converted.read_bytes(), simulated.read_bytes()])
    lists = "0.1 a\n0.2 a\n\0" "0.1 a\n0.21 a\n\0" "0.1 1 2 3 0 0 0 1\n0.15 1 2 3 0.5 0.5 0.5 0.5\n\0"
    write("folder", [lists.encode() + image for image in (png(8, 2, b"abc"), png(16, 0, b"ab"))])
    deep, color = png(16, 0, b"ab"), png(8, 2, b"abc")
    images = [bytes([kind, 2, 2]) + bytes(range(32)) for kind in range(12)]
    images += [bytes([kind, 0, 0]) + data for kind, data in (
        (12, color), (13, deep), (14, bytes(12) + deep), (17, struct.pack("<iff", 0, 10100, -1009) + deep),
        (15, bytes(12) + struct.pack("<III", 3, 2, 0x23C24510)))]
    write("image", images)
    write("nmea", [b"GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,\n"
                   b"GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W\n"
                   b"GNGST,123520.00,1.0,,,,0.02,0.03,0.05"])
    rows = "1000000000,a\n"
    layouts = [
        b"\0" + b"\0".join(text.encode() for text in (
            "0.1 a\n", "0.1 a\n", "0.1 1 2 3\n", "0.1 1 2 3\n", "0.1 1 2 3 0 0 0 1\n",
            "\nd400_color_optical_frame:\n intrinsics:\n  data: [1, 2, 3, 4]\n "
            "distortion_coefficients:\n  data: [0, 0, 0, 0, 0]\n",
            "parent_frame: d400_color_optical_frame\nchild_frame: d400_gyroscope\n"
            "data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n")),
        b"\1" + b"\0".join((b"1,0,1\n0,1,1\n0,0,1", b"0.1,0,1,2,3,0,0,0,1\n", b"0.1,0,-1,0,1,2,3\n", color, deep)),
        b"\2" + b"\0".join((rows.encode(), rows.encode(), b"", b"1000000000,1,2,3,4,5,6\n",
                            b"1000000000,1,2,3,1,0,0,0\n", color)),
        b"\3" + b"\0".join((b"a:\n  relative_file_paths:\n  - a_0.mcap\n", b"\x89MCAP0\r\n", b""))]
    write("layout", layouts)
    write("database", [database()])
    write("scene", [recipe.read_bytes() for recipe in sorted((ROOT.parent / "datasets").glob("*.toml"))])


if __name__ == "__main__":
    main()
