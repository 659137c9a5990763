"""The walk-throughs in docs/ run as they stand, and the version is one. README is short, its figures are
those of the accepted run, and its commands exist."""

import argparse
import copy
import doctest
import importlib
import importlib.util
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


def told(monkeypatch, capsys, *arguments: str) -> str:
    """What the command prints with these arguments and --help."""
    monkeypatch.setattr("sys.argv", ["beadline", *arguments, "--help"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    return " ".join(capsys.readouterr().out.split())


def test_the_help_of_every_command_has_a_sentence_an_example_and_the_exit_statuses(monkeypatch, capsys):
    names = re.findall(r"choose from|'([\w-]+)'", _choices(monkeypatch, capsys))
    names = [name for name in names if name]
    assert {"accept", "runs", "nightly", "export"} <= set(names) <= set(cli.EXAMPLES)
    for name in names:
        text = told(monkeypatch, capsys, name)
        assert f"Example: ./run beadline {name} {cli.EXAMPLES[name]}".rstrip() in text, name
        assert re.search(r"Exit status: 0 .*; 1 ", text), name
        # its sentence stands between the usage and the options
        assert re.search(r"\S[.:] (positional arguments|options):", text), (name, text)


def _choices(monkeypatch, capsys) -> str:
    monkeypatch.setattr("sys.argv", ["beadline", "no-such-command"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    return capsys.readouterr().err.split("choose from")[1]


def test_the_pictures_of_the_readme_are_those_that_the_command_takes(root):
    from pipeline.report.screenshots import SHOTS

    shown = re.findall(r"!\[[^\]]+\]\((reports/[^)]+)\)", (root / "README.md").read_text(encoding="utf-8"))
    assert shown == [f"reports/{shot.file}" for shot in SHOTS]
    assert all((root / path).read_bytes().startswith(b"\x89PNG") for path in shown)


def test_where_there_is_no_page_no_picture_is_taken(tmp_path):
    from pipeline.report.screenshots import take

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
    figures["model_based"]["identity"]["J100"] += 100.0
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
    assert all(f"## {name}\n" in commands for name in cli.EXAMPLES)
    assert "| `--to` |" in commands
    assert "Disk margin\n  Change of gain and phase" in generated.glossary()


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
