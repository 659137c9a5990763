"""A hundred sets of metrics, drawn around those of the bundled study with figures missing, and the verdicts
that they got: whoever changes how a verdict is made sees which of them change.

frozen_metrics.json holds what is drawn around; frozen_verdicts.json the answers alone. After a change that is
meant, `./run python -m tests.mission.test_frozen_verdicts` writes the answers anew; the note of the change
lists the differences.
"""

import copy
import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.temperature.settings import Plant
from pipeline.verdict import loops
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Missing, Verdict

HERE = Path(__file__).parent
INPUTS, ANSWERS = HERE / "frozen_metrics.json", HERE / "frozen_verdicts.json"
DRAWS = 100
NOT_MADE = Missing("not measured", "nothing ran")
# of a table's columns: shares of runs, which stay between 0 and 100
PERCENT = "percent"
# of a study that could pass: the frames that its classifier names rightly
SEES_WELL = {"image_accuracy": 0.85}


class Tables(dict):
    """Tables by name; one that is not among them was never made."""

    def __missing__(self, name: str) -> Missing:
        return NOT_MADE


# ---- the draws


def draw(inputs: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """{"metrics", "tables", "recorded", "quick"}: figures times exp(normal), keys dropped, stages lost.

    Each draw has its own deviation, and its own shares of keys and of stages that are missing.
    """
    rng = np.random.default_rng([35, seed])
    deviation = float(rng.choice((0.02, 0.1, 0.3, 1.0)))
    key_share, stage_share = float(rng.choice((0.0, 0.002, 0.02))), float(rng.choice((0.0, 0.05, 0.3)))

    def lose(stages: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in stages.items() if rng.uniform() >= stage_share}

    # one more figure of a stage draws no other stage anew
    metrics = {
        name: scale(stage, np.random.default_rng([35, seed, *name.encode()]), deviation, key_share)
        for name, stage in lose(inputs["metrics"]).items()
    }
    if "evaluate_temperature" in metrics:  # a machine that is hard to control, in some draws
        hard = float(rng.choice((0.0, 0.0, 0.0, 2.0, 4.0)))
        metrics["evaluate_temperature"] = scale(metrics["evaluate_temperature"], rng, 0.0, 0.0, by=hard)
    favourable = bool(rng.uniform() < 0.4)
    if favourable and "train_classifier" in metrics:
        metrics["train_classifier"] |= SEES_WELL
    tables = lose(improve(inputs["tables"]) if favourable else inputs["tables"])
    tables = {
        name: scale_table(table, rng, deviation) if name in inputs["columns"] else table
        for name, table in tables.items()
    }
    return {
        "metrics": metrics,
        "tables": tables,
        "recorded": bool(rng.uniform() < 0.2),
        "quick": bool(rng.uniform() < 0.1),
    }


def improve(tables: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of a study that could pass: without the part whose forecast is not judged, and with half a
    per cent of what a scoreboard lacks to 100 %, or has of harm."""
    unjudged = {
        part
        for part, of in tables["conformance"].items()
        if not all(forecast["judged"] for forecast in of["forecast"].values())
    }
    scores = tables["scores"]
    rows = [k for k, part in enumerate(scores["part"]) if part not in unjudged]
    scoreboard = {
        name: [share(name, value, 1 / 200) for value in values] if PERCENT in name else values
        for name, values in tables["scoreboard"].items()
    }
    return {
        **tables,
        "conformance": {part: of for part, of in tables["conformance"].items() if part not in unjudged},
        "scores": {name: [values[k] for k in rows] for name, values in scores.items()},
        "scoreboard": scoreboard,
    }


def scale(
    value: Any, rng: np.random.Generator, deviation: float, key_share: float, *, by: float = 0.0
) -> Any:
    """Every float below `value` times exp(by) and a factor of its own, and some keys gone."""
    if isinstance(value, dict):
        kept = {key: inner for key, inner in value.items() if rng.uniform() >= key_share}
        return {key: scale(inner, rng, deviation, key_share, by=by) for key, inner in kept.items()}
    if isinstance(value, list):
        return [scale(inner, rng, deviation, key_share, by=by) for inner in value]
    if isinstance(value, float):
        return value * math.exp(by + deviation * rng.standard_normal())
    return copy.copy(value)


def scale_table(table: Mapping[str, list], rng: np.random.Generator, deviation: float) -> dict[str, list]:
    """Of every row the shares of harm, and what the others lack to 100 %, times one factor, so that an
    interval still holds its estimate."""
    rows = len(next(iter(table.values())))
    factor = np.exp(deviation * rng.standard_normal(rows))
    return {
        name: [share(name, value, by) for value, by in zip(values, factor, strict=True)]
        if PERCENT in name
        else values
        for name, values in table.items()
    }


def share(name: str, value: float | None, by: float) -> float | None:
    if value is None or value > 100:
        return value
    if name.startswith(("beyond", "rms", "predicted", "worst_line")):
        return min(100.0, value * by)
    return max(0.0, 100 - (100 - value) * by)


# ---- the verdicts


def evidence_of(inputs: Mapping[str, Any], drawn: Mapping[str, Any]) -> Evidence:
    """What the stage `verdict` would read, without its files."""
    everything = copy.deepcopy(inputs["params"])
    if drawn["recorded"]:
        for section in ("generate_probing", "train_ilc", "train_classifier"):
            everything[section]["source"] = "recordings"
    metrics = {name: drawn["metrics"].get(name, NOT_MADE) for name in inputs["metrics"]}
    tables = Tables({
        name: {key: column(values) for key, values in table.items()} if name in inputs["columns"] else table
        for name, table in drawn["tables"].items()
    })  # fmt: skip
    rules, machine = (
        ReportRules.model_validate(everything["report"]),
        Plant.model_validate(everything["plant"]),
    )
    return Evidence(metrics, tables, machine, rules, everything, quick=drawn["quick"])


def column(values: list) -> np.ndarray:
    missing = [math.nan if value is None else value for value in values]
    return np.array(missing)


def answer(verdict: Verdict) -> dict[str, Any]:
    """State, who is named, and the state of each rule by its key, for each controller that is shown."""
    rules: dict[str, list[list[str]]] = {}
    for line in verdict.rules:
        question = line[0].question
        key = question.key if question and verdict.loop != "deposition" else line[0].name
        rules.setdefault(key, []).append([rule.state for rule in line])
    return {"state": verdict.state, "winner": verdict.winner, "subject": verdict.subject, "rules": rules}


def answers(inputs: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """The verdict of each loop, or the error by which the report ends."""
    evidence = evidence_of(inputs, draw(inputs, seed))
    try:
        verdicts = loops.verdicts(evidence)
    except Exception as error:
        return {"error": type(error).__name__}
    return {loop: answer(verdict) for loop, verdict in verdicts.items()}


# ---- the tests


@pytest.fixture(scope="module")
def inputs() -> dict[str, Any]:
    return json.loads(INPUTS.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def frozen() -> list[dict[str, Any]]:
    return json.loads(ANSWERS.read_text(encoding="utf-8"))


def test_each_set_of_metrics_gets_the_verdict_that_it_got(inputs, frozen):
    assert len(frozen) == DRAWS
    differ = {seed: found for seed, was in enumerate(frozen) if (found := answers(inputs, seed)) != was}
    assert differ == {}


def test_the_sets_reach_every_verdict(frozen):
    """Frozen answers that were all alike would hold nothing."""
    for loop in ("temperature", "deposition", "setpoint"):
        states = Counter(one[loop]["state"] for one in frozen if loop in one)
        assert {"passed", "failed", "not measured"} <= states.keys(), (loop, states)


def main() -> None:
    inputs = json.loads(INPUTS.read_text(encoding="utf-8"))
    lines = [
        json.dumps(answers(inputs, seed), separators=(",", ":"), ensure_ascii=False) for seed in range(DRAWS)
    ]
    ANSWERS.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
