"""Digits of a row tell figures apart as the raw figures do: none reads alike whose bands do not meet, and
none stands the other way round."""

from itertools import combinations

import numpy as np
import pytest

from pipeline.verdict.digits import THIN
from pipeline.verdict.verdict import Figure, Question
from pipeline.verdict.wording import places_of, worded

ROW = Question(0, "settled_error", "Settled error", "°C", 0.5, False, "")


def printed(figures):
    places = places_of(ROW, figures)
    return [worded(ROW, figure.value, places).replace(THIN, " ") for figure in figures]


def test_figures_of_the_study_read_as_they_are():
    """1.53 and 2.48 were once printed "2" and "2", with 1.85 between them as the best."""
    raw = [Figure(1.53, 1.5, 1.56), Figure(2.48, 2.4, 2.56), Figure(1.85, 1.8, 1.9)]
    assert printed(raw) == ["1.53 °C", "2.48 °C", "1.85 °C"]
    assert printed([Figure(0.0262, 0.0253, 0.0267), Figure(0.0298, 0.0284, 0.0311)]) == [
        "0.026 °C",
        "0.030 °C",
    ]
    assert printed([Figure(31.0, 28.0, 36.0), Figure(66.0, 61.0, 69.0)]) == ["31 °C", "66 °C"]
    # a figure off the scale sets no digits
    assert printed([Figure(np.inf, np.inf, np.inf), Figure(3.25, 3.2, 3.3)])[1] == "3.25 °C"


@pytest.mark.parametrize("seed", range(200))
def test_no_row_ties_or_turns_round_what_its_bands_keep_apart(seed):
    random = np.random.default_rng(seed)
    values = 10 ** random.uniform(-3, 2.5, 4) * np.where(random.random(4) < 0.5, 1.0, 1.0 + 1e-3)
    values[1] = values[0] * (1 + 10 ** random.uniform(-4, 0))
    widths = values * 10 ** random.uniform(-6, -0.3, 4)
    figures = [Figure(v, v - w, v + w) for v, w in zip(values, widths, strict=True)]
    read = [float(text.split()[0].replace(",", "")) for text in printed(figures)]
    for (a, x), (b, y) in combinations(zip(figures, read, strict=True), 2):
        assert (x - y) * (a.value - b.value) >= 0
        if min(a.high, b.high) < max(a.low, b.low) and abs(a.value - b.value) > 2e-6:
            assert x != y, (a, b)
