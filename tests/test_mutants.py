"""Mutants are drawn the same every time, are other programs, and leave words and annotations alone."""

import ast

import pytest

from benchmarks import mutants

TEXT = '''
def limited(value: int, low: float = 0.0) -> float:
    """At least `low` and at most 10."""
    if value < low or not value:
        raise ValueError(f"{value + 1} is below {low}")
    return min(value * 2, 10)
'''


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("a < b", "a <= b"),
        ("a * b", "a / b"),
        ("a and b", "a or b"),
        ("not a", "a"),
        ("3", "4"),
        ("0.5", "1.0"),
        ("True", "False"),
        ("min(a)", "max(a)"),
        ("x.T", "x"),
    ],
)
def test_a_node_becomes_a_wrong_one(before, after):
    assert ast.unparse(mutants.changed(ast.parse(before, mode="eval").body)) == after


def test_a_draw_is_the_same_every_time_and_another_by_another_seed():
    one, again, other = (mutants.mutants(TEXT, 5, seed) for seed in ("1", "1", "2"))
    assert one == again != other
    assert len(one) == 5


def test_every_mutant_is_another_program_with_the_same_words():
    whole = mutants.mutants(TEXT, 1000, "1")
    plain = ast.unparse(ast.parse(TEXT))
    assert len({mutant.text for mutant in whole}) == len(whole) > 8
    for mutant in whole:
        assert mutant.text != plain
        compile(mutant.text, "mutant", "exec")
        assert "value: int" in mutant.text
        assert "At least `low` and at most 10." in mutant.text
        assert "{value + 1} is below" in mutant.text or mutant.change.startswith("raise")


def test_a_share_counts_neither_the_killed_nor_the_equivalent_as_alive(monkeypatch):
    monkeypatch.setattr(mutants, "JUDGED", {("m", "3: 1 -> 2"): "no one can see it"})
    rows = [
        (mutants.Mutant(line, change, ""), mutants.Played(outcome, 1.0))
        for line, change, outcome in (
            (1, "a -> b", "killed"), (2, "a -> c", "hangs"),
            (3, "1 -> 2", "survives"), (4, "1 -> 2", "survives"),
        )
    ]  # fmt: skip
    made = mutants.table("m", "test_m.py", rows, [])
    assert (made["killed"], made["equivalent"], made["share_killed"]) == (2, 1, 0.667)
    assert [row["equivalent"] for row in made["survivors"]] == ["no one can see it", None]


def test_survivors_of_another_text_are_not_taken_for_killed():
    before = {"mutants": 60, "survivors": [{"mutant": "1: never -> there", "equivalent": None}]}
    with pytest.raises(SystemExit, match="kernel: the module has changed since, 1: never -> there is none"):
        mutants.play("kernel", 60, 0.0, before)
