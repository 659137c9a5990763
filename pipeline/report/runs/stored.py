"""What git holds of runs: revisions of the figures, DVC's experiments, and the files of each.

One `git cat-file --batch` reads all; a file that many revisions share is read and parsed once.
"""

import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

# of a file, in bytes: metrics of more are no figures of ours, and would fill the memory of whoever asks
LARGEST = 20_000_000
METRICS, ACCEPTED, NIGHTLY = "reports/metrics", "reports/accepted.json", "reports/metrics/nightly.json"
# hash, date and subject of a commit; no subject holds the bytes between them
FORMAT = "%x01%H%x00%cI%x00%s"
# refs/exps/<two digits>/<38 digits of the commit it began from>/<name>; DVC keeps other things beside them
EXPERIMENT = re.compile(r"refs/exps/([0-9a-f]{2})/([0-9a-f]{38})/(.+)", re.DOTALL)


class Commit(NamedTuple):
    """A revision: its hash, date and subject; which files of FOLLOWED it changed. `name` and `base` (the
    commit it began from) are those of an experiment."""

    hash: str
    date: str
    subject: str
    changed: frozenset[str] = frozenset()
    name: str = ""
    base: str = ""


def git(*arguments: str, given: str = "") -> bytes:
    """What `git ...` printed. Raises ValueError with its reason where it fails, or is not there."""
    try:
        return subprocess.run(
            ["git", *arguments], input=given.encode(errors="surrogateescape"), capture_output=True, check=True
        ).stdout
    except FileNotFoundError:
        raise ValueError("git is not installed; install it to see the history") from None
    except subprocess.CalledProcessError as error:
        message = " ".join(error.stderr.decode(errors="replace").split())
        raise ValueError(
            f"the history cannot be read ({message}); run this inside the git checkout of the project"
        ) from None


def commits(most: int, *paths: str) -> list[Commit]:
    """The last `most` revisions that touched `paths`, oldest first."""
    log = git("log", f"--max-count={most}", f"--format={FORMAT}", "--name-only", "--", *paths)
    found = []
    for entry in log.decode(errors="replace").split("\x01")[1:]:
        head, _, names = entry.partition("\n")
        commit, date, subject = head.split("\0", 2)
        found.append(Commit(commit, date, subject, frozenset(filter(None, names.split("\n")))))
    return found[::-1]


def experiments(most: int) -> list[Commit]:
    """DVC's last `most` experiments, oldest first."""
    form = "%(refname)%00%(objectname)%00%(committerdate:iso-strict)%00%(contents:subject)"
    listed = git("for-each-ref", "--sort=-committerdate", f"--format={form}", "refs/exps")
    found = []
    for line in listed.decode(errors="replace").splitlines():
        ref, commit, date, subject = line.split("\0", 3)
        if place := EXPERIMENT.fullmatch(ref):
            found.append(Commit(commit, date, subject, name=place[3], base=place[1] + place[2]))
    return found[:most][::-1]


def objects(names: Sequence[str]) -> list[str]:
    """The object of each REVISION:PATH; "" where it is not there, or no file of at most LARGEST bytes."""
    told = git("cat-file", "--batch-check=%(objectname) %(objecttype) %(objectsize)", given=_lines(names))
    found = []
    for line in told.decode(errors="replace").splitlines():
        fields = line.rsplit(" ", 2)
        whole = len(fields) == 3 and fields[1] == "blob" and int(fields[2]) <= LARGEST
        found.append(fields[0] if whole else "")
    return found


def contents(objects: Iterable[str]) -> Iterator[tuple[str, bytes]]:
    """(object, its bytes) of each object once, a few at a time."""
    wanted = list(dict.fromkeys(filter(None, objects)))
    for start in range(0, len(wanted), 200):
        data, at = git("cat-file", "--batch", given=_lines(wanted[start : start + 200])), 0
        while at < len(data):
            end = data.index(b"\n", at)
            name, _, size = data[at:end].decode().split()
            at = end + 1
            yield name, data[at : at + int(size)]
            at += int(size) + 1


def _lines(names: Iterable[str]) -> str:
    return "".join(f"{name}\n" for name in names)


# ---- YAML that changes little from run to run


def blocks(text: str, indent: int = 0) -> Mapping[str, str]:
    """{first line of a block: the block} of YAML whose keys stand `indent` spaces from the left; comments and
    empty lines before the first block are left out. A list may stand as far left as its own key."""
    first = r"[^\s#-]" if indent else r"[^\s#]"
    heads = list(re.finditer(rf"^ {{{indent}}}(?={first})[^\n]*", text, re.MULTILINE))
    ends = [*(head.start() for head in heads[1:]), len(text)]
    return {head[0]: text[head.start() : end] for head, end in zip(heads, ends, strict=False)}
