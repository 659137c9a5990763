"""Loop 1, temperature: from a record of inputs and outputs to a control law `u = -K z - D y - K_r r - k`.

Source: Zavrakli, Parnell, Dey 2023. Every method takes and returns arrays. Inputs u (T, m) are in percent,
outputs y (T, p) in °C, T samples; a record is a list of such segments, each without a gap.

>>> import numpy as np
>>> from pipeline import temperature

A heater warms a sensor: 2 °C for each percent, with a time constant of 50 s.

>>> rng = np.random.default_rng(1)
>>> u = 50.0 + 20.0 * rng.standard_normal((1000, 1))
>>> y = np.full((1000, 1), 100.0)
>>> for t in range(999):
...     y[t + 1] = y[t] + (2.0 * u[t] - y[t]) / 50.0
>>> y += 0.1 * rng.standard_normal(y.shape)

Model-based: subspace identification, then the gains of the Riccati equation with an observer.

>>> model = temperature.identify([u], [y], sample_time_s=1.0).plant
>>> steady_gain = model.C @ np.linalg.solve(np.eye(model.n) - model.A, model.B) + model.D
>>> print(round(steady_gain.item(), 1), "°C per percent")
2.0 °C per percent
>>> Q, R, gamma = np.eye(1), np.eye(1), 0.99
>>> lqg = temperature.observer_law(model, temperature.gains(model, Q, R, gamma), model.K)

Model-based by least squares: a long VARX window is the state.

>>> varx = temperature.varx_law(temperature.fit_varx([u], [y], longest=8), Q, R, gamma)

Data-driven: the kernel of the value function from the same record, without a model (Algorithm 2).

>>> windows = temperature.window_tuples([u], [y], 2, offset=True)
>>> kernel = temperature.kernel_law(temperature.regress(windows), Q, R, gamma)

Baseline: PI by the SIMC rules.

>>> pairs = temperature.pairing(model, np.zeros(1), np.full(1, 100.0), horizon=300)
>>> pi = temperature.pi_law(pairs, inputs=1)

The disk margin of a loop says how much gain and phase may change before the loop becomes unstable.

>>> for name, law in {"LQG": lqg, "VARX": varx, "kernel": kernel, "PI": pi}.items():
...     print(f"{name}: {temperature.margins([model], law)[0].disk:.1f}")
LQG: 1.7
VARX: 1.8
kernel: 1.9
PI: 1.2
"""

from pipeline import import_when_used

_PLACES = {
    "Plant": "plant:Plant",
    "identify": "identification.model_choice:identify",
    "riccati": "tracking:riccati",
    "gains": "tracking:gains",
    "observer_law": "tracking:observer_law",
    "fit_varx": "controllers.window:learn",
    "varx_law": "controllers.window:law",
    "window_tuples": "controllers.kernel:tuples",
    "regress": "controllers.kernel:regress",
    "value_iteration": "controllers.kernel:value_iteration",
    "kernel_law": "controllers.kernel:law",
    "fit_trajectories": "controllers.predictive:learn",
    "predictive_law": "controllers.predictive:law",
    "pairing": "controllers.baseline:pairing",
    "pi_law": "controllers.baseline:pi_law",
    "margins": "test_set.scorecard:margins",
}
__all__ = list(_PLACES)
__getattr__ = import_when_used(__name__, _PLACES)
