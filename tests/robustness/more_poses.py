# ruff: noqa: E501
"""Poses of other programs."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
from base import MOSAICS
from forked import Case
from making import Change, of_bytes, of_json
from making import more_case as case


def _posed(name: str, content: str | bytes) -> Change:
    data = content if isinstance(content, bytes) else content.encode()
    return of_bytes(name, data)


def pose_cases() -> Iterator[Case]:
    """``transforms.json``, ``cameras.xml``, ``cameras.npz``."""
    turned = [[1, 0, 0, 0.1], [0, -1, 0, 0], [0, 0, -1, -2.5], [0, 0, 0, 1]]
    lens = {"w": 32, "h": 24, "fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0}

    def frames(**of_first: Any) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for k in range(3):
            matrix = [list(row) for row in turned]
            matrix[0][3] = 0.1 * k
            rows.append({"file_path": f"images/v00{k}.png", "transform_matrix": matrix})
        rows[0] |= of_first
        return rows

    def command(name: str) -> list[str]:
        return [*MOSAICS[:-1], name]

    huge = {"k1": 1e300}
    for name, record in {
        "without a width": {**lens, "w": None, "frames": frames()},
        "of a negative focal length along y": {**lens, "fl_y": -40.0, "frames": frames()},
        "of a focal length along y of 1e300": {**lens, "fl_y": 1e300, "frames": frames()},
        "of a focal length of 1e-300": {**lens, "fl_x": 1e-300, "frames": frames()},
        "of a center at 1e300": {**lens, "cx": 1e300, "frames": frames()},
        "of a distortion of 1e300": {**lens, **huge, "frames": frames()},
        "of a distortion of -50": {**lens, "k1": -50.0, "frames": frames()},
        "of a place at 1e300": {**lens, "frames": frames(transform_matrix=[[1, 0, 0, 1e300], *turned[1:]])},
        "of a ragged matrix": {**lens, "frames": frames(transform_matrix=[[1, 0, 0], [1], [], [0, 0, 0, 1]])},
        "of a matrix that mirrors": {**lens, "frames": frames(transform_matrix=[[-1, 0, 0, 0], *turned[1:]])},
        "of a matrix of nothing": {**lens, "frames": frames(transform_matrix=[[0] * 4] * 4)},
        "of a frame twice": {**lens, "frames": [*frames(), frames()[0]]},
        "of a path that leaves": {**lens, "frames": frames(file_path="../../outside/victim.txt")},
        "of an angle of pi": {"w": 32, "h": 24, "camera_angle_x": 3.141592653589793, "frames": frames()},
        "of a negative angle": {"w": 32, "h": 24, "camera_angle_x": -1.0, "frames": frames()},
        "of a fisheye": {**lens, "camera_model": "OPENCV_FISHEYE", "frames": frames()},
        "of no frames": {**lens, "frames": []},
        "of frames as a number": {**lens, "frames": 3},
        "of a huge size": {**lens, "w": 99999, "h": 99999, "frames": frames()},
        "of a size of a fraction": {**lens, "w": 0.4, "h": 0.4, "frames": frames()},
        "of one place": {**lens, "frames": [{**row, "transform_matrix": turned} for row in frames()]},
    }.items():
        yield case(f"transforms.json {name}", of_json("poses.json", record), command("poses.json"),
                    "a far place is as good as any" if name in ("of a center at 1e300",) else "")  # fmt: skip

    numbers = "1 0 0 {x} 0 -1 0 0 0 0 -1 2.5 0 0 0 1"
    sensor = ('<sensor id="0" type="frame"><resolution width="{w}" height="{h}"/><calibration type="frame" '
              'class="adjusted"><resolution width="{w}" height="{h}"/><f>{f}</f>{more}</calibration></sensor>')  # fmt: skip

    def xml(
        w: object = 32,
        h: object = 24,
        f: object = 40,
        more: str = "",
        head: str = "",
        cameras: str | None = None,
    ) -> bytes:
        rows = "".join(
            f'<camera id="{k}" sensor_id="0" label="v00{k}.png"><transform>{numbers.format(x=0.1 * k)}</transform></camera>'
            for k in range(3)
        )
        body = sensor.format(w=w, h=h, f=f, more=more)
        return f"{head}<document><chunk><sensors>{body}</sensors><cameras>{rows if cameras is None else cameras}</cameras></chunk></document>".encode()

    laughs = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">' + "".join(
        f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(8)) + "]>"  # fmt: skip
    for name, data in {
        "of a width of infinity": xml(w="inf"),
        "of a width that is none": xml(w="nan"),
        "of a width of 1e400": xml(w="1e400"),
        "of a width of words": xml(w="wide"),
        "of a negative focal length": xml(f=-1),
        "of a focal length of words": xml(f="x"),
        "of a distortion of 1e300": xml(more="<k1>1e300</k1>"),
        "of a skew": xml(more="<b2>10</b2>"),
        "of a camera twice": xml(
            cameras=2
            * f'<camera id="1" sensor_id="0" label="v001"><transform>{numbers.format(x=1)}</transform></camera>'
        ),
        "of a camera of 15 numbers": xml(
            cameras='<camera id="1" sensor_id="0" label="v001"><transform>1 2 3 4 5 6 7 8 9 10 11 12 13 14 15</transform></camera>'
        ),
        "of a camera without a sensor": xml(
            cameras=f'<camera id="1" sensor_id="9" label="v001"><transform>{numbers.format(x=1)}</transform></camera>'
        ),
        "of a camera without a label": xml(
            cameras=f'<camera id="1" sensor_id="0"><transform>{numbers.format(x=1)}</transform></camera>'
        ),
        "of laughs": (laughs + xml(more="<k1>&i;</k1>").decode()).encode(),
        "of laughs in UTF-16": (
            laughs.replace('?xml version="1.0"', '?xml version="1.0" encoding="UTF-16"')
            + xml(more="<k1>&i;</k1>").decode()
        ).encode("utf-16"),
        "of a file outside in UTF-16": (
            '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
            + xml(more="<k1>&a;</k1>").decode()
        ).encode("utf-16"),
        "of a million levels": b"<a>" * 1_000_000,
        "of 20 million elements": b"<a>" + b"<b/>" * 16_000_000 + b"</a>",
        "of an unknown encoding": b'<?xml version="1.0" encoding="klingon"?><a/>',
        "that is none": b"no such thing",
        "of zeros": bytes(4096),
    }.items():
        yield case(f"cameras.xml {name}", _posed("poses.xml", data), command("poses.xml"))

    eye, good = np.eye(4), np.array([[40.0, 0, 16, 0], [0, 40, 12, 0], [0, 0, 1, 2.5], [0, 0, 0, 1]])
    whole = {
        f"{kind}_{k}": value for k in range(3) for kind, value in (("world_mat", good), ("scale_mat", eye))
    }

    def arrays(**changed: Any) -> Change:
        return lambda folder: np.savez(folder / "poses.npz", **{**whole, **changed})

    def members(*rows: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Change:
        return lambda folder: made.archive(folder / "poses.npz", rows, method)

    def damaged(folder: Path) -> None:
        made.archive(
            folder / "poses.npz",
            [("world_mat_0.npy", made.npy(np.random.default_rng(0).random((4, 4)))), ("x", b"y" * 900)],
        )
        data = bytearray((folder / "poses.npz").read_bytes())
        data[60:110] = bytes(50)
        (folder / "poses.npz").write_bytes(bytes(data))

    for name, change in {
        "of zeros": arrays(world_mat_0=np.zeros((4, 4))),
        "of what is not finite": arrays(world_mat_0=np.full((4, 4), np.nan)),
        "of huge numbers": arrays(world_mat_0=np.full((4, 4), 1e308)),
        "of a scale of huge numbers": arrays(scale_mat_0=1e200 * eye, world_mat_0=1e200 * good),
        "of a wrong shape": arrays(world_mat_0=np.zeros(16)),
        "of texts": arrays(world_mat_0=np.array([["a"] * 4] * 4)),
        "of complex numbers": arrays(world_mat_0=good * 1j),
        "of a camera without a scale": members(("world_mat_0.npy", made.npy(good))),
        "of no cameras": members(("other.npy", made.npy(good))),
        "of a broken head": members(("world_mat_0.npy", made.header("{'descr': ("))),
        "of a deep head": members(("world_mat_0.npy", made.header("-" * 9000 + "1"))),
        "of a head with a dictionary as key": members(("world_mat_0.npy", made.header("{{}: 1}"))),
        "that is damaged within": damaged,
        "that lies about its size": lambda f: made.lying_archive(
            f / "poses.npz", "world_mat_0.npy", 3 << 30, says=200
        ),
        "that lies in bzip2": lambda f: made.lying_archive(
            f / "poses.npz", "world_mat_0.npy", 1 << 28, says=200, method=zipfile.ZIP_BZIP2
        ),
        "that is junk in LZMA": lambda f: made.lying_archive(
            f / "poses.npz", "world_mat_0.npy", 0, says=200, method=zipfile.ZIP_LZMA
        ),
    }.items():
        yield case(f"cameras.npz {name}", change, command("poses.npz"))

    def cut(folder: Path) -> None:
        path = folder / "mosaics/v000.png"
        path.unlink()
        path.with_suffix(".tif").write_bytes(b"II*\0\xff\xff\xff\xff")
        of_json("poses.json", {**lens, "frames": frames()})(folder)

    yield case("transforms.json beside a TIFF cut short", cut, command("poses.json"))
