#!/usr/bin/env python3
"""Index a folder of images, localize the frames of another folder, and print the results."""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from whereabouts_client import Answer, Frame, GeographicPose, Job, MetricPose, Pose, Problem, Whereabouts

PICTURES = {
    *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".gif"),
    *(".pbm", ".pgm", ".ppm", ".pnm", ".pam"),
}


class Failure(Exception):
    """An error that the user can fix."""


def arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="Poses are read from poses.csv in the folder of images, if present: a header with `file` "
        "and lat,lon[,alt,heading] (degrees, metres) or x,y[,z,qx,qy,qz,qw] (metres, unit quaternion). "
        "`whereabouts demo` renders two such folders: demo-out/map and demo-out/frames. "
        "An API key, if required, is read from WHEREABOUTS_API_KEY.",
    )
    parser.add_argument("images", type=Path, help="the folder of reference images")
    parser.add_argument("frames", type=Path, help="the folder of frames to localize")
    parser.add_argument("--map", required=True, help="the map; created if it does not exist")
    parser.add_argument(
        "--server", default="http://localhost:8080", metavar="URL", help="default: %(default)s"
    )
    parser.add_argument(
        "--scene", choices=["outdoor", "indoor"], default="outdoor", help="default: %(default)s"
    )
    parser.add_argument("-k", type=int, default=5, help="candidates per answer; default: %(default)s")
    parser.add_argument(
        "--parallel", type=int, default=4, metavar="N", help="concurrent uploads; default: %(default)s"
    )
    parser.add_argument(
        "--wait",
        type=float,
        default=60,
        metavar="SECONDS",
        help="how long to wait for a job, for an overloaded server, and for a map to be calibrated; "
        "default: %(default)s",
    )
    return parser.parse_args(argv)


def pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise Failure(f"{folder} is not a folder; give one with pictures")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    if not found:
        raise Failure(f"{folder} has no pictures")
    return found


def read_poses(folder: Path) -> dict[str, Pose]:
    """Reads poses.csv; returns poses by file name."""
    path = folder / "poses.csv"
    if not path.exists():
        return {}
    poses: dict[str, Pose] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            try:
                name = row.pop("file")
                numbers = {column: float(text) for column, text in row.items() if text}
                poses[name] = GeographicPose(**numbers) if "lat" in numbers else MetricPose(**numbers)
            except (KeyError, TypeError, ValueError) as error:
                hint = "it needs the columns file,lat,lon[,alt,heading] or file,x,y[,z,qx,qy,qz,qw]"
                raise Failure(f"{path}: invalid row ({error}); {hint}") from error
    return poses


def index(service: Whereabouts, options: argparse.Namespace) -> None:
    images, poses = pictures(options.images), read_poses(options.images)
    metric = any(isinstance(pose, MetricPose) for pose in poses.values())
    frame: Frame = "metric" if metric else "wgs84"
    service.put_map(options.map, scene=options.scene, frame=frame if poses else None)

    def add(path: Path) -> str | None:
        """Adds one image; returns the error, if any."""
        try:
            service.add_image(options.map, path, id=path.name, pose=poses.get(path.name))
        except (Problem, ValueError) as error:
            return f"{path.name}: {error}"
        return None

    began = time.monotonic()
    with ThreadPoolExecutor(options.parallel) as threads:
        failed = [why for why in threads.map(add, images) if why]
    took = time.monotonic() - began
    print(f"indexed {len(images) - len(failed)} of {len(images)} images in {took:.1f} s")
    if failed:
        raise Failure("\n".join([*failed, "run it again: images already in the map are skipped"]))


def wait_for_calibration(service: Whereabouts, options: argparse.Namespace) -> None:
    """Waits for the background calibration of the map; confidence is not measured until then."""
    end = time.monotonic() + options.wait
    while True:
        state = service.map(options.map)
        if state.calibration and state.calibration.images == state.images:
            return
        if time.monotonic() > end:
            print("no confidence is measured yet; run this again later", file=sys.stderr)
            return
        time.sleep(0.2)


def row(frame: str, answer: Answer, job: Job | None) -> str:
    coarse = answer.candidates[0].image_id if answer.candidates else "-"
    refined = job.ranking[0].image_id if job and job.ranking else "-"
    estimate = (job.estimate if job else None) or answer.estimate
    if estimate is None:
        confidence = "-"
    else:
        confidence = "unmeasured" if estimate.confidence is None else f"{estimate.confidence:.2f}"
    if job:
        ended = job.state if not job.error else f"{job.state}: {job.error}"
    else:
        ended = f"none: {answer.no_job.detail}" if answer.no_job else "none"
    ms = answer.timing_ms.total
    return f"{frame:24} {coarse:24} {refined:24} {confidence:>10} {ms:7.1f}  {ended}"


def localize(service: Whereabouts, options: argparse.Namespace) -> None:
    frames = pictures(options.frames)
    answers = [service.localize(options.map, frame, k=options.k) for frame in frames]
    print(f"{'frame':24} {'coarse first':24} {'refined first':24} {'confidence':>10} {'ms':>7}  job")
    unended = 0
    for frame, answer in zip(frames, answers, strict=True):
        job = service.wait_for_job(answer.job.id, options.wait) if answer.job else None
        unended += bool(job and not job.ended)
        print(row(frame.name, answer, job))
    if unended:
        raise Failure(f"{unended} jobs have not ended; see GET /jobs?map={options.map}, or increase --wait")


def main(argv: Sequence[str] | None = None) -> int:
    options = arguments(argv)
    key = os.environ.get("WHEREABOUTS_API_KEY")
    try:
        with Whereabouts(options.server, api_key=key, retry_for_s=options.wait) as service:
            index(service, options)
            wait_for_calibration(service, options)
            localize(service, options)
    except (Failure, Problem, ValueError) as error:
        print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
