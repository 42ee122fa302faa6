"""The step of a camera between two images by OpenCV's RGB-D odometry (Steinbruecker, Sturm, Cremers, 2011)."""

from typing import Any

import numpy as np

from simtrack.contracts import Float64, RgbdFrame
from simtrack.geometry.transforms import transform

APART = 0.5
"""Metres in depth up to which pixels of two images are compared: with OpenCV's 7 cm, turns of 10 deg are lost."""


class DenseSteps:
    """Aligns one image with another one, all of both; by depth alone where there are no colours."""

    def __init__(self, max_depth: float, max_translation: float, max_rotation: float) -> None:
        """Steps of at most that many metres and radians, by readings within `max_depth` metres."""
        self.limits = max_depth, max_translation, max_rotation
        self._odometry: Any = None

    def step(self, before: RgbdFrame, now: RgbdFrame) -> Float64 | None:
        """T_before_now (4, 4); None where they do not align."""
        if self._odometry is None:
            self._odometry = self._made(now)
        done, found = self._odometry.compute(self._prepared(now), self._prepared(before), np.eye(4))
        if not done:
            return None
        T = np.asarray(found, float)
        u, _, v = np.linalg.svd(T[:3, :3])  # rigid up to rounding
        return transform(u @ v, T[:3, 3])

    def _made(self, frame: RgbdFrame) -> Any:
        import cv2

        max_depth, max_translation, max_rotation = self.limits
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(frame.intrinsics.matrix.astype(np.float32))
        settings.setMaxDepth(max_depth)
        settings.setMaxTranslation(max_translation)
        settings.setMaxRotation(float(np.degrees(max_rotation)))
        settings.setMaxDepthDiff(APART)
        kind = cv2.OdometryType_DEPTH if frame.rgb is None else cv2.OdometryType_RGB_DEPTH
        return cv2.Odometry(kind, settings, cv2.OdometryAlgoType_COMMON)

    def _prepared(self, frame: RgbdFrame) -> Any:
        """A frame as OpenCV keeps it."""
        import cv2

        image = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.rgb is None else frame.rgb
        prepared = cv2.OdometryFrame(np.where(frame.depth > 0.0, frame.depth, np.nan).astype(np.float32), image)
        self._odometry.prepareFrame(prepared)
        return prepared
