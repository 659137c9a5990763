"""Nights that end badly, played as the benchmark does on a toy project: the quick ones of
`benchmarks.killed_nights`, and that it sees what it is there to see."""

import numpy as np
import pytest

from benchmarks import killed_nights

TROUBLES = killed_nights.troubles()


@pytest.fixture(scope="module")
def play(tmp_path_factory):
    """A toy project after its first night; each trouble leaves it with a champion and mended."""
    return killed_nights.begun(tmp_path_factory.mktemp("killed") / "toy")


@pytest.fixture
def number(play):
    """The next night's: each challenger is better by 6 % than the one before."""
    play.woken.unlink(missing_ok=True)
    return 1 + len(list((play.project.folder / "datasets/raw/toy").glob("shift_*.csv")))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["state_types", "lock_markers", "params_unknown_key", "webhook_refuses"])
def test_in_trouble_the_champion_stays_somebody_is_woken_and_the_next_night_works(play, number, name):
    outcome = killed_nights.troubled(play, TROUBLES[name], number)
    assert outcome.passed, outcome


@pytest.mark.slow
def test_a_night_that_is_killed_once_its_stages_are_done_promotes_whole_or_not_at_all(play, number):
    rng = np.random.default_rng(2)
    assert rng.uniform() < killed_nights.LATE  # this one waits for the stages
    one = killed_nights.kill(play, number, np.random.default_rng(2), killed_nights.Pace(4.0, 1.0))
    assert one.late and one.passed, one


@pytest.mark.slow
def test_a_night_that_is_in_no_trouble_is_not_taken_for_one_that_stood_it(play, number):
    calm = killed_nights.troubled(
        play, killed_nights.Trouble(lambda _: ({}, lambda: None), "trouble"), number
    )
    assert not any((calm.champion_same, calm.status_1, calm.woken, calm.named, calm.passed)), calm


@pytest.mark.slow
def test_a_cause_that_is_not_named_is_seen(play, number):
    trouble = killed_nights.Trouble(TROUBLES["params_unknown_key"].spoil, "the moon")
    assert not killed_nights.troubled(play, trouble, number).named
