#!/usr/bin/env python3
"""Write ONNX files that are wrong in one way each, for the tests of `whereabouts model add`.

    make_odd_models.py FOLDER

Each is the model of make_tiny_tokens.py with one change, in a folder of its own: FOLDER/NAME/model.onnx, with files of
external weights where that is the point. The manifest of make_tiny_tokens.py describes the unchanged model.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from make_tiny_tokens import CHANNELS, Weights, build_model
from onnx import ModelProto, TensorProto, helper, numpy_helper

INPUT = "pixel_values"
OUTPUT = "last_hidden_state"
FLOAT16_MAX = 65504


def set_shape(value: onnx.ValueInfoProto, dimensions: list[int | str]) -> None:
    """Replaces the shape of an input or output."""
    kind = value.type.tensor_type.elem_type
    value.CopyFrom(helper.make_tensor_value_info(value.name, kind, dimensions))


def rename(model: ModelProto, old: str, new: str) -> None:
    """Renames an input or output."""
    for node in model.graph.node:
        for names in (node.input, node.output):
            for index, name in enumerate(names):
                if name == old:
                    names[index] = new
    for value in (*model.graph.input, *model.graph.output):
        if value.name == old:
            value.name = new


def after(model: ModelProto, *nodes: tuple[str, list[str], dict[str, object]]) -> None:
    """Appends nodes to the output; each takes the result of the one before as its first input."""
    last = "before"
    rename(model, OUTPUT, last)
    model.graph.output[0].name = OUTPUT
    for index, (operator, inputs, attributes) in enumerate(nodes):
        result = OUTPUT if index + 1 == len(nodes) else f"after_{index}"
        model.graph.node.append(helper.make_node(operator, [last, *inputs], [result], **attributes))
        last = result


def constant(model: ModelProto, name: str, value: object) -> str:
    """Adds a constant."""
    model.graph.initializer.append(numpy_helper.from_array(np.asarray(value), name))
    return name


def cast_output(model: ModelProto, kind: int) -> None:
    """Changes the type of the output."""
    after(model, ("Cast", [], {"to": kind}))
    model.graph.output[0].type.tensor_type.elem_type = kind


def cast_input(model: ModelProto, kind: int) -> None:
    """Changes the type of the input."""
    rename(model, INPUT, "pixels")
    model.graph.input[0].name = INPUT
    model.graph.input[0].type.tensor_type.elem_type = kind
    cast = helper.make_node("Cast", [INPUT], ["pixels"], to=TensorProto.FLOAT)
    model.graph.node.insert(0, cast)


def half(model: ModelProto) -> None:
    cast_input(model, TensorProto.FLOAT16)
    cast_output(model, TensorProto.FLOAT16)


def half_overflow(model: ModelProto) -> None:
    after(model, ("Mul", [constant(model, "large", np.float32(FLOAT16_MAX * 1000))], {}))
    rename(model, OUTPUT, "wide")
    model.graph.output[0].name = OUTPUT
    cast = helper.make_node("Cast", ["wide"], [OUTPUT], to=TensorProto.FLOAT16)
    model.graph.node.append(cast)
    model.graph.output[0].type.tensor_type.elem_type = TensorProto.FLOAT16


def extra_input(model: ModelProto) -> None:
    model.graph.input.append(helper.make_tensor_value_info("temperature", TensorProto.FLOAT, [1]))
    after(model, ("Mul", ["temperature"], {}))


def not_a_number(model: ModelProto) -> None:
    after(model, ("Mul", [constant(model, "nan", np.float32("nan"))], {}))


def same_for_all(model: ModelProto) -> None:
    nothing, one = constant(model, "nothing", np.float32(0)), constant(model, "one", np.float32(1))
    after(model, ("Mul", [nothing], {}), ("Add", [one], {}))


def all_zero(model: ModelProto) -> None:
    after(model, ("Mul", [constant(model, "nothing", np.float32(0))], {}))


def fewer_channels(model: ModelProto) -> None:
    bounds = [constant(model, name, [value]) for name, value in (("from", 0), ("to", 4), ("axis", 2))]
    after(model, ("Slice", bounds, {}))
    set_shape(model.graph.output[0], ["batch", "tokens", 4])


def one_at_a_time(model: ModelProto) -> None:
    set_shape(model.graph.input[0], [1, 3, "height", "width"])
    set_shape(model.graph.output[0], [1, "tokens", CHANNELS])


def other_size(model: ModelProto) -> None:
    set_shape(model.graph.input[0], ["batch", 3, 28, 28])


def frozen(model: ModelProto) -> None:
    """Position embeddings for 224×224, after two registers and the CLS token, in a graph that declares any size."""
    positions = np.random.default_rng(1).standard_normal((1, 3 + 16 * 16, CHANNELS))
    after(model, ("Add", [constant(model, "positions", positions.astype(np.float32))], {}))


def flat(model: ModelProto) -> None:
    set_shape(model.graph.input[0], ["batch", 3])


def new_opset(model: ModelProto) -> None:
    model.opset_import[0].version = 999


def unknown_operator(model: ModelProto) -> None:
    model.graph.node[0].op_type = "NoSuchOperator"


CHANGES: dict[str, Callable[[ModelProto], None]] = {
    "good": lambda _: None,
    "half": half,
    "half-output": lambda model: cast_output(model, TensorProto.FLOAT16),
    "half-overflow": half_overflow,
    "one-at-a-time": one_at_a_time,
    "input-name": lambda model: rename(model, INPUT, "images"),
    "output-name": lambda model: rename(model, OUTPUT, "features"),
    "extra-input": extra_input,
    "bytes-in": lambda model: cast_input(model, TensorProto.UINT8),
    "double-out": lambda model: cast_output(model, TensorProto.DOUBLE),
    "other-size": other_size,
    "frozen": frozen,
    "flat": flat,
    "fewer-channels": fewer_channels,
    "not-a-number": not_a_number,
    "same-for-all": same_for_all,
    "all-zero": all_zero,
    "new-opset": new_opset,
    "unknown-operator": unknown_operator,
}


def save_external(model: ModelProto, folder: Path, location: str) -> None:
    """Saves a model whose weights are in another file, as torch does by default."""
    (folder / location).parent.mkdir(parents=True, exist_ok=True)
    onnx.save_model(
        model,
        folder / "model.onnx",
        save_as_external_data=True,
        location=location,
        size_threshold=64,
        convert_attribute=True,
    )


def relocate(file: Path, location: str) -> None:
    """Changes where a model says that its weights are."""
    model = onnx.load(file, load_external_data=False)
    for tensor in model.graph.initializer:
        for entry in tensor.external_data:
            if entry.key == "location":
                entry.value = location
    file.write_bytes(model.SerializeToString())


def main() -> None:
    """Writes the models."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="output folder")
    root: Path = parser.parse_args().folder

    def folder(name: str) -> Path:
        (root / name).mkdir(parents=True, exist_ok=True)
        return root / name

    for name, change in CHANGES.items():
        model = build_model(Weights.seeded())
        change(model)
        (folder(name) / "model.onnx").write_bytes(model.SerializeToString())

    for name, location in {
        "external-torch": "model.onnx.data",
        "external-hub": "model.onnx_data",
        "external-below": "weights/all.bin",
        "external-missing": "model.onnx.data",
        "external-cut": "model.onnx.data",
        "external-outside": "model.onnx.data",
        "external-absolute": "model.onnx.data",
    }.items():
        save_external(build_model(Weights.seeded()), folder(name), location)
    (root / "external-missing/model.onnx.data").unlink()
    cut = root / "external-cut/model.onnx.data"
    cut.write_bytes(cut.read_bytes()[:1000])
    (root / "external-outside/model.onnx.data").rename(root / "outside.data")
    relocate(root / "external-outside/model.onnx", "../outside.data")
    relocate(root / "external-absolute/model.onnx", "/etc/hostname")


if __name__ == "__main__":
    main()
