"""``polarguide run``: the recognized captures, the commands that follow, resuming, and refused options."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_files import behind, busy_light, write_mosaics, write_picture

from polarguide.cli import app
from polarguide.cli.runs import _is_current

Refused = Callable[..., str]
VIEWS = 6


def shots(folder: Path, angles: tuple[float, ...], name: str = "IMG_{0:04d}") -> Path:
    """Pictures of six places in a row, with running numbers as names."""
    folder.mkdir()
    for place in range(VIEWS):
        light = busy_light(96, 128, place) * np.array([1, 0.5, 0.5])[:, None, None, None]
        for turn, shot in enumerate(behind(light, angles)):
            file = name.format(place * len(angles) + turn + 1, place, angles[turn])
            write_picture(folder / f"{file}.png", np.clip(shot, 0, 1) * [0.9, 0.8, 1.0], bits=8)
    return folder


def video(folder: Path) -> Path:
    folder.mkdir()
    writer = cv2.VideoWriter(str(folder / "turn.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    return folder


def mosaics(folder: Path) -> Path:
    folder.mkdir()
    write_mosaics(folder, 3, bits=12)
    return folder


FOUR = (0, 45, 90, 135)
own_call = app.call


@pytest.mark.parametrize(
    ("make", "options", "recognized"),
    [
        (lambda at: shots(at, (0,)), (), "6 photographs without a polarizing filter"),
        (lambda at: shots(at, FOUR), ("--angles", "0,45,90,135"), "6 views, each with shots at 0, 45, 90 and 135"),
        (lambda at: shots(at, FOUR, "cup{1}_{2}"), (), "6 views, each with shots at 0, 45, 90 and 135"),
        (lambda at: shots(at, (0,)), ("--angles", "unknown"), "filter (angles: unknown)"),
        (lambda at: shots(at, (0, 60, 120)), ("--angles", "0,60,120"), "6 views, 18 photographs through"),
        (mosaics, ("--sensor", "IMX250MYR"), "3 raw mosaics"),
        (video, (), "the video turn.avi"),
    ],
    ids=["photographs", "numbered", "named", "unknown", "three", "mosaics", "video"],
)  # fmt: skip
def test_a_capture_is_recognized_and_its_commands_are_printed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    make: Callable[[Path], Path],
    options: tuple[str, ...],
    recognized: str,
) -> None:
    called: list[list[str]] = []
    monkeypatch.setattr(app, "call", lambda verb, words: called.append([*words]))
    monkeypatch.setattr("polarguide.cli.runs._verdict", lambda folder: "ok")
    monkeypatch.chdir(tmp_path)
    source = make(tmp_path / "My mug")
    own_call("run", ["run", source.name, *options, "--steps", "9", "--open", "--threads", "1"])
    first, *listed = capsys.readouterr().out.partition("\n\n")[0].splitlines()
    assert first.startswith("recognized: ")
    assert recognized in first
    scene = "runs/My mug/scene"
    assert called == [
        ["prepare", "My mug", "--out", scene, *options, "--threads", "1"],
        ["inspect", scene, "--out", "runs/My mug/inspection", "--threads", "1"],
        ["train", scene, "--out", "runs/My mug/run", "--steps", "9", "--viewer", "--threads", "1"],
        ["eval", "runs/My mug/run", "--threads", "1"],
        ["view", "runs/My mug/run", "--threads", "1"],
    ]
    assert [line.split()[1] for line in listed] == [words[0] for words in called]
    assert "'runs/My mug/scene'" in listed[0]
    assert not (tmp_path / "runs").exists()


def test_a_scene_is_trained_and_the_same_command_resumes(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second call resumes the finished training, and repeats no inspection unless the scene is newer."""
    scene = Path(shutil.copytree(demo_scene, tmp_path / "scene"))
    out = tmp_path / "out"
    called: list[str] = []

    def call(verb: str, words: Any) -> int:
        called.append(f"{verb} --resume" if "--resume" in words else verb)
        if verb != "inspect":
            return own_call(verb, words)
        (out / "inspection").mkdir(parents=True, exist_ok=True)
        record = {"verdict": "wrong", "scene": {"path": str(Path(words[1]).resolve())}}
        (out / "inspection" / "inspection.json").write_text(json.dumps(record))
        return 0

    monkeypatch.setattr(app, "call", call)
    line = [str(scene), "--out", str(out), "--recipe", "3dgs", "--steps", "8", "--downscale", "8"]
    line += ["--no-view", "--threads", "1"]
    own_call("run", ["run", *line])
    assert called == ["inspect", "train", "eval"]
    assert (out / "run" / "metrics.json").exists()
    printed = capsys.readouterr().out
    assert "recognized: a scene with poses" in printed
    assert "verdict of the inspection is wrong" in printed
    called.clear()
    own_call("run", ["run", *line])
    assert called == ["train --resume", "eval"]
    assert "verdict of the inspection is wrong" in capsys.readouterr().out
    called.clear()
    os.utime(scene / "split.json")
    own_call("run", ["run", *line])
    assert called == ["inspect", "train --resume", "eval"]


def test_an_inspection_of_another_scene_is_not_reused(demo_scene: Path, tmp_path: Path) -> None:
    """Both scenes are older than the record."""
    first = Path(shutil.copytree(demo_scene, tmp_path / "first"))
    second = Path(shutil.copytree(demo_scene, tmp_path / "second"))
    record = tmp_path / "inspection" / "inspection.json"
    assert not _is_current(record, first)
    own_call("inspect", ["inspect", str(first), "--out", str(record.parent), "--normals", "points"])
    assert _is_current(record, first)
    assert not _is_current(record, second)
    content = json.loads(record.read_text())
    del content["scene"]["path"]
    record.write_text(json.dumps(content))
    assert not _is_current(record, first)


def test_ctrl_c_names_the_command_that_continues(
    demo_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def call(verb: str, words: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "call", call)
    with pytest.raises(KeyboardInterrupt):
        own_call("run", ["run", str(demo_scene), "--out", str(tmp_path / "out")])
    assert "polarguide run" in capsys.readouterr().out


def test_what_cannot_be_run_is_refused_before_anything_is_written(
    demo_scene: Path, trained: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    numbered = shots(tmp_path / "numbered", FOUR)
    assert "--angles 0,45,90,135 --shots-per-view 4" in refused("run", numbered)
    assert "prepared scene" in refused("run", demo_scene, "--angles", "0,45,90,135")
    assert "run.json" in refused("run", demo_scene, "--out", trained)
    assert "camera files" in refused("run", tmp_path / "nowhere")
    assert "nothing to read" in refused("run", tmp_path / "empty")
    assert "a sensor" in refused("run", numbered, "--sensor", "IMX1")
    assert "--angles" in refused("run", numbered, "--shots-per-view", "4")
    assert "--steps" in refused("run", demo_scene, "--steps", "0")
    assert "recipe" in refused("run", demo_scene, "--recipe", "4dgs")
    assert not (tmp_path / "runs").exists()
