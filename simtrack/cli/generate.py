"""``simtrack generate``: make a labelled data set as a recipe says."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.datasets.engine import GenerationProgress

ROOM_FILMS = "rooms_panoptic"


def generate(
    recipe: Annotated[str | None, tyro.conf.Positional] = None,
    out: Path | None = None,
    count: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    engine: Literal["local", "ray"] = "local",
    address: str | None = None,
) -> int:
    """Make a labelled data set as a recipe says. The same command carries on where a stopped or killed run was.

    Args:
        recipe: Name of a recipe, or path of its YAML file; lists the recipes if not given. rooms_panoptic makes films
            of furnished rooms with a segment for every entity, for `simtrack train segmenter`.
        out: Folder of the data set; datasets/RECIPE-SEED if not given.
        count: Images, rounded up to whole scenes; the recipe's own number if not given. More than before extend a
            data set.
        seed: Of everything random. The same recipe and seed give the same bytes.
        workers: Processes that make scenes; one a core if not given. They do not change the result.
        engine: local uses processes of this machine, ray those of a cluster (needs the extra distributed).
        address: Of the Ray cluster, HOST:PORT or auto; one is started on this machine if not given.
    """
    if recipe is None:
        return _list_recipes()
    from functools import partial

    from simtrack.cli import console
    from simtrack.datasets import engine as engines
    from simtrack.datasets.generator import Generator
    from simtrack.datasets.recipe import load_recipe
    from simtrack.datasets.writers import make_writer
    from simtrack.errors import InvalidValueError

    if seed < 0:
        raise InvalidValueError("seed", seed, "0 or more")
    if count is not None and count < 1:
        raise InvalidValueError("count", count, "1 or more")
    if workers is not None and workers < 1:
        raise InvalidValueError("workers", workers, "1 or more")
    if address is not None and engine != "ray":
        raise InvalidValueError("address", address, "nothing without --engine ray")
    if recipe == ROOM_FILMS:
        return _room_films(out, count, seed, workers, engine)
    loaded = load_recipe(recipe)
    folder = out if out is not None else Path("datasets") / f"{loaded.name}-{seed}"
    size = workers or len(os.sched_getaffinity(0))
    with console.ProgressLine(f"{loaded.name} · seed {seed}", "reading models") as line:

        def show(progress: "GenerationProgress") -> None:
            line.show(_state(progress), progress.frames / progress.total_frames)

        try:
            summary = engines.generate(
                partial(Generator, loaded, seed),
                [make_writer(name, options, loaded.path) for name, options in loaded.writers.items()],
                folder,
                count or loaded.counts.frames,
                engines.local_pool(size) if engine == "local" else engines.ray_pool(size, address),
                show,
                line.say,
            )
        except KeyboardInterrupt:
            console.show_error("stopped: complete scenes are kept, and the same command carries on")
            return 130
    rate = f", {summary.made / summary.seconds:.1f} a second" if summary.made else ""
    print(f"{summary.frames} images in {summary.scenes} scenes, {summary.bytes / 1e9:.2f} GB{rate}")
    console.show_written(folder, ["dataset.json", *(f"{name}/" for name in loaded.writers)])
    return 0


def _room_films(out: Path | None, count: int | None, seed: int, workers: int | None, engine: str) -> int:
    from simtrack.cli import console
    from simtrack.datasets.room_films import ABOUT, ROOMS, RoomFilmsConfig, write_room_films
    from simtrack.errors import InvalidValueError

    if engine != "local" or workers not in (None, 1):
        raise InvalidValueError("engine, workers", (engine, workers), f"local and 1 for {ROOM_FILMS}")
    config = RoomFilmsConfig(seed=seed) if count is None else RoomFilmsConfig(images=count, seed=seed)
    folder = out if out is not None else Path("datasets") / f"{ROOM_FILMS}-{seed}"
    with console.ProgressLine(f"{ROOM_FILMS} · seed {seed}", "furnishing") as line:
        try:
            images = write_room_films(folder, config, lambda done, of: line.show(f"{done}/{of} images", done / of))
        except KeyboardInterrupt:
            console.show_error("stopped: complete rooms are kept, and the same command carries on")
            return 130
    print(f"{images} images of {len(config.rooms)} rooms")
    console.show_written(folder, [ABOUT, f"{ROOMS}/"])
    return 0


def _state(progress: "GenerationProgress") -> str:
    state = f"{progress.frames}/{progress.total_frames} images"
    left = progress.seconds_left
    if progress.rate > 0.0 and left is not None:
        state += f"  {progress.rate:.1f} a second  {_duration(left)} left"
    return f"{state}  {progress.bytes / 1e9:.2f} GB"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _list_recipes() -> int:
    from simtrack.cli import console
    from simtrack.datasets.recipe import read_recipe, recipe_names
    from simtrack.errors import SimtrackError

    films = "furnished rooms filmed by hand, every entity told apart: for simtrack train segmenter"
    rows: list[tuple[str, str, str, str]] = [(ROOM_FILMS, "3000", "segments", films)]
    broken: list[str] = []
    for name, path in sorted(recipe_names().items()):
        try:
            recipe = read_recipe(path)
        except SimtrackError as error:
            broken.append(str(error))
            continue
        rows.append((name, str(recipe.counts.frames), ", ".join(recipe.writers), recipe.description.strip()))
    console.show_table(("recipe", "images", "formats", "description"), rows, right=(1,))
    for message in broken:
        console.show_error(message)
    return 2 if broken else 0
