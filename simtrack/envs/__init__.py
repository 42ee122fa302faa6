"""Gymnasium environments with perception in the loop: agents act on what a stack believes, rewards know the truth.

The ids are registered on ``import simtrack``; see `simtrack.envs.environment.SimtrackEnv` for their arguments.
"""
