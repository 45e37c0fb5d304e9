"""The subject of a run: the part of the scene that films, pages and exported files show by default."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Reporter
from polarguide.core.text import command
from polarguide.geometry.camera import Camera, seen_at
from polarguide.runs.model import Within
from polarguide.runs.opened import OpenedRun

Inside = Callable[[NDArray[Any]], NDArray[np.bool_]]
"""Function that returns which places [N, 3] of the scene belong to the subject."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The part of a scene that is shown.

    Attributes:
        inside: selects the part; None: everything.
        description: description of the part.
    """

    inside: Inside | None
    description: str

    def holds(self, places: Tensor) -> Tensor:
        """Return which places [N, 3] belong to it, [N] bool on their device."""
        if self.inside is None:
            return torch.ones(len(places), dtype=torch.bool, device=places.device)
        return torch.from_numpy(self.inside(places.detach().cpu().numpy())).to(places.device)

    def report_removed(self, inside: Tensor, run: OpenedRun, reporter: Reporter) -> None:
        """Report the number of Gaussians [N] bool in the part, if some are outside, and the commands to change it."""
        count = int(inside.sum())
        if count < len(inside):
            reporter.say(
                f"{count:,} of {len(inside):,} Gaussians: {self.description}. "
                f"Everything: {command('present', run.folder, '--crop', 'all')}   "
                f"a box: {command('view', run.folder)}, Crop"
            )


def subject_of(run: OpenedRun, *, masked: bool = False) -> Subject:
    """Return the subject of a run: the crop box, the foreground of the masks, or the region that the cameras see.

    The first of these that exists is the subject. The foreground is decided by the majority of the pictures
    that contain a place. The region contains the places that are in most of the pictures.

    Args:
        run: the run. The scene is read if it has masks, else only its poses.
        masked: the subject must be inside the masks even if there is a crop box.

    Raises:
        PolarguideError: ``masked`` is set and the scene has no masks, or the scene is missing.
    """
    presentation = run.presentation
    if masked and not run.has_masks:
        raise PolarguideError(
            "--masked",
            expected="a scene with masks of the foreground (masks/)",
            found="none",
            remedy="Set a crop box instead: polarguide present RUN --crop.",
        )
    crop = presentation.crop
    if crop is not None:
        around = run.camera_frame

        def boxed(places: NDArray[Any]) -> NDArray[np.bool_]:
            return np.asarray(crop.inside(torch.from_numpy(places), around).numpy())

        if not masked:
            return Subject(boxed, "the content of the crop box")
        in_masks = _in_masks(run)
        return Subject(
            lambda places: boxed(places) & in_masks(places), "the content of the crop box and the masks"
        )
    if run.has_masks and (masked or not presentation.whole):
        return Subject(_in_masks(run), "the foreground in most of the scene's masks")
    if presentation.whole:
        return Subject(None, "everything")
    everywhere = [(camera, None) for camera in run.poses.values()]
    return Subject(_by_majority(everywhere), "the region in most of the pictures")


def part_shown(run: OpenedRun, reporter: Reporter) -> Within:
    """Return the part of a run in a film, as an argument of renderings.

    Args:
        run: the run.
        reporter: receives a line about removed Gaussians.

    Raises:
        PolarguideError: the scene is missing.
    """
    subject = subject_of(run)
    inside = subject.holds(run.model.state.gaussians["means"])
    subject.report_removed(inside, run, reporter)
    return lambda _: inside


def _in_masks(run: OpenedRun) -> Inside:
    return _by_majority([(view.camera, view.mask.cpu()) for view in run.scene.views if view.mask is not None])


def _by_majority(views: Sequence[tuple[Camera, Tensor | None]]) -> Inside:
    """Return a function that selects the places with more votes for than against them.

    Args:
        views: cameras, and masks [H, W] bool. A view votes against places outside its mask, and abstains outside its
            picture. Without a mask it votes against places outside its picture.
    """

    def inside(places: NDArray[Any]) -> NDArray[np.bool_]:
        points = torch.from_numpy(places)
        votes = torch.zeros(len(points))
        for camera, mask in views:
            pixel, _, in_picture = seen_at(points - camera.center, camera)
            if mask is None:
                votes += torch.where(in_picture, 1.0, -1.0)
            else:
                votes += torch.where(mask[pixel], 1.0, -1.0) * in_picture
        return np.asarray((votes > 0).numpy())

    return inside
