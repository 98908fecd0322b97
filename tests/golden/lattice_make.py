"""Record what TensorFlow Lattice and PyTorch Lattice compute, as `lattice_peers.npz` here.

Run in an environment of its own, not in the project's:

    python -m venv .lattice-peers
    .lattice-peers/bin/pip install tensorflow==2.21.0 tf_keras==2.21.0 tensorflow-lattice==2.1.1
    .lattice-peers/bin/pip install torch==2.13.0 pydantic pandas tqdm matplotlib
    .lattice-peers/bin/pip install --no-deps pytorch-lattice==0.2.0
    TF_USE_LEGACY_KERAS=1 .lattice-peers/bin/python tests/golden/lattice_make.py

About one minute. Weights and inputs are random with a fixed seed, rounded to float32 and stored
with the outputs; the libraries compute in float64 where they can. Keys are `<case>.<name>`;
`tfl` and `ptl` are the outputs of the two libraries.
"""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("TF_USE_LEGACY_KERAS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np
import pytorch_lattice.layers as ptl
import tensorflow as tf
import tensorflow_lattice as tfl
import torch
from pytorch_lattice.enums import Interpolation
from tensorflow_lattice.python import lattice_lib, linear_lib, pwl_calibration_layer

rng = np.random.default_rng(0)
store: dict[str, np.ndarray] = {}


def draw(*shape: int, low: float = -1.0, high: float = 1.0) -> np.ndarray:
    """Random numbers that float32 holds exactly, as float64."""
    return rng.uniform(low, high, shape).astype(np.float32).astype(np.float64)


def keep(case: str, **arrays: np.ndarray) -> None:
    """Store arrays: floats that are inputs as float32 (exact), outputs as float64."""
    for name, value in arrays.items():
        value = np.asarray(value)
        if value.dtype == np.float64 and name not in ("tfl", "ptl"):
            value = value.astype(np.float32)
        store[f"{case}.{name}"] = value


def steps(outputs: np.ndarray) -> np.ndarray:
    """Keypoint outputs `[k]` as both libraries hold them: the first value, then differences."""
    return np.concatenate([outputs[:1], np.diff(outputs)])[:, None]


def torch_parameter(values: np.ndarray) -> torch.nn.Parameter:
    """A float64 parameter."""
    return torch.nn.Parameter(torch.tensor(values, dtype=torch.double))


def pwl() -> None:
    """Fixed keypoints with a missing value; learned keypoints."""
    where = np.array([-1.0, -0.5, 0.25, 0.75, 2.0])
    outputs, missing = draw(5), draw(1)
    x = np.concatenate([draw(40, low=-2.0, high=3.0), where, [-7.0]])[:, None]
    layer = tfl.layers.PWLCalibration(
        where, impute_missing=True, missing_input_value=-7.0, dtype="float64"
    )
    layer.build((None, 1))
    layer.kernel.assign(steps(outputs))
    layer.missing_output.assign(missing.reshape(layer.missing_output.shape))
    peer = ptl.NumericalCalibrator(where, missing_input_value=-7.0)
    peer.kernel = torch_parameter(steps(outputs))
    peer.missing_output = torch_parameter(missing)
    keep(
        "pwl", where=where, outputs=outputs, missing=missing, x=x[:, 0],
        tfl=layer(tf.constant(x)).numpy()[:, 0],
        ptl=peer(torch.tensor(x)).detach().numpy()[:, 0],
    )  # fmt: skip
    logits = draw(4)
    # Learned keypoints work in float32 only in this release.
    learned = tfl.layers.PWLCalibration(
        where.astype(np.float32), input_keypoints_type="learned_interior"
    )
    learned.build((None, 1))
    learned.kernel.assign(steps(outputs))
    learned.interpolation_logits.assign(logits.reshape(learned.interpolation_logits.shape))
    keep(
        "pwl_learned", where=where, outputs=outputs, logits=logits, x=x[:-1, 0],
        tfl=learned(tf.constant(x[:-1], tf.float32)).numpy()[:, 0],
    )  # fmt: skip
    heights = tf.constant(steps(draw(9)))
    keep(
        "pwl_regularizers",
        outputs=np.cumsum(heights.numpy()[:, 0]),
        tfl=np.array(
            [
                kind(l1=l1, l2=l2)(heights).numpy()
                for kind in (
                    pwl_calibration_layer.LaplacianRegularizer,
                    pwl_calibration_layer.HessianRegularizer,
                    pwl_calibration_layer.WrinkleRegularizer,
                )
                for l1, l2 in ((0.3, 0.0), (0.0, 0.7), (0.3, 0.7))
            ]
        ),
    )


def categorical() -> None:
    """Four categories and a missing one, -1."""
    outputs, missing = draw(4), draw(1)
    x = np.array([0, 1, 2, 3, -1, 2])
    layer = tfl.layers.CategoricalCalibration(5, default_input_value=-1)  # float32 only
    layer.build((None, 1))
    kernel = np.concatenate([outputs, missing])[:, None]
    layer.kernel.assign(kernel)
    peer = ptl.CategoricalCalibrator(4, missing_input_value=-1)
    peer.kernel = torch_parameter(kernel)
    keep(
        "categorical", outputs=outputs, missing=missing, x=x,
        tfl=layer(tf.constant(x[:, None])).numpy()[:, 0],
        ptl=peer(torch.tensor(x[:, None].astype(np.float64))).detach().numpy()[:, 0],
    )  # fmt: skip


def linear() -> None:
    """Weights with a bias; the constraints of the weights (dominance without a shared input)."""
    weights, bias, x = draw(6), draw(1), draw(20, 6)
    layer = tfl.layers.Linear(6, dtype="float64")
    layer.build((None, 6))
    layer.kernel.assign(weights[:, None])
    layer.bias.assign(bias.reshape(layer.bias.shape))
    peer = ptl.Linear(6)
    peer.kernel = torch_parameter(weights[:, None])
    peer.bias = torch_parameter(bias)
    keep(
        "linear", weights=weights, bias=bias, x=x,
        tfl=layer(tf.constant(x)).numpy()[:, 0],
        ptl=peer(torch.tensor(x)).detach().numpy()[:, 0],
    )  # fmt: skip
    signs = np.array([1, -1, 0, 1, 1, 0])
    keep(
        "linear_norm", weights=weights, signs=signs,
        tfl=linear_lib.project(
            tf.constant(weights[:, None]), list(signs), normalization_order=1
        ).numpy()[:, 0],
    )  # fmt: skip


def lattice() -> None:
    """A 3 x 2 x 4 lattice, both interpolations; penalties."""
    sizes = [3, 2, 4]
    vertices = draw(*sizes)
    x = draw(60, 3, low=-0.5, high=3.5)
    x[:4] = [[0, 0, 0], [2, 1, 3], [1, 0.5, 2], [1, 1, 1]]
    names = {"hypercube": Interpolation.HYPERCUBE, "simplex": Interpolation.SIMPLEX}
    for name, kind in names.items():
        layer = tfl.layers.Lattice(sizes, interpolation=name, dtype="float64")
        layer.build((None, 3))
        layer.kernel.assign(vertices.reshape(-1, 1))
        peer = ptl.Lattice(sizes, interpolation=kind)
        peer.kernel = torch_parameter(vertices.reshape(-1, 1))
        keep(
            f"lattice_{name}", vertices=vertices, x=x,
            tfl=layer(tf.constant(x)).numpy()[:, 0],
            ptl=peer(torch.tensor(x)).detach().numpy()[:, 0],
        )  # fmt: skip
    flat = tf.constant(vertices.reshape(-1, 1))
    keep(
        "lattice_regularizers", vertices=vertices,
        tfl=np.array([
            lattice_lib.laplacian_regularizer(flat, sizes, l1=0.3, l2=0.7).numpy(),
            lattice_lib.laplacian_regularizer(flat, sizes, l1=[0.1, 0.2, 0.3]).numpy(),
            lattice_lib.torsion_regularizer(flat, sizes, l1=0.3).numpy(),
            lattice_lib.torsion_regularizer(flat, sizes, l1=0.3, l2=0.7).numpy(),
        ]),
    )  # fmt: skip


def projected(vertices: np.ndarray, **constraints: object) -> np.ndarray:
    """The lattice projection of TensorFlow Lattice, run until it has converged."""
    sizes = list(vertices.shape)
    settings: dict[str, object] = {
        "monotonicities": [0] * len(sizes), "unimodalities": [0] * len(sizes),
        "edgeworth_trusts": None, "trapezoid_trusts": None, "monotonic_dominances": None,
        "range_dominances": None, "joint_monotonicities": None, "joint_unimodalities": None,
        "num_iterations": 400, **constraints,
    }  # fmt: skip
    result = lattice_lib.project_by_dykstra(tf.constant(vertices.reshape(-1, 1)), sizes, **settings)
    return result.numpy().reshape(sizes)


def projections() -> None:
    """Euclidean projections onto monotone, unimodal and trusting lattices."""
    vertices = draw(4, 3, 3)
    keep("project_monotone", vertices=vertices,
         tfl=projected(vertices, monotonicities=[1, 0, 1]))  # fmt: skip
    vertices = draw(5, 4)
    keep("project_valley", vertices=vertices,
         tfl=projected(vertices, monotonicities=[0, 1], unimodalities=[1, 0]))  # fmt: skip
    vertices = draw(4, 3)
    keep("project_trust", vertices=vertices,
         tfl=projected(vertices, monotonicities=[1, 0], edgeworth_trusts=[(0, 1, -1)]),
         )  # fmt: skip


def deep() -> None:
    """Calibrators (4 inputs, the first falling), linear, calibrators, two 3 x 3 lattices, mean."""
    n, lattices, rank = 4, 2, 2
    x = draw(30, n, low=-0.5, high=4.5)
    inputs = np.sort(draw(n, 6), axis=1)
    inputs[0] = inputs[0, ::-1]
    inputs[1:] = draw(n - 1, 6)
    weights = draw(lattices * rank, n)
    weights[::2, 0] = np.abs(weights[::2, 0])
    weights[1::2, 0] = 0.0
    hidden = np.sort(draw(lattices * rank, 5, low=0.0, high=2.0), axis=1)
    vertices = draw(lattices, 3, 3)
    first = tfl.layers.PWLCalibration(np.linspace(0.0, 4.0, 6), units=n, dtype="float64")
    first.build((None, n))
    first.kernel.assign(np.concatenate([steps(row) for row in inputs], axis=1))
    second = tfl.layers.PWLCalibration(
        np.linspace(-1.0, 1.0, 5), units=lattices * rank, dtype="float64"
    )
    second.build((None, lattices * rank))
    second.kernel.assign(np.concatenate([steps(row) for row in hidden], axis=1))
    h = second(tf.matmul(first(tf.constant(x)), tf.constant(weights.T)))
    outputs = []
    for i in range(lattices):
        layer = tfl.layers.Lattice([3, 3], dtype="float64")
        layer.build((None, rank))
        layer.kernel.assign(vertices[i].reshape(-1, 1))
        outputs.append(layer(h[:, i * rank : (i + 1) * rank]).numpy()[:, 0])
    keep(
        "deep", x=x, inputs=inputs, weights=weights, hidden=hidden, vertices=vertices,
        tfl=np.mean(outputs, axis=0),
    )  # fmt: skip


def main() -> None:
    """Compute all cases and write the file."""
    for case in (pwl, categorical, linear, lattice, projections, deep):
        case()
    path = Path(__file__).with_name("lattice_peers.npz")
    np.savez_compressed(path, **store)
    print(f"result: file={path.name} arrays={len(store)} bytes={path.stat().st_size}")


if __name__ == "__main__":
    main()
