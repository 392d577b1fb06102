"""Tests of the client and the example against a real server, and against a scripted one for faults.

WHEREABOUTS_BIN is the path of the server binary:

    WHEREABOUTS_BIN=../../target/release/whereabouts python -m unittest
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import socket
import subprocess
import tempfile
import threading
import time
import unittest
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from datetime import datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, TypeAlias

import index_and_localize
import whereabouts_client as client
from whereabouts_client import GeographicPose, Job, MetricPose, PairDescribed, Problem, Whereabouts

PLACES = 6
CONTRACT = Path(__file__).resolve().parents[2] / "docs" / "openapi.json"
JPEG = b"\xff\xd8\xff\xe0 ignored by the scripted server"


def binary() -> str:
    path = os.environ.get("WHEREABOUTS_BIN", "")
    if not os.access(path, os.X_OK):
        raise SystemExit(
            "WHEREABOUTS_BIN must name the whereabouts binary, such as target/release/whereabouts; "
            f"it is {path!r}. `make build` builds it."
        )
    return str(Path(path).resolve())


def draw_town(folder: Path) -> None:
    """Renders `map/place-N.jpg` with poses, and `frames/frame-N.jpg` taken nearby."""
    command = [binary(), "demo", "--offline", "--json", "--places", str(PLACES), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if done.returncode:
        raise RuntimeError(f"the demo failed: {done.stderr}")


class Server:
    """A real server on a free port."""

    def __init__(self, folder: Path) -> None:
        address = folder / "address"
        command = [binary(), "serve", "--data", str(folder / "served"), "--listen", "127.0.0.1:0"]
        settings = {
            "WHEREABOUTS_MODEL__NAME": "xfeat",
            "WHEREABOUTS_MODEL__PROVIDER": "cpu",
            "WHEREABOUTS_MODEL__THREADS": "1",
        }
        self.log = (folder / "log").open("w+")
        self.process = subprocess.Popen(
            [*command, "--address-file", str(address)], stderr=self.log, env={**os.environ, **settings}
        )
        end = time.monotonic() + 30
        while not address.exists() or not address.read_text().strip():
            if self.process.poll() is not None or time.monotonic() > end:
                self.stop()
                raise RuntimeError(f"the server did not start: {(folder / 'log').read_text()}")
            time.sleep(0.02)
        self.url = f"http://{address.read_text().strip()}"

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.log.close()


class RealServer(unittest.TestCase):
    """All tests share one server with the map `town`."""

    folder: tempfile.TemporaryDirectory[str]
    town: Path
    server: Server
    service: Whereabouts

    @classmethod
    def setUpClass(cls) -> None:
        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        root = Path(cls.folder.name)
        cls.town = root / "town"
        draw_town(cls.town)
        cls.server = Server(root)
        cls.addClassCleanup(cls.server.stop)
        cls.service = Whereabouts(cls.server.url, retry_for_s=20)
        cls.addClassCleanup(cls.service.close)
        cls.service.put_map("town", scene="outdoor", frame="wgs84", description="drawn")
        poses = index_and_localize.read_poses(cls.town / "map")
        for path in index_and_localize.pictures(cls.town / "map"):
            cls.service.add_image("town", path, id=path.name, pose=poses[path.name], tags=["drawn, by day"])

    def place(self, number: int) -> Path:
        return self.town / "map" / f"place-{number:04}.jpg"

    def frame(self, number: int) -> Path:
        return self.town / "frames" / f"frame-{number:04}.jpg"

    def test_a_frame_with_an_idempotency_key_is_localized_once(self) -> None:
        first, again, other = (
            self.service.localize("town", self.frame(0), idempotency_key=key) for key in ("a", "a", "b")
        )
        self.assertEqual(first, again)
        self.assertNotEqual(first.query_id, other.query_id)

    def test_the_right_image_is_first_and_its_job_ends(self) -> None:
        answer = self.service.localize("town", self.place(2).read_bytes(), k=3)
        self.assertEqual(len(answer.candidates), 3)
        first = answer.candidates[0]
        self.assertEqual((first.rank, first.image_id), (1, "place-0002.jpg"))
        self.assertGreater(first.similarity, 0.999)
        self.assertGreater(first.similarity, answer.candidates[1].similarity)
        self.assertIsInstance(first.pose, GeographicPose)
        assert answer.job
        job = self.service.wait_for_job(answer.job.id, 30)
        self.assertEqual((job.state, job.query_id), ("succeeded", answer.query_id))
        assert job.ranking and job.estimate and job.finished_at
        self.assertEqual(job.ranking[0].image_id, "place-0002.jpg")
        self.assertEqual(job.estimate.pose, first.pose)
        self.assertGreaterEqual(job.finished_at, job.created_at)
        self.assertTrue(all(description.took_ms is not None for description in job.descriptions))
        self.assertIsNone(job.reasoning_took_ms)

    def test_refined_frames_from_nearby_match_their_places(self) -> None:
        for number in range(PLACES):
            answer = self.service.localize("town", self.frame(number), refine="wait", priority="high")
            assert answer.job
            job = self.service.job(answer.job.id)
            self.assertTrue(job.ended)
            assert job.ranking
            self.assertEqual(job.ranking[0].image_id, f"place-{number:04}.jpg")
            self.assertEqual(answer.ranking, job.ranking)

    def test_without_refinement_there_is_no_job(self) -> None:
        answer = self.service.localize("town", self.frame(0), refine="off")
        self.assertIsNone(answer.job)
        self.assertEqual(len(answer.candidates), PLACES)

    def test_a_track_accumulates_its_frames(self) -> None:
        taken = datetime(2026, 3, 1, 12, tzinfo=timezone.utc)
        track = None
        for frames in (1, 2, 3):
            answer = self.service.localize(
                "town",
                self.frame(2),
                refine="off",
                track="robot-7",
                captured_at=taken + timedelta(seconds=frames),
                moved_m=0.0,
            )
            track = answer.track
            assert track
            self.assertEqual((track.id, track.frames), ("robot-7", frames))
        for seconds in (4, 2):
            moved = client.RelativePose(0.1, 0.0, 0.0, (0.01, 0.01, 0.001))
            at = taken + timedelta(seconds=seconds)
            answer = self.service.localize(
                "town", self.frame(2), refine="off", track="robot-7", captured_at=at, moved=moved
            )
            track = answer.track
            assert track
            self.assertEqual(track.is_late, seconds == 2)
        assert track
        self.assertEqual(track.image_id, "place-0002.jpg")
        self.assertIsInstance(track.pose, GeographicPose)
        way = self.service.track("town", "robot-7")
        # A late frame is none of the way.
        self.assertEqual((way.id, way.frames, len(way.places)), ("robot-7", 5, 4))
        self.assertEqual(way.places[-1].image_id, "place-0002.jpg")
        self.assertEqual(way.places[-1].captured_at, taken + timedelta(seconds=4))
        self.assertIsNone(self.service.localize("town", self.frame(2), refine="off").track)

    def test_a_time_without_a_time_zone_is_refused(self) -> None:
        with self.assertRaisesRegex(ValueError, "time zone"):
            self.service.localize("town", self.frame(2), track="r", captured_at=datetime(2026, 3, 1))

    def test_an_unknown_map_is_a_problem_with_status_404(self) -> None:
        with self.assertRaises(Problem) as raised:
            self.service.localize("nowhere", self.frame(0))
        problem = raised.exception
        self.assertEqual((problem.status, problem.title), (404, "Not found"))
        self.assertIn("nowhere", problem.detail)
        self.assertTrue(problem.request_id)

    def test_events_report_every_pair_and_end_with_the_job(self) -> None:
        answer = self.service.localize("town", self.frame(1))
        assert answer.job
        events = list(self.service.job_events(answer.job.id))
        pairs = [event for event in events if isinstance(event, PairDescribed)]
        self.assertEqual([pair.described for pair in pairs], list(range(1, PLACES + 1)))
        described = sorted(pair.description.image_id for pair in pairs)
        self.assertEqual(described, [f"place-{number:04}.jpg" for number in range(PLACES)])
        end = events[-1]
        assert isinstance(end, Job)
        self.assertEqual(end, self.service.job(answer.job.id))
        with self.assertRaises(Problem) as raised:
            list(self.service.job_events("018f0000-0000-7000-8000-000000000000"))
        self.assertEqual(raised.exception.status, 404)

    def test_waiting_for_a_job_returns_it_unfinished_after_the_timeout(self) -> None:
        answer = self.service.localize("town", self.frame(3), priority="low")
        assert answer.job
        began = time.monotonic()
        self.assertEqual(self.service.wait_for_job(answer.job.id, 0).id, answer.job.id)
        self.assertLess(time.monotonic() - began, 5)

    def test_a_missed_deadline_is_a_problem(self) -> None:
        with self.assertRaises(Problem) as raised, Whereabouts(self.server.url) as service:
            service.localize("town", self.frame(0), refine="off", deadline_ms=1)
        self.assertIn(raised.exception.status, (429, 504))

    def test_images_are_added_listed_page_by_page_and_deleted(self) -> None:
        state = self.service.put_map("yard", frame="metric", scene="indoor")
        self.assertEqual((state.frame, state.scene, state.images), ("metric", "indoor", 0))
        pose = MetricPose(x=1.5, y=-2.0, z=0.25, qx=0.0, qy=0.0, qz=0.0, qw=1.0)
        ids = ["a", "b/c é?#%", "d"]
        for number, id in enumerate(ids):
            taken = client._instant("2026-05-04T03:02:01.5Z")
            image = self.service.add_image(
                "yard", self.place(number), id=id, pose=pose, captured_at=taken, tags=["x, y", "z"]
            )
            self.assertEqual((image.id, image.pose, image.captured_at), (id, pose, taken))
            self.assertEqual((image.tags, image.media_type, image.width), (("x, y", "z"), "image/jpeg", 640))
        self.assertEqual([image.id for image in self.service.images("yard", page_size=2)], ids)
        self.service.delete_image("yard", ids[1])
        self.assertEqual([image.id for image in self.service.images("yard")], ["a", "d"])
        self.assertEqual(self.service.map("yard").images, 2)
        with self.assertRaises(Problem) as raised:
            self.service.delete_image("yard", ids[1])
        self.assertEqual(raised.exception.status, 404)
        self.assertLessEqual({"town", "yard"}, {state.name for state in self.service.maps()})

    def test_the_pose_time_and_tags_of_an_image_are_changed(self) -> None:
        self.service.put_map("moved", frame="metric")
        first = self.service.add_image("moved", self.place(0), id="a", pose=MetricPose(1, 2, z=3), tags=["x"])
        self.assertEqual(first.changed, ())
        again = self.service.add_image("moved", self.place(0), id="a", pose=MetricPose(4, 5))
        self.assertEqual((again.changed, again.pose, again.tags), (("pose",), MetricPose(4, 5), ("x",)))
        moved = self.service.update_image("moved", "a", pose=MetricPose(6, 7, z=8))
        self.assertEqual((moved.changed, moved.pose), (("pose",), MetricPose(6, 7, z=8)))
        flat = self.service.update_image("moved", "a", pose=MetricPose(6, 7), tags=["y"])
        self.assertEqual((flat.changed, flat.pose, flat.tags), (("pose", "tags"), MetricPose(6, 7), ("y",)))
        taken = datetime(2026, 5, 1, 12, tzinfo=timezone.utc)
        self.assertEqual(self.service.update_image("moved", "a", captured_at=taken).captured_at, taken)
        bare = self.service.update_image("moved", "a", pose=None, captured_at=None, tags=None)
        self.assertEqual((bare.pose, bare.captured_at, bare.tags), (None, None, ()))
        self.assertEqual(self.service.update_image("moved", "a").changed, ())
        with self.assertRaises(Problem) as raised:
            self.service.update_image("moved", "a", pose=GeographicPose(1, 2))
        self.assertEqual(raised.exception.status, 422)

    def test_adding_the_same_image_twice_succeeds_and_other_bytes_conflict(self) -> None:
        again = self.service.add_image("town", self.place(0), id="place-0000.jpg")
        self.assertEqual(again.tags, ("drawn, by day",))
        with self.assertRaises(Problem) as raised:
            self.service.add_image("town", self.place(1), id="place-0000.jpg")
        self.assertEqual(raised.exception.status, 409)

    def test_an_id_that_would_change_the_path_is_refused(self) -> None:
        for id in ("..", ".", ""):
            with self.assertRaises(ValueError):
                self.service.delete_image("town", id)
        self.assertEqual(self.service.map("town").images, PLACES)

    def test_a_file_that_is_not_a_picture_is_refused(self) -> None:
        with self.assertRaises(Problem) as raised:
            self.service.localize("town", self.town / "map" / "poses.csv")
        self.assertEqual(raised.exception.status, 422)

    def test_health(self) -> None:
        health = self.service.health()
        self.assertEqual((health.ready, health.detail), (True, "ready"))

    def test_the_example_prints_the_right_places(self) -> None:
        code, out, err = run_example(
            str(self.town / "map"), str(self.town / "frames"), "--map", "example", "--server", self.server.url
        )
        self.assertEqual((code, err), (0, ""))
        indexed, _, *rows = out.splitlines()
        self.assertTrue(indexed.startswith(f"indexed {PLACES} of {PLACES} images"), indexed)
        self.assertEqual(len(rows), PLACES)
        for number, row in enumerate(rows):
            frame, _, refined, confidence, ms, state = row.split()
            self.assertEqual((frame, refined), (f"frame-{number:04}.jpg", f"place-{number:04}.jpg"))
            self.assertTrue(0 <= float(confidence) <= 1 and float(ms) > 0, row)
            self.assertEqual(state, "succeeded")

    def test_the_example_explains_errors(self) -> None:
        town, frames = str(self.town), str(self.town / "frames")
        unreachable = f"http://127.0.0.1:{free_port()}"
        for images, queries, name, url, hint in [
            (town, frames, "m", self.server.url, "no pictures"),
            (frames, frames + "-not", "m", self.server.url, "is not a folder"),
            (frames, frames, "m", unreachable, "whereabouts serve"),
            (frames, frames, "No Name", self.server.url, "No Name"),
        ]:
            code, _, err = run_example(images, queries, "--map", name, "--server", url)
            self.assertEqual(code, 1)
            self.assertIn(hint, err)


def run_example(*arguments: str) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = index_and_localize.main([*arguments, "--wait", "20"])
    return code, out.getvalue(), err.getvalue()


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
    return port


Reply: TypeAlias = tuple[int, dict[str, str], str]
"""Status, headers and body."""


class Script:
    """A server that replays scripted responses, repeating the last one, and records the requests."""

    def __init__(self, *answers: Reply) -> None:
        self.requests: list[tuple[str, str, dict[str, str]]] = []
        script = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self) -> None:
                self.rfile.read(int(self.headers.get("Content-Length", 0)))
                status, headers, body = answers[min(len(script.requests), len(answers) - 1)]
                script.requests.append((self.command, self.path, dict(self.headers.items())))
                self.send_response(status)
                for name, value in {"Content-Length": str(len(body)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body.encode())

            do_GET = do_POST = do_PUT = do_DELETE = handle_any

            def log_message(self, *_: object) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}"

    @contextlib.contextmanager
    def serving(self) -> Iterator[str]:
        thread = threading.Thread(target=self.http.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield self.url
        finally:
            self.http.shutdown()
            thread.join()
            self.http.server_close()


def problem(status: int, retry_after: int | None = None) -> Reply:
    headers = {"Content-Type": "application/problem+json"}
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return status, headers, json.dumps({"title": "Scripted", "status": status, "detail": "as scripted"})


ANSWER: dict[str, object] = {
    "query_id": "q", "map": "m", "model": "xfeat", "candidates": [], "estimate": None, "job": None,
    "no_job": {"reason": "empty_map", "detail": "none"}, "a_field_of_tomorrow": 1,
    "timing_ms": {"decode": 1, "extract": 2, "search": 0.5, "total": 4},
}  # fmt: skip
LOCALIZED: Reply = (200, {}, json.dumps(ANSWER))


class ScriptedServer(unittest.TestCase):
    def test_a_429_is_retried_after_retry_after(self) -> None:
        script = Script(problem(429, 1), LOCALIZED)
        began = time.monotonic()
        with script.serving() as url, Whereabouts(url, retry_for_s=5) as service:
            answer = service.localize("m", JPEG, k=7, deadline_ms=250)
        self.assertGreaterEqual(time.monotonic() - began, 1)
        self.assertEqual(answer.timing_ms.total, 4)
        assert answer.no_job
        self.assertEqual(answer.no_job.reason, "empty_map")
        self.assertEqual(len(script.requests), 2)
        for method, path, headers in script.requests:
            self.assertEqual((method, path), ("POST", "/localize?map=m&k=7&refine=async"))
            self.assertEqual((headers["Content-Type"], headers["X-Deadline-Ms"]), ("image/jpeg", "250"))

    def test_a_description_is_localized(self) -> None:
        line = {"text": "PHARMACY", "confidence": 0.99, "corners": [[0.1, 0.2]] * 4}
        candidate = {
            "rank": 1, "image_id": "a", "pose": {"x": 1, "y": 2}, "probability": 0.7,
            "signs": [{"text": "pharmacy", "lines": [line]}],
        }  # fmt: skip
        estimate = {"image_id": "a", "pose": {"x": 1, "y": 2}, "probability": 0.75, "known": False}
        answer = {
            "map": "m", "candidates": [candidate], "estimate": estimate, "reason": "name another sign",
            "signs": [{"text": "pharmacy", "is_name": False, "images": 1}], "unread": 0, "warnings": [],
            "timing_ms": {"total": 1.5},
        }  # fmt: skip
        script = Script((200, {}, json.dumps(answer)))
        with script.serving() as url, Whereabouts(url) as service:
            found = service.localize_text("m", "opposite the pharmacy", k=3)
        self.assertEqual(script.requests[0][:2], ("POST", "/localize?map=m&k=3&text=opposite+the+pharmacy"))
        assert found.estimate
        self.assertEqual((found.estimate.probability, found.estimate.known), (0.75, False))
        self.assertEqual(found.candidates[0].signs[0].lines[0].text, "PHARMACY")
        self.assertEqual(found.signs[0].images, 1)

    def test_requests_are_not_retried_by_default(self) -> None:
        script = Script(problem(429, 0), LOCALIZED)
        with script.serving() as url, Whereabouts(url) as service, self.assertRaises(Problem) as raised:
            service.localize("m", JPEG)
        self.assertEqual((raised.exception.status, raised.exception.retry_after_s), (429, 0))
        self.assertEqual(len(script.requests), 1)

    def test_a_retry_after_beyond_the_retry_budget_fails_at_once(self) -> None:
        script = Script(problem(429, 30), LOCALIZED)
        began = time.monotonic()
        with (
            script.serving() as url,
            Whereabouts(url, retry_for_s=2) as service,
            self.assertRaises(Problem),
        ):
            service.maps()
        self.assertLess(time.monotonic() - began, 2)
        self.assertEqual(len(script.requests), 1)

    def test_retries_end_with_the_retry_budget(self) -> None:
        script = Script(problem(503, 1))
        began = time.monotonic()
        with (
            script.serving() as url,
            Whereabouts(url, retry_for_s=1.5) as service,
            self.assertRaises(Problem) as raised,
        ):
            service.maps()
        self.assertEqual(raised.exception.status, 503)
        self.assertLess(time.monotonic() - began, 3)
        self.assertEqual(len(script.requests), 2)

    def test_calls_that_are_not_idempotent_are_not_retried_after_503(self) -> None:
        script = Script(problem(503, 0))
        with script.serving() as url, Whereabouts(url, retry_for_s=1) as service:
            calls: list[Callable[[], object]] = [
                lambda: service.localize("m", JPEG),
                lambda: service.delete_image("m", "i"),
            ]
            for call in calls:
                with self.assertRaises(Problem) as raised:
                    call()
                self.assertEqual(raised.exception.status, 503)
        self.assertEqual([method for method, _, _ in script.requests], ["POST", "DELETE"])

    def test_a_frame_with_an_idempotency_key_is_retried_after_503_with_the_same_key(self) -> None:
        script = Script(problem(503, 0), problem(404))
        with (
            script.serving() as url,
            Whereabouts(url, retry_for_s=1) as service,
            self.assertRaises(Problem),
        ):
            service.localize("m", JPEG, idempotency_key="k")
        keys = [{name.lower(): value for name, value in sent.items()} for _, _, sent in script.requests]
        self.assertEqual([sent["idempotency-key"] for sent in keys], ["k", "k"])

    def test_adding_an_image_is_retried_after_503(self) -> None:
        stored = {"id": "i", "digest": "sha256:0", "media_type": "image/jpeg", "width": 1, "height": 1}
        body = json.dumps({**stored, "created_at": "2026-11-22T14:27:26.095151545Z", "pose": None})
        script = Script(problem(503, 0), (201, {}, body))
        with script.serving() as url, Whereabouts(url, retry_for_s=1) as service:
            image = service.add_image("m", JPEG, id="i")
        self.assertEqual(image.created_at.isoformat(), "2026-11-22T14:27:26.095151+00:00")
        self.assertEqual(len(script.requests), 2)

    def test_other_problems_are_not_retried(self) -> None:
        for answer in (problem(500), problem(503), problem(504, 0), problem(429)):
            script = Script(answer)
            with (
                script.serving() as url,
                Whereabouts(url, retry_for_s=5) as service,
                self.assertRaises(Problem),
            ):
                service.maps()
            self.assertEqual(len(script.requests), 1, answer)

    def test_the_api_key_is_sent_as_a_bearer_token_only_if_set(self) -> None:
        script = Script((200, {}, '{"maps": []}'))
        with script.serving() as url:
            for key in ("s3cret", None):
                with Whereabouts(url, api_key=key) as service:
                    self.assertEqual(service.maps(), [])
        sent = [headers.get("Authorization") for _, _, headers in script.requests]
        self.assertEqual(sent, ["Bearer s3cret", None])

    def test_a_refused_connection_explains_how_to_start_a_server(self) -> None:
        url = f"http://127.0.0.1:{free_port()}"
        with Whereabouts(url, retry_for_s=5) as service:
            calls: list[Callable[[], object]] = [
                service.health,
                service.maps,
                lambda: list(service.job_events("j")),
            ]
            for call in calls:
                with self.assertRaises(Problem) as raised:
                    call()
                self.assertEqual((raised.exception.status, raised.exception.title), (0, "Unreachable"))
                self.assertIn(url, str(raised.exception))
                self.assertIn("whereabouts serve", raised.exception.detail)

    def test_a_server_that_does_not_respond_times_out(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            url = f"http://127.0.0.1:{listener.getsockname()[1]}"
            with Whereabouts(url, timeout_s=0.3) as service, self.assertRaises(Problem) as raised:
                service.health()
        self.assertEqual((raised.exception.status, raised.exception.title), (0, "No answer in time"))

    def test_a_draining_server_is_not_ready(self) -> None:
        with Script(problem(503, 2)).serving() as url, Whereabouts(url) as service:
            self.assertEqual(service.health(), client.Health(False, "as scripted"))

    def test_unknown_events_and_comments_are_skipped(self) -> None:
        state = 'event: state\ndata: {"state": "running",\ndata: "attempts": 1, "error": null}\n\n'
        body = ": still here\n\nevent: of tomorrow\ndata: ?\n\n" + state
        script = Script((200, {"Content-Type": "text/event-stream"}, body))
        with script.serving() as url, Whereabouts(url) as service:
            events = service.job_events("j")
            self.assertEqual(next(events), client.JobStatus("running", 1))
            with self.assertRaises(Problem) as raised:
                next(events)
        self.assertEqual((raised.exception.status, raised.exception.title), (0, "Stream ended"))

    def test_a_response_of_another_server_is_a_problem(self) -> None:
        for body in ("<html>", "[]", '{"candidates": 3}'):
            with (
                Script((200, {}, body)).serving() as url,
                Whereabouts(url) as service,
                self.assertRaises(Problem) as raised,
            ):
                service.localize("m", JPEG)
                self.assertEqual(raised.exception.title, "Not understood")
        with (
            Script((502, {}, "<html>bad gateway")).serving() as url,
            Whereabouts(url) as service,
            self.assertRaises(Problem) as raised,
        ):
            service.maps()
        self.assertEqual((raised.exception.status, raised.exception.title), (502, "Bad Gateway"))

    def test_a_url_without_a_scheme_is_refused(self) -> None:
        with self.assertRaisesRegex(ValueError, "http://HOST:PORT"):
            Whereabouts("localhost:8080")


class Contract(unittest.TestCase):
    def test_the_classes_have_the_fields_of_the_openapi_schemas(self) -> None:
        schemas = json.loads(CONTRACT.read_text())["components"]["schemas"]
        ours = [kind for kind in vars(client).values() if isinstance(kind, type) and is_dataclass(kind)]
        self.assertGreater(len(ours), 15)
        for kind in ours:
            # A relative pose is sent as parameters of the query.
            if kind not in (client.Health, client.RelativePose):
                names = {field.name for field in fields(kind)}
                self.assertEqual(names, properties(schemas, schemas[kind.__name__]), kind.__name__)

    def test_the_literals_are_the_enum_values_of_the_openapi_schemas(self) -> None:
        schemas = json.loads(CONTRACT.read_text())["components"]["schemas"]
        for name in ("Scene", "Frame", "Priority", "JobState"):
            self.assertEqual(set(getattr(client, name).__args__), set(words(schemas[name])), name)


def properties(schemas: dict[str, Any], schema: dict[str, Any]) -> set[str]:
    """The fields of a schema, including those of the schemas that it extends."""
    found = set(schema.get("properties", ()))
    for part in schema.get("allOf", ()):
        extended = schemas[part["$ref"].rsplit("/", 1)[1]] if "$ref" in part else part
        found |= properties(schemas, extended)
    return found


def words(schema: dict[str, object]) -> list[str]:
    """The values of an enumeration, with or without a description of each."""
    options = schema.get("oneOf", [schema])
    assert isinstance(options, list)
    return [word for option in options for word in option["enum"]]


if __name__ == "__main__":
    unittest.main()
