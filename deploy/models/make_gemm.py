#!/usr/bin/env python3
"""Build the graph that `whereabouts model bench` uses to measure peak GEMM throughput.

    make_gemm.py src/vision/gemm.onnx

    input   x   float32 [1024, 1024]
    output  y   float32 [1024, 1024]   x times the same matrix, 8 times over: 17.18 GFLOP

All elements of the matrix are 1/1024, so that ones stay ones. The matrix is stored as a shape and
a number, which the runtime folds into a constant, so the file has only a few hundred bytes. The
output is reproducible with the same version of onnx.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import onnx
from onnx import TensorProto, helper

SIZE = 1024
TIMES = 8
OPSET = 17
IR_VERSION = 8


def build() -> onnx.ModelProto:
    shape = helper.make_tensor("shape", TensorProto.INT64, [2], [SIZE, SIZE])
    value = helper.make_tensor("value", TensorProto.FLOAT, [1], [1 / SIZE])
    nodes = [helper.make_node("ConstantOfShape", ["shape"], ["matrix"], value=value)]
    names = ["x", *(f"x{i}" for i in range(1, TIMES)), "y"]
    for source, target in zip(names, names[1:]):
        nodes.append(helper.make_node("MatMul", [source, "matrix"], [target]))
    square = [SIZE, SIZE]
    graph = helper.make_graph(
        nodes,
        "gemm",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, square)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, square)],
        [shape],
    )
    opset = helper.make_opsetid("", OPSET)
    return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, metavar="FILE")
    model = build()
    onnx.checker.check_model(model)
    parser.parse_args().file.write_bytes(model.SerializeToString(deterministic=True))


if __name__ == "__main__":
    main()
