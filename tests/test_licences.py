"""docs/licences.md follows uv.lock: each package once, with version, and licence where it is installed."""

import importlib.util
import re

import pytest


@pytest.fixture(scope="module")
def licences(root):
    spec = importlib.util.spec_from_file_location("licences", root / ".ci/licences.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def lock(root) -> str:
    return (root / "uv.lock").read_text()


def test_the_page_is_what_the_lock_and_the_packages_say(root, licences, lock):
    shown = (root / "docs/licences.md").read_text()
    assert licences.differences(shown, licences.page(licences.locked(lock))) == []


def test_every_package_of_the_lock_stands_there_once(licences, lock):
    names = re.findall(r'^\[\[package\]\]\nname = "(.+)"', lock, re.M)
    found = licences.locked(lock)
    assert sorted([one.name for one in found] + ["beadline"]) == sorted(names)
    with_licence = {one.name for one in found if one.licence}
    assert {"numpy", "dvc", "jax", "pytest", "scipy"} <= with_licence
    assert not with_licence & {"optuna", "dvc-s3", "jax-cuda12-plugin"}  # peers, S3, GPU


def test_licences_known_from_their_projects(licences, lock):
    """As their own pages say them."""
    known = {one.name: one.licence for one in licences.locked(lock)}
    assert known["jinja2"] in ("BSD", "BSD-3-Clause")
    assert known["jax"] == known["dvc"] == "Apache-2.0"
    assert known["pydantic"] == "MIT"


def test_a_new_version_or_a_new_package_is_a_difference(licences, lock):
    packages = licences.locked(lock)
    shown = licences.page(packages)
    changed = licences.page([packages[0]._replace(version="0.0.0"), *packages[1:]])
    assert [line[0] for line in licences.differences(shown, changed)] == ["-", "+"]
    assert licences.differences(shown, licences.page(packages[1:]))


def test_a_package_that_is_not_installed_is_refused_by_name(licences):
    with pytest.raises(ValueError, match=r"uv\.lock: no-such-package is not in the environment"):
        licences.licence("no-such-package")
