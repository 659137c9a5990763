"""The networks for key areas: the paper's vision transformer and head (Li and Pattinson 2025, figure 5a), and
a small one.

They work on whole batches: every layer is one matrix product over (images x tokens). Weights are float32 and
are exported as named arrays.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

ROWS, COLUMNS = 16, 48  # of a key area: rows across the bead, columns along it from the tip outward
CLASSES = 3  # flow below 90 %, 90 to 110 %, above
CENTRE_DEGC, SPREAD_DEGC = (
    210.0,
    20.0,
)  # a nozzle temperature enters as (T - 210) / 20: the paper's five lie in -1 .. 1


class Size(NamedTuple):
    """`patch`: (rows, columns) in px; `width`: of tokens; `layers`; `heads`; `feed_forward`: its width;
    `image_features` and `temperature_features`: concatenated by the head."""

    patch: tuple[int, int]
    width: int
    layers: int
    heads: int
    feed_forward: int
    image_features: int
    temperature_features: int


PAPER = Size((4, 4), 256, 3, 8, 2048, 128, 16)  # 3,962,880 + 33,363 parameters
SMALL = Size(
    (16, 4), 64, 2, 4, 128, 64, 16
)  # 72,128 + 4,435: each token is the whole profile of 4 px of the line, and a fifth of the work


class Dense(eqx.Module):
    """x W + b over the last axis of x (..., inputs)."""

    W: Float[Array, "inputs outputs"]
    b: Float[Array, " outputs"]

    def __init__(self, inputs: int, outputs: int, rng: np.random.Generator):
        """Glorot and Bengio 2010: uniform within sqrt(6 / (inputs + outputs))."""
        limit = np.sqrt(6.0 / (inputs + outputs))
        self.W, self.b = _float32(rng.uniform(-limit, limit, (inputs, outputs))), _float32(np.zeros(outputs))

    def __call__(self, x: Float[Array, "*n inputs"]) -> Float[Array, "*n outputs"]:
        return x @ self.W + self.b


@jax.custom_jvp
def inverse_root(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns 1 / sqrt(x), with both operations rounded as IEEE 754 requires. XLA would merge them into an
    rsqrt; its first instruction gives different results on CPUs of two makers. The barrier prevents this."""
    return 1.0 / jax.lax.optimization_barrier(jnp.sqrt(x))


@inverse_root.defjvp
def _inverse_root_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    y = inverse_root(*primals)
    return y, -0.5 * y * y * y * tangents[0]


class Norm(eqx.Module):
    """Layer normalisation over the last axis (Ba, Kiros and Hinton 2016)."""

    scale: Float[Array, " width"]
    shift: Float[Array, " width"]

    def __init__(self, width: int):
        self.scale, self.shift = _float32(np.ones(width)), _float32(np.zeros(width))

    def __call__(self, x: Float[Array, "*n width"]) -> Float[Array, "*n width"]:
        centred = x - x.mean(-1, keepdims=True)
        return (
            centred * inverse_root(jnp.mean(centred**2, -1, keepdims=True) + 1e-5) * self.scale + self.shift
        )


class Block(eqx.Module):
    """x + attention(norm x), then x + feed-forward(norm x): the pre-norm layer of Dosovitskiy et al. 2021."""

    norm_1: Norm
    queries_keys_values: Dense
    attended: Dense
    norm_2: Norm
    expand: Dense
    contract: Dense
    heads: int = eqx.field(static=True)

    def __init__(self, size: Size, rng: np.random.Generator):
        d = size.width
        self.norm_1, self.norm_2, self.heads = Norm(d), Norm(d), size.heads
        self.queries_keys_values, self.attended = Dense(d, 3 * d, rng), Dense(d, d, rng)
        self.expand, self.contract = Dense(d, size.feed_forward, rng), Dense(size.feed_forward, d, rng)

    def __call__(self, x: Float[Array, "n tokens width"], wanted: int) -> Float[Array, "n wanted width"]:
        """Returns the first `wanted` tokens after the layer. Of the last layer only the class token is read,
        so the others are not computed."""
        n, tokens, d = x.shape
        normed, W, b = self.norm_1(x), self.queries_keys_values.W, self.queries_keys_values.b
        q = (normed[:, :wanted] @ W[:, :d] + b[:d]).reshape(n, wanted, self.heads, d // self.heads)
        kv = (normed @ W[:, d:] + b[d:]).reshape(n, tokens, 2, self.heads, d // self.heads)
        k, v = kv[:, :, 0], kv[:, :, 1]
        weight = jax.nn.softmax(jnp.einsum("nqhd,nkhd->nhqk", q, k) / np.sqrt(d / self.heads), axis=-1)
        x = x[:, :wanted] + self.attended(jnp.einsum("nhqk,nkhd->nqhd", weight, v).reshape(n, wanted, d))
        return x + self.contract(jax.nn.gelu(self.expand(self.norm_2(x))))


class VisionTransformer(eqx.Module):
    """Maps key areas to the class token after the last layer and the final norm (n, width)."""

    patches: Dense
    class_token: Float[Array, " width"]
    positions: Float[Array, "tokens width"]
    blocks: list[Block]
    norm: Norm
    patch: tuple[int, int] = eqx.field(static=True)

    def __init__(self, size: Size, rng: np.random.Generator):
        if ROWS % size.patch[0] or COLUMNS % size.patch[1]:
            raise ValueError(
                f"a patch of {size.patch[0]} x {size.patch[1]} px does not tile the key area of {ROWS} x "
                f"{COLUMNS}; choose divisors of both"
            )
        pixels = size.patch[0] * size.patch[1]
        self.patches = Dense(pixels, size.width, rng)
        self.class_token = _float32(0.02 * rng.standard_normal(size.width))
        self.positions = _float32(0.02 * rng.standard_normal((ROWS * COLUMNS // pixels + 1, size.width)))
        self.blocks = [Block(size, rng) for _ in range(size.layers)]
        self.norm, self.patch = Norm(size.width), size.patch

    def __call__(self, x: Float[Array, "n 16 48"]) -> Float[Array, "n width"]:
        (rows, columns), n = self.patch, len(x)
        tiles = (
            x.reshape(n, ROWS // rows, rows, COLUMNS // columns, columns)
            .swapaxes(2, 3)
            .reshape(n, -1, rows * columns)
        )
        tokens = self.patches(tiles)
        tokens = (
            jnp.concatenate([jnp.broadcast_to(self.class_token, (n, 1, tokens.shape[-1])), tokens], axis=1)
            + self.positions
        )
        for block in self.blocks[:-1]:
            tokens = block(tokens, tokens.shape[1])
        return self.norm(self.blocks[-1](tokens, 1)[:, 0])


class ClassifierHead(eqx.Module):
    """The relu of an image layer and of a temperature layer, concatenated, then one layer to the classes:
    33,363 parameters at the paper's size."""

    image: Dense
    temperature: Dense
    classes: Dense

    def __init__(self, width: int, image_features: int, temperature_features: int, rng: np.random.Generator):
        self.image, self.temperature = Dense(width, image_features, rng), Dense(1, temperature_features, rng)
        self.classes = Dense(image_features + temperature_features, CLASSES, rng)


# log deviation of a frame's log flow: LOG_DEVIATION[0] +- LOG_DEVIATION[1], 1.1 % to 160 % of the flow
LOG_DEVIATION = (-2.0, 2.5)


class FlowHead(eqx.Module):
    """Maps features to log(flow / 100 %) and the log of its standard deviation with one layer. This head is
    ours; the paper's head gives classes only."""

    flow: Dense

    def __init__(self, features: int, rng: np.random.Generator):
        self.flow = Dense(features, 2, rng)

    def __call__(self, features: Float[Array, "n features"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        mean, z = self.flow(features).T
        return mean, LOG_DEVIATION[0] + LOG_DEVIATION[1] * jnp.tanh(z)


class Classifier(eqx.Module):
    """Maps key area and nozzle temperature to logits of the three flow classes, and from the same features to
    log flow with the log of its standard deviation."""

    body: VisionTransformer
    head: ClassifierHead
    flow_head: FlowHead

    def features(self, key_area: Array, temperature_degC: Array) -> Float[Array, "n features"]:
        """Returns the input of the last layer: image features, then temperature features. Each key area is
        scaled to mean 0 and deviation 1, so that lighting does not matter."""
        x = key_area.astype(jnp.float32)
        x = x - x.mean(axis=(1, 2), keepdims=True)
        x = x / (
            jnp.sqrt(jnp.mean(x**2, axis=(1, 2), keepdims=True)) + 1.0
        )  # + 1 gray level: a flat area stays flat
        u = (temperature_degC.astype(jnp.float32)[:, None] - CENTRE_DEGC) / SPREAD_DEGC
        return jnp.concatenate(
            [jax.nn.relu(self.head.image(self.body(x))), jax.nn.relu(self.head.temperature(u))], axis=-1
        )

    def __call__(self, key_area: Array, temperature_degC: Array) -> Float[Array, "n 3"]:
        return self.head.classes(self.features(key_area, temperature_degC))

    def outputs(self, key_area: Array, temperature_degC: Array) -> tuple[Array, Array, Array]:
        """Returns logits (n, 3), log(flow / 100 %) (n,) and the log of its standard deviation (n,)."""
        features = self.features(key_area, temperature_degC)
        return self.head.classes(features), *self.flow_head(features)


def vision_transformer(size: Size, rng: np.random.Generator) -> Classifier:
    """Returns a classifier with random weights. `size`: PAPER, SMALL, or another one."""
    return Classifier(
        VisionTransformer(size, rng),
        ClassifierHead(size.width, size.image_features, size.temperature_features, rng),
        FlowHead(size.image_features + size.temperature_features, rng),
    )


def parameters(tree) -> int:
    """Returns the number of trained parameters."""
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)))


def named_arrays(tree) -> dict[str, np.ndarray]:
    """Returns every array of a network or of a training state by its path, e.g. "body.blocks.0.expand.W";
    numbers are arrays of shape ()."""
    paths = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array_like))[0]
    return {_name(path): np.asarray(leaf) for path, leaf in paths}


def from_named_arrays(like, arrays: dict[str, np.ndarray]):
    """Returns `like` with its arrays replaced by those of the same names. Raises ValueError if names or
    shapes belong to another architecture."""
    paths, structure = jax.tree_util.tree_flatten_with_path(like)
    names = {_name(path): np.shape(leaf) for path, leaf in paths if eqx.is_array_like(leaf)}
    for name in sorted(names.keys() | arrays.keys()):
        expected, actual = names.get(name), np.shape(arrays[name]) if name in arrays else None
        if expected != actual:
            raise ValueError(
                f"weights of another architecture: {name} is expected {_shape(expected)} but "
                f"found {_shape(actual)}; "
                "load them into the size that they were trained with, or train again"
            )
    leaves = [
        jnp.asarray(arrays[_name(path)], jnp.asarray(leaf).dtype) if eqx.is_array_like(leaf) else leaf
        for path, leaf in paths
    ]
    return jax.tree_util.tree_unflatten(structure, leaves)


def _float32(x: np.ndarray) -> Array:
    return jnp.asarray(x, jnp.float32)


def _name(path) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _shape(shape: tuple | None) -> str:
    return "absent" if shape is None else f"of shape {shape}"
