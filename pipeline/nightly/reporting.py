"""How a night is told: what is remembered of it, its page, the alarm or the heartbeat, and one line. None of
these may hide the others, nor a mistake of this program the night."""

import contextlib
import datetime
import html
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.nightly import champion, guarding, records, remembered, watch
from pipeline.nightly.processes import STATE
from pipeline.nightly.records import ChampionState, Night
from pipeline.nightly.remembered import METRICS, Remembered
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params

OK, FAILED, DRIFTED, QUARANTINED, BUSY = 0, 1, 3, 4, 75
# every night that is remembered, what is in production, and the settings -> the page. The caller brings it,
# so that the night knows no page
Render = Callable[[Sequence[Night], ChampionState, Nightly], str]
PAGE = Path("reports/nightly.html")
# what ends a night in a sentence; anything else is a mistake of this program, whose traceback is in the log
REFUSALS = (ValueError, OSError, MemoryError, np.linalg.LinAlgError)


def told(error: Exception, run: str) -> str:
    """An error in one sentence. The traceback of a mistake of this program goes to the night's log."""
    said = " ".join(
        (artifacts.reason(error) if isinstance(error, OSError | MemoryError) else str(error)).split()
    )
    if isinstance(error, REFUSALS) and not isinstance(error, UnicodeError):
        return said or type(error).__name__
    log = STATE / "logs" / f"{run}.log"
    try:
        before = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
        text = "".join(traceback.format_exception(error)).encode("utf-8", "replace").decode()
        artifacts.write_text(log, f"{before}\n{text}")
        where = f"its traceback is in {log}"
    except OSError as full:
        where = f"its traceback could not be written ({full.strerror})"
    return f"a mistake of this program ({type(error).__name__}: {said}); {where}; please report it"


def settings_or_known(last: Remembered, run: str) -> tuple[Nightly | None, list[str]]:
    """Section nightly of the parameters, or as it was last known where they are broken, None where it never
    was; and what is wrong with them, as a sentence."""
    try:
        guarding.whole_text(params.FILE, *([params.EXPERT] if Path(params.EXPERT).exists() else []))
        return params.load(Nightly, "nightly"), []
    except Exception as error:  # nothing in a file of parameters may keep the alarm from going out
        return last.known(), [told(error, run)]


# ---- the report


def report(night: Night, tonight: Remembered, settings: Nightly | None, render: Render) -> tuple[int, str]:
    """State, page, alarm or heartbeat; the exit status and the summary. `tonight` is what is remembered,
    `render` makes the page."""
    troubles: list[str] = []

    def attempt(part: Callable[[], None]) -> bool:
        try:
            part()
            return True
        except Exception as error:  # the next part is tried all the same
            troubles.append(told(error, night.run))
            return False

    if night.outcome not in (records.FAILED, records.NOTHING_NEW) and not night.commit:
        attempt(lambda: artifacts.write_json(METRICS, night.metrics(champion.read())))
    attempt(lambda: remembered.remember(tonight))
    attempt(lambda: remembered.add(night))
    shown = night.noted(*troubles)
    made = night.outcome == records.NOTHING_NEW or (
        settings and attempt(lambda: _write_page(shown, settings, render))
    )
    if not made:
        attempt(lambda: artifacts.write_text(PAGE, plain_page(night, troubles)))
    status = FAILED if troubles else exit_status(night)
    routes = watch.routes(settings)
    if status == OK or (status in (DRIFTED, QUARANTINED) and night.outcome != records.FAILED):
        troubles += watch.beat(routes)
    if status != OK:
        kind, reasons = _alarm(night, status, troubles)
        details = {
            "night": night.run,
            "when": night.when,
            "status": status,
            "drift": night.drift_row(),
            "quarantined": dict(night.quarantined),
            "log": f".beadline/logs/{night.run}.log",
        }
        troubles += watch.wake(kind, reasons, details, routes)
    return status, summary(night, troubles)


def _write_page(night: Night, settings: Nightly, render: Render) -> None:
    nights = [*(earlier for earlier in remembered.nights() if earlier.number != night.number), night]
    artifacts.write_text(PAGE, render(nights, champion.read(), watch.shown(settings)))


def plain_page(night: Night, troubles: Sequence[str]) -> str:
    """A page of sentences, for a night whose own page cannot be made."""
    sentences = dict.fromkeys((*night.reasons, *night.notes, *troubles))
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    head = f"{night.run}: {night.outcome or 'ended'}"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(head)}</title>'
        f"<h1>{html.escape(head)}</h1><p>{html.escape(night.when)}. What is in production has not been "
        f"looked at for this page; the log is .beadline/logs/{html.escape(night.run)}.log.</p>"
        f"<ul>{items}</ul></html>\n"
    )


def exit_status(night: Night) -> int:
    """What a scheduler is told: the gravest of what the night met."""
    if night.outcome == records.FAILED or night.unpushed or night.lost:
        return FAILED
    if night.drift.alarms:
        return DRIFTED
    return QUARANTINED if night.quarantined else OK


def _alarm(night: Night, status: int, troubles: Sequence[str]) -> tuple[str, list[str]]:
    """What somebody is woken for, and all of why: the gravest hides none of the others."""
    drift, aside = [alarm.cause for alarm in night.drift.alarms], list(night.quarantined.values())
    if status == FAILED:
        lost = [f"{name}: {night.decisions[name].reasons[0]}" for name in night.lost]
        own = (
            night.reasons
            if night.outcome == records.FAILED
            else (*lost, *(night.notes if night.unpushed else ()))
        )
        return "failed", list(dict.fromkeys([*own, *troubles, *drift, *aside]))
    return ("drift", [*drift, *aside]) if status == DRIFTED else ("quarantined", aside)


def summary(night: Night, troubles: Sequence[str]) -> str:
    alarms = [alarm.cause for alarm in night.drift.alarms]
    parts = [f"nightly: {night.run} {night.outcome}"]
    if night.promoted:
        where = f" on branch {night.branch}" if night.branch else ""
        parts.append(f"promoted {', '.join(night.promoted)}{where}")
    waiting = [f"{name}: {why}" for name, why in night.candidates.items()]
    parts += [f"candidate {one}" for one in waiting]
    if alarms:
        parts.append(f"drift: {'; '.join(alarms)}")
    if not (night.promoted or alarms) or night.lost or night.outcome == records.FAILED:
        parts += ["; ".join(rest)] if (rest := [why for why in night.reasons if why not in waiting]) else []
    if night.quarantined:
        parts.append("quarantined: " + "; ".join(night.quarantined.values()))
    sentences = dict.fromkeys([*parts, *night.notes, *troubles])
    text = " ".join(" | ".join([*sentences, f"{night.seconds or 0:g} s"]).split())
    return text if len(text) <= 1000 else text[:999] + "…"


# ---- when there is no night


def last_resort(error: Exception, now: datetime.datetime) -> tuple[int, str]:
    """Exit status and summary where not even a night could be begun or reported; somebody is woken all the
    same, by whatever is known."""
    try:
        last = remembered.last()
    except Exception:  # of a broken memory nothing is known
        last = Remembered()
    why = told(error, "nightly")
    settings, _ = settings_or_known(last, "nightly")
    details = {"night": "nightly", "when": watch.stamp(now), "status": FAILED}
    troubles = watch.wake("failed", [why], details, watch.routes(settings))
    night = Night(last.night + 1, "nightly", watch.stamp(now)).ended(records.FAILED, why)
    try:
        artifacts.write_text(PAGE, plain_page(night, troubles))
    except Exception as unwritten:
        troubles.append(told(unwritten, "nightly"))
    return FAILED, summary(night, troubles)


def watchdog(now: datetime.datetime | None = None) -> tuple[int, str]:
    """Whether somebody should look: no night has succeeded for too long, or what nights work by is broken.
    The alarm goes out with it. Takes no lock: a night that hangs is seen too."""
    now = now or datetime.datetime.now(datetime.UTC)
    try:
        reasons, last = remembered.broken(), Remembered()
        try:
            champion.read()
        except remembered.MISSHAPEN as error:
            reasons.append(told(error, "watch"))
        with contextlib.suppress(ValueError):  # broken, which is a reason already
            last = remembered.last()
        settings, refused = settings_or_known(last, "watch")
        late = watch.overdue(now, last.success, settings.watch_h) if settings and not reasons else ""
        reasons = [*reasons, *refused, *filter(None, [late])]
    except Exception as error:  # a watchdog that dies would be the most silent of all
        reasons, settings, last = [told(error, "watch")], None, Remembered()
    if not reasons:
        return OK, f"nightly: watch: the last success was at {last.success}"
    troubles = watch.wake("watch", reasons, {"when": watch.stamp(now)}, watch.routes(settings))
    return FAILED, " | ".join([f"nightly: watch: {'; '.join(reasons)}", *troubles])
