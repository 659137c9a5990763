"""Who is woken, and when nobody ran: the alarm's JSON file, its
command and webhook, and the age of the last success."""

import datetime
import json
import os
import shlex
import subprocess
import urllib.error
import urllib.request
from collections.abc import Mapping
from typing import Any

from pipeline.nightly import remembered
from pipeline.nightly.processes import STATE
from pipeline.store import artifacts

ALARM = STATE / "alarm.json"


def stamp(now: datetime.datetime) -> str:
    return now.astimezone(datetime.UTC).isoformat(timespec="seconds")


def overdue(now: datetime.datetime, watch_h: float) -> str:
    """Why somebody should look: the last success is older than `watch_h` hours,
    or lies in the future; empty where all is well."""
    success = remembered.last().success
    if success is None:
        return "no night has ever succeeded; run ./run beadline nightly, and look at its schedule"
    age_h = (now - datetime.datetime.fromisoformat(success)).total_seconds() / 3600
    if age_h < -0.1:
        return (
            f"the clock is wrong: the last success, {success}, is {-age_h:.1f} h from now in the future; "
            "set the clock"
        )
    if age_h > watch_h:
        return (
            f"the last success was {age_h:.1f} h ago ({success}); nightly.watch_h allows {watch_h:g} h; "
            "look at .beadline/logs and at the schedule"
        )
    return ""


def wake(
    kind: str, reasons: list[str], details: Mapping[str, Any], *, command: str, webhook: str
) -> list[str]:
    """Writes the alarm, runs `command FILE`, posts the file to `webhook`; what went wrong on the way, as
    sentences, for an alarm that fails must not hide the night."""
    alarm = {"schema": "alarm", "version": 1, "kind": kind, "reasons": reasons, **details}
    troubles = []
    text = json.dumps(alarm, indent=2, ensure_ascii=False, default=str)
    try:
        artifacts.write_text(ALARM, text + "\n")
    except OSError as error:
        troubles.append(f"the alarm could not be written: {error}")
    if command:
        try:
            ended = subprocess.run(
                [*shlex.split(command), str(ALARM)],
                check=False,
                input=text,
                text=True,
                capture_output=True,
                timeout=60,
                env={**os.environ, "BEADLINE_ALARM": kind},
            )
            if ended.returncode:
                troubles.append(
                    f"nightly.alarm: {command} ended with status {ended.returncode}: "
                    f"{ended.stderr.strip()[-200:]}"
                )
        except (OSError, ValueError, subprocess.TimeoutExpired) as error:
            troubles.append(f"nightly.alarm: {error}")
    if webhook:
        try:
            request = urllib.request.Request(webhook, text.encode(), {"Content-Type": "application/json"})
            with urllib.request.urlopen(request, timeout=20):
                pass
        except (OSError, ValueError, urllib.error.URLError) as error:
            troubles.append(f"nightly.webhook: {webhook}: {error}")
    return troubles
