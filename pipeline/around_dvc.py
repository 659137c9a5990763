"""What `run` does around DVC: python -P pipeline/around_dvc.py OPTIONS COMMAND...

OPTIONS are those of uv, in one word; COMMAND begins with dvc or beadline. Before it, files that are no
recordings and parameters that fit no section are refused, a table of locks that a killed DVC left empty is
removed, and reports/machine.js says where the pages are made. Loops without results run side by side, each in
a DVC of its own, before the one that does the rest. If the pages are those of this `dvc repro`, the last line
is the verdict. DVC runs in this process: a signal reaches it, and its exit status is the one of `run`. Only
the standard library is imported: DVC itself takes most of a repro with nothing to do.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import zlib
from pathlib import Path

import stages
from pipeline.recordings.plain_files import check_plain_files
from pipeline.side_by_side import new_loops, run_loops
from pipeline.store.printable import printable

# a link to this folder stays in the project that has the link
ROOT = Path(__file__).absolute().parents[1]
RAW = Path("datasets/raw")
# the code, as git is asked whether it has changed
CODE = "pipeline stages run pyproject.toml uv.lock dvc.yaml params.yaml params.expert.yaml".split()
MAKES_PAGES = ("dvc repro ", "dvc exp run ", "beadline nightly ")
RUNS_STAGES = (*MAKES_PAGES, "beadline quick ")


def main() -> None:
    options, *command = sys.argv[1:]
    words = " ".join(command) + " "
    shows_only = {"--help", "-h", "--dry", "--dry-run", "--rollback"}.intersection(command)
    elsewhere = {"--queue", "--temp", "--watch"}.intersection(command)
    loops: dict[str, bool] = {}
    if words.startswith(MAKES_PAGES) and not shows_only and not elsewhere:
        write_machine(options)
    if words.startswith("dvc "):
        remove_empty_locks(ROOT / ".dvc/tmp/rwlock")
    # a log has no use for progress bars
    if not sys.stderr.isatty():
        os.environ.setdefault("TQDM_DISABLE", "1")
    # production goes back whatever the parameters are
    by_hand = words.startswith("beadline nightly ") and "--rollback" in words
    if words.startswith(("dvc ", "beadline nightly ", "beadline quick ")) and not by_hand:
        try:
            for folder in dict.fromkeys([RAW, Path(os.path.relpath(ROOT / RAW))]):
                check_plain_files(folder)
            loops = check_params(runs_stages=words.startswith(RUNS_STAGES) and not shows_only)
        except ValueError as error:
            sys.exit(f"run: {printable('; '.join(str(error).splitlines()))}")
    if command[0] != "dvc":
        os.execvp(command[0], command)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end_with_children)
    page = ROOT / "reports/index.html"
    before = version(page)
    new = new_loops(loops, ROOT / "datasets") if command == ["dvc", "repro"] else {}
    status = run_loops(new, [sys.executable, "-P", __file__, options, "dvc"]) if len(new) > 1 else 0
    status = status or run_dvc(command)
    # of stages by name, report may be none
    names_stages = any(not word.startswith("-") for word in command[2:])
    is_new = version(page) != before or not names_stages
    if status == 0 and words.startswith("dvc repro ") and not shows_only and is_new:
        if verdict := first_title(page):
            print(f"{verdict}. Open {page}")
    sys.exit(status)


def check_params(*, runs_stages: bool) -> dict[str, bool]:
    """Section `loops`, {} if nothing is run. Raises ValueError with a line for each problem of the
    parameters. DVC would read them first, by a parser in C that crashes on hostile text; and a stage would
    find them after those before it."""
    path = os.path.relpath(ROOT / "params.yaml")
    if runs_stages:
        return stages.check_parameters(path)
    if not stages.checked_loops(path):
        from pipeline.store import params

        params.files(path)
    return {}


def run_dvc(command: list[str]) -> int:
    """The exit status of `dvc ...`, as its own script calls it."""
    from dvc.cli import main as dvc

    sys.argv = command
    return dvc(command[1:])


def end_with_children(number: int, _frame: object) -> None:
    """Hands a signal that reached DVC alone to the stage and its workers, and ends by it."""
    pids = [os.getpid()]
    for pid in pids:
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            pids += map(int, read(children).split())
    signal.signal(number, signal.SIG_DFL)
    for pid in reversed(pids):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def remove_empty_locks(rwlock: Path) -> None:
    """A DVC that was killed while it wrote its table of locks leaves it empty, and no later one starts. A DVC
    at work has it empty for less than a blink."""
    for wait_s in (1, 0):
        if not rwlock.is_file() or rwlock.stat().st_size:
            return
        time.sleep(wait_s)
    print("run: .dvc/tmp/rwlock was left half written by a killed DVC and is removed", file=sys.stderr)
    rwlock.unlink(missing_ok=True)


def version(page: Path) -> tuple[int, int]:
    """What differs after the page was written or checked out again."""
    try:
        return page.stat().st_ino, page.stat().st_mtime_ns
    except OSError:
        return (0, 0)


def first_title(page: Path) -> str:
    """The verdict, which is the title of page one; "" without a page."""
    if not page.is_file():
        return ""
    found = re.search(r"<title>(.*) · beadline</title>", page.read_text(encoding="utf-8", errors="replace"))
    return found[1] if found else ""


# ---- reports/machine.js


def write_machine(options: str) -> None:
    """Writes what this run is made on. The pages read it by script. It is no out of DVC, as outs are equal on
    every machine. A folder that cannot be written stops no run."""
    path = ROOT / "reports/machine.js"
    beside = path.with_name(f".machine.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(exist_ok=True)
        beside.write_text(f"window.beadline = {json.dumps({'machine': machine(options)})};\n")
        beside.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink()


def machine(options: str) -> dict[str, str | int | bool]:
    """CPU, cores and pins, the version and commit of the code, and the packages: a page can tell another CPU
    from another environment."""
    version = re.search(r'^version *= *"(.*)"', read(ROOT / "pyproject.toml").decode(), re.MULTILINE)
    packages = b"".join(read(ROOT / name) for name in ("uv.lock", "run", ".python-version"))
    commit = git("rev-parse", "--short=8", "HEAD") if (ROOT / ".git").exists() else ""
    return {
        "cpu": cpu(),
        "cores": os.cpu_count() or 0,
        "pins": "avx2" if os.environ.get("OPENBLAS_CORETYPE") else "none",
        "version": plain(version[1] if version else ""),
        "commit": commit or "none",
        "changed": bool(commit) and git("status", "--porcelain", "--", *CODE) != "",
        "locked": str(zlib.crc32(packages + options.encode())),
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def cpu() -> str:
    """The name of the CPU, as Linux or macOS says it, else the architecture."""
    about = read(Path(os.environ.get("BEADLINE_CPUINFO", "/proc/cpuinfo"))).decode(errors="replace")
    named = re.search(r"^model name[^:\n]*: *(.*)", about, re.MULTILINE)
    name = plain(named[1]) if named else ""
    return (
        name or plain(output("sysctl", "-n", "machdep.cpu.brand_string") or "") or plain(os.uname().machine)
    )


def git(*arguments: str) -> str | None:
    return output("git", "--no-optional-locks", "-C", str(ROOT), *arguments)


def output(*command: str) -> str | None:
    """What a command prints, None if it fails."""
    try:
        ended = subprocess.run(command, capture_output=True, text=True, errors="replace", check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return ended.stdout.strip()


def read(path: Path) -> bytes:
    """The content of a file, b"" for one that cannot be read."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def plain(text: str) -> str:
    """Text that breaks out of no string of a script."""
    return re.sub(r"[^A-Za-z0-9 ()@.,:/_+-]", "", text)[:80]


if __name__ == "__main__":
    main()
