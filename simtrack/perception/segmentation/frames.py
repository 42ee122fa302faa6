"""RGB-D frames in lower resolution."""

import numpy as np

from simtrack.contracts import CameraIntrinsics, RgbdFrame


def reduced_frame(frame: RgbdFrame, reduction: int) -> RgbdFrame:
    """A frame with each so many-th reading, and colours that are means around them."""
    if reduction == 1:
        return frame
    import cv2

    K, k = frame.intrinsics, reduction
    height, width = K.height // k, K.width // k
    half = (k - 1) / 2
    small = CameraIntrinsics(width, height, K.fx / k, K.fy / k, (K.cx - half) / k, (K.cy - half) / k)
    rgb = None
    if frame.rgb is not None:
        block = np.ascontiguousarray(frame.rgb[: height * k, : width * k])
        rgb = np.asarray(cv2.resize(block, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    depth = np.ascontiguousarray(frame.depth[k // 2 :: k, k // 2 :: k][:height, :width])
    return RgbdFrame(frame.stamp, depth, rgb, small, frame.T_base_camera, frame.sequence)
