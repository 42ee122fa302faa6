"""The simulated world: scene files, robot, hand, clock, sensors' views and the ground truth."""
