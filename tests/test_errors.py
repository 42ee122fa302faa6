"""Errors tell the same in every process."""

import pickle

import pytest

from simtrack.errors import (
    DatasetError,
    FileFormatError,
    InvalidValueError,
    MeshError,
    OutputExistsError,
    QueryError,
    SimtrackError,
    StageError,
    UnknownNameError,
)

RAISED = [
    UnknownNameError("scene", "lap", ("lab", "workbench")),
    FileFormatError("scene.yaml", "objects", "missing"),
    MeshError("mug.obj", "has no face"),
    InvalidValueError("stamp", 3, "0 to 2"),
    OutputExistsError("runs/a"),
    DatasetError("data", "is of another recipe"),
    QueryError("no such relation"),
    StageError("tracker", "a:B", "has no update"),
]


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_an_error_of_a_worker_is_the_error_of_its_caller(error: SimtrackError) -> None:
    told = pickle.loads(pickle.dumps(error))
    assert type(told) is type(error)
    assert str(told) == str(error)
    assert vars(told) == vars(error)
