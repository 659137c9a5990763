"""A rule is a row of rules.toml: one more row decides, in every loop, and a row with a mistake is refused."""

import json
from pathlib import Path

import pytest

from pipeline.verdict import rules
from pipeline.verdict.temperature import of_controller
from pipeline.verdict.verdict import FAILED, PASSED, Figure, read
from tests.report import made
from tests.report.test_pages import DEPOSITION, IDENTIFICATION, SETPOINT, TEMPERATURE, Page


@pytest.fixture
def add(tmp_path, monkeypatch):
    """add(text): the rules of rules.toml and one more row."""

    def add(text: str) -> None:
        path = tmp_path / "more_rules.toml"
        path.write_text(rules.PATH.read_text(encoding="utf-8") + text, encoding="utf-8")
        monkeypatch.setattr(rules, "PATH", path)

    return add


ENERGY = """
[temperature.energy_use]
name = "energy"
figure = "evaluate_temperature.contestants.{controller}.energy.q90"
at_most = %s
unit = "%%"
needed_for = ["trial"]
fails = "{who} uses {value} of the power; the rule allows {limit}."
remedy = "Lower the set point."
"""


def test_one_more_row_decides_the_temperature_loop_and_stands_on_its_page(project, add):
    add(ENERGY % 0.001)
    made.main()
    verdict = read("datasets/verdict")["temperature"]
    assert (verdict.state, verdict.winner, verdict.rule) == (FAILED, None, "energy")
    assert verdict.lead == "First failed rule: energy." and "the rule allows 0.001\u202f%." in verdict.reason
    assert verdict.remedy.startswith("Lower the set point.")
    text = Page(TEMPERATURE).text
    assert "First failed rule: energy." in text and "Energy failed failed" in text


def test_one_more_row_that_passes_changes_nobody_s_verdict(project, add):
    made.main()
    before = read("datasets/verdict")["temperature"]
    add(ENERGY % 1e6)
    made.main()
    verdict = read("datasets/verdict")["temperature"]
    assert (verdict.state, verdict.winner) == (before.state, before.winner) == (PASSED, "subspace_lqg")
    assert {line[0].name for line in verdict.rules} - {line[0].name for line in before.rules} == {"energy"}


def test_a_row_with_the_key_of_a_figure_of_the_page_is_refused(project, add):
    add((ENERGY % 40).replace("[temperature.energy_use]", "[temperature.energy]"))
    with pytest.raises(ValueError, match=r"\[temperature.energy\] has the key of a figure of the page; give"):
        of_controller(made.metrics(), "pi")


def test_a_reservation_that_fails_is_not_the_one_that_is_closest_to_its_limit(project, add):
    add((ENERGY % 0.001).replace('needed_for = ["trial"]\n', ""))
    made.main()
    verdict = read("datasets/verdict")["temperature"]
    assert verdict.state == PASSED
    assert "Closest to its limit: " in verdict.reason and "limit: energy" not in verdict.reason


@pytest.mark.parametrize(
    ("loop", "row", "page"),
    [
        (
            "identification",
            'figure = "identify_plant.fit_holdout.*"\nat_least = 101\nneeded_for = ["design"]',
            IDENTIFICATION,
        ),
        ("deposition", 'figure = "train_ilc.*.gamma"\nat_most = -1\nneeded_for = ["simulation"]', DEPOSITION),
        ("setpoint", 'figure = "train_classifier.ece_image"\nbelow = 0\nneeded_for = ["see"]', SETPOINT),
    ],
)  # fmt: skip
def test_one_more_row_decides_the_other_loops_too(project, add, loop, row, page):
    add(f'\n[{loop}.mine]\nname = "My rule"\n{row}\n')
    made.main()
    verdict = read("datasets/verdict", (loop,))[loop]
    assert verdict.state == FAILED
    rule = next(line[0] for line in verdict.rules if line[0].name == "My rule")
    assert rule.state == FAILED and "My rule is " in rule.reason
    assert "My rule" in Page(page).text


def test_of_several_figures_the_worst_decides():
    figures = {"fit": {"a": 80.0, "b": 60.0}, "of": {"a": {"q90": 3.0, "low": 2.0, "high": 5.0}}}
    assert rules.at_path(figures, "fit.*", at_least=True) == Figure(60.0, 60.0, 60.0)
    assert rules.at_path(figures, "fit.*", at_least=False) == Figure(80.0, 80.0, 80.0)
    assert rules.at_path(figures, "of.a", at_least=False) == Figure(3.0, 2.0, 5.0)
    assert (
        rules.at_path(figures, "fit.c", at_least=True).reason == "fit.c is not among what the stages measured"
    )


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ('name = "x"\nfigur = "a.b"\nat_most = 1', r"\[setpoint.mine\] figure: Field required"),
        ('name = "x"\nfigure = "a.b"\nat_most = 1\nunits = "s"', r"\[setpoint.mine\] units: Extra inputs"),
        ('name = "x"\nfigure = "a.b"', r"\[setpoint.mine\] expected one of at_least, at_most and"),
        ('name = "x"\nfigure = "a.b"\nat_most = "settling"', r"\[setpoint.mine\] expected one of at_least"),
        ('name = "x"\nfigure = "a.b"\nat_most = 1\nat_least = 0', r"\[setpoint.mine\] expected one of at_l"),
        ('name = "x"\nfigure = "a.{controler}"\nat_most = 1', r"figure: {controler} is unknown; write {con"),
        (
            'name = "x"\nfigure = "a.b"\nat_most = 1\nneeded_for = ["contrl"]',
            r"\[setpoint.mine\] needed_for: contrl is no use of this loop; expected control, see",
        ),
        ('name = "x"\nname = "y"', r"more_rules.toml: Cannot overwrite a value .* git checkout"),
    ],
)
def test_a_row_with_a_mistake_is_refused_by_name(add, row, sentence):
    add(f"\n[setpoint.mine]\n{row}\n")
    with pytest.raises(ValueError, match=sentence):
        rules.rows("setpoint")


# ---- certificates


def certified(**refused: str) -> None:
    path = Path("datasets/certify/certified.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    each = {name: {"measured": False, "why": why} for name, why in refused.items()}
    path.write_text(json.dumps({"temperature": each, "setpoint": {}}))


def test_a_controller_whose_certificate_is_refused_is_not_named_and_the_next_that_passes_is(project):
    certified(subspace_lqg="The disk margin is 0.2.")
    made.main()
    verdict = read("datasets/verdict")["temperature"]
    assert verdict.state == PASSED and verdict.winner not in (None, "subspace_lqg")


def test_if_nobody_who_passes_is_certified_nothing_is_ready_and_the_certificate_says_why(project):
    names = made.comparison()["contestants"]
    certified(**dict.fromkeys(names, "The disk margin is 0.2."))
    made.main()
    verdict = read("datasets/verdict")["temperature"]
    assert (verdict.winner, verdict.rule) == (None, "certificate") and verdict.state not in (PASSED, FAILED)
    assert verdict.lead == "First undecided rule: certificate." and verdict.subject in names
    assert verdict.reason.startswith("The disk margin is 0.2.")


def test_a_sentence_with_an_unknown_place_is_refused_by_the_name_of_its_rule(project, add, capsys):
    add((ENERGY % 0.001).replace("{value}", "{watts}"))
    with pytest.raises(SystemExit):
        made.main()
    said = capsys.readouterr().err
    assert "a sentence of the rule energy has no place for 'watts'; it may use " in said and "{value}" in said
