"""Reproduces the study's own part, on its simulated machine, which no recording changes: datasets/published
-> datasets/papers/reproduce_study.json.

It has the study's learners on noise-free and on many noisy data sets, and the parity search: Q and R by
Bayesian optimisation of its fitness (37), whose optimum is known.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from joblib import delayed
from pydantic import Field
from tqdm import tqdm

from pipeline.papers import files, study
from pipeline.papers.published import PRINTED
from pipeline.papers.study_draws import read_published
from pipeline.store import params
from pipeline.store.execution import run_all
from pipeline.store.params import Execution, Section
from pipeline.temperature.test_set import tuning

SAMPLES = 15_000  # of a data set of the study


class ReproduceStudy(Section):
    """Section `reproduce_study`: the study's own part; the bounds are those of its search for Q and R."""

    seed: int = Field(ge=0, le=2**31)
    data_sets: int = Field(ge=1, le=1000)
    initial: int = Field(ge=4, le=5000)
    evaluations: int = Field(ge=8, le=5000)
    q_low: float = Field(gt=0, le=1e6)
    q_high: float = Field(gt=0, le=1e6)
    r_low: float = Field(gt=0, le=1e6)
    r_high: float = Field(gt=0, le=1e6)


class Reproduced(NamedTuple):
    """`study`: a row per noisy data set and route; `metrics`: the figures with the paper's."""

    study: dict[str, list]
    metrics: dict[str, Any]


def check(settings: ReproduceStudy) -> None:
    """Raises ValueError if the bounds or numbers of the parity search leave no room."""
    for name in ("q", "r"):
        low, high = getattr(settings, f"{name}_low"), getattr(settings, f"{name}_high")
        if low >= high:
            raise ValueError(
                f"{params.PAPERS}: reproduce_study.{name}_low is {low:g} but must be less than "
                f"reproduce_study.{name}_high, {high:g}; change one of the two"
            )
    if settings.initial > settings.evaluations:
        raise ValueError(
            f"{params.PAPERS}: reproduce_study.initial is {settings.initial} but must be at most "
            f"reproduce_study.evaluations, {settings.evaluations}; change one of the two"
        )


def reproduced(settings: ReproduceStudy, execution: Execution, folder: str) -> Reproduced:
    """Returns the study's part. `folder` has the random data behind the paper's figures."""
    _, u, y = read_published(folder)
    rows = _noisy(settings, execution)
    noise_free = study.noise_free(u[1:], y[1:], np.random.default_rng(settings.seed))
    figures = {"printed": PRINTED, **study.exact(), "kernel": noise_free}
    return Reproduced(rows, figures | {"parity": study.parity_metrics(_parity(settings))})


def _noisy(settings: ReproduceStudy, execution: Execution) -> dict[str, list]:
    """Returns gap and error of every route on every noisy data set."""
    sets_u, sets_y = study.data_sets(np.random.default_rng(settings.seed), SAMPLES, settings.data_sets)
    work = [(noise, i) for noise in study.NOISE for i in range(settings.data_sets)]
    calls = [delayed(study.under_noise)(sets_u[:, i], sets_y[:, i], noise=noise, seed=i) for noise, i in work]
    results = tqdm(
        run_all(calls, execution), total=len(work), desc="reproduce_study: noisy data sets", mininterval=2
    )
    return study.rows(work, list(results))


def _parity(settings: ReproduceStudy) -> tuning.SearchResult:
    low, high = (
        np.repeat(ends, (study.OUTPUTS, study.INPUTS))
        for ends in ((settings.q_low, settings.r_low), (settings.q_high, settings.r_high))
    )
    with tqdm(
        total=settings.evaluations, desc="reproduce_study: parity", unit="candidate", mininterval=2
    ) as bar:
        return tuning.minimise(
            study.tuning_objective,
            low,
            high,
            initial=settings.initial,
            evaluations=settings.evaluations,
            rng=np.random.default_rng(settings.seed),
            on_step=lambda _: bar.update(),
        )


def result(reproduced: Reproduced) -> dict[str, Any]:
    """Returns the contents of the file: the figures, and the table as lists, eight digits per number."""
    return {"figures": plain(reproduced.metrics), "study": plain(reproduced.study, digits=8)}


def plain(value: Any, digits: int = 17) -> Any:
    """Returns a value for JSON, a number with `digits` significant digits; None for infinity and NaN."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {key: plain(one, digits) for key, one in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(one, digits) for one in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def main() -> None:
    settings = params.load(ReproduceStudy, "reproduce_study", "datasets/papers/params.yaml")
    check(settings)
    execution = params.load(Execution, "execution")
    files.write("reproduce_study", result(reproduced(settings, execution, "datasets/published")))


if __name__ == "__main__":
    main()
