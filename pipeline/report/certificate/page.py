"""The page of the certificate: what was found by each rule, poles, margins, the worst plants, bands of gains,
and the files that leave the house."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.report.certificate import exported
from pipeline.report.shared import page, words
from pipeline.report.shared.sources import Sources
from pipeline.verdict.controllers import BY_NAME
from pipeline.verdict.digits import number
from pipeline.verdict.evidence import entry, gap_of, known, need, need_figure, or_nothing
from pipeline.verdict.temperature import comparison
from pipeline.verdict.verdict import FAILED, OPEN, PASSED, Missing, Verdict

WORDS = ("verdict", "margin_disk", "margin_delay", "spread", "step", "hash")


def render(sources: Sources, verdict: Verdict) -> str:
    """The text of certificate.html; `verdict` is that of the temperature loop on page one."""
    lines = exported.lines(sources, verdict)
    shown = _certificate(sources, lines)
    whole = known(shown, None)
    mine = next((line for line in known(lines, []) if line["loop"] == "temperature"), None)
    passes = entry(comparison(sources.metrics), "best_reason", "passes") or {}
    return page.render(
        "certificate.html",
        here="certificate",
        sources=sources,
        title="Certificate",
        no_lines=gap_of(lines),
        state=mine["state"] if mine and mine["state"] in (PASSED, FAILED) else "open",
        mine=mine,
        certificate=whole,
        missing_certificate=gap_of(shown),
        controllers=sources.certified.get("temperature") or {},
        known_names=BY_NAME,
        beyond=[name for name, held in passes.items() if not held],
        figure=_figure,
        poles=poles(shown),
        margins=margins(whole) if whole else [],
        judged_margins=judged_margins(sources),
        lines=known(lines, []),
        origin_of=page.origin(sources.source("certificate", "export_controllers")),
        exports=known(sources.metrics.get("export_controllers") or {}, {}),
        words=words.chosen(sources, WORDS),
    )


def _certificate(
    sources: Sources, lines: Sequence[Mapping[str, str]] | Missing
) -> Mapping[str, Any] | Missing:
    """The certificate, or why there is none: in the words of export_controllers if it ran."""
    shown = sources.tables.get("certificate") or Missing(OPEN, "export_controllers has not run")
    why = next((line["why"] for line in known(lines, []) if line["loop"] == "temperature"), "")
    if not gap_of(shown):
        return shown
    return Missing(OPEN, why) if why else shown


def _figure(value: float | None, unit: str) -> str:
    """A number with its unit; empty where a rule counts nothing."""
    if value is None:
        return ""
    text = number(value, 0) if abs(value) >= 100 else f"{value:.3g}"
    return text if unit in ("", "1") else f"{text} {unit.replace('degC', '°C')}"


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
