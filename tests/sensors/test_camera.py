"""Pinhole geometry: round trips and the data sheet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError
from simtrack.sensors.camera import XTION, CameraModel, pixel_rays, project, unproject

CAMERA = XTION.intrinsics


@given(st.floats(0.3, 8.0), st.integers(0, 639), st.integers(0, 479))
def test_unproject_then_project_is_the_identity(z: float, u: int, v: int) -> None:
    depth = np.zeros((480, 640), np.float32)
    depth[v, u] = z
    points = unproject(depth, CAMERA)
    np.testing.assert_allclose(project(points[v, u][None], CAMERA), [[u, v]], atol=1e-3)
    assert points[v, u, 2] == np.float32(z)
    assert np.count_nonzero(points.any(axis=-1)) == 1


def test_points_behind_the_camera_project_nowhere() -> None:
    assert np.isnan(project([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0]], CAMERA)).all()


def test_xtion_has_the_field_of_view_of_its_data_sheet() -> None:
    edge = np.abs(pixel_rays(CAMERA)[0, [0, -1], 0]) + 0.5 / CAMERA.fx
    assert np.rad2deg(np.arctan(edge)).sum() == pytest.approx(58.0, abs=0.1)
    assert XTION.period == 33_333_333


@pytest.mark.parametrize(
    "change", [{"rate_hz": 0.0}, {"min_range": 9.0}, {"baseline": -1.0}, {"rate_hz": float("nan")}]
)
def test_impossible_cameras_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(change))):
        CameraModel(CAMERA, **change)
    with pytest.raises(InvalidValueError, match="intrinsics"):
        CameraModel(CameraIntrinsics(0, 1, 1.0, 1.0, 0.0, 0.0))
