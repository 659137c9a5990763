"""Scores of trajectories made by hand, the cases that controllers meet, and the choice of the default."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pipeline.setpoint.agents import baselines
from pipeline.setpoint.agents.criteria import NO_CONTROL
from pipeline.setpoint.agents.score import Outcomes, judge, outcomes, summary
from pipeline.setpoint.agents.trials import START_FLOWS, START_TEMPERATURES
from pipeline.setpoint.evaluation import judging
from pipeline.setpoint.evaluation.judging import Case, all_cases, choose
from pipeline.setpoint.simulation.recorded import recorded_windows
from pipeline.setpoint.simulation.simulator import STAND, Action, SetpointController, nominal
from pipeline.statistics import effective, mean_of_pools, pooled_share, wilson
from pipeline.verdict.setpoint import LEAST_RUNS, threshold
from pipeline.verdict.verdict import FAILED, PASSED, UNDECIDED, Figure, Question, state
from tests.setpoint.synthetic import synthetic_flow_table, synthetic_table


def path(*pieces):
    """Flow (201,) that takes each value from its step on."""
    flow = np.empty(201)
    for step, value in pieces:
        flow[step:] = value
    return flow


def run(*flows, temperature=210.0):
    flow = np.stack(flows)
    return flow, np.broadcast_to(temperature, flow.shape)


def test_settled_staying_and_recovered_are_what_the_notes_define():
    flows = [
        path((0, 60), (7, 95)),  # settles at step 7 and stays
        path((0, 60), (90, 95)),  # at the last step that counts
        path((0, 60), (91, 95)),  # one too late, so that it neither settles nor stays
        path((0, 60), (7, 95), (150, 111), (151, 95)),  # leaves for one step later on
        path((0, 60), (7, 95), (99, 89), (100, 95)),  # out within the dwell
        path((0, 60), (7, 95), (110, 80), (121, 95)),  # out before 120: settled, not recovered
        path((0, 100), (60, 60), (75, 90)),  # a clog made good at step 75, on the border
    ]
    score = judge(*run(*flows))
    assert score.settled.percent == pytest.approx(100 * 5 / 7)
    assert score.stay.percent == pytest.approx(100 * 3 / 7)
    assert score.recovered.percent == pytest.approx(100 * 4 / 7)
    assert score.median_steps == 7  # of 7, 90, 7, 7, 75
    assert score.p90_steps == pytest.approx(84)  # 0.6 of the way from 75 to 90
    assert score.worst_start == (60.0, 210.0, pytest.approx(100 * 4 / 6))


def test_a_temperature_out_of_its_band_is_not_settled():
    warm = np.where(np.arange(201) < 12, 215.1, 215.0)
    assert judge(*run(path((0, 100)), temperature=warm)).median_steps == 12
    assert judge(*run(path((0, 100)), temperature=215.1)).settled.percent == 0
    assert np.isnan(judge(*run(path((0, 100)), temperature=215.1)).median_steps)


def test_overshoot_counts_the_far_side_of_the_start_until_the_clog_only():
    score = judge(*run(path((0, 300), (20, 85), (30, 100), (60, 60), (75, 100))))
    assert score.overshoot_p95 == 15
    assert judge(*run(path((0, 30), (20, 130), (30, 100)))).overshoot_p95 == 30
    assert judge(*run(path((0, 30), (20, 99)))).overshoot_p95 == 0


def test_the_flow_error_is_the_mean_distance_over_the_second_hundred_steps():
    score = judge(*run(path((0, 60), (100, 95), (150, 105)), path((0, 60), (100, 98))))
    assert score.flow_error == pytest.approx(3.5)


def test_harm_is_the_farthest_that_a_run_from_a_good_start_goes():
    flows = [
        path((0, 100), (10, 110), (20, 100)),  # on the border, which is inside
        path((0, 92.5), (150, 115.5), (151, 100)),
        path((0, 107.5), (199, 74), (200, 100)),
        path((0, 100), (200, 126)),  # at the last decision
    ]
    assert [share.percent for share in judge(*run(*flows)).beyond] == [75, 75, 50]


def test_recovery_counts_from_the_clog_and_back_is_within_15_percent():
    score = judge(
        *run(
            path((0, 100), (60, 60), (75, 91)),
            path((0, 100), (60, 60), (85, 86)),  # back within 15, not recovered
            path((0, 100), (60, 60), (91, 91)),  # too late
        )
    )
    assert score.recovered.percent == pytest.approx(100 / 3)
    assert np.isnan(score.recovery_p95)  # one of three is never inside for good
    back = judge(*run(*[path((0, 100), (60, 60), (60 + k, 91)) for k in range(1, 101)]))
    assert back.recovery_p95 == 96  # 95 of the hundred are inside after as many decisions, and one more
    assert score.back.percent == pytest.approx(200 / 3)


def test_wilson_s_interval_by_hand():
    # 81 of 263: 0.2553 to 0.3662, the example of Newcombe (1998), whose digits these are
    share = wilson(np.arange(263) < 81)
    np.testing.assert_allclose(share, [100 * 81 / 263, 25.53, 36.62], atol=5e-3)
    assert wilson(np.ones(10, bool)).high == pytest.approx(100.0)  # rounding
    assert wilson(np.zeros(10, bool)).low == pytest.approx(0.0, abs=1e-12)


# ---- what runs on pools of segments are worth


def test_what_runs_on_pools_are_worth_by_hand():
    # shares of 1/2 and 1 of two pools of four: they differ by 1/8, chance alone would by 3/16 / 4
    happened = np.array([[1, 1, 0, 0], [1, 1, 1, 1]], bool)
    assert effective(happened) == pytest.approx(8 / ((1 / 8) / (3 / 16 / 4)))
    assert effective(np.array([[True, False], [False, True]])) == 4  # pools that are alike: every run counts
    assert effective(np.ones((3, 5), bool)) == 15
    assert effective(np.ones((1, 5), bool)) == 1  # one pool says nothing of others
    mean = mean_of_pools(np.array([1.0, 3.0]), level=0.9)
    assert mean.value == 2 and mean.high - 2 == pytest.approx(6.313752)  # Student's t of 1, 95 %, times 1


def pooled(rng: np.random.Generator, share: float, shared: float, pools: int = 12, runs: int = 42):
    """Runs (pools, runs) that are kept with a probability of their pool: beta about `share`, of which runs on
    one pool share so much of their variance."""
    a, b = share * (1 / shared - 1), (1 - share) * (1 / shared - 1)
    return rng.random((pools, runs)) < rng.beta(a, b, pools)[:, None]


def test_intervals_of_pools_hold_what_other_segments_give_and_wilson_s_do_not():
    rng, inside, of_wilson = np.random.default_rng(0), [], []
    for share in (0.8, 0.9, 0.97):
        for _ in range(200):
            happened = pooled(rng, share, shared=0.1)
            told, naive = pooled_share(happened), wilson(happened.ravel())
            inside.append(told.low <= 100 * share <= told.high)
            of_wilson.append(naive.low <= 100 * share <= naive.high)
    assert np.mean(inside) >= 0.9
    assert np.mean(of_wilson) < 0.75


def test_in_ten_reseeds_hardly_a_figure_moves_by_more_than_twice_its_half_width():
    rng = np.random.default_rng(1)
    shares = [pooled(rng, 0.9, shared=0.05) for _ in range(11)]
    told = [pooled_share(happened) for happened in shares]
    first, half = told[0].percent, (told[0].high - told[0].low) / 2
    assert all(abs(one.percent - first) <= 2 * half for one in told)


def ruled(happened: np.ndarray, limit: float) -> str:
    share = pooled_share(happened)
    figure, words = threshold(Figure(*share[:3]), share.n, limit, at_least=True)
    return state(Question(0, "", "", "%", words["limit"], True, ""), figure)


def test_a_rule_passes_a_controller_of_99_percent_and_fails_one_of_94_in_19_of_20_repetitions():
    """By 190 runs that share nothing, the fewest that decide."""
    rng, n = np.random.default_rng(2), int(LEAST_RUNS)
    states = {
        share: [ruled(rng.random((10, n // 10)) < share, 97.0) for _ in range(400)] for share in (0.99, 0.94)
    }
    decided = {share: [one for one in told if one != UNDECIDED] for share, told in states.items()}
    assert np.mean([one == PASSED for one in decided[0.99]]) >= 0.95
    assert np.mean([one == FAILED for one in decided[0.94]]) >= 0.95
    assert min(map(len, decided.values())) > 50


def test_runs_on_few_segments_leave_a_rule_undecided():
    """Whatever they are: half of the pools keep all and half none."""
    assert ruled(np.repeat([[True], [False]], 6, axis=0) & np.ones((12, 42), bool), 97.0) == UNDECIDED
    assert ruled(np.ones((12, 42), bool), 97.0) == PASSED


def test_a_score_of_pools_has_their_intervals_and_worth():
    flow = np.stack([path((0, 60), (7, 95))] * 21 + [path((0, 60))] * 21)
    of = outcomes(*run(*flow))
    told, plain = summary(of, pools=2), summary(of)
    assert told.stay.percent == plain.stay.percent == 50
    assert plain.stay == (*wilson(of.stay), 42)
    assert told.stay == pooled_share(of.stay.reshape(2, 21))
    assert told.stay.low < plain.stay.low and told.stay.n < plain.stay.n == 42


# ---- the cases


def test_every_start_comes_as_often_in_every_case():
    asked = all_cases(3, segment_mean_decisions=10.0)
    wrong = {name: case.conditions for name, case in asked.items() if judging.counts(name)}
    assert (len(asked), len(wrong)) == (8, 5)
    for conditions in wrong.values():
        pairs, counts = np.unique(
            np.stack([conditions.flow, conditions.temperature]), axis=1, return_counts=True
        )
        assert set(map(tuple, pairs.T)) == {(q, u) for q in START_FLOWS for u in START_TEMPERATURES}
        assert set(counts) == {3}
    clogged = {
        left: [
            n for n, c in wrong.items() if (c.clog == jnp.float32(left)).all() and (c.clog_step == 60).all()
        ]
        for left in (0.6, 0.75)
    }
    assert clogged[0.6] == [name for name in wrong if name.endswith(", clog")]
    assert clogged[0.75] == ["recorded, sticky, half clog"]
    paper = [name for name, c in wrong.items() if (c.persistence == 0).all()]
    assert paper == ["accuracy 0.7"] and (wrong["accuracy 0.7"].accuracy == jnp.float32(0.7)).all()


def test_good_starts_lie_within_the_band_and_one_camera_has_another_scale():
    harm = {name: case for name, case in all_cases(1, segment_mean_decisions=10.0).items() if case.good}
    assert list(harm) == ["perfect", "in band", "in band, another camera"]
    for name, case in harm.items():
        flow = np.asarray(case.conditions.flow)
        assert (len(flow), set(np.asarray(case.conditions.temperature))) == (21, {210.0})
        assert (flow.min(), flow.max()) == ((100, 100) if name.startswith("perfect") else (92.5, 107.5))
        assert (np.asarray(case.conditions.clog_step) == 0).all()
    assert judging.harm_limits([*harm], perfect=1.0, in_band=2.0) == {"perfect": 1.0, "in band": 2.0}


TABLE = synthetic_table(np.random.default_rng(0), segments=6, windows=2)


def windows_at(source, flows, persistence, u=0.3):
    conditions = nominal(flows, 210.0, accuracy=1.0)._replace(persistence=jnp.full(len(flows), persistence))
    return jax.vmap(lambda c, q: source.draw(source.table, c, q, 0.5, jnp.full(3, u)))(
        conditions, conditions.flow
    )


def test_a_camera_shows_what_the_recorded_one_shows_at_the_flow_that_it_makes_of_the_true_one():
    recorded = recorded_windows(TABLE)
    flows = np.array([60.0, 95.0, 100.0, 120.0])
    nowhere = nominal(flows, 210.0, accuracy=1.0)
    camera = judging.shown_by(recorded, Case(nowhere, scale=1.1, exponent=0.5))
    expected = windows_at(recorded, 110 * np.sqrt(flows / 100), 1.0)
    for a, b in zip(windows_at(camera, flows, 10.0), expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    # without persistence the paper's windows, right at accuracy 1
    np.testing.assert_array_equal(windows_at(camera, flows, 0.0)[1], [0, 1, 1, 2])


# ---- pools of segments


def flow_table(*, segments: int, seed: int = 0):
    """Few bins, so that few segments fill them."""
    table = synthetic_flow_table(np.random.default_rng(seed), segments=segments, windows=4)
    return table._replace(flow_edges=np.array([20.0, 90.0, 310.0]), flow_bin=(table.flow >= 90.0).astype(int))


def test_pools_share_no_segment_and_what_fills_them_up_is_never_drawn():
    """Of tables of unlike size, pools that are one program."""
    tables = [flow_table(segments=n, seed=seed) for seed, n in ((0, 60), (1, 90))]
    few, many = judging.pools(tables, 20)
    assert [len(few), len(many)] == [3, 4]
    shapes = {tuple(np.shape(a) for a in pool.table) for pool in (*few, *many)}
    assert len(shapes) == 1
    whole = [recorded_windows(table) for table in tables]
    for several, source in ((few, whole[0]), (many, whole[1])):
        biases = np.concatenate([np.asarray(pool.table.bias) for pool in several])
        assert len(np.unique(biases)) == len(biases) and set(biases) <= set(np.asarray(source.table.bias))
        assert all((np.diff(pool.table.bias) >= 0).all() for pool in several)
        # the noise of a window is that of the whole table
        flows, pool = np.linspace(21, 310, 60), several[0]
        one = source._replace(table=source.table._replace(bias=pool.table.bias, seen=pool.table.seen))
        for u in (0.0, 0.4, 0.999):
            for x, y in zip(windows_at(pool, flows, 1.0, u), windows_at(one, flows, 1.0, u), strict=True):
                np.testing.assert_array_equal(x, y)


def test_segments_are_dealt_to_pools_by_chance_and_not_by_what_they_misread():
    (made,) = judging.pools([flow_table(segments=400)], 50)
    means = [float(pool.table.bias.mean()) for pool in made]
    # of 50 segments of 5 % the mean has a deviation of 0.7 %
    assert 0.003 < np.std(means) < 0.013


def test_few_segments_are_two_pools_and_a_table_of_classes_is_one():
    assert [len(several) for several in judging.pools([flow_table(segments=9)], 50)] == [2]
    assert [len(several) for several in judging.pools([TABLE], 50)] == [1]


def test_each_case_is_run_on_each_pool_from_one_key():
    (segments,) = judging.pools([flow_table(segments=9)], 3)
    key, asked = jax.random.key(0), all_cases(1, segment_mean_decisions=10.0)

    def ask(controller, parameters, case):
        return judging.become(judging.simulate(controller, parameters, case, segments, key))

    idle = ask(baselines.nothing(), (), asked["in band, another camera"])
    assert idle.flow.shape == (63,)
    assert not idle.beyond.any()
    assert idle.stay.all()
    always = SetpointController(lambda: (), lambda p, m, o, key: (m, Action(jnp.int32(4), jnp.int32(STAND))))
    assert ask(always, (), asked["perfect"]).beyond.all()
    test = baselines.sequential_test(), baselines.SequentialTest(0.75, 2.9, 5.3)
    once, again = (ask(*test, asked["recorded, sticky"]) for _ in range(2))
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a, b)


# ---- the choice


BARS = {"in band": 2.0}
ORDER = (NO_CONTROL, "simple", "Bayes filter", "paper's agent")


def judged(calm: float, clog: float, harmed: float = 0.0, runs: int = 480) -> dict[str, Outcomes]:
    """So much of the runs is kept in two cases from wrong starts, and harmed from good ones; alike in every
    pool of 24."""

    def dealt(share: float) -> np.ndarray:
        return np.arange(runs).reshape(24, 20).T.ravel() < round(share * runs)

    def one(**changed) -> Outcomes:
        empty = dict.fromkeys(Outcomes._fields, np.zeros(runs))
        return Outcomes(
            **empty | {"stay": np.ones(runs, bool), "beyond": np.zeros((runs, 3), bool)} | changed
        )

    return {
        "calm": one(stay=dealt(calm)),
        "clog": one(stay=dealt(clog)),
        "in band": one(beyond=np.repeat(dealt(harmed)[:, None], 3, axis=1)),
    }


def default(contestants: dict[str, dict[str, Outcomes]]) -> judging.DefaultChoice:
    return choose(contestants, 20, simplest_first=ORDER, bars=BARS)


def test_the_default_is_the_best_in_its_worst_case_and_is_told_with_the_others():
    choice = default(
        {NO_CONTROL: judged(1.0, 0.1), "simple": judged(0.9, 0.8), "Bayes filter": judged(0.99, 0.9)}
    )
    assert (choice.name, choice.case) == ("Bayes filter", "clog")
    assert choice.worst == pytest.approx(90, abs=0.2)
    assert "simple 80.0 % (clog)" in choice.sentence and "do nothing 10.0 % (clog)" in choice.sentence


def test_within_two_points_the_simpler_runs():
    near = {"simple": judged(0.99, 0.89), "Bayes filter": judged(0.99, 0.9)}
    assert default(near).name == "simple"
    assert default(near | {"simple": judged(0.99, 0.87)}).name == "Bayes filter"


def test_whoever_surely_does_harm_is_no_candidate_and_says_why():
    choice = default({NO_CONTROL: judged(0.5, 0.1), "simple": judged(1.0, 0.95, harmed=0.2)})
    assert choice.name == NO_CONTROL
    assert choice.refused == {"simple": "leaves +-25 % in 20.0 % of the runs (in band), of at most 2 %"}
    # 2.5 % of 480 runs may be 2 %
    assert default({NO_CONTROL: judged(0.5, 0.1), "simple": judged(1.0, 0.95, harmed=0.025)}).name == "simple"
    with pytest.raises(ValueError, match='expected a contestant that does no harm, .* add "do nothing"'):
        default({"simple": judged(1.0, 0.95, harmed=0.2)})


def test_model_based_against_data_driven_is_paired_run_by_run_and_told_or_more_segments_asked_for():
    pair = {"Bayes filter": judged(0.99, 0.9), "paper's agent": judged(0.9, 0.5)}
    told = judging.compare(pair, 20, segments=600)
    assert (told["a"], told["b"], told["winner"]) == ("Bayes filter", "paper's agent", "Bayes filter")
    assert told["difference"] == pytest.approx((0.09 + 0.4) / 2 * 100, abs=0.2)
    assert told["low"] <= told["difference"] <= told["high"] and told["needed"] is None
    swapped = judging.compare(dict(zip(pair, [*pair.values()][::-1], strict=True)), 20, segments=600)
    assert swapped["winner"] == "paper's agent"
    # half of the pools go to either: nobody is better, and how many more segments would tell is said
    mixed = judged(0.5, 0.5)
    one_sided = {case: of._replace(stay=np.arange(480) % 480 < 245) for case, of in mixed.items()}
    other_side = {case: of._replace(stay=np.arange(480) % 480 >= 240) for case, of in mixed.items()}
    open_ = judging.compare({"Bayes filter": one_sided, "paper's agent": other_side}, 20, segments=600)
    assert open_["winner"] is None and open_["needed"] > 600
    assert "difference" not in judging.compare({"Bayes filter": mixed}, 20, segments=600)


def test_short_trajectories_are_refused():
    short = np.full((1, 101), 100.0)
    with pytest.raises(
        ValueError, match=r"expected trajectories of 200 decisions, found 100; roll out with steps=200"
    ):
        judge(short, short)
