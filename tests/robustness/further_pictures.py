# ruff: noqa: E501
"""Pictures that are whole and still not what they should be, and bombs of kinds that the corpus has not."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import hostile_files as made
import numpy as np
from base import MOSAICS, READ, SHOTS
from further_folders import MEASURE
from making import MOSAIC, UNUSED, Change, MadeCase, instead, made_case, small_machine, sparse

FORM = "it is the same picture in another form"


def _mosaic(folder: Path) -> Any:
    return cv2.imread(str(folder / MOSAIC), cv2.IMREAD_UNCHANGED)


def _saved(suffix: str, write: Callable[[Path, Any], object]) -> Change:
    """The mosaic as ``write`` saves its values."""

    def change(folder: Path) -> None:
        values, path = _mosaic(folder), folder / MOSAIC
        path.unlink()
        write(path.with_suffix(suffix), values)

    return change


def _tiff(**how: Any) -> Change:
    import tifffile

    convert = how.pop("convert", lambda values: values)
    return _saved(".tif", lambda path, values: tifffile.imwrite(path, convert(values), **how))


def _pillow(suffix: str, mode: str, **how: Any) -> Change:
    from PIL import Image

    def write(path: Path, values: Any) -> None:
        picture = Image.fromarray((values >> 8).astype(np.uint8)).convert(mode)
        picture.save(path, format={".png": "PNG", ".tif": "TIFF"}.get(suffix, how.pop("format", None)), **how)

    return _saved(suffix, write)


def tiff_cases() -> Iterator[MadeCase]:
    """What scanners, microscopes and cameras save as TIFF."""
    three = lambda v: np.repeat(v[..., None], 3, axis=2)  # noqa: E731
    for name, change, reason in (
        ("in tiles", _tiff(tile=(16, 16)), FORM),
        ("in big-endian bytes", _tiff(byteorder=">"), FORM),
        ("as BigTIFF", _tiff(bigtiff=True), FORM),
        ("as big-endian BigTIFF in tiles", _tiff(bigtiff=True, byteorder=">", tile=(16, 16)), FORM),
        ("deflated with a predictor", _tiff(compression="zlib", predictor=True), FORM),
        ("as three equal colors", _tiff(convert=three, photometric="rgb"), ""),
        ("as three planes", _tiff(convert=lambda v: np.stack([v] * 3), photometric="rgb", planarconfig="separate"), ""),
        ("of signed numbers", _tiff(convert=lambda v: v.astype(np.int16)), ""),
        ("of 32-bit whole numbers", _tiff(convert=lambda v: v.astype(np.uint32)), ""),
        ("of half precision", _tiff(convert=lambda v: (v / 65535).astype(np.float16)), ""),
        ("of floating point", _tiff(convert=lambda v: (v / 65535).astype(np.float32)), ""),
        ("of double precision", _tiff(convert=lambda v: (v / 65535).astype(np.float64)), ""),
        ("of complex numbers", _tiff(convert=lambda v: v.astype(np.complex64)), ""),
        ("of 40 pages", _tiff(convert=lambda v: np.stack([v] * 40), photometric="minisblack"), ""),
        ("with a smaller copy in it", _saved(".tif", lambda path, v: _pyramid(path, v)), "the whole picture is read"),
        ("turned by its orientation", _tiff(extratags=[(274, "H", 1, 6, True)]), ""),
        ("where white is 0", _tiff(photometric="miniswhite"), ""),
        ("of 1 bit", _pillow(".tif", "1"), ""),
        ("with a palette", _pillow(".tif", "P"), ""),
        ("in CMYK", _pillow(".tif", "CMYK"), ""),
        ("with alpha", _pillow(".tif", "LA"), ""),
        ("in CIELAB", _pillow(".tif", "LAB"), ""),
        ("in JPEG", _pillow(".tif", "L", compression="jpeg"), ""),
        ("in tiles of 60000 pixels", _tiled_bomb(60000), ""),
        ("whose directory is at its end, behind a hole", _far_directory(1 << 30), ""),
        ("whose directory is nowhere", instead(".tif", lambda p: p.write_bytes(b"II*\0" + struct.pack("<I", 0xFFFFFFF0) + bytes(64)), at=MOSAIC), ""),
        ("of 2 GiB, sparse, with a small picture in it", _small_in_large(), ""),
        ("as BigTIFF whose directory has 2^63 entries", instead(".tif", lambda p: p.write_bytes(b"II+\0\x08\0\0\0" + struct.pack("<QQ", 16, 1 << 63) + bytes(64)), at=MOSAIC), ""),
    ):  # fmt: skip
        yield made_case(f"further mosaic TIFF {name}", change, MOSAICS, reason)


def _pyramid(path: Path, values: Any) -> None:
    import tifffile

    with tifffile.TiffWriter(path) as file:
        file.write(values, subifds=1)
        file.write(values[::2, ::2], subfiletype=1)


def _tiled_bomb(side: int) -> Change:
    def change(folder: Path) -> None:
        (folder / MOSAIC).unlink()
        packed = zlib.compress(bytes(2 * 4096 * 4096), 9)
        count = (-(-side // 4096)) ** 2
        tags = [(256, 4, 1, side), (257, 4, 1, side), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 1), (277, 3, 1, 1),
                (322, 4, 1, 4096), (323, 4, 1, 4096), (324, 4, count, 0), (325, 4, count, 0)]  # fmt: skip
        start = 8 + 2 + 12 * len(tags) + 4
        places, sizes = start + len(packed), start + len(packed) + 4 * count
        tags = [(n, k, c, {324: places, 325: sizes}.get(n, v)) for n, k, c, v in tags]
        made.tiff(
            (folder / MOSAIC).with_suffix(".tif"), tags,
            packed + struct.pack(f"<{count}I", *[start] * count) + struct.pack(f"<{count}I", *[len(packed)] * count),
        )  # fmt: skip

    return change


def _far_directory(at: int) -> Change:
    def change(folder: Path) -> None:
        values, path = _mosaic(folder), (folder / MOSAIC).with_suffix(".tif")
        (folder / MOSAIC).unlink()
        height, width = values.shape
        tags = made.gray_tags(width, height, values.nbytes)
        with open(path, "wb") as file:
            file.write(struct.pack("<2sHI", b"II", 42, at) + values.tobytes())
            file.seek(at)
            file.write(struct.pack("<H", len(tags)))
            for number, kind, count, value in tags:
                file.write(struct.pack("<HHII", number, kind, count, 8 if value == -1 else value))
            file.write(bytes(4))

    return change


def _small_in_large() -> Change:
    def change(folder: Path) -> None:
        values, path = _mosaic(folder), (folder / MOSAIC).with_suffix(".tif")
        (folder / MOSAIC).unlink()
        height, width = values.shape
        made.tiff(path, made.gray_tags(width, height, values.nbytes), values.tobytes())
        with open(path, "r+b") as file:
            file.truncate((1 << 31) - 1)

    return change


def other_cases() -> Iterator[MadeCase]:
    """PNG files of other kinds, files that are none, and arrays."""
    big = (1 << 16) - 1

    def renamed(name: str, data: bytes) -> tuple[str, Change, str]:
        return f"PNG that is {name}", lambda f: (f / MOSAIC).write_bytes(data), ""

    def encoded(kind: str) -> bytes:
        from PIL import Image

        stream = io.BytesIO()
        Image.new("L", (64, 48), 99).save(stream, kind)
        return stream.getvalue()

    for name, change, reason in (
        ("PNG of 1 bit", _pillow(".png", "1"), ""),
        ("PNG with a palette", _pillow(".png", "P"), ""),
        ("PNG with alpha", _pillow(".png", "LA"), ""),
        ("PNG of colors with alpha", _pillow(".png", "RGBA"), ""),
        ("PNG of 8 bits among those of 16", _pillow(".png", "L"), ""),
        ("PNG with a color that counts as transparent", lambda f: made.png(f / MOSAIC, 64, 48, before=[(b"tRNS", b"\0\0")]), ""),
        ("PNG with a gamma", lambda f: made.png(f / MOSAIC, 64, 48, before=[(b"gAMA", struct.pack(">I", 1))]), ""),
        ("PNG of 65535 pixels a side", lambda f: made.png(f / MOSAIC, big, big, idat=zlib.compress(bytes(1 << 24), 9)), ""),
        ("PNG of 2^31 - 1 pixels a side", lambda f: made.png(f / MOSAIC, (1 << 31) - 1, (1 << 31) - 1, idat=b"x"), ""),
        ("PNG whose chunk says 4 GiB", lambda f: (f / MOSAIC).write_bytes((f / MOSAIC).read_bytes()[:33] + b"\xff\xff\xff\xffIDAT" + bytes(99)), ""),
        ("PNG with a second head", lambda f: made.png(f / MOSAIC, 64, 48, before=[(b"IHDR", struct.pack(">IIBBBBB", 30000, 30000, 16, 0, 0, 0, 0))]), ""),
        ("PNG of 60000 empty chunks", lambda f: made.png(f / MOSAIC, 64, 48, before=[(b"tEXt", b"a\0")] * 60000), "black"),
        renamed("a JPEG", encoded("JPEG")),
        renamed("a GIF", encoded("GIF")),
        renamed("a BMP", encoded("BMP")),
        renamed("a WebP", encoded("WebP")),
        renamed("a page of a server", b"<!DOCTYPE html><title>404</title>"),
        renamed("a pointer of Git LFS", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 99\n"),
        renamed("a camera raw file", b"II*\0\x10\0\0\0CR\2\0" + bytes(64)),
        ("PNG of 3 GB of nothing", lambda f: sparse(f / MOSAIC, 3 << 30, b"\x89PNG\r\n\x1a\n"), ""),
        (".npy in Fortran's order", _saved(".npy", lambda p, v: np.save(p, np.asfortranarray(v))), FORM),
        (".npy of big-endian bytes", _saved(".npy", lambda p, v: np.save(p, v.astype(">u2"))), FORM),
        (".npy of signed numbers", _saved(".npy", lambda p, v: np.save(p, v.astype(np.int32))), ""),
        (".npy of truth values", _saved(".npy", lambda p, v: np.save(p, v > 9)), ""),
        (".npy of four pictures", _saved(".npy", lambda p, v: np.save(p, np.stack([v] * 4))), ""),
        (".npy with more behind it", _saved(".npy", lambda p, v: p.write_bytes(made.npy(v) + b"more")), UNUSED),
        (".npy of three axes of 1", _saved(".npy", lambda p, v: np.save(p, v[..., None])), FORM),
        (".npy that is an .npz", _saved(".npy", lambda p, v: made.archive(p, [("a.npy", made.npy(v))])), ""),
    ):  # fmt: skip
        yield made_case(f"further mosaic {name}", change, MOSAICS, reason)

    raw = [*MOSAICS, "--packing", "12p", "--width", "64", "--height", "48"]
    for name, command, size in (
        ("of one byte too few", raw, 64 * 48 * 3 // 2 - 1),
        ("of one byte too many", raw, 64 * 48 * 3 // 2 + 1),
        ("without a size", MOSAICS, 4608),
        (
            "of 10^9 columns",
            [*MOSAICS, "--packing", "10p", "--width", str(10**9), "--height", str(10**9)],
            4608,
        ),
        ("of minus one column", [*MOSAICS, "--packing", "12packed", "--width", "-1", "--height", "-1"], 4608),
    ):
        yield made_case(
            f"further mosaic .raw {name}",
            _saved(".raw", lambda p, v, n=size: p.write_bytes(bytes(n))),
            command,
        )

    for name, change, command, reason in (
        ("shot PNG with alpha", lambda f: made.png(f / "shots/45/v001.png", 64, 48, color=6), SHOTS, ""),
        ("shot in CMYK", lambda f: _cmyk(f / "shots/45/v001.png"), SHOTS, ""),
        ("shot turned by its EXIF", lambda f: _turned(f / "shots"), SHOTS, ""),
        ("shot DNG of zeros", lambda f: [(f / f"shots/{a}/v001.png").rename(f / f"shots/{a}/v001.dng") for a in ("0", "45", "90", "135")], SHOTS, ""),
        ("measured mosaic of 2 GiB, sparse", lambda f: sparse((f / MOSAIC).with_suffix(".tif"), (1 << 31) - 1, b"II*\0"), MEASURE, ""),
        ("measured mosaic in tiles of 60000 pixels", _tiled_bomb(60000), MEASURE, ""),
        ("measured mosaic PNG of 30000 pixels a side", lambda f: made.png(f / MOSAIC, 30000, 30000, bits=8), MEASURE, ""),
        ("mask in CMYK", lambda f: _cmyk(f / "scene/masks/v001.png"), READ, "a mask may be any picture"),
        ("mosaic of 12000 pixels a side and little memory", small_machine(lambda f: made.png(f / MOSAIC, 12000, 12000, bits=8)), MOSAICS, ""),
        ("measured mosaic of 12000 pixels a side and little memory", small_machine(lambda f: made.png(f / MOSAIC, 12000, 12000, bits=8)), MEASURE, ""),
    ):  # fmt: skip
        yield made_case(f"further {name}", change, command, reason)


def _cmyk(path: Path) -> None:
    from PIL import Image

    size = cv2.imread(str(path)).shape[1::-1]
    Image.new("CMYK", size, (9, 9, 9, 9)).save(path, "JPEG")


def _turned(folder: Path) -> None:
    from PIL import Image

    for angle in ("0", "45", "90", "135"):
        exif = Image.Exif()
        exif[274] = {"90": 6}.get(angle, 1)
        picture = Image.new("RGB", (64, 48), (40, 50, 60))
        for view in ("v000", "v001"):
            (folder / angle / f"{view}.png").unlink()
            picture.save(folder / angle / f"{view}.jpg", exif=exif)
