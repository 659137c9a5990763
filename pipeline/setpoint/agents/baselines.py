"""Controllers without learning, behind the interface of the agent: nothing, and a sequential test (CUSUM) of
the window's class.

The class depends on the flow alone, so nothing that the camera sees bears on the temperature: every
controller here moves the target to 210 °C in the largest steps that lambda's clock allows, which the lag (6)
then follows. The Bayes filter is in flow_filter.py.
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
    """The index of the move nearest to the wanted one; of two as near, the smaller."""
    distance = jnp.abs(jnp.asarray(moves) - wanted) + 1e-4 * jnp.abs(jnp.asarray(moves))
    return jnp.argmin(distance).astype(jnp.int32)


def temperature_move(observation: Observation) -> jax.Array:
    """Straight to 210 °C: the move nearest to u* - u_bar. It says so
    at every step; lambda's clock takes every tenth."""
    return nearest(TEMPERATURE_MOVES, BEST_TEMPERATURE - observation.target)


@cache
def nothing() -> SetpointController:
    """Never moves the flow, whatever it sees: what any other controller must be better than. Its parameters
    are ()."""

    def act(parameters, memory: tuple, observation: Observation, key: jax.Array) -> tuple[tuple, Action]:
        return memory, Action(jnp.int32(STAND), temperature_move(observation))

    return SetpointController(lambda: (), act)


class SequentialTest(NamedTuple):
    """accuracy: of the class, as the test assumes it; threshold and cap in units of log likelihood ratio, the
    cap the most that a class may fall behind."""

    accuracy: float
    threshold: float
    cap: float


@cache
def sequential_test() -> SetpointController:
    """A running test of the three classes, 10 % against under or over where it leads good by the threshold
    (Wald 1945; capped as in Page's CUSUM, 1954).

        S_i <- max(S_i + log P(x | i) - max_j (S_j + log P(x | j)), -cap)

    The cap lets a class come back, once a move or a clog has made it true.
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
