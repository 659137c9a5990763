"""Decimals follow the band; signs, units and words as the design has them."""

import math

import pytest

from pipeline.verdict.digits import (
    band,
    count,
    decimals,
    declared,
    number,
    percent,
    quantity,
    short,
    shortened,
    typeset,
    with_unit,
)


@pytest.mark.parametrize(
    ("low", "high", "value", "places"),
    [
        (0.31, 0.58, 0.42, 2),
        (0.61, 0.84, 0.72, 2),
        (4.8, 7.9, 6.1, 1),
        (8.0, 30.0, 9.0, 0),
        (0.0064, 0.0126, 0.0121, 3),
        (109.9, 110.05, 110.0, 0),
        (0.0035, 0.27, 0.0049, 3),
        (5.0, 5.0, 5.0, 0),
        (0.4, 0.4, 0.4, 3),
        (5.0, math.inf, 6.5, 2),
    ],
)
def test_decimals_follow_the_width_of_the_band(low, high, value, places):
    assert decimals(low, high, value=value) == places


def test_a_number_has_a_true_minus_thousands_and_no_negative_nothing():
    assert (number(-1234.5, 1), number(-0.04, 1), number(2000, 0)) == ("\u22121,234.5", "0.0", "2,000")


def test_a_quantity_has_a_narrow_space_before_its_unit_and_words_for_what_never_comes():
    assert quantity(0.724, "°C", 2) == "0.72\u202f°C"
    assert quantity(math.inf, "s", 2) == "never"


def test_a_figure_beyond_all_meaning_is_a_word_and_a_declared_limit_is_not():
    assert quantity(6.4e20, "%", 0) == percent(6.4e20) == quantity(math.inf, "%", 0) == "beyond 1,000\u202f%"
    assert quantity(-9e15, "%", 1) == "below \u22121,000\u202f%"
    assert quantity(1000.0, "%", 0) == with_unit(1000.0, "%", 0) == "1,000\u202f%"
    assert with_unit(5000.0, "%", 0) == "5,000\u202f%" and quantity(5000.0, "s", 0) == "5,000\u202fs"
    assert band(980.0, 4e12, 0, unit="%") == "980 to beyond 1,000\u202f%"
    assert band(7e12, 8e12, 0, unit="%") == ""


def test_a_band_has_an_en_dash_and_to_where_an_end_is_negative_or_in_words():
    assert band(0.61, 0.84, 2) == "0.61\u20130.84"
    assert band(-2.0, 3.0, 0) == "\u22122 to 3"
    assert band(5.0, math.inf, 0) == "5 to never"
    assert band(25.01, 25.02, 0) == ""


def test_numbers_without_a_band_keep_three_digits_from_tiny_to_large():
    assert [short(v) for v in (0.00123, 45.67, 183362.49, 3.1e-8, 0.0)] == [
        "0.00123",
        "45.7",
        "183,362",
        "3.10 × 10⁻⁸",
        "0",
    ]


def test_counts_and_long_names():
    assert (count(1, "run"), count(24, "run"), count(0, "candidate")) == (
        "one run",
        "24 runs",
        "no candidates",
    )
    assert len(shortened("x" * 200)) == 60
    assert shortened("a" * 30 + "b" * 60).startswith("a" * 29 + "…")


def test_a_line_of_a_log_is_set_as_a_page_has_it_and_names_stay():
    text = "night-0005, 2030-01-09: gain -15.1 % (-16.0 to -0.2 %), offset -2.0 °C; shift_-1.csv, a-b"
    thin = "\u202f"
    assert typeset(text) == (
        f"night-0005, 2030-01-09: gain −15.1{thin}% (−16.0 to −0.2{thin}%), "
        f"offset −2.0{thin}°C; shift_-1.csv, a-b"
    )


@pytest.mark.parametrize(
    ("limit", "text"),
    [(60.0, "60"), (0.5, "0.5"), (0.00025, "0.00025"), (577.382821858, "577"), (1 / 30, "0.0333"), (0, "0")],
)
def test_a_limit_has_the_digits_that_somebody_wrote_and_a_measured_one_has_three(limit, text):
    assert number(limit, declared(limit)) == text
