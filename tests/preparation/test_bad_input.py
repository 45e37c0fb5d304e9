"""Source format x damage: every cell is one clear message, in finite time, and leaves no scene that looks whole."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from camera_files import behind, smooth_light, write_model, write_mosaic, write_mosaics, write_shots
from camera_files import mosaic as seen_through
from damage import EVERYWHERE, colmap_binary, duplicate, patched
from dataset_files import write_gnerp, write_neisf, write_nersp, write_pandora, write_pisr
from refused_preparations import refused_in_one_line as refused

from polarguide.core import files
from polarguide.geometry.polarizer import ANGLES
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

# The light of these tests has no outlines: nothing tells the sense of NeRSP's and NeISF's angles.
pytestmark = pytest.mark.filterwarnings("ignore:The sense of .* is uncertain")
PLAIN = PrepareSettings(poses="none", gains="none")
MOSAIC = replace(PLAIN, sensor="IMX250MYR")
COLOR = ("R90 R45 G90 G45", "R135 R0 G135 G0", "G90 G45 B90 B45", "G135 G0 B135 B0")


@dataclass(frozen=True)
class Kind:
    """A source: how it is written, how it is asked for, and the file that is damaged."""

    write: Callable[[Path], object]
    settings: PrepareSettings
    target: str


def write_raw(root: Path) -> None:
    for name in ("a", "b"):
        write_mosaic(root / f"{name}.12p.raw", seen_through(behind(smooth_light()), COLOR), bits=12)


def write_dngs(root: Path) -> None:
    pytest.importorskip("rawpy")
    pytest.importorskip("tifffile")
    from raw_photographs import write_dng

    for angle, values in zip(ANGLES, behind(smooth_light()), strict=True):
        write_dng(root / str(angle) / "v.dng", values)


def write_filter(suffix: str) -> Callable[[Path], object]:
    def write(root: Path) -> None:
        for view in "ab":
            write_shots(root, view, behind(smooth_light()), suffix=suffix, bits=8)

    return write


def write_exr(root: Path) -> None:
    pytest.importorskip("OpenEXR")
    write_neisf(root)


KINDS = {
    "mosaic png": Kind(write_mosaics, MOSAIC, "v001.png"),
    "mosaic npy": Kind(lambda root: write_mosaics(root, suffix=".npy"), MOSAIC, "v001.npy"),
    "mosaic raw": Kind(write_raw, replace(MOSAIC, packing="12p", width=64, height=48), "b.12p.raw"),
    "filter png": Kind(write_filter(".png"), replace(PLAIN, align=False), "45/b.png"),
    "filter jpg": Kind(write_filter(".jpg"), replace(PLAIN, align=False), "45/b.jpg"),
    "filter dng": Kind(write_dngs, replace(PLAIN, align=False), "45/v.dng"),
    "pandora": Kind(write_pandora, PLAIN, "images_stokes/02_s0p1.hdr"),
    "pandora cameras": Kind(write_pandora, PLAIN, "cameras.npz"),
    "pisr": Kind(write_pisr, PLAIN, "raw/001.npy"),
    "nersp": Kind(write_nersp, PLAIN, "s2/0001.npy"),
    "nersp masks": Kind(write_nersp, PLAIN, "input_azimuth_maps/0001.png"),
    "neisf": Kind(write_exr, PLAIN, "images_s1/img_002.exr"),
    "neisf cameras": Kind(write_exr, PLAIN, "poses_bounds.npy"),
    "gnerp": Kind(write_gnerp, PLAIN, "images/1.png"),
    "gnerp aop": Kind(write_gnerp, PLAIN, "aop/1.npy"),
}
NO_BOMB = ("mosaic raw", "filter dng", "pandora cameras")
CELLS = [
    (kind, damage) for kind in KINDS for damage in EVERYWHERE
    if damage != "picture bomb" or kind not in NO_BOMB
]  # fmt: skip


@pytest.mark.parametrize(("kind", "damage"), CELLS)
def test_damaged_files(tmp_path: Path, kind: str, damage: str) -> None:
    case, (spoil, message) = KINDS[kind], EVERYWHERE[damage]
    source = tmp_path / "räume und zeit"  # with blanks and umlauts, for every message
    case.write(source)
    target = source / case.target
    spoil(target)
    text = refused(source, tmp_path / "out", case.settings)
    assert target.name in text or target.stem in text or target.parent.name in text, text
    assert re.search(message, text), text


@pytest.mark.parametrize("kind", KINDS)
def test_unreadable_files(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may read everything, so the refusal of the system is put in."""
    case = KINDS[kind]
    case.write(tmp_path / "in")
    target, read = tmp_path / "in" / case.target, Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        if path == target:
            raise PermissionError(errno.EACCES, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    text = refused(tmp_path / "in", tmp_path / "out", case.settings)
    assert f"{target}: expected a readable file, found Permission denied" in text


WHOLE = [kind for kind in KINDS if " c" not in kind and "mask" not in kind and "aop" not in kind]


@pytest.mark.parametrize("kind", WHOLE)
@pytest.mark.parametrize(("code", "said"), [(errno.ENOSPC, "No space left"), (errno.EROFS, "Read-only")])
def test_full_and_read_only_disks(
    tmp_path: Path, kind: str, code: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = KINDS[kind]
    case.write(tmp_path / "in")
    replace_file, count = os.replace, [0]

    def fail(source: str, target: str) -> None:
        count[0] += 1
        if count[0] > 4:
            raise OSError(code, os.strerror(code))
        replace_file(source, target)

    monkeypatch.setattr(files.os, "replace", fail)
    text = refused(tmp_path / "in", tmp_path / "out", case.settings)
    assert said in text
    assert "goes on where it stopped" in text
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.parametrize("kind", WHOLE)
def test_blanks_and_umlauts_work(tmp_path: Path, kind: str) -> None:
    source, out = tmp_path / "größe & zeit" / "ä b", tmp_path / "eine szene ü"
    KINDS[kind].write(source)
    assert len(prepare_scene(source, out, KINDS[kind].settings).views) >= 1
    assert (out / "scene.json").exists()


@pytest.mark.parametrize("kind", ["mosaic png", "mosaic npy", "filter png", "filter jpg", "gnerp"])
def test_duplicates(tmp_path: Path, kind: str) -> None:
    case = KINDS[kind]
    case.write(tmp_path / "in")
    duplicate(tmp_path / "in" / case.target)
    assert re.search(
        r"expected one (file called \w+|picture of \w+ at \d+ degrees), found",
        refused(tmp_path / "in", tmp_path / "out", case.settings),
    )


COLMAP: dict[str, tuple[str, Callable[[Path], None], str]] = {
    f"{damage}: {name}": (name, spoil, rf"{name}: .*({message}|a damaged one|bytes where its counts)")
    for damage, (spoil, message) in EVERYWHERE.items()
    for name in ("cameras.bin", "images.bin", "points3D.bin")
    if damage in ("truncated", "zero bytes", "garbage", "a pipe")
} | {
    "images that go on for ever": ("images.bin", patched(0, "<Q", 1 << 62), "count of 4611686018427387904"),
    "points that go on for ever": ("points3D.bin", patched(0, "<Q", 1 << 62), "too many for"),
    "a track that goes on for ever": ("points3D.bin", patched(51, "<Q", 1 << 60), "too many for"),
    "a picture of no size": ("cameras.bin", patched(16, "<QQ", 0, 0), "a camera of 0x0 pixels"),
    "another camera": ("images.bin", patched(72, "<I", 9), "COLMAP|cannot read"),
    "an unknown model": ("cameras.bin", patched(12, "<i", 99), "cannot read"),
    "a nan pose": ("images.bin", patched(12, "<d", float("nan")), "an image whose pose is not finite"),
    "an infinite place": ("images.bin", patched(44, "<d", float("inf")), "an image whose pose is not finite"),
    "a zero quaternion": ("images.bin", patched(12, "<d", 0.0), "a quaternion of length 1, found one of length 0"),
    "a negative focal length": ("cameras.bin", patched(32, "<dd", -80, -80), "positive focal"),
    "no cameras": ("cameras.bin", lambda path: path.unlink(), "expected a COLMAP model"),
    "no images": ("images.bin", lambda path: path.unlink(), "images.bin: expected this file of the COLMAP model"),
    "more than there should be": (
        "cameras.bin", lambda path: path.write_bytes(path.read_bytes() + b"x"), "bytes instead of"
    ),
}  # fmt: skip


TEXT: dict[str, tuple[str, str, str]] = {
    "no words": ("cameras.txt", "", "cameras.txt: .*an empty file"),
    "no images": ("images.txt", "", "images.txt: .*an empty file"),
    "other words": ("cameras.txt", "hello there\n", "COLMAP model|images called|finite|cannot read"),
    "an unknown model": ("cameras.txt", "1 HOLE 64 48 80 82 32 24\n", "cannot read"),
    "parameters too few": ("cameras.txt", "1 PINHOLE 64 48 80 82\n", "COLMAP model|cannot read|finite"),
    "no size": ("cameras.txt", "1 PINHOLE 0 0 80 82 32 24\n", "expected the size of the pictures, 32x24.* found 0x0"),
    "negative size": ("cameras.txt", "1 PINHOLE -64 -48 80 82 32 24\n", "expected the size|cannot read|positive"),
    "words for numbers": ("images.txt", "1 one 0 0 0 0 0 2 1 v000.png\n\n", "cannot read|finite|images called"),
    "a line cut short": ("images.txt", "1 1 0 0 0 0 0\n\n", "cannot read|images called|COLMAP model"),
    "another camera": ("images.txt", "1 1 0 0 0 0 0 2 7 v000.png\n\n", "cannot read"),
    "two of a name": (
        "images.txt", "1 1 0 0 0 0 0 2 1 a/v000.png\n\n2 1 0 0 0 0 0 2 1 b/v000.jpg\n\n", "one image called v000"
    ),
    "strangers": ("images.txt", "1 1 0 0 0 0 0 2 1 other.png\n\n", "expected images named like the views"),
    "a nan pose": ("images.txt", "1 nan 0 0 0 0 0 2 1 v000.png\n\n", "a pose and a lens of|cannot read"),
    "an infinite place": ("images.txt", "1 1 0 0 0 inf 0 2 1 v000.png\n\n", "a pose and a lens of|cannot read"),
}  # fmt: skip


@pytest.mark.parametrize("case", TEXT)
def test_colmap_text_models(tmp_path: Path, case: str) -> None:
    name, text, message = TEXT[case]
    write_mosaics(tmp_path / "in")
    model = write_model(tmp_path / "model", ("v000", "v001", "v002"), "PINHOLE 64 48 80 82 32 24")
    (model / name).write_text(text)
    said = refused(tmp_path / "in", tmp_path / "out", replace(MOSAIC, poses=str(model)))
    assert re.search(message, said), said


@pytest.mark.parametrize("case", COLMAP)
def test_colmap_models(tmp_path: Path, case: str) -> None:
    name, spoil, message = COLMAP[case]
    write_mosaics(tmp_path / "in")
    model = colmap_binary(tmp_path / "ein modell ü")
    spoil(model / name)
    text = refused(tmp_path / "in", tmp_path / "out", replace(MOSAIC, poses=str(model)))
    assert re.search(message, text), text
