"""Poses of nerfstudio, Metashape and IDR, and published datasets with a file that is not as it was published."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
from base import posed
from case import Case, Change, table
from changes import field, instead, several, write, write_json
from dataset_files import WRITERS

CASES: list[Case] = []

TURNED = [[1, 0, 0, 0.1], [0, -1, 0, 0], [0, 0, -1, -2.5], [0, 0, 0, 1]]
LENS: dict[str, Any] = {"w": 32, "h": 24, "fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0}
NUMBERS = "1 0 0 {x} 0 -1 0 0 0 0 -1 2.5 0 0 0 1"
EYE = np.eye(4)
GOOD = np.array([[40.0, 0, 16, 0], [0, 40, 12, 0], [0, 0, 1, 2.5], [0, 0, 0, 1]])
LAUGHS = "<!DOCTYPE x [" + '<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(8)) + "]>"  # fmt: skip


def _frames(names: Sequence[str] = ("v000", "v001", "v002"), **of_first: Any) -> list[dict[str, Any]]:
    rows = []
    for k, name in enumerate(names):
        matrix = [list(row) for row in TURNED]
        matrix[0][3] = 0.1 * k
        rows.append({"file_path": f"images/{name}.png", "transform_matrix": matrix})
    rows[0] |= of_first
    return rows


def _record(**changed: Any) -> Change:
    return write_json("poses.json", {**LENS, "frames": _frames(), **changed})


def _matrix(matrix: object) -> Change:
    return _record(frames=_frames(transform_matrix=matrix))


CASES += table(
    "transforms.json", posed("poses.json"),
    Case("as a list", write("poses.json", "[1, 2, 3]"), ci=True),
    Case("of no frames", _record(frames=[])),
    Case("of frames of other names", _record(frames=_frames(("a", "b", "c")))),
    Case("of one place", _record(frames=[{**row, "transform_matrix": TURNED} for row in _frames()])),
    Case("of a matrix of nothing", _matrix([[0] * 4] * 4)),
    Case("of another lens", _record(camera_model="FISHEYE624")),
    Case("of a rolling shutter", _record(rolling_shutter=[0, 0, 1]), ci=True),
    Case("without a width", _record(w=None)),
    Case("of 100000 frames", _record(frames=_frames([f"w{k}" for k in range(100_000)])), ci=True),
    Case("of a frame twice", _record(frames=[*_frames(), _frames()[0]]), ci=True),
    Case("of a path that leaves", _record(frames=_frames(file_path="../../outside/victim.txt")), ci=True),
    Case("of another shape than the pictures'", _record(w=24, h=32)),
    Case("of a negative focal length along y", _record(fl_y=-40.0), ci=True),
    Case("of a distortion of -50", _record(k1=-50.0), ci=True),
    Case("of a negative angle", _record(camera_angle_x=-1.0, fl_x=None, fl_y=None)),
    Case("of a place at 1e300", _matrix([[1, 0, 0, 1e300], *TURNED[1:]]), ci=True),
    Case("of a matrix that mirrors", _matrix([[-1, 0, 0, 0], *TURNED[1:]]), ci=True),
    Case("beside a TIFF cut short", several(instead(
        ".tif", lambda path: path.write_bytes(b"II*\0" + 4 * b"\xff"), at="mosaics/v000.png"),
                                            _record()), ci=True),
)  # fmt: skip


def _xml(head: str = "", kind: str = "frame", w: object = 32, f: object = 40, lens: str = "", numbers: str = NUMBERS,
         more: str = "", cameras: str | None = None, chunks: int = 1) -> str:  # fmt: skip
    size = f'<resolution width="{w}" height="24"/>'
    calibration = f'<calibration class="adjusted">{size}<f>{f}</f>{lens}</calibration>'
    sensors = f'<sensors><sensor id="0" type="{kind}">{size}{calibration}</sensor></sensors>'
    rows = "".join(_camera(f'sensor_id="0" label="v00{k}"', numbers.format(x=0.1 * k), k) for k in range(3))
    chunk = f"<chunk>{sensors}<cameras>{rows if cameras is None else cameras}</cameras>{more}</chunk>"
    return f'{head}<document version="2.0">{chunk * chunks}</document>'


def _camera(named: str, numbers: str = NUMBERS.format(x=1), number: int = 1) -> str:
    return f'<camera id="{number}" {named}><transform>{numbers}</transform></camera>'


def _written(text: str, encoding: str = "utf-8") -> Change:
    head = "" if encoding == "utf-8" else f'<?xml version="1.0" encoding="{encoding}"?>'
    return write("poses.xml", (head + text).encode(encoding))


CASES += table(
    "cameras.xml", posed("poses.xml"),
    Case("of laughs", _written(LAUGHS + _xml(lens="<k1>&i;</k1>")), ci=True),
    Case("of a width of infinity", _written(_xml(w="inf")), ci=True),
    Case("of a width of words", _written(_xml(w="wide")), ci=True),
    Case("of a skew", _written(_xml(lens="<b2>10</b2>"))),
    Case("of a fisheye", _written(_xml(kind="equisolid_fisheye"))),
    Case("of a camera twice", _written(_xml(cameras=2 * _camera('sensor_id="0" label="v001"'))), ci=True),
    Case("of a camera without a sensor", _written(_xml(cameras=_camera('sensor_id="9" label="v001"')))),
)  # fmt: skip


def _arrays(*names: str, **changed: Any) -> Change:
    whole = {
        f"{kind}_{k}": v for k in names or "012" for kind, v in (("world_mat", GOOD), ("scale_mat", EYE))
    }
    return lambda: np.savez("poses.npz", **{**whole, **changed})


def _members(*rows: tuple[str, bytes]) -> Change:
    return lambda: made.archive(Path("poses.npz"), rows)


def _lies(unfolds: int, method: int = zipfile.ZIP_DEFLATED) -> Change:
    return lambda: made.lying_archive(Path("poses.npz"), name, unfolds, says=200, method=method)


name = "world_mat_0.npy"
CASES += table(
    "cameras.npz", posed("poses.npz"),
    Case("of two cameras for three views", _arrays("0", "1")),
    Case("of zeros", _arrays(world_mat_0=np.zeros((4, 4))), ci=True),
    Case("of a camera without a scale", _members((name, made.npy(GOOD)))),
    Case("of a wrong shape", _arrays(world_mat_0=np.zeros(16)), ci=True),
    Case("of a broken head", _members((name, made.header("{'descr': ("))), ci=True),
    Case("of a head with a dictionary as key", _members((name, made.header("{{}: 1}"))), ci=True),
    Case("that lies about its size", _lies(3 << 30), ci=True),
    Case("that is junk in LZMA", _lies(0, zipfile.ZIP_LZMA), ci=True),
)  # fmt: skip


def _dataset(kind: str, name: str, spoil: Callable[[], object], ci: bool = False) -> Case:
    change = several(lambda: WRITERS[kind](Path("data")), spoil)
    return Case(f"{kind} with {name}", change, f"prepare data --out new --format {kind}", ci=ci)


def _npz(path: str, **changed: Any) -> Change:
    return lambda: np.savez(path, **{**np.load(path), **changed})


def _rows(value: float) -> Change:
    poses = Path("data/poses_bounds.npy")
    return lambda: np.save(poses, np.concatenate((np.full((1, 17), value), np.load(poses)[1:])))


def _first(pattern: str) -> Path:
    return sorted(Path("data").glob(pattern))[0]


CASES += [
    _dataset("phygap", "a width that is no number", _npz("data/camera_params.npz", image_width=np.nan), ci=True),
    _dataset("neisf", "rows of 1e300", _rows(1e300)),
    _dataset("neisf", "no rows", lambda: np.save("data/poses_bounds.npy", np.zeros((0, 17)))),
    _dataset("nersp", "light of another size", lambda: np.save(_first("s1/*.npy"), np.ones((4, 4, 3)))),
    _dataset("gnerp", "cameras of texts", field("data/cameras.json", "w2c_mat_0", to="x")),
]  # fmt: skip
