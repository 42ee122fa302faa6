"""Dataclass trees (maps, object models, robots) as bytes and back, without pickle and without code from files.

The bytes are a zip of ``tree.json`` (everything but arrays) and one ``.npy`` an array, so `numpy.load` opens it as an
``.npz``. Decoding follows the type hints of the class that the caller names: nothing in the bytes chooses a type.
"""

import io
import json
import math
import types
import typing
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, get_args, get_origin

import numpy as np

T = TypeVar("T")

MAX_BYTES = 2**30
"""Largest archive, unpacked."""
_MAX_MEMBERS = 100_000
_BROKEN = (zipfile.BadZipFile, zlib.error, KeyError, EOFError, ValueError, NotImplementedError, RuntimeError, OSError)
"""What reading a damaged archive raises; ValueError for offsets below zero, RuntimeError for encrypted members and JSON
nested beyond recursion."""
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same tree gives the same bytes on every day


class ArchiveError(ValueError):
    """Bytes that are no such archive; the caller knows the file and says so."""


def encode(value: object) -> bytes:
    """Bytes of a dataclass, or a tuple or mapping with string keys of such, of arrays, numbers, strings and None."""
    arrays: list[np.ndarray] = []
    tree = json.dumps(_to_tree(value, arrays), separators=(",", ":"))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(_member("tree.json"), tree)
        for index, array in enumerate(arrays):
            data = io.BytesIO()
            np.lib.format.write_array(data, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            archive.writestr(_member(f"{index}.npy"), data.getvalue())
    return buffer.getvalue()


def decode(kind: type[T] | Any, data: bytes) -> T:
    """Value of the type that `encode` was given; `kind` may be generic, as in ``dict[str, ObjectModel]``.

    Raises `ArchiveError` for anything else, before memory is taken for it.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > _MAX_MEMBERS or sum(member.file_size for member in members) > MAX_BYTES:
                raise ArchiveError(f"unpacks to more than {MAX_BYTES} bytes or {_MAX_MEMBERS} members")
            return _from_tree(kind, json.loads(archive.read("tree.json")), archive, "")
    except ArchiveError:
        raise
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ArchiveError(f"tree.json: {error}") from error
    except _BROKEN as error:
        raise ArchiveError(f"not a readable archive: {error}") from error


def _member(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, date_time=_EPOCH)
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


def _to_tree(value: object, arrays: list[np.ndarray]) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _to_tree(getattr(value, field.name), arrays) for field in fields(value) if field.init}
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return len(arrays) - 1
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {str(key): _to_tree(entry, arrays) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_to_tree(entry, arrays) for entry in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"cannot archive a {type(value).__name__}")


def _from_tree(kind: Any, node: Any, archive: zipfile.ZipFile, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if node is None and type(None) in arguments:
            return None
        (kind,) = (argument for argument in arguments if argument is not type(None))
        return _from_tree(kind, node, archive, where)
    if origin is np.ndarray:
        return _array(arguments, _expect(int, node, where), archive, where)
    if is_dataclass(kind):
        return _instance(kind, _expect(dict, node, where), archive, where)
    if origin in (dict, Mapping):
        entries = _expect(dict, node, where)
        return {key: _from_tree(arguments[1], entry, archive, f"{where}[{key}]") for key, entry in entries.items()}
    if origin is tuple:
        entries = _expect(list, node, where)
        kinds = [arguments[0]] * len(entries) if len(arguments) == 2 and arguments[1] is Ellipsis else arguments
        if len(kinds) != len(entries):
            raise ArchiveError(f"{where}: {len(entries)} entries, expected {len(kinds)}")
        pairs = zip(kinds, entries, strict=True)
        return tuple(_from_tree(kind, entry, archive, f"{where}[{i}]") for i, (kind, entry) in enumerate(pairs))
    if origin is typing.Literal:
        if node not in arguments:
            raise ArchiveError(f"{where}: {node!r}, expected one of {', '.join(map(repr, arguments))}")
        return node
    if isinstance(kind, type) and issubclass(kind, Enum):
        try:
            return kind(node)
        except ValueError as error:
            raise ArchiveError(f"{where}: {error}") from error
    if kind is float and isinstance(node, int) and not isinstance(node, bool):
        return float(node)
    return _expect(kind, node, where)


def _instance(kind: Any, node: dict[str, Any], archive: zipfile.ZipFile, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    known = {field.name: field for field in fields(kind) if field.init}
    required = {name for name, field in known.items() if field.default is field.default_factory is MISSING}
    if not required <= set(node) <= set(known):
        raise ArchiveError(f"{where or kind.__name__}: fields {sorted(node)}, expected {sorted(known)}")
    values = {name: _from_tree(hints[name], node[name], archive, f"{where}.{name}") for name in node}
    try:
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise ArchiveError(f"{where or kind.__name__}: {error}") from error


def _expect(kind: Any, node: Any, where: str) -> Any:
    if not isinstance(node, kind) or (isinstance(node, bool) and kind is not bool):
        raise ArchiveError(f"{where}: {type(node).__name__}, expected {kind.__name__}")
    return node


def _array(arguments: tuple[Any, ...], index: int, archive: zipfile.ZipFile, where: str) -> np.ndarray:
    data = archive.read(f"{index}.npy")
    stream = io.BytesIO(data)
    try:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ArchiveError(f"{where}: unknown version of the npy format")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    except ValueError as error:
        raise ArchiveError(f"{where}: {error}") from error
    expected = np.dtype(get_args(arguments[1])[0])
    if dtype != expected or fortran:
        raise ArchiveError(f"{where}: array of {dtype}, expected {expected} in row-major order")
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ArchiveError(f"{where}: shape {shape} does not match {len(data) - stream.tell()} bytes")
    return np.frombuffer(data, dtype=dtype, offset=stream.tell()).reshape(shape).copy()
