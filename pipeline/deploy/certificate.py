"""The certificate of a controller: what was measured, and on which evidence, and whether it is exported.

This module is the document: the record on which it is based, its rules, their results, and its JSON.
certify.py measures once, independent of the limits; `decide` compares with the limits, in the declared order
of RULES. Six rules use the settled error and the margins that section `report` declares, so a changed limit
needs no new measurement. The first rule that fails refuses the controller. The evidence is "recorded" or
"simulated".
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from pipeline.deploy.supervise import Signal, signal
from pipeline.store import artifacts

VERSION, LOOP = 1, "temperature"
Segments = Sequence[np.ndarray]


class EvidenceRecord(NamedTuple):
    """The record on which a certificate is based: the signals as recorded, and segments without gaps. The
    newest segments come from the machine as it is today, with the wiring that the controller will have."""

    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sample_time_s: float
    u: list[np.ndarray]  # segments (T, m), from which the models were learned
    y: list[np.ndarray]  # segments (T, p) in °C
    newest_u: list[np.ndarray]
    newest_y: list[np.ndarray]


class Rules(NamedTuple):
    """How a controller is measured, and the limits that no params file changes. Starting at rest at `start`,
    each of `references` is applied for `steps` samples."""

    references: np.ndarray  # (g, p) °C
    start: np.ndarray  # (p,) °C
    steps: int = 300
    settled: int = 50  # the last samples, over which the settled error is the mean error
    crossing_degC: float = 1.0  # allowed beyond the limits of outputs
    failing: float = 0.1  # share of the plants that may miss a limit
    tail: float = 0.5  # share of a margin's limit that is required on the newest record alone
    plants: int = 1000
    poles_of: int = 24
    resamples: int = 200
    longest_window: int = 24
    samples: float = 5.0  # for each unknown of a window model
    moves: float = 0.002  # least share of an input's range that it moves by itself
    ahead: int = 20
    # fraction of the newest record's movement over `ahead` samples that the model may miss, beyond what the
    # record's own window model misses
    unexplained: float = 0.5
    noise: float = 0.3  # deviation of a settled mean as a share of the settled error's limit
    # temperatures at rest without inputs to which the record's window models may extrapolate: those of a
    # room, widened by the error of a straight line from hot to cold
    extrapolated_degC: tuple[float, float] = (-50.0, 110.0)
    reach: float = 0.5  # of the recorded span, by which references may lie beyond it


class RuleResult(NamedTuple):
    """Result of one rule: the figure, the limit, and a sentence. `asked` is False if an earlier rule
    refused."""

    name: str
    passed: bool
    found: float | None
    limit: float | None
    unit: str
    sentence: str
    asked: bool = True


class Certificate(NamedTuple):
    """What was measured of a controller. Fields of rules that were not reached are empty or None.

    `poles`, of each closed loop: {"of": "model", "spread", "record" or "newest", "radius", "poles": the
    largest, [real, imaginary]}. `margins` of family and record, as [median, the one that nine of ten reach,
    least]: {"plants", "disk", "delay_s"}, None if unlimited. `worst`, settled errors in °C of sampled plants,
    as [median, 99 % quantile, worst]: {"plants", "settled_error_degC", "failing", "diverged"}. `violations`,
    by how many °C plants cross a limit: {"output", "worst_degC", "plants": number of plants above the
    allowed}. `bands` of learned gains u = -K w - K_r r: {"level", "resamples", "on": a signal so many samples
    before, or a reference, "gain", "low", "high": rows by input}.
    """

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
    poles: tuple[dict[str, Any], ...]
    margins: dict[str, Any] | None
    worst: dict[str, Any] | None
    violations: tuple[dict[str, Any], ...]
    bands: dict[str, Any] | None
    rules: tuple[RuleResult, ...]
    verdict: Literal["passed", "refused"]
    first_failed: str | None
    conditions: str  # one sentence: which disturbances were recorded, and what the controller knows of them


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
    """Returns None for infinity, which JSON does not have."""
    return None if value is None or not np.isfinite(value) else float(value)


# ---- as JSON


def to_json(certificate: Certificate) -> str:
    """Returns canonical JSON: sorted keys, no blanks; limits that are not declared are null."""
    return json.dumps(
        plain(certificate), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def sha256(certificate: Certificate) -> str:
    """Returns the SHA-256 of the canonical JSON."""
    return hashlib.sha256(to_json(certificate).encode()).hexdigest()


def from_json(text: str) -> Certificate:
    """Returns the certificate. Raises ValueError, naming what is missing, if the text is no certificate of
    this version."""
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
        certificate = rebuilt(about)
        _check(certificate)
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"the certificate cannot be read ({error}); certify the controller again") from None
    return certificate


def _check(certificate: Certificate) -> None:
    """Raises ValueError if the verdict does not follow from the rules, or if the rules belong to another
    version."""
    first = next((one.name for one in certificate.rules if not one.passed), None)
    if certificate.first_failed != first or certificate.verdict != ("refused" if first else "passed"):
        raise ValueError(f"its verdict {certificate.verdict} is not that of its rules")
    if tuple(one.name for one in certificate.rules) != RULES:
        raise ValueError("its rules are not those of this version")


def rebuilt(about: dict[str, Any]) -> Certificate:
    """Returns the certificate of a JSON object."""
    made: dict[str, Any] = {name: about[name] for name in Certificate._fields}
    made |= {name: tuple(about[name]) for name in ("samples", "poles", "violations")}
    made |= {side: tuple(map(signal, about[side])) for side in ("inputs", "outputs")}
    made["rules"] = tuple(RuleResult(**one) for one in about["rules"])
    return Certificate(**made)


def plain(value: Any) -> Any:
    """Returns values as JSON types; numbers that are not finite are null."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: plain(part) for name, part in value._asdict().items()}
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return [plain(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


# ---- compared with the limits

MEASURED, CERTIFIED = "measured.json", "certified.json"
# placeholder in the exported files for the SHA-256 of the certificate, which depends on the limits
PLACE = "@certificate@"
# signals, samples, evidence, loop: all rules of a group are evaluated if every group before it passed
GROUPS = (RULES[:4], RULES[4:7], RULES[7:12], RULES[12:])


class MeasuredController(NamedTuple):
    """A certificate before its limits. `draft` holds the rules that use no limit of section `report`;
    `figures`, by rule, what the other rules compare."""

    draft: Certificate
    figures: Mapping[str, Mapping[str, Any]]


def decide(
    measured: MeasuredController, *, settled_error_degC: float, disk_margin: float, delay_margin_s: float
) -> Certificate:
    """Returns the certificate under these limits, as section `report` declares them. The first rule that
    fails, in the order of RULES, refuses the controller; rules of later groups are not evaluated."""
    draft, figures = measured
    rules: dict[str, Callable[[Any], RuleResult]] = {
        "noise": lambda f: _of_noise(f, settled_error_degC),
        "coloured": lambda f: _of_colour(f, settled_error_degC),
        "newest": lambda f: _of_newest(f, 2 * settled_error_degC),
        "disk_margin": lambda f: _of_margin("disk_margin", f, disk_margin),
        "delay_margin": lambda f: _of_margin("delay_margin", f, f["share"] * delay_margin_s),
        "settled_error": lambda f: _of_settled_error(f, settled_error_degC),
    }
    known = {one.name: one for one in draft.rules}
    known |= {name: rule(figures[name]) for name, rule in rules.items() if name in figures}
    results: list[RuleResult] = []
    for group in GROUPS:
        results += [known[name] for name in group if name in known]
        if not all(one.passed for one in results):
            break
    first = next((one.name for one in results if not one.passed), None)
    done = {one.name for one in results}
    results += [
        RuleResult(name, False, None, None, "", f"Not asked, because {first} failed.", False)
        for name in RULES
        if name not in done
    ]
    decided = draft._replace(
        rules=tuple(results), verdict="passed" if first is None else "refused", first_failed=first
    )
    if "settled_error" not in done or decided.worst is None:
        return decided._replace(poles=(), margins=None, worst=None, violations=(), bands=None)
    failing = int((np.array(figures["settled_error"]["degC"]) > settled_error_degC).sum())
    return decided._replace(worst=decided.worst | {"failing": failing})


def _of_noise(figures: Mapping[str, Any], limit_degC: float) -> RuleResult:
    deviation, outputs = np.array(figures["degC"]), figures["outputs"]
    share = deviation / np.sqrt(figures["settled"]) / limit_degC
    worst = int(share.argmax())
    return at_most(
        "noise",
        float(share[worst]),
        figures["limit"],
        "of the settled error",
        f"One step ahead, noise is {deviation[worst]:.2g} °C at most.",
        f"Noise of {deviation[worst]:.3g} °C on {outputs[worst]} hides the settled error that is allowed.",
    )


def _of_colour(figures: Mapping[str, Any], limit_degC: float) -> RuleResult:
    """Checks that no more than the allowed settled error of the one-step errors is predictable."""
    degC = _number(figures["degC"])
    return at_most(
        "coloured",
        degC,
        limit_degC,
        "degC",
        f"Of errors of one step {degC:.2g} °C at most could have been foretold.",
        f"Of the errors of one step of {figures['output']} {degC:.2g} °C could have been "
        "foretold: the model misses what the newest record shows.",
    )


def _of_newest(figures: Mapping[str, Any], limit_degC: float) -> RuleResult:
    degC = figures["degC"]
    return at_most(
        "newest",
        degC,
        limit_degC,
        "degC",
        f"On what the newest record alone shows it settles within {degC:.2g} °C.",
        f"On what the newest record alone shows it does not settle: {degC:.3g} °C remain.",
    )


def _of_margin(name: str, figures: Mapping[str, Any], limit: float) -> RuleResult:
    """Checks `limit` for the 10 % plant, which nine plants in ten reach, and a fraction of it on the newest
    record. A margin without limit is None. The sentence names the figure that is furthest below its limit."""
    unit = {"disk_margin": "1", "delay_margin": "s"}[name]
    margins = [_number(one) for one in figures["margins"][1:]]
    limits = [limit, figures["tail"] * limit]
    worst = int(np.argmin(np.array(margins) - limits)) if np.isfinite(margins).any() else 0
    of = ("of the 10 % plant", "on what the newest record alone shows")
    what = f"The {name.replace('_', ' ')} on the record"
    texts = [f"{margin:.3g}" if np.isfinite(margin) else "without end" for margin in margins]
    each = " and ".join(f"{text} {where}" for text, where in zip(texts, of, strict=True))
    return at_least(
        name,
        margins[worst],
        limits[worst],
        unit,
        f"{what} is {each}.",
        f"{what} is {each}; {limits[worst]:g} is required {of[worst]}.",
    )


def _of_settled_error(figures: Mapping[str, Any], limit_degC: float) -> RuleResult:
    settled = np.array(figures["degC"])
    plants, failing, worst = len(settled), int((settled > limit_degC).sum()), float(settled.max())
    return at_most(
        "settled_error",
        100 * failing / plants,
        100 * figures["failing"],
        "% of plants",
        f"Of {plants} plants that the record leaves open {plants - failing} settle "
        f"within {limit_degC:g} °C, the worst at {worst:.2g} °C.",
        f"{failing} of {plants} plants that the record leaves open do not settle within "
        f"{limit_degC:g} °C, the worst by {worst:.3g} °C.",
    )


def _number(value: float | None) -> float:
    """Returns infinity for null, since JSON has no infinity."""
    return np.inf if value is None else value


# ---- the files of the stage certify


def write(folder: Path, measured: MeasuredController) -> None:
    """Writes measured.json of a controller's folder."""
    artifacts.write_json(folder / MEASURED, plain(measured))


def read(folder: Path) -> MeasuredController:
    about = artifacts.read_json(folder / MEASURED)
    return MeasuredController(rebuilt(about["draft"]), about["figures"])


def fill(path: Path, certificate_sha256: str) -> str:
    """Returns the text of a prepared file with the SHA-256 inserted in its marked place."""
    return path.read_text(encoding="utf-8").replace(PLACE, certificate_sha256)


def results(
    folder: str | Path, *, settled_error_degC: float, disk_margin: float, delay_margin_s: float
) -> dict[str, dict[str, Any]]:
    """Returns, by controller of the temperature loop, whether its certificate is passed under these limits,
    and why not. Empty if certify did not run."""
    folder = Path(folder)
    if not artifacts.exists(folder / CERTIFIED):
        return {}
    found = {}
    for name, one in artifacts.read_json(folder / CERTIFIED)["temperature"].items():
        why = one["why"]
        if one["measured"]:
            certificate = decide(
                read(folder / "temperature" / name),
                settled_error_degC=settled_error_degC,
                disk_margin=disk_margin,
                delay_margin_s=delay_margin_s,
            )
            why = refusal(certificate)
        found[name] = {"passed": not why, "why": why}
    return found


def refusal(certificate: Certificate) -> str:
    """Returns why the controller is refused; "" if the certificate is passed."""
    rule = next((one for one in certificate.rules if one.name == certificate.first_failed), None)
    if rule is None:
        return ""
    return f"The certificate is refused by its rule {rule.name.replace('_', ' ')}. {rule.sentence}"
