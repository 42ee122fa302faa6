"""Sensor models: what a camera, a lidar, wheels and encoders report, and how they err."""
