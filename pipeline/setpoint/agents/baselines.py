"""Controllers without learning, with the same interface as the agent: no control, and a sequential test
(CUSUM) of the window's class.

The class depends on the flow alone, so the camera gives no information on the temperature. Every controller
here moves the target to 210 °C in the largest steps that lambda's clock allows; the temperature follows with
the lag (6). The Bayes filter is in flow_filter.py.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pipeline.setpoint.published import BEST_TEMPERATURE, TEMPERATURE_MOVES
from pipeline.setpoint.simulation.simulator import (
    CLASSES,
    GOOD,
    OVER,
    STAND,
    UNDER,
    Action,
    Observation,
    SetpointController,
)


def nearest(moves: tuple[float, ...], wanted: jax.Array) -> jax.Array:
    """Returns the index of the move nearest to the wanted one. If two are equally near, takes the smaller
    move."""
    distance = jnp.abs(jnp.asarray(moves) - wanted) + 1e-4 * jnp.abs(jnp.asarray(moves))
    return jnp.argmin(distance).astype(jnp.int32)


def temperature_move(observation: Observation) -> jax.Array:
    """Returns the move that takes the target straight to 210 °C: the one nearest to u* - u_bar. It is given
    at every step, and lambda's clock applies every tenth."""
    return nearest(TEMPERATURE_MOVES, BEST_TEMPERATURE - observation.target)


@cache
def nothing() -> SetpointController:
    """Returns the controller that never moves the flow; every other controller must be better. Its parameters
    are ()."""

    def act(parameters, memory: tuple, observation: Observation, key: jax.Array) -> tuple[tuple, Action]:
        return memory, Action(jnp.int32(STAND), temperature_move(observation))

    return SetpointController(lambda: (), act)


class SequentialTest(NamedTuple):
    """`accuracy`: of the class, as the test assumes it. `threshold` and `cap` are in units of log likelihood
    ratio; the cap is the most by which a class may fall behind."""

    accuracy: float
    threshold: float
    cap: float


@cache
def sequential_test() -> SetpointController:
    """Returns a sequential test of the three classes. It moves the flow by 10 % against under or over if that
    class leads good by the threshold (Wald 1945; capped as in Page's CUSUM, 1954).

        S_i <- max(S_i + log P(x | i) - max_j (S_j + log P(x | j)), -cap)

    The cap lets a class recover quickly once a move or a clog has made it true.
    """

    def act(
        parameters: SequentialTest, S: jax.Array, observation: Observation, key: jax.Array
    ) -> tuple[jax.Array, Action]:
        S = S + jnp.log(
            jnp.where(
                jnp.arange(CLASSES) == observation.named, parameters.accuracy, (1.0 - parameters.accuracy) / 2
            )
        )
        S = jnp.maximum(S - S.max(), -parameters.cap)
        leads = S - S[GOOD] >= parameters.threshold
        move = STAND + 2 * jnp.where(
            S[UNDER] > S[OVER], leads[UNDER].astype(jnp.int32), -leads[OVER].astype(jnp.int32)
        )
        return S, Action(move, temperature_move(observation))

    return SetpointController(lambda: jnp.zeros(CLASSES), act)


# ---- rows of controllers.CONTROLLERS: settings, agents and recorded windows -> controller and parameters


def build_no_control(
    settings: Mapping[str, float], agents: Any, windows: Any
) -> tuple[SetpointController, tuple]:
    return nothing(), ()


def build_sequential_test(
    settings: Mapping[str, float], agents: Any, windows: Any
) -> tuple[SetpointController, SequentialTest]:
    return sequential_test(), SequentialTest(**settings)
