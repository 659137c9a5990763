"""Sixty nights of the nightly job on a made-up machine: recordings as CSV in the users' format, one a night,
with seeds; then drift, bad nights and a planted challenger.

`nice ./run python -m benchmarks.nights [null|alarms|drift|bad|planted|screened ...]` plays the
scenarios named (default: null, drift, bad, planted), prints the figures beside the bars, and writes
benchmarks/results/nights.json. Each night is `pipeline.nightly.night.nightly` itself in a git
repository of its own; only `dvc repro` is replaced by a call of the same stages in one process,
because starting five of them takes longer than their work. `--dvc` plays it with `dvc repro`.
`screened` are the nights of `benchmarks.screened_nights`, which learn nothing: creeping and stepping
faults in a minute and a half.

The machine: two heated zones (60 and 90 s, 1.6 and 1.2 °C per percent) that warm each other, 20 °C around
them give or take 0.5 °C a night, 0.1 °C of sensor noise. The judge of all is the machine itself: what a
promotion was worth is measured on it, not on the panel that the job judged by.
"""

import argparse
import datetime
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

import numpy as np
import scipy.linalg
import yaml

from pipeline.nightly import champion, judge, night, processes, promoting, remembered
from pipeline.nightly.reproducing import Reproduced
from pipeline.report.nightly.record import Night
from pipeline.store import artifacts, params
from pipeline.temperature import panel
from pipeline.temperature.plant import Plant, hold_output, plant
from pipeline.temperature.probing import InputLimits, OperatingPoint, prbs, probe

reproduce = night._reproduce
ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results/nights.json"
STAGES = ("probe_machine", "ingest", "identify_plant", "generate_probing", "learn_kernel", "tune_weights")
SAMPLES, KEPT, REFERENCE, NOISE_DEGC, AMBIENT_DEGC = 600, 4, np.array([120.0, 110.0]), 0.1, 20.0
START = datetime.datetime(2030, 1, 1, 2, 0, tzinfo=datetime.UTC)
TIME_CONSTANTS_S, GAINS = np.array([60.0, 90.0]), np.array([1.6, 1.2])


def machine(
    *,
    gain: tuple[float, float] = (1.0, 1.0),
    slower: tuple[float, float] = (1.0, 1.0),
    ambient: float = AMBIENT_DEGC,
) -> Plant:
    """Two zones: tau_i dy_i = K_i u_i + ambient + 0.1 (y_j - y_i) - (y_i - ambient), sampled each second;
    gains and time constants as shares of the nominal ones."""
    tau, K = TIME_CONSTANTS_S * slower, GAINS * gain
    F = np.array([[-1.1, 0.1], [0.1, -1.1]]) / tau[:, None]
    G = np.column_stack([np.diag(K) / tau[:, None], ambient / tau])
    whole = scipy.linalg.expm(np.block([[F, G], [np.zeros((3, 5))]]))
    return plant(whole[:2, :2], whole[:2, 2:4], np.eye(2), b=whole[:2, 4])


def recording(
    truth: Plant,
    seed: int,
    *,
    samples: int = SAMPLES,
    aim_degC: tuple[float, float] = (0.0, 0.0),
    dither: float = 8.0,
) -> dict[str, np.ndarray]:
    """A shift of the machine under its operator's loop, dithered, which aims so far beside the references:
    columns as a user's CSV has them."""
    rng = np.random.default_rng(seed)
    x0, u0 = hold_output(truth, REFERENCE)
    signal = prbs(rng, samples, 2, amplitude=dither, shortest=20)
    noise = NOISE_DEGC * rng.standard_normal((samples, 2))
    run = probe(
        truth,
        signal,
        OperatingPoint(x0, u0, REFERENCE + aim_degC),
        InputLimits(np.zeros(2), np.full(2, 100.0), 20.0),
        feedback=0.5 * np.eye(2),
        noise=noise,
    )
    return {
        "time_s": np.arange(samples, dtype=float),
        "heater_1": run.u[:, 0],
        "heater_2": run.u[:, 1],
        "sensor_1": run.y[:, 0],
        "sensor_2": run.y[:, 1],
    }


def a_night(
    seed: int, index: int, *, loop: dict | None = None, colder_degC: float = 0.0, **changes
) -> dict[str, np.ndarray]:
    """The recording of one night: `loop` are settings of `recording`, `changes` those of the machine."""
    rng = np.random.default_rng([seed, index])
    truth = machine(ambient=AMBIENT_DEGC - colder_degC + rng.uniform(-0.5, 0.5), **changes)
    return recording(truth, int(rng.integers(2**31)), **(loop or {}))


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    artifacts.write_csv(path, {name: np.round(values, 4) for name, values in columns.items()})


# ---- a project


def project(folder: Path, seed: int, *, recordings: int = 4, with_dvc: bool = False) -> None:
    """A repository with the temperature loop's stages, `recordings` nights recorded, three held out, and the
    first champion made; the working directory is in it afterwards."""
    folder.mkdir(parents=True)
    for name in ("pipeline", "stages"):
        (folder / name).symlink_to(ROOT / name)
    dvc_yaml = yaml.safe_load((ROOT / "dvc.yaml").read_text())
    dvc_yaml["stages"] = {name: dvc_yaml["stages"][name] for name in STAGES}
    (folder / "dvc.yaml").write_text(yaml.safe_dump(dvc_yaml))
    declared = settings()
    for path, sections in params.files(ROOT / "params.yaml").items():
        here = {section: {key: declared[section][key] for key in keys} for section, keys in sections.items()}
        (folder / Path(path).name).write_text(yaml.safe_dump(here))
    (folder / ".gitignore").write_text(
        "/pipeline\n/stages\n/reports/*.html\n/datasets/memo\n/datasets/[gilt]*\n/datasets/.*.[0-9]*\n*.tmp\n"
    )
    os.chdir(folder)
    for command in (
        "git init -q -b main",
        f"{sys.executable} -m dvc init -q",
        "git config user.email n@example.com",
        "git config user.name N",
    ):
        subprocess.run(command.split(), check=True)
    if not with_dvc:
        (folder / "dvc.lock").write_text("schema: '2.0'\nstages: {}\n")
    for k in range(recordings):
        write(Path(f"datasets/raw/temperature/shift_{k:03d}.csv"), a_night(seed, k))
    for k in range(3):
        write(Path(f"datasets/holdout/temperature/holdout_{k}.csv"), a_night(seed + 1000, k))
    subprocess.run(["git", "add", "-A"], check=True)
    subprocess.run(["git", "commit", "-q", "-m", "project"], check=True)
    night._reproduce = reproduce if with_dvc else _stages
    # here challengers are held against champions alone: no stage makes the figures of the pages
    promoting.verdicts_of = lambda settings, night: ({}, night)


def settings() -> dict:
    """The project's own parameters, of both files, for this machine
    and small; section nightly as the tests have it."""
    from tests.nightly.toy_nights import SETTINGS

    found = params.read(ROOT / "params.yaml")
    signal = {"unit": "percent", "low": 0, "high": 100}
    found["plant"] = {
        "sample_time_s": 1.0, "inputs": [{"name": f"heater_{k}", **signal} for k in (1, 2)],
        "outputs": [{"name": f"sensor_{k}", "unit": "degC", "low": 0, "high": 300,
                     "reference": float(REFERENCE[k - 1])} for k in (1,
        2)],
    }  # fmt: skip
    found["execution"] |= {
        "jobs": 1
    }  # a night's recordings are few: workers would take longer to start than to work
    found["generate_probing"] |= {"source": "recordings", "samples": 100}
    found["panel"] |= {
        "steps": 150,
        "settled_steps": 40,
        "training": found["panel"]["training"] | {"plants": 6},
        "judging": found["panel"]["judging"] | {"plants": 6},
    }
    found["learn_kernel"] |= {"longest_window": 8}
    found["identify_plant"] |= {"max_order": 3}
    found["tune_weights"] |= {"practical_initial": 8, "practical_evaluations": 14}
    found["nightly"] = SETTINGS | {
        "loops": {
            "temperature": {
                "artifacts": ["datasets/identify_plant/plant.parquet", "datasets/learn_kernel/window.parquet",
                "datasets/tune_weights/weights.json"],
                "judge": "temperature", "cases": "", "recordings": "datasets/raw/temperature",
            }
        },
        "holdout": SETTINGS["holdout"] | {"starts_degC": [50, 90], "reference_offsets_degC": [0, -10],
        "seed": 901, "plants": 16, "controller": "varx_riccati"},
    }  # fmt: skip
    found["nightly"]["holdout"]["steps"] = 150
    return found


def _stages(_, run: str) -> Reproduced:
    """The stages in one forked process, in place of `dvc repro`."""
    log = Path(".beadline/logs") / f"{run}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    child = os.fork()
    if child == 0:
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        status = 1
        try:
            import importlib

            for name in STAGES:
                importlib.import_module(f"stages.{name}").main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        finally:
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        raise ValueError(f"dvc repro failed: {processes.sentence(log.read_text())}")
    return Reproduced()


def play(index: int, columns: dict[str, np.ndarray] | None) -> tuple[int, str, Night]:
    """One night, and what it remembers of itself."""
    if columns is not None:
        # the last KEPT recordings are learned from; the older ones are the archive's
        for old in sorted(Path("datasets/raw/temperature").glob("shift_*.csv"))[: -KEPT + 1]:
            old.unlink()
        write(Path(f"datasets/raw/temperature/shift_{index:03d}.csv"), columns)
    status, said = night.nightly(START + datetime.timedelta(days=index))
    return status, said, remembered.nights()[-1]


def true_cost(folder: Path) -> float:
    """What the controller below `folder` costs on the machine itself,
    over starts, references and seeds of its own."""
    from pipeline.nightly.settings import Nightly

    holdout = params.load(Nightly, "nightly").holdout
    plants = [machine(gain=gain) for gain in ((1, 1), (0.95, 1.05), (1.05, 0.95))] * 5
    asked = panel.asked(
        [panel.delayed(one, late=False) for one in plants],
        panel.Questions(
            np.array([[start] * 2 for start in (40.0, 70.0, 100.0)]),
            REFERENCE - np.array([[0.0], [10.0], [20.0]]),
            None,
            None,
            None,
        ),
        noise=np.full(2, NOISE_DEGC),
        seed=0,
        steps=150,
        hold=30,
        cells=False,
    )
    frozen = judge.frozen_panel(holdout)
    frozen = frozen._replace(rehearsal=frozen.rehearsal._replace(judging=asked))
    return float(judge.judged(frozen, folder, holdout.controller).costs.mean())


# ---- scenarios


def null(seed: int, count: int, folder: Path, with_dvc: bool, *, learn: bool = True) -> dict:
    """`count` nights with no change of the machine; without learning after the first one, they say how many
    alarms are false, in a tenth of the time."""
    project(folder, seed, with_dvc=with_dvc)
    promotions, alarms, worse, costs, seconds = [], [], 0, [], []
    for k in range(4, 4 + count):
        if k == 5 and not learn:
            night._reproduce = lambda *_: Reproduced()
        before = true_cost(champion.FOLDER / "temperature") if champion.read().champions else None
        began = time.monotonic()
        status, said, tonight = play(k, a_night(seed, k) if k > 4 else None)
        seconds.append(time.monotonic() - began)
        assert status in (night.OK, night.DRIFTED), said
        alarms += [(tonight.run, alarm.cause, alarm.sigmas) for alarm in tonight.drift.alarms]
        if tonight.promoted:
            after = true_cost(champion.FOLDER / "temperature")
            promotions.append((tonight.run, before, after))
            worse += before is not None and after > before
        costs.append(true_cost(champion.FOLDER / "temperature"))
        print(f"  {said[:230]}", flush=True)
    return {
        "nights": count, "seed": seed, "false_alarms": len(alarms), "alarms": alarms,
        "promotions": len(promotions) - 1, "first_champion": promotions[0][0],
        "promotions_on_the_machine": promotions[1:], "worse_promoted": worse,
        "seconds_a_night": float(np.median(seconds)),
    }  # fmt: skip


def drifted(seed: int, folder: Path, with_dvc: bool) -> dict:
    """10 % of a gain or a time constant, up and down, each from a fresh clone of the same settled project:
    nights until the alarm, and the cause it names."""
    project(folder / "base", seed, with_dvc=with_dvc)
    status, said, _ = play(4, None)
    assert status == night.OK, said
    os.chdir("/")
    # drift is found before anything is learned, and the challenger is not asked for here
    night._reproduce = lambda *_: Reproduced()
    found = {}
    for name, changes in {
        "gain of heater_1 -10 %": {"gain": (0.9, 1.0)}, "gain of heater_1 +10 %": {"gain": (1.1, 1.0)},
        "gain of heater_2 -10 %": {"gain": (1.0, 0.9)},
        "gain of both -10 %": {"gain": (0.9, 0.9)}, "time constant of zone 1 +10 %": {"slower": (1.1, 1.0)},
        "time constant of zone 2 -10 %": {"slower": (1.0, 0.9)},
        "time constants of both +10 %": {"slower": (1.1, 1.1)},
        "15 °C colder around it": {"colder_degC": 15.0},
        "heaters at their limits": {"loop": {"dither": 30.0}},
    }.items():  # fmt: skip
        shutil.copytree(folder / "base", folder / "now", symlinks=True)
        os.chdir(folder / "now")
        nights, causes = 0, []
        for k in (5, 6, 7):
            nights += 1
            columns = a_night(seed, k + 10 * zlib.crc32(name.encode()) % 1000, **changes)
            causes = [alarm.cause for alarm in play(k, columns)[2].drift.alarms]
            if causes:
                break
        found[name] = {"nights": nights if causes else None, "causes": causes}
        print(f"  {name}: {found[name]}", flush=True)
        os.chdir("/")
        shutil.rmtree(folder / "now")
    return found


def bad(seed: int, folder: Path, with_dvc: bool) -> dict:
    """Bad recordings, one a night, each followed by a good night."""
    project(folder, seed, with_dvc=with_dvc)
    status, said, _ = play(4, None)
    assert status == night.OK, said
    found = {}
    good = a_night(seed, 5)
    wrong = {
        "empty file": None,
        "half a header": {"time_s": np.zeros(0)},
        "swapped sensors": good | {"sensor_1": good["sensor_2"], "sensor_2": good["sensor_1"]},
        "swapped heaters": good | {"heater_1": good["heater_2"], "heater_2": good["heater_1"]},
        "sensors in °F": good | {name: 1.8 * good[name] + 32 for name in ("sensor_1", "sensor_2")},
        "one sensor in K": good | {"sensor_1": good["sensor_1"] + 273.15},
        "heaters as shares": good | {name: good[name] / 100 for name in ("heater_1", "heater_2")},
        "a sensor that is not there": {name: values for name, values in good.items() if name != "sensor_2"},
        "not a number": good | {"sensor_1": np.full(SAMPLES, np.nan)},
    }
    for k, (name, columns) in enumerate(wrong.items()):
        files, run = (
            champion.md5s(champion.FOLDER / "temperature"),
            champion.read().champions["temperature"].run,
        )
        path = Path(f"datasets/raw/temperature/bad_{k}.csv")
        if columns is None:
            path.write_bytes(b"")
        else:
            write(path, columns)
        status, said, _ = play(10 + 2 * k, None)
        same = (
            champion.md5s(champion.FOLDER / "temperature") == files
            and champion.read().champions["temperature"].run == run
        )
        path.unlink(missing_ok=True)
        after = play(11 + 2 * k, a_night(seed, 11 + 2 * k))
        found[name] = {
            "status": status,
            "champion_untouched": same,
            "told": said,
            "next_night": after[0],
            "page_names_it": f"bad_{k}.csv" in Path("reports/nightly.html").read_text(),
        }
        print(f"  {name}: {status} untouched {same}, next {after[0]}: {said[:240]}", flush=True)
    return found


def planted(seed: int, folder: Path, with_dvc: bool) -> dict:
    """The champion is made 10 % worse than what a night learns, by weights on its
    inputs: nights until the challenger is promoted."""
    project(folder, seed, with_dvc=with_dvc)
    play(4, None)
    from pipeline.nightly.settings import Nightly

    rule = params.load(Nightly, "nightly")
    measured = judge.judge(rule.loops["temperature"], rule).measure
    own = Path("champion/temperature/tune_weights/weights.json")
    weights = artifacts.read_json(own)["contestants"]
    mine = weights[rule.holdout.controller]

    def cost(share: float) -> float:
        worse = mine | {"effort_weight": mine["effort_weight"] * share}
        artifacts.write_json(own, {"contestants": weights | {rule.holdout.controller: worse}})
        return float(
            np.mean([value for _, value in measured(champion.FOLDER / "temperature").cases.values()])
        )

    best, low, high = cost(1.0), 0.0, 6.0
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (middle, high) if cost(10**middle) < best / 0.9 else (low, middle)
    made = cost(10**high)
    processes.dvc("add", "--quiet", "champion/temperature")
    state = champion.read()
    present = state.champions["temperature"]
    files = present.installed._replace(
        files=champion.md5s(champion.FOLDER / "temperature"), folder=champion.pointer("temperature")
    )
    champion.write(
        state._replace(champions={**state.champions, "temperature": present._replace(installed=files)})
    )
    processes.commit(champion.paths(), "a champion that is 10 % worse")
    for k in (5, 6, 7):
        _, said, tonight = play(k, a_night(seed, k))
        print(f"  {said[:300]}", flush=True)
        if tonight.promoted:
            return {"planted_percent": 100 * (1 - best / made), "nights": k - 4}
    return {"planted_percent": 100 * (1 - best / made), "nights": None}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenarios", nargs="*", default=["null", "drift", "bad", "planted"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--nights", type=int, default=60)
    parser.add_argument("--dvc", action="store_true")
    parser.add_argument("--folder", type=Path)
    a = parser.parse_args()
    whole = a.folder or Path(tempfile.mkdtemp(prefix="nights-"))
    for name in a.scenarios:
        print(name, flush=True)
        if name == "screened":
            from benchmarks import screened_nights

            screened_nights.play_and_keep([a.seed])
            continue
        call = {
            "null": lambda f: null(a.seed, a.nights, f, a.dvc),
            "alarms": lambda f: null(a.seed, a.nights, f, a.dvc, learn=False),
            "drift": lambda f: drifted(a.seed, f, a.dvc),
            "bad": lambda f: bad(a.seed, f, a.dvc),
            "planted": lambda f: planted(a.seed, f, a.dvc),
        }
        found = call[name](whole / name)
        os.chdir(ROOT)
        # another run may have written meanwhile
        known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        artifacts.write_json(RESULTS, known | {f"{name}_seed_{a.seed}": found})
        print(json.dumps(found, indent=1, ensure_ascii=False, default=str)[:6000])
    shutil.rmtree(whole)


if __name__ == "__main__":
    main()
