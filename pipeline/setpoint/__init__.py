"""Loop 3, setpoint: the nozzle image sets flow and temperature (Li and Pattinson 2025).

A controller is a pair of pure functions of JAX, `start() -> memory` and `act(parameters, memory, ...)`. Flows
are in percent of nominal, temperatures in °C; one step is one decision.

>>> import jax, jax.numpy as jnp
>>> from pipeline import setpoint

The paper's simulator classifies a bead as under, good or over, and is right 70 % of the time (7).

>>> windows = setpoint.paper_windows()
>>> starts = setpoint.starts(4, accuracy=0.7)
>>> print(starts.flow.shape, "wrong starts")
(84,) wrong starts

A sequential test moves when the evidence suffices (Wald 1945).

>>> test = setpoint.sequential_test()
>>> values = jax.tree.map(jnp.float32, setpoint.SequentialTest(accuracy=0.746, threshold=2.86, cap=5.28))
>>> run = setpoint.rollout(test, values, windows, starts, jax.random.key(1), steps=200)
>>> score = setpoint.judge(run.flow, run.temperature)
>>> print(f"settles in {score.settled.percent:.0f} % of {score.runs} runs")
settles in 100 % of 84 runs
"""

from pipeline import import_when_used

_PLACES = {
    "paper_windows": "simulation.simulator:paper_windows",
    "starts": "agents.trials:starts",
    "rollout": "simulation.simulator:rollout",
    "judge": "agents.score:judge",
    "SequentialTest": "agents.baselines:SequentialTest",
    "sequential_test": "agents.baselines:sequential_test",
    "fit_filter": "agents.flow_filter:fit",
    "flow_filter": "agents.flow_filter:flow_filter",
    "train_agent": "agents.agent:train_published",
}
__all__ = list(_PLACES)
__getattr__ = import_when_used(__name__, _PLACES)
