"""Options that several verbs share.

The command line takes names, types, defaults and help texts from these classes. This module does not import torch, so
that the command line starts quickly.
"""

from __future__ import annotations

import math
import numbers
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from tyro.constructors import PrimitiveConstructorSpec

from polarguide.core.errors import PolarguideError

DeviceName = Literal["auto", "cpu", "cuda"]
Transfer = Literal["linear", "srgb"]
Split = Literal["directions", "every-8th"]
Exposures = Literal["captured", "four", "three", "two", "one", "unknown", "mixed", "sparse", "none"]
EXPOSURES: tuple[Exposures, ...] = get_args(Exposures)
ExportFormat = Literal[
    "ply",
    "spz",
    "splat-glb",
    "splat-usdz",
    "mesh",
    "glb",
    "usdz",
    "stl",
    "environment",
    "cameras",
    "normals",
    "all",
]
Axes = Literal["upright", "scene"]
PlyFields = Literal["release", "all"]
NormalLayout = Literal["brush", "dn-splatter"]
TrainingPicture = Literal["photograph", "diffuse", "minimum"]
BaseColor = Literal["delit", "diffuse", "photographs", "picture"]
PictureFormat = Literal["png", "exr", "npy"]
EXPORT_PACKAGES: dict[str, tuple[str, ...]] = {
    "spz": ("gaussforge",),
    "mesh": ("skimage",),
    "glb": ("skimage", "xatlas", "fast_simplification"),
    "all": ("gaussforge", "skimage", "xatlas", "fast_simplification"),
    "usdz": ("pxr", "skimage", "xatlas", "fast_simplification"),
    "splat-usdz": ("pxr",),
    "stl": ("skimage", "trimesh", "fast_simplification"),
    "environment": ("OpenEXR",),
}
"""Packages that each export format needs. They are checked before a run is loaded."""
PathLike = str | os.PathLike[str]
INDEX = 1.5
"""Default refractive index of a scene. It is typical of glass, plastic and glaze."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")


MOST = 10**9
"""Largest count that an option accepts."""
MOST_THREADS = 1024
LEAST_MEMORY = 2**-10
"""Smallest memory limit that is accepted, in GiB. No scene fits into less memory."""


def check_count(name: str, value: int, minimum: int = 1, most: int = MOST) -> None:
    """Check an integer option.

    Args:
        name: name of the option.
        value: its value.
        minimum, most: smallest and largest valid value.

    Raises:
        PolarguideError: the value is not a whole number, or out of range.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise PolarguideError(name, expected="a whole number", found=repr(value), remedy="Round it.")
    if not minimum <= value <= most:
        expected, change = (f"up to {most}", "smaller") if value > most else (f"{minimum} or more", "larger")
        raise PolarguideError(name, expected=expected, found=str(value), remedy=f"Give a {change} number.")


def check_finite(name: str, value: float, least: float = -math.inf, most: float = math.inf) -> None:
    """Check a numerical option.

    Args:
        name: name of the option.
        value: its value.
        least, most: smallest and largest valid value.

    Raises:
        PolarguideError: the value is not finite, or out of range.
    """
    if not (math.isfinite(value) and least <= value <= most):
        whole = math.isinf(least) and math.isinf(most)
        raise PolarguideError(
            name,
            expected="a finite number" if whole else f"{least:g} to {most:g}",
            found=str(value),
            remedy="Correct the number.",
        )


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Check an option with a fixed set of values.

    Raises:
        PolarguideError: the value is not one of the choices.
    """
    allowed = list(choices)
    if value not in allowed:
        raise PolarguideError(
            name, expected="one of " + ", ".join(allowed), found=value, remedy="Correct the name."
        )


def picture_size(size: str) -> tuple[int, int]:
    """Parse a width and a height such as 1920x1080.

    Raises:
        PolarguideError: the text has another form, or a side is not from 16 to 8192.
    """
    try:
        width, height = (int(part) for part in size.lower().split("x"))
        right = min(width, height) >= 16 and max(width, height) <= 8192
    except ValueError:
        right = False
    if not right:
        raise PolarguideError(
            "--size",
            expected="width and height from 16 to 8192 such as 256x192",
            found=repr(size),
            remedy="Give whole numbers.",
        )
    return width, height


_UNITS = {"k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_BINARY = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30, "t": 1 << 40}
_SIZE = re.compile(r"(?P<count>\d+(\.\d*)?|\.\d+) ?(?P<unit>[kmgt])(?P<binary>i?)b?", re.IGNORECASE)


def gibibytes(text: str) -> float:
    """Parse a size such as 4GB, 600MB or 3.5GiB to GiB. The default unit is GiB.

    Raises:
        ValueError: the text is not a size.
    """
    match = _SIZE.fullmatch(text.strip())
    if match is None:
        return float(text)
    units = _BINARY if match["binary"] else _UNITS
    return float(match["count"]) * units[match["unit"].lower()] / _BINARY["g"]


Memory = Annotated[
    float,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="SIZE",
        instance_from_str=lambda words: gibibytes(words[0]),
        is_instance=lambda value: isinstance(value, int | float),
        str_from_instance=lambda value: [f"{value}GiB"],
    ),
]
"""Memory in GiB. The command line accepts sizes such as 4GB."""


def index_of(specified: float | None, scene: float | None = None) -> float:
    """Return the specified refractive index, the index in ``scene.json``, or ``INDEX``: the first that exists."""
    return next((index for index in (specified, scene) if index is not None), INDEX)


LARGEST_STOPS = 20.0
"""Largest absolute exposure in stops. Cameras cover about twenty stops."""


@dataclass(frozen=True)
class SceneOptions:
    """Options for reading a scene folder.

    Attributes:
        downscale: Factor of the reduction: pictures are averaged over boxes of this many pixels.
        transfer: Encoding of radiance in the files. Polarization needs linear; srgb undoes the display curve of
            JPEGs.
        memory: Memory limit, such as 4GB (the default unit is GiB). For a training, the limit of the process;
            elsewhere, of
            the pictures as their headers state. Default: 80 % of the free memory.
        split: Held-out views, one in eight, of a scene without split.json: directions spreads them among the others,
            every-8th counts through the names.
    """

    downscale: int = 1
    transfer: Transfer = "linear"
    memory: Memory | None = None
    split: Split = "directions"

    def __post_init__(self) -> None:
        check_count("downscale", self.downscale)
        if self.memory is not None:
            check_finite("memory", self.memory, LEAST_MEMORY, 1e6)


@dataclass(frozen=True)
class ModelOptions:
    """Options of a textured model (formats glb and usdz) or of its surface (stl).

    Attributes:
        triangles: Approximate number of triangles of the simplified surface.
        texture: Texels along the texture's side.
        jpeg: Write textures as JPEG, a third of the size of PNG.
        base_color: delit: the diffuse layer without its shading; diffuse: the layer with its shading; photographs;
            picture: the rendered picture with its highlights. Default: delit, or picture with unlit.
        albedo_scale: Factor on the base color. The learned light has no absolute scale, so one factor of a delit base
            color
            is unknown: choose the value that makes a gray card right.
        unlit: Show the color without shading, for viewers without light.
        close_bottom: Close surfaces that no camera saw with a plane, such as the bottom of an object on a table;
            always in
            an STL.
        masked: Restrict the model to the foreground of most of the scene's masks, in addition to the crop box.
    """

    triangles: int = 50_000
    texture: int = 2048
    jpeg: bool = False
    base_color: BaseColor | None = None
    albedo_scale: float = 1.0
    unlit: bool = False
    close_bottom: bool = False
    masked: bool = False

    def __post_init__(self) -> None:
        check_count("triangles", self.triangles, 100, 10_000_000)
        check_count("texture", self.texture, 64, 16_384)
        check_finite("albedo_scale", self.albedo_scale, 1e-3, 1e3)
        if self.base_color is not None:
            check_choice("base_color", self.base_color, get_args(BaseColor))

    @property
    def resolved_base_color(self) -> BaseColor:
        """Kind of base color. The default depends on the option ``unlit``."""
        return self.base_color or ("picture" if self.unlit else "delit")


@dataclass(frozen=True)
class NormalOptions:
    """Options of normal maps for other trainers (format normals).

    Attributes:
        layout: Program that reads the folder: brush or dn-splatter.
        picture: photograph; diffuse: the rendered diffuse layer; minimum: the least light behind a polarizer at any
            angle.
    """

    layout: NormalLayout = "brush"
    picture: TrainingPicture = "photograph"

    def __post_init__(self) -> None:
        check_choice("layout", self.layout, get_args(NormalLayout))
        check_choice("picture", self.picture, get_args(TrainingPicture))


@dataclass(frozen=True)
class ThreadOptions:
    """Use of the machine.

    Attributes:
        threads: Number of threads; 0: all cores.
    """

    threads: int = 0

    def __post_init__(self) -> None:
        check_count("threads", self.threads, 0, MOST_THREADS)


@dataclass(frozen=True)
class ComputeOptions(ThreadOptions):
    """Device and threads of a computation.

    Attributes:
        device: Device of the computation; auto: the GPU if there is one and gsplat is installed.
    """

    device: DeviceName = "auto"


@dataclass(frozen=True)
class VisitorOptions:
    """Web pages that may connect to the viewer, in addition to its own pages at an address of its machine.

    Attributes:
        allow_host: Host names, such as a tunnel's, under which the viewer may be opened, in addition to addresses and
            localhost.
        allow_origin: Names of sites, such as a proxy, whose pages may connect to the viewer.
    """

    allow_host: tuple[str, ...] = ()
    allow_origin: tuple[str, ...] = ()


@dataclass(frozen=True)
class SessionOptions(VisitorOptions, ComputeOptions):
    """Options of a training that do not change its result.

    Attributes:
        checkpoint_every: Steps between two checkpoints. A killed training loses at most as many.
        keep_optimizer: Keep the optimizer's state in the last checkpoint, which is then four times as large. Only
            your own
            code that continues the training needs it.
        viewer: Show the training in a browser (afterwards: polarguide view).
        viewer_host: Address of the viewer's server. Other machines can connect only to an address of the network
            (0.0.0.0:
            any).
        viewer_port: Port of the viewer's server. The next free port is taken if it is in use.
    """

    checkpoint_every: int = 500
    keep_optimizer: bool = False
    viewer: bool = False
    viewer_host: str = LOOPBACK[0]
    viewer_port: int = 8080

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("checkpoint_every", self.checkpoint_every)
        check_finite("viewer_port", self.viewer_port, 1, 65535)
