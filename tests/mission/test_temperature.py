"""From probing to the verdict: on the study's simulated machine, on a record with a declared disturbance, and
the next experiment on the machine that was identified."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas
import pytest

from tests.foreign import hot_end
from tests.mission.toy_temperature import (  # noqa: F401  hot_end_project and hot_end_record are fixtures
    HOT_END,
    LIMITS,
    TOY,
    Refused,
    accept_recording,
    begin,
    declare,
    declared,
    hot_end_project,
    hot_end_record,
    play,
    stages_between,
)

pytestmark = pytest.mark.xdist_group("toy_temperature")


def metrics(folder: Path, stage: str) -> dict:
    return json.loads((folder / "datasets" / stage / "figures.json").read_text(encoding="utf-8"))


# ---- the study's machine


@pytest.fixture(scope="session")
def simulated_project(made_once) -> Path:
    """The study's machine, probed in simulation, up to the page."""

    def make(folder: Path) -> None:
        declare(begin(folder), TOY | {"generate_probing.samples": 3000})
        play(folder, *stages_between("probe_machine", "report"))

    return made_once("study_machine", make)


@pytest.mark.full
def test_probing_leads_over_identification_kernel_and_tuning_to_a_verdict(simulated_project):
    fits = metrics(simulated_project, "identify_plant")["fit_holdout"]
    # percent of the part that was left out; sensor_3 hardly moves beside its noise of 0.1 °C
    assert len(fits) == 5 and np.median(list(fits.values())) >= 90.0 and min(fits.values()) >= 70.0
    assert metrics(simulated_project, "learn_kernel")["refused"] is None
    contestants = metrics(simulated_project, "evaluate_temperature")["contestants"]
    # model-based, data-driven and baseline are judged side by side, and doing nothing settles nothing
    assert {"subspace_lqg", "varx_riccati", "pi", "hold"} <= set(contestants)
    settled = {name: figures["settled_error"]["median"] for name, figures in contestants.items()}
    assert settled["subspace_lqg"] <= 0.5 < settled["hold"]
    verdict = metrics(simulated_project, "report")["verdicts"]["temperature"]
    assert verdict["decision"] and verdict["reason"]
    page = (simulated_project / "reports/temperature.html").read_text(encoding="utf-8")
    assert verdict["decision"] in page


@pytest.mark.full
def test_a_simulated_machine_is_never_said_to_be_ready(simulated_project):
    assert metrics(simulated_project, "report")["verdicts"]["temperature"]["rehearsal"] is True


# ---- a declared disturbance

FAN = "fan"


@pytest.fixture(scope="session")
def disturbed_project(made_once) -> Path:
    """The hot end's record with its part fan, declared under plant.disturbances, up to the judged
    controllers."""

    def make(folder: Path) -> None:
        begin(folder)
        recorded = hot_end.record(np.random.default_rng(2), fan=True)
        hot_end.write_csv(folder / "datasets/raw/temperature/log.csv", recorded, fan=True)
        heater, output = HOT_END
        mapped = {"scale": 1.0, "offset": 0.0}
        declare(
            folder,
            TOY
            | {
                "generate_probing.source": "recordings",
                "plant.inputs": [{"name": heater, "unit": "percent", "low": 0, "high": 100, "heats": True}],
                "plant.outputs": [{"name": output, "unit": "degC", **LIMITS}],
                "ingest.mapping": {
                    heater: {"source": "heater_pct", "unit": "percent", **mapped},
                    FAN: {"source": "fan_pct", "unit": "percent", **mapped},
                    output: {"source": "hotend_C", "unit": "degC", **mapped},
                },
            },
        )
        declare_disturbance(folder)
        play(folder, *stages_between("ingest", "evaluate_temperature"))

    return made_once("disturbed", make)


def declare_disturbance(folder: Path) -> None:
    """params.yaml names no disturbances as shipped, so the key is new in the section."""
    declare(
        folder, {"plant": declared(folder, "plant") | {"disturbances": [{"name": FAN, "unit": "percent"}]}}
    )


def test_a_record_with_a_declared_disturbance_is_identified_and_judged(disturbed_project):
    (fit,) = metrics(disturbed_project, "identify_plant")["fit_holdout"].values()
    assert fit >= 85.0
    contestants = metrics(disturbed_project, "evaluate_temperature")["contestants"]
    assert contestants["subspace_lqg"]["settled_error"]["median"] <= 0.5


def test_a_record_with_a_declared_disturbance_leads_to_a_file_or_to_the_rule_that_fails(
    disturbed_project, tmp_path
):
    folder = shutil.copytree(disturbed_project, tmp_path / "copy", symlinks=True)
    play(folder, *stages_between("evaluate_temperature", "export_controllers")[1:])
    told = json.loads((folder / "datasets/export_controllers/exported.json").read_text(encoding="utf-8"))
    assert told["temperature"]["files"] or told["temperature"]["why"]


def fan_dip_degC(folder: Path, name: str, *, told: bool) -> float:
    """The largest error of the true temperature after the fan's step from 0 to 100 %, under an exported
    controller on the machine of the record."""
    made: dict = {"__name__": "exported"}
    code = (folder / "datasets/certify/temperature" / name / "python/controller.py").read_text(
        encoding="utf-8"
    )
    exec(compile(code, "controller.py", "exec"), made)
    machine, dt = hot_end.HotEnd(np.random.default_rng(5)), made["SAMPLE_TIME_S"]
    running = made["controller"](
        plant_sha256=made["PLANT_SHA256"],
        sample_time_s=dt,
        input_unit="percent",
        output_unit="degC",
        rehearsal=made["SIMULATED"],
    )
    r, begins, errors = np.array([LIMITS["reference"]]), 1200.0, []
    for k in range(int(1800 / dt)):
        fan = 100.0 if k * dt >= begins else 0.0
        running.tell([fan if told else np.nan])
        y, u = np.array([machine.read()]), np.zeros(1)
        if k < 20:
            running.watch(u, y, r)
        else:
            if k == 20:
                running.hand_over(y)
            u = running.step(y, r, k * dt).u
        if k * dt >= begins:
            errors.append(abs(machine.block - r[0]))
        machine.advance(float(u[0]), fan, dt)
    return max(errors)


@pytest.mark.full
def test_a_fan_that_is_told_is_made_up_for_on_the_machine(disturbed_project, tmp_path):
    folder = shutil.copytree(disturbed_project, tmp_path / "copy", symlinks=True)
    learned = metrics(folder, "learn_kernel")["forward"][FAN]["heater_1"]
    assert learned["fed_forward"] and learned["gain"] > 5 * learned["deviation"]
    play(folder, "certify")
    for name in ("pi", "subspace_lqg", "varx_riccati"):
        assert fan_dip_degC(folder, name, told=True) < 0.5 * fan_dip_degC(folder, name, told=False)


# ---- the next experiment

TIGHT_DEGC = 235.0  # so near that the experiment must heed it


@pytest.fixture
def next_experiment(hot_end_project, tmp_path) -> pandas.DataFrame:  # noqa: F811
    folder = shutil.copytree(hot_end_project, tmp_path / "copy", symlinks=True)
    (output,) = declared(folder, "plant")["outputs"]
    declare(folder, {"plant.outputs": [output | {"high": TIGHT_DEGC}]})
    play(folder, "generate_probing")
    return pandas.read_csv(folder / "datasets/generate_probing/next_experiment.csv")


def test_the_next_experiment_on_the_identified_machine_stays_inside_its_limits(
    next_experiment,
    hot_end_record,  # noqa: F811
):
    machine = hot_end.HotEnd(np.random.default_rng(1))
    for duty in hot_end_record.duty_percent:  # the machine as the record leaves it
        machine.advance(duty, 0.0, 1.0)
    duty = next_experiment["heater_1"].to_numpy()
    assert 0 <= duty.min() and duty.max() <= 100 and duty.std() >= 1.0
    measured = np.empty(len(duty))
    for t, percent in enumerate(duty):
        machine.advance(percent, 0.0, 1.0)
        measured[t] = machine.read()
    assert LIMITS["low"] <= measured.min() and measured.max() <= TIGHT_DEGC
    assert np.ptp(measured[len(measured) // 2 :]) >= 5.0  # °C that teach something
