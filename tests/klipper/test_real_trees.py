"""The exported module in the host programs of Klipper and Kalico themselves, in virtual time (trees.py)."""

import numpy as np
import pytest

from pipeline.deploy import to_klipper
from tests.deploy.deployed_machines import passed
from tests.klipper import trees
from tests.klipper.machines import HOT_ENDS, TARGET_DEGC, exported

pytestmark = pytest.mark.klipper
HEATED = [["gcode", f"M104 S{TARGET_DEGC:g}"], ["wait", 300]]
OBJECTS = ["extruder", "beadline"]
OWN_PID = [22.2, 1.08, 114.0]  # of trees.PRINTER


@pytest.fixture(scope="session", params=["kalico", "klipper", "named"])
def firmware(request):
    try:
        return trees.tree(request.param)
    except trees.Missing as reason:
        pytest.skip(str(reason))


def played(
    firmware, folder, steps, *, parts=HOT_ENDS[3], told=True, change=lambda text: text, module=True, **options
):
    """What came of the steps, with the exported module and its settings as they are exported."""
    of, files, settings = exported(parts, told=told), {}, ""
    if module:
        files, settings = (
            to_klipper.module(of, passed(of)),
            to_klipper.settings(of, passed(of), section="extruder"),
        )
    folder.mkdir(exist_ok=True)
    tree = trees.with_module(firmware, folder, files)
    return trees.play(tree, folder, steps, config=change(settings), parts=parts._asdict(), **options)


def block(out) -> tuple[np.ndarray, np.ndarray]:
    """Seconds since the start (T,) and true temperature of the block (T,)."""
    trace = np.array(out["trace"])
    return trace[:, 0] - trace[0, 0], trace[:, 1]


def test_it_drives_the_heater_and_answers_subscribers(firmware, tmp_path):
    steps = [
        ["subscribe", OBJECTS],
        *HEATED,
        ["status", OBJECTS],
        ["gcode", "M104 S0"],
        ["wait", 30],
        ["status", OBJECTS],
    ]
    out = played(firmware, tmp_path, steps)
    assert out["states"][-1] == ["Printer is ready", "ready"]
    hot, off = out["answers"][3], out["answers"][6]
    assert hot["beadline"]["mode"] == "law" and abs(hot["extruder"]["temperature"] - TARGET_DEGC) < 0.6
    assert off["beadline"]["mode"] == "watches" and off["extruder"]["power"] == 0.0
    # a subscriber hears of what changes, at most four times a second
    assert off["sent"] > 600
    time_s, y = block(out)
    assert y.max() < TARGET_DEGC + 5 and out["cpu_s"] < 5.0


@pytest.mark.parametrize(
    ("disturb", "rest"), [([["gcode", "M106 S255"], ["wait", 120]], "fan"), ([["feed", 3, 60]], "feed")]
)
def test_a_fan_and_filament_that_are_told_dip_at_most_half_as_much(firmware, tmp_path, disturb, rest):
    dips = []
    for told in (True, False):
        out = played(firmware, tmp_path / str(told), [*HEATED, *disturb], told=told)
        time_s, y = block(out)
        assert out["states"][-1][1] == "ready"
        dips.append(TARGET_DEGC - y[time_s > 298].min())
    assert 0.0 < dips[0] <= 0.5 * dips[1]


def test_what_is_told_is_the_mean_over_a_sample(firmware, tmp_path):
    steps = [*HEATED, ["gcode", "M106 S102"], ["wait", 10], ["feed", 3, 20], ["status", ["beadline"]]]
    told = played(firmware, tmp_path, steps)["answers"][-1]["beadline"]["disturbances"]
    assert told["part_fan"] == pytest.approx(40, abs=0.1) and told["feed"] == pytest.approx(3, abs=0.1)


def test_filament_that_moves_again_after_a_rest_is_told_as_it_moves(firmware, tmp_path):
    """The firmware forgets where an extruder stands that has not moved for some time."""
    rests = [step for k in range(12) for step in (["feed", 3, 10], ["wait", 45.0 + 0.13 * k])]
    steps = [["listen"], *HEATED, *rests, ["feed", 3, 30], ["heard"]]
    told = np.array(played(firmware, tmp_path, steps)["answers"][-1]["told"], float)
    assert told[-20:-5, 1].mean() == pytest.approx(3.0, abs=0.1)
    assert told[:, 1].min() >= 0.0 and told[:, 1].max() < 12.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "disturbance_part_fan: fan",
            "# no fan",
            "no option disturbance_part_fan, which the controller is told in percent",
        ),
        (
            "disturbance_part_fan: fan",
            "disturbance_part_fan: fan_generic side",
            "is fan_generic side, but no such object",
        ),
        (
            "disturbance_feed: extruder",
            "disturbance_feed: fan",
            "disturbance_feed is fan, but no such object gives it in mm/s",
        ),
        (
            "[beadline]",
            "max_power: 0.7\n[beadline]",
            "max_power of extruder is 0.7 but the controller is certified for 1",
        ),
        ("plant: ", "plant: 0", "certificate is of another plant"),
        ("heater: extruder", "heater: chamber", "Unknown heater 'chamber'"),
    ],
)
def test_settings_that_do_not_fit_are_a_config_error(firmware, tmp_path, old, new, message):
    out = played(firmware, tmp_path, [["wait", 1]], change=lambda text: text.replace(old, new, 1))
    assert message in out["states"][0][0] and out["states"][0][1] == "error"


def test_a_disturbance_that_nothing_measures_is_not_told(firmware, tmp_path):
    out = played(
        firmware,
        tmp_path,
        [*HEATED, ["status", OBJECTS]],
        change=lambda text: text.replace("disturbance_feed: extruder", "disturbance_feed: none"),
    )
    assert out["answers"][-1]["beadline"]["disturbances"] == {"part_fan": 0.0, "feed": None}
    assert out["answers"][-1]["beadline"]["mode"] == "law"


def test_a_missing_numpy_is_one_sentence(firmware, tmp_path):
    if firmware.name == "kalico":
        pytest.skip("Kalico itself does not start without numpy")
    out = played(firmware, tmp_path, [["wait", 1]], without=["numpy"])
    assert out["states"][0][1] == "error" and "Internal error" not in out["states"][0][0]
    sentence = out["states"][0][0].splitlines()[0]
    assert sentence.startswith("[beadline]: ") and "install numpy" in sentence


@pytest.mark.parametrize("what", ["slow", "loose", "stuck", "dead"])
def test_a_sensor_or_a_heater_that_fails_ends_in_off_or_shutdown(firmware, tmp_path, what):
    """While the target changes by 10 degC every two minutes; the block stays below what the parts bear."""
    moves = [step for k in range(8) for step in (["gcode", f"M104 S{200 + 10 * (k % 2)}"], ["wait", 120])]
    out = played(firmware, tmp_path, [*HEATED, ["fail", what], *moves, ["status", OBJECTS]])
    shut_down = any(state[1] == "shutdown" for state in out["states"])
    assert shut_down or out["answers"][-1]["beadline"]["mode"] == "off"
    duty, hottest = np.array(out["trace"])[:, 4], block(out)[1].max()
    assert duty[-1] == 0.0 and hottest < 300.0


@pytest.mark.parametrize("how", ["raises", "asks for no number"])
def test_a_controller_that_fails_gives_the_heater_back_to_its_pid(firmware, tmp_path, how):
    steps = [*HEATED, ["break", how], ["wait", 200], ["status", OBJECTS], ["pid"]]
    out = played(firmware, tmp_path, steps)
    assert out["states"][-1][1] == "ready" and out["answers"][-2]["beadline"]["mode"] == "own control"
    assert out["answers"][-1] == pytest.approx(OWN_PID)
    time_s, y = block(out)
    # the PID of a heater that nobody tuned; it starts from the duty that there was
    assert np.abs(y[time_s > 300] - TARGET_DEGC).max() < 4.0


def test_it_steps_once_a_sample_of_its_own_however_often_the_sensor_reports(firmware, tmp_path):
    times = played(firmware, tmp_path, [["listen"], *HEATED, ["heard"]])["answers"][-1]["times"]
    # 1 s between reports of 0.3 s
    assert 295 < len(times) <= 301 and np.abs(np.diff(times) - 1.0).max() < 1e-6


def test_pid_calibrate_save_config_and_restart_while_hot_keep_the_heater_s_own_pid(firmware, tmp_path):
    tune = [["gcode", f"PID_CALIBRATE HEATER=extruder TARGET={TARGET_DEGC:g}"], ["gcode", "SAVE_CONFIG"]]
    pids, texts = [], []
    for module in (True, False):
        folder = tmp_path / str(module)
        steps = [["pid"], *tune, ["pid"], *HEATED, ["gcode", "RESTART"], ["pid"], *HEATED, ["pid"]]
        out = played(firmware, folder, steps, module=module)
        assert out["states"][-1][1] == "ready" and out["starts"] == 3
        pids.append([answer for answer in out["answers"] if isinstance(answer, list)])
        texts.append((folder / "printer.cfg").read_text())
        time_s, y = block(out)
        assert abs(y[-1] - TARGET_DEGC) < 1.0 and y.max() < TARGET_DEGC + 12
    assert pids[0][0] == pytest.approx(OWN_PID) and pids[0][1] != pids[0][0]
    assert pids[0] == pids[1]
    # the owner's file differs by our section alone, and the module removed leaves the tuned PID
    saved = [text[text.index("#*#") :] for text in texts]
    assert saved[0] == saved[1]
    config = tmp_path / "True/printer.cfg"
    config.write_text(
        config.read_text().replace(texts[0][texts[0].index("# heater and") : texts[0].index("#*#")], "\n")
    )
    trees.with_module(firmware, tmp_path / "gone", {})
    out = trees.play(firmware, tmp_path / "True", [["pid"], *HEATED], parts=HOT_ENDS[3]._asdict())
    assert out["answers"][0] == pids[0][-1] and out["states"][-1][1] == "ready"
    assert not (tmp_path / "True" / to_klipper.FILE).exists()


def test_a_fan_under_pi_with_feed_forward_beside_pid_calibrate(firmware, tmp_path):
    """Six hot ends, gain 20 % short: dip of the block when the fan comes on, r.m.s. error while it goes on
    and off, and overshoot at the start. Untold, the same PI dips 2 to 3 times as far as PID_CALIBRATE."""
    tune = [["gcode", f"PID_CALIBRATE HEATER=extruder TARGET={TARGET_DEGC:g}"], ["gcode", "SAVE_CONFIG"]]
    disturb = [["gcode", "M106 S255"], ["wait", 150], ["gcode", "M107"], ["wait", 150]]
    figures = np.empty((len(HOT_ENDS), 2, 3))
    for i, parts in enumerate(HOT_ENDS):
        for j, before in enumerate(([], tune)):
            steps, folder = [*before, *HEATED, *disturb], tmp_path / f"{i}{j}"
            out = played(firmware, folder, steps, parts=parts, module=not before)
            assert out["states"][-1][1] == "ready"
            time_s, y = block(out)
            last_s = time_s[-1] - time_s
            error = y[last_s < 300] - TARGET_DEGC
            overshoot = y[(last_s > 300) & (last_s < 600)].max() - TARGET_DEGC
            figures[i, j] = -error.min(), np.sqrt((error**2).mean()), overshoot
    dip, rms = (figures[:, 0, :2] / figures[:, 1, :2]).T
    # a PID with derivative reacts faster to the fifth that is left
    assert dip.max() < 1.7 and rms.max() < 1.75 and figures[:, 0, 2].max() < 1.0, figures.round(2).tolist()
