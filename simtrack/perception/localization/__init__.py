"""Robot pose in the static map: odometry, MICP-L against the mesh by ray casting, global search."""

from simtrack.perception.localization.config import (
    LocalizerConfig,
    MotionConfig,
    RecoveryConfig,
    RegistrationConfig,
    SearchConfig,
)
from simtrack.perception.localization.localizer import MeshLocalizer

__all__ = ["LocalizerConfig", "MeshLocalizer", "MotionConfig", "RecoveryConfig", "RegistrationConfig", "SearchConfig"]
