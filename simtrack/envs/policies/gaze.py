"""A gaze that is learned: what it sees of a belief, the postures that it asks for, and the network between them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import Float32, Float64
from simtrack.envs.actions import AXES, vector
from simtrack.envs.policies import Briefing
from simtrack.envs.settings import CONTROL_HZ
from simtrack.errors import FileFormatError
from simtrack.geometry.transforms import wrapped

HOLD = 4
"""Control steps for which a posture is asked for."""
TRACKS, REGIONS, SECTORS = 10, 4, 8
"""Tracks and unexplained regions that are looked at, and directions for which is known when they were seen last."""
TURN, PAN, TILT, LEVEL = np.pi, 1.0, 0.4, -0.4
"""What 1 stands for: radians that the base turns off its heading at the start, of the head's pan, and of its tilt off
`LEVEL`."""
CAMERA = 1.4
"""Metres above the floor, about, of the camera."""
FORGOTTEN = 10.0
"""Seconds after which a direction or a track counts as not seen for a while."""
FEATURES = TRACKS * 13 + REGIONS * 4 + SECTORS + 9
NETWORK = "gaze.npz"
"""File of a trained network."""


class Gaze:
    """Belief in, speeds out: features of what is believed, and the way to the posture that is asked for."""

    def __init__(self, seconds: float) -> None:
        """`seconds`: length of an episode."""
        self._seconds = seconds
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self._start: float | None = None
        self._seen = np.full(SECTORS, -FORGOTTEN)

    def features(self, arrays: Mapping[str, np.ndarray]) -> Float32:
        """(FEATURES,) of about unit size, of the arrays of a belief; places as the camera looks at them.

        Tracks come in the order of their age, the oldest first, so that it does not matter which slot they are in.
        """
        x, y, c, s = arrays["base"].tolist()
        heading = float(np.arctan2(s, c))
        self._start = heading if self._start is None else self._start
        pan, tilt, torso = arrays["joints"].tolist()
        now, off = float(arrays["time"][0]), wrapped(heading - self._start)
        sector = round(wrapped(off + pan) / (2.0 * np.pi / SECTORS)) % SECTORS
        self._seen[sector] = now
        known = np.flatnonzero(arrays["mask"] > 0.5)
        known = known[np.argsort(-arrays["age"][known], kind="stable")][:TRACKS]
        deviation = np.sqrt(np.maximum(np.einsum("nii->ni", arrays["covariance"][known])[:, :3].sum(axis=1), 0.0))
        tracks = np.zeros((TRACKS, 13))
        tracks[: len(known)] = np.column_stack(
            [
                _as_seen(arrays["position"][known], np.array([x, y]), heading + pan),
                arrays["age"][known] / FORGOTTEN,
                arrays["visible"][known],
                arrays["moving"][known],
                deviation / 0.05,
                arrays["status"][known],
            ]
        )
        there = np.flatnonzero(arrays["regions_mask"] > 0.5)[:REGIONS]
        regions = np.zeros((REGIONS, 4))
        regions[: len(there)] = _as_seen(arrays["regions"][there], np.array([x, y]), heading + pan)
        robot = [
            np.cos(off), np.sin(off), off / TURN, pan, tilt - LEVEL, torso, 2.0 * now / self._seconds - 1.0,
            5.0 * float(arrays["unexplained"][0]), float(arrays["speed"][1]),
        ]  # fmt: skip
        flat = [tracks.ravel(), regions.ravel(), np.minimum(now - self._seen, FORGOTTEN) / FORGOTTEN, robot]
        return np.clip(np.concatenate(flat), -3.0, 3.0).astype(np.float32)

    def speeds(self, wanted: Float32, arrays: Mapping[str, np.ndarray]) -> Float32:
        """(5,) the action that leads towards a posture (3,): turn of the base, pan and tilt, each from -1 to 1."""
        turn, pan, tilt = np.clip(np.asarray(wanted, dtype=float), -1.0, 1.0) * (TURN, PAN, TILT) + (0.0, 0.0, LEVEL)
        heading = float(np.arctan2(arrays["base"][3], arrays["base"][2]))
        start = heading if self._start is None else self._start
        now_pan, now_tilt, _ = arrays["joints"].tolist()
        moves = {
            "angular": 1.5 * wrapped(start + turn - heading) / AXES["angular"],
            "pan": 0.5 * (pan - now_pan) * CONTROL_HZ / AXES["pan"],
            "tilt": 0.5 * (tilt - now_tilt) * CONTROL_HZ / AXES["tilt"],
        }
        return np.clip(vector(moves), -1.0, 1.0)


def _as_seen(places: Float64, base: Float64, heading: float) -> Float64:
    """(N, 4) distance and height in units of 2 m, cosine and sine of the bearing off where the camera looks."""
    offset = places[:, :2] - base
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - heading
    distance = np.linalg.norm(offset, axis=1) / 2.0
    return np.column_stack([distance, (places[:, 2] - CAMERA) / 2.0, np.cos(bearing), np.sin(bearing)])


class GazePolicy:
    """Plays what a network has learned; needs numpy only."""

    def __init__(self, briefing: Briefing, mode: str, path: Path) -> None:
        """`path`: folder of `simtrack train agent`; raises FileFormatError if it holds no network that fits."""
        self._briefing, self._mode = briefing, mode
        file = Path(path) / NETWORK
        try:
            with np.load(file, allow_pickle=False) as stored:
                count = len(stored.files) // 2
                self._layers = [(stored[f"weight{k}"], stored[f"bias{k}"]) for k in range(count)]
        except (OSError, ValueError, KeyError) as error:
            raise FileFormatError(
                file, "network", f"cannot be read ({error}); `simtrack train agent` writes it"
            ) from error
        sizes = [weight.shape[1] for weight, _ in self._layers] + [len(bias) for _, bias in self._layers[-1:]]
        if not self._layers or (sizes[0], sizes[-1]) != (FEATURES, 3):
            raise FileFormatError(file, "network", f"of layers {sizes}; must take {FEATURES} numbers and give 3")
        self._gaze = Gaze(briefing.layout.seconds)
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """See `simtrack.envs.policies.Policy`."""
        self._gaze.reset()
        self._steps, self._wanted = 0, np.zeros(3, np.float32)

    def act(self, observation: Any) -> Float32:
        """See `simtrack.envs.policies.Policy`."""
        arrays = self._briefing.arrays(observation, self._mode)
        if self._steps % HOLD == 0:
            value = self._gaze.features(arrays)
            for weight, bias in self._layers[:-1]:
                value = np.tanh(weight @ value + bias)
            weight, bias = self._layers[-1]
            self._wanted = weight @ value + bias
        self._steps += 1
        return self._gaze.speeds(self._wanted, arrays)
