"""Rays against the surfaces of a scene: what is known exactly about a pixel, without any light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.camera import Camera
from polarguide.synth.build import Built
from polarguide.synth.mesh import Array


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet surfaces.

    Attributes:
        distance: [N] along the ray, 0 where it meets nothing.
        normal: [N, 3] unit shading normal that faces the ray's origin, 0 where it meets nothing.
        thing: [N] number of the object, counted from 1; 0 where it meets a light or nothing.
    """

    distance: Array
    normal: Array
    thing: NDArray[np.uint8]


def cast(built: Built, origins: Array, toward: Array) -> Hits:
    """Follow rays [N, 3] to the first surface."""
    import mitsuba as mi

    if mi.variant().startswith("scalar"):
        pairs = zip(origins.tolist(), toward.tolist(), strict=True)
        rows = [_cast(built, mi.Point3f(*o), mi.Vector3f(*d)) for o, d in pairs]
        distance, normal, thing = (np.array(column, float) for column in zip(*rows, strict=True))
    else:
        origin = mi.Point3f(np.ascontiguousarray(origins.T, np.float32))
        direction = mi.Vector3f(np.ascontiguousarray(toward.T, np.float32))
        distance, normal, thing = (np.array(value, float) for value in _cast(built, origin, direction))
        normal = normal.T
    known = thing > 0
    normal = np.where((normal * toward).sum(-1, keepdims=True) > 0, -normal, normal) * known[:, None]
    return Hits(distance * known, normal, thing.astype(np.uint8))


def _cast(built: Built, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
    import drjit as dr
    import mitsuba as mi

    si = built.scenes[0].ray_intersect(mi.Ray3f(origin, direction))
    if mi.variant().startswith("scalar"):
        number = next((k + 1 for k, shape in enumerate(built.shapes) if shape == si.shape), 0)
        return (si.t if number else 0.0), list(si.sh_frame.n), number
    number = mi.UInt32(0)
    for k, shape in enumerate(built.shapes):
        number = dr.select(si.shape == mi.ShapePtr(shape), k + 1, number)
    return dr.select(si.is_valid(), si.t, 0.0), si.sh_frame.n, number


def pixel_truth(built: Built, camera: Camera) -> dict[str, NDArray[Any]]:
    """Normals, depth, mask and object numbers at the centers of pixels, under the names of a ground-truth file."""
    rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    origins = np.broadcast_to(camera.center.numpy(), rays.shape)
    hits = cast(built, origins, rays)
    shape = (camera.height, camera.width)
    front = np.array([False] + [thing.foreground for thing in built.spec.things])
    depth = hits.distance * (rays @ camera.rotation[2].numpy())
    return {
        "normal": hits.normal.reshape(*shape, 3).astype(np.float16),
        "depth": depth.reshape(shape).astype(np.float16),
        "mask": front[hits.thing].reshape(shape),
        "objid": hits.thing.reshape(shape),
    }
