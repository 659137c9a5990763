"""The temperature paper's figures to the printed digit (Zavrakli, Parnell and Dey 2023, figures 3 to 6)."""

import csv

import numpy as np
import pytest

from pipeline.papers import published
from pipeline.papers import temperature as paper
from pipeline.papers.published import IDENTITY, TUNED_DATA


@pytest.fixture(scope="module")
def start_gain(root) -> np.ndarray:
    """The authors' draw of K0 (7, 11)."""
    with (root / "datasets/published/algorithm1_K0_seed10.csv").open() as stream:
        rows = [row for row in csv.reader(stream) if row and row[0].lstrip("-")[:1].isdigit()]
    return np.array(rows, float)[:, -11:]


@pytest.mark.parametrize(
    ("column", "J100", "J1000", "error"),
    [("identity", "183362.5", "183436.2", "0.0376"), ("tuned", "76060.36", "76072.6", "0.0274")],
    ids=["figure_3", "figure_4"],
)
def test_the_model_based_figures_are_printed(start_gain, column, J100, J1000, error):
    _, script = paper.model_based(start_gain)
    figures = [script[column][name] for name in ("J100", "J1000", "error")]
    assert as_printed(figures, J100, J1000, error) == (J100, J1000, error)


def as_printed(figures, *printed: str) -> tuple[str, ...]:
    """The figures with as many places as the paper prints."""
    return tuple(
        f"{value:.{len(text.partition('.')[2])}f}" for value, text in zip(figures, printed, strict=True)
    )


@pytest.fixture(scope="module")
def kernel_data():
    """The squares of the record that the authors' script draws, on the rows that it sums."""
    u, y = paper.record(paper.SAMPLES + paper.LENGTH + 1)
    (data,) = paper.squares(u, y, (paper.SAMPLES + paper.LENGTH - paper.N,))
    return data


@pytest.mark.full
@pytest.mark.parametrize(
    ("weights", "J100", "J1000", "error"),
    [(IDENTITY, "1065077", "1074985", "1.2942"), (TUNED_DATA, "204635.7", "206358.8", "0.3154")],
    ids=["figure_5", "figure_6"],
)
def test_the_data_driven_figures_are_printed(kernel_data, weights, J100, J1000, error):
    gain, _ = paper.value_iteration(kernel_data, weights)
    run = paper.data_driven(weights[0], gain)
    figures = run.J[99], run.J[999], np.linalg.norm(run.y[99] - published.REFERENCE)
    assert as_printed(figures, J100, J1000, error) == (J100, J1000, error)
