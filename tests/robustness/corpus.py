# ruff: noqa: E501
"""The corpus: seeded mutations of scene files, run folders, raw sources and options.

Each ends in an error of one clear line, in a printed warning, or passes for a reason that stands here. ``many`` makes
further seeds of the random ones.
"""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import spoil
from base import EVAL, MOSAICS, READ, RESUME, SHOTS, TRAIN
from corpus_more import more_cases
from corpus_shots import shot_cases
from disk import disk_cases
from fifth import fifth_cases
from forked import Case
from fourth import fourth_cases
from further import further_cases
from options import option_cases
from seventh import seventh_cases
from sixth import sixth_cases

BYTES = ("cut", "empty", "garbage", "flip", "fill", "insert", "append", "twice")
PLACES = ("folder", "pipe", "device", "loop", "dangling", "outside")
CHECKED = "the chunk or the bytes that changed are not read, such as those behind the end of the picture"
PLAUSIBLE = "the number that changed is as plausible as the one before"
COMPUTED = "it is written anew from the run, and never read"
OPTIONAL = "the field may be missing, and is not relied on"


def corpus(first_seed: int = 0, times: int = 1) -> Iterator[Case]:
    """All cases; seeds begin at ``first_seed``, and every mutation is made with ``times`` of them."""
    for make in (scene_cases, run_cases, source_cases):
        for case in make():
            for seed in range(first_seed, first_seed + times):
                yield replace(case, seed=1000 * seed + case.seed)
    yield from option_cases()
    yield from disk_cases()
    yield from more_cases(every=times > 1)
    yield from shot_cases()
    yield from further_cases(every=times > 1)
    yield from fourth_cases(every=times > 1)
    yield from fifth_cases(every=times > 1)
    yield from sixth_cases()
    yield from seventh_cases()


def case(
    name: str,
    seed: int,
    change: Callable[[Path, random.Random], None],
    command: list[str],
    accepted: str = "",
) -> Case:
    """A case that spoils something and runs a command."""

    def make(folder: Path, rng: random.Random) -> list[str]:
        change(folder, rng)
        return command

    return Case(name, seed, make, accepted)


def on(path: str, spoiler: Callable[..., None], *arguments: object) -> Callable[[Path, random.Random], None]:
    """Spoil a file of the base with ``spoiler(path, rng, ...)``."""
    return lambda folder, rng: spoiler(folder / path, rng, *arguments)


def scene_cases() -> Iterator[Case]:
    """Files of a scene, read for a training."""
    files = {
        "polar/v001_045.png": CHECKED,
        "masks/v002.png": CHECKED,
        "invalid/v001.png": CHECKED,
        "gt/v000.npz": CHECKED,
        "sparse/0/cameras.txt": PLAUSIBLE,
        "sparse/0/images.txt": PLAUSIBLE,
        "sparse/0/points3D.txt": PLAUSIBLE,
        "scene.json": PLAUSIBLE,
        "split.json": PLAUSIBLE,
    }
    for file, reason in files.items():
        for how in BYTES:
            for seed in range(2):
                yield case(
                    f"scene {file} {how}", seed, on(f"scene/{file}", spoil.bytes_of, how), READ, reason
                )
        for how in PLACES:
            yield case(
                f"scene {file} {how}",
                0,
                lambda f, r, file=file, how=how: spoil.place(f / "scene" / file, how),
                READ,
            )
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        for how in BYTES:
            reason = "" if how == "cut" else PLAUSIBLE
            for seed in range(1, 5 if how in ("cut", "fill") else 3):
                yield case(f"scene {name}.bin {how}", seed, _binary(name, how), READ, reason)
    for how in (
        "black",
        "white",
        "gray",
        "small",
        "wide",
        "turned",
        "8 bits",
        "noise",
        "floats",
        "huge",
        "animated",
    ):
        reason = {"noise": "any picture may be noise", "wide": "", "gray": ""}.get(how, "")
        yield case(
            f"scene picture {how}", 0, on("scene/polar/v001_045.png", spoil.picture, how), READ, reason
        )
    for how in ("small", "wide", "turned", "floats", "huge", "black"):
        for file in ("masks/v002.png", "invalid/v001.png"):
            reason = {"black": "a mask may be empty", "floats": "a mask may be of any type"}.get(how, "")
            yield case(f"scene {file} {how}", 0, on(f"scene/{file}", spoil.picture, how), READ, reason)
    for how in ("not finite", "other shape", "other type", "objects", "bomb", "header", "encrypted", "zeros"):
        reason = "unknown values are zeros" if how == "zeros" else ""
        for seed in range(1 if how in ("bomb", "header") else 2):  # these have no random choice
            yield case(f"scene gt {how}", seed, on("scene/gt/v000.npz", spoil.archive, how), READ, reason)
    for file in ("scene.json", "split.json"):
        for how in ("value", "removed", "renamed", "near", "nested"):
            for seed in range(3):
                yield case(
                    f"scene {file} json {how}", seed, on(f"scene/{file}", spoil.json_of, how), READ, OPTIONAL
                )
    yield from _whole_scene_cases()


def _binary(name: str, how: str) -> Callable[[Path, random.Random], None]:
    def change(folder: Path, rng: random.Random) -> None:
        binary_model(folder)
        spoil.bytes_of(folder / "scene/sparse/0" / f"{name}.bin", rng, how)

    return change


def binary_model(folder: Path) -> None:
    """Write the scene's model in COLMAP's other format."""
    pycolmap = importlib.import_module("pycolmap")
    sparse = folder / "scene" / "sparse" / "0"
    model = pycolmap.Reconstruction()
    model.read_text(str(sparse))
    model.write_binary(str(sparse))
    for path in sparse.glob("*.txt"):
        path.unlink()


def _whole_scene_cases() -> Iterator[Case]:
    def every(change: Callable[[Path], None]) -> Callable[[Path, random.Random], None]:
        return lambda folder, rng: [change(path) for path in sorted((folder / "scene").iterdir())] and None

    def camera_at(x: str) -> Callable[[Path, random.Random], None]:
        def change(folder: Path, rng: random.Random) -> None:
            path = folder / "scene/sparse/0/images.txt"
            lines = path.read_text().splitlines()
            words = lines[0].split()
            words[5] = x
            path.write_text("\n".join([" ".join(words), *lines[1:]]) + "\n")

        return change

    def together(folder: Path, rng: random.Random) -> None:
        path = folder / "scene/sparse/0/images.txt"
        lines = [line.split() for line in path.read_text().splitlines()]
        path.write_text("".join(" ".join([w[0], "1 0 0 0 0 0 1", *w[8:]]) + "\n\n" for w in lines if w))

    def views(count: int) -> Callable[[Path, random.Random], None]:
        def change(folder: Path, rng: random.Random) -> None:
            for path in (folder / "scene").rglob("v00*"):
                if int(path.name[1:4]) >= count:
                    path.unlink()
            (folder / "scene/split.json").unlink()

        return change

    def invalid(folder: Path, rng: random.Random) -> None:
        import cv2
        import numpy as np

        for index in range(9):
            cv2.imwrite(str(folder / f"scene/invalid/v00{index}.png"), np.full((20, 24), 255, np.uint8))

    def masks_file(folder: Path, rng: random.Random) -> None:
        import shutil

        shutil.rmtree(folder / "scene/masks")
        (folder / "scene/masks").write_text("no folder")

    def big(folder: Path, rng: random.Random) -> None:
        for path in (folder / "scene/polar").glob("v001_*"):
            path.unlink()
            spoil.big_tiff(path.with_suffix(".tif"), 12000, 12000)

    def all_huge(folder: Path, rng: random.Random) -> None:
        for path in (folder / "scene/polar").glob("v00*"):
            spoil.picture(path, rng, "huge") if path.name == "v000_000.png" else path.write_bytes(
                (folder / "scene/polar/v000_000.png").read_bytes()
            )

    def wrong_name(folder: Path, rng: random.Random) -> None:
        import os

        os.rename(
            bytes(folder / "scene/polar/v001_045.png"), bytes(folder) + b"/scene/polar/v\xff\xfe_045.png"
        )

    def markup(folder: Path, rng: random.Random) -> None:
        (folder / "scene").rename(folder / "[bold red]x")

    for x in ("1e30", "-1e300", "nan", "inf"):
        yield case(f"scene camera at {x}", 0, camera_at(x), TRAIN)
    yield case("scene cameras together", 0, together, TRAIN)
    for count in (0, 1, 2):
        yield case(f"scene {count} views", 0, views(count), TRAIN)
    for name, change in (("invalid everywhere", invalid), ("masks a file", masks_file), ("BigTIFF", big), ("huge", all_huge),
                         ("name not UTF-8", wrong_name)):  # fmt: skip
        yield case(f"scene {name}", 0, change, TRAIN)
    reason = "a folder may be called so; the name is shown as it is"
    yield case("scene markup in its name", 0, markup, ["train", "[bold red]x", *TRAIN[2:]], reason)
    for seed in range(4):
        for verb in (
            ["priors", "scene", "--out", "new"],
            ["inspect", "scene", "--normals", "points", "--out", "new"],
        ):
            yield case(
                f"scene {verb[0]} picture fill",
                seed,
                on("scene/polar/v004_090.png", spoil.bytes_of, "fill"),
                verb,
                CHECKED,
            )


def run_cases() -> Iterator[Case]:
    """Files of a run, for what opens it and what goes on with it."""
    commands = {
        "eval": EVAL,
        "resume": RESUME,
        "export": ["export", "run", "--format", "ply", "--out", "new.ply"],
        "share": ["share", "run", "--out", "new.html"],
    }
    for number, how in enumerate((*BYTES, "cut", "flip", "fill")):
        for verb in ("eval", "resume"):
            yield case(f"run checkpoint {how} {verb}", number, on("run/checkpoint.safetensors", spoil.bytes_of, how),
                       commands[verb], PLAUSIBLE if how in ("flip", "fill") else "")  # fmt: skip
    for how in ("missing", "not finite", "shorter", "longer", "axis", "type", "huge", "stranger", "none"):
        for seed, (verb, command) in enumerate(commands.items()):
            yield case(f"run tensor {how} {verb}", seed, on("run/checkpoint.safetensors", spoil.tensors, how), command,
                       "a run may have no Gaussians" if how == "none" else "")  # fmt: skip
        other = ["eval", "run-ref", *EVAL[2:]]
        yield case(f"run tensor {how} ref-gs", 7, on("run-ref/checkpoint.safetensors", spoil.tensors, how), other,
                   "a run may have no Gaussians" if how == "none" else "")  # fmt: skip
    for how in ("value", "removed", "renamed", "near", "nested"):
        for seed in range(4):
            for verb in ("eval", "resume"):
                yield case(
                    f"run run.json {how} {verb}",
                    seed,
                    on("run/run.json", spoil.json_of, how),
                    commands[verb],
                    OPTIONAL,
                )
    for field in ("refractive_index",):
        for seed, value in enumerate((0, -1, 1e30, float("nan"), None, "1.5", 1.0, 4)):
            change = on("run/run.json", _set, ("settings", field), value)
            yield case(f"run {field} {value}", seed, change, EVAL)
    for file in ("run.json", "checkpoint.safetensors", "log.jsonl", "metrics.json"):
        for how in PLACES:
            reason = COMPUTED if file == "metrics.json" else OPTIONAL if file == "log.jsonl" else ""
            yield case(
                f"run {file} {how}",
                0,
                lambda f, r, file=file, how=how: spoil.place(f / "run" / file, how),
                RESUME if file == "log.jsonl" else EVAL,
                reason,
            )
    for number, how in enumerate(BYTES):
        yield case(
            f"run log {how}",
            number,
            on("run/log.jsonl", spoil.bytes_of, how),
            RESUME,
            "a log that was cut short is mended",
        )
        yield case(f"run metrics {how}", number, on("run/metrics.json", spoil.bytes_of, how), EVAL, COMPUTED)
        yield case(f"run.json {how}", number, on("run/run.json", spoil.bytes_of, how), EVAL, PLAUSIBLE)
    rows = ['{"step": "x"}', '{"step": 1e400}', '{"step": null}', "[]", "{}", '{"step": 1, "seconds": "x", "alone": []}', '{"step": true}',
            '{"step": 1}', "\x00", "[" * 5000]  # fmt: skip
    for number, row in enumerate(rows):
        change = on("run/log.jsonl", _write, row + "\n")
        yield case(f"run log row {number}", 0, change, RESUME, "a line of the log that is none is dropped")
    for seed in range(12):
        yield case(
            "run camera path",
            seed,
            _camera_path,
            ["render", "run", "--path", "path.json", "--video", "new.mp4", "--frames", "2"],
            PLAUSIBLE,
        )


def _set(path: Path, rng: random.Random, keys: tuple[str, ...], value: object) -> None:
    spoil.json_field(path, keys, value)


def _write(path: Path, rng: random.Random, text: str) -> None:
    path.write_text(text)


def _camera_path(folder: Path, rng: random.Random) -> None:
    import json

    camera = {"width": 12, "height": 10, "fx": 15.0, "fy": 15.0, "cx": 6.0, "cy": 5.0,
              "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 2.5]}  # fmt: skip
    path = folder / "path.json"
    path.write_text(json.dumps({"frames_per_second": 30, "cameras": [camera, camera]}))
    spoil.json_of(path, rng, rng.choice(("value", "removed", "renamed", "near", "nested")))


def source_cases() -> Iterator[Case]:
    """Raw mosaics, shots through a filter, calibrations, and preparations that others left unfinished."""
    for how in BYTES:
        for seed in range(2):
            yield case(f"mosaic {how}", seed, on("mosaics/v001.png", spoil.bytes_of, how), MOSAICS, CHECKED)
            yield case(f"shot {how}", seed, on("shots/45/v001.png", spoil.bytes_of, how), SHOTS, CHECKED)
    for how in PLACES:
        yield case(
            f"mosaic {how}", 0, lambda f, r, how=how: spoil.place(f / "mosaics/v001.png", how), MOSAICS
        )
        yield case(f"shot {how}", 0, lambda f, r, how=how: spoil.place(f / "shots/45/v001.png", how), SHOTS)
    for how in ("black", "white", "small", "wide", "turned", "8 bits", "noise", "floats", "huge", "animated"):
        reason = (
            "any picture may be noise"
            if how == "noise"
            else "mosaics may differ in size"
            if how in ("small", "wide", "turned")
            else ""
        )
        yield case(f"mosaic picture {how}", 0, on("mosaics/v001.png", spoil.picture, how), MOSAICS, reason)
        yield case(
            f"shot picture {how}",
            0,
            on("shots/45/v001.png", spoil.picture, how),
            SHOTS,
            reason if how == "noise" else "",
        )
    unfinished = [*MOSAICS[:3], "unfinished", *MOSAICS[4:]]
    for how in ("value", "removed", "renamed", "near", "nested"):
        for seed in range(8):
            yield case(
                f"journal {how}",
                seed,
                on("unfinished/prepare.json", spoil.json_of, how),
                unfinished,
                OPTIONAL,
            )
    calibrated = [*MOSAICS, "--calibration", "calibration.json"]
    for how in ("value", "removed", "near", "nested"):
        for seed in range(4):
            yield case(
                f"calibration {how}", seed, on("calibration.json", spoil.json_of, how), calibrated, PLAUSIBLE
            )
    for name in ("cameras", "images", "points3D"):
        for how in ("cut", "flip", "fill", "append"):
            command = [*MOSAICS[:-1], "model"]
            yield case(
                f"model {name}.bin {how}",
                0,
                on(f"model/sparse/0/{name}.bin", spoil.bytes_of, how),
                command,
                PLAUSIBLE,
            )
