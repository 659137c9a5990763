"""The setpoint loop in arrays: a camera names each bead, a controller moves flow and temperature.

`./run python docs/setpoint.py` draws setpoint.svg into the folder where it is started.
The setpoint stages do the same with images, trained networks and eight cases.
"""

# %% The simulator of Li 2025 classifies a bead as under, good or over. It is right 70 % of the time.
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

from pipeline.setpoint.agents import flow_filter, score, trials
from pipeline.setpoint.agents.baselines import SequentialTest, sequential_test
from pipeline.setpoint.simulation.recorded import UNSEEN, WindowTable
from pipeline.setpoint.simulation.simulator import paper_windows, rollout

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402  a figure without a screen

windows = paper_windows()
starts = trials.starts(4, accuracy=0.7)  # 21 wrong starts, four times each
key = jax.random.key(1)

# %% Three controllers. Each is a pair of pure functions: start() -> memory, act(parameters, memory, ...).
costs = {"move_cost": 0.0, "move_fixed_cost": 0.0, "outside_cost": 0.0, "border_std": 1.0}
declared = {"gains": [1.0], "biases": 1, "accuracy": 0.7, "ends": 0.2, "known_start_share": 0.0} | costs
nothing = WindowTable(*4 * (np.empty(0),), np.empty(0), UNSEEN)  # this camera shows classes, no flows
no_jumps, jumps = (
    flow_filter.fit(nothing, known_start_std=0.05, hazard=hazard, **declared) for hazard in (0.0, 0.02)
)
law = flow_filter.flow_filter(len(jumps.gains), len(jumps.bias))
controllers = {  # parameters are arrays, so that one compiled program serves all values
    "sequential test": (sequential_test(), SequentialTest(accuracy=0.746, threshold=2.86, cap=5.28)),
    "Bayes filter": (law, no_jumps),
    "Bayes filter, expects jumps": (law, jumps),
}
controllers = {name: (law, jax.tree.map(jnp.float32, values)) for name, (law, values) in controllers.items()}

# %% All meet the same chances. Settled: within 10 % and 5 °C by decision 90; stays: never out again.
runs = {
    name: rollout(controller, parameters, windows, starts, key, steps=score.STEPS)
    for name, (controller, parameters) in controllers.items()
}
scores = {name: score.judge(run.flow, run.temperature) for name, run in runs.items()}
for name, one in scores.items():
    settled, stay = one.settled, one.stay
    print(
        f"{name:27} settles in {settled.percent:5.1f} % of {one.runs} runs, stays in {stay.percent:5.1f} % "
        f"[{stay.low:.1f}, {stay.high:.1f}], mean error of the flow {one.flow_error:.1f} %"
    )

# %% The same camera, and a nozzle that clogs at decision 60: the flow falls to 0.6 of what it was.
one = jnp.ones_like(starts.flow)
clog = starts._replace(clog=0.6 * one, clog_step=score.CLOG_STEP * one)
clogged = {}
for name in ("Bayes filter", "Bayes filter, expects jumps"):
    controller, parameters = controllers[name]
    clogged[name] = rollout(controller, parameters, windows, clog, key, steps=score.STEPS)
    recovered = score.judge(clogged[name].flow, clogged[name].temperature).recovered
    print(f"{name:27} recovers from the clog in {recovered.percent:5.1f} %")

# %% The figure: the flow of every run, and the band that it should stay in.
figure, axes = pyplot.subplots(2, 2, figsize=(10, 6), sharex=True, sharey=True)
panels = {name: runs[name] for name in ("sequential test", "Bayes filter")}
panels |= {f"{name}; a clog": run for name, run in clogged.items()}
for axis, (name, run) in zip(axes.flat, panels.items(), strict=True):
    axis.plot(np.asarray(run.flow).T, color="tab:blue", alpha=0.15, linewidth=0.8)
    axis.axhspan(100 - score.FLOW_BAND, 100 + score.FLOW_BAND, color="tab:green", alpha=0.2)
    axis.set(title=name, xlabel="decision", ylabel="flow in % of nominal")
figure.tight_layout()
figure.savefig("setpoint.svg")
