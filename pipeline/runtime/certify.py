"""Certify a controller on its record. Three questions, asked in the declared order of certificate.RULES; the
first rule that fails refuses.

Is the record of this machine, and does the evidence hold (certificate_evidence.py)? Would it work
(certificate_loop.py)?
"""

from collections.abc import Sequence

import numpy as np

from pipeline.runtime import bands, certificate_evidence, certificate_loop
from pipeline.runtime.certificate import LOOP, RULES, VERSION, Certificate, Record, RuleResult, Rules
from pipeline.runtime.machine import Exported, controller_sha256
from pipeline.temperature.plant import Plant


def certify(
    exported: Exported,
    family: Sequence[Plant],
    record: Record,
    rules: Rules,
    rng: np.random.Generator,
    *,
    learning: bands.Learning | None = None,
) -> Certificate:
    """The certificate of a controller on its record; `family` is the spread of the identified plant.

    `learning` says how gains were learned, where a record's bands of them are wanted. Raises ValueError where
    the arrays of the record do not have the machine's number of signals.
    """
    _check(exported, record, rules)
    with np.errstate(all="ignore"):  # what diverges is a finding
        return _certified(exported, family, record, rules, rng, learning)


def _certified(
    exported: Exported,
    family: Sequence[Plant],
    record: Record,
    rules: Rules,
    rng: np.random.Generator,
    learning: bands.Learning | None,
) -> Certificate:
    results = [*certificate_evidence.of_signals(exported, record, rules)]
    shown = certificate_loop.Shown()
    if all(one.passed for one in results):
        sampled, of_evidence = certificate_evidence.of_evidence(exported, record, rules, rng)
        results += of_evidence
        if sampled is not None and all(one.passed for one in results):
            shown, of_loop = certificate_loop.of_loop(exported, family, sampled, rules, rng)
            results += of_loop
            if learning is not None:
                shown = shown._replace(
                    bands=certificate_loop.gain_bands(exported, record, learning, rules, rng)
                )
    done = {one.name for one in results}
    first = next((one.name for one in results if not one.passed), None)
    results += [
        RuleResult(name, False, None, None, "", f"Not asked, because {first} failed.", False)
        for name in RULES
        if name not in done
    ]
    return Certificate(
        VERSION,
        LOOP,
        exported.name,
        controller_sha256(exported),
        exported.plant_sha256,
        exported.spread_sha256,
        "simulated" if exported.simulated else "recorded",
        float(exported.machine.sample_time_s),
        exported.machine.inputs,
        exported.machine.outputs,
        (sum(map(len, record.u)), sum(map(len, record.newest_u))),
        shown.poles,
        shown.margins,
        shown.worst,
        shown.violations,
        shown.bands,
        tuple(results),
        "passed" if first is None else "refused",
        first,
    )


def _check(exported: Exported, record: Record, rules: Rules) -> None:
    m, p = exported.controller.law.D.shape
    for what, parts, count in (
        ("u", record.u, m),
        ("newest_u", record.newest_u, m),
        ("y", record.y, p),
        ("newest_y", record.newest_y, p),
    ):
        if not parts or any(part.ndim != 2 or part.shape[1] != count for part in parts):
            shapes = [part.shape for part in parts]
            raise ValueError(
                f"certificate of {exported.name}: expected segments {what} of {count} columns but found "
                f"shapes {shapes}; give the record of the machine that the controller is for"
            )
        if not all(np.isfinite(part).all() for part in parts):
            raise ValueError(
                f"certificate of {exported.name}: {what} holds samples that are missing; cut the record into "
                "segments without them"
            )
    if np.shape(rules.references)[1:] != (p,) or np.shape(rules.start) != (p,):
        raise ValueError(
            f"certificate of {exported.name}: expected references (g, {p}) and a start ({p},) but found "
            f"{np.shape(rules.references)} and {np.shape(rules.start)}; give one temperature an output"
        )
