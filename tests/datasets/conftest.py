"""What all tests of data sets share."""

import pytest


@pytest.fixture(autouse=True)
def _users_objects_of_a_test_are_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recipes make users' objects known to the process: later tests shall not know them."""
    monkeypatch.setattr("simtrack.objects.registry._registered", {})
