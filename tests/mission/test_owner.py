"""The owner's net: params files of version 0.2, the log of their own printer, every stage, and the pages.

It is played before and after each change. A key that was renamed since must be refused with its new name."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.foreign import hot_end
from tests.foreign.hot_end_files import write_klippy_log
from tests.mission.toy_temperature import (
    LIMITS,
    PARAMS,
    ROOT,
    Refused,
    beadline,
    begin,
    declare,
    declared,
    play,
    stages_between,
)

pytestmark = pytest.mark.xdist_group("toy_temperature")
OWNER = Path(__file__).parent / "owner"  # params.yaml and params.expert.yaml as version 0.2 shipped them
# toy sizes under the names of version 0.2, as it was shipped: leave them as they are
SIZES_0_2 = {
    "execution.jobs": 1,
    "panel.steps": 300,
    "panel.judging.plants": 6,
    "panel.judging.starts_degC": [20],
    "panel.judging.sequence_offsets_degC": [0, 5],
    "panel.training.plants": 4,
    "panel.training.starts_degC": [20],
    "panel.training.sequence_offsets_degC": [],
    "tune_weights.practical_initial": 6,
    "tune_weights.practical_evaluations": 8,
    "evaluate_temperature.resamples": 20,
    "certify.plants": 60,
    "certify.resamples": 20,
}
MOST_REMEDIES = 60


# ---- the product's remedies, followed to the letter


def follow_remedies(folder: Path, attempt: Callable[[], Any]) -> list[str]:
    """Calls `attempt` until it is no more refused, and does to the params files what each refusal says; the
    refusals. Raises Refused if one names no remedy that stands in the table below."""
    followed: list[str] = []
    for _ in range(MOST_REMEDIES):
        try:
            attempt()
            return followed
        except Refused as refused:
            if not any(_follow(folder, pattern, apply, str(refused)) for pattern, apply in REMEDIES):
                raise
            followed.append(str(refused))
    raise Refused(f"{MOST_REMEDIES} remedies were followed and no end: {followed[-1]}")


def _follow(folder: Path, pattern: str, apply: Callable[..., None], sentence: str) -> bool:
    found = re.search(pattern, sentence)
    if found is None:
        return False
    files = {name: yaml.safe_load((folder / name).read_text(encoding="utf-8")) for name in PARAMS}
    apply(files, *found.groups())
    for name, sections in files.items():
        text = yaml.safe_dump(sections, sort_keys=False, allow_unicode=True)
        (folder / name).write_text(text, encoding="utf-8")
    return True


def _take(files: dict[str, dict], dotted: str) -> tuple[str, Any]:
    """Removes a key or a section; the file that it stood in, and its value."""
    *parents, key = dotted.split(".")
    for name, sections in files.items():
        for parent in parents:
            sections = sections.get(parent, {})
        if key in sections:
            return name, sections.pop(key)
    raise KeyError(f"{dotted} stands in no file, and the product refuses it")


def _put(files: dict[str, dict], name: str, dotted: str, value: Any) -> None:
    *parents, key = dotted.split(".")
    sections = files[name]
    for parent in parents:
        sections = sections.setdefault(parent, {})
    sections[key] = value


def rename(files: dict[str, dict], old: str, new: str) -> None:
    name, value = _take(files, old)
    _put(files, name, new, value)


def remove(files: dict[str, dict], dotted: str) -> None:
    _take(files, dotted)


def add(files: dict[str, dict], dotted: str) -> None:
    """The value that this version ships."""
    for name in PARAMS:
        value: Any = yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))
        for key in dotted.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            _put(files, name, dotted, value)
            return
    raise KeyError(f"{dotted} is asked for, and no file that is shipped has it")


REMEDIES: list[tuple[str, Callable[..., None]]] = [
    (r"([\w.]+) was renamed to ([\w.]+)", rename),
    (r"([\w.]+) was retired: ", remove),
    (r"section (\w+) is missing; add ", add),
    (r"([\w.]+) is missing; add it", add),
    (r"([\w.]+) is unknown; remove it", remove),
    (r"(\w+) is no section; remove it", remove),
    (r"(\w+) has moved to \S+; delete it here", remove),
]


def test_a_key_that_the_owner_lacks_is_asked_for_by_name_and_then_found(tmp_path):
    folder = begin(tmp_path / "owner", OWNER)
    text = (folder / "params.expert.yaml").read_text(encoding="utf-8")
    (folder / "params.expert.yaml").write_text(text.replace("  rate_percent_per_step: 5.0\n", ""))
    declare(folder, {"generate_probing.samples": 200})
    followed = follow_remedies(folder, lambda: play(folder, "probe_machine"))
    assert any("generate_probing.rate_percent_per_step is missing; add it" in one for one in followed)
    assert (folder / "datasets/probe_machine").is_dir()


def test_a_refusal_without_a_remedy_ends_the_owner_s_way(tmp_path):
    folder = begin(tmp_path / "owner", OWNER)
    declare(folder, {"generate_probing.samples": 2})
    with pytest.raises(Refused, match="generate_probing.samples is 2 but must be at least"):
        follow_remedies(folder, lambda: play(folder, "probe_machine"))


# ---- the whole way


@pytest.fixture(scope="session")
def owner_project(made_once) -> Path:
    """The owner's folder after all stages."""

    def make(folder: Path) -> None:
        declare(begin(folder, OWNER), SIZES_0_2)
        log = folder / "klippy.log"
        log.write_bytes(write_klippy_log(hot_end.record_print(np.random.default_rng(5))))
        follow_remedies(folder, lambda: beadline(folder, "init", str(log), "--copy"))
        outputs = declared(folder, "plant")["outputs"]
        asked = [{key: LIMITS[key] for key in LIMITS if output.get(key) is None} for output in outputs]
        filled = [output | more for output, more in zip(outputs, asked, strict=True)]
        declare(folder, {"plant.outputs": filled})
        for stage in stages_between("ingest", "report"):
            follow_remedies(folder, lambda stage=stage: play(folder, stage))

    return made_once("owner_0_2", make)


@pytest.fixture
def verdict(owner_project) -> dict[str, Any]:
    told = json.loads((owner_project / "datasets/report/figures.json").read_text(encoding="utf-8"))
    return told["verdicts"]["temperature"]


@pytest.mark.full
def test_the_owner_of_version_0_2_gets_a_verdict_on_their_printer_and_pages_that_say_it(
    owner_project, verdict
):
    assert verdict["decision"] and verdict["reason"]
    for page in ("index", "temperature"):
        text = (owner_project / f"reports/{page}.html").read_text(encoding="utf-8")
        assert verdict["decision"] in text, page


@pytest.mark.full
def test_the_printer_s_own_controller_is_among_the_judged(owner_project):
    figures = json.loads((owner_project / "datasets/evaluate_temperature/figures.json").read_text())
    assert {"printer_pid", "subspace_lqg", "hold"} <= set(figures["contestants"])


@pytest.mark.full
def test_ready_on_the_page_means_a_file_and_nothing_else_does(owner_project, verdict):
    told = json.loads((owner_project / "datasets/export_controllers/exported.json").read_text())
    assert bool(told["temperature"]["files"]) == verdict["decision"].startswith("Ready")
    assert told["temperature"]["files"] or told["temperature"]["why"]
