"""Poses of a handheld RGB-D camera: from image to image by OpenCV, then against the surface that was seen so far."""
