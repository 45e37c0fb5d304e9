# ruff: noqa: E501
"""Ways to spoil files: bytes, numbers in JSON, pictures, arrays and tensors, chosen by a seed."""

from __future__ import annotations

import json
import math
import os
import random
import struct
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

WORDS: list[Any] = [
    None, True, False, -1, 0, 1, 3, 1e308, -1e30, 1e30, 1e-300, math.nan, math.inf, -math.inf, 2**31, 2**63, 2**70, "", "x" * 5000,
    "../../outside/victim.txt", "/dev/zero", "[bold]x[/bold]", "[/]", "=1+1", "\u202e\x00\x1b[31m", "nan", "1.5", [], {}, [[]], [None],
    [1e30, math.nan], {"": ""},
]  # fmt: skip


def bytes_of(path: Path, rng: random.Random, how: str) -> None:
    """Spoil a file's bytes."""
    data = bytearray(path.read_bytes())
    size = max(1, len(data))
    if how == "cut":
        data = data[: rng.randrange(size)]
    elif how == "empty":
        data = bytearray()
    elif how == "garbage":
        data = bytearray(rng.randbytes(rng.randint(1, 400)))
    elif how == "flip":
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif how == "fill":
        at = rng.randrange(size)
        data[at : at + rng.choice((4, 8, 16))] = rng.choice((b"\xff", b"\x00", b"\x7f")) * 8
    elif how == "insert":
        at = rng.randrange(size)
        data[at:at] = rng.randbytes(rng.randint(1, 40))
    elif how == "append":
        data += rng.randbytes(rng.randint(1, 40))
    elif how == "twice":
        data = data + data
    path.write_bytes(bytes(data))


def place(path: Path, how: str) -> None:
    """Put something else in a file's place."""
    path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "pipe":
        os.mkfifo(path)
    elif how == "device":
        path.symlink_to("/dev/zero")
    elif how == "loop":
        path.symlink_to(path.name)
    elif how == "dangling":
        path.symlink_to("nowhere")
    elif how == "outside":
        path.symlink_to(Path("../../outside/victim.txt"))


def json_of(path: Path, rng: random.Random, how: str) -> None:
    """Spoil one value of a JSON file."""
    content = json.loads(path.read_text())
    if how == "nested":
        depth = rng.choice((60, 900, 3000, 100_000))
        inner = "[" * depth + "]" * depth
        key = json.dumps(rng.choice(list(content)) if isinstance(content, dict) else "x")
        path.write_text(f"{{{key}: {inner}}}")
        return
    places = list(_places(content, ()))
    keys = rng.choice(places)
    owner = content
    for key in keys[:-1]:
        owner = owner[key]
    if how == "removed":
        del owner[keys[-1]]
    elif how == "renamed" and isinstance(owner, dict):
        owner[str(keys[-1]) + "_"] = owner.pop(keys[-1])
    elif how == "near":
        old = owner[keys[-1]]
        number = isinstance(old, int | float) and not isinstance(old, bool)
        owner[keys[-1]] = rng.choice((-old, old * 1e9, old + 0.5, str(old))) if number else [old]
    else:
        owner[keys[-1]] = rng.choice(WORDS)
    path.write_text(json.dumps(content))


def _places(value: Any, before: tuple[Any, ...]) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*before, key)
        yield from _places(inner, (*before, key))


def json_field(path: Path, keys: tuple[Any, ...], value: Any) -> None:
    """Set one value of a JSON file."""
    content = json.loads(path.read_text())
    owner = content
    for key in keys[:-1]:
        owner = owner[key]
    owner[keys[-1]] = value
    path.write_text(json.dumps(content))


def picture(path: Path, rng: random.Random, how: str) -> None:
    """A whole picture with other content."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if how == "black":
        pixels = np.zeros_like(pixels)
    elif how == "white":
        pixels = np.full_like(pixels, np.iinfo(pixels.dtype).max)
    elif how == "gray":
        pixels = pixels if pixels.ndim == 2 else pixels[..., 1]
    elif how == "small":
        pixels = pixels[: rng.randint(1, len(pixels) - 1)]
    elif how == "wide":
        pixels = np.concatenate((pixels, pixels), axis=1)
    elif how == "turned":
        pixels = np.rot90(pixels)
    elif how == "8 bits":
        pixels = (pixels // 257 if pixels.dtype == np.uint16 else pixels).astype(np.uint8)
        pixels = pixels[..., :2] if rng.random() < 0 else pixels
    elif how == "noise":
        pixels = np.random.default_rng(rng.randrange(2**31)).integers(
            0, np.iinfo(pixels.dtype).max, pixels.shape, dtype=pixels.dtype
        )
    elif how == "floats":
        cv2.imwrite(str(path.with_suffix(".tif")), pixels.astype(np.float32))
        path.unlink()
        return
    elif how == "huge":
        assert cv2.imwrite(str(path), np.zeros((12000, 12000), np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return
    elif how == "animated":
        path.write_bytes(b"GIF89a" + rng.randbytes(60))
        return
    else:
        raise ValueError(how)
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels))


def big_tiff(path: Path, width: int, height: int) -> None:
    """A BigTIFF of a few bytes that says how large it is."""
    tags = [(256, 4, width), (257, 4, height), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 16, 16), (277, 3, 1), (278, 4, height),
            (279, 16, 64)]  # fmt: skip
    data = struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) + struct.pack("<Q", len(tags))
    for tag, kind, value in tags:
        data += struct.pack("<HHQQ", tag, kind, 1, value)
    path.write_bytes(data + bytes(72))


def archive(path: Path, rng: random.Random, how: str) -> None:
    """Spoil an .npz file."""
    arrays = dict(np.load(path))
    name = rng.choice(sorted(arrays))
    value = arrays[name]
    if how == "not finite":
        value = value.astype(np.float32)
        value.reshape(-1)[rng.randrange(value.size)] = rng.choice((math.nan, math.inf))
    elif how == "other shape":
        value = value[: rng.randrange(len(value))]
    elif how == "other type":
        value = value.astype(rng.choice(("complex64", "U3", "datetime64[s]")))
    elif how == "objects":
        value = np.array([{"a": 1}], dtype=object)
    elif how == "bomb":
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
            file.open("normal.npy", "w", force_zip64=True) as member,
        ):
            np.lib.format.write_array_header_1_0(
                member, {"descr": "<f4", "fortran_order": False, "shape": (1 << 20, 300, 3)}
            )  # type: ignore
            for _ in range(450):
                member.write(bytes(1 << 23))
        return
    elif how == "header":
        with zipfile.ZipFile(path, "w") as file, file.open("normal.npy", "w") as member:
            np.lib.format.write_array_header_1_0(
                member, {"descr": "<f4", "fortran_order": False, "shape": (1 << 40, 1 << 20)}
            )  # type: ignore
        return
    elif how == "encrypted":
        np.savez(path, **arrays)
        data = bytearray(path.read_bytes())
        for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            found = data.find(mark)
            while found >= 0:
                data[found + at] |= 1
                found = data.find(mark, found + 4)
        path.write_bytes(bytes(data))
        return
    elif how == "zeros":
        value = np.zeros_like(value)
    np.savez_compressed(path, **{**arrays, name: value})


def tensors(path: Path, rng: random.Random, how: str) -> None:
    """Spoil one tensor of a checkpoint."""
    import torch
    from safetensors.torch import load_file, save_file

    whole = load_file(path)
    name = rng.choice(sorted(whole))
    value = whole[name]
    if how == "missing":
        del whole[name]
    elif how == "not finite":
        name = rng.choice(sorted(key for key, t in whole.items() if t.is_floating_point()))
        whole[name].view(-1)[rng.randrange(whole[name].numel())] = rng.choice((math.nan, math.inf))
    elif how == "shorter":
        whole[name] = value.reshape(-1)[: max(0, value.numel() - rng.randint(1, 5))].clone()
    elif how == "longer":
        whole[name] = torch.cat((value.reshape(-1), value.reshape(-1))).clone()
    elif how == "axis":
        whole[name] = value[None].clone()
    elif how == "type":
        whole[name] = value.to(rng.choice((torch.float64, torch.float16, torch.int32, torch.uint8)))
    elif how == "huge":
        name = rng.choice(sorted(key for key in whole if key.startswith("gaussians.")))
        whole[name].view(-1)[rng.randrange(whole[name].numel())] = rng.choice((-1, 1)) * 3e38
    elif how == "stranger":
        whole["../" + name] = value.clone()
    elif how == "none":
        whole = {
            key: (t[:0].clone() if t.ndim and t.shape[:1] == whole["gaussians.means"].shape[:1] else t)
            for key, t in whole.items()
        }
    save_file(whole, path)
