"""What train_classifier learns from: key areas of rendered frames, or of a user's folder, in four parts that share no segment; and the windows that controllers are trained on."""

import collections
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from joblib import delayed
from pydantic import Field
from tqdm import tqdm

from pipeline import artifacts, nozzle_frames
from pipeline.execution import run_all
from pipeline.nozzle_frames import NozzleFrames, Reading
from pipeline.nozzle_recordings import Topics
from pipeline.nozzle_rendering import FLOW_EDGES, Seen, joined, rendered, swept
from pipeline.params import Execution, Mapped, Section
from pipeline.setpoint.classifier import Labelled, split_by_segment
from pipeline.setpoint.recorded import WindowTable

PARTS = ("learned", "held_out", "calibration", "judged")


class Counts(Section):
    """A number for each of the four parts."""

    learned: int = Field(ge=1, le=10_000)
    held_out: int = Field(ge=1, le=10_000)
    calibration: int = Field(ge=1, le=10_000)
    judged: int = Field(ge=1, le=10_000)


class Recorded(Section):
    """Segments whose windows over the whole range of flows are recorded for the simulator, and windows of each in a bin of the flow: those that controllers are trained
    and tuned on (many segments, as what a segment adds stays with its windows), and those that they are judged on."""

    learn: int = Field(ge=1, le=1000)
    judge: int = Field(ge=1, le=1000)
    learn_windows: float = Field(gt=0, le=100)
    judge_windows: float = Field(gt=0, le=100)


class Recipe(Section):
    """How a network of one size is trained."""

    epochs: int = Field(ge=1, le=10_000)
    cycle_epochs: int = Field(ge=1, le=10_000)
    warmup_epochs: float = Field(ge=0, le=1000)
    batch: int = Field(ge=1, le=100_000)
    learning_rate: float = Field(gt=0, le=1)
    weight_decay: float = Field(ge=0, le=1)
    smoothing: float = Field(ge=0, lt=1)
    averaging: float = Field(ge=0, lt=1)
    patience: int = Field(ge=1, le=10_000)


class RecordedTopics(Section):
    """Topics of a user's MCAP recordings, as nozzle_recordings.Topics says."""

    image: str = Field(max_length=300)
    time: str = Field(max_length=300)
    mapping: dict[str, Mapped]

    def topics(self) -> Topics:
        return Topics(self.image, self.time, {name: (m.source, m.unit, m.scale, m.offset) for name, m in self.mapping.items()})


class TrainClassifier(Section):
    """Section `train_classifier`."""

    source: Literal["simulated", "recordings"]
    seed: int = Field(ge=0, le=2**31)
    size: Literal["small", "paper"]
    augmentation: Literal["along_bead", "adr"]
    segments: Counts
    prints: Counts
    frames: Counts
    window: int = Field(ge=1, le=1000)
    least_score: float = Field(ge=0, le=255)
    tip_px: tuple[Annotated[float, Field(ge=0, le=100_000)], Annotated[float, Field(ge=0, le=100_000)]] | None
    topics: RecordedTopics
    small: Recipe
    paper: Recipe
    cnn: Recipe
    coverage: float = Field(gt=0.5, lt=1)
    confidence: float = Field(gt=0.5, lt=1)
    false_alarms: float = Field(gt=0, lt=0.5)
    recorded: Recorded


def parts(p: TrainClassifier, folder: str, execution: Execution) -> tuple[dict[str, Seen], dict[str, Any]]:
    """The four parts of PARTS, no segment in two of them, and what was read, counted; the frames of `folder` where the source is recordings."""
    if p.source == "recordings":
        folder = Path(folder)
        frames = nozzle_frames.read_folder(
            folder, Reading(p.tip_px, p.least_score, p.topics.topics()), execution, memo=Path("datasets/memo/train_classifier")
        )
        nozzle_frames.check(folder, frames)
        with artifacts.about(folder):
            return _by_print(p, frames), nozzle_frames.figures(frames)
    counts = p.segments.model_dump()
    frames = p.frames.model_dump()
    calls = [delayed(rendered)((p.seed, k, i), frames[part], p.least_score) for k, part in enumerate(PARTS) for i in range(counts[part])]
    done = iter(tqdm(run_all(calls, execution), total=len(calls), desc="train_classifier: frames", mininterval=2))
    everything = joined([*done])
    owner = np.repeat(PARTS, [15 * frames[part] * counts[part] for part in PARTS])
    found = {part: everything.take(owner == part) for part in PARTS}
    return found, {
        "frames": len(everything.valid), "valid": int(everything.valid.sum()), "valid_share": float(everything.valid.mean()),
        "rejected": dict(sorted(collections.Counter(_kind(reason) for reason in everything.reasons if reason).items())),
        "segments": len(np.unique(everything.segment)), "of_class": [int((everything.valid & (everything.label == c)).sum()) for c in range(3)],
    }  # fmt: skip


def _kind(reason: str) -> str:
    return reason.split(":")[0]


def _by_print(p: TrainClassifier, frames: NozzleFrames) -> dict[str, Seen]:
    """The frames of a folder, its prints dealt out to the parts in proportion to `prints`; frames without a known class or temperature are left out."""
    known = (frames.label >= 0) & np.isfinite(frames.temperature)
    seen = Seen(
        frames.images, frames.label, frames.flow, frames.temperature, frames.print_number, frames.segment, frames.valid, np.array(frames.reasons, object)
    ).take(known)  # fmt: skip
    valid = seen.take(seen.valid)
    shares = tuple(float(n) for n in p.prints.model_dump().values())
    chosen = split_by_segment(
        Labelled(valid.images, valid.temperature, valid.label, valid.print_number), shares=shares, rng=np.random.default_rng(p.seed)
    )
    return {part: seen.take(np.isin(seen.print_number, valid.print_number[rows])) for part, rows in zip(PARTS, chosen, strict=True)}


# ---- windows for the simulator


def to_record(p: TrainClassifier, found: dict[str, Seen], execution: Execution) -> dict[str, Seen]:
    """Frames whose windows controllers are trained on ("learn") and judged on ("judge"): rendered over the whole range of flows, or what a folder has for calibration and judging."""
    if p.source == "recordings":
        return {"learn": found["calibration"], "judge": found["judged"]}
    counts, windows = {"learn": p.recorded.learn, "judge": p.recorded.judge}, (p.recorded.learn_windows, p.recorded.judge_windows)
    calls = [
        delayed(swept)((p.seed, len(PARTS) + k, i), windows[k], p.window, p.least_score)
        for k, part in enumerate(counts)
        for i in range(counts[part])
    ]
    done = iter(tqdm(run_all(calls, execution), total=len(calls), desc="train_classifier: windows at every flow", mininterval=2))
    return {part: joined([next(done) for _ in range(count)]) for part, count in counts.items()}


def edges(flows: Sequence[np.ndarray]) -> np.ndarray:
    """FLOW_EDGES, of which those are left out that would leave a bin without a window in any of several sets of flows (w,)."""
    kept = [min(FLOW_EDGES[0], *(float(flow.min()) for flow in flows))]
    for edge in FLOW_EDGES[1:-1]:
        if all(((flow >= kept[-1]) & (flow < edge)).any() for flow in flows):
            kept.append(edge)
    while len(kept) > 1 and not all((flow >= kept[-1]).any() for flow in flows):
        kept.pop()
    return np.array([*kept, max(FLOW_EDGES[-1], *(float(flow.max()) for flow in flows))])


def window_rows(tables: dict[str, WindowTable]) -> dict[str, np.ndarray]:
    """The tables of "learn" and "judge" as columns of schema WINDOWS."""
    columns = collections.defaultdict(list)
    for part, table in tables.items():
        columns["part"] += [part] * len(table.named)
        columns["flow_bin"].append(table.flow_bin)
        columns["flow_low_percent"].append(table.flow_edges[table.flow_bin])
        columns["flow_high_percent"].append(table.flow_edges[table.flow_bin + 1])
        columns["segment"].append(table.segment)
        columns["named"].append(table.named)
        for c, name in enumerate(("under", "good", "over")):
            columns[f"p_{name}"].append(table.shares[:, c])
    return {name: values if name == "part" else np.concatenate(values) for name, values in columns.items()}


def window_tables(columns: dict[str, np.ndarray]) -> dict[str, WindowTable]:
    """The reverse of `window_rows`."""
    found = {}
    for part in ("learn", "judge"):
        rows = columns["part"] == part
        bins, first = np.unique(columns["flow_bin"][rows], return_index=True)
        low, high = (columns[f"flow_{end}_percent"][rows][first] for end in ("low", "high"))
        shares = np.stack([columns[f"p_{name}"][rows] for name in ("under", "good", "over")], axis=1)
        found[part] = WindowTable(
            shares,
            columns["named"][rows],
            np.searchsorted(bins, columns["flow_bin"][rows]),
            columns["segment"][rows],
            np.append(low, high[-1]),
        )
    return found
