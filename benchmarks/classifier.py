"""The classifier and its calibration over training seeds, each on
scenes of its own; what it says by flow; and how fast the paper's size trains.

`./run python -m benchmarks.classifier 5` prints five seeds with their bars and writes
benchmarks/results/classifier.json; `... 5 others` trains the CNN and the published crop beside them; `...
classifier speed` measures throughput alone and adds `speed` to the results. `... classifier --by-flow` judges
the classifier that datasets/train_classifier holds on 200 new segments in each bin of 5 % from 70 to 150 %,
with windows of 20 and of 8 frames, and adds `by_flow`.

Parts of the seeds are split by segment: 3,000 segments of 6 frames to learn from, 120 of 8 to stop on, 540 of
20 to calibrate with and 360 of 20 to judge on. Images that the front end rejects are neither learned nor
judged; windows are 20 frames in a row of one segment, whatever of them is valid. The worst seed counts. Times
are CPU seconds of all threads.
"""

import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np

from pipeline.setpoint import calibrated_classifier, calibration, nozzle_scene, yardsticks
from pipeline.setpoint.classifier import (
    Labelled,
    Rates,
    TrainingSettings,
    _step,
    adr,
    along_bead,
    predict,
    train,
    untrained,
)
from pipeline.setpoint.vision_transformer import PAPER, SMALL, Classifier, convolutional, vision_transformer
from pipeline.setpoint.workflow.classifier_files import restore_classifier

RESULTS = Path(__file__).parent / "results" / "classifier.json"
PARTS = {
    "learned": (3000, 6),
    "stopping": (120, 8),
    "unseen": (540, 20),
    "test": (360, 20),
}  # segments, frames
LEAST_SCORE, WINDOW, BINS = 10.0, 20, 10
TRAINING = TrainingSettings(
    cycle_epochs=12,
    warmup_epochs=2,
    batch=64,
    learning_rate=4e-3,
    weight_decay=0.01,
    smoothing=0.0,
    averaging=0.99,
    patience=6,
)
EPOCHS = 12
PROMISE, FALSE_ALARMS = calibration.Promise(coverage=0.95, confidence=0.8, by_flow=0.93), 0.03
# new segments in a bin of flow, windows of so many frames, segments rendered in one go
A_BIN, LENGTHS, AT_ONCE = 200, (20, 8), 64
STORED = [f"datasets/train_classifier/{name}" for name in ("weights.safetensors", "calibration.parquet")]
BARS = {
    "image_accuracy": (">=", 0.70), "window_accuracy": (">=", 0.83), "above_svc": (">=", 0.03),
    "ece_image": ("<=", 0.025), "ece_window": ("<=", 0.04),
    "right_70_150": (">=", 0.75), "coverage": (">=", 0.93), "false_alarms": ("<=", 0.05),
    "auroc_blur": (">=", 0.90), "auroc_transposed": (">=", 0.90),
    "train_cpu_s": ("<=", 200.0),
}  # fmt: skip


def parts(seed: int) -> dict[str, tuple[Labelled, np.ndarray]]:
    """Scenes of every part with its valid mask; segments are numbered through."""
    out, rng = {}, np.random.default_rng(seed)
    for i, (name, (segments, frames)) in enumerate(PARTS.items()):
        draw = nozzle_scene.draw_judged_flow if name == "test" else nozzle_scene.draw_flow
        made = filmed(rng, draw(rng, segments), frames)
        out[name] = made[0]._replace(segment=made[0].segment + 10_000 * i), made[1]
    return out


def filmed(rng: np.random.Generator, flow: np.ndarray, frames: int) -> tuple[Labelled, np.ndarray]:
    """A segment of `frames` frames at each flow (n,), the temperatures in turn; and which are valid."""
    temperature = np.resize(nozzle_scene.TEMPERATURES, len(flow))
    made = nozzle_scene.filmed(rng, flow, temperature, frames=frames, least_score=LEAST_SCORE)
    return Labelled(made.images, made.temperature, made.label, made.flow, made.segment), made.valid


def trained(network: Classifier, data: dict, seed: int, *, augment=along_bead) -> Classifier:
    learned, stopping = (
        data[name][0].take(np.flatnonzero(data[name][1])) for name in ("learned", "stopping")
    )
    start, key = untrained(network, epochs=EPOCHS), jax.random.key(seed)
    return train(start, learned, stopping, TRAINING, key=key, augment=augment).best


def foreign(
    network: Classifier, fitted: calibration.Calibration, test: calibration.ClassifierOutputs, data: Labelled
) -> dict:
    """AUROC of blur and transposed crops by the distance, and by its yardsticks; with the share of foreign
    images that the threshold finds."""
    v = test.valid
    familiar = calibration.mahalanobis(fitted.familiar, test.features[v])
    confidence = np.exp(calibration.log_probabilities(test.logits[v], fitted.temperature)).max(axis=1)
    out = {}
    for name, area in calibrated_classifier.foreign_images(data.key_area[v]).items():
        shown = predict(network, area, data.temperature_degC[v])
        score = calibration.mahalanobis(
            fitted.familiar, np.hstack([shown.features, calibration.appearance(area)])
        )
        p = np.exp(calibration.log_probabilities(shown.logits, fitted.temperature)).max(axis=1)
        out[f"auroc_{name}"] = calibration.auroc(familiar, score)
        out[f"found_{name}"] = float(np.mean(score > fitted.foreign_above))
        out[f"auroc_{name}_energy"] = calibration.auroc(
            calibration.energy(test.logits[v]), calibration.energy(shown.logits)
        )
        out[f"auroc_{name}_confidence"] = calibration.auroc(-confidence, -p)
    return out


class Judgement(NamedTuple):
    """Images that are valid, and windows: share right, reliability; windows by the paper's hard counts beside
    them; the sets; and the share of images taken for foreign."""

    image_accuracy: float
    window_accuracy: float
    image: calibration.Reliability
    window: calibration.Reliability
    hard_window: calibration.Reliability
    sets: calibration.Sets
    false_alarms: float


def judge(
    fitted: calibration.Calibration, test: calibration.ClassifierOutputs, *, length: int, bins: int
) -> Judgement:
    """How a calibrated classifier does on segments that neither learning nor calibration saw."""
    v, log_p = test.valid, calibration.log_probabilities(test.logits, fitted.temperature)
    windows = calibrated_classifier.window_predictions(fitted, test, length=length)
    label, p = windows.truth.label, windows.seen.prob
    image = calibration.reliability(np.exp(log_p[v]), test.label[v], bins=bins)
    window = calibration.reliability(p, label, bins=bins)
    hard = calibration.reliability(windows.hard, label, bins=bins)
    right = [float(np.mean(a.argmax(axis=1) == b)) for a, b in ((log_p[v], test.label[v]), (p, label))]
    foreign = calibration.mahalanobis(fitted.familiar, test.features[v]) > fitted.foreign_above
    return Judgement(
        *right, image, window, hard, calibration.sets(p, label, fitted.level), float(foreign.mean())
    )


def judged(network: Classifier, data: dict) -> dict:
    """Every figure of a trained network; `head_...` are those of the
    distance in the head's features alone."""
    outputs = {
        name: calibration.classifier_outputs(predict(network, d.key_area, d.temperature_degC), d, v)
        for name, (d, v) in data.items()
    }
    fitted = calibration.calibrate(
        outputs["learned"], outputs["unseen"], length=WINDOW, promise=PROMISE, false_alarms=FALSE_ALARMS
    )
    windows = calibrated_classifier.window_predictions(fitted, outputs["test"], length=WINDOW)
    right = windows.seen.prob.argmax(axis=1) == windows.truth.label
    judgement = judge(fitted, outputs["test"], length=WINDOW, bins=BINS)
    return {
        "image_accuracy": judgement.image_accuracy, "window_accuracy": judgement.window_accuracy,
        "temperature": fitted.temperature, "divisor": 1 + (WINDOW - 1) * fitted.correlation,
        "ece_image": judgement.image.error, "ece_image_floor": judgement.image.floor,
        "ece_window": judgement.window.error, "ece_window_floor": judgement.window.floor,
        "ece_window_hard": judgement.hard_window.error,
        "right_70_150": calibration.uniform_share(right, windows.truth).percent / 100,
        "coverage": judgement.sets.coverage,
        "held": judgement.sets.held, "false_alarms": judgement.false_alarms,
    } | foreign(network, fitted, outputs["test"], data["test"][0])  # fmt: skip


def yardstick(data: dict) -> dict:
    """The yardsticks, fitted on one learned frame in three."""
    (learned, v), (test, w) = data["learned"], data["test"]
    learned, v = learned.take(np.arange(0, len(v), 3)), v[::3]
    machine = yardsticks.fit_profile_machine(
        learned.key_area[v], learned.temperature_degC[v], learned.label[v], learned.segment[v]
    )
    rule = yardsticks.fit_width_rule(learned.key_area[v], learned.label[v])
    p = yardsticks.profile_probabilities(machine, test.key_area, test.temperature_degC)
    rows = calibration.windows(test.segment, test.label, length=WINDOW).rows
    windows = calibration.hard_shares(np.log(p + 1e-12)[rows], w[rows]).argmax(axis=1)
    return {
        "svc_image_accuracy": float(np.mean(p.argmax(axis=1)[w] == test.label[w])),
        "svc_window_accuracy": float(np.mean(windows == test.label[rows[:, 0]])),
        "otsu_image_accuracy": float(np.mean(yardsticks.width_class(rule,
        test.key_area[w]) == test.label[w])),
    }  # fmt: skip


def row(seed: int, others: bool) -> dict:
    data = parts(seed)
    start = time.process_time()
    small = trained(vision_transformer(SMALL, np.random.default_rng(seed)), data, seed)
    seconds = time.process_time() - start
    out = {"seed": seed} | judged(small, data) | yardstick(data) | {"train_cpu_s": seconds}
    out["above_svc"] = out["image_accuracy"] - out["svc_image_accuracy"]
    if others:
        forms = {
            "cnn": (convolutional(np.random.default_rng(seed)), along_bead),
            "small_published_crop": (vision_transformer(SMALL, np.random.default_rng(seed)), adr),
        }
        for name, (network, augment) in forms.items():
            figures = judged(trained(network, data, seed, augment=augment), data)
            out |= {
                f"{name}_image_accuracy": figures["image_accuracy"],
                f"{name}_window_accuracy": figures["window_accuracy"],
            }
    return out


def met(name: str, value: float) -> bool:
    kind, bar = BARS[name]
    return value >= bar if kind == ">=" else value <= bar


def worst(rows: list[dict]) -> dict:
    """The worst seed of each figure with a bar."""
    far = {">=": min, "<=": max}
    values = {name: far[kind]([r[name] for r in rows]) for name, (kind, _) in BARS.items()}
    return {
        name: {"worst": value, "bar": BARS[name][1], "met": bool(met(name, value))}
        for name, value in values.items()
    }


def speed(batch: int = 64, repeats: int = 4) -> dict:
    """Images a second of the paper's size, forward and backward with its update, and
    milliseconds an image of the forward pass: wall and CPU. Beside them what the matrix products
    that it cannot do without would take at the rate of the widest of them alone: on a machine
    that others use too, that ratio is what can be compared."""
    rng = np.random.default_rng(0)
    network = vision_transformer(PAPER, rng)
    rows = [
        jax.numpy.asarray(rng.integers(0, 256, (batch, 16, 48)), jax.numpy.uint8),
        jax.numpy.full(batch, 210.0),
        jax.numpy.arange(batch) % 3,
        jax.numpy.full(batch, 100.0),
    ]
    carry, drawn = untrained(network, epochs=1), (jax.random.key(0), jax.numpy.arange(batch))
    carry = (carry.network, carry.average, carry.opt_state)

    def timed(f) -> tuple[float, float]:
        jax.block_until_ready(f())
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(repeats):
            jax.block_until_ready(f())
        return (time.perf_counter() - wall) / repeats / batch, (time.process_time() - cpu) / repeats / batch

    step = timed(lambda: _step(along_bead, carry, drawn, rows, Rates(1e-4, 1, 100, 0.0, 0.0, 0.0)))
    forward = jax.jit(lambda x, u: network(x, u))
    forward_pass = timed(lambda: forward(rows[0], rows[1]))
    x, W = (
        jax.numpy.asarray(rng.normal(size=shape), jax.numpy.float32)
        for shape in ((batch * 49, PAPER.width), (PAPER.width, PAPER.feed_forward))
    )
    both_ways = jax.jit(lambda x: (x @ W) @ W.T)
    products = [
        taken * batch / (4 * x.size * PAPER.feed_forward) for taken in timed(lambda: both_ways(x))
    ]  # seconds a floating point operation
    flop = forward_flop()
    return {
        "forward_gflop": flop / 1e9,
        "step_by_products_wall": step[0] / (3 * flop * products[0]),
        "step_by_products_cpu": step[1] / (3 * flop * products[1]),
        "share_of_products": 3 * flop * products[0] / step[0],
        "forward_by_products_wall": forward_pass[0] / (flop * products[0]),
        "forward_by_products_cpu": forward_pass[1] / (flop * products[1]),
        "products_gflop_per_s_wall": 1e-9 / products[0],
        "products_gflop_per_cpu_s": 1e-9 / products[1],
        "images_per_s_wall": 1 / step[0],
        "images_per_cpu_s": 1 / step[1],
        "ms_per_image_wall": 1e3 * forward_pass[0],
        "cpu_ms_per_image": 1e3 * forward_pass[1],
    }


def forward_flop() -> float:
    """Floating point operations of one image's products: of the last layer
    only keys and values are needed of every token."""
    d, tokens = PAPER.width, 49
    layer, last = 4 * d * d + 2 * d * PAPER.feed_forward, 2 * d * d
    return 2.0 * (tokens * ((PAPER.layers - 1) * layer + last) + layer - last + 48 * 16 * d)


# bars of the bins from .. to together, in percent of windows right: the bins beside the borders have none
BY_FLOW_BARS = {(70, 150): 79, (70, 80): 87, (120, 150): 87, (80, 85): 72, (115, 120): 72, (110, 130): 77}


def stored_by_flow(seed: int = 10_000) -> dict:
    """Of the stored classifier: right and covered by flow on A_BIN new segments a bin, with windows of each
    of LENGTHS frames, and the bars. Scenes are of a seed that no stage uses."""
    model = restore_classifier(*STORED)
    bins = len(calibration.JUDGED_PERCENT) - 1
    flow = np.tile(np.repeat(calibration.JUDGED_PERCENT[:-1], 5), A_BIN // 5)
    pieces: dict[int, list] = {length: [] for length in LENGTHS}
    for i in range(0, A_BIN * bins, AT_ONCE):
        rng = np.random.default_rng([seed, i])
        some = flow[i : i + AT_ONCE]
        data, valid = filmed(rng, some + 5 * rng.random(len(some)), max(LENGTHS))
        of_frames = calibrated_classifier.outputs(model.network, data, valid)
        for length in LENGTHS:
            first = np.tile(np.arange(max(LENGTHS)) < length, len(some))
            shorter = calibration.ClassifierOutputs(*(column[first] for column in of_frames))
            windows = calibrated_classifier.window_predictions(model.calibration, shorter, length=length)
            truth = windows.truth._replace(segment=windows.truth.segment + i)
            pieces[length].append((windows.seen.prob, *truth))
    return {
        f"frames_{length}": told(model.calibration.level, *map(np.concatenate, zip(*rows, strict=True)))
        for length, rows in pieces.items()
    }


def told(level: float, prob: np.ndarray, *truth: np.ndarray) -> dict:
    """Right and covered by flow, over all, and of the bins that have a bar."""
    of = calibration.WindowTruth(*truth)
    right = prob.argmax(axis=1) == of.label
    held = calibration.holds_true_class(prob, of.label, level)
    bars = []
    for (low, high), bar in BY_FLOW_BARS.items():
        here = (of.flow_percent >= low) & (of.flow_percent < high)
        share = calibration.share_by_segment(right[here], of.segment[here])
        bars.append({"from": low, "to": high, **share._asdict(), "bar": bar, "met": share.percent >= bar})
    return {
        "right_70_150": calibration.uniform_share(right, of)._asdict(),
        "bars": bars,
        "by_flow": [row._asdict() for row in calibration.by_flow(right, of)],
        "coverage_by_flow": [row._asdict() for row in calibration.by_flow(held, of)],
        "held_percent": 100 * calibration.sets(prob, of.label, level).held,
    }


def by_flow() -> None:
    """Prints stored_by_flow and adds it to the results."""
    cv2.setNumThreads(1)
    figures = stored_by_flow()
    for name, one in figures.items():
        print(name, json.dumps(one["right_70_150"]), f"held {one['held_percent']:.1f} %")
        for right, covered in zip(one["by_flow"], one["coverage_by_flow"], strict=True):
            print(
                f"  {right['flow_low']:3.0f}-{right['flow_high']:3.0f} %: right {right['percent']:5.1f} "
                f"({right['low']:.1f}-{right['high']:.1f}), covered {covered['percent']:5.1f} "
                f"({covered['low']:.1f}-{covered['high']:.1f}), {right['windows']} windows"
            )
        for bar in one["bars"]:
            met = "met" if bar["met"] else "MISSED"
            print(f"  {bar['from']}-{bar['to']} %: {bar['percent']:.1f}   bar >= {bar['bar']}   {met}")
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps(results | {"by_flow": figures}, indent=1) + "\n")


def fast() -> None:
    """Prints speed and adds it to the results."""
    figures = speed()
    print(json.dumps(figures, indent=1))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps(results | {"speed": figures}, indent=1) + "\n")


def main(seeds: int, others: bool) -> None:
    cv2.setNumThreads(1)
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    kept = {name: kept[name] for name in ("by_flow", "speed") if name in kept}
    rows = []
    for seed in range(seeds):
        rows.append(row(seed, others=others))
        print(json.dumps({k: round(v, 4) for k, v in rows[-1].items()}), flush=True)
        RESULTS.write_text(json.dumps({"seeds": rows, "worst": worst(rows), **kept}, indent=1) + "\n")
    for name, figure in worst(rows).items():
        print(
            f"{name:20s} worst {figure['worst']:8.4f}   bar {BARS[name][0]} {figure['bar']}   "
            f"{'met' if figure['met'] else 'MISSED'}"
        )


if __name__ == "__main__":
    if sys.argv[1:] == ["speed"]:
        fast()
    elif sys.argv[1:] == ["--by-flow"]:
        by_flow()
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 5, "others" in sys.argv)
