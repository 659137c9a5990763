"""The identification's page on the small project: what it says the model may be used
for, in each case, and what it shows behind it."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.report.identification import pictures
from pipeline.report.identification.page import since
from pipeline.report.shared import charts
from pipeline.store import artifacts, params
from pipeline.temperature import tables
from pipeline.temperature.settings import Plant
from pipeline.verdict.verdict import Figure
from tests.report import made
from tests.report.made import main
from tests.report.test_pages import IDENTIFICATION, TEMPERATURE, Page, change, figures

FOLDER = Path("datasets/identify_plant")


def page():
    main()
    return Page(IDENTIFICATION).text


def rewrite(name, schema, **columns):
    """A table of the identification with some columns changed."""
    table = artifacts.read_table(FOLDER / f"{name}.parquet", schema)
    artifacts.write_table(FOLDER / f"{name}.parquet", schema, table | columns)


def white():
    """The made model without its one flaw."""
    table = artifacts.read_table(FOLDER / "residuals.parquet", tables.RESIDUALS)
    rewrite("residuals", tables.RESIDUALS, passed=np.ones(len(table["passed"]), bool))


# ---- the verdict


def test_a_model_that_passes_every_rule_is_trusted_for_every_use_with_its_weakest_figure(project):
    white()
    text = page()
    assert "Trust this model to design controllers, to predict 10 s ahead and to simulate." in text
    assert "All seven rules passed; weakest in simulation: zone_2, 80 % (at least 50 %)." in text
    assert 'class="verdict passed"' in IDENTIFICATION.read_text()


def test_errors_that_are_not_noise_are_a_reservation_and_take_no_use_away(project):
    text = page()
    assert "Trust this model to design controllers, to predict 10 s ahead and to simulate." in text
    assert (
        "One reservation, the first failed rule: whiteness. The one-step errors of zone_2 are not noise: "
        "correlation +0.42 at lag 1" in text
    )
    assert "zone_2 errors not noise" in text and "zone_1 errors are noise" in text


def test_a_failed_simulation_takes_only_simulation_away_and_marks_the_page_and_the_row(project):
    white()
    change("identify_plant", fit_holdout__zone_2=42.0, fit_holdout_band__zone_2=[38.0, 47.0])
    text = page()
    assert "Trust this model to design controllers and to predict 10 s ahead, not to simulate." in text
    assert (
        "First failed rule: simulation. zone_2 is simulated with a fit of 42 % (38–47); "
        "the rule asks for 50 %" in text
    )
    html = IDENTIFICATION.read_text()
    assert 'class="verdict failed"' in html
    # its row among the outputs, and the rule's
    assert len(re.findall(r'<tr[^>]* class="fail"', html)) == 2


def test_a_band_that_straddles_the_limit_is_undecided_and_says_how_much_longer_a_hold_out_would_decide(
    project,
):
    white()
    change("identify_plant", fit_holdout__zone_2=60.0, fit_holdout_band__zone_2=[45.0, 68.0])
    text = page()
    assert "not yet to simulate." in text
    # the band reaches 15 points below 60, the limit lies 10 below: (15 / 10)^2 = 2.25 times as long
    assert (
        "First undecided rule: simulation." in text and "A hold-out three times as long would decide." in text
    )


def test_a_prediction_that_holding_the_last_value_beats_is_not_trusted_whatever_its_fit(project):
    white()
    change("identify_plant", fit_holdout_held__zone_1=97.0)
    text = page()
    assert "Trust this model to simulate, not to design controllers and to predict 10 s ahead." in text
    assert (
        "zone_1 is predicted 10 s ahead with a fit of 95 % (94–96); holding its last value gives 97 %" in text
    )


@pytest.mark.parametrize(
    ("how", "rule", "said"),
    [
        (
            "input left",
            "inputs used up",
            "The errors of zone_1 still follow heater_2: correlation +0.02 at lag 5, "
            "0.20 times its 99 % band.",
        ),
        (
            "poor input",
            "excitation",
            "The inputs move in 9 of 10 directions over the window. Too poor on its own: heater_1.",
        ),
        ("blind input", "effects known", "What heater_2 does is not known, not even in sign"),
        ("unstable", "stability", "The largest pole, 1.0010, is not inside the unit circle"),
    ],
)
def test_each_rule_that_design_needs_takes_it_away_and_is_named(project, how, rule, said):
    white()
    if how == "input left":
        table = artifacts.read_table(FOLDER / "residuals.parquet", tables.RESIDUALS)
        rewrite(
            "residuals",
            tables.RESIDUALS,
            passed=~((table["output"] == "zone_1") & (table["against"] == "heater_2")),
        )
    elif how == "poor input":
        change("identify_plant", excitation__rank=9, excitation__inputs__heater_1__rank=4)
    elif how == "blind input":
        table = artifacts.read_table(FOLDER / "dynamics.parquet", tables.DYNAMICS)
        rewrite("dynamics", tables.DYNAMICS, seen=table["input"] == "heater_1")
    else:
        change("identify_plant", largest_pole=1.001)
    text = page()
    assert f"First failed rule: {rule}. {said}" in text
    assert re.search(r"Trust this model to predict 10 s ahead[^.]*, not to design controllers", text)


def test_a_model_that_fails_everywhere_is_marked_on_every_page(project):
    change(
        "identify_plant",
        fit_holdout={"zone_1": 10.0, "zone_2": 5.0},
        fit_holdout_ahead={"zone_1": 1.0, "zone_2": 2.0},
    )
    change("identify_plant", fit_holdout_band=None, fit_holdout_ahead_band=None)
    assert "Do not trust this model." in page()
    assert '<a href="identification.html">Do not trust this model.</a>' in TEMPERATURE.read_text()


def test_a_hold_out_too_short_to_predict_over_leaves_that_open_and_keeps_the_rest(project):
    change("identify_plant", fit_holdout_ahead=None, fit_holdout_ahead_band=None, fit_holdout_held=None)
    text = page()
    assert "Trust this model to simulate, not yet to design controllers and to predict 10 s ahead." in text
    assert (
        "First undecided rule: 10 s ahead. "
        "no stretch of the hold-out outlasts the start-up of the prediction. "
        "Record longer, or lower ahead_steps." in text
    )


def test_nothing_identified_reads_as_open_never_as_passed(project):
    for path in [*FOLDER.glob("*.parquet"), Path("datasets/identify_plant/figures.json")]:
        path.unlink()
    text = page()
    assert (
        "Do not trust this model yet." in text
        and "figures.json of identify_plant is not there. Run ./run dvc repro identify_plant." in text
    )
    assert "passed" not in re.search(r"Rule State Weakest(.*?)Fits on the hold-out", text)[1]


# ---- the figures


def test_every_output_stands_beside_what_it_must_beat_and_the_accepted_run(project):
    artifacts.write_json(
        "reports/accepted.json",
        made.accepted(metrics={"identify_plant": {"fit_holdout": {"zone_1": 90.0, "zone_2": 70.0}}}),
    )
    text = page()
    # 95 and 91 % ahead against 20 and -10 % of holding the last value
    assert re.search(
        r"zone_1 .*?90\.0 % 88–91 .*?95 % 94–96 Held 20\.0 % unchanged, 90\.0 %".replace("\\.0", r"(?:\.0)?"),
        text,
    )
    assert "+10.0 points · better" in text


def test_a_change_within_both_bands_is_noise():
    now = Figure(80.0, 75.0, 84.0)
    assert since(None, now) == ("first run", False)
    assert since(Figure(80.0, 80.0, 80.0), now) == ("unchanged, 80\u202f%", False)
    assert since(Figure(78.0, 76.0, 79.5), now) == ("within noise of 78.0\u202f%", False)
    assert since(Figure(88.0, 86.0, 89.0), now) == ("−8.0 points · worse", True)


def test_masked_samples_and_the_end_of_a_stretch_are_seen_in_the_hold_out(project):
    text = page()
    assert (
        "50 samples in two stretches, the last part of each; four measured values are masked and not scored."
        in text
    )
    panel = re.search(
        r'<svg[^>]*aria-label="zone_2 on the hold-out[^>]*>.*?</svg>', IDENTIFICATION.read_text(), re.DOTALL
    )[0]
    assert panel.count('class="gone"') == 1 and panel.count('class="end"') == 1
    seen = re.search(r'<path class="line seen" d="([^"]*)"', panel)[1]
    # before the mask, after it, and the second stretch
    assert seen.count("M") == 3


def test_an_effect_whose_sign_is_not_known_has_no_time_constant(project):
    text = page()
    assert re.search(
        r"zone_1 heater_1 2\.0 \(1\.5–2\.5\)[^z]*? τ 10 s, delay 1\.0 s heater_2 −1\.0 to 2\.5[^z]*? "
        r"sign not known zone_2",
        text,
    )


def test_lags_outside_of_the_band_are_marked_only_where_the_test_failed(project):
    main()
    panels = re.findall(
        r'aria-label="(zone_\d), errors with themselves.*?</svg>', IDENTIFICATION.read_text(), re.DOTALL
    )
    assert panels == ["zone_1", "zone_2"]
    html = IDENTIFICATION.read_text()
    first, second = (
        re.search(rf'aria-label="{name}, errors with themselves.*?</svg>', html, re.DOTALL)[0]
        for name in panels
    )
    assert "stem bad" not in first and "stem bad" in second


def test_poles_are_listed_with_their_time_constants_and_those_not_found_again_are_said_so(project):
    text = page()
    # -1 / ln 0.99 = 99.5 s, and the spread's 0.989, 0.988 have 90.4 and 82.8 s
    assert "0.9900 99.5 s not found again" in text
    assert "0.9000 9.49 s" in text


@pytest.mark.parametrize(
    ("C", "rank", "samples"), [([[1.0, 0.0]], 2, 2), ([[0.0, 1.0]], 1, 1), (np.eye(2), 2, 1)]
)
def test_what_the_outputs_show_of_the_states_is_the_rank_of_the_observability_matrix(C, rank, samples):
    plant = {"A": np.array([[[0.9, 1.0], [0.0, 0.8]]]), "C": np.array([C])}
    assert pictures.states_seen(plant) == {"rank": rank, "of": 2, "samples": samples}
    assert pictures.states_seen(None) is None


def test_the_page_says_whether_the_model_is_observable(project):
    assert "The outputs show 2 of 2 states within one sample: observable." in page()


def test_advice_and_the_remedies_that_it_does_not_speak_of_stand_under_what_to_do(project):
    change("identify_plant", largest_pole=1.001, notes=["12 rows touch a masked sample"])
    text = page()
    todo = text[text.index("What to do The") :][:600]
    assert "The residuals of zone_2 are not white (correlation +0.42 at lag 1): lengthen the window" in todo
    assert (
        "Stability: Record longer" in todo and "Noted while fitting: 12 rows touch a masked sample." in todo
    )


def test_what_was_masked_is_counted_by_signal(project):
    change("ingest", findings={"zone_1": {"spike": 3}})
    text = page()
    # made.record masks samples 100 to 109 of the third signal
    assert "zone_1 400 10 (2.5 %) spike 3" in text and "heater_1 400 0 none" in text
    assert "Dead time found heater_2 three samples" in text


@pytest.mark.parametrize(
    "name", ["holdout", "residuals", "steps", "dynamics", "first_order", "poles", "levels", "order"]
)
@pytest.mark.parametrize("how", ["missing", "broken"])
def test_a_table_that_is_missing_or_broken_is_said_so_in_its_place(project, render_only, name, how):
    path = FOLDER / f"{name}.parquet"
    if how == "missing":
        path.unlink()
    else:
        path.write_bytes(b"{")
    render_only("identification")
    text = Page(IDENTIFICATION).text
    sentence = (
        f"{name}.parquet of identify_plant is not there. Run ./run dvc repro identify_plant."
        if how == "missing"
        else "is not a whole Parquet file"
    )
    assert sentence in text


def test_a_machine_of_32_inputs_and_outputs_and_a_long_hold_out_stay_within_the_size_of_a_page(project):
    sections = params.read("params.yaml")
    sections["plant"]["inputs"] = [
        {"name": f"heater_{i}", "unit": "percent", "low": 0, "high": 100} for i in range(32)
    ]
    sections["plant"]["outputs"] = [
        {"name": f"zone_{i}", "unit": "degC", "reference": 100.0} for i in range(32)
    ]
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    machine = params.load(Plant, "plant")
    rng, names = np.random.default_rng(0), [o.name for o in machine.outputs]
    samples = 100 * 300
    seen = {
        "segment": np.repeat(np.arange(100), 300).astype(np.int32),
        "time_s": np.tile(np.arange(300.0), 100),
    }
    seen |= {
        f"{name}_{kind}": rng.standard_normal(samples)
        for name in names
        for kind in ("measured", "simulated", "ahead")
    }
    artifacts.write_table(FOLDER / "holdout.parquet", tables.holdout(machine.outputs), seen)
    for name, (schema, columns) in made.model(machine).items():
        artifacts.write_table(FOLDER / f"{name}.parquet", schema, columns)
    change("identify_plant", fit_holdout=dict.fromkeys(names, 90.0), fit_holdout_band=None)
    main()
    # the limit of a page: 1.5 MB, and 20 kB for the files at its foot
    assert figures()["bytes"]["identification"] <= 1_520_000


# ---- the primitives


def test_a_thinned_line_breaks_where_samples_are_missing():
    y = np.sin(np.arange(10_000.0))
    y[4321] = np.nan
    x, kept = charts.decimated(np.arange(10_000.0), y, 100)
    assert np.isnan(kept).sum() == 1 and x[np.isnan(kept)] == 4321 and len(kept) <= 300


def test_a_balanced_axis_has_zero_and_a_round_number_on_either_side():
    assert charts.balanced(0.19).ticks == ((-0.1, "−0.1"), (0.0, "0.0"), (0.1, "0.1"))
    assert [label for _, label in charts.balanced(600.0).ticks] == ["−500", "0", "500"]


def test_ticks_of_a_quarter_of_a_thousand_have_no_decimals():
    assert [label for _, label in charts.linear(0, 1000, ticks=4).ticks] == [
        "0",
        "250",
        "500",
        "750",
        "1,000",
    ]
