# ruff: noqa: E501
"""Headers of pictures and of ground truth that lie, and decoders that believe them."""

from __future__ import annotations

import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import hostile_files as made
import numpy as np
from base import HEIGHT, MOSAICS, READ, SHOTS, TRAIN, WIDTH
from forked import Case
from making import PICTURE, SAME, TRUTH, UNUSED, Change, instead, sparse
from making import more_case as case


def picture_cases() -> Iterator[Case]:
    """Headers that lie, and decoders that believe them."""

    def tags(*changed: made.Tag, drop: Sequence[int] = ()) -> Change:
        size = 2 * WIDTH * HEIGHT
        table = {tag[0]: tag for tag in made.gray_tags(WIDTH, HEIGHT, size)}
        table |= {tag[0]: tag for tag in changed}
        return instead(
            ".tif",
            made.tiff,
            [table[key] for key in sorted(table) if key not in drop],
            bytes(max(size, 4096)),
        )

    where = "scene/polar/v000_000.png"
    for name, change in {
        "TIFF of signed sizes": instead(".tif", made.deflated_tiff, 30000, kind=9),
        "TIFF of 64-bit sizes": instead(".tif", made.deflated_tiff, 30000, kind=16),
        "TIFF of two sizes": instead(".tif", made.deflated_tiff, 30000, twice=WIDTH),
        "TIFF of 14000 pixels a side": instead(".tif", made.deflated_tiff, 14000),
        "first TIFF of signed sizes": instead(".tif", made.deflated_tiff, 30000, kind=9, at=where),
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
        yield case(f"picture {name}", change, READ)

    def ring(path: Path) -> None:
        made.tiff(path, made.gray_tags(WIDTH, HEIGHT, 2 * WIDTH * HEIGHT), bytes(4096))
        data = bytearray(path.read_bytes())
        data[8 + 2 + 9 * 12 : 8 + 2 + 9 * 12 + 4] = struct.pack("<I", 8)
        path.write_bytes(bytes(data))

    yield case("picture TIFF whose next directory is its first", instead(".tif", ring), READ, UNUSED)
    yield case(
        "picture TIFF of 65535 entries",
        instead(".tif", lambda path: path.write_bytes(b"II*\0\x08\0\0\0\xff\xff" + bytes(12 * 65535 + 64))),
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

    yield case("picture PNG with a bomb of text", chunked, READ, UNUSED)
    for name, change in {
        "PNG whose size comes second": lambda f: made.png(f / PICTURE, 30000, 30000, bits=1, first=[(b"tEXt", struct.pack(">II", WIDTH, HEIGHT) + b"\x10\0\0\0\0")]),
        "PNG of size 0": lambda f: made.png(f / PICTURE, 0, HEIGHT, idat=b""),
        "PNG of no pixels": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, idat=b""),
        "PNG of other pixels": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, idat=zlib.compress(b"no such thing")),
        "PNG of 3 bits": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, bits=3),
        "PNG without a palette": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, bits=8, color=3),
        "PNG of a million frames": lambda f: made.png(f / PICTURE, WIDTH, HEIGHT, before=[(b"acTL", struct.pack(">II", 1 << 20, 0)), (b"fcTL", struct.pack(">IIIIIHHBB", 0, 60000, 60000, 0, 0, 1, 1, 0, 0))]),
        "JPEG of two sizes": instead(".jpg", made.two_sizes_jpeg, 30000),
    }.items():  # fmt: skip
        yield case(
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

    yield case("masks of 12000 pixels a side", masks, TRAIN)
    yield case("three angles of 12000 pixels a side", angles, TRAIN)

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

    yield case("shots of 12000 pixels a side", shots, SHOTS)
    yield case("shots of 4000 scans", scans, SHOTS)
    big = "mosaics/v001.png"
    yield case(
        "mosaic TIFF of signed sizes", instead(".tif", made.deflated_tiff, 30000, kind=9, at=big), MOSAICS
    )
    yield case(
        "mosaic .npy of a broken head",
        instead(".npy", lambda p: p.write_bytes(made.header("{'descr': (")), at=big),
        MOSAICS,
    )
    yield case(
        "mosaic .npy of a deep head",
        instead(".npy", lambda p: p.write_bytes(made.header("-" * 9000 + "1")), at=big),
        MOSAICS,
    )
    yield case(
        "mosaic .npy of a wrong key",
        instead(".npy", lambda p: p.write_bytes(made.header("{{}: 1}")), at=big),
        MOSAICS,
    )
    yield case(
        "mosaic .npy of version 9",
        instead(".npy", lambda p: p.write_bytes(made.header("{}", version=(9, 0))), at=big),
        MOSAICS,
    )
    yield case(
        "mosaic .npy of negative sides",
        instead(
            ".npy",
            lambda p: p.write_bytes(
                made.header("{'descr': '<u2', 'fortran_order': False, 'shape': (-64, -64), }") + bytes(8192)
            ),
            at=big,
        ),
        MOSAICS,
    )
    yield case(
        "mosaic .npy of objects",
        instead(".npy", lambda p: np.save(p, np.array([[{}]], dtype=object)), at=big),
        MOSAICS,
    )
    yield case("mosaic sparse of 2 GiB", instead(".tif", sparse, (1 << 31) - 1, b"II*\0", at=big), MOSAICS)


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
        yield case(f"gt {name}", change, READ, reason)
    yield case(
        "gt has the same array 2000 times",
        lambda f: made.archive(f / TRUTH, [("depth.npy", good)] * 2000),
        READ,
        UNUSED,
    )
    yield case(
        "gt has 60000 other files",
        lambda f: made.archive(f / TRUTH, [(f"{k}", b"") for k in range(60000)], zipfile.ZIP_STORED),
        READ,
        "there may be none of the arrays",
    )
    yield case(
        "gt behind a picture",
        lambda f: (f / TRUTH).write_bytes((f / PICTURE).read_bytes() + (f / TRUTH).read_bytes()),
        READ,
        SAME,
    )
