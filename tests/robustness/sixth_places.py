"""Places that lead elsewhere, pipes, options, and variables of the environment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from base import FLAGS, READ, SHOTS, TRAIN
from corpus_shots import OF_SENSOR
from fifth_runs import RENDER, export
from further_records import RUNS
from making import SAME, Change, MadeCase, link, made_case, nothing, put

FILM = ["render", "run", "--path", "orbit", "--frames", "2", "--layers", "final", *RUNS]
MAPS = ["priors", "shots", "--out", "new", "--no-align", "--formats", "npy", *RUNS]


def _two_links(folder: Path) -> None:
    link("new/other")(folder)
    link("new/v000", "other")(folder)


def _mine(folder: Path) -> None:
    (folder / "new").mkdir()
    (folder / "new/table.csv").write_text("mine")


def _still_mine(folder: Path) -> None:
    assert (folder / "new/table.csv").read_text() == "mine"


def _no_film_in_the_scene(folder: Path) -> None:
    assert not list((folder / "scene").rglob("path_*")) + list((folder / "scene").rglob("*.mp4"))


def link_cases() -> Iterator[MadeCase]:
    """What is written goes nowhere but where it was asked to go."""
    for name, change, command in (
        ("maps of shots through a link", link("new/v000", "../../../outside"), MAPS),
        ("maps of shots through two links", _two_links, MAPS),
        ("maps of a scene through a link", link("new/v001", "../../../outside"), [*READ, "--formats", "npy"]),
        ("a film through a link", link("run/render", "../../outside"), FILM),
        ("pictures through a link", link("run/render", "../../outside"), ["render", "run", *RUNS]),
        ("files of other programs through a link", link("run/export", "../../outside"), export("ply")[:4]),
    ):
        yield made_case(f"sixth place: {name}", change, command)
    for name, out in (
        ("a film into a scene", ["--out", "scene"]),
        ("a film among the pictures of a scene", ["--video", "scene/polar/film.mp4"]),
    ):
        yield made_case(f"sixth place: {name}", nothing, [*FILM, *out], "", _no_film_in_the_scene)
    yield made_case("sixth place: a table over another's", _mine, OF_SENSOR, "", _still_mine)
    yield made_case(
        "sixth place: a table over another's, as asked", _mine, [*OF_SENSOR, "--overwrite"], "it is asked for"
    )
    yield made_case(
        "sixth place: a page over a link", link("new.html"), ["share", "run", "--out", "new.html"], SAME
    )
    for verb, command in (
        ("train", [*TRAIN[:3], "calibration.json", *TRAIN[4:]]),
        ("compare", ["compare", "scene", "--recipes", "3dgs", "--steps", "2", "--out", "calibration.json"]),
    ):
        says = "a folder to write"
        yield made_case(f"sixth place: a file, to {verb} into", nothing, command, says=says)
    yield made_case(
        "sixth place: a folder called like an option",
        nothing,
        ["train", "scene", "--out", "scene", *TRAIN[4:]],
        says=r"^error: scene: expected a folder for what is written",
    )


def pipe_cases() -> Iterator[MadeCase]:
    """Pipes into which nobody writes."""
    pipe = put("calibration.json", "pipe")
    for name, command in (
        ("prepare", SHOTS),
        ("priors", MAPS),
        ("measure", ["measure", "shots", "--out", "new", "--no-align", *RUNS]),
        ("inspect", ["inspect", "prepared", "--normals", "points", "--out", "new", *RUNS]),
    ):
        given = [*command, "--calibration", "calibration.json"]
        yield made_case(f"sixth pipe for a calibration, to {name}", pipe, given, says="a pipe or device")


def option_cases() -> Iterator[MadeCase]:
    """Options that would be taken for something else."""
    view = [*TRAIN, "--viewer"]
    for name, command, says in (
        ("a pattern of hosts", [*view, "--allow-host", "*"], "--allow-host: expected a name"),
        ("two hosts in one", [*view, "--allow-host", "a b"], "--allow-host: expected a name"),
        ("an address that is none", [*view, "--viewer-host", "no.such.host.invalid"], "viewer's host"),
        ("an order of a hundred thousand angles", [*SHOTS, "--order", "0" + ",0" * 100_000], r"\A.{,1000}\Z"),
        ("white of 1_0", ["present", "run", "--white-balance", "1_0,1,1"], ""),
        ("a length of other digits", ["present", "run", "--white-balance", "\uff11,1,1"], ""),
    ):
        yield made_case(f"sixth option: {name}", nothing, command, says=says)


def _variables(**values: str) -> Change:
    def change(folder: Path) -> None:
        os.environ.update(values)

    return change


def variable_cases() -> Iterator[MadeCase]:
    """Variables that libraries read before anything can be said about them."""
    for name, change, accepted in (
        ("a billion threads", _variables(POLARGUIDE_THREADS="1000000000"), ""),
        ("pixels in words for OpenCV", _variables(OPENCV_IO_MAX_IMAGE_PIXELS="many"), ""),
        ("a width below 0 for OpenCV", _variables(OPENCV_IO_MAX_IMAGE_WIDTH="-1"), ""),
        ("a size with its unit for OpenCV", _variables(OPENCV_IO_MAX_IMAGE_PIXELS="64MB"), SAME),
    ):
        yield made_case(f"sixth variable: {name}", change, READ, accepted)
    yield made_case(
        "sixth variable: a rank of words", _variables(RANK="first"), [*TRAIN[:4], "--steps", "2", *FLAGS]
    )
    yield made_case(
        "sixth option: a layer that there is not", nothing, [*RENDER[:4], "--layers", "final,x", *RUNS]
    )
