"""Validation of data sets: every file against its format, and samples against what the stated poses show.

Nothing here uses the writers: files are read as a stranger would read them, and all numbers are computed anew.
"""

from simtrack.datasets.validation.findings import Finding
from simtrack.datasets.validation.run import Validation, validate

__all__ = ["Finding", "Validation", "validate"]
