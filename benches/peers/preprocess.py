"""Benchmarks turning a JPEG into a 224×224 tensor, on one core.

usage: preprocess.py FOLDER ROUNDS
prints: one line per peer, `NAME MILLISECONDS`: the median over the files of the minimum of ROUNDS
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from torchvision.io import ImageReadMode, decode_jpeg
from torchvision.transforms.v2 import functional as F

SIZE = 224
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
STD = np.array([0.229, 0.224, 0.225], np.float32)


def by_opencv(data, flags=cv2.IMREAD_COLOR):
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    height, width = picture.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    square = picture[top : top + edge, left : left + edge]
    small = cv2.resize(square, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    small = cv2.cvtColor(small, cv2.COLOR_BGR2RGB).astype(np.float32)
    return np.ascontiguousarray((((small / 255) - MEAN) / STD).transpose(2, 0, 1))


def by_opencv_reduced(data):
    """Decodes at half size with OpenCV's reduction in the frequency domain."""
    return by_opencv(data, cv2.IMREAD_REDUCED_COLOR_2)


def by_torchvision(data):
    picture = decode_jpeg(torch.frombuffer(bytearray(data), dtype=torch.uint8), ImageReadMode.RGB)
    picture = F.resize(picture, [SIZE], interpolation=F.InterpolationMode.BICUBIC, antialias=True)
    picture = F.center_crop(picture, [SIZE, SIZE])
    return F.normalize(F.to_dtype(picture, torch.float32, scale=True), MEAN.tolist(), STD.tolist())


def main():
    files = [path.read_bytes() for path in sorted(Path(sys.argv[1]).glob("*.jpg"))]
    rounds = int(sys.argv[2])
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for name, run in {
        "OpenCV": by_opencv,
        "OpenCV-reduced": by_opencv_reduced,
        "torchvision": by_torchvision,
    }.items():
        times = []
        for data in files:
            least = float("inf")
            for _ in range(rounds):
                start = time.perf_counter()
                run(data)
                least = min(least, time.perf_counter() - start)
            times.append(least)
        print(name, f"{np.median(times) * 1e3:.3f}", flush=True)


main()
