"""Classifies the flow from key areas: split by segment, augmentation, training with checkpoints (Li and
Pattinson 2025, sections 2.2 and 3.2), prediction."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from pipeline.setpoint.vision.vision_transformer import CLASSES, COLUMNS, ROWS, Classifier

CLASS_NAMES = ("under (flow < 90 %)", "good (90 to 110 %)", "over (flow > 110 %)")


class Labelled(NamedTuple):
    """Key areas (n, 16, 48) uint8, each with its nozzle temperature in °C (n,), class 0, 1 or 2 (n,), flow in
    percent of nominal (n,), and the segment or print in which it was filmed (n,)."""

    key_area: np.ndarray
    temperature_degC: np.ndarray
    label: np.ndarray
    flow_percent: np.ndarray
    segment: np.ndarray

    def take(self, rows: np.ndarray) -> "Labelled":
        return Labelled(*(np.asarray(a)[rows] for a in self))


def checked(data: Labelled) -> Labelled:
    """Returns `data` as arrays. Raises ValueError if shapes, pixel depth, labels, flows or temperatures are
    unusable for training, or if a class is empty."""
    data = Labelled(*(np.asarray(a) for a in data))
    n = len(data.label)
    if data.key_area.shape != (n, ROWS, COLUMNS) or data.key_area.dtype != np.uint8:
        raise ValueError(
            f"key areas are expected as uint8 ({n}, {ROWS}, {COLUMNS}) but found {data.key_area.dtype} "
            f"{data.key_area.shape}; cut them with key_area"
        )
    for name in ("temperature_degC", "flow_percent", "segment"):
        if getattr(data, name).shape != (n,):
            raise ValueError(
                f"{name} is expected once a key area, ({n},), but found {getattr(data, name).shape}"
            )
    if not np.isfinite(data.temperature_degC).all():
        raise ValueError(
            f"{np.sum(~np.isfinite(data.temperature_degC))} of {n} temperatures are no numbers; "
            "drop those frames or fill in the measured temperature"
        )
    no_flow = ~(np.isfinite(data.flow_percent) & (data.flow_percent > 0))
    if no_flow.any():
        raise ValueError(
            f"flows are expected above 0 % but {no_flow.sum()} of {n} are not, the first "
            f"{data.flow_percent[no_flow][0]:g}; write flow_rate in percent of nominal, or drop those frames"
        )
    outside = ~np.isin(data.label, range(CLASSES))
    if outside.any():
        raise ValueError(
            f"labels are expected to be 0, 1 or 2 but {outside.sum()} of {n} are not, "
            f"the first {data.label[outside][0]}; label by flow_rate"
        )
    for c in range(CLASSES):
        if not np.any(data.label == c):
            raise ValueError(
                f"class {c}, {CLASS_NAMES[c]}, has no key area among {n}; add prints at such flow rates"
            )
    return data


def split_by_segment(
    data: Labelled, *, shares: tuple[float, ...], rng: np.random.Generator
) -> list[np.ndarray]:
    """Returns the rows of each part. No segment is in two parts, and every class is near its share: segments
    come in random order, and each goes to the part that lacks its classes most.

    Images of one segment look alike, so a split by image would test memory. A print with several classes
    counts for each of them (the idea is iterative stratification; Sechidis, Tsoumakas and Vlahavas 2011).
    Raises ValueError if there are too few segments.
    """
    data = checked(data)
    names, index = np.unique(data.segment, return_inverse=True)
    if len(names) < 2:
        raise ValueError(
            f"all {len(index)} key areas come from one print, which allows no honest split; "
            f"film at least {len(shares)} prints with every class in them"
        )
    counts = np.zeros((len(names), CLASSES))
    np.add.at(counts, (index, data.label), 1)
    wanted = np.outer(shares, counts.sum(axis=0)) / np.sum(shares)
    part, missing = np.zeros(len(names), int), wanted.copy()
    for s in rng.permutation(len(names)):
        part[s] = np.argmax((missing / wanted) @ (counts[s] > 0))
        missing[part[s]] -= counts[s]
    rows = [np.flatnonzero(part[index] == i) for i in range(len(shares))]
    for i, chosen in enumerate(rows):
        for c in range(CLASSES):
            if not np.any(data.label[chosen] == c):
                raise ValueError(
                    f"{len(names)} segments do not let each of {len(shares)} parts hold every class: "
                    f"part {i + 1} has none of class {c}, {CLASS_NAMES[c]}; film more prints"
                )
    return rows


# ---- augmentation: functions (key, x (n, 16, 48)) -> x of the same
# shape, each operation with probability 1/2


def _resample(x: Array, start: Array, keep: Array) -> Array:
    """Reads the last axis (index k) at start + keep k by linear interpolation. `start` (n,) in px; `keep`
    (n,) as a fraction of 1."""
    k = jnp.arange(x.shape[-1])
    at = start[:, None] + keep[:, None] * (k + 0.5) - 0.5
    return jnp.einsum("nrk,nkj->nrj", x, jax.nn.relu(1 - jnp.abs(at[:, None, :] - k[:, None])))


def _crop(key: Array, x: Array) -> Array:
    """Cuts 10 to 30 % off the last axis, divided at random between both ends, and stretches the rest to the
    old length."""
    do, share, where = jax.random.split(key, 3)
    cut = jax.random.bernoulli(do, 0.5, (len(x),)) * jax.random.uniform(
        share, (len(x),), minval=0.1, maxval=0.3
    )
    return _resample(x, cut * x.shape[-1] * jax.random.uniform(where, (len(x),)), 1 - cut)


def _flip(key: Array, x: Array, axis: int) -> Array:
    return jnp.where(jax.random.bernoulli(key, 0.5, (len(x), 1, 1)), jnp.flip(x, axis), x)


def _light(key: Array, x: Array) -> Array:
    """Changes brightness and contrast by up to +-10 %."""
    do, size = jax.random.split(key)
    change = jax.random.bernoulli(do, 0.5, (2, len(x), 1, 1)) * jax.random.uniform(
        size, (2, len(x), 1, 1), minval=-0.1, maxval=0.1
    )
    mean = x.mean(axis=(1, 2), keepdims=True)
    return jnp.clip((x - mean) * (1 + change[0]) + mean * (1 + change[1]), 0, 255)


def adr(key: Array, x: Float[Array, "n 16 48"]) -> Float[Array, "n 16 48"]:
    """The published augmentation: crop 10-30 % in both directions, flip, brightness and contrast (Li and
    Pattinson 2025, section 2.2.1). Its crop widens the bead, although the label depends on the width."""
    across, along, flip, light = jax.random.split(key, 4)
    x = _crop(across, x.swapaxes(1, 2)).swapaxes(1, 2)
    return _light(light, _flip(flip, _crop(along, x), 2))


def along_bead(key: Array, x: Float[Array, "n 16 48"]) -> Float[Array, "n 16 48"]:
    """The augmentation that keeps the bead's width: it crops along the bead only, and may also swap the two
    sides of the bead."""
    along, flip, mirror, light = jax.random.split(key, 4)
    return _light(light, _flip(mirror, _flip(flip, _crop(along, x), 2), 1))


# ---- training


AT_ONCE = 512  # images processed together, so that a network of the paper's size needs less than 1 GB
AT_ONCE_ON_CPU = 16  # images predicted together: they fit a CPU's caches, and little is padded
ADAM = optax.scale_by_adam()  # Kingma and Ba 2015, its own beta 0.9 and 0.999


class TrainState(NamedTuple):
    """Everything needed to continue training: epochs done; network; running average of its weights; optimiser
    state; best average so far and its epoch; learning curve `history` (epochs, 3) with training loss,
    held-out loss and held-out accuracy of each epoch done, NaN after that."""

    epoch: Array
    network: Classifier
    average: Classifier
    opt_state: optax.OptState
    best: Classifier
    best_epoch: Array
    history: Array


def untrained(network: Classifier, *, epochs: int) -> TrainState:
    """Returns the state before the first of at most `epochs` epochs. from_named_arrays loads a checkpoint
    into it."""
    return TrainState(
        jnp.array(0),
        network,
        network,
        ADAM.init(network),
        network,
        jnp.array(0),
        jnp.full((epochs, 3), jnp.nan),
    )


class TrainingSettings(NamedTuple):
    """Settings of the training by AdamW. The learning rate rises over `warmup_epochs` to `learning_rate` and
    then falls by a cosine with half period `cycle_epochs`. `averaging`: decay per step of the running average
    of the weights, which is tested and kept (0: the weights themselves). Training ends after `patience`
    epochs without a better held-out loss."""

    cycle_epochs: int
    warmup_epochs: float
    batch: int
    learning_rate: float
    weight_decay: float
    smoothing: float
    averaging: float
    patience: int


class Rates(NamedTuple):
    """`highest`: largest learning rate; `rise`: steps of its linear rise; `cycle`: steps of half its cosine;
    `weight_decay`; `smoothing` of labels; `averaging`: decay per step of the weights' running average."""

    highest: float
    rise: float
    cycle: float
    weight_decay: float
    smoothing: float
    averaging: float


def cosine(step: Array, rates: Rates) -> Array:
    """Returns the learning rate of a step: cosine annealing highest (1 + cos(pi t / cycle)) / 2 (Loshchilov
    and Hutter 2017; the paper's cycle is 100 epochs from 1e-4), times a linear rise over the first `rise`
    steps."""
    return (
        rates.highest
        * jnp.minimum(1.0, (step + 1) / jnp.maximum(rates.rise, 1))
        * (1 + jnp.cos(jnp.pi * step / rates.cycle))
        / 2
    )


def cross_entropy(logits: Float[Array, "n 3"], label: Array, smoothing: float) -> Array:
    """Returns the mean of -sum_c t_c log p_c with targets t = (1 - smoothing) one-hot + smoothing / 3."""
    target = (1 - smoothing) * jax.nn.one_hot(label, CLASSES) + smoothing / CLASSES
    return -jnp.mean(jnp.sum(target * jax.nn.log_softmax(logits), axis=1))


def flow_loss(log_flow: Array, log_deviation: Array, flow_percent: Array) -> Array:
    """Returns the mean of log s + ((y - mu) / s)^2 / 2 with y = log(flow / 100 %): the negative log
    likelihood of Normal(mu, s) without its constant (Nix and Weigend 1994)."""
    error = jnp.log(flow_percent / 100) - log_flow
    return jnp.mean(log_deviation + 0.5 * (error * jnp.exp(-log_deviation)) ** 2)


def total_loss(
    outputs: tuple[Array, Array, Array], label: Array, flow_percent: Array, smoothing: float
) -> Array:
    """Returns the cross entropy of the classes plus flow_loss: the negative log likelihood of both."""
    logits, *flow = outputs
    return cross_entropy(logits, label, smoothing) + flow_loss(*flow, flow_percent)


def train(
    state: TrainState,
    learned: Labelled,
    held_out: Labelled,
    settings: TrainingSettings,
    *,
    key: Array,
    augment: Callable[[Array, Array], Array],
    on_step: Callable[[TrainState], None] = lambda state: None,
) -> TrainState:
    """Trains on `learned` until the loss on `held_out` has not improved for settings.patience epochs. `best`
    of the returned state is the classifier.

    Calls on_step(state) after each epoch; a checkpoint is such a state. All randomness comes from (key,
    epoch), so training continued from any of these states ends with identical weights. Raises ValueError for
    data that `checked` refuses, for a segment in both sets, or if no held-out loss is a number.
    """
    learned, held_out = checked(learned), checked(held_out)
    _check_apart(learned, held_out)
    batch, epochs = min(settings.batch, len(learned.label)), len(state.history)
    steps = len(learned.label) // batch
    rates = Rates(
        settings.learning_rate,
        settings.warmup_epochs * steps,
        settings.cycle_epochs * steps,
        settings.weight_decay,
        settings.smoothing,
        settings.averaging,
    )
    rows, judged = [[_on_device(a) for a in data[:4]] for data in (learned, held_out)]
    run = _steps_on_cpu if jax.default_backend() == "cpu" else _steps
    while int(state.epoch) < epochs and int(state.epoch) - int(state.best_epoch) <= settings.patience:
        order, drawn = jax.random.split(jax.random.fold_in(key, state.epoch))
        chosen = jax.random.permutation(order, len(learned.label))[: steps * batch].reshape(steps, batch)
        (network, average, opt_state), loss = run(
            augment,
            (state.network, state.average, state.opt_state),
            (jax.random.split(drawn, steps), chosen),
            rows,
            rates,
        )
        state = state._replace(network=network, average=average, opt_state=opt_state)
        outputs = [
            _outputs(average, *(a[i : i + AT_ONCE] for a in judged[:2]))
            for i in range(0, len(judged[2]), AT_ONCE)
        ]
        whole = tuple(jnp.concatenate(one) for one in zip(*outputs, strict=True))
        state = _judged(state, loss, whole, judged[2:])
        on_step(state)
    if int(state.best_epoch) == 0:
        raise ValueError(
            f"no epoch of {int(state.epoch)} had a held-out loss that is a number; "
            f"lower the learning rate of {settings.learning_rate:g}"
        )
    return state


def _on_device(values: np.ndarray) -> Array:
    return jnp.asarray(values, jnp.float32 if values.dtype.kind == "f" else None)


def _check_apart(learned: Labelled, held_out: Labelled) -> None:
    """Raises ValueError if a segment is in both sets."""
    shared = np.intersect1d(learned.segment, held_out.segment)
    if len(shared):
        raise ValueError(
            f"{len(shared)} segments are both learned and held out, the first {shared[0]}; "
            "split with split_by_segment"
        )


@functools.partial(jax.jit, static_argnums=0)
def _step(augment, carry, drawn: tuple[Array, Array], rows: list[Array], rates: Rates):
    """Trains on one batch, `drawn` = (key, rows), with AdamW (Loshchilov and Hutter 2019),

        theta <- theta - rate (Adam's direction + decay theta)

    and updates the running average of theta.
    """
    (network, average, opt_state), (key, chosen) = carry, drawn
    key_area, temperature, label, flow = [a[chosen] for a in rows]
    augmented = augment(key, key_area.astype(jnp.float32))
    loss, gradient = jax.value_and_grad(
        lambda net: total_loss(net.outputs(augmented, temperature), label, flow, rates.smoothing)
    )(network)
    t = opt_state.count
    direction, opt_state = ADAM.update(gradient, opt_state)
    rate = cosine(t, rates)
    network = jax.tree.map(lambda w, d: w - rate * (d + rates.weight_decay * w), network, direction)
    keep = jnp.minimum(rates.averaging, (1 + t) / (10 + t))  # forgets the first steps sooner
    return (network, jax.tree.map(lambda a, w: keep * a + (1 - keep) * w, average, network), opt_state), loss


@functools.partial(jax.jit, static_argnums=0)
def _steps(augment, carry, drawn, rows, rates):
    """Runs a whole epoch as one program, for a device that should not wait for Python."""
    return jax.lax.scan(lambda carry, one: _step(augment, carry, one, rows, rates), carry, drawn)


def _steps_on_cpu(augment, carry, drawn, rows, rates):
    """Does the same with one call for each step. A scan would be another program and would round
    differently."""
    losses = []
    for one in zip(*drawn, strict=True):
        carry, loss = _step(augment, carry, one, rows, rates)
        losses.append(loss)
    return carry, jnp.stack(losses)


@jax.jit
def _outputs(network: Classifier, key_area: Array, temperature_degC: Array) -> tuple[Array, Array, Array]:
    return network.outputs(key_area, temperature_degC)


@jax.jit
def _judged(state: TrainState, loss: Array, outputs: tuple, truth: list[Array]) -> TrainState:
    """Returns the state after an epoch. Tests its average by its outputs on the held-out segments, whose
    class and flow are `truth`, and keeps it as `best` if its loss is the lowest so far."""
    right = jnp.argmax(outputs[0], axis=1) == truth[0]
    row = jnp.stack([loss.mean(), total_loss(outputs, *truth, 0.0), jnp.mean(right)])
    better = row[1] < jnp.min(
        jnp.nan_to_num(state.history[:, 1], nan=jnp.inf)
    )  # never if the loss is not a number
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), state.average, state.best)
    history = state.history.at[state.epoch].set(row)
    return state._replace(
        epoch=state.epoch + 1,
        best=best,
        best_epoch=jnp.where(better, state.epoch + 1, state.best_epoch),
        history=history,
    )


# ---- prediction


class ClassifierPrediction(NamedTuple):
    """Logits (n, 3); the features that enter the last layers (n, f); log(flow / 100 %) (n,) and its standard
    deviation (n,). All float32."""

    logits: np.ndarray
    features: np.ndarray
    log_flow: np.ndarray
    deviation: np.ndarray


@jax.jit
def _predict(network: Classifier, key_area: Array, temperature_degC: Array) -> tuple[Array, ...]:
    mirrored = (key_area, key_area[:, ::-1], key_area[:, :, ::-1], key_area[:, ::-1, ::-1])
    features = sum(network.features(x, temperature_degC) for x in mirrored) / len(mirrored)
    log_flow, log_deviation = network.flow_head(features)
    return network.head.classes(features), features, log_flow, jnp.exp(log_deviation)


def predict(
    network: Classifier, key_area: np.ndarray, temperature_degC: np.ndarray, *, batch: int | None = None
) -> ClassifierPrediction:
    """Returns logits, features and flow of key areas (n, 16, 48) at temperatures (n,) in °C. Features are
    averaged over each area's four mirror images, because a bead has no left, right, head or tail.

    Works in batches (on a CPU of AT_ONCE_ON_CPU) and pads the last one, so that one program serves any n.
    """
    batch = batch or (AT_ONCE_ON_CPU if jax.default_backend() == "cpu" else AT_ONCE)
    key_area, temperature_degC = (
        np.asarray(key_area),
        np.broadcast_to(np.asarray(temperature_degC, np.float32), len(key_area)),
    )
    parts = []
    for i in range(0, len(key_area), batch):
        k = min(batch, len(key_area) - i)
        x, u = np.zeros((batch, ROWS, COLUMNS), np.uint8), np.zeros(batch, np.float32)
        x[:k], u[:k] = key_area[i : i + k], temperature_degC[i : i + k]
        parts.append([np.asarray(a)[:k] for a in _predict(network, x, u)])
    if not parts:
        shapes = (0, CLASSES), (0, network.head.classes.W.shape[0]), (0,), (0,)
        return ClassifierPrediction(*(np.zeros(shape, np.float32) for shape in shapes))
    return ClassifierPrediction(*(np.concatenate(p) for p in zip(*parts, strict=True)))
