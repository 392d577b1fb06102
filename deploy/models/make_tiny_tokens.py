#!/usr/bin/env python3
"""Build the tiny token model that the tests use instead of a vision transformer.

    make_tiny_tokens.py tests/fixtures/models/tiny-tokens

Writes three files. `model.onnx` has the inputs and outputs of DINOv2 with registers, and seeded
random weights:

    input   pixel_values       float32 [N, 3, H, W]          H and W multiples of 14
    output  last_hidden_state  float32 [N, 1 + 2 + h·w, 8]   h = H/14, w = W/14

    patches   = a 14×14 convolution of stride 14 to 8 channels, row by row
    CLS token = cls + 0.5 · mean of the patches
    registers = two constants, 100 times as large, so that code that pools them fails the test

`manifest.toml` describes it. `expected.json` contains the expected descriptors of one image,
computed here with numpy from the same weights, without ONNX. The image has 56×42 pixels, the input
size of the model, so nothing is resized or cropped:

    r = (7x + 13y) mod 256,  g = (11x + 3y + 50) mod 256,  b = (5x + 17y + 101) mod 256

with x to the right and y down, then scaled to 0..1 and normalised with ImageNet's mean and standard
deviation. The two descriptors, both L2-normalised:

    cls   the CLS token
    gem   for each channel, m = mean of x³ over the patches, then sign(m) · |m|^(1/3)

The output is reproducible with the same versions of numpy and onnx.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SEED = 14
PATCH = 14
CHANNELS = 8
REGISTERS = 2
WIDTH, HEIGHT = 56, 42
MEAN = [0.485, 0.456, 0.406]
STD = [0.229, 0.224, 0.225]
CLS_SHARE = 0.5
OPSET = 17
IR_VERSION = 8

MANIFEST = f"""\
# Written by deploy/models/make_tiny_tokens.py.
name = "tiny-tokens"
description = "Seeded random weights in the shape of a vision transformer, for tests."
file = "model.onnx"
sha256 = "@SHA256@"
licence = "Apache-2.0"
source = "deploy/models/make_tiny_tokens.py"

[input]
name = "pixel_values"
width = {WIDTH}
height = {HEIGHT}
resize = "centre_crop"
interpolation = "bicubic"
multiple = {PATCH}
mean = {MEAN}
std = {STD}

[output]
features = "last_hidden_state"
layout = "tokens"
channels = {CHANNELS}
stride = {PATCH}
registers = {REGISTERS}
cls = true

[pooling]
gem_p = 3.0
grid = [1, 1]
dimension = {CHANNELS}
"""


@dataclass(frozen=True)
class Weights:
    """The model's parameters, all float32."""

    kernel: np.ndarray  # [CHANNELS, 3, PATCH, PATCH]
    bias: np.ndarray  # [CHANNELS]
    cls: np.ndarray  # [1, 1, CHANNELS]
    registers: np.ndarray  # [1, REGISTERS, CHANNELS]

    @classmethod
    def seeded(cls) -> Weights:
        """The weights of the fixture."""
        rng = np.random.default_rng(SEED)

        def normal(*shape: int) -> np.ndarray:
            return rng.standard_normal(shape, dtype=np.float32)

        return cls(
            kernel=normal(CHANNELS, 3, PATCH, PATCH) / np.float32(PATCH),
            bias=normal(CHANNELS),
            cls=normal(1, 1, CHANNELS),
            registers=normal(1, REGISTERS, CHANNELS) * np.float32(100),
        )


def build_model(weights: Weights) -> onnx.ModelProto:
    """Builds the model as an ONNX graph."""
    constants = {
        "kernel": weights.kernel,
        "bias": weights.bias,
        "cls": weights.cls,
        "registers": weights.registers,
        "cls_share": np.float32(CLS_SHARE),
        "one_row_per_channel": np.array([0, CHANNELS, -1]),
        "unchanged": np.array([1]),
    }
    node = helper.make_node
    nodes = [
        node(
            "Conv",
            ["pixel_values", "kernel", "bias"],
            ["map"],
            kernel_shape=[PATCH, PATCH],
            strides=[PATCH, PATCH],
        ),
        node("Reshape", ["map", "one_row_per_channel"], ["rows"]),
        node("Transpose", ["rows"], ["patches"], perm=[0, 2, 1]),
        node("ReduceMean", ["patches"], ["mean"], axes=[1], keepdims=1),
        node("Mul", ["mean", "cls_share"], ["share"]),
        node("Add", ["share", "cls"], ["cls_token"]),
        # The registers are the same for every image: repeat them along the batch.
        node("Shape", ["pixel_values"], ["batch"], start=0, end=1),
        node("Concat", ["batch", "unchanged", "unchanged"], ["repeats"], axis=0),
        node("Expand", ["registers", "repeats"], ["register_tokens"]),
        node("Concat", ["cls_token", "register_tokens", "patches"], ["last_hidden_state"], axis=1),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny-tokens",
        [
            helper.make_tensor_value_info(
                "pixel_values", TensorProto.FLOAT, ["batch", 3, "height", "width"]
            )
        ],
        [
            helper.make_tensor_value_info(
                "last_hidden_state", TensorProto.FLOAT, ["batch", "tokens", CHANNELS]
            )
        ],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(
        graph,
        producer_name="whereabouts",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def test_image() -> np.ndarray:
    """The image described at the top: bytes [HEIGHT, WIDTH, 3], RGB."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    colours = [7 * x + 13 * y, 11 * x + 3 * y + 50, 5 * x + 17 * y + 101]
    return (np.stack(colours, axis=-1) % 256).astype(np.uint8)


def expected_tokens(weights: Weights, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The CLS token [CHANNELS] and the patch tokens [h·w, CHANNELS], in float64."""
    pixels = (image / 255.0 - MEAN) / STD
    rows, columns = HEIGHT // PATCH, WIDTH // PATCH
    tiles = pixels.reshape(rows, PATCH, columns, PATCH, 3)
    patches = np.einsum("iyjxc,kcyx->ijk", tiles, weights.kernel.astype(np.float64))
    patches = patches.reshape(rows * columns, CHANNELS) + weights.bias
    return weights.cls[0, 0] + CLS_SHARE * patches.mean(axis=0), patches


def unit(vector: np.ndarray) -> list[float]:
    """Normalises a vector to unit length."""
    return [round(float(value), 9) for value in vector / np.linalg.norm(vector)]


def signed_gem(tokens: np.ndarray) -> np.ndarray:
    """Signed generalised mean (GeM) over the tokens, with p = 3."""
    return np.cbrt((tokens**3).mean(axis=0))


def main() -> None:
    """Writes the three files."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0],
        epilog="The top of this script describes the files.",
    )
    parser.add_argument("folder", type=Path, help="output folder of the three files")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)

    weights = Weights.seeded()
    model = build_model(weights).SerializeToString(deterministic=True)
    (folder / "model.onnx").write_bytes(model)
    digest = hashlib.sha256(model).hexdigest()
    (folder / "manifest.toml").write_text(MANIFEST.replace("@SHA256@", digest), encoding="utf-8")

    cls_token, patches = expected_tokens(weights, test_image())
    expected = {"cls": unit(cls_token), "gem": unit(signed_gem(patches))}
    (folder / "expected.json").write_text(json.dumps(expected, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
