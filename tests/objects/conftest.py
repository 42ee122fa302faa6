"""A cache of their own for the tests of objects, and no deadline for a single example on a busy machine."""

from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("no-deadline", deadline=None)
settings.load_profile("no-deadline")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMTRACK_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
