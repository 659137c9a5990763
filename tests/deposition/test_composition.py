"""Composition: the three composers on structures that nobody trained on, judged by the true flow; the choice
between them; materials, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.deposition.drive import UNLIMITED, Drive, follows, obeyed
from pipeline.deposition.learning import ilc, training
from pipeline.deposition.parts import basis, composition, evaluation
from pipeline.deposition.parts.composition import PartSettings, commands, compose, priority, superposition
from pipeline.deposition.parts.conformance import conform
from pipeline.deposition.parts.library import Basis, Library
from pipeline.deposition.parts.library import learned as learned_command
from pipeline.deposition.parts.pressure_advance import LEADS
from pipeline.deposition.toolpath import gcode
from pipeline.deposition.toolpath.motion import plan
from tests.deposition.trained import (
    AREA,
    CREEPING,
    INVERSE,
    NOMINAL,
    NOZZLE,
    PLANT,
    RAMP,
    TS,
    learned,
    percent_of_on_off,
    protocol,
    trainings,
)

PARTS = Path(__file__).parents[2] / "datasets" / "parts"
MACHINE = {
    "acceleration": 1000.0,
    "junction_deviation_mm": 0.05,
    "speed_limit": 100.0,
    "unset_feed": 8.0,
    "tool_change_s": 2.0,
}
PART = PartSettings(NOZZLE, AREA, RAMP, corner_deg=30.0, longest_pause_s=1.0, drive=UNLIMITED)


def composed(text, plant=PLANT, materials=None, **changes):
    program = gcode.parse(text)
    return compose(
        learned(plant),
        program,
        plan(program.moves, **MACHINE),
        PART._replace(**changes),
        materials=materials or {0: "A", 1: "B"},
    )


def of_part(name, plant=PLANT, **changes):
    return composed((PARTS / f"{name}.gcode").read_text(), plant, **changes)


LAWS = training.LawSettings(TS, UNLIMITED, ilc.HoelzleSettings(0.25, 0.03, 2, 3.0), INVERSE, 0.1)


# ---- errors on structures that were not trained (issue's bars beside them)


@pytest.mark.parametrize(("plant", "bars"), [(PLANT, (3.0, 6.0, 4.0, 6.0)), (CREEPING, (5.0, 6.0, 5.0, 6.0))])
def test_parts_pauses_and_speeds_that_were_not_trained_stay_within_the_bars(plant, bars):
    for name, bar in (("tic_tac_toe", bars[0]), ("dashes", bars[1])):
        for stream in of_part(name, plant).streams:
            assert (
                percent_of_on_off(plant, stream.u, stream.r) < bar / 2
            )  # half of the bar: one plant stands for a family
    chain = learned(plant).materials[0].chain.extruder
    for r, bar in (
        (protocol(8.0, 0.2).r, bars[2]),
        (protocol(4.0, 0.6).r, bars[3]),
        (protocol(12.0, 0.6).r, bars[3]),
    ):
        assert percent_of_on_off(plant, basis.compose(chain, r, sample_time_s=TS), r) < bar / 2


def test_the_prediction_of_each_composer_is_near_its_true_error():
    for name in ("fig9", "tic_tac_toe", "dashes"):
        made = of_part(name)
        for stream in made.streams:
            true = commands(learned(PLANT), made, stream, drive=UNLIMITED)
            assert true[stream.composer].tobytes() == stream.u.tobytes()
            for prediction in made.predictions:
                if prediction.material == stream.material:
                    error = percent_of_on_off(PLANT, true[prediction.composer], stream.r)
                    assert prediction.median == pytest.approx(
                        error, rel=0.15, abs=1.5
                    )  # predicted from trials alone
            chosen = [p for p in made.predictions if p.chosen and p.material == stream.material]
            assert len(chosen) == 1 and stream.composer == chosen[0].composer == "basis"


def test_short_lines_need_superposition_and_long_ones_do_not():
    made, library = of_part("dashes"), learned(PLANT).library
    where = (library, "A", NOZZLE, made.tasks, made.lines, 0)
    r = made.streams[0].r
    errors = [percent_of_on_off(PLANT, by(*where, samples=len(r)), r) for by in (priority, superposition)]
    assert errors[0] > 50 and errors[1] < errors[0] / 3  # notes, 5: the priority rule prints next to nothing
    made = of_part("fig9")
    where = (library, "A", NOZZLE, made.tasks, made.lines, 0)
    one, other = (by(*where, samples=len(made.streams[0].r)) for by in (priority, superposition))
    np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(one).max())  # nothing overlaps: the same


# ---- by hand


def test_the_library_composed_for_its_own_routine_is_what_was_learned():
    """A line as long as the routine's, with its pause: the composed command is
    the learned one, but for the flattened plateaus."""
    case = protocol(8.0, 0.6, on_s=11)
    made = composed(
        f"G21\nG90\nM83\nT0\nG0 X0 Y0 F480\nG1 X{8 * 11} E1 F480\nG4 P600\nG1 X{2 * 8 * 11} "
        "E1\nG0 X200\nG4 P5000"
    )
    tasks, lines = made.tasks, made.lines
    u = priority(learned(PLANT).library, "A", NOZZLE, tasks, lines, 0, samples=len(made.streams[0].r))
    command = learned_command(trainings(PLANT)[0])[0]
    begin = round(lines.begin_s[0] / TS)
    start = round(case.start_s / TS)
    composed_u, learned_u = u[begin - 20 : begin + 500], command[start - 20 : start + 500]
    assert np.linalg.norm(composed_u - learned_u) < 0.2 * np.linalg.norm(
        learned_u
    )  # Start is the mean over two pauses, and each plateau its mean


def test_where_tasks_overlap_the_higher_one_rules_and_superposition_adds_them():
    """A line of 0.5 s between Start (3, from 0.2 s before to 0.4 s after) and Stop (-5, from 0.3 s before to
    0.2 s after), Steady-State 1 at 8 mm/s."""
    columns = [
        Basis("Stop", "A", NOZZLE, 8.0, 0.0, 15, np.full(25, -5.0)),
        Basis("Start", "A", NOZZLE, 8.0, 0.0, 10, np.full(30, 3.0)),
    ]
    columns += [
        Basis("Steady-State", "A", NOZZLE, 8.0, 0.0, 0, np.ones(1)),
        Basis("No-Flow", "A", NOZZLE, 8.0, 0.0, 0, np.zeros(1)),
    ]
    made = composed("G21\nG90\nM83\nT0\nG0 X40 Y0 F480\nG1 X44 E1\nG0 X84\nG4 P3000")
    k = round(made.lines.begin_s[0] / TS)
    where = (Library(tuple(columns), TS, {}), "A", NOZZLE, made.tasks, made.lines, 0)
    by_rank, added = (by(*where, samples=len(made.streams[0].r)) for by in (priority, superposition))
    assert round((made.lines.end_s[0] - made.lines.begin_s[0]) / TS) == 25
    expected = np.repeat(
        [0.0, 3.0, -5.0, 0.0], [5, 20, 25, 5]
    )  # before; Start until Stop takes over; Stop; after
    np.testing.assert_array_equal(by_rank[k - 15 : k + 40], expected)
    # from 0.2 s to 0.4 s both: 3 + (-5 - 1); then Stop alone
    expected = np.repeat([0.0, 3.0, -3.0, -5.0, 0.0], [5, 20, 10, 15, 5])
    np.testing.assert_allclose(added[k - 15 : k + 40], expected, atol=1e-12)


def test_each_material_is_composed_by_its_own_chain_gain_and_signals():
    """B is another plant than A: beside each other both are composed as each is alone."""
    a, b = learned(PLANT), learned(CREEPING)
    b = b._replace(library=b.library._replace(marks=a.library.marks))
    columns = [one for one in a.library.columns if one.material == "A"]
    columns += [one for one in b.library.columns if one.material == "B"]
    library = a.library._replace(columns=tuple(columns))
    both = a._replace(library=library, materials=(a.materials[0], b.materials[1]))
    program = gcode.parse((PARTS / "tic_tac_toe.gcode").read_text())
    motion = plan(program.moves, **MACHINE)
    made, alone_a, alone_b = (
        compose(each, program, motion, PART, materials={0: "A", 1: "B"}) for each in (both, a, b)
    )
    assert [stream.material for stream in made.streams] == ["A", "B"]
    for k, (material, own, alone) in enumerate((("A", a, alone_a), ("B", b, alone_b))):
        stream, expected = made.streams[k], alone.streams[k]
        assert stream.composer == expected.composer
        for name in ("r", "u", "y", "on_off"):
            np.testing.assert_array_equal(getattr(stream, name), getattr(expected, name), err_msg=name)
        assert [p for p in made.predictions if p.material == material] == [
            p for p in alone.predictions if p.material == material
        ]
        by_composer = commands(both, made, stream, drive=UNLIMITED)
        for composer, u in commands(own, alone, expected, drive=UNLIMITED).items():
            np.testing.assert_array_equal(by_composer[composer], u, err_msg=composer)
    # the two plants ask for other commands: the wrong chain would show
    u, wrong = alone_b.streams[1].u, alone_a.streams[1].u
    assert np.linalg.norm(u - wrong) > 0.05 * np.linalg.norm(u)


def test_the_wanted_flow_holds_the_volume_of_every_line_and_of_no_travel():
    made = of_part("tic_tac_toe")
    for stream in made.streams:
        planned = AREA * made.lines.length[made.lines.tool == stream.tool].sum()
        assert stream.r.sum() * TS == pytest.approx(planned, rel=1e-9)
        assert stream.unshaped.sum() * TS == pytest.approx(planned, rel=1e-9)
    assert not np.any((made.streams[0].r > 0) & (made.streams[1].r > 0))


def test_where_nothing_is_wanted_nothing_is_left_of_rounding_and_the_tasks_end_with_the_signal():
    made = of_part("fig9")
    for stream in (*made.streams, *of_part("tic_tac_toe").streams, *of_part("dashes").streams):
        assert stream.r[stream.r > 0].min() > 1e-9 * stream.r.max()
        assert (stream.r == 0).any()
    assert made.tasks.end_s.max() == pytest.approx(len(made.streams[0].r) * TS)


def test_the_learned_percent_is_of_the_steady_flow():
    of = learned(PLANT).materials[0]
    errors = []
    for one in trainings(PLANT):
        if one.material == of.material:
            y = learned_command(one)[1]
            errors.append(np.nanmean(((y - one.r) / one.r.max()) ** 2))
    raw = 100 * np.sqrt(np.mean(errors))  # without the means over 0.2 s, which take noise off
    assert 0.3 * raw < of.learned_percent < 1.05 * raw


def test_a_long_job_is_judged_on_its_first_minutes_with_the_clock_of_these(monkeypatch):
    monkeypatch.setattr(composition, "EXCERPT_S", 12.0)
    lines = "".join(f"G1 X{40 * k + 24} E1 F480\nG0 X{40 * k + 40}\n" for k in range(1, 12))
    made = composed(f"G21\nG90\nM83\nT0\nG0 X40 Y0 F480\nG4 P30000\n{lines}")
    share = composition.ToolShare(0, learned(PLANT).materials[0], made.streams[0].r, made.tasks, made.lines)
    excerpt = composition._excerpt(share, TS)
    begin = int(np.argmax(share.r > 0)) - round(composition.MARGIN_S / TS)
    np.testing.assert_array_equal(excerpt.r, share.r[begin : begin + round(12 / TS)])
    late = made.lines.begin_s > (begin + 12 / TS) * TS + 0.1
    early = made.lines.begin_s < begin * TS - 0.1
    assert late.any() and not early.any()
    np.testing.assert_allclose(excerpt.lines.begin_s, made.lines.begin_s[~late] - begin * TS)
    np.testing.assert_allclose(excerpt.lines.end_s, made.lines.end_s[~late] - begin * TS)
    assert excerpt.tasks.begin_s.max() <= 12.1 and (excerpt.tasks.begin_s > -0.1).all()
    for line_begin in excerpt.lines.begin_s:
        at = round(line_begin / TS)
        assert at + 5 >= len(excerpt.r) or excerpt.r[at + 5] > excerpt.r[at - 10]


def test_a_command_that_the_drive_cannot_follow_is_sent_ahead_by_delay_and_lag():
    made = of_part("fig9")
    material = learned(PLANT).materials[0]
    chain = material.chain._replace(extruder=material.chain.extruder._replace(delay_s=0.3))
    r = np.repeat([0.0, 1.0, 0.0], [200, 400, 200])
    share = composition.ToolShare(0, material._replace(chain=chain), r, made.tasks, made.lines)
    sent = composition._sent_ahead(share, TS)
    ahead = 200 - int(np.argmax(sent > 0.5))
    assert ahead == pytest.approx((0.3 + basis.mean_lag_s(chain.extruder)) / TS, abs=1)
    assert ahead >= 14


def test_lines_shorter_than_a_millimetre_are_wanted_too():
    steps = "".join(f"G1 X{20 + 0.5 * k:g} E1\n" for k in range(1, 21))
    made = composed(f"G21\nG90\nM83\nT0\nG0 X20 Y0 F480\nG1 F480\n{steps}G0 X84\nG4 P3000")
    assert len(made.lines.line) == 20 and made.lines.length.max() < 1.0
    assert made.streams[0].r.sum() * TS == pytest.approx(AREA * 10.0, rel=1e-9)


def test_a_line_that_begins_at_once_is_given_the_time_for_its_lead():
    made = composed("G21\nG90\nM83\nT0\nG1 X20 E1 F480\nG0 X0")
    assert made.lead_in_s == pytest.approx(2.0)
    assert made.lines.begin_s[0] == pytest.approx(2.0)
    assert made.tasks.task[0] == "No-Flow"


@pytest.mark.parametrize("part", ["fig9", "dashes"])
def test_every_composed_command_follows_and_beats_one_that_is_obeyed_as_it_comes(part):
    drive = Drive(10.0, 20.0, 0.0)
    made = of_part(part)
    for stream in made.streams:
        slow, free = (commands(learned(PLANT), made, stream, drive=one) for one in (drive, UNLIMITED))
        for composer, u in slow.items():
            assert not follows(free[composer], drive, sample_time_s=TS)
            assert follows(u, drive, sample_time_s=TS)
            slewed = obeyed(free[composer], drive, sample_time_s=TS)
            near, cut = (percent_of_on_off(PLANT, v, stream.r) for v in (u, slewed))
            print(part, composer, near, cut)
            if composer not in ("priority", *LEADS):  # a firmware does not plan around its drive
                assert near < 0.9 * cut, composer


def test_the_limit_is_kept_and_its_share_reported():
    made = of_part("fig9", drive=Drive(15.0, np.inf, 0.0))
    stream = made.streams[0]
    assert np.abs(stream.u).max() <= 15.0 and stream.saturated > 0
    assert stream.saturated == np.mean(np.abs(stream.u) >= 0.999 * 15.0)


def test_the_same_inputs_give_the_same_bytes():
    one, other = of_part("dashes"), of_part("dashes")
    assert one.streams[0].u.tobytes() == other.streams[0].u.tobytes() and one.predictions == other.predictions


# ---- refusals


def test_a_tool_without_a_material_and_a_material_that_was_not_learned_are_refused_with_the_line():
    text = (PARTS / "tic_tac_toe.gcode").read_text()
    with pytest.raises(
        ValueError,
        match=r"line \d+: T1 prints but has no material; expected one of tools \[0\], or name its material",
    ):
        composed(text, materials={0: "A"})
    with pytest.raises(
        ValueError,
        match=re.escape(
            "T1 prints C with a nozzle of 0.6 mm, but what was learned is A with 0.6 mm, "
            "B with 0.6 mm; train it first"
        ),
    ):
        composed(text, materials={0: "A", 1: "C"})
    with pytest.raises(ValueError, match="T0 prints A with a nozzle of 0.4 mm"):
        composed(text, nozzle_mm=0.4)


def test_a_program_that_would_jump_from_steady_state_to_no_flow_is_refused_with_its_line():
    program = gcode.parse("G21\nG90\nM83\nT0\nG0 X10 F480\nG1 X20 E1\nT1\nG1 X30 E1\nG0 X0")
    motion = plan(program.moves, **{**MACHINE, "tool_change_s": 0.0})
    # the rest of Stop behind the one line, and the lead of Start ahead of the other
    marks = learned(PLANT).library.marks
    switch_s = marks["Stop"][1] + marks["Start"][0]
    with pytest.raises(
        ValueError,
        match=(
            "line 7: T1 comes 0.00 s after line 6 still printed with T0, so Steady-State would go to "
            f"No-Flow without a Stop; expected {switch_s:.2f} s between them: write G4 P{1000 * switch_s:.0f}"
        ),
    ):
        compose(learned(PLANT), program, motion, PART, materials={0: "A", 1: "B"})


def test_on_a_machine_whose_flow_nobody_knows_a_composer_scores_the_upper_end_of_its_forecast():
    made = of_part("dashes")
    plain = evaluation.Judging({"A": NOMINAL}, {}, LAWS, training.Noise(0, 0, 0), 1, AREA, 0.4)
    checks = conform(
        made, learned(PLANT), bead_area_mm2=AREA, ramp_s=RAMP, drive=UNLIMITED, shortest_s=0.4,
        largest_error_percent=20.0,
    )  # fmt: skip
    scores, prints = evaluation.evaluate(learned(PLANT), made, checks.lines, plain, np.random.default_rng(0))
    assert not prints  # no print of a real machine tells its true flow
    told = {prediction.composer: prediction for prediction in made.predictions}
    assert {score.composer for score in scores} == {"on_off", *told}
    for score in scores[1:]:
        assert score.rms_percent_of_on_off == told[score.composer].high > score.predicted_percent
    # and the line furthest off is that of the interval, not that of the chain that made the command
    ends = np.abs([checks.lines.low_percent, checks.lines.high_percent]).max()
    assert np.all(checks.lines.low_percent <= checks.lines.high_percent)
    chosen = next(score for score in scores if score.chosen)
    assert chosen.worst_line_volume_percent == ends > checks.worst_line_volume_percent
    # a forecast that may not be believed tells no volume either
    doubtful = [one._replace(judged=one.judged._replace(judged=False)) for one in made.streams]
    made = made._replace(streams=tuple(doubtful))
    scores, _ = evaluation.evaluate(learned(PLANT), made, checks.lines, plain, np.random.default_rng(0))
    assert np.isnan([score.worst_line_volume_percent for score in scores]).all()


def test_the_last_print_of_a_part_that_is_learned_itself_is_its_score_and_the_first_comes_after_on_off():
    made, library = of_part("dashes"), learned(PLANT)
    noise = training.Noise(0.01, 0.01, 0.01)
    judging = evaluation.Judging({"A": NOMINAL}, {"A": PLANT}, LAWS, noise, 3, AREA, 0.4)
    checks = conform(
        made, library, bead_area_mm2=AREA, ramp_s=RAMP, drive=UNLIMITED, shortest_s=0.4,
        largest_error_percent=20.0,
    )  # fmt: skip
    scores, prints = evaluation.evaluate(library, made, checks.lines, judging, np.random.default_rng(0))
    assert [one.prints for one in prints] == [1, 2, 3, 4]
    assert prints[0].rms_percent_of_on_off > prints[-1].rms_percent_of_on_off
    by_name = {score.composer: score.rms_percent_of_on_off for score in scores}
    assert prints[-1].rms_percent_of_on_off == pytest.approx(by_name["ilc"])
    # what the whole library taught is what the scores say
    then = evaluation.learned_from(library, made, judging, [8])
    assert {one.prints for one in then} == {8}
    assert {one.composer: one.rms_percent_of_on_off for one in then} == pytest.approx(
        {name: error for name, error in by_name.items() if name not in ("on_off", "ilc")}
    )


def test_the_composer_with_the_least_upper_end_is_chosen():
    for name in ("fig9", "dashes"):
        told = of_part(name).predictions
        for material in {prediction.material for prediction in told}:
            mine = [prediction for prediction in told if prediction.material == material]
            assert [one for one in mine if one.chosen] == [min(mine, key=lambda one: one.high)]
