"""Tests the server with a gRPC client that learns the contract only through reflection."""

import contextlib
import functools
import json
import os
import pathlib
import signal
import subprocess
import tempfile
import threading
import time
import unittest
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import grpc
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.rpc import error_details_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)
from grpc_status import rpc_status

TOWN = pathlib.Path(os.environ["TOWN"])
URL = os.environ["URL"]
KEY = json.loads(pathlib.Path(os.environ["KEY"]).read_text())["token"]
ADDRESS = URL.removeprefix("http://")
PACKAGE = "whereabouts.v1"


class Services:
    """The services of a server, discovered through reflection."""

    def __init__(self, key: str | None) -> None:
        self.channel = grpc.insecure_channel(ADDRESS)
        self.metadata = [("authorization", f"Bearer {key}")] if key else []
        admin = grpc.intercept_channel(grpc.insecure_channel(ADDRESS), WithKey(KEY))
        self.database = ProtoReflectionDescriptorDatabase(admin)
        self.pool = DescriptorPool(self.database)

    def message(self, name: str, **fields: Any) -> Any:
        return GetMessageClass(self.pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))(**fields)

    def call(self, service: str, method: str, request: Any, **options: Any) -> Any:
        """Calls a method; `request` is a message, or an iterator of messages for a client stream."""
        about = self.pool.FindServiceByName(f"{PACKAGE}.{service}").FindMethodByName(method)
        shapes = {
            (False, False): self.channel.unary_unary,
            (False, True): self.channel.unary_stream,
            (True, False): self.channel.stream_unary,
            (True, True): self.channel.stream_stream,
        }
        make = shapes[(about.client_streaming, about.server_streaming)]
        answer = GetMessageClass(about.output_type)
        function = make(
            f"/{PACKAGE}.{service}/{method}",
            request_serializer=lambda message: message.SerializeToString(),
            response_deserializer=answer.FromString,
        )
        return function(request, metadata=self.metadata, timeout=options.get("timeout", 30))


class WithKey(grpc.StreamStreamClientInterceptor):
    """Adds an API key to the calls of reflection."""

    def __init__(self, key: str) -> None:
        self.key = key

    def intercept_stream_stream(self, continuation: Any, details: Any, requests: Any) -> Any:
        metadata = [("authorization", f"Bearer {self.key}")]
        return continuation(details._replace(metadata=metadata), requests)


def pictures(folder: str) -> list[tuple[str, bytes]]:
    return [(file.stem, file.read_bytes()) for file in sorted((TOWN / folder).glob("*.jpg"))]


def poses() -> dict[str, dict[str, float]]:
    lines = (TOWN / "map" / "poses.csv").read_text().splitlines()
    fields = lines[0].split(",")[1:]
    rows = (line.split(",") for line in lines[1:])
    return {
        row[0].removesuffix(".jpg"): dict(zip(fields, map(float, row[1:]), strict=True))
        for row in rows
    }


def over_http(method: str, path: str, body: bytes | None = None, kind: str = "image/jpeg") -> Any:
    headers = {"Authorization": f"Bearer {KEY}", "Content-Type": kind}
    request = urllib.request.Request(URL + path, method=method, data=body, headers=headers)
    with urllib.request.urlopen(request, timeout=60) as response:
        text = response.read()
    return json.loads(text) if text else None


def make_key(**wanted: Any) -> tuple[str, str]:
    """Creates an API key; returns its id and token."""
    made = over_http("POST", "/keys", json.dumps(wanted).encode(), "application/json")
    return made["key"]["id"], made["token"]


class Contract(unittest.TestCase):
    services: Services

    @classmethod
    def setUpClass(cls) -> None:
        cls.services = Services(KEY)
        message, call = cls.services.message, cls.services.call
        made = call("MapService", "PutMap", message("PutMapRequest", map="town", scene=2))
        assert made.created and made.map.name == "town" and made.map.images == 0, made
        again = call("MapService", "PutMap", message("PutMapRequest", map="town", description="x"))
        assert not again.created and again.map.description == "x" and again.map.scene == 2, again

        def images() -> Iterator[Any]:
            where = poses()
            for index, (name, picture) in enumerate(pictures("map")):
                pose = message("Pose", geographic=message("GeographicPose", **where[name]))
                named = "town" if index == 0 else ""
                yield message("AddImagesRequest", map=named, id=name, image=picture, pose=pose)
                if index == 3:
                    yield message("AddImagesRequest", id="broken", image=b"no picture")
                    yield message("AddImagesRequest", id=name, image=picture)
                    yield message("AddImagesRequest", map="other", id="x", image=picture)
                    bad = message("Pose", geographic=message("GeographicPose", lat=91))
                    yield message("AddImagesRequest", id="pole", image=picture, pose=bad)

        cls.added = call("MapService", "AddImages", images()).results
        deadline = time.monotonic() + 30
        while over_http("GET", "/maps/town")["calibration"] is None:
            assert time.monotonic() < deadline, "the map was not calibrated"
            time.sleep(0.2)

    def call(self, service: str, method: str, request: Any, **options: Any) -> Any:
        return self.services.call(service, method, request, **options)

    def message(self, name: str, **fields: Any) -> Any:
        return self.services.message(name, **fields)

    def refused(self, code: grpc.StatusCode, call: Any) -> grpc.RpcError:
        with self.assertRaises(grpc.RpcError) as raised:
            answer = call()
            if hasattr(answer, "__next__"):
                list(answer)
        self.assertEqual(raised.exception.code(), code, raised.exception)
        return raised.exception

    def test_reflection_names_all_services(self) -> None:
        names = set(self.services.database.get_services())
        expected = {f"{PACKAGE}.{name}Service" for name in ("Localization", "Map", "Job")}
        self.assertLessEqual(expected | {"grpc.health.v1.Health"}, names)

    def test_every_image_of_a_stream_gets_its_own_result(self) -> None:
        outcomes = [(result.id, result.WhichOneof("outcome")) for result in self.added]
        names = [name for name, _ in pictures("map")]
        expected = [(name, "stored") for name in names]
        expected[4:4] = [("broken", "problem"), (names[3], "stored"), ("", "problem"), ("pole", "problem")]
        self.assertEqual(outcomes, expected)
        by_place = {index: result for index, result in enumerate(self.added)}
        self.assertEqual(by_place[4].problem.kind, "unprocessable")
        self.assertTrue(by_place[5].stored.present and not by_place[3].stored.present)
        self.assertIn("one map", by_place[6].problem.detail)
        self.assertIn("lat is 91", by_place[7].problem.detail)
        self.assertEqual(over_http("GET", "/maps/town")["images"], len(names))

    def test_an_image_is_corrected_by_an_update_or_by_adding_it_again(self) -> None:
        call, message = self.call, self.message
        _, picture = pictures("map")[0]
        call("MapService", "PutMap", message("PutMapRequest", map="moved", frame=2))

        def metric(x: float) -> Any:
            return message("Pose", metric=message("MetricPose", x=x, y=2))

        def add(**fields: Any) -> Any:
            request = message("AddImagesRequest", map="moved", id="a", image=picture, **fields)
            return call("MapService", "AddImages", iter([request])).results[0].stored

        def update(**fields: Any) -> Any:
            request = message("UpdateImageRequest", map="moved", id="a", **fields)
            return call("MapService", "UpdateImage", request)

        self.assertEqual((add(pose=metric(1)).present, list(add().changed)), (False, []))
        again = add(pose=metric(3), tags=["x"])
        self.assertEqual((again.present, list(again.changed)), (True, ["pose", "tags"]))
        moved = update(pose=metric(5))
        self.assertEqual((list(moved.changed), moved.image.pose.metric.x), (["pose"], 5))
        self.assertEqual((moved.image.id, list(moved.image.tags)), ("a", ["x"]))
        mask = {"update_mask": {"paths": ["pose", "tags"]}}
        bare = update(**mask)
        self.assertEqual(list(bare.changed), ["pose", "tags"])
        self.assertFalse(bare.image.HasField("pose") or bare.image.tags)
        self.assertEqual(over_http("GET", "/maps/moved/images/a")["pose"], None)
        # Without poses, the map can change its coordinate frame.
        call("MapService", "PutMap", message("PutMapRequest", map="moved", frame=1))
        wrong = message("UpdateImageRequest", map="moved", id="a", pose=metric(1))
        refusal = self.refused(
            grpc.StatusCode.INVALID_ARGUMENT, lambda: call("MapService", "UpdateImage", wrong)
        )
        self.assertIn("unknown field `x`", refusal.details())
        missing = message("UpdateImageRequest", map="moved", id="b")
        self.refused(grpc.StatusCode.NOT_FOUND, lambda: call("MapService", "UpdateImage", missing))
        call("MapService", "DeleteMap", message("DeleteMapRequest", map="moved"))

    def test_a_frame_gets_the_same_answer_as_over_http(self) -> None:
        frame = pictures("frames")[0][1]
        request = self.message("LocalizeRequest", map="town", image=frame, k=5, refine=3)
        answer = self.call("LocalizationService", "Localize", request)
        same = over_http("POST", "/localize?map=town&k=5&refine=off", frame)
        candidates = [(c.rank, c.image_id, round(c.similarity, 5)) for c in answer.candidates]
        expected = [(c["rank"], c["image_id"], round(c["similarity"], 5)) for c in same["candidates"]]
        self.assertEqual(candidates, expected)
        self.assertEqual(answer.estimate.image_id, same["estimate"]["image_id"])
        confidence = same["estimate"]["confidence"]
        # It may be measured between the two requests, and is absent before.
        if confidence is not None and answer.estimate.HasField("confidence"):
            self.assertAlmostEqual(answer.estimate.confidence, confidence, 5)
        pose = answer.estimate.pose.geographic
        self.assertEqual((pose.lat, pose.lon), tuple(same["estimate"]["pose"][f] for f in ("lat", "lon")))
        self.assertFalse(answer.HasField("job") or answer.HasField("track"))
        self.assertGreater(answer.timing.total_ms, 0)

    def test_images_are_found_by_the_text_in_them_like_over_http(self) -> None:
        deadline = time.monotonic() + 60
        while over_http("GET", "/maps/town")["texts"]["waiting"]:
            assert time.monotonic() < deadline, "the images were not read"
            time.sleep(0.2)
        counts = over_http("GET", "/maps/town")["texts"]
        of_map = self.call("MapService", "GetMap", self.message("GetMapRequest", map="town")).map.texts
        self.assertEqual(
            (of_map.reader, of_map.read, of_map.lines), (counts["reader"], counts["read"], counts["lines"])
        )
        images = over_http("GET", "/maps/town/images")["images"]
        states = [over_http("GET", f"/maps/town/images/{image['id']}") for image in images]
        lines = [line["text"] for state in states for line in state["texts"]["lines"]]
        sign = next(text for text in lines if len(text) > 5)
        expected, found, cursor = over_http("GET", f"/maps/town/images?text={quote(sign)}")["matches"], [], ""
        while cursor or not found:
            asked = self.message("FindImagesRequest", map="town", text=sign, limit=1, cursor=cursor)
            page = self.call("MapService", "FindImages", asked)
            found += [(one.image.id, one.score, [line.text for line in one.lines]) for one in page.found]
            cursor = page.next_cursor
        lines = [[line["text"] for line in one["lines"]] for one in expected]
        self.assertEqual([one[0] for one in found], [one["image_id"] for one in expected])
        self.assertEqual([one[2] for one in found], lines)
        best = page.found[0].lines[0].corners
        self.assertTrue(len(best) == 4 and all(0 <= at.x <= 1 and 0 <= at.y <= 1 for at in best), best)
        for wrong in ("", "!!", "x" * 101):
            message = self.message("FindImagesRequest", map="town", text=wrong)
            find = functools.partial(self.call, "MapService", "FindImages", message)
            refused = self.refused(grpc.StatusCode.INVALID_ARGUMENT, find)
            self.assertIn("text has", refused.details())

    def test_a_track_accumulates_frames(self) -> None:
        for number, (_, frame) in enumerate(pictures("frames")[:3], 1):
            track = self.message("Track", id="robot-7", moved_m=1.0)
            request = self.message("LocalizeRequest", map="town", image=frame, refine=3, track=track)
            answer = self.call("LocalizationService", "Localize", request)
            self.assertEqual((answer.track.id, answer.track.frames), ("robot-7", number))
        frame = pictures("frames")[3][1]
        moved = self.message("RelativePose", dx=1.0, dy=0.0, dyaw=0.1, covariance=[0.1, 0.1, 0.01])
        for wrong in (False, True):
            odometry = {"moved": moved, **({"moved_m": 1.0} if wrong else {})}
            track = self.message("Track", id="robot-7", **odometry)
            request = self.message("LocalizeRequest", map="town", image=frame, refine=3, track=track)
            call = lambda request=request: self.call("LocalizationService", "Localize", request)
            if wrong:
                self.refused(grpc.StatusCode.INVALID_ARGUMENT, call)
            else:
                self.assertEqual(call().track.frames, 4)

    def test_an_answer_that_waited_has_the_refined_order(self) -> None:
        frame = pictures("frames")[2][1]
        for refine, has_order in ((2, True), (3, False)):
            request = self.message("LocalizeRequest", map="town", image=frame, refine=refine)
            answer = self.call("LocalizationService", "Localize", request)
            self.assertEqual(len(answer.ranking) >= len(answer.candidates) > 0, has_order)
            if has_order:
                self.assertEqual(answer.ranking[0].image_id, answer.estimate.image_id)

    def test_a_job_can_be_watched_until_it_ends(self) -> None:
        frame = pictures("frames")[1][1]
        request = self.message("LocalizeRequest", map="town", image=frame)
        job = self.call("LocalizationService", "Localize", request).job
        watch = self.message("WatchJobRequest", id=job.id)
        events = [event.WhichOneof("event") for event in self.call("JobService", "WatchJob", watch)]
        self.assertEqual(events[-1], "ended")
        self.assertIn("described", events)
        ended = self.call("JobService", "GetJob", self.message("GetJobRequest", id=job.id, wait_s=20)).job
        same = over_http("GET", f"/jobs/{job.id}")
        self.assertEqual(ended.state, 3)
        self.assertEqual([c.image_id for c in ended.ranking], [c["image_id"] for c in same["ranking"]])
        self.assertEqual([d.text for d in ended.descriptions], [d["text"] for d in same["descriptions"]])
        took = [description["took_ms"] for description in same["descriptions"]]
        self.assertEqual([description.took_ms for description in ended.descriptions], took)
        self.assertTrue(all(d.HasField("took_ms") for d in ended.descriptions))
        self.assertFalse(ended.HasField("reasoning_took_ms"))
        self.assertEqual(ended.finished_at.ToJsonString()[:19], same["finished_at"][:19])
        page = self.call("JobService", "ListJobs", self.message("ListJobsRequest", map="town", page_size=1))
        self.assertEqual(len(page.jobs), 1)
        search = self.message("ListJobsRequest", text=job.id.upper())
        self.assertEqual([found.id for found in self.call("JobService", "ListJobs", search).jobs], [job.id])
        search = self.message("ListJobsRequest", map="town", text="no job says so")
        self.assertEqual(list(self.call("JobService", "ListJobs", search).jobs), [])
        search = self.message("ListJobsRequest", text="a" * 201)
        self.refused(grpc.StatusCode.INVALID_ARGUMENT, lambda: self.call("JobService", "ListJobs", search))
        retry = self.message("RetryJobRequest", id=job.id)
        self.refused(grpc.StatusCode.FAILED_PRECONDITION, lambda: self.call("JobService", "RetryJob", retry))
        cancel = self.message("CancelJobRequest", id=job.id)
        self.assertEqual(self.call("JobService", "CancelJob", cancel).job.state, 3)

    def test_the_newest_frame_wins(self) -> None:
        frames = [frame for _, frame in pictures("frames")]
        count = 80

        def fast() -> Iterator[Any]:
            for number in range(1, count + 1):
                frame = self.message(
                    "LocalizeRequest", map="town", image=frames[number % len(frames)], refine=3
                )
                yield self.message("LocalizeStreamRequest", frame_number=number, frame=frame)
                time.sleep(0.001)

        answers = list(self.call("LocalizationService", "LocalizeStream", fast()))
        numbers = [answer.frame_number for answer in answers]
        self.assertEqual(numbers, sorted(numbers))
        self.assertEqual(numbers[-1], count, "the last frame is answered")
        self.assertEqual(sum(answer.skipped for answer in answers) + len(answers), count)
        self.assertGreater(sum(answer.skipped for answer in answers), 0)
        before = [0, *numbers[:-1]]
        for answer, last in zip(answers, before, strict=True):
            self.assertEqual(answer.skipped, answer.frame_number - last - 1)
            self.assertEqual(answer.WhichOneof("outcome"), "answer")

    def test_a_bad_frame_does_not_end_a_stream(self) -> None:
        frame = pictures("frames")[0][1]
        good = self.message("LocalizeRequest", map="town", image=frame, refine=3)
        turn = threading.Semaphore(1)

        def one_by_one() -> Iterator[Any]:
            bad = self.message("LocalizeRequest", map="town", image=b"no picture")
            nowhere = self.message("LocalizeRequest", map="nowhere", image=frame)
            for number, request in enumerate([good, bad, None, nowhere, good]):
                turn.acquire()
                yield self.message("LocalizeStreamRequest", frame_number=number, frame=request)

        outcomes = []
        for answer in self.call("LocalizationService", "LocalizeStream", one_by_one()):
            outcomes.append(answer.problem.kind or "answer")
            turn.release()
        self.assertEqual(outcomes, ["answer", "unprocessable", "malformed", "not-found", "answer"])

    def test_errors_have_the_documented_code_and_reason(self) -> None:
        frame = pictures("frames")[0][1]
        for code, reason, fields in [
            (grpc.StatusCode.NOT_FOUND, "NOT_FOUND", {"map": "nowhere", "image": frame}),
            (grpc.StatusCode.INVALID_ARGUMENT, "MALFORMED", {"map": "No Name", "image": frame}),
            (grpc.StatusCode.INVALID_ARGUMENT, "MALFORMED", {"map": "town"}),
            (grpc.StatusCode.INVALID_ARGUMENT, "MALFORMED", {"map": "town", "image": frame, "refine": 9}),
            (grpc.StatusCode.INVALID_ARGUMENT, "UNPROCESSABLE", {"map": "town", "image": frame, "k": 0}),
            (grpc.StatusCode.INVALID_ARGUMENT, "UNPROCESSABLE", {"map": "town", "image": b"no picture"}),
            (grpc.StatusCode.OUT_OF_RANGE, "TOO_LARGE", {"map": "town", "image": bytes(2_000_001)}),
        ]:
            request = self.message("LocalizeRequest", **fields)
            error = self.refused(code, lambda r=request: self.call("LocalizationService", "Localize", r))
            info = error_details_pb2.ErrorInfo()
            [detail] = [d for d in rpc_status.from_call(error).details if d.Is(info.DESCRIPTOR)]
            detail.Unpack(info)
            self.assertEqual((info.reason, info.domain), (reason, "whereabouts"))
            self.assertGreater(len(error.details()), 10)

    def test_an_unknown_method_is_unimplemented(self) -> None:
        for path in [f"/{PACKAGE}.JobService/Nothing", "/some.Other/Thing"]:
            call = self.services.channel.unary_unary(path)
            self.refused(
                grpc.StatusCode.UNIMPLEMENTED,
                lambda c=call: c(b"", metadata=self.services.metadata, timeout=5),
            )

    def test_a_plain_post_is_not_a_call(self) -> None:
        for path in [f"/{PACKAGE}.JobService/WatchJob", f"/{PACKAGE}.JobService/GetJob"]:
            with self.assertRaises(urllib.error.HTTPError) as raised:
                over_http("POST", path, b"")
            self.assertEqual(raised.exception.code, 415)

    def test_deadlines_are_enforced(self) -> None:
        frame = pictures("frames")[0][1]
        request = self.message("LocalizeRequest", map="town", image=frame)
        begun = time.monotonic()
        self.refused(
            grpc.StatusCode.DEADLINE_EXCEEDED,
            lambda: self.call("LocalizationService", "Localize", request, timeout=0.001),
        )
        silent = threading.Event()

        def nothing() -> Iterator[Any]:
            silent.wait(20)
            yield from ()

        self.refused(
            grpc.StatusCode.DEADLINE_EXCEEDED,
            lambda: self.call("LocalizationService", "LocalizeStream", nothing(), timeout=0.5),
        )
        self.assertLess(time.monotonic() - begun, 3)
        error = self.refused(
            grpc.StatusCode.DEADLINE_EXCEEDED,
            lambda: self.call("LocalizationService", "LocalizeStream", nothing()),
        )
        self.assertIn("server.stream_idle_s", error.details())
        silent.set()

    def test_a_cancelled_stream_frees_its_slot(self) -> None:
        def watch() -> Any:
            # A separate connection, because one has at most server.max_concurrent calls.
            own = [("grpc.use_local_subchannel_pool", 1)]
            health = health_pb2_grpc.HealthStub(grpc.insecure_channel(ADDRESS, own))
            asked = health_pb2.HealthCheckRequest()
            return health.Watch(asked, metadata=self.services.metadata, timeout=30)

        streams = [watch() for _ in range(300)]
        # 256 may be open (server.max_streams); the rest are refused.
        codes = []
        for stream in streams:
            try:
                self.assertEqual(next(stream).status, health_pb2.HealthCheckResponse.SERVING)
            except grpc.RpcError as error:
                codes.append(error.code())
                self.assertIn("server.max_streams", error.details())
            if len(codes) == 44:
                break
        self.assertEqual(codes, [grpc.StatusCode.RESOURCE_EXHAUSTED] * 44)
        for stream in streams:
            stream.cancel()
        deadline = time.monotonic() + 10
        while True:
            try:
                stream = watch()
                next(stream)
                stream.cancel()
                break
            except grpc.RpcError:
                self.assertLess(time.monotonic(), deadline, "the slots were not freed")
                time.sleep(0.1)

    def metric(self, name: str) -> list[str]:
        request = urllib.request.Request(URL + "/metrics", headers={"Authorization": f"Bearer {KEY}"})
        with urllib.request.urlopen(request, timeout=10) as response:
            lines = response.read().decode().splitlines()
        return [line for line in lines if line.startswith(name)]

    def test_calls_are_counted_by_status(self) -> None:
        request = self.message("GetMapRequest", map="not-there")
        self.refused(grpc.StatusCode.NOT_FOUND, lambda: self.call("MapService", "GetMap", request))
        counted = self.metric("whereabouts_http_requests_total")
        counted = [line for line in counted if "MapService/GetMap" in line]
        self.assertTrue(any('status="404"' in line for line in counted), counted)

    def test_health_needs_no_key(self) -> None:
        health = health_pb2_grpc.HealthStub(grpc.insecure_channel(ADDRESS))
        for name in ["", f"{PACKAGE}.LocalizationService"]:
            answer = health.Check(health_pb2.HealthCheckRequest(service=name), timeout=5)
            self.assertEqual(answer.status, health_pb2.HealthCheckResponse.SERVING)
        unknown = health_pb2.HealthCheckRequest(service="nothing")
        self.refused(grpc.StatusCode.NOT_FOUND, lambda: health.Check(unknown, timeout=5))

    def test_a_key_grants_only_its_role_and_maps(self) -> None:
        frame = pictures("frames")[0][1]
        here = self.message("LocalizeRequest", map="town", image=frame, refine=3)
        anonymous, unknown = Services(None), Services("wab_" + "0" * 77)
        for services in (anonymous, unknown):
            error = self.refused(
                grpc.StatusCode.UNAUTHENTICATED,
                lambda s=services: s.call("LocalizationService", "Localize", here),
            )
            self.assertNotIn("0000", error.details())
        _, token = make_key(name="robot", role="robot", maps=["yard"])
        robot = Services(token)
        listed = robot.call("MapService", "ListMaps", self.message("ListMapsRequest"))
        self.assertEqual(list(listed.maps), [])
        for service, method, request in [
            ("LocalizationService", "Localize", here),
            ("MapService", "GetMap", self.message("GetMapRequest", map="town")),
            ("MapService", "PutMap", self.message("PutMapRequest", map="yard")),
            ("MapService", "DeleteMap", self.message("DeleteMapRequest", map="town")),
            ("JobService", "ListJobs", self.message("ListJobsRequest")),
        ]:
            self.refused(
                grpc.StatusCode.PERMISSION_DENIED,
                lambda s=service, m=method, r=request: robot.call(s, m, r),
            )
        frame_of_town = self.message("LocalizeStreamRequest", frame=here)
        [answer] = robot.call("LocalizationService", "LocalizeStream", iter([frame_of_town]))
        self.assertEqual(answer.problem.kind, "forbidden")
        request = self.message("LocalizeRequest", map="town", image=frame)
        job = self.call("LocalizationService", "Localize", request).job.id
        for method in ("GetJob", "WatchJob"):
            asked = self.message(f"{method}Request", id=job)
            self.refused(
                grpc.StatusCode.PERMISSION_DENIED,
                lambda m=method, r=asked: robot.call("JobService", m, r),
            )

    def test_revoking_a_key_ends_its_stream(self) -> None:
        id, token = make_key(name="short", role="robot")
        requests = threading.Event()

        def nothing() -> Iterator[Any]:
            requests.wait(20)
            yield from ()

        stream = Services(token).call("LocalizationService", "LocalizeStream", nothing())
        threading.Timer(0.5, lambda: over_http("DELETE", f"/keys/{id}")).start()
        begun = time.monotonic()
        error = self.refused(grpc.StatusCode.UNAUTHENTICATED, lambda: stream)
        self.assertIn("revoked", error.details())
        self.assertLess(time.monotonic() - begun, 3)
        requests.set()

    def test_revoking_a_key_ends_its_upload_with_the_results_so_far(self) -> None:
        id, token = make_key(name="brief", role="operator")
        go_on = threading.Event()

        def images() -> Iterator[Any]:
            yield self.message("AddImagesRequest", map="brief", id="a", image=pictures("map")[0][1])
            go_on.wait(20)

        self.call("MapService", "PutMap", self.message("PutMapRequest", map="brief"))
        threading.Timer(1, lambda: over_http("DELETE", f"/keys/{id}")).start()
        begun = time.monotonic()
        answer = Services(token).call("MapService", "AddImages", images())
        self.assertEqual([result.id for result in answer.results], ["a"])
        self.assertLess(time.monotonic() - begun, 4)
        go_on.set()
        nowhere = self.message("AddImagesRequest", map="nowhere", image=pictures("map")[0][1])
        self.refused(
            grpc.StatusCode.NOT_FOUND, lambda: self.call("MapService", "AddImages", iter([nowhere]))
        )

    def test_body_memory_is_released(self) -> None:
        # Many large frames that cannot be decoded, so that a leak would exhaust the body budget.
        for _ in range(3):
            streams = []
            for _ in range(30):
                frame = self.message("LocalizeRequest", map="town", image=bytes(1_900_000), refine=3)
                request = self.message("LocalizeStreamRequest", frame=frame)
                streams.append(self.call("LocalizationService", "LocalizeStream", iter([request])))
            for stream in streams:
                self.assertEqual(next(stream).problem.kind, "unprocessable")
        self.test_a_frame_gets_the_same_answer_as_over_http()

    def test_each_frame_of_a_stream_counts_as_a_request(self) -> None:
        _, token = make_key(name="few", role="robot", limits={"requests_per_minute": 3})
        frame = pictures("frames")[0][1]
        request = self.message("LocalizeRequest", map="town", image=frame, refine=3)
        turn = threading.Semaphore(1)

        def frames() -> Iterator[Any]:
            for number in range(4):
                turn.acquire()
                yield self.message("LocalizeStreamRequest", frame_number=number, frame=request)

        outcomes = []
        for answer in Services(token).call("LocalizationService", "LocalizeStream", frames()):
            outcomes.append(answer.problem.kind or "answer")
            turn.release()
        self.assertEqual(outcomes, ["answer", "answer", "answer", "overloaded"])
        self.assertGreater(answer.problem.retry_after.seconds, 5)


class Encrypted(unittest.TestCase):
    """Over TLS, where the HTTP version is negotiated with ALPN."""

    def test_calls_work_over_tls(self) -> None:
        with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
            place = pathlib.Path(folder)
            certificate, key = place / "certificate.pem", place / "key.pem"
            subprocess.run(
                ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
                + ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
                + ["-days", "2", "-keyout", key, "-out", certificate],
                check=True,
                capture_output=True,
            )
            settings = {
                "WHEREABOUTS_SERVER__TLS_CERTIFICATE": str(certificate),
                "WHEREABOUTS_SERVER__TLS_KEY": str(key),
                "WHEREABOUTS_AUTH__KEYS": "off",
            }
            command = [os.environ["BINARY"], "serve", "--data", place / "data", "--listen", "127.0.0.1:0"]
            server = subprocess.Popen(
                [*command, "--address-file", place / "address"],
                env=os.environ | settings,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(server.wait)
            stack.callback(server.terminate)
            deadline = time.monotonic() + 30
            while not (place / "address").exists() or not (place / "address").read_text():
                self.assertLess(time.monotonic(), deadline, "the server did not start")
                time.sleep(0.05)
            port = (place / "address").read_text().strip().rpartition(":")[2]
            trusted = grpc.ssl_channel_credentials(certificate.read_bytes())
            channel = stack.enter_context(grpc.secure_channel(f"localhost:{port}", trusted))
            answer = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
            self.assertEqual(answer.status, health_pb2.HealthCheckResponse.SERVING)


class ZDrain(unittest.TestCase):
    """Stops the server; its name makes it run last."""

    def test_streams_end_when_the_server_drains(self) -> None:
        services = Services(KEY)
        go_on = threading.Event()

        def nothing() -> Iterator[Any]:
            go_on.wait(20)
            yield from ()

        stream = services.call("LocalizationService", "LocalizeStream", nothing())
        threading.Timer(0.5, lambda: os.kill(int(os.environ["SERVER"]), signal.SIGTERM)).start()
        with self.assertRaises(grpc.RpcError) as raised:
            list(stream)
        self.assertEqual(raised.exception.code(), grpc.StatusCode.UNAVAILABLE, raised.exception)
        go_on.set()


if __name__ == "__main__":
    unittest.main()
