"""Is the winner of model-based against data-driven that a page names also the winner on the machine?

    ./run --group dev python -m tests.foreign.winner --seeds 7101-7124 --out /tmp/winner

For each drawn machine its owner's two recordings, with fan and feed or screw recorded beside, the stages at
the sizes of params.quick.yaml, the pair as evaluate_temperature names it; and the true cost of both,
exported, on the machine itself. Writes winner.jsonl, a row a machine, and prints the tables. About a minute
of CPU a machine.
"""

import argparse
import contextlib
import ctypes
import json
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import yaml

from pipeline.deploy import assembly, certificate, machine, to_c
from pipeline.deploy.supervise import KINDS
from pipeline.store import params
from pipeline.temperature.controllers.table import BY_NAME, answering_pair, design_controllers
from pipeline.temperature.test_set import panel, scorecard
from stages.evaluate_temperature import EvaluateTemperature, EvaluationInputs, load_problem, wire
from tests.foreign import normal_life, thermal_machines
from tests.foreign.normal_life import COLD, PATIENCE_S, told
from tests.foreign.thermal_machines import DOOR, Machine, draw, pointer, quiet, sampled
from tests.mission import toy_temperature

STAGES = "ingest", "identify_plant", "learn_kernel", "tune_weights"
SECTIONS = "panel", "tune_weights", "evaluate_temperature", "identify_plant"
KIND = "model-based", "data-driven"
STARTS = 10  # of which every second is from cold
PARTS = "constant", "sequence", "disturbed"  # of a life, each as long as a case of the panel
WARMED_S = 1200.0  # by hand at a set-point, before a warm start
DOOR_S = 20.0, 90.0


# ---- what the page names


def quick_sizes() -> dict[str, Any]:
    """What params.quick.yaml sets of the temperature loop, by dotted key."""

    def leaves(at: str, value: Any) -> Iterator[tuple[str, Any]]:
        if not isinstance(value, dict):
            yield at, value
            return
        for key, inner in value.items():
            yield from leaves(f"{at}.{key}", inner)

    sections = yaml.safe_load((toy_temperature.ROOT / "params.quick.yaml").read_text(encoding="utf-8"))
    return dict(pair for name in SECTIONS for pair in leaves(name, sections.get(name, {})))


def learn(seed: int, folder: Path) -> None:
    """The owner's path in an empty folder, from two recordings to tuned controllers."""
    drawn, rng = draw(seed), np.random.default_rng([seed, 1])
    project, logs = toy_temperature.begin(folder / "project"), [folder / "steps.csv", folder / "evening.csv"]
    for log, record in zip(logs, (thermal_machines.record, thermal_machines.evening), strict=True):
        recorded = record(drawn, rng, disturbed=True)
        thermal_machines.write_csv(log, drawn, recorded, disturbed=True)
    normal_life.declare(project, drawn, logs[::-1])
    toy_temperature.declare(project, quick_sizes() | {"loops.deposition": False, "loops.setpoint": False})
    toy_temperature.play(project, *STAGES)


def name_winner(loaded: EvaluationInputs, seed: int) -> dict[str, Any]:
    """The pair as evaluate_temperature has it; without "winner" where one of the two is refused."""
    designs, refused = design_controllers(loaded.problem, loaded.weights)
    standing = [name for name in designs if BY_NAME[name].kind != "reference"]
    a, b = answering_pair(standing, {name: one["cost"] for name, one in loaded.weights.items()})
    row: dict[str, Any] = {
        "a": a,
        "b": b,
        "refused": refused,
        "answers": [BY_NAME[name].kind for name in (a, b)] == [*KIND],
    }
    cases, costs = loaded.setting.rehearsal.judging, {}
    for name in {a, b} & {*standing}:
        rests = panel.rests(designs[name].model, cases, loaded.setting.limits)
        played = panel.play(designs[name], rests, cases, loaded.setting)[1]
        costs[name] = panel.costs(played, loaded.setting.allowance)
    if len(costs) < 2:
        return row
    structure = cases.plant % len(panel.STRUCTURES)
    row |= scorecard.pair(a, b, costs, cases.plant, structure, seed=seed)
    favours = 1 if np.log(costs[b] / costs[a]).mean() >= 0 else -1
    return row | {"page_percent": favours * row["difference"], "spread": float(np.ptp(row["by_structure"]))}


# ---- what the machine says


class MachineLife(NamedTuple):
    """References r (3 N, p), what acts from outside (3 N, 4), the seed of the noise, and the set-point (p,)
    at which the machine is held by hand before; None from cold."""

    r: np.ndarray
    outside: np.ndarray
    noise: int
    held: np.ndarray | None


def draw_lives(drawn: Machine, seed: int, steps: int) -> list[MachineLife]:
    """STARTS lives of three times `steps` at the machine's sample time: to the reference; to two other
    set-points and back; there, while fan, feed or screw, a door and the room act."""
    lives, third = [], steps // 3
    for k in range(STARTS):
        rng = np.random.default_rng([seed, 43, k])
        points = [thermal_machines._set_point(drawn, rng) for _ in range(2)]
        lengths = third, third, steps - 2 * third
        sequence = np.repeat([*points, drawn.reference_degC], lengths, axis=0)
        still = np.tile(drawn.reference_degC, (steps, 1))
        outside = thermal_machines._wander(drawn, rng, quiet(drawn, 3 * steps))
        last = outside[2 * steps :]
        thermal_machines.disturb(drawn, rng, last)
        if drawn.has_door:
            at = int(rng.uniform(0, 0.8) * steps)
            last[at : at + round(rng.uniform(*DOOR_S) / drawn.sample_time_s), DOOR] = 1.0
        noise, warm = int(rng.integers(2**40)), np.random.default_rng([seed, 44, k])
        held = thermal_machines._set_point(drawn, warm) if k % 2 else None
        lives.append(MachineLife(np.concatenate([still, sequence, still]), outside, noise, held))
    return lives


def begin_state(drawn: Machine, life: MachineLife) -> tuple[thermal_machines.State, np.ndarray]:
    """The machine as its controller finds it, and the duties (m,) by which it is held."""
    if life.held is None:
        return thermal_machines.start(drawn, life.noise), np.zeros(len(drawn.inputs))
    duty = thermal_machines.holding(drawn, life.held)
    degC, _ = thermal_machines.at_rest(drawn.parts, life.held, tuple(quiet(drawn, 1)[0]))
    state = thermal_machines.start(drawn, life.noise, float(life.held.mean()))
    state.degC[: len(degC)] = degC.tolist()
    state.sensor[: len(life.held)] = life.held.tolist()
    steps = round(WARMED_S / drawn.sample_time_s)
    thermal_machines.drive(drawn, state, np.tile(duty, (steps, 1)), quiet(drawn, steps))
    return state, duty


def export(names: list[str], folder: Path, loaded: EvaluationInputs) -> None:
    """The C of each controller, supervisor and own control in it, in folder/NAME/c. Raises ValueError for one
    that cannot be exported."""
    designs, _ = design_controllers(loaded.problem, loaded.weights)
    own, declared = assembly.own_control(designs), wire(loaded.machine)
    for name in names:
        made = assembly.assemble(
            name, designs[name], own, declared, loaded.setting, loaded.problem.family, simulated=False
        )
        machine.check(made)
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name / "c").mkdir(parents=True)
        for file, text in to_c.code(made, certificate.PLACE).items():
            (folder / name / "c" / file).write_text(text, encoding="utf-8")


def live(
    folder: Path, drawn: Machine, life: MachineLife, begun: tuple[thermal_machines.State, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """True sensors (3 N, p), duties (3 N, m) and modes (3 N,) of the machine under an exported controller,
    from where it is held for COLD samples; and what its supervisor left the law for."""
    state, duty = thermal_machines.State.from_buffer_copy(begun[0]), begun[1]
    r, outside = (np.concatenate([np.tile(a[0], (COLD, 1)), a]) for a in (life.r, life.outside))
    (T, p), modes = r.shape, np.zeros((2, len(r)), np.int8)
    y, sensor, u = np.zeros((T, p)), np.zeros((T, p)), np.zeros((T, len(duty)))
    result = normal_life.build(folder).held_life(
        ctypes.byref(drawn.parts), ctypes.byref(state), T, COLD, round(PATIENCE_S / drawn.sample_time_s),
        *map(pointer, (duty, r, outside, y, sensor, u)), *[ctypes.c_void_p(row.ctypes.data) for row in modes],
        pointer(told(folder, drawn, outside)),
    )  # fmt: skip
    if result:
        raise RuntimeError(f"a call of the exported controller ended with result {result}")
    causes = sorted({KINDS[kind] for kind in modes[1].tolist() if kind >= 0})
    return sensor[COLD:], u[COLD:], modes[0, COLD:], causes


def cost_of(
    y: np.ndarray, u: np.ndarray, life: MachineLife, setting: panel.CaseConditions
) -> list[dict[str, float]]:
    """The panel's cost of each part of a life and what it is made of, from true outputs and duties. What a
    law wished past a limit is seen as a duty at it."""
    limits, found = setting.limits, []
    beyond = (u >= limits.high - 1e-9) * 1.0 - (u <= limits.low + 1e-9)
    wished = u + beyond * (limits.high - limits.low)
    steps = len(y) // len(PARTS)
    for k, kind in enumerate(PARTS):
        y_part, u_part, r_part, wish = (a[k * steps : (k + 1) * steps, None] for a in (y, u, life.r, wished))
        begin = [[0, steps // 3, 2 * (steps // 3)]] if kind == "sequence" else [[0]]
        cold = np.array([kind == "constant" and life.held is None])
        case = SimpleNamespace(
            kind=np.array([kind]), begin=np.array(begin), plant=np.zeros(1, int), steps=steps, cold=cold
        )
        low, high = setting.output_limits
        figures = panel.figures(
            panel.Rollout(y_part, r_part, r_part, wish, u_part, y_part),
            case,  # ty: ignore[invalid-argument-type]
            limits=limits,
            low=low,
            high=high,
            band=setting.rehearsal.band_degC,
            settled=setting.settled,
        )
        parts = {key: float(getattr(figures, key)[0] / unit) for key, unit in setting.allowance.items()}
        found.append({"cost": float(panel.costs(figures, setting.allowance)[0])} | parts)
    return found


def play_truth(seed: int, folder: Path, names: list[str], loaded: EvaluationInputs) -> dict[str, Any]:
    """Of each controller the costs (STARTS, parts) on the machine, all parts of them, the share of samples in
    percent for which its supervisor left the law, and why. Both meet the same lives."""
    export(names, folder, loaded)
    setting, drawn = loaded.setting, sampled(draw(seed), loaded.machine.sample_time_s)
    found = {name: {"cost": [], "parts": [], "left_percent": [], "causes": []} for name in names}
    for life in draw_lives(drawn, seed, setting.rehearsal.judging.steps):
        begun = begin_state(drawn, life)
        for name, mine in found.items():
            y, u, modes, causes = live(folder / name, drawn, life, begun)
            parts = cost_of(y, u, life, setting)
            mine["cost"].append([one["cost"] for one in parts])
            mine["parts"].append(parts)
            mine["left_percent"].append(100 * float((modes != 0).mean()))
            mine["causes"].append(causes)
    return found


# ---- the table


def judge(seed: int, folder: Path) -> dict[str, Any]:
    """The row of a machine: what the page names, and what is true. "error" says what ended the path, "" for
    nothing. What is learned stays in the folder and is learned once."""
    row: dict[str, Any] = {"seed": seed, "structure": draw(seed).structure, "error": ""}
    try:
        if not (folder / "learned").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            learn(seed, folder)
            (folder / "learned").touch()
        with contextlib.chdir(folder / "project"):
            loaded = load_problem()
            chance = params.load(EvaluateTemperature, "evaluate_temperature").seed
        row |= name_winner(loaded, chance)
        if "winner" not in row:
            return row
        row["true"] = play_truth(seed, folder, [row["a"], row["b"]], loaded)
    except Exception as error:  # whatever ends an owner's path is a finding
        return row | {"error": f"{type(error).__name__}: {error}"}
    a, b = (np.array(row["true"][row[key]]["cost"]).mean(axis=1) for key in "ab")
    of = max(a.mean(), b.mean())
    return row | {
        "true_cost": [a.mean(), b.mean()],
        "cost_se": [one.std(ddof=1) / np.sqrt(STARTS) for one in (a, b)],
        "true_percent": 100 * (b.mean() - a.mean()) / of,
        "percent_se": 100 * (b - a).std(ddof=1) / np.sqrt(STARTS) / of,
        "true_winner": row["a"] if b.mean() >= a.mean() else row["b"],
    }


def print_row(row: dict[str, Any]) -> None:
    head = f"| {row['seed']} | {row['structure']} | "
    if "true_cost" not in row:
        print(f"{head}{row['error'] or row['refused']} |", flush=True)
        return
    left = [np.mean(row["true"][row[key]]["left_percent"]) for key in "ab"]
    costs = [f"{x:.3g} ± {se:.2g}" for x, se in zip(row["true_cost"], row["cost_se"], strict=True)]
    cells = [
        row["a"], row["b"], row["winner"] or "undecided", f"{row['page_percent']:+.1f}",
        f"{row['spread']:.1f}", *costs, f"{row['true_percent']:+.1f} ± {row['percent_se']:.1f}",
        row["true_winner"], " / ".join(f"{x:.1f}" for x in left),
    ]  # fmt: skip
    print(f"{head}{' | '.join(cells)} |", flush=True)


def print_totals(rows: list[dict[str, Any]]) -> None:
    """Of the machines whose pair is a model-based and a data-driven controller, and of those whose true
    difference exceeds the spread that the page prints: how often the named winner is right."""
    pairs = [row for row in rows if row["answers"] and "true_cost" in row]
    far = [row for row in pairs if abs(row["true_percent"]) > row["spread"]]
    kinds = {None: "undecided"} | {name: one.kind for name, one in BY_NAME.items()}
    table = Counter((kinds[row["winner"]], kinds[row["true_winner"]]) for row in pairs)
    named = [row for row in far if row["winner"]]
    right = sum(row["winner"] == row["true_winner"] for row in named)
    frequent = Counter(kinds[row["true_winner"]] for row in far).most_common(1)
    print(f"\n{len(rows)} machines, {len(pairs)} pairs; (named, true): {dict(table)}")
    print(f"{len(far)} true differences exceed the spread: {right} named rightly, {len(named) - right}")
    print(f"wrongly, {len(far) - len(named)} undecided; the more frequent kind wins: {frequent}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=normal_life._seeds, default=normal_life._seeds("7101-7124"))
    parser.add_argument("--out", type=Path, required=True)
    asked, rows = parser.parse_args(), []
    for seed in asked.seeds:
        rows.append(judge(seed, asked.out / str(seed)))
        with (asked.out / "winner.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print_row(rows[-1])
    print_totals([row for row in rows if not row["error"]])


if __name__ == "__main__":
    main()
