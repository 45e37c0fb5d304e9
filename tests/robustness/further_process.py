# ruff: noqa: E501
"""What a process is given by its machine: limits, an environment, rights, and a current folder that goes away."""

from __future__ import annotations

import os
import resource
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from base import EVAL, MOSAICS, READ, RESUME, TRAIN
from further_folders import MEASURE
from making import MOSAIC, Change, MadeCase, made_case

NOBODY = 65534
WORKS = "it works all the same"
SHARE = ["share", "run", "--out", "new.html", "--threads", "1"]


def process_cases() -> Iterator[MadeCase]:
    """All of them."""

    def limit(kind: int, value: int) -> Change:
        return lambda folder: resource.setrlimit(kind, (value, value))

    def environment(**changed: str | None) -> Change:
        def change(folder: Path) -> None:
            for name, value in changed.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value

        return change

    def nobody(*closed: str, mode: int = 0) -> Change:
        """As a user without rights, for whom some places are closed."""

        def change(folder: Path) -> None:
            for path in [folder, *folder.rglob("*")]:
                if not path.is_symlink():
                    os.chown(path, NOBODY, NOBODY)
            for name in closed:
                os.chmod(folder / name, mode)
            os.setgid(NOBODY)
            os.setuid(NOBODY)

        return change

    read_only = stat.S_IRUSR | stat.S_IXUSR
    for name, change, command, reason in (
        ("with 32 files open at most, training", limit(resource.RLIMIT_NOFILE, 32), TRAIN, WORKS),
        ("with 32 files open at most, measuring", limit(resource.RLIMIT_NOFILE, 32), MEASURE, WORKS),
        ("with 8 files open at most", limit(resource.RLIMIT_NOFILE, 8), MOSAICS, WORKS),
        ("with files of 400 bytes", limit(resource.RLIMIT_FSIZE, 400), MEASURE, ""),
        ("with little more memory, training", _memory(64), TRAIN, WORKS),
        ("with no more memory, preparing", _memory(1), MOSAICS, WORKS),
        ("with no more memory, sharing", _memory(1), SHARE, ""),
        ("with no more memory and a large mosaic", _large(_memory(256)), MOSAICS, ""),
        ("with no more memory and a large measured mosaic", _large(_memory(256)), MEASURE, ""),
        ("with no more processes", limit(resource.RLIMIT_NPROC, 0), EVAL, WORKS),
        ("with a stack of 256 KiB", limit(resource.RLIMIT_STACK, 1 << 18), MOSAICS, WORKS),
        ("without HOME", environment(HOME=None, XDG_CACHE_HOME=None), EVAL, WORKS),
        ("with a HOME that is no folder", environment(HOME="/dev/null", XDG_CACHE_HOME="/dev/null"), EVAL, WORKS),
        ("without a folder for what is temporary", environment(TMPDIR="/nowhere"), EVAL, WORKS),
        ("without a folder for what is temporary, exporting SPZ", environment(TMPDIR="/nowhere"), ["export", "run", "--format", "spz", "--out", "new"], WORKS),
        ("with threads in words", environment(POLARGUIDE_THREADS="many", OMP_NUM_THREADS="x"), READ, WORKS),
        ("with a terminal of no columns", environment(COLUMNS="0", LINES="-1", TERM=""), EVAL, WORKS),
        ("with columns in words", environment(COLUMNS="wide", TERM="\x1b"), EVAL, WORKS),
        ("with ranks in words", environment(RANK="first", WORLD_SIZE="many", LOCAL_RANK="x"), TRAIN, ""),
        ("with a world of 10^9", environment(RANK="0", WORLD_SIZE="1000000000", LOCAL_RANK="0", MASTER_ADDR="127.0.0.1", MASTER_PORT="0"), TRAIN, ""),
        ("without rights to a mosaic", nobody(MOSAIC), MOSAICS, ""),
        ("without rights to the source", nobody("mosaics"), MOSAICS, ""),
        ("without rights to list the source", nobody("mosaics", mode=stat.S_IXUSR), MOSAICS, ""),
        ("without rights to write here", nobody(".", mode=read_only), MOSAICS, ""),
        ("without rights to write a table", nobody(".", mode=read_only), MEASURE, ""),
        ("without rights to write a run", nobody("run", mode=read_only), EVAL, ""),
        ("without rights to write a run, going on", nobody("run", mode=read_only), RESUME, ""),
        ("without rights to a page", nobody(".", mode=read_only), SHARE, ""),
        ("without rights to a scene", nobody("scene"), TRAIN, ""),
        ("without rights to its pictures", nobody("scene/polar"), TRAIN, ""),
        ("without rights to its model", nobody("scene/sparse/0"), TRAIN, ""),
        ("without rights to its masks", nobody("scene/masks"), TRAIN, ""),
        ("without rights to its split", nobody("scene/split.json"), TRAIN, ""),
        ("without rights to a checkpoint", nobody("run/checkpoint.safetensors"), EVAL, ""),
        ("without rights to a run.json", nobody("run/run.json"), EVAL, ""),
        ("without rights to a presentation", _closed_presentation(nobody("run/presentation.json")), SHARE, ""),
        ("without rights to a calibration", nobody("calibration.json"), [*MOSAICS, "--calibration", "calibration.json"], ""),
        ("without rights to a model", nobody("model"), [*MOSAICS[:-1], "model"], ""),
        ("without rights to a lock", _locked(nobody("run/.lock")), RESUME, ""),
        ("in a folder that is no more", _removed, ["train", "scene", *TRAIN[2:]], ""),
        ("given empty names", lambda f: None, ["train", "scene", "--out=", *TRAIN[4:]], ""),
        ("in a folder that is no more, with no verb", _removed, ["--help"], WORKS),
        ("without an input", lambda f: os.close(0), MOSAICS, WORKS),
        ("without an output", lambda f: os.dup2(os.open("/dev/full", os.O_WRONLY), 1), MEASURE, ""),
        ("while another writes the run", _held("run/.lock"), RESUME, ""),
        ("while another writes the table", _held("new/.lock"), MEASURE, ""),
        ("while another prepares", _held("new/.lock"), MOSAICS, ""),
        ("whose source is renamed meanwhile", _meanwhile(lambda f: os.rename(f / "mosaics", f / "elsewhere")), MOSAICS, WORKS),
        ("whose mosaics grow meanwhile", _meanwhile(lambda f: [_swap(f) for _ in range(400)]), MOSAICS, WORKS),
        ("whose table's folder is removed meanwhile", _meanwhile(lambda f: shutil.rmtree(f / "new", ignore_errors=True)), MEASURE, WORKS),
        ("whose run is renamed meanwhile", _meanwhile(lambda f: os.rename(f / "new", f / "elsewhere"), 0.6), [*TRAIN[:4], "--steps", "60", "--checkpoint-every", "5", *TRAIN[6:]], "the training may have ended before"),
        ("whose run is removed meanwhile", _meanwhile(lambda f: shutil.rmtree(f / "new"), 0.6), [*TRAIN[:4], "--steps", "60", "--checkpoint-every", "5", *TRAIN[6:]], "the training may have ended before"),
    ):  # fmt: skip
        yield made_case(f"further process {name}", change, command, reason)


def _memory(more: int) -> Change:
    """Room for so many MiB more than the process has now."""

    def change(folder: Path) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + (more << 20)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))

    return change


def _large(then: Change) -> Change:
    def change(folder: Path) -> None:
        import hostile_files as made

        made.png(folder / MOSAIC, 9000, 9000)
        then(folder)

    return change


def _closed_presentation(then: Change) -> Change:
    return lambda folder: ((folder / "run/presentation.json").write_text("{}"), then(folder))


def _locked(then: Change) -> Change:
    return lambda folder: ((folder / "run/.lock").touch(), then(folder))


def _removed(folder: Path) -> None:
    os.mkdir(folder / "gone")
    os.chdir(folder / "gone")
    os.rmdir(folder / "gone")


def _held(name: str) -> Change:
    """A lock that another process has, for some seconds."""

    def change(folder: Path) -> None:
        import fcntl

        path = folder / name
        path.parent.mkdir(exist_ok=True)
        read, write = os.pipe()
        if not os.fork():
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            with open(path, "w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                os.write(write, b"x")
                import time

                time.sleep(4)
            os._exit(0)
        os.read(read, 1)

    return change


def _meanwhile(act: Change, after: float = 0.05) -> Change:
    """Do something from another process while the command works."""

    def change(folder: Path) -> None:
        if not os.fork():
            import contextlib
            import time

            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            time.sleep(after)
            with contextlib.suppress(OSError):
                act(folder)
            os._exit(0)

    return change


def _swap(folder: Path) -> None:
    """Half a mosaic in the place of a whole one, and back."""
    path = folder / MOSAIC
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    path.write_bytes(whole)
