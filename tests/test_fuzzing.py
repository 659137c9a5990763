"""Whatever a file holds, what reads it takes it or refuses it by a sentence: no traceback, no hang."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import fuzzing


@pytest.mark.parametrize("name", fuzzing.TARGETS)
def test_a_damaged_file_is_read_or_refused_by_a_sentence(name):
    target = fuzzing.TARGETS[name]
    assert fuzzing.answer(target, target.good()) == "read"
    seen = set()

    @settings(max_examples=25)
    @given(fuzzing.DAMAGE)
    def each(edits):
        seen.add(fuzzing.answer(target, fuzzing.damaged(target.good(), edits)))

    each()
    assert "refused" in seen


@settings(max_examples=25)
@given(st.integers(-3, 3), st.sampled_from(["", "t", "y"]), st.sampled_from(["", "x", "time_s"]))
def test_a_table_of_another_version_is_refused_and_its_own_is_read(change, drop, rename):
    content = fuzzing.versions(change, drop, rename)
    expected = "read" if not drop and not change else "refused"
    assert fuzzing.answer(fuzzing.TARGETS["table"], content) == expected


def test_a_traceback_and_a_hang_are_found():
    def broken(path):
        return {}[path.read_bytes()]

    def endless(_):
        while True:
            pass

    with pytest.raises(KeyError):
        fuzzing.answer(fuzzing.Target(bytes, ".csv", broken), b"a")
    with pytest.raises(fuzzing.Hang), fuzzing.within(0.05):
        endless(None)
