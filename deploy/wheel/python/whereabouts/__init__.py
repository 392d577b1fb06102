"""The client of whereabouts, the service that localizes a robot from a single camera frame.

    from whereabouts import Client

    with Client("http://localhost:8080") as service:
        answer = service.localize("town", "frame.jpg", k=5)

The command `whereabouts`, which comes with this package, starts a server: `whereabouts serve`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from .client import (
    KEEP,
    Answer,
    CalibrationState,
    Candidate,
    Description,
    Estimate,
    GeographicPose,
    Health,
    Image,
    ImageAnswer,
    ImageMessage,
    Job,
    JobEvent,
    JobLink,
    JobState,
    JobStatus,
    JobVerdict,
    Keep,
    MapState,
    MapTexts,
    MetricPose,
    NamedSign,
    NoJob,
    PairDescribed,
    Picture,
    PilImage,
    Pixels,
    Pose,
    Problem,
    RankedCandidate,
    RefineMode,
    Refiner,
    Reindex,
    RelativePose,
    SeenSign,
    StandIn,
    TextLine,
    TimingMs,
    TrackEstimate,
    TrackHypothesis,
    TrackPlace,
    TrackWay,
    Usage,
    VocabularyState,
    Whereabouts,
    WordsAnswer,
    WordsCandidate,
    WordsEstimate,
    WordsTimingMs,
)

if TYPE_CHECKING:
    from typing_extensions import Self

Client = Whereabouts

P = ParamSpec("P")
T = TypeVar("T")


def _in_thread(
    method: Callable[Concatenate[Client, P], T],
) -> Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]]:
    async def call(self: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await asyncio.to_thread(method, self._client, *args, **kwargs)

    call.__name__, call.__doc__ = method.__name__, method.__doc__
    return call


class AsyncClient:
    """The same for asyncio: each call runs in a thread of the default executor. Arguments: those of `Client`.

    A call that is cancelled is not awaited any more, but its request may still be carried out.
    """

    def __init__(self, base_url: str = "http://localhost:8080", **settings: Any) -> None:
        self._client = Client(base_url, **settings)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    close = _in_thread(Client.close)
    health = _in_thread(Client.health)
    put_map = _in_thread(Client.put_map)
    map = _in_thread(Client.map)
    maps = _in_thread(Client.maps)
    track = _in_thread(Client.track)
    add_image = _in_thread(Client.add_image)
    update_image = _in_thread(Client.update_image)
    delete_image = _in_thread(Client.delete_image)
    localize = _in_thread(Client.localize)
    localize_text = _in_thread(Client.localize_text)
    job = _in_thread(Client.job)
    wait_for_job = _in_thread(Client.wait_for_job)

    async def images(self, map: str, *, page_size: int = 100) -> list[Image]:
        """Returns all images of a map, sorted by id."""
        return await asyncio.to_thread(lambda: list(self._client.images(map, page_size=page_size)))


__all__ = [
    "KEEP",
    "Answer",
    "AsyncClient",
    "CalibrationState",
    "Candidate",
    "Client",
    "Description",
    "Estimate",
    "GeographicPose",
    "Health",
    "Image",
    "ImageAnswer",
    "ImageMessage",
    "Job",
    "JobEvent",
    "JobLink",
    "JobState",
    "JobStatus",
    "JobVerdict",
    "Keep",
    "MapState",
    "MapTexts",
    "MetricPose",
    "NamedSign",
    "NoJob",
    "PairDescribed",
    "Picture",
    "PilImage",
    "Pixels",
    "Pose",
    "Problem",
    "RankedCandidate",
    "RefineMode",
    "Refiner",
    "Reindex",
    "RelativePose",
    "SeenSign",
    "StandIn",
    "TextLine",
    "TimingMs",
    "TrackEstimate",
    "TrackHypothesis",
    "TrackPlace",
    "TrackWay",
    "Usage",
    "VocabularyState",
    "Whereabouts",
    "WordsAnswer",
    "WordsCandidate",
    "WordsEstimate",
    "WordsTimingMs",
]
