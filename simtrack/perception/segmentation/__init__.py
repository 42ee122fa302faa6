"""What is in one RGB-D image: panoptic segments by a network or an oracle, and geometric ones from depth alone."""
