"""A verdict as it is stored: what is written is read again, and equal verdicts are equal bytes."""

import math

from pipeline.verdict.verdict import FAILED, OPEN, Figure, Missing, Question, Rule, Verdict, read, write

QUESTION = Question(5, "settling", "Settling", "s", math.inf, False, "settling")
RULES = (
    (
        Rule(
            "settling",
            QUESTION,
            Figure(math.inf, 20.0, math.inf, (1.0, math.inf)),
            reason="It never settles.",
        ),
        Rule("settling", QUESTION, Figure(20.0, 19.0, 21.0), text="20 s"),
    ),
    (Rule("drift", None, Missing(OPEN, "No night has run", "Run one")),) * 2,
)
VERDICT = Verdict(
    "temperature", FAILED, "Fail.", "First failed rule: settling.", "It never settles.", "", "settling", None,
    rules=RULES, subject="pi",
)  # fmt: skip


def test_what_is_written_is_read_again(tmp_path):
    write({"temperature": VERDICT}, tmp_path)
    assert read(tmp_path) == {"temperature": VERDICT}


def test_equal_verdicts_are_equal_bytes(tmp_path):
    write({"temperature": VERDICT}, tmp_path / "a")
    write(read(tmp_path / "a"), tmp_path / "b")
    assert (tmp_path / "a/temperature.json").read_bytes() == (tmp_path / "b/temperature.json").read_bytes()


def test_a_loop_without_a_file_has_no_verdict(tmp_path):
    assert read(tmp_path) == {}
