"""What the estimator believes an object to look like: a scan of it, not the thing itself."""

from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.objects.model import ObjectModel, Symmetries, box_keypoints


@dataclass(frozen=True, slots=True)
class TrackerModelConfig:
    """How the tracker's model of an object differs from the object."""

    noise: float = 0.0003
    """Metres, standard deviation of the surface along its normals, as left by a hand-held 3D scanner."""
    correlation_length: float = 0.005
    """Metres: closer points err alike (a scan is fused from many measurements, its surface is smooth)."""
    max_scale_error: float = 0.003
    """The scale is drawn uniformly within this share of the true one."""
    face_share: float = 0.5
    """Share of the faces that is left after decimation, in (0, 1]."""
    false_symmetry: bool = False
    """The model is said to look the same after half a turn about its z axis, which it need not."""

    def __post_init__(self) -> None:
        for name, valid, allowed in (
            ("noise", 0.0 <= self.noise <= 0.05, "0 to 0.05 m"),
            ("correlation_length", 1e-4 <= self.correlation_length <= 1.0, "0.0001 to 1 m"),
            ("max_scale_error", 0.0 <= self.max_scale_error <= 0.5, "0 to 0.5"),
            ("face_share", 0.0 < self.face_share <= 1.0, "above 0, at most 1"),
        ):
            if not valid:
                raise InvalidValueError(f"TrackerModelConfig.{name}", getattr(self, name), allowed)


EXACT = TrackerModelConfig(noise=0.0, max_scale_error=0.0, face_share=1.0)
"""The tracker knows the true shape."""


def tracker_model(model: ObjectModel, config: TrackerModelConfig, rng: np.random.Generator) -> ObjectModel:
    """The estimator's imperfect model of `model`: decimated, noisy, slightly off in scale.

    Its frame is still the true one's to within the noise: decimation and noise do not move the origin, because a model
    is scanned in the frame in which its poses are stated. Extents, diameter and keypoints are those of its own box,
    mass and inertia are what a data sheet says; there are no collision parts.

    `rng` is drawn from in the same way whatever the settings, so one setting does not change what another one draws.
    """
    from simtrack.objects.cache import cached_decimation

    scale_draw, waves = rng.uniform(-1.0, 1.0), _SurfaceWaves.draw(rng)

    def scanned(mesh: Mesh) -> Mesh:
        vertices = mesh.vertices
        if config.noise > 0.0:
            height = waves.at(vertices / config.correlation_length)
            vertices = vertices + config.noise * height[:, None] * meshes.vertex_normals(mesh)
        return Mesh(vertices * (1.0 + config.max_scale_error * scale_draw), mesh.faces, mesh.face_colors)

    lighter = cached_decimation(model.name, model.mesh, round(config.face_share * len(model.mesh.faces)))
    mesh = scanned(lighter)
    extents = mesh.extents
    return replace(
        model,
        mesh=mesh,
        visual=scanned(cached_decimation(model.name, lighter, len(model.visual.faces))),
        collision=(),
        extents=extents,
        diameter=meshes.diameter(mesh),
        keypoints=box_keypoints(extents),
        symmetries=_half_turned(model.symmetries) if config.false_symmetry else model.symmetries,
    )


def _half_turned(symmetries: Symmetries) -> Symmetries:
    """Symmetries with half a turn about z among them."""
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    discrete = symmetries.discrete
    if any(np.allclose(turn, pose) for pose in discrete):
        return symmetries
    return replace(symmetries, discrete=np.concatenate([discrete, discrete @ turn]))


@dataclass(frozen=True, slots=True, eq=False)
class _SurfaceWaves:
    """A smooth random field in space of unit variance: a sum of plane waves (random Fourier features).

    Its covariance is Gaussian, ``exp(-d^2 / 2)`` at distance d (Rahimi and Recht 2007).
    """

    frequencies: Float64
    """(K, 3)."""
    phases: Float64
    """(K,)."""

    @classmethod
    def draw(cls, rng: np.random.Generator, count: int = 96) -> "_SurfaceWaves":
        return cls(rng.standard_normal((count, 3)), rng.uniform(0.0, 2.0 * np.pi, count))

    def at(self, points: Float64) -> Float64:
        """(N,) values at (N, 3) points in units of the correlation length."""
        total = np.zeros(len(points))
        for frequency, phase in zip(self.frequencies, self.phases, strict=True):
            total += np.cos(points @ frequency + phase)
        return total * np.sqrt(2.0 / len(self.phases))
