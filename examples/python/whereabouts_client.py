"""A client of whereabouts, the service that tells a robot where it is from one camera frame.

    with Whereabouts("http://localhost:8080") as service:
        answer = service.localize("town", "frame.jpg", k=5)
        print(answer.estimate)
        if answer.job:
            print(service.wait_for_job(answer.job.id, 60).estimate)

It needs Python 3.10 and httpx, and is one file: copy it. A client may be used by several threads at once.
The classes are those of the service's description (`GET /openapi.json`), under the same names; fields that
a newer server adds are ignored.
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
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, get_args, get_type_hints
from urllib.parse import quote

import httpx

if TYPE_CHECKING:
    from typing_extensions import Self

Scene: TypeAlias = Literal["outdoor", "indoor"]
Frame: TypeAlias = Literal["wgs84", "metric"]
DescriptorKind: TypeAlias = Literal["gem", "cls"]
RefineMode: TypeAlias = Literal["async", "wait", "off"]
Priority: TypeAlias = Literal["low", "normal", "high"]
JobState: TypeAlias = Literal["queued", "running", "succeeded", "degraded", "failed", "cancelled"]

T = TypeVar("T")

Picture: TypeAlias = "bytes | str | os.PathLike[str]"
"""A JPEG, PNG or WebP picture: its bytes, or the path of its file."""


class Problem(Exception):
    """A call that failed: the server's RFC 9457 problem, or why there was no answer at all (status 0).

    A problem with status 0 or 503 leaves open whether the server did what it was asked.
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
        """The HTTP status; 0 if there was no answer."""
        self.title = title
        self.detail = detail
        """What happened and what to do next."""
        self.type = type
        self.request_id = request_id
        """As in the server's log."""
        self.retry_after_s = retry_after_s
        """After how many seconds it is worth trying again, if the server said so."""


@dataclass(frozen=True)
class GeographicPose:
    """A pose on the globe (WGS84)."""

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
    """A pose in a map's own frame: metres, and a unit quaternion of which all parts are given or none."""

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
    """Pixels, as shown (after the EXIF orientation)."""
    height: int
    created_at: datetime
    pose: Pose | None = None
    captured_at: datetime | None = None
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class CalibrationState:
    """What confidence in a map rests on."""

    images: int
    """Images that the map had when it was measured."""
    asked: int
    """Images that were asked as if they were frames."""
    refined: int
    """Of these, how many were refined too."""


@dataclass(frozen=True)
class Reindex:
    """How far the last reindex of a map has come."""

    model: str
    descriptor: DescriptorKind
    state: Literal["running", "succeeded", "failed"]
    done: int
    total: int
    started_at: datetime
    error: str | None = None
    finished_at: datetime | None = None


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
    """Numbers in a descriptor."""
    images: int
    index: Literal["exact", "building", "hnsw"]
    created_at: datetime
    reindex: Reindex | None = None
    calibration: CalibrationState | None = None
    """None until it is measured, a moment after images were added; until then every confidence is 0."""
    description: str | None = None


@dataclass(frozen=True)
class Candidate:
    """A reference image that looks like the frame."""

    rank: int
    """Its place in the coarse order; 1 is the most similar."""
    image_id: str
    similarity: float
    """Cosine similarity of its descriptor to the frame's, -1 to 1."""
    pose: Pose | None = None


@dataclass(frozen=True)
class Estimate:
    """The best guess of where a frame was taken."""

    image_id: str
    confidence: float
    """0 to 1: of frames from outside the map, at most the rest to 1 get so much."""
    known: bool
    """Whether the confidence reaches the server's bound; below it the place is perhaps not in the map."""
    pose: Pose | None = None


@dataclass(frozen=True)
class JobLink:
    """Where to find a job."""

    id: str
    href: str
    state: JobState


@dataclass(frozen=True)
class NoJob:
    """Why an answer has no job, although one was asked for."""

    reason: Literal["no_refiner", "empty_map", "queue_full", "overload", "disk_full"]
    detail: str


@dataclass(frozen=True)
class TimingMs:
    """How long the stages of an answer took in the server, in milliseconds."""

    decode: float
    extract: float
    search: float
    total: float


@dataclass(frozen=True)
class TrackEstimate:
    """Where a robot is, given all frames of its track."""

    id: str
    frames: int
    """Frames of the track so far, this one included."""
    probability: float
    """0 to 1: that the robot is within the size of a place of the image, as the filter sees it."""
    known: bool
    image_id: str | None = None
    """The most probable image; None as long as none is likely."""
    pose: Pose | None = None


@dataclass(frozen=True)
class Answer:
    """Where a frame was probably taken."""

    query_id: str
    map: str
    model: str
    candidates: tuple[Candidate, ...]
    """The most similar images, best first."""
    timing_ms: TimingMs
    estimate: Estimate | None = None
    """None in an empty map."""
    job: JobLink | None = None
    """The refinement, if there is one."""
    no_job: NoJob | None = None
    track: TrackEstimate | None = None
    """None for a frame of no track."""


@dataclass(frozen=True)
class Usage:
    """What a refinement cost."""

    calls: int
    cached: int
    prompt_tokens: int
    completion_tokens: int
    estimated: int = 0
    """Of the calls, those whose tokens are a guess."""


@dataclass(frozen=True)
class StandIn:
    """An earlier frame that is nearly the same."""

    query_id: str
    similarity: float


@dataclass(frozen=True)
class Description:
    """The text that compares the frame with one candidate."""

    image_id: str
    text: str
    cached: bool
    usage: Usage
    stands_in: StandIn | None = None
    took_ms: int | None = None
    """Milliseconds that the model took to write it; None for a text that was known."""


@dataclass(frozen=True)
class RankedCandidate:
    """A candidate after refinement."""

    rank: int
    """Its place in the refined order; 1 is the most likely same place."""
    image_id: str
    coarse_rank: int
    pose: Pose | None = None


@dataclass(frozen=True)
class Job:
    """One refinement."""

    id: str
    map: str
    query_id: str
    refiner: Literal["local", "mllm"]
    state: JobState
    created_at: datetime
    attempts: int
    descriptions: tuple[Description, ...]
    usage: Usage
    priority: Priority = "normal"
    started_at: datetime | None = None
    finished_at: datetime | None = None
    ranking: tuple[RankedCandidate, ...] | None = None
    """The refined order, once there is one. The server may compare more candidates than it answered."""
    reasoning: str | None = None
    reasoning_took_ms: int | None = None
    """Milliseconds that the call took which ordered the candidates, if there was one."""
    estimate: Estimate | None = None
    """Where the frame was probably taken, by the refined order."""
    error: str | None = None
    trace_id: str | None = None
    """The trace of its request and its refinement, where the server sends traces."""

    @property
    def ended(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.state not in ("queued", "running")


@dataclass(frozen=True)
class JobStatus:
    """Event: a job's state or attempt has changed."""

    state: JobState
    attempts: int
    error: str | None = None


@dataclass(frozen=True)
class PairDescribed:
    """Event: one more pair of a job is described."""

    described: int
    of: int
    description: Description


JobEvent: TypeAlias = JobStatus | PairDescribed | Job


@dataclass(frozen=True)
class Health:
    """What a server says of itself."""

    ready: bool
    """Whether it takes requests."""
    detail: str
    """`ready`, or why not."""


class Whereabouts:
    """A server. Every call raises `Problem` when it fails.

    `api_key` is sent as a bearer token, where a key is wanted. `timeout_s` bounds each wait for the server
    within a call, on top of the time that the call itself asks the server to wait.

    `retry_for_s` is how many seconds a call may spend on being refused: after 429, or 503 with
    `Retry-After`, it is sent again as soon as that says, if that is within this time. 0, the default, never
    sends anything twice. A call that may have been carried out and would be carried out twice (`localize`
    and `delete_image` after 503) is never sent again.
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
            raise ValueError(f"{base_url!r} is not an address of a server; give http://HOST:PORT")
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
        """Whether the server takes requests. One that is not there is a `Problem` with status 0."""
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
        description: str | None = None,
    ) -> MapState:
        """Creates a map, or changes one. What is left out keeps its value, or its default in a new map."""
        change = _given(
            scene=scene, frame=frame, descriptor=descriptor, model=model, description=description
        )
        return self._call(MapState, "PUT", f"/maps/{_segment(map)}", json=change)

    def map(self, map: str) -> MapState:
        """One map."""
        return self._call(MapState, "GET", f"/maps/{_segment(map)}")

    def maps(self) -> list[MapState]:
        """All maps, by name."""
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
        deadline_ms: int | None = None,
    ) -> Image:
        """Adds an image to a map. The same id with the same bytes again is welcome; with others it is 409."""
        name, data, media_type = _load(picture)
        meta = _given(
            id=id,
            pose=_given(**asdict(pose)) if pose else None,
            captured_at=_rfc3339(captured_at) if captured_at else None,
            tags=list(tags) or None,
        )
        return self._call(
            Image,
            "POST",
            f"/maps/{_segment(map)}/images",
            repeatable=True,
            headers=_deadline(deadline_ms),
            files={
                "image": (name, data, media_type),
                "meta": ("meta.json", json.dumps(meta).encode(), "application/json"),
            },
        )

    def images(self, map: str, *, page_size: int = 100) -> Iterator[Image]:
        """The images of a map, by id; asks for a page when it is needed."""
        cursor: str | None = None
        while True:
            params = _given(limit=page_size, cursor=cursor)
            response = self._send("GET", f"/maps/{_segment(map)}/images", params=params)
            yield from _read(response, lambda body: _decode(tuple[Image, ...], body["images"]))
            cursor = response.json()["next_cursor"]
            if cursor is None:
                return

    def delete_image(self, map: str, id: str) -> None:
        """Removes an image from a map."""
        self._send("DELETE", f"/maps/{_segment(map)}/images/{_segment(id)}", repeatable=False)

    def localize(
        self,
        map: str,
        frame: Picture,
        *,
        k: int | None = None,
        refine: RefineMode = "async",
        priority: Priority | None = None,
        track: str | None = None,
        captured_at: datetime | None = None,
        moved_m: float | None = None,
        deadline_ms: int | None = None,
        idempotency_key: str | None = None,
    ) -> Answer:
        """Localizes a frame: the `k` most similar images of the map, and a job that orders them anew.

        `refine="wait"` answers when the job has ended, `"off"` makes none. `deadline_ms` tells the server
        for how many milliseconds the answer is of use, from the arrival of the request: it then refuses
        at once (429) what it cannot answer in time, and gives up (504) what takes longer.

        A robot that names its `track`, an id of its own choice, also hears where it is given all frames of
        that track. `captured_at` is then when the frame was taken, by default when it came, and `moved_m`
        how many metres the robot has come since the frame before, by its odometry.

        With an `idempotency_key`, a text that no other request has, the same frame can be sent again
        after an answer was lost, and gets its first answer: no second job. `retry_for_s` then does so
        after 503 too.
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
                priority=priority,
                track=track,
                captured_at=_rfc3339(captured_at) if captured_at else None,
                moved_m=moved_m,
            ),
            headers={
                "Content-Type": media_type,
                **_deadline(deadline_ms),
                **({"Idempotency-Key": idempotency_key} if idempotency_key else {}),
            },
            repeatable=idempotency_key is not None,
            content=data,
        )

    def job(self, id: str, *, wait_s: float = 0.0) -> Job:
        """A job. With `wait_s` the server answers when it has ended, or after so many seconds (at most 60
        with its default settings)."""
        params = {"wait": wait_s} if wait_s > 0 else {}
        return self._call(Job, "GET", f"/jobs/{_segment(id)}", wait_s=wait_s, params=params)

    def wait_for_job(self, id: str, timeout_s: float, *, poll_s: float = 20.0) -> Job:
        """The job once it has ended, or as it is after `timeout_s` seconds: look at `ended`.

        It asks the server to wait, for at most `poll_s` seconds at a time.
        """
        end = time.monotonic() + timeout_s
        while True:
            job = self.job(id, wait_s=max(0.0, min(end - time.monotonic(), poll_s)))
            if job.ended or time.monotonic() >= end:
                return job

    def job_events(self, id: str) -> Iterator[JobEvent]:
        """Follows a job: what has happened, then what happens, and at last the `Job` that has ended.

        A stream that breaks off before that is a `Problem` with status 0; ask again, all of it is told anew.
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
        raise Problem(0, "Stream ended", "the server ended the events before the job; follow it again")

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
        """Sends a request, again where that is allowed: 429 says that nothing was done, 503 does not."""
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
            detail = f"{url} was silent for too long; allow more time (timeout_s), or look at its GET /readyz"
            return Problem(0, "No answer in time", detail)
        return Problem(0, "No answer", f"the connection to {url} broke ({error!r}); try again")


# The longest that a server holds back an answer with its default settings, in seconds (jobs.max_wait_s).
_LONGEST_WAIT_S = 60.0

# Between two tries, whatever Retry-After says, in seconds.
_SHORTEST_PAUSE_S = 0.1

# An event stream is never silent for longer, in seconds.
_KEEP_ALIVE_S = 15.0

_EVENTS: dict[str, type[JobStatus | PairDescribed | Job]] = {
    "state": JobStatus,
    "description": PairDescribed,
    "end": Job,
}


def _events(lines: Iterator[str]) -> Iterator[JobEvent]:
    """Server-sent events; comments and kinds that this client does not know are passed over."""
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
    """The problem in an answer, also where a proxy on the way wrote it."""
    wait = response.headers.get("retry-after", "")
    retry_after_s = float(wait) if wait.isdecimal() else None
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, Mapping):
        body = {"detail": response.text[:200].strip() or "the answer has no body"}
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
        detail = f"{response.url} answers, but not as whereabouts does ({error!r}); is the URL right?"
        raise Problem(response.status_code, "Not understood", detail) from error


def _decode(kind: Any, value: Any) -> Any:
    """JSON as a value of one of the types above."""
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
    """A moment of RFC 3339, to the microsecond."""
    text = re.sub(r"\.(\d+)", lambda digits: "." + digits[1].ljust(6, "0")[:6], text)
    return datetime.fromisoformat(text.replace("Z", "+00:00"))


def _rfc3339(moment: datetime) -> str:
    if moment.tzinfo is None:
        raise ValueError("captured_at has no time zone; use datetime.now(timezone.utc) or the like")
    return moment.isoformat()


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _deadline(ms: int | None) -> dict[str, str]:
    return {} if ms is None else {"X-Deadline-Ms": str(ms)}


def _segment(text: str) -> str:
    """A name or an id within a path. `.` and `..` would change which path it is."""
    if text in ("", ".", ".."):
        raise ValueError(f"{text!r} cannot be asked for by its address; use another id")
    return quote(text, safe="")


def _load(picture: Picture) -> tuple[str, bytes, str]:
    """File name, bytes and media type of a picture."""
    if isinstance(picture, bytes):
        name, data = "picture", picture
    else:
        name, data = Path(picture).name, Path(picture).read_bytes()
    if data.startswith(b"\xff\xd8\xff"):
        return name, data, "image/jpeg"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return name, data, "image/png"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return name, data, "image/webp"
    raise ValueError(f"{name} is not a JPEG, PNG or WebP picture")
