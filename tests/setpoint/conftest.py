"""What XLA compiled for the tests of one file is forgotten after it, and its memory given back: a worker that
keeps all of it grows by gigabytes. Programs come back from JAX's cache on disk (tests/conftest.py)."""

import ctypes
import sys

import pytest


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    yield
    if jax := sys.modules.get("jax"):
        jax.clear_caches()
        # glibc keeps what was freed; elsewhere there is no such call
        if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
            trim(0)
