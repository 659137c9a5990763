"""Old names of parameters, columns and metrics -> today's names.

Files of earlier versions are read under today's names. Whoever writes an old name in a params file is
told the new one. An entry is never removed: somebody's accepted run or champion may still have the name.
"""

import functools
from collections.abc import Iterable, Mapping
from typing import Any

# dotted keys of params.yaml and params.expert.yaml; a key stands for all below it, and * for any one name
PARAMETERS: dict[str, str] = {
    "compose_parts.whole_updates": "compose_parts.full_part_updates",
    "evaluate_setpoint.baselines.bayes_robust.look": (
        "evaluate_setpoint.baselines.bayes_robust.width_bias_std"
    ),
    "evaluate_setpoint.baselines.bayes_robust.looks": (
        "evaluate_setpoint.baselines.bayes_robust.width_bias_levels"
    ),
    "evaluate_setpoint.baselines.bayes_robust.repeats": (
        "evaluate_setpoint.baselines.bayes_robust.window_repeat_probability"
    ),
    "evaluate_setpoint.baselines.bayes_robust.segment": (
        "evaluate_setpoint.baselines.bayes_robust.segment_mean_decisions"
    ),
    "evaluate_setpoint.baselines.bayes_robust.switch": (
        "evaluate_setpoint.baselines.bayes_robust.mode_switch_probability"
    ),
    "evaluate_setpoint.pixels.segment_s": "evaluate_setpoint.pixels.segment_mean_s",
    "evaluate_setpoint.segment": "evaluate_setpoint.segment_mean_decisions",
    "evaluate_temperature.data_sets": "reproduce_study.data_sets",
    "panel.loss": "panel.extra_heat_loss_per_step",
    "printer.limit_mm": "printer.drive.amplitude_mm",
    "printer.speed_limit_mm_per_s": "printer.gantry_speed_limit_mm_per_s",
    "train_agent.ours": "train_agent.belief_dqn",
    "train_agent.ours.filter.look": "train_agent.belief_dqn.filter.width_bias_std",
    "train_agent.ours.filter.looks": "train_agent.belief_dqn.filter.width_bias_levels",
    "train_agent.ours.filter.repeats": "train_agent.belief_dqn.filter.window_repeat_probability",
    "train_agent.ours.filter.segment": "train_agent.belief_dqn.filter.segment_mean_decisions",
    "train_agent.ours.filter.switch": "train_agent.belief_dqn.filter.mode_switch_probability",
    "train_agent.ours.troubles": "train_agent.belief_dqn.disturbances",
    "train_agent.paper": "train_agent.li_2025",
    "train_classifier.frames": "render_frames.frames",
    "train_classifier.recorded": "render_frames.sweeps",
    "train_classifier.recorded.judge_windows": "render_frames.sweep_windows.judge",
    "train_classifier.recorded.learn_windows": "render_frames.sweep_windows.learn",
    "train_classifier.segments": "render_frames.segments",
    "train_ilc.law": "train_ilc.model_inverse",
    "train_ilc.paper": "train_ilc.hoelzle_2009",
    "tune_weights.evaluations": "reproduce_study.evaluations",
    "tune_weights.initial": "reproduce_study.initial",
}

# dotted keys that nothing reads any more -> why, as the end of a sentence
RETIRED: dict[str, str] = {
    "evaluate_temperature.report_noise_degC": "panel.noise_degC is the one level of noise",
    "nightly.holdout.seeds": "nightly.holdout.seed draws plants and noise",
    "panel.judging.seeds": "panel.judging.seed draws plants and noise",
    "panel.training.seeds": "panel.training.seed draws plants and noise",
    "report.gap_percent": "the gap to the optimum is shown and decides nothing",
    "report.window_accuracy": (
        "it was asked of windows of all flows; report.window_right_70_150 asks for a share right where every "
        "flow from 70 to 150 % is as frequent"
    ),
    "report.worst_case_gap_percent": "the rules are asked at the 90 % quantile of all cases",
    "tune_weights.acquisition": "every contestant has the same search, expected improvement",
    "tune_weights.q_high": "each contestant has parameters of its own (workflow/contestants.py)",
    "tune_weights.q_low": "each contestant has parameters of its own (workflow/contestants.py)",
    "tune_weights.r_high": "each contestant has parameters of its own (workflow/contestants.py)",
    "tune_weights.r_low": "each contestant has parameters of its own (workflow/contestants.py)",
    "tune_weights.tau_high": "each contestant has parameters of its own (workflow/contestants.py)",
    "tune_weights.tau_low": "each contestant has parameters of its own (workflow/contestants.py)",
}

# (dotted key of today, old choice) -> today's choice; of parameters that are one of several words
CHOICES: dict[tuple[str, str], str] = {
    ("nightly.holdout.controller", "model_based"): "subspace_lqg",
    ("nightly.holdout.controller", "window"): "varx_riccati",
    ("segment_library.law", "ours"): "model_inverse",
}

# (table, old column) -> column; the table's version is raised with it
COLUMNS: dict[tuple[str, str], str] = {}

# dotted keys of reports/metrics/<stage>.json, the stage first; a key stands for all below it, and * for any
# one name, such as a material
METRICS: dict[str, str] = {
    "evaluate_temperature.algorithm_1": "reproduce_study.algorithm_1",
    "evaluate_temperature.as_published": "reproduce_study.as_published",
    "evaluate_temperature.kernel": "reproduce_study.kernel",
    "evaluate_temperature.kernel_predicted_state": "reproduce_study.kernel_predicted_state",
    "evaluate_temperature.observer": "reproduce_study.observer",
    "evaluate_temperature.optimal": "reproduce_study.optimal",
    "evaluate_temperature.printed": "reproduce_study.printed",
    "evaluate_temperature.takeover": "reproduce_study.takeover",
    "evaluate_temperature.window": "reproduce_study.window",
    "generate_probing.excitation_condition": "probe_machine.excitation_condition",
    "generate_probing.excitation_full_rank": "probe_machine.excitation_full_rank",
    "generate_probing.excitation_order": "probe_machine.excitation_order",
    "generate_probing.excitation_rank": "probe_machine.excitation_rank",
    "generate_probing.level_percent_per_band": "probe_machine.level_percent_per_band",
    "generate_probing.limited_share": "probe_machine.limited_share",
    "generate_probing.samples": "probe_machine.samples",
    "train_agent.ours": "train_agent.belief_dqn",
    "train_agent.ours_at_0.7": "train_agent.belief_dqn_at_0.7",
    "train_agent.parameters.ours": "train_agent.parameters.belief_dqn",
    "train_agent.parameters.paper": "train_agent.parameters.li_2025",
    "train_ilc.*.authority": "train_ilc.*.actuator_headroom",
    "train_ilc.*.gamma_ours": "train_ilc.*.gamma_model_inverse",
    "train_ilc.*.gamma_ours_worst": "train_ilc.*.gamma_model_inverse_worst",
    "train_ilc.*.ours": "train_ilc.*.model_inverse",
    "train_ilc.*.paper": "train_ilc.*.hoelzle_2009_nominal",
    "train_ilc.*.paper_on_machine": "train_ilc.*.hoelzle_2009",
    "tune_weights.parity": "reproduce_study.parity",
}


def new_name(key: str, table: Mapping[str, str]) -> str:
    """Today's name of a dotted key; a key that nobody renamed stays.

    The longest old name that the key begins with is replaced, until none is left. A * in an old name is
    any one name, and comes back where the new name has its *. The names below a renamed section may be
    listed with the old section or with the new one.

    Example: new_name("a.b.c", {"a.b": "a.d"}) is "a.d.c".
    """
    patterns = _patterns(tuple(table.items()))
    for _ in range(1 + len(table)):
        key, before = _replaced(key, patterns), key
        if key == before:
            break
    return key


Patterns = dict[str, list[tuple[list[str], list[str]]]]


@functools.lru_cache(maxsize=16)
def _patterns(entries: tuple[tuple[str, str], ...]) -> Patterns:
    """{first name: [(old names, new names), ...]}, the longest first.

    An entry below a renamed section stands there once more, with the section's new name.
    """
    given = _by_first_name(entries)
    below = []
    for old, new in entries:
        section, _, name = old.rpartition(".")
        today = f"{_replaced(section, given)}.{name}"
        if section and today not in (old, new):
            below.append((today, new))
    return _by_first_name([*entries, *below])


def _by_first_name(entries: Iterable[tuple[str, str]]) -> Patterns:
    patterns: Patterns = {}
    for old, new in sorted(entries, key=lambda entry: -entry[0].count(".")):
        patterns.setdefault(old.split(".")[0], []).append((old.split("."), new.split(".")))
    return patterns


def _replaced(key: str, patterns: Patterns) -> str:
    names = key.split(".")
    for old, new in patterns.get(names[0], ()):
        pairs = list(zip(old, names, strict=False))
        if len(pairs) == len(old) and all(wanted in ("*", name) for wanted, name in pairs):
            starred = iter([name for wanted, name in pairs if wanted == "*"])
            today = [next(starred) if name == "*" else name for name in new]
            return ".".join([*today, *names[len(old) :]])
    return key


def under_new_names(data: Mapping[str, Any], table: Mapping[str, str], place: str = "") -> dict[str, Any]:
    """Nested dictionaries and lists with today's keys; `place` is the dotted key under which they stand."""
    moved: list[tuple[str, Any]] = []
    today = _translated(data, table, place, moved)
    for key, item in moved:
        _put(today, key.removeprefix(f"{place}.").split("."), item)
    return today


def _translated(data: Any, table: Mapping[str, str], place: str, moved: list[tuple[str, Any]]) -> Any:
    """`data` with new keys; what a new name puts into another section is appended to `moved`."""
    if isinstance(data, list):
        return [_translated(item, table, f"{place}.{index}", moved) for index, item in enumerate(data)]
    if not isinstance(data, Mapping):
        return data
    today: dict[str, Any] = {}
    section = f"{new_name(place, table)}." if place else ""
    for name, item in data.items():
        old = f"{place}.{name}" if place else str(name)
        new = new_name(old, table)
        item = _translated(item, table, old, moved)
        inside = new.removeprefix(section)
        # a name may have a dot of its own, such as share_at_0.7
        if not new.startswith(section) or inside.count(".") > str(name).count("."):
            moved.append((new, item))
        else:
            today[inside] = item
    return today


def _put(data: dict[str, Any], names: list[str], item: Any) -> None:
    for name in names[:-1]:
        data = data.setdefault(name, {})
    data[names[-1]] = item


def parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """The sections of a params file of an earlier version, with today's keys and choices, without what was
    retired."""
    today = under_new_names(values, PARAMETERS)
    for key in RETIRED:
        *sections, name = key.split(".")
        holder: Any = today
        for section in sections:
            holder = holder.get(section) if isinstance(holder, Mapping) else None
        if isinstance(holder, dict):
            holder.pop(name, None)
    for (key, old), new in CHOICES.items():
        *sections, name = key.split(".")
        holder: Any = today
        for section in sections:
            holder = holder.get(section) if isinstance(holder, Mapping) else None
        if isinstance(holder, dict) and holder.get(name) == old:
            holder[name] = new
    return today


def metrics(files: Mapping[str, Any]) -> dict[str, Any]:
    """{stage: its metrics} of an earlier version, with today's keys."""
    return under_new_names(files, METRICS)


def columns(table: str) -> dict[str, str]:
    """{old column: column of today} of one table."""
    return {old: new for (name, old), new in COLUMNS.items() if name == table}


def accepted(run: Mapping[str, Any]) -> dict[str, Any]:
    """An accepted run of an earlier version, with today's keys of its parameters, metrics and figures."""
    today = dict(run)
    if isinstance(run.get("params"), Mapping):
        today["params"] = parameters(run["params"])
    if isinstance(run.get("metrics"), Mapping):
        today["metrics"] = metrics(run["metrics"])
    if isinstance(run.get("figures"), Mapping):
        today["figures"] = under_new_names(run["figures"], METRICS, "report.figures")
    return today
