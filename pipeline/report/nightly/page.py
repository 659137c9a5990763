"""reports/nightly.html: what the job decided and why, what has drifted, what was in
production when, and whether anybody is watching."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pipeline.nightly import records
from pipeline.nightly.records import (
    PLANT,
    SENSOR,
    Champion,
    ChampionState,
    HistoryLine,
    LoopDecision,
    Night,
    sort_alarms,
)
from pipeline.nightly.settings import Nightly
from pipeline.report.shared import charts, page
from pipeline.statistics import Paired
from pipeline.verdict.controllers import heading
from pipeline.verdict.digits import beyond_meaning, count, number, quantity, short
from pipeline.verdict.verdict import FAILED, OPEN, PASSED

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


def render(nights: Sequence[Night], state: ChampionState, settings: Nightly) -> str:
    """The whole page; `nights` as the job remembers them, the oldest first, the
    last of them tonight's; `state` is champion.json."""
    tonight = nights[-1]
    measured = next((night for night in reversed(nights) if night.drift.figures), None)
    return page.render(
        "nightly.html",
        here="nightly",
        title=_head(tonight)[0],
        verdict=_verdict(tonight),
        champions=_champions(state.champions),
        candidates=_champions(state.candidates),
        decisions=[_decision(name, decision) for name, decision in tonight.decisions.items()],
        drift=_drift(measured, settings) if measured else None,
        alarms=sort_alarms(tonight.drift.alarms),
        watched=tonight.drift.watched,
        pictures=_pictures(nights, settings),
        nights=[_row(night) for night in reversed(nights[-SHOWN:])],
        more=max(len(nights) - SHOWN, 0),
        history=[_line(line) for line in reversed(state.history)],
        quarantined=tonight.drift.quarantined,
        notes=tonight.notes,
        used=[_used(path, share, tonight) for path, share in tonight.used.items()],
        watch=_watch(nights, settings),
        rule=_rule(settings),
        state=_head(tonight)[1],
    )


def _when(text: str) -> str:
    return text[:16].replace("T", " ") + " UTC"


def _watch(nights: Sequence[Night], settings: Nightly) -> dict[str, str]:
    good = [night for night in nights if night.outcome != records.FAILED]
    return {
        "last": _when(good[-1].when) if good else "never",
        "run": good[-1].run if good else "",
        "hours": f"{settings.watch_h:g}",
        "alarm": settings.alarm or "none is set",
        "webhook": settings.webhook or "none is set",
    }


def _head(night: Night) -> tuple[str, str]:
    """The decision in a sentence, and whether it is as it should be."""
    drifted, promoted = _drifted(night), ", ".join(night.promoted)
    where = f" on branch {night.branch}, not yet in production" if night.branch else ""
    if night.outcome == records.FAILED:
        return "The night failed; the champions stay.", FAILED
    if drifted:
        what = "The machine has drifted" if drifted == [PLANT] else f"Drift of {', '.join(drifted)}"
        if dead := _dead_sensors(night):
            what = f"Check {', '.join(dead)} before the machine heats again"
        return (
            f"{what}; promoted{where}: {promoted}." if promoted else f"{what}; the champions stay."
        ), FAILED
    if night.outcome == records.QUARANTINED:
        return "Bad recordings are set aside; the champions stay.", FAILED
    candidates = ", ".join(night.candidates)
    head = f"Promoted{where}: {promoted}." if promoted else "The champions stay."
    if candidates:
        passes = f"{candidates} {'do' if len(night.candidates) > 1 else 'does'} not pass"
        head = f"{head} {passes[:1].upper()}{passes[1:]}." if promoted else f"Nothing is promoted: {passes}."
    if night.lost:
        return f"Failed: {', '.join(night.lost)}. {head}", FAILED
    if night.drift.quarantined:
        return f"{head} Bad recordings are set aside.", FAILED
    return head, OPEN if candidates and not promoted else PASSED


def _drifted(night: Night) -> list[str]:
    """The loops that raised an alarm."""
    return list(dict.fromkeys(alarm.loop for alarm in night.drift.alarms))


def _dead_sensors(night: Night) -> list[str]:
    return list(dict.fromkeys(alarm.channel for alarm in night.drift.alarms if alarm.kind == SENSOR))


def _verdict(night: Night) -> dict[str, Any]:
    head, kind = _head(night)
    drifted = [] if night.outcome == records.FAILED else _drifted(night)
    causes = [alarm.cause for alarm in sort_alarms(night.drift.alarms)]
    reasons = (
        # of the loops that did not drift is said what is said on any night
        [*causes, *_reasons(night, without=drifted)]
        if drifted
        else [*_reasons(night), *night.drift.quarantined.values()]
    )
    return {
        "state": {FAILED: "failed", PASSED: "passed"}.get(kind, "open"),
        "decision": head,
        "lead": f"{night.run}, {_when(night.when)}:",
        "reason": "; ".join(reasons),
        "remedy": _remedy(night, drifted),
    }


def _remedy(night: Night, drifted: Sequence[str]) -> str:
    """What to do; `drifted` are the loops whose alarm stands."""
    if dead := _dead_sensors(night):
        return (
            f"Check {', '.join(dead)}, the wiring and the heater beside it: a controller on a dead sensor "
            "heats without limit. The recording is set aside, and nothing is promoted while this lasts."
        )
    if drifted:
        commands = (f'./run beadline nightly --accept-drift {loop} "WHY"' for loop in drifted)
        return (
            f"No challenger of {'this loop' if len(drifted) == 1 else 'these loops'} is promoted while this "
            f"lasts. Look at the machine; where the change is meant to stay: {' and '.join(commands)}."
        )
    remedy = {
        records.FAILED: (
            "Nothing of what is in production has changed. "
            f"The log is .beadline/logs/{night.run}.log; mend the cause, and the next night works."
        ),
        records.PROMOTED: (
            f"To put it into production: git merge {night.branch}; the next night brings it."
            if night.branch
            else "To go back: ./run beadline nightly --rollback."
        ),
    }.get(night.outcome, "")
    if not night.drift.quarantined:
        return remedy
    set_aside = (
        "They lie in datasets/quarantine, unchanged, each with its reason beside it; mend them and put them "
        "back. What git or DVC keeps lies where it was, listed in excluded.yaml; mend it there."
    )
    return f"{remedy} {set_aside}".strip()


def _reasons(night: Night, *, without: Sequence[str] = ()) -> list[str]:
    """The night's reasons, those that several loops share once; of the loops `without` nothing."""
    loops: dict[str, list[str]] = {}
    for name, decision in night.decisions.items():
        if name not in without:
            loops.setdefault("; ".join(decision.reasons), []).append(name)
    by_loop = [f"{', '.join(names)}: {reason}" for reason, names in loops.items()]
    return by_loop if by_loop or without else list(night.reasons)


def _champions(champions: Mapping[str, Champion]) -> list[dict[str, str]]:
    """Champions or candidates: whose files, since when, and what runs as it."""
    return [
        {
            "loop": name,
            "run": champion.run,
            "since": _when(champion.since or champion.when),
            "contestant": heading(champion.contestant),
            "simulation": "simulation" if champion.rehearsal else "",
            "verdict": champion.verdict,
            "exported": _exported(champion),
        }
        for name, champion in champions.items()
    ]


def _exported(champion: Champion) -> str:
    """The certified controller in a champion's folder, with the hash of its certificate; empty where it has
    none."""
    files = champion.files
    certificate = next((path for path in files if path.endswith("/certificate.json")), "")
    folder = certificate.removesuffix("certificate.json")
    if not certificate or f"{folder}controller.json" not in files:
        return ""
    return f"{folder}controller.json, certificate {files[certificate][:8]}"


def _decision(name: str, decision: LoopDecision) -> dict[str, Any]:
    guards = [_guard(guard, figures) for guard, figures in decision.guards.items()]
    return {
        "loop": name,
        "decision": decision.decision,
        "reasons": [
            reason
            for reason in decision.reasons
            if not decision.verdict or reason != decision.verdict.sentence
        ],
        "page": decision.verdict,
        "paired": _paired(decision.paired),
        "guards": guards,
        "compared": any(guard["champion"] for guard in guards),
    }


def _guard(name: str, guard: Mapping[str, float | None]) -> dict[str, Any]:
    figures = {key: _figure(value) for key, value in guard.items()}
    return {"name": GUARDS.get(name, name), **figures, "bad": _worse_than_allowed(guard)}


def _worse_than_allowed(guard: Mapping[str, float | None]) -> bool:
    champion, challenger, allowed = guard["champion"], guard["challenger"], guard["allowed"]
    if champion is None or challenger is None or allowed is None:
        return False
    return challenger > champion + allowed + 1e-9 * abs(champion)


def _paired(test: Paired | None) -> str:
    if not test:
        return ""
    low, high = quantity(test.low_percent, "%", 1), quantity(test.high_percent, "%", 1)
    word = "less" if test.improvement_percent >= 0 else "more"
    saving = quantity(abs(test.improvement_percent), "%", 1)
    return (
        f"The challenger's cases cost {saving} {word} (90 % interval "
        f"of the saving {low} to {high}); chance alone does as well with "
        f"probability {short(test.p, 2)}, by a sign-flip test over {count(test.blocks, 'block')} of "
        f"{count(test.cases, 'case')}."
    )


def _figure(value: float | None) -> str:
    return "" if value is None else short(value, 3) if math.isfinite(value) else "none"


def _rule(settings: Nightly) -> str:
    r = settings.rule
    return (
        f"Promoted is what is at least {r.least_improvement_percent:g} % better, at level {r.level:g}, with "
        "no guard worse than is allowed, on a night without drift; otherwise the champion stays. What does "
        "not pass the rules of its loop's page is a candidate: kept in champion/LOOP.candidate, and not run."
    )


def _used(path: str, share: Mapping[str, float], night: Night) -> dict[str, str]:
    """How much of a new recording was used, and the smallest changes that it could have shown."""
    columns = {name: quantity(share[f"{name}_percent"], "%", 0) for name in ("used", "masked", "cut")}
    return {"recording": path, **columns, "least": night.drift.figures.get(path, {}).get("least", "")}


# ---- drift


def _drift(night: Night, settings: Nightly) -> dict[str, Any]:
    path, figures = list(night.drift.figures.items())[-1]
    limit = settings.drift.parameter_percent
    rows = [
        {"name": name, "value": quantity(change["percent"], "%", 1),
        "band": f"± {quantity(change['band_percent'], '%', 1)}", "sigmas": number(change["sigmas"], 1),
         "svg": _interval(name, change["percent"], change["band_percent"], limit),
         "bad": abs(change["percent"]) >= limit and abs(change["sigmas"]) >= settings.drift.watch_sigmas}
        for name, change in figures["parameters"].items()
    ]  # fmt: skip
    changes = figures.get("closed_loop", {}).items()
    worst = sorted(((abs(one["sigmas"]), name, one["moved"], one["sigmas"]) for name, one in changes))[:-7:-1]
    return {
        "recording": path,
        "run": night.run,
        "rows": rows,
        "innovation": [
            {
                "name": output,
                "noise": quantity(errors["noise_percent"], "%", 0),
                "noise_sigmas": number(errors["noise_sigmas"], 1),
                "mean": beyond_meaning(errors["mean_degC"], "°C") or f"{short(errors['mean_degC'], 2)} °C",
                "mean_sigmas": number(errors["mean_sigmas"], 1),
            }
            for output, errors in figures.get("innovation", {}).items()
        ],
        "limit": f"{limit:g}",
        "not_applicable": figures.get("not_applicable", ""),
        "loop": [
            {"name": _words(name), "moved": number(moved, 2), "sigmas": number(sigmas, 1)}
            for _, name, moved, sigmas in worst
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
        *(beyond_meaning(part, "%") or number(part, 1) for part in (value, value - half, value + half)),
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


def _pictures(nights: Sequence[Night], settings: Nightly) -> list[dict[str, Any]]:
    """The largest change of the plant's parameters, night by night, in sigmas, beside the alarm."""
    x, y = [], []
    for night in nights:
        if figures := night.drift.figures.values():
            changes = [change for recording in figures for change in recording["parameters"].values()]
            x.append(night.number)
            y.append(max(abs(change["sigmas"]) for change in changes))
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


def _row(night: Night) -> dict[str, Any]:
    causes = [alarm.cause for alarm in sort_alarms(night.drift.alarms)]
    state = OPEN if night.outcome in (records.NOTHING_NEW, records.CANDIDATE) else PASSED
    if night.outcome == records.FAILED or night.lost or night.drift.quarantined or causes:
        state = FAILED
    reasons = "; ".join([*_reasons(night), *night.drift.quarantined.values()])
    return {
        "run": night.run,
        "when": _when(night.when),
        "state": state,
        "outcome": night.outcome,
        "new": sum(map(len, night.new_recordings.values())),
        "reasons": "; ".join([*(cause for cause in causes if cause not in reasons), reasons]),
        "seconds": number(night.seconds, 0),
    }


def _line(line: HistoryLine) -> dict[str, str]:
    return {
        "when": _when(line.when),
        "loop": line.loop,
        "run": line.run,
        "event": line.event,
        "before": line.before or "nothing",
        "why": line.why,
        "hash": line.champion.md5[:12],
    }
