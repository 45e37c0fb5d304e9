"""Random ways to spoil files: bytes, numbers in JSON, pictures, arrays, tensors. ``random`` is seeded with the case."""

from __future__ import annotations

import importlib
import json
import math
import random
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from base import CHECKPOINT
from changes import deferred

BYTES = ("cut", "empty", "garbage", "flip", "fill", "insert", "append", "twice")
FIELDS = ("value", "removed", "renamed", "near", "nested")
PICTURES = (
    "black",
    "white",
    "gray",
    "small",
    "wide",
    "turned",
    "8 bits",
    "noise",
    "floats",
    "huge",
    "animated",
)
ARRAYS = ("not finite", "other shape", "other type", "objects", "bomb", "header", "encrypted", "zeros")
TENSORS = ("missing", "not finite", "shorter", "longer", "axis", "type", "huge", "stranger", "none")
WORDS: list[Any] = [
    None, True, False, -1, 0, 1, 3, 1e308, -1e30, 1e30, 1e-300, math.nan, math.inf, -math.inf, 2**31, 2**63, 2**70, "",
    "x" * 5000, "../../outside/victim.txt", "/dev/zero", "[bold]x[/bold]", "[/]", "=1+1", "\u202e\x00\x1b[31m", "nan",
    "1.5", [], {}, [[]], [None], [1e30, math.nan], {"": ""},
]  # fmt: skip


def _bytes(data: bytearray, how: str) -> bytes:
    size = max(1, len(data))
    at = random.randrange(size)
    if how == "cut":
        return data[:at]
    if how == "empty":
        return b""
    if how == "garbage":
        return random.randbytes(random.randint(1, 400))
    if how == "flip":
        for _ in range(random.randint(1, 8)):
            data[random.randrange(size)] ^= 1 << random.randrange(8)
    elif how == "fill":
        data[at : at + random.choice((4, 8, 16))] = random.choice((b"\xff", b"\x00", b"\x7f")) * 8
    elif how == "insert":
        data[at:at] = random.randbytes(random.randint(1, 40))
    elif how == "append":
        data += random.randbytes(random.randint(1, 40))
    else:
        assert how == "twice", how
        return bytes(data) * 2
    return bytes(data)


@deferred
def bytes_of(path: str, how: str) -> None:
    """Spoil a file's bytes."""
    Path(path).write_bytes(_bytes(bytearray(Path(path).read_bytes()), how))


@deferred
def json_of(path: str, how: str = "") -> None:
    """Spoil one value of a JSON file, in a way that is drawn where none is given."""
    content = json.loads(Path(path).read_text())
    Path(path).write_text(_spoiled(content, how or random.choice(FIELDS)))


def _spoiled(content: Any, how: str) -> str:
    if how == "nested":
        depth = random.choice((60, 900, 3000, 100_000))
        key = random.choice(list(content)) if isinstance(content, dict) else "x"
        return f"{{{json.dumps(key)}: {'[' * depth + ']' * depth}}}"
    *above, key = random.choice(list(_places(content, ())))
    owner = content
    for step in above:
        owner = owner[step]
    old = owner[key]
    if how == "removed":
        del owner[key]
    elif how == "renamed" and isinstance(owner, dict):
        owner[f"{key}_"] = owner.pop(key)
    elif how == "near":
        number = isinstance(old, int | float) and not isinstance(old, bool)
        owner[key] = random.choice((-old, old * 1e9, old + 0.5, str(old))) if number else [old]
    else:
        owner[key] = random.choice(WORDS)
    return json.dumps(content)


def _places(value: Any, before: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*before, key)
        yield from _places(inner, (*before, key))


def _noise(pixels: np.ndarray) -> np.ndarray:
    draw = np.random.default_rng(random.randrange(2**31))
    return draw.integers(0, np.iinfo(pixels.dtype).max, pixels.shape, dtype=pixels.dtype)


CONTENT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "black": np.zeros_like,
    "white": lambda pixels: np.full_like(pixels, np.iinfo(pixels.dtype).max),
    "gray": lambda pixels: pixels if pixels.ndim == 2 else pixels[..., 1],
    "small": lambda pixels: pixels[: random.randint(1, len(pixels) - 1)],
    "wide": lambda pixels: np.concatenate((pixels, pixels), axis=1),
    "turned": np.rot90,
    "8 bits": lambda pixels: (pixels // 257 if pixels.dtype == np.uint16 else pixels).astype(np.uint8),
    "noise": _noise,
    "huge": lambda pixels: np.zeros((12000, 12000), np.uint8),
}


@deferred
def picture(path: str, how: str) -> None:
    """A whole picture with other content."""
    if how == "animated":
        Path(path).write_bytes(b"GIF89a" + random.randbytes(60))
        return
    pixels = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    if how == "floats":
        cv2.imwrite(str(Path(path).with_suffix(".tif")), pixels.astype(np.float32))
        Path(path).unlink()
        return
    written = np.ascontiguousarray(CONTENT[how](pixels))
    assert cv2.imwrite(path, written, [cv2.IMWRITE_PNG_COMPRESSION, 1])


@deferred
def archive(path: str, how: str) -> None:
    """Spoil an .npz file."""
    if how in ("bomb", "header"):
        shape, blocks = ((1 << 20, 300, 3), 450) if how == "bomb" else ((1 << 40, 1 << 20), 0)
        _promise(path, shape, blocks)
        return
    arrays = dict(np.load(path))
    name = random.choice(sorted(arrays))
    value = arrays[name]
    if how == "not finite":
        value = value.astype(np.float32)
        value.reshape(-1)[random.randrange(value.size)] = random.choice((math.nan, math.inf))
    elif how == "other shape":
        value = value[: random.randrange(len(value))]
    elif how == "other type":
        value = value.astype(random.choice(("complex64", "U3", "datetime64[s]")))
    elif how == "objects":
        value = np.array([{"a": 1}], dtype=object)
    elif how == "zeros":
        value = np.zeros_like(value)
    np.savez_compressed(path, **{**arrays, name: value})
    if how == "encrypted":
        _encrypt(Path(path))


def _promise(path: str, shape: tuple[int, ...], blocks: int) -> None:
    """An array of a shape, and so many blocks of 8 MiB of it."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("normal.npy", "w", force_zip64=True) as member,
    ):
        head = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(member, head)  # type: ignore[arg-type]
        for _ in range(blocks):
            member.write(bytes(1 << 23))


def _encrypt(path: Path) -> None:
    """Say of every member of a zip file that it is encrypted."""
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        found = data.find(mark)
        while found >= 0:
            data[found + at] |= 1
            found = data.find(mark, found + 4)
    path.write_bytes(bytes(data))


@deferred
def checkpoint(how: str, path: str = CHECKPOINT) -> None:
    """Spoil one tensor of a checkpoint."""
    torch, files = importlib.import_module("torch"), importlib.import_module("safetensors.torch")
    whole = files.load_file(path)
    kinds = {"not finite": [k for k, t in whole.items() if t.is_floating_point()],
             "huge": [k for k in whole if k.startswith("gaussians.")]}  # fmt: skip
    name = random.choice(sorted(kinds.get(how, whole)))
    value = whole[name]
    if how == "missing":
        del whole[name]
    elif how in ("not finite", "huge"):
        numbers = (math.nan, math.inf) if how == "not finite" else (-3e38, 3e38)
        value.view(-1)[random.randrange(value.numel())] = random.choice(numbers)
    elif how == "shorter":
        whole[name] = value.reshape(-1)[: max(0, value.numel() - random.randint(1, 5))].clone()
    elif how == "longer":
        whole[name] = torch.cat((value.reshape(-1), value.reshape(-1))).clone()
    elif how == "axis":
        whole[name] = value[None].clone()
    elif how == "type":
        whole[name] = value.to(random.choice((torch.float64, torch.float16, torch.int32, torch.uint8)))
    elif how == "stranger":
        whole["../" + name] = value.clone()
    else:
        assert how == "none", how
        whole = without_gaussians(whole)
    files.save_file(whole, path)


def without_gaussians(whole: dict[str, Any]) -> dict[str, Any]:
    """The tensors of a checkpoint, without a row for any Gaussian."""
    count = whole["gaussians.means"].shape[:1]
    return {key: t[:0].clone() if t.ndim and t.shape[:1] == count else t for key, t in whole.items()}
