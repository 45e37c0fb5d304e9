"""Primary rays of a pinhole camera, and Stokes vectors in its lens frames, in Mitsuba's types."""

from __future__ import annotations

from typing import Any

from polarguide.camera import Camera


def opaque_value(kind: Any, value: float) -> Any:
    """A number that is not compiled into the kernel as a literal, so that one kernel serves all views."""
    import drjit as dr
    import mitsuba as mi

    return kind(value) if mi.variant().startswith("scalar") else dr.opaque(kind, value)


def pinhole(camera: Camera) -> list[Any]:
    """A camera in Mitsuba's types: width, (fx, fy, cx, cy), the axes of the camera in the world, and its center."""
    import mitsuba as mi

    inner = [opaque_value(mi.Float, value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
    # The rows of the world-to-camera rotation are the camera's axes in the world.
    axes = [mi.Vector3f(*(opaque_value(mi.Float, float(v)) for v in row)) for row in camera.rotation]
    origin = mi.Point3f(*(opaque_value(mi.Float, float(v)) for v in camera.center))
    return [opaque_value(mi.UInt32, camera.width), inner, axes, origin]


def primary_rays(camera: list[Any], pixel: Any, place: Any) -> tuple[Any, Any]:
    """Rays through points in pixels.

    Args:
        camera: from ``pinhole``.
        pixel: index of the pixel, row by row.
        place: position in the pixel, [0, 1)^2.

    Returns:
        Mitsuba's rays, and the x axis of the lens frame of each ray (see ``optics.lens_frame``), in world axes.
    """
    import drjit as dr
    import mitsuba as mi

    width, (fx, fy, cx, cy), axes, origin = camera
    row = pixel // width
    x = (mi.Float(pixel - row * width) + place.x - cx) / fx
    y = (mi.Float(row) + place.y - cy) / fy
    d = dr.normalize(mi.Vector3f(x, y, mi.Float(1.0)))
    scale = 1 / (1 + d.z)
    x_ref = mi.Vector3f(1 - d.x * d.x * scale, -d.x * d.y * scale, -d.x)
    ray, right = (axes[0] * v.x + axes[1] * v.y + axes[2] * v.z for v in (d, x_ref))
    return mi.Ray3f(origin, ray), right


def lens_stokes(light: list[Any], ray: Any, x_ref: Any) -> list[Any]:
    """Convert Stokes vectors from Mitsuba's frame of ``-ray.d`` to our lens frame.

    Mitsuba measures angles from its basis counter-clockwise as seen against the light, that is in the picture, as we
    do; only the basis has to be rotated.
    """
    import mitsuba as mi

    forward = -ray.d
    turn = mi.mueller.rotate_stokes_basis(forward, mi.mueller.stokes_basis(forward), x_ref)
    s0, s1, s2 = light
    return [s0, s1 * turn[1, 1] + s2 * turn[1, 2], s1 * turn[2, 1] + s2 * turn[2, 2]]
