"""Plant, controller and their closed loop as linear systems with named signals, made with python-control:
systems.json for any program, systems.mat for Matlab and Octave.

They describe small signals: deviations from rest, without limits, governor, supervisor and feed-forward.
"""

import io
import json
from typing import Any

import control
import numpy as np
import scipy.io

from pipeline.deploy.supervise import Exported
from pipeline.deploy.to_c import at_rest, feeds
from pipeline.temperature.plant import bandwidth_rad_s, strictly_proper

NOTE = "Deviations from rest. Limits, governor, supervisor and what is fed forward are left out."
HEADER = b"MATLAB 5.0 MAT-file, beadline".ljust(116)  # scipy's own holds the date


def systems(exported: Exported) -> dict[str, control.StateSpace]:
    """Returns the systems by name: "plant" from inputs u (m,) in percent to outputs y (p,) in °C;
    "controller" from references r and y to u; "loop" from r to y and u:

        z(t+1) = A z + B_u u + B_y y + B_r r,  xi(t+1) = xi + integral (r - y)
        u = F r - K z - D y - K_r xi,          F r holds y at r
    """
    machine, law, model = exported.machine, exported.controller.law, strictly_proper(exported.model)
    # python-control reads the part after a dot as a signal of another system
    u, y = ([one.name.replace(".", "_") for one in side] for side in (machine.inputs, machine.outputs))
    r, T = [f"{name}_reference" for name in y], machine.sample_time_s
    p, q = len(y), len(law.A)
    feed = feeds(law)
    holds = np.linalg.pinv(at_rest(exported.model)[0])
    F = -law.K_r if law.conditional else feed["feed_u"] @ holds + feed["feed_y"] + feed["feed_r"]
    share = np.diag(np.broadcast_to(np.asarray(law.integral, float), (p,)))
    A = np.block([[law.A - law.B_u @ law.K, -law.B_u @ law.K_r], [np.zeros((p, q)), np.eye(p)]])
    B = np.block([[law.B_r + law.B_u @ F, law.B_y - law.B_u @ law.D], [share, -share]])
    C, D = np.hstack([-law.K, -law.K_r]), np.hstack([F, -law.D])
    if not share.any():  # nothing integrates: xi rests, and is no state
        A, B, C = A[:q, :q], B[:q], C[:, :q]
    plant = control.ss(model.A, model.B, model.C, model.D, T, name="plant", inputs=u, outputs=y)
    controller = control.ss(A, B, C, D, T, name="controller", inputs=[*r, *y], outputs=u)
    loop = control.interconnect([plant, controller], name="loop", inputs=r, outputs=[*y, *u])
    return {"plant": plant, "controller": controller, "loop": loop}


def files(exported: Exported) -> dict[str, bytes]:
    """Returns the folder's files, name to content."""
    text = json.dumps(described(exported), indent=1, allow_nan=False) + "\n"
    return {"systems.json": text.encode(), "systems.mat": mat(exported)}


def described(exported: Exported) -> dict[str, Any]:
    """Returns the content of systems.json: matrices row by row, names, poles, and the bandwidth of the
    plant."""
    made = systems(exported)
    return {
        "sample_time_s": exported.machine.sample_time_s,
        "note": NOTE,
        "bandwidth_rad_s": bandwidth_rad_s(exported.model),
        "systems": {
            name: {key: getattr(one, key).tolist() for key in "ABCD"}
            | {"inputs": one.input_labels, "outputs": one.output_labels}
            | {"poles": [[float(pole.real), float(pole.imag)] for pole in np.sort_complex(one.poles())]}
            for name, one in made.items()
        },
    }


def mat(exported: Exported) -> bytes:
    """Returns systems.mat: a struct for each system, with names as cells."""
    contents: dict[str, Any] = {"note": NOTE, "Ts": exported.machine.sample_time_s}
    for name, one in systems(exported).items():
        names = {"inputs": one.input_labels, "outputs": one.output_labels}
        cells = {key: np.array(labels, object) for key, labels in names.items()}
        contents[name] = {key: getattr(one, key) for key in "ABCD"} | cells
    written = io.BytesIO()
    scipy.io.savemat(written, contents, oned_as="row")
    return HEADER + written.getvalue()[len(HEADER) :]
