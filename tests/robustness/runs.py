"""Run folders of strangers: records, checkpoints, logs, and what is rendered along paths and in other light."""

from __future__ import annotations  # noqa: I001

import importlib
import struct
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
import spoil
from base import CHECKPOINT, EVAL, FLAGS, PICTURE, RENDER, RESUME, SHARE, export
from case import Case, Change, nothing, table
from changes import (
    OF_FILES, OPTIONAL, PLAUSIBLE, UNUSED, copy, edit, field, filled, put, remove, several, small_machine,
    sparse, tensors, write, write_json,
)  # fmt: skip

CASES: list[Case] = []

COMPUTED = "it is written anew from the run, and never read"
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
    *(Case(f"run.json {how} {verb}", spoil.json_of(RECORD, how), VERBS[verb], passes=OPTIONAL, seeds=4,
           ci=verb == "eval") for how in spoil.FIELDS for verb in ("eval", "resume")),
    *(Case(f"checkpoint is a {how}", put(CHECKPOINT, how), EVAL, ci=how in ("pipe", "device")) for how in OF_FILES),
    *(Case(f"log.jsonl is a {how}", put(LOG, how), RESUME, passes=OPTIONAL) for how in ("folder", "outside")),
    *(Case(f"metrics.json is a {how}", put("run/metrics.json", how), EVAL, passes=COMPUTED) for how in OF_FILES),
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


TWICE = edit(RECORD, lambda given: given.replace('"downscale": 1', '"downscale": 1,\n "downscale": 2'))
CASES += table(
    "run.json", EVAL,
    *(Case(f"with a {key} of {name}", _set(*key.split("."), to=value), passes=reason, ci=ci)
      for key, name, value, reason, ci in (
        ("scene", "no name", "", "", True),
        ("scene", "a long name", "x" * 300, "", True),
        ("version", "9.9.9", "9.9.9", "", True),
        ("version", "a number", 0.2, "", False),
        ("downscale", "10^9", 10**9, "", False),
        ("downscale", "0", 0, "", True),
        ("device", "another machine", "cuda:7\x1b[2J", "it is a remark: --device says what to render on", False),
        ("test_views", "ways out", ["../../x"], "", True),
        ("settings", "nothing", {}, "", True),
        ("settings.refractive_index", "-1", -1, "", True),
        ("settings.refractive_index", "words", "1.5", "", True),
        ("recipe", "a path", "../../outside", "", True),
        ("recipe_data.shading.model", "a program", "os.system", "", True),
      )),
    Case("without test views", _set("test_views", to=[]), expected="test view", ci=True),
    Case("with a version of a million letters", edit(RECORD, lambda given: given.replace(
        '"version": "', '"version": "' + "v" * 1_000_000)), RENDER, prints=r"\A.{,2000}\Z", ci=True),
    Case("with a key twice", TWICE, RENDER, found="occurs twice", ci=True),
    Case("of 2 GiB", sparse(RECORD, (1 << 31) - 1, b"{"), ci=True),
)  # fmt: skip


CASES += table(
    "run", EVAL,
    Case("with its settings alone", remove(CHECKPOINT, LOG, "run/metrics.json"), ci=True),
    Case("with the checkpoint of another recipe", copy("run-ref/checkpoint.safetensors", CHECKPOINT), ci=True),
    Case("with scores of words, shared", write_json("run/metrics.json", {"psnr": "<script>alert(1)</script>"}), SHARE),
    Case("with a lock that is a folder", put("run/.lock", "folder"), RESUME),
    Case("resumed with fewer steps", nothing, RESUME.replace("--steps 10", "--steps 3")),
    Case("whose scene is gone, scored", remove("scene"), ci=True),
    Case("whose scene is gone, exported", remove("scene"), export("ply"), passes="a PLY takes no pictures"),
    Case("whose scene has another picture, resumed", copy("scene/polar/v002_045.png", PICTURE), RESUME, ci=True),
)  # fmt: skip

rows = ('{"step": "x"}', '{"step": 1e400}', "[]", '{"step": 1, "seconds": "x", "alone": []}', '{"step": true}', "\x00",
        "[" * 5000)  # fmt: skip
CASES += table(
    "log", RESUME,
    *(Case(f"row {number}", write(LOG, row + "\n"), passes=DROPPED, ci=number == 1) for number, row in enumerate(rows)),
    Case("of 8 million lines", write(LOG, b"{}\n" * 8_000_000), passes=DROPPED),
    Case("of lists and words, scored", write(LOG, b'[1]\n"x"\n{"step":"x"}\n\xff{\n'), EVAL, passes=UNUSED),
)  # fmt: skip


def _empty(whole: dict[str, Any]) -> None:
    whole.update(spoil.without_gaussians(whole))
    whole.update({name: values[..., :0] for name, values in whole.items() if name.startswith("statistics")})


PICKLE = b"\x80\x04cos\nsystem\n(S'touch ../outside/made'\ntR."
CASES += table(
    "checkpoint", EVAL,
    Case("of a head of 2^63 bytes", write(CHECKPOINT, struct.pack("<Q", 1 << 63) + b"{}"), ci=True),
    Case("of a head of brackets", write(CHECKPOINT, struct.pack("<Q", 15_000) + b'{"a":' * 3000), RENDER, ci=True),
    Case("as a pickle", write(CHECKPOINT, PICKLE), ci=True),
    Case("of no Gaussian, resumed", tensors(_empty), RESUME, ci=True),
)  # fmt: skip


CASES += table(
    "checkpoint with all", EVAL,
    *(Case(f"{tensor} {value:g} {verb}", filled(f"gaussians.{tensor}", value), VERBS[verb], passes=EXTREME)
      for tensor, value in (("log_scales", 60.0), ("log_scales", -1e4), ("means", 1e12), ("means", 0.0),
                            ("quaternions", 1e-40), ("quaternions", 1e8), ("opacity_logits", 1e8),
                            ("opacity_logits", -1e8))
      for verb in VERBS if verb in ("eval", "share") or value in (60.0, 1e12, 1e-40)),
    Case("means in one place, as mesh", filled("gaussians.means", 0.25), f"{export('mesh')} --resolution 32",
         passes="a heap has a surface"),
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


drawn = several(_path({}, {}), spoil.json_of("path.json"))
CASES += table(
    "path", ALONG,
    Case("with a field spoiled, as a film", drawn, f"{FILM} --frames 2", passes=PLAUSIBLE, seeds=12),
    *(Case(f"is a {how}", put("path.json", how), FILM, where=r"path\.json", found="a pipe or device", ci=True)
      for how in ("pipe", "device")),
    *(Case(f"{name}{kind}", small_machine(_path(*fields, rate=rate)), command, passes=reason, ci=ci,
           check=_nothing_left) for name, fields, rate, reason, ci in (
        ("of a side of 8192", [{"width": 8192, "height": 8192}], 30, "", False),
        ("of sides that differ", [{}, {"width": 20}], 30, "", True),
        ("of a mirror", [{"rotation": [-1, 0, 0, 0, 1, 0, 0, 0, 1]}] * 2, 30, "", False),
        ("of a slow rate", [{}, {}], 1e-300, "any rate will do", False),
      ) for kind, command in (("", ALONG), (", as a film", FILM))),
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


CASES += [
    Case(f"environment {name}", change, RENDER, f"--environment {file} --views v000", check=_nothing_left, ci=ci)
    for name, file, change, ci in (
        ("EXR of a huge window", "sky.exr", lambda: made.exr(Path("sky.exr"), 40000), True),
        ("EXR of no numbers", "sky.exr", _panorama(float("nan")), True),
        ("EXR without light", "sky.exr", _panorama(0.0), True),
        ("HDR of two sizes", "sky.hdr", lambda: made.two_sizes_hdr(Path("sky.hdr"), 30000), False),
        ("array of negative light", "sky.npy", lambda: np.save("sky.npy", -np.ones((4, 8, 3))), True),
    )
]  # fmt: skip
