"""The curves of a run's searches and trainings. `accept` keeps them; runs.html draws them."""

import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from pipeline.verdict.controllers import heading
from pipeline.verdict.evidence import Table, known
from pipeline.verdict.verdict import Missing

# of one curve at most
SAMPLES = 40


class Curve(NamedTuple):
    """A curve: names of its axes, its samples."""

    across: str
    up: str
    x: list[float]
    y: list[float]


def curves(tables: Mapping[str, Table | Missing]) -> dict[str, Curve]:
    """{name: curve} of the tables that exist."""
    return {
        name: curve
        for table, read in READERS.items()
        if (rows := known(tables[table], None))
        for name, curve in read(rows)
        if curve.x
    }


def restored(stored: Any) -> dict[str, Curve]:
    """The curves that an accepted run kept; none if it has none."""
    return {name: Curve(**fields) for name, fields in (stored or {}).items()}


def as_json(drawn: Mapping[str, Curve]) -> str:
    """The curves as a text of JSON, which `accept` keeps."""
    return json.dumps({name: curve._asdict() for name, curve in drawn.items()}, ensure_ascii=False)


def _search(table: Table) -> Iterator[tuple[str, Curve]]:
    for name in dict.fromkeys(table["contestant"]):
        rows = table["contestant"] == name
        label = f"Temperature: search of {heading(str(name))}"
        yield (
            label,
            _curve("Evaluation", "Lowest cost so far", table["evaluation"][rows], table["incumbent"][rows]),
        )


def _trials(table: Table) -> Iterator[tuple[str, Curve]]:
    """The first recorded routine with the law that is used: `pixels` if the trials were filmed."""
    law = "pixels" if "pixels" in table["law"] else "model_inverse"
    for material in dict.fromkeys(table["material"]):
        rows = (table["material"] == material) & (table["law"] == law)
        rows &= table["routine"] == min(table["routine"][rows], default=0)
        error = table["rms_measured"][rows]
        yield (
            f"Deposition: error of the measured flow, material {material}",
            _curve("Trial", "% of trial 0", table["trial"][rows], 100 * error / error[:1]),
        )


def _classifier(table: Table) -> Iterator[tuple[str, Curve]]:
    rows = table["learner"] == "vision transformer"
    loss = table["held_out_loss"][rows]
    if rows.any():  # few own pictures train no network
        yield "Setpoint: classifier, held-out loss", _curve("Epoch", "Loss", table["epoch"][rows], loss)


def _agent(table: Table) -> Iterator[tuple[str, Curve]]:
    reward = table["reward"]
    yield "Setpoint: agent, reward of a step", _curve("Update", "Mean reward", table["update"], reward)


def _curve(across: str, up: str, x: np.ndarray, y: np.ndarray) -> Curve:
    """At most SAMPLES samples, the first and the last among them, of four significant digits."""
    known = np.flatnonzero(np.isfinite(np.asarray(y, float)))
    kept = (
        known[np.unique(np.linspace(0, len(known) - 1, SAMPLES).round().astype(int))] if len(known) else known
    )
    return Curve(across, up, [float(x[i]) for i in kept], [float(f"{y[i]:.4g}") for i in kept])


# table -> what reads its curves
READERS = {"tuning": _search, "trials": _trials, "course": _classifier, "agents": _agent}
