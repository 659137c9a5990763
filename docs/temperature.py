"""The temperature loop in arrays: probe an extruder, learn from the record, design and run four controllers.

`./run python docs/temperature.py` draws temperature.svg into the folder where it is started.
The temperature stages do the same with recordings, tuned weights and a panel of plants.
"""

# %% The machine is the extruder of Zavrakli 2023: six heaters, a motor -> five temperatures in °C.
import matplotlib
import numpy as np

from pipeline.papers import study
from pipeline.papers.published import K_DATA
from pipeline.temperature import plant, probing, tracking
from pipeline.temperature.controllers import kernel, window
from pipeline.temperature.controllers.baseline import pairing, pi_law
from pipeline.temperature.controllers.law import ActuatorLimits
from pipeline.temperature.controllers.law import deployed as limited
from pipeline.temperature.identification.model_choice import Settings, identify
from pipeline.temperature.test_set import panel

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402  a figure without a screen

rng = np.random.default_rng(1)
machine = plant.baam()
low, high = np.zeros(machine.m), np.full(machine.m, 100.0)

# %% A multisine probes it for 6,000 s; the sensors have 0.1 °C of noise. A little of the
# study's feedback keeps the temperatures in reach; all of it would hide the slow poles from the record.
signal = probing.multisine(rng, 6000, machine.m, amplitude=10.0)
noise = 0.1 * rng.standard_normal((6000, machine.p))
record = study.study_probe(machine, signal, 0.05 * K_DATA, x0=np.full(machine.n, 50.0), noise=noise)
u, y = record.u, record.y

# %% Three models come from one record: a subspace model, a long VARX window, and the kernel of Algorithm 2.
model = identify([u], [y], sample_time_s=1.0, settings=Settings(order=machine.n)).plant
learned = window.learn([u], [y], longest=24)
regression = kernel.regress(window.predicted_tuples(learned, [u], [y]))
for name, A in (("true", machine.A), ("identified", model.A)):
    print(f"poles, {name:10}", np.sort(np.abs(np.linalg.eigvals(A)))[::-1].round(4))

# %% Each gives a law u = -K z - D y - K_r r - k that minimises the discounted cost for Q = R = I.
gamma, Q, R = 0.99, np.eye(machine.p), np.eye(machine.m)
algorithm_2 = kernel.value_iteration(regression, Q, R, gamma)
laws = {
    "subspace + LQG": tracking.observer_law(
        model, tracking.gains(model, Q, R, gamma), tracking.robust_observer_gain(model, 1.0)
    ),
    "VARX + Riccati": window.law(learned, Q, R, gamma),
    "learned kernel": kernel.window_law(algorithm_2.K, algorithm_2.K_r, algorithm_2.k, learned.N),
}
pi_simc = pi_law(pairing(model, low, high, horizon=1000), inputs=machine.m)

# %% The yardstick: cost above the optimum that knows the true state, from 20 °C, without limits.
references = np.array([[150.0, 160.0, 170.0, 175.0, 180.0]])
scenarios = study.study_panel(references, noise=0.1, hold=30)
gaps = {name: float(study.gap(law, scenarios)[0]) for name, law in laws.items()}
for name, gap in gaps.items():
    print(f"{name:15} {100 * gap:9.4f} % above the optimum")

# %% As deployed: heaters give 0 to 100 %, and every law aims at the nearest temperatures that can be held.
limits = ActuatorLimits(low, high, rate=np.full(machine.m, np.inf))
questions = panel.Questions(np.full((1, machine.p), 20.0), references, None, None, None)
true = panel.delayed(machine, late=False)
cases = panel.asked([true], questions, noise=np.full(machine.p, 0.1), seed=1, steps=1000, hold=30, cells=True)
rests = panel.rests(model, cases, limits)
figure, axes = pyplot.subplots(2, 2, figsize=(9, 6), sharex=True, sharey=True)
runs = {}
for axis, (name, law) in zip(axes.flat, (laws | {"PI, SIMC": pi_simc}).items(), strict=True):
    deployed = limited(law, limits, integral_limit=1.0)
    runs[name] = panel.rolled_out(deployed, cases, panel.aims(law, rests, cases))
    axis.plot(runs[name].y[:, 0])
    axis.set_prop_cycle(None)
    axis.plot(np.tile([0, len(runs[name].y)], (machine.p, 1)).T, np.tile(references[0], (2, 1)), ":")
    axis.set(title=name, xlabel="time in s", ylabel="temperature in °C")
figure.tight_layout()
figure.savefig("temperature.svg")
