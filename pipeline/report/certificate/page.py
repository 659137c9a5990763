"""The page of the certificate: what was found by each rule, poles, margins, the worst plants, bands of gains,
and the files that leave the house."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.report.certificate import exported
from pipeline.report.shared import page, words
from pipeline.report.shared.sources import Sources
from pipeline.verdict.controllers import BY_NAME, heading
from pipeline.verdict.digits import number, with_unit
from pipeline.verdict.evidence import entry, gap_of, known, need, need_figure, or_nothing
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Missing, Verdict

WORDS = ("verdict", "margin_disk", "margin_delay", "spread", "step", "hash")


def render(sources: Sources, verdict: Verdict) -> str:
    """The text of certificate.html; `verdict` is that of the temperature loop on page one."""
    lines = exported.lines(sources, verdict)
    shown = _certificate(sources, lines)
    whole = known(shown, None)
    return page.render(
        "certificate.html",
        here="certificate",
        sources=sources,
        title="Certificate",
        head=head(shown, lines),
        missing_certificate=gap_of(shown),
        rules=rule_rows(whole) if whole else [],
        controllers=controllers(sources),
        about=about(whole) if whole else [],
        poles=poles(shown),
        margins=margins(whole) if whole else [],
        judged_margins=judged_margins(sources),
        lines=known(lines, []),
        origin_of=page.origin(sources.source("certificate", "export_controllers")),
        differences=differences(sources),
        words=words.chosen(sources, WORDS),
    )


def _certificate(
    sources: Sources, lines: Sequence[exported.ExportedLine] | Missing
) -> Mapping[str, Any] | Missing:
    """The certificate, or why there is none: in the words of export_controllers if it ran."""
    shown = sources.tables.get("certificate") or Missing(OPEN, "export_controllers has not run")
    why = next((line.why for line in known(lines, []) if line.loop == "temperature"), "")
    if not gap_of(shown):
        return shown
    return Missing(OPEN, why) if why else shown


def head(
    shown: Mapping[str, Any] | Missing, lines: Sequence[exported.ExportedLine] | Missing
) -> dict[str, Any]:
    """Passed or refused, and the first rule that failed."""
    said: dict[str, Any] = {"state": "open", "decision": "No certificate.", "reason": "", "lead": ""}
    said |= {"remedy": "", "claim": "", "changed": "", "rules": (), "heads": ()}
    if gap := gap_of(lines):
        return said | {"reason": gap.sentence()}
    mine = next(line for line in known(lines, []) if line.loop == "temperature")
    state = {PASSED: "passed", FAILED: "failed"}.get(mine.state, "open")
    said |= {"state": state, "decision": mine.word, "reason": mine.why}
    if gap_of(shown) or mine.state == OPEN:
        return said
    if mine.state == FAILED:
        rule = str(entry(shown, "first_failed") or "").replace("_", " ")
        return said | {"lead": f"First failed rule: {rule}.", "remedy": "Nothing of this loop is exported."}
    limits = "It holds for this plant, these units and this sample time, and nothing else."
    if entry(shown, "evidence") == "simulated":
        limits += " The plant is simulated: not for a real machine."
    return said | {"decision": f"{mine.word} {mine.name[:1].upper()}{mine.name[1:]}.", "reason": limits}


def rule_rows(shown: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rules in the order in which they were asked."""
    rows = []
    for rule in shown["rules"]:
        found, limit = (_figure(rule.get(key), rule.get("unit") or "") for key in ("found", "limit"))
        rows.append(
            {
                "name": rule["name"].replace("_", " "),
                "state": OPEN if not rule.get("asked", True) else PASSED if rule["passed"] else FAILED,
                "found": found,
                "limit": f"{_side(rule)}{limit}",
                "sentence": rule["sentence"],
            }
        )
    return rows


def controllers(sources: Sources) -> list[tuple[str, str, str]]:
    """State, controller and reason: whether each controller of the temperature loop has a certificate."""
    certified = sources.certified.get("temperature") or {}
    return [
        (
            PASSED if one["passed"] else FAILED,
            heading(name) if name in BY_NAME else name,
            one["why"] or "Every rule of the certificate is passed.",
        )
        for name, one in certified.items()
    ]


def _side(rule: Mapping[str, Any]) -> str:
    """On which side of its limit a figure passes: the one where it lies, or does not."""
    found, limit = rule.get("found"), rule.get("limit")
    if found is None or limit is None or found == limit or not rule.get("asked", True):
        return ""
    return "≥ " if (found > limit) == rule["passed"] else "≤ "


def _figure(value: float | None, unit: str) -> str:
    """A number with its unit; empty where a rule counts nothing."""
    if value is None:
        return ""
    text = number(value, 0) if abs(value) >= 100 else f"{value:.3g}"
    return text if unit in ("", "1") else f"{text} {unit.replace('degC', '°C')}"


def about(shown: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What it was made for."""
    name = shown["controller"]
    learned, newest = shown["samples"]
    return [
        ("Controller", heading(name) if name in BY_NAME else name),
        ("Evidence", shown["evidence"]),
        ("Conditions", shown["conditions"]),
        ("Sample time", with_unit(shown["sample_time_s"], "s", 2)),
        *(
            (side.capitalize(), "; ".join(_signal(one) for one in shown[side]))
            for side in ("inputs", "outputs")
        ),
        ("Record", f"{learned} samples learned from, {newest} of the newest"),
        *((f"SHA-256 of {key}", shown[f"{key}_sha256"]) for key in ("controller", "plant", "spread")),
    ]


def _signal(one: Mapping[str, Any]) -> str:
    low, high = ("none" if one[side] is None else f"{one[side]:g}" for side in ("low", "high"))
    return f"{one['name']} in {one['unit']}, {low} to {high}"


@or_nothing
def poles(shown: Mapping[str, Any] | Missing) -> str:
    """The largest closed-loop pole over the model, its spread and what the record leaves open; "" if an
    earlier rule refused."""
    radii = [one["radius"] for one in need(shown)["poles"]]
    if not radii:
        return ""
    stable = "stable" if max(radii) < 1 else "not stable"
    return f"On {len(radii)} plants the largest pole is of size {number(max(radii), 4)}: {stable}."


def margins(shown: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Figures over plants: median, nine of ten (margins) or 99 % (errors), worst."""
    rows = []
    found, worst = shown.get("margins"), shown.get("worst")
    if found:
        for name, key, unit in (
            ("Disk margin on the record", "disk", ""),
            ("Delay margin on the record", "delay_s", "s"),
        ):
            rows.append((name, *("unlimited" if v is None else _figure(v, unit) for v in found[key])))
    if worst:
        rows.append(("Settled error", *(_figure(v, "°C") for v in worst["settled_error_degC"])))
    return rows


@or_nothing
def judged_margins(sources: Sources) -> str:
    """The same margins on the plants that page one judges on, which the record did not choose; "" where they
    were not judged."""
    name = need_figure(sources.metrics.get(exported.STAGE), "temperature.contestant")
    judged = sources.metrics.get("evaluate_temperature")
    plants = need_figure(judged, "plants")
    ends = [need_figure(judged, f"contestants.{name}.margins.{key}") for key in ("disk", "delay_s")]
    # null is a margin without end
    disk, delay = (
        ["unlimited" if one.get(of) is None else _figure(one[of], unit) for of in ("q10", "worst")]
        for one, unit in zip(ends, ("", "s"), strict=True)
    )
    return (
        "These are the margins on the record: on the identified model, on its spread and on what the record "
        "leaves open. The rules ask for them on the 10 % plant. The temperature page has the margins on the "
        f"test set, {plants} other plants: disk margin {disk[0]} of the weakest tenth and {disk[1]} of the "
        f"worst, delay margin {delay[0]} and {delay[1]}."
    )


def differences(sources: Sources) -> list[tuple[str, str]]:
    """How far what is exported is from what was judged."""
    metrics = sources.metrics.get("export_controllers")
    if not isinstance(metrics, Mapping):
        return []
    named = {
        "judged": "the object against the judged commands of the deciding case",
        "python": "the file of Python against the object, with limits, faults and hand-overs",
        "log_flow": "log flow of the exported classifier against the network",
    }
    return [
        (
            f"{loop.capitalize()}: {named.get(name, name)}",
            f"{value:.2g} {fields['unit'].replace('1', '')}".strip(),
        )
        for loop, fields in metrics.items()
        for name, value in (fields.get("largest_difference") or {}).items()
    ]
