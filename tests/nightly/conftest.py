"""The toy project as most tests of the nights find it."""

import pytest

from tests.nightly.toy_nights import Project, entered


@pytest.fixture(scope="session")
def first(tmp_path_factory):
    """The toy project after its first night, which promoted."""
    return Project(tmp_path_factory.mktemp("nights") / "toy").make().promoted()


@pytest.fixture
def project(first, tmp_path, monkeypatch):
    """A copy of it, and this process in it."""
    return entered(first, tmp_path / "toy", monkeypatch)
