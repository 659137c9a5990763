"""Criteria by which a run of a setpoint controller is scored: plain numbers, so that a page can use them
without a simulator."""

FLOW_BAND, TEMPERATURE_BAND = 10.0, 5.0  # about 100 % and 210 °C
SETTLED_BY, DWELL_UNTIL, STEPS = (
    90,
    100,
    200,
)  # settled: inside from some step <= 90 until 100; stay: never outside from 100 to 200
CLOG_STEP, RECOVERED_UNTIL = 60, 120
BEYOND = (10, 15, 25)  # points of flow past which a run from a good start counts as harmed
NO_CONTROL = "do nothing"  # the controller that leaves every print alone
BACK_BAND = 15.0  # percent: to which the flow of a half clogged nozzle must return


def harm_bar(case: str, *, perfect: float, in_band: float) -> float | None:
    """Returns the percentage of runs from good starts that may leave +-25 % in this case. None means no
    limit: no controller can detect a camera of another scale, so harm is only reported."""
    return {"perfect": perfect, "in band": in_band}.get(case)
