"""The paper's elliptical reward of flow and temperature (Li and Pattinson 2025, eqs. 14-16)."""

import jax
import jax.numpy as jnp

from pipeline.setpoint.published import BEST_FLOW, BEST_TEMPERATURE, ROTATION


def reward(flow: jax.Array, temperature: jax.Array, *, a: float, b: float) -> jax.Array:
    """r = 2 / (1 + sqrt(q_r^2 / a^2 + u_r^2 / b^2)) - 1 in (-1, 1], 1 at (q*, u*) = (100 %, 210 °C); flow in
    percent, temperature in °C, any one shape.

    q_r = (q - q*) cos theta - (u - u*) sin theta,   u_r = (q - q*) sin theta + (u - u*) cos theta
    """
    dq, du = flow - BEST_FLOW, temperature - BEST_TEMPERATURE
    q_r = dq * jnp.cos(ROTATION) - du * jnp.sin(ROTATION)
    u_r = dq * jnp.sin(ROTATION) + du * jnp.cos(ROTATION)
    return 2.0 / (1.0 + jnp.sqrt(q_r**2 / a**2 + u_r**2 / b**2)) - 1.0
