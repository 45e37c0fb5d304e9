# ruff: noqa: E501
"""More of the corpus: what somebody malicious makes by hand, and what somebody unlucky finds. Nothing here is random."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hostile_files as made
import numpy as np
import spoil
from base import EVAL, HEIGHT, MOSAICS, READ, RESUME, SHOTS, TRAIN, WIDTH
from forked import Case

Change = Callable[[Path], object]
PICTURE, TRUTH = "scene/polar/v001_045.png", "scene/gt/v000.npz"
SAME = "it is the same content in another form"
UNUSED = "what is wrong with it is not read"
POSED = [*MOSAICS[:-1], "poses"]
INSPECT = ["inspect", "scene", "--normals", "points", "--out", "new"]
SHARE = ["share", "run", "--out", "new.html"]
RENDER = ["render", "run", "--out", "new", "--device", "cpu"]
UNFINISHED = [*MOSAICS[:3], "unfinished", *MOSAICS[4:]]


FOUND = """
picture TIFF of signed sizes/picture TIFF of two sizes/shots of 4000 scans/mosaic TIFF of signed sizes/mosaic .npy of a broken head/
mosaic .npy of a wrong key/mosaic sparse of 2 GiB/gt is junk in LZMA/gt has a broken head/gt has a head of brackets/gt lies about its size/gt has huge depths/
scene with 60000 objects/scene.json of 2 GiB/transforms.json of a place at 1e300/transforms.json of a negative focal length along y/
transforms.json beside a TIFF cut short/cameras.xml of a width of infinity/cameras.xml of a width of words/cameras.xml of a camera twice/
cameras.npz of a broken head/cameras.npz of a head with a dictionary as key/cameras.npz that lies about its size/cameras.npz that is junk in LZMA/
option a zero of 1e308/run log of 8 million lines/run scene of a long name/masks with links to themselves/view with control characters and no pose
""".replace("\n", "").split("/")
"""Cases that ended otherwise than they should before what they showed was mended."""
SHARE_OF_OTHERS = 5
"""One of so many of the other quick cases is always run, all cases by ``make fuzz``."""
QUICK = ("priors", "prepare", "bench")


def more_cases(*, every: bool) -> Iterator[Case]:
    """All cases, or those that are always run."""
    makers = (picture_cases, truth_cases, scene_cases, colmap_cases, pose_cases, run_cases, link_cases, folder_cases,
              dataset_cases, option_cases, name_cases)  # fmt: skip
    for number, case in enumerate(case for make in makers for case in make()):
        found = case.name.removeprefix("more ") in FOUND
        if every or found or (case.command in QUICK and number % SHARE_OF_OTHERS == 0):
            yield case


@dataclass(frozen=True)
class MadeCase(Case):
    """A case of these; ``command`` is its verb."""

    command: str = ""


def _case(
    name: str,
    change: Change,
    command: Sequence[str],
    accepted: str = "",
    check: Callable[[Path], None] | None = None,
) -> MadeCase:
    def make(folder: Path, rng: random.Random) -> list[str]:
        change(folder)
        return list(command)

    return MadeCase(f"more {name}", 0, make, accepted, check, command=command[0])


# Pictures.


def _instead(
    suffix: str, write: Callable[..., None], *arguments: Any, at: str = PICTURE, **more: Any
) -> Change:
    """A file of another suffix in the place of a picture."""

    def change(folder: Path) -> None:
        path = folder / at
        path.unlink()
        write(path.with_suffix(suffix), *arguments, **more)

    return change


def picture_cases() -> Iterator[Case]:
    """Headers that lie, and decoders that believe them."""

    def tags(*changed: made.Tag, drop: Sequence[int] = ()) -> Change:
        size = 2 * WIDTH * HEIGHT
        table = {tag[0]: tag for tag in made.gray_tags(WIDTH, HEIGHT, size)}
        table |= {tag[0]: tag for tag in changed}
        return _instead(
            ".tif",
            made.tiff,
            [table[key] for key in sorted(table) if key not in drop],
            bytes(max(size, 4096)),
        )

    where = "scene/polar/v000_000.png"
    for name, change in {
        "TIFF of signed sizes": _instead(".tif", made.deflated_tiff, 30000, kind=9),
        "TIFF of 64-bit sizes": _instead(".tif", made.deflated_tiff, 30000, kind=16),
        "TIFF of two sizes": _instead(".tif", made.deflated_tiff, 30000, twice=WIDTH),
        "TIFF of 14000 pixels a side": _instead(".tif", made.deflated_tiff, 14000),
        "first TIFF of signed sizes": _instead(".tif", made.deflated_tiff, 30000, kind=9, at=where),
        "TIFF of size 0": tags((256, 4, 1, 0)),
        "TIFF of 65535 channels": tags((277, 3, 1, 65535)),
        "TIFF of 64-bit numbers": tags((258, 3, 1, 64), (339, 3, 1, 3)),
        "TIFF of complex numbers": tags((339, 3, 1, 6), (258, 3, 1, 64)),
        "TIFF of 1 bit": tags((258, 3, 1, 1)),
        "TIFF without a palette": tags((262, 3, 1, 3)),
        "TIFF in JPEG": tags((259, 3, 1, 7)),
        "TIFF in an unknown compression": tags((259, 3, 1, 60000)),
        "TIFF of huge rows": tags((278, 4, 1, 0xFFFFFFFF)),
        "TIFF of no rows": tags((278, 4, 1, 0)),
        "TIFF of huge tiles": tags((322, 4, 1, 0xFFFFFFF0), (323, 4, 1, 0xFFFFFFF0), (324, 4, 1, 8), (325, 4, 1, 64), drop=(273, 278, 279)),
        "TIFF of 4 billion strips": tags((273, 4, 0xFFFFFFFF, 8), (279, 4, 0xFFFFFFFF, 8)),
        "TIFF without strips": tags(drop=(273, 279)),
    }.items():  # fmt: skip
        yield _case(f"picture {name}", change, READ)

    def ring(path: Path) -> None:
        made.tiff(path, made.gray_tags(WIDTH, HEIGHT, 2 * WIDTH * HEIGHT), bytes(4096))
        data = bytearray(path.read_bytes())
        data[8 + 2 + 9 * 12 : 8 + 2 + 9 * 12 + 4] = struct.pack("<I", 8)
        path.write_bytes(bytes(data))

    yield _case("picture TIFF whose next directory is its first", _instead(".tif", ring), READ, UNUSED)
    yield _case(
        "picture TIFF of 65535 entries",
        _instead(".tif", lambda path: path.write_bytes(b"II*\0\x08\0\0\0\xff\xff" + bytes(12 * 65535 + 64))),
        READ,
    )

    def chunked(folder: Path) -> None:
        made.png(
            folder / PICTURE,
            WIDTH,
            HEIGHT,
            before=[
                (b"zTXt", b"bomb\0\0" + zlib.compress(bytes(1 << 28), 9)),
                (b"iCCP", b"x\0\0" + zlib.compress(bytes(1 << 28), 9)),
            ],
        )

    yield _case("picture PNG with a bomb of text", chunked, READ, UNUSED)
    for name, change in {
        "PNG whose size comes second": lambda f: made.png(f / PICTURE, 30000, 30000, bits=1, first=[(b"tEXt", struct.pack(">II", WIDTH, HEIGHT) + b"\x10\0\0\0\0")]),
        "PNG of size 0": lambda f: made.png(f / PICTURE, 0, HEIGHT, idat=b""),
        "PNG of no pixels": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, idat=b""),
        "PNG of other pixels": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, idat=zlib.compress(b"no such thing")),
        "PNG of 3 bits": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, bits=3),
        "PNG without a palette": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, bits=8, color=3),
        "PNG of a million frames": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, before=[(b"acTL", struct.pack(">II", 1 << 20, 0)), (b"fcTL", struct.pack(">IIIIIHHBB", 0, 60000, 60000, 0, 0, 1, 1, 0, 0))]),
        "JPEG of two sizes": _instead(".jpg", made.two_sizes_jpeg, 30000),
    }.items():  # fmt: skip
        yield _case(
            f"picture {name}",
            change,
            READ,
            "a frame beside the picture is not shown" if "frames" in name else "",
        )

    def masks(folder: Path) -> None:
        made.png(folder / "scene/masks/v000.png", 12000, 12000, color=6)
        for index in range(1, 9):
            shutil.copyfile(folder / "scene/masks/v000.png", folder / f"scene/masks/v00{index}.png")

    def angles(folder: Path) -> None:
        made.png(folder / "scene/polar/v000_045.png", 12000, 12000, color=6)
        for index in range(9):
            for angle in ("045", "090", "135"):
                if (index, angle) != (0, "045"):
                    shutil.copyfile(
                        folder / "scene/polar/v000_045.png", folder / f"scene/polar/v00{index}_{angle}.png"
                    )

    yield _case("masks of 12000 pixels a side", masks, TRAIN)
    yield _case("three angles of 12000 pixels a side", angles, TRAIN)

    def shots(folder: Path) -> None:
        made.png(folder / "shots/0/v000.png", 12000, 12000, color=2)
        for angle in ("0", "45", "90", "135"):
            for view in ("v000", "v001"):
                if (angle, view) != ("0", "v000"):
                    shutil.copyfile(folder / "shots/0/v000.png", folder / f"shots/{angle}/{view}.png")

    def scans(folder: Path) -> None:
        for angle in ("0", "45", "90", "135"):
            (folder / f"shots/{angle}/v000.png").unlink()
        made.scans_jpeg(folder / "shots/0/v000.jpg", 12000, 4000)
        for angle in ("45", "90", "135"):
            shutil.copyfile(folder / "shots/0/v000.jpg", folder / f"shots/{angle}/v000.jpg")

    yield _case("shots of 12000 pixels a side", shots, SHOTS)
    yield _case("shots of 4000 scans", scans, SHOTS)
    big = "mosaics/v001.png"
    yield _case(
        "mosaic TIFF of signed sizes", _instead(".tif", made.deflated_tiff, 30000, kind=9, at=big), MOSAICS
    )
    yield _case(
        "mosaic .npy of a broken head",
        _instead(".npy", lambda p: p.write_bytes(made.header("{'descr': (")), at=big),
        MOSAICS,
    )
    yield _case(
        "mosaic .npy of a deep head",
        _instead(".npy", lambda p: p.write_bytes(made.header("-" * 9000 + "1")), at=big),
        MOSAICS,
    )
    yield _case(
        "mosaic .npy of a wrong key",
        _instead(".npy", lambda p: p.write_bytes(made.header("{{}: 1}")), at=big),
        MOSAICS,
    )
    yield _case(
        "mosaic .npy of version 9",
        _instead(".npy", lambda p: p.write_bytes(made.header("{}", version=(9, 0))), at=big),
        MOSAICS,
    )
    yield _case(
        "mosaic .npy of negative sides",
        _instead(
            ".npy",
            lambda p: p.write_bytes(
                made.header("{'descr': '<u2', 'fortran_order': False, 'shape': (-64, -64), }") + bytes(8192)
            ),
            at=big,
        ),
        MOSAICS,
    )
    yield _case(
        "mosaic .npy of objects",
        _instead(".npy", lambda p: np.save(p, np.array([[{}]], dtype=object)), at=big),
        MOSAICS,
    )
    yield _case("mosaic sparse of 2 GiB", _instead(".tif", _sparse, (1 << 31) - 1, b"II*\0", at=big), MOSAICS)


def _sparse(path: Path, size: int, begin: bytes) -> None:
    with open(path, "wb") as file:
        file.write(begin)
        file.truncate(size)


# Ground truth.


def truth_cases() -> Iterator[Case]:
    """Archives that unfold to more than they say."""
    good = made.header("{'descr': '<f4', 'fortran_order': False, 'shape': (20, 24), }") + bytes(4 * 480)
    says = len(good)

    def member(data: bytes, name: str = "depth.npy", method: int = zipfile.ZIP_DEFLATED) -> Change:
        return lambda folder: made.archive(folder / TRUTH, [(name, data)], method)

    def text(shown: str) -> Change:
        return member(made.header(shown) + bytes(2000))

    shape = "'fortran_order': False, 'shape': (20, 24), }"
    for name, change in {
        "lies about its size": lambda f: made.lying_archive(f / TRUTH, "depth.npy", 3 << 30, says=says),
        "lies about its size in bzip2": lambda f: made.lying_archive(f / TRUTH, "depth.npy", 1 << 28, says=says, method=zipfile.ZIP_BZIP2),
        "is junk in LZMA": lambda f: made.lying_archive(f / TRUTH, "depth.npy", 0, says=says, method=zipfile.ZIP_LZMA),
        "has a broken head": text("{'descr': ("),
        "has a deep head": text("-" * 9000 + "1"),
        "has a head of brackets": text("(" * 3000),
        "has a head that is no dictionary": text("1"),
        "has a head with a dictionary as key": text("{{}: 1}"),
        "has records": text("{'descr': [('a', '<f4'), ('b', '|O')], " + shape),
        "has numbers of numbers": text("{'descr': ('<f4', (100000, 100000)), " + shape),
        "has times": text("{'descr': '<M8[s]', " + shape),
        "has texts": text("{'descr': '<U40', " + shape),
        "has empty texts": text("{'descr': '<U0', 'fortran_order': False, 'shape': (1099511627776, 4096), }"),
        "has negative sides": text("{'descr': '<f4', 'fortran_order': False, 'shape': (-20, -24), }"),
        "has a side of nothing": text("{'descr': '<f4', 'fortran_order': False, 'shape': (0, 4611686018427387904), }"),
        "has booleans as sides": text("{'descr': '<f4', 'fortran_order': False, 'shape': (True, 24), }"),
        "has a head of 2 GiB": member(b"\x93NUMPY\x02\0" + struct.pack("<I", (1 << 31) - 1) + bytes(2000)),
        "has a path as name": lambda f: made.archive(f / TRUTH, [("../../outside/victim.npy", good), ("depth.npy", good[:-4])]),
        "ends within": lambda f: (made.archive(f / TRUTH, [("depth.npy", good)]), (f / TRUTH).write_bytes((f / TRUTH).read_bytes()[:-30])),
        "has numbers of objects that are negative": lambda f: np.savez(f / TRUTH, objid=np.full((20, 24), -1)),
        "has numbers of objects that are huge": lambda f: np.savez(f / TRUTH, objid=np.full((20, 24), 1 << 63, np.uint64)),
        "has numbers of objects that are fractions": lambda f: np.savez(f / TRUTH, objid=np.full((20, 24), 0.5)),
        "has numbers without objects": lambda f: np.savez(f / TRUTH, objid=np.full((20, 24), 7)),
        "is a picture": lambda f: shutil.copyfile(f / PICTURE, f / TRUTH),
        "is a folder of files": lambda f: ((f / TRUTH).unlink(), (f / TRUTH).mkdir(), (f / TRUTH / "depth.npy").write_bytes(good)),
        "has huge depths": lambda f: np.savez(f / TRUTH, depth=np.full((20, 24), 1e300)),
        "has huge normals": lambda f: np.savez(f / TRUTH, normal=np.full((20, 24, 3), 3e38, np.float32)),
        "has negative depths": lambda f: np.savez(f / TRUTH, depth=np.full((20, 24), -5.0), mask=np.ones((20, 24))),
    }.items():  # fmt: skip
        reason = {
            "has negative depths": "no depth is known where it is not positive",
            "has numbers without objects": "objects may go without a table",
            "is not": "",
        }.get(name, "")
        yield _case(f"gt {name}", change, READ, reason)
    yield _case(
        "gt has the same array 2000 times",
        lambda f: made.archive(f / TRUTH, [("depth.npy", good)] * 2000),
        READ,
        UNUSED,
    )
    yield _case(
        "gt has 60000 other files",
        lambda f: made.archive(f / TRUTH, [(f"{k}", b"") for k in range(60000)], zipfile.ZIP_STORED),
        READ,
        "there may be none of the arrays",
    )
    yield _case(
        "gt behind a picture",
        lambda f: (f / TRUTH).write_bytes((f / PICTURE).read_bytes() + (f / TRUTH).read_bytes()),
        READ,
        SAME,
    )


# Scene folders.


def _json(path: str, content: Any) -> Change:
    return lambda folder: (folder / path).write_text(json.dumps(content))


def _bytes(path: str, data: bytes) -> Change:
    return lambda folder: (folder / path).write_bytes(data)


def _objects(objects: Any) -> Change:
    def change(folder: Path) -> None:
        (folder / "scene/scene.json").write_text(json.dumps({"objects": objects}))
        np.savez(folder / TRUTH, objid=np.ones((20, 24), np.int32))

    return change


def scene_cases() -> Iterator[Case]:
    """The files beside the pictures, and the folder itself."""
    whole = b'{"refractive_index": 1.5}'
    for file in ("scene.json", "split.json"):
        at = f"scene/{file}"
        key = b'"test": ["v000"]' if file == "split.json" else b'"refractive_index": 1.5'
        for name, data, reason in (
            ("in UTF-16", (b"{" + key + b"}").decode().encode("utf-16"), SAME),
            ("with a mark of its bytes", b"\xef\xbb\xbf{" + key + b"}", SAME),
            ("with a key twice", b"{" + key + b", " + key.replace(b"1.5", b"1.4").replace(b"v000", b"v001") + b"}", "the last one counts, as Python's JSON has it"),
            ("with a number of 5000 digits", b'{"x": ' + b"9" * 5000 + b", " + key + b"}", ""),
            ("with half a character", b'{"x": "\\ud800", ' + key + b"}", UNUSED),
            ("with zeros behind", b"{" + key + b"}" + bytes(4096), ""),
            ("as a list", b"[{" + key + b"}]", ""),
            ("as a number", b"1", ""),
            ("of many brackets", b'{"x": [' + b"[]," * 2_000_000 + b"[]], " + key + b"}", UNUSED),
        ):  # fmt: skip
            yield _case(f"{file} {name}", _bytes(at, data), READ, reason)
        yield _case(f"{file} of 2 GiB", lambda f, at=at: _sparse(f / at, (1 << 31) - 1, b"{"), READ)
    del whole
    many = [{"id": k % 65535 + 1, "name": f"n{k}"} for k in range(60000)]
    for name, objects in {
        "60000 objects": many,
        "two objects of one number": [{"id": 1, "name": "a"}, {"id": 1, "name": "b"}],
        "two objects of one name": [{"id": 1, "name": "a"}, {"id": 2, "name": "a"}],
        "an object of number 0": [{"id": 0, "name": "a"}],
        "an object of a negative roughness": [{"id": 1, "name": "a", "material": {"alpha": -1}}],
        "an object without a name": [{"id": 1, "name": ""}],
        "an object as a text": ["ball"],
        "an object of half a character": [{"id": 1, "name": "\ud800"}],
        "an object with markup": [{"id": 1, "name": "<img src=x onerror=alert(1)>", "material": "[bold]"}],
    }.items():
        reason = {
            "60000 objects": "there may be many",
            "an object with markup": "a name is shown as it is",
            "an object of half a character": "any name will do",
        }.get(name, "")
        yield _case(f"scene with {name}", _objects(objects), READ, reason)
    yield _case("split with half a character", _json("scene/split.json", {"test": ["\ud800"]}), READ)
    yield _case(
        "split with a name of a million letters", _json("scene/split.json", {"test": ["x" * 1_000_000]}), READ
    )
    yield _case(
        "split with a name 300000 times",
        _json("scene/split.json", {"test": ["v000"] * 300_000}),
        READ,
        "a view may be named twice",
    )
    yield _case(
        "scene with corrections that are none",
        _json("scene/scene.json", {"corrections": 5}),
        [*INSPECT, "--fix", "fixed"],
        UNUSED,
    )

    def exchanged(folder: Path, more: Change = lambda folder: None) -> None:
        """So that there is something to fix: the pictures of two angles change places."""
        for path in sorted((folder / "scene/polar").glob("*_000.png")):
            other = path.with_name(path.name.replace("_000", "_090"))
            kept = path.read_bytes()
            path.write_bytes(other.read_bytes())
            other.write_bytes(kept)
        more(folder)

    def rings(folder: Path) -> None:
        for name in "abcd":
            (folder / "scene/masks" / name).symlink_to("../masks")

    yield _case(
        "masks with links to themselves", lambda f: exchanged(f, rings), [*INSPECT, "--fix", "fixed"], UNUSED
    )
    yield _case(
        "corrections that are a number",
        lambda f: exchanged(f, _json("scene/scene.json", {"corrections": 5})),
        [*INSPECT, "--fix", "fixed"],
        "there is nothing to fix where geometry does not decide",
    )

    def put(path: str, how: str) -> Change:
        def change(folder: Path) -> None:
            target = folder / path
            shutil.rmtree(target) if target.is_dir() else target.unlink()
            if how == "file":
                target.write_text("no folder")
            elif how == "pipe":
                os.mkfifo(target)
            elif how == "loop":
                target.symlink_to(target.name)
            elif how == "root":
                target.symlink_to("/")
            elif how == "itself":
                target.symlink_to(".")

        return change

    for path in ("scene", "scene/polar", "scene/sparse", "scene/sparse/0", "scene/gt", "scene/invalid"):
        for how in ("file", "pipe", "loop", "root", "itself"):
            reason = (
                "a folder may hold none of what is looked for"
                if how in ("root", "itself") and path in ("scene/gt", "scene/invalid")
                else ""
            )
            yield _case(f"{path} is {how}", put(path, how), READ, reason)

    def suffixes(folder: Path) -> None:
        shutil.copyfile(folder / PICTURE, folder / "scene/polar/v001_045.PNG")

    def cases(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            shutil.copyfile(path, path.with_name(path.name.upper()))

    def composed(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            shutil.copyfile(path, path.with_name(path.name.replace("v001", "caf\u00e9")))
            shutil.copyfile(path, path.with_name(path.name.replace("v001", "cafe\u0301")))

    yield _case("two suffixes of one picture", suffixes, READ)
    yield _case("names that differ in case", cases, TRAIN)
    yield _case("names that differ in composition", composed, TRAIN)


# COLMAP.

_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5)


def colmap_cases() -> Iterator[Case]:
    """Binary models whose structure is whole and whose numbers are not."""
    lens = [30.0, 30.0, WIDTH / 2, HEIGHT / 2]
    camera = (1, 1, WIDTH, HEIGHT, lens)
    names = [f"v00{k}.png".encode() for k in range(9)]

    def images(**of_first: Any) -> list[Any]:
        rows = [
            [k + 1, (1.0, 0, 0, 0, 0.1 * k - 0.4, 0.05 * (k % 3), 2.5), 1, names[k], []] for k in range(9)
        ]
        for key, value in of_first.items():
            rows[1][("number", "pose", "camera", "name", "points").index(key)] = value
        return rows

    places = [(7, (0.5, 0.25, 0.5), []), (2, (-0.4, 0, 0), []), (3, (0, 0, 0.3), []), (4, (0.2, 0.2, 0), [])]

    def model(cameras: Any = (camera,), rows: Any = None, points: Any = places) -> Change:
        def change(folder: Path) -> None:
            sparse = folder / "scene/sparse/0"
            for path in sparse.iterdir():
                path.unlink()
            (sparse / "cameras.bin").write_bytes(made.cameras_bin(cameras))
            (sparse / "images.bin").write_bytes(made.images_bin(images() if rows is None else rows))
            (sparse / "points3D.bin").write_bytes(made.points_bin(points))

        return change

    nan, inf, top = float("nan"), float("inf"), 0xFFFFFFFF
    for name, change in {
        "a camera twice": model([camera, camera]),
        "a camera of number -1": model([(top, 1, WIDTH, HEIGHT, lens)], [[*row[:2], top, *row[3:]] for row in images()]),
        "a model -1": model([(1, 0xFFFFFFFF - (1 << 32), WIDTH, HEIGHT, lens)]),
        "a model 1000": model([(1, 1000, WIDTH, HEIGHT, lens)]),
        "an image twice": model(rows=images(number=1)),
        "an image of number -1": model(rows=images(number=top)),
        "an image of no camera": model(rows=images(camera=99)),
        "an image of camera -1": model(rows=images(camera=top)),
        "a rotation of length 0": model(rows=images(pose=(0.0, 0, 0, 0, 0, 0, 2.5))),
        "a rotation of length 7": model(rows=images(pose=(7.0, 0, 0, 0, 0, 0, 2.5))),
        "a rotation that is none": model(rows=images(pose=(nan, 0, 0, 0, 0, 0, 2.5))),
        "a place that is none": model(rows=images(pose=(1.0, 0, 0, 0, inf, 0, 2.5))),
        "a focal length of nothing": model([(1, 1, WIDTH, HEIGHT, [0.0, 30, 12, 10])]),
        "a negative focal length": model([(1, 1, WIDTH, HEIGHT, [-30.0, 30, 12, 10])]),
        "a focal length that is none": model([(1, 1, WIDTH, HEIGHT, [nan, 30, 12, 10])]),
        "a center that is none": model([(1, 1, WIDTH, HEIGHT, [30.0, 30, inf, 10])]),
        "a center far away": model([(1, 1, WIDTH, HEIGHT, [30.0, 30, 1e308, 10])]),
        "an empty name": model(rows=images(name=b"")),
        "a name that is no UTF-8": model(rows=images(name=b"\xff\xfe.png")),
        "a name of 4000 letters": model(rows=images(name=b"x" * 4000)),
        "a name that leaves": model(rows=images(name=b"../../../outside/victim.png")),
        "a name with control characters": model(rows=images(name=b"\x1b[2J\x1b]0;mine\x07\xe2\x80\xae.png")),
        "a name twice": model(rows=images(name=b"sub/v000.jpg")),
        "an image that sees no such point": model(rows=images(points=[(1.0, 1.0, 999)])),
        "an image that sees a point twice": model(rows=images(points=[(1.0, 1.0, 7), (2.0, 2.0, 7)])),
        "a point twice": model(points=[*places, places[0]]),
        "a point of number -1": model(points=[((1 << 64) - 1, (0, 0, 0), [])]),
        "a point that is seen by no such image": model(points=[(7, (0, 0, 0), [(99, 0)])]),
        "a point that is seen where there is nothing": model(points=[(7, (0, 0, 0), [(1, 4000000000)])]),
        "a point that is none": model(points=[(7, (nan, 0, 0), [])]),
        "one point": model(points=places[:1]),
        "points in one place": model(points=[(k, (0.1, 0.1, 0.1), []) for k in range(50)]),
        "points at the edge": model(points=[(k, (1e9, -1e9, 1e9 * (k % 2)), []) for k in range(50)]),
    }.items():  # fmt: skip
        reason = {
            "a camera of number -1": "", "a rotation of length 7": "", "one point": "one point is enough to begin with",
            "points in one place": "points may coincide", "points at the edge": "any finite place will do",
        }.get(name, "a point or an image that no view needs is not looked at")  # fmt: skip
        yield _case(f"model of {name}", change, TRAIN if "point" in name else READ, reason)

    def crowd(folder: Path) -> None:
        long = "x" * 230
        rows = [[k + 1, _POSE, 1, f"{long}{k:06d}.png".encode(), []] for k in range(20000)]
        model(rows=rows)(folder)
        for path in sorted((folder / "scene/polar").glob("v00*")):
            path.rename(path.with_name(long + path.name[1:]))

    yield _case("model of 20000 long names that are nearly the views'", crowd, READ)

    def rigs(frames: bytes, rig: bytes) -> Change:
        def change(folder: Path) -> None:
            model()(folder)
            (folder / "scene/sparse/0/rigs.bin").write_bytes(rig)
            (folder / "scene/sparse/0/frames.bin").write_bytes(frames)

        return change

    one = struct.pack("<QIIiI", 1, 1, 1, 0, 1)  # a rig of one sensor, camera 1
    frame = struct.pack("<II7dIiIQ", 1, 1, *_POSE, 1, 0, 1, 1)
    for name, rig, frames in (
        ("of no such rig", one, struct.pack("<Q", 1) + struct.pack("<II", 1, 77) + frame[8:]),
        ("of no such image", one, struct.pack("<Q", 1) + frame[:-8] + struct.pack("<Q", 999)),
        ("of no such sensor", one, struct.pack("<Q", 1) + frame[:-12] + struct.pack("<IQ", 55, 1)),
        ("of an unknown kind", one, struct.pack("<Q", 1) + frame[:-16] + struct.pack("<iIQ", 99, 1, 1)),
        ("twice", one, struct.pack("<Q", 2) + frame + frame),
        ("whose rig has no such camera", struct.pack("<QIIiI", 1, 1, 1, 0, 44), struct.pack("<Q", 1) + frame),
        (
            "whose rig stands there twice",
            struct.pack("<Q", 2) + one[8:] + one[8:],
            struct.pack("<Q", 1) + frame,
        ),
        ("whose rig has no sensor", struct.pack("<QII", 1, 1, 0), struct.pack("<Q", 1) + frame),
        ("that is none", struct.pack("<Q", 0), struct.pack("<Q", 0)),
    ):
        yield _case(f"frame {name}", rigs(frames, rig), READ, UNUSED if name == "that is none" else "")

    def text(file: str, content: str | bytes) -> Change:
        data = content if isinstance(content, bytes) else content.encode()
        return _bytes(f"scene/sparse/0/{file}.txt", data)

    good = f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 12 10\n"
    for name, content in {
        "of two lines alike": good + good,
        "of a negative size": f"1 PINHOLE -24 {HEIGHT} 30 30 12 10\n",
        "of a huge number": f"99999999999999999999 PINHOLE {WIDTH} {HEIGHT} 30 30 12 10\n",
        "of too many numbers": good[:-1] + " 1" * 10 + "\n",
        "of too few numbers": f"1 PINHOLE {WIDTH} {HEIGHT} 30\n",
        "of words": f"1 PINHOLE {WIDTH} {HEIGHT} thirty 30 12 10\n",
        "in UTF-16": good.encode("utf-16"),
        "of lines as Windows has them": good.replace("\n", "\r\n"),
        "in hexadecimal": f"1 PINHOLE {WIDTH} {HEIGHT} 0x1e 30 12 10\n",
        "of an unknown model": f"1 NO_SUCH {WIDTH} {HEIGHT} 30 30 12 10\n",
        "of a fisheye": f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} 30 30 12 10 0 0 0 0\n",
        "of comments": "# none\n" * 1000,
        "of one line of 20 MB": "1 " * 10_000_000,
    }.items():
        reason = SAME if name in ("of lines as Windows has them", "in hexadecimal") else ""
        yield _case(f"cameras.txt {name}", text("cameras", content), READ, reason)
    yield _case("images.txt of 400000 empty lines", text("images", "\n" * 400_000), READ)
    yield _case(
        "images.txt of one line",
        lambda f: (f / "scene/sparse/0/images.txt").write_text(
            (f / "scene/sparse/0/images.txt").read_text().replace("\n", " ")
        ),
        READ,
    )
    yield _case(
        "points3D.txt of a negative number",
        text("points3D", "-1 0 0 0 1 2 3 0.5\n"),
        READ,
        "numbers are names",
    )
    yield _case(
        "points3D.txt of colors beyond bytes",
        text("points3D", "1 0 0 0 300 -2 3 0.5\n"),
        READ,
        "COLMAP takes their lowest bytes",
    )


# Poses of other programs.


def _posed(name: str, content: str | bytes) -> Change:
    data = content if isinstance(content, bytes) else content.encode()
    return _bytes(name, data)


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
        yield _case(f"transforms.json {name}", _json("poses.json", record), command("poses.json"),
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
        yield _case(f"cameras.xml {name}", _posed("poses.xml", data), command("poses.xml"))

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
        yield _case(f"cameras.npz {name}", change, command("poses.npz"))

    def cut(folder: Path) -> None:
        path = folder / "mosaics/v000.png"
        path.unlink()
        path.with_suffix(".tif").write_bytes(b"II*\0\xff\xff\xff\xff")
        _json("poses.json", {**lens, "frames": frames()})(folder)

    yield _case("transforms.json beside a TIFF cut short", cut, command("poses.json"))


# Runs.


def _pid_link(folder: Path, name: str) -> None:
    """What somebody who guesses the number of the process puts where its temporary file will be."""
    path = folder / name
    path.with_name(f".{path.name}.{os.getpid()}.tmp").symlink_to("../../outside/victim.txt")


def _link(path: str, target: str = "../../outside") -> Change:
    def change(folder: Path) -> None:
        place = folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.symlink_to(target)

    return change


def link_cases() -> Iterator[Case]:
    """Links in folders of strangers that lead what is written elsewhere."""
    victim = "../../outside/victim.txt"
    export = ["export", "run", "--format"]
    for name, change, command in (
        ("lock of a run", _link("run/.lock", victim), RESUME),
        ("log of a run", _link("run/log.jsonl", victim), RESUME),
        ("checkpoint of a run", _link("run/checkpoint.safetensors", victim), RESUME),
        ("PLY of a run", _link("run/point_cloud.ply", victim), RESUME),
        ("scores of a run", _link("run/metrics.json", victim), EVAL),
        ("errors of a run", _link("run/errors.png", victim), EVAL),
        ("page of a run", _link("run/share.html", victim), ["share", "run"]),
        ("pictures of a run", _link("run/render"), ["render", "run", "--device", "cpu"]),
        ("exports of a run", _link("run/export"), [*export, "points"]),
        ("cameras of a run", _link("run/export"), [*export, "cameras"]),
        ("environment of a run", _link("run/export"), [*export, "environment"]),
        ("folder of cameras in exports", _link("new/sparse"), [*export, "cameras", "--out", "new"]),
        ("temporary file of run.json", lambda f: _pid_link(f, "run/run.json"), RESUME),
        ("temporary file of the scores", lambda f: _pid_link(f, "run/metrics.json"), EVAL),
        ("temporary file of a page", lambda f: _pid_link(f, "run/share.html"), ["share", "run"]),
        ("temporary file of the log", lambda f: _pid_link(f, "run/log.jsonl"), RESUME),
        ("lock of a new run", _link("new/.lock", victim), TRAIN),
        ("log of a new run", _link("new/log.jsonl", victim), TRAIN),
        ("folder of an inspection", _link("scene-inspection"), ["inspect", "scene", "--normals", "points"]),
        ("pictures of an unfinished scene", _link("unfinished/polar"), UNFINISHED),
        ("sparse of an unfinished scene", _link("unfinished/sparse"), [*UNFINISHED[:-1], "model"]),
        (
            "photographs of an unfinished scene",
            _link("unfinished/.sfm/images", "../../../outside"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        (
            "masks of an unfinished scene",
            _link("unfinished/.sfm/masks", "../../../outside"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        (
            "database of an unfinished scene",
            _link("unfinished/.sfm/database.db", "../../../outside/made.db"),
            [*UNFINISHED[:-1], "sfm"],
        ),
        ("a picture of an unfinished scene", _link("unfinished/polar/v000_000.png", victim), UNFINISHED),
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
            _link("unfinished/.sparse.partial"),
            [*UNFINISHED[:-1], "model"],
        ),
        (
            "lock of a comparison",
            _link("new/.lock", victim),
            ["compare", "scene", "--recipes", "3dgs", "--out", "new", "--steps", "0"],
        ),
    ):
        yield _case(f"link for the {name}", change, command, "a link is replaced, and what it led to stays")
    yield _case(
        "odd temporary name",
        lambda f: (f / "run/.run.json.\u00b2.tmp").write_text(""),
        RESUME,
        "it is nobody's",
    )
    yield _case(
        "temporary folder of this process",
        lambda f: (f / f"new/.sparse.{os.getpid()}.tmp").mkdir(parents=True),
        [*export, "cameras", "--out", "new"],
        "what an earlier process of this number left is removed",
    )


def run_cases() -> Iterator[Case]:
    """Run folders, and the small files that commands read."""
    for name, change, command, reason in (
        ("log of 8 million lines", _bytes("run/log.jsonl", b"{}\n" * 8_000_000), RESUME, "lines that are none are dropped"),
        ("log of 300000 rows", _bytes("run/log.jsonl", b'{"step": 3, "seconds": 1}\n' * 300_000), RESUME, "a log may be long"),
        ("log of one line of 50 MB", _bytes("run/log.jsonl", b'{"step": 1, "x": "' + b"x" * 50_000_000 + b'"}'), RESUME, "a line may be long"),
        ("log with a half character", _bytes("run/log.jsonl", b'{"step": 1, "x": "\\ud800"}\n{"step": 2, "x": "\xff"}\n'), RESUME, "lines that are none are dropped"),
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
        ("run.json of 2 GiB", lambda f: _sparse(f / "run/run.json", (1 << 31) - 1, b"{"), EVAL, ""),
        ("run.json in UTF-16", lambda f: (f / "run/run.json").write_bytes((f / "run/run.json").read_text().encode("utf-16")), EVAL, SAME),
    ):  # fmt: skip
        yield _case(f"run {name}", change, command, reason)
    yield from _checkpoint_cases()
    yield from _environment_cases()
    camera = {"width": 12, "height": 10, "fx": 15.0, "fy": 15.0, "cx": 6.0, "cy": 5.0,
              "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 2.5]}  # fmt: skip
    for name, cameras, rate, reason in (
        ("of a side of 8192", [{**camera, "width": 8192, "height": 8192}], 30, "a picture may be large"),
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
            yield _case(
                f"path {name} {how[0]}",
                _json("path.json", {"frames_per_second": rate, "cameras": cameras}),
                ["render", "run", "--path", "path.json", *how, "--layers", "final", "--device", "cpu"],
                reason,
            )


def _checkpoint_cases() -> Iterator[Case]:
    def raw(head: bytes, data: bytes = b"", length: int | None = None) -> Change:
        return _bytes(
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
        "as a pickle": _bytes("run/checkpoint.safetensors", b"\x80\x04cos\nsystem\n(S'touch ../outside/made'\ntR."),
    }.items():  # fmt: skip
        yield _case(f"checkpoint {name}", change, EVAL)

    def set_all(name: str, value: float) -> Change:
        def change(folder: Path) -> None:
            from safetensors.torch import load_file, save_file

            whole = load_file(folder / "run/checkpoint.safetensors")
            whole[name][...] = value
            save_file(whole, folder / "run/checkpoint.safetensors")

        return change

    extreme = "values in range are rendered as they are"
    for tensor, value in (("log_scales", 60.0), ("log_scales", -1e4), ("means", 1e12), ("means", 0.0), ("quaternions", 1e-40),
                          ("quaternions", 1e8), ("opacities", 1e8), ("opacities", -1e8)):  # fmt: skip
        for verb, command in (
            ("eval", EVAL),
            ("share", SHARE),
            ("ply", ["export", "run", "--format", "ply", "--out", "new"]),
            ("resume", RESUME),
        ):
            if verb in ("eval", "share") or value in (60.0, 1e12, 1e-40):
                yield _case(
                    f"checkpoint with all {tensor} {value:g} {verb}",
                    set_all(f"gaussians.{tensor}", value),
                    command,
                    extreme,
                )
    yield _case("checkpoint with a step of 2^50", lambda f: _scalars(f, [1 << 50, 0]), RESUME)
    yield _case("checkpoint with a later freeze", lambda f: _scalars(f, [10, 1 << 50]), RESUME, extreme)


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
        ("EXR of nothing", "sky.exr", _bytes("sky.exr", b"\x76\x2f\x31\x01")),
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
        yield _case(f"environment {name}", change, lit(file))


# Folders to write, and those of benches; comparisons start processes, and are in tests/experiments/test_jobs.py.


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
        "a file": _bytes("new", b""),
        "a device": _link("new", "/dev/null"),
        "a pipe": lambda f: os.mkfifo(f / "new"),
        "a link to nothing": _link("new", "nowhere"),
        "a loop": _link("new", "new"),
        "under a file": lambda f: None,
    }.items():
        for verb, command in {"train": TRAIN, "prepare": MOSAICS, "render": RENDER, "priors": READ, "compare": compare, "inspect": INSPECT,
                              "export": ["export", "run", "--format", "cameras", "--out", "new"]}.items():  # fmt: skip
            arguments = (
                [("run/run.json/x" if word == "new" else word) for word in command]
                if name == "under a file"
                else command
            )
            yield _case(f"out {name} {verb}", change, arguments)

    def bench(spoiler: Change) -> Change:
        def change(folder: Path) -> None:
            from polarguide.experiments.bench import SCENES
            from polarguide.experiments.bench_options import BENCH, BenchOptions
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
        yield _case(
            f"bench with {name}",
            bench(spoiler),
            ["bench", "--out", "new", "--render-only", "--device", "cpu"],
        )


# Published datasets.


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
        yield _case(f"{kind} with {name}", of(kind, spoiler), prepare)


# Options and names.


def option_cases() -> Iterator[Case]:
    """Values of options beyond what any file holds."""
    path = ["render", "run", "--out", "new", "--device", "cpu"]
    for name, command, reason in (
        ("views of 50000 commas", [*path, "--views", "," * 50_000], ""),
        (
            "a view 300 times",
            [*path, "--views", ",".join(["v000"] * 300), "--layers", "final"],
            "a view may be named twice",
        ),
        (
            "a layer 300 times",
            [*path, "--views", "v000", "--layers", ",".join(["final"] * 300)],
            "a layer may be named twice",
        ),
        (
            "a turn of 1e308",
            [*path, "--views", "v000", "--layers", "final", "--rotate-environment", "1e308"],
            "any angle will do",
        ),
        ("a video without a suffix", [*path[:2], "--path", "orbit", "--frames", "2", "--video", "new"], ""),
        ("a video as text", [*path[:2], "--path", "orbit", "--frames", "2", "--video", "new.txt"], ""),
        ("a video that is a folder", [*path[:2], "--path", "orbit", "--frames", "2", "--video", "run"], ""),
        ("10^9 frames", [*path, "--path", "orbit", "--frames", "1000000000"], ""),
        ("a page that is a folder", ["share", "run", "--out", "scene"], ""),
        ("a page at a device", ["share", "run", "--out", "/dev/full"], ""),
        ("memory of NaN", [*TRAIN, "--memory", "nan"], ""),
        ("memory of nothing", [*TRAIN, "--memory", "1e-9"], ""),
        ("downscale of 20", [*TRAIN, "--downscale", "21"], ""),
        ("gains of NaN", [*MOSAICS, "--white-balance", "nan,1,1"], ""),
        ("an order of one angle", [*MOSAICS, "--order", "0,0,0,0"], ""),
        ("an order of many angles", [*MOSAICS, "--order", ",".join(["0"] * 5000)], ""),
        ("intrinsics of 1e308", [*MOSAICS[:-1], "sfm", "--intrinsics", "1e308,1e308,1e308,1e308"], ""),
        ("masks that are a file", [*MOSAICS, "--masks", "calibration.json"], ""),
        ("a dark frame that is a folder", [*MOSAICS, "--dark-frame", "scene"], ""),
        ("a dark frame that is a device", [*MOSAICS, "--dark-frame", "/dev/zero"], ""),
        ("a calibration that is a device", [*MOSAICS, "--calibration", "/dev/zero"], ""),
        ("poses that are a device", [*MOSAICS[:-1], "/dev/zero"], ""),
        ("poses that are a picture", [*MOSAICS[:-1], "mosaics/v000.png"], ""),
        ("a zero of 1e308", [*MOSAICS, "--zero", "1e308"], ""),
        ("a black level of 1e308", [*MOSAICS, "--black-level", "1e308"], ""),
        ("a scene twice", ["compare", "scene", "scene", "--recipes", "3dgs", "--out", "new"], ""),
        ("200 recipes", ["compare", "scene", "--recipes", *["3dgs"] * 200, "--out", "new"], ""),
        ("a port of 10^9", [*TRAIN, "--viewer", "--viewer-port", "1000000000"], ""),
        ("a host of words", [*TRAIN, "--viewer", "--viewer-host", "no such host"], ""),
        ("a host to allow that is an address with a path", [*TRAIN, "--viewer", "--allow-host", "x/y"], ""),
    ):
        yield _case(f"option {name}", lambda f: None, command, reason)


def name_cases() -> Iterator[Case]:
    """Names that mean something to whoever shows them: pages, tables, terminals."""

    def no_control(folder: Path) -> None:
        said = (folder.parent / "said").read_bytes()
        assert b"\x1b" not in said, said[-300:]
        assert "\u202e".encode() not in said, said[-300:]

    control = "\x1b[2J\x1b]0;mine\x07\u202e"

    def renamed(to: str) -> Change:
        def change(folder: Path) -> None:
            for path in list((folder / "scene/polar").glob("v001_*")):
                path.rename(path.with_name(path.name.replace("v001", to)))
            text = folder / "scene/sparse/0/images.txt"
            text.write_text(text.read_text().replace("v001.png", f"{to}.png".replace(" ", "")))

        return change

    yield _case("view with control characters and no pose", renamed(control), READ, check=no_control)
    yield _case(
        "stranger with control characters",
        lambda f: shutil.copyfile(f / PICTURE, f / f"scene/polar/{control}.png"),
        READ,
        check=no_control,
    )
    yield _case(
        "scene of control characters",
        lambda f: (f / "scene").rename(f / control),
        ["priors", control, *READ[2:]],
        "it is shown without them",
        check=no_control,
    )
    yield _case(
        "option of control characters", lambda f: None, [*TRAIN, "--recipe", control], check=no_control
    )
    yield _case("verb of control characters", lambda f: None, [control], check=no_control)
    script = "<script>alert(1)</script><img src=x onerror=alert(1)>"

    def no_script(*names: str) -> Change:
        def check(folder: Path) -> None:
            for name in names:
                for path in folder.glob(name):
                    shown = path.read_text(errors="replace")
                    assert "<script>alert(1)" not in shown, path
                    assert "<img src=x" not in shown, path

        return check

    yield _case(
        "page of a hostile title",
        lambda f: None,
        [*SHARE, "--title", script, "--caption", "</title>" + script + "<!--"],
        "it is escaped",
        no_script("new.html"),
    )

    def hostile(folder: Path) -> None:
        (folder / "scene").rename(folder / "x<img src=x onerror=alert(1)>")

    yield _case(
        "inspection of a hostile name",
        hostile,
        ["inspect", "x<img src=x onerror=alert(1)>", "--normals", "points", "--out", "new"],
        "it is escaped",
        no_script("new/*.html", "new/*.svg"),
    )

    def newline(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            path.rename(path.with_name(path.name.replace("v001", "v0\n01")))

    yield _case("view of two lines", newline, READ)

    def long(folder: Path) -> None:
        name = "x" * 246
        for path in list((folder / "scene/polar").glob("v000_*")):
            path.rename(path.with_name(path.name.replace("v000", name)))
        text = folder / "scene/sparse/0/images.txt"
        text.write_text(text.read_text().replace("v000.png", f"{name}.png"))
        (folder / "scene/split.json").write_text(json.dumps({"test": [name]}))

    yield _case(
        "view of the longest name",
        long,
        ["priors", "scene", "--out", "new", "--views", "x" * 246, "--threads", "1"],
    )
    yield _case("option that begins like another", lambda f: None, ["train", "--", "--out", "new"])
