"""YAML files that users write: read safely, validated strictly, refused with file, field and what is allowed."""

import re
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from simtrack.errors import FileFormatError

MAX_BYTES = 1_000_000

Name: TypeAlias = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Range: TypeAlias = tuple[float, float]
Vector: TypeAlias = tuple[float, float, float]


class Strict(BaseModel):
    """Refuses unknown fields by naming the known ones, and pairs [low, high] that are the wrong way round."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            known = {field.alias or name for name, field in cls.model_fields.items()}
            if unknown := sorted(str(key) for key in data if key not in known):
                message = "unknown field {unknown}; allowed: {known}"
                raise PydanticCustomError(
                    "unknown_field", message, {"unknown": ", ".join(unknown), "known": ", ".join(sorted(known))}
                )
        return data

    @model_validator(mode="after")
    def _ordered_ranges(self) -> "Strict":
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            numbers = (
                isinstance(value, tuple) and len(value) == 2 and re.search(r"\b(float|int)\b", str(field.annotation))
            )
            if numbers and value[0] > value[1]:
                raise PydanticCustomError("range", "{name} is [low, high] and low must not exceed high", {"name": name})
        return self


Document = TypeVar("Document", bound=Strict)


class _Loader(yaml.SafeLoader):
    """Safe YAML without aliases (they can blow up exponentially) and without silently repeated keys."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.constructor.ConstructorError(
                None, None, "aliases (*name) are not allowed here", self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) < len(keys):
            twice = next(key for key in keys if keys.count(key) > 1)
            raise yaml.constructor.ConstructorError(None, None, f"key '{twice}' occurs twice", node.start_mark)
        return super().construct_mapping(node, deep)


# As in YAML 1.2, only true and false are booleans: `on` is the name of a field here.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in rules if first in "tTfF" or not tag.endswith(":bool")]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_document(path: Path) -> Any:
    """The plain data in a YAML file; raises `FileFormatError`."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FileFormatError(path, "", f"larger than {MAX_BYTES} bytes, which no such file is")
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except OSError as error:
        raise FileFormatError(path, "", f"cannot be read: {error.strerror}") from error
    except yaml.MarkedYAMLError as error:
        where = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise FileFormatError(path, where, f"not valid YAML: {error.problem}") from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(path, "", f"not valid YAML: {error}") from error


def validated(model: type[Document], document: Any, path: Path, what: str) -> Document:
    """Plain data as a model, as if read from `path`; raises `FileFormatError` for the first thing that is wrong.

    `what` is what such a file describes, in the words of the message.
    """
    if not isinstance(document, dict):
        required = [field.alias or name for name, field in model.model_fields.items() if field.is_required()]
        raise FileFormatError(path, "", f"a {what} is a mapping with at least the fields {', '.join(required)}")
    try:
        return model.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        given = "" if isinstance(first["input"], dict) else f" (given: {first['input']!r:.80})"
        raise FileFormatError(path, field, f"{first['msg']}{given}") from error
