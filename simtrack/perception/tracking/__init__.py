"""Tracking of mesh models by ray tracing (tracking paper, III.B) and pre-segmentation of what is unknown (III.C)."""
