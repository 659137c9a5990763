"""Work sent to a cluster gives what this machine gives, whoever is killed meanwhile; a worker whose results
could differ is refused, and what is missing is one sentence."""

import re
import sys

import joblib
import numpy as np
import pytest

from pipeline.papers import study
from pipeline.store import execution
from pipeline.store.execution import run_all
from tests.cluster import Cluster
from tests.temperature.test_ingest import INLINE


def noisy(count: int) -> list:
    """The judging of learners on noisy data sets, as the second pipeline spreads it: arrays are arguments."""
    u, y = study.data_sets(np.random.default_rng(0), 1500, count)
    return [
        joblib.delayed(study.under_noise)(u[:, i], y[:, i], noise=0.01, seed=i, longest=6)
        for i in range(count)
    ]


def test_what_the_cluster_computes_for_a_stage_is_what_this_machine_computes(cluster):
    here = list(run_all(noisy(2), INLINE))
    assert list(run_all(noisy(2), cluster.execution)) == here and len(here) == 2


def test_arrays_given_to_a_worker_that_is_killed_are_not_lost_with_it(mortal_cluster):
    killing = mortal_cluster.killing(mortal_cluster.workers[1])
    assert list(killing(noisy(8), mortal_cluster.execution)) == list(run_all(noisy(8), INLINE))
    assert mortal_cluster.workers[0].is_alive() and not mortal_cluster.workers[1].is_alive()


def test_a_scheduler_that_ends_is_one_sentence(mortal_cluster):
    killing = mortal_cluster.killing(mortal_cluster.scheduler)
    with pytest.raises(
        ValueError,
        match=rf"^params.yaml: execution\.scheduler: the scheduler {mortal_cluster.address} ended, or could "
        r"no longer be reached; .* run it again: all is kept$",
    ):
        list(killing(noisy(8), mortal_cluster.execution, remains=": all is kept"))


def test_without_dask_the_sentence_names_the_group_that_has_it(cluster, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"dask is not installed; write \./run --group cluster before the"):
        list(run_all(noisy(2), cluster.execution))


# ---- workers that are not as this process


def test_a_worker_without_our_pins_is_refused_with_what_differs(tmp_path):
    made = Cluster(tmp_path, 1, OPENBLAS_NUM_THREADS="7")
    try:
        with pytest.raises(
            ValueError, match=r"the worker tcp://\S+ has OPENBLAS_NUM_THREADS 7, expected "
        ) as e:
            list(run_all(noisy(2), made.execution))
        assert "start it anew by `./run --group cluster dask worker`" in str(e.value)
    finally:
        made.stop()


def test_other_code_and_other_packages_are_told_apart():
    asked = execution.surroundings()
    assert execution._differences(asked, asked) == []
    found = asked._replace(code="0", packages=asked.packages | {"scipy": "0.1"})
    assert execution._differences(asked, found) == [
        "another pipeline/, or one of before a change", f"scipy 0.1, expected {asked.packages['scipy']}"
    ]  # fmt: skip


def test_the_pins_are_all_that_run_exports_for_last_bits(root):
    exported = set(re.findall(r"\b([A-Z_]+)=", " ".join(
        line for line in (root / "run").read_text().splitlines() if " export " in f" {line}"
    )))  # fmt: skip
    assert set(execution.PINS) == exported - {
        # of no arithmetic
        "OPENCV_IO_MAX_IMAGE_PIXELS", "PYTHONHASHSEED", "DVC_NO_ANALYTICS", "UV_COMPILE_BYTECODE",
        "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
    }  # fmt: skip
