"""Exports a controller as C99 without heap: a folder that `make test` compiles and checks.

law.c and controller.c are the same for every machine. They mirror law.py and supervise.py, with the same
letters. machine.h names the machine that they are made for; tables.h holds its numbers, each as the shortest
decimal that reads back identically. golden.csv holds the results of the Python object, and test_controller.c
requires the same within 1e-9 of each signal's range. With -DBEADLINE_SINGLE a `real` is a float, for boards;
its tolerance is in test_controller.c.
"""

import re
from pathlib import Path

import numpy as np

from pipeline.deploy import supervise
from pipeline.deploy.certificate import Certificate, sha256
from pipeline.deploy.machine import check, check_certificate
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers import law
from pipeline.temperature.controllers.law import (
    Deployed,
    FeedForward,
    Governor,
    Law,
    Plant,
    Rest,
    aim,
    constant,
)
from pipeline.temperature.plant import strictly_proper

TEMPLATES = Path(__file__).with_name("templates")
PARTS = ("law.h", "law.c", "supervisor.h", "supervisor.c")
COPIED = ("test_controller.c", "Makefile")
WIDTH = 110
# the governor's bound of rounding errors in °C: a forecast of 250 °C in single precision is accurate to 3e-5
SINGLE_EXACT = "BY_PRECISION({}, 3e-5)"
# least_squares takes at most INPUTS columns; gcc does not see this, and with one input it warns of a second
# column
ONE_INPUT = '#if defined(__GNUC__)\n#pragma GCC diagnostic ignored "-Warray-bounds"\n#endif\n\n'


def files(exported: Exported, certificate: Certificate, golden: str) -> dict[str, str]:
    """Returns the folder's files, name to text; `golden` is golden.csv (vectors.py). Raises ValueError if the
    certificate was not passed, or belongs to another controller."""
    check(exported)
    check_certificate(exported, certificate)
    return code(exported, sha256(certificate)) | {"golden.csv": golden}


def code(exported: Exported, certificate_sha256: str) -> dict[str, str]:
    """Returns the folder's files without golden.csv."""
    return {name: _template(name) for name in COPIED} | {
        "controller.h": _assembled("controller.h"),
        "controller.c": _assembled("controller.c"),
        "machine.h": machine_header(exported, certificate_sha256),
        "tables.h": tables(exported),
        "test_plant.h": plant_header(exported),
        "README.txt": readme(exported, certificate_sha256),
    }


def _template(name: str) -> str:
    return (TEMPLATES / name).read_text(encoding="utf-8")


def _assembled(name: str) -> str:
    """Returns a file with its parts inserted, each marked @part@."""
    text = _template(name)
    for part in PARTS:
        text = text.replace(f"@{part}@", _template(part).rstrip())
    return text


def readme(exported: Exported, certificate_sha256: str) -> str:
    """Returns README.txt: purpose, how to call the controller, and how its stack and its time for a step are
    measured."""
    signals = "".join(
        f"{kind:<8}{one.name}, {one.unit}, {one.low:g} to {one.high:g}\n"
        for kind, group in (("input", exported.machine.inputs), ("output", exported.machine.outputs))
        for one in group
    )
    simulated = "The plant was simulated: beadline_init asks for rehearsal = 1, beside a simulation only.\n"
    parts = {
        "contestant": exported.name,
        "sample_time": f"{exported.machine.sample_time_s:g}",
        "signals": signals,
        "certificate": certificate_sha256,
        "plant": exported.plant_sha256,
        "simulated": simulated if exported.simulated else "",
    }
    text = _template("README.txt")
    for name, value in parts.items():
        text = text.replace(f"@{name}@", value)
    return text


# ---- the text of numbers


def number(value: float) -> str:
    """Returns the shortest decimal that reads back as the same double."""
    if np.isinf(value):
        return "-INFINITY" if value < 0 else "INFINITY"
    return repr(float(value))


def _wrapped(items: list[str], indent: str) -> str:
    lines, line = [], indent
    for item in items:
        if len(line) + len(item) + 2 > WIDTH and line.strip():
            lines.append(line.rstrip())
            line = indent
        line += item + ", "
    return "\n".join([*lines, line.rstrip(" ,")])


def _braced(array: np.ndarray, depth: int) -> str:
    indent = "    " * depth
    if array.ndim == 1:
        return indent + "{\n" + _wrapped([number(v) for v in array], indent + "    ") + "\n" + indent + "}"
    return indent + "{\n" + ",\n".join(_braced(part, depth + 1) for part in array) + "\n" + indent + "}"


def table(name: str, values: np.ndarray, *, flat: bool = False, of: str = "real") -> str:
    """Returns `static const real name[a][b] = {...};`. `flat`: row after row; `of`: the type. C has no empty
    array, so an array without numbers gets one 0."""
    array = np.asarray(values, float)
    array = array.reshape(-1) if flat or not array.size else array
    array = array if array.size else np.zeros(1)
    shape = "".join(f"[{length}]" for length in array.shape)
    return f"static const {of} {name}{shape} =\n{_braced(array, 0)};\n"


def define(name: str, value: float | int | str, real: str = "REAL({})") -> str:
    """Returns `#define name value`. `real`: format of a float, with the precision of the build."""
    whole = f'"{value}"' if isinstance(value, str) else str(value)
    text = real.format(number(value)) if isinstance(value, float) else whole
    return f"#define {name} {text}\n"


# ---- machine.h


def sizes(exported: Exported) -> dict[str, int]:
    """Returns lengths of the arrays. `watched`: states of a governor's member; `instants`: that it looks
    ahead for each output; `watch`: states of the supervisor's observer; `windows`: its forecasts; `pairs`: of
    input and output."""
    m, p = exported.controller.law.D.shape
    laws = [one for one in (exported.controller, exported.fallback) if one is not None]
    family, watched = governor_of(exported), exported.supervision
    members, states, instants = 1, p, 1
    if family is not None:
        members, states = len(family.start_0), family.start_0.shape[1] // 2
        instants = family.above.shape[1] // p
    return {
        "inputs": m,
        "outputs": p,
        "disturbances": len(exported.machine.disturbances),
        "memory": max([1, *(len(one.law.A) for one in laws)]),
        "members": members,
        "watched": states,
        "instants": instants,
        "watch": len(watched.A),
        "windows": supervise.WINDOWS,
        "signals": max(m, p),
        "pairs": len(watched.of_input),
    }


def governor_of(exported: Exported) -> Governor | None:
    """Returns the governor that law and fallback share. Raises ValueError if they have different ones."""
    found = [one.governor for one in (exported.controller, exported.fallback) if one is not None]
    found = [one for one in found if one is not None]
    for other in found[1:]:
        if not all(map(np.array_equal, found[0], other)):
            raise ValueError(
                f"controller {exported.name}: law and fallback have different governors; expected one for "
                "both, deploy them in one setting"
            )
    return found[0] if found else None


def machine_header(exported: Exported, certificate_sha256: str) -> str:
    machine = exported.machine
    kinds = {"INPUT": machine.inputs, "OUTPUT": machine.outputs, "DISTURBANCE": machine.disturbances}
    return "".join(
        [
            "/* The machine that this controller is made for; beadline_init refuses others. Do not edit.\n",
            f" * Contestant {exported.name}. */\n",
            "#ifndef BEADLINE_MACHINE_H\n#define BEADLINE_MACHINE_H\n\n",
            define("BEADLINE_CONTESTANT", exported.name),
            define("BEADLINE_CERTIFICATE_SHA256", certificate_sha256),
            define("BEADLINE_PLANT_SHA256", exported.plant_sha256),
            define("BEADLINE_SPREAD_SHA256", exported.spread_sha256),
            "/* 1: the plant was simulated, and the controller runs in a rehearsal only */\n",
            define("BEADLINE_SIMULATED", int(exported.simulated)),
            define("BEADLINE_SAMPLE_TIME_S", float(machine.sample_time_s), "{}"),
            define("BEADLINE_INPUT_UNIT", machine.inputs[0].unit),
            define("BEADLINE_OUTPUT_UNIT", machine.outputs[0].unit),
            "\n/* Inputs and outputs in the order of every array */\n",
            *(
                define(f"{kind}_{identifier(one.name)}", i)
                for kind, signals in kinds.items()
                for i, one in enumerate(signals)
            ),
            "\n/* Lengths of arrays */\n",
            *(define(name.upper(), value) for name, value in sizes(exported).items()),
            "#define FORECASTS (OUTPUTS * INSTANTS)\n\n#endif\n",
        ]
    )


# ---- tables.h


def tables(exported: Exported) -> str:
    """Returns tables.h: law, target, governor and supervisor as numbers."""
    own = exported.fallback
    return "".join(
        [
            "/* The numbers of one controller. Generated; do not edit. Included by controller.c only. */\n\n",
            ONE_INPUT if len(exported.machine.inputs) == 1 else "",
            _aiming(exported),
            _governing(exported),
            "\n/* ---- the law */\n\n",
            _law("the_law", exported.controller),
            "\n/* ---- the safe mode own */\n\n",
            define("HAS_FALLBACK", int(own is not None)),
            "#define the_fallback the_law\n" if own is None else _law("the_fallback", own),
            define("FADES", law.FADES),
            _forward("forward", exported),
            supervising(exported.supervision),
        ]
    )


def _forward(name: str, exported: Exported, *, of: str = "real") -> str:
    """Returns gain, mean and lead of the feed-forward, as in law.FeedForward."""
    m, q = len(exported.machine.inputs), len(exported.machine.disturbances)
    forward = exported.controller.forward or FeedForward(np.zeros((m, q)), np.zeros(q), np.zeros(q))
    gain = forward.gain if q else np.zeros((m, 1))
    parts = {"gain": gain, "mean": forward.mean, "lead": forward.lead}
    return "".join(table(f"{name}_{part}", values, of=of) for part, values in parts.items())


def plant_header(exported: Exported) -> str:
    """Returns test_plant.h: the model that test_controller.c heats."""
    model = strictly_proper(exported.model)
    text = "/* The model that the test heats: x(t+1) = A x + B u + b, y = C x + d. Do not edit. */\n\n"
    arrays = {"A": model.A, "B": model.B, "C": model.C, "b": model.b, "d": model.d}
    text += define("STATES", model.n)
    span = np.array([one.high - one.low for one in exported.machine.inputs])
    text += table("input_range", span, of="double") + _forward("plant", exported, of="double")
    return text + "".join(table(f"plant_{name}", values, of="double") for name, values in arrays.items())


def _aiming(exported: Exported) -> str:
    """Returns what feasible_target needs: outputs at rest are aim_rows u + aim_rest + aim_d."""
    limits = exported.controller.limits
    rows, rest = at_rest(exported.model)
    narrowest = float((limits.high - limits.low).min())
    return "".join(
        [
            "/* ---- the feasible target, as law.feasible_target has it */\n\n",
            define("AIM_TOLERANCE", 1e-3, "{}"),
            define("AIM_FINEST", 1e-3, "{}"),
            define("AIM_FIRST", narrowest / 4, "{}"),
            define("AIM_WIDEST", 0.49 * narrowest, "{}"),
            define("LIGHT", law.LIGHT, "{}"),
            define("ROUNDING", law.ROUNDING, "{}"),
            define("FALL", law.FALL, "{}"),
            table("aim_rows", rows, of="double"),
            table("aim_rest", rest, of="double"),
            table("aim_d", exported.model.d, of="double"),
        ]
    )


def at_rest(model: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Returns G (p, m) and g (p,), with which the outputs rest at G u + g + d for constant inputs u."""
    per_u, rest = law.state_at_rest(model)
    return model.C @ per_u + model.D, model.C @ rest


def feeds(law: Law) -> dict[str, np.ndarray]:
    """Returns the terms of feed = feed_u u + feed_y y* + feed_r r + feed_0 in `law.aim`, for constant
    references."""
    m, p = law.D.shape
    bare, none = law._replace(c=np.zeros(len(law.c))), np.zeros(p)

    def feed(of: Law, u: np.ndarray, y: np.ndarray, r: np.ndarray) -> np.ndarray:
        return aim(of, Rest(u[:, None], y[:, None], none, ()), constant(r)).feed[:, 0]

    still = np.zeros(m)
    return {
        "feed_u": np.column_stack([feed(bare, one, none, none) for one in np.eye(m)]),
        "feed_y": np.column_stack([feed(bare, still, one, none) for one in np.eye(p)]),
        "feed_r": np.column_stack([feed(bare, still, none, one) for one in np.eye(p)]),
        "feed_0": feed(law, still, none, none),
    }


def _governing(exported: Exported) -> str:
    family = governor_of(exported)
    forgets, overshoot, strength = 0.0, 0.0, law.Strength(1.0, 1.0, 0.0)
    if family is not None:
        forgets, overshoot, strength = float(family.forgets), float(family.overshoot), family.strength
    halves = member_halves(family) if family is not None else _no_members(sizes(exported))
    return "".join(
        [
            "\n/* ---- the governor, as law.Governor has it; members first */\n\n",
            define("SWEEPS", law.SWEEPS),
            define("ROUNDS", law.ROUNDS),
            define("EXACT", law.EXACT, SINGLE_EXACT),
            define("CONTRADICTED", law.CONTRADICTED),
            define("ARRIVED", law.ARRIVED),
            define("FORGETS", forgets),
            define("OVERSHOOT", overshoot),
            define("STRONGEST", strength.strongest),
            define("WEAKEST", strength.weakest),
            *(table(f"governor_{name}", values) for name, values in halves.items()),
        ]
    )


def _no_members(at: dict[str, int]) -> dict[str, np.ndarray]:
    """Returns the tables of `member_halves`, all zero, if there is no governor."""
    f, n, p, m = (at[name] for name in ("members", "watched", "outputs", "inputs"))
    h = p * at["instants"]
    shapes = {
        "C": (f, p, n), "L": (f, n, p), "A": (f, n, n), "B": (f, n, m), "B_lacks": (f, n, m), "b": (f, n),
        "start": (f, n, p), "start_0": (f, n), "ahead": (f, h, n), "offset": (f, p), "above": (f, h),
        "below": (f, h), "rise": (f, h, m), "fall": (f, h, m), "rise_least": (f, h), "fall_least": (f, h),
        "low": (p,), "high": (p,), "surprise": (p,), "doubt": (p,), "near": (p,),
    }  # fmt: skip
    return {name: np.zeros(shape) for name, shape in shapes.items()}


def member_halves(family: Governor) -> dict[str, np.ndarray]:
    """Returns the matrices of a Governor without known zeros and duplicates. The state and what it lacks at
    the weakest move in the same way, so each block is stored once. The golden vectors fail if a governor has
    another form."""
    f, p = family.offset.shape
    n = family.start_0.shape[1] // 2
    C, A = (part.transpose(0, 2, 1)[:, : len(part[0].T) // 2, :n] for part in (family.see, family.move))
    ahead = family.ahead.transpose(0, 2, 1)[:, : family.above.shape[1], :n]
    quick, slow = family.correct[:, :p, :n], family.correct[:, p : 2 * p, :n]
    L = (quick + slow).transpose(0, 2, 1)
    B, B_lacks = (family.push.transpose(0, 2, 1)[:, part] for part in (slice(n), slice(n, None)))
    return {
        "C": C, "L": L, "A": A, "B": B, "B_lacks": B_lacks, "b": family.rest[:, :n],
        "start": family.start.transpose(0, 2, 1)[:, :n], "start_0": family.start_0[:, :n],
        "ahead": ahead, "offset": family.offset, "above": family.above, "below": family.below,
        "rise": family.rise.transpose(0, 2, 1), "fall": family.fall.transpose(0, 2, 1),
        "rise_least": _least(family.rise), "fall_least": _least(family.fall),
        "low": family.low, "high": family.high, "surprise": family.surprise, "doubt": family.doubt,
        "near": family.near,
    }  # fmt: skip


def _least(rows: np.ndarray) -> np.ndarray:
    """Returns the smallest effects (f, p h) that count, as in law._swept, for rows (f, m, p h)."""
    return law.LEAST_EFFECT * np.maximum(rows, 0.0).max(axis=1)


def _law(name: str, deployed: Deployed) -> str:
    """Returns `static const law <name>` with its matrices."""
    law, limits = deployed.law, deployed.limits
    q, (_, p) = len(law.A), law.D.shape
    A = np.zeros(0) if deployed.shift else law.A
    arrays = {
        "A": A, "B_u": law.B_u, "B_y": law.B_y, "B_r": law.B_r, "c": law.c, "K": law.K, "D": law.D,
        "K_r": law.K_r, "integral": np.broadcast_to(np.asarray(law.integral, float), (p,)),
        "back": deployed.back, "start_u": law.start_u, "start_y": law.start_y, "start": law.start,
        "low": limits.low, "high": limits.high, "rate": limits.rate, **feeds(law),
    }  # fmt: skip
    text = "".join(table(f"{name}_{key}", values, flat=True) for key, values in arrays.items())
    flags = (
        q,
        deployed.shift,
        int(law.conditional),
        int(bool(np.any(law.integral))),
        int(deployed.holds),
        int(deployed.governor is not None),
    )
    fields = [str(flag) for flag in flags] + [number(deployed.integral_limit)]
    fields += [f"{name}_{key}" for key in arrays]
    return text + f"static const law {name} = {{\n{_wrapped(fields, '    ')}\n}};\n"


# ---- the supervisor in numbers

# names in tables.h of the constants of supervise.py
OF_SUPERVISOR = (
    "SPACING", "STILL_AFTER", "FIT_AFTER", "STEPS_STILL", "NOISE_STILL", "SAME_STEPS", "SAME_NOISE",
    "CLEARED_S", "CLEARER", "MISFIT", "DOUBT", "RESTS", "REPEATED", "SHOWN", "SLOWLY",
    "EARLY", "JUMP", "SETTLES", "BACK_S", "RETURNS", "MOST_STEP_DEGC", "UNKNOWN_STEP_DEGC",
    "MISSING", "AT_LIMIT", "FAR_DEGC",
)  # fmt: skip
OF_OBSERVER = (
    "A",
    "B",
    "C",
    "b",
    "d",
    "L",
    "M",
    "hurried",
    "unsure",
    "wander",
    "start",
    "start_0",
    "low",
    "high",
    "heat",
)


def supervising(s: supervise.Supervision) -> str:
    """Returns the Supervision, with the constants that its step takes from its module."""
    arrays = {name: getattr(s, name) for name in OF_OBSERVER}
    arrays |= {"coldest": s.coldest, "hottest": s.hottest, "noise": s.noise_degC}
    return "".join(
        [
            "\n/* ---- the supervisor, as supervise.Supervision has it */\n\n",
            *(define(name, getattr(supervise, name)) for name in OF_SUPERVISOR),
            define("FOLLOWS_LEAST", supervise.FOLLOWS[0]),
            define("FOLLOWS_MOST", supervise.FOLLOWS[1]),
            define("REACH_DEGC", s.reach_degC),
            table("explanation_least", supervise.LEAST),
            table("explanation_most", supervise.MOST),
            define("MISSING_FOR", s.missing_for),
            integers("supervisor_of_input", s.of_input),
            integers("supervisor_input_of", s.input_of),
            *(table(f"supervisor_{name}", values) for name, values in arrays.items()),
        ]
    )


def integers(name: str, values: np.ndarray) -> str:
    items = [str(int(value)) for value in values]
    return f"static const int {name}[{len(items)}] = {{\n{_wrapped(items, '    ')}\n}};\n"


def identifier(name: str) -> str:
    """Returns `name` in capitals, with _ for characters that no identifier may contain."""
    return re.sub(r"\W", "_", name, flags=re.ASCII).upper()
