"""What the stage certify measured, compared with the limits of section `report`: the certificate.

certify.py measures once, whatever is allowed. Six rules of a certificate compare with the settled error and
the margins that section `report` declares; they are decided here, from stored figures. A changed limit
measures nothing again.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploy.certificate import RULES, Certificate, RuleResult, at_least, at_most, plain, rebuilt
from pipeline.store import artifacts

MEASURED, CERTIFIED = "measured.json", "certified.json"
# stands in the exported files for the SHA-256 of the certificate, which depends on the limits
PLACE = "@certificate@"
# signals, samples, evidence, loop: the rules of a group are all asked if every group before it passed
GROUPS = (RULES[:4], RULES[4:7], RULES[7:12], RULES[12:])


class MeasuredController(NamedTuple):
    """A certificate before its limits: `draft` holds the rules that no limit of section `report` enters, and
    `figures`, by rule, what the other rules compare."""

    draft: Certificate
    figures: Mapping[str, Mapping[str, Any]]


def decide(
    measured: MeasuredController, *, settled_error_degC: float, disk_margin: float, delay_margin_s: float
) -> Certificate:
    """The certificate under these limits, as section `report` declares them. The first rule that fails, in
    the order of RULES, refuses the controller; rules of later groups are not asked."""
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
    """Errors of one step may be predictable by no more than the settled error that is allowed."""
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
    """`limit` for the 10 % plant, which nine plants in ten reach, and a share of it on the newest record; a
    margin without end is None. The sentence names the figure that is furthest below its limit."""
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
    """JSON knows no infinity: null is a figure without end."""
    return np.inf if value is None else value


# ---- the files of the stage certify


def write(folder: Path, measured: MeasuredController) -> None:
    """measured.json of a controller's folder."""
    artifacts.write_json(folder / MEASURED, plain(measured))


def read(folder: Path) -> MeasuredController:
    about = artifacts.read_json(folder / MEASURED)
    return MeasuredController(rebuilt(about["draft"]), about["figures"])


def fill(path: Path, certificate_sha256: str) -> str:
    """The text of a prepared file with the SHA-256 in its marked place."""
    return path.read_text(encoding="utf-8").replace(PLACE, certificate_sha256)


def results(
    folder: str | Path, *, settled_error_degC: float, disk_margin: float, delay_margin_s: float
) -> dict[str, dict[str, Any]]:
    """By controller of the temperature loop, whether its certificate is passed under these limits, and why
    not. Empty if certify did not run."""
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
    """Why the controller is refused; empty if the certificate is passed."""
    rule = next((one for one in certificate.rules if one.name == certificate.first_failed), None)
    if rule is None:
        return ""
    return f"The certificate is refused by its rule {rule.name.replace('_', ' ')}. {rule.sentence}"
