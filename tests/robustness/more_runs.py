# ruff: noqa: E501
"""Run folders of strangers, and links in them."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import hostile_files as made
import numpy as np
import spoil
from base import EVAL, MOSAICS, RESUME, TRAIN
from forked import Case
from making import SAME, Change, link, of_bytes, of_json, small_machine, sparse
from making import more_case as case

SHARE = ["share", "run", "--out", "new.html"]
RENDER = ["render", "run", "--out", "new", "--device", "cpu"]
UNFINISHED = [*MOSAICS[:3], "unfinished", *MOSAICS[4:]]


def _pid_link(folder: Path, name: str) -> None:
    """What somebody who guesses the number of the process puts where its temporary file will be."""
    path = folder / name
    path.with_name(f".{path.name}.{os.getpid()}.tmp").symlink_to("../../outside/victim.txt")


def link_cases() -> Iterator[Case]:
    """Links in folders of strangers that lead what is written elsewhere."""
    victim = "../../outside/victim.txt"
    export = ["export", "run", "--format"]
    for name, change, command in (
        ("lock of a run", link("run/.lock", victim), RESUME),
        ("log of a run", link("run/log.jsonl", victim), RESUME),
        ("checkpoint of a run", link("run/checkpoint.safetensors", victim), RESUME),
        ("PLY of a run", link("run/point_cloud.ply", victim), RESUME),
        ("scores of a run", link("run/metrics.json", victim), EVAL),
        ("errors of a run", link("run/errors.png", victim), EVAL),
        ("page of a run", link("run/share.html", victim), ["share", "run"]),
        ("pictures of a run", link("run/render"), ["render", "run", "--device", "cpu"]),
        ("exports of a run", link("run/export"), [*export, "points"]),
        ("cameras of a run", link("run/export"), [*export, "cameras"]),
        ("environment of a run", link("run/export"), [*export, "environment"]),
        ("folder of cameras in exports", link("new/sparse"), [*export, "cameras", "--out", "new"]),
        ("temporary file of run.json", lambda f: _pid_link(f, "run/run.json"), RESUME),
        ("temporary file of the scores", lambda f: _pid_link(f, "run/metrics.json"), EVAL),
        ("temporary file of a page", lambda f: _pid_link(f, "run/share.html"), ["share", "run"]),
        ("temporary file of the log", lambda f: _pid_link(f, "run/log.jsonl"), RESUME),
        ("lock of a new run", link("new/.lock", victim), TRAIN),
        ("log of a new run", link("new/log.jsonl", victim), TRAIN),
        ("folder of an inspection", link("scene-inspection"), ["inspect", "scene", "--normals", "points"]),
        ("pictures of an unfinished scene", link("unfinished/polar"), UNFINISHED),
        ("sparse of an unfinished scene", link("unfinished/sparse"), [*UNFINISHED[:-1], "model"]),
        (
            "photographs of an unfinished scene",
            link("unfinished/.sfm/images", "../../../outside"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        (
            "masks of an unfinished scene",
            link("unfinished/.sfm/masks", "../../../outside"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        (
            "database of an unfinished scene",
            link("unfinished/.sfm/database.db", "../../../outside/made.db"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        ("a picture of an unfinished scene", link("unfinished/polar/v000_000.png", victim), UNFINISHED),
        (
            "journal of an unfinished scene",
            lambda f: (
                (
                    shutil.move(f / "unfinished/prepare.json", f / "kept.json"),
                    (f / "unfinished/prepare.json").symlink_to("../kept.json"),
                )
            ),
            UNFINISHED,
        ),
        (
            "partial model of an unfinished scene",
            link("unfinished/.sparse.partial"),
            [*UNFINISHED[:-1], "model"],
        ),
        (
            "lock of a comparison",
            link("new/.lock", victim),
            ["compare", "scene", "--recipes", "3dgs", "--out", "new", "--steps", "0"],
        ),
    ):
        yield case(f"link for the {name}", change, command, "a link is replaced, and what it led to stays")
    yield case(
        "odd temporary name",
        lambda f: (f / "run/.run.json.\u00b2.tmp").write_text(""),
        RESUME,
        "it is nobody's",
    )
    yield case(
        "temporary folder of this process",
        lambda f: (f / f"new/.sparse.{os.getpid()}.tmp").mkdir(parents=True),
        [*export, "cameras", "--out", "new"],
        "what an earlier process of this number left is removed",
    )


def run_cases() -> Iterator[Case]:
    """Run folders, and the small files that commands read."""
    for name, change, command, reason in (
        ("log of 8 million lines", of_bytes("run/log.jsonl", b"{}\n" * 8_000_000), RESUME, "lines that are none are dropped"),
        ("log of 300000 rows", of_bytes("run/log.jsonl", b'{"step": 3, "seconds": 1}\n' * 300_000), RESUME, "a log may be long"),
        ("log of one line of 50 MB", of_bytes("run/log.jsonl", b'{"step": 1, "x": "' + b"x" * 50_000_000 + b'"}'), RESUME, "a line may be long"),
        ("log with a half character", of_bytes("run/log.jsonl", b'{"step": 1, "x": "\\ud800"}\n{"step": 2, "x": "\xff"}\n'), RESUME, "lines that are none are dropped"),
        ("scene of no name", lambda f: spoil.json_field(f / "run/run.json", ("scene",), ""), EVAL, ""),
        ("scene of a NUL", lambda f: spoil.json_field(f / "run/run.json", ("scene",), "a\0b"), EVAL, ""),
        ("scene of a long name", lambda f: spoil.json_field(f / "run/run.json", ("scene",), "x" * 300), EVAL, ""),
        ("scene of half a character", lambda f: spoil.json_field(f / "run/run.json", ("scene",), "\ud800"), EVAL, ""),
        ("scene of control characters", lambda f: spoil.json_field(f / "run/run.json", ("scene",), "\x1b[2J\x1b]0;mine\x07\u202e"), EVAL, ""),
        ("scene of a device", lambda f: spoil.json_field(f / "run/run.json", ("scene",), "/dev/zero"), EVAL, ""),
        ("recipe of a module", lambda f: spoil.json_field(f / "run/run.json", ("recipe",), "os:system"), EVAL, ""),
        ("recipe of a path", lambda f: spoil.json_field(f / "run/run.json", ("recipe",), "../../outside"), EVAL, ""),
        ("recipe of another kind", lambda f: spoil.json_field(f / "run/run.json", ("recipe",), "3dgs"), EVAL, ""),
        ("downscale of 1e9", lambda f: spoil.json_field(f / "run/run.json", ("downscale",), 10**9), EVAL, ""),
        ("downscale of 0", lambda f: spoil.json_field(f / "run/run.json", ("downscale",), 0), EVAL, ""),
        ("version of a million letters", lambda f: spoil.json_field(f / "run/run.json", ("version",), "x" * 10**6), EVAL, ""),
        ("device of control characters", lambda f: spoil.json_field(f / "run/run.json", ("device",), "\x1b[2J"), EVAL, "it is a note"),
        ("run.json of 2 GiB", lambda f: sparse(f / "run/run.json", (1 << 31) - 1, b"{"), EVAL, ""),
        ("run.json in UTF-16", lambda f: (f / "run/run.json").write_bytes((f / "run/run.json").read_text().encode("utf-16")), EVAL, SAME),
    ):  # fmt: skip
        yield case(f"run {name}", change, command, reason)
    yield from _checkpoint_cases()
    yield from _environment_cases()
    camera = {"width": 12, "height": 10, "fx": 15.0, "fy": 15.0, "cx": 6.0, "cy": 5.0,
              "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 2.5]}  # fmt: skip
    for name, cameras, rate, reason in (
        ("of a side of 8192", [{**camera, "width": 8192, "height": 8192}], 30, ""),
        ("of sides that differ", [camera, {**camera, "width": 20}], 30, ""),
        ("of a tiny focal length", [{**camera, "fx": 1e-300, "fy": 1e-300}] * 2, 30, "any lens will do"),
        ("of a huge focal length", [{**camera, "fx": 1e300, "fy": 1e300}] * 2, 30, "any lens will do"),
        ("of a far place", [{**camera, "translation": [1e300, 0, 0]}] * 2, 30, "any place will do"),
        ("of a mirror", [{**camera, "rotation": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}] * 2, 30, ""),
        ("of a slow rate", [camera] * 2, 1e-300, "any rate will do"),
        ("of a fast rate", [camera] * 2, 999.999, "any rate will do"),
        ("of 1 pixel", [{**camera, "width": 1, "height": 1}] * 2, 30, "any size will do"),
    ):  # fmt: skip
        for how in (["--video", "new.mp4"], ["--out", "new"]):
            yield case(
                f"path {name} {how[0]}",
                small_machine(of_json("path.json", {"frames_per_second": rate, "cameras": cameras})),
                ["render", "run", "--path", "path.json", *how, "--layers", "final", "--device", "cpu"],
                reason,
            )


def _checkpoint_cases() -> Iterator[Case]:
    def raw(head: bytes, data: bytes = b"", length: int | None = None) -> Change:
        return of_bytes(
            "run/checkpoint.safetensors",
            struct.pack("<Q", len(head) if length is None else length) + head + data,
        )

    for name, change in {
        "of a head of 2^63 bytes": raw(b"{}", length=1 << 63),
        "of a head of 90 MB": raw(b"{}" + b" " * 90_000_000),
        "of a deep head": raw(b"[" * 100_000),
        "of nothing": raw(b"{}"),
        "of a tensor twice": raw(b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}}', bytes(8)),
        "of a tensor of 2^62": raw(b'{"gaussians.means":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}}'),
        "of a negative place": raw(b'{"gaussians.means":{"dtype":"F32","shape":[1],"data_offsets":[-4,0]}}'),
        "of tensors that overlap": raw(b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"b":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}', bytes(4)),
        "of an unknown type": raw(b'{"gaussians.means":{"dtype":"F8_E5M2","shape":[4],"data_offsets":[0,4]}}', bytes(4)),
        "of a million tensors": raw(b"{" + b",".join(b'"%d":{"dtype":"U8","shape":[0],"data_offsets":[0,0]}' % k for k in range(200_000)) + b"}"),
        "as a pickle": of_bytes("run/checkpoint.safetensors", b"\x80\x04cos\nsystem\n(S'touch ../outside/made'\ntR."),
    }.items():  # fmt: skip
        yield case(f"checkpoint {name}", change, EVAL)

    def set_all(name: str, value: float) -> Change:
        def change(folder: Path) -> None:
            from safetensors.torch import load_file, save_file

            whole = load_file(folder / "run/checkpoint.safetensors")
            whole[name][...] = value
            save_file(whole, folder / "run/checkpoint.safetensors")

        return change

    extreme = "values in range are rendered as they are"
    for tensor, value in (("log_scales", 60.0), ("log_scales", -1e4), ("means", 1e12), ("means", 0.0), ("quaternions", 1e-40),
                          ("quaternions", 1e8), ("opacity_logits", 1e8), ("opacity_logits", -1e8)):  # fmt: skip
        for verb, command in (
            ("eval", EVAL),
            ("share", SHARE),
            ("ply", ["export", "run", "--format", "ply", "--out", "new"]),
            ("resume", RESUME),
        ):
            if verb in ("eval", "share") or value in (60.0, 1e12, 1e-40):
                yield case(
                    f"checkpoint with all {tensor} {value:g} {verb}",
                    set_all(f"gaussians.{tensor}", value),
                    command,
                    extreme,
                )
    yield case("checkpoint with a step of 2^50", lambda f: _scalars(f, [1 << 50, 0]), RESUME)
    yield case("checkpoint with a later freeze", lambda f: _scalars(f, [10, 1 << 50]), RESUME, extreme)


def _scalars(folder: Path, values: list[int]) -> None:
    import torch
    from safetensors.torch import load_file, save_file

    whole = load_file(folder / "run/checkpoint.safetensors")
    whole["scalars"] = torch.tensor(values)
    save_file(whole, folder / "run/checkpoint.safetensors")


def _environment_cases() -> Iterator[Case]:
    def lit(name: str) -> list[str]:
        return [*RENDER, "--environment", name, "--views", "v000", "--layers", "final"]

    row = np.ones((4, 8, 3), np.float32)
    for name, file, change in (
        ("EXR of a huge window", "sky.exr", lambda f: made.exr(f / "sky.exr", 40000)),
        ("EXR of nothing", "sky.exr", of_bytes("sky.exr", b"\x76\x2f\x31\x01")),
        ("HDR of two sizes", "sky.hdr", lambda f: made.two_sizes_hdr(f / "sky.hdr", 30000)),
        ("array of NaN", "sky.npy", lambda f: np.save(f / "sky.npy", row * np.nan)),
        ("array of infinities", "sky.npy", lambda f: np.save(f / "sky.npy", row * np.inf)),
        ("array of negative light", "sky.npy", lambda f: np.save(f / "sky.npy", -row)),
        ("array of 1e300", "sky.npy", lambda f: np.save(f / "sky.npy", row.astype(float) * 1e300)),
        ("array of nothing", "sky.npy", lambda f: np.save(f / "sky.npy", row[:0])),
        ("array of 7 channels", "sky.npy", lambda f: np.save(f / "sky.npy", np.ones((4, 8, 7)))),
        ("array of 1 pixel", "sky.npy", lambda f: np.save(f / "sky.npy", np.ones((1, 1)))),
        ("pipe", "sky.hdr", lambda f: os.mkfifo(f / "sky.hdr")),
        ("folder", "sky.exr", lambda f: (f / "sky.exr").mkdir()),
    ):
        yield case(f"environment {name}", change, lit(file))
