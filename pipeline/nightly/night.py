"""One night: recordings in, `dvc repro`, judge, promote or keep, say so.

Exit status 0: promoted, kept, or nothing new; 1: the night failed; 3: drift alarm; 4: recordings were set
aside; 75: another night is at work."""

import datetime
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.nightly import champion, guarding, inputs, watch
from pipeline.nightly.processes import STATE, commit, dvc, git
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params

if TYPE_CHECKING:  # what judges takes seconds to import, and a night with nothing new is done without
    from pipeline.nightly.decision import Decision

OK, FAILED, DRIFTED, QUARANTINED, BUSY = 0, 1, 3, 4, 75
NIGHTS = STATE / "nights.json"
METRICS = Path("reports/metrics/nightly.json")
LONGEST_HISTORY = 1000


def nightly(now: datetime.datetime | None = None) -> tuple[int, str]:
    """Exit status and the one-line summary of a night. Raises
    ValueError where the parameters do not say what to do."""
    settings = params.load(Nightly, "nightly")
    started = now or datetime.datetime.now(datetime.UTC)
    try:
        with guarding.alone() as left:
            return _night(settings, started, left)
    except guarding.BusyError as busy:
        return BUSY, f"nightly: refused: {busy}"


def _night(settings: Nightly, now: datetime.datetime, left: list[str]) -> tuple[int, str]:
    remembered, clock = watch.last(), time.monotonic()
    entry: dict[str, Any] = {
        "night": int(remembered["night"]) + 1,
        "run": f"night-{int(remembered['night']) + 1:04d}",
        "when": watch.stamp(now),
        "outcome": "",
        "notes": left,
    }
    success = remembered.get("success")
    if success and now < datetime.datetime.fromisoformat(success):
        entry["notes"].append(
            f"the clock was set back: it is {entry['when']}, and the last success was at {success}"
        )
    overdue = watch.overdue(now, settings.watch_h) if success else ""
    hashes, digests = inputs.Hashes(remembered.get("hashes", {})), None
    try:
        guarding.ready(settings.least_free_mb)
        digests = _work(settings, entry, remembered, hashes)
    except (ValueError, OSError, np.linalg.LinAlgError) as error:
        guarding.RESERVE.unlink(missing_ok=True)  # on a full disk, what follows is written from it
        entry |= {"outcome": "failed", "reasons": [" ".join(str(error).split())]}
    entry["seconds"] = round(time.monotonic() - clock, 1)
    entry["notes"] += [f"watch: {overdue}"] if overdue else []
    return _say(settings, entry, remembered, hashes, digests)


def _work(
    settings: Nightly,
    entry: dict[str, Any],
    remembered: dict[str, Any],
    hashes: inputs.Hashes,
    *,
    again: bool = True,
) -> dict[str, str]:
    """The night itself; what it did goes to `entry`. Returns what it was made from, {path: digest}.
    If that changes while the stages run, the night restarts once."""
    places = _places(settings)
    before = inputs.contents(hashes, places)
    if _nothing_new(before, remembered):
        outcome = "quarantined" if entry.get("quarantined") else "nothing new"
        entry |= {
            "outcome": outcome,
            "reasons": ["no recording, parameter or code has changed since the last night"],
        }
        return before
    new = {
        name: _new(before, loop.recordings, remembered.get("recordings", {}).get(name, {}))
        for name, loop in settings.loops.items()
    }
    entry["new_recordings"] = {name: sorted(paths) for name, paths in new.items() if paths}
    from pipeline.nightly import screening

    state = champion.read()
    screened = screening.look(settings, state, new, remembered.get("drift", {}), night=entry["night"])
    entry |= {"drift": screened.drift, "memory": screened.memory}
    entry["quarantined"] = entry.get("quarantined", {}) | screened.drift.quarantined
    before = {name: content for name, content in before.items() if name not in entry["quarantined"]}
    if _nothing_new(before, remembered):
        entry |= {"outcome": "quarantined", "reasons": ["all that was new is quarantined"]}
        return before
    guarding.remember_before()
    try:
        _reproduce(settings, entry)
        # what came or changed meanwhile may be in some stages and not in others, and
        # nobody has looked whether it is fit to learn from
        moved = sorted({name for name, _ in before.items() ^ inputs.contents(hashes, places).items()})
        if moved and (not again or any(name.endswith(".py") for name in moved)):
            raise ValueError(
                f"{moved[0]} changed{'' if again else ' again'} while the stages ran; "
                "start the night when nothing is recorded or edited"
            )
        if not moved:
            state = _judge(settings, entry, state, before)
    except (ValueError, OSError, np.linalg.LinAlgError):
        entry["notes"] += guarding.back_to_before() + champion.as_committed()
        raise
    if moved:
        entry["notes"] += [
            *guarding.back_to_before(),
            f"{', '.join(moved[:3])} changed while the stages ran: the night began once again",
        ]
        for key in ("drift", "memory", "new_recordings"):
            entry.pop(key)
        return _work(params.load(Nightly, "nightly"), entry, remembered, hashes, again=False)
    _keep(settings, entry, state)
    return before


def _places(settings: Nightly) -> list[str]:
    """All that a night is made from."""
    recordings = [loop.recordings for loop in settings.loops.values() if loop.recordings]
    return [*inputs.sources(), settings.holdout.recordings, *recordings]


def _nothing_new(digests: dict[str, str], remembered: dict[str, Any]) -> bool:
    return inputs.digest(digests) == remembered.get("inputs") and not remembered.get("unpushed")


def _new(digests: dict[str, str], folder: str, before: dict[str, str]) -> dict[str, str]:
    """The recordings below a folder whose content was not there the night before."""
    return {
        name: content
        for name, content in inputs.recordings(digests, folder).items()
        if content not in before.values()
    }


def _reproduce(settings: Nightly, entry: dict[str, Any]) -> None:
    log = STATE / "logs" / f"{entry['run']}.log"
    for loop in settings.loops.values():
        # large recordings are DVC's: the pointer beside the folder moves with it
        if loop.recordings and Path(f"{loop.recordings}.dvc").exists():
            dvc("add", "--quiet", loop.recordings)
    dvc("repro", log=log, limit_s=settings.longest_h * 3600)
    for old in sorted((STATE / "logs").glob("*.log"))[:-60]:
        old.unlink()


def _judge(
    settings: Nightly, entry: dict[str, Any], state: dict[str, Any], made_from: dict[str, str]
) -> dict[str, Any]:
    """Each loop's challenger against its champion; champion.json with those that are
    promoted, whose files lie in champion/<loop> by then."""
    from pipeline.nightly import screening

    decisions: dict[str, Any] = {}
    promoted: list[str] = []
    lineage = _lineage(settings, made_from)
    for name, loop in settings.loops.items():
        decision, figures = _decide(settings, name, state, entry)
        decisions[name] = {"decision": decision.decision, "reasons": decision.reasons, **decision.figures}
        if decision.promotes:
            promoted.append(name)
            reference = screening.reference(loop, Path("datasets"))
            beside = {screening.REFERENCE: reference} if reference else {}
            made = champion.install(name, loop.artifacts, beside)
            described = {
                "run": entry["run"],
                "when": entry["when"],
                "why": "; ".join(decision.reasons),
                **made,
                "metrics": figures,
                "lineage": lineage,
            }
            state = champion.promoted(state, name, described, event=decision.decision)
    entry["decisions"] = decisions
    entry |= {
        "outcome": "promoted" if promoted else "kept",
        "promoted": promoted,
        "reasons": [f"{name}: {reason}" for name, one in decisions.items() for reason in one["reasons"]],
    }
    return state


def _decide(
    settings: Nightly, name: str, state: dict[str, Any], entry: dict[str, Any]
) -> tuple["Decision", dict[str, Any]]:
    from pipeline.nightly import judge
    from pipeline.nightly.decision import KEPT, Decision, decide

    loop = settings.loops[name]
    if lacking := champion.missing(loop.artifacts):
        return Decision(KEPT, [f"the challenger lacks {lacking[0]}; its stage did not write it"], {}), {}
    present = state["champions"].get(name)
    if present and champion.same(present["files"], loop.artifacts):
        return Decision(KEPT, ["the challenger is the champion, byte for byte"], {}), {}
    if run := champion.rolled_back(state, name, loop.artifacts):
        return Decision(KEPT, [f"the challenger is that of {run}, which was rolled back by hand"], {}), {}
    judged = judge.judge(loop, settings)
    challenger = judged.measure(Path("datasets"))
    before = judged.measure(champion.FOLDER / name) if present else None
    allowed = judged.allowed(before) if before else {}
    figures = {
        "panel": challenger.panel,
        "mean_cost": float(np.mean([cost for _, cost in challenger.cases.values()])),
        "guards": challenger.guards,
    }
    decision = decide(
        before,
        challenger,
        settings.rule,
        allowed=allowed,
        alarms=entry["drift"].of(name).alarms,
        seed=entry["night"],
    )
    return decision, figures


def _lineage(settings: Nightly, made_from: dict[str, str]) -> dict[str, Any]:
    """What the challengers were made from: the commit, what lay
    uncommitted on it, dvc.lock, parameters and recordings."""
    uncommitted = [line[3:] for line in git("status", "--porcelain", "--untracked-files=no").splitlines()]
    return {
        "commit": git("rev-parse", "HEAD"),
        "uncommitted": [
            path
            for path in uncommitted
            if path != "dvc.lock" and not path.startswith(("reports/", "champion"))
        ],
        "dvc_lock": artifacts.sha256("dvc.lock"),
        "params": {
            name: artifacts.sha256(name) for name in (params.FILE, params.EXPERT) if artifacts.exists(name)
        },
        "recordings": {
            name: inputs.recordings(made_from, loop.recordings) for name, loop in settings.loops.items()
        },
    }


def _keep(settings: Nightly, entry: dict[str, Any], state: dict[str, Any]) -> None:
    """The night's commit, which is the promotion; then the remote."""
    on_branch = settings.branch if settings.promotion == "branch" and entry["promoted"] else ""
    if entry["promoted"]:
        artifacts.write_json(champion.FILE, state)
    recordings = [*(loop.recordings for loop in settings.loops.values()), settings.holdout.recordings]
    tracked = [
        "dvc.lock",
        "reports/metrics",
        "datasets/.gitignore",
        # of a folder that DVC keeps, git keeps the pointer alone
        *(pointer if Path(pointer := f"{place}.dvc").exists() else place for place in recordings if place),
        *(champion.paths() if entry["promoted"] else []),
    ]
    done = f"promoted {', '.join(entry['promoted'])}" if entry["promoted"] else "kept the champions"
    changed = (
        bool(
            git(
                "status",
                "--porcelain",
                "--",
                *(path for path in tracked if path != str(METRICS) and Path(path).exists()),
            )
        )
        or entry["promoted"]
    )
    if changed and (on_branch or settings.promotion == "at_once"):
        _metrics(entry, state)
        entry["commit"] = commit(
            tracked, f"nightly {entry['run']}: {done}\n\n" + "\n".join(entry["reasons"]), branch=on_branch
        )
    if settings.remote:
        try:
            dvc("push", "--quiet", "--remote", settings.remote)
        except ValueError as error:
            entry["unpushed"] = True
            entry["notes"].append(
                f"the artifacts are not on remote {settings.remote}: {error}; the next night tries again"
            )
    if on_branch:
        entry["notes"].append(f"the promotion waits on branch {on_branch}: git merge {on_branch}")
        champion.as_committed()


def _metrics(entry: dict[str, Any], state: dict[str, Any]) -> None:
    """reports/metrics/nightly.json."""
    production = {
        name: {key: present[key] for key in ("run", "when", "why")}
        for name, present in state["champions"].items()
    }
    rest = {
        key: entry.get(key)
        for key in ("night", "run", "when", "seconds", "notes", "new_recordings", "quarantined")
    }
    artifacts.write_json(
        METRICS,
        {
            "decision": entry["outcome"],
            "reasons": entry.get("reasons", []),
            "decisions": entry.get("decisions", {}),
            "drift": _written(entry).get("drift", {}),
            "champion": production,
        }
        | rest,
    )


def _say(
    settings: Nightly,
    entry: dict[str, Any],
    remembered: dict[str, Any],
    hashes: inputs.Hashes,
    digests: dict[str, str] | None,
) -> tuple[int, str]:
    """State, page, alarm; the exit status and the summary. On a disk without room the summary still comes."""
    alarms = [alarm.cause for alarm in entry["drift"].alarms] if "drift" in entry else []
    status = _status(entry)
    troubles: list[str] = []
    try:
        _remember(settings, entry, remembered, hashes, digests)
        if entry["outcome"] != "nothing new":
            from pipeline.report.nightly import page

            artifacts.write_text("reports/nightly.html", page.render(nights(), champion.read(), settings))
    except OSError as error:
        troubles.append(str(error))
    if status != OK:
        details = {
            "night": entry["run"],
            "when": entry["when"],
            "status": status,
            "drift": _written(entry).get("drift", {}),
            "quarantined": entry.get("quarantined", {}),
            "log": f".beadline/logs/{entry['run']}.log",
        }
        kind, reasons = {
            FAILED: ("failed", entry.get("reasons", []) if entry["outcome"] == "failed" else entry["notes"]),
            DRIFTED: ("drift", alarms),
            QUARANTINED: ("quarantined", [*entry.get("quarantined", {}).values()]),
        }[status]
        troubles += watch.wake(kind, reasons, details, command=settings.alarm, webhook=settings.webhook)
    return status, _summary(entry, alarms, troubles)


def _status(entry: dict[str, Any]) -> int:
    """What a scheduler is told: the gravest of what the night met."""
    if entry["outcome"] == "failed" or entry.get("unpushed"):
        return FAILED
    if "drift" in entry and entry["drift"].alarms:
        return DRIFTED
    return QUARANTINED if entry.get("quarantined") else OK


def _remember(
    settings: Nightly,
    entry: dict[str, Any],
    remembered: dict[str, Any],
    hashes: inputs.Hashes,
    digests: dict[str, str] | None,
) -> None:
    good = entry["outcome"] != "failed"
    if good and entry["outcome"] != "nothing new" and not entry.get("commit"):
        _metrics(entry, champion.read())
    # a recording of a failed night is new again the next one, and must not count as two
    memory = entry.get("memory", remembered.get("drift", {}))
    artifacts.write_json(
        watch.LAST,
        {
            "night": entry["night"],
            # a clock that was set back must not make the last success look older than it is
            "success": max(entry["when"], remembered.get("success") or "")
            if good
            else remembered.get("success"),
            "inputs": inputs.digest(digests or {}) if good else remembered.get("inputs"),
            "unpushed": bool(entry.get("unpushed")),
            "recordings": {
                name: inputs.recordings(digests or {}, loop.recordings)
                for name, loop in settings.loops.items()
            }
            if good
            else remembered.get("recordings", {}),
            "drift": memory if good else remembered.get("drift", {}),
            "hashes": hashes.now,
        },
    )
    artifacts.write_json(NIGHTS, [*nights(), _written(entry)][-LONGEST_HISTORY:])


def _written(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The night as its files have it."""
    rest = {key: value for key, value in entry.items() if key != "memory"}
    return rest | ({"drift": entry["drift"].written()} if "drift" in entry else {})


def nights() -> list[dict[str, Any]]:
    """Every night that this checkout remembers, the oldest first."""
    return artifacts.read_json(NIGHTS) if NIGHTS.exists() else []


def _summary(entry: dict[str, Any], alarms: list[str], troubles: list[str]) -> str:
    parts = [f"nightly: {entry['run']} {entry['outcome']}"]
    if entry.get("promoted"):
        parts.append(f"promoted {', '.join(entry['promoted'])}")
    if alarms:
        parts.append(f"drift: {'; '.join(alarms)}")
    if not (entry.get("promoted") or alarms) or entry["outcome"] == "failed":
        parts.append("; ".join(entry.get("reasons", [])))
    if entry.get("quarantined"):
        parts.append("quarantined: " + "; ".join(entry["quarantined"].values()))
    text = " ".join(" | ".join([*parts, *entry["notes"], *troubles, f"{entry['seconds']:g} s"]).split())
    return text if len(text) <= 1000 else text[:999] + "…"


def watchdog() -> tuple[int, str]:
    """Whether somebody should look, because no night has succeeded for too long; the alarm goes out with it.
    Takes no lock: a night that hangs is seen too."""
    settings, now = params.load(Nightly, "nightly"), datetime.datetime.now(datetime.UTC)
    late = watch.overdue(now, settings.watch_h)
    if not late:
        return OK, f"nightly: watch: the last success was at {watch.last()['success']}"
    STATE.mkdir(exist_ok=True)
    troubles = watch.wake(
        "watch", [late], {"when": watch.stamp(now)}, command=settings.alarm, webhook=settings.webhook
    )
    return FAILED, " | ".join([f"nightly: watch: {late}", *troubles])


# ---- the way back


def rollback(run: str, loop: str) -> str:
    """Puts the champion of an earlier run back into production, bit by bit, and says what was done."""
    params.load(Nightly, "nightly")
    with guarding.alone():
        state = champion.read()
        earlier = champion.earlier(state, run, loop)
        when = watch.stamp(datetime.datetime.now(datetime.UTC))
        for name, entry in earlier.items():
            champion.put_back(name, entry)
            state = champion.promoted(
                state,
                name,
                {**entry, "why": f"rolled back to {entry['run']} by hand", "since": when},
                event="rolled back",
            )
            state["history"][-1] |= {"when": when, "why": "by hand"}
        artifacts.write_json(champion.FILE, state)
        names = ", ".join(f"{name} is {entry['run']}" for name, entry in earlier.items())
        made = commit(champion.paths(), f"rollback: {names}")
        return f"rollback: {names} again, every file as it was; commit {made[:12]}"
