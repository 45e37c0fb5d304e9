# ruff: noqa: E501
"""Run folders of strangers: records, checkpoints, logs and names that are wrong."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from base import EVAL, RESUME, TRAIN
from fifth_scenes import raw, several, text
from further_records import RUNS, SHARE, no_script
from making import SAME, UNUSED, Change, MadeCase, link, made_case, nothing, of_bytes, of_json, put

A_NAME, NO_ERROR = "a name may be any that the disk takes", r"\A(?!.*error: )"
CHECKPOINT = "run/checkpoint.safetensors"
RENDER = ["render", "run", "--out", "new", "--layers", "final", *RUNS]


def export(kind: str) -> list[str]:
    """An export of the run."""
    return ["export", "run", "--format", kind, "--out", "new", *RUNS]


def record(*path: str, value: Any) -> Change:
    """A value of run.json."""

    def change(given: str) -> str:
        whole = inner = json.loads(given)
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        return json.dumps(whole)

    return text("run/run.json", change)


def configuration_cases() -> Iterator[MadeCase]:
    """run.json."""
    for name, change, command, accepted in (
        ("steps in words", record("settings", "steps", value="20"), RENDER, ""),
        ("a shading model that is a program", record("recipe_data", "shading", "model", value="os.system"), RENDER, ""),
        ("an environment of 10^9 texels a side", record("recipe_data", "shading", "environment_resolution", value=10**9), RENDER, ""),
        ("no stages, resumed", record("recipe_data", "stages", value=[]), RESUME, ""),
        ("a stage of no number, resumed", record("recipe_data", "stages", value=[{"fraction": float("nan")}]), RESUME, ""),
        ("test views that are a number", record("test_views", value=["../../x", 5]), RENDER, ""),
        ("test views that lead out", record("test_views", value=["../../x"]), RENDER, ""),
        ("an index that is true", record("settings", "refractive_index", value=True), RENDER, ""),
        ("boxes of a million pixels", record("downscale", value=10**6), EVAL, ""),
        ("another transfer", record("transfer", value="gamma"), RENDER, ""),
        ("a device that is not there", record("device", value="cuda:7"), RENDER, "it is a remark: --device says what to render on"),
        ("a recipe of a path", record("recipe", value="polarguide:../../x"), SHARE, ""),
        ("its own scene", lambda folder: record("scene", value=str(folder / "run"))(folder), EVAL, ""),
    ):  # fmt: skip
        yield made_case(f"fifth run.json: {name}", change, command, accepted)
    yield made_case("fifth run of a scene without a name", record("scene", value=""), EVAL, says="run.json")
    yield made_case(
        "fifth run without test views",
        record("test_views", value=[]),
        EVAL,
        says="expected test views to score",
    )


def _tensors(change: Callable[[dict[str, Any]], None]) -> Change:
    def changed(folder: Path) -> None:
        from safetensors.torch import load_file, save_file

        tensors = load_file(folder / CHECKPOINT)
        change(tensors)
        save_file({name: values.contiguous() for name, values in tensors.items()}, folder / CHECKPOINT)

    return changed


def _filled(name: str, value: float) -> Change:
    return _tensors(lambda tensors: tensors[name].fill_(value))


def _one(tensors: dict[str, Any]) -> None:
    count = len(tensors["gaussians.means"])
    for name, values in tensors.items():
        tensors[name] = values[:1] if values.shape[:1] == (count,) else values


def _shared(data: bytes) -> bytes:
    """Two tensors in the same bytes."""
    (length,) = struct.unpack("<Q", data[:8])
    head = json.loads(data[8 : 8 + length])
    head["gaussians.means"]["data_offsets"] = head["gaussians.log_scales"]["data_offsets"]
    written = json.dumps(head).encode()
    return struct.pack("<Q", len(written)) + written + data[8 + length :]


def checkpoint_cases() -> Iterator[MadeCase]:
    """checkpoint.safetensors."""
    for name, change, command, accepted in (
        ("a head of 2^63 bytes", raw(CHECKPOINT, lambda data: struct.pack("<Q", 1 << 63) + data[8:]), RENDER, ""),
        ("two tensors in one place", raw(CHECKPOINT, _shared), RENDER, ""),
        ("means in double precision", _tensors(lambda t: t.update({"gaussians.means": t["gaussians.means"].double()})), RENDER, ""),
        ("one Gaussian, as sog", _tensors(_one), export("sog"), "one is a scene"),
        ("rotations of zeros", _filled("gaussians.quaternions", 0), RENDER, ""),
        ("sizes of e^80", _filled("gaussians.log_scales", 80), RENDER, ""),
        ("places at 1e30", _filled("gaussians.means", 1e30), export("spz"), ""),
        ("one place for all, as mesh", _filled("gaussians.means", 0.25), [*export("mesh"), "--resolution", "32"], "a heap has a surface"),
        ("nothing to be seen, as points", _filled("gaussians.opacity_logits", -1e4), export("points"), ""),
        ("light of -1e20", _filled("environment.texels", -1e20), export("environment"), ""),
        ("a folder", put(CHECKPOINT, "folder"), RENDER, ""),
        ("another recipe's", lambda folder: os.replace(folder / "run-ref/checkpoint.safetensors", folder / CHECKPOINT), RENDER, ""),
    ):  # fmt: skip
        yield made_case(f"fifth checkpoint: {name}", change, command, accepted)


def record_cases() -> Iterator[MadeCase]:
    """What else lies in a run folder."""
    title = {"title": "a\nend_header\n\x1b[2J", "author": "x" * 1_000_000}
    inside_out = {"crop": {"low": [1, 1, 1], "high": [-1, -1, -1]}}
    for name, change, command, accepted in (
        ("a log of lists and words", of_bytes("run/log.jsonl", b'[1]\n"x"\n{"step":"x"}\n\xff{\n'), EVAL, UNUSED),
        ("a log that is a full disk", link("run/log.jsonl", "/dev/full"), RESUME, ""),
        ("a log outside", link("run/log.jsonl", "../../outside/victim.txt"), RESUME, SAME),
        ("scores of words, shared", of_json("run/metrics.json", {"psnr": "<script>alert(1)</script>"}), SHARE, ""),
        ("scores that are a number, shared", of_bytes("run/metrics.json", b"5"), SHARE, ""),
        ("white of zeros", of_json("run/presentation.json", {"white_balance": [0, 0, 0]}), RENDER, ""),
        ("an author of a million letters", of_json("run/presentation.json", title), export("ply"), ""),
        ("a box inside out", of_json("run/presentation.json", inside_out), export("points"), ""),
        ("a lock that is a folder", several(lambda folder: (folder / "run/.lock").unlink(missing_ok=True), put("run/.lock", "folder")), RESUME, ""),
    ):  # fmt: skip
        yield made_case(f"fifth run with {name}", change, command, accepted, no_script)


def name_cases() -> Iterator[MadeCase]:
    """Runs in a folder whose name is no UTF-8: what was trained there can be read again."""
    name = os.fsdecode(b"run\xff")

    def moved(folder: Path) -> None:
        (folder / "run").rename(folder / name)

    what = "fifth run in a folder whose name is no UTF-8"
    for verb, command in {
        "eval": ["eval", name, *EVAL[2:]],
        "render": ["render", name, "--layers", "final", "--out", name + "/new", *RUNS],
        "export ply": ["export", name, "--format", "ply", *RUNS],
        "export sog": ["export", name, "--format", "sog", *RUNS],
        "export environment": ["export", name, "--format", "environment", *RUNS],
        "export cameras": ["export", name, "--format", "cameras", *RUNS],
        "share": ["share", name, *RUNS],
    }.items():
        yield made_case(f"{what}: {verb}", moved, command, A_NAME, says=NO_ERROR)
    maps = [
        "priors",
        "mosaics",
        "--out",
        name,
        "--sensor",
        "IMX250MYR",
        "--bits",
        "16",
        "--formats",
        "exr",
        *RUNS,
    ]
    yield made_case(f"{what}: maps", nothing, maps, A_NAME, says=NO_ERROR)
    film = [
        "render",
        name,
        "--path",
        "orbit",
        "--frames",
        "2",
        "--layers",
        "final",
        "--video",
        name + "/a.mp4",
        *RUNS,
    ]
    yield made_case(f"{what}: a film", moved, film, A_NAME, says=NO_ERROR)
    yield made_case(
        f"{what}: train",
        nothing,
        ["train", "scene", "--out", name, *TRAIN[4:]],
        "a name may be any that the disk takes",
    )
