"""A client for whereabouts, the service that localizes a robot from a single camera frame.

    with Whereabouts("http://localhost:8080") as service:
        answer = service.localize("town", "frame.jpg", k=5)
        print(answer.estimate)
        if answer.job:
            print(service.wait_for_job(answer.job.id, 60).estimate)

It needs Python 3.10 or later and httpx, and is a single file: copy it. A client is thread-safe.
The classes have the names of the API schemas (`GET /openapi.json`); fields added by a newer server are
ignored.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, TypeVar, cast, get_args, get_type_hints
from urllib.parse import quote

import httpx

if TYPE_CHECKING:
    from uuid import UUID

    from typing_extensions import Self

Scene: TypeAlias = Literal["outdoor", "indoor"]
Frame: TypeAlias = Literal["wgs84", "metric"]
DescriptorKind: TypeAlias = str
"""A kind of descriptor that the model declares, such as `gem`, `cls` or `vlad`."""
RefineMode: TypeAlias = Literal["async", "wait", "off"]
Refiner: TypeAlias = Literal["local", "cascade", "mllm"]
Priority: TypeAlias = Literal["low", "normal", "high"]
JobState: TypeAlias = Literal["queued", "running", "succeeded", "degraded", "failed", "cancelled"]

T = TypeVar("T")

class Pixels(Protocol):
    """An array of numpy, or one like it, of 8-bit samples: height × width of grey, or height × width × 3 or 4
    of RGB or RGBA. OpenCV has BGR: pass `frame[:, :, ::-1]`."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def dtype(self) -> Any: ...
    def tobytes(self) -> bytes: ...


class PilImage(Protocol):
    """An image of Pillow."""

    @property
    def size(self) -> tuple[int, int]: ...
    def convert(self, mode: str) -> Any: ...


class ImageMessage(Protocol):
    """A ROS message `sensor_msgs/Image` with the encoding `rgb8`, `bgr8`, `rgba8`, `bgra8` or `mono8`."""

    encoding: str
    width: int
    height: int
    step: int
    data: Any


Picture: TypeAlias = "bytes | str | os.PathLike[str] | Pixels | PilImage | ImageMessage"
"""A picture: bytes or path of a file (JPEG, PNG, WebP, TIFF, BMP, GIF or PNM), or pixels in memory."""


class Problem(Exception):
    """A failed call: the server's RFC 9457 problem, or the reason for no response (status 0).

    After status 0 or 503, the server may or may not have carried out the request.
    """

    def __init__(
        self,
        status: int,
        title: str,
        detail: str,
        *,
        type: str = "about:blank",
        request_id: str | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        where = f" (request {request_id})" if request_id else ""
        super().__init__(f"{f'{status} ' if status else ''}{title}: {detail}{where}")
        self.status = status
        """The HTTP status; 0 if there was no response."""
        self.title = title
        self.detail = detail
        """What happened and what to do next."""
        self.type = type
        self.request_id = request_id
        """The id of the request in the server's log."""
        self.retry_after_s = retry_after_s
        """Seconds to wait before a retry, if the server gave them."""


@dataclass(frozen=True)
class GeographicPose:
    """A geographic pose (WGS84)."""

    lat: float
    """Degrees, -90 to 90."""
    lon: float
    """Degrees, -180 to 180."""
    alt: float | None = None
    """Metres above the ellipsoid."""
    heading: float | None = None
    """Viewing direction in degrees clockwise from north."""


@dataclass(frozen=True)
class MetricPose:
    """A pose in a map's local frame: metres, and optionally a unit quaternion (all components or none)."""

    x: float
    y: float
    z: float | None = None
    qx: float | None = None
    qy: float | None = None
    qz: float | None = None
    qw: float | None = None


Pose: TypeAlias = GeographicPose | MetricPose


@dataclass(frozen=True)
class Image:
    """A reference image of a map."""

    id: str
    digest: str
    """`sha256:` and 64 hexadecimal digits."""
    media_type: str
    width: int
    """Pixels, after EXIF orientation."""
    height: int
    created_at: datetime
    pose: Pose | None = None
    captured_at: datetime | None = None
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImageAnswer(Image):
    """An image as it is stored now, and what the call changed of it."""

    changed: tuple[Literal["pose", "captured_at", "tags"], ...] = ()
    """Fields of an image stored before that the call changed. Empty if it is new or stayed as it was."""
    warnings: tuple[str, ...] = ()
    """What the sender should know about the picture, such as damage in transit."""


class Keep:
    """The type of `KEEP`."""


KEEP = Keep()
"""Leaves a field of `update_image` as it is; None removes its value."""


@dataclass(frozen=True)
class CalibrationState:
    """The sample that a map's confidence was calibrated on."""

    images: int
    """Images in the map when it was calibrated."""
    asked: int
    """Images that were queried as if they were frames."""
    refined: int
    """How many of those were also refined."""
    model_asked: int = 0
    """About how many of those the model was asked."""


@dataclass(frozen=True)
class Reindex:
    """Progress of the last reindex of a map."""

    model: str
    descriptor: DescriptorKind
    state: Literal["running", "succeeded", "failed"]
    done: int
    total: int
    started_at: datetime
    error: str | None = None
    finished_at: datetime | None = None


@dataclass(frozen=True)
class VocabularyState:
    """The vocabulary of a map whose descriptors have one."""

    source: Literal["shipped", "own"]
    """`shipped` with the model, or fitted on the images of the map."""
    digest: str | None = None
    fitted_at: datetime | None = None
    images: int | None = None
    """Number of images that an own vocabulary was fitted on."""
    reason: str | None = None
    """Why the map has the vocabulary of the model; None if it has its own, or if one may be fitted."""


@dataclass(frozen=True)
class MapState:
    """A map: a named set of reference images."""

    name: str
    scene: Scene
    descriptor: DescriptorKind
    frame: Frame
    model: str
    model_digest: str
    precision: Literal["full", "bf16"]
    dim: int
    """Dimension of the descriptors."""
    images: int
    index: Literal["exact", "building", "hnsw"]
    created_at: datetime
    vocabulary: VocabularyState | None = None
    """The vocabulary of the descriptors; None if this kind has none."""
    texts: MapTexts | None = None
    """How much of the map was read; None if no reader is installed and nothing was read."""
    reindex: Reindex | None = None
    calibration: CalibrationState | None = None
    """None until the map is calibrated, soon after images are added. Every confidence is None until then."""
    refiner: Refiner | None = None
    """The refiner that the map is set to; None for the server's."""
    description: str | None = None


@dataclass(frozen=True)
class Candidate:
    """A reference image that is similar to the frame."""

    rank: int
    """Rank in the coarse order; 1 is the most similar."""
    image_id: str
    similarity: float
    """Cosine similarity of its descriptor and the frame's, -1 to 1."""
    pose: Pose | None = None


@dataclass(frozen=True)
class Estimate:
    """The best estimate of where a frame was taken."""

    image_id: str
    confidence: float | None
    """Calibrated, 0 to 1: of frames from outside the map, at most a share of 1 - confidence reach it.
    None while it is not measured yet, shortly after images are added."""
    known: bool
    """Whether the confidence reaches the server's threshold; below it, the place may not be in the map."""
    pose: Pose | None = None
    reason: str | None = None
    """Why the place cannot be known from this frame, whatever it resembles."""
    evidence: dict[str, Any] | None = None
    """What the confidence will be computed from, while it is None."""


@dataclass(frozen=True)
class JobLink:
    """A reference to a job."""

    id: str
    href: str
    state: JobState


@dataclass(frozen=True)
class NoJob:
    """Why an answer has no job although one was requested."""

    reason: Literal["no_refiner", "empty_map", "queue_full", "overload", "disk_full"]
    detail: str


@dataclass(frozen=True)
class TimingMs:
    """Duration of each stage in the server, in milliseconds."""

    decode: float
    extract: float
    search: float
    total: float


@dataclass(frozen=True)
class RelativePose:
    """How a robot has moved in the plane since its last frame, in its own axes at that frame."""

    dx: float
    """Metres ahead."""
    dy: float
    """Metres to the left."""
    dyaw: float
    """Radians turned to the left."""
    covariance: tuple[float, ...] = ()
    """In m², m·rad and rad²: 9 numbers row by row, or the 3 of the diagonal; empty if unknown."""


@dataclass(frozen=True)
class TrackHypothesis:
    """A place where a robot may be."""

    image_id: str
    probability: float
    pose: Pose | None = None


@dataclass(frozen=True)
class TrackEstimate:
    """A robot's place given all frames of its track."""

    id: str
    frames: int
    """Number of frames in the track so far, including this one."""
    probability: float
    """The probability that the robot is at the image or one next to it, 0 to 1."""
    known: bool
    image_id: str | None = None
    """The most probable image; None while none is likely."""
    pose: Pose | None = None
    others: tuple[TrackHypothesis, ...] = ()
    """Up to two other places where the robot may be, the most probable first."""
    is_late: bool = False
    """Whether the frame is older than the last one of the track."""
    off_map: float = 0.0
    """The probability that the robot is at no place of the map, 0 to 1."""


@dataclass(frozen=True)
class TrackPlace:
    """Where a robot was at one frame, given the frames before and after it."""

    received_at: datetime
    probability: float
    """The probability that the robot was at the image or one next to it, 0 to 1."""
    known: bool
    off_map: float
    """The probability that the robot was at no place of the map, 0 to 1."""
    captured_at: datetime | None = None
    image_id: str | None = None
    pose: Pose | None = None


@dataclass(frozen=True)
class TrackWay:
    """The last places of a robot, the oldest first."""

    id: str
    map: str
    frames: int
    """Number of frames in the track so far."""
    places: tuple[TrackPlace, ...]
    key: str | None = None
    """Id of the API key whose robot sends the track; None without keys."""


@dataclass(frozen=True)
class Answer:
    """The answer to a frame: candidates and the estimated place."""

    query_id: str
    map: str
    model: str
    candidates: tuple[Candidate, ...]
    """The most similar images, best first."""
    timing_ms: TimingMs
    estimate: Estimate | None = None
    """None for an empty map."""
    job: JobLink | None = None
    """The refinement job, if there is one."""
    no_job: NoJob | None = None
    track: TrackEstimate | None = None
    """None without a track."""
    warnings: tuple[str, ...] = ()
    """What the sender should know about the frame, such as damage in transit."""
    ranking: tuple[RankedCandidate, ...] | None = None
    """With `refine="wait"`, the refined order once the job has ended."""


@dataclass(frozen=True)
class MapTexts:
    """How much of a map was read."""

    read: int
    failed: int
    lines: int
    reader: str | None = None
    waiting: int | None = None
    """Images that will be read; None without a reader."""


@dataclass(frozen=True)
class TextLine:
    """A line of text that was read in an image."""

    text: str
    confidence: float
    """Mean probability of the characters, not calibrated."""
    corners: tuple[tuple[float, ...], ...]
    """Top left, top right, bottom right, bottom left, as shares of width and height."""


@dataclass(frozen=True)
class SeenSign:
    """A sign of a description that was read in an image."""

    text: str
    """What the description says."""
    lines: tuple[TextLine, ...]


@dataclass(frozen=True)
class WordsCandidate:
    """An image that fits a description."""

    rank: int
    image_id: str
    pose: Pose | None
    probability: float
    """That this image shows the place, 0 to 1."""
    signs: tuple[SeenSign, ...]


@dataclass(frozen=True)
class WordsEstimate:
    """The most likely place of a description."""

    image_id: str
    pose: Pose | None
    probability: float
    """Of the place: the sum over the images that show it, 0 to 1."""
    known: bool


@dataclass(frozen=True)
class NamedSign:
    """A sign that a description names."""

    text: str
    is_name: bool
    images: int
    """Number of images in which it was read."""


@dataclass(frozen=True)
class WordsTimingMs:
    """Duration of a search by words in milliseconds."""

    total: float


@dataclass(frozen=True)
class WordsAnswer:
    """The answer to a description in words."""

    map: str
    candidates: tuple[WordsCandidate, ...]
    """The images that fit, best first; empty if none shows any of the signs."""
    signs: tuple[NamedSign, ...]
    unread: int
    """Images that are not read, and may show any sign."""
    timing_ms: WordsTimingMs
    estimate: WordsEstimate | None = None
    reason: str | None = None
    """Why the place is not known, and what would help; None if it is."""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Usage:
    """The cost of a refinement."""

    calls: int
    cached: int
    prompt_tokens: int
    completion_tokens: int
    estimated: int = 0
    """Calls whose tokens are estimated."""


@dataclass(frozen=True)
class StandIn:
    """An earlier, nearly identical frame whose description was reused."""

    query_id: str
    similarity: float


@dataclass(frozen=True)
class Description:
    """A text that compares the frame with one candidate."""

    image_id: str
    text: str
    cached: bool
    usage: Usage
    stands_in: StandIn | None = None
    took_ms: int | None = None
    """Latency of the model in milliseconds; None for a cached text."""


@dataclass(frozen=True)
class RankedCandidate:
    """A candidate after refinement."""

    rank: int
    """Rank in the refined order; 1 is most likely the same place."""
    image_id: str
    coarse_rank: int
    pose: Pose | None = None


@dataclass(frozen=True)
class JobVerdict:
    """What one of the refiners of a cascade found."""

    refiner: Refiner
    image_id: str
    confidence: float | None
    """None while it is not measured yet."""
    compared: int
    """Number of candidates that it compared."""
    certainty: Literal["certain", "likely", "unsure", "none"] | None = None
    """How certain a model says it is."""
    then: str | None = None
    """Whether the answer stands or goes on to the model, and why."""
    evidence: dict[str, Any] | None = None
    """What the confidence will be computed from, while it is None."""


@dataclass(frozen=True)
class Job:
    """A refinement job."""

    id: str
    map: str
    query_id: str
    refiner: Refiner
    state: JobState
    created_at: datetime
    attempts: int
    descriptions: tuple[Description, ...]
    usage: Usage
    priority: Priority = "normal"
    started_at: datetime | None = None
    finished_at: datetime | None = None
    ranking: tuple[RankedCandidate, ...] | None = None
    """The refined order, once there is one. It may have more candidates than the answer."""
    reasoning: str | None = None
    reasoning_took_ms: int | None = None
    """Latency of the call that ranked the candidates in milliseconds, if there was one."""
    estimate: Estimate | None = None
    """The estimated place according to the refined order."""
    error: str | None = None
    trace_id: str | None = None
    """Trace id of its request and refinement, if the server exports traces."""
    fresh_since: datetime | None = None
    """Descriptions from before this time are bought again."""
    verdicts: tuple[JobVerdict, ...] = ()
    """What each refiner of a cascade found: `local`, and the model if it was asked."""
    texts: tuple[TextLine, ...] | None = None
    """What was read in the frame; None if nothing is read in its map."""

    @property
    def ended(self) -> bool:
        """Whether the job has ended."""
        return self.state not in ("queued", "running")


@dataclass(frozen=True)
class JobStatus:
    """Event: the state or attempt of a job changed."""

    state: JobState
    attempts: int
    error: str | None = None


@dataclass(frozen=True)
class PairDescribed:
    """Event: one more pair of a job was described."""

    described: int
    of: int
    description: Description


JobEvent: TypeAlias = JobStatus | PairDescribed | Job


@dataclass(frozen=True)
class Health:
    """The readiness of a server."""

    ready: bool
    """Whether it accepts requests."""
    detail: str
    """`ready`, or the reason it is not."""


class Whereabouts:
    """A connection to a server. Every call raises `Problem` if it fails.

    `api_key` is sent as a bearer token, if given. `timeout_s` is the timeout of each network operation, in
    addition to the time that a call asks the server to wait.

    `retry_for_s` is the time budget for retries, in seconds: after 429 or 503 with `Retry-After`, the call is
    sent again after that delay if it is within the budget. The default, 0, never retries. Calls that are not
    idempotent (`localize` and `delete_image`) are not retried after 503, which may have carried them out.
    """

    def __init__(
        self,
        base_url: str = "http://localhost:8080",
        *,
        api_key: str | None = None,
        timeout_s: float = 35.0,
        connect_timeout_s: float = 5.0,
        retry_for_s: float = 0.0,
    ) -> None:
        if not base_url.startswith(("http://", "https://")):
            raise ValueError(f"{base_url!r} is not the URL of a server; give http://HOST:PORT")
        self._timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._retry_for_s = retry_for_s
        headers = {"Authorization": f"Bearer {api_key}"} if api_key else {}
        self._http = httpx.Client(base_url=base_url, headers=headers)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections."""
        self._http.close()

    def health(self) -> Health:
        """Returns whether the server accepts requests; `Problem` with status 0 if it is unreachable."""
        try:
            response = self._once("GET", "/readyz", 0.0)
        except Problem as problem:
            if problem.status != 503:
                raise
            return Health(False, problem.detail)
        return Health(True, response.text.strip())

    def put_map(
        self,
        map: str,
        *,
        scene: Scene | None = None,
        frame: Frame | None = None,
        descriptor: DescriptorKind | None = None,
        model: str | None = None,
        refiner: Literal["default", "local", "cascade", "mllm"] | None = None,
        description: str | None = None,
    ) -> MapState:
        """Creates or updates a map. Omitted fields keep their values, or get defaults in a new map."""
        change = _given(
            scene=scene,
            frame=frame,
            descriptor=descriptor,
            model=model,
            refiner=refiner,
            description=description,
        )
        return self._call(MapState, "PUT", f"/maps/{_segment(map)}", json=change)

    def map(self, map: str) -> MapState:
        """Returns one map."""
        return self._call(MapState, "GET", f"/maps/{_segment(map)}")

    def track(self, map: str, id: str) -> TrackWay:
        """Returns the last places of a track, each estimated from the frames before and after it."""
        return self._call(TrackWay, "GET", f"/maps/{_segment(map)}/tracks/{_segment(id)}")

    def maps(self) -> list[MapState]:
        """Returns all maps, sorted by name."""
        response = self._send("GET", "/maps")
        return list(_read(response, lambda body: _decode(tuple[MapState, ...], body["maps"])))

    def add_image(
        self,
        map: str,
        picture: Picture,
        *,
        id: str | None = None,
        pose: Pose | None = None,
        captured_at: datetime | None = None,
        tags: Sequence[str] = (),
        recording: tuple[UUID, int] | None = None,
        deadline_ms: int | None = None,
    ) -> ImageAnswer:
        """Adds an image to a map. Repeating an id is allowed with the same bytes, and 409 with others.

        `recording` is the id of a recording and the number of the image in it: tracks follow the images
        of a recording in that order, also if they arrive in another.

        Repeated with another pose, time or tags, it changes those: see `changed` of the answer. What is
        omitted keeps its value.
        """
        name, data, media_type = _load(picture)
        meta = _given(
            id=id,
            pose=_given(**asdict(pose)) if pose else None,
            captured_at=_rfc3339(captured_at) if captured_at else None,
            tags=list(tags) or None,
            recording=recording and {"id": str(recording[0]), "number": recording[1]},
        )
        return self._call(
            ImageAnswer,
            "POST",
            f"/maps/{_segment(map)}/images",
            repeatable=True,
            headers=_deadline(deadline_ms),
            files={
                "image": (name, data, media_type),
                "meta": ("meta.json", json.dumps(meta).encode(), "application/json"),
            },
        )

    def update_image(
        self,
        map: str,
        id: str,
        *,
        pose: Pose | None | Keep = KEEP,
        captured_at: datetime | None | Keep = KEEP,
        tags: Sequence[str] | None | Keep = KEEP,
    ) -> ImageAnswer:
        """Changes the pose, time or tags of an image. A pose is replaced as a whole; None removes a value."""
        change: dict[str, Any] = {}
        if not isinstance(pose, Keep):
            # In a merge patch, None removes what an earlier pose had and this one has not.
            change["pose"] = asdict(pose) if pose else None
        if not isinstance(captured_at, Keep):
            change["captured_at"] = _rfc3339(captured_at) if captured_at else None
        if not isinstance(tags, Keep):
            change["tags"] = list(tags or ())
        path = f"/maps/{_segment(map)}/images/{_segment(id)}"
        return self._call(ImageAnswer, "PATCH", path, json=change)

    def images(self, map: str, *, page_size: int = 100) -> Iterator[Image]:
        """Iterates over the images of a map, sorted by id, fetching pages lazily."""
        cursor: str | None = None
        while True:
            params = _given(limit=page_size, cursor=cursor)
            response = self._send("GET", f"/maps/{_segment(map)}/images", params=params)
            yield from _read(response, lambda body: _decode(tuple[Image, ...], body["images"]))
            cursor = response.json()["next_cursor"]
            if cursor is None:
                return

    def delete_image(self, map: str, id: str) -> None:
        """Deletes an image from a map."""
        self._send("DELETE", f"/maps/{_segment(map)}/images/{_segment(id)}", repeatable=False)

    def localize(
        self,
        map: str,
        frame: Picture,
        *,
        k: int | None = None,
        refine: RefineMode = "async",
        refiner: Refiner | None = None,
        priority: Priority | None = None,
        track: str | None = None,
        captured_at: datetime | None = None,
        moved_m: float | None = None,
        moved: RelativePose | None = None,
        deadline_ms: int | None = None,
        idempotency_key: str | None = None,
    ) -> Answer:
        """Localizes a frame: returns the `k` most similar images of the map and a job that re-ranks them.

        `refine="wait"` waits for the job to end; `"off"` creates none. `refiner` chooses among those that the
        server allows and that cost no more than the map's. `deadline_ms` is how long the answer
        is useful, counted from the arrival of the request: the server rejects the request immediately (429)
        if it cannot meet the deadline, and aborts it (504) if it takes longer.

        With a `track`, an id chosen by the robot, the answer also contains the robot's place given all frames
        of that track. `captured_at` is when the frame was taken (default: unknown), and `moved_m` the
        distance travelled since the previous frame in metres, from odometry; or, better, `moved` the
        relative pose.

        With a unique `idempotency_key`, the same frame can be sent again after its answer was lost, and gets
        the first answer instead of a second job. `retry_for_s` then also covers 503.
        """
        _, data, media_type = _load(frame)
        return self._call(
            Answer,
            "POST",
            "/localize",
            wait_s=_LONGEST_WAIT_S if refine == "wait" else 0.0,
            params=_given(
                map=map,
                k=k,
                refine=refine,
                refiner=refiner,
                priority=priority,
                track=track,
                captured_at=_rfc3339(captured_at) if captured_at else None,
                moved_m=moved_m,
                **(_relative(moved) if moved else {}),
            ),
            headers={
                "Content-Type": media_type,
                **_deadline(deadline_ms),
                **({"Idempotency-Key": idempotency_key} if idempotency_key else {}),
            },
            repeatable=idempotency_key is not None,
            content=data,
        )

    def localize_text(self, map: str, text: str, *, k: int | None = None) -> WordsAnswer:
        """Finds a place by a description, above all by what signs say, among what was read in the map."""
        return self._call(WordsAnswer, "POST", "/localize", params=_given(map=map, k=k, text=text))

    def job(self, id: str, *, wait_s: float = 0.0) -> Job:
        """Returns a job. With `wait_s`, the server waits that many seconds for it to end (at most 60 with its
        default settings)."""
        params = {"wait": wait_s} if wait_s > 0 else {}
        return self._call(Job, "GET", f"/jobs/{_segment(id)}", wait_s=wait_s, params=params)

    def wait_for_job(self, id: str, timeout_s: float, *, poll_s: float = 20.0) -> Job:
        """Returns the job once it has ended, or unfinished after `timeout_s` seconds: check `ended`.

        It long-polls, for at most `poll_s` seconds at a time.
        """
        end = time.monotonic() + timeout_s
        while True:
            job = self.job(id, wait_s=max(0.0, min(end - time.monotonic(), poll_s)))
            if job.ended or time.monotonic() >= end:
                return job

    def job_events(self, id: str) -> Iterator[JobEvent]:
        """Streams the events of a job: past events, then live ones, and finally the `Job` that has ended.

        Raises `Problem` with status 0 if the stream is interrupted; a new call replays all events.
        """
        path = f"/jobs/{_segment(id)}/events"
        request = self._http.build_request("GET", path, timeout=self._timeout(_KEEP_ALIVE_S))
        try:
            response = self._http.send(request, stream=True)
            try:
                if response.is_error:
                    response.read()
                    raise _problem(response)
                for event in _events(response.iter_lines()):
                    yield event
                    if isinstance(event, Job):
                        return
            finally:
                response.close()
        except httpx.HTTPError as error:
            raise self._no_answer(error) from error
        raise Problem(0, "Stream ended", "the server closed the stream before the job ended; follow it again")

    def _call(self, kind: type[T], method: str, path: str, **more: Any) -> T:
        response = self._send(method, path, **more)
        decoded: T = _read(response, lambda body: _decode(kind, body))
        return decoded

    def _send(
        self,
        method: str,
        path: str,
        *,
        repeatable: bool | None = None,
        wait_s: float = 0.0,
        **more: Any,
    ) -> httpx.Response:
        """Sends a request, with retries: always safe after 429, but after 503 only if it is `repeatable`."""
        repeatable = method != "POST" if repeatable is None else repeatable
        end = time.monotonic() + self._retry_for_s
        while True:
            try:
                return self._once(method, path, wait_s, **more)
            except Problem as problem:
                refused = problem.status == 429 or (problem.status == 503 and repeatable)
                pause = problem.retry_after_s
                if not refused or pause is None or time.monotonic() + pause > end:
                    raise
            time.sleep(max(pause, _SHORTEST_PAUSE_S))

    def _once(self, method: str, path: str, wait_s: float, **more: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, timeout=self._timeout(wait_s), **more)
        except httpx.HTTPError as error:
            raise self._no_answer(error) from error
        if not response.is_success:
            raise _problem(response)
        return response

    def _timeout(self, wait_s: float) -> httpx.Timeout:
        return httpx.Timeout(self._timeout_s + wait_s, connect=self._connect_timeout_s)

    def _no_answer(self, error: httpx.HTTPError) -> Problem:
        url = str(self._http.base_url).rstrip("/")
        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
            detail = f"cannot connect to {url} ({error}); `whereabouts serve` starts a server"
            return Problem(0, "Unreachable", detail)
        if isinstance(error, httpx.TimeoutException):
            detail = f"{url} did not respond in time; increase timeout_s, or check its GET /readyz"
            return Problem(0, "No answer in time", detail)
        return Problem(0, "No answer", f"the connection to {url} failed ({error!r}); try again")


# The longest wait of a server with default settings, in seconds (jobs.max_wait_s).
_LONGEST_WAIT_S = 60.0

# Minimum delay between two attempts, whatever Retry-After says, in seconds.
_SHORTEST_PAUSE_S = 0.1

# Interval of keep-alive comments on an event stream, in seconds.
_KEEP_ALIVE_S = 15.0

_EVENTS: dict[str, type[JobStatus | PairDescribed | Job]] = {
    "state": JobStatus,
    "description": PairDescribed,
    "end": Job,
}


def _events(lines: Iterator[str]) -> Iterator[JobEvent]:
    """Parses server-sent events; skips comments and unknown event types."""
    name, data = "", []
    for line in (line.rstrip("\r\n") for line in lines):
        field, _, value = line.partition(":")
        if field == "event":
            name = value.removeprefix(" ")
        elif field == "data":
            data.append(value.removeprefix(" "))
        elif not line:
            if name in _EVENTS:
                event: JobEvent = _decode(_EVENTS[name], json.loads("\n".join(data)))
                yield event
            name, data = "", []


def _problem(response: httpx.Response) -> Problem:
    """Parses the problem of an error response, including one written by a proxy."""
    wait = response.headers.get("retry-after", "")
    retry_after_s = float(wait) if wait.isdecimal() else None
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, Mapping):
        body = {"detail": response.text[:200].strip() or "the response has no body"}
    return Problem(
        response.status_code,
        str(body.get("title", response.reason_phrase)),
        str(body.get("detail", "the server gave no reason")),
        type=str(body.get("type", "about:blank")),
        request_id=body.get("request_id") or response.headers.get("x-request-id"),
        retry_after_s=retry_after_s,
    )


def _read(response: httpx.Response, decode: Any) -> Any:
    try:
        return decode(response.json())
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        detail = f"{response.url} did not respond like a whereabouts server ({error!r}); is the URL right?"
        raise Problem(response.status_code, "Not understood", detail) from error


def _decode(kind: Any, value: Any) -> Any:
    """Converts JSON to one of the types above."""
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        given = {
            field.name: _decode(hints[field.name], value[field.name])
            for field in fields(kind)
            if field.name in value or field.default is MISSING
        }
        return kind(**given)
    options = [option for option in get_args(kind) if option is not type(None)]
    if value is None or not options:
        return _instant(value) if kind is datetime and value is not None else value
    if Ellipsis in options:
        return tuple(_decode(options[0], item) for item in value)
    if GeographicPose in options:
        return _decode(GeographicPose if "lat" in value else MetricPose, value)
    return _decode(options[0], value) if type(None) in get_args(kind) else value


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _instant(text: str) -> datetime:
    """Parses an RFC 3339 time, to the microsecond."""
    text = re.sub(r"\.(\d+)", lambda digits: "." + digits[1].ljust(6, "0")[:6], text)
    return datetime.fromisoformat(text.replace("Z", "+00:00"))


def _relative(moved: RelativePose) -> dict[str, object]:
    covariance = ",".join(map(repr, moved.covariance)) or None
    return _given(dx=moved.dx, dy=moved.dy, dyaw=moved.dyaw, covariance=covariance)


def _rfc3339(moment: datetime) -> str:
    if moment.tzinfo is None:
        raise ValueError("captured_at has no time zone; use, for example, datetime.now(timezone.utc)")
    return moment.isoformat()


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _deadline(ms: int | None) -> dict[str, str]:
    return {} if ms is None else {"X-Deadline-Ms": str(ms)}


def _segment(text: str) -> str:
    """Quotes a name or an id as one path segment. `.` and `..` would change the path."""
    if text in ("", ".", ".."):
        raise ValueError(f"{text!r} cannot be part of a URL path; use another id")
    return quote(text, safe="")


def _load(picture: Picture) -> tuple[str, bytes, str]:
    """Returns the file name, bytes and media type of a picture."""
    if isinstance(picture, bytes | bytearray | memoryview):
        name, data = "picture", bytes(picture)
    elif isinstance(picture, str | os.PathLike):
        name, data = Path(picture).name, Path(picture).read_bytes()
    else:
        name, data = "picture", _portable(picture)
    if data.startswith(b"\xff\xd8\xff"):
        return name, data, "image/jpeg"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return name, data, "image/png"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return name, data, "image/webp"
    # TIFF, BMP, GIF, PNM and whatever else: the server decides.
    return name, data, "application/octet-stream"


_LAYOUTS = {"mono8": "0", "rgb8": "012", "bgr8": "210", "rgba8": "012.", "bgra8": "210."}


def _portable(picture: object) -> bytes:
    """Writes pixels in memory as a portable anymap, which costs a copy and loses nothing but transparency."""
    if hasattr(picture, "encoding") and hasattr(picture, "step"):
        message = cast(ImageMessage, picture)
        layout = _LAYOUTS.get(message.encoding)
        if layout is None:
            known = ", ".join(_LAYOUTS)
            raise ValueError(f"the encoding {message.encoding!r} is none of {known}; convert the image first")
        width, height, step, data = message.width, message.height, message.step, bytes(message.data)
        row = width * len(layout)
        if step < row or len(data) < step * (height - 1) + row:
            size = f"{width} × {height} pixels of {message.encoding}"
            raise ValueError(f"{len(data)} bytes in rows of {step} are not {size}; check step and data")
        rows = b"".join(data[at * step : at * step + row] for at in range(height))
        return _anymap(width, height, layout, rows)
    if hasattr(picture, "convert") and hasattr(picture, "size"):
        rgb = cast(PilImage, picture).convert("RGB")
        width, height = rgb.size
        return _anymap(width, height, "012", rgb.tobytes())
    if hasattr(picture, "shape") and hasattr(picture, "tobytes"):
        array = cast(Pixels, picture)
        shape = array.shape if len(array.shape) == 3 else (*array.shape, 1)
        if str(array.dtype) != "uint8" or len(shape) != 3 or shape[2] not in (1, 3, 4):
            raise ValueError(
                f"an array of {array.dtype} with the shape {tuple(array.shape)} is no picture: pass 8-bit "
                "samples (uint8), height × width of grey, or height × width × 3 of RGB"
            )
        height, width, channels = shape
        layout = {1: "0", 3: "012", 4: "012."}[channels]
        return _anymap(width, height, layout, array.tobytes())
    raise TypeError(
        f"{type(picture).__name__} is no picture: pass the path or the bytes of a file, an array of uint8, "
        "an image of Pillow or a sensor_msgs/Image"
    )


def _anymap(width: int, height: int, layout: str, samples: bytes) -> bytes:
    """A PGM or PPM of samples whose channels have this order; `.` is left out."""
    if layout in ("0", "012"):
        ordered = samples
    else:
        wanted = bytearray(width * height * 3)
        for channel, target in enumerate(layout):
            if target != ".":
                wanted[int(target) :: 3] = samples[channel :: len(layout)]
        ordered = bytes(wanted)
    return b"P%d\n%d %d\n255\n" % (5 if layout == "0" else 6, width, height) + ordered
