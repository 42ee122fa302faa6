"""Spatial relations that are believed, against those that truly hold between the same objects.

Definitions
-----------
* Scored are ordered pairs of tracked objects (`simtrack.evaluation.tracking.match_tracks`) of the catalogue.
* True relations follow from the true shapes at the true poses by the scene graph's own definitions; the true pose of an
  object that looks alike in several poses is the one closest to the estimate. `on` is read off the physical contacts.
* A pair that lies within 1 cm of a relation's boundary in truth is not counted for that relation.
* F1 of a relation counts pairs over all evaluated frames; the macro figure is the mean over the relations that held or
  were believed at least once.
* `relations.support.f1` is the same figure for `on` between tracked objects and furniture.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Relation
from simtrack.evaluation.metrics import Metrics, measured, unmeasured
from simtrack.evaluation.pose_errors import closest_equivalent
from simtrack.evaluation.record import graph_name
from simtrack.evaluation.tracking import ObjectFrame

if TYPE_CHECKING:
    from simtrack.objects import ObjectModel
    from simtrack.perception.scene_graph import Body, RelationConfig
    from simtrack.simulation.ground_truth import Truth

BOUNDARY = 0.01
"""Metres."""


class _Counts:
    """Hits, false alarms and misses."""

    def __init__(self) -> None:
        self.both = self.only_believed = self.only_true = 0

    def add(self, believed: bool, true: bool) -> None:
        self.both += believed and true
        self.only_believed += believed and not true
        self.only_true += true and not believed

    @property
    def f1(self) -> float | None:
        whole = 2 * self.both + self.only_believed + self.only_true
        return 2 * self.both / whole if whole else None


class RelationEvaluator:
    """Counts believed and true relations."""

    def __init__(self, models: "Mapping[str, ObjectModel]", config: "RelationConfig | None" = None) -> None:
        """`models`: class name -> true model; `config`: the scene graph's thresholds."""
        from simtrack.perception.scene_graph import RELATIONS, RelationConfig, model_shapes

        self._config = config or RelationConfig()
        self._symmetries = {name: model.symmetries for name, model in models.items()}
        self._shapes = model_shapes(models)
        self._counts = {name: _Counts() for name in RELATIONS}
        self._support = _Counts()

    def observe(self, believed: Set[Relation], frames: Sequence[ObjectFrame], truth: "Truth") -> None:
        """Take the relations of one belief with the object-frames of its stamp."""
        from simtrack.perception.scene_graph import relation_margins

        tracked = [frame for frame in frames if frame.track is not None]
        self._count_support(believed, tracked, truth.contacts, set(truth.objects))
        if len(tracked) < 2:
            return
        margins = relation_margins([self._true_body(frame, truth) for frame in tracked], self._config)
        names = [graph_name(frame.track) for frame in tracked if frame.track is not None]
        for k, (relation, counts) in enumerate(self._counts.items()):
            for i, j in np.argwhere(np.abs(margins[:, :, k]) >= BOUNDARY):
                if i == j:
                    continue
                pair = tracked[i].name, tracked[j].name
                true = pair in truth.contacts if relation == "on" else bool(margins[i, j, k] >= 0.0)
                counts.add(Relation(names[i], relation, names[j]) in believed, true)

    def _true_body(self, frame: ObjectFrame, truth: "Truth") -> "Body":
        from simtrack.perception.scene_graph import Body

        assert frame.track is not None
        T_true = truth.objects[frame.name].T_map_object
        T_equivalent = closest_equivalent(frame.track.T_map_object, T_true, self._symmetries[frame.class_name])
        return Body(self._shapes[frame.class_name], T_equivalent)

    def _count_support(
        self,
        believed: Set[Relation],
        tracked: Sequence[ObjectFrame],
        contacts: Iterable[tuple[str, str]],
        objects: set[str],
    ) -> None:
        """Compare what stands on which furniture; parts of a piece (``shelf/board2``) count as the piece."""
        true: defaultdict[str, set[str]] = defaultdict(set)
        for subject, supporter in contacts:
            if supporter not in objects:
                true[subject].add(supporter.partition("/")[0])
        held: defaultdict[str, set[str]] = defaultdict(set)
        for relation in believed:
            if relation.name == "on":
                held[relation.subject].add(relation.reference.partition("/")[0])
        entities = {graph_name(frame.track) for frame in tracked if frame.track is not None}
        for frame in tracked:
            assert frame.track is not None
            furniture = held[graph_name(frame.track)] - entities
            for piece in furniture | true[frame.name]:
                self._support.add(piece in furniture, piece in true[frame.name])

    def metrics(self) -> Metrics:
        """The ``relations.*`` metrics."""
        missing = "it neither held nor was believed between tracked objects"
        metrics: Metrics = {}
        values: list[float] = []
        for name, counts in self._counts.items():
            f1 = counts.f1
            metrics[f"relations.f1.{name}"] = unmeasured("1", missing) if f1 is None else measured(f1, "1")
            values += [] if f1 is None else [f1]
        none = unmeasured("1", "no relation held between tracked objects")
        metrics["relations.f1"] = measured(float(np.mean(values)), "1") if values else none
        support = self._support.f1
        metrics["relations.support.f1"] = none if support is None else measured(support, "1")
        return metrics
