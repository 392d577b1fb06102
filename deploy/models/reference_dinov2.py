#!/usr/bin/env python3
"""Write the DINOv2 descriptors that the tests expect, computed with PyTorch. For developers.

    pip install torch torchvision transformers numpy onnx
    reference_dinov2.py tests/fixtures/dinov2

Reads the pictures `*.jpg` in the folder and writes `expected.json` to it. The weights are
those of `export_dinov2.py --random`, loaded into the DINOv2 of transformers; our graph, decoder
and resizing are not used. A test therefore has to export with `--position hub`, which treats the
position embedding like transformers, and to read the same pictures.

A picture is decoded by Pillow, scaled as 8-bit RGB with an antialiased bicubic filter, and
normalised with ImageNet's mean and standard deviation:

    squash        to width × height, whatever its aspect ratio (torchvision's `resize`)
    longest_edge  to the longer of both on its longer edge, and in proportion on the other, both in
                  multiples of 14
    centre_crop   the largest centred crop with the aspect ratio width : height, at subpixel
                  precision, scaled to width × height (Pillow's `ImageOps.fit`). This differs from
                  torchvision's usual resize of the shorter edge followed by a crop, which rounds
                  in between

The descriptors, L2-normalised and rounded to six significant digits:

    cls   the CLS token after the final layer normalisation
    gem   for each channel, m = mean of x³ over the patch tokens, then sign(m) · |m|^(1/3)
    vlad  as AnyLoc (Keetha et al., 2023) computes it: the patch tokens L2-normalised, each assigned to
          the centre of the highest cosine, the residuals of each centre summed and L2-normalised

A case with a facet is about the keys or values of the attention of one block, or its tokens, instead
of the last tokens, as AnyLoc's extractor hooks them. The centres of `vlad` are tokens of the first
such case, rounded to 16 bits, and written to `vlad.bin`.

The committed file was made with torch 2.15.0, torchvision 0.29.2, transformers 5.23.0 and Pillow
13.0.0, on x86_64; it takes about a minute on one core.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
import transformers
from export_dinov2 import VARIANTS, Weights, random_weights, shapes
from PIL import Image, ImageOps
from torchvision.transforms import InterpolationMode
from torchvision.transforms import functional as transforms

SEED = 7
MEAN = [0.485, 0.456, 0.406]
STD = [0.229, 0.224, 0.225]
SQUARE, LARGE, OBLONG = (224, 224), (322, 322), (322, 224)  # width, height

UPRIGHT, PANORAMA, LONGEST = (224, 322), (560, 140), (434, 434)
FACET_LAYER = 7
CENTRES = 4

# Model, picture, size, resize mode and facet. A vector is 4 to 8 kB of JSON.
Case = tuple[str, str, tuple[int, int], str, str]
PLAIN_CASES = [
    ("dinov2-small", "town-a.jpg", SQUARE, "squash"),
    ("dinov2-small", "town-a.jpg", SQUARE, "centre_crop"),
    ("dinov2-small", "town-a.jpg", LARGE, "squash"),
    ("dinov2-small", "town-a.jpg", LARGE, "centre_crop"),
    ("dinov2-small", "town-a.jpg", OBLONG, "squash"),
    ("dinov2-small", "town-a.jpg", OBLONG, "centre_crop"),
    ("dinov2-small", "town-b.jpg", SQUARE, "squash"),
    ("dinov2-small", "town-b.jpg", OBLONG, "centre_crop"),
    ("dinov2-with-registers-small", "town-a.jpg", SQUARE, "squash"),
    ("dinov2-with-registers-small", "town-b.jpg", OBLONG, "squash"),
    ("dinov2-base", "town-b.jpg", SQUARE, "squash"),
    ("dinov2-base", "town-b.jpg", LARGE, "squash"),
    ("dinov2-base", "town-b.jpg", OBLONG, "centre_crop"),
    ("dinov2-small", "town-a.jpg", UPRIGHT, "squash"),
    ("dinov2-small", "town-b.jpg", PANORAMA, "squash"),
    ("dinov2-small", "town-b.jpg", LONGEST, "longest_edge"),
    ("dinov2-with-registers-small", "town-a.jpg", UPRIGHT, "squash"),
]
CASES: list[Case] = [(*case, "") for case in PLAIN_CASES] + [
    ("dinov2-small", "town-a.jpg", LARGE, "squash", "value"),
    ("dinov2-small", "town-b.jpg", LONGEST, "longest_edge", "value"),
    ("dinov2-small", "town-a.jpg", LARGE, "squash", "key"),
    ("dinov2-small", "town-a.jpg", LARGE, "squash", "token"),
    ("dinov2-with-registers-small", "town-b.jpg", OBLONG, "squash", "value"),
]

# The names in transformers 5 of the tensors of export_dinov2.py, outside and inside the blocks.
OUTSIDE = {
    "cls": "embeddings.cls_token",
    "positions": "embeddings.position_embeddings",
    "registers": "embeddings.register_tokens",
    "patch": "embeddings.patch_embeddings.projection",
    "norm": "layernorm",
}
INSIDE = {
    "query": "attention.q_proj",
    "key": "attention.k_proj",
    "value": "attention.v_proj",
    "out": "attention.o_proj",
    "fc1": "mlp.fc1",
    "fc2": "mlp.fc2",
    "gate": "mlp.gate_proj",
    "up": "mlp.up_proj",
    "down": "mlp.down_proj",
    "norm1": "norm1",
    "norm2": "norm2",
    "scale1": "layer_scale1.lambda1",
    "scale2": "layer_scale2.lambda1",
}


def their_name(name: str) -> str:
    """The name in transformers of a tensor of export_dinov2.py."""
    first, *rest = name.split(".")
    if not first.isdigit():
        return ".".join([OUTSIDE[first], *rest])
    return ".".join(["encoder.layer", first, INSIDE[rest[0]], *rest[1:]])


def transformers_model(name: str, weights: Weights, depth: int | None = None) -> torch.nn.Module:
    """The transformers model with these weights; `depth` cuts it to its first blocks."""
    variant = VARIANTS[name]
    kind = "Dinov2WithRegisters" if variant.registers else "Dinov2"
    settings = {
        "hidden_size": variant.channels,
        "num_hidden_layers": depth or variant.depth,
        "num_attention_heads": variant.channels // 64,
        "image_size": 518,
        "patch_size": 14,
        "use_swiglu_ffn": variant.swiglu,
    }
    if variant.registers:
        settings["num_register_tokens"] = variant.registers
    config = getattr(transformers, f"{kind}Config")(**settings)
    model = getattr(transformers, f"{kind}Model")(config)
    state = model.state_dict()
    ours = {their_name(tensor): tensor for tensor in shapes(variant)}
    for key in state:
        if key != "embeddings.mask_token":  # for training only
            state[key] = torch.from_numpy(np.array(weights(ours[key])))
    model.load_state_dict(state)
    return model.eval()


def fit(picture: Image.Image, size: tuple[int, int], resize: str) -> torch.Tensor:
    """Converts a picture to model input: 1 × 3 × height × width."""
    if resize == "longest_edge":
        scale = max(size) / max(picture.size)
        size = tuple(round(edge * scale / 14) * 14 for edge in picture.size)
        resize = "squash"
    width, height = size
    if resize == "squash":
        fitted = transforms.resize(picture, [height, width], InterpolationMode.BICUBIC)
    else:
        fitted = ImageOps.fit(picture, size, Image.Resampling.BICUBIC)
    return transforms.normalize(transforms.to_tensor(fitted), MEAN, STD)[None]


def descriptors(tokens: torch.Tensor, registers: int) -> dict[str, torch.Tensor]:
    """Both descriptors [N, C] of tokens [N, 1 + registers + h·w, C]."""
    mean = (tokens[:, 1 + registers :] ** 3).mean(dim=1)
    gem = mean.sign() * mean.abs() ** (1 / 3)
    return {
        kind: torch.nn.functional.normalize(pooled)
        for kind, pooled in (("cls", tokens[:, 0]), ("gem", gem))
    }


def facet_of(model: torch.nn.Module, facet: str, pixels: torch.Tensor) -> torch.Tensor:
    """What a block computes for the tokens, [N, 1 + registers + h·w, C]."""
    block = model.encoder.layer[FACET_LAYER]
    part = {"token": block, "key": block.attention.k_proj, "value": block.attention.v_proj}[facet]
    found: list[torch.Tensor] = []
    hook = part.register_forward_hook(lambda _part, _input, output: found.append(output))
    model(pixels)
    hook.remove()
    output = found[0]
    return output[0] if isinstance(output, tuple) else output


def vlad(patches: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """AnyLoc's descriptor of patch tokens [h·w, C]: hard assignment, intra-normalised."""
    unit = torch.nn.functional.normalize
    patches = unit(patches)
    labels = (patches @ unit(centres).T).argmax(dim=1)
    sums = torch.zeros_like(centres)
    for centre in range(len(centres)):
        sums[centre] = (patches[labels == centre] - centres[centre]).sum(dim=0)
    return unit(unit(sums).flatten(), dim=0)


def main() -> None:
    """Writes expected.json and vlad.bin."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of the pictures")
    folder: Path = parser.parse_args().folder
    torch.set_num_threads(1)

    models: dict[str, torch.nn.Module] = {}
    centres = torch.empty(0)
    lines = []
    for name, file, size, resize, facet in CASES:
        if name not in models:
            models = {name: transformers_model(name, random_weights(VARIANTS[name], SEED))}
        picture = Image.open(folder / file).convert("RGB")
        registers = VARIANTS[name].registers
        with torch.inference_mode():
            pixels = fit(picture, size, resize)
            if facet:
                tokens = facet_of(models[name], facet, pixels)
            else:
                tokens = models[name](pixels).last_hidden_state
        vectors = descriptors(tokens, registers)
        if facet == "value":
            patches = tokens[0, 1 + registers :]
            if not len(centres):
                chosen = patches[:: len(patches) // CENTRES][:CENTRES]
                centres = torch.nn.functional.normalize(chosen).half().float()
                (folder / "vlad.bin").write_bytes(centres.half().numpy().astype("<f2").tobytes())
            vectors["vlad"] = vlad(patches, centres)[None]
        for kind, vector in vectors.items():
            entry = {
                "model": name,
                "seed": SEED,
                "width": size[0],
                "height": size[1],
                "resize": resize,
                "facet": f"{facet}-{FACET_LAYER}" if facet else "",
                "kind": kind,
                "picture": file,
                "vector": [float(f"{value:.6g}") for value in vector[0].tolist()],
            }
            lines.append(json.dumps(entry, separators=(",", ":")))
    (folder / "expected.json").write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
