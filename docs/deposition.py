"""The deposition loop in arrays: a plunger learns, trial by trial, to lay a line as wide as it should be.

`./run python docs/deposition.py` draws deposition.svg into the folder where it is started.
The deposition stages do the same with camera frames, a library of learned signals and parts.
"""

# %% The routine: 4 s off, 6 s on, a pause of 0.6 s, 6 s on, off; flow r = bead area x speed in mm^3/s.
import matplotlib
import numpy as np

from pipeline.deposition.drive import UNLIMITED
from pipeline.deposition.extruder import Extruder, disturb, flow, frequency_response, routine
from pipeline.deposition.learning import ilc

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402  a figure without a screen

Ts = 0.02
task = routine(
    off_s=4.0,
    on_s=6.0,
    pause_s=0.6,
    tail_s=8.0,
    speed=8.0,
    bead_area_mm2=0.304,
    ramp_s=0.15,
    sample_time_s=Ts,
)
r, steady = task.r, float(task.r.max())

# %% The machine has a delay, a lag, play and a yield stress; we know its gain and time constant, roughly.
nominal = Extruder(gain=1.08, time_constant_s=2.7)
machine = Extruder(gain=0.92, time_constant_s=3.2, delay_s=0.113, lag_hz=4.3, play=0.06, yield_=0.15)
rng = np.random.default_rng(1)


def print_trial(u: np.ndarray) -> ilc.Trial:
    """One trial with the command u (T,) in mm: the flow as measured, and the true one."""
    y = flow(machine, u, sample_time_s=Ts)
    return ilc.Trial(u, disturb(y, rng, steady_flow=steady, white=0.03, drift=0.01, gain=0.01), y)


# %% Before anything runs: the law of Hoelzle 2009 converges where gamma = max |Q (1 - L P)| < 1.
hoelzle = ilc.HoelzleSettings(learning_gain=0.25, fast_zero_s=0.03, order=2, cutoff_hz=3.0)
f = np.linspace(0.0, 0.5 / Ts, 500)
Q = (
    ilc.magnitude(f, order=hoelzle.order, cutoff_hz=hoelzle.cutoff_hz, sample_time_s=Ts) ** 2
)  # forwards and backwards
L = ilc.hoelzle_filter(f, nominal, hoelzle, sample_time_s=Ts)
P = frequency_response(nominal, f, sample_time_s=Ts)
print(f"gamma on the nominal model: {float(ilc.gamma(Q, L, P[None])[0]):.3f}")

# %% Trial 0 is on-off control, u = r / K; ten updates follow from what was measured.
inverse = ilc.InverseSettings(identify_trials=3, floor=0.1, order=4, cutoff_hz=5.0)
on_this_machine = {"drive": UNLIMITED, "sample_time_s": Ts}
laws = {
    "Hoelzle 2009": ilc.hoelzle_law(r, nominal, ilc.zero_phase, hoelzle, **on_this_machine),
    "model inverse": ilc.InverseLaw(r, inverse, **on_this_machine),
}
trials = {
    name: ilc.learn(law, print_trial, r / nominal.gain, r, trials=10, rise=0.1) for name, law in laws.items()
}
ratios = {}
for name, done in trials.items():
    errors = np.array([ilc.rms(trial.truth - r) for trial in done])
    ratios[name] = errors / errors[0]
    print(f"{name:14} r.m.s. error, share of trial 0:", ratios[name].round(3))

# %% The figure: the error from trial to trial, and the flow of the first and of the last trial.
figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="tight")
for name, ratio in ratios.items():
    left.semilogy(ratio, "o-", label=name)
left.set(xlabel="trial", ylabel="r.m.s. error, share of trial 0")
learned = trials["model inverse"]
for values, label in ((r, "wanted"), (learned[0].truth, "on-off"), (learned[-1].truth, "learned")):
    right.plot(task.time_s, values, label=label)
right.set(xlabel="time in s", ylabel="flow in mm³/s")
for axis in (left, right):
    axis.legend()
figure.savefig("deposition.svg")
