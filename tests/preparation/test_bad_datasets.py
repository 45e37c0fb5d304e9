"""Published datasets whose cameras or numbers make no sense: what is said of each."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_files import WRITERS, disc, write_npy
from test_bad_input import PLAIN, refused
from tiny_capture import write_picture

from polarguide.capture.calibration import Calibration
from polarguide.preparation.settings import PrepareSettings

# The light of these tests has no outlines: nothing tells the sense of NeRSP's and NeISF's angles.
pytestmark = pytest.mark.filterwarnings("ignore:The sense of .* is not certain")


def npz(name: str, **changes: object) -> Callable[[Path], None]:
    """Other entries in a file of arrays; None removes one."""

    def change(root: Path) -> None:
        with np.load(root / name) as file:
            arrays: dict = dict(file)
        for key, value in changes.items():
            if value is None:
                arrays.pop(key)
            else:
                arrays[key] = value(arrays[key]) if callable(value) else value
        np.savez(root / name, **arrays)

    return change


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda root: np.save(root / "poses_bounds.npy", change(np.load(root / "poses_bounds.npy")))


def cameras(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def rewrite(root: Path) -> None:
        content = json.loads((root / "cameras.json").read_text())
        change(content)
        (root / "cameras.json").write_text(json.dumps(content))

    return rewrite


def put(index: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = np.array(array, float)
        array[index] = value
        return array

    return change


def without(array: np.ndarray) -> np.ndarray:
    return array[:-1]


def inflate(root: Path) -> None:
    with zipfile.ZipFile(root / "cameras.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", bytes(200_000_000))


def view(array: np.ndarray) -> np.ndarray:
    """A matrix whose rotation is none."""
    array = np.array(array, float)
    array[:3, :3] *= 2
    return array


CELLS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    # cameras.npz
    "pandora: wrong keys": (
        "pandora", lambda d: np.savez(d / "cameras.npz", camera_mat=np.eye(4)),
        "cameras.npz: expected the entry world_mat_<i>, found camera_mat",
    ),
    "pandora: no scale": (
        "pandora", npz("cameras.npz", scale_mat_2=None), "expected the entry scale_mat_2, found .*and 3 more"
    ),
    "pandora: a camera too few": (
        "pandora", npz("cameras.npz", world_mat_3=None, scale_mat_3=None),
        "expected the entry world_mat_3 for view 04, found none; 1 of 4 views",
    ),
    "pandora: nan": (
        "pandora", npz("cameras.npz", world_mat_1=put((0, 0), np.nan)), r"\(world_mat_1\): .*not finite"
    ),
    "pandora: singular": (
        "pandora", npz("cameras.npz", world_mat_0=np.ones((4, 4))), "that can be inverted, found a singular one"
    ),
    "pandora: zero scale": ("pandora", npz("cameras.npz", scale_mat_0=np.zeros((4, 4))), "found a singular one"),
    "pandora: skew": (
        "pandora", npz("cameras.npz", world_mat_0=lambda m: np.array([[1, 0.3, 0, 0], *np.eye(4)[1:]]) @ m),
        "without skew",
    ),
    "pandora: wrong shape": ("pandora", npz("cameras.npz", world_mat_0=np.eye(3)), "in shape 3x4 or 4x4, found 3x3"),
    "pandora: words": ("pandora", npz("cameras.npz", world_mat_0=np.array("x")), "a damaged one|something else"),
    "pandora: objects": (
        "pandora", npz("cameras.npz", world_mat_0=np.array([{}], dtype=object)), "a damaged one"
    ),
    "pandora: zip bomb": ("pandora", inflate, "unfolds to 200000000 bytes"),
    "pandora: no cameras": ("pandora", lambda d: (d / "cameras.npz").unlink(), "cameras.npz: expected a readable file"),
    # pictures
    "pandora: no part": (
        "pandora", lambda d: (d / "images_stokes" / "03_s0p2.hdr").unlink(), "the s0p2 of view 03, found nothing"
    ),
    "pandora: no pictures": ("pandora", lambda d: shutil.rmtree(d / "images"), "intrinsics belong to, found none"),
    "pandora: another aspect": (
        "pandora", lambda d: write_picture(d / "images" / "01.png", np.ones((96, 140, 3)), bits=8),
        "expected the size of the pictures, 64x48.*found 140x96",
    ),
    "pandora: mixed sizes": (
        "pandora", lambda d: shutil.copy(
            write_hdr_of(d, 24, 32), d / "images_stokes" / "02_s0p1.hdr"
        ), "expected 64x48 pixels like 02_s0.hdr, found 32x24",
    ),
    "pandora: mask of another aspect": (
        "pandora", lambda d: write_picture(d / "mask" / "01.png", disc(48, 80).astype(float), bits=8),
        "mask of view 01: expected the aspect of the pictures, 64x48",
    ),
    "pandora: no files": (
        "pandora", lambda d: [p.unlink() for p in (d / "images_stokes").iterdir()], "the files of a pandora dataset"
    ),
    # NeRSP
    "nersp: whole numbers": (
        "nersp", lambda d: write_npy(d / "s0" / "0002.npy", np.ones((48, 64, 3), int)),
        "0002.npy: expected a picture of floating-point numbers .*int64",
    ),
    "nersp: two channels": (
        "nersp", lambda d: write_npy(d / "s0" / "0002.npy", np.ones((48, 64, 2))), "found an array 48x64x2"
    ),
    "nersp: mixed sizes": (
        "nersp", lambda d: write_npy(d / "s1" / "0002.npy", np.ones((24, 64, 3))), "expected 64x48 pixels like 0002.npy"
    ),
    "nersp: objects": (
        "nersp", lambda d: np.save(d / "s0" / "0002.npy", np.array([{}]), allow_pickle=True), "a complete .npy file"
    ),
    "nersp: no light": (
        "nersp", lambda d: [write_npy(p, np.zeros((48, 64, 3))) for p in d.glob("s?/*.npy")], "light in at least"
    ),
    "nersp: nothing finite": (
        "nersp", lambda d: [write_npy(p, np.full((48, 64, 3), np.nan)) for p in d.glob("s?/*.npy")], "expected light in"
    ),
    "nersp: missing part": ("nersp", lambda d: (d / "s2" / "0000.npy").unlink(), "s2 of view 0000, found nothing"),
    # NeISF
    "neisf: rows too few": ("neisf", rows(without), "expected the entry row 4 for view img_004"),
    "neisf: columns": ("neisf", rows(lambda r: r[:, :12]), "an array N x 17 .*found 4x12"),
    "neisf: nan": ("neisf", rows(put((1, 3), np.nan)), r"\(row 1\): expected finite numbers"),
    "neisf: no rotation": ("neisf", rows(put((2, 0), 5.0)), r"\(row 2\): expected a rotation"),
    "neisf: no size": ("neisf", rows(put((0, 4), 0.0)), "height, width and focal length in pixels, found 0, 64 and 90"),
    "neisf: negative focal": ("neisf", rows(put((3, 14), -1.0)), "found 48, 64 and -1"),
    # GNeRP
    "gnerp: broken json": ("gnerp", lambda d: (d / "cameras.json").write_text("{"), "JSON file, found broken"),
    "gnerp: bottomless json": ("gnerp", lambda d: (d / "cameras.json").write_text("[" * 100_000), "a JSON file"),
    "gnerp: a list": ("gnerp", lambda d: (d / "cameras.json").write_text("[]"), r"found \[\]"),
    "gnerp: degrees": ("gnerp", lambda d: multiply(d / "aop", 180 / np.pi), "expected angles in radians, found up to"),
    "gnerp: percent": ("gnerp", lambda d: multiply(d / "dop", 100.0), "from 0 to 1, found a median of"),
    "gnerp: no intrinsics": ("gnerp", cameras(lambda c: c.pop("intrinsic")), "expected the entry intrinsic"),
    "gnerp: no cameras": ("gnerp", cameras(lambda c: c.clear()), "expected the entry w2c_mat_<i>, found no entry"),
    "gnerp: a camera too few": ("gnerp", cameras(lambda c: c.pop("w2c_mat_2")), "the entry w2c_mat_2 for view 2"),
    "gnerp: words": ("gnerp", cameras(lambda c: c.update(w2c_mat_1="x")), r"\(w2c_mat_1\): .*something else"),
    "gnerp: ragged": ("gnerp", cameras(lambda c: c.update(w2c_mat_1=[[1], [2, 3]])), "something else"),
    "gnerp: scaled pose": (
        "gnerp", cameras(lambda c: c.update(w2c_mat_1=view(np.array(c["w2c_mat_1"])).tolist())), "expected a rotation"
    ),
    "gnerp: negative focal": (
        "gnerp", cameras(lambda c: c["intrinsic"][0].__setitem__(0, -5)), r"\(intrinsic\): .*positive focal"
    ),
    "gnerp: aop of three channels": (
        "gnerp", lambda d: write_npy(d / "aop" / "2.npy", np.ones((48, 64, 3))), "one channel, found an array 48x64x3"
    ),
    "gnerp: whole numbers": (
        "gnerp", lambda d: write_npy(d / "dop" / "2.npy", np.ones((48, 64), np.uint8)), "of uint8"
    ),
    "gnerp: mixed sizes": (
        "gnerp", lambda d: write_npy(d / "dop" / "2.npy", np.ones((24, 64), np.float32)), "64x48 pixels like 2.png"
    ),
    "gnerp: missing dop": ("gnerp", lambda d: (d / "dop" / "3.npy").unlink(), "expected the DoP of view 3"),
    # PISR
    "pisr: wrong keys": (
        "pisr", lambda d: np.savez(d / "intrinsics.npz", K=np.eye(3)), "expected the entry camera_matrix, found K"
    ),
    "pisr: coefficients": (
        "pisr", npz("intrinsics.npz", dist_coeffs=np.zeros(3)), "shape 4 or 5 or 8, found 3"
    ),
    "pisr: nan": ("pisr", npz("intrinsics.npz", dist_coeffs=np.full(5, np.nan)), "not finite"),
    "pisr: two gammas": ("pisr", lambda d: (d / "gamma2.txt").touch(), "expected one file called gamma<number>.txt"),
    "pisr: no gamma": ("pisr", lambda d: (d / "gamma1.txt").rename(d / "gammas.txt"), "found gammas.txt"),
    "pisr: no poses": ("pisr", lambda d: (d / "cameras_sphere.npz").unlink(), "sphere.npz: expected a readable"),
    "pisr: float raw": (
        "pisr", lambda d: write_npy(d / "raw" / "001.npy", np.ones((256, 306))), "of 8- or 16-bit whole numbers"
    ),
    "pisr: mixed sizes": (
        "pisr", lambda d: write_npy(d / "raw" / "001.npy", np.ones((128, 306), np.uint16)), "expected 306x256 pixels"
    ),
    "pisr: a camera too few": (
        "pisr", npz("cameras_sphere.npz", world_mat_0=None, scale_mat_0=None), "the entry world_mat_0 for view 000"
    ),
}  # fmt: skip


def multiply(folder: Path, factor: float) -> None:
    for path in folder.iterdir():
        np.save(path, np.load(path) * factor)


def write_hdr_of(root: Path, height: int, width: int) -> Path:
    from dataset_files import write_hdr

    write_hdr(root.parent / "small.hdr", np.full((height, width, 3), 0.5))
    return root.parent / "small.hdr"


@pytest.mark.parametrize("case", CELLS)
def test_datasets(tmp_path: Path, case: str) -> None:
    name, damage, message = CELLS[case]
    if name == "neisf":
        pytest.importorskip("OpenEXR")
    source = tmp_path / "eine quelle ü"
    WRITERS[name](source)
    damage(source)
    settings = replace(PLAIN, format=name, poses="auto" if "aspect" in case else "none")
    text = refused(source, tmp_path / "out", settings)
    assert re.search(message, text), text


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("nersp", {"sensor": "IMX250MYR"}, "--sensor: expected only flags that apply to the format nersp"),
        ("pandora", {"transfer": "srgb"}, "--transfer: .*rotating filters, single shots and gnerp"),
        ("pisr", {"align": False}, "--align: .*format pisr"),
        ("gnerp", {"bits": 12}, "--bits: .*format gnerp"),
        ("gnerp", {"calibration": Calibration(gains=(1, 1, 1, 1.1))}, r"calibration \(gains\): .*Stokes"),
        ("nersp", {"calibration": Calibration(sense="left")}, r"calibration \(sense\)"),
        ("nersp", {"format": "other"}, r"--format: expected .*mosaic.*pandora.*\"other\""),
        ("nersp", {"format": "pisr"}, "intrinsics.npz: expected a readable file"),
    ],
)
def test_flags(tmp_path: Path, name: str, changes: dict, message: str) -> None:
    WRITERS[name](tmp_path / "in")
    text = refused(tmp_path / "in", tmp_path / "out", replace(PLAIN, **changes))
    assert re.search(message, text), text


def test_poses_of_a_dataset_are_for_datasets(tmp_path: Path) -> None:
    from camera_files import write_mosaics

    write_mosaics(tmp_path / "in")
    settings = PrepareSettings(sensor="IMX250MYR", poses="dataset")
    assert "--poses: expected sfm, none" in refused(tmp_path / "in", tmp_path / "out", settings)
