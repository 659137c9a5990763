"""./run: the command that uv gets, and what goes before and after DVC."""

import os
import signal
import subprocess
import sys

import pytest

import stages
from tests import fake_uv


@pytest.fixture
def copy(root, tmp_path):
    fake_uv.furnish(tmp_path, root)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "asked"),
    [
        ("true", "true"),
        ("pytest -k x", "--group dev pytest -k x"),
        ("ruff check", "--group dev ruff check"),
        ("ty check", "--group dev ty check"),
        ("--group peers pytest", "--group peers --group dev pytest"),
        ("cat pytest ruff", "cat pytest ruff"),
        ("--group pytest true", "--group pytest true"),
        ("dvc status", "python -P {folder}/pipeline/around_dvc.py  dvc status"),
        (
            "--group cluster --quiet dvc pull -q",
            "--group cluster --quiet python -P {folder}/pipeline/around_dvc.py  --group cluster --quiet "
            "dvc pull -q",
        ),
        ("beadline quick", "python -P {folder}/pipeline/around_dvc.py  beadline quick"),
    ],
)
def test_uv_gets_the_command_behind_its_options_and_the_group_that_the_command_needs(copy, command, asked):
    ended = fake_uv.run(copy, *command.split())
    assert ended.returncode == 0, ended.stderr
    assert fake_uv.asked(copy) == f"uv run --frozen --project {copy} {asked.format(folder=copy)}"


def test_words_of_a_command_stay_as_they_are(copy):
    code = "import sys; print(sys.argv[1:])"
    ended = fake_uv.run(copy, "python", "-c", code, "a  b", "", "*", "--group")
    assert ended.stdout == "['a  b', '', '*', '--group']\n"


def test_the_last_line_is_the_verdict_of_page_one(copy):
    page = copy / "reports/index.html"
    fake_uv.write(page, "<html><title>3 of 3 pass (simulation) · beadline</title>")
    last = f"3 of 3 pass (simulation). Open {page}\n"
    assert fake_uv.run(copy, "dvc", "repro").stdout == f"dvc repro\n{last}"
    for others in (["repro", "--dry"], ["repro", "-h"], ["status"], ["exp", "run"]):
        assert fake_uv.run(copy, "dvc", *others).stdout == f"dvc {' '.join(others)}\n"
    page.unlink()
    assert fake_uv.run(copy, "dvc", "repro").stdout == "dvc repro\n"


def test_a_repro_of_named_stages_ends_with_the_verdict_only_if_it_made_the_page(copy):
    page = copy / "reports/index.html"
    fake_uv.write(page, "<title>Fail · beadline</title>")
    assert fake_uv.run(copy, "dvc", "repro", "-f", "train_ilc").stdout == "dvc repro -f train_ilc\n"
    makes = "import pathlib\ndef main(_):\n    pathlib.Path({!r}).write_text({!r})\n    return 0\n"
    fake_uv.write(copy / "fake/dvc/cli.py", makes.format(str(page), "<title>Pass · beadline</title>"))
    assert fake_uv.run(copy, "dvc", "repro", "report").stdout == f"Pass. Open {page}\n"


def test_the_exit_status_of_dvc_is_handed_on_without_a_last_line(root, tmp_path):
    fake_uv.furnish(tmp_path, root, status=7)
    fake_uv.write(tmp_path / "reports/index.html", "<title>pass · beadline</title>")
    ended = fake_uv.run(tmp_path, "dvc", "repro")
    assert (ended.returncode, ended.stdout) == (7, "dvc repro\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_run_reaches_dvc(copy, number):
    """The process that was started is DVC in the end: nothing between the two can be killed alone."""
    slow = "import os, time\ndef main(arguments):\n    print(os.getpid(), flush=True)\n    time.sleep(600)\n"
    fake_uv.write(copy / "fake/dvc/cli.py", slow)
    with subprocess.Popen(
        ["./run", "dvc", "repro"],
        cwd=copy,
        env=fake_uv.environment(copy),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a job in the background of a shell ignores SIGINT, and so does what it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as started:
        assert started.stdout is not None
        # the process of the shell became the one of uv, and that, here, the one of DVC
        assert int(started.stdout.readline()) == started.pid
        started.send_signal(number)
        # as Python ends by that signal
        assert started.wait(timeout=60) == -number


STAGE = "import subprocess; worker = subprocess.Popen(['sleep', '600']); print(1, flush=True); worker.wait()"


def test_a_signal_to_run_alone_ends_the_stage_and_its_workers(copy):
    slow = "import subprocess, sys\ndef main(arguments):\n    subprocess.run([sys.executable, '-c', {!r}])\n"
    fake_uv.write(copy / "fake/dvc/cli.py", slow.format(STAGE))
    with subprocess.Popen(
        ["./run", "dvc", "repro"], cwd=copy, env=fake_uv.environment(copy), stdout=subprocess.PIPE, text=True
    ) as started:
        assert started.stdout is not None
        assert started.stdout.readline() == "1\n"
        started.send_signal(signal.SIGTERM)
        # stage and worker hold the other end of the pipe: it ends when both have ended
        assert started.stdout.read() == ""
        assert started.wait(timeout=60) == -signal.SIGTERM


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x: " + "[" * 100_000, "run: params.yaml: line 1: "),
        ("a: &a [*a]\n", "run: params.yaml: line 1: "),
        ("x: 1\nx: 2\n", "run: params.yaml: line 2: "),
        ("x: " + "1 " * 200_000, "run: params.yaml has 400003 bytes but may have 200000; "),
    ],
)
def test_parameters_that_nobody_can_read_are_refused_before_dvc_reads_them(copy, text, sentence):
    (copy / "params.yaml").write_text(text)
    for folder in (copy, copy / "pipeline"):
        ended = subprocess.run(
            [copy / "run", "dvc", "repro"],
            cwd=folder,
            env=fake_uv.environment(copy),
            capture_output=True,
            text=True,
            check=False,
        )
        assert (ended.returncode, ended.stdout) == (1, "")
        assert (
            sentence.replace("params.yaml", str(os.path.relpath(copy / "params.yaml", folder)))
            in ended.stderr
        )
        assert ended.stderr.count("\n") == 1


RUNS_STAGES = ("dvc repro", "dvc exp run -S report.settled_percent=90", "beadline quick", "beadline nightly")


@pytest.mark.parametrize("command", RUNS_STAGES)
def test_misspelt_keys_are_refused_by_name_before_a_command_that_runs_stages(copy, command):
    text = (copy / "params.yaml").read_text()
    misspelt = text.replace("settled_error_degC:", "settled_eror_degC:").replace("  watch_h:", "  wach_h:")
    (copy / "params.yaml").write_text(misspelt)
    ended = fake_uv.run(copy, *command.split())
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == (
        "run: params.yaml: nightly.wach_h is unknown; did you mean watch_h?; "
        "params.yaml: report.settled_eror_degC is unknown; did you mean settled_error_degC?\n"
    )


@pytest.mark.parametrize("command", ["dvc status", "dvc pull", "dvc repro --help", "beadline init log.csv"])
def test_misspelt_keys_stop_no_command_that_runs_no_stage(copy, command):
    (copy / "params.yaml").write_text((copy / "params.yaml").read_text().replace("  watch_h:", "  wach_h:"))
    assert fake_uv.run(copy, *command.split()).returncode == 0


def test_parameters_that_were_checked_once_are_not_read_again_until_they_change(copy):
    (copy / ".dvc/tmp").mkdir(parents=True)
    assert fake_uv.run(copy, "dvc", "repro").returncode == 0
    remembered = (copy / stages.CHECKED).read_bytes()
    assert fake_uv.run(copy, "dvc", "repro").returncode == 0
    (copy / "params.yaml").write_text("x: [")
    assert fake_uv.run(copy, "dvc", "status").returncode == 1
    assert (copy / stages.CHECKED).read_bytes() == remembered


def test_what_goes_around_dvc_imports_the_standard_library_alone(root):
    """Every `./run dvc` pays for it."""
    code = "import sys; import pipeline.around_dvc; print(*{name.partition('.')[0] for name in sys.modules})"
    ended = subprocess.run(
        [sys.executable, "-S", "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert set(ended.stdout.split()) <= sys.stdlib_module_names | {"pipeline", "stages", "__main__"}
