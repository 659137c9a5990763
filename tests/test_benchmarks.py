"""docs/reference/benchmarks.md shows benchmarks/results.json, and nothing else needs benchmarks/."""

import json
import re

import pytest


@pytest.fixture
def results(root):
    """The module that renders the page; the suite runs without benchmarks/ too."""
    if not (root / "benchmarks").exists():
        pytest.skip("benchmarks/ was removed")
    import importlib

    return importlib.import_module("benchmarks.results")


def test_the_page_is_what_the_results_say(root, results):
    text = (root / "docs/reference/benchmarks.md").read_text(encoding="utf-8")
    parts = json.loads((root / "benchmarks/results.json").read_text(encoding="utf-8"))
    assert list(parts) == list(results.TITLES)
    assert text == results.page(text, parts), "run ./run python -m benchmarks --render"
    # another figure is another page
    parts["gcode"]["rows"][0][1] = "1 line/s"
    assert text != results.page(text, parts)
    with pytest.raises(ValueError, match=r"benchmarks.md: expected one block .*; put it back"):
        results.page("no block", parts)


def test_the_file_of_results_is_short_and_a_row_stands_on_a_line(root, results):
    text = (root / "benchmarks/results.json").read_text(encoding="utf-8")
    parts = json.loads(text)
    assert len(text.splitlines()) <= 300 and text == results.dumped(parts)
    assert all(len(row) == 4 for part in parts.values() for row in part["rows"])


def test_nothing_of_the_product_and_no_other_test_names_benchmarks(root):
    places = [root / "dvc.yaml", *(root / "pipeline").rglob("*.py"), *(root / "stages").rglob("*.py")]
    places += [
        path
        for path in (root / "tests").rglob("*.py")
        if path.name not in ("test_benchmarks.py", "test_house.py")
    ]
    named = re.compile(r"benchmarks[./]|(from|import) benchmarks")
    assert [str(path) for path in places if named.search(path.read_text(encoding="utf-8"))] == []
