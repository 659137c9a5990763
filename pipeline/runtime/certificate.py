"""The certificate of a controller: what was shown of it, on what evidence, and whether it may leave.

Here is the document: the record that it rests on, what is asked, what was found, and its JSON. The rules are
asked in the declared order of RULES by certify.py; the first that fails refuses.

Words are of what was shown: "recorded" or "simulated" evidence.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from pipeline.runtime.machine import Signal

VERSION, LOOP = 1, "temperature"
Segments = Sequence[np.ndarray]


class Record(NamedTuple):
    """What a certificate rests on: signals as recorded, and the segments that were learned from, u (T, m), y
    (T, p); `newest` segments come from the machine as it is now, by the wires that the controller will have.
    All are without gaps. `cold_degC` (p,) is what the sensors read of the cold machine, None where nobody
    looked."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sample_time_s: float
    u: list[np.ndarray]
    y: list[np.ndarray]
    newest_u: list[np.ndarray]
    newest_y: list[np.ndarray]
    cold_degC: np.ndarray | None = None


class Rules(NamedTuple):
    """What is asked. From rest at `start` (p,) °C the references (g, p) °C are asked for, `steps` each; over
    the last `settled` of them the mean error may be `settled_error_degC`, beyond the limits of outputs
    `crossing_degC`. In a share `failing` of the plants either may be more.

    `disk_margin` and `delay_margin_s` are asked, as on page one, of the median plant, here of family and
    record; a share `tail` of them of nine in ten, and of the window model of the newest record alone.
    `samples` are those for each unknown of a window model. `moves` is the least share of an input's range
    that it moves by itself. Of the newest record's movement over `ahead` steps the model may miss
    `unexplained` beyond what the record's own window model misses, and of errors of one step no more than the
    settled error allowed may be foretold by errors and inputs before. On the window model of the newest
    record alone twice that error is allowed.
    `noise`: the deviation of a settled mean as a share of the settled error allowed. A cold machine is as
    warm as its room, `room_degC`; where no cold reading is given, the record's window models must not
    contradict `extrapolated_degC` at rest without inputs, wider by what a line from hot to cold misses.
    `reach`: by how much of the recorded span references may lie beyond it.
    """

    references: np.ndarray
    start: np.ndarray
    steps: int = 300
    settled: int = 50
    settled_error_degC: float = 0.5
    crossing_degC: float = 1.0
    failing: float = 0.1
    disk_margin: float = 0.4
    delay_margin_s: float = 1.0
    tail: float = 0.5
    plants: int = 1000
    poles_of: int = 24
    resamples: int = 200
    longest_window: int = 24
    samples: float = 5.0
    moves: float = 0.002
    ahead: int = 20
    unexplained: float = 0.5
    noise: float = 0.3
    room_degC: tuple[float, float] = (5.0, 45.0)
    extrapolated_degC: tuple[float, float] = (-50.0, 110.0)
    reach: float = 0.5


class RuleResult(NamedTuple):
    """One rule: what was found, the limit, and a sentence. `asked` is False where an earlier one refused."""

    name: str
    passed: bool
    found: float | None
    limit: float | None
    unit: str
    sentence: str
    asked: bool = True


class Poles(NamedTuple):
    """The largest poles of one closed loop, [real, imaginary]; `of` is "model", "spread", "record" or
    "newest"."""

    of: str
    radius: float
    poles: tuple[tuple[float, float], ...]


class MarginsFound(NamedTuple):
    """MIMO disk margin and delay margin over family and record: median, the one that nine of ten reach, and
    the least; a delay margin without end is None."""

    plants: int
    disk: tuple[float, float, float]
    delay_s: tuple[float | None, float | None, float | None]


class Worst(NamedTuple):
    """Over `plants` sampled plants: settled error in °C, median, 99 % quantile and worst, how many settle
    worse than allowed, and how many did not stay finite."""

    plants: int
    settled_error_degC: tuple[float, float, float]
    failing: int
    diverged: int


class Violation(NamedTuple):
    """By how many °C a sampled plant crosses a limit of an output at most, and how many do by more than
    allowed."""

    output: str
    worst_degC: float
    plants: int


class GainBands(NamedTuple):
    """Bands of the learned gains u = -K w - K_r r at `level`, by `resamples` of the record: rows by input,
    columns `on` a signal so many samples before, or a reference."""

    level: float
    resamples: int
    on: tuple[str, ...]
    gain: tuple[tuple[float, ...], ...]
    low: tuple[tuple[float, ...], ...]
    high: tuple[tuple[float, ...], ...]


class Certificate(NamedTuple):
    """What was shown of a controller. Fields that no rule came to are empty or None."""

    version: int
    loop: str
    controller: str
    controller_sha256: str
    plant_sha256: str
    spread_sha256: str
    evidence: Literal["simulated", "recorded"]
    sample_time_s: float
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    samples: tuple[int, int]
    poles: tuple[Poles, ...]
    margins: MarginsFound | None
    worst: Worst | None
    violations: tuple[Violation, ...]
    bands: GainBands | None
    rules: tuple[RuleResult, ...]
    verdict: Literal["passed", "refused"]
    first_failed: str | None


RULES = (
    "signals",
    "units",
    "sample_time",
    "limits",
    "samples",
    "excitation",
    "reach",
    "noise",
    "room",
    "unexplained",
    "coloured",
    "newest",
    "poles",
    "disk_margin",
    "delay_margin",
    "settled_error",
    "violations",
)


# ---- one rule


def at_most(name: str, found: float, limit: float, unit: str, good: str, bad: str) -> RuleResult:
    return result(name, bool(found <= limit), found, limit, unit, good, bad)


def at_least(name: str, found: float, limit: float, unit: str, good: str, bad: str) -> RuleResult:
    return result(name, bool(found >= limit), found, limit, unit, good, bad)


def result(
    name: str, passed: bool, found: float | None, limit: float | None, unit: str, good: str, bad: str
) -> RuleResult:
    return RuleResult(name, passed, _finite(found), _finite(limit), unit, good if passed else bad)


def _finite(value: float | None) -> float | None:
    """JSON knows no infinity."""
    return None if value is None or not np.isfinite(value) else float(value)


# ---- as JSON


def to_json(certificate: Certificate) -> str:
    """Canonical JSON: sorted keys, no blanks; limits that are not declared are null."""
    return json.dumps(
        _plain(certificate), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def sha256(certificate: Certificate) -> str:
    """Of the canonical JSON."""
    return hashlib.sha256(to_json(certificate).encode()).hexdigest()


def from_json(text: str) -> Certificate:
    """Raises ValueError where the text is no certificate of this version, saying what is missing."""
    try:
        about = json.loads(text)
    except ValueError as error:
        raise ValueError(f"the certificate is no JSON ({error}); certify the controller again") from None
    version = about.get("version") if isinstance(about, dict) else None
    if version != VERSION:
        raise ValueError(
            f"expected a certificate of version {VERSION} but found {version}; certify the controller again"
        )
    missing = [name for name in Certificate._fields if name not in about]
    if missing:
        raise ValueError(f"the certificate has no {missing[0]}; certify the controller again")
    try:
        return _read(about)
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"the certificate cannot be read ({error}); certify the controller again") from None


def _read(about: dict[str, Any]) -> Certificate:
    def signals(entries: list[dict[str, Any]]) -> tuple[Signal, ...]:
        return tuple(
            Signal(
                one["name"],
                one["unit"],
                -np.inf if one["low"] is None else one["low"],
                np.inf if one["high"] is None else one["high"],
            )
            for one in entries
        )

    margins, worst = about["margins"], about["worst"]
    made = {name: about[name] for name in Certificate._fields}
    made |= {
        "inputs": signals(about["inputs"]),
        "outputs": signals(about["outputs"]),
        "samples": tuple(about["samples"]),
        "poles": tuple(
            Poles(one["of"], one["radius"], tuple((a, b) for a, b in one["poles"])) for one in about["poles"]
        ),
        "margins": margins
        and MarginsFound(margins["plants"], tuple(margins["disk"]), tuple(margins["delay_s"])),
        "worst": worst and Worst(**(worst | {"settled_error_degC": tuple(worst["settled_error_degC"])})),
        "violations": tuple(Violation(**one) for one in about["violations"]),
        "bands": about["bands"]
        and GainBands(**{name: _tuples(part) for name, part in about["bands"].items()}),
        "rules": tuple(RuleResult(**one) for one in about["rules"]),
    }
    certificate = Certificate(**made)
    first = next((one.name for one in certificate.rules if not one.passed), None)
    if certificate.first_failed != first or certificate.verdict != ("refused" if first else "passed"):
        raise ValueError(f"its verdict {certificate.verdict} is not that of its rules")
    if tuple(one.name for one in certificate.rules) != RULES:
        raise ValueError("its rules are not those of this version")
    return certificate


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
