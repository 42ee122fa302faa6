"""How the command's help reads: folded to the terminal's width, no breaks in mid-sentence, plain names of types."""

import inspect
import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from types import NoneType
from typing import TYPE_CHECKING, Any, TextIO, get_args

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

_BOX = tuple("│╭╰")
_STYLE = re.compile(r"\x1b\[[0-9;]*m")
_ARGUMENT = re.compile(r" {4}\w+: ")


def unbroken(function: Callable[..., int]) -> Callable[..., int]:
    """The function, each paragraph and each argument in its docstring on one line: tyro keeps some of the breaks."""
    lines: list[str] = []
    for line in inspect.cleandoc(function.__doc__ or "").splitlines():
        if line and lines and lines[-1] and not _ARGUMENT.match(line):
            lines[-1] += " " + line.strip()
        else:
            lines.append(line)
    function.__doc__ = "\n".join(lines)
    return function


def optional_values() -> "ConstructorRegistry":
    """What tyro is to make of ``X | None``: an X, and None where None is written; the help tells of X alone."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

    registry = ConstructorRegistry()

    @registry.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
        if len(kinds) != 1 or NoneType not in get_args(info.type):
            return None
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        return _or_none(spec) if isinstance(spec, PrimitiveConstructorSpec) else None

    return registry


def _or_none(spec: "PrimitiveConstructorSpec[Any]") -> "PrimitiveConstructorSpec[Any]":
    return replace(
        spec,
        instance_from_str=lambda words: None if words == ["None"] else spec.instance_from_str(words),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )


class _Buffer(io.StringIO):
    """Tells of itself what standard output would: colours and characters of boxes follow from it."""

    def __init__(self, of: TextIO) -> None:
        super().__init__()
        self._of = of

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride] - read-only in fact
        return self._of.encoding

    def isatty(self) -> bool:
        return self._of.isatty()


@contextmanager
def folded() -> Iterator[None]:
    """Fold what is printed meanwhile to the terminal's width; boxes are drawn to it already."""
    buffer = _Buffer(sys.stdout)
    try:
        with redirect_stdout(buffer):
            yield
    finally:
        width = max(40, shutil.get_terminal_size().columns)
        for line in buffer.getvalue().splitlines():
            print("\n".join(_fold(line, width)))


def _fold(line: str, width: int) -> list[str]:
    shown = _STYLE.sub("", line)
    if len(shown) <= width or shown.startswith(_BOX):
        return [line]
    indent = "       " if shown.startswith("usage:") else ""
    return textwrap.wrap(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
