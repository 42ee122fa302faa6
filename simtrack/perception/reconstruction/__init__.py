"""From a contact graph to a functional scene: bodies and joints, their physics, and the files that hold them."""
