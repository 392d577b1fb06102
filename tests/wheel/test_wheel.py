"""Uses the installed package: arguments are the command and a folder that `whereabouts demo` has filled."""

import asyncio
import dataclasses
import inspect
import socket
import subprocess
import sys
import time
import unittest
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import whereabouts
from PIL import Image
from whereabouts import AsyncClient, Client, Problem, client

COMMAND, TOWN = sys.argv[1], Path(sys.argv[2])
FRAME = TOWN / "frames" / "frame-0000.jpg"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Wheel(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        cls.url = f"http://127.0.0.1:{(port := free_port())}"
        serve = [COMMAND, "serve", "--data", str(TOWN / "data"), "--listen", f"127.0.0.1:{port}"]
        cls.server = subprocess.Popen(serve, stderr=subprocess.DEVNULL)
        cls.addClassCleanup(cls.server.wait)
        cls.addClassCleanup(cls.server.terminate)
        cls.client = Client(cls.url, retry_for_s=10)
        cls.addClassCleanup(cls.client.close)
        for _ in range(300):
            try:
                if cls.client.health().ready:
                    return
            except Problem:
                pass
            time.sleep(0.1)
        raise AssertionError("the server did not become ready within 30 s")

    def candidates(self, picture: client.Picture) -> list[tuple[str, float]]:
        answer = self.client.localize("town", picture, k=5, refine="off")
        return [(one.image_id, round(one.similarity, 5)) for one in answer.candidates]

    def test_pictures_in_memory_are_answered_like_the_file_that_they_came_from(self) -> None:
        pil = Image.open(FRAME).convert("RGB")
        rgb = np.asarray(pil)
        height, width, _ = rgb.shape
        lossless = TOWN / "frame.png"
        pil.save(lossless)
        expected = self.candidates(lossless)
        padded = np.zeros((height, width * 3 + 13), np.uint8)
        padded[:, : width * 3] = rgb[:, :, ::-1].reshape(height, -1)
        rgba = np.dstack([rgb, np.full((height, width), 255, np.uint8)])
        size = {"width": width, "height": height}
        for name, picture in {
            "bytes": lossless.read_bytes(),
            "path as text": str(lossless),
            "pillow": pil,
            "pillow with a palette": Image.open(lossless),
            "numpy": rgb,
            "numpy, a view of BGR": np.ascontiguousarray(rgb[:, :, ::-1])[:, :, ::-1],
            "numpy with alpha": rgba,
            "message rgb8": SimpleNamespace(encoding="rgb8", step=width * 3, data=rgb.tobytes(), **size),
            "message bgr8 with padding": SimpleNamespace(
                encoding="bgr8", step=width * 3 + 13, data=padded.tobytes(), **size
            ),
            "message rgba8": SimpleNamespace(encoding="rgba8", step=width * 4, data=rgba.tobytes(), **size),
        }.items():
            with self.subTest(name):
                self.assertEqual(self.candidates(picture), expected)
        grey = np.asarray(pil.convert("L"))
        message = SimpleNamespace(encoding="mono8", step=width, data=grey.tobytes(), **size)
        self.assertEqual(self.candidates(grey), self.candidates(message))

    def test_what_is_no_picture_is_refused_with_what_to_pass(self) -> None:
        message = SimpleNamespace(encoding="16UC1", width=2, height=2, step=4, data=b"12345678")
        short = SimpleNamespace(encoding="rgb8", width=2, height=2, step=6, data=b"123456")
        for picture, says in [
            (np.zeros((4, 4, 3)), "uint8"),
            (np.zeros((4, 4, 2), np.uint8), "height"),
            (np.zeros(4, np.uint8), "height"),
            (message, "convert"),
            (short, "step"),
            (7, "path"),
            (None, "path"),
        ]:
            with self.subTest(says), self.assertRaisesRegex((TypeError, ValueError), says):
                self.client.localize("town", picture)

    def test_the_calls_of_the_asynchronous_client_run_side_by_side(self) -> None:
        async def localize() -> list[client.Answer]:
            async with AsyncClient(self.url) as service:
                self.assertEqual(len(await service.images("town")), 6)
                calls = (service.localize("town", FRAME, k=3, refine="off") for _ in range(4))
                return await asyncio.gather(*calls)

        self.assertEqual([len(answer.candidates) for answer in asyncio.run(localize())], [3, 3, 3, 3])

    def test_the_asynchronous_client_has_every_call(self) -> None:
        def calls(kind: type) -> set[str]:
            return {name for name, _ in inspect.getmembers(kind, callable) if not name.startswith("_")}

        # A stream of events is an iterator that blocks.
        self.assertEqual(calls(Client) - calls(AsyncClient), {"job_events"})

    def test_the_package_exports_every_public_type_of_the_client(self) -> None:
        types = {
            name
            for name, value in vars(client).items()
            if inspect.isclass(value) and value.__module__ == client.__name__ and not name.startswith("_")
        }
        self.assertIn("Answer", types)
        self.assertEqual(types - set(whereabouts.__all__), set())
        self.assertTrue(dataclasses.is_dataclass(whereabouts.Answer))


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
