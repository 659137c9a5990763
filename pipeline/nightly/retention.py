"""How much DVC's cache may hold: what stages made in earlier runs is removed, the oldest first, for it can be
made again. Recordings and champions of any commit, accepted runs, and what any branch, tag or experiment
names are kept, and so is whatever this cannot place."""

import json
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pipeline.nightly import guarding
from pipeline.nightly.processes import STATE, git
from pipeline.store import artifacts

CACHE, MADE = Path(".dvc/cache/files/md5"), STATE / "made.json"
YOUNG_S = 24 * 3600.0  # somebody may be at work with what is younger


class Out(NamedTuple):
    """What a stage once made: the hashes of its files in DVC's cache, its own last, and the time at which it
    came there, in s."""

    hashes: tuple[str, ...]
    age: float


def freed(keep_gb: float) -> list[str]:
    """Removes what stages made in earlier runs until the cache holds `keep_gb`; what was done, as a sentence.
    0: no limit."""
    made = _remembered_made()
    if not keep_gb or not CACHE.is_dir():
        return []
    sizes = {path: path.stat().st_size for path in CACHE.rglob("*") if path.is_file()}
    total, limit = sum(sizes.values()), keep_gb * 1e9
    if total <= limit:
        return []
    try:
        kept = _closure(_kept())
    except (ValueError, yaml.YAMLError, AttributeError, KeyError, TypeError) as error:
        return [f"nothing of DVC's cache was removed: what must be kept could not be read ({error})"]
    outs = sorted(_outs(made - kept), key=lambda out: out.age)
    used = Counter(name for out in outs for name in out.hashes)
    removed, before = 0, total
    for out in outs:
        if total <= limit:
            break
        used.subtract(out.hashes)
        for name in out.hashes:
            path = _place(name)
            if name not in kept and used[name] <= 0 and path.exists():
                path.unlink()
                removed, total = removed + 1, total - sizes.get(path, 0)
    over = "" if total <= limit else ", and what is kept needs more: raise it, or tidy up by hand"
    return [
        f"DVC's cache held {before / 1e9:.3g} GB, nightly.keep_gb allows {keep_gb:g}{over}; removed "
        f"{removed} files of earlier runs, {(before - total) / 1e9:.3g} GB"
    ]


def _place(md5: str) -> Path:
    return CACHE / md5[:2] / md5[2:]


def _remembered_made() -> set[str]:
    """The hashes of all that stages ever made here: of dvc.lock in any commit, and as nights found it."""
    try:
        made = set(artifacts.read_json(MADE)) if MADE.exists() else set()
    except (ValueError, TypeError):
        made = set()
    here = (
        _of_lock(Path(guarding.LOCKED).read_text(encoding="utf-8"))
        if Path(guarding.LOCKED).exists()
        else set()
    )
    if here - made:
        made |= here
        artifacts.write_json(MADE, sorted(made))
    return made | {md5 for text in _versions("dvc.lock") for md5 in _of_lock(text)}


def _kept() -> set[str]:
    """The hashes of all that somebody may still ask for. Raises ValueError where that cannot be told."""
    revisions = git("for-each-ref", "--format=%(objectname)").splitlines()
    revisions += ["HEAD", *git("rev-list", "--all", "HEAD", "--", "reports/accepted.json").splitlines()]
    locks = {
        text for revision in set(revisions) if (text := git("show", f"{revision}:dvc.lock", check=False))
    }
    locks |= {
        path.read_text(encoding="utf-8")
        for path in (Path("dvc.lock"), guarding.BEFORE / "dvc.lock")
        if path.exists()
    }
    here = git("ls-files", "--cached", "--others", "--exclude-standard", "*.dvc").splitlines()
    pointers = [
        *_versions("*.dvc"),
        *(Path(name).read_text(encoding="utf-8") for name in here if Path(name).exists()),
    ]
    kept = {md5 for text in locks for md5 in _of_lock(text, whole=True)}
    kept |= {out["md5"] for text in pointers for out in (yaml.safe_load(text) or {}).get("outs", [])}
    champions = [*_versions("champion.json")]
    return kept | {md5 for text in champions for md5 in _md5s(json.loads(text))}


def _versions(pattern: str) -> list[str]:
    """The text of every version of these files in any commit of any reference."""
    listed = git(
        "log", "--all", "HEAD", "--format=", "--raw", "--no-abbrev", "--no-renames", "-m", "--", pattern
    )
    blobs = {line.split()[3] for line in listed.splitlines() if line.startswith(":")}
    return [git("cat-file", "blob", blob) for blob in sorted(blobs) if blob.strip("0")]


def _of_lock(text: str, *, whole: bool = False) -> set[str]:
    """The hashes of a dvc.lock's outs. Raises ValueError where it is broken and `whole` is asked for."""
    try:
        stages = (yaml.safe_load(text) or {}).get("stages") or {}
        return {out["md5"] for stage in stages.values() for out in stage.get("outs", []) if "md5" in out}
    except (yaml.YAMLError, AttributeError, TypeError):
        if whole:
            raise ValueError("a dvc.lock that a branch or an accepted run has is broken") from None
        return set()


def _md5s(data: Any) -> Iterable[str]:
    """Every hash below a key md5."""
    if isinstance(data, dict):
        if isinstance(data.get("md5"), str):
            yield data["md5"]
        for part in data.values():
            yield from _md5s(part)
    elif isinstance(data, list):
        for part in data:
            yield from _md5s(part)


def _closure(hashes: Iterable[str]) -> set[str]:
    """These hashes, with those of the files in each folder among them."""
    return {name for md5 in hashes for name in _files(md5)}


def _files(md5: str) -> tuple[str, ...]:
    if not md5.endswith(".dir") or not _place(md5).exists():
        return (md5,)
    return (*(entry["md5"] for entry in artifacts.read_json(_place(md5))), md5)


def _outs(hashes: Iterable[str]) -> list[Out]:
    """What lies in the cache of these, but for what is young."""
    there = [(md5, _place(md5).stat().st_mtime) for md5 in sorted(hashes) if _place(md5).exists()]
    return [Out(_files(md5), when) for md5, when in there if time.time() - when > YOUNG_S]
