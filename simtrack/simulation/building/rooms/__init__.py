"""Rooms from a seed: furnished, settled, and known to the last contact."""
