"""Cameras from files of other programs: nerfstudio's ``transforms.json``, Metashape's ``cameras.xml``, IDR's .npz."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from polarguide.capture.camera_sizes import Sizes, settled_size
from polarguide.capture.colmap.files import PosedCamera
from polarguide.capture.datasets.dataset import pinhole_camera, read_projections
from polarguide.capture.metashape_file import read_metashape
from polarguide.capture.transforms_file import read_transforms
from polarguide.core.errors import PolarguideError

SUFFIXES = (".json", ".xml", ".npz")


def read_pose_file(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Cameras by view name.

    Args:
        path: ``.json`` of nerfstudio, instant-ngp or Blender, ``.xml`` of Metashape, or ``.npz`` with ``world_mat_<i>``
            and ``scale_mat_<i>`` (IDR).
        views: names of the views, sorted.
        sizes: what a view's camera may have been made for, where the file does not say.

    Raises:
        PolarguideError: the file cannot be read, or describes no camera of these views.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _idr(path, views, sizes)
    names = frozenset(views)
    found = read_metashape(path, names) if suffix == ".xml" else read_transforms(path, names, sizes)
    if not found:
        raise PolarguideError(
            path,
            expected="cameras with a pose",
            found="none",
            remedy="Align the pictures and export the cameras again.",
        )
    return found


def _idr(path: Path, views: Sequence[str], sizes: Sizes) -> dict[str, PosedCamera]:
    """Cameras by number: of the views called so, or of the views in their order where there are as many.

    Raises:
        PolarguideError: the file does not say which camera is whose.
    """
    cameras = read_projections(path).cameras
    numbered = {view: int(view) for view in views if view.isascii() and view.isdigit() and len(view) < 7}
    named = len(numbered) == len(views)
    order = sorted(views, key=lambda view: numbered[view]) if named else sorted(views)
    in_order = dict(zip(order, sorted(cameras), strict=False))
    # As many of both: the order holds, whether numbers begin with 0 or 1.
    offsets = {number - in_order[view] for view, number in numbered.items() if view in in_order}
    if len(cameras) == len(views) and len(offsets) <= 1:
        chosen = in_order
    elif named and min(cameras) == min(numbered.values()) and set(numbered.values()) <= set(cameras):
        chosen = numbered
    else:
        raise PolarguideError(
            path,
            expected=f"as many cameras as views, {len(views)}, or one of the number of every view",
            found=f"{len(cameras)} cameras, world_mat_{min(cameras)} to world_mat_{max(cameras)}",
            remedy="Number the views as the cameras are: view 7 has world_mat_7. Or leave out cameras without a view.",
        )
    found = {}
    for view, number in chosen.items():
        inner, *pose = cameras[number]
        center = (float(inner[0, 2]), float(inner[1, 2]))
        size = settled_size(f"{path} (world_mat_{number})", sizes(view), center, in_pixels=True)
        found[view] = pinhole_camera(size, inner, *pose)
    return found
