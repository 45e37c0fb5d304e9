"""Values of options, and names that mean something to whoever shows them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

from base import MOSAICS, READ, TRAIN
from forked import Case
from making import PICTURE, Change
from making import more_case as case

SHARE = ["share", "run", "--out", "new.html"]


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
        yield case(f"option {name}", lambda f: None, command, reason)


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

    yield case("view with control characters and no pose", renamed(control), READ, check=no_control)
    yield case(
        "stranger with control characters",
        lambda f: shutil.copyfile(f / PICTURE, f / f"scene/polar/{control}.png"),
        READ,
        check=no_control,
    )
    yield case(
        "scene of control characters",
        lambda f: (f / "scene").rename(f / control),
        ["priors", control, *READ[2:]],
        "it is shown without them",
        check=no_control,
    )
    yield case(
        "option of control characters", lambda f: None, [*TRAIN, "--recipe", control], check=no_control
    )
    yield case("verb of control characters", lambda f: None, [control], check=no_control)
    script = "<script>alert(1)</script><img src=x onerror=alert(1)>"

    def no_script(*names: str) -> Change:
        def check(folder: Path) -> None:
            for name in names:
                for path in folder.glob(name):
                    shown = path.read_text(errors="replace")
                    assert "<script>alert(1)" not in shown, path
                    assert "<img src=x" not in shown, path

        return check

    yield case(
        "page of a hostile title",
        lambda f: None,
        [*SHARE, "--title", script, "--caption", "</title>" + script + "<!--"],
        "it is escaped",
        no_script("new.html"),
    )

    def hostile(folder: Path) -> None:
        (folder / "scene").rename(folder / "x<img src=x onerror=alert(1)>")

    yield case(
        "inspection of a hostile name",
        hostile,
        ["inspect", "x<img src=x onerror=alert(1)>", "--normals", "points", "--out", "new"],
        "it is escaped",
        no_script("new/*.html", "new/*.svg"),
    )

    def newline(folder: Path) -> None:
        for path in list((folder / "scene/polar").glob("v001_*")):
            path.rename(path.with_name(path.name.replace("v001", "v0\n01")))

    yield case("view of two lines", newline, READ)

    def long(folder: Path) -> None:
        name = "x" * 246
        for path in list((folder / "scene/polar").glob("v000_*")):
            path.rename(path.with_name(path.name.replace("v000", name)))
        text = folder / "scene/sparse/0/images.txt"
        text.write_text(text.read_text().replace("v000.png", f"{name}.png"))
        (folder / "scene/split.json").write_text(json.dumps({"test": [name]}))

    yield case(
        "view of the longest name",
        long,
        ["priors", "scene", "--out", "new", "--views", "x" * 246, "--threads", "1"],
    )
    yield case("option that begins like another", lambda f: None, ["train", "--", "--out", "new"])
