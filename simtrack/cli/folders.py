"""Folders of results that are there as a whole or not at all."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree


@contextmanager
def new_folder(folder: Path, overwrite: bool, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Iterator[Path]:
    """A folder to work in, beside the wanted one, which it becomes if all goes well; else nothing is left of it.

    Args:
        folder: the wanted one.
        overwrite: whether results in it may be replaced.
        files: names of results, which are removed from an existing folder; nothing else is.
        folders: likewise.

    Raises:
        OutputExistsError: the wanted one exists and may not be overwritten.
        InvalidValueError: it is a file, or cannot be written.
    """
    from simtrack.errors import InvalidValueError, OutputExistsError

    if folder.exists() and not folder.is_dir():
        raise InvalidValueError("out", str(folder), "a folder, but this is a file")
    if folder.exists() and not overwrite:
        raise OutputExistsError(folder)
    work = folder.with_name(f".{folder.name}.part")
    try:
        work.parent.mkdir(parents=True, exist_ok=True)
        rmtree(work, ignore_errors=True)
        work.mkdir()
    except OSError as error:
        raise InvalidValueError("out", str(folder), f"a folder that can be written ({error.strerror})") from error
    try:
        yield work
        _replace(folder, work, files, folders)
    finally:
        rmtree(work, ignore_errors=True)


def _replace(folder: Path, work: Path, files: Sequence[str], folders: Sequence[str]) -> None:
    """Move the results into place; of an older folder, its results are removed and nothing else."""
    if not folder.exists():
        work.rename(folder)
        return
    for name in files:
        (folder / name).unlink(missing_ok=True)
    for name in folders:
        rmtree(folder / name, ignore_errors=True)
    for made in work.iterdir():
        made.rename(folder / made.name)
