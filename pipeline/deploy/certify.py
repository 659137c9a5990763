"""Measure a controller on its record, for its certificate. Three questions, in the declared order of
certificate.RULES: is the record of this machine, does the evidence hold (certificate_evidence.py), and would
the controller work (certificate_loop.py)? What is allowed is compared afterwards (certified.py).
"""

import copy
from collections.abc import Sequence

import numpy as np

from pipeline.deploy import bands, certificate_evidence, certificate_loop
from pipeline.deploy.certificate import LOOP, VERSION, Certificate, EvidenceRecord, Rules
from pipeline.deploy.certificate_evidence import WindowModels
from pipeline.deploy.certified import MeasuredController
from pipeline.deploy.machine import controller_sha256
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers.law import Plant
from pipeline.temperature.test_set import panel

NEWEST = 0.25  # of a single recording: its end stands for the machine as it is today
SHORTEST = 100  # samples of a piece between two missing ones, below which it shows nothing of its own
REACH = 0.25  # of the recorded span, beyond which no reference is certified
COOLEST = 0.05  # quantile of the recorded temperatures


def cut_at_missing(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], recordings: Sequence[int]
) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """The pieces (T, m), (T, p) and the recording of each, cut where a sample of an output is missing (NaN);
    pieces shorter than SHORTEST samples are left out."""
    parts = [
        (inputs[run], outputs[run], number)
        for inputs, outputs, number in zip(u, y, recordings, strict=True)
        for run in np.ma.clump_unmasked(np.ma.masked_invalid(outputs.sum(axis=1)))
        if run.stop - run.start >= min(SHORTEST, len(outputs))
    ]
    return [a for a, _, _ in parts], [b for _, b, _ in parts], [number for *_, number in parts]


def split_newest(
    u: Sequence[np.ndarray], y: Sequence[np.ndarray], recordings: Sequence[int]
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """u, y, newest u, newest y of pieces (T, m), (T, p) without a missing sample and the recording of each.
    The newest are the pieces of the last recording, or the last quarter of the longest piece of a single
    one."""
    pieces, new = list(zip(u, y, strict=True)), [number == recordings[-1] for number in recordings]
    if all(new):
        longest = max(range(len(pieces)), key=lambda i: len(pieces[i][0]))
        a, b = pieces[longest]
        cut = round((1 - NEWEST) * len(a))
        pieces[longest : longest + 1] = [(a[:cut], b[:cut]), (a[cut:], b[cut:])]
        new = [i == longest + 1 for i in range(len(pieces))]
    learned, newest = (
        [piece for piece, flag in zip(pieces, new, strict=True) if flag == wanted] for wanted in (False, True)
    )
    return [a for a, _ in learned], [b for _, b in learned], [a for a, _ in newest], [b for _, b in newest]


def require(half: panel.Cases, record: EvidenceRecord, settled: int, plants: int, resamples: int) -> Rules:
    """How each controller is measured: on the constant references of the judging half that the record
    reaches, from where the record is coolest. References further off were simulated only. If the record
    reaches none, all are taken, and the certificate is refused."""
    constants = sorted({int(half.asked[row, 0]) for row in np.flatnonzero(half.kind == "constant")})
    references = np.array([half.references[index].H[:, 0] for index in constants])
    y = np.concatenate([*record.y, *record.newest_y])
    low, high = y.min(axis=0), y.max(axis=0)
    near = (references >= low - REACH * (high - low)) & (references <= high + REACH * (high - low))
    return Rules(
        references=references[near.all(axis=1)] if near.all(axis=1).any() else references,
        start=np.quantile(y, COOLEST, axis=0),
        steps=half.steps // 2,
        settled=min(settled, half.steps // 4),
        plants=plants,
        resamples=resamples,
    )


def measure(
    exported: Exported,
    family: Sequence[Plant],
    record: EvidenceRecord,
    rules: Rules,
    models: WindowModels,
    rng: np.random.Generator,
    *,
    learning: bands.GainRoute | None = None,
    delay_share: float = 1.0,
    conditions: str = "",
) -> MeasuredController:
    """What the certificate of a controller says before its limits are known.

    `family` is the spread of the identified plant, `models` what certificate_evidence.window_models drew from
    the record with `rng`, which is copied. `learning` says how gains were learned from the record; then bands
    of them are measured. `delay_share` of a declared delay margin is required of this machine. `conditions`
    is the certificate's sentence.
    """
    rng = copy.deepcopy(rng)
    results = certificate_evidence.of_signals(exported, record, rules)
    figures, fields = {}, {}
    draft = _draft(exported, record)._replace(conditions=conditions)
    if not all(one.passed for one in results):
        return MeasuredController(draft._replace(rules=tuple(results)), {})
    results = [*results, *models.results]
    if models.noise_degC is not None:
        names = [one.name for one in exported.machine.outputs]
        noise_degC = models.noise_degC.tolist()
        figures["noise"] = {
            "degC": noise_degC, "outputs": names, "settled": rules.settled, "limit": rules.noise
        }  # fmt: skip
        if models.of_newest is None:
            results.append(certificate_evidence.no_newest(record, rules))
    with np.errstate(all="ignore"):  # what diverges is a finding
        if models.of_record is not None and models.of_newest is not None:
            unexplained, more = certificate_evidence.of_newest(exported, record, models.of_newest, rules)
            results, figures = [*results, unexplained], figures | more
            if all(one.passed for one in results):
                fields, of_loop, more = certificate_loop.of_loop(
                    exported, family, models.of_record, models.of_newest, rules, rng
                )
                results, figures = [*results, *of_loop], figures | more
                figures["delay_margin"]["share"] = delay_share
                if learning is not None:
                    fields["bands"] = certificate_loop.gain_bands(exported, record, learning, rules, rng)
    return MeasuredController(draft._replace(rules=tuple(results), **fields), figures)


def _draft(exported: Exported, record: EvidenceRecord) -> Certificate:
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
        poles=(),
        margins=None,
        worst=None,
        violations=(),
        bands=None,
        rules=(),
        verdict="refused",
        first_failed=None,
        conditions="",
    )
