"""What the JSON files of graphs share: building blocks of their schemas, and reading with clear errors."""

from pathlib import Path
from typing import Annotated, TypeAlias, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from simtrack.errors import FileFormatError

MAX_BYTES = 512 * 1024 * 1024
"""Larger files are refused before they are read."""

Number: TypeAlias = Annotated[float, Field(allow_inf_nan=False)]
Positive: TypeAlias = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Triple: TypeAlias = tuple[Number, Number, Number]
Row: TypeAlias = tuple[Number, Number, Number, Number]
Matrix: TypeAlias = tuple[Row, Row, Row, Row]
Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=256)]


class JsonModel(BaseModel):
    """A JSON object that has the stated fields and no others."""

    model_config = ConfigDict(extra="forbid")


Document = TypeVar("Document", bound=BaseModel)


def read_bounded(path: Path) -> str:
    """Text of a file.

    Raises:
        FileFormatError: it cannot be read, is no text or is too large.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FileFormatError(path, "", f"larger than {MAX_BYTES} bytes")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, "", f"cannot be read: {error}") from None


def parse_document(schema: type[Document], text: str, source: str | Path) -> Document:
    """JSON text as a value of the schema; `source` is named in errors.

    Raises:
        FileFormatError: the text is not of the schema; names field and reason.
    """
    try:
        return schema.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        raise FileFormatError(source, ".".join(map(str, first["loc"])), first["msg"]) from None
