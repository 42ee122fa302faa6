"""Whether a URDF scene is physically plausible: settled and moved in two engines, each in a process of its own."""
