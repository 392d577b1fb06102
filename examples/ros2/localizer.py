"""The logic of the ROS 2 node, without ROS: newest frame first, answers as poses with covariances.

A pose here is the camera pose of the reference image named by an estimate. The covariance covers how far the
robot may be from it, and how much the candidates disagree:

    C = s² I + Σ wᵢ dᵢ dᵢᵀ,    wᵢ = exp((simᵢ − sim₁) / τ) / Σⱼ exp((simⱼ − sim₁) / τ)

over the candidates that have a pose: dᵢ is the vector from the estimate to candidate i, simᵢ its cosine
similarity, sim₁ the largest one; s and τ are in `Spread`. Position and orientation have one block each;
in the second, dᵢ is the rotation vector from the estimate's orientation to the candidate's, over those
that have one. It measures disagreement and is not a calibrated error: candidates that look alike and are
far apart make it large; a wrong estimate on which all candidates agree does not.
"""

from __future__ import annotations

import io
import json
import math
import re
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta, timezone
from typing import Generic, Protocol, TypeAlias, TypedDict, TypeVar

from whereabouts_client import (
    Answer,
    Candidate,
    Estimate,
    Job,
    MetricPose,
    Pose,
    Problem,
    RefineMode,
    RelativePose,
    TrackEstimate,
)

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
"""x, y, z, w."""
T = TypeVar("T")
S_contra = TypeVar("S_contra", contravariant=True)

UNKNOWN_VARIANCE = 1e6
"""Variance of an unknown value, in m² or rad²: large enough for any filter to ignore it."""


class Refused(Exception):
    """An answer or a frame that cannot be used; the message says why and what to do."""


# --- From poses of a map to ROS ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Placed:
    """A pose in metres: x east, y north, z up for a wgs84 map, else in the map's own axes."""

    position: Vector
    height_known: bool
    orientation: Quaternion | None
    tilt_known: bool
    """Whether roll and pitch are known, not only yaw."""


@dataclass(frozen=True)
class PoseWithCovariance:
    """The content of geometry_msgs/PoseWithCovariance."""

    position: Vector
    orientation: Quaternion
    covariance: tuple[float, ...]
    """6 × 6, row-major: x, y, z in m², then rotations about the fixed axes x, y, z in rad²."""


@dataclass(frozen=True)
class Spread:
    """How far the robot may be from the place of an image."""

    place_m: float = 5.0
    """Standard deviation of the distance between the reference image's camera and the robot's, in metres."""
    turn_rad: float = 0.5
    """Standard deviation of the angle between the two, in radians."""
    similarity_scale: float = 0.02
    """A candidate whose similarity is this much below the first one's has 1/e of its weight."""


@dataclass(frozen=True)
class Origin:
    """The geographic point that is (0, 0, 0) in ROS."""

    lat: float
    lon: float
    alt: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.lat) <= 90 and abs(self.lon) <= 180 and math.isfinite(self.alt)):
            raise Refused(f"the origin {self.lat}, {self.lon}, {self.alt} is not a valid geographic point")

    def east_north_up(self, lat: float, lon: float, alt: float) -> Vector:
        """Converts a WGS84 point to metres east, north and up from the origin (local tangent plane)."""
        dx, dy, dz = (
            there - here
            for there, here in zip(_earth_fixed(lat, lon, alt), _earth_fixed(self.lat, self.lon, self.alt))
        )
        sin_lat, cos_lat = math.sin(math.radians(self.lat)), math.cos(math.radians(self.lat))
        sin_lon, cos_lon = math.sin(math.radians(self.lon)), math.cos(math.radians(self.lon))
        outward = cos_lon * dx + sin_lon * dy
        return (
            -sin_lon * dx + cos_lon * dy,
            -sin_lat * outward + cos_lat * dz,
            cos_lat * outward + sin_lat * dz,
        )


def _earth_fixed(lat: float, lon: float, alt: float) -> Vector:
    semi_major_m, flattening = 6378137.0, 1 / 298.257223563
    eccentricity = flattening * (2 - flattening)
    sin_lat, cos_lat = math.sin(math.radians(lat)), math.cos(math.radians(lat))
    normal = semi_major_m / math.sqrt(1 - eccentricity * sin_lat**2)
    return (
        (normal + alt) * cos_lat * math.cos(math.radians(lon)),
        (normal + alt) * cos_lat * math.sin(math.radians(lon)),
        (normal * (1 - eccentricity) + alt) * sin_lat,
    )


def place(pose: Pose, origin: Origin | None) -> Placed:
    """Converts a pose of a map to ROS conventions."""
    if isinstance(pose, MetricPose):
        if origin is not None:
            raise Refused(
                "the map's poses are metres in a local frame, to which a geographic origin does not "
                "apply; unset the parameters origin_lat and origin_lon"
            )
        quaternion = None
        if pose.qx is not None and pose.qy is not None and pose.qz is not None and pose.qw is not None:
            quaternion = (pose.qx, pose.qy, pose.qz, pose.qw)
        position = (pose.x, pose.y, pose.z or 0.0)
        return Placed(position, pose.z is not None, quaternion, quaternion is not None)
    if origin is None:
        raise Refused(
            "the map's poses are latitudes and longitudes, and ROS needs metres; set the parameters "
            "origin_lat and origin_lon to the point that is (0, 0) in frame_id"
        )
    alt = origin.alt if pose.alt is None else pose.alt
    position = origin.east_north_up(pose.lat, pose.lon, alt)
    heading = None
    if pose.heading is not None:
        # Clockwise from north to anticlockwise from east.
        yaw = math.radians(90 - pose.heading)
        heading = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return Placed(position, pose.alt is not None, heading, False)


def pose_with_covariance(
    estimate: Estimate | TrackEstimate,
    candidates: Sequence[Candidate],
    origin: Origin | None = None,
    spread: Spread = Spread(),
) -> PoseWithCovariance | None:
    """Converts an estimate to ROS conventions; None if its image has no pose."""
    if estimate.pose is None:
        return None
    centre = place(estimate.pose, origin)
    others = [(place(other.pose, origin), other.similarity) for other in candidates if other.pose]
    ways = [(_minus(other.position, centre.position), similarity) for other, similarity in others]
    position = _second_moment(ways, spread.place_m, spread.similarity_scale)
    if not centre.height_known:
        _forget(position, 2)
    turns = [
        (_rotation_vector(centre.orientation, other.orientation), similarity)
        for other, similarity in others
        if centre.orientation and other.orientation
    ]
    orientation = _second_moment(turns, spread.turn_rad, spread.similarity_scale)
    for axis in range(3):
        if centre.orientation is None or (axis < 2 and not centre.tilt_known):
            _forget(orientation, axis)
    nothing = [0.0, 0.0, 0.0]
    rows = [row + nothing for row in position] + [nothing + row for row in orientation]
    return PoseWithCovariance(
        centre.position,
        centre.orientation or (0.0, 0.0, 0.0, 1.0),
        tuple(number for row in rows for number in row),
    )


def _second_moment(
    vectors: Sequence[tuple[Vector, float]], floor: float, similarity_scale: float
) -> list[list[float]]:
    """Returns Σ wᵢ dᵢ dᵢᵀ with the weights above, plus floor² on the diagonal."""
    best = max((similarity for _, similarity in vectors), default=0.0)
    weights = [math.exp((similarity - best) / similarity_scale) for _, similarity in vectors]
    total = sum(weights)
    return [
        [
            sum(w * vector[i] * vector[j] for w, (vector, _) in zip(weights, vectors)) / (total or 1.0)
            + (floor**2 if i == j else 0.0)
            for j in range(3)
        ]
        for i in range(3)
    ]


def _forget(matrix: list[list[float]], axis: int) -> None:
    for other in range(3):
        matrix[axis][other] = matrix[other][axis] = 0.0
    matrix[axis][axis] = UNKNOWN_VARIANCE


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _rotation_vector(start: Quaternion, end: Quaternion) -> Vector:
    """The rotation about fixed axes from `start` to `end`: its axis times its angle, at most π."""
    (ax, ay, az, aw), (bx, by, bz, bw) = end, start
    # end × conjugate of start
    x = -aw * bx + ax * bw - ay * bz + az * by
    y = -aw * by + ax * bz + ay * bw - az * bx
    z = -aw * bz - ax * by + ay * bx + az * bw
    w = aw * bw + ax * bx + ay * by + az * bz
    if w < 0:
        x, y, z, w = -x, -y, -z, -w
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(length, w) / length if length > 1e-12 else 2.0
    return (x * scale, y * scale, z * scale)


# --- Odometry ---------------------------------------------------------------------------------------------

MOST_READINGS = 10_000
"""Number of odometry readings kept: at 50 Hz, more than three minutes."""
LONGEST_GAP = timedelta(seconds=1)
"""Across a longer gap between two readings, the path of the robot is unknown."""
LONGEST_STEP_M = 100.0
"""A longer step between two readings means that the odometry was reset, not that the robot moved."""
LATEST = timedelta(seconds=0.2)
"""How far a frame may be ahead of the newest reading: readings have latency, too."""


def instant(sec: int, nanosec: int) -> datetime | None:
    """Converts a ROS stamp to a time, to the microsecond; None for zero, which means unknown."""
    if sec == nanosec == 0:
        return None
    return datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=sec, microseconds=nanosec // 1000)


class Odometer:
    """How a robot has moved, from its odometry. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._readings: deque[tuple[datetime, float]] = deque(maxlen=MOST_READINGS)
        """Times and path lengths in metres since the start of the path, in order and without a gap."""
        self._poses: deque[tuple[datetime, Vector]] = deque(maxlen=MOST_READINGS)
        """Times, and x, y and yaw, of those readings that have an orientation."""
        self._position: Vector = (0.0, 0.0, 0.0)
        """The position of the newest reading."""

    def add(self, at: datetime, position: Vector, orientation: Quaternion | None = None) -> None:
        """Adds a position in metres, and an orientation if it is known, in the odometry's own frame.

        A late reading is dropped. After a gap, a jump, or a clock that was set back, a new path starts.
        """
        if not all(map(math.isfinite, position)):
            return
        with self._lock:
            metres = 0.0
            if self._readings:
                newest, before = self._readings[-1]
                if -LONGEST_GAP <= at - newest <= timedelta(0):
                    return
                step = math.dist(position, self._position)
                if abs(at - newest) > LONGEST_GAP or step > LONGEST_STEP_M:
                    self._readings.clear()
                    self._poses.clear()
                else:
                    metres = before + step
            self._readings.append((at, metres))
            self._position = position
            if orientation and any(orientation) and all(map(math.isfinite, orientation)):
                x, y, z, w = orientation
                yaw = math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
                self._poses.append((at, (position[0], position[1], yaw)))

    def metres(self, start: datetime, end: datetime) -> float | None:
        """The path length between two times, in either order; None if the path does not cover both."""
        start, end = min(start, end), max(start, end)
        with self._lock:
            readings = list(self._readings)
        if not readings or start < readings[0][0] or end > readings[-1][0] + LATEST:
            return None
        # Rounding must not make it negative, which the service refuses.
        return max(0.0, _metres_at(readings, end) - _metres_at(readings, start))

    def relative_pose(self, start: datetime, end: datetime) -> RelativePose | None:
        """The pose at a time relative to that at an earlier one; None if it is not known for both."""
        with self._lock:
            poses = list(self._poses)
        if not poses or not poses[0][0] <= start <= end <= poses[-1][0] + LATEST:
            return None
        (x, y, yaw), (end_x, end_y, end_yaw) = _pose_at(poses, start), _pose_at(poses, end)
        cos, sin, east, north = math.cos(yaw), math.sin(yaw), end_x - x, end_y - y
        return RelativePose(cos * east + sin * north, cos * north - sin * east, _turn(yaw, end_yaw))


def _pose_at(poses: Sequence[tuple[datetime, Vector]], moment: datetime) -> Vector:
    """x, y and yaw at a time not before the first reading, interpolated between readings."""
    after = bisect_left(poses, moment, key=lambda reading: reading[0])
    if after == len(poses) or after == 0:
        return poses[min(after, len(poses) - 1)][1]
    (earlier, low), (later, high) = poses[after - 1], poses[after]
    share = (moment - earlier) / (later - earlier)
    x, y = (low[axis] + (high[axis] - low[axis]) * share for axis in (0, 1))
    return (x, y, low[2] + _turn(low[2], high[2]) * share)


def _turn(start: float, end: float) -> float:
    """The shorter turn from one angle to another, in radians."""
    return math.remainder(end - start, 2 * math.pi)


def _metres_at(readings: Sequence[tuple[datetime, float]], moment: datetime) -> float:
    """The path length at a time not before the first reading, linearly interpolated between readings."""
    after = bisect_left(readings, moment, key=lambda reading: reading[0])
    if after == len(readings):
        return readings[-1][1]
    if after == 0:
        return readings[0][1]
    (earlier, low), (later, high) = readings[after - 1], readings[after]
    return low + (high - low) * ((moment - earlier) / (later - earlier))


# --- Frames -----------------------------------------------------------------------------------------------


def encode(encoding: str, width: int, height: int, step: int, data: bytes) -> bytes:
    """Encodes a raw sensor_msgs/Image as JPEG. Needs Pillow (python3-pil)."""
    layouts = {"rgb8": ("RGB", "RGB", 3), "bgr8": ("RGB", "BGR", 3), "mono8": ("L", "L", 1)}
    if encoding not in layouts:
        known = ", ".join(layouts)
        raise Refused(f"the encoding {encoding} is not supported (only {known}); use compressed images")
    mode, layout, channels = layouts[encoding]
    if width < 1 or height < 1 or step < width * channels or len(data) < step * height:
        size = f"{width} × {height} pixels of {encoding} in rows of {step} bytes"
        raise Refused(f"{len(data)} bytes are not {size}")
    try:
        from PIL import Image
    except ImportError as error:
        hint = "install it (python3-pil), or use compressed images"
        raise Refused(f"raw images need Pillow; {hint}") from error
    picture = Image.frombytes(mode, (width, height), data, "raw", layout, step, 1)
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=90)
    return encoded.getvalue()


@dataclass(frozen=True)
class Shot(Generic[T]):
    """A frame, with the stamp that its pose is published under (in ROS, that of the header)."""

    stamp: T
    picture: Callable[[], bytes]
    """Returns the bytes of a picture file; called only if the frame is posted."""
    taken_at: datetime | None = None
    """When the frame was taken, with a time zone, if known."""


class Newest(Generic[T]):
    """A queue of length one: a newer item replaces one that was not taken yet."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False
        self.dropped = 0
        """Number of items replaced by a newer one."""

    def put(self, item: T) -> None:
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> T | None:
        """Waits for an item and returns the newest; None once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is not None)
            item, self._item = self._item, None
            return None if self._closed else item

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Motion(TypedDict):
    """The parameters of a frame that say how the robot has moved."""

    moved_m: float | None
    moved: RelativePose | None


class Service(Protocol):
    """The part of `whereabouts_client.Whereabouts` that the localizer uses."""

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
    ) -> Answer: ...

    def wait_for_job(self, id: str, timeout_s: float) -> Job: ...


@dataclass(frozen=True)
class Wishes:
    """Parameters of the localizer."""

    map: str
    k: int = 10
    refine: bool = True
    """Whether a job re-ranks the candidates."""
    deadline_ms: int = 2000
    """Deadline for an answer, in milliseconds."""
    job_timeout_s: float = 60.0
    """How long to wait for a job, in seconds."""
    only_known: bool = True
    """Whether to publish only poses that the service calls known."""
    origin: Origin | None = None
    spread: Spread = field(default_factory=Spread)
    track: str | None = None
    """Id of the robot's track; None to localize each frame on its own."""

    def __post_init__(self) -> None:
        if self.track is not None and not re.fullmatch(r"[A-Za-z0-9_.:-]{1,64}", self.track):
            raise Refused(f"the track {self.track!r} must have 1 to 64 letters, digits, -, _, . and :")


class Sink(Protocol[S_contra]):
    """Receives the results, on the localizer's own two threads."""

    def coarse(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose of the most similar image, immediately."""

    def refined(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose after refinement, once the job has ended."""

    def tracked(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose given all frames of the track, immediately."""

    def job(self, text: str) -> None:
        """A job as JSON, once it has ended or the wait has timed out."""

    def trouble(self, text: str) -> None:
        """Why a frame or a job failed, and what to do."""


class Localizer(Generic[T]):
    """Posts the newest frame, one at a time, and follows the newest job."""

    def __init__(
        self, service: Service, wishes: Wishes, sink: Sink[T], odometer: Odometer | None = None
    ) -> None:
        self._service, self._wishes, self._sink, self._odometer = service, wishes, sink, odometer
        self._last: datetime | None = None
        """Capture time of the last frame that is certainly in the track; None if that is uncertain."""
        self._frames: Newest[Shot[T]] = Newest()
        self._jobs: Newest[tuple[T, Answer, str]] = Newest()
        self.posted = 0
        """Number of frames posted."""
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._post, self._follow)]
        for thread in self._threads:
            thread.start()

    @property
    def dropped(self) -> int:
        """Number of frames replaced by a newer one while a request was in flight."""
        return self._frames.dropped

    @property
    def unfollowed(self) -> int:
        """Number of jobs replaced by a newer one while another job was being followed."""
        return self._jobs.dropped

    def offer(self, shot: Shot[T]) -> None:
        """Offers a new frame. Returns immediately."""
        self._frames.put(shot)

    def close(self, timeout_s: float = 5.0) -> None:
        """Stops posting; waits up to `timeout_s` seconds for the requests in flight."""
        self._frames.close()
        self._jobs.close()
        for thread in self._threads:
            thread.join(timeout_s)

    def _post(self) -> None:
        while shot := self._frames.take():
            try:
                self._localize(shot)
            except (Problem, Refused, ValueError, OSError) as error:
                self._sink.trouble(str(error))

    def _localize(self, shot: Shot[T]) -> None:
        wishes = self._wishes
        picture = shot.picture()
        self.posted += 1
        try:
            answer = self._service.localize(
                wishes.map,
                picture,
                k=wishes.k,
                refine="async" if wishes.refine else "off",
                deadline_ms=wishes.deadline_ms,
                track=wishes.track,
                captured_at=shot.taken_at if wishes.track else None,
                **self._motion(shot),
            )
        except Problem as problem:
            if not 400 <= problem.status < 500:
                # The frame may be in the track nevertheless; a rejected (4xx) frame is not.
                self._last = None
            raise
        if answer.track:
            self._last = shot.taken_at
        if answer.job:
            self._jobs.put((shot.stamp, answer, answer.job.id))
        elif answer.no_job:
            self._sink.trouble(f"no refinement: {answer.no_job.detail}")
        self._tell(self._sink.coarse, shot.stamp, answer.estimate, answer)
        if answer.track and answer.track.pose:
            self._tell(self._sink.tracked, shot.stamp, answer.track, answer)

    def _motion(self, shot: Shot[T]) -> Motion:
        """How the robot has moved since the last frame of the track, as far as that is known."""
        if self._odometer is None or self._last is None or shot.taken_at is None:
            return {"moved_m": None, "moved": None}
        moved = self._odometer.relative_pose(self._last, shot.taken_at)
        metres = None if moved else self._odometer.metres(self._last, shot.taken_at)
        return {"moved_m": metres, "moved": moved}

    def _follow(self) -> None:
        while item := self._jobs.take():
            stamp, answer, id = item
            try:
                job = self._service.wait_for_job(id, self._wishes.job_timeout_s)
                self._sink.job(job_text(job))
                self._tell(self._sink.refined, stamp, job.estimate, answer)
            except (Problem, Refused) as error:
                self._sink.trouble(str(error))

    def _tell(
        self,
        publish: Callable[[T, PoseWithCovariance], None],
        stamp: T,
        estimate: Estimate | TrackEstimate | None,
        answer: Answer,
    ) -> None:
        wishes = self._wishes
        if estimate is None or (wishes.only_known and not estimate.known):
            return
        pose = pose_with_covariance(estimate, answer.candidates, wishes.origin, wishes.spread)
        if pose is None:
            self._sink.trouble(f"the image {estimate.image_id} has no pose; add it again with one")
        else:
            publish(stamp, pose)


def job_text(job: Job) -> str:
    """Serializes a job as JSON, with the field names of the API."""

    def plain(value: object) -> str:
        if isinstance(value, datetime):
            return value.isoformat()
        raise TypeError(f"{value!r} is not JSON serializable")

    def bare(items: list[tuple[str, object]]) -> dict[str, object]:
        # Like the service, leave the unknown parts of a pose out.
        pose = any(name in ("lat", "x") for name, _ in items)
        return {name: value for name, value in items if not (pose and value is None)}

    return json.dumps(asdict(job, dict_factory=bare), default=plain, ensure_ascii=False)


def origin_of(lat: float, lon: float, alt: float) -> Origin | None:
    """The origin from three parameters; None while `lat` and `lon` are NaN (unset)."""
    if math.isnan(lat) and math.isnan(lon):
        return None
    return Origin(lat, lon, 0.0 if math.isnan(alt) else alt)

