"""The walk-throughs in docs/ run as they stand, and the version is one. README is short, its figures are
those of the accepted run, and its commands exist."""

import argparse
import copy
import doctest
import importlib
import importlib.util
import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline import cli
from pipeline.setpoint.agents import score
from pipeline.store import artifacts
from tests import readme
from tests.recordings import klipper_machine

LOOPS = ("temperature", "deposition", "setpoint")


@pytest.fixture
def walked(root, tmp_path, monkeypatch):
    """walked("setpoint"): the names that the walk-through leaves behind."""
    monkeypatch.chdir(tmp_path)

    def walk(loop: str) -> dict:
        left = runpy.run_path(str(root / f"docs/{loop}.py"))
        assert (tmp_path / f"{loop}.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")
        return left

    return walk


@pytest.mark.parametrize("loop", LOOPS)
def test_a_walk_through_is_read_in_a_sitting(root, loop):
    text = (root / f"docs/{loop}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80 and text.count("\n# %% ") >= 5


def test_every_learned_law_of_the_temperature_walk_through_is_within_a_percent_of_the_optimum(walked):
    left = walked("temperature")
    assert set(left["gaps"]) == {"subspace + LQG", "VARX + Riccati", "learned kernel"}
    assert max(left["gaps"].values()) < 0.01
    for name in left["gaps"]:  # as deployed, all zones settle on their references
        np.testing.assert_allclose(left["runs"][name].y[-1, 0], left["references"][0], atol=0.5)  # noise 0.1


def test_the_deposition_walk_through_learns_the_line_and_the_model_inverse_learns_it_sooner(walked):
    ratios = walked("deposition")["ratios"]
    assert ratios["model inverse"].min() < 0.15 and ratios["Hoelzle 2009"].min() < 0.6
    assert ratios["model inverse"][3] < ratios["Hoelzle 2009"][3]


def test_the_bayes_filter_of_the_setpoint_walk_through_stays_and_one_that_expects_jumps_survives_a_clog(
    walked,
):
    left = walked("setpoint")
    stay = {name: one.stay.percent for name, one in left["scores"].items()}
    assert max(stay, key=stay.get) == "Bayes filter" and stay["Bayes filter"] > 95
    last = {
        name: np.median(np.asarray(run.flow)[:, score.RECOVERED_UNTIL])
        for name, run in left["clogged"].items()
    }
    assert last["Bayes filter"] < 90 < last["Bayes filter, expects jumps"]


def test_the_version_is_one_and_the_same_wherever_it_stands(root, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["beadline", "--version"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    version = capsys.readouterr().out.split()[1]
    assert ended.value.code == 0
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f'name = "beadline"\nversion = "{version}"\n' in (root / "uv.lock").read_text(encoding="utf-8")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.*?)\]", changes, re.MULTILINE)[:2] == ["Unreleased", version]


@pytest.fixture
def beadline(monkeypatch, capsys):
    """beadline("init", "--help"): status, what was printed, and what was said of errors."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["beadline", *arguments])
        status = 0
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
        return status, *capsys.readouterr()

    return run


VERBS = {
    *("Make", "Write", "List", "Compute", "Calibrate", "Watch", "Show", "Compare", "Learn"),
    *("Measure", "Correct"),
}


def test_help_has_twelve_commands_in_groups_and_each_line_begins_with_a_verb(beadline):
    lines = {name: line for group in cli.GROUPS.values() for name, line in group.items()}
    assert sorted(lines) == sorted({name.split()[0] for name in cli.COMMANDS}) and len(lines) == 12
    assert {line.split()[0] for line in lines.values()} <= VERBS
    assert all(len(line) <= 60 for line in lines.values())
    status, text, _ = beadline("--help")
    assert status == 0
    for group, commands in cli.GROUPS.items():
        assert f"{group}:\n" + "\n".join(f"  {name:<12}{line}" for name, line in commands.items()) in text


def test_all_commands_together_have_at_most_45_options():
    options = [
        (name, names[0])
        for name, command in cli.COMMANDS.items()
        for names, _ in command.arguments
        if names[0].startswith("-")
    ]
    assert len(options) <= 45, options


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_the_help_of_a_command_has_an_example_exit_statuses_and_defaults(beadline, name):
    status, text, _ = beadline(*name.split(), "--help")
    plain = " ".join(text.split())
    assert status == 0 and f"Example: ./run beadline {name} {cli.COMMANDS[name].example}".rstrip() in plain
    assert re.search(r"Exit status: 0 .* 1 ", plain)
    for names, settings in cli.COMMANDS[name].arguments:
        if (
            names[0].startswith("-")
            and settings.get("default")
            and settings["default"] == settings["default"]
        ):
            assert f"(default: {settings['default']})" in plain, names
        assert settings["help"], names


@pytest.mark.parametrize("name", ["calibrate", "experiment"])
def test_the_help_of_a_command_of_several_parts_names_them_with_an_example(beadline, name):
    status, text, _ = beadline(name, "--help")
    assert status == 0 and f"Example: ./run beadline {name} " in text and "Exit status:\n  0   done" in text
    parts = [part for part in cli.COMMANDS if part.startswith(f"{name} ")]
    listed = " ".join(f"{part.split()[1]} {cli.WITHIN[part]}" for part in parts)
    assert f"WHAT {listed} options:" in " ".join(text.split())
    assert all(cli.WITHIN[part].split()[0] in VERBS and len(cli.WITHIN[part]) <= 60 for part in parts)


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_each_line_of_help_on_an_option_fits_beside_it(name):
    for names, settings in cli.COMMANDS[name].arguments:
        assert len(settings["help"].replace("%%", "%")) <= 60, names
    assert {0, 1, 2} <= set(cli.COMMANDS[name].statuses)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["inspct", "log.csv"], "inspect"), (["calibrate", "cam"], "camera"),
        (["init", "a.csv", "--coppy"], "--copy"),
        (["nightly", "--roll-back"], "--rollback"), (["calibrate", "levels", "in", "--hodl=3"], "--hold"),
    ],
)  # fmt: skip
def test_a_mistyped_command_or_option_is_answered_with_the_closest_one(beadline, typed, meant):
    status, out, wrong = beadline(*typed)
    assert (status, out) == (2, "") and wrong.rstrip().endswith(f"; did you mean {meant}?")


def test_what_is_like_no_command_is_answered_without_a_guess(beadline):
    status, _, wrong = beadline("zzzzzz")
    assert status == 2 and "did you mean" not in wrong and "choose from" in wrong


def test_a_closed_pipe_ends_a_command_silently(root, tmp_path):
    """Whoever reads closes at once, before the command has printed."""
    (tmp_path / "log.csv").write_text("time_s,sensor\n" + "".join(f"{t},{t % 7}\n" for t in range(50)))
    command = f"{sys.executable} -m pipeline.cli inspect {tmp_path}/log.csv; echo $? >&2"
    with subprocess.Popen(
        ["bash", "-c", command], cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as ran:
        ran.stdout.close()
        assert ran.stderr.read() == b"141\n"


def test_the_pictures_of_the_readme_are_those_that_are_taken(root):
    from tests.screenshots import SHOTS

    shown = re.findall(r"!\[[^\]]+\]\((reports/[^)]+)\)", (root / "README.md").read_text(encoding="utf-8"))
    assert shown == [f"reports/{shot.file}" for shot in SHOTS]
    assert all((root / path).read_bytes().startswith(b"\x89PNG") for path in shown)


def test_where_there_is_no_page_no_picture_is_taken(tmp_path):
    from tests.screenshots import take

    with pytest.raises(ValueError, match="index.html: expected the page, found none; run ./run dvc repro"):
        take(tmp_path)


# ---- README


@pytest.fixture
def text(root) -> str:
    return (root / "README.md").read_text(encoding="utf-8")


@pytest.fixture
def accepted(root) -> dict:
    return artifacts.read_json(root / readme.ACCEPTED)


def check_readme(text: str, accepted: dict, papers: Path) -> None:
    """Raises AssertionError, naming the block, if README does not hold what the accepted run gives."""
    for name, block in readme.blocks(accepted, papers).items():
        assert block in text, f"README.md, block {name}: run {readme.COMMAND}, which writes it"


def test_the_figures_and_verdicts_of_the_readme_are_those_of_the_accepted_run(root, text, accepted):
    check_readme(text, accepted, root / readme.PAPERS)
    assert readme.rewritten(text, readme.blocks(accepted, root / readme.PAPERS)) == text


@pytest.mark.parametrize("loop", LOOPS)
def test_one_changed_figure_of_a_loop_makes_the_readme_wrong(root, text, accepted, loop):
    metrics = copy.deepcopy(accepted["metrics"])
    if loop == "temperature":
        subject = metrics["evaluate_temperature"]["contestants"][accepted["verdicts"][loop]["subject"]]
        subject["settling"]["q90"] += 1.0
    elif loop == "deposition":
        metrics["compose_parts"]["dashes"]["A"][accepted["verdicts"][loop]["winner"]][
            "rms_percent_of_on_off"
        ] += 0.1
    else:
        metrics["evaluate_setpoint"]["cases"]["recorded, sticky, half clog"]["settled"] += 0.1
    with pytest.raises(AssertionError, match="README.md, block loops"):
        check_readme(text, accepted | {"metrics": metrics}, root / readme.PAPERS)


@pytest.mark.parametrize("loop", LOOPS)
def test_another_verdict_of_a_loop_makes_the_readme_wrong(root, text, accepted, loop):
    verdicts = copy.deepcopy(accepted["verdicts"])
    verdicts[loop]["decision"] = "Quick look failed."
    with pytest.raises(AssertionError, match="README.md, block loops"):
        check_readme(text, accepted | {"verdicts": verdicts}, root / readme.PAPERS)


def test_another_count_of_the_papers_makes_the_readme_wrong(root, text, accepted, tmp_path):
    for key in readme.KEYS:
        for suffix in ("json", "toml"):
            name = f"{key}.{suffix}"
            (tmp_path / name).write_bytes((root / readme.PAPERS / name).read_bytes())
    figures = artifacts.read_json(tmp_path / "temperature.json")
    figures["model_based"]["identity"]["farthest"] += 1.0
    artifacts.write_json(tmp_path / "temperature.json", figures)
    with pytest.raises(AssertionError, match="README.md, block papers"):
        check_readme(text, accepted, tmp_path)


def test_the_figures_of_the_readme_are_those_that_the_verdicts_name(root, accepted):
    table = readme.blocks(accepted, root / readme.PAPERS)["loops"]
    for loop, figure in (
        ("deposition", r"Largest flow error: ([\d.]+ %)"),
        ("setpoint", r"worst test case ([\d.]+ %)"),
    ):
        reason = accepted["verdicts"][loop]["reason"].replace("\u202f", " ").replace("\u00a0", " ")
        assert re.search(figure, table)[1] in reason, loop


def test_a_readme_without_the_place_of_a_block_is_refused(text, root, accepted):
    with pytest.raises(ValueError, match="README.md: expected the lines <!-- papers"):
        readme.rewritten(text.replace("<!-- /papers -->", ""), readme.blocks(accepted, root / readme.PAPERS))


def test_outside_its_blocks_the_readme_states_no_measured_figure(text):
    """Times, sizes and versions alone may stand there."""
    units = (
        r"°C|%|percent|points?|mm\b|mm/s|mm³|µm|Hz|kHz|W\b|V\b|Pa\b|px|frames?|images?|times faster|x faster"
    )
    assert re.findall(rf"\d[\d,.]*\s?(?:{units})", readme.without_blocks(text)) == []
    assert re.findall(rf"\d[\d,.]*\s?(?:{units})", text)


def test_the_readme_is_short_and_plain(text):
    assert len(text.splitlines()) <= 150 and len(text.split()) <= 1300
    first_screen = text.split("## Quick start")[0]
    for words in ("research software", "simulated data", "No controller has run on a real printer",
                  "No licence chosen yet", "reports/papers.html"):  # fmt: skip
        assert words in first_screen, words


def test_every_link_of_the_readme_and_the_documents_leads_to_a_file(root):
    for path in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text(encoding="utf-8")):
            assert (path.parent / link).exists(), f"{path.name}: {link}"


def commands(root: Path) -> list[tuple[str, str]]:
    """The commands of beadline that README and the documents name, each with its file."""
    paths = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    return [
        (path.name, command.split("  #")[0].strip())
        for path in paths
        for command in re.findall(r"\./run beadline ([a-z][^`\n]*)", path.read_text(encoding="utf-8"))
    ]


class Parsed(Exception):
    """The arguments were read; the command does not run."""


def test_every_command_of_the_readme_and_the_documents_exists_with_its_options(root, monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def stop(parser: argparse.ArgumentParser) -> None:
        parse(parser)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    named = commands(root)
    assert {"init", "inspect", "quick", "export", "replay"} <= {command.split()[0] for _, command in named}
    for name, command in named:
        monkeypatch.setattr("sys.argv", ["beadline", *shlex.split(command)])
        try:
            cli.main()
        except Parsed:
            continue
        except SystemExit:
            pytest.fail(f"{name}: ./run beadline {command} is refused")


def test_no_page_and_no_document_advises_to_deploy(root):
    pages = [*(root / "pipeline/report/templates").glob("*"), *(root / "docs").rglob("*"), root / "README.md"]
    advice = re.compile(r"(?<!pipeline/)\bdeploy\b", re.IGNORECASE)  # but for the folder of the code
    assert not [
        path.name
        for path in pages
        if path.suffix in {".md", ".py", ".html", ".toml", ".css", ".js"}
        and "_build" not in path.parts
        and advice.search(path.read_text(encoding="utf-8"))
    ]


# ---- the reference that the code itself states


@pytest.fixture(scope="module")
def generated(root):
    """docs/generated.py; it needs no Sphinx."""
    spec = importlib.util.spec_from_file_location("generated", root / "docs/generated.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_part_of_the_reference_has_a_place_on_a_page_and_every_place_a_part(root, generated):
    pages = "".join(path.read_text(encoding="utf-8") for path in (root / "docs").rglob("*.md"))
    places = re.findall(r"<!-- generated: ([\w ]+) -->", pages)
    assert sorted(places) == sorted(generated.PARTS)
    with pytest.raises(KeyError, match="no such part"):
        generated.fill("<!-- generated: no such part -->")


def test_the_reference_has_every_key_of_the_parameter_files(root, generated):
    text = generated.parameters()
    named = set(re.findall(r"^\| `([^`]+)`", text, re.MULTILINE))
    for path in ("params.yaml", "params.expert.yaml"):
        for section, values in yaml.safe_load((root / path).read_text(encoding="utf-8")).items():
            for key in values:
                assert any(re.match(rf"{section}\.{key}(\W|$)", name) for name in named), f"{section}.{key}"
    assert "| `plant.sample_time_s` | s | number, > 0, ≤ 3600 | `1.0` |" in text
    assert "Read by: `render_frames`, `train_classifier`" in text


def test_the_reference_has_every_stage_command_and_word(root, generated):
    stages = yaml.safe_load((root / "dvc.yaml").read_text(encoding="utf-8"))["stages"]
    assert re.findall(r"^## (\w+)$", generated.wiring(), re.MULTILINE) == list(stages)
    commands = generated.commands()
    assert all(f"## {name}\n" in commands for name in cli.COMMANDS)
    assert "| `--rate` | snapshots a second | `5.0` |" in commands
    assert "| 75 | another nightly run is at work | wait for it |" in generated.exit_codes()
    assert "Disk margin\n  How much gain and phase may change" in generated.glossary()


@pytest.mark.parametrize("loop", LOOPS)
def test_the_public_names_of_a_loop_are_there_explained_and_their_example_runs(loop):
    package = importlib.import_module(f"pipeline.{loop}")
    ran = doctest.testmod(package)
    assert ran.failed == 0 and ran.attempted >= 8
    for name in package.__all__:
        value = getattr(package, name)
        assert value.__doc__ or not callable(value), name
    with pytest.raises(AttributeError, match=f"module 'pipeline.{loop}' has no attribute 'no_such_name'"):
        package.no_such_name  # noqa: B018


def test_a_package_of_public_names_loads_no_method(root):
    code = "import sys; from pipeline import temperature, deposition, setpoint; print('numpy' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"


# ---- the blocks of commands


def blocks(root: Path) -> list[tuple[str, str, str]]:
    """(page, what it needs, commands) of each block of commands of the documents."""
    found = []
    for path in sorted((root / "docs").rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        for need, lines in re.findall(r"(?:<!-- needs: (.+?) -->\n)?```sh\n(.*?)```", text, re.DOTALL):
            found.append((path.relative_to(root).as_posix(), need, lines))
    return found


def test_every_block_of_commands_runs_as_it_stands_or_names_what_it_needs(
    root, beadline, tmp_path, monkeypatch
):
    """In a project that has nothing but the shipped files. A block with a need is only read, by the test of
    commands and options."""
    for name in ("params.yaml", "params.expert.yaml", "docs/tutorials/klippy.log"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes((root / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    ran = []
    for page, _, lines in [block for block in blocks(root) if not block[1]]:
        for line in lines.splitlines():
            words = shlex.split(line, comments=True)
            assert words[:2] == ["./run", "beadline"], f"{page}: {line}: say what it needs"
            status, said, wrong = beadline(*words[2:])
            assert (status, wrong) == (0, ""), f"{page}: {line}: {wrong}"
            ran.append((words[2], said))
    assert [name for name, _ in ran] == ["inspect", "init", "init", "experiment"]
    assert "extruder.temp" in ran[0][1] and "nothing is written" in ran[1][1] and "70 °C" in ran[3][1]
    assert (tmp_path / "datasets/raw/temperature/klippy.log").exists() and (
        tmp_path / "experiment.gcode"
    ).exists()


def test_the_log_of_the_tutorial_is_what_the_simulated_printer_writes(root):
    targets = [(0, 0, 60), (60, 200, 60), (600, 215, 70), (900, 205, 65), (1200, 220, 75)]
    made = klipper_machine.print_log(targets, longest_s=1250)
    assert (root / "docs/tutorials/klippy.log").read_text(encoding="utf-8") == made


def test_inspect_and_init_say_in_json_and_beforehand_what_they_would_say_and_write(
    root, beadline, tmp_path, monkeypatch
):
    for name in ("params.yaml", "params.expert.yaml"):
        (tmp_path / name).write_bytes((root / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    log = str(root / "docs/tutorials/klippy.log")
    looked = json.loads(beadline("inspect", log, "--json")[1])
    signals = {signal["source"]: signal for signal in looked["signals"]}
    assert looked["format"] == "klippy.log" and signals["extruder.pwm"]["largest"] == 100.0
    assert {finding["kind"] for finding in looked["findings"]} == {"printed_file", "printer"}
    assert yaml.safe_load(looked["proposed_yaml"])["plant"]["sample_time_s"] == 1.0
    before = Path("params.yaml").read_bytes()
    foretold = beadline("init", log, "--copy", "--dry-run")[1]
    assert Path("params.yaml").read_bytes() == before and not Path("datasets").exists()
    written = beadline("init", log, "--copy")[1]
    assert foretold.splitlines()[1] == written.splitlines()[0] and Path("params.yaml").read_bytes() != before
