#!/usr/bin/env python3
"""Compare the ONNX model of DINOv2 with the one in transformers. For developers.

    pip install torch torchvision transformers numpy onnx onnxruntime==1.24.4
    check_dinov2.py tests/fixtures/dinov2

Both get the same seeded weights and the same pictures: those in the folder and their reflections.
For `--position original`, the interpolation of the position embedding in transformers is replaced
by that of the authors' code, reimplemented here. The large and giant variants are cut to one block.
Fails if the cosine of a descriptor with that of transformers is below 0.99999, or if a position
embedding changes at 518×518.

Results of several runs with torch 2.15.0, transformers 5.23.0, onnxruntime 1.24.4 and
numpy 2.4.6 on x86_64: the largest difference of a token, whose values reach about ±5, and the
largest 1 − cosine of a descriptor, over batches of 1 and 8 and graphs of dynamic and fixed size:

    model             blocks  sizes                      hub               original
    small                 12  224×224, 322×224, 322×322  1.0e-05  1.9e-12  1.9e-05  9.9e-13
    small                 12  518×518                    5.2e-06  4.0e-13  5.2e-06  4.0e-13
    small, registers      12  224×224, 322×224, 322×322  5.7e-06  4.7e-13  the same graph
    small, registers      12  518×518, batch of 1        5.0e-06  3.3e-13
    small, registers       2  700×560                    2.1e-05  9.2e-13
    base                  12  224×224                    5.5e-06  3.9e-13  1.4e-05  2.7e-10
    base, registers       12  224×224                    6.7e-06  7.4e-13
    large                  1  224×224                    6.0e-06  5.3e-13  2.4e-05  3.2e-12
    giant                  1  224×224                    6.9e-06  2.3e-12  2.4e-05  2.6e-11

The position embeddings were identical at 518×518.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
import transformers
from export_dinov2 import VARIANTS, build_model, random_weights
from PIL import Image
from reference_dinov2 import SEED, descriptors, fit, transformers_model

LEAST_COSINE = 0.99999
BATCHES = [1, 8]
SIZES = [(224, 224), (322, 224), (322, 322), (700, 560)]  # width, height
NATIVE = (518, 518)
# Model, blocks (all if None), and sizes.
CASES: list[tuple[str, int | None, list[tuple[int, int]]]] = [
    ("dinov2-small", None, [*SIZES[:3], NATIVE]),
    ("dinov2-with-registers-small", None, [*SIZES[:3], NATIVE]),
    ("dinov2-base", None, SIZES[:1]),
    ("dinov2-with-registers-base", None, SIZES[:1]),
    ("dinov2-small", 2, SIZES[3:]),
    ("dinov2-with-registers-small", 2, SIZES[3:]),
    ("dinov2-large", 1, SIZES[:1]),
    ("dinov2-giant", 1, SIZES[:1]),
]


def authors_positions(
    embeddings: torch.nn.Module, tokens: torch.Tensor, height: int, width: int
) -> torch.Tensor:
    """Interpolates the position embedding like the authors' code, for variants without registers.

    That code passes both the size and a scale factor with 0.1 added; PyTorch samples by the factor.
    """
    table = embeddings.position_embeddings
    rows, columns = height // 14, width // 14
    if rows == columns == 37:
        return table
    patches = table[:, 1:].reshape(1, 37, 37, -1).permute(0, 3, 1, 2)
    factors = ((rows + 0.1) / 37, (columns + 0.1) / 37)
    patches = torch.nn.functional.interpolate(patches, scale_factor=factors, mode="bicubic")
    assert patches.shape[2:] == (rows, columns)
    return torch.cat([table[:, :1], patches.flatten(2).transpose(1, 2)], dim=1)


def batch_of(pictures: list[Image.Image], count: int, size: tuple[int, int]) -> np.ndarray:
    """Returns `count` pictures: the given ones, mirrored, flipped, and both."""
    mirror, flip = Image.Transpose.FLIP_LEFT_RIGHT, Image.Transpose.FLIP_TOP_BOTTOM
    many = [*pictures, *(picture.transpose(mirror) for picture in pictures)]
    many += [picture.transpose(flip) for picture in many]
    return torch.cat([fit(picture, size, "squash") for picture in many[:count]]).numpy()


def session_of(name: str, depth: int | None, **choices: Any) -> onnxruntime.InferenceSession:
    """Loads our model, on one thread."""
    variant = VARIANTS[name]
    if depth:
        variant = dataclasses.replace(variant, depth=depth)
    model = build_model(variant, random_weights(variant, SEED), **choices)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )


def compare(
    theirs: torch.nn.Module, ours: onnxruntime.InferenceSession, pixels: np.ndarray, registers: int
) -> str:
    """Runs both and formats their difference; exits if it is too large."""
    begin = time.perf_counter()
    with torch.inference_mode():
        truth = theirs(torch.from_numpy(pixels)).last_hidden_state
    middle = time.perf_counter()
    outputs = dict(
        zip(
            [output.name for output in ours.get_outputs()],
            ours.run(None, {"pixel_values": pixels}),
            strict=True,
        )
    )
    end = time.perf_counter()

    tokens = outputs["last_hidden_state"]
    if tokens.shape != truth.shape:
        sys.exit(f"check_dinov2: shape {tokens.shape} instead of {tuple(truth.shape)}")
    expected = descriptors(truth, registers)
    found = descriptors(torch.from_numpy(tokens), registers)
    if "descriptor" in outputs:  # pooled in the graph
        found["gem"] = torch.from_numpy(outputs["descriptor"])
    double = {kind: (expected[kind].double(), found[kind].double()) for kind in expected}
    cosines = [torch.cosine_similarity(*pair).min().item() for pair in double.values()]
    if min(cosines) < LEAST_COSINE:
        sys.exit(f"check_dinov2: cosines {cosines}")
    off = " ".join(f"{1 - cosine:8.1e}" for cosine in cosines)
    difference = float(np.abs(tokens - truth.numpy()).max())
    return f"{difference:7.1e} {off} {middle - begin:6.2f} {end - middle:6.2f}"


def native_positions_stay(name: str, position: str) -> bool:
    """Whether the position embedding at 518×518 is bitwise unchanged."""
    variant = dataclasses.replace(VARIANTS[name], depth=1)
    model = build_model(variant, random_weights(variant, SEED), position=position)
    placed = model.graph.output.add()
    placed.name = "positions.placed"
    placed.type.tensor_type.elem_type = 1
    session = onnxruntime.InferenceSession(model.SerializeToString())
    pixels = np.zeros((1, 3, 518, 518), np.float32)
    (result,) = session.run([placed.name], {"pixel_values": pixels})
    table = random_weights(variant, SEED)("positions")[0, 1:]
    return np.array_equal(result[0].reshape(variant.channels, -1).T, table)


def main() -> None:
    """Prints one line per comparison; fails if one exceeds its tolerance."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of the pictures")
    folder: Path = parser.parse_args().folder
    torch.set_num_threads(1)
    pictures = [Image.open(path).convert("RGB") for path in sorted(folder.glob("*.jpg"))]

    versions = f"torch {torch.__version__}, transformers {transformers.__version__}"
    print(f"{versions}, onnxruntime {onnxruntime.__version__}, numpy {np.__version__}")
    print("model                        blocks  position  size      batch    error  1−cos(cls)"
          " (gem)  torch s  onnx s")
    for name, depth, sizes in CASES:
        variant = VARIANTS[name]
        theirs = transformers_model(name, random_weights(variant, SEED), depth)
        for position in ["hub"] if variant.registers else ["hub", "original"]:
            if position == "original":
                patched = types.MethodType(authors_positions, theirs.embeddings)
                theirs.embeddings.interpolate_pos_encoding = patched
            anything = session_of(name, depth, position=position, pool="gem")
            for size in sizes:
                only = session_of(name, depth, position=position, size=[size[1], size[0]])
                for session, word in ((anything, ""), (only, " fixed")):
                    for batch in BATCHES if session is anything else [1]:
                        pixels = batch_of(pictures, batch, size)
                        result = compare(theirs, session, pixels, variant.registers)
                        print(
                            f"{name:<28} {depth or variant.depth:>6}  {position:<8}"
                            f"  {size[0]}×{size[1]}  {batch:>5}  {result}{word}",
                            flush=True,
                        )
    for name, position in [
        ("dinov2-small", "hub"),
        ("dinov2-small", "original"),
        ("dinov2-with-registers-small", "hub"),
    ]:
        if not native_positions_stay(name, position):
            sys.exit(f"check_dinov2: {name}, {position}: positions change at 518×518")
    print("position embeddings are identical at 518×518")


if __name__ == "__main__":
    main()
