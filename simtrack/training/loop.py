"""The loop in which a network learns: steps that can be repeated, checkpoints, an averaged network, a log."""

import copy
import json
import pickle
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - extra `train`
from torch import Tensor, nn  # pyright: ignore[reportMissingImports] - extra `train`

from simtrack.errors import FileFormatError, InvalidValueError

CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"
STEADY = 0.55
"""Share of the training before the learning rate falls, along half a cosine."""
WARM_STEPS = 200
LAST_RATE = 0.02
"""Learning rate at the end, in shares of the highest."""
AVERAGED = 0.998
"""Decay of the averaged network."""
DECAY = 0.02
"""Of weights (AdamW)."""
LARGEST_GRADIENT = 5.0


class Task(Protocol):
    """A network and how it learns."""

    name: str
    batch_size: int
    learning_rate: float

    def network(self) -> nn.Module:
        """A new one."""
        ...

    def batch(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Random samples."""
        ...

    def loss(self, network: Any, batch: tuple[Tensor, ...]) -> Tensor:
        """Of a batch."""
        ...

    def validate(self, network: Any) -> dict[str, float]:
        """Figures from held-out samples."""
        ...


@dataclass(frozen=True, slots=True)
class Budget:
    """How long a network learns."""

    samples: int
    """After so many it has learned."""
    minutes: float | None = None
    """Of computing time over all calls; the schedule ends then if that is earlier."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise InvalidValueError("Budget.samples", self.samples, "1 or more")
        if self.minutes is not None and not self.minutes > 0.0:
            raise InvalidValueError("Budget.minutes", self.minutes, "> 0")

    def spent(self, samples: int, seconds: float) -> float:
        """Share of it that is used up, 0 to 1."""
        share = samples / self.samples
        return min(max(share, seconds / (60.0 * self.minutes) if self.minutes else 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class Progress:
    """How a training fares."""

    task: str
    step: int
    samples: int
    seconds: float
    """Of computing time."""
    spent: float
    """Share of the budget."""
    loss: float
    """Running mean."""
    figures: dict[str, float]
    """Of the last validation."""


def train(
    task: Task,
    folder: Path,
    budget: Budget,
    told: Callable[[Progress], None] | None = None,
    *,
    saved_every: float = 120.0,
    validated_every: int = 1500,
) -> nn.Module:
    """Let a network learn, or carry on where a stopped run was; returns the averaged network.

    Step n draws its samples from (seed, n) alone, so a run that was interrupted meets the same ones.

    Args:
        task: what is learned.
        folder: where checkpoint and log are kept.
        budget: how long.
        told: called after every validation and every 50 steps.
        saved_every: seconds of the wall clock between checkpoints.
        validated_every: steps between validations.

    Raises:
        FileFormatError: the folder's checkpoint is that of another network.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(budget.seed)
    network = task.network().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    averaged = copy.deepcopy(network).eval()
    optimizer = torch.optim.AdamW(network.parameters(), lr=task.learning_rate, weight_decay=DECAY)
    state = _restored(folder / CHECKPOINT, network, averaged, optimizer)
    step, seconds, figures = int(state["step"]), float(state["seconds"]), dict(state["figures"])
    running, saved_at = float(state["loss"]), time.monotonic()
    network.train()
    while (spent := budget.spent(step * task.batch_size, seconds)) < 1.0:
        began = time.process_time()
        for group in optimizer.param_groups:
            group["lr"] = task.learning_rate * rate(spent, step)
        loss = task.loss(network, task.batch(np.random.default_rng([budget.seed, step])))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        _average(averaged, network, min(AVERAGED, step / (step + 10.0)))
        step += 1
        seconds += time.process_time() - began
        running = loss.item() if step == 1 else 0.98 * running + 0.02 * loss.item()
        over = budget.spent(step * task.batch_size, seconds) >= 1.0
        progress = Progress(task.name, step, step * task.batch_size, seconds, spent, running, figures)
        if step % validated_every == 0 or over:
            with torch.no_grad():
                figures = {name: float(value) for name, value in task.validate(averaged).items()}
            progress = Progress(task.name, step, step * task.batch_size, seconds, spent, running, figures)
            _log(folder / LOG, progress)
        if told is not None and (step % 50 == 0 or over):
            told(progress)
        if over or time.monotonic() - saved_at > saved_every:
            state = {"step": step, "seconds": seconds, "figures": figures, "loss": running}
            parts = {"network": network, "averaged": averaged, "optimizer": optimizer}
            _save(folder / CHECKPOINT, state | {name: part.state_dict() for name, part in parts.items()})
            saved_at = time.monotonic()
    return averaged


def rate(spent: float, step: int) -> float:
    """Learning rate in shares of the highest one, when so much of the budget is used up."""
    warm = min(1.0, (step + 1) / WARM_STEPS)
    if spent <= STEADY:
        return warm
    falling = 0.5 * (1.0 + np.cos(np.pi * (spent - STEADY) / (1.0 - STEADY)))
    return float(warm * (LAST_RATE + (1.0 - LAST_RATE) * falling))


def restored_network(task: Task, folder: Path) -> nn.Module:
    """The averaged network of a checkpoint.

    Raises:
        FileFormatError: there is none, or it is another network's.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        raise FileFormatError(path, "", "no checkpoint; train first")
    averaged = task.network()
    averaged.load_state_dict(_loaded(path)["averaged"])
    return averaged.eval()


def _average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    with torch.no_grad():
        for ours, theirs in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
            if ours.is_floating_point():
                ours.lerp_(theirs, 1.0 - decay)


def _restored(path: Path, network: nn.Module, averaged: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    if not path.is_file():
        return {"step": 0, "seconds": 0.0, "figures": {}, "loss": 0.0}
    state = _loaded(path)
    try:
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
    except (KeyError, RuntimeError, ValueError) as error:
        reason = f"the checkpoint of another network (other classes?): {error}; choose another --out"
        raise FileFormatError(path, "", reason) from error
    return state


def _loaded(path: Path) -> dict[str, Any]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise FileFormatError(path, "", f"no checkpoint that can be read: {error}") from error
    return state


def _save(path: Path, state: dict[str, Any]) -> None:
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)


def _log(path: Path, progress: Progress) -> None:
    with path.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(progress)) + "\n")
