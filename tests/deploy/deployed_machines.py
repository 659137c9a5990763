"""Controllers of small machines, and of the study's, as they leave the house, for tests of files."""

from functools import cache

import numpy as np
import scipy.linalg

from pipeline.deploy.assembly import supervision
from pipeline.deploy.certificate import RULES, VERSION, Certificate, RuleResult
from pipeline.deploy.machine import canonical, controller_sha256, plants_sha256
from pipeline.deploy.supervise import Exported, Machine, Signal
from pipeline.temperature import tracking
from pipeline.temperature.controllers import baseline, printer_pid
from pipeline.temperature.controllers.governor import OutputLimits, governor
from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Deployed,
    FeedForward,
    Governor,
    Strength,
    compact,
    deployed,
)
from pipeline.temperature.controllers.window import law as varx_law
from pipeline.temperature.controllers.window import learn, observer_form
from pipeline.temperature.plant import Plant, baam, plant
from pipeline.temperature.tracking import Law, still_law

INTEGRAL_LIMIT = 1.0
NOISE = 0.1
STRENGTH = Strength(0.85, 1.15, 0.1)
LAWS = ("lqg", "window", "pi", "printer_pid", "told", "told_pid", "hold", "slow", "tight")
PIDS, TOLD = ("printer_pid", "told_pid"), ("told", "told_pid")


def block_and_sensor(*, zones: int, sample_time_s: float = 1.0) -> Plant:
    """Zones in a row, each a block of 20 J/K that 40 W heat and that loses 0.15 W/K, with a sensor that lags
    8 s; neighbours exchange 0.1 W/K. Room 25 degC."""
    neighbours = np.diag(np.full(zones - 1, 0.1), 1) + np.diag(np.full(zones - 1, 0.1), -1)
    loss = (neighbours - np.diag(0.15 + neighbours.sum(axis=1))) / 20.0
    A = np.block([[loss, np.zeros((zones, zones))], [np.eye(zones) / 8.0, -np.eye(zones) / 8.0]])
    B = np.vstack([np.eye(zones) * 0.4 / 20.0, np.zeros((zones, zones))])
    moved = scipy.linalg.expm(sample_time_s * np.block([[A, B], [np.zeros((zones, 3 * zones))]]))[: 2 * zones]
    return plant(
        moved[:, : 2 * zones],
        moved[:, 2 * zones :],
        np.hstack([np.zeros((zones, zones)), np.eye(zones)]),
        d=np.full(zones, 25.0),
        K=np.vstack([np.eye(zones), np.eye(zones)]) * 0.1,
        sample_time_s=sample_time_s,
    )


def limits_of(zones: int, *, rate: float = np.inf) -> ActuatorLimits:
    return ActuatorLimits(np.zeros(zones), np.full(zones, 100.0), np.full(zones, rate))


def guard(model: Plant, limits: ActuatorLimits, high: float = 250.0) -> Governor:
    outputs = OutputLimits(np.zeros(model.p), np.full(model.p, high), np.full(model.p, 3 * NOISE), 0.05)
    return governor([model], limits, outputs, STRENGTH)


def _windowed(model: Plant) -> tuple[Law, Plant]:
    """VARX + Riccati of a record of the model: a memory that is a plain shift."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(5, 60, (60, model.m)), 10, axis=0)
    x, y = np.zeros(model.n), np.zeros((len(u), model.p))
    for t in range(len(u)):
        y[t] = model.C @ x + model.d + rng.normal(0, NOISE, model.p)
        x = model.A @ x + model.B @ u[t] + model.b
    learned = learn([u], [y], longest=6)
    made = varx_law(learned, np.eye(model.p), 0.1 * np.eye(model.m), 0.99, integral=0.05)
    return compact(made, learned.N), observer_form(learned)[0]


def _law(kind: str, model: Plant, limits: ActuatorLimits) -> tuple[Law, Plant]:
    if kind in ("lqg", "slow", "tight", "told", "study"):
        effort = np.full(model.m, 1e-4 if kind == "tight" else 0.1)
        return tracking.model_based(model, np.ones(model.p), effort, 0.05, gamma=0.99, tau=1.0), model
    if kind == "window":
        return _windowed(model)
    if kind == "pi":
        return _pi(model, limits), model
    if kind in PIDS:
        pids = tuple(printer_pid.HeaterPid(i, i, 3.0, 0.05, 8.0, 100.0, 1.0) for i in range(model.m))
        return printer_pid.law(pids, sample_time_s=model.sample_time_s), model
    return still_law(model.m, model.p), model


def _pi(model: Plant, limits: ActuatorLimits) -> Law:
    pairs = baseline.pairing(model, limits.low, limits.high, horizon=300)
    return baseline.pi_law(pairs, inputs=model.m)


@cache
def exported(
    kind: str = "lqg", *, zones: int = 2, simulated: bool = True, sample_time_s: float = 1.0
) -> Exported:
    """A controller of `zones` heaters and sensors by a law of LAWS; "slow" has a rate limit, "tight" outputs
    that may rise 5 degC above where its episodes begin; TOLD a fan and a feed to make up for. "study": the
    study's machine, more inputs than outputs."""
    plant_ = baam() if kind == "study" else block_and_sensor(zones=zones, sample_time_s=sample_time_s)
    limits = limits_of(plant_.m, rate=4.0 if kind == "slow" else np.inf)
    law, model = _law(kind, plant_, limits)
    high = 130.0 if kind == "tight" else 250.0
    watched = None if kind in ("hold", *PIDS) else guard(plant_, limits, high)
    machine = Machine(
        tuple(Signal(f"heater_{i + 1}", "percent", 0.0, 100.0) for i in range(plant_.m)),
        tuple(Signal(f"sensor_{i + 1}", "degC", 0.0, 250.0) for i in range(plant_.p)),
        sample_time_s,
        tuple(Signal(name, "percent", -np.inf, np.inf) for name in ("fan", "feed") if kind in TOLD),
    )
    forward = FeedForward(np.array([[0.1, 2.0], [0.05, -0.5]]), np.array([40.0, 1.5]), np.array([1.5, 0.0]))
    forward = forward if kind in TOLD else None
    return canonical(
        Exported(
            name=kind,
            machine=machine,
            controller=_deployed(law, limits, watched, holds=kind == "hold", forward=forward),
            model=model,
            fallback=None
            if kind == "pi"
            else _deployed(_pi(plant_, limits), limits, watched, forward=forward),
            supervision=supervision(plant_, machine, np.full(plant_.p, NOISE)),
            simulated=simulated,
            plant_sha256=plants_sha256([plant_]),
            spread_sha256=plants_sha256([]),
        )
    )


def _deployed(
    law: Law,
    limits: ActuatorLimits,
    watched: Governor | None,
    *,
    holds: bool = False,
    forward: FeedForward | None = None,
) -> Deployed:
    return deployed(
        law, limits, integral_limit=INTEGRAL_LIMIT, governor=watched, holds=holds, forward=forward
    )


def passed(of: Exported) -> Certificate:
    """A certificate whose rules all passed."""
    return Certificate(
        version=VERSION,
        loop="temperature",
        controller=of.name,
        controller_sha256=controller_sha256(of),
        plant_sha256=of.plant_sha256,
        spread_sha256=of.spread_sha256,
        evidence="simulated" if of.simulated else "recorded",
        sample_time_s=of.machine.sample_time_s,
        inputs=of.machine.inputs,
        outputs=of.machine.outputs,
        samples=(600, 100),
        poles=(),
        margins=None,
        worst=None,
        violations=(),
        bands=None,
        rules=tuple(RuleResult(name, True, 0.0, 1.0, "", "It holds.") for name in RULES),
        verdict="passed",
        first_failed=None,
        conditions="No disturbance is declared.",
    )


def refused(of: Exported, rule: str) -> Certificate:
    """A certificate that was refused by a rule."""
    rules = tuple(one._replace(passed=one.name != rule) for one in passed(of).rules)
    return passed(of)._replace(rules=rules, verdict="refused", first_failed=rule)
