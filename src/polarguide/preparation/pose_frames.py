"""Whether poses from outside are of the pictures as stored, or as EXIF turns them for display."""

from __future__ import annotations

from collections import Counter

from polarguide.capture.colmap.poses import Poses
from polarguide.capture.filter.exif import QUARTER_TURNS, TURNS
from polarguide.capture.view import listed
from polarguide.preparation.source import Source


def settle_pose_frames(pictures: Source, poses: Poses, asked: str) -> str:
    """Decide which views are used as stored, because the poses are of the stored pixels, and tell the source.

    COLMAP, Metashape and nerfstudio read pixels as stored and leave the orientation tag alone; other programs turn the
    pictures first. Where a quarter turn exchanges width and height, the size of the pose's camera tells. Views whose
    sizes tell nothing (half a turn, a mirror image, a square) are as those that do; where none does, as stored.

    Args:
        pictures: the source, which has not developed a view yet.
        poses: from outside; their cameras have sizes.
        asked: what the user says; ``auto`` decides as above.

    Returns:
        One line for the user; empty where no picture has an orientation tag.
    """
    codes: dict[str, int] = {}
    by_size: dict[str, bool] = {}
    for view in poses.views:
        stored = pictures.stored(view)
        if stored.orientation == 1:
            continue
        codes[view] = stored.orientation
        if stored.size is not None and stored.orientation in QUARTER_TURNS:
            (width, height), camera = stored.size, poses.stated_size(view)
            if camera is not None and width != height and camera[0] != camera[1]:
                by_size[view] = (width > height) == (camera[0] > camera[1])
    if not codes:
        return ""
    alike = set(by_size.values())
    others = asked == "stored" if asked != "auto" else alike != {False}
    as_stored = {view: others if asked != "auto" else by_size.get(view, others) for view in codes}
    kept = [view for view, keep in as_stored.items() if keep]
    pictures.use_stored(kept)
    reason = "as --poses-of says" if asked != "auto" else "as the sizes of the cameras tell"
    if asked == "auto" and not alike:
        reason = "as COLMAP, Metashape and nerfstudio read pictures; sizes do not tell"
    counts = Counter(codes.values())
    turns = listed([f"{count} {TURNS[code]}" for code, count in sorted(counts.items())])
    if len(kept) in (0, len(codes)):
        frame, other = ("stored", "displayed") if kept else ("displayed", "stored")
        text = f"their poses are taken to be of the {frame} pixels, {reason}"
    else:
        frame, other = "stored", "displayed"
        kind = f"the poses of {len(kept)} are taken to be of the stored pixels"
        text = f"{kind}, {reason}, those of the others of the displayed ones"
    used = "Those views, their angles and masks are used as stored. " if kept else ""
    return (
        f"EXIF orientation of {len(codes)} of {len(poses.views)} views ({turns}): {text}. {used}"
        f"If the poses are of the {other} pixels: --poses-of {other}."
    )
