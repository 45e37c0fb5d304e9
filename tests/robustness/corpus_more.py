# ruff: noqa: E501
"""More of the corpus: what somebody malicious makes by hand, and what somebody unlucky finds. Nothing here is random."""

from __future__ import annotations

from collections.abc import Iterator

import more_folders
import more_models
import more_names
import more_pictures
import more_poses
import more_runs
import more_scenes
from making import MadeCase

MAKERS = (
    more_pictures.picture_cases, more_pictures.truth_cases, more_scenes.scene_cases, more_models.colmap_cases,
    more_poses.pose_cases, more_runs.run_cases, more_runs.link_cases, more_folders.folder_cases,
    more_folders.dataset_cases, more_names.option_cases, more_names.name_cases,
)  # fmt: skip

FOUND = """
picture TIFF of signed sizes/picture TIFF of two sizes/shots of 4000 scans/mosaic TIFF of signed sizes/mosaic .npy of a broken head/
mosaic .npy of a wrong key/mosaic sparse of 2 GiB/gt is junk in LZMA/gt has a broken head/gt has a head of brackets/gt lies about its size/gt has huge depths/
scene with 60000 objects/scene.json of 2 GiB/transforms.json of a place at 1e300/transforms.json of a negative focal length along y/
transforms.json beside a TIFF cut short/cameras.xml of a width of infinity/cameras.xml of a width of words/cameras.xml of a camera twice/
cameras.npz of a broken head/cameras.npz of a head with a dictionary as key/cameras.npz that lies about its size/cameras.npz that is junk in LZMA/
option a zero of 1e308/run log of 8 million lines/run scene of a long name/masks with links to themselves/view with control characters and no pose
""".replace("\n", "").split("/")
"""Cases that ended otherwise than they should before what they showed was mended."""
SHARE_OF_OTHERS = 5
"""One of so many of the other quick cases is always run, all cases by ``make fuzz``."""
QUICK = ("priors", "prepare", "bench")


def more_cases(*, every: bool) -> Iterator[MadeCase]:
    """All cases, or those that are always run."""
    for number, case in enumerate(case for make in MAKERS for case in make()):
        found = case.name.removeprefix("more ") in FOUND
        if every or found or (case.command in QUICK and number % SHARE_OF_OTHERS == 0):
            yield case
