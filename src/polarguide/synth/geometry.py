"""Ray casting against the surfaces of a scene: normals, depth and object masks without light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polarguide.camera import Camera
from polarguide.synth.build import BuiltScene
from polarguide.synth.mesh import Array


@dataclass(frozen=True, eq=False)
class Intersections:
    """The first intersections of rays with surfaces.

    Attributes:
        distance: [N] along the ray, 0 without intersection.
        normal: [N, 3] unit shading normal that faces the ray's origin, 0 without intersection.
        thing: [N] number of the object, counted from 1; 0 for a light source or no intersection.
    """

    distance: Array
    normal: Array
    thing: NDArray[np.uint8]


def intersect(built: BuiltScene, origins: Array, toward: Array) -> Intersections:
    """Intersect rays with origins [N, 3] and unit directions [N, 3] with the scene."""
    import mitsuba as mi

    if mi.variant().startswith("scalar"):
        pairs = zip(origins.tolist(), toward.tolist(), strict=True)
        rows = [_intersect(built, mi.Point3f(*o), mi.Vector3f(*d)) for o, d in pairs]
        distance, normal, thing = (np.array(column, float) for column in zip(*rows, strict=True))
    else:
        origin = mi.Point3f(np.ascontiguousarray(origins.T, np.float32))
        direction = mi.Vector3f(np.ascontiguousarray(toward.T, np.float32))
        distance, normal, thing = (np.array(value, float) for value in _intersect(built, origin, direction))
        normal = normal.T
    known = thing > 0
    normal = np.where((normal * toward).sum(-1, keepdims=True) > 0, -normal, normal) * known[:, None]
    return Intersections(distance * known, normal, thing.astype(np.uint8))


def _intersect(built: BuiltScene, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
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


def ground_truth_maps(built: BuiltScene, camera: Camera) -> dict[str, NDArray[Any]]:
    """Normals, depth, mask and object numbers at pixel centers, with the keys of a ground-truth file; nothing of
    what is black to the camera."""
    rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    origins = np.broadcast_to(camera.center.numpy(), rays.shape)
    hits = intersect(built, origins, rays)
    shape = (camera.height, camera.width)
    front = np.array([False] + [thing.foreground for thing in built.spec.things])
    shown = np.array([False, *built.spec.shown])[hits.thing]
    depth = shown * hits.distance * (rays @ camera.rotation[2].numpy())
    return {
        "normal": (shown[:, None] * hits.normal).reshape(*shape, 3).astype(np.float16),
        "depth": depth.reshape(shape).astype(np.float16),
        "mask": front[hits.thing].reshape(shape),
        "objid": (shown * hits.thing).reshape(shape),
    }
