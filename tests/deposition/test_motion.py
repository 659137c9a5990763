"""The gantry's travel in time: limits kept, way conserved, the closed-form look-ahead
against passes move by move, corners and arcs by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.deposition.toolpath import motion
from pipeline.deposition.toolpath.gcode import Kind, parse

LIMITS = {
    "acceleration": 500.0,
    "junction_deviation_mm": 0.02,
    "speed_limit": 60.0,
    "unset_feed": 25.0,
    "tool_change_s": 1.5,
}
A = LIMITS["acceleration"]


def planned(text, **changes):
    moves = parse(text).moves
    return moves, motion.plan(moves, **(LIMITS | changes))


@st.composite
def programs(draw):
    """Lines, arcs, retracts, dwells and tool changes with lengths from a
    hundredth to a hundred mm and feeds from 1 to 100 mm/s."""
    step = st.sampled_from([0.01, -0.02, 0.3, 1.0, -5.0, 40.0, -100.0])
    line = st.builds(
        "G1 X{} Y{} E{} F{}".format, step, step, st.sampled_from([0, 0.5]), st.sampled_from([60, 480, 6000])
    )
    arc = st.builds(
        "G{} X{} Y0 I{} J0.1".format, st.sampled_from([2, 3]), st.sampled_from([0, 2]), st.just(1)
    )
    other = st.sampled_from(
        ["G1 E-2 F1800", "G1 E2", "G4 P300", "T1", "T0", "G0 Z0.3 F600", "M204 S100", "G3 I0.5 Z0.4"]
    )
    return "M83\nG91\nG1 X1 F900\n" + "\n".join(
        draw(st.lists(st.one_of(line, line, arc, other), max_size=25))
    )


@settings(max_examples=80, deadline=None)
@given(programs())
def test_no_limit_is_broken_and_no_way_is_lost(program):
    moves, plan = planned(program)
    runs = moves.length > 0
    v = np.stack([plan.entry, plan.cruise, plan.exit])
    feed = np.where(np.isfinite(moves.feed), moves.feed, LIMITS["unset_feed"])
    assert (v <= np.minimum(feed, LIMITS["speed_limit"]) + 1e-9).all()  # rounding of roots
    np.testing.assert_allclose(plan.exit[:-1], plan.entry[1:], atol=1e-9)
    assert plan.exit[-1] == plan.entry[0] == 0
    flat = plan.duration_s - plan.ramp_s.sum(axis=0)
    way = (plan.ramp_s * (v[[0, 2]] + v[1]) / 2).sum(axis=0) + v[1] * flat
    np.testing.assert_allclose(way[runs], moves.length[runs], rtol=1e-9)  # rounding of the sums of 2 a l
    np.testing.assert_allclose(
        (v[1] - v[[0, 2]])[:, runs], (plan.acceleration * plan.ramp_s)[:, runs], atol=1e-9
    )
    assert (plan.acceleration <= A).all() and (flat >= -1e-12).all() and (plan.ramp_s >= 0).all()
    assert plan.duration_s[runs].sum() >= (moves.length / feed)[runs].sum() * (1 - 1e-12)


@settings(max_examples=60, deadline=None)
@given(programs())
def test_samples_follow_the_plan(program):
    moves, plan = planned(program)
    Ts = 0.005
    signal = motion.sampled(plan, moves, sample_time_s=Ts)
    end = plan.begin_s[-1] + plan.duration_s[-1]
    assert 0 < end - signal.time_s[-1] <= Ts * (1 + 1e-9)
    for amount in (moves.e, moves.length):
        spent = motion.rate(signal, amount, sample_time_s=Ts)
        assert spent.sum() * Ts == pytest.approx(amount.sum(), rel=1e-12, abs=1e-12)
    mean = motion.rate(signal, moves.length, sample_time_s=Ts)
    less = motion.sampled(plan, moves, sample_time_s=Ts, rates_only=True)
    np.testing.assert_array_equal(motion.rate(less, moves.length, sample_time_s=Ts), mean)
    # the mean speed over a sample lies within a Ts / 2 of the trapezoid's at
    # both ends, and more only where a ramp turns inside
    np.testing.assert_allclose(mean[:-1], (signal.speed[1:] + signal.speed[:-1]) / 2, atol=A * Ts / 2)
    assert np.abs(np.diff(signal.speed)).max(initial=0) <= A * Ts * (1 + 1e-9)
    # a chord is never longer than its path
    assert (np.linalg.norm(np.diff(signal.position, axis=0), axis=1) <= mean[:-1] * Ts + 1e-9).all()


def naive_look_ahead(cap, gain):
    v = np.append(cap, 0.0)
    for i in range(len(cap) - 1, -1, -1):
        v[i] = min(v[i], v[i + 1] + gain[i])
    for i in range(len(cap)):
        v[i + 1] = min(v[i + 1], v[i] + gain[i])
    return v[:-1], v[1:]


@pytest.mark.parametrize("seed", range(5))
def test_the_closed_form_of_the_look_ahead_is_a_backward_and_a_forward_pass(seed):
    rng = np.random.default_rng(seed)
    cap, gain = (
        rng.choice([0.0, 25.0, 900.0, 3600.0], 500),
        rng.exponential(200.0, 500) * rng.choice([0.01, 1], 500),
    )
    np.testing.assert_allclose(
        motion._look_ahead(cap, gain), naive_look_ahead(cap, gain), atol=1e-9
    )  # sums of 1e5


def test_a_single_line_is_a_trapezoid():
    moves, plan = planned("G1 X10 F600", acceleration=100.0)
    assert plan.duration_s == pytest.approx(1.1)  # 10 mm at 10 mm/s, and half of two ramps of 0.1 s each
    signal = motion.sampled(plan, moves, sample_time_s=0.05)
    np.testing.assert_allclose(signal.speed[[0, 1, 2, 10, 20, 21]], [0, 5, 10, 10, 10, 5], atol=1e-9)
    np.testing.assert_allclose(signal.position[[1, 2, 10], 0], [0.125, 0.5, 4.5], atol=1e-9)


def test_a_line_too_short_for_its_feed_is_a_triangle():
    _, plan = planned("G1 X1 F6000", acceleration=100.0)
    assert plan.cruise == pytest.approx(10.0) and plan.duration_s == pytest.approx(0.2)  # v^2 = a l


@pytest.mark.parametrize(("corner", "speed"), [("X20 Y0", 20.0), ("X10 Y10", 5.0), ("X0 Y0", 0.0)])
def test_corners_straight_on_square_and_back(corner, speed):
    deviation = (
        5.0**2 * (np.sqrt(2.0) - 1.0) / A
    )  # at which a square corner is passed at 5 mm/s, by Klipper's conversion
    _, plan = planned(f"G1 X10 F1200\nG1 {corner}", junction_deviation_mm=deviation)
    assert plan.entry[1] == pytest.approx(speed, abs=1e-6)


def test_an_arc_keeps_its_centripetal_limit_up_to_its_ends():
    _, plan = planned("G0 X10 F6000\nG3 X10 Y0 I-1 J0\nG1 X20", acceleration=100.0, junction_deviation_mm=1.0)
    assert plan.cruise[1] == pytest.approx(10.0)  # v^2 = a r
    assert plan.entry[1] <= 10.0 + 1e-9 >= plan.exit[1]
    assert plan.turn[1] == pytest.approx(np.pi / 2) and plan.turn[2] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("arc", ["G3 X12 Y2 I0 J2", "G2 X12 Y-2 I0 J-2"])
def test_an_arc_that_goes_on_in_the_lines_direction_is_no_corner(arc):
    _, plan = planned(f"G1 X10 F600\n{arc}\n", junction_deviation_mm=0.0)
    assert plan.turn[1] == pytest.approx(0.0, abs=1e-9) and plan.entry[1] == pytest.approx(10.0)


def test_a_corner_between_two_accelerations_takes_the_lower():
    _, plan = planned("G1 X10 F6000\nM204 S100\nG1 Y10\n", junction_deviation_mm=0.1)
    assert plan.entry[1] == pytest.approx(np.sqrt(100 * 0.1 * (np.sqrt(2) + 1)))
    _, plan = planned("M204 S100\nG1 X10 F6000\nM204 S400\nG1 Y10\n", junction_deviation_mm=0.1)
    assert plan.entry[1] == pytest.approx(np.sqrt(100 * 0.1 * (np.sqrt(2) + 1)))


def test_a_circle_in_short_legs_is_no_faster_than_the_circle():
    h = np.linspace(0, 4 * np.pi, 400)
    legs = "\n".join(f"G1 X{2 * np.cos(k):.6f} Y{2 * np.sin(k):.6f}" for k in h)
    _, plan = planned(f"G1 X2 F6000\n{legs}", junction_deviation_mm=0.5)
    assert plan.cruise[100:300].max() == pytest.approx(
        np.sqrt(A * 2), rel=0.02
    )  # legs of 0.063 mm: junction and half a leg of speeding up


def test_dwells_tool_changes_and_retracts_stand_still():
    moves, plan = planned("M83\nG1 X10 F600\nG4 P250\nT1\nG1 E-3 F1800\nG1 X20")
    signal = motion.sampled(plan, moves, sample_time_s=0.01)
    assert [Kind(k).name for k in moves.kind] == ["TRAVEL", "DWELL", "TOOL", "RETRACT", "TRAVEL"]
    assert plan.duration_s[1:3].tolist() == [0.25, 1.5]
    assert plan.duration_s[3] == pytest.approx(0.1 + 30 / A)  # 3 mm of filament at 30 mm/s
    still = np.isin(signal.move, [1, 2, 3])
    assert (signal.speed[still] == 0).all() and (np.ptp(signal.position[still], axis=0) == 0).all()
    assert motion.rate(signal, moves.e, sample_time_s=0.01)[signal.move == 3].min() == pytest.approx(-30.0)


def test_the_programs_own_acceleration_counts_where_it_is_lower():
    _, plan = planned("M204 S100\nG1 X10 F600\nM204 S9000\nG1 X20")
    assert plan.acceleration.tolist() == [100.0, A]


def test_an_empty_program_is_an_empty_plan():
    moves, plan = planned("M104 S200")
    assert len(motion.sampled(plan, moves, sample_time_s=0.02).time_s) == 0


@pytest.mark.parametrize("name", ["acceleration", "speed_limit", "unset_feed"])
def test_limits_must_be_positive(name):
    with pytest.raises(ValueError, match=f"expected {name} > 0, found 0; set it"):
        planned("G1 X1", **{name: 0.0})


def test_a_feed_that_is_a_slip_is_named_with_its_line():
    moves, plan = planned("G1 X1 F600\nG1 X50 F.001\n")
    with pytest.raises(
        ValueError, match="expected at most 278 h, found .* h, of which line 2 takes .* s; check its F"
    ):
        motion.sampled(plan, moves, sample_time_s=0.02)


def test_printed_moves_change_speed_no_faster_than_asked_and_rest_beside_travel():
    text = "M83\nG91\nG1 X20 E1 F600\nG0 X20\nG1 X20 E1\nG1 Y20 E1\nG0 Y20"
    moves, plan = planned(text, printing_acceleration=5.0)
    prints = moves.kind == Kind.EXTRUDE
    assert prints.tolist() == [True, False, True, True, False]
    np.testing.assert_array_equal(plan.acceleration[prints], 5.0)
    np.testing.assert_array_equal(plan.acceleration[~prints], A)
    # straight on from printing to travel, where nothing else would slow it down
    assert plan.exit[0] == plan.entry[1] == plan.exit[1] == plan.entry[2] == 0.0
    # 10 mm/s need 10 mm each way: the first line just comes to its feed, in 2 s
    assert plan.cruise[0] == pytest.approx(10.0) and plan.ramp_s[0, 0] == pytest.approx(2.0)
    # the corner itself is the gantry's own
    quick = planned(text)[1]
    assert plan.exit[2] == pytest.approx(quick.exit[2]) and 0 < plan.exit[2] < 10
    assert quick.exit[0] == pytest.approx(10.0)
