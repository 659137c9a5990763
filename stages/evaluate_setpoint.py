"""Agents and classifier -> who sets flow and temperature: reads datasets/train_classifier
and datasets/train_agent; writes datasets/evaluate_setpoint: scoreboard.parquet,
paths.parquet of one run from each start, in the case that decides too, decisions.parquet of
two episodes through pixels, and choice.json, the default with its worst case."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import stages
from pipeline.setpoint.controllers import THROUGH_PIXELS, BuiltController, build_controllers
from pipeline.setpoint.settings import EvaluateSetpoint, TrainClassifier
from pipeline.setpoint.tables import DECISIONS, PATHS, SCOREBOARD, WINDOW_PARTS, WINDOWS
from pipeline.store import artifacts, params

if TYPE_CHECKING:
    from pipeline.setpoint.evaluation.contest import Contest
    from pipeline.setpoint.evaluation.judging import Case, DefaultChoice
    from pipeline.setpoint.evaluation.pixel_rollouts import PixelRollouts
    from pipeline.setpoint.simulation.recorded import WindowTable

WEIGHTS = "datasets/train_classifier/weights.safetensors"
CALIBRATION = "datasets/train_classifier/calibration.parquet"
AGENTS = "datasets/train_agent/weights.safetensors"
# figures of control that git keeps and that runs are compared by
METRICS = (
    "default",
    "worst",
    "margin*",
    "cases.*.settled",
    "cases.*.stay",
    "cases.*.recovered",
    "harm.*.beyond_25*",
    "*.paper.*.stay",
    "*.recorded.*.stay",
)


def main() -> None:
    with artifacts.stage("evaluate_setpoint") as out:
        settings = params.load(EvaluateSetpoint, "evaluate_setpoint")
        view = params.load(TrainClassifier, "train_classifier")
        from pipeline.setpoint.agents.files import restore_agents
        from pipeline.setpoint.evaluation import judging, scoreboard
        from pipeline.setpoint.evaluation.contest import with_figures
        from pipeline.setpoint.frames.files import restore_camera
        from pipeline.setpoint.simulation.recorded import window_tables
        from pipeline.setpoint.vision.files import restore_classifier

        model = restore_classifier(WEIGHTS, CALIBRATION)
        table = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
        windows = window_tables(table, WINDOW_PARTS)
        controllers = build_controllers(settings.baselines, restore_agents(AGENTS), windows["learn"])
        room = judging.room([windows["choose"], windows["judge"]])  # one program for both
        choice = choose_default(controllers, windows["choose"], settings, room=room)
        camera = restore_camera("datasets/train_classifier/known_camera.parquet")
        with ThreadPoolExecutor(1) as beside:
            running = beside.submit(
                simulate_pixels, controllers, choice.name, settings, pixel_loop(model, settings, view, camera)
            )
            contest = simulate_contest(controllers, windows["judge"], settings, choice.name, room=room)
        rollouts, choice = running.result(), with_figures(choice, contest)
        groups = {name: controller.group for name, controller in controllers.items()}
        board = scoreboard.scoreboard(groups, contest, rollouts)
        artifacts.write_table(out / "scoreboard.parquet", SCOREBOARD, board)
        paths = scoreboard.paths(groups, contest, choice, rollouts)
        artifacts.write_table(out / "paths.parquet", PATHS, paths)
        none = {column.name: [] for column in DECISIONS.columns}
        decisions = none | scoreboard.decisions(choice.name, rollouts)
        artifacts.write_table(out / "decisions.parquet", DECISIONS, decisions)
        artifacts.write_json(out / "choice.json", scoreboard.choice_record(choice))
        figures = scoreboard.metrics(groups, contest, choice, rollouts)
        artifacts.write_metrics("evaluate_setpoint", figures, METRICS)


# ---- on the simulators


def choose_default(
    controllers: Mapping[str, BuiltController],
    windows: "WindowTable",
    settings: EvaluateSetpoint,
    *,
    room: int = 0,
) -> "DefaultChoice":
    """The default, by the segments to choose on (sequential halving): in each of settings.rounds every
    controller that may still become the default runs on settings.redraws further redraws of them."""
    import jax
    import numpy as np

    from pipeline.setpoint.evaluation import contest, judging

    redraws, harmed = settings.redraws, settings.most_harmed
    limits = contest.harm_limits(perfect=harmed.perfect_percent, in_band=harmed.in_band_percent)
    every = judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)
    cases = {name: case for name, case in every.items() if not case.good or name in limits}
    rng = np.random.default_rng([settings.seed, 0])
    redrawn = judging.redrawn(windows, settings.rounds * redraws, rng, room=room)
    outcomes: dict[str, Any] = {name: {} for name in controllers}
    judged, survivors = {}, list(controllers)
    for number in range(settings.rounds):
        key = jax.random.fold_in(jax.random.key(settings.seed), number)
        segments = contest.one_round(redrawn, number, redraws)
        with progress(f"choose, round {number + 1}", len(survivors) * len(cases)) as bar:
            simulate = partial(simulate_controller, controllers, cases, redraws, bar.update, segments, key)
            batch = each_controller(controllers, survivors, simulate)
        for name, (latest, _) in batch.items():
            outcomes[name] = contest.append(outcomes[name], latest)
            judged[name] = contest.judge(outcomes[name], cases, (number + 1) * redraws)
        if number + 1 < settings.rounds:
            survivors = contest.eliminate(survivors, judged, limits)
    return judging.choose(judged, simplest_first=list(controllers), bars=limits)


def simulate_contest(
    controllers: Mapping[str, BuiltController],
    windows: "WindowTable",
    settings: EvaluateSetpoint,
    default: str,
    *,
    room: int = 0,
) -> "Contest":
    """Figures on segments that nothing was trained, tuned or chosen on: the default on all redraws of them,
    the others on those of one round."""
    import jax
    import numpy as np

    from pipeline.setpoint.evaluation import contest, judging

    cases = judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)
    redraws = settings.redraws
    rng = np.random.default_rng([settings.seed, 1])
    redrawn = judging.redrawn(windows, settings.rounds * redraws, rng, room=room)
    segments = [contest.one_round(redrawn, number, redraws) for number in range(settings.rounds)]
    rounds = {name: settings.rounds if name == default else 1 for name in controllers}
    with progress("judge", sum(rounds.values()) * len(cases)) as bar:

        def simulate(name: str) -> tuple[Any, Any, Any]:
            outcomes, paths = {}, {}
            for number in range(rounds[name]):
                key = jax.random.fold_in(jax.random.key(settings.seed), settings.rounds + number)
                latest, first = simulate_controller(
                    controllers, cases, redraws, bar.update, segments[number], key, name
                )
                outcomes, paths = contest.append(outcomes, latest), paths or first
            n = rounds[name] * redraws
            return contest.summaries(outcomes, n), contest.judge(outcomes, cases, n), paths

        simulated = each_controller(controllers, list(controllers), simulate)
    return contest.Contest(
        {name: scores for name, (scores, _, _) in simulated.items()},
        {name: judged for name, (_, judged, _) in simulated.items()},
        {name: count * redraws for name, count in rounds.items()},
        {name: paths for name, (_, _, paths) in simulated.items()},
    )


def simulate_controller(
    controllers: Mapping[str, BuiltController],
    cases: "Mapping[str, Case]",
    redraws: int,
    on_case: Callable[[], object],
    segments: Any,
    key: Any,
    name: str,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """contest.simulate of the controller with this name on the redrawn segments of one round."""
    from pipeline.setpoint.evaluation import contest

    built = controllers[name]
    return contest.simulate(built.controller, built.parameters, cases, segments, redraws, key, on_case)


T = TypeVar("T")


def each_controller(
    controllers: Mapping[str, BuiltController], names: Sequence[str], work: Callable[[str], T]
) -> dict[str, T]:
    """work(name) of these controllers, on every core at once. Those that share what is compiled follow each
    other; the elaborate ones begin. What comes out does not depend on the cores."""
    alike: dict[Any, list[str]] = {}
    for name in names:
        alike.setdefault(controllers[name].controller, []).append(name)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        groups = pool.map(lambda group: {name: work(name) for name in group}, [*alike.values()][::-1])
        results = {name: result for group in groups for name, result in group.items()}
    return {name: results[name] for name in names}


def progress(words: str, total: int) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, desc=f"evaluate_setpoint: {words}", mininterval=2)


# ---- through pixels


def simulate_pixels(
    controllers: Mapping[str, BuiltController], default: str, settings: EvaluateSetpoint, loop: Any
) -> "PixelRollouts":
    """The default, and the belief DQN or the robust filter beside it, from some starts; and two episodes in
    which something befalls the default. Nothing if no start is set."""
    import numpy as np

    from pipeline.setpoint.deployment import pixels
    from pipeline.setpoint.evaluation import pixel_rollouts

    own = settings.pixels
    if not own.starts:
        return pixel_rollouts.PixelRollouts({}, None, ())
    names = [*dict.fromkeys((default, *THROUGH_PIXELS))][:2]
    starts = pixel_rollouts.spread_starts(own.starts, own.runs)
    hard_starts, disturbances, words = pixel_rollouts.disturbed_episodes(own.decisions)

    def run(name: str, starts: np.ndarray, disturbances: Any, seed: int) -> pixels.Episodes:
        built, rng = controllers[name], np.random.default_rng([settings.seed, seed])
        episodes = pixels.run(
            built.controller, built.parameters, starts, loop, disturbances, decisions=own.decisions, rng=rng
        )
        bar.update()
        return episodes

    with progress("through pixels", 3) as bar:
        calm = {name: run(name, starts, pixels.calm(len(starts)), 1) for name in names}
        disturbed = run(default, hard_starts, disturbances, 2)
    return pixel_rollouts.PixelRollouts(calm, disturbed, words)


def pixel_loop(model: Any, settings: EvaluateSetpoint, view: TrainClassifier, camera: Any) -> Any:
    """The loop as deployed (pixels.PixelLoop). Windows that are not of the known camera are held."""
    from pipeline.setpoint.deployment import deployment, pixels
    from pipeline.setpoint.simulation import actuation
    from pipeline.setpoint.vision.calibrated_classifier import read_frames
    from pipeline.setpoint.vision.window_flow import window_flow

    q, fitted = settings.pixels, model.calibration
    return pixels.PixelLoop(
        machine=pixels.MachineDynamics(q.heater_s, q.heater_delay_s, q.melt_s, q.softening_per_degC),
        classify=partial(read_frames, model),
        frames=view.window,
        frame_rate_hz=q.frame_rate_hz,
        waits=actuation.Waits(q.wait_s, q.wait_s, q.idle_wait_s),
        limits=deployment.deployed_limits(q.per_action, q.per_minute),
        judge=partial(
            deployment.judge_window, least_frames=q.least_frames, foreign_above=fitted.foreign_above
        ),
        least_score=view.least_score,
        tip_tolerance_px=q.tip_tolerance_px,
        segment_mean_s=q.segment_mean_s,
        window_flow=partial(window_flow, fitted=fitted.flow),
        foreign=deployment.camera_guard(camera, fitted.proof),
    )


if __name__ == "__main__":
    stages.run(main, "evaluate_setpoint", loop="setpoint")
