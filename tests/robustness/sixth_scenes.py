# ruff: noqa: E501
"""Scenes and runs: records with a key twice, numbers as only Python writes them, models, pictures and truths that mislead."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from base import EVAL, HEIGHT, READ, SHOTS, TRAIN, WIDTH
from corpus_shots import OF_SENSOR
from fifth_runs import CHECKPOINT, RENDER, export
from fifth_scenes import CAMERAS, IMAGES, POINTS, drawn, text
from making import MOSAIC, PICTURE, SAME, TRUTH, Change, MadeCase, made_case, of_bytes, put

TWICE = "stands there twice"
WITH_CALIBRATION = [*SHOTS, "--calibration", "calibration.json"]
MASK = "scene/masks/v001.png"
WHITE = np.full((HEIGHT, WIDTH), 255, np.uint8)


def record_cases() -> Iterator[MadeCase]:
    """JSON with a key twice: which of the two holds, no standard says."""
    doubled = text(
        "run/run.json", lambda given: given.replace('"downscale": 1', '"downscale": 1,\n "downscale": 2')
    )
    for name, change, command in (
        ("scene.json", of_bytes("scene/scene.json", b'{"refractive_index": 1.5, "refractive_index": 1.9}'), READ),
        ("run.json", doubled, RENDER),
        ("presentation.json", of_bytes("run/presentation.json", b'{"title": "a", "title": "b"}'), export("ply")),
        ("a calibration", of_bytes("calibration.json", b'{"zero": 0, "zero": 90}'), WITH_CALIBRATION),
    ):  # fmt: skip
        yield made_case(f"sixth {name} with a key twice", change, command, says=TWICE)
    yield made_case(
        "sixth calibration of a key that there is not, which begins like a file of analyzers",
        of_bytes("calibration.json", b'{"gain":{"0": 1.0}}'), WITH_CALIBRATION, says="expected only gains, order",
    )  # fmt: skip
    long = text("run/run.json", lambda given: given.replace('"version": "', '"version": "' + "v" * 1_000_000))
    yield made_case("sixth run.json with a version of a million letters", long, RENDER, says=r"\A.{,2000}\Z")
    yield made_case(
        "sixth scene.json: as many objects as there may be", _many_objects, EVAL, "a scene may have them",
        says="the 100 largest of 65,535 objects",
    )  # fmt: skip


def _many_objects(folder: Path) -> None:
    objects = [{"id": number, "name": f"object {number}"} for number in range(1, 1 << 16)]
    (folder / "scene/scene.json").write_text(json.dumps({"objects": objects}))
    _truth(objid=np.ones((HEIGHT, WIDTH), np.uint16))(folder)


def table_cases() -> Iterator[MadeCase]:
    """Numbers that Python takes for such, and people do not."""
    head = "file,view,angle,gain\n"
    for name, line in (
        ("an angle of 4_5", "v000_000.png,v000,4_5,1"),
        ("an angle in other digits", "v000_000.png,v000,\u0664\u0665,1"),
        ("a gain of 1_0", "v000_000.png,v000,45,1_0"),
        ("a gain of 1e-300", "v000_000.png,v000,45,1e-300"),
    ):
        yield made_case(
            f"sixth angles.csv: {name}", of_bytes("scene/angles.csv", (head + line + "\n").encode()), READ
        )


def model_cases() -> Iterator[MadeCase]:
    """COLMAP models that pycolmap reads without a word."""
    stretched = text(CAMERAS, lambda given: given.replace(" 30 30 ", " 30 30000000 "))
    quaternion = text(IMAGES, lambda given: given.replace("1 1 0 0 0", "1 1e200 1e200 0 0", 1))
    away = text(POINTS, lambda given: "".join(f"{n} {n} {-n} -900 1 2 3 0.5\n" for n in range(1, 30)))
    silent = r"\A(?!.*RuntimeWarning)"
    for name, change, says in (
        ("one focal length a million times the other", stretched, "100 times one another"),
        ("a quaternion of 1e200", quaternion, silent),
        ("a color of 256", text(POINTS, lambda given: given.replace("10 20 30", "256 20 30")), "256, 20, 30"),
        ("a color of -1", text(POINTS, lambda given: given.replace("10 20 30", "-1 20 30")), "-1, 20, 30"),
        ("all points behind the cameras", away, "None of the 29 points"),
    ):
        yield made_case(f"sixth model: {name}", change, TRAIN, says=says)


def _animated(path: str) -> Change:
    def change(folder: Path) -> None:
        data, body = (folder / path).read_bytes(), b"acTL" + struct.pack(">II", 3, 0)
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        (folder / path).write_bytes(data[:33] + chunk + data[33:])

    return change


def _copied(folder: Path) -> None:
    for angle in ("000", "045", "090", "135"):
        shutil.copy(folder / f"scene/polar/v002_{angle}.png", folder / f"scene/polar/v003_{angle}.png")


def _in_transparency(colors: np.ndarray) -> Change:
    """A mask whose transparency says that the left half is the object."""
    alpha = WHITE.copy()
    alpha[:, WIDTH // 2 :] = 0
    return drawn(MASK, np.dstack((colors, colors, colors, alpha)))


def picture_cases() -> Iterator[MadeCase]:
    """Pictures of which decoders show what nobody means."""
    left = WHITE.copy()
    left[:, WIDTH // 2 :] = 0
    masked, animated = [*TRAIN, "--background", "masked"], "an animated PNG file"
    yield made_case("sixth picture: animated", _animated(PICTURE), READ, says=animated)
    yield made_case("sixth mask: animated", _animated(MASK), masked, says=animated)
    yield made_case("sixth mosaic: animated", _animated(MOSAIC), OF_SENSOR, says=animated)
    yield made_case("sixth mask: in its transparency", _in_transparency(WHITE), masked, says="transparen")
    yield made_case("sixth mask: in its colors and its transparency", _in_transparency(left), masked, SAME)
    yield made_case("sixth pictures of one view twice", _copied, TRAIN, says="have the same pictures")


def _truth(**arrays: np.ndarray) -> Change:
    def change(folder: Path) -> None:
        found = dict(np.load(folder / TRUTH)) | arrays
        np.savez_compressed(folder / TRUTH, **found)

    return change


def truth_cases() -> Iterator[MadeCase]:
    """Ground truths that cannot be."""
    flat, light = np.ones((HEIGHT, WIDTH), np.float32), np.ones((HEIGHT, WIDTH, 3), np.float32)
    for name, change in (
        ("depth behind the camera", _truth(depth=-flat)),
        ("negative light", _truth(specular=-light, diffuse=light)),
    ):
        yield made_case(f"sixth truth: {name}", change, EVAL, says="0 or more")


def checkpoint_cases() -> Iterator[MadeCase]:
    """Checkpoints as hostile people have them; none of these was ever taken for one."""
    yield made_case("sixth checkpoint: a device", put(CHECKPOINT, "device"), RENDER)
    yield made_case(
        "sixth checkpoint: a pipe, shared", put(CHECKPOINT, "pipe"), ["share", "run", "--out", "new.html"]
    )
    head = struct.pack("<Q", 15_000) + b'{"a":' * 3000
    yield made_case("sixth checkpoint: a header of brackets", of_bytes(CHECKPOINT, head), RENDER)
