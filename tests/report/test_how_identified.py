"""What the identification's page says of how the record was taken, of gains that physics forbids, of fits
with a free mean, and of first-order models with their PID."""

import re
from pathlib import Path

import numpy as np
import yaml

from pipeline.store import artifacts, params
from pipeline.temperature import tables
from tests.report import made
from tests.report.made import main
from tests.report.test_identification_page import FOLDER, page, rewrite, white
from tests.report.test_pages import IDENTIFICATION, TEMPERATURE, Page, change

COOLS = {
    "output": "zone_1",
    "input": "heater_2",
    "gain": -0.5,
    "low": -0.8,
    "high": -0.2,
    "certain": True,
    "reason": "a heater that cools",
}
CLOSED = {"closed": True, "level": 0.00025, "p_value": {"heater_1": 1e-12, "heater_2": 0.3}}


def heating():
    """Both inputs of the made machine are declared to heat."""
    sections = params.read("params.yaml")
    for signal in sections["plant"]["inputs"]:
        signal["heats"] = True
    Path("params.yaml").write_text(yaml.safe_dump(sections))


# ---- open or closed loop


def test_where_no_feedback_is_recognised_it_is_said_with_the_input_that_comes_nearest_to_feedback(project):
    text = page()
    assert (
        "No feedback was recognised. No input responds detectably to past errors of the outputs: "
        "least p = 0.030, heater_2; feedback is called below 0.00025." in text
    )
    assert "The fit in simulation flatters." not in text


def test_a_closed_loop_is_said_on_the_first_screen_and_names_who_answers_and_how_it_was_identified(project):
    change("identify_plant", closed_loop=CLOSED)
    text = page()
    verdict = text[: text.index("What to do")]
    assert "Recorded in closed loop. The fit in simulation flatters." in verdict
    assert "heater_1 answers past errors of the outputs (p below 0.000001), as a controller does." in text
    assert "identified in predictor form (PBSID), which feedback does not bias" in text
    assert "and predicted one step ahead" in text  # the rule of the order


def test_a_closed_loop_fitted_to_simulated_outputs_is_advised_against(project):
    change("identify_plant", closed_loop=CLOSED, fit="simulation")
    assert "which feedback biases: set it to validated." in page()


def test_in_closed_loop_an_error_at_lag_zero_is_the_controllers_and_takes_no_use_away(project):
    white()
    change("identify_plant", closed_loop=CLOSED)
    table = artifacts.read_table(FOLDER / "residuals.parquet", tables.RESIDUALS)
    other = (table["output"] == "zone_1") & (table["against"] == "heater_2")
    rewrite("residuals", tables.RESIDUALS, passed=~(other & (table["lag"] == 0)))
    assert "Trust this model to design controllers" in page()


def test_a_noise_free_record_and_a_test_that_was_not_made_are_told_apart(project):
    change("identify_plant", closed_loop={"closed": False, "level": 0.00025, "p_value": {}})
    assert "Not applicable. the record is noise-free" in page()
    change("identify_plant", closed_loop=None)
    assert "Not measured. the test for feedback is not among what the stage measured." in page()


# ---- gains that physics forbids


def test_a_heater_that_cools_takes_design_away_with_its_band_and_is_said_on_the_loops_page(project):
    white()
    heating()
    change("identify_plant", forbidden_gains=[COOLS])
    text = page()
    sentence = (
        "One gain is flagged: heater_2 on zone_1, −0.5 (−0.8 to −0.2) °C per %, is a heater that cools."
    )
    assert (
        f"First failed rule: gains possible. {sentence} Design no controller from this model before" in text
    )
    assert "Trust this model to predict 10 s ahead and to simulate, not to design controllers." in text
    assert "zone_1 heater_2 −0.5 −0.8 to −0.2 the whole band a heater that cools" in text
    temperature = Page(TEMPERATURE).text
    assert f"The controllers are designed from a model that physics forbids. {sentence}" in temperature


def test_a_gain_whose_band_reaches_what_is_possible_is_a_reservation_and_takes_no_use_away(project):
    white()
    heating()
    change("identify_plant", forbidden_gains=[COOLS | {"high": 0.1, "certain": False}])
    text = page()
    assert "Trust this model to design controllers, to predict 10 s ahead and to simulate." in text
    assert "One reservation, the first undecided rule: gains possible." in text
    assert "would be a heater that cools" in text and "the value, not the whole band" in text
    assert "before a controller relies on it." in text and "Design no controller" not in text
    assert "designed from a model that physics may forbid." in Page(TEMPERATURE).text


def test_heaters_that_heat_pass_an_eighth_rule_and_no_finding_is_made_of_it(project):
    white()
    heating()
    text = page()
    assert "All eight rules passed" in text
    assert "None: every effect of heater_1 and heater_2 is one that a heater can have." in text
    assert "that physics forbids" not in Page(TEMPERATURE).text


def test_where_no_input_is_declared_to_heat_the_page_says_what_to_set(project):
    text = page()
    assert "no input is declared to heat, so no sign is known to be wrong. Set heats: true" in text


# ---- choices and fits


def test_window_feed_through_refinement_and_validation_stand_with_the_order(project):
    change("identify_plant", feedthrough__zone_2=True, validation="recordings")
    text = page()
    assert "Past horizon five samples, 5 s" in text
    assert "Direct feed-through zone_2, 1 of two outputs" in text
    assert "Refinement to the least errors one step ahead" in text
    assert "Validation one recording left out in turn" in text
    assert "each is identified with one recording left out in turn and simulated on it" in text


def test_a_free_mean_that_gains_more_than_the_bands_is_named_with_its_points(project):
    assert "A free mean gains nothing beyond noise" in page()
    change(
        "identify_plant", fit_holdout_free_mean__zone_2=92.0, fit_holdout_free_mean_band__zone_2=[90.0, 93.0]
    )
    text = page()
    assert "A free mean gains 12.0 points in zone_2: the level moved up to the hold-out" in text
    assert re.search(r"zone_2 80 % 75–84 92 % 90–93 12.0 points 91 % 89–92 no", text)


def test_figures_of_an_older_run_leave_the_page_whole_and_say_what_is_not_measured(project):
    for key in ("fit_holdout_free_mean", "feedthrough", "validation", "fit", "forbidden_gains"):
        change("identify_plant", **{key: None})
    artifacts.write_json("datasets/ingest/printer_pid.json", {})
    text = page()
    assert "Refinement not measured" in text and "Direct feed-through not measured" in text
    assert "The printer’s own PID" not in text


# ---- first-order models


def test_every_pair_has_its_model_with_bands_and_a_pid_in_both_forms(project):
    text = page()
    assert "Three of four pairs have a gain of known sign" in text
    # Ti = Kp / Ki = 2 / 0.2, Td = Kd / Kp = 1 / 2
    assert "zone_1 heater_1 2.0 1.5–2.5 10 9–11 1.0 0.5–1.5 2.00 0.200 Ti 10 s 1.00 Td 0.50 s" in text
    assert "zone_1 sign not known: heater_2" in text
    assert "u = Kp (e + ∫e dt / Ti + Td de/dt)" in text


def test_a_time_constant_beyond_the_step_responses_is_no_model_and_takes_the_bold_from_a_weaker_input(
    project,
):
    table = artifacts.read_table(FOLDER / "first_order.parquet", tables.FIRST_ORDER)
    slow = (table["output"] == "zone_2") & (table["input"] == "heater_1")
    rewrite(
        "first_order",
        tables.FIRST_ORDER,
        time_constant_s=np.where(slow, 500.0, table["time_constant_s"]),
        gain=np.where(slow, 90.0, table["gain"]),
    )
    assert "zone_2 not settled within 40.0 s: heater_1" in page()
    html = IDENTIFICATION.read_text()
    # zone_1's one input; zone_2's strongest does not settle
    assert re.findall(r'<span class="b best"><bdi>(.*?)</bdi>', html) == ["heater_1"]


def test_the_printers_own_pid_stands_beside_in_percent_and_as_its_configuration_has_it(project):
    text = page()
    # 2.55 times the gains in percent
    assert "heater_1 to zone_1 the printer’s own 8.00 0.400 40.0 20.4 1.02 102" in text
    assert "heater_1 to zone_1 SIMC, from this record 2.00 0.200 1.00 5.10 0.510 2.55" in text
    assert "smoothed over 1 s, and its duty ends at 100 %. From the configuration in klippy.log." in text


def test_the_page_of_the_loop_says_whether_the_printers_own_pid_was_judged(project, monkeypatch):
    change("evaluate_temperature", refused={"printer_pid": "found those of 1 heaters in the log"})
    main()
    text = Page(TEMPERATURE).text
    assert "The printer’s own PID is not among these contestants." in text
    assert "It was refused: found those of 1 heaters in the log." in text
    assert "The printer holds heater_1 by Kp 8.00, Ki 0.400, Kd 40.0, in % of duty, °C and s." in text
    monkeypatch.setattr(made, "CONTESTANTS", (*made.CONTESTANTS, "printer_pid"))
    made.write(project)
    main()
    text = Page(TEMPERATURE).text
    assert "The printer’s own PID is among these contestants, as it is." in text
    words = Page(Path("reports/words.html")).text
    assert "The printer’s own PID. Klipper’s PID with the gains of the printer’s configuration" in words


def test_a_machine_without_a_printers_log_shows_nothing_of_its_pid(project):
    artifacts.write_json("datasets/ingest/printer_pid.json", {})
    main()
    for path in (TEMPERATURE, IDENTIFICATION):
        assert "own PID" not in Page(path).text, path


def test_a_page_from_recordings_does_not_call_their_units_a_convention(project):
    main()
    assert "read seconds as steps" in Page(TEMPERATURE).text
    sections = params.read("params.yaml")
    sections["generate_probing"]["source"] = "recordings"
    for output in sections["plant"]["outputs"]:
        output |= {"low": 0, "high": 300}
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    main()
    assert "read seconds as steps" not in Page(TEMPERATURE).text


def test_the_printers_own_pid_stays_where_the_models_are_missing(project):
    (FOLDER / "first_order.parquet").unlink()
    text = page()
    assert "the printer’s own 8.00 0.400 40.0" in text and "SIMC, from this record none none none" in text


def test_a_table_of_disturbances_is_no_broken_record(project):
    sections = params.read("params.yaml")
    sections["plant"]["disturbances"] = [{"name": "room", "unit": "degC"}]
    Path("params.yaml").write_text(yaml.safe_dump(sections))
    record = Path("datasets/ingest/record.parquet")
    machine = params.read("params.yaml")["plant"]
    schema = tables.record(*[[_signal(s) for s in part] for part in _roles(machine)])
    old = tables.record(*[[_signal(s) for s in machine[key]] for key in ("inputs", "outputs")])
    table = artifacts.read_table(record, old)
    more = {"room": np.full(len(table["time_s"]), 20.0), "room_masked": np.zeros(len(table["time_s"]), bool)}
    artifacts.write_table(record, schema, table | more)
    main()
    assert "Measured disturbances room" in Page(IDENTIFICATION).text
    assert "record.parquet: expected" not in Page(IDENTIFICATION).text


def _roles(machine):
    return [*machine["inputs"], *machine["disturbances"]], machine["outputs"]


def _signal(entry):
    return type("Signal", (), entry)


def test_a_page_with_a_closed_loop_and_flagged_gains_does_not_overflow_a_phone(project, open_page):
    heating()
    change("identify_plant", closed_loop=CLOSED, forbidden_gains=[COOLS, COOLS | {"output": "zone_2"}])
    main()
    narrow = open_page("identification", folder=project / "reports", width=390)
    assert narrow.evaluate("document.documentElement.scrollWidth") == 390
