"""Model-based against data-driven in the deposition loop: who is better, by what ratio, what would tell."""

import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.store import params
from pipeline.verdict.deposition import data_driven, pair_sentence, structures
from pipeline.verdict.evidence import Evidence
from pipeline.verdict.settings import ReportRules
from pipeline.verdict.verdict import Missing

GAP = Missing("not measured", "")
LIMITS = params.load(ReportRules, "report", Path(__file__).parents[2] / "params.yaml")


def evidence(streams, prints=GAP, source="simulated"):
    """`streams` {part: {composer: error}}; every composer on one material."""
    rows = [(part, name, error) for part, of in streams.items() for name, error in of.items()]
    scores = {
        "part": np.array([part for part, _, _ in rows], object),
        "material": np.full(len(rows), "A", object),
        "composer": np.array([name for _, name, _ in rows], object),
        "chosen": np.array([name == "basis" for _, name, _ in rows]),
        "rms_percent_of_on_off": np.array([error for _, _, error in rows]),
        "predicted_percent": np.full(len(rows), np.nan),
        "worst_line_volume_percent": np.full(len(rows), 1.0),
    }
    tables = {"scores": scores, "conformance": GAP, "prints": prints}
    return Evidence({"train_ilc": {}}, tables, None, LIMITS, {"train_ilc": {"source": source}})


def errors(basis, priority, superposition):
    return {"on_off": 100.0, "priority": priority, "superposition": superposition, "basis": basis, "ilc": 1.0}


def test_the_better_rule_of_the_library_answers_for_what_learned_from_data():
    parts = structures(evidence({"a": errors(2.0, 90.0, 30.0), "b": errors(1.0, 2.0, 2.0)}))
    assert data_driven(parts) == "superposition"
    assert data_driven(structures(evidence({"a": errors(2.0, 3.0, 3.0)}))) == "priority"


def test_the_ratio_of_errors_and_its_interval_are_those_of_the_logarithms_by_hand():
    streams = {"a": errors(1.0, 90.0, 2.0), "b": errors(1.0, 90.0, 4.0), "c": errors(1.0, 90.0, 8.0)}
    found = pair_sentence(evidence(streams))
    # ratios 1/2, 1/4, 1/8: mean of logs -ln 4, sd ln 2; Student's t of 2 at 90 %: 2.920
    half = 2.919986 * math.log(2) / math.sqrt(3)
    low, high = 0.25 * math.exp(-half), 0.25 * math.exp(half)
    assert found.winner == "basis"
    assert (
        "the basis functions leave 0.25 of the flow error that the library by superposition leaves"
        in found.text
    )
    assert f"{low:.2f}–{high:.2f}" in found.text and "three streams" in found.text


def test_the_library_may_win():
    streams = {"a": errors(2.0, 1.0, 1.0), "b": errors(2.2, 1.0, 1.0), "c": errors(1.8, 1.0, 1.0)}
    found = pair_sentence(evidence(streams))
    assert found.winner == "priority" and "the library by its priority rule leaves 0.50" in found.text


def test_streams_that_disagree_are_undecided_and_the_number_that_would_tell_is_said():
    found = pair_sentence(evidence({"a": errors(2.0, 9.0, 1.0), "b": errors(1.0, 9.0, 2.4)}))
    assert found.winner is None and "undecided between" in found.text
    # mean of logs (ln 2 - ln 2.4) / 2, half width 6.314 * (ln 4.8 / 2): (half / mean)^2 - 1 times two streams
    mean, half = (math.log(2) - math.log(2.4)) / 2, 6.313752 * math.log(4.8) / 2
    assert f"about {math.ceil(2 * ((half / mean) ** 2 - 1)):,} more streams would tell" in found.text


def test_composers_that_are_equal_are_undecided_and_no_number_of_streams_would_tell():
    found = pair_sentence(evidence({"a": errors(2.0, 2.0, 2.0), "b": errors(3.0, 3.0, 3.0)}))
    assert found.winner is None and "no number of streams would tell" in found.text


@pytest.mark.parametrize("streams", [{}, {"a": errors(1.0, 2.0, 2.0)}])
def test_less_than_two_streams_tell_nothing(streams):
    assert pair_sentence(evidence(streams)).winner is None


def test_forecasts_of_a_real_machine_name_no_winner():
    found = pair_sentence(evidence({"a": errors(1, 9, 9), "b": errors(1, 9, 9)}, source="recordings"))
    assert found.winner is None and "forecasts cannot tell" in found.text


def spent(rows):
    part, composer, prints, error = zip(*rows, strict=True)
    return {
        "part": np.array(part, object), "material": np.full(len(rows), "A", object),
        "composer": np.array(composer, object), "prints": np.array(prints),
        "rms_percent_of_on_off": np.array(error),
    }  # fmt: skip


def test_when_the_answer_turns_is_said_and_from_which_print_of_a_part_learning_it_is_as_good():
    of_each = [
        row
        for part in "ab"
        for row in [
            (part, "basis", 8, 6.0), (part, "superposition", 8, 5.0),
            (part, "basis", 16, 1.0), (part, "superposition", 16, 3.0),
            (part, "ilc", 1, 9.0), (part, "ilc", 2, 1.05), (part, "ilc", 3, 1.09 if part == "a" else 1.2),
        ]
    ]  # fmt: skip
    streams = {"a": errors(1.0, 9.0, 3.0), "b": errors(1.0, 9.0, 3.3), "c": errors(1.0, 9.0, 3.1)}
    note = pair_sentence(evidence(streams, spent(of_each))).note
    assert note == (
        "Up to 8 prints of a material the other is better. Learning the part itself (data-driven) comes "
        "within a tenth of that on 1 of 2 streams, after 2 prints of it."
    )
