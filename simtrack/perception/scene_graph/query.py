"""The text form of a query: ``on workbench``, ``? left-of multimeter``, ``relay ? materialbox``, ``on tray @ 12.5``."""

from dataclasses import dataclass

from simtrack.contracts import NANOSECONDS
from simtrack.errors import QueryError
from simtrack.perception.scene_graph.relations import RELATIONS

_VARIANTS = {
    "strict": ("strict", True),
    "relaxed": ("strict", False),
    "projection": ("projection", True),
    "half-space": ("projection", False),
}
_FORMS = "'[SUBJECT] RELATION[:VARIANT] [REFERENCE] [@ SECONDS]', with ? for anything"


@dataclass(frozen=True, slots=True)
class Query:
    """A question to a scene graph; None leaves a place open."""

    relation: str | None = None
    """One of `relations.RELATIONS`."""
    reference: str | None = None
    """Name of an entity, or a class: any instance of it."""
    subject: str | None = None
    """Name of an entity, or a class: any instance of it."""
    strict: bool | None = None
    """Variant of directions and `in`; None for the live one."""
    projection: bool | None = None
    """Variant of directions; None for the live one."""
    at: int | None = None
    """Nanoseconds; None for now."""


def parse_query(text: str) -> Query:
    """Parse the text form.

    Raises:
        QueryError: the text has another form, or names no known relation or variant.
    """
    body, _, time = text.partition("@")
    words = body.split()
    places: list[str | None]
    if len(words) == 3:
        places = [*words]
    elif len(words) == 2 and _is_relation(words[0]):
        places = [None, *words]
    elif len(words) == 2 and _is_relation(words[1]):
        places = [*words, None]
    elif len(words) == 1 and _is_relation(words[0]):
        places = [None, words[0], None]
    else:
        raise QueryError(f"cannot read query {text!r}; expected {_FORMS}. Relations: {', '.join(RELATIONS)}")
    subject, relation, reference = (None if place == "?" else place for place in places)
    name, *variants = (relation or "").split(":")
    if name and name not in RELATIONS:
        raise QueryError(f"unknown relation {name!r} in query {text!r}. Relations: {', '.join(RELATIONS)}")
    chosen: dict[str, bool] = {}
    for variant in variants:
        if variant not in _VARIANTS:
            raise QueryError(f"unknown variant {variant!r} in query {text!r}. Variants: {', '.join(_VARIANTS)}")
        key, value = _VARIANTS[variant]
        chosen[key] = value
    return Query(
        relation=name or None,
        reference=reference,
        subject=subject,
        strict=chosen.get("strict"),
        projection=chosen.get("projection"),
        at=_stamp(time, text) if "@" in text else None,
    )


def _is_relation(word: str) -> bool:
    return word.split(":")[0] in RELATIONS


def _stamp(time: str, text: str) -> int:
    try:
        return round(float(time) * NANOSECONDS)
    except (ValueError, OverflowError):
        raise QueryError(f"{time.strip()!r} in query {text!r} is no time; expected seconds, e.g. '@ 12.5'") from None
