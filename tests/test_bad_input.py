"""What bad input gets: exit status 1 and one sentence with file, place, expected, found and remedy; the last good artifacts stay as they were."""

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline import artifacts, params
from pipeline.temperature.plant import plant, simulate

SAMPLES = 600


def signals(samples: int = SAMPLES, *, seed: int = 1) -> dict[str, np.ndarray]:
    """Two heaters that are switched, two zones that follow, with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([30.0, 50.0], size=(-(-samples // 5), 2)), 5, axis=0)[:samples]
    machine = plant([[0.95, 0.02], [0.01, 0.9]], [[0.02, 0.0], [0.0, 0.04]], np.eye(2), d=[20.0, 20.0])
    y = simulate(machine, u, np.array([16.0, 16.0]))[1] + 0.02 * rng.standard_normal((samples, 2))
    return {"t_s": np.arange(samples, dtype=float), "Q1": u[:, 0], "Q2": u[:, 1], "T1": y[:, 0], "T2": y[:, 1]}


def record(tree: Path, columns: dict[str, np.ndarray]) -> None:
    artifacts.write_csv(tree / "datasets/raw/temperature/rig.csv", columns)


def declare(tree: Path, changes: dict) -> None:
    """{dotted key: value} into the tree's params.yaml."""
    sections = params.read(tree / "params.yaml")
    for dotted, value in changes.items():
        *parents, key = dotted.split(".")
        inner = sections
        for parent in parents:
            inner = inner[parent]
        inner[key] = value
    (tree / "params.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))


def run(tree: Path, stage: str, monkeypatch) -> int:
    """`python -m stages.<stage>` in the tree, in this process: the imports are paid once."""
    with monkeypatch.context() as inside:
        inside.chdir(tree)
        inside.setattr(sys, "argv", [stage])
        try:
            runpy.run_module(f"stages.{stage}", run_name="__main__")
        except SystemExit as ended:
            return ended.code
    return 0


def good(tree: Path) -> dict[str, bytes]:
    """Everything that stages wrote; the recordings and the memo are not theirs to lose."""
    return {
        path.relative_to(tree).as_posix(): path.read_bytes()
        for path in tree.rglob("*")
        if path.is_file() and not path.is_relative_to(tree / "datasets/raw") and not path.is_relative_to(tree / "datasets/memo")
    }


@pytest.fixture(scope="module")
def ready(root, tmp_path_factory) -> Path:
    """A project whose record was ingested, identified and learned well."""
    tree = tmp_path_factory.mktemp("project")
    shutil.copy(root / "params.yaml", tree)
    declare(
        tree,
        {
            "plant.inputs": [{"name": f"heater_{i}", "unit": "percent", "low": 0, "high": 100} for i in (1, 2)],
            "plant.outputs": [{"name": f"zone_{i}", "unit": "degC", "reference": 35} for i in (1, 2)],
            "generate_probing.source": "recordings",
            "ingest.mapping": {
                ours: {"source": theirs, "unit": unit, "scale": 1.0, "offset": 0.0}
                for ours, theirs, unit in (
                    ("heater_1", "Q1", "percent"),
                    ("heater_2", "Q2", "percent"),
                    ("zone_1", "T1", "degC"),
                    ("zone_2", "T2", "degC"),
                )
            },
            "identify_plant.max_order": 3,
            "learn_kernel.longest_window": 6,
            "panel.steps": 60,
        },
    )
    record(tree, signals())
    with pytest.MonkeyPatch.context() as monkeypatch:
        for stage in ("ingest", "identify_plant", "learn_kernel"):
            assert run(tree, stage, monkeypatch) == 0
    return tree


@pytest.fixture
def tree(ready, tmp_path) -> Path:
    return Path(shutil.copytree(ready, tmp_path / "tree"))


@pytest.fixture
def refused(monkeypatch, capfd):
    def refused(tree: Path, stage: str) -> str:
        """The sentence with which the stage ends, once it is seen to be one, and to have left everything as it was."""
        before = good(tree)
        capfd.readouterr()
        assert run(tree, stage, monkeypatch) == 1
        printed = capfd.readouterr()
        assert printed.out == ""
        assert printed.err.count("\n") == 1, printed.err
        assert printed.err.startswith(f"{stage}: ")
        assert "; " in printed.err or " must be " in printed.err, "neither a remedy nor a bound"
        assert good(tree) == before
        return printed.err

    return refused


# ---- params.yaml


@pytest.mark.parametrize(
    ("stage", "key", "value", "said"),
    [
        ("ingest", "ingest.colour", 1, "params.yaml: ingest.colour is unknown; remove it, or use mapping, time, max_gap_s, strict"),
        ("ingest", "ingest.max_gaps", 5.0, "params.yaml: ingest.max_gaps is unknown; did you mean max_gap_s?"),
        ("ingest", "ingest.max_gap_s", -1.0, "params.yaml: ingest.max_gap_s is -1.0 but must be more than 0"),
        ("identify_plant", "identify_plant.order", 61, "params.yaml: identify_plant.order is 61 but must be at most 60"),
        ("learn_kernel", "tracking.gamma", 1.5, "params.yaml: tracking.gamma is 1.5 but must be at most 1"),
        ("identify_plant", "plant.sample_time_s", "one", 'params.yaml: plant.sample_time_s is "one" but must be a number'),
        ("ingest", "generate_probing.source", "recording", "did you mean recordings?"),
        ("ingest", "ingest.mapping.heater_1.source", "Q3", "rig.csv"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_by_name(tree, refused, stage, key, value, said):
    declare(tree, {key: value})
    assert said in refused(tree, stage)


def test_xx(tree, monkeypatch, capfd):
    def t(name, columns=None, stages=("ingest",), **declared):
        import shutil as s
        w = tree.parent / name
        s.copytree(tree, w)
        if columns is not None:
            record(w, columns)
        declare(w, {k.replace("__", "."): v for k, v in declared.items()})
        codes = [run(w, x, monkeypatch) for x in stages]
        open("/tmp/realrec/said.txt", "a").write(f"### {name} {codes} {capfd.readouterr().err} \n")
    S = signals()
    def with_(**k):
        c = {n: v.copy() for n, v in S.items()}
        for n, (i, v) in k.items():
            c[n][i] = v
        return c
    three = ("ingest", "identify_plant", "learn_kernel")
    import contextlib
    def tt(*a, **k):
        try:
            t(*a, **k)
        except BaseException as e:
            open("/tmp/realrec/said.txt", "a").write(f"!!! {a[0]} {type(e)} {e}\n")
    real = print
    global_print = open("/tmp/realrec/said.txt", "a")
    tt("missing", ingest__mapping__heater_1__source="Q3")
    tt("unit", ingest__mapping__zone_1__unit="degF")
    tt("back", with_(t_s=(300, 20.0)))
    tt("twice", with_(t_s=(300, 299.0)))
    tt("nan", with_(T1=(slice(None), np.nan)))
    tt("const", with_(Q1=(slice(None), 30.0)), three)
    tt("const2", with_(Q1=(slice(None), 30.0)), ("ingest", "learn_kernel"))
    tt("collinear", S | {"Q2": S["Q1"]}, three)
    tt("collinear2", S | {"Q2": S["Q1"]}, ("ingest", "learn_kernel"))
    tt("constout", with_(T1=(slice(None), 30.0)), three)
    tt("constout2", with_(T1=(slice(None), 30.0)), ("ingest", "learn_kernel"))
    tt("short", signals(40), three)
    tt("short2", signals(40), ("ingest", "learn_kernel"))
    tt("one", signals(1), three)
    tt("same", S | {"T2": S["T1"]}, three)
    tt("same2", S | {"T2": S["T1"]}, ("ingest", "learn_kernel"))
    tt("noise", S | {"T1": np.random.default_rng(0).normal(size=600), "T2": np.random.default_rng(3).normal(size=600)}, (*three,"tune_weights"), tune_weights__initial=3, tune_weights__evaluations=4)
    tt("signal", ingest__mapping={"heater_11": {"source": "Q1", "unit": "percent", "scale": 1.0, "offset": 0.0}})
    tt("order", stages=("identify_plant",), identify_plant__order=40)
    tt("text", stages=("identify_plant",))
    tt("sim", stages=("generate_probing",), generate_probing__source="simulated")
