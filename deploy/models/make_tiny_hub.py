#!/usr/bin/env python3
"""Build a tiny DINOv2 as the model hub's files are made, and what PyTorch says of it. For developers.

    pip install optimum-onnx==0.1.0 onnx torch
    make_tiny_hub.py tests/fixtures/models/tiny-hub

The ONNX files of DINOv2 on the hub are exports of the model of transformers by Hugging Face Optimum.
This script exports one block of that architecture in the same way, with seeded random weights and a
position embedding of 5×5, and writes:

    model.onnx     the export of Optimum; takes pictures of any size in multiples of 14
    frozen.onnx    as exporters wrote it before the interpolation of the position embedding could be
                   traced: it declares any size, but runs at 224×224 only
    manifest.toml  describes model.onnx
    expected.json  the descriptors that PyTorch computes at several sizes

The pictures have the size of the input, so nothing is resized or cropped:

    r = (7x + 13y) mod 256,  g = (11x + 3y + 50) mod 256,  b = (5x + 17y + 101) mod 256

with x to the right and y down, scaled to 0..1 and normalised with ImageNet's mean and standard
deviation. The descriptors `cls` and `gem` are those of reference_dinov2.py. `first`, `middle` and
`last` are tokens of these patches, L2-normalised: an average hides where positions are wrong.

The committed files were made with torch 2.15.0, transformers 4.57.6, optimum 2.1.0 and optimum-onnx
0.1.0. The same export of ViT-S/14 with two blocks and a position embedding of 37×37 differed from
PyTorch by at most 1.6e-5 in a token at 224×224, 322×322, 518×518, 308×490, 448×224, 1008×252, 14×14,
560×700 and 434×322 (width × height).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from pathlib import Path

import numpy as np
import torch
from optimum.exporters.onnx import main_export
from transformers import Dinov2Config, Dinov2Model
from transformers.models.dinov2.modeling_dinov2 import Dinov2Embeddings

SEED = 21
PATCH = 14
NATIVE = 70  # width and height at which the position embedding is not interpolated
FROZEN = 224
CHANNELS = 16
MEAN = [0.485, 0.456, 0.406]
STD = [0.229, 0.224, 0.225]
SIZES = [(70, 70), (224, 224), (322, 322), (224, 322), (322, 224), (560, 140), (14, 98)]

MANIFEST = """\
# Written by deploy/models/make_tiny_hub.py.
name = "tiny-hub"
description = "Seeded random weights, exported as the model hub's files of DINOv2 are, for tests."
file = "model.onnx"
sha256 = "{sha256}"
licence = "Apache-2.0"
source = "deploy/models/make_tiny_hub.py"

[input]
name = "pixel_values"
width = 322
height = 322
resize = "squash"
interpolation = "bicubic"
multiple = 14
mean = {mean}
std = {std}

[output]
features = "last_hidden_state"
layout = "tokens"
channels = {channels}
stride = 14
registers = 0
cls = true

[pooling]
gem_p = 3.0
grid = [1, 1]
dimension = {channels}
"""


def tiny_model() -> Dinov2Model:
    """One block with seeded weights."""
    torch.manual_seed(SEED)
    config = Dinov2Config(
        hidden_size=CHANNELS,
        num_hidden_layers=1,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=NATIVE,
        patch_size=PATCH,
    )
    model = Dinov2Model(config).eval()
    with torch.no_grad():
        # As large as what is added to it, so that a wrong interpolation shows.
        model.embeddings.position_embeddings.normal_()
        model.embeddings.patch_embeddings.projection.weight.normal_(std=0.04)
    return model


def frozen_positions(
    self: Dinov2Embeddings, tokens: torch.Tensor, height: int, width: int
) -> torch.Tensor:
    """The interpolation with plain numbers, which a trace records as constants."""
    edge, channels = NATIVE // PATCH, tokens.shape[-1]
    patches = self.position_embeddings[:, 1:].reshape(1, edge, edge, channels).permute(0, 3, 1, 2)
    size = (int(height) // PATCH, int(width) // PATCH)
    patches = torch.nn.functional.interpolate(
        patches, size=size, mode="bicubic", align_corners=False
    )
    patches = patches.permute(0, 2, 3, 1).view(1, -1, channels)
    return torch.cat((self.position_embeddings[:, :1], patches), dim=1)


class Tokens(torch.nn.Module):
    """Returns the tokens as a tensor."""

    def __init__(self, model: Dinov2Model) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: torch.Tensor) -> torch.Tensor:
        """Runs the model."""
        return self.model(pixel_values).last_hidden_state


def export_frozen(model: Dinov2Model, file: Path) -> None:
    """Exports with dynamic axes, and a position embedding that is fixed all the same."""
    usual = Dinov2Embeddings.interpolate_pos_encoding
    Dinov2Embeddings.interpolate_pos_encoding = frozen_positions
    axes = {
        "pixel_values": {0: "batch_size", 2: "height", 3: "width"},
        "last_hidden_state": {0: "batch_size"},
    }
    try:
        torch.onnx.export(
            Tokens(model),
            (torch.zeros(1, 3, FROZEN, FROZEN),),
            str(file),
            input_names=["pixel_values"],
            output_names=["last_hidden_state"],
            dynamic_axes=axes,
            opset_version=18,
            dynamo=False,
        )
    finally:
        Dinov2Embeddings.interpolate_pos_encoding = usual


def picture(width: int, height: int) -> torch.Tensor:
    """The picture described at the top as model input."""
    y, x = np.mgrid[:height, :width]
    colours = [7 * x + 13 * y, 11 * x + 3 * y + 50, 5 * x + 17 * y + 101]
    pixels = np.stack(colours, axis=-1) % 256
    normalised = (pixels / 255 - MEAN) / STD
    return torch.from_numpy(normalised.transpose(2, 0, 1)[None].astype(np.float32))


def descriptors(tokens: torch.Tensor) -> dict[str, list[float]]:
    """Both descriptors of tokens [1, 1 + h·w, CHANNELS], and three of the patches."""
    tokens = tokens.double()
    patches = tokens[0, 1:]
    mean = (patches**3).mean(dim=0)
    pooled = {"cls": tokens[0, 0], "gem": mean.sign() * mean.abs() ** (1 / 3)}
    pooled |= {"first": patches[0], "middle": patches[len(patches) // 2], "last": patches[-1]}
    return {kind: [round(x, 8) for x in (v / v.norm()).tolist()] for kind, v in pooled.items()}


def main() -> None:
    """Writes the four files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="output folder of the files")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    model = tiny_model()
    expected = []
    for width, height in SIZES:
        with torch.inference_mode():
            tokens = model(picture(width, height)).last_hidden_state
        expected.append({"width": width, "height": height, **descriptors(tokens)})
    lines = ",\n".join(json.dumps(entry, separators=(",", ":")) for entry in expected)
    (folder / "expected.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")

    with tempfile.TemporaryDirectory() as work:
        model.save_pretrained(Path(work) / "model")
        # From which the exporter takes the size that it traces.
        preprocessor = {"image_processor_type": "BitImageProcessor", "crop_size": FROZEN, "size": 256}
        settings = Path(work) / "model" / "preprocessor_config.json"
        settings.write_text(json.dumps(preprocessor), encoding="utf-8")
        main_export(
            str(Path(work) / "model"), output=Path(work) / "out", task="feature-extraction"
        )
        exported = (Path(work) / "out" / "model.onnx").read_bytes()
    (folder / "model.onnx").write_bytes(exported)
    digest = hashlib.sha256(exported).hexdigest()
    manifest = MANIFEST.format(sha256=digest, mean=MEAN, std=STD, channels=CHANNELS)
    (folder / "manifest.toml").write_text(manifest, encoding="utf-8")
    export_frozen(model, folder / "frozen.onnx")


if __name__ == "__main__":
    main()
