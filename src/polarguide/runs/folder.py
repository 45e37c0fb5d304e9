"""A run folder: the configuration, atomically written checkpoints, the log, and the exported PLY.

RUN/run.json            what was asked for (scene, recipe, settings), plain JSON
RUN/checkpoint.safetensors   everything training needs to go on, and all that rendering needs
RUN/log.jsonl           one line per logged step
RUN/point_cloud.ply     for other viewers, at the end
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from polarguide import __version__
from polarguide.capture import Scene
from polarguide.errors import PolarguideError
from polarguide.files import atomic, write_text
from polarguide.options import Transfer
from polarguide.records import decode
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings
from polarguide.training.state import TrainingState

CONFIGURATION = "run.json"
CHECKPOINT = "checkpoint.safetensors"
LOG = "log.jsonl"
PLY = "point_cloud.ply"


@dataclass(frozen=True)
class RunConfiguration:
    """What defines a run.

    Attributes:
        scene: absolute path of the scene folder.
        scene_digest: hash of the scene's files, so that a run does not go on with other data.
        recipe: its name. recipe_data: all its values, for the record.
        settings: steps, seed, refractive index.
        downscale: side of the averaged pixel boxes. transfer: how the files were read.
        device: what it trained on. version: of the program.
    """

    scene: str
    scene_digest: str
    recipe: str
    recipe_data: dict[str, Any]
    settings: TrainSettings
    downscale: int
    transfer: Transfer
    device: str
    version: str = __version__

    @classmethod
    def of(
        cls, scene: Scene, recipe: Recipe, settings: TrainSettings, device: torch.device
    ) -> RunConfiguration:
        """What is recorded of a training."""
        return cls(
            scene=str(scene.root.resolve()),
            scene_digest=scene.digest,
            recipe=recipe.name,
            recipe_data=recipe.data(),
            settings=settings,
            downscale=scene.downscale,
            transfer="srgb" if scene.transfer == "srgb" else "linear",
            device=str(device),
        )

    def save(self, run: Path) -> None:
        """Write ``run.json``."""
        write_text(run / CONFIGURATION, json.dumps(dataclasses.asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, run: Path) -> RunConfiguration:
        """Read ``run.json``.

        Raises:
            PolarguideError: not a run folder, a run of another version, or a file that is no configuration.
        """
        path = run / CONFIGURATION
        try:
            data = path.read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            raise PolarguideError(
                run,
                expected=f"a run folder with {CONFIGURATION}",
                found="none",
                remedy="Give the folder that a training wrote.",
            ) from None
        remedy = "Restore the file, or train again into a new folder."
        written = decode(data, _Written, path, remedy=remedy).version
        if _series(written) != _series(__version__):
            raise PolarguideError(
                run,
                expected=f"a run of polarguide {_series(__version__)}",
                found=f"one of version {written}",
                remedy=f"Train again into a new folder, or open it with polarguide {_series(written)}.",
            )
        return decode(data, cls, path, remedy=remedy)


@dataclass(frozen=True)
class _Written:
    """What is read of a run of any version."""

    version: str


def _series(version: str) -> str:
    """The versions that read each other's runs: 0.2 of 0.2.1."""
    return ".".join(version.split(".")[:2])


def save_checkpoint(run: Path, state: TrainingState) -> None:
    """Write the state so that a kill at any moment leaves either the old checkpoint or the new one."""
    with atomic(run / CHECKPOINT) as path:
        save_file(state.tensors(), path, metadata={"step": str(state.step), "version": __version__})


def load_checkpoint(run: Path, recipe: Recipe, device: torch.device | str = "cpu") -> TrainingState:
    """Read the state of a run, whatever it was trained on, to a device.

    Raises:
        PolarguideError: there is none, or it is damaged.
    """
    path = run / CHECKPOINT
    if not path.exists():
        raise PolarguideError(
            run,
            expected=f"a checkpoint ({CHECKPOINT})",
            found="none",
            remedy="Train first, or without --resume.",
        )
    try:
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            tensors: dict[str, Tensor] = {key: file.get_tensor(key).to(device) for key in names}
        return TrainingState.from_tensors(tensors, recipe)
    except (SafetensorError, KeyError, ValueError) as error:
        raise PolarguideError(
            path,
            expected="a checkpoint of this program",
            found=f"damaged or foreign data ({error})",
            remedy="Train again into a new folder.",
        ) from None


class RunLog:
    """Appends one JSON line at a time."""

    def __init__(self, run: Path) -> None:
        self._path = run / LOG

    def append(self, **values: Any) -> None:
        """Write one line."""
        with open(self._path, "a") as file:
            file.write(json.dumps(values) + "\n")

    def cut(self, step: int) -> None:
        """Drop lines at or after a step: they will be written again after a resume."""
        if self._path.exists():
            kept = [row for row in self.rows() if row["step"] < step]
            write_text(self._path, "".join(json.dumps(row) + "\n" for row in kept))

    def rows(self) -> list[dict[str, Any]]:
        """The lines that are whole, none where there is no log; a kill can cut one short."""
        rows = []
        for line in self._path.read_text().splitlines() if self._path.exists() else ():
            with contextlib.suppress(json.JSONDecodeError):
                row = json.loads(line)
                rows += [row] if isinstance(row, dict) and "step" in row else []
        return rows

    def elapsed(self) -> tuple[float, bool]:
        """Training seconds that the log accounts for, and whether the machine worked for nobody else."""
        rows = self.rows()
        return (float(rows[-1]["seconds"]), bool(rows[-1]["alone"])) if rows else (0.0, True)
