# ruff: noqa: E501
"""Folders to write, those of benches, and published datasets; comparisons start processes, and are in tests/experiments/test_jobs.py."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
import spoil
from base import MOSAICS, READ, TRAIN
from forked import Case
from making import Change, link, of_bytes
from making import more_case as case

INSPECT = ["inspect", "scene", "--normals", "points", "--out", "new"]
RENDER = ["render", "run", "--out", "new", "--device", "cpu"]


def folder_cases() -> Iterator[Case]:
    """Where something is to be written, and what stands there already."""
    compare = [
        "compare",
        "scene",
        "--recipes",
        "3dgs",
        "--steps",
        "1",
        "--out",
        "new",
        "--threads",
        "1",
        "--device",
        "cpu",
    ]

    for name, change in {
        "a file": of_bytes("new", b""),
        "a device": link("new", "/dev/null"),
        "a pipe": lambda f: os.mkfifo(f / "new"),
        "a link to nothing": link("new", "nowhere"),
        "a loop": link("new", "new"),
        "under a file": lambda f: None,
    }.items():
        for verb, command in {"train": TRAIN, "prepare": MOSAICS, "render": RENDER, "priors": READ, "compare": compare, "inspect": INSPECT,
                              "export": ["export", "run", "--format", "cameras", "--out", "new"]}.items():  # fmt: skip
            arguments = (
                [("run/run.json/x" if word == "new" else word) for word in command]
                if name == "under a file"
                else command
            )
            yield case(f"out {name} {verb}", change, arguments)

    def bench(spoiler: Change) -> Change:
        def change(folder: Path) -> None:
            from polarguide.experiments.bench import SCENES
            from polarguide.experiments.options import BENCH, BenchOptions
            from polarguide.synth.folder import scene_request
            from polarguide.synth.settings import Overrides, find_scene

            name = BenchOptions().chosen(BENCH)[0]
            spec = Overrides(views=BENCH.views).apply(find_scene(name))
            place = folder / "new" / SCENES / spec.name
            place.mkdir(parents=True)
            (place / "request.json").write_text(json.dumps(scene_request(spec, BENCH.synth)))
            (place / "scene.json").write_text("{}")
            (place / "checksums.txt").write_text("")
            spoiler(place)

        return change

    def changed(key: str, value: Any) -> Change:
        return lambda place: spoil.json_field(place / "request.json", (key,), value)

    for name, spoiler in {
        "a request with nothing more": changed("more", None),
        "a request of a list": lambda p: (p / "request.json").write_text("[]"),
        "a request of a scene that is a number": changed("scene", 3),
        "a request of settings that are text": changed("settings", "x"),
        "a request that is a pipe": lambda p: (
            ((p / "request.json").unlink(), os.mkfifo(p / "request.json"))
        ),
        "checksums that leave": lambda p: (p / "checksums.txt").write_text(
            f"{'0' * 64}  ../../../../outside/victim.txt\n"
        ),
        "checksums that are none": lambda p: (p / "checksums.txt").write_bytes(b"\xff\xfe\x00 x\n"),
        "checksums of one word": lambda p: (p / "checksums.txt").write_text("word\n"),
        "checksums that are a pipe": lambda p: (
            ((p / "checksums.txt").unlink(), os.mkfifo(p / "checksums.txt"))
        ),
        "no checksums": lambda p: (p / "checksums.txt").unlink(),
        "a scene.json of a list": lambda p: (p / "scene.json").write_text("[]"),
        "a scene.json that is none": lambda p: (p / "scene.json").write_bytes(b"\xff"),
        "a scene.json that is a pipe": lambda p: (((p / "scene.json").unlink(), os.mkfifo(p / "scene.json"))),
        "a deep scene.json": lambda p: (p / "scene.json").write_text("[" * 100_000),
    }.items():
        yield case(
            f"bench with {name}",
            bench(spoiler),
            ["bench", "--out", "new", "--render-only", "--device", "cpu"],
        )


def dataset_cases() -> Iterator[Case]:
    """Datasets with a file that is not as it was published."""

    def of(kind: str, spoiler: Change) -> Change:
        def change(folder: Path) -> None:
            from dataset_files import WRITERS

            WRITERS[kind](folder / "data")
            spoiler(folder / "data")

        return change

    def phygap(**changed: Any) -> Change:
        def change(root: Path) -> None:
            whole = dict(np.load(root / "camera_params.npz"))
            np.savez(root / "camera_params.npz", **{**whole, **changed})

        return change

    def rows(value: float) -> Change:
        def change(root: Path) -> None:
            poses = np.load(root / "poses_bounds.npy")
            poses[0, :] = value
            np.save(root / "poses_bounds.npy", poses)

        return change

    def first(pattern: str, write: Change) -> Change:
        return lambda root: write(sorted(root.glob(pattern))[0])

    table: list[tuple[str, str, Change]] = [
        ("phygap", "a width of many", phygap(image_width=np.array([64, 64]))),
        ("phygap", "a width that is none", phygap(image_width=np.nan)),
        ("phygap", "a width of infinity", phygap(image_width=np.inf)),
        ("phygap", "a negative width", phygap(image_width=-64)),
        ("phygap", "a width of 2^70", phygap(image_width=2.0**70)),
        ("phygap", "poses that are not finite", phygap(extrinsics=np.full((4, 4, 4), np.nan))),
        ("phygap", "poses of texts", phygap(extrinsics=np.full((4, 4, 4), "x"))),
        ("phygap", "poses of complex numbers", phygap(extrinsics=np.ones((4, 4, 4)) * 1j)),
        ("phygap", "intrinsics of infinity", phygap(intrinsics=np.full((3, 3), np.inf))),
        ("phygap", "EXR of a huge window", first("images_full/*.exr", lambda p: made.exr(p, 40000))),
        ("neisf", "rows of NaN", rows(np.nan)),
        ("neisf", "rows of zeros", rows(0.0)),
        ("neisf", "rows of 1e300", rows(1e300)),
        ("neisf", "EXR of a huge window", first("images_s0/*.exr", lambda p: made.exr(p, 40000))),
        ("neisf", "poses in a broken head", lambda r: (r / "poses_bounds.npy").write_bytes(made.header("{'descr': ("))),
        ("nersp", "light of NaN", first("s0/*.npy", lambda p: np.save(p, np.full((48, 64, 3), np.nan)))),
        ("nersp", "light of 1e300", first("s0/*.npy", lambda p: np.save(p, np.full((48, 64, 3), 1e300)))),
        ("nersp", "negative light", first("s0/*.npy", lambda p: np.save(p, np.full((48, 64, 3), -1.0)))),
        ("nersp", "light of another size", first("s1/*.npy", lambda p: np.save(p, np.ones((4, 4, 3))))),
        ("nersp", "a picture of two sizes", first("image/*.png", lambda p: (p.unlink(), made.deflated_tiff(p.with_suffix(".tif"), 30000, kind=9)))),
        ("pandora", "HDR of two sizes", first("images_stokes/*.hdr", lambda p: made.two_sizes_hdr(p, 30000))),
        ("pandora", "a view of superscripts", first("images_stokes/*_s0.hdr", lambda p: shutil.copyfile(p, p.with_name("\u0661\u0662_s0.hdr")))),
        ("pisr", "distortion of 1e300", lambda r: np.savez(r / "intrinsics.npz", camera_matrix=np.diag([1500.0, 1500, 1]), dist_coeffs=np.full((1, 5), 1e300))),
        ("pisr", "distortion of texts", lambda r: np.savez(r / "intrinsics.npz", camera_matrix=np.diag([1500.0, 1500, 1]), dist_coeffs=np.full((1, 5), "x"))),
        ("pisr", "two gammas", lambda r: (r / "gamma2.txt").touch()),
        ("pisr", "a gamma of nan", lambda r: [p.rename(r / "gammanan.txt") for p in r.glob("gamma*")]),
        ("gnerp", "cameras of deep JSON", lambda r: (r / "cameras.json").write_text("[" * 100_000)),
        ("gnerp", "cameras of texts", lambda r: spoil.json_field(r / "cameras.json", ("w2c_mat_0",), "x")),
        ("gnerp", "polarization of NaN", first("dop/*.npy", lambda p: np.save(p, np.full((48, 64), np.nan)))),
        ("gnerp", "polarization of 50", first("dop/*.npy", lambda p: np.save(p, np.full((48, 64), 50.0)))),
    ]  # fmt: skip
    for kind, name, spoiler in table:
        prepare = ["prepare", "data", "--out", "new", "--format", kind]
        yield case(f"{kind} with {name}", of(kind, spoiler), prepare)
