"""Tests of the localizer with a fake client, and of the node with stubs of ROS."""

from __future__ import annotations

import importlib
import io
import json
import math
import sys
import threading
import time
import types
import unittest
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any
from unittest import mock

import localizer
from localizer import (
    MOST_READINGS,
    UNKNOWN_VARIANCE,
    Localizer,
    Newest,
    Odometer,
    Origin,
    PoseWithCovariance,
    Refused,
    Shot,
    Spread,
    Wishes,
    encode,
    instant,
    origin_of,
    pose_with_covariance,
)
from whereabouts_client import (
    Answer,
    Candidate,
    Estimate,
    GeographicPose,
    Job,
    JobLink,
    MetricPose,
    NoJob,
    Pose,
    Problem,
    RankedCandidate,
    RefineMode,
    RelativePose,
    TimingMs,
    TrackEstimate,
    Usage,
)

HALF = math.sqrt(0.5)


def estimate(pose: Pose | None, known: bool = True) -> Estimate:
    return Estimate("first", 0.95, known, pose)


def candidates(*poses: tuple[Pose | None, float]) -> list[Candidate]:
    return [
        Candidate(rank, f"image-{rank}", similarity, pose)
        for rank, (pose, similarity) in enumerate(poses, start=1)
    ]


def block(pose: PoseWithCovariance, start: int) -> list[list[float]]:
    """The covariance of the position (0) or of the orientation (3)."""
    rows = [pose.covariance[6 * row : 6 * row + 6] for row in range(start, start + 3)]
    return [list(row[start : start + 3]) for row in rows]


class Covariance(unittest.TestCase):
    def given(
        self, pose: Pose, others: list[Candidate], origin: Origin | None = None, **spread: float
    ) -> PoseWithCovariance:
        found = pose_with_covariance(estimate(pose), others, origin, Spread(**spread))
        assert found
        self.assertEqual(len(found.covariance), 36)
        for row in range(6):
            for column in range(6):
                self.assertEqual(found.covariance[6 * row + column], found.covariance[6 * column + row])
        return found

    def test_agreeing_candidates_have_the_covariance_of_one_place(self) -> None:
        here = MetricPose(1, 2, 3, 0, 0, 0, 1)
        found = self.given(here, candidates((here, 0.9), (here, 0.8)), place_m=2, turn_rad=0.1)
        self.assertEqual((found.position, found.orientation), ((1, 2, 3), (0, 0, 0, 1)))
        for start, variance in ((0, 4.0), (3, 0.01)):
            for i, row in enumerate(block(found, start)):
                for j, value in enumerate(row):
                    self.assertAlmostEqual(value, variance if i == j else 0)

    def test_candidates_are_weighted_by_similarity(self) -> None:
        # The second has 1/e of the first one's weight, and is 3 m east and 4 m north of it.
        others = candidates((MetricPose(0, 0, 0), 0.90), (MetricPose(3, 4, 0), 0.85))
        found = self.given(MetricPose(0, 0, 0), others, place_m=1, similarity_scale=0.05)
        share = math.exp(-1) / (1 + math.exp(-1))
        position = block(found, 0)
        self.assertAlmostEqual(position[0][0], 1 + 9 * share)
        self.assertAlmostEqual(position[1][1], 1 + 16 * share)
        self.assertAlmostEqual(position[0][1], 12 * share)
        self.assertAlmostEqual(position[2][2], 1)

    def test_the_covariance_is_around_the_estimate_not_the_mean(self) -> None:
        # A refined estimate far from all similar candidates has a large covariance.
        others = candidates((MetricPose(0, 0, 0), 0.9), (MetricPose(0, 0, 0), 0.9))
        found = self.given(MetricPose(10, 0, 0), others, place_m=1)
        self.assertAlmostEqual(block(found, 0)[0][0], 101)

    def test_candidates_without_a_pose_are_left_out(self) -> None:
        others = candidates((None, 0.99), (MetricPose(0, 2, 0), 0.5))
        found = self.given(MetricPose(0, 0, 0), others, place_m=1)
        self.assertAlmostEqual(block(found, 0)[1][1], 5)
        self.assertIsNone(pose_with_covariance(estimate(None), others))

    def test_unknown_values_have_a_large_variance(self) -> None:
        others = candidates((MetricPose(0, 1, 7, 0, 0, 0, 1), 0.9))
        found = self.given(MetricPose(0, 0), others, place_m=1)
        self.assertEqual(found.position, (0, 0, 0))
        self.assertEqual(found.orientation, (0, 0, 0, 1))
        self.assertEqual(block(found, 0)[2], [0, 0, UNKNOWN_VARIANCE])
        unknown = UNKNOWN_VARIANCE
        self.assertEqual(block(found, 3), [[unknown, 0, 0], [0, unknown, 0], [0, 0, unknown]])

    def test_orientations_differ_by_the_shorter_rotation(self) -> None:
        # A quarter turn about z, the same with opposite sign, and no turn.
        quarter = MetricPose(0, 0, 0, 0, 0, -HALF, -HALF)
        others = candidates((MetricPose(0, 0, 0, 0, 0, 0, 1), 0.9), (quarter, 0.9))
        found = self.given(MetricPose(0, 0, 0, 0, 0, HALF, HALF), others, turn_rad=0.1)
        turns = block(found, 3)
        self.assertAlmostEqual(turns[2][2], 0.01 + (math.pi / 2) ** 2 / 2)
        self.assertAlmostEqual(turns[0][0], 0.01)

    def test_rotations_are_about_the_fixed_axes(self) -> None:
        # Yawed by a quarter turn, then rolled about the camera's own x axis, which is the fixed y axis.
        yawed = (0.0, 0.0, HALF, HALF)
        rolled = (0.5, 0.5, 0.5, 0.5)
        turn = localizer._rotation_vector(yawed, rolled)
        for value, expected in zip(turn, (0, math.pi / 2, 0), strict=True):
            self.assertAlmostEqual(value, expected)
        # The same orientation has two quaternions.
        eighth = (0.0, 0.0, -math.sin(math.pi / 8), -math.cos(math.pi / 8))
        self.assertAlmostEqual(localizer._rotation_vector((0, 0, 0, 1), eighth)[2], math.pi / 4)


class Globe(unittest.TestCase):
    ORIGIN = Origin(45.0, -30.0, 100.0)

    def test_degrees_become_metres_east_north_and_up(self) -> None:
        # At 45° a degree of latitude is 111,131.8 m and one of longitude 78,846.8 m (WGS84).
        for pose, expected in [
            (GeographicPose(45.001, -30.0, 100.0), (0, 111.132, 0)),
            (GeographicPose(45.0, -29.999, 100.0), (78.847, 0, 0)),
            (GeographicPose(45.0, -30.0, 112.5), (0, 0, 12.5)),
        ]:
            position = localizer.place(pose, self.ORIGIN).position
            for value, wanted in zip(position, expected, strict=True):
                self.assertAlmostEqual(value, wanted, delta=0.01)

    def test_a_heading_becomes_a_yaw_with_unknown_roll_and_pitch(self) -> None:
        for heading, (z, w) in {90.0: (0, 1), 0.0: (HALF, HALF), 180.0: (-HALF, HALF)}.items():
            found = pose_with_covariance(estimate(GeographicPose(45, -30, None, heading)), [], self.ORIGIN)
            assert found
            self.assertAlmostEqual(found.orientation[2], z)
            self.assertAlmostEqual(found.orientation[3], w)
            turns = block(found, 3)
            self.assertEqual([turns[0][0], turns[1][1]], [UNKNOWN_VARIANCE] * 2)
            self.assertAlmostEqual(turns[2][2], Spread().turn_rad ** 2)
            self.assertEqual(found.position[2], 0)
            self.assertEqual(block(found, 0)[2][2], UNKNOWN_VARIANCE)

    def test_geographic_poses_without_an_origin_are_refused(self) -> None:
        with self.assertRaisesRegex(Refused, "origin_lat"):
            pose_with_covariance(estimate(GeographicPose(45, -30)), [])

    def test_an_origin_for_a_metric_map_is_refused(self) -> None:
        with self.assertRaisesRegex(Refused, "unset"):
            pose_with_covariance(estimate(MetricPose(1, 2)), [], self.ORIGIN)

    def test_an_invalid_origin_is_refused(self) -> None:
        nan = math.nan
        self.assertIsNone(origin_of(nan, nan, nan))
        self.assertEqual(origin_of(45, -30, nan), Origin(45, -30, 0))
        for lat, lon in ((45, nan), (nan, 7), (91, 0), (0, 181)):
            with self.assertRaises(Refused):
                origin_of(lat, lon, nan)


def at(seconds: float) -> datetime:
    return datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc) + timedelta(seconds=seconds)


def driven(start: float, end: float, speed_m_s: float = 10.0) -> Odometer:
    """An odometer of a robot that drives along x, with a reading every 0.1 s."""
    odometer = Odometer()
    for tenth in range(round(start * 10), round(end * 10) + 1):
        odometer.add(at(tenth / 10), (tenth / 10 * speed_m_s, 0.0, 0.0))
    return odometer


class Odometry(unittest.TestCase):
    def metres(self, odometer: Odometer, start: float, end: float, expected: float | None) -> None:
        found = odometer.metres(at(start), at(end))
        if found is None or expected is None:
            self.assertEqual(found, expected)
        else:
            self.assertAlmostEqual(found, expected)

    def test_a_stamp_is_a_time_and_zero_is_none(self) -> None:
        self.assertIsNone(instant(0, 0))
        moment = instant(1_767_323_045, 250_000_999)
        self.assertEqual(moment, at(0.25))
        assert moment
        self.assertEqual(moment.isoformat(), "2026-01-02T03:04:05.250000+00:00")

    def test_the_distance_is_the_path_length_not_the_straight_line(self) -> None:
        odometer = Odometer()
        for second, position in enumerate([(0, 0, 0), (3, 4, 0), (3, 4, 2), (0, 0, 0)]):
            odometer.add(at(second), position)
        self.metres(odometer, 0, 3, 5 + 2 + math.sqrt(29))

    def test_distances_are_interpolated_between_readings(self) -> None:
        odometer = driven(0, 2)
        self.metres(odometer, 0.5, 1.25, 7.5)
        self.metres(odometer, 0.51, 0.53, 0.2)
        self.metres(odometer, 1, 1, 0)
        # A frame before the last one: the same distance in the other direction.
        self.metres(odometer, 1.25, 0.5, 7.5)

    def test_times_outside_the_readings_are_unknown(self) -> None:
        self.metres(Odometer(), 0, 1, None)
        odometer = driven(1, 2)
        self.metres(odometer, 0.95, 1.5, None)
        self.metres(odometer, 1.5, 2.25, None)
        self.metres(odometer, 1, 2, 10)
        # The reading after the frame has not arrived yet.
        self.metres(odometer, 1.5, 2.15, 5)

    def test_a_gap_starts_a_new_path(self) -> None:
        odometer = driven(0, 1)
        for seconds in (2.0, 4.0, 5.0):
            odometer.add(at(seconds), (10 * seconds, 0, 0))
        self.metres(odometer, 1, 4, None)
        self.metres(odometer, 4, 5, 10)

    def test_an_odometry_reset_starts_a_new_path(self) -> None:
        odometer = driven(0, 1)
        for seconds, x in ((1.1, 500_000.0), (1.2, 500_001.0)):
            odometer.add(at(seconds), (x, 0, 0))
        self.metres(odometer, 1, 1.2, None)
        self.metres(odometer, 1.1, 1.2, 1)

    def test_a_relative_pose_is_in_the_axes_of_the_robot(self) -> None:
        odometer = Odometer()
        # It drives north, and turns to the left: from north to west.
        for tenth in range(11):
            yaw = math.radians(90 + 9 * tenth)
            turn = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
            odometer.add(at(tenth / 10), (5.0, tenth / 10, 0.0), turn)
        moved = odometer.relative_pose(at(0), at(1))
        assert moved
        self.assertAlmostEqual(moved.dx, 1)
        self.assertAlmostEqual(moved.dy, 0)
        self.assertAlmostEqual(moved.dyaw, math.pi / 2)
        half = odometer.relative_pose(at(0), at(0.55))
        assert half
        self.assertAlmostEqual(half.dyaw, math.pi / 2 * 0.55)
        self.assertIsNone(odometer.relative_pose(at(-1), at(1)))
        self.assertIsNone(driven(0, 1).relative_pose(at(0), at(1)))

    def test_late_and_invalid_readings_are_dropped(self) -> None:
        odometer = driven(0, 1)
        odometer.add(at(0.45), (900, 0, 0))
        odometer.add(at(1), (900, 0, 0))
        odometer.add(at(1.05), (math.nan, 0, 0))
        odometer.add(at(1.1), (11, 0, 0))
        self.metres(odometer, 0, 1.1, 11)

    def test_a_clock_set_back_starts_a_new_path(self) -> None:
        odometer = driven(100, 101)
        for seconds in (1.0, 1.5):
            odometer.add(at(seconds), (10 * seconds, 0, 0))
        self.metres(odometer, 100, 101, None)
        self.metres(odometer, 1, 1.5, 5)

    def test_the_number_of_readings_is_bounded(self) -> None:
        end = MOST_READINGS / 10 + 5
        odometer = driven(0, end)
        self.assertEqual(len(odometer._readings), MOST_READINGS)
        self.metres(odometer, 0, end, None)
        self.metres(odometer, 6, end, 10 * (end - 6))


class Encoding(unittest.TestCase):
    def setUp(self) -> None:
        try:
            import PIL.Image
        except ImportError:
            self.skipTest("Pillow is not installed")
        self.pil: Any = PIL.Image

    def test_raw_images_become_jpegs_of_the_same_colours(self) -> None:
        red_in_rows_with_padding = (b"\xff\x00\x00" * 16 + b"??") * 8
        blue_first = (b"\x00\x00\xff" * 16 + b"??") * 8
        for encoding, data in (("rgb8", red_in_rows_with_padding), ("bgr8", blue_first)):
            picture = self.pil.open(io.BytesIO(encode(encoding, 16, 8, 50, data)))
            self.assertEqual((picture.format, picture.size, picture.mode), ("JPEG", (16, 8), "RGB"))
            for value, wanted in zip(picture.getpixel((12, 6)), (255, 0, 0), strict=True):
                self.assertAlmostEqual(value, wanted, delta=6)
        grey = self.pil.open(io.BytesIO(encode("mono8", 16, 8, 16, b"\x80" * 128 + b"more")))
        self.assertEqual(grey.mode, "L")
        self.assertAlmostEqual(grey.getpixel((3, 3)), 128, delta=2)

    def test_an_image_that_cannot_be_encoded_is_refused(self) -> None:
        with self.assertRaisesRegex(Refused, "bayer_rggb8"):
            encode("bayer_rggb8", 4, 4, 4, b"\0" * 16)
        with self.assertRaisesRegex(Refused, "11 bytes are not"):
            encode("rgb8", 2, 2, 6, b"\0" * 11)

    def test_a_missing_pillow_is_explained(self) -> None:
        with mock.patch.dict(sys.modules, {"PIL": None}), self.assertRaisesRegex(Refused, "python3-pil"):
            encode("mono8", 1, 1, 1, b"\0")


def answer(number: int, known: bool = True, job: bool = True, pose: Pose | None = None) -> Answer:
    at = pose or MetricPose(float(number), 0.0)
    return Answer(
        f"query-{number}",
        "town",
        "xfeat",
        tuple(candidates((at, 0.9))),
        TimingMs(1, 1, 1, 3),
        estimate(at, known),
        JobLink(f"job-{number}", f"/jobs/job-{number}", "queued") if job else None,
        None if job else NoJob("overload", "too much to do"),
    )


def job(id: str, state: Any = "succeeded") -> Job:
    at = MetricPose(0.0, 5.0)
    moment = datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc)
    ended = state == "succeeded"
    return Job(
        id, "town", id.replace("job", "query"), "local", state, moment, 1, (), Usage(0, 0, 0, 0),
        ranking=(RankedCandidate(1, "image-1", 1, at),) if ended else None,
        estimate=estimate(at) if ended else None,
    )  # fmt: skip


def tracked(number: int, known: bool = True, pose: Pose | None = None) -> Answer:
    """An answer whose track places the robot elsewhere."""
    track = TrackEstimate("robot-7", number, 0.9, known, "first", pose or MetricPose(0.0, float(number)))
    return replace(answer(number), track=track)


class Client:
    """A fake client that answers when permitted and records its calls."""

    def __init__(self) -> None:
        self.asked: list[tuple[bytes, int | None, str, int | None]] = []
        self.steps: list[tuple[str | None, datetime | None, float | None]] = []
        """Track, time and distance of each frame."""
        self.waited: list[str] = []
        self.may_answer = threading.Semaphore(0)
        self.moved: list[RelativePose | None] = []
        self.answers: Callable[[int], Answer] = answer
        self.jobs: Callable[[str], Job] = job

    def localize(
        self,
        map: str,
        frame: bytes,
        *,
        k: int | None,
        refine: RefineMode,
        deadline_ms: int | None,
        track: str | None,
        captured_at: datetime | None,
        moved_m: float | None,
        moved: RelativePose | None,
    ) -> Answer:
        assert map == "town"
        self.steps.append((track, captured_at, moved_m))
        self.moved.append(moved)
        self.asked.append((frame, k, refine, deadline_ms))
        assert self.may_answer.acquire(timeout=10)
        return self.answers(len(self.asked))

    def wait_for_job(self, id: str, timeout_s: float) -> Job:
        self.waited.append(id)
        return self.jobs(id)


class Told:
    """A sink that records the results."""

    def __init__(self) -> None:
        self.poses: list[tuple[int, PoseWithCovariance]] = []
        self.refined_poses: list[tuple[int, PoseWithCovariance]] = []
        self.tracked_poses: list[tuple[int, PoseWithCovariance]] = []
        self.jobs: list[dict[str, Any]] = []
        self.troubles: list[str] = []

    def coarse(self, stamp: int, pose: PoseWithCovariance) -> None:
        self.poses.append((stamp, pose))

    def refined(self, stamp: int, pose: PoseWithCovariance) -> None:
        self.refined_poses.append((stamp, pose))

    def tracked(self, stamp: int, pose: PoseWithCovariance) -> None:
        self.tracked_poses.append((stamp, pose))

    def job(self, text: str) -> None:
        self.jobs.append(json.loads(text))

    def trouble(self, text: str) -> None:
        self.troubles.append(text)


class WithLocalizer(unittest.TestCase):
    def start(self, wishes: Wishes | None = None, odometer: Odometer | None = None) -> None:
        self.client, self.told = Client(), Told()
        self.localizer: Localizer[int] = Localizer(self.client, wishes or Wishes("town"), self.told, odometer)
        self.addCleanup(self.localizer.close)

    def offer(self, number: int) -> None:
        self.localizer.offer(Shot(number, lambda: b"frame %d" % number))

    def until(self, holds: Callable[[], object]) -> None:
        end = time.monotonic() + 10
        while not holds():
            if time.monotonic() > end:
                self.fail(f"timed out; received: {vars(self.told)}, asked: {self.client.asked}")
            time.sleep(0.002)


class Frames(WithLocalizer):
    def test_only_the_newest_frame_is_posted_and_the_others_are_counted(self) -> None:
        self.start(Wishes("town", k=3, deadline_ms=400))
        self.offer(1)
        self.until(lambda: len(self.client.asked) == 1)
        for number in (2, 3, 4):
            self.offer(number)
        self.client.may_answer.release(2)
        self.until(lambda: len(self.told.poses) == 2)
        self.assertEqual(
            self.client.asked, [(b"frame 1", 3, "async", 400), (b"frame 4", 3, "async", 400)]
        )
        self.assertEqual([stamp for stamp, _ in self.told.poses], [1, 4])
        self.assertEqual((self.localizer.dropped, self.localizer.posted), (2, 2))

    def test_a_job_and_its_pose_are_published_with_the_stamp_of_the_frame(self) -> None:
        self.start()
        self.offer(7)
        self.client.may_answer.release()
        self.until(lambda: self.told.refined_poses)
        (stamp, pose), = self.told.refined_poses
        self.assertEqual((stamp, pose.position), (7, (0, 5, 0)))
        # The most similar candidate is elsewhere, which the covariance shows.
        self.assertAlmostEqual(block(pose, 0)[1][1], Spread().place_m ** 2 + 25)
        (told,) = self.told.jobs
        self.assertEqual((told["id"], told["state"]), ("job-1", "succeeded"))
        self.assertEqual(told["ranking"][0]["pose"], {"x": 0.0, "y": 5.0})
        self.assertEqual(told["created_at"], "2026-01-02T03:04:05+00:00")

    def test_an_unfinished_job_gives_no_pose(self) -> None:
        self.start()
        self.client.jobs = lambda id: job(id, "running")
        self.offer(1)
        self.client.may_answer.release()
        self.until(lambda: self.told.jobs)
        self.assertEqual(self.told.jobs[0]["state"], "running")
        self.localizer.close()
        self.assertEqual(self.told.refined_poses, [])

    def test_jobs_do_not_delay_frames(self) -> None:
        self.start()
        go_on = threading.Event()
        self.addCleanup(go_on.set)

        def slow(id: str) -> Job:
            assert go_on.wait(10)
            return job(id)

        self.client.jobs = slow
        for number in (1, 2, 3):
            self.offer(number)
            self.client.may_answer.release()
            self.until(lambda number=number: len(self.told.poses) == number)  # type: ignore[misc]
            self.until(lambda: self.client.waited)
        go_on.set()
        self.until(lambda: len(self.told.jobs) == 2)
        self.assertEqual([told["id"] for told in self.told.jobs], ["job-1", "job-3"])
        self.assertEqual(self.localizer.unfollowed, 1)

    def test_an_unknown_place_gives_no_pose_unless_configured(self) -> None:
        for only_known, poses in ((True, 0), (False, 1)):
            self.start(Wishes("town", only_known=only_known, refine=False))
            self.client.answers = lambda number: answer(number, known=False, job=False)
            self.offer(1)
            self.client.may_answer.release()
            self.until(lambda: self.told.troubles)
            self.localizer.close()
            self.assertEqual(len(self.told.poses), poses)
            self.assertEqual(self.client.asked[0][2], "off")
            self.assertEqual(self.told.troubles, ["no refinement: too much to do"])

    def test_it_continues_after_errors(self) -> None:
        self.start()

        def refused(number: int) -> Answer:
            if number == 1:
                raise Problem(429, "Overloaded", "drop the frame", retry_after_s=1)
            if number == 2:
                return answer(number, pose=GeographicPose(45, -30))
            return answer(number)

        self.client.answers = refused
        for number in (1, 2, 3):
            self.client.may_answer.release()
            self.offer(number)
            self.until(lambda number=number: len(self.told.troubles) + len(self.told.poses) >= number)  # type: ignore[misc]
        self.until(lambda: self.told.poses)
        self.assertEqual(self.told.poses[0][0], 3)
        self.assertIn("429 Overloaded: drop the frame", self.told.troubles)
        self.assertTrue(any("origin_lat" in trouble for trouble in self.told.troubles))

    def test_a_frame_that_cannot_be_encoded_is_reported_and_not_posted(self) -> None:
        self.start()

        def broken() -> bytes:
            raise Refused("cannot be encoded")

        self.localizer.offer(Shot(1, broken))
        self.until(lambda: self.told.troubles == ["cannot be encoded"])
        self.assertEqual((self.localizer.posted, self.client.asked), (0, []))

    def test_no_frame_is_posted_after_close(self) -> None:
        newest: Newest[int] = Newest()
        newest.put(1)
        newest.close()
        self.assertIsNone(newest.take())


class Tracks(WithLocalizer):
    """Frames of a robot that drives at 10 m/s; frame n is taken n seconds after the start."""

    def setUp(self) -> None:
        self.start(Wishes("town", track="robot-7"), driven(0, 10))
        self.client.answers = tracked

    def frame(self, number: int, taken_at: datetime | None = None) -> None:
        """Offers a frame and waits until it is processed."""
        before = len(self.told.poses) + len(self.told.troubles)
        self.client.may_answer.release()
        self.localizer.offer(Shot(number, lambda: b"frame", taken_at or at(number)))
        self.until(lambda: len(self.told.poses) + len(self.told.troubles) > before)

    def ways(self) -> list[float | None]:
        return [None if way is None else round(way, 6) for _, _, way in self.client.steps]

    def failing(self, *problems: Problem | None) -> None:
        """Sets the answer to every frame."""

        def answers(number: int) -> Answer:
            if number <= len(problems) and (problem := problems[number - 1]):
                raise problem
            return tracked(number)

        self.client.answers = answers

    def test_without_a_track_no_time_or_distance_is_sent(self) -> None:
        self.start(Wishes("town"), driven(0, 10))
        for number in (1, 2):
            self.frame(number)
        self.assertEqual(self.client.steps, [(None, None, None)] * 2)
        self.assertEqual(self.told.tracked_poses, [])

    def test_frames_of_a_track_carry_their_time_and_the_distance_since_the_previous_one(self) -> None:
        for number in (1, 2, 5):
            self.frame(number)
        times = [("robot-7", at(number)) for number in (1, 2, 5)]
        self.assertEqual([(track, taken) for track, taken, _ in self.client.steps], times)
        self.assertEqual(self.ways(), [None, 10, 30])

    def test_without_odometry_no_distance_is_sent(self) -> None:
        self.start(Wishes("town", track="robot-7"))
        self.client.answers = tracked
        for number in (1, 2):
            self.frame(number)
        self.assertEqual(self.client.steps, [("robot-7", at(1), None), ("robot-7", at(2), None)])

    def test_after_a_rejected_frame_the_distance_is_from_the_last_frame_in_the_track(self) -> None:
        self.failing(None, Problem(429, "Overloaded", "drop the frame"), None)
        for number in (1, 2, 3, 4):
            self.frame(number)
        self.assertEqual(self.ways(), [None, 10, 20, 10])

    def test_after_a_frame_of_unknown_outcome_one_frame_has_no_distance(self) -> None:
        for status in (0, 500, 504):
            with self.subTest(status):
                self.setUp()
                self.failing(None, Problem(status, "No answer", "try again"))
                for number in (1, 2, 3, 4):
                    self.frame(number)
                self.assertEqual(self.ways(), [None, 10, None, 10])

    def test_a_frame_that_was_not_posted_is_not_in_the_track(self) -> None:
        def broken() -> bytes:
            raise Refused("cannot be encoded")

        self.frame(1)
        self.localizer.offer(Shot(2, broken, at(2)))
        self.until(lambda: self.told.troubles)
        self.frame(3)
        self.assertEqual(self.ways(), [None, 20])

    def test_a_frame_without_a_time_and_the_next_one_have_no_distance(self) -> None:
        self.frame(1)
        self.client.may_answer.release()
        self.localizer.offer(Shot(2, lambda: b"frame"))
        self.until(lambda: len(self.told.poses) == 2)
        for number in (3, 4):
            self.frame(number)
        self.assertEqual([taken for _, taken, _ in self.client.steps], [at(1), None, at(3), at(4)])
        self.assertEqual(self.ways(), [None, None, None, 10])

    def test_beyond_the_odometry_the_distance_is_unknown(self) -> None:
        for number in (9, 10, 11):
            self.frame(number)
        self.assertEqual(self.ways(), [None, 10, None])

    def test_the_pose_of_the_track_is_published_in_addition_to_that_of_the_frame(self) -> None:
        self.frame(3, at(0))
        self.until(lambda: self.told.tracked_poses)
        (stamp, pose), = self.told.tracked_poses
        self.assertEqual((stamp, pose.position), (3, (0, 1, 0)))
        self.assertEqual(self.told.poses[0][1].position, (1, 0, 0))
        # The frame's candidate is elsewhere, which the covariance shows.
        self.assertAlmostEqual(block(pose, 0)[0][0], Spread().place_m ** 2 + 1)

    def test_an_unknown_place_of_a_track_gives_no_pose_unless_configured(self) -> None:
        for only_known, poses in ((True, 0), (False, 1)):
            self.start(Wishes("town", track="robot-7", only_known=only_known))
            self.client.answers = lambda number: tracked(number, known=False)
            self.frame(1)
            self.localizer.close()
            self.assertEqual((len(self.told.poses), len(self.told.tracked_poses)), (1, poses))

    def test_a_track_without_a_likely_image_gives_no_pose_and_no_error(self) -> None:
        self.start(Wishes("town", track="robot-7", only_known=False))
        self.client.answers = lambda number: replace(
            answer(number), track=TrackEstimate("robot-7", number, 0.0, False)
        )
        self.frame(1)
        self.localizer.close()
        self.assertEqual((self.told.tracked_poses, self.told.troubles), ([], []))

    def test_an_invalid_track_id_is_refused_at_once(self) -> None:
        for id in ("r", "Robot-7_a.b:c", "x" * 64):
            self.assertEqual(Wishes("town", track=id).track, id)
        for id in ("", "robot 7", "x" * 65, "röbot", "robot-7\n"):
            with self.assertRaisesRegex(Refused, "1 to 64"):
                Wishes("town", track=id)


class Anything(types.SimpleNamespace):
    """A message stub that has every attribute."""

    def __getattr__(self, name: str) -> Anything:
        value = Anything()
        setattr(self, name, value)
        return value


class StubNode:
    """The part of rclpy.node.Node that the node uses."""

    settings: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.declared: dict[str, Any] = {}
        self.subscriptions: dict[str, Callable[[Any], None]] = {}
        self.published: dict[str, list[Any]] = {}
        self.warnings: list[str] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        self.declared[name] = self.settings.get(name, default)
        return Anything(value=self.declared[name])

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return Anything(publish=self.published.setdefault(topic, []).append)

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
        self.subscriptions[topic] = callback

    def create_timer(self, seconds: float, callback: Any) -> None:
        self.timer = callback

    def get_logger(self) -> Any:
        return Anything(warning=lambda text, **_: self.warnings.append(text), info=self.warnings.append)


def stubs() -> dict[str, Any]:
    """Stub modules of ROS."""
    messages = dict.fromkeys(
        ["Time", "PoseWithCovarianceStamped", "CompressedImage", "Image", "Odometry", "String"], Anything
    )
    names = ["rclpy", "rclpy.node", "rclpy.qos"]
    packages = ("geometry", "nav", "sensor", "std")
    names += [f"{package}_msgs{part}" for package in packages for part in ("", ".msg")]
    names += ["builtin_interfaces", "builtin_interfaces.msg"]
    modules = {name: types.ModuleType(name) for name in names}
    for module in modules.values():
        vars(module).update(messages, Node=StubNode, qos_profile_sensor_data="sensor data")
    return modules


class NodeWithStubs(unittest.TestCase):
    """Tests the node against stubs of ROS, which does not prove that it runs in ROS."""

    def node(self, **settings: Any) -> Any:
        client = Client()
        client.may_answer.release(3)
        modules = mock.patch.dict(sys.modules, stubs())
        modules.start()
        self.addCleanup(modules.stop)
        sys.modules.pop("whereabouts_node", None)
        shell = importlib.import_module("whereabouts_node")
        self.addCleanup(sys.modules.pop, "whereabouts_node", None)
        connect = mock.Mock(return_value=client)
        client.close = lambda: None  # type: ignore[attr-defined]
        for patch in (
            mock.patch.object(shell, "Whereabouts", connect),
            mock.patch.object(StubNode, "settings", settings),
        ):
            patch.start()
            self.addCleanup(patch.stop)
        node = shell.WhereaboutsNode()
        self.addCleanup(node.close)
        self.client, self.connect = client, connect
        return node

    def until(self, holds: Callable[[], object]) -> None:
        end = time.monotonic() + 10
        while not holds():
            self.assertLess(time.monotonic(), end, "never came")
            time.sleep(0.002)

    def test_a_compressed_frame_becomes_a_pose_and_a_job(self) -> None:
        node = self.node(frame_id="world", k=4, server_url="http://robot:1")
        self.assertEqual(self.connect.call_args.args, ("http://robot:1",))
        stamp = Anything(sec=12, nanosec=0)
        node.subscriptions["image/compressed"](Anything(header=Anything(stamp=stamp), data=[1, 2, 3]))
        self.until(lambda: node.published["~/refined_pose"] and node.published["~/job"])
        self.assertEqual(self.client.asked, [(b"\1\2\3", 4, "async", 2000)])
        (message,) = node.published["~/pose"]
        self.assertIs(message.header.stamp, stamp)
        self.assertEqual(message.header.frame_id, "world")
        position = message.pose.pose.position
        self.assertEqual((position.x, position.y, position.z), (1, 0, 0))
        self.assertEqual(message.pose.pose.orientation.w, 1)
        self.assertEqual(len(message.pose.covariance), 36)
        self.assertEqual(node.published["~/refined_pose"][0].pose.pose.position.y, 5)
        self.assertEqual(json.loads(node.published["~/job"][0].data)["id"], "job-1")
        node.timer()
        self.assertIn("1 frames posted, 0 dropped", node.warnings[-1])

    def test_a_raw_frame_in_an_unknown_encoding_logs_a_warning(self) -> None:
        node = self.node(image_transport="raw")
        self.assertEqual(list(node.subscriptions), ["image"])
        raw = Anything(encoding="16UC1", width=1, height=1, step=2, data=b"\0\0")
        raw.header = Anything(stamp=Anything(sec=0, nanosec=0))
        node.subscriptions["image"](raw)
        self.until(lambda: node.warnings)
        self.assertIn("16UC1", node.warnings[0])
        self.assertEqual(self.client.asked, [])

    def test_frames_of_a_track_carry_the_odometry(self) -> None:
        node = self.node(track="robot-7", odometry_topic="/odom")
        self.client.answers = tracked
        for tenth in range(21):
            stamp = Anything(sec=100 + tenth // 10, nanosec=tenth % 10 * 100_000_000)
            # It faces north.
            turn = Anything(x=0.0, y=0.0, z=HALF, w=HALF)
            pose = Anything(pose=Anything(position=Anything(x=0.0, y=tenth / 2, z=0.0), orientation=turn))
            node.subscriptions["/odom"](Anything(header=Anything(stamp=stamp), pose=pose))
        for number, stamp in enumerate(
            (Anything(sec=100, nanosec=500_000_000), Anything(sec=102, nanosec=0)), start=1
        ):
            frame = Anything(header=Anything(stamp=stamp), data=b"frame")
            node.subscriptions["image/compressed"](frame)
            self.until(lambda number=number: len(node.published["~/track_pose"]) == number)  # type: ignore[misc]
        (_, first, _), (track, second, way) = self.client.steps
        self.assertEqual((track, first, second), ("robot-7", instant(100, 500_000_000), instant(102, 0)))
        self.assertIsNone(way)
        moved = self.client.moved[1]
        assert moved
        self.assertAlmostEqual(moved.dx, 7.5)
        self.assertAlmostEqual(moved.dy, 0)
        self.assertAlmostEqual(moved.dyaw, 0)
        self.assertEqual(node.published["~/track_pose"][1].pose.pose.position.y, 2)
        self.assertIs(node.published["~/track_pose"][1].header.stamp, stamp)

    def test_without_a_track_odometry_is_not_subscribed(self) -> None:
        node = self.node(odometry_topic="/odom")
        self.assertEqual(list(node.subscriptions), ["image/compressed"])


if __name__ == "__main__":
    unittest.main()
