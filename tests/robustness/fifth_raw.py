# ruff: noqa: E501
"""Raw inputs of prepare, priors, measure and calibrate, and the files that are given beside them."""

from __future__ import annotations

import importlib
import json
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from base import MOSAICS, SHOTS
from fifth_scenes import drawn, several
from further_folders import CALIBRATE, MEASURE
from making import MOSAIC, SAME, Change, MadeCase, instead, made_case, nothing, of_bytes, of_json, put

SENSOR = ["--sensor", "IMX250MYR", "--bits", "16"]
PRIORS = ["priors", "mosaics", "--out", "new", *SENSOR, "--formats", "npy"]
SHOT = "shots/45/v001.png"


def _directory(*entries: tuple[int, int, int, int], then: int = 0) -> bytes:
    """A TIFF file of a directory and nothing else."""
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries)) + body + struct.pack("<I", then)


def _array(path: Path, values: Any) -> None:
    np.save(path, values)


def _code(path: Path) -> None:
    head = b"{'descr': '<u2', 'fortran_order': __import__('os').abort(), 'shape': (4, 4)}".ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + bytes(32))


def mosaic_cases() -> Iterator[MadeCase]:
    """Mosaics."""
    tiles = [(256, 4, 1, 96), (257, 4, 1, 64), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 1), (277, 3, 1, 1), (322, 4, 1, 0), (323, 4, 1, 0), (324, 4, 1, 8), (325, 4, 1, 2**32 - 1)]  # fmt: skip
    height, width = 48, 64
    for name, change, accepted in (
        ("RGB", drawn(MOSAIC, np.zeros((height, width, 3), np.uint8)), ""),
        ("one pixel", drawn(MOSAIC, np.ones((1, 1), np.uint16)), ""),
        ("big-endian columns", instead(".npy", _array, np.asfortranarray(np.ones((height, width), ">u2")), at=MOSAIC), ""),
        ("floats with gaps", instead(".npy", _array, np.full((height, width), np.nan), at=MOSAIC), ""),
        ("code for a head", instead(".npy", _code, at=MOSAIC), ""),
        ("no rows", instead(".npy", _array, np.zeros((0, 0), np.uint16), at=MOSAIC), ""),
        ("a TIFF that points to itself", instead(".tif", lambda path: path.write_bytes(_directory((256, 4, 1, 96), then=8)) and None, at=MOSAIC), ""),
        ("a TIFF of tiles without width", instead(".tif", lambda path: path.write_bytes(_directory(*tiles)) and None, at=MOSAIC), ""),
        ("a JPEG", several(drawn("mosaics/v003.jpg", np.zeros((height, width), np.uint8)), put(MOSAIC, "empty")), ""),
        ("a device", put(MOSAIC, "device"), ""),
        ("a folder", put(MOSAIC, "folder"), ""),
    ):  # fmt: skip
        yield made_case(f"fifth mosaic: {name}", change, MOSAICS, accepted)
    for name, more in {
        "an offset below zero": ["--offset-x", "-1"],
        "a black level at full scale": ["--black-level", "65535"],
        "a white balance beyond floats": ["--white-balance", "1e400,0,-1"],
        "a dark frame of another size": ["--dark-frame", "scene/polar/v000_000.png"],
        "a dark frame that is a folder": ["--dark-frame", "mosaics"],
        "masks of other names": ["--masks", "scene/polar"],
        "intrinsics that are no numbers": ["--intrinsics", "nan,1,1,1"],
    }.items():
        yield made_case(f"fifth mosaics with {name}", nothing, [*MOSAICS, *more])
    bright = drawn("dark.png", np.full((height, width), 65000, np.uint16))
    yield made_case(
        "fifth mosaics darker than their dark frame", bright, [*MOSAICS, "--dark-frame", "dark.png"]
    )
    yield made_case(
        "fifth mosaics with a calibration of zeros",
        of_json("c.json", {"gains": {"0": 0, "45": 1, "90": 1, "135": 1}, "order": [0, 0, 0, 0]}),
        [*MOSAICS, "--calibration", "c.json"],
    )
    for name, command in {
        "priors into a file": [*PRIORS[:3], "calibration.json", *PRIORS[4:]],
        "priors of devices": ["priors", "/dev/null", "/dev/zero", *PRIORS[2:]],
        "priors of an empty name": ["priors", "", *PRIORS[1:]],
        "priors in formats that there are not": [*PRIORS[:-1], ",npy,exe"],
        "priors with noise that is no number": [
            *PRIORS,
            "--full-well",
            "0",
            "--read-noise",
            "nan",
            "--snr",
            "-1",
        ],
    }.items():
        yield made_case(f"fifth {name}", nothing, command)

    def loops(folder: Path) -> None:
        (folder / "mosaics/loop").symlink_to(".")
        (folder / "mosaics/root").symlink_to("/")

    yield made_case(
        "fifth priors of a folder with links to itself and to /",
        loops,
        PRIORS,
        "links are followed one level down",
    )


def _exif(of: str, tag: int, value: int) -> Change:
    def change(folder: Path) -> None:
        image = importlib.import_module("PIL.Image")
        for path in sorted((folder / "shots").glob(of)):
            with image.open(path) as opened:
                opened.load()
            exif = image.Exif()
            exif[tag] = value
            opened.save(path, exif=exif)

    return change


def shot_cases() -> Iterator[MadeCase]:
    """Shots through a filter, and single ones."""
    turned = 0x0112
    for name, change, accepted in (
        ("one of four is turned", _exif("45/v001.png", turned, 6), ""),
        ("an orientation that there is not", _exif("*/*.png", turned, 77), SAME),
        ("one is cut in half", lambda folder: (folder / SHOT).write_bytes((folder / SHOT).read_bytes()[:400]), ""),
        ("one is there twice", drawn("shots/45/v001.jpg", np.zeros((48, 64, 3), np.uint8)), ""),
        ("one is transparent", drawn(SHOT, np.full((48, 64, 4), 100, np.uint8)), ""),
    ):  # fmt: skip
        yield made_case(f"fifth shots: {name}", change, SHOTS, accepted)
    singles = ["prepare", "shots/0", "--out", "new", "--poses", "none", "--format", "singles"]
    yield made_case(
        "fifth single shots: a table of half of them",
        of_bytes("t.csv", b"file,angle\nv000.png,0\n"),
        [*singles, "--angles", "t.csv"],
    )
    yield made_case("fifth single shots: an angle left out", nothing, [*singles, "--angles", "0,,60,inf"])


def pose_cases() -> Iterator[MadeCase]:
    """Poses of other programs, and records that lead out."""
    entities = "".join(f'<!ENTITY {chr(98 + n)} "{f"&{chr(97 + n)};" * 10}">' for n in range(9))
    laughs = f'<?xml version="1.0"?><!DOCTYPE d [<!ENTITY a "aaaaaaaaaa">{entities}<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    laughs += '<document><chunk><cameras><camera label="&j;&x;"/></cameras></chunk></document>'
    frames = '{"fl_x":NaN,"w":48,"h":32,"frames":[{"file_path":"v000.png","transform_matrix":[[1,0],[0,1]]}]}'

    def pickled(folder: Path) -> None:
        np.savez(folder / "c.npz", world_mat_0=np.array([{}], object), scale_mat_0=np.eye(4))

    for name, change, poses in (
        ("entities without end", of_bytes("c.xml", laughs.encode()), "c.xml"),
        ("frames that are no numbers", of_bytes("t.json", frames.encode()), "t.json"),
        ("a pickle", pickled, "c.npz"),
        ("an empty folder", lambda folder: (folder / "k").mkdir(), "k"),
    ):  # fmt: skip
        yield made_case(f"fifth poses: {name}", change, [*MOSAICS[:-1], poses])

    def leaves(folder: Path) -> None:
        path = folder / "prepared/scene.json"
        path.write_text(path.read_text().replace('"v001"', '"../../outside/victim"'))

    yield made_case(
        "fifth prepared scene whose views lie outside",
        leaves,
        [*MOSAICS[:3], "prepared", *MOSAICS[4:-1], "model"],
    )

    def listed(folder: Path) -> None:
        path = folder / "prepared/scene.json"
        data = json.loads(path.read_text())
        views = data["prepare"]["views"]
        data["prepare"]["views"] = (
            {name: [1] for name in views} if isinstance(views, dict) else [[1] for _ in views]
        )
        path.write_text(json.dumps(data))

    yield made_case(
        "fifth prepared scene whose views are lists", listed, [*MOSAICS[:3], "prepared", *MOSAICS[4:]]
    )

    def dataset(folder: Path) -> None:
        for name in ("images_s0", "images_s1", "images_s2"):
            (folder / "neisf" / name).mkdir(parents=True)
            (folder / "neisf" / name / "img_001.exr").write_bytes(b"v/1\x01\x02\0\0\0" + bytes(range(256)))
        np.save(folder / "neisf/poses_bounds.npy", np.zeros((0, 17)))

    yield made_case("fifth dataset without poses", dataset, ["prepare", "neisf", "--out", "new"])


def measure_cases() -> Iterator[MadeCase]:
    """Regions, limits, and what else a table takes."""
    limits = '{"limits":{"dolp_mean":{"min":"a","max":NaN}},"regions":[]}'
    for name, more in {
        "regions outside": ["--roi", "a=0,0,0,5", "--roi=b=-5,0,9,9", "--roi", "c=90,60,50,50"],
        "a region called by a formula": ["--roi", "=1+1=0,0,5,5"],
        "two regions of one name": ["--roi", "x=0,0,5,5", "--roi", "x=1,1,5,5"],
        "a reference of another size": ["--reference", "scene/polar/v000_000.png"],
        "a watch of its own table": ["--watch", "new"],
        "a watch with times that are none": ["--watch", "mosaics", "--settle", "nan", "--idle", "-1"],
    }.items():
        command = [MEASURE[0], *MEASURE[2:]] if "--watch" in more else MEASURE
        yield made_case(f"fifth measure with {name}", nothing, [*command, *more])
    yield made_case(
        "fifth measure with limits of words",
        of_bytes("l.json", limits.encode()),
        [*MEASURE, "--limits", "l.json"],
    )


def calibrate_cases() -> Iterator[MadeCase]:
    """Shots of a polarizer."""

    def shots(level: int) -> Change:
        def change(folder: Path) -> None:
            (folder / "polarizer").mkdir()
            for angle in range(0, 180, 15):
                drawn(f"polarizer/shot_{angle:03d}.png", np.full((48, 64), level, np.uint16))(folder)

        return change

    named = [*CALIBRATE, "--angles", "names", "--bits", "12"]
    for name, change, command in (
        ("black shots", shots(0), named),
        ("equal shots", shots(2000), [*CALIBRATE, "--bits", "12"]),
        ("blocks larger than the sensor", shots(2000), [*named, "--block", "1000000000"]),
        ("a polarizer of 0.5", shots(2000), [*named, "--polarizer-extinction", "0.5"]),
        ("angles too few", shots(2000), [*CALIBRATE, "--angles", "nan,0,1,2", "--bits", "12"]),
        ("a folder without shots", lambda folder: os.mkdir(folder / "polarizer"), named),
    ):  # fmt: skip
        yield made_case(f"fifth calibrate: {name}", change, command)
