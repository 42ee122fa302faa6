"""From evidence to the tree: which parent supports each child, without cycles.

The paper maximises Eq. 3 over all planes below a child. Here observed contact comes first, because a gap of 30 cm costs
less in Eq. 3 than a quarter of the area does, and Eq. 3 decides among equals and wherever no contact was observed.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.upright_boxes import horizontal_hull
from simtrack.perception.scene_graph.contact.evidence import (
    NOTHING,
    ContactConfig,
    Evidence,
    PairEvidence,
    Posed,
    SupportOption,
)
from simtrack.perception.scene_graph.contact.graph import Support, SupportKind
from simtrack.perception.scene_graph.contact.nodes import FLOOR, SCENE, EntityKind, Finding, FindingCode


class _Rank(IntEnum):
    """How much speaks for a support; the higher comes first, Eq. 3 decides among equals."""

    LIKELY = 0
    """The likeliest plane below."""
    HANGS = 1
    WITHIN = 2
    """Stands in something whose boards nobody saw."""
    BALANCED = 3
    """Touches with less than b_th of its bottom, but with its centre of mass above what it touches, or nearly so."""
    SEATED = 4
    """Eq. 1 within the noise and Eq. 2."""


@dataclass(frozen=True, slots=True)
class _Choice:
    """A parent for a child."""

    rank: _Rank
    support: Support
    others: tuple[Support, ...] = ()

    @property
    def key(self) -> tuple[int, float]:
        return int(self.rank), self.support.score


def select_supports(
    bodies: Mapping[str, Posed], evidence: Evidence, config: ContactConfig
) -> tuple[dict[str, Support], tuple[Support, ...], list[Finding]]:
    """One support for every body, further supporters, and what was doubtful."""
    findings: list[Finding] = []
    choices = {name: _choices(name, bodies, evidence, config) for name in bodies}
    taken = dict.fromkeys(bodies, 0)
    while (cycle := _cycle(choices, taken)) is not None:
        weakest = min(cycle, key=lambda name: choices[name][taken[name]].key)
        parent = choices[weakest][taken[weakest]].support.parent
        taken[weakest] += 1
        message = f"{' -> '.join([*cycle, cycle[0]])} would support one another; '{parent}' no longer supports it"
        findings.append(Finding(FindingCode.SUPPORT_CYCLE, weakest, message))
    supports: dict[str, Support] = {}
    others: list[Support] = []
    for name, options in choices.items():
        choice = options[taken[name]]
        supports[name] = choice.support
        others += choice.others
        findings += _doubts(choice, bodies[name])
    # What lies in a box may touch its underside, as far as noise lets one see; it does not support the box.
    others = [other for other in others if other.child not in _supporters(other.parent, supports)]
    return supports, tuple(others), findings


def _supporters(name: str, supports: Mapping[str, Support]) -> Iterator[str]:
    """A body and everything below it, up to the root of the tree."""
    while name != SCENE:
        yield name
        name = supports[name].parent


def _doubts(choice: _Choice, body: Posed) -> Iterator[Finding]:
    support = choice.support
    if body.node.kind is EntityKind.LAYOUT:
        return
    if support.kind is SupportKind.ROOT:
        message = "nothing below it, around it or beside it supports it; it became a child of the scene"
        yield Finding(FindingCode.UNSUPPORTED, support.child, message)
    elif not support.touching:
        message = (
            f"touches nothing that supports it; '{support.parent}' is the likeliest, {support.distance:.3f} m below"
        )
        yield Finding(FindingCode.SUPPORT_GUESSED, support.child, message)


def _cycle(choices: Mapping[str, list[_Choice]], taken: Mapping[str, int]) -> list[str] | None:
    """Names of some cycle of the chosen supports, or None."""
    done: set[str] = set()
    for start in choices:
        path: list[str] = []
        name = start
        while name != SCENE and name not in done and name not in path:
            path.append(name)
            name = choices[name][taken[name]].support.parent
        if name in path:
            return path[path.index(name) :]
        done.update(path)
    return None


def _choices(name: str, bodies: Mapping[str, Posed], evidence: Evidence, config: ContactConfig) -> list[_Choice]:
    """Everything that may support a child, best first; the scene node last."""
    root = _Choice(_Rank.LIKELY, Support(name, SCENE, SupportKind.ROOT))
    child = bodies[name]
    if child.node.kind is EntityKind.LAYOUT:
        return [root]
    found = {parent: pair for parent in bodies if (pair := evidence.get((name, parent), NOTHING)) is not NOTHING}
    choices = _touching(name, child, found, evidence, config)
    likely = [
        _on(name, p, pair, option, config, touching=False)
        for p, pair in found.items()
        for option in _below(pair, config)
    ]
    clearance = min((s.distance for s in likely), default=np.inf)
    for parent, pair in found.items():
        if pair.within is not None:
            choices.append(_Choice(_Rank.WITHIN, _on(name, parent, pair, pair.within, config, touching=True)))
        if pair.hang is not None and clearance > config.hang_clearance:
            choices += _hung(name, child, parent, pair, config)
    choices += [_Choice(_Rank.LIKELY, support) for support in likely]
    if not choices:
        choices += _onto_floor(name, bodies, found, config)
    best: dict[str, _Choice] = {}  # one way a parent
    for choice in sorted(choices, key=lambda choice: choice.key, reverse=True):
        best.setdefault(choice.support.parent, choice)
    return [*best.values(), root]


def _on(
    child: str, parent: str, pair: PairEvidence, option: SupportOption, config: ContactConfig, *, touching: bool
) -> Support:
    kind = SupportKind.INSIDE if pair.enclosure >= config.inside and touching else SupportKind.ON
    numbers = option.plane, option.height, option.distance, option.area, option.score
    return Support(child, parent, kind, *numbers, touching)


def _touching(
    name: str, child: Posed, found: Mapping[str, PairEvidence], evidence: Evidence, config: ContactConfig
) -> list[_Choice]:
    """Parents whose plane the child's bottom touches (Eq. 1 within the noise), those with enough area first (Eq. 2)."""
    contacts: dict[str, SupportOption] = {}
    for parent, pair in found.items():
        options = [o for o in _direct(pair) if abs(o.distance) <= config.contact_gap]
        if options and not _rests(parent, name, evidence, config):  # nothing stands on what stands in it
            contacts[parent] = max(options, key=lambda option: option.score)
    seated = {parent for parent, option in contacts.items() if option.area >= config.contact_area}
    hidden_by = {p for p in contacts if _hidden(p, child, contacts, seated, evidence, config)}
    hidden_by -= {p for p in hidden_by if any(_rests(p, q, evidence, config) for q in seated if q != p)}
    open_to = {parent: option for parent, option in contacts.items() if parent not in hidden_by}
    choices = []
    for parent, option in open_to.items():
        if parent in seated:
            rank = _Rank.SEATED
        elif option.area >= config.weak_area or _balanced(child, open_to.values()):
            rank = _Rank.BALANCED
        else:
            continue
        choices.append(_Choice(rank, _on(name, parent, found[parent], option, config, touching=True)))
    supports = {c.support.parent: c.support for c in choices}
    return [replace(c, others=tuple(s for p, s in supports.items() if p != c.support.parent)) for c in choices]


def _hidden(
    parent: str,
    child: Posed,
    contacts: Mapping[str, SupportOption],
    seated: set[str],
    evidence: Evidence,
    config: ContactConfig,
) -> bool:
    """Whether what rests on a parent carries the child: alone with enough area, or several together in balance."""
    between = [q for q in contacts if q != parent and _rests(q, parent, evidence, config)]
    several = [contacts[q] for q in between if contacts[q].distance <= contacts[parent].distance]
    return any(q in seated for q in between) or (len(several) >= 2 and _balanced(child, several))


def _direct(pair: PairEvidence) -> Iterator[SupportOption]:
    """Planes that were seen, and hidden ones that what was seen implies."""
    yield from pair.options
    if pair.inside is not None:
        yield pair.inside
    if pair.top is not None:
        yield pair.top


def _rests(upper: str, lower: str, evidence: Evidence, config: ContactConfig) -> bool:
    """Whether one body is seated on another, and not the other on it: what lies between hides what is below."""

    def seated(child: str, parent: str) -> bool:
        options = _direct(evidence.get((child, parent), NOTHING))
        return any(abs(o.distance) <= config.contact_gap and o.area >= config.contact_area for o in options)

    return seated(upper, lower) and not seated(lower, upper)


def _balanced(child: Posed, contacts: Iterable[SupportOption]) -> bool:
    """Whether the centre of mass is above the hull of the rectangles of contact."""
    corners = [option.corners for option in contacts]
    if not corners:
        return False
    return distance_outside(horizontal_hull(np.concatenate(corners)), child.centre_of_mass[:2]) <= 0.0


def distance_outside(outline: Float64, point: Float64) -> float:
    """Metres from (2,) a point to a convex polygon of (K, 2) corners, counter-clockwise; 0 inside."""
    ends = np.roll(outline, -1, axis=0)
    along = ends - outline
    if len(outline) >= 3 and np.all(along[:, 0] * (point - outline)[:, 1] - along[:, 1] * (point - outline)[:, 0] >= 0):
        return 0.0
    length = np.maximum(np.einsum("kd,kd->k", along, along), 1e-300)
    s = np.clip(np.einsum("kd,kd->k", point - outline, along) / length, 0.0, 1.0)
    return float(np.linalg.norm(outline + s[:, None] * along - point, axis=1).min())


def _below(pair: PairEvidence, config: ContactConfig) -> Iterator[SupportOption]:
    """Planes below a child that satisfy Eq. 2 and score in Eq. 3."""
    for option in pair.options:
        if option.area >= config.contact_area and option.score > 0.0 and option.distance > -config.contact_gap:
            yield option


def _hung(name: str, child: Posed, parent: str, pair: PairEvidence, config: ContactConfig) -> Iterator[_Choice]:
    """A flat thing before a wall hangs, one whose underside or the wall below which was seen, too; chairs do not."""
    hang = pair.hang
    if hang is None or child.node.semantic_class in config.standing_classes:
        return
    if hang.slenderness <= config.hang_slender or child.underside >= 0.3 or hang.bare >= config.hang_bare:
        plane = {"plane": hang.plane, "distance": hang.gap, "area": hang.area, "score": hang.area}
        yield _Choice(_Rank.HANGS, Support(name, parent, SupportKind.HUNG, **plane))


def _onto_floor(
    name: str, bodies: Mapping[str, Posed], found: Mapping[str, PairEvidence], config: ContactConfig
) -> Iterator[_Choice]:
    """A floor below, however far and however small the share of it that was seen."""
    for parent, pair in found.items():
        if bodies[parent].node.semantic_class == FLOOR:
            for option in pair.options:
                yield _Choice(_Rank.LIKELY, _on(name, parent, pair, option, config, touching=False))
