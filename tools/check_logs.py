#!/usr/bin/env python3
"""Compare what mfg-vio reads and writes with the Python packages of the formats' authors.

    python3 -m venv logs && logs/bin/pip install mcap==1.6.0 mcap-ros2-support==0.6.0 rosbags==0.11.9
    logs/bin/python tools/check_logs.py [--binary target/debug/mfg-vio]

1. ROS 1 bags written by rosbags (chunks without compression, bz2, lz4) are converted by mfg-vio;
   mcap-ros2-support must read back the same messages: topics, log times, header stamps, content.
2. A log written by `mfg-vio simulate` is read through message by message; sizes, stamps, poses and
   transforms must agree with one another and with `mfg-vio info`.

Exit code 1 at the first difference.
"""

import argparse
import json
import pathlib
import subprocess
import tempfile

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(get_types_from_msg(
    "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
SCENE = """
duration = 1.0
start_time = 5645.18
[image]
width = 64
height = 48
[camera]
fx = 46.0
fy = 46.0
cx = 31.5
cy = 23.5
[room]
texel = 0.02
"""


def check(condition, *what):
    if not condition:
        raise SystemExit("check_logs: " + " ".join(map(str, what)))


def messages_of(random):
    """Topic, type, log time and message of a small recording with VCU-RVI's habits."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"]
    number = 0

    def header(t, frame):
        nonlocal number
        number += 1
        t = round(t * 1e9)
        time = stamp(sec=t // 10**9, nanosec=t % 10**9)
        return types["std_msgs/msg/Header"](seq=number, stamp=time, frame_id=frame)

    def vector(values):
        return types["geometry_msgs/msg/Vector3"](*map(float, values))

    def quaternion():
        q = random.normal(size=4)
        return types["geometry_msgs/msg/Quaternion"](*(q / np.linalg.norm(q)))

    def image(t, encoding, size):
        data = random.integers(0, 256, 12 * 10 * size, dtype=np.uint8)
        return types["sensor_msgs/msg/Image"](
            header(t, "camera"), 10, 12, encoding, 0, 12 * size, data)

    for k in range(60):
        t = 5645.18 + 0.01 * k
        log = round((t + 1.55e9) * 1e9) + int(random.integers(0, 10**6))
        yield "/imu", "sensor_msgs/msg/Imu", log, types["sensor_msgs/msg/Imu"](
            header(t, "imu"), quaternion(), random.normal(size=9), vector(random.normal(size=3)),
            random.normal(size=9), vector(random.normal(size=3)), random.normal(size=9))
        point = types["geometry_msgs/msg/Point"](*random.normal(size=3))
        pose = types["geometry_msgs/msg/Pose"](point, quaternion())
        yield "/truth", "geometry_msgs/msg/PoseStamped", log, types[
            "geometry_msgs/msg/PoseStamped"](header(t, "world"), pose)
        transform = types["geometry_msgs/msg/Transform"](vector(random.normal(size=3)), quaternion())
        stamped = types["geometry_msgs/msg/TransformStamped"](header(t, "world"), "imu", transform)
        yield "/tf", "tf2_msgs/msg/TFMessage", log, types["tf2_msgs/msg/TFMessage"]([stamped])
        if k % 3 == 0:
            yield "/cam0/color", "sensor_msgs/msg/Image", log, image(t, "8UC3", 3)
            yield "/cam0/depth", "sensor_msgs/msg/Image", log, image(t, "16UC1", 2)
            yield "/cam0/jpeg", "sensor_msgs/msg/CompressedImage", log, types[
                "sensor_msgs/msg/CompressedImage"](
                    header(t, "camera"), "jpeg", random.integers(0, 256, 77, dtype=np.uint8))
            roi = types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True)
            yield "/cam0/camera_info", "sensor_msgs/msg/CameraInfo", log, types[
                "sensor_msgs/msg/CameraInfo"](
                    header(t, "camera"), 10, 12, "plumb_bob", random.normal(size=5),
                    random.normal(size=9), random.normal(size=9), random.normal(size=12), 1, 2, roi)


def write_bag(path, compression):
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connections = {}
        for topic, kind, log, message in messages_of(np.random.default_rng(1)):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log, STORE.serialize_ros1(message, kind))


def read_bag(path):
    with Reader(path) as reader:
        for connection, log, data in reader.messages():
            yield connection.topic, log, STORE.deserialize_ros1(data, connection.msgtype)


def read_mcap(path):
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            yield channel.topic, message.log_time, decoded


def same(a, b, where):
    """Whether a message of rosbags and one of mcap-ros2-support are the same."""
    if hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            if name in ("seq", "__msgtype__"):
                continue
            same(getattr(a, name), getattr(b, name.lower()), f"{where}.{name}")
    elif isinstance(a, list):
        check(len(a) == len(b), where, "differs in length")
        for number, (left, right) in enumerate(zip(a, b)):
            same(left, right, f"{where}[{number}]")
    elif isinstance(a, np.ndarray):
        right = np.frombuffer(b, a.dtype) if isinstance(b, (bytes, memoryview)) else np.array(b)
        check(np.array_equal(a, right), where, "differs")
    else:
        # The one thing that is made plain: BGR images that VCU-RVI calls 8UC3.
        wanted = "bgr8" if where.endswith("encoding") and a == "8UC3" else a
        check(wanted == b, where, a, b)


def check_bags(binary, folder):
    for compression in [None, "BZ2", "LZ4"]:
        bag = folder / f"{compression}.bag"
        write_bag(bag, compression)
        converted = bag.with_suffix(".mcap")
        run([binary, "convert", bag, converted])
        count = 0
        for left, right in zip(read_bag(bag), read_mcap(converted), strict=True):
            check(left[:2] == right[:2], bag.name, left[:2], right[:2])
            same(left[2], right[2], left[0])
            count += 1
        print(f"bag, compression {compression}: {count} messages agree")


def check_simulated(binary, folder):
    scene, log = folder / "scene.toml", folder / "simulated.mcap"
    scene.write_text(SCENE)
    run([binary, "simulate", "--config", scene, "--out", log])
    counts, last_pose, stamps = {}, None, {}
    for topic, log_time, message in read_mcap(log):
        counts[topic] = counts.get(topic, 0) + 1
        if topic in ("/tf", "/tf_static"):
            message = message.transforms[0]
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        check(stamp == log_time, topic, "stamp", stamp, "logged at", log_time)
        check(stamp >= stamps.get(topic, 0), topic, "goes back in time")
        stamps[topic] = stamp
        if topic in ("/cam0/color", "/cam0/depth"):
            size = {"/cam0/color": ("rgb8", 3), "/cam0/depth": ("16UC1", 2)}[topic]
            check((message.encoding, message.step // message.width) == size, topic, message.encoding)
            check(len(message.data) == message.height * message.step, topic, "size")
        elif topic == "/cam0/camera_info":
            check((message.width, message.height, message.k[0]) == (64, 48, 46.0), topic)
        elif topic == "/imu":
            force = message.linear_acceleration
            norm = np.linalg.norm([force.x, force.y, force.z])
            check(5 < norm < 15, topic, norm)
        elif topic == "/truth/pose":
            last_pose = message.pose
        elif topic == "/tf":
            left, right = message.transform, last_pose
            check(left.translation.x == right.position.x, topic, "differs from the pose")
            check(left.rotation.w == right.orientation.w, topic, "differs from the pose")
    info = json.loads(run([binary, "info", log, "--json"]))
    told = {topic: value["messages"] for topic, value in info["topics"].items()}
    check(told == counts, "info counts", told, "but there are", counts)
    check(info["verdict"]["fit"], info["verdict"]["text"])
    print(f"simulated log: {sum(counts.values())} messages on {len(counts)} topics read back")


def run(command):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    check(done.returncode == 0, *command, done.stderr)
    return done.stdout


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", default="target/debug/mfg-vio", type=pathlib.Path)
    binary = parser.parse_args().binary.resolve()
    with tempfile.TemporaryDirectory() as folder:
        check_bags(binary, pathlib.Path(folder))
        check_simulated(binary, pathlib.Path(folder))


if __name__ == "__main__":
    main()
