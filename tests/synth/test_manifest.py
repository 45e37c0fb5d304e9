"""Checksums of a rendered scene that somebody else made."""

import hashlib
import json
import os
from pathlib import Path

import pytest
from faults import Fault

from polarguide_synth.folder import MANIFEST, folder_state, verify_scene


def scene(root: Path, listed: bytes = b"") -> Path:
    root.mkdir()
    (root / MANIFEST).write_bytes(listed)
    (root / "scene.json").write_text(json.dumps({"sha256": hashlib.sha256(listed).hexdigest()}))
    return root


@pytest.mark.parametrize(
    ("name", "content", "expected", "found"),
    [
        ("scene.json", b"[]", "a JSON object", ""),
        ("scene.json", b"\xff", "a JSON file", ""),
        ("scene.json", None, "a readable file", ""),
        (MANIFEST, None, "a readable file", ""),
        (MANIFEST, "pipe", "", "a pipe or device"),
    ],
)
def test_files_that_are_none(
    tmp_path: Path, name: str, content: bytes | str | None, expected: str, found: str
) -> None:
    root = scene(tmp_path / "scene")
    verify_scene(root)
    (root / name).unlink()
    if content == "pipe":
        os.mkfifo(root / name)
    elif content is not None:
        (root / name).write_bytes(content)
    Fault(name, expected, found).raised_by(verify_scene, root)


@pytest.mark.parametrize("listed", [b"word\n", b"\xff\xfe\x00 x\n", b"0  \n"])
def test_lists_that_are_none(tmp_path: Path, listed: bytes) -> None:
    Fault(expected="checksums.txt lists").raised_by(verify_scene, scene(tmp_path / "scene", listed))


def test_no_file_outside_the_scene_is_read(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    listed = f"{hashlib.sha256(b'mine').hexdigest()}  ../victim\n".encode()
    Fault(expected="files of this scene").raised_by(verify_scene, scene(tmp_path / "scene", listed))


def test_a_request_that_says_nothing_more(tmp_path: Path) -> None:
    (tmp_path / "request.json").write_text('{"scene": {}, "settings": {}, "more": null}')
    Fault(found="more: null").raised_by(folder_state, tmp_path, {"scene": {}, "settings": {}})
