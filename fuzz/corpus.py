#!/usr/bin/env python3
"""Make the corpus from which the fuzz targets start: small logs, whole, cut and with flipped bits.

    logs/bin/python fuzz/corpus.py [--binary target/debug/mfg-vio]    # packages: tools/check_logs.py
    cargo +nightly fuzz run bag -- -max_total_time=600 -rss_limit_mb=2048

Writes to fuzz/corpus/{bag,mcap,folder,scene}. Without a nightly toolchain `RUSTC_BOOTSTRAP=1` does.
"""

import argparse
import pathlib
import random
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
    write("scene", [recipe.read_bytes() for recipe in sorted((ROOT.parent / "datasets").glob("*.toml"))])


if __name__ == "__main__":
    main()
