"""The loop of training: an interrupted one ends where an uninterrupted one does. Networks: what goes into a file."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import FileFormatError, InvalidValueError
from tests.training.data import write_dataset

torch = pytest.importorskip("torch", reason="training needs the extra train")

from simtrack.training import networks  # noqa: E402
from simtrack.training.loop import CHECKPOINT, Budget, Progress, rate, restored_network, train  # noqa: E402


class Line:
    """Learns a straight line through noisy points."""

    name, batch_size, learning_rate = "line", 8, 0.5

    def __init__(self, width: int = 1) -> None:
        self.width = width

    def network(self):
        return torch.nn.Sequential(
            torch.nn.Unflatten(1, (1, 1, 1)), torch.nn.Conv2d(1, self.width, 1), torch.nn.Flatten()
        )

    def batch(self, rng: np.random.Generator):
        x = torch.from_numpy(rng.standard_normal((self.batch_size, 1)).astype(np.float32))
        return x, 3.0 * x + 1.0

    def loss(self, network, batch):
        return (network(batch[0]) - batch[1]).square().mean()

    def validate(self, network) -> dict[str, float]:
        x = torch.linspace(-1, 1, 5)[:, None]
        return {"error": float((network(x) - 3.0 * x - 1.0).abs().max())}


class Stop(Exception):
    pass


def test_a_network_learns_and_an_interrupted_training_carries_on(tmp_path: Path) -> None:
    budget, told = Budget(8 * 80), list[Progress]()
    whole = train(Line(), tmp_path / "whole", budget, told.append, validated_every=20)
    assert told[-1].figures["error"] < 0.5  # of a line that rises from -2 to 4

    def stop(progress: Progress) -> None:
        if progress.step == 50:
            raise Stop

    with pytest.raises(Stop):
        train(Line(), tmp_path / "parts", budget, stop, validated_every=20, saved_every=0.0)
    parts = train(Line(), tmp_path / "parts", budget, validated_every=20)
    for a, b in zip(whole.state_dict().values(), parts.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    lines = [json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [20, 40, 60, 80]
    again = restored_network(Line(), tmp_path / "whole")
    assert all(torch.equal(a, b) for a, b in zip(again.state_dict().values(), whole.state_dict().values(), strict=True))


def test_checkpoints_of_others_are_refused(tmp_path: Path) -> None:
    train(Line(), tmp_path, Budget(8))
    with pytest.raises(FileFormatError, match="another network"):
        train(Line(width=2), tmp_path, Budget(16))
    (tmp_path / CHECKPOINT).write_bytes(b"nonsense")
    with pytest.raises(FileFormatError, match="no checkpoint that can be read"):
        train(Line(), tmp_path, Budget(16))
    with pytest.raises(FileFormatError, match="train first"):
        restored_network(Line(), tmp_path / "nowhere")


def test_the_rate_rises_stays_and_falls() -> None:
    assert rate(0.0, 0) < 0.02 < rate(0.0, 5000) == 1.0
    falling = [rate(spent, 10_000) for spent in np.linspace(0.55, 1.0, 20)]
    assert all(a >= b for a, b in pairwise(falling))
    assert np.isclose(falling[-1], 0.02)
    assert Budget(100, minutes=1.0).spent(10, 30.0) == 0.5
    assert Budget(100).spent(10, 30.0) == 0.1
    for wrong in ({"samples": 0}, {"samples": 1, "minutes": 0.0}):
        with pytest.raises(InvalidValueError):
            Budget(**wrong)  # type: ignore[arg-type]


def test_both_networks_train_and_answer_alike_in_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of each, 16-bit weights against 32-bit ones, and the files in the detector."""
    pytest.importorskip("onnx", reason="networks are written with onnx, of the extra train")
    from simtrack.objects import load_object
    from simtrack.perception.detection.keypoint_detector import KeypointDetector
    from simtrack.perception.detection.onnx_network import open_network
    from simtrack.training import box_task, detector, keypoint_task

    monkeypatch.setattr(keypoint_task.KeypointTask, "batch_size", 4)
    monkeypatch.setattr(box_task.BoxTask, "batch_size", 2)
    monkeypatch.setattr(detector, "SAMPLES", {"keypoints": 8, "boxes": 2})
    config = detector.TrainingConfig(write_dataset(tmp_path / "data"), tmp_path / "out")
    source = detector.prepared(config)
    for part in detector.PARTS:
        path = detector.train_part(part, config)
        network = open_network(path)
        assert network.about()["classes"] == ["relay"]
        trained = restored_network(
            detector.make_task(part, source, tmp_path / "out" / "shards"), tmp_path / "out" / part
        )
        rng = np.random.default_rng(0)
        shapes = [[size if isinstance(size, int) else 3 for size in shape] for shape in network.inputs.values()]
        given = [rng.standard_normal(shape).astype(np.float32) for shape in shapes]
        answered = network.run(dict(zip(network.inputs, given, strict=True)))
        with torch.no_grad():
            expected = trained(*(torch.from_numpy(array) for array in given))
        for ours, theirs in zip(answered, expected, strict=True):
            assert np.allclose(ours, theirs.numpy(), atol=0.02 * float(theirs.abs().max()) + 1e-3)
    relay = load_object("relay")
    made = KeypointDetector({"relay": relay}, tmp_path / "out")
    assert made.class_names == ("relay",)
    assert sum(path.stat().st_size for path in (tmp_path / "out").glob("*.onnx")) < 12_000_000


def test_bfloat16_is_used_while_learning_only_and_is_close(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "bfloat16_is_native", lambda: True)
    torch.manual_seed(3)
    network = networks.BoxNetwork(2).train()
    image = torch.randn(2, 5, 64, 64)
    halved = network(image)
    assert all(answer.dtype == torch.float32 for answer in halved)
    monkeypatch.setattr(networks, "bfloat16_is_native", lambda: False)
    exact = network(image)
    assert not torch.equal(halved[0], exact[0])
    for a, b in zip(halved, exact, strict=True):
        assert torch.linalg.norm(a - b) < 0.05 * torch.linalg.norm(b)
    network.eval()
    told = network(image)
    monkeypatch.setattr(networks, "bfloat16_is_native", lambda: True)
    assert all(torch.equal(a, b) for a, b in zip(network(image), told, strict=True))
