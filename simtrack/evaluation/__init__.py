"""Metrics of every stage against the ground truth, and the closed loop that measures them."""
