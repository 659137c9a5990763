"""Who is woken, and when nobody ran: the alarm's JSON file, its command and webhook, the heartbeat, and the
age of the last success."""

import contextlib
import datetime
import json
import os
import re
import shlex
import signal
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from pipeline.nightly.processes import STATE, git
from pipeline.nightly.settings import Nightly
from pipeline.store import artifacts, params

ALARM = STATE / "alarm.json"
# a try at a server, the pause before the second, and the alarm's command: all that waking may take is bounded
ASKED_S, PAUSE_S, COMMAND_S = 20.0, 2.0, 60.0


class Routes(NamedTuple):
    """How somebody is told: the alarm's command and webhook, and the heartbeat of nights that went well."""

    alarm: str = ""
    webhook: str = ""
    heartbeat: str = ""


def find_routes(settings: Nightly | None) -> Routes:
    """Those of the environment, so that no secret stands in a file; otherwise those of the parameters, or if
    these are broken, of the last commit whose parameters can be read."""
    written = settings.model_dump() if settings else _read_committed()
    return Routes(
        *(os.environ.get(f"BEADLINE_{key.upper()}") or str(written.get(key, "")) for key in Routes._fields)
    )


def _read_committed() -> dict[str, Any]:
    revisions = git("rev-list", "-n", "20", "HEAD", "--", params.FILE, check=False).split()
    for revision in ("HEAD", *revisions):
        with contextlib.suppress(yaml.YAMLError, KeyError, TypeError, ValueError):
            return dict(yaml.safe_load(git("show", f"{revision}:{params.FILE}", check=False))["nightly"])
    return {}


def hide_secrets(settings: Nightly) -> Nightly:
    """The settings as a page may show them: of a URL the server, of a command its first word."""
    routes = find_routes(settings)
    public = {
        "webhook": _server(routes.webhook),
        "heartbeat": _server(routes.heartbeat),
        "alarm": _word(routes.alarm),
    }
    return settings.model_copy(update=public)


def _server(url: str) -> str:
    """Of a URL what is no secret; empty if there is none."""
    try:
        parts = urllib.parse.urlsplit(url)
        return f"{parts.scheme}://{parts.hostname}" if parts.hostname else "a URL" if url else ""
    except ValueError:
        return "a URL"


def _word(command: str) -> str:
    return command.split()[0] if command.split() else ""


def stamp(now: datetime.datetime) -> str:
    return now.astimezone(datetime.UTC).isoformat(timespec="seconds")


def find_overdue(now: datetime.datetime, success: str, watch_h: float) -> str:
    """Why somebody should look: the last success is older than `watch_h` hours,
    or lies in the future; empty if all is well."""
    if not success:
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


# ---- waking


def wake(kind: str, reasons: Sequence[str], details: Mapping[str, Any], routes: Routes) -> list[str]:
    """Writes the alarm, runs the command with its path, posts it to the webhook; what went wrong on the way,
    as sentences, for an alarm that fails must not hide the night."""
    chat = escape_for_chat(f"beadline: {details.get('night', 'nightly')}: {kind}: {'; '.join(reasons)}")
    alarm = {"schema": "alarm", "version": 1, "kind": kind, "text": chat, "reasons": list(reasons), **details}
    text = json.dumps(alarm, indent=2, ensure_ascii=False, default=str).encode("utf-8", "replace")
    troubles = []
    try:
        artifacts.write_bytes(ALARM, text + b"\n")
    except OSError as error:
        troubles.append(f"the alarm could not be written: {error}")
    if routes.alarm and (trouble := _command(routes.alarm, kind, text)):
        troubles.append(f"nightly.alarm: {_word(routes.alarm)} {trouble}")
    if routes.webhook and (trouble := _ask(routes.webhook, text)):
        troubles.append(f"nightly.webhook: {_server(routes.webhook)}: {trouble}")
    return troubles


# signs that are markup in Slack or Mattermost, and others that look like them and are none
PLAIN = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "*": "\u2217", "`": "\u02cb", "~": "\u223c", "@": "@\u200b"}


def escape_for_chat(text: str) -> str:
    """A text in which Slack and Mattermost find no tag, mention, link, picture or emphasis: names of files
    are anybody's. An underscore is markup at the edge of a word alone, so that shift_12 stays what it is."""
    text = re.sub(r"(?<![^\W_])_|_(?![^\W_])", "\u02cd", text.translate(str.maketrans(PLAIN)))
    return text.replace("](", "]\u200b(")


def beat(routes: Routes) -> list[str]:
    """Tells the heartbeat's URL that a night went well; what went wrong, as sentences."""
    trouble = _ask(routes.heartbeat) if routes.heartbeat else ""
    return [f"nightly.heartbeat: {_server(routes.heartbeat)}: {trouble}"] if trouble else []


def _command(command: str, kind: str, alarm: bytes) -> str:
    """Why the command did not do its work, empty if it did. It reads the alarm from its input too, which
    needs no file."""
    with tempfile.TemporaryFile() as printed:
        try:
            child = subprocess.Popen(
                [*shlex.split(command), str(ALARM)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=printed,
                start_new_session=True,
                env={**os.environ, "BEADLINE_ALARM_KIND": kind},
            )
            child.communicate(alarm, COMMAND_S)
        except (OSError, ValueError) as error:
            return f"could not be started: {getattr(error, 'strerror', None) or error}"
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
            return f"was ended after {COMMAND_S:g} s"
        printed.seek(0)
        words = " ".join(printed.read().decode(errors="replace").split())[-200:]
    return f"ended with status {child.returncode}: {words}" if child.returncode else ""


def _ask(url: str, body: bytes | None = None) -> str:
    """Asks a server, once more after a pause if it fails; why it failed, empty if it did not."""
    if not (trouble := _try(url, body)):
        return ""
    time.sleep(PAUSE_S)
    return _try(url, body) and f"{trouble} (tried twice)"


def _try(url: str, body: bytes | None) -> str:
    """One try, within ASKED_S: in a thread, for a server's name or its headers byte by byte take as long as
    they like."""
    troubles = [f"no answer within {ASKED_S:g} s"]

    def ask() -> None:
        try:
            headers = {"User-Agent": "beadline"} | ({"Content-Type": "application/json"} if body else {})
            request = urllib.request.Request(url, body, headers)
            if request.type not in ("http", "https"):
                raise ValueError(request.type)  # a file of this machine wakes nobody
            with urllib.request.urlopen(request, timeout=ASKED_S) as answer:
                # on the way to another URL the alarm is lost
                sent_on = body is not None and answer.url != request.full_url
            troubles[:] = ["it sends on to another URL; write that one"] if sent_on else []
        except Exception as error:  # whatever it is, it must not hide the night, nor tell the URL
            troubles[:] = [_refusal(error)]

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(ASKED_S)
    return troubles[0] if troubles else ""


def _refusal(error: Exception) -> str:
    """Why a server could not be asked, without its URL, which may hold a secret."""
    if isinstance(error, urllib.error.HTTPError):
        return f"it answered with status {error.code}"
    reason = getattr(error, "reason", error)
    if isinstance(reason, OSError):
        return reason.strerror or type(reason).__name__
    return "this is no URL of the form https://server/path"
