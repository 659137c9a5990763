"""Klipper's PID as a controller of the comparison: against its formula, number by number."""

import numpy as np
import pytest

from pipeline.temperature.controllers.law import (
    ActuatorLimits,
    Rest,
    RunningController,
    aim,
    constant,
    deployed,
)
from pipeline.temperature.controllers.printer_pid import HeaterPid, law, law_of_printer
from pipeline.temperature.plant import Plant
from pipeline.temperature.test_set import panel
from pipeline.temperature.test_set.scorecard import closed_loop, law_response

BED = HeaterPid(input=1, output=0, Kp=21.2, Ki=0.30, Kd=372.0, most_percent=100.0, smooth_s=1.0)
HOT = HeaterPid(input=0, output=1, Kp=8.7, Ki=0.42, Kd=44.7, most_percent=100.0, smooth_s=1.0)
LIMITS = np.zeros(2), np.full(2, 100.0)
ANY_RATE, UNLIMITED = (
    np.full(2, np.inf),
    ActuatorLimits(np.full(2, -np.inf), np.full(2, np.inf), np.full(2, np.inf)),
)
AMBIENT = 24.0
# it aims at no target, so that where the machine would rest says nothing to it
NOWHERE = Rest(np.full((2, 1), np.nan), np.full((2, 1), np.nan), np.full(2, np.nan), ())


def heaters(sample_time_s: float) -> Plant:
    """A bed (output 0, input 1) and a hot end (output 1, input 0), each of first order and apart."""
    pole = np.exp(-sample_time_s / np.array([600.0, 150.0]))
    gain = (1 - pole) * np.array([1.1, 4.2])
    return Plant(
        A=np.diag(pole),
        B=np.array([[0.0, gain[0]], [gain[1], 0.0]]),
        C=np.eye(2),
        D=np.zeros((2, 2)),
        b=(1 - pole) * AMBIENT,
        d=np.zeros(2),
        K=np.zeros((2, 2)),
        sample_time_s=sample_time_s,
    )


class Klipper:
    """One heater's ControlPID as klippy/extras/heaters.py writes it, of a duty of 0 to `most`."""

    def __init__(self, pid: HeaterPid, temp: float, duty: float):
        self.pid, self.prev_temp, self.prev_deriv = pid, temp, 0.0
        self.integ_max = pid.most_percent / pid.Ki
        self.prev_integ = duty / pid.Ki

    def slope(self, temp: float, time_diff: float) -> float:
        smooth, temp_diff = self.pid.smooth_s, temp - self.prev_temp
        if time_diff >= smooth:
            deriv = temp_diff / time_diff
        else:
            deriv = (self.prev_deriv * (smooth - time_diff) + temp_diff) / smooth
        self.prev_temp, self.prev_deriv = temp, deriv
        return deriv

    def update(self, temp: float, target: float, time_diff: float) -> float:
        """With readings of 0.3 s on the straight line between two of ours for the slope."""
        for reading in np.linspace(self.prev_temp, temp, round(time_diff / 0.3) + 1)[1:]:
            deriv = self.slope(reading, 0.3)
        error = target - temp
        integ = max(0.0, min(self.integ_max, self.prev_integ + error * time_diff))
        co = self.pid.Kp * error + self.pid.Ki * integ - self.pid.Kd * deriv
        bounded = max(0.0, min(self.pid.most_percent, co))
        if co == bounded:
            self.prev_integ = integ
        return bounded


def warm_up(machine: Plant, *, noise: float, steps: int = 900, to=(60.0, 200.0)) -> panel.Cases:
    """From a hold at 40 °C, of which the law sees one sample."""
    questions = panel.Questions(np.full((1, 2), 40.0), np.array([to]), None, None, None)
    return panel.asked(
        [panel.delayed(machine, late=False)],
        questions,
        noise=np.full(2, noise),
        seed=3,
        steps=steps,
        hold=1,
        cells=False,
    )


def run_of(cases: panel.Cases, made, limits: ActuatorLimits) -> panel.Rollout:
    starts = [constant(start) for start in cases.starts]
    aims = [aim(made, NOWHERE, reference) for reference in (*cases.references, *starts)]
    return panel.rolled_out(deployed(made, limits, integral_limit=1.0), cases, aims)


def by_the_formula(
    cases: panel.Cases, sample_time_s: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Temperatures and duties (steps, 2) under Klipper's own words, from the hold of the panel; noise (1 +
    steps, 2)."""
    machine, x, y, u, r = cases.plants[0], cases.x0[0], [], [], cases.references[0].H[:, 0]
    first = machine.C @ x + noise[0]
    pids = {pid.input: Klipper(pid, first[pid.output], cases.u0[0][pid.input]) for pid in (BED, HOT)}
    for pid in pids.values():
        # the sample of the hold is once more the one before the first
        pid.slope(first[pid.pid.output], sample_time_s)
    for t in range(cases.steps):
        y.append(machine.C @ x)
        measured, duty = y[-1] + noise[1 + t], np.zeros(2)
        for i, heater in pids.items():
            at = heater.pid.output
            duty[i] = heater.update(measured[at], r[at], sample_time_s)
        u.append(duty)
        x = machine.A @ x + machine.B @ duty + machine.b
    return np.array(y), np.array(u)


@pytest.mark.parametrize("sample_time_s", [0.3, 0.9, 1.5])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_law_warms_the_heaters_as_klippers_formula_does(sample_time_s, noise):
    cases = warm_up(heaters(sample_time_s), noise=noise)
    run = run_of(cases, law((BED, HOT), sample_time_s=sample_time_s), ActuatorLimits(*LIMITS, ANY_RATE))
    y, u = by_the_formula(cases, sample_time_s, panel.noise_of(cases)[:, 0])
    assert (u == 100).mean() > 0.05  # the way up is at the limit
    # rounding, some 1e-12 a step, over 900 steps of a loop that forgets
    np.testing.assert_allclose(run.u[:, 0], u, atol=1e-7)
    np.testing.assert_allclose(run.y[:, 0], y, atol=1e-7)


def test_where_klipper_holds_the_integral_before_the_duty_and_we_after_it_they_part_by_little():
    """A heater too weak for its target: its integral goes up to its limit."""
    machine = heaters(0.9)
    cases = warm_up(machine, noise=0.0, to=(140.0, 200.0))
    run = run_of(cases, law((BED, HOT), sample_time_s=0.9), ActuatorLimits(*LIMITS, ANY_RATE))
    y, _ = by_the_formula(cases, 0.9, np.zeros((1 + cases.steps, 2)))
    np.testing.assert_allclose(run.y[:, 0], y, atol=0.1)  # a tenth of the band that counts as settled


def test_the_response_is_that_of_two_pids_with_shares_of_their_own():
    """u/(-y) = Kp + Ki T z/(z-1) + Kd (1 - 1/z) / (a - (a - T)/z), by hand at three frequencies."""
    T = 0.3
    z = np.exp(1j * np.array([0.01, 0.3, 2.0]))
    response = law_response(law((BED, HOT), sample_time_s=T), z)
    for pid in (BED, HOT):
        a = max(pid.smooth_s, T)
        expected = pid.Kp + pid.Ki * T * z / (z - 1) + pid.Kd * (1 - 1 / z) / (a - (a - T) / z)
        np.testing.assert_allclose(response[:, pid.input, pid.output], expected, rtol=1e-9)  # rounding
    assert (response[:, 0, 0] == 0).all() and (response[:, 1, 1] == 0).all()


def late(sample_time_s: float, delay_s: float) -> Plant:
    """The hot end alone, measured `delay_s` late."""
    n, pole = round(delay_s / sample_time_s) + 1, np.exp(-sample_time_s / 150.0)
    A, B = np.eye(n, k=-1), np.zeros((n, 1))
    A[0, 0], B[0, 0] = pole, 4.2 * (1 - pole)
    C = np.eye(1, n, n - 1)
    return Plant(A, B, C, np.zeros((1, 1)), np.zeros(n), np.zeros(1), np.zeros((n, 1)), sample_time_s)


@pytest.mark.parametrize(("delay_s", "stable"), [(0.0, True), (2.0, False), (3.0, False)])
def test_at_one_second_the_loop_is_as_stable_as_at_klippers_own_rate(delay_s, stable):
    """Away from the edge, which our hold of 1 s moves. At 1 s Klipper's formula would not smooth the slope,
    and the loop would be unstable without any delay."""
    for sample_time_s in (0.3, 1.0):
        made = law((HOT._replace(input=0, output=0),), sample_time_s=sample_time_s)
        radius = np.abs(np.linalg.eigvals(closed_loop(late(sample_time_s, delay_s), made))).max()
        assert (radius < 1) == stable, (sample_time_s, radius)


def test_without_limits_the_errors_obey_the_characteristic_polynomial_of_the_closed_loop():
    """Cayley and Hamilton: what the margins are computed on is what runs."""
    machine, made = heaters(1.0), law((BED, HOT), sample_time_s=1.0)
    polynomial = np.poly(closed_loop(machine, made))
    run = run_of(warm_up(machine, noise=0.0, steps=300), made, UNLIMITED)
    for error in (run.y[:, 0] - [60, 200]).T:
        # rounding of errors up to 160 °C under coefficients up to 30
        assert abs(np.convolve(error, polynomial, mode="valid")).max() < 1e-8


def test_a_machine_that_the_printers_pids_do_not_control_whole_is_refused_with_the_reason():
    machine = heaters(1.0)
    with pytest.raises(ValueError, match=r"each of the 2 outputs and 2 inputs; found those of 1 heaters"):
        law_of_printer((HOT,), machine, LIMITS)
    weak = HOT._replace(most_percent=80.0)
    with pytest.raises(ValueError, match=r"ends at 80 % of duty \(max_power\), but input 1 may go to 100 %"):
        law_of_printer((BED, weak), machine, LIMITS)
    with pytest.raises(ValueError, match=r"found Kp 0, Ki 0.42 for output 2"):
        law_of_printer((BED, HOT._replace(Kp=0.0)), machine, LIMITS)


def test_it_has_its_own_integral_in_the_order_of_the_outputs():
    made = law_of_printer((HOT, BED), heaters(1.0), LIMITS)
    assert made.conditional
    np.testing.assert_allclose(made.integral, [0.30 / 21.5, 0.42 / 9.12], rtol=1e-12)  # Ki T / (Kp + Ki T)


def test_it_gives_its_commands_again_from_its_temperatures_although_they_round_otherwise():
    plant, wanted = heaters(1.0), np.array([60.0, 205.0])
    limits = ActuatorLimits(*LIMITS, ANY_RATE)
    runs = [
        RunningController(deployed(law((BED, HOT), sample_time_s=1.0), limits, integral_limit=5.0), plant)
        for _ in range(2)
    ]
    x, commands = np.array([50.0, 190.0]), []
    for run in runs:
        run.watch(np.full(2, 30.0), x, wanted)
        run.hand_over(x)
    for t in range(600):
        u = runs[0].step(x, wanted, t)
        rounded = np.clip(u * (1 + 1e-14), *LIMITS)
        commands.append(np.abs(runs[1].step(x, wanted, t, rounded) - u).max())
        x = plant.A @ x + plant.B @ u + plant.b
    assert max(commands) < 1e-9
