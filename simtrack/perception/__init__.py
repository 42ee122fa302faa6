"""The perception stack: every estimator, none of which can see ground truth. Each stage is usable alone."""
