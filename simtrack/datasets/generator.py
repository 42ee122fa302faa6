"""Makes labelled frames as a recipe says; each scene depends on recipe, seed and its own number alone."""

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol

from simtrack.datasets.content import ColorRenderer
from simtrack.datasets.frame import Category, DatasetInfo, LabelledFrame, SceneInfo, StuffCategory
from simtrack.datasets.recipe import DriveViews, Recipe


class _Source(Protocol):
    """What makes the frames of one kind of views."""

    categories: tuple[Category, ...]
    stuff: tuple[StuffCategory, ...]

    def scenes(self, count: int) -> int: ...

    def scene_info(self, scene: int) -> SceneInfo: ...

    def frames(self, scene: int) -> Iterator[LabelledFrame]: ...

    def close(self) -> None: ...


class Generator:
    """Frames of a recipe, scene by scene, in any order.

    ::

        with Generator(load_recipe("workbench_keypoints"), seed=0) as generator:
            for frame in generator.frames(scene=12):
                print(frame.key, [label.name for label in frame.targets()])
    """

    def __init__(self, recipe: Recipe, seed: int, renderer: ColorRenderer | None = None) -> None:
        """Load what all scenes share.

        Args:
            recipe: from `load_recipe`.
            seed: of everything random.
            renderer: of the colour images of settled scenes, instead of the one that the recipe names.

        Raises:
            FileFormatError: what the recipe names does not exist or cannot be used.
        """
        self._source: _Source = _source(recipe, seed, renderer)
        self.info = DatasetInfo(
            name=recipe.name,
            description=recipe.description,
            seed=seed,
            recipe=recipe.canonical(),
            intrinsics=recipe.camera.intrinsics,
            categories=self._source.categories,
            stuff=self._source.stuff,
            split=recipe.split,
            val_share=recipe.val_share,
        )

    def scenes(self, count: int) -> int:
        """Number of scenes that hold at least `count` frames."""
        return self._source.scenes(count)

    def scene_info(self, scene: int) -> SceneInfo:
        """What is known of a scene before its first frame."""
        return self._source.scene_info(scene)

    def frames(self, scene: int) -> Iterator[LabelledFrame]:
        """Make the frames of a scene, in order.

        Raises:
            FileFormatError: the things cannot be placed, or the cameras; names the thing.
            RenderingError: no image can be rendered here.
        """
        return self._source.frames(scene)

    def close(self) -> None:
        """Release OpenGL and ray scenes; may be called twice."""
        self._source.close()

    def __enter__(self) -> "Generator":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _source(recipe: Recipe, seed: int, renderer: ColorRenderer | None) -> _Source:
    if isinstance(recipe.views, DriveViews):
        from simtrack.datasets.drives import Drives

        return Drives(recipe, seed)
    from simtrack.datasets.settled import SettledScenes

    return SettledScenes(recipe, seed, renderer)
