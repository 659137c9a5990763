"""Tests on rendered pictures what Li and Pattinson (2025) say about their camera: the hard mask against the
whole crop, ADR against no ADR, and windows of several lengths (sections 2.2 and 2.4).

`./run dvc repro datasets/papers/dvc.yaml:camera` writes datasets/papers/camera.json; it takes minutes. One
small network with the paper's patches learns from 4,500 pictures, divided as in the paper: 300 of each of
three classes at five temperatures. Without the mask it gets the whole crop, 350 x 350 px, equalised and
resized to its 48 x 16 px.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from pipeline.papers import files
from pipeline.setpoint.frames import nozzle_scene
from pipeline.setpoint.frames.key_area import SHAPE
from pipeline.setpoint.vision import classifier
from pipeline.setpoint.vision.classifier import Labelled, TrainingSettings
from pipeline.setpoint.vision.vision_transformer import Classifier, Size, vision_transformer

SEED, EPOCHS = 1, 8
# segments of each class at each temperature, and pictures of each: 300 to learn from as in the paper
LEARNED, HELD_OUT, JUDGED = (20, 15), (2, 15), (6, 40)
WINDOWS = (5, 10, 20, 40)  # pictures
# by how much the tip is off its calibrated place, at most, in either direction; the first is the one shown
SHAKES_PX = (5.0, 2.5, 10.0, 20.0)
# other ways to take ADR, which the paper does not print: its crop along the bead only, and longer learning
LONGER = 3 * EPOCHS
NETWORK = Size((4, 4), 64, 2, 4, 128, 64, 16)
TRAINING = TrainingSettings(EPOCHS, 1.0, 64, 0.002, 0.01, 0.0, 0.99, EPOCHS)


class Filmed(NamedTuple):
    """n pictures in which a line is found: the key areas and the whole crops (n, 16, 48) uint8; the key areas
    for a shaken tip (n, shakes, 16, 48); then temperature, class, flow and segment as in Labelled."""

    key_area: np.ndarray
    whole: np.ndarray
    shaken: np.ndarray
    truth: tuple[np.ndarray, ...]

    def seen(self, name: str) -> Labelled:
        return Labelled(getattr(self, name), *self.truth)

    def shaken_by(self, k: int) -> Labelled:
        return Labelled(self.shaken[:, k], *self.truth)


def film(rng: np.random.Generator, segments: int, frames: int, first: int) -> Filmed:
    """Renders `frames` pictures of each segment, with `segments` segments of each class at each temperature,
    numbered from `first`."""
    pieces: list[tuple[np.ndarray, ...]] = []
    for kind in range(len(classifier.CLASS_NAMES)):
        for degrees in nozzle_scene.TEMPERATURES:
            for percent in nozzle_scene.draw_class_flow(rng, kind, segments):
                segment, flow = nozzle_scene.draw_segment(rng), np.full(frames, percent)
                scene = nozzle_scene.render(segment, flow, degrees, rng)  # ty: ignore[invalid-argument-type]
                way = rng.uniform(-1.0, 1.0, 2)
                clear, *shaken = (
                    nozzle_scene.key_areas(scene._replace(tip=(x, y)), least_score=0.0)
                    for x, y in (np.add(scene.tip, px * way) for px in (0.0, *SHAKES_PX))
                )
                truth = (
                    scene.temperature,
                    nozzle_scene.label(flow),
                    flow,
                    np.full(frames, first + len(pieces)),
                )
                usable = clear.valid & np.all([one.valid for one in shaken], axis=0)
                areas = np.stack([one.images for one in shaken], axis=1)
                columns = clear.images, whole_crops(scene.frames), areas, *truth
                pieces.append(tuple(column[usable] for column in columns))
    columns = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    return Filmed(*columns[:3], tuple(columns[3:]))


def whole_crops(frames: np.ndarray) -> np.ndarray:
    """Returns frames (n, 350, 350), equalised, resized to the pixels of a key area (n, 16, 48)."""
    size = SHAPE[::-1]
    return np.array([cv2.resize(cv2.equalizeHist(a), size, interpolation=cv2.INTER_AREA) for a in frames])


def learned(parts: Sequence[Filmed], name: str, augment: Callable, epochs: int = EPOCHS) -> Classifier:
    """Returns the network trained on the pictures `name` of the first part, with this augmentation. Its epoch
    is chosen by the second part."""
    network = vision_transformer(NETWORK, np.random.default_rng(SEED))
    state = classifier.untrained(network, epochs=epochs)
    seen, settings = (
        [part.seen(name) for part in parts[:2]],
        TRAINING._replace(cycle_epochs=epochs, patience=epochs),
    )
    return classifier.train(state, *seen, settings, key=jax.random.key(SEED), augment=augment).best


def unchanged(key: jax.Array, x: jax.Array) -> jax.Array:
    """Returns the pictures as they are: no ADR."""
    return x


def robustness(parts: Sequence[Filmed], networks: Mapping[str, Classifier]) -> dict[str, Any]:
    """Compares ADR with no ADR in the ways that the paper leaves open: crop of both sides or along the bead,
    8 or 24 epochs, and how far the nozzle shakes. Returns a row per way with the percentage of shaken
    pictures that are right, and twice the standard error of ADR's gain, over segments. Also returns the
    number of ways in which ADR gains more than that error, and the way with the largest gain. `networks` are
    those of 8 epochs without ADR, "mask", and with it, "mask_adr"."""
    judged, rows = parts[2], []
    ways = {"both sides": classifier.adr, "along the bead": classifier.along_bead}
    known = {(EPOCHS, "none"): networks["mask"], (EPOCHS, "both sides"): networks["mask_adr"]}
    for epochs, (crop, augment) in itertools.product((EPOCHS, LONGER), ways.items()):
        for name, way in (("none", unchanged), (crop, augment)):
            if (epochs, name) not in known:
                known[epochs, name] = learned(parts, "key_area", way, epochs)
        for k, px in enumerate(SHAKES_PX):
            seen = judged.shaken_by(k)
            none, adr = (named(known[epochs, name], seen) == seen.label for name in ("none", crop))
            gain = pd.Series(100.0 * adr - 100.0 * none).groupby(seen.segment).mean()
            rows.append(
                {
                    "epochs": epochs,
                    "shaken_px": px,
                    "crop": crop,
                    "none": 100.0 * float(none.mean()),
                    "adr": 100.0 * float(adr.mean()),
                    "gains": 100.0 * float(adr.mean() - none.mean()),
                    "error": 2.0 * float(gain.std() / np.sqrt(len(gain))),
                }
            )
    helping = [row for row in rows if row["gains"] > row["error"]]
    best = max(rows, key=lambda row: row["gains"])
    return {"rows": rows, "ways": len(rows), "helping": len(helping), "helps": bool(helping), "best": best}


def named(network: Classifier, seen: Labelled) -> np.ndarray:
    """Returns the predicted class (n,) of each picture."""
    ask = jax.jit(lambda images, degrees: jnp.argmax(network(images, degrees), axis=1))
    parts = np.array_split(np.arange(len(seen.label)), max(len(seen.label) // 500, 1))
    return np.concatenate([np.asarray(ask(*(a[rows] for a in seen[:2]))) for rows in parts])


def right(network: Classifier, seen: Labelled) -> float:
    """Returns the percentage of the pictures that are classified correctly."""
    return 100.0 * float(np.mean(named(network, seen) == seen.label))


def right_windows(names: np.ndarray, seen: Labelled, length: int) -> float:
    """Returns the percentage of correct windows. A window is `length` successive pictures of one segment; it
    is correct if the most frequent class, the largest of (4), is the true one."""
    hits = []
    for segment in np.unique(seen.segment):
        rows = np.flatnonzero(seen.segment == segment)
        for some in rows[: len(rows) // length * length].reshape(-1, length):
            hits.append(np.bincount(names[some], minlength=3).argmax() == seen.label[some[0]])
    return 100.0 * float(np.mean(hits))


def main() -> None:
    rng, first = np.random.default_rng(SEED), 0
    parts = []
    for segments, frames in (LEARNED, HELD_OUT, JUDGED):
        parts.append(film(rng, segments, frames, first))
        first += len(classifier.CLASS_NAMES) * len(nozzle_scene.TEMPERATURES) * segments
    judged = parts[2]
    networks = {
        "mask_adr": learned(parts, "key_area", classifier.adr),
        "mask": learned(parts, "key_area", unchanged),
        "whole_adr": learned(parts, "whole", classifier.adr),
    }
    percent: dict[str, Any] = {
        name: right(network, judged.seen("whole" if name.startswith("whole") else "key_area"))
        for name, network in networks.items()
    }
    percent |= {f"{name}_shaken": right(networks[name], judged.shaken_by(0)) for name in ("mask_adr", "mask")}
    seen = judged.seen("key_area")
    names = named(networks["mask_adr"], seen)
    files.write(
        "camera",
        percent
        | {
            "pictures": [len(part.whole) for part in parts],
            "mask_helps": percent["mask_adr"] > percent["whole_adr"],
            "adr_helps": percent["mask_adr_shaken"] > percent["mask_shaken"],
            "shaken_px": SHAKES_PX[0],
            "robustness": robustness(parts, networks),
            "lengths": list(WINDOWS),
            "windows": [right_windows(names, seen, length) for length in WINDOWS],
        },
    )


if __name__ == "__main__":
    main()
