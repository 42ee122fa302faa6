"""End-to-end accuracy in other people's tests: ``pytest --simtrack`` (see docs/testing.md)."""

from simtrack.testing.assertions import Runs, assert_metrics, assert_no_regression

__all__ = ["Runs", "assert_metrics", "assert_no_regression"]
