"""Reports a nightly run: memory, page, alarm or heartbeat, and one line. If one of these fails, the others
are still made, and an error of this program does not hide the run."""

import datetime
import html
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.nightly import champion, records, remembered, watch
from pipeline.nightly.processes import STATE
from pipeline.nightly.records import ChampionState, Memory, Night, to_json
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params

OK, FAILED, DRIFTED, QUARANTINED, BUSY = 0, 1, 3, 4, 75
# returns the page from all remembered runs, the state of production, and the settings. The caller passes it
# in, so that this package does not depend on pages
Render = Callable[[Sequence[Night], ChampionState, Nightly], str]
PAGE = Path("reports/nightly.html")
# errors that are reported in a sentence; any other is an error of this program, and its traceback is in the
# log
REFUSALS = (ValueError, OSError, MemoryError, np.linalg.LinAlgError)
MOST_RECORDS = 3  # recordings for which the summary says how much was used


def tell(error: Exception, run: str) -> str:
    """Returns an error in one sentence. The traceback of an error of this program is written to the run's
    log."""
    text = artifacts.reason(error) if isinstance(error, OSError | MemoryError) else str(error)
    sentence = " ".join(text.split())
    if isinstance(error, REFUSALS) and not isinstance(error, UnicodeError):
        return sentence or type(error).__name__
    log = STATE / "logs" / f"{run}.log"
    try:
        before = log.read_bytes() if log.exists() else b""
        lines = "".join(traceback.format_exception(error)).encode("utf-8", "replace")
        artifacts.write_bytes(log, before + b"\n" + lines)
        where = f"its traceback is in {log}"
    except OSError as full:
        where = f"its traceback could not be written ({full.strerror})"
    return f"a mistake of this program ({type(error).__name__}: {sentence}); {where}; please report it"


def report(night: Night, memory: Memory, settings: Nightly | None, render: Render) -> tuple[int, str]:
    """Writes memory and page, and sends alarm or heartbeat. Returns exit status and summary. `render` makes
    the page."""
    troubles: list[str] = []

    def attempt(part: Callable[[], None]) -> bool:
        try:
            part()
            return True
        except Exception as error:  # the next part is tried all the same
            troubles.append(tell(error, night.run))
            return False

    memory.nights.append(night)
    attempt(lambda: remembered.write(memory))
    made = night.outcome == records.NOTHING_NEW and PAGE.exists()
    if not made and not (
        settings and attempt(lambda: _write_page(night, troubles, memory, settings, render))
    ):
        attempt(lambda: artifacts.write_text(PAGE, render_plainly(night, troubles)))
    status = FAILED if troubles else exit_status(night)
    routes = watch.find_routes(settings)
    if status != FAILED:
        troubles += watch.beat(routes)
    if status != OK:
        kind, reasons = _alarm(night, status, troubles)
        details = {
            "drift": to_json(night.drift),
            "quarantined": night.drift.quarantined,
            "log": f".beadline/logs/{night.run}.log",
        }
        troubles += watch.wake(kind, reasons, _details(night, status) | details, routes)
    return status, summarise(night, troubles)


def _write_page(
    night: Night, troubles: Sequence[str], memory: Memory, settings: Nightly, render: Render
) -> None:
    night.notes += troubles
    artifacts.write_text(PAGE, render(memory.nights, champion.read(), watch.hide_secrets(settings)))


def _details(night: Night, status: int) -> dict[str, str | int]:
    return {"night": night.run, "when": night.when, "status": status}


def render_plainly(night: Night, troubles: Sequence[str]) -> str:
    """Returns a page of plain sentences, if the run's own page cannot be made."""
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
    """Returns the exit status for a scheduler: the most serious event of the run."""
    if night.outcome == records.FAILED or night.unpushed or night.lost:
        return FAILED
    if night.drift.alarms:
        return DRIFTED
    return QUARANTINED if night.drift.quarantined else OK


def _alarm(night: Night, status: int, troubles: Sequence[str]) -> tuple[str, list[str]]:
    """Returns the alarm's kind, by the most serious event, and the reasons of all events."""
    drift, aside = [alarm.cause for alarm in night.drift.alarms], list(night.drift.quarantined.values())
    if status == FAILED:
        lost = [f"{name}: {night.decisions[name].reasons[0]}" for name in night.lost]
        own = night.reasons if night.outcome == records.FAILED else lost
        unpushed = night.notes if night.unpushed else ()
        return "failed", list(dict.fromkeys([*own, *unpushed, *troubles, *drift, *aside]))
    return ("drift", [*drift, *aside]) if status == DRIFTED else ("quarantined", aside)


def summarise(night: Night, troubles: Sequence[str]) -> str:
    alarms = [alarm.cause for alarm in night.drift.alarms]
    parts = [f"nightly: {night.run} {night.outcome}"]
    if night.promoted:
        where = f" on branch {night.branch}" if night.branch else ""
        parts.append(f"promoted {', '.join(night.promoted)}{where}")
    waiting = [f"{name}: {why}" for name, why in night.candidates.items()]
    parts += [f"candidate {one}" for one in waiting]
    if alarms:
        parts.append(f"drift: {'; '.join(alarms)}")
    rest = [why for why in night.reasons if why not in waiting]
    if rest and (not (night.promoted or alarms) or night.lost or night.outcome == records.FAILED):
        parts.append("; ".join(rest))
    if night.drift.quarantined:
        parts.append("quarantined: " + "; ".join(night.drift.quarantined.values()))
    for path, share in list(night.used.items())[:MOST_RECORDS]:
        lost = [word for word in ("masked", "cut") if share[f"{word}_percent"] >= 1]
        parts.append(", ".join([f"used {share['used_percent']:.0f} % of {Path(path).name}", *lost]))
    sentences = dict.fromkeys([*parts, *night.notes, *troubles])
    text = " ".join(" | ".join([*sentences, f"{night.seconds:g} s"]).split())
    return text if len(text) <= 1000 else text[:999] + "…"


# ---- when there is no night


def last_resort(error: Exception, now: datetime.datetime) -> tuple[int, str]:
    """Returns exit status and summary of a run that could not be started or reported. The alarm is sent
    anyway, with whatever is known."""
    night = Night(0, "nightly", watch.stamp(now))
    night.end(records.FAILED, tell(error, "nightly"))
    settings, _ = load_settings()
    troubles = watch.wake("failed", night.reasons, _details(night, FAILED), watch.find_routes(settings))
    try:
        artifacts.write_text(PAGE, render_plainly(night, troubles))
    except Exception as unwritten:
        troubles.append(tell(unwritten, "nightly"))
    return FAILED, summarise(night, troubles)


def load_settings() -> tuple[Nightly | None, list[str]]:
    """Returns section nightly of the parameters, None if it is broken, and what is wrong with it, as
    sentences."""
    try:
        return params.load(Nightly, "nightly"), []
    except Exception as error:  # whatever is in the parameters, the alarm must be sent
        return None, [tell(error, "nightly")]


def watchdog(now: datetime.datetime | None = None) -> tuple[int, str]:
    """Returns exit status and summary of a check: has no run succeeded for too long, or is something broken
    that runs depend on? If so, sends the alarm. Takes no lock, so it also detects a run that hangs."""
    now = now or datetime.datetime.now(datetime.UTC)
    settings, reasons = load_settings()
    success = ""
    try:
        champion.read()
        success = remembered.read().success
        if settings:
            reasons += filter(None, [watch.find_overdue(now, success, settings.watch_h)])
    except Exception as error:  # a watchdog that crashes would not warn anybody
        reasons.append(tell(error, "watch"))
    if not reasons:
        return OK, f"nightly: watch: the last success was at {success}"
    troubles = watch.wake("watch", reasons, {"when": watch.stamp(now)}, watch.find_routes(settings))
    return FAILED, " | ".join([f"nightly: watch: {'; '.join(reasons)}", *troubles])
