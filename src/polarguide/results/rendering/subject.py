"""Subject of a run: the part of the scene that films, web pages and exported files show by default."""

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
"""Function that maps points [N, 3] of the scene to a mask [N]: True for points of the subject."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The part of a scene that is shown.

    Attributes:
        inside: function that selects the points of the part; None selects the whole scene.
        description: name of the part in messages.
    """

    inside: Inside | None
    description: str

    def holds(self, places: Tensor) -> Tensor:
        """Return a mask [N] on the device of the points [N, 3]: True for points of the subject."""
        if self.inside is None:
            return torch.ones(len(places), dtype=torch.bool, device=places.device)
        return torch.from_numpy(self.inside(places.detach().cpu().numpy())).to(places.device)

    def report_removed(self, inside: Tensor, run: OpenedRun, reporter: Reporter) -> None:
        """Report how many Gaussians belong to the part, and the commands that change the part.

        Without Gaussians outside the part, report no message.
        """
        count = int(inside.sum())
        if count < len(inside):
            reporter.say(
                f"{count:,} of {len(inside):,} Gaussians: {self.description}. "
                f"Everything: {command('present', run.folder, '--crop', 'all')}   "
                f"a box: {command('view', run.folder)}, Crop"
            )


def subject_of(run: OpenedRun, *, masked: bool = False) -> Subject:
    """Return the subject of a run.

    It is the crop box if the presentation has one. Otherwise it is the foreground of the masks, or without masks the
    region that the cameras see.

    A point belongs to the foreground if most of the pictures that contain it show it inside the mask. It belongs to the
    region of the cameras if most pictures contain it.

    Args:
        run: the run. If its scene has masks, the whole scene is read, otherwise only its poses.
        masked: restrict the subject to the foreground of the masks even if there is a crop box.

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
    """Return the function that restricts renderings of a film to the subject.

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
    """Return a function that selects each point with more votes for it than against it.

    Args:
        views: camera and mask [H, W] of each view. A view with a mask votes for points inside the mask and against
            points outside it. It has no vote on points outside its picture. A view without a mask votes against those.
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
