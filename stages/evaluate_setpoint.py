"""Agents and classifier -> who sets flow and temperature: reads datasets/train_classifier and the paper's
agent from datasets/papers/train_agent; writes datasets/evaluate_setpoint: scoreboard.parquet,
paths.parquet of one run from each start, in the case that decides too, decisions.parquet of
two episodes through pixels, and choice.json: the default with its worst case, and the best model-based
controller against the best data-driven one."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import stages
from pipeline.setpoint.controllers import BuiltController, build_controllers, of_kind
from pipeline.setpoint.settings import EvaluateSetpoint, TrainClassifier
from pipeline.setpoint.tables import DECISIONS, PATHS, SCOREBOARD, WINDOW_PARTS, WINDOWS
from pipeline.store import artifacts, params

if TYPE_CHECKING:
    from pipeline.setpoint.evaluation.judging import DefaultChoice
    from pipeline.setpoint.evaluation.pixel_rollouts import PixelRollouts

WEIGHTS = "datasets/train_classifier/weights.safetensors"
CALIBRATION = "datasets/train_classifier/calibration.parquet"
AGENTS = "datasets/papers/train_agent/weights.safetensors"
# figures of control that git keeps and that runs are compared by
METRICS = (
    "default",
    "worst",
    "pair.*",
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
        from pipeline.setpoint.agents.files import restore_published
        from pipeline.setpoint.evaluation import judging, scoreboard
        from pipeline.setpoint.frames.files import restore_camera
        from pipeline.setpoint.simulation.recorded import window_tables
        from pipeline.setpoint.vision.files import restore_classifier

        model = restore_classifier(WEIGHTS, CALIBRATION)
        table = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
        windows = window_tables(table, WINDOW_PARTS)
        controllers = build_controllers(settings.baselines, restore_published(AGENTS), windows["learn"])
        segments = judging.pools([windows["choose"], windows["judge"]], settings.pool)
        choice = choose_default(controllers, segments[0], settings)
        camera = restore_camera("datasets/train_classifier/known_camera.parquet")
        with ThreadPoolExecutor(1) as beside:
            running = beside.submit(
                simulate_pixels, controllers, choice.name, settings, pixel_loop(model, settings, view, camera)
            )
            judged, paths = simulate(controllers, segments[1], settings, stream=1)
        count = len(segments[1])
        contest = scoreboard.Contest(scoreboard.scores(judged, count), paths)
        worst, case = judging.worst_case(judged[choice.name])
        rollouts, choice = running.result(), choice._replace(worst=worst, case=case)
        pair = judging.compare(judged, count, segments=len({*windows["judge"].segment.tolist()}))
        artifacts.write_table(
            out / "scoreboard.parquet", SCOREBOARD, scoreboard.scoreboard(contest, rollouts)
        )
        artifacts.write_table(out / "paths.parquet", PATHS, scoreboard.paths(contest, choice, rollouts))
        none = {column.name: [] for column in DECISIONS.columns}
        decisions = none | scoreboard.decisions(choice.name, rollouts)
        artifacts.write_table(out / "decisions.parquet", DECISIONS, decisions)
        artifacts.write_json(out / "choice.json", choice._asdict() | {"pair": pair})
        figures = scoreboard.metrics(contest, choice, pair, rollouts)
        artifacts.write_metrics("evaluate_setpoint", figures, METRICS)


# ---- on the simulators


def choose_default(
    controllers: Mapping[str, BuiltController], segments: Sequence[Any], settings: EvaluateSetpoint
) -> "DefaultChoice":
    """The default, by the pools of segments to choose on, of which none is judged."""
    from pipeline.setpoint.evaluation import judging

    harmed = settings.most_harmed
    outcomes, _ = simulate(controllers, segments, settings, stream=0)
    limits = {"perfect": harmed.perfect_percent, "in_band": harmed.in_band_percent}
    bars = judging.harm_limits([*outcomes[next(iter(outcomes))]], **limits)
    return judging.choose(outcomes, len(segments), simplest_first=list(controllers), bars=bars)


def simulate(
    controllers: Mapping[str, BuiltController],
    segments: Sequence[Any],
    settings: EvaluateSetpoint,
    *,
    stream: int,
) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
    """What becomes of every controller's runs on these pools, by name and case (Outcomes), and of the cases
    that count its first run from each start. Controllers run on every core at once; what comes out does not
    depend on the cores."""
    import jax

    from pipeline.setpoint.evaluation import judging, scoreboard

    cases = judging.all_cases(settings.runs, segment_mean_decisions=settings.segment_mean_decisions)
    key = jax.random.fold_in(jax.random.key(settings.seed), stream)

    def one(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
        outcomes, paths = {}, {}
        for i, (case, asked) in enumerate(cases.items()):
            built, own = controllers[name], jax.random.fold_in(key, i)
            runs = judging.simulate(built.controller, built.parameters, asked, segments, own)
            outcomes[case] = judging.become(runs)
            if judging.counts(case):
                paths[case] = scoreboard.first_of_each(runs)
            bar.update()
        return outcomes, paths

    words = ("choose", "judge")[stream]
    with progress(words, len(controllers) * len(cases)) as bar, ThreadPoolExecutor(os.cpu_count()) as pool:
        # the elaborate ones begin
        found = dict(zip([*controllers][::-1], pool.map(one, [*controllers][::-1]), strict=True))
    return {name: found[name][0] for name in controllers}, {name: found[name][1] for name in controllers}


def progress(words: str, total: int) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, desc=f"evaluate_setpoint: {words}", mininterval=2)


# ---- through pixels


def simulate_pixels(
    controllers: Mapping[str, BuiltController], default: str, settings: EvaluateSetpoint, loop: Any
) -> "PixelRollouts":
    """The default, and the first model-based controller or data-driven one beside it, from some starts; and
    two episodes in which something befalls the default. Nothing if no start is set."""
    import numpy as np

    from pipeline.setpoint.deployment import pixels
    from pipeline.setpoint.evaluation import pixel_rollouts

    own = settings.pixels
    if not own.starts:
        return pixel_rollouts.PixelRollouts({}, None, ())
    names = [*dict.fromkeys((default, of_kind("model-based"), of_kind("data-driven")))][:2]
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
