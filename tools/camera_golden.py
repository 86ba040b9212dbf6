"""Pixels of points by other implementations of the camera models, for src/sensor/camera/tests.rs.

    pip install opencv-contrib-python-headless mpmath
    python tools/camera_golden.py

Radial-tangential and rational: cv2.projectPoints; equidistant in front of the camera:
cv2.fisheye; omnidirectional: cv2.omnidir. What OpenCV does not have (double sphere, equidistant
beyond 90 degrees) is computed from the papers' formulas with 50 digits.
"""

import cv2
import mpmath as mp
import numpy as np

mp.mp.dps = 50
FX, FY, CX, CY = 190.9785, 190.9733, 254.9317, 256.8974
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]])
NARROW = [(0.1, -0.2, 1.5), (-0.7, 0.4, 1.2), (0.9, 0.8, 1.9), (0.0, 0.0, 2.0), (0.3, -1.0, 2.2)]
WIDE = NARROW + [(2.0, 0.5, 0.1), (-1.0, 2.0, 0.3)]
BEHIND = [(1.5, -0.5, -0.2), (-0.4, -1.1, -0.3)]
ZERO = np.zeros(3)


def array(points):
    return np.array(points, dtype=float).reshape(1, -1, 3)


def rows(model, distortion, points, pixels):
    for point, pixel in zip(points, pixels):
        u, v = (repr(float(x)) for x in pixel)
        print(f"    (CameraModel::{model}, &{list(distortion)}, {list(point)}, [{u}, {v}]),")


def opencv(points, distortion):
    pixels, _ = cv2.projectPoints(array(points), ZERO, ZERO, K, np.array(distortion))
    return pixels.reshape(-1, 2).tolist()


def fisheye(points, distortion):
    pixels, _ = cv2.fisheye.projectPoints(array(points), ZERO, ZERO, K, np.array(distortion))
    return pixels.reshape(-1, 2).tolist()


def omnidir(points, xi, distortion):
    pixels, _ = cv2.omnidir.projectPoints(array(points), ZERO, ZERO, K, xi, np.array([distortion]))
    return pixels.reshape(-1, 2).tolist()


def kannala_brandt(point, k):
    x, y, z = map(mp.mpf, point)
    r = mp.sqrt(x**2 + y**2)
    t = mp.acos(z / mp.sqrt(r**2 + z**2))
    d = t + sum(mp.mpf(k[i]) * t ** (2 * i + 3) for i in range(4))
    return FX * d * x / r + mp.mpf(CX), FY * d * y / r + mp.mpf(CY)


def double_sphere(point, xi, alpha):
    x, y, z, xi, alpha = map(mp.mpf, (*point, xi, alpha))
    d1 = mp.sqrt(x**2 + y**2 + z**2)
    d2 = mp.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return FX * x / below + mp.mpf(CX), FY * y / below + mp.mpf(CY)


radtan = [-0.283, 0.0739, 1.9e-4, 1.76e-5, 0.01]
rows("RadialTangential", radtan, NARROW, opencv(NARROW, radtan))
rational = [0.52, -2.6, 8e-4, -3e-4, 1.4, 0.40, -2.4, 1.3]
rows("Rational", rational, NARROW, opencv(NARROW, rational))
kb4 = [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182]
rows("Equidistant", kb4, WIDE, fisheye(WIDE, kb4))
rows("Equidistant", kb4, BEHIND, [kannala_brandt(p, kb4) for p in BEHIND])
ds = [-0.2996, 0.5941]
rows("DoubleSphere", ds, WIDE + BEHIND, [double_sphere(p, *ds) for p in WIDE + BEHIND])
mei = [1.62, -0.12, 0.031, 1.1e-3, -6e-4]
rows("Omnidirectional", mei, WIDE + BEHIND, omnidir(WIDE + BEHIND, mei[0], mei[1:]))
