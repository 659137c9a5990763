"""reports/nightly.html: what the job decided and why, what has drifted, what was in
production when, and whether anybody is watching."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pipeline.nightly.settings import Nightly
from pipeline.report.shared import charts, page
from pipeline.report.shared import night as records
from pipeline.report.shared.digits import count, number, short
from pipeline.report.shared.verdict import FAILED, OPEN, PASSED

SHOWN = 40  # nights in the table, the newest first
REACH = 20.0  # percent: half the width of the picture of the plant's parameters
GUARDS = {
    "worst_case": "worst plant's cost", "settled_error_degC": "worst settled error, °C",
    "margin_short_of_least": "disk margin, short of the least",
    "holdout_error_degC": "one-step error on hold-out recordings, °C",
    "unstable_plants": "plants on which it is unstable",
    "worst_line_volume_percent": "worst line's volume, % off",
    "worst_unsettled_percent": "runs not settled in the worst case, %, plus one",
    "slowest_p90_steps": "decisions until settled, slowest case",
}  # fmt: skip

LOOP = {
    "offset_degC": "offset from its reference, °C",
    "effort_percent": "effort, points",
    "at_limits_percent": "share of time at a limit, points",
}


def render(nights: Sequence[Mapping[str, Any]], state: Mapping[str, Any], settings: Nightly) -> str:
    """The whole page; `nights` as the job remembers them, the oldest first, the
    last of them tonight's; `state` is champion.json."""
    tonight = nights[-1]
    drift = records.read(tonight.get("drift"))
    measured = next((night for night in reversed(nights) if night.get("drift", {}).get("figures")), None)
    good = [night for night in nights if night["outcome"] != "failed"]
    return page.render(
        "nightly.html", here="nightly", title=_head(tonight)[0], verdict=_verdict(tonight, state),
        champions=_champions(state), decisions=_decisions(tonight),
        drift=_drift(measured, settings) if measured else None, alarms=drift.alarms, watched=drift.watched,
        pictures=_pictures(nights, settings), nights=[_row(night) for night in reversed(nights[-SHOWN:])],
        more=max(len(nights) - SHOWN, 0),
        history=[_line(line) for line in reversed(state["history"])],
        quarantined=tonight.get("quarantined", {}), notes=tonight.get("notes", []),
        watch={"last": _when(good[-1]["when"]) if good else "never", "run": good[-1]["run"] if good else "",
        "hours": f"{settings.watch_h:g}",
               "alarm": settings.alarm or "none is set", "webhook": settings.webhook or "none is set"},
        rule=_rule(settings), state=PASSED if _head(tonight)[1] == PASSED else FAILED,
    )  # fmt: skip


def _when(text: str) -> str:
    return text[:16].replace("T", " ") + " UTC"


def _head(night: Mapping[str, Any]) -> tuple[str, str]:
    drifted = _drifted(night)
    if night["outcome"] == "failed":
        return "The night failed; the champions stay.", FAILED
    if drifted:
        what = "The machine has drifted" if drifted == [records.PLANT] else f"Drift of {', '.join(drifted)}"
        promoted = ", ".join(night.get("promoted", []))
        return (f"{what}; promoted: {promoted}." if promoted else f"{what}; the champions stay."), FAILED
    if night["outcome"] == "quarantined":
        return "Bad recordings are set aside; the champions stay.", FAILED
    head = f"Promoted: {', '.join(night['promoted'])}." if night.get("promoted") else "The champions stay."
    return (f"{head} Bad recordings are set aside.", FAILED) if night.get("quarantined") else (head, PASSED)


def _drifted(night: Mapping[str, Any]) -> list[str]:
    """The loops that raised an alarm."""
    return list(dict.fromkeys(alarm.loop for alarm in records.read(night.get("drift")).alarms))


def _verdict(night: Mapping[str, Any], state: Mapping[str, Any]) -> dict[str, Any]:
    head, kind = _head(night)
    alarms, drifted = records.read(night.get("drift")).alarms, _drifted(night)
    reasons = (
        # of the loops that did not drift is said what is said on any night
        [*(alarm.cause for alarm in alarms), *_reasons(night, without=drifted)]
        if alarms and night["outcome"] != "failed"
        else [*_reasons(night), *night.get("quarantined", {}).values()]
    )
    remedy = {
        "failed": (
            "Nothing of what is in production has changed. "
            f"The log is .beadline/logs/{night['run']}.log; mend the cause, and the next night works."
        ),
        "promoted": "To go back: ./run beadline rollback.",
    }.get(night["outcome"], "")
    if night.get("quarantined"):
        remedy = (
            f"{remedy} They lie in datasets/quarantine, unchanged, each with its reason beside it; mend them "
            "and put them back."
        ).strip()
    if alarms and night["outcome"] != "failed":
        remedy = (
            f"No challenger of {'this loop' if len(drifted) == 1 else 'these loops'} is promoted while this "
            "lasts. Look at the machine; where the change is meant to stay: "
            + " and ".join(f'./run beadline nightly --accept-drift {loop} "WHY"' for loop in drifted)
            + "."
        )
    return {
        "state": "failed" if kind == FAILED else "passed",
        "decision": head,
        "lead": f"{night['run']}, {_when(night['when'])}:",
        "reason": "; ".join(reasons),
        "remedy": remedy,
    }


def _reasons(night: Mapping[str, Any], *, without: Sequence[str] = ()) -> list[str]:
    """The night's reasons, those that several loops share once; of the loops `without` nothing."""
    loops: dict[str, list[str]] = {}
    for name, decision in night.get("decisions", {}).items():
        if name not in without:
            loops.setdefault("; ".join(decision["reasons"]), []).append(name)
    by_loop = [f"{', '.join(names)}: {reason}" for reason, names in loops.items()]
    return by_loop if by_loop or without else list(night.get("reasons", []))


def _champions(state: Mapping[str, Any]) -> list[dict[str, str]]:
    return [
        {
            "loop": name,
            "run": entry["run"],
            "since": _when(entry.get("since", entry["when"])),
            "hash": entry["folder"]["md5"][:12],
            "commit": entry["lineage"]["commit"][:12],
        }
        for name, entry in state["champions"].items()
    ]


def _decisions(night: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for name, decision in night.get("decisions", {}).items():
        guards = [_guard(guard, figures) for guard, figures in decision.get("guards", {}).items()]
        rows.append(
            {
                "loop": name,
                "decision": decision["decision"],
                "reasons": decision["reasons"],
                "paired": _paired(decision.get("paired")),
                "guards": guards,
                "compared": any(guard["champion"] for guard in guards),
            }
        )
    return rows


def _guard(name: str, figures: Mapping[str, float | None]) -> dict[str, Any]:
    champion, challenger, allowed = (figures.get(key) for key in ("champion", "challenger", "allowed"))
    return {
        "name": GUARDS.get(name, name),
        "champion": _figure(champion),
        "challenger": _figure(challenger),
        "allowed": _figure(allowed),
        "bad": champion is not None and challenger > champion + allowed + 1e-9 * abs(champion),
    }


def _paired(test: Mapping[str, float] | None) -> str:
    if not test:
        return ""
    low, high = number(test["low_percent"], 1), number(test["high_percent"], 1)
    word = "less" if test["improvement_percent"] >= 0 else "more"
    return (
        f"The challenger's cases cost {number(abs(test['improvement_percent']), 1)} % {word} (90 % interval "
        f"of the saving {low} to {high} %); chance alone does as well with "
        f"probability {short(test['p'], 2)}, by a sign-flip test over {count(test['blocks'], 'block')} of "
        f"{count(test['cases'], 'case')}."
    )


def _figure(value: float | None) -> str:
    return "" if value is None else short(value, 3) if math.isfinite(value) else "none"


def _rule(settings: Nightly) -> str:
    r = settings.rule
    return (
        f"Promoted is what is at least {r.least_improvement_percent:g} % better, at level {r.level:g}, with "
        "no guard worse than is allowed, on a night without drift; otherwise the champion stays."
    )


# ---- drift


def _drift(night: Mapping[str, Any], settings: Nightly) -> dict[str, Any]:
    path, figures = list(night["drift"]["figures"].items())[-1]
    limit = settings.drift.parameter_percent
    rows = [
        {"name": name, "value": f"{number(one['percent'], 1)} %",
        "band": f"± {number(one['band_percent'], 1)}", "sigmas": number(one["sigmas"], 1),
         "svg": _interval(name, one["percent"], one["band_percent"], limit),
         "bad": abs(one["percent"]) >= limit and abs(one["sigmas"]) >= settings.drift.watch_sigmas}
        for name, one in figures["parameters"].items()
    ]  # fmt: skip
    innovation = [
        {"name": name, "noise": f"{number(one['noise_percent'], 0)} %",
        "noise_sigmas": number(one["noise_sigmas"], 1), "mean": f"{short(one['mean_degC'], 2)} °C",
         "mean_sigmas": number(one["mean_sigmas"], 1)}
        for name, one in figures["innovation"].items()
    ]  # fmt: skip
    loop = figures["closed_loop"]
    worst = sorted(
        ((abs(one["sigmas"]), name, one) for name, one in loop.items() if isinstance(one, dict)), reverse=True
    )[:6]
    return {
        "recording": path,
        "run": night["run"],
        "rows": rows,
        "innovation": innovation,
        "limit": f"{limit:g}",
        "not_applicable": loop.get("not_applicable") or "",
        "loop": [
            {"name": _words(name), "moved": number(one["moved"], 2), "sigmas": number(one["sigmas"], 1)}
            for _, name, one in worst
        ],
    }


def _words(name: str) -> str:
    """`heater_1 effort_percent` as a person says it."""
    signal, _, key = name.rpartition(" ")
    return f"{signal}: {LOOP.get(key, key)}"


def _interval(name: str, value: float, half: float, limit: float) -> Markup:
    """The change of a parameter with its 90 % band, from -REACH to REACH; grey is where nothing is wrong."""
    at = [
        160 + 160 * max(-1.0, min(1.0, part / REACH))
        for part in (value - half, value, value + half, -limit, limit)
    ]
    bad = " bad" if abs(value) - half > limit else ""
    return Markup(
        '<svg viewBox="0 0 320 20" width="320" height="20" role="img" aria-label="{}: {} percent, '
        'band {} to {}, allowed {} either way">'
        '<rect class="beyond" x="{:.1f}" width="{:.1f}" y="0" height="20"/><line class="limit" x1="160" '
        'x2="160" y1="0" y2="20"/>'
        '<line class="mb{}" x1="{:.1f}" x2="{:.1f}" y1="10" y2="10"/><rect class="mb{}" x="{:.1f}" y="6.5" '
        'width="7" height="7"/></svg>'
    ).format(
        name,
        number(value, 1),
        number(value - half, 1),
        number(value + half, 1),
        f"{limit:g}",
        at[3],
        at[4] - at[3],
        bad,
        at[0],
        at[2],
        bad,
        at[1] - 3.5,
    )


def _nights_axis(x: Sequence[int]) -> charts.Axis:
    every = max(1, math.ceil((x[-1] - x[0]) / 8))
    return charts.Axis(x[0], x[-1], tuple((float(k), str(k)) for k in range(x[0], x[-1] + 1, every)))


def _pictures(nights: Sequence[Mapping[str, Any]], settings: Nightly) -> list[dict[str, Any]]:
    """The largest change of the plant's parameters, night by night, in sigmas, beside the alarm."""
    x, y = [], []
    for night in nights:
        figures = night.get("drift", {}).get("figures", {})
        if figures:
            x.append(night["night"])
            y.append(
                max(
                    abs(one["sigmas"]) for figure in figures.values() for one in figure["parameters"].values()
                )
            )
    if len(x) < 2:
        return []
    top = max(*y, settings.drift.alarm_sigmas) * 1.15
    frame = charts.Frame(_nights_axis(x), charts.linear(0, top), 760, 150, 36, 18, 20, 12)
    layers = [
        charts.tint(frame, 0, settings.drift.alarm_sigmas),
        charts.line(frame, x, y),
        charts.dots(frame, x, y),
        charts.level(frame, settings.drift.alarm_sigmas, "lim", "alarm"),
    ]
    alt = (
        f"Largest change of a plant parameter over {len(x)} nights: {number(y[-1], 1)} sigmas last night, "
        f"{number(max(y), 1)} at most; the alarm is at {settings.drift.alarm_sigmas:g}"
    )
    return [
        {
            "svg": charts.panel(frame, layers, alt=alt, title="Largest change of a plant parameter, sigmas"),
            "caption": f"{alt}. Across: nights.",
        }
    ]


# ---- the nights


def _row(night: Mapping[str, Any]) -> dict[str, Any]:
    alarms = [alarm.cause for alarm in records.read(night.get("drift")).alarms]
    state = (
        FAILED
        if night["outcome"] == "failed" or night.get("quarantined") or alarms
        else OPEN
        if night["outcome"] == "nothing new"
        else PASSED
    )
    reasons = "; ".join([*_reasons(night), *night.get("quarantined", {}).values()])
    return {
        "run": night["run"], "when": _when(night["when"]), "state": state, "outcome": night["outcome"],
        "new": sum(map(len, night.get("new_recordings", {}).values())),
        "reasons": "; ".join([*(alarm for alarm in alarms if alarm not in reasons), reasons]),
        "seconds": number(night.get("seconds", 0), 0),
    }  # fmt: skip


def _line(line: Mapping[str, Any]) -> dict[str, str]:
    return {
        "when": _when(line["when"]),
        "loop": line["loop"],
        "run": line["run"],
        "event": line["event"],
        "before": line["before"] or "nothing",
        "why": line["why"],
        "hash": line["champion"]["folder"]["md5"][:12],
    }
