"""The flow classifier with numpy alone. It computes class logits, log flow and its standard deviation from
key areas, and flow and class probabilities from windows. It reads classifier.safetensors, which lies beside
this file once exported."""

import json
import math

import numpy as np


def read_safetensors(path):
    """Returns arrays by name. The file has the length of its header, the header in JSON, then the numbers."""
    with open(path, "rb") as stream:
        data = stream.read()
    start = 8 + int.from_bytes(data[:8], "little")
    header, kinds = json.loads(data[8:start]), {"F32": "<f4", "F64": "<f8", "I64": "<i8"}
    arrays = {}
    for name, at in header.items():
        if name != "__metadata__":
            a, b = (start + offset for offset in at["data_offsets"])
            arrays[name] = np.frombuffer(data[a:b], kinds[at["dtype"]]).reshape(at["shape"])
    return arrays


def dense(w, name, x):
    return x @ w[f"{name}.W"] + w[f"{name}.b"]


def norm(w, name, x):
    z = x - x.mean(-1, keepdims=True)
    return z / np.sqrt(np.mean(z**2, -1, keepdims=True) + 1e-5) * w[f"{name}.scale"] + w[f"{name}.shift"]


def block(w, name, x, wanted, heads):
    """Returns the first `wanted` tokens after one layer: attention, then feed-forward (Dosovitskiy et al.
    2021)."""
    n, tokens, d = x.shape
    qkv = dense(w, f"{name}.queries_keys_values", norm(w, f"{name}.norm_1", x))
    q, k, v = (part.reshape(n, tokens, heads, d // heads) for part in np.split(qkv, 3, axis=2))
    score = np.einsum("nqhd,nkhd->nhqk", q[:, :wanted], k) / np.sqrt(d / heads)
    score = np.exp(score - score.max(-1, keepdims=True))
    mixed = np.einsum("nhqk,nkhd->nqhd", score / score.sum(-1, keepdims=True), v).reshape(n, wanted, d)
    x = x[:, :wanted] + dense(w, f"{name}.attended", mixed)
    z = dense(w, f"{name}.expand", norm(w, f"{name}.norm_2", x))
    z = 0.5 * z * (1 + np.tanh(np.sqrt(2 / np.pi) * (z + 0.044715 * z**3)))
    return x + dense(w, f"{name}.contract", z)


def image_features(w, x):
    """Returns the class token of the last layer for x (n, 16, 48), each scaled to mean 0 and deviation 1."""
    x = x - x.mean(axis=(1, 2), keepdims=True)
    x = x / (np.sqrt(np.mean(x**2, axis=(1, 2), keepdims=True)) + 1)
    (rows, columns), heads, n = w["patch"], int(w["heads"]), len(x)
    tiles = x.reshape(n, 16 // rows, rows, 48 // columns, columns).swapaxes(2, 3)
    tokens = dense(w, "body.patches", tiles.reshape(n, -1, rows * columns).astype(np.float32))
    first = np.broadcast_to(w["body.class_token"], (n, 1, tokens.shape[-1]))
    tokens = np.concatenate([first, tokens], axis=1) + w["body.positions"]
    layers = int(w["layers"])
    for i in range(layers):
        tokens = block(w, f"body.blocks.{i}", tokens, tokens.shape[1] if i < layers - 1 else 1, heads)
    return norm(w, "body.norm", tokens[:, 0])


def outputs(w, key_area, temperature_degC):
    """Returns logits (n, 3), log(flow / 100 %) (n,) and its standard deviation (n,). `key_area` (n, 16, 48)
    in gray levels; `temperature_degC` (n,) of the nozzle. Features are averaged over each area's four mirror
    images."""
    x, t = np.asarray(key_area, np.float32), np.asarray(temperature_degC, np.float32)[:, None]
    u = np.maximum(dense(w, "head.temperature", (t - 210) / 20), 0)
    mirrored = (x, x[:, ::-1], x[:, :, ::-1], x[:, ::-1, ::-1])
    seen = sum(np.maximum(dense(w, "head.image", image_features(w, one)), 0) for one in mirrored) / 4
    features = np.concatenate([seen, u], axis=1)
    log_flow, z = dense(w, "flow_head.flow", features).T
    return dense(w, "head.classes", features), log_flow, np.exp(-2 + 2.5 * np.tanh(z))


def window(w, log_flow, deviation, looks=None):
    """Returns flow in percent, its relative standard deviation, and the probabilities of under, good, over of
    one window of valid frames (m,). `looks` (measures,): measures around the bead, as in
    pipeline/setpoint/frames/familiar.py; without them the standard deviation is larger."""
    weight, moved, unknown = np.asarray(deviation, float) ** -2.0, 0.0, w["looks_explained"]
    if looks is not None and np.isfinite(looks).all():
        z = (np.asarray(looks, float) - w["looks_mean"]) / w["looks_deviation"]
        moved, unknown = np.clip(z, -3.0, 3.0) @ w["looks_weight"], 0.0
    shown, m = (weight * log_flow).sum() / weight.sum() - moved, len(weight)
    seen = np.interp(shown, w["flow_shown"], w["flow_knots"])
    scale = np.interp(seen, w["flow_knots"], w["flow_scale"])
    spread = np.hypot(scale * np.sqrt((1 + (m - 1) * w["flow_correlation"]) / weight.sum()), unknown)
    below, above = (0.5 * math.erfc((b - seen) / spread / -math.sqrt(2)) for b in np.log([0.9, 1.1]))
    return 100 * np.exp(seen), spread, np.array([below, above - below, 1 - above])
