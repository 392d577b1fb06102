#!/usr/bin/env python3
"""Compute VLAD descriptors of random features, for the test of the service's own code.

    reference_vlad.py tests/fixtures/vlad

Each case is a file `NAME.json` with the manifest's settings of the descriptor, the output of a model
(`map` or `tokens`), the reliability map and the expected descriptor, and a file `NAME.bin` with the
vocabulary. The descriptor is computed here cell by cell in float64, as the formula reads:

    x_i        the cell i at unit norm; w_i its weight: the reliability, at least 1e-6, or 1
    s_ik       the cosine of x_i and the centre c_k
    a_ik       hard: 1 for the largest s_ik; soft: exp(sharpness · s_ik), without those below
               least_share times the largest, divided by their sum
    v_bk       the sum of w_i · a_ik · (x_i - c_k) over the cells of the band b, at unit norm
    y          all v_bk one after another, each multiplied by its matrix if there is one
    descriptor y, multiplied by the projection if there is one, at unit norm

The case `anyloc` is that of AnyLoc (Keetha et al., 2023): hard assignment, the whole picture, no
weights. Centres are not at unit norm there, as k-means leaves them. It needs only numpy.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

CHANNELS = 6
MIN_WEIGHT = 1e-6

# layout, height, width, registers before the patches, settings
CASES: dict[str, tuple[str, int, int, int, dict[str, Any]]] = {
    "anyloc": ("tokens", 4, 5, 2, {"centres": 5, "rows": 1, "weighting": "none"}),
    "hard": ("map", 5, 4, 0, {"centres": 7, "rows": 2, "weighting": "reliability"}),
    "soft": (
        "map", 5, 3, 0,
        {"centres": 18, "rows": 3, "weighting": "reliability", "sharpness": 4.0, "least_share": 0.3},
    ),
    "short": (
        "map", 6, 7, 0,
        {
            "centres": 17, "rows": 2, "weighting": "reliability", "sharpness": 10.0,
            "least_share": 0.01, "block": 3, "dimension": 11,
        },
    ),
    "projected": (
        "tokens", 3, 3, 0,
        {"centres": 3, "rows": 1, "weighting": "none", "sharpness": 5.0, "dimension": 8},
    ),
}


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector at unit norm; zeros stay zeros."""
    length = float(np.sqrt((vector**2).sum()))
    return vector / length if length > 1e-12 else vector * 0


def shares(cosines: np.ndarray, settings: dict[str, Any]) -> np.ndarray:
    """How much of a cell each centre gets."""
    if "sharpness" not in settings:
        return (np.arange(len(cosines)) == cosines.argmax()).astype(float)
    parts = np.exp(settings["sharpness"] * cosines)
    parts[parts < settings["least_share"] * parts.max()] = 0
    return parts / parts.sum()


def vlad(
    cells: np.ndarray, weights: np.ndarray, vocabulary: list[np.ndarray], settings: dict[str, Any]
) -> np.ndarray:
    """The descriptor of cells [height, width, CHANNELS]."""
    centres, blocks, projection = vocabulary
    height, width, _ = cells.shape
    sums = np.zeros((settings["rows"], len(centres), CHANNELS))
    for row in range(height):
        band = row * settings["rows"] // height
        for column in range(width):
            cell = unit(cells[row, column])
            cosines = np.array([cell @ unit(centre) for centre in centres])
            for k, share in enumerate(shares(cosines, settings)):
                sums[band, k] += weights[row, column] * share * (cell - centres[k])
    parts = []
    for band in range(settings["rows"]):
        for k in range(len(centres)):
            part = unit(sums[band, k])
            parts.append(part @ blocks[band * len(centres) + k] if blocks.size else part)
    joined = np.concatenate(parts)
    return unit(joined @ projection if projection.size else joined)


def make(name: str, seed: int, folder: Path) -> None:
    """Writes one case."""
    layout, height, width, registers, settings = CASES[name]
    random = np.random.default_rng(seed)
    settings = {"least_share": 0.05, **settings}
    rows, centres = settings["rows"], settings["centres"]
    block = settings.get("block")
    expanded = rows * centres * (block or CHANNELS)
    settings.setdefault("dimension", expanded)

    def numbers(*shape: int) -> np.ndarray:
        return random.normal(size=shape).astype("<f2")

    vocabulary = [
        numbers(centres, CHANNELS),
        numbers(rows * centres, CHANNELS, block) if block else numbers(0),
        numbers(expanded, settings["dimension"]) if settings["dimension"] < expanded else numbers(0),
    ]
    (folder / f"{name}.bin").write_bytes(b"".join(part.tobytes() for part in vocabulary))

    cells = random.normal(size=(height, width, CHANNELS)).astype(np.float32)
    cells[0, 1] = 0  # a cell without a direction counts for nothing
    reliability = random.uniform(size=(height, width)).astype(np.float32)
    reliability[height - 1, 0] = 0
    if settings["weighting"] == "reliability":
        weights = np.maximum(reliability.astype(float), MIN_WEIGHT)
    else:
        weights = np.ones((height, width))
    weights[0, 1] = 0
    if layout == "map":
        output = cells.transpose(2, 0, 1).reshape(-1)
    else:
        leading = 100 * random.normal(size=((1 + registers) * CHANNELS)).astype(np.float32)
        output = np.concatenate([leading, cells.reshape(-1)])
    expected = vlad(
        cells.astype(float), weights, [part.astype(float) for part in vocabulary], settings
    )
    case = {
        "descriptor": {"file": f"{name}.bin", **settings},
        "layout": layout, "height": height, "width": width,
        "channels": CHANNELS, "registers": registers,
        "output": [round(float(x), 6) for x in output],
        "reliability": [round(float(x), 6) for x in reliability.reshape(-1)],
        "expected": [round(float(x), 7) for x in expected],
    }
    (folder / f"{name}.json").write_text(json.dumps(case) + "\n", encoding="utf-8")


def main() -> None:
    """Writes all cases."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").partition("\n")[0],
        epilog="The top of this script describes the files.",
    )
    parser.add_argument("folder", type=Path, help="output folder")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(CASES):
        make(name, seed, folder)


if __name__ == "__main__":
    main()
