"""Stages that answer from ground truth with the errors of real ones: they implement the stages' own Protocols."""

from simtrack.simulation.oracles.detector import OracleDetector, OracleDetectorConfig
from simtrack.simulation.oracles.localizer import OracleLocalizer

__all__ = ["OracleDetector", "OracleDetectorConfig", "OracleLocalizer"]
