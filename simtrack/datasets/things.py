"""Which things a scene holds: targets and distractors, drawn from what a recipe names."""

from collections.abc import Sequence

import numpy as np

from simtrack.datasets.content import Placed
from simtrack.datasets.frame import Category
from simtrack.datasets.physics import Body
from simtrack.datasets.primitives import primitive
from simtrack.datasets.recipe import Recipe
from simtrack.errors import FileFormatError, SimtrackError
from simtrack.objects import ObjectModel, load_object, register_folder
from simtrack.raycast import TriangleMesh


class Things:
    """The models of a recipe, loaded once, and what scenes take of them."""

    def __init__(self, recipe: Recipe) -> None:
        """Load the models.

        Warns (UserWarning) where a user's mesh is open or seems not to be in metres.

        Raises:
            FileFormatError: an object that does not exist or cannot be used, or fewer of them than scenes hold.
        """
        self._recipe = recipe
        targets = _load(recipe, "targets", recipe.targets.models, recipe.targets.folders)
        self.categories = tuple(Category(k, model) for k, model in enumerate(targets, start=1))
        self.distractors = _load(recipe, "distractors", recipe.distractors.models, recipe.distractors.folders)
        most = len(targets) * recipe.targets.repeat
        if targets and recipe.targets.count[1] > most:
            reason = (
                f"{recipe.targets.count[1]} of {len(targets)} models; allowed: at most {most}, or a higher 'repeat'"
            )
            raise FileFormatError(recipe.path, "targets.count", reason)
        self._meshes: dict[str, TriangleMesh] = {}

    def draw(self, rng: np.random.Generator) -> list[tuple[Body, int | None]]:
        """Bodies of a scene with their category ids (None: distractor), targets first, each with a name of its own."""
        targets, distractors = self._recipe.targets, self._recipe.distractors
        pool = np.repeat(np.arange(len(self.categories)), targets.repeat)
        chosen = np.sort(rng.permutation(pool)[: _count(targets.count, rng)])
        drawn: list[tuple[ObjectModel, float, int | None]] = []
        drawn += [(self.categories[k].model, 1.0, self.categories[k].id) for k in chosen.tolist()]
        for _ in range(_count(distractors.count, rng)):
            model = self.distractors[int(rng.integers(len(self.distractors)))]
            drawn.append((model, float(rng.uniform(*distractors.scale)), None))
        for _ in range(_count(distractors.primitives.count, rng)):
            drawn.append((primitive(distractors.primitives, rng), 1.0, None))
        return [(Body(f"{m.name}-{k}", m, scale), c) for k, (m, scale, c) in enumerate(drawn, start=1)]

    def placed(
        self, bodies: Sequence[tuple[Body, int | None]], poses: np.ndarray, first_id: int, first_ray: int
    ) -> tuple[Placed, ...]:
        """Bodies at poses (N, 4, 4) with ids and ray instances counted up from the given ones."""
        return tuple(
            Placed(
                instance=first_id + k,
                ray_instance=first_ray + k,
                name=body.name,
                semantic_class=body.model.semantic_class,
                category=category,
                mesh=self._mesh(body.model),
                T_map_object=poses[k],
                scale=np.full(3, body.scale),
                extents=body.extents,
                keypoints=body.model.keypoints if category is not None else np.empty((0, 3)),
            )
            for k, (body, category) in enumerate(bodies)
        )

    def _mesh(self, model: ObjectModel) -> TriangleMesh:
        """The model as rays meet it; that of a known model is built once."""
        if all(model is not known for known in (*(c.model for c in self.categories), *self.distractors)):
            return TriangleMesh(model.mesh.vertices, model.mesh.faces, model.name)
        if model.name not in self._meshes:
            self._meshes[model.name] = TriangleMesh(model.mesh.vertices, model.mesh.faces, model.name)
        return self._meshes[model.name]


def _count(bounds: tuple[int, int], rng: np.random.Generator) -> int:
    return int(rng.integers(bounds[0], bounds[1] + 1))


def _load(recipe: Recipe, section: str, names: Sequence[str], folders: Sequence[str]) -> tuple[ObjectModel, ...]:
    """The named models, then those of the folders by name; each once."""
    found: dict[str, ObjectModel] = {}
    for k, folder in enumerate(folders):
        try:
            names = [*names, *register_folder(recipe.beside(folder))]
        except SimtrackError as error:
            raise FileFormatError(recipe.path, f"{section}.folders.{k}", str(error)) from error
    for k, name in enumerate(names):
        try:
            found[name] = load_object(name)
        except SimtrackError as error:
            raise FileFormatError(recipe.path, f"{section}.models.{k}", str(error)) from error
    return tuple(found.values())
