"""Compares `whereabouts read` with rapidocr on drawn signs. Arguments: command and folder of the reader."""

import json
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import tomllib
from PIL import Image, ImageDraw, ImageFont
from rapidocr import RapidOCR

COMMAND, READER = sys.argv[1], Path(sys.argv[2]).resolve()


def sign(
    text: str, size: int, colours: tuple[str, str] = ("black", "white"), degrees: float = 0.0
) -> Image.Image:
    """A sign with a margin, turned counterclockwise on grey."""
    font = ImageFont.load_default(size)
    left, top, right, bottom = font.getbbox(text)
    board = Image.new("RGB", (int(right - left) + size, int(bottom - top) + size), colours[1])
    ImageDraw.Draw(board).text((size / 2 - left, size / 2 - top), text, fill=colours[0], font=font)
    return board.rotate(degrees, expand=True, fillcolor="grey", resample=Image.Resampling.BICUBIC)


def street(*signs: tuple[Image.Image, tuple[int, int]], size: tuple[int, int] = (640, 480)) -> Image.Image:
    picture = Image.new("RGB", size, "grey")
    for board, place in signs:
        picture.paste(board, place)
    return picture


SIGNS = {
    "one sign": (street((sign("PHARMACY", 40), (150, 200))), ["PHARMACY"]),
    "white on black": (street((sign("Kawa Coffee", 36, ("white", "black")), (120, 90))), ["Kawa Coffee"]),
    "letters of 12 pixels": (street((sign("OPTICIAN", 17), (300, 240))), ["OPTICIAN"]),
    "turned to the left": (street((sign("BAKERY", 44, degrees=20), (200, 150))), ["BAKERY"]),
    "turned to the right": (street((sign("BAKERY", 44, degrees=-15), (200, 150))), ["BAKERY"]),
    "running downwards": (street((sign("HARDWARE", 40, degrees=-90), (300, 100))), ["HARDWARE"]),
    "running upwards": (street((sign("HARDWARE", 40, degrees=90), (300, 100))), ["HARDWARE"]),
    "two side by side": (
        street((sign("TOYS", 40), (60, 200)), (sign("BANK", 40), (360, 200))),
        ["BANK", "TOYS"],
    ),
    "one above the other": (
        street((sign("HOTEL", 40), (200, 60)), (sign("ROOM 24", 40), (200, 300))),
        ["HOTEL", "ROOM 24"],
    ),
    "a wide picture": (street((sign("GROCERY", 60), (1200, 200)), size=(2000, 500)), ["GROCERY"]),
    "a portrait": (street((sign("CINEMA", 60), (60, 700)), size=(480, 1200)), ["CINEMA"]),
}


def nothing() -> dict[str, Image.Image]:
    noise = np.random.default_rng(1).integers(0, 256, (480, 640, 3), np.uint8)
    ramp = np.tile(np.linspace(0, 255, 640, dtype=np.uint8), (480, 1))
    return {
        "black": Image.new("RGB", (640, 480)),
        "white": Image.new("RGB", (640, 480), "white"),
        "noise": Image.fromarray(noise),
        "a ramp": Image.fromarray(ramp),
        "one pixel": Image.new("RGB", (1, 1), "red"),
        "a line of pixels": Image.new("RGB", (3000, 1), "red"),
    }


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """The largest distance of the bounds of two quadrilaterals, in pixels."""
    bounds = [np.concatenate([corners.min(0), corners.max(0)]) for corners in (a, b)]
    return float(np.abs(bounds[0] - bounds[1]).max())


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Runs `whereabouts read`."""
    environment = {"PATH": "/usr/bin:/bin", "WHEREABOUTS_MODEL__ASSETS": str(READER.parent.parent)}
    command = [COMMAND, "read", *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, env=environment)


class Reading(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        manifest = tomllib.loads((READER / "reader.toml").read_text())
        detector, recogniser = manifest["detector"], manifest["recogniser"]
        cls.longest_side = detector["longest_side"]
        scratch = tempfile.TemporaryDirectory()
        cls.addClassCleanup(scratch.cleanup)
        cls.folder = Path(scratch.name)
        # rapidocr adds the blank and the space itself.
        keys = (READER / recogniser["keys"]).read_text().splitlines()[1:-1]
        (cls.folder / "keys.txt").write_text("\n".join(keys))
        cls.peer = RapidOCR(
            params={
                "Det.model_path": str(READER / detector["file"]),
                "Det.limit_side_len": detector["longest_side"],
                "Det.limit_type": "max",
                "Det.thresh": detector["pixel_threshold"],
                "Det.box_thresh": detector["line_threshold"],
                "Det.unclip_ratio": detector["unclip"],
                "Det.mean": detector["mean"],
                "Det.std": detector["std"],
                "Det.use_dilation": False,
                "Rec.model_path": str(READER / recogniser["file"]),
                "Rec.rec_keys_path": str(cls.folder / "keys.txt"),
                "Global.use_cls": False,
                "Global.log_level": "error",
            }
        )

    def read(self, *pictures: Image.Image) -> list[dict]:
        files = []
        for number, picture in enumerate(pictures):
            files.append(self.folder / f"{number}.png")
            picture.save(files[-1])
        ran = run("--json", *files)
        self.assertEqual(ran.returncode, 0, ran.stderr)
        return [json.loads(line) for line in ran.stdout.splitlines()]

    def test_signs_are_read_where_they_are_like_by_the_peer(self) -> None:
        answers = self.read(*(picture for picture, _ in SIGNS.values()))
        for (name, (picture, texts)), answer in zip(SIGNS.items(), answers, strict=True):
            with self.subTest(name):
                lines = sorted(answer["lines"], key=lambda line: line["text"])
                self.assertEqual([line["text"] for line in lines], texts)
                if name == "running upwards":
                    # The peer turns steep lines in one direction only.
                    continue
                peer = self.peer(np.asarray(picture)[:, :, ::-1])
                theirs = sorted(zip(peer.txts, peer.boxes, peer.scores, strict=True))
                self.assertEqual([text for text, _, _ in theirs], texts)
                for line, (_, box, score) in zip(lines, theirs, strict=True):
                    # In pixels of the detector, to which larger pictures are scaled.
                    scale = max(1.0, max(answer["size"]) / self.longest_side)
                    off = distance(np.array(line["corners"]) * answer["size"], box) / scale
                    self.assertLess(off, 3.0)
                    self.assertAlmostEqual(line["confidence"], float(score), delta=0.1)

    def test_nothing_is_read_where_nothing_is(self) -> None:
        pictures = nothing()
        for name, answer in zip(pictures, self.read(*pictures.values()), strict=True):
            with self.subTest(name):
                self.assertEqual(answer["lines"], [])

    def test_a_reader_that_is_missing_or_damaged_is_an_error_that_says_what_to_do(self) -> None:
        picture = self.folder / "sign.png"
        SIGNS["one sign"][0].save(picture)
        ran = run("--reader", "none", picture)
        self.assertEqual(ran.returncode, 1)
        self.assertIn("make reader", ran.stderr)

    def test_one_file_that_is_no_picture_does_not_keep_the_others_from_being_read(self) -> None:
        picture, other = self.folder / "sign.png", self.folder / "notes.txt"
        SIGNS["one sign"][0].save(picture)
        other.write_text("no picture")
        ran = run(other, picture)
        self.assertEqual(ran.returncode, 1)
        self.assertIn("PHARMACY", ran.stdout)
        self.assertIn("notes.txt", ran.stderr)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
