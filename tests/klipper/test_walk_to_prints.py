"""One owner's walk from klippy.log to prints, in both firmwares; owner.py walks with as many as you like."""

import json

import pytest

from tests.klipper import owner, trees

pytestmark = pytest.mark.klipper
SEED = 902


@pytest.fixture(scope="session")
def both():
    try:
        return [trees.tree("kalico"), trees.tree("klipper")]
    except trees.Missing as reason:
        pytest.skip(str(reason))


def test_a_klippy_log_leads_to_prints_better_than_under_pid_calibrate(both, tmp_path):
    printer = owner.draw(SEED)
    made = owner.make(both[0], tmp_path, printer)
    assert made["files"], made["why"]
    assert made["hottest_degC"] < 300 - 15
    for tree in both:
        pid, ours = (
            owner.printing(tree, tmp_path / f"{tree.name}_{name}", printer, exported)
            for name, exported in (("pid", None), ("ours", tmp_path / "klipper"))
        )
        told = json.dumps([pid, ours])
        assert not ours["shut_down_within"] and len(ours["modes"]) == 1, told
        assert ours["dip_degC"] <= pid["dip_degC"] and ours["rms_degC"] <= pid["rms_degC"], told
