#!/usr/bin/env python3
"""Fit the vocabulary of the built-in model's descriptor `vlad`.

    fit_vlad.py assets/models/xfeat deploy/models/xfeat-vlad.bin FOLDER...

The vocabulary must not know the places that it is to tell apart, so none of the pictures is from a set
that docs/evaluation.md measures. `xfeat-vlad.bin` was fitted with seed 1 and 320 views on these folders, in this order:

    town-1001/map town-1001/frames town-1002/map town-1002/frames
        rendered by `whereabouts demo --offline --model xfeat --places 160 --seed 1001` (and 1002)
    photographs-a
        astronaut, brick, camera, chelsea, coffee, coins, grass, gravel, motorcycle_left and rocket of
        the PyPI package scikit-image 0.26.0 (public domain, CC0 and BSD), china and flower of
        scikit-learn 1.9.1 (CC BY 2.0)
    photographs-b
        backgrounds/mate/nature of the Debian package mate-backgrounds 1.26.0-1 (GPL-2+), and
        lomiri-wallpapers-16.04 and -20.04 20.04.0-2 (CC BY 4.0, CC BY-SA 3.0 and 4.0)

What is kept of them are averages over all pictures, which contain no part of any of them. From each
folder come as many views: whole pictures, then random crops in the model's aspect ratio.

    centres     spherical k-means over cells at unit norm, the same number from each folder
    blocks      for each band and centre, random orthonormal columns: a residual sum of 64 numbers is
                shortened to 8 nearly without changing the cosines between pictures
    projection  the principal directions of the shortened descriptors of all views, each divided by the
                fourth root of its energy: half of whitening

The settings of the descriptor come from `manifest.toml`. Needs numpy, onnxruntime and Pillow. The
output depends on their versions in the last bits, so the file is kept in the repository.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tomllib
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import onnxruntime
from PIL import Image

CELLS_PER_FOLDER = 8000
KMEANS_STEPS = 25
MIN_WEIGHT = 1e-6
CROP = (0.35, 1.0)
LONGEST = 1600


def views(folder: Path, count: int, random: np.random.Generator) -> Iterator[Image.Image]:
    """Whole pictures of a folder, then random crops of 4:3, `count` in all."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".png"))
    if not files:
        sys.exit(f"{folder} has no JPEG or PNG")
    pictures = []
    for index in range(count):
        if index < len(files):
            with Image.open(files[index]) as opened:
                opened.thumbnail((LONGEST, LONGEST))
                pictures.append(opened.convert("RGB"))
        picture = pictures[index % len(files)]
        if index >= len(files):
            width = int(picture.width * random.uniform(*CROP))
            height = min(picture.height, int(width * 0.75))
            x = int(random.integers(0, picture.width - width + 1))
            y = int(random.integers(0, picture.height - height + 1))
            picture = picture.crop((x, y, x + width, y + height))
        yield picture


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors at unit norm; zeros stay zeros."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


class Model:
    """The model and the settings of its descriptor."""

    def __init__(self, folder: Path) -> None:
        self.manifest: dict[str, Any] = tomllib.loads((folder / "manifest.toml").read_text())
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        file = str(folder / self.manifest["file"])
        self.session = onnxruntime.InferenceSession(file, options)

    def run(self, picture: Image.Image) -> tuple[np.ndarray, np.ndarray]:
        """The cells at unit norm [rows, columns, channels] and their reliability."""
        given, output = self.manifest["input"], self.manifest["output"]
        picture = picture.resize((given["width"], given["height"]), Image.Resampling.BICUBIC)
        pixels = (np.asarray(picture, np.float32) / 255 - given["mean"]) / given["std"]
        tensor = pixels.astype(np.float32).transpose(2, 0, 1)[None]
        names = [output["features"], output["reliability"]]
        features, reliability = self.session.run(names, {given["name"]: tensor})
        return unit(features[0].transpose(1, 2, 0)), reliability[0, 0]


def kmeans(cells: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Centres at unit norm, first chosen by k-means++ on the cosine."""
    centres = [cells[random.integers(len(cells))]]
    far = 1 - cells @ centres[0]
    for _ in range(count - 1):
        chance = np.maximum(far, 0).astype(np.float64)
        centres.append(cells[random.choice(len(cells), p=chance / chance.sum())])
        far = np.minimum(far, 1 - cells @ centres[-1])
    found = np.stack(centres)
    for _ in range(KMEANS_STEPS):
        nearest = np.argmax(cells @ found.T, axis=1)
        for k in range(count):
            members = cells[nearest == k]
            found[k] = members.mean(axis=0) if len(members) else cells[random.integers(len(cells))]
        found = unit(found)
    return found


def residual_sums(
    cells: np.ndarray, reliability: np.ndarray, centres: np.ndarray, settings: dict[str, Any]
) -> np.ndarray:
    """The residual sum of each band and centre, at unit norm."""
    rows = settings["rows"]
    height, width, channels = cells.shape
    bands = np.repeat(np.arange(height) * rows // height, width)
    flat = cells.reshape(-1, channels)
    cosines = flat @ centres.T
    shares = np.exp(settings["sharpness"] * (cosines - cosines.max(axis=1, keepdims=True)))
    shares[shares < settings["least_share"]] = 0
    shares /= shares.sum(axis=1, keepdims=True)
    shares *= np.maximum(reliability.reshape(-1, 1), MIN_WEIGHT)
    sums = []
    for band in range(rows):
        part = shares[bands == band]
        sums.append(part.T @ flat[bands == band] - part.sum(axis=0)[:, None] * centres)
    return unit(np.concatenate(sums))


def main() -> None:
    """Fits and writes the vocabulary, and prints its digest."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0],
        epilog="The top of this script names the pictures.",
    )
    parser.add_argument("model", type=Path, help="folder of the model and its manifest.toml")
    parser.add_argument("out", type=Path, help="the vocabulary")
    parser.add_argument("folders", type=Path, nargs="+", help="folders of pictures")
    parser.add_argument("--views", type=int, default=320, help="views of each folder")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    model = Model(arguments.model)
    settings = model.manifest["descriptors"]["vlad"]
    random = np.random.default_rng(arguments.seed)

    everything = []
    sample = []
    for folder in arguments.folders:
        outputs = [model.run(view) for view in views(folder, arguments.views, random)]
        cells = np.concatenate([cells.reshape(-1, cells.shape[-1]) for cells, _ in outputs])
        sample.append(cells[random.choice(len(cells), CELLS_PER_FOLDER, replace=False)])
        everything += [(cells.astype(np.float16), weight) for cells, weight in outputs]
        print(f"{folder}: {len(outputs)} views", file=sys.stderr)
    centres = kmeans(np.concatenate(sample), settings["centres"], random).astype("<f2")

    channels, block = centres.shape[1], settings["block"]
    matrices = [random.normal(size=(channels, block)) for _ in range(settings["rows"] * len(centres))]
    blocks = np.stack([np.linalg.qr(matrix)[0] for matrix in matrices]).astype("<f2")
    shortened = []
    for cells, weight in everything:
        sums = residual_sums(
            cells.astype(np.float32), weight, centres.astype(np.float32), settings
        )
        shortened.append(np.einsum("sc,scd->sd", sums, blocks.astype(np.float32)).reshape(-1))
    joined = unit(np.stack(shortened)).astype(np.float64)
    energy, directions = np.linalg.eigh(joined.T @ joined / len(joined))
    kept = slice(None, -settings["dimension"] - 1, -1)
    projection = (directions[:, kept] * energy[kept] ** -0.25).astype("<f2")

    data = centres.tobytes() + blocks.tobytes() + projection.tobytes()
    arguments.out.write_bytes(data)
    print(hashlib.sha256(data).hexdigest())


if __name__ == "__main__":
    main()
