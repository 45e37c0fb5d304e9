"""A run folder: configuration, atomically written checkpoints, log, and exported PLY.

- ``run.json``: scene, recipe and settings, plain JSON.
- ``checkpoint.safetensors``: state to resume from; at the end, data for rendering.
- ``log.jsonl``: one line per logged step.
- ``point_cloud.ply``: Gaussians for other viewers, at the end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from polarguide import __version__
from polarguide.capture import Scene
from polarguide.capture.scene import IN_MEMORY
from polarguide.capture.variants import has_black_background
from polarguide.core.errors import PolarguideError
from polarguide.core.files import atomic, in_utf8, make_folder, read_file, require_file, write_text, writing
from polarguide.core.options import Transfer, index_of
from polarguide.core.records import LARGEST_RECORD, decode
from polarguide.training.checkpoint_checks import refuse_foreign
from polarguide.training.context import SavedState, TrainingState
from polarguide.training.recipe import Recipe
from polarguide.training.settings import STEPS, ResolvedSettings, TrainSettings

CONFIGURATION = "run.json"
CHECKPOINT = "checkpoint.safetensors"
LOG = "log.jsonl"
LOCK = ".lock"
PLY = "point_cloud.ply"
FOR_STEPS = {"adam", "frozen", "callback"}
"""First parts of the names of tensors that are needed only to continue the training."""


@dataclass(frozen=True)
class RunConfiguration:
    """Record that defines a run, stored in ``run.json``.

    Attributes:
        scene: absolute path of the scene folder, or ``IN_MEMORY`` for a scene that was created from arrays.
        scene_digest: hash of the scene's files, which prevents a run from being resumed with other data.
        recipe: name of the recipe.
        recipe_data: all values of the recipe, for the record.
        settings: complete settings of the training.
        downscale: side in pixels of the squares that are averaged to one pixel.
        transfer: transfer function of the picture files.
        device: device of the training.
        test_views: names of the held-out views.
        version: version of polarguide.
        painted: hash of materials that were painted in the viewer of an earlier version. None without them.
    """

    scene: Annotated[str, msgspec.Meta(min_length=1)]
    scene_digest: str
    recipe: str
    recipe_data: dict[str, Any]
    settings: ResolvedSettings
    downscale: int
    transfer: Transfer
    device: str
    test_views: tuple[str, ...]
    version: str = __version__
    painted: str | None = None

    @classmethod
    def of(
        cls,
        scene: Scene,
        recipe: str,
        recipe_data: dict[str, Any],
        settings: ResolvedSettings,
        device: torch.device,
    ) -> RunConfiguration:
        """Return the record of a training."""
        return cls(
            scene=str(scene.root if scene.root == IN_MEMORY else scene.root.resolve()),
            scene_digest=scene.digest,
            recipe=recipe,
            recipe_data=recipe_data,
            settings=settings,
            downscale=scene.downscale,
            transfer="srgb" if scene.transfer == "srgb" else "linear",
            device=str(device),
            test_views=scene.test_names,
        )

    def save(self, run: Path) -> None:
        """Write ``run.json``."""
        write_text(run / CONFIGURATION, json.dumps(dataclasses.asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, run: Path) -> RunConfiguration:
        """Read ``run.json``.

        Raises:
            PolarguideError: the folder is not a run, the run belongs to another version, or the file is invalid.
        """
        path = run / CONFIGURATION
        if not os.path.lexists(path):
            raise PolarguideError(
                run,
                expected=f"a run folder with {CONFIGURATION}",
                found="none",
                remedy="Specify the folder of a training.",
            )
        remedy = "Restore the file, or train again into a new folder."
        data = read_file(path, largest=LARGEST_RECORD, remedy=remedy)
        written = decode(data, _Written, path, remedy=remedy).version
        if _series(written) != _series(__version__):
            raise PolarguideError(
                run,
                expected=f"a run of polarguide {_series(__version__)}",
                found=f"a run of version {written}",
                remedy=f"Train again into a new folder, or open it with polarguide {_series(written)}.",
            )
        configuration = decode(data, cls, path, remedy=remedy)
        _refuse_unknown(decode(data, dict[str, Any], path, remedy=remedy), configuration, path, remedy)
        return configuration


def _refuse_unknown(data: dict[str, Any], record: RunConfiguration, path: Path, remedy: str) -> None:
    """Check that a record has no unknown fields, because they could change the meaning of a run."""
    for place, values, of in (("", data, record), ("settings.", data["settings"], record.settings)):
        names = [field.name for field in dataclasses.fields(of)]
        for name in sorted(values.keys() - names):
            where = f"{path} ({place}{name[:100]})"
            raise PolarguideError(where, expected=f"only {', '.join(names)}", found=name[:100], remedy=remedy)


@dataclass(frozen=True)
class _Written:
    """Fields of ``run.json`` that are the same in every version."""

    version: str


def _series(version: str) -> str:
    """Return the series of a version, such as 0.2 for 0.2.1. Versions of a series read each other's runs."""
    return ".".join(version.split(".")[:2])


def save_checkpoint(run: Path, state: SavedState, *, optimizer: bool = True) -> None:
    """Write the state atomically. If the process is killed, either the old or the new checkpoint is complete.

    Args:
        run: the run folder.
        state: state of the training.
        optimizer: True to include data that only further steps need. These are the moments of Adam, the frozen
            Gaussians and the tensors of callbacks.

    Raises:
        PolarguideError: the checkpoint cannot be written. The old checkpoint remains.
    """
    tensors = state.tensors()
    if not optimizer:
        tensors = {name: values for name, values in tensors.items() if not FOR_STEPS & set(name.split("."))}
    with atomic(run / CHECKPOINT) as path:
        try:
            # One entry, because safetensors writes several in random order: equal states are equal bytes.
            save_file(tensors, path, metadata={"polarguide": f"{__version__}, step {state.step}"})
        except SafetensorError as error:  # raised for a full disk as well
            raise OSError(str(error)) from None


def load_checkpoint(run: Path, recipe: Recipe, device: torch.device | str = "cpu") -> TrainingState:
    """Read the state of a run to a device. The training may have run on another device.

    Raises:
        PolarguideError: the checkpoint is missing or damaged.
    """
    with checkpoint_tensors(run) as tensors:
        refuse_foreign(tensors, recipe)
    return TrainingState.from_tensors({name: values.to(device) for name, values in tensors.items()}, recipe)


@contextlib.contextmanager
def checkpoint_tensors(run: Path) -> Iterator[dict[str, Tensor]]:
    """Yield the tensors of a run's checkpoint on the CPU.

    Errors that are raised inside the context are reported as errors of the file.

    Raises:
        PolarguideError: the checkpoint is missing or damaged.
    """
    path = run / CHECKPOINT
    if not path.exists():
        link = path.is_symlink()
        restore = "Restore the target of the link, or remove the link to begin at step 0."
        raise PolarguideError(
            run,
            expected=f"a checkpoint ({CHECKPOINT})",
            found="a link to nowhere" if link else "none",
            remedy=restore if link else "Train first, or without --resume.",
        )
    require_file(path, expected="a checkpoint of this program", remedy="Train again into a new folder.")
    try:
        with in_utf8(path) as name, safe_open(name, framework="pt") as file:
            tensors: dict[str, Tensor] = {key: file.get_tensor(key) for key in list(file.keys())}
        yield tensors
    except (SafetensorError, ValueError, OSError, RuntimeError) as error:
        raise PolarguideError(
            path,
            expected="a checkpoint of this program",
            found=f"damaged or foreign data ({str(error)[:300]})",
            remedy="Train again into a new folder.",
        ) from None


@contextlib.contextmanager
def writing_to(run: Path) -> Iterator[None]:
    """Create a run folder, and lock it against other writers. The lock ends with the process.

    Raises:
        PolarguideError: another training writes to it.
    """
    make_folder(run)
    lock = FileLock(run / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise PolarguideError(
            run,
            expected="a run folder without another training",
            found="another training that writes to it",
            remedy="Wait until it has ended, or choose another folder.",
        ) from None
    except OSError as error:
        reason = error.strerror or str(error)
        remedy = "Free space on the disk, or change the rights."
        raise PolarguideError(
            run / LOCK, expected="a file that can be locked", found=reason, remedy=remedy
        ) from None
    try:
        yield
    finally:
        lock.release()


class RunLog:
    """Log with one JSON line per entry."""

    def __init__(self, run: Path) -> None:
        self._path = run / LOG

    def append(self, **values: Any) -> None:
        """Write one line.

        Raises:
            PolarguideError: the log cannot be written.
        """
        with writing(self._path), open(self._path, "a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")

    def cut(self, step: int) -> None:
        """Remove the lines of ``step`` and later steps, and all lines that are not from polarguide.

        A resumed training writes the removed lines again.
        """
        if os.path.lexists(self._path):
            lines = [line for line, row in self._lines() if row["step"] < step]
            write_text(self._path, "".join(f"{line}\n" for line in lines))

    def rows(self) -> list[dict[str, Any]]:
        """Return the complete lines of the log; empty without a log.

        A killed process may leave an incomplete line, which is skipped.

        Raises:
            PolarguideError: the log cannot be read.
        """
        return [row for _, row in self._lines()]

    def _lines(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the lines that polarguide wrote, each as a tuple of text and values."""
        if not os.path.lexists(self._path):
            return []
        rows = []
        remedy = "Remove it; a training does not need it."
        for line in read_file(self._path, largest=LARGEST_RECORD, remedy=remedy).split(b"\n"):
            with contextlib.suppress(ValueError, RecursionError):  # errors of msgspec are ValueErrors
                row: dict[str, Any] = msgspec.to_builtins(_ROWS.decode(line))
                rows.append((line.decode(), row))
        return rows

    def elapsed(self) -> tuple[float, bool]:
        """Return a tuple of the logged seconds of training, and True if no other process was busy."""
        rows = self.rows()
        return (rows[-1]["seconds"], rows[-1]["alone"]) if rows else (0.0, True)


class _Row(msgspec.Struct):
    """Fields of a line of the log that are read."""

    step: Annotated[int, msgspec.Meta(ge=0)]
    seconds: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    alone: bool = True
    psnr: float | None = None
    held_out: float | None = None
    gaussians: int | None = None


_ROWS = msgspec.json.Decoder(_Row)


OPEN = ("steps", "refractive_index", "background")
"""Settings that ``resolve`` completes if they are not specified.

The number of Gaussians is not listed, because it is needed before pictures are read.
"""
VISITS = 60
"""Least number of visits to each training view."""
LARGE = 1_000_000
"""Number of pixels of a view above which the number of steps doubles.

Finer detail takes more rounds of the density control.
"""
MOST_GAUSSIANS = 400_000
"""Upper bound of the default number of Gaussians, which limits the memory for large captures.

Scenes with pictures of 256 x 192 have 150,000 Gaussians. Larger numbers at full size were not studied.
"""


def most_gaussians(
    pixels: int, method: Recipe, settings: TrainSettings, resumed: ResolvedSettings | None = None
) -> int:
    """Return the largest number of Gaussians of a training.

    Args:
        pixels: number of pixels of all training views.
        method: the recipe.
        settings, resumed: arguments of ``resolve``.
    """
    if settings.gaussians is not None:
        return settings.gaussians
    by_size = min(int(pixels / method.densification.pixels_each), MOST_GAUSSIANS)
    return by_size if resumed is None else resumed.gaussians


def resolve(
    settings: TrainSettings,
    scene: Scene,
    method: Recipe,
    resumed: ResolvedSettings | None = None,
) -> ResolvedSettings:
    """Return the complete settings of a training.

    Args:
        settings: settings that the user specified.
        scene, method: scene and recipe of the training.
        resumed: settings of the run to resume. They take precedence over defaults that depend on the scene.

    Raises:
        PolarguideError: a setting is out of range.
    """
    recorded = {} if resumed is None else {name: getattr(resumed, name) for name in OPEN}
    sizes = [view.camera.width * view.camera.height for view in scene.train_views]
    values: dict[str, Any] = {
        **vars(settings),
        "steps": _steps(sizes),
        "refractive_index": index_of(None, scene.refractive_index),
        **recorded,
        "gaussians": most_gaussians(sum(sizes), method, settings, resumed),
        **settings.specified(),
    }
    if values["background"] == "auto":
        values["background"] = "black" if has_black_background(scene.train_views) else "scene"
    return ResolvedSettings(**values)


def _steps(sizes: Sequence[int]) -> int:
    return max(STEPS, 500 * math.ceil(VISITS * len(sizes) / 500)) * (2 if max(sizes) > LARGE else 1)
