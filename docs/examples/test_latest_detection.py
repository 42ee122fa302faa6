"""End-to-end accuracy in tests: `pytest --simtrack test_latest_detection.py`."""

from simtrack.testing import assert_metrics


def test_most_objects_are_known_within_centimetres(simtrack_runs):
    runs = simtrack_runs("workbench", duration=6.0, tracker="latest_detection:LatestDetection")
    assert_metrics(runs, "tracking.recall >= 0.2", "tracking.static.translation_error.median <= 80 mm")
