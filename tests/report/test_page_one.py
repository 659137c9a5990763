"""Every statement of page one, recomputed here from the artifacts themselves, apart from the code that writes
the page."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from pipeline.report.certificate import exported
from pipeline.report.shared import page
from pipeline.report.shared.sources import LARGEST_COPY
from pipeline.report.temperature.card import failure
from pipeline.verdict.verdict import Question, count_of
from tests.report.test_pages import Page

LOOPS = ("temperature", "deposition", "setpoint")


def metrics(reports, stage):
    return json.loads((reports.parent / f"datasets/{stage}/figures.json").read_text())


@pytest.fixture(scope="module")
def first(reports):
    return Page(reports / "index.html")


@pytest.fixture(scope="module")
def cards(first):
    """Text of each loop's card."""
    starts = [first.text.index(words) for words in ("Heaters and motor", "Plunger command", "Nozzle camera")]
    ends = [*starts[1:], first.text.index("Since the")]
    return {loop: first.text[a:b] for loop, a, b in zip(LOOPS, starts, ends, strict=True)}


def numbers(text):
    return [float(found.replace(",", "")) for found in re.findall(r"(?<![\w.])\d[\d,]*\.?\d*", text)]


def row(card, title, until):
    return card[card.index(title) + len(title) : card.index(until, card.index(title))]


def test_the_headline_counts_the_verdicts_that_the_metrics_keep(reports, first):
    verdicts = metrics(reports, "report")["verdicts"]
    assert {loop: verdicts[loop]["state"] for loop in LOOPS} == dict.fromkeys(LOOPS, "passed")
    assert "Pass (simulation): all three loops." in first.text
    for loop in LOOPS:
        assert f"{verdicts[loop]['decision']} {verdicts[loop]['lead']}" in first.text


def test_temperature_shows_the_quantiles_and_bands_of_the_comparison(reports, cards):
    contestants = metrics(reports, "evaluate_temperature")["contestants"]
    card, limits = cards["temperature"], {"Settled error": 0.5, "Overshoot": 5.0}
    names = ("subspace_lqg", "learned_kernel")
    for title, key, until in (
        ("Settled error", "settled_error", "Settling"),
        ("Overshoot", "overshoot", "90"),
    ):
        shown = numbers(row(card, title, until))
        asked = [limits[title]]
        for name in names:
            figure = contestants[name][key]
            asked += [figure["q90"], figure["low"], figure["high"]]
        np.testing.assert_allclose(shown[: len(asked)], asked, atol=0.051, err_msg=title)


def test_deposition_shows_the_worst_stream_of_each_composer_and_the_range(reports, cards):
    scores = pd.read_parquet(reports.parent / "datasets/compose_parts/scores.parquet")
    shown = numbers(row(cards["deposition"], "Flow error", "Line volume"))
    asked = [6.0]
    of_library = scores[scores.composer.isin(["priority", "superposition"])]
    library = of_library.groupby("composer").rms_percent_of_on_off.max().idxmin()
    for composer in ("on_off", "basis", library):
        errors = scores.rms_percent_of_on_off[scores.composer == composer]
        asked += [errors.max()] + ([errors.min(), errors.max()] if np.ptp(errors) else [])
    np.testing.assert_allclose(shown, asked, atol=0.51)
    lines = numbers(row(cards["deposition"], "Line volume", "Above learned part"))
    worst = scores.worst_line_volume_percent[scores.composer == "basis"].max()
    assert lines[0] == 3.0 and any(line == pytest.approx(worst, abs=0.051) for line in lines[2:3])


def test_setpoint_shows_the_worst_case_of_each_controller_with_its_interval(reports, cards):
    board = pd.read_parquet(reports.parent / "datasets/evaluate_setpoint/scoreboard.parquet")
    ends = []
    for name in ("sequential test", "Bayes filter", "paper's agent"):
        counting = board[board.counts & (board.controller == name)]
        worst = counting.loc[counting.settled_percent.idxmin()]
        ends += [worst.settled_percent, worst.settled_low_percent, worst.settled_high_percent]
    shown = numbers(row(cards["setpoint"], "Settles", "Stays"))
    np.testing.assert_allclose(shown[1:], ends, atol=0.051)


def test_each_card_names_one_next_step_and_its_command_is_a_command(cards):
    from pipeline.cli import COMMANDS

    for card in cards.values():
        found = re.findall(r"\./run (?:beadline ([\w-]+)|dvc (repro))", card[card.index(" Next ") :])
        assert len(found) == 1 and all(
            any(command.split()[0] == name for command in COMMANDS) or repro for name, repro in found
        )


def test_the_files_and_the_certificate_are_those_of_the_export_with_the_first_digits_of_their_hash(
    reports, cards
):
    exported = metrics(reports, "export_controllers")
    for loop in LOOPS:
        place = cards[loop][cards[loop].index(" File ") :]
        for path, sha256 in list((exported.get(loop, {}).get("files") or {}).items())[:1]:
            assert Path(path).name in place or "controller.json" in place
            assert any(digits[:8] in place for digits in exported[loop]["files"].values()), sha256
    assert exported["temperature"]["certificate"]["sha256"][:8] in cards["temperature"]


def test_what_the_data_cost_is_what_the_stages_read(reports, cards):
    samples = metrics(reports, "ingest")["samples"]
    minutes = float(re.search(r"Learned from ([\d.,]+) minutes of record", cards["temperature"])[1])
    assert minutes == pytest.approx(samples / 60, rel=0.01)  # a second a sample
    trials = pd.read_parquet(reports.parent / "datasets/train_ilc/trials.parquet")
    prints = (trials.law == "model_inverse").sum()
    assert f"Learned from {prints} prints of training routines" in cards["deposition"]
    data = metrics(reports, "train_classifier")["data"]
    assert f"Learned from {data['segments']:,} segments, {data['frames']:,} pictures" in cards["setpoint"]


def test_no_link_leads_out_of_the_folder_of_the_pages(reports):
    leads = {
        (path.name, link)
        for path in reports.glob("*.html")
        for link in re.findall(r'href="([^"#]+)', path.read_text(encoding="utf-8"))
    }
    assert len(leads) > 50
    assert {lead for lead in leads if lead[1].startswith("..") or not (reports / lead[1]).exists()} == set()


def test_a_file_too_large_to_lie_beside_the_pages_is_named_and_not_linked():
    path = "datasets/train_ilc/lessons.parquet"
    named = page.placed(f"../{path}", path, "lessons")
    assert "href" not in named and f"<code>{path}</code> of the project" in named
    assert 'href="data/train_ilc.lessons.parquet"' in page.placed("data/train_ilc.lessons.parquet", path, "x")


def test_the_file_to_load_is_copied_beside_the_pages_byte_for_byte_where_it_is_small(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("datasets/export_controllers/temperature/controller.json")
    line = {"loop": "temperature", "file": path.as_posix()}
    read = type("Read", (), {"read": {}})()
    # what was not exported, and what is not there, is no link
    for absent in (line, line | {"file": ""}):
        assert exported.link(read, absent) == "" and exported.copies(read, [absent]) == {}
    path.parent.mkdir(parents=True)
    path.write_bytes(b"{}")
    assert exported.link(read, line) == "data/temperature.controller.json"
    assert exported.copies(read, [line]) == {"temperature.controller.json": b"{}"}
    path.write_bytes(bytes(LARGEST_COPY + 1))
    assert exported.link(read, line) == "" and exported.copies(read, [line]) == {}


def test_no_controller_reads_as_approved(first):
    """The accepted run is what figures are compared with; nobody approved its controller."""
    assert "as accepted" not in first.text


def test_a_contestant_that_fails_a_rule_which_the_card_does_not_show_says_so_under_its_name():
    asked = [
        Question(1, "settled_error", "Settled error, worst zone", "°C", 0.5, False, ""),
        Question(8, "disk_margin", "Margin: disk, weakest tenth of plants", "", 0.4, True, ""),
    ]
    figures = {"settled_error": count_of(0.03), "disk_margin": count_of(0.37)}
    bad = figures | {"settled_error": count_of(0.7)}
    good = figures | {"disk_margin": count_of(0.41)}
    judged = SimpleNamespace(asked=asked, answers={"low": figures, "bad": bad, "good": good})
    told = {
        name: failure(judged, name, ["settled_error", "settling"]) for name in ("low", "bad", "good", "none")
    }
    assert told == {"low": "; fails disk margin", "bad": "", "good": "", "none": ""}


def test_a_plain_pi_stands_beside_the_one_that_runs_with_its_cost(reports, cards):
    kept = reports.parent / "datasets/evaluate_temperature/figures.json"
    figures = json.loads(kept.read_text())["contestants"]
    told = re.search(r"PI, SIMC: (\d+)\W*% (cheaper|dearer) than subspace \+ LQG", cards["temperature"])
    assert told, cards["temperature"]
    plain, ours = (figures[name]["cost"]["median"] for name in ("pi_simc", "subspace_lqg"))
    less = 100 * (1 - plain / ours)
    assert int(told[1]) == round(abs(less)) and told[2] == ("cheaper" if less > 0 else "dearer")


def lines_listed(told):
    """{controller: value} below the deciding picture, whose caption begins what is told."""
    return dict(
        re.findall(
            r" ([A-Za-z+, ]+?) ((?:beyond )?\d[\d.]*|none)(?:\u202f| )?s? ?,", told[: told.index("limit")]
        )
    )


CAPTION = "is off its reference by more than"


def test_the_deciding_picture_tells_how_long_each_controller_is_off(reports, first):
    runs = pd.read_parquet(reports.parent / "datasets/evaluate_temperature/trajectories.parquet")
    deciding = runs[runs.case_name == "deciding"]
    told = first.text[first.text.index(CAPTION) :]
    limit = float(re.search(r"more than ([\d.]+)", told)[1])
    listed = lines_listed(told[told.index("°C:") + 3 :])
    zones = [name for name in runs if f"{name}_reference" in runs]
    for shown, name in (("subspace + LQG", "subspace_lqg"), ("learned kernel", "learned_kernel")):
        mine = deciding[deciding.contestant == name]
        last = [mine.time_s[np.abs(mine[zone] - mine[f"{zone}_reference"]) > limit].max() for zone in zones]
        seconds = float(listed[shown].removeprefix("beyond "))
        if listed[shown].startswith("beyond"):
            assert any(end >= seconds for end in last), (listed, last)
        else:
            assert any(end == pytest.approx(seconds, rel=0.01) for end in last), (listed, last)


def test_the_deciding_picture_draws_whom_the_table_beside_it_shows(cards):
    card = cards["temperature"]
    told = card[card.index(CAPTION) :]
    listed = lines_listed(told[told.index("°C:") + 3 :])
    heads = card[: card.index("Settled error")]
    assert len(listed) == 3 and all(name in heads for name in listed), (listed, heads)


def test_what_changed_is_counted_for_every_loop(first):
    place = first.text[first.text.index("Since the") :]
    assert "First run: nothing to compare with." in place
