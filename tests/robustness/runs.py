"""Run folders of strangers: records, checkpoints, logs, and what is rendered from them along paths and in other light."""

from __future__ import annotations  # noqa: I001

import importlib
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
import spoil
from base import CHECKPOINT, EVAL, FLAGS, ONE, RENDER, RESUME, SHARE, export
from case import Case, Change, nothing, table
from changes import (
    OF_FILES, PLAUSIBLE, UNUSED, copy, edit, field, filled, link, put, remove, several, small_machine,
    sparse, tensors, write, write_json,
)  # fmt: skip

CASES: list[Case] = []

COMPUTED = "it is written anew from the run, and never read"
OPTIONAL = "the field may be missing, and is not relied on"
DROPPED = "lines that are none are dropped"
EXTREME = "values in range are rendered as they are"
RECORD, LOG = "run/run.json", "run/log.jsonl"
VERBS = {"eval": EVAL, "resume": RESUME, "export": export("ply"), "share": SHARE}

empty = "a run may have no Gaussians"
CASES += [
    *(Case(f"checkpoint {how} {verb}", spoil.bytes_of(CHECKPOINT, how), VERBS[verb], seeds=1, ci=verb == "eval",
           passes=PLAUSIBLE if how in ("flip", "fill") else "") for how in spoil.BYTES for verb in ("eval", "resume")),
    *(Case(f"tensor {how} {verb}", spoil.checkpoint(how), command, passes=empty if how == "none" else "", seeds=1,
           ci=verb == "eval") for how in spoil.TENSORS for verb, command in VERBS.items()),
    *(Case(f"tensor {how} ref-gs", spoil.checkpoint(how, "run-ref/checkpoint.safetensors"),
           EVAL.replace("run", "run-ref", 1), passes=empty if how == "none" else "", seeds=1) for how in spoil.TENSORS),
    *(Case(f"run.json {how} {verb}", spoil.json_of(RECORD, how), VERBS[verb], passes=OPTIONAL, seeds=4, ci=verb == "eval")
      for how in spoil.FIELDS for verb in ("eval", "resume")),
    *(Case(f"{name} is a {how}", put(f"run/{name}", how), RESUME if name == "log.jsonl" else EVAL, passes=reason,
           ci=name.startswith("check") and how in ("pipe", "device"))
      for name, reason in (("run.json", ""), ("checkpoint.safetensors", ""), ("log.jsonl", OPTIONAL),
                           ("metrics.json", COMPUTED)) for how in OF_FILES),
    *(Case(f"log {how}", spoil.bytes_of(LOG, how), RESUME, passes="a log that was cut short is completed", seeds=1)
      for how in spoil.BYTES),
    *(Case(f"run.json {how}", spoil.bytes_of(RECORD, how), EVAL, passes=PLAUSIBLE, seeds=1) for how in spoil.BYTES),
    Case("metrics fill", spoil.bytes_of("run/metrics.json", "fill"), EVAL, passes=COMPUTED, seeds=1),
    Case("checkpoint is a pipe, resumed", put(CHECKPOINT, "pipe"), RESUME, where=CHECKPOINT, found="a pipe or device",
         ci=True),
    Case("checkpoint is a pipe, shared", put(CHECKPOINT, "pipe"), SHARE, found="a pipe or device", ci=True),
]  # fmt: skip


def _set(*keys: Any, to: Any) -> Change:
    return field(RECORD, *keys, to=to)

twice = edit(RECORD, lambda given: given.replace('"downscale": 1', '"downscale": 1,\n "downscale": 2'))
scenes = (
    ("of no name", "", True), ("of a long name", "x" * 300, True),
)  # fmt: skip
CASES += table(
    "run.json", EVAL,
    *(Case(f"with a scene {name}", _set("scene", to=value), ci=ci) for name, value, ci in scenes),
    *(Case(f"with a refractive index of {value}", _set("settings", "refractive_index", to=value), ci=value in (-1, "1.5"))
      for value in (0, -1, 1e30, float("nan"), "1.5", True)),
    *(Case(f"with a {key} of {name}", _set(key, to=value), passes=reason, ci=ci) for key, name, value, reason, ci in (
        ("version", "9.9.9", "9.9.9", "", True),
        ("version", "a number", 0.2, "", False),
        ("version", "nothing", "", "", False),
        ("version", "control characters", "0.9\x1b[2J", "", False),
        ("downscale", "10^9", 10**9, "", False),
        ("downscale", "0", 0, "", True),
        ("device", "control characters", "\x1b[2J", "it is a note", False),
        ("device", "another machine", "cuda:7", "it is a remark: --device says what to render on", False),
        ("transfer", "another name", "gamma", "", False),
        ("test_views", "ways out", ["../../x"], "", True),
        ("test_views", "numbers", ["../../x", 5], "", False),
        ("settings", "nothing", {}, "", False),
        ("recipe_data", "a text", "x", "", False),
    )),
    Case("without test views", _set("test_views", to=[]), expected="test views to score", ci=True),
    Case("with a version of a million letters", edit(RECORD, lambda given: given.replace(
        '"version": "', '"version": "' + "v" * 1_000_000)), RENDER, prints=r"\A.{,2000}\Z", ci=True),
    Case("with a key twice", twice, RENDER, found="stands there twice", ci=True),
    Case("of 2 GiB", sparse(RECORD, (1 << 31) - 1, b"{"), ci=True),
    Case("of its own scene", lambda: _set("scene", to=str(Path("run").absolute()))()),
)  # fmt: skip

{"fraction": float("nan")}
CASES += table(
    "run.json with", EVAL,
    Case("a recipe of a path", _set("recipe", to="../../outside"), ci=True),
    Case("a recipe of another kind", _set("recipe", to="3dgs")),
    Case("a shading model that is a program", _set("recipe_data", "shading", "model", to="os.system"), ci=True),
    Case("no stages, resumed", _set("recipe_data", "stages", to=[]), RESUME),
)  # fmt: skip


def _only(*names: str) -> Change:
    return lambda: remove(*(f"run/{name}" for name in os.listdir("run") if name not in names))()

other = copy("run-ref/checkpoint.safetensors", CHECKPOINT)
CASES += table(
    "run", EVAL,
    Case("with nothing in it", _only()),
    Case("with its settings alone", _only("run.json"), ci=True),
    Case("with its checkpoint alone", _only("checkpoint.safetensors")),
    Case("with the checkpoint of another recipe", other, ci=True),
    Case("with a log that is a full disk", link(LOG, "/dev/full"), RESUME),
    Case("with scores that are a number, shared", write("run/metrics.json", "5"), SHARE),
    Case("with a page that is a folder", put("run/share.html", "folder"), f"share run {ONE}"),
    Case("with a lock that is a folder", put("run/.lock", "folder"), RESUME),
    Case("that is none, for priors", nothing, f"priors scene --out new --run mosaics {ONE}"),
    *(Case(f"resumed with {name}", nothing, command) for name, command in (
        ("another seed", f"{RESUME} --seed 7"), ("fewer steps", RESUME.replace("--steps 10", "--steps 3")),
        ("another recipe", f"{RESUME} --recipe 3dgs"), ("another size", f"{RESUME} --downscale 2"))),
)  # fmt: skip

gone, another = remove("scene"), copy("scene/polar/v002_045.png", "scene/polar/v001_045.png")
fewer = lambda: remove(*map(str, Path("scene").rglob("v008*")))()  # noqa: E731
CASES += table(
    "run whose scene", EVAL,
    Case("is gone, scored", gone, ci=True),
    Case("is gone, exported", gone, export("ply"), passes="a PLY takes no pictures"),
    Case("is a file", put("scene", "file")),
    Case("has another picture, resumed", another, RESUME, ci=True),
    Case("has a view less, resumed", fewer, RESUME),
)  # fmt: skip

rows = ('{"step": "x"}', '{"step": 1e400}', "[]", '{"step": 1, "seconds": "x", "alone": []}', '{"step": true}', "\x00",
        "[" * 5000)  # fmt: skip
CASES += table(
    "log", RESUME,
    *(Case(f"row {number}", write(LOG, row + "\n"), passes=DROPPED, ci=number == 1) for number, row in enumerate(rows)),
    Case("of 8 million lines", write(LOG, b"{}\n" * 8_000_000), passes=DROPPED, ci=True),
    Case("of lists and words, scored", write(LOG, b'[1]\n"x"\n{"step":"x"}\n\xff{\n'), EVAL, passes=UNUSED),
)  # fmt: skip


def _raw(head: bytes, data: bytes = b"", length: int | None = None) -> Change:
    return write(CHECKPOINT, struct.pack("<Q", len(head) if length is None else length) + head + data)


def _shared(data: bytes) -> bytes:
    """Two tensors in the same bytes."""
    (length,) = struct.unpack("<Q", data[:8])
    head = json.loads(data[8 : 8 + length])
    head["gaussians.means"]["data_offsets"] = head["gaussians.log_scales"]["data_offsets"]
    written = json.dumps(head).encode()
    return struct.pack("<Q", len(written)) + written + data[8 + length :]


def _empty(whole: dict[str, Any]) -> None:
    whole.update(spoil.without_gaussians(whole))
    whole.update({name: values[..., :0] for name, values in whole.items() if name.startswith("statistics")})


def _one(whole: dict[str, Any]) -> None:
    count = whole["gaussians.means"].shape[:1]
    whole.update({name: values[:1] for name, values in whole.items() if values.shape[:1] == count})


def _scalars(*values: int) -> Change:
    return tensors(lambda whole: whole.update(scalars=importlib.import_module("torch").tensor(values)))


one = '"{}":{{"dtype":"{}","shape":[{}],"data_offsets":[{}]}}'

def head(*rows: tuple[str, str, str, str]) -> bytes:
    return ("{" + ",".join(one.format(*row) for row in rows) + "}").encode()

pickle = b"\x80\x04cos\nsystem\n(S'touch ../outside/made'\ntR."
[(str(k), "U8", "0", "0,0") for k in range(200_000)]
CASES += table(
    "checkpoint", EVAL,
    Case("of a head of 2^63 bytes", _raw(b"{}", length=1 << 63), ci=True),
    Case("of a head of brackets", write(CHECKPOINT, struct.pack("<Q", 15_000) + b'{"a":' * 3000), RENDER, ci=True),
    Case("of tensors that overlap", _raw(head(("a", "F32", "1", "0,4"), ("b", "F32", "1", "0,4")), bytes(4)), ci=True),
    Case("as a pickle", write(CHECKPOINT, pickle), ci=True),
    Case("of no Gaussian, rendered", tensors(_empty), RENDER),
    Case("of no Gaussian, resumed", tensors(_empty), RESUME, ci=True),
    Case("of one Gaussian, as sog", tensors(_one), export("sog"), passes="one is a scene"),
    Case("of a step of 2^50", _scalars(1 << 50, 0), RESUME),
)  # fmt: skip


heap = "a heap has a surface"
mesh = f"{export('mesh')} --resolution 32"
CASES += table(
    "checkpoint with all", EVAL,
    *(Case(f"{tensor} {value:g} {verb}", filled(f"gaussians.{tensor}", value), VERBS[verb], passes=EXTREME)
      for tensor, value in (("log_scales", 60.0), ("log_scales", -1e4), ("means", 1e12), ("means", 0.0),
                            ("quaternions", 1e-40), ("quaternions", 1e8), ("opacity_logits", 1e8),
                            ("opacity_logits", -1e8))
      for verb in VERBS if verb in ("eval", "share") or value in (60.0, 1e12, 1e-40)),
    Case("log_scales 80", filled("gaussians.log_scales", 80), RENDER, ci=True),
    Case("means in one place, as mesh", filled("gaussians.means", 0.25), mesh, passes=heap),
    Case("opacities of nothing, as points", filled("gaussians.opacity_logits", -1e4), export("points"), ci=True),
)  # fmt: skip


LENS: dict[str, Any] = {
    "width": 12, "height": 10, "fx": 15.0, "fy": 15.0, "cx": 6.0, "cy": 5.0,
    "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 2.5],
}  # fmt: skip
ALONG = f"{RENDER} --path path.json"
FILM = f"render run --path path.json --video new.mp4 --layers final {FLAGS}"


def _path(*fields: dict[str, Any], rate: float = 30) -> Change:
    cameras = [{**LENS, **changed} for changed in fields]
    return write_json("path.json", {"frames_per_second": rate, "cameras": cameras})


def _nothing_left() -> None:
    assert not list(Path().glob(".*.tmp*"))

place = "any place will do"
lens = "any lens will do"
drawn = several(_path({}, {}), spoil.json_of("path.json"))
CASES += table(
    "path", ALONG,
    Case("with a field spoiled, as a film", drawn, f"{FILM} --frames 2", passes=PLAUSIBLE, seeds=12),
    *(Case(f"is a {how}", put("path.json", how), FILM, where=r"path\.json", found="a pipe or device", ci=True)
      for how in ("pipe", "device")),
    *(Case(f"{name}{kind}", small_machine(_path(*fields, rate=rate)), command, passes=reason, check=_nothing_left, ci=ci)
      for name, fields, rate, reason, ci in (
        ("of a side of 8192", [{"width": 8192, "height": 8192}], 30, "", False),
        ("of sides that differ", [{}, {"width": 20}], 30, "", True),
        ("of a far place", [{"translation": [1e300, 0, 0]}] * 2, 30, place, False),
        ("of a mirror", [{"rotation": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}] * 2, 30, "", False),
        ("of a slow rate", [{}, {}], 1e-300, "any rate will do", False),
        ("of 1 pixel", [{"width": 1, "height": 1}] * 2, 30, "any size will do", False),
      ) for kind, command in (("", ALONG), (", as a film", FILM))),
    Case("without speed, as a film", _path({}, {}, rate=0), FILM),
    Case("of a huge focal length", _path({"fx": 1e300, "fy": 1e300}), passes=lens),
    Case("of a focal length of nearly nothing", _path({"fx": 1e-30}), expected="positive focal lengths", ci=True),
    Case("of a principal point beyond all", _path({"cx": 1e300}), expected="principal point", ci=True),
    Case("of a place beyond all", _path({"translation": [1e38, 0, 0]}), prints="translation", ci=True),
)  # fmt: skip


def _panorama(value: float) -> Change:
    def change() -> None:
        files = importlib.import_module("OpenEXR")
        pixels = np.full((8, 16, 3), value, np.float32)
        files.File({"type": files.scanlineimage}, {"RGB": pixels}).write("sky.exr")

    return change

b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000 +X 2000000\n" + bytes(100)
row = np.ones((4, 8, 3))

def lit(name: str, change: Callable[[], object], suffix: str = "npy", ci: bool = False) -> Case:
    return Case(name, change, more=f"--environment sky.{suffix} --views v000", check=_nothing_left, ci=ci)

def array(name: str, values: np.ndarray, ci: bool = False) -> Case:
    return lit(f"array of {name}", lambda: np.save("sky.npy", values), ci=ci)

CASES += table(
    "environment", RENDER,
    lit("EXR of a huge window", lambda: made.exr(Path("sky.exr"), 40000), "exr", ci=True),
    lit("EXR of no numbers", _panorama(float("nan")), "exr", ci=True),
    lit("EXR without light", _panorama(0.0), "exr", ci=True),
    lit("HDR of two sizes", lambda: made.two_sizes_hdr(Path("sky.hdr"), 30000), "hdr"),
    lit("that is a pipe", put("sky.hdr", "pipe"), "hdr"),
    array("NaN", row * np.nan),
    array("negative light", -row, ci=True),
)  # fmt: skip
