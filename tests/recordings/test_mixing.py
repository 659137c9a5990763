import numpy as np
import pytest

from pipeline.recordings.quality import alternate, find_mixed
from pipeline.recordings.recordings import Raw, resample


def course(samples: int = 600, seed: int = 0, noise: float = 0.05) -> np.ndarray:
    """A temperature that follows a heater which is switched every 100 samples."""
    rng = np.random.default_rng(seed)
    heat, y = np.repeat(rng.choice([20.0, 40.0, 60.0], samples // 100), 100), np.full(samples, 25.0)
    for k in range(1, samples):
        y[k] = y[k - 1] + (20 + heat[k] - y[k - 1]) / 80
    return y + noise * rng.standard_normal(samples)


def in_turn(samples: int) -> np.ndarray:
    return np.arange(samples) % 2 == 1


WAYS = {
    "in turn": in_turn,
    "at random": lambda n: np.random.default_rng(1).random(n) < 0.4,
    "one in five": lambda n: np.random.default_rng(2).random(n) < 0.2,
    "in batches of twenty": lambda n: np.arange(n) // 20 % 2 == 1,
    "at rates that beat": lambda n: (
        np.argsort(np.argsort(np.r_[np.arange(0, n, 1.7), np.arange(0, n, 2.43)][:n])) % 3 == 0
    ),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("apart", [3.0, 15.0])
def test_two_devices_under_one_name_are_found_over_the_whole_record(way, apart):
    y = course() + apart * WAYS[way](600)
    covered = sum(last - first + 1 for first, last, _ in find_mixed(y))
    # the window that shows batches is longer than what a parabola follows where the heater is switched
    assert covered > (0.4 if "batches" in way else 0.75) * 600
    # the gap is what lies between the courses, less their noise and what they move within a window
    assert all(0.5 * apart < distance < 1.2 * apart for _, _, distance in find_mixed(y))


def test_the_place_is_where_the_second_device_writes():
    y = course()
    y[300:420] += 5 * in_turn(120)
    ((first, last, _),) = find_mixed(y)
    # to half a window of 32 samples
    assert abs(first - 300) <= 32
    assert abs(last - 419) <= 32


def test_two_devices_at_rest_are_two_and_a_coarse_sensor_between_two_steps_is_one():
    assert find_mixed(np.where(in_turn(200), 35.0, 20.0))
    rng = np.random.default_rng(0)
    for step in (0.1, 0.25, 1.0, 2.0):
        assert find_mixed(20 + step * (rng.random(500) < 0.5)) == []


@pytest.mark.parametrize("step", [0.5, 5.0, 10.0, 16.0, 50.0])
@pytest.mark.parametrize("noise", [0.2, 0.3])
def test_a_coarse_converter_that_steps_by_one_is_one_device_whatever_its_step(step, noise):
    rng = np.random.default_rng(3)
    y = 200 + step * (1.5 * np.sin(np.arange(4000) / 300) + rng.normal(0, noise, 4000))
    assert find_mixed(np.round(y / step) * step) == []


def test_what_one_device_does_is_not_mixed():
    time = np.arange(2000.0)
    for y in (
        *(course(2000, seed, noise) for seed in range(5) for noise in (0, 0.05, 1.0)),
        *(np.round(course(2000, seed) / step) * step for seed in range(5) for step in (0.1, 0.5, 2.0)),
        np.where(time < 1000, 20.0, 60.0),
        20 + 40 * (time % 500 < 250),
        10 * np.sin(time / 3),
        np.abs(time % 100 - 50),
        np.random.default_rng(0).normal(size=2000),
        np.full(2000, 20.0),
        np.where(time % 97 == 0, 85.0, course(2000)),
    ):
        assert find_mixed(y) == []


def test_what_is_mixed_is_masked_with_its_place_though_the_table_would_show_one_of_the_two():
    """On a grid of 1 s the second device, half a second later, does not appear at all."""
    time = np.arange(600) / 2
    y = course() + 8 * in_turn(600)
    u = (time // 50 % 2) * 40
    table = resample(
        Raw("rig.csv", {"u": (time, u), "y": (time, y)}, {}, []),
        sample_time_s=1.0,
        inputs=["u"],
        outputs=["y"],
    )
    (flag,) = [one for one in table.flags if one.kind == "mixed"]
    assert (flag.signal, flag.start_s, flag.end_s, flag.count) == ("y", 0.0, 299.5, 600)
    assert table.masked["y"].all()
    assert "two devices seem to write under one name; record each under a name of its own" in flag.message


def test_intervals_that_alternate_are_two_clocks_and_jitter_is_one():
    assert alternate(np.diff(np.sort(np.r_[np.arange(100.0), np.arange(100) + 0.3])))
    rng = np.random.default_rng(0)
    assert not alternate(np.diff(np.arange(200) + 0.1 * rng.standard_normal(200)))
    assert not alternate(np.ones(200))
