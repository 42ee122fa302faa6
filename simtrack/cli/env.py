"""``simtrack env``: let a policy play an environment."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.envs.play import EpisodeResult


def env(
    env_id: Annotated[str, tyro.conf.Positional],
    policy: str = "scripted",
    episodes: int = 1,
    seed: int = 0,
    scene: tuple[str, ...] = (),
    observation: tuple[str, ...] = ("belief",),
    feed: Literal["belief", "state"] = "belief",
    seconds: float | None = None,
    miss_rate: float | None = None,
    keypoint_error: float | None = None,
    video: Path | None = None,
    record: Path | None = None,
    record_as: Literal["mcap", "bop"] = "mcap",
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    threads: int = 1,
) -> int:
    """Let a policy play an environment, and tell how well it did.

    Args:
        env_id: Id of the environment, e.g. ActivePerception or simtrack/ActivePerception-v0.
        policy: What acts: scripted, random, still, or the folder in which simtrack train agent has left a network.
        episodes: How many are played; episode k has the seed SEED + k.
        seed: Of the first episode.
        scene: Name or path of a scene; the task's own if not given. With several, such as a kitchen and its
            reconstruction, the same episodes are played in each, and their figures stand side by side.
        observation: Observation modes: belief, state, rgbd.
        feed: What a scripted policy sees: what is believed, or the truth (which must then be observed, too).
        seconds: Length of an episode; the task's own if not given.
        miss_rate: Share of visible objects that the detector does not find; the oracle's own if not given.
        keypoint_error: Median error of the detector's keypoints as a share of the object's size.
        video: Write a video of all episodes to this file.
        record: Record each episode to this folder.
        record_as: Logs that simtrack replay reads, or a data set in the format of BOP.
        json_file: Keep the figures of each episode in this file; those that it has already are not played again.
        threads: Threads of the compiled kernels.
    """
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.process import set_threads

    if episodes < 1:
        raise InvalidValueError("episodes", episodes, "1 or more")
    set_threads(threads)
    errors = {"miss_rate": miss_rate, "keypoint_error": keypoint_error}
    arguments: dict[str, Any] = {
        "observation": observation[0] if len(observation) == 1 else observation,
        "seconds": seconds,
        "detector_errors": {name: value for name, value in errors.items() if value is not None},
    }
    columns = []
    for number, name in enumerate(scene or (None,)):
        chosen = arguments if name is None else {**arguments, "scene": name}
        own = number if len(scene) > 1 else None
        kept, film, log = (_numbered(path, own) for path in (json_file, video, record))
        if len(scene) > 1:
            print(f"{name}:", flush=True)
        seeds = range(seed, seed + episodes)
        columns.append(_played(full_id(env_id), policy, feed, seeds, chosen, kept, film, log, record_as))
    rows = [("success", *(f"{sum(r.success for r in results)}/{episodes}" for results in columns))]
    rows += [("return", *(f"{sum(r.total for r in results) / episodes:.3f}" for results in columns))]
    for name in columns[0][0].metrics:
        rows.append((name, *(f"{sum(r.metrics[name] for r in results) / episodes:.4g}" for results in columns)))
    heads = list(scene) if len(scene) > 1 else ["value"]
    console.show_table(("mean over episodes", *heads), rows, right=range(1, 1 + len(heads)))
    return 0


def _numbered(path: Path | None, number: int | None) -> Path | None:
    """A path of its own for each of several scenes."""
    return path if path is None or number is None else path.with_name(f"{path.stem}-{number}{path.suffix}")


def _played(
    env_id: str,
    policy: str,
    feed: "Literal['belief', 'state']",
    seeds: range,
    arguments: dict[str, Any],
    json_file: Path | None,
    video: Path | None,
    record: Path | None,
    record_as: str,
) -> "list[EpisodeResult]":
    """Episodes of one scene; those that the file has are not played again."""
    import gymnasium as gym

    from simtrack.envs.bop_recorder import BopRecorder
    from simtrack.envs.episodes import EpisodeFile
    from simtrack.envs.play import play
    from simtrack.envs.wrappers import Recorder, Video

    made: gym.Env = gym.make(env_id, disable_env_checker=True, **arguments)
    if video is not None:
        made = Video(made, video)
    if record is not None:
        made = Recorder(made, record) if record_as == "mcap" else BopRecorder(made, record)
    with made:
        kept = None
        if json_file is not None:
            kept = EpisodeFile(json_file, {"env": env_id, "policy": policy, "feed": feed, **arguments})
        done = kept.results if kept is not None else {}
        results = [done[number] for number in seeds if number in done]
        for result in play(made, policy, [number for number in seeds if number not in done], feed):
            print(
                f"seed {result.seed}: return {result.total:.2f}, {'success' if result.success else 'no success'}, "
                + ", ".join(f"{name} {value:.3g}" for name, value in result.metrics.items()),
                flush=True,
            )
            results.append(result)
            if kept is not None:
                kept.add(result)
    return results


def full_id(name: str) -> str:
    """The registered id that a name stands for; raises UnknownNameError with the known ones."""
    import gymnasium as gym

    from simtrack.errors import UnknownNameError

    known = [spec for spec in gym.registry if spec.startswith("simtrack/")]
    for candidate in (name, f"simtrack/{name}", f"simtrack/{name}-v0"):
        if candidate in known:
            return candidate
    raise UnknownNameError("environment", name, known)
