"""Frame-to-frame RGB-D odometry: the peers that mfg-vio is compared with.

`step` takes the next frame and returns the 4x4 transform `previous_from_current` of camera
coordinates, or None where there is no previous frame or the motion is not found.
"""

import cv2
import numpy as np
import open3d


class OrbPnp:
    """ORB features matched to the previous frame, its depth, and PnP in RANSAC."""

    FEATURES = 1000
    REPROJECTION_ERROR = 3.0  # pixels
    ITERATIONS = 300
    CONFIDENCE = 0.999
    MIN_MATCHES = 6

    def __init__(self, camera, threads):
        cv2.setNumThreads(threads)
        cv2.setRNGSeed(0)
        self.camera = camera
        self.inverse = np.linalg.inv(camera.matrix)
        self.orb = cv2.ORB_create(self.FEATURES)
        self.matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self.previous = None

    def step(self, frame):
        keypoints, descriptors = self.orb.detectAndCompute(
            cv2.cvtColor(frame.color, cv2.COLOR_BGR2GRAY), None)
        previous, self.previous = self.previous, None
        if not keypoints:
            return None
        pixels = cv2.KeyPoint_convert(keypoints).reshape(-1, 2)
        columns, rows = np.rint(pixels).astype(int).T
        depths = frame.depth[rows, columns]
        pixels = cv2.undistortPoints(pixels[:, None], self.camera.matrix, self.camera.distortion,
                                     P=self.camera.matrix)[:, 0]
        self.previous = pixels, depths, descriptors
        if previous is None:
            return None

        before, depths, descriptors_before = previous
        matches = self.matcher.match(descriptors_before, descriptors)
        pairs = [(m.queryIdx, m.trainIdx) for m in matches if depths[m.queryIdx] > 0]
        if len(pairs) < self.MIN_MATCHES:
            return None
        query, train = np.array(pairs).T
        rays = np.column_stack([before[query], np.ones(len(query))]) @ self.inverse.T
        found, rotation, translation, _ = cv2.solvePnPRansac(
            rays * depths[query, None], pixels[train], self.camera.matrix, None,
            reprojectionError=self.REPROJECTION_ERROR, iterationsCount=self.ITERATIONS,
            confidence=self.CONFIDENCE)
        if not found:
            return None
        current_from_previous = np.eye(4)
        current_from_previous[:3, :3] = cv2.Rodrigues(rotation)[0]
        current_from_previous[:3, 3] = translation[:, 0]
        return np.linalg.inv(current_from_previous)


class Open3dHybrid:
    """Dense alignment of color and depth (Park, Zhou and Koltun, ICCV 2017), from identity."""

    def __init__(self, camera, _threads):
        self.camera = camera
        self.term = open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()
        self.option = open3d.pipelines.odometry.OdometryOption()
        self.previous = None

    def step(self, frame):
        current = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(cv2.cvtColor(frame.color, cv2.COLOR_BGR2RGB)),
            open3d.geometry.Image(frame.depth), depth_scale=1.0, depth_trunc=4.0)
        previous, self.previous = self.previous, current
        if previous is None:
            return None
        height, width = frame.depth.shape
        intrinsic = open3d.camera.PinholeCameraIntrinsic(width, height, self.camera.matrix)
        found, previous_from_current, _ = open3d.pipelines.odometry.compute_rgbd_odometry(
            current, previous, intrinsic, np.eye(4), self.term, self.option)
        return previous_from_current if found else None


PEERS = {"orb-pnp": OrbPnp, "open3d-hybrid": Open3dHybrid}
