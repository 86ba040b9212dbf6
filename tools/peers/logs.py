"""RGB-D logs with ground truth: TUM folders, 7-Scenes folders, ROS 1 bags of the VCU-RVI kind."""

import re
from pathlib import Path
from typing import Iterator, NamedTuple

import cv2
import numpy as np
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore


class LogError(Exception):
    """A log, or the truth of a log, cannot be read."""


class Frame(NamedTuple):
    stamp: float  # s
    color: np.ndarray  # BGR, 8 bit
    depth: np.ndarray  # m along the optical axis, 32-bit float, 0 where there is none


class Camera(NamedTuple):
    matrix: np.ndarray  # 3x3, pixels
    distortion: np.ndarray  # k1 k2 p1 p2 k3 of OpenCV


def pinhole(fx, fy, cx, cy, distortion=(0, 0, 0, 0, 0)):
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=float)
    return Camera(matrix, np.array(distortion, dtype=float))


def nearest_rotation(matrix):
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def read_image(path, flags):
    image = cv2.imread(str(path), flags)
    if image is None:
        raise LogError(f"{path}: not a readable image")
    return image


class TumLog:
    """https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""

    CAMERAS = {
        "1": pinhole(517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        "2": pinhole(520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
        "3": pinhole(535.4, 539.2, 320.1, 247.6),
    }
    DEFAULT_CAMERA = pinhole(525.0, 525.0, 319.5, 239.5)
    UNITS_PER_METER = 5000.0
    MAX_STAMP_DIFFERENCE = 0.02  # s, of color and depth

    def __init__(self, path: Path):
        self.path, self.name = path, path.resolve().name
        sensor = re.search(r"fr(?:eiburg)?([123])", self.name)
        self.camera = self.CAMERAS[sensor[1]] if sensor else self.DEFAULT_CAMERA

    def _list(self, name):
        lines = (self.path / name).read_text().splitlines()
        rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
        return np.array([float(row[0]) for row in rows]), [self.path / row[1] for row in rows]

    def frames(self) -> Iterator[Frame]:
        color_stamps, color_paths = self._list("rgb.txt")
        depth_stamps, depth_paths = self._list("depth.txt")
        for stamp, color_path in zip(color_stamps, color_paths):
            nearest = int(np.abs(depth_stamps - stamp).argmin())
            if abs(depth_stamps[nearest] - stamp) > self.MAX_STAMP_DIFFERENCE:
                continue
            depth = read_image(depth_paths[nearest], cv2.IMREAD_UNCHANGED)
            yield Frame(stamp, read_image(color_path, cv2.IMREAD_COLOR),
                        depth.astype(np.float32) / self.UNITS_PER_METER)

    def camera_truth(self):
        return file_interface.read_tum_trajectory_file(self.path / "groundtruth.txt")

    body_truth = camera_truth  # there is no gyroscope: the camera is the body


class SevenScenesLog:
    """https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes"""

    FRAMES_PER_SECOND = 30.0
    INVALID_DEPTH = 65535

    def __init__(self, path: Path):
        self.path, self.name = path, path.resolve().name
        self.camera = pinhole(585.0, 585.0, 320.0, 240.0)

    def _stamp(self, path):
        return int(re.match(r"frame-(\d+)", path.name)[1]) / self.FRAMES_PER_SECOND

    def frames(self) -> Iterator[Frame]:
        for color_path in sorted(self.path.glob("frame-*.color.*")):
            depth_path = color_path.with_name(color_path.name.split(".")[0] + ".depth.png")
            depth = read_image(depth_path, cv2.IMREAD_UNCHANGED)
            depth[depth == self.INVALID_DEPTH] = 0
            yield Frame(self._stamp(color_path), read_image(color_path, cv2.IMREAD_COLOR),
                        depth.astype(np.float32) / 1000)

    def camera_truth(self):
        paths = sorted(self.path.glob("frame-*.pose.txt"))
        poses = [np.loadtxt(path) for path in paths]
        for pose in poses:  # written with few digits
            pose[:3, :3] = nearest_rotation(pose[:3, :3])
        stamps = np.array([self._stamp(path) for path in paths])
        return PoseTrajectory3D(poses_se3=poses, timestamps=stamps)

    body_truth = camera_truth


class VcuRviBag:
    """https://github.com/rising-turtle/VCU_RVI_Benchmark"""

    COLOR, DEPTH = "/cam0/color", "/cam0/depth"
    MAX_STAMP_DIFFERENCE = 0.005  # s, of color and depth
    IMU_FROM_CAMERA = np.array([
        [0.00193013, -0.999997, 0.00115338, -0.00817048],
        [-0.999996, -0.0019327, -0.00223606, 0.015075],
        [0.00223829, -0.00114906, -0.999997, -0.0110795],
        [0, 0, 0, 1],
    ])
    IMU_FROM_CAMERA[:3, :3] = nearest_rotation(IMU_FROM_CAMERA[:3, :3])

    def __init__(self, path: Path):
        self.path, self.name = path, path.stem
        self.camera = pinhole(459.357, 459.764, 332.695, 258.998)

    def frames(self) -> Iterator[Frame]:
        types = get_typestore(Stores.ROS1_NOETIC)
        waiting = {}
        with Reader(self.path) as bag:
            connections = [c for c in bag.connections if c.topic in (self.COLOR, self.DEPTH)]
            if {c.topic for c in connections} != {self.COLOR, self.DEPTH}:
                raise LogError(f"{self.path}: needs the topics {self.COLOR} and {self.DEPTH}")
            for connection, _, data in bag.messages(connections):
                message = types.deserialize_ros1(data, connection.msgtype)
                waiting[connection.topic] = message
                if len(waiting) < 2:
                    continue
                stamps = {topic: stamp_of(image) for topic, image in waiting.items()}
                if abs(stamps[self.COLOR] - stamps[self.DEPTH]) > self.MAX_STAMP_DIFFERENCE:
                    del waiting[min(stamps, key=stamps.get)]
                    continue
                depth = pixels(waiting[self.DEPTH]).astype(np.float32) / 1000
                yield Frame(stamps[self.COLOR], pixels(waiting[self.COLOR]), depth)
                waiting.clear()

    def body_truth(self):
        return file_interface.read_tum_trajectory_file(self.path.with_name(f"{self.name}_gt.tum"))

    def camera_truth(self):
        path = self.path.with_name(f"{self.name}_gt_cam.tum")
        if path.exists():
            return file_interface.read_tum_trajectory_file(path)
        truth = self.body_truth()
        truth.transform(self.IMU_FROM_CAMERA, right_mul=True)
        return truth


def stamp_of(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def pixels(message):
    """The image of a `sensor_msgs/Image`: BGR or 16-bit depth, as the encoding says."""
    if message.encoding in ("8UC3", "bgr8", "rgb8"):
        rows = message.data.reshape(message.height, message.step)[:, : 3 * message.width]
        image = rows.reshape(message.height, message.width, 3)
        return np.ascontiguousarray(image[..., ::-1] if message.encoding == "rgb8" else image)
    if message.encoding in ("16UC1", "mono16"):
        rows = message.data.reshape(message.height, message.step)[:, : 2 * message.width]
        return np.ascontiguousarray(rows).view(">u2" if message.is_bigendian else "<u2")
    raise LogError(f"image encoding '{message.encoding}' is not read here")


def open_log(path: Path):
    if path.is_file() and path.suffix == ".bag":
        return VcuRviBag(path)
    if (path / "rgb.txt").is_file():
        return TumLog(path)
    if next(path.glob("frame-*.color.*"), None):
        return SevenScenesLog(path)
    raise LogError(f"{path}: neither a .bag file nor a TUM or 7-Scenes folder")
