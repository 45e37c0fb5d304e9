"""The lens frame of a view ray, and zenith and azimuth of normals in this frame.

All vectors are in camera axes (OpenCV: x right, y down, z forward). ``rays`` are unit vectors from the camera into the
scene and broadcast against the other arguments. Polarization angles are measured in the lens frame of a pixel. An ideal
lens with rotational symmetry carries this frame from the optical axis to the ray of the pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polarguide.geometry.vectors import dot
from polarguide.optics._numerics import for_arrays, safe_atan2


@for_arrays
def lens_frame(rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the directions "right" and "up" of the image at each view ray.

    The smallest rotation from the optical axis to the ray carries both directions along. ``x_ref``, ``up_ref`` and
    ``-ray`` form a right-handed orthonormal basis. On the optical axis, ``x_ref`` is (1, 0, 0) and ``up_ref`` is (0,
    -1, 0).

    Args:
        rays: [..., 3] unit.

    Returns:
        (x_ref, up_ref), each [..., 3] unit.
    """
    x, y, z = rays.unbind(-1)
    # A ray straight back has no smallest rotation; the clamp defines its frame.
    scale = 1 / (1 + z).clamp(min=torch.finfo(rays.dtype).eps)
    mixed = x * y * scale
    x_ref = torch.stack((1 - x * x * scale, -mixed, -x), dim=-1)
    up_ref = torch.stack((mixed, y * y * scale - 1, y), dim=-1)
    return x_ref, up_ref


@for_arrays
def azimuth(vectors: Tensor, rays: Tensor) -> Tensor:
    """Return the azimuth of a vector about the ray: ``atan2(v . up_ref, v . x_ref)``.

    Args:
        vectors: [..., 3], any length.
        rays: [..., 3] unit.

    Returns:
        [...] radians in [-pi, pi]; 0 with zero gradient if the vector is parallel to the ray.
    """
    x_ref, up_ref = lens_frame(rays)
    return safe_atan2(dot(vectors, up_ref), dot(vectors, x_ref))


@for_arrays
def zenith(normals: Tensor, rays: Tensor) -> Tensor:
    """Return the angle between a normal and the direction to the camera, ``-ray``.

    Args:
        normals: [..., 3], any length.
        rays: [..., 3] unit.

    Returns:
        [...] radians in [0, pi]. It is more than pi/2 if the normal faces away, and 0 for a zero normal. The gradient
        is 0 if the normal is parallel to the ray, while the gradient of an arc cosine would be infinite.
    """
    along = dot(normals, rays)
    across = torch.linalg.vector_norm(normals - along[..., None] * rays, dim=-1)
    return safe_atan2(across, -along)


@for_arrays
def normal_from_angles(zenith: Tensor, azimuth: Tensor, rays: Tensor) -> Tensor:
    """Return the unit normal with a zenith and an azimuth about the ray.

    The normal is ``-cos(zenith) ray + sin(zenith) (cos(azimuth) x_ref + sin(azimuth) up_ref)``. It faces the camera if
    the zenith is less than pi/2.

    Args:
        zenith, azimuth: [...] radians.
        rays: [..., 3] unit.

    Returns:
        [..., 3] unit.
    """
    sine = torch.sin(zenith)
    right = sine * torch.cos(azimuth)
    up = sine * torch.sin(azimuth)
    back = torch.cos(zenith)
    # Component by component, because PyTorch is slow if the last axis of three broadcasts.
    axes = zip(*(vectors.unbind(-1) for vectors in (*lens_frame(rays), rays)), strict=True)
    return torch.stack([right * x + up * y - back * ray for x, y, ray in axes], dim=-1)
