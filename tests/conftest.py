"""What every test may ask for: the repository's root, other people's data (or the reason why not), and slow
tests only when they are asked for."""

import contextlib
import fcntl
import hashlib
import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import pytest

from pipeline import cli
from pipeline.recordings import plain_files
from pipeline.store.execution import PINS

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT / os.environ.get("BEADLINE_SHARED", "../shared")


def compiled_for(cpuinfo: str) -> str:
    """A name for what XLA's programs depend on beside their source, its version and its flags, which JAX's
    own key holds: the CPU, its number of cores, and the pins that `run` exports."""
    cpu = sorted(
        {line for line in cpuinfo.splitlines() if line.startswith(("model name", "flags", "Features"))}
    )
    told = [platform.machine(), str(os.cpu_count()), *cpu, *(os.environ.get(pin, "") for pin in PINS)]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]


# Programs that XLA compiled are kept from one process and one run to the next, in pytest's own cache
# (--cache-clear removes them). Set before anything imports jax, and for the processes that tests start.
cpuinfo = Path("/proc/cpuinfo")
kept = ROOT / ".pytest_cache/d" / f"jax-{compiled_for(cpuinfo.read_text() if cpuinfo.exists() else '')}"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(kept))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

# files that a test has just written count as complete
plain_files.REST_S = 0.0

# the same examples in every run, and no folder of remembered ones
hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def browser():
    """Debian's Chromium, or the reason why there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed; uv sync installs it"
    )
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found:
        pytest.skip("no Chromium on this machine; install it to see the pages in a browser")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


@pytest.fixture(scope="session")
def shared():
    """shared("data/tclab_mlid_prbs/prbs.csv"): the path of other
    people's data; the test is skipped where it is absent."""

    def path(name: str) -> Path:
        if not (SHARED / name).exists():
            pytest.skip(
                f"{name} is not in BEADLINE_SHARED ({os.environ.get('BEADLINE_SHARED', '../shared')})"
            )
        return SHARED / name

    return path


@pytest.fixture(scope="session")
def cluster(tmp_path_factory):
    """A dask scheduler and two workers on loopback; nobody kills them."""
    from tests.cluster import Cluster

    made = Cluster(tmp_path_factory.mktemp("cluster"))
    yield made
    made.stop()


@pytest.fixture
def mortal_cluster(tmp_path):
    """One of its own for a test that kills."""
    from tests.cluster import Cluster

    made = Cluster(tmp_path)
    yield made
    made.stop()


@pytest.fixture
def must_end():
    """Ends a test that waits for ever or works without an end: five minutes are no measure of a machine."""

    def end(*_):
        raise AssertionError("this test had not ended after 300 s")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(300)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def started(monkeypatch):
    """The command of each process that this one starts from now on."""
    commands: list[str] = []
    start = subprocess.Popen.__init__

    def told(process, command, *arguments, **settings):
        commands.append(command if isinstance(command, str) else " ".join(map(os.fsdecode, command)))
        start(process, command, *arguments, **settings)

    monkeypatch.setattr(subprocess.Popen, "__init__", told)
    return commands


def count_calls(work: Callable[[], object]) -> int:
    """How many functions `work` calls: its cost in a unit that no machine changes."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(before)
    return calls


@pytest.fixture
def beadline(tmp_path, monkeypatch, capfd):
    """beadline("inspect", "a.csv") in an empty folder: status, what was printed, and what was said of
    errors."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["beadline", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capfd.readouterr()

    return command


def pytest_collection_modifyitems(config, items):
    """Tests marked slow, full or klipper run with -m and that mark, or when they are named by ::."""
    if config.option.markexpr or any("::" in argument for argument in config.args):
        return
    longer = [item for item in items if any(map(item.get_closest_marker, ("slow", "full", "klipper")))]
    if longer:
        config.hook.pytest_deselected(items=longer)
        items[:] = [item for item in items if item not in longer]


@pytest.fixture(scope="session")
def made_once(tmp_path_factory) -> Callable[[str, Callable[[Path], None]], Path]:
    """made_once("owner", make): the folder that `make` filled, by one of the workers for all of them."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made_once"
    shared.mkdir(exist_ok=True)

    def made(name: str, make: Callable[[Path], None]) -> Path:
        with _locked(shared / f"{name}.lock"):
            if not (shared / f"{name}.done").exists():
                shutil.rmtree(shared / name, ignore_errors=True)
                make(shared / name)
                (shared / f"{name}.done").touch()
        return shared / name

    return made


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
