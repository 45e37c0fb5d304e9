"""Checks of the poses: epipolar errors, and gaps in the coverage."""

from __future__ import annotations

import numpy as np
import torch

from polarguide.capture.view import listed
from polarguide.inspection.capture import Capture
from polarguide.inspection.epipolar import epipolar_errors, view_errors
from polarguide.inspection.verdict import Check, Verdict
from polarguide.scene_frame import scene_frame
from polarguide.vectors import unit_array

TYPICAL_PX, VIEW_PX = 2.0, 2.0
"""Median epipolar errors in stored pixels above which a capture, or one view of it, gets a warning."""
STANDS_OUT = 2.5
"""A view also has to be this many times worse than the median view."""
GAP_DEG = 25.0
FEW_VIEWS = 20


def pose_check(capture: Capture) -> Check:
    """Check whether feature matches agree with the poses."""
    key, title = "poses", "Pose quality"
    if capture.model is None:
        remedy = "Run polarguide prepare with --poses sfm or --poses PATH."
        return Check(key, title, "n/a", "There are no poses.", remedy)
    missing = tuple(view.name for view in capture.views if view.camera is None)
    errors = view_errors(epipolar_errors(capture))
    if len(errors) < 3:
        return Check(
            key, title, "n/a" if not missing else "warning",
            f"Too few features match between neighboring views to judge the poses. {len(missing)} views have none.",
            "Structure from motion needs static texture." if missing else "", missing,
            {"views": {}, "without_pose": len(missing)},
        )  # fmt: skip
    typical = float(np.median(list(errors.values())))
    bad = tuple(name for name, e in errors.items() if e > max(VIEW_PX, STANDS_OUT * typical))
    figures = {"median_px": typical, "views": errors, "without_pose": len(missing)}
    said = f"Matches lie {typical:.2f} px from their epipolar lines (median view of {len(errors)})."
    verdict: Verdict = "ok"
    remedies = []
    if bad:
        verdict = "warning"
        said += f" Far worse: {listed([f'{name} ({errors[name]:.1f} px)' for name in bad])}."
        remedies.append("Leave these views out, or register them again.")
    if missing:
        verdict = "warning"
        said += f" Without a pose: {len(missing)} views ({listed(list(missing))})."
        remedies.append("Remove the pictures of views without a pose, which train refuses, or register them.")
    if typical > TYPICAL_PX:
        verdict = "wrong" if typical > 2 * TYPICAL_PX else "warning"
        remedies.append("Refine the model (bundle adjustment), and check that it belongs to these pictures.")
    return Check(key, title, verdict, said, " ".join(remedies), (*bad, *missing), figures)


def coverage_check(capture: Capture) -> Check:
    """Check whether neighboring views are close enough to each other."""
    key, title = "coverage", "Coverage"
    cameras = [view.camera for view in capture.posed if view.camera is not None]
    if len(cameras) < 2:
        return Check(key, title, "n/a", "Fewer than two views have a pose.")
    focus = scene_frame(cameras).center
    seen = unit_array(torch.stack([camera.center - focus for camera in cameras]).numpy())
    angles = np.degrees(np.arccos(np.clip(seen @ seen.T, -1, 1))) + 360 * np.eye(len(seen))
    nearest = angles.min(axis=1)
    spread = float(np.degrees(np.arccos(np.clip(seen @ unit_array(seen.mean(axis=0)), -1, 1))).max())
    figures = {"views": len(seen), "median_step_deg": float(np.median(nearest)),
               "largest_step_deg": float(nearest.max()), "half_angle_deg": spread}  # fmt: skip
    said = (
        f"{len(seen)} views, {np.median(nearest):.0f}° from the nearest view (median; at most {nearest.max():.0f}°), "
        f"within {spread:.0f}° of their mean direction."
    )
    lonely = tuple(v.name for v, gap in zip(capture.posed, nearest, strict=True) if gap > GAP_DEG)
    if lonely or len(seen) < FEW_VIEWS:
        return Check(
            key, title, "warning", said,
            "Reconstruction is unreliable across gaps: add views at most 15 degrees apart.", lonely, figures,
        )  # fmt: skip
    return Check(key, title, "ok", said, figures=figures)
