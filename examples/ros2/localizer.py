"""What the ROS 2 node does, without ROS: newest frame first, answers as poses with covariances.

A pose here is that of the camera of the reference image that an estimate names. How far the robot may be
from it, and how much the candidates contradict each other, is in the covariance:

    C = s² I + Σ wᵢ dᵢ dᵢᵀ,    wᵢ = exp((simᵢ − sim₁) / τ) / Σⱼ exp((simⱼ − sim₁) / τ)

over the candidates that have a pose: dᵢ is the way from the estimate to candidate i, simᵢ its cosine
similarity, sim₁ the largest of them, s and τ are in `Spread`. Position and orientation have a block each,
dᵢ of the second being the rotation vector from the estimate's orientation to the candidate's, over those
that have one. It is a measure of disagreement, not a calibrated error: candidates that look alike and are
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
from typing import Generic, Protocol, TypeAlias, TypeVar

from whereabouts_client import (
    Answer,
    Candidate,
    Estimate,
    Job,
    MetricPose,
    Pose,
    Problem,
    RefineMode,
    TrackEstimate,
)

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
"""x, y, z, w."""
T = TypeVar("T")
S_contra = TypeVar("S_contra", contravariant=True)

UNKNOWN_VARIANCE = 1e6
"""Of what nothing is known about, in m² or rad²: large enough for any filter to leave it out."""


class Refused(Exception):
    """An answer or a frame that cannot be used; says why and what to do."""


# --- From poses of a map to ROS ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Placed:
    """A pose in metres: x east, y north, z up in a map on the globe, else the map's own axes."""

    position: Vector
    height_known: bool
    orientation: Quaternion | None
    tilt_known: bool
    """Whether roll and pitch are known, and not the yaw only."""


@dataclass(frozen=True)
class PoseWithCovariance:
    """What goes into geometry_msgs/PoseWithCovariance."""

    position: Vector
    orientation: Quaternion
    covariance: tuple[float, ...]
    """6 × 6, row by row: x, y, z in m², then rotations about the fixed axes x, y, z in rad²."""


@dataclass(frozen=True)
class Spread:
    """How far apart the place of an image and the robot may be."""

    place_m: float = 5.0
    """Standard deviation of the way from the reference image's camera to the robot's, in metres."""
    turn_rad: float = 0.5
    """The same of the angle between the two, in radians."""
    similarity_scale: float = 0.02
    """A candidate whose similarity is less than the first one's by so much has 1/e of its weight."""


@dataclass(frozen=True)
class Origin:
    """The point on the globe that is (0, 0, 0) in ROS."""

    lat: float
    lon: float
    alt: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.lat) <= 90 and abs(self.lon) <= 180 and math.isfinite(self.alt)):
            raise Refused(f"the origin {self.lat}, {self.lon}, {self.alt} is not a point on the globe")

    def east_north_up(self, lat: float, lon: float, alt: float) -> Vector:
        """A point of WGS84 in metres from the origin, on the plane that touches the ellipsoid there."""
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
    """A pose of a map as ROS has it."""
    if isinstance(pose, MetricPose):
        if origin is not None:
            raise Refused(
                "the map's poses are metres in its own frame, to which an origin on the globe does not "
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
    """An estimate as ROS has it; None if the image that it names has no pose."""
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
    """Σ wᵢ dᵢ dᵢᵀ with the weights above, and floor² on the diagonal."""
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
    """The rotation about fixed axes that turns `start` into `end`: its axis times its angle, at most π."""
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
"""What is remembered of the odometry: at 50 Hz, more than three minutes."""
LONGEST_GAP = timedelta(seconds=1)
"""Between two readings further apart, the robot may have come any way."""
LONGEST_STEP_M = 100.0
"""Between two readings further apart, the odometry was set anew and the robot did not move."""
LATEST = timedelta(seconds=0.2)
"""A frame may be ahead of the newest reading by so much: readings are on their way, too."""


def instant(sec: int, nanosec: int) -> datetime | None:
    """A stamp of ROS, to the microsecond; None for zero, which means that it is not known."""
    if sec == nanosec == 0:
        return None
    return datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=sec, microseconds=nanosec // 1000)


class Odometer:
    """The length of the path that a robot has come, by its odometry. May be used by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._readings: deque[tuple[datetime, float]] = deque(maxlen=MOST_READINGS)
        """Without a gap and in order: when, and the metres from where the path begins."""
        self._position: Vector = (0.0, 0.0, 0.0)
        """Where the newest of them was taken."""

    def add(self, at: datetime, position: Vector) -> None:
        """A position in metres, in the odometry's own frame.

        One that comes late is left out. After a gap, a leap, or a clock that was set back, the path begins
        anew.
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
                else:
                    metres = before + step
            self._readings.append((at, metres))
            self._position = position

    def metres(self, start: datetime, end: datetime) -> float | None:
        """The metres from one moment to another, in either order; None if the path does not cover both."""
        start, end = min(start, end), max(start, end)
        with self._lock:
            readings = list(self._readings)
        if not readings or start < readings[0][0] or end > readings[-1][0] + LATEST:
            return None
        # Rounding must not make it negative, which the service refuses.
        return max(0.0, _metres_at(readings, end) - _metres_at(readings, start))


def _metres_at(readings: Sequence[tuple[datetime, float]], moment: datetime) -> float:
    """The metres at a moment that is not before the first reading; between two, at constant speed."""
    after = bisect_left(readings, moment, key=lambda reading: reading[0])
    if after == len(readings):
        return readings[-1][1]
    if after == 0:
        return readings[0][1]
    (earlier, low), (later, high) = readings[after - 1], readings[after]
    return low + (high - low) * ((moment - earlier) / (later - earlier))


# --- Frames -----------------------------------------------------------------------------------------------


def encode(encoding: str, width: int, height: int, step: int, data: bytes) -> bytes:
    """A raw sensor_msgs/Image as a JPEG. Needs Pillow (python3-pil)."""
    layouts = {"rgb8": ("RGB", "RGB", 3), "bgr8": ("RGB", "BGR", 3), "mono8": ("L", "L", 1)}
    if encoding not in layouts:
        known = ", ".join(layouts)
        raise Refused(f"the encoding {encoding} is not among {known}; take a compressed image instead")
    mode, layout, channels = layouts[encoding]
    if width < 1 or height < 1 or step < width * channels or len(data) < step * height:
        size = f"{width} × {height} pixels of {encoding} in rows of {step} bytes"
        raise Refused(f"{len(data)} bytes are not {size}")
    try:
        from PIL import Image
    except ImportError as error:
        hint = "install it (python3-pil), or take a compressed image"
        raise Refused(f"raw images need Pillow; {hint}") from error
    picture = Image.frombytes(mode, (width, height), data, "raw", layout, step, 1)
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=90)
    return encoded.getvalue()


@dataclass(frozen=True)
class Shot(Generic[T]):
    """A frame with what its pose is published under: in ROS the header's stamp."""

    stamp: T
    picture: Callable[[], bytes]
    """Gives the bytes of a JPEG, PNG or WebP; called only if the frame is posted."""
    taken_at: datetime | None = None
    """When the frame was taken, with a time zone, if that is known."""


class Newest(Generic[T]):
    """A place for one item: a newer one takes the place of one that nobody has taken yet."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False
        self.dropped = 0
        """Items that a newer one replaced."""

    def put(self, item: T) -> None:
        with self._changed:
            self.dropped += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self) -> T | None:
        """The newest item, once there is one; None when nothing more is to be done."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is not None)
            item, self._item = self._item, None
            return None if self._closed else item

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Service(Protocol):
    """What is asked of a client: `whereabouts_client.Whereabouts` has it."""

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
    ) -> Answer: ...

    def wait_for_job(self, id: str, timeout_s: float) -> Job: ...


@dataclass(frozen=True)
class Wishes:
    """How to localize."""

    map: str
    k: int = 10
    refine: bool = True
    """Whether a job orders the candidates anew."""
    deadline_ms: int = 2000
    """How long an answer is of use, in milliseconds."""
    job_timeout_s: float = 60.0
    """How long to wait for a job, in seconds."""
    only_known: bool = True
    """Whether to give no pose where the service is not sure that the place is in the map."""
    origin: Origin | None = None
    spread: Spread = field(default_factory=Spread)
    track: str | None = None
    """The robot's name for its frames one after another; None if each of them is for itself."""

    def __post_init__(self) -> None:
        if self.track is not None and not re.fullmatch(r"[A-Za-z0-9_.:-]{1,64}", self.track):
            raise Refused(f"the track {self.track!r} must have 1 to 64 letters, digits, -, _, . and :")


class Sink(Protocol[S_contra]):
    """Who is told, from the localizer's own two threads."""

    def coarse(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose by the most similar image, at once."""

    def refined(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose by the refined order, once the job has ended."""

    def tracked(self, stamp: S_contra, pose: PoseWithCovariance) -> None:
        """The pose by all frames of the track, at once."""

    def job(self, text: str) -> None:
        """A job that has ended, or was given up waiting for, as JSON."""

    def trouble(self, text: str) -> None:
        """Why a frame or a job came to nothing, and what to do."""


class Localizer(Generic[T]):
    """Posts the newest frame while no other is in flight, and follows the newest job."""

    def __init__(
        self, service: Service, wishes: Wishes, sink: Sink[T], odometer: Odometer | None = None
    ) -> None:
        self._service, self._wishes, self._sink, self._odometer = service, wishes, sink, odometer
        self._last: datetime | None = None
        """When the last frame that the service has in the track was taken; None if that is not certain."""
        self._frames: Newest[Shot[T]] = Newest()
        self._jobs: Newest[tuple[T, Answer, str]] = Newest()
        self.posted = 0
        """Frames that were posted."""
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._post, self._follow)]
        for thread in self._threads:
            thread.start()

    @property
    def dropped(self) -> int:
        """Frames that were not posted, because a newer one came while another was in flight."""
        return self._frames.dropped

    @property
    def unfollowed(self) -> int:
        """Jobs that were not waited for, because a newer one came while another was."""
        return self._jobs.dropped

    def offer(self, shot: Shot[T]) -> None:
        """A new frame. Returns at once."""
        self._frames.put(shot)

    def close(self, timeout_s: float = 5.0) -> None:
        """Posts no more; waits so many seconds for what is in flight."""
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
                moved_m=self._moved_m(shot),
            )
        except Problem as problem:
            if not 400 <= problem.status < 500:
                # The frame may be in the track all the same; one that was refused is not.
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

    def _moved_m(self, shot: Shot[T]) -> float | None:
        """How far the robot has come since the last frame of the track, in metres, if that is known."""
        if self._odometer is None or self._last is None or shot.taken_at is None:
            return None
        return self._odometer.metres(self._last, shot.taken_at)

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
    """A job as JSON, under the names that the service has."""

    def plain(value: object) -> str:
        if isinstance(value, datetime):
            return value.isoformat()
        raise TypeError(f"{value!r} has no JSON")

    def bare(items: list[tuple[str, object]]) -> dict[str, object]:
        # As the service does, a pose has no parts that are not known.
        pose = any(name in ("lat", "x") for name, _ in items)
        return {name: value for name, value in items if not (pose and value is None)}

    return json.dumps(asdict(job, dict_factory=bare), default=plain, ensure_ascii=False)


def origin_of(lat: float, lon: float, alt: float) -> Origin | None:
    """The origin that three parameters name, none of which is set while the first two are NaN."""
    if math.isnan(lat) and math.isnan(lon):
        return None
    return Origin(lat, lon, 0.0 if math.isnan(alt) else alt)

