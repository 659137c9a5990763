"""Page one's sentence: what is claimed of each loop, in few words."""

from pipeline.report.shared.headline import Loop, decision, state


def three(*states):
    return [
        Loop(name, one) for name, one in zip(("temperature", "deposition", "setpoint"), states, strict=True)
    ]


def test_the_sentence_names_every_loop_once_by_what_may_be_done_with_it():
    assert decision(three("passed", "passed", "passed")) == "Pass (simulation): all three loops."
    assert (
        decision(three("passed", "passed", "failed"))
        == "Pass (simulation): temperature and deposition; fail: setpoint."
    )
    assert (
        decision(three("failed", "open", "not measured"))
        == "Fail (simulation): temperature; undecided: deposition; not measured: setpoint."
    )
    assert decision(three("failed", "failed", "failed")) == "Fail (simulation): all three loops."
    assert (
        decision(three("open", "not measured", "not measured"))
        == "Undecided (simulation): temperature; not measured: deposition and setpoint."
    )


def test_of_a_recorded_machine_a_loop_is_ready_for_a_trial_or_not():
    ready, not_ready, rehearsed = three("passed", "open", "passed")
    loops = [ready._replace(recorded=True), not_ready._replace(recorded=True), rehearsed]
    assert (
        decision(loops)
        == "Ready for a supervised trial: temperature; not ready: deposition; pass (simulation): setpoint."
    )


def test_the_page_takes_the_colour_of_the_worst_loop_that_was_measured():
    assert state(three("passed", "open", "failed")) == "failed"
    assert state(three("passed", "open", "not measured")) == "open"
    assert state(three("passed", "passed", "not measured")) == "passed"
    assert state(three("not measured", "not measured", "not measured")) == "open"


def test_every_page_says_in_its_head_that_its_machine_is_simulated(reports):
    for path in reports.glob("*.html"):
        head = path.read_text(encoding="utf-8").split("</header>")[0 if path.stem != "index" else 1]
        assert "Simulated machines" in head.split("<h2")[0], path.name
