#!/usr/bin/env python3
"""Build the ONNX model of DINOv2, and its manifest, from a checkpoint or from seeded weights.

    export_dinov2.py dinov2-small FOLDER --weights dinov2_vits14_pretrain.pth
    export_dinov2.py dinov2-with-registers-base FOLDER --weights model.safetensors
    export_dinov2.py dinov2-small FOLDER --random 7

DINOv2 is by Oquab et al., "DINOv2: Learning Robust Visual Features without Supervision", 2023, the
variants with registers by Darcet et al., "Vision Transformers Need Registers", 2023 (Apache-2.0).
FOLDER gets `model.onnx` and `manifest.toml`:

    input   pixel_values       float32 [N, 3, H, W]             RGB, (x − mean) / std;
                                                                H and W multiples of 14
    output  last_hidden_state  float32 [N, 1 + registers + h·w, C]   h = H/14, w = W/14
    output  descriptor         float32 [N, C]                   L2-normalised; only with --pool

Weights can have the layout of the authors (.pth) or of transformers (.safetensors, .bin). PyTorch
files need torch; everything else needs only numpy and onnx. `--random SEED` generates untrained
weights for tests: integers from PCG64, added and scaled, so that every machine and version of
numpy produces the same ones.

The graph interpolates the 37×37 position embedding to h×w. `--position original` works like the
authors' code: by the factor (h + 0.1) / 37, where the 0.1 shifts the samples slightly. `--position
hub` works by size, like transformers 5. At 518×518 neither changes it. With registers, both
work by size and with antialiasing, and the option makes no difference.

`--int8` quantizes the linear layers to 8 bits: a quarter of the file size, and about half the time
with ONNX Runtime's CPU provider on processors with VNNI. The result is a different model, and no
map mixes its descriptors with those of the original: with seeded weights of ViT-S/14 and twelve
photographs at 224×224, the cosines between the two were at least 0.998 (GeM) and 0.9995 (CLS).
Processors without VNNI saturate the sums of 8-bit products; measure before you use it there.

`--facet value --layer 31` exports what one block computes instead of the last tokens, and leaves
out the blocks after it: the queries, keys or values of its attention, or its tokens, counted from 0.
AnyLoc (Keetha et al., 2023) aggregates the values of block 31 of the giant variant with VLAD:

    [descriptors.vlad]
    method = "vlad"
    file = "vocabulary.bin"        # the centres, 16-bit floats
    centres = 32
    rows = 1
    weighting = "none"
    dimension = 49152              # centres × channels; less with a projection in the file

Not supported: half precision; checkpoints in several files; training checkpoints
(a teacher or a student, or blocks in chunks); and position embeddings of a grid other than 37×37.
The manifest cannot describe a pooled output, so the service pools `last_hidden_state` itself and
ignores the output that --pool adds. The weights of dinov2-…-giant, 4.5 GB, do not fit into one ONNX
file: they go to `model.onnx.data` next to it, which the manifest names and `whereabouts model add`
installs, too.

check_dinov2.py lists how closely the model matches PyTorch.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import pickle
import re
import sys
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 18  # the first whose Resize can antialias
IR_VERSION = 8
PATCH = 14
GRID = 37  # rows and columns of the position embedding: trained at 518×518
HEAD = 64  # dimension of an attention head, the same in all variants
EPSILON = 1e-6
OFFSET = 0.1
GEM_P = 3.0
MANIFEST_SIZE = 322  # of either edge, unless --fixed is given
PAGE = 4096
LARGEST_FILE = 2_000_000_000  # bytes; a protobuf message is limited to 2 GiB

MANIFEST = """\
# Written by deploy/models/export_dinov2.py.
name = "{name}"
description = "{description}"
file = "model.onnx"
sha256 = "{sha256}"
licence = "Apache-2.0"
source = "{source}"
{data}
[input]
name = "pixel_values"
width = {width}
height = {height}
resize = "squash"
interpolation = "bicubic"
multiple = 14
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]

[output]
features = "{features}"
layout = "tokens"
channels = {channels}
stride = 14
registers = {registers}
cls = true

[pooling]
gem_p = {gem_p}
grid = [1, 1]
dimension = {channels}
"""

# Returns a tensor by its name in this script; see `shapes`.
Weights = Callable[[str], np.ndarray]


class WeightsError(Exception):
    """The weights file has a format that this script cannot read."""


# --- The variants --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """One architecture of the family."""

    title: str
    channels: int
    depth: int
    swiglu: bool = False  # the gated MLP of the giant variant
    registers: int = 0

    @property
    def hidden(self) -> int:
        """Hidden dimension of the MLP: four times the channels, and two thirds of that if gated."""
        return 4 * self.channels * 2 // 3 if self.swiglu else 4 * self.channels


@dataclass(frozen=True)
class Facet:
    """What one block computes, to be exported instead of the last tokens."""

    name: str  # query, key, value or token
    layer: int  # from 0

    @property
    def output(self) -> str:
        """The name of the output."""
        return "facet"


PLAIN = {
    "small": Variant("ViT-S/14", 384, 12),
    "base": Variant("ViT-B/14", 768, 12),
    "large": Variant("ViT-L/14", 1024, 24),
    "giant": Variant("ViT-g/14", 1536, 40, swiglu=True),
}
VARIANTS = {f"dinov2-{size}": plain for size, plain in PLAIN.items()} | {
    f"dinov2-with-registers-{size}": Variant(
        f"{plain.title} with registers", plain.channels, plain.depth, plain.swiglu, registers=4
    )
    for size, plain in PLAIN.items()
}


def shapes(variant: Variant) -> dict[str, tuple[int, ...]]:
    """All tensors and their shapes; a linear layer is [out, in], as in PyTorch."""
    channels, hidden = variant.channels, variant.hidden
    square = (channels, channels)
    linears = {"query": square, "key": square, "value": square, "out": square}
    if variant.swiglu:
        linears |= {"gate": (hidden, channels), "up": (hidden, channels)}
        linears |= {"down": (channels, hidden)}
    else:
        linears |= {"fc1": (hidden, channels), "fc2": (channels, hidden)}

    found: dict[str, tuple[int, ...]] = {
        "cls": (1, 1, channels),
        "positions": (1, 1 + GRID * GRID, channels),
        "patch.weight": (channels, 3, PATCH, PATCH),
        "patch.bias": (channels,),
    }
    if variant.registers:
        found["registers"] = (1, variant.registers, channels)
    for block in range(variant.depth):
        for name, shape in linears.items():
            found[f"{block}.{name}.weight"] = shape
            found[f"{block}.{name}.bias"] = shape[:1]
        for half in "12":
            found[f"{block}.norm{half}.weight"] = (channels,)
            found[f"{block}.norm{half}.bias"] = (channels,)
            found[f"{block}.scale{half}"] = (channels,)
    return found | {"norm.weight": (channels,), "norm.bias": (channels,)}


# --- Weights from a seed -------------------------------------------------------------------------


def random_weights(variant: Variant, seed: int) -> Weights:
    """Weights with scales similar to trained ones.

    Queries and keys are slightly larger than would preserve the variance. With smaller ones,
    attention averages and all pictures get similar descriptors; with twice the scale, the last bit
    of a pixel changes a descriptor as much as a wrong filter does, and a test could not tell them
    apart.
    """
    shape_of = shapes(variant)

    def tensor(name: str) -> np.ndarray:
        shape = shape_of[name]
        values = bell_shaped([seed, zlib.crc32(name.encode())], shape)
        match name.split(".")[-2:]:
            case ["cls" | "registers" | "positions"]:
                return values * np.float32(0.3)
            case [_, "scale1" | "scale2"]:
                return np.float32(0.5) + values * np.float32(0.1)
            case ["norm" | "norm1" | "norm2", "weight"]:
                return np.float32(1) + values * np.float32(0.1)
            case [_, "bias"]:
                return values * np.float32(0.02)
            case ["patch", _]:
                return values * np.float32(0.04)
            case [layer, _]:
                gain = 1.2 if layer in ("query", "key") else 1.0
                return values * np.float32(gain / shape[1] ** 0.5)
        raise AssertionError(name)

    return tensor


def bell_shaped(seed: list[int], shape: tuple[int, ...]) -> np.ndarray:
    """Float32 numbers, mean 0, standard deviation 1, magnitude up to 3.5: sums of four uniforms.

    Only the raw bits of a generator are the same in every version of numpy, and only integer sums
    are the same on every machine, so nothing else is used.
    """
    count = int(np.prod(shape))
    raw = np.random.default_rng(seed).bit_generator.random_raw(count).astype("<u8", copy=False)
    quarters = raw.view("<u2").reshape(count, 4)
    total = np.zeros(count, np.int32)
    for quarter in range(4):
        total += quarters[:, quarter]
    total -= 2 * 65535
    return (total.astype(np.float32) * np.float32(3**0.5 / 65536)).reshape(shape)


# --- Weights from a file -------------------------------------------------------------------------

# The names that the authors and transformers (up to 4, then 5) use for tensors outside the blocks.
OUTSIDE = {
    "cls_token": "cls",
    "pos_embed": "positions",
    "position_embeddings": "positions",
    "register_tokens": "registers",
    "patch_embed.proj.weight": "patch.weight",
    "patch_embed.proj.bias": "patch.bias",
    "patch_embeddings.projection.weight": "patch.weight",
    "patch_embeddings.projection.bias": "patch.bias",
    "norm.weight": "norm.weight",
    "norm.bias": "norm.bias",
    "layernorm.weight": "norm.weight",
    "layernorm.bias": "norm.bias",
}
# The same for tensors inside a block. Several names mean a tensor with all of them stacked.
INSIDE = {
    "attn.qkv": ["query", "key", "value"],
    "attn.proj": ["out"],
    "attention.attention.query": ["query"],
    "attention.attention.key": ["key"],
    "attention.attention.value": ["value"],
    "attention.output.dense": ["out"],
    "attention.q_proj": ["query"],
    "attention.k_proj": ["key"],
    "attention.v_proj": ["value"],
    "attention.o_proj": ["out"],
    "mlp.fc1": ["fc1"],
    "mlp.fc2": ["fc2"],
    "mlp.w12": ["gate", "up"],
    "mlp.w3": ["down"],
    "mlp.weights_in": ["gate", "up"],
    "mlp.weights_out": ["down"],
    "mlp.gate_proj": ["gate"],
    "mlp.up_proj": ["up"],
    "mlp.down_proj": ["down"],
    "norm1": ["norm1"],
    "norm2": ["norm2"],
    "ls1.gamma": ["scale1"],
    "ls2.gamma": ["scale2"],
    "layer_scale1.lambda1": ["scale1"],
    "layer_scale2.lambda1": ["scale2"],
}
PREFIX = re.compile(r"^(dinov2\.|dinov2_with_registers\.)?(embeddings\.)?")
IN_BLOCK = re.compile(r"^(?:blocks|encoder\.layer)\.(\d+)\.(.+?)(\.weight|\.bias)?$")


def own_names(key: str) -> list[str]:
    """The names in this script for a checkpoint's tensor; empty if the model does not need it."""
    key = PREFIX.sub("", key)
    if match := IN_BLOCK.match(key):
        block, part, kind = match.groups(default="")
        return [f"{block}.{name}{kind}" for name in INSIDE.get(part, [])]
    return [OUTSIDE[key]] if key in OUTSIDE else []


def checkpoint_weights(path: Path, variant: Variant) -> Weights:
    """The weights in a file, by the names in this script; shapes are checked on reading."""
    keys, read = open_safetensors(path) if path.suffix == ".safetensors" else open_torch(path)
    places = {
        name: (key, part, len(names))
        for key in keys
        for names in [own_names(key)]
        for part, name in enumerate(names)
    }
    shape_of = shapes(variant)
    if missing := [name for name in shape_of if name not in places]:
        raise WeightsError(f"it lacks {len(missing)} tensors of {variant.title}: {missing[:3]} …")
    if foreign := [places[name][0] for name in places if name not in shape_of]:
        raise WeightsError(
            f"it has {len(foreign)} tensors that {variant.title} does not: {foreign[:3]} …"
        )
    if unused := [key for key in keys if not own_names(key)]:
        print(f"export_dinov2: ignoring {', '.join(unused)}", file=sys.stderr)

    def tensor(name: str) -> np.ndarray:
        key, part, parts = places[name]
        whole = read(key)
        expected = shape_of[name]
        if whole.shape != (parts * expected[0], *expected[1:]):
            raise WeightsError(f"{key} has the shape {whole.shape}, unlike {variant.title}")
        return np.split(whole, parts)[part]

    return tensor


def open_safetensors(path: Path) -> tuple[list[str], Weights]:
    """Names and a reader of a safetensors file: a length, a JSON table, and the data."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        table = json.loads(file.read(length))
    table.pop("__metadata__", None)
    data = np.memmap(path, np.uint8, "r", offset=8 + length)

    def read(key: str) -> np.ndarray:
        entry = table[key]
        begin, end = entry["data_offsets"]
        raw = data[begin:end]
        match entry["dtype"]:
            case "F32":
                values = raw.view("<f4")
            case "F16":
                values = raw.view("<f2").astype(np.float32)
            case "BF16":
                values = (raw.view("<u2").astype(np.uint32) << 16).view(np.float32)
            case other:
                raise WeightsError(f"{key} has the unsupported type {other}")
        return values.reshape(entry["shape"])

    return list(table), read


def open_torch(path: Path) -> tuple[list[str], Weights]:
    """Names and a reader of a PyTorch file, without running code from it."""
    try:
        import torch
    except ImportError:
        raise WeightsError("reading it needs torch: pip install torch") from None
    try:
        state = torch.load(path, "cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        # PyTorch's own message suggests running the code in the file, so it is not shown.
        raise WeightsError("torch cannot read it as a dict of tensors") from error
    if not isinstance(state, dict) or not all(map(torch.is_tensor, state.values())):
        raise WeightsError("it is not a dict of tensors")
    return list(state), lambda key: state[key].float().numpy()


# --- Building the graph --------------------------------------------------------------------------


@dataclass
class Graph:
    """Nodes and constants in insertion order. Values are referred to by name."""

    weights: Weights
    data: BinaryIO | None = None  # file for large constants, if they are external
    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)
    int8: bool = False  # quantize linear layers to 8 bits
    quantized: set[str] = field(default_factory=set)  # values that are already quantized
    digest: Any = field(default_factory=hashlib.sha256)  # of all constants so far

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant."""
        array = np.ascontiguousarray(value, dtype).reshape(np.shape(value))
        self.digest.update(name.encode() + array.tobytes())
        if self.data and array.nbytes >= PAGE:
            self.constants.append(outside(name, array, self.data))
        else:
            self.constants.append(numpy_helper.from_array(array, name))
        return name

    def integers(self, name: str, *values: int) -> str:
        """Adds a list of integers, such as a shape or axes."""
        return self.constant(name, values, np.int64)

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Adds a node with one output, and names it after that output."""
        self.nodes.append(helper.make_node(operator, inputs, [output], output, **attributes))
        return output

    def norm(self, source: str, name: str) -> str:
        """Adds a layer normalisation over the channels."""
        constants = [
            self.constant(f"{name}.{kind}", self.weights(f"{name}.{kind}"))
            for kind in ("weight", "bias")
        ]
        return self.node(
            "LayerNormalization", [source, *constants], name, axis=-1, epsilon=EPSILON
        )

    def linear(self, source: str, name: str, scale: np.ndarray | float = 1.0) -> str:
        """Adds a linear layer with its output, [out], multiplied by `scale`."""
        weight, bias = self.weights(f"{name}.weight"), self.weights(f"{name}.bias")
        if self.int8:
            product = self.integer_product(source, name, weight.T * scale)
        else:
            weight = self.constant(f"{name}.weight", weight.T * scale)
            product = self.node("MatMul", [source, weight], f"{name}.product")
        bias = self.constant(f"{name}.bias", bias * scale)
        return self.node("Add", [product, bias], name)

    def integer_product(self, source: str, name: str, weight: np.ndarray) -> str:
        """Adds a product with `weight`, [in, out], in whole numbers.

        Each column of the weight has a scale of its own, its largest number over 127; the other
        side is made bytes when it is there, by its least and largest number.
        """
        scales = np.maximum(np.abs(weight).max(axis=0), np.finfo(np.float32).tiny) / 127
        whole = self.constant(f"{name}.weight", np.rint(weight / scales), np.int8)
        scales = self.constant(f"{name}.scales", scales)
        parts = [f"{source}.bytes", f"{source}.scale", f"{source}.zero"]
        if source not in self.quantized:
            self.quantized.add(source)
            self.nodes.append(helper.make_node("DynamicQuantizeLinear", [source], parts, parts[0]))
        values, scale, zero = parts
        product = self.node("MatMulInteger", [values, whole, zero], f"{name}.integer")
        product = self.node("Cast", [product], f"{name}.float", to=TensorProto.FLOAT)
        scales = self.node("Mul", [scale, scales], f"{name}.scale")
        return self.node("Mul", [product, scales], f"{name}.product")


def outside(name: str, array: np.ndarray, data: BinaryIO) -> onnx.TensorProto:
    """Writes an array to `data` at the next page boundary; returns a tensor that refers to it."""
    data.write(bytes(-data.tell() % PAGE))
    place = {"location": "model.onnx.data", "offset": data.tell(), "length": array.nbytes}
    data.write(array.data)
    tensor = TensorProto(name=name, dims=array.shape, data_location=TensorProto.EXTERNAL)
    tensor.data_type = helper.np_dtype_to_tensor_dtype(array.dtype)
    for key, value in place.items():
        tensor.external_data.add(key=key, value=str(value))
    return tensor


def add_embeddings(graph: Graph, variant: Variant, position: str, size: list[int] | None) -> str:
    """Adds the embedding of pixels as tokens: CLS, registers, patches row by row."""
    channels = variant.channels
    kernel = graph.constant("patch.weight", graph.weights("patch.weight"))
    bias = graph.constant("patch.bias", graph.weights("patch.bias"))
    edges = [PATCH, PATCH]
    cells = graph.node(
        "Conv", ["pixel_values", kernel, bias], "patch", kernel_shape=edges, strides=edges
    )
    if size:
        grid = graph.integers("grid", *(edge // PATCH for edge in size))
    else:
        grid = graph.node("Shape", [cells], "grid", start=2, end=4)
    cells = graph.node("Add", [cells, add_positions(graph, variant, position, grid)], "placed")
    rows = graph.node("Reshape", [cells, graph.integers("rows", 0, channels, -1)], "patch.rows")
    patches = graph.node("Transpose", [rows], "patch.tokens", perm=[0, 2, 1])

    # The tokens before the patches are the same for every picture: repeat them along the batch.
    # The CLS token has a position embedding; registers have none.
    leading = [graph.weights("cls") + graph.weights("positions")[:, :1]]
    if variant.registers:
        leading.append(graph.weights("registers"))
    leading = graph.constant("leading", np.concatenate(leading, axis=1))
    batch = graph.node("Shape", ["pixel_values"], "batch", start=0, end=1)
    repeats = graph.node("Concat", [batch, graph.integers("once", 1, 1)], "repeats", axis=0)
    leading = graph.node("Expand", [leading, repeats], "leading.tokens")
    return graph.node("Concat", [leading, patches], "tokens", axis=1)


def add_positions(graph: Graph, variant: Variant, position: str, grid: str) -> str:
    """Adds the position embedding [1, C, h, w] for a grid of h×w.

    PyTorch's bicubic filter is Keys' with a = −0.75 without antialiasing, and a = −0.5 with
    antialiasing, where the weights are renormalised at the borders.
    """
    channels = variant.channels
    table = graph.weights("positions")[0, 1:].T.reshape(1, channels, GRID, GRID)
    table = graph.constant("positions", table)
    attributes: dict[str, Any] = {"mode": "cubic", "coordinate_transformation_mode": "half_pixel"}
    if variant.registers:
        attributes |= {"antialias": 1, "cubic_coeff_a": -0.5, "exclude_outside": 1}
    else:
        attributes |= {"cubic_coeff_a": -0.75}

    if variant.registers or position == "hub":
        channels = graph.integers("channels", 1, channels)
        sizes = graph.node("Concat", [channels, grid], "positions.size", axis=0)
        return graph.node("Resize", [table, "", "", sizes], "positions.placed", **attributes)

    # The authors add 0.1 except on the native grid: `away` is 0 there, else 1.
    native = graph.integers("native", GRID, GRID)
    distance = graph.node("Abs", [graph.node("Sub", [grid, native], "difference")], "distances")
    distance = graph.node("ReduceMax", [distance], "distance", keepdims=1)
    away = graph.node("Min", [distance, graph.integers("one", 1)], "away")
    away = graph.node("Cast", [away], "away.float", to=TensorProto.FLOAT)
    offset = graph.node("Mul", [away, graph.constant("offset", OFFSET)], "offset.here")
    edges = graph.node("Cast", [grid], "grid.float", to=TensorProto.FLOAT)
    edges = graph.node("Add", [edges, offset], "grid.offset")
    scales = graph.node("Div", [edges, graph.constant("native.float", GRID)], "grid.scales")
    scales = graph.node(
        "Concat", [graph.constant("unscaled", [1.0, 1.0]), scales], "positions.scales", axis=0
    )
    return graph.node("Resize", [table, "", scales], "positions.placed", **attributes)


def add_attention(graph: Graph, source: str, block: int, channels: int) -> str:
    """Adds multi-head self-attention with its layer scale."""

    def heads(name: str, order: list[int], scale: float = 1.0) -> str:
        projected = graph.linear(source, f"{block}.{name}", scale)
        split = graph.node("Reshape", [projected, "heads.shape"], f"{projected}.split")
        return graph.node("Transpose", [split], f"{projected}.heads", perm=order)

    # The usual 1/√64 is a power of two, so folding it into the weights is exact.
    query = heads("query", [0, 2, 1, 3], HEAD**-0.5)
    key = heads("key", [0, 2, 3, 1])
    value = heads("value", [0, 2, 1, 3])
    name = f"{block}.attention"
    scores = graph.node("MatMul", [query, key], f"{name}.scores")
    shares = graph.node("Softmax", [scores], f"{name}.shares", axis=-1)
    mixed = graph.node("MatMul", [shares, value], f"{name}.mixed")
    mixed = graph.node("Transpose", [mixed], f"{name}.tokens", perm=[0, 2, 1, 3])
    joined = graph.node("Reshape", [mixed, "joined.shape"], f"{name}.joined")
    return graph.linear(joined, f"{block}.out", graph.weights(f"{block}.scale1"))


def add_mlp(graph: Graph, source: str, block: int, swiglu: bool) -> str:
    """Adds the MLP with its layer scale: exact GELU (erf) or SwiGLU."""
    scale = graph.weights(f"{block}.scale2")
    if swiglu:
        gate = graph.linear(source, f"{block}.gate")
        sigmoid = graph.node("Sigmoid", [gate], f"{gate}.sigmoid")
        gate = graph.node("Mul", [gate, sigmoid], f"{gate}.silu")
        up = graph.linear(source, f"{block}.up")
        return graph.linear(graph.node("Mul", [gate, up], f"{up}.gated"), f"{block}.down", scale)
    hidden = graph.linear(source, f"{block}.fc1")
    scaled = graph.node("Div", [hidden, "gelu.root"], f"{hidden}.scaled")
    error = graph.node("Erf", [scaled], f"{hidden}.erf")
    error = graph.node("Add", [error, "gelu.one"], f"{hidden}.share")
    product = graph.node("Mul", [hidden, error], f"{hidden}.twice")
    return graph.linear(
        graph.node("Mul", [product, "gelu.half"], f"{hidden}.gelu"), f"{block}.fc2", scale
    )


def add_blocks(graph: Graph, variant: Variant, tokens: str, count: int) -> str:
    """Adds that many transformer blocks."""
    channels = variant.channels
    if count:
        graph.integers("heads.shape", 0, 0, channels // HEAD, HEAD)
        graph.integers("joined.shape", 0, 0, channels)
        if not variant.swiglu:
            graph.constant("gelu.root", 2**0.5)
            graph.constant("gelu.one", 1.0)
            graph.constant("gelu.half", 0.5)
    for block in range(count):
        attention = add_attention(graph, graph.norm(tokens, f"{block}.norm1"), block, channels)
        tokens = graph.node("Add", [tokens, attention], f"{block}.attended")
        mlp = add_mlp(graph, graph.norm(tokens, f"{block}.norm2"), block, variant.swiglu)
        tokens = graph.node("Add", [tokens, mlp], f"{block}.tokens")
    return tokens


def add_output(graph: Graph, variant: Variant, tokens: str, facet: Facet | None) -> str:
    """Adds the blocks and the output: the last tokens, normalised, or the facet of a block."""
    if facet is None:
        tokens = add_blocks(graph, variant, tokens, variant.depth)
        return graph.node("Identity", [graph.norm(tokens, "norm")], "last_hidden_state")
    if facet.name == "token":
        tokens = add_blocks(graph, variant, tokens, facet.layer + 1)
        return graph.node("Identity", [tokens], facet.output)
    tokens = graph.norm(add_blocks(graph, variant, tokens, facet.layer), f"{facet.layer}.norm1")
    return graph.node("Identity", [graph.linear(tokens, f"{facet.layer}.{facet.name}")], facet.output)


def add_pooling(graph: Graph, variant: Variant, tokens: str, kind: str) -> None:
    """Adds the descriptor: the CLS token, or the signed GeM of the patches."""
    if kind == "cls":
        pooled = graph.node("Gather", [tokens, graph.constant("first", 0, np.int64)], "cls", axis=1)
    else:
        begin = graph.integers("patches.begin", 1 + variant.registers)
        end, along = graph.integers("patches.end", 2**31 - 1), graph.integers("tokens.axis", 1)
        patches = graph.node("Slice", [tokens, begin, end, along], "patches")
        square = graph.node("Mul", [patches, patches], "patches.square")
        cube = graph.node("Mul", [square, patches], "patches.cube")
        mean = graph.node("ReduceMean", [cube, along], "gem.mean", keepdims=0)
        size = graph.node("Abs", [mean], "gem.abs")
        root = graph.node("Pow", [size, graph.constant("gem.exponent", 1 / GEM_P)], "gem.root")
        pooled = graph.node("Mul", [root, graph.node("Sign", [mean], "gem.sign")], "gem")
    graph.node("LpNormalization", [pooled], "descriptor", axis=-1, p=2)


def build_model(
    variant: Variant,
    weights: Weights,
    *,
    position: str = "original",
    size: list[int] | None = None,
    pool: str | None = None,
    facet: Facet | None = None,
    int8: bool = False,
    data: BinaryIO | None = None,
) -> onnx.ModelProto:
    """Builds the model; `size` is [height, width] for a fixed input size, `data` the file for
    external weights, if any."""
    graph = Graph(weights, data, int8=int8)
    tokens = add_embeddings(graph, variant, position, size)
    tokens = add_output(graph, variant, tokens, facet)
    if pool:
        add_pooling(graph, variant, tokens, pool)

    def value(name: str, *shape: int | str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape])

    count = 1 + variant.registers + size[0] * size[1] // PATCH**2 if size else "tokens"
    outputs = [value(tokens, count, variant.channels)]
    if pool:
        outputs.append(value("descriptor", variant.channels))
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "dinov2",
            [value("pixel_values", 3, *(size or ["height", "width"]))],
            outputs,
            graph.constants,
        ),
        producer_name="whereabouts",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    helper.set_model_props(model, {"weights_sha256": graph.digest.hexdigest()})
    return model


# --- Writing -------------------------------------------------------------------------------------


def export(
    folder: Path, base: str, name: str, weights: Weights, source: str, choices: dict[str, Any]
) -> None:
    """Writes the model and its manifest. Each file is written atomically, the manifest last."""
    variant = VARIANTS[base]
    folder.mkdir(parents=True, exist_ok=True)
    files = {file: folder / f".{file}.{os.getpid()}" for file in ("model.onnx.data", "model.onnx")}
    written_data, model_file = files.values()
    large = 4 * sum(int(np.prod(shape)) for shape in shapes(variant).values()) > LARGEST_FILE
    try:
        if large:
            with written_data.open("wb") as stream:
                model = build_model(variant, weights, data=stream, **choices)
        else:
            model = build_model(variant, weights, **choices)
            onnx.checker.check_model(model, full_check=True)
        model_file.write_bytes(model.SerializeToString(deterministic=True))
        for file, written in files.items():
            if written.exists():
                written.replace(folder / file)
    finally:
        for written in files.values():
            written.unlink(missing_ok=True)
    if large:
        onnx.checker.check_model(str(folder / "model.onnx"), full_check=True)
    data = folder / "model.onnx.data" if large else None
    manifest = describe(variant, name, source, choices, folder / "model.onnx", data)
    (folder / "manifest.toml").write_text(manifest, encoding="utf-8")


def describe(
    variant: Variant,
    name: str,
    source: str,
    choices: dict[str, Any],
    model: Path,
    data: Path | None,
) -> str:
    """The manifest of `model`, with its weights in `data` if they are external."""
    by_size = variant.registers or choices["position"] == "hub"
    way = "by size" if by_size else "as the authors' code does"
    description = f"DINOv2 {variant.title}; its position embedding is stretched {way}."
    if choices["int8"]:
        description += " Its linear layers multiply 8-bit numbers."
    if "random" in name:
        description = f"Seeded random weights in the shape of {description}"
    height, width = choices["size"] or (MANIFEST_SIZE, MANIFEST_SIZE)
    if facet := choices["facet"]:
        description += f" Its output is the {facet.name} of block {facet.layer}."
    return MANIFEST.format(
        name=name,
        features=facet.output if facet else "last_hidden_state",
        description=description,
        sha256=digest(model),
        source=json.dumps(source, ensure_ascii=False)[1:-1],  # TOML escapes as JSON does
        data=f'\n[data]\nfile = "{data.name}"\nsha256 = "{digest(data)}"\n' if data else "",
        width=width,
        height=height,
        channels=variant.channels,
        registers=variant.registers,
        gem_p=GEM_P,
    )


def digest(file: Path) -> str:
    """The SHA-256 of a file in hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def size_of(text: str) -> list[int]:
    """Parses `HEIGHTxWIDTH`."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    size = [int(edge) for edge in match.groups()] if match else [0]
    if not all(edge > 0 and edge % PATCH == 0 for edge in size):
        raise argparse.ArgumentTypeError(f"{text!r} is not HEIGHTxWIDTH in multiples of {PATCH}")
    return size


def main() -> None:
    """Reads or generates the weights, builds the model, writes it and its manifest."""
    description, _, details = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description,
        epilog=details,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", choices=VARIANTS, help="variant")
    parser.add_argument("folder", type=Path, help="output folder for model.onnx and manifest.toml")
    origin = parser.add_mutually_exclusive_group(required=True)
    origin.add_argument("--weights", type=Path, metavar="FILE", help="a checkpoint")
    origin.add_argument("--random", type=int, metavar="SEED", help="generate weights, for tests")
    parser.add_argument(
        "--position",
        choices=["original", "hub"],
        default="original",
        help="how to interpolate the position embedding (default: original)",
    )
    parser.add_argument(
        "--fixed", type=size_of, metavar="HxW", help="fix the input height and width"
    )
    parser.add_argument("--pool", choices=["cls", "gem"], help="add the output `descriptor`")
    parser.add_argument(
        "--facet", choices=["query", "key", "value", "token"], help="export what a block computes"
    )
    parser.add_argument("--layer", type=int, metavar="N", help="the block of --facet, from 0")
    parser.add_argument("--int8", action="store_true", help="quantize linear layers to 8 bits")
    arguments = parser.parse_args()

    name, variant = arguments.model, VARIANTS[arguments.model]
    facet = None
    if arguments.facet:
        if arguments.layer is None or not 0 <= arguments.layer < variant.depth:
            parser.error(f"--facet needs --layer 0 to {variant.depth - 1}")
        facet = Facet(arguments.facet, arguments.layer)
    elif arguments.layer is not None:
        parser.error("--layer needs --facet")
    choices = {
        "facet": facet,
        "position": arguments.position,
        "size": arguments.fixed,
        "pool": arguments.pool,
        "int8": arguments.int8,
    }
    try:
        if arguments.weights:
            weights = checkpoint_weights(arguments.weights, variant)
            source = f"{arguments.weights.name} (DINOv2, Oquab et al., 2023)"
        else:
            weights = random_weights(variant, arguments.random)
            name = f"{name}-random-{arguments.random}"
            source = f"deploy/models/export_dinov2.py --random {arguments.random}"
        if facet:
            name = f"{name}-{facet.name}-{facet.layer}"
        if arguments.int8:
            name = f"{name}-int8"
        export(arguments.folder, arguments.model, name, weights, source, choices)
    except (WeightsError, OSError, ValueError, KeyError) as error:
        origin_text = arguments.weights or f"seed {arguments.random}"
        sys.exit(f"export_dinov2: cannot create {arguments.folder} from {origin_text}: {error}")


if __name__ == "__main__":
    main()
