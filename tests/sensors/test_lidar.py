"""The VLP-16's firing pattern and noise."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import InvalidValueError
from simtrack.sensors.lidar import (
    IDEAL_LIDAR_NOISE,
    VLP16,
    LidarModel,
    LidarNoiseConfig,
    apply_lidar_noise,
    reflected_intensity,
)


def test_firing_order_and_timing() -> None:
    shots = VLP16.shots()
    k, n = np.divmod(np.arange(len(shots)), 16)
    np.testing.assert_allclose(shots.times, 55.296e-6 * k + 2.304e-6 * n, atol=1e-8)
    elevations = np.rad2deg(np.arcsin(shots.directions[:, 2]))
    order = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    np.testing.assert_allclose(elevations[:16], order, atol=1e-4)
    np.testing.assert_array_equal(shots.rings[:16], (np.array(order) + 15) // 2)
    np.testing.assert_allclose(elevations, 2.0 * shots.rings - 15, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(shots.directions, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(("rate", "columns", "driver"), [(5.0, 3616.9, 3624), (10.0, 1808.4, 1824), (20.0, 904.2, 912)])
def test_a_turn_is_360_degrees_by_true_time(rate: float, columns: float, driver: int) -> None:
    lidar = LidarModel(rate_hz=rate)
    assert 1 / (rate * lidar.firing_period) == pytest.approx(columns, abs=0.06)
    shots = lidar.shots()
    assert shots.times.max() < 1 / rate
    assert len(shots) / 16 == pytest.approx(columns, abs=0.3)
    assert np.ptp(shots.azimuths) == pytest.approx(2 * np.pi, abs=1e-3)
    assert lidar.driver_columns == driver
    paper = lidar.shots(columns=lidar.driver_columns)
    assert len(paper) == 16 * driver
    if rate == 10.0:
        assert np.rad2deg(np.ptp(paper.azimuths)) == pytest.approx(363.0, abs=0.2)


def test_it_turns_clockwise_also_within_a_firing() -> None:
    shots = VLP16.shots(start_azimuth=0.5)
    azimuth = np.unwrap(np.arctan2(shots.directions[:, 1], shots.directions[:, 0]).astype(float))
    assert azimuth[0] == pytest.approx(-0.5, abs=1e-6)
    assert (np.diff(azimuth) < 0).all()
    np.testing.assert_allclose(azimuth, -shots.azimuths, atol=1e-5)
    assert -np.rad2deg(azimuth[16] - azimuth[0]) == pytest.approx(0.199, abs=1e-3)
    assert -np.rad2deg(azimuth[15] - azimuth[0]) == pytest.approx(0.199 * 15 * 2.304 / 55.296, abs=1e-3)


def test_noise_resolution_and_limits() -> None:
    config = LidarNoiseConfig(dropout=0.0)
    generator = np.random.default_rng(0)
    ranges = np.full(50_000, 5.0)
    measured = apply_lidar_noise(ranges, None, config, generator)
    assert measured.std() == pytest.approx(np.hypot(0.008, 0.002 / np.sqrt(12)), rel=0.02)
    assert measured.mean() == pytest.approx(5.0, abs=2e-4)
    np.testing.assert_allclose(measured / 0.002, np.round(measured / 0.002), atol=2e-3)
    bad = np.array([np.inf, np.nan, 0.0, -1.0, 0.2, 120.0, np.inf])
    assert np.isinf(apply_lidar_noise(bad, None, config, generator)).all()
    ideal = apply_lidar_noise(np.array([0.1, 3.3, np.inf]), None, IDEAL_LIDAR_NOISE, generator)
    np.testing.assert_allclose(ideal, [0.1, 3.3, np.inf], rtol=1e-6)


def test_losses_grow_with_incidence_and_darkness() -> None:
    generator = np.random.default_rng(0)
    ranges = np.full(20_000, 10.0)
    config = LidarNoiseConfig()

    def lost(**arguments: float) -> float:
        filled = {name: np.full(20_000, value) for name, value in arguments.items()}
        result = apply_lidar_noise(ranges, filled.get("intensities"), config, generator, filled.get("incidence"))
        return float(np.isinf(result).mean())

    assert lost(incidence=0.3) < 0.01 < lost(incidence=1.44) < lost(incidence=1.48) < lost(incidence=1.55)
    assert lost(incidence=1.48) == pytest.approx(0.5, abs=0.03)
    assert lost(intensities=50.0) < 0.01
    assert lost(intensities=0.01) == 1.0


def test_one_shots_fate_does_not_change_the_others() -> None:
    ranges = np.linspace(1, 9, 100)
    changed = ranges.copy()
    changed[10] = np.inf
    a, b = (apply_lidar_noise(r, None, LidarNoiseConfig(), np.random.default_rng(1)) for r in (ranges, changed))
    np.testing.assert_array_equal(np.delete(a, 10), np.delete(b, 10))


def test_intensity_follows_lambert() -> None:
    np.testing.assert_array_equal(reflected_intensity([0.5, 0.5, 1.2], [0.0, np.pi / 3, 0.0]), [50, 25, 100])


def test_impossible_lidars_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="rate_hz"):
        LidarModel(rate_hz=0.0)
    with pytest.raises(InvalidValueError, match="elevations"):
        LidarModel(elevations=())
    with pytest.raises(InvalidValueError, match="laser_period"):
        LidarModel(laser_period=1e-3)
    with pytest.raises(InvalidValueError, match="sigma"):
        LidarNoiseConfig(sigma=-1.0)
    with pytest.raises(InvalidValueError, match="dropout"):
        LidarNoiseConfig(dropout=2.0)


def test_a_real_vlp16_fires_in_the_same_pattern(real_data: Path) -> None:
    decoder = pytest.importorskip("velodyne_decoder", reason="needs the package velodyne-decoder")
    file = real_data / "mrpt_vlp16.pcap"
    if not file.is_file():
        pytest.skip(f"no {file}")
    shots = VLP16.shots()
    delay_of_ring = np.empty(16)
    delay_of_ring[shots.rings[:16]] = shots.times[:16]
    turns = list(decoder.read_pcap(str(file)))
    assert len(turns) == 4
    for _, points in turns:
        x, y, z, _, time, column, ring = points[:, :7].astype(np.float64).T
        ring, column = ring.astype(int), column.astype(int)
        # Up to the heights at which the lasers leave the real sensor, 11.2 mm above and below its centre.
        elevation = np.deg2rad(2.0 * ring - 15.0)
        assert np.abs(z - np.hypot(x, y) * np.tan(elevation)).max() < 0.013
        # Time: a shot's delay in its firing is that of its laser, and firings follow each other by 55.296 us (but for
        # the few packets that the recording lost).
        firing = time - delay_of_ring[ring]
        steps = np.diff(firing) - 55.296e-6 * np.diff(column)
        assert np.mean(np.abs(steps) < 2e-6) > 0.99
        # Clockwise, and on within a firing: azimuth goes down with each shot's own time at one rate.
        azimuth = np.unwrap(np.arctan2(y, x))
        rate = np.polyfit(time, azimuth, 1)[0]
        assert rate == pytest.approx(-2 * np.pi * 10.0, rel=0.01)
        residual = azimuth - np.polyval(np.polyfit(time, azimuth, 1), time)
        assert np.rad2deg(residual.std()) < 0.1
