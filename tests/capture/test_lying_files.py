"""Files whose headers lie, and archives that unfold to more than they say: refused before memory is taken for them."""

from __future__ import annotations

import json
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import hostile_files as made
import numpy as np
import pytest
from faults import Fault

from polarguide.capture.formats.pictures import decode_arrays, read_array, read_arrays, read_radiance
from polarguide.capture.formats.stored import declared_size, decode_stored, find_damage
from polarguide.capture.metadata import objects_of
from polarguide.capture.pose_files import read_pose_file

HUGE, SMALL = 30_000, (24, 20)


@pytest.mark.parametrize(
    ("suffix", "write", "fault"),
    [
        (".tif", lambda path: made.deflated_tiff(path, HUGE, kind=9), Fault(found="without one plain size")),
        (".tif", lambda path: made.deflated_tiff(path, HUGE, kind=16), Fault(found="without one plain size")),
        (".tif", lambda path: made.deflated_tiff(path, HUGE, twice=24), Fault(found="without one plain size")),
        (".tif", lambda path: made.deflated_tiff(path, HUGE), Fault(found="more than any camera has")),
        (".png", lambda path: made.png(path, 64, 64, first=[(b"tEXt", b"\0\0\0\x18\0\0\0\x14\x10\0\0\0\0")]),
         Fault(found="does not begin with its size")),
        (".png", lambda path: made.png(path, 64, 64, before=[(b"acTL", bytes(8))]),
         Fault(found="an animated PNG file")),
        (".jpg", lambda path: made.two_sizes_jpeg(path, HUGE), Fault(found="without a size")),
        (".jpg", lambda path: made.scans_jpeg(path, 64, 4000), Fault(found="4000 scans")),
    ],
)  # fmt: skip
def test_pictures(tmp_path: Path, suffix: str, write: Callable[[Path], None], fault: Fault) -> None:
    path = tmp_path / f"picture{suffix}"
    write(path)
    fault.raised_by(decode_stored, path, path.read_bytes())


def test_ordinary_ones_pass(tmp_path: Path) -> None:
    path = tmp_path / "picture"
    made.deflated_tiff(path, 64)
    assert (find_damage(path.read_bytes()), declared_size(path.read_bytes())) == (None, (64, 64))
    made.png(path, *SMALL)
    assert (find_damage(path.read_bytes()), declared_size(path.read_bytes())) == (None, SMALL)
    made.scans_jpeg(path, 64, 20)
    assert (find_damage(path.read_bytes()), declared_size(path.read_bytes())) == (None, (64, 64))


@pytest.mark.parametrize("side", [12_500, 16_383])
def test_webp_pictures_larger_than_any_camera_takes(tmp_path: Path, side: int) -> None:
    done, data = cv2.imencode(".webp", np.zeros((16, 16, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert done
    chunk = bytearray(
        data[12:].tobytes()
    )  # 14 bits each of width and height, less 1, behind a byte of its own
    packed = int.from_bytes(chunk[9:13], "little") >> 28 << 28
    chunk[9:13] = (packed | side - 1 | side - 1 << 14).to_bytes(4, "little")
    canvas = bytes(4) + 2 * (side - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + len(canvas).to_bytes(4, "little") + canvas + chunk
    whole = b"RIFF" + len(body).to_bytes(4, "little") + body
    Fault(found="than any camera has").raised_by(decode_stored, tmp_path / "a.webp", whole)


def test_the_size_of_a_tiff_cut_short_is_not_known() -> None:
    assert declared_size(b"II*\0\xff\xff\xff\xff") is None


GOOD = made.header("{'descr': '<f4', 'fortran_order': False, 'shape': (20, 24), }")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_archives_unfold_to_no_more_than_they_say(tmp_path: Path, method: int) -> None:
    path, says = tmp_path / "truth.npz", len(GOOD) + 4 * 480
    made.lying_archive(path, "depth.npy", 1 << 28, says=says, method=method)
    tracemalloc.start()
    try:
        Fault("truth.npz", expected="a complete .npz file").raised_by(
            decode_arrays, path, path.read_bytes(), ("depth",), 1 << 20
        )
        Fault("truth.npz", expected="a complete .npz file").raised_by(read_arrays, path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "head", ["{'descr': (", "(" * 3000, "-" * 9000 + "1", "{{}: 1}", "1", "{'descr': \x00"]
)
def test_heads_of_arrays_that_python_cannot_read(tmp_path: Path, head: str) -> None:
    (tmp_path / "a.npy").write_bytes(made.header(head) + bytes(64))
    made.archive(tmp_path / "a.npz", [("depth.npy", made.header(head) + bytes(64))])
    Fault("a.npy", expected="a complete .npy file").raised_by(read_array, tmp_path / "a.npy")
    Fault("a.npz", expected="a complete .npz file").raised_by(read_arrays, tmp_path / "a.npz")
    Fault("a.npz", expected="a complete .npz file").raised_by(
        decode_arrays, tmp_path / "a.npz", (tmp_path / "a.npz").read_bytes(), ("depth",), 1 << 20
    )


def test_radiance(tmp_path: Path) -> None:
    made.two_sizes_hdr(tmp_path / "sky.hdr", HUGE)
    Fault(expected="complete Radiance HDR file").raised_by(read_radiance, tmp_path / "sky.hdr")
    pytest.importorskip("OpenEXR")
    made.exr(tmp_path / "sky.exr", 40_000)
    Fault(found="40000x40000 pixels").raised_by(read_radiance, tmp_path / "sky.exr")
    (tmp_path / "sky.exr").write_bytes(b"\x76\x2f\x31\x01")
    Fault(expected="complete OpenEXR file").raised_by(read_radiance, tmp_path / "sky.exr")


def test_many_objects_are_compared_in_no_time() -> None:
    objects = [{"id": number, "name": f"n{number}"} for number in range(1, 60_000)]
    path = Path("scene.json")
    assert len(objects_of(path, json.dumps({"objects": objects}).encode())) == 59_999
    twice = json.dumps({"objects": [*objects, {"id": 5, "name": "x"}]}).encode()
    Fault(found="with the id 5").raised_by(objects_of, path, twice)


SENSOR = '<sensor id="0"><calibration><resolution width="{w}" height="24"/><f>40</f></calibration></sensor>'
CAMERA = '<camera sensor_id="0" label="v0"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>'


def metashape(width: object = 32, cameras: str = CAMERA, head: str = "") -> str:
    return f"{head}<document>{SENSOR.format(w=width)}{cameras}</document>"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (metashape("inf"), Fault(found="infx24")),
        (metashape("nan"), Fault(found="nanx24")),
        (metashape(cameras=2 * CAMERA), Fault(expected="one camera called v0")),
        (
            metashape(head='<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE x [<!ENTITY a "b">]>'),
            Fault(found="something else"),
        ),
    ],
)
def test_cameras_of_metashape(tmp_path: Path, text: str, fault: Fault) -> None:
    path = tmp_path / "cameras.xml"
    path.write_bytes(text.encode("utf-16" if "UTF-16" in text else "utf-8"))
    fault.raised_by(read_pose_file, path, ["v0"], lambda _: ((32, 24),))


def test_focal_lengths_of_nerfstudio_are_positive(tmp_path: Path) -> None:
    frame = {"file_path": "v0.png", "transform_matrix": np.eye(4).tolist()}
    record = {"w": 32, "h": 24, "fl_x": 40.0, "fl_y": -40.0, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    Fault(expected="a positive focal length fl_y").raised_by(
        read_pose_file, tmp_path / "transforms.json", ["v0"], lambda _: ((32, 24),)
    )
