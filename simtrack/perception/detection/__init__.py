"""From an RGB image to poses: the `Detector` Protocol's results turned into pose hypotheses by PnP."""
