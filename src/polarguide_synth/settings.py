"""Settings of a rendering, changes to a scene, and the start of Mitsuba."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from polarguide.capture.sensor.pattern import SENSORS, Sensor, any_case, sensor_named
from polarguide.core.errors import optional_import, require
from polarguide.core.options import LARGEST_STOPS, picture_size
from polarguide.core.records import check_options
from polarguide.core.text import decimals
from polarguide_synth.schema import SceneSpec, parse_scene, read_scene_file

VARIANT = "llvm_ad_mono_polarized"
"""Variant of Mitsuba that renders the three channels one after the other, with exact values."""
OLDEST_LLVM = 16
"""Oldest supported version of LLVM. Earlier versions crash on newer processors."""
PATHS_PER_SECOND = 200_000.0
"""Approximate number of paths per second and thread."""
LONG_SECONDS = 3600.0
"""Estimated duration of a rendering above which the estimate is printed."""


class _Library:
    """Placeholder for a library of the extra ``synth``, which is imported on first use because it may be missing."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(optional_import(self._module, "synth"), name)


dr: Any = _Library("drjit")
mi: Any = _Library("mitsuba")


def start_mitsuba(*, threads: int = 0) -> None:
    """Load Mitsuba, and select the variant that supports polarization.

    Args:
        threads: number of threads; 0 uses all cores.

    Raises:
        PolarguideError: Mitsuba or its compiler LLVM is not installed.
    """
    with _silent_stderr():
        mi.variant()  # the import prints messages
        missing = missing_llvm()
    require(
        not missing,
        "synth",
        expected=f"LLVM {OLDEST_LLVM} or newer as a shared library",
        found=missing,
        remedy="On Debian, run apt-get install libllvm19. Elsewhere, set DRJIT_LIBLLVM_PATH to the library.",
    )
    if threads:
        dr.set_thread_count(threads)


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard the messages that native code writes to the error stream."""
    sys.stderr.flush()
    stderr = os.dup(2)
    with open(os.devnull, "wb") as null:
        os.dup2(null.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


def missing_llvm() -> str:
    """Return the reason why LLVM cannot be used. The text is empty if it can be used."""
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    if path and not os.path.exists(path):  # otherwise the library prints messages
        return f"DRJIT_LIBLLVM_PATH names {path}, which does not exist"
    try:
        mi.set_variant(VARIANT)
        version = dr.detail.llvm_version()
    except (ImportError, RuntimeError):
        return "none was found"
    return "" if version[0] >= OLDEST_LLVM else f"found {'.'.join(map(str, version))}"


def rough_time(seconds: float) -> str:
    """Format an estimated duration."""
    hours = seconds / 3600
    return f"about {hours:.0f} hours" if hours >= 2 else f"about {max(2.0, hours * 60):.0f} minutes"


PRESETS = (
    *("figure", "kit", "car", "cup", "water"),
    *("metals-a", "metals-b", "ceramic-a", "ceramic-b", "rough", "lacquer"),
    *("alloys", "frame", "glossy", "proof"),
)
"""Names of the scenes that are part of the package."""
TEST_EVERY = 8
"""Default interval of held-out views. 8 is common in reports of 3DGS."""


@dataclass(frozen=True)
class SynthSettings:
    """Settings of the rendering and of the simulated camera.

    Attributes:
        size: Width and height of the pictures. A simulated polarization sensor has twice as many pixels in each
            direction.
        samples: Paths per pixel and lobe. Held-out views use four times as many.
        seed: Seed of every random draw.
        sensor: Sensor whose 12-bit raw mosaics are also written, for polarguide prepare. filter writes one 8-bit JPEG
            of each view, through a filter before an ordinary camera.
        noise: Photon and read noise. 1 simulates an exposure to full scale, 2 an exposure with a quarter of that light,
            0 no noise.
        exposures: Exposures of each mosaic or photograph in stops, such as 0,-3,-6. By default, one normal exposure.
        color: Representation of color in records. Earlier versions could also sample a spectrum.
        ground_truth: Views for which ground truth is written.
        points: Approximate number of sparse points.
        test_every: Interval of held-out views.
    """

    size: str = "256x192"
    samples: Annotated[int, Meta(ge=1, le=65536)] = 64
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    sensor: Annotated[
        Literal["ideal", "filter"] | Sensor,
        any_case("ideal", *SENSORS, "filter"),
    ] = "ideal"
    noise: Annotated[float, Meta(ge=0, le=100)] = 0.0
    exposures: str | None = None
    color: Literal["rgb"] = field(default="rgb", init=False)
    ground_truth: Literal["test", "all"] = "test"
    points: Annotated[int, Meta(ge=0)] = 5000
    test_every: Annotated[int, Meta(ge=2)] = TEST_EVERY

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensor", sensor_named(self.sensor))

    @property
    def width(self) -> int:
        """Width of the pictures in pixels."""
        return picture_size(self.size)[0]

    @property
    def height(self) -> int:
        """Height of the pictures in pixels."""
        return picture_size(self.size)[1]

    @property
    def stops(self) -> tuple[float, ...]:
        """Exposures of each file of the sensor in stops."""
        return (0.0,) if self.exposures is None else decimals(self.exposures)

    def data(self) -> dict[str, Any]:
        """Return the settings as JSON data."""
        values = asdict(self)
        del values["size"]
        values["sensor"] = self.sensor.lower()  # as in requests of earlier versions
        # Requests of earlier versions lack these settings.
        if self.test_every == TEST_EVERY:
            del values["test_every"]
        if self.exposures is None:
            del values["exposures"]
        return {"width": self.width, "height": self.height, **values}

    def check(self) -> None:
        """Validate the settings.

        Raises:
            PolarguideError: a value is out of range.
        """
        check_options(self)
        picture_size(self.size)
        stops = self.stops
        require(
            0 < len(stops) == len(set(stops)) and all(abs(stop) <= LARGEST_STOPS for stop in stops),
            "--exposures",
            expected=f"different exposures in stops up to {LARGEST_STOPS:g}, such as 0,-3,-6",
            found=repr(self.exposures),
            remedy="Separate the numbers by commas.",
        )
        require(
            self.exposures is None or self.sensor != "ideal",
            "--exposures",
            expected="a --sensor whose files are written, such as IMX250MYR or filter",
            found="--sensor ideal",
            remedy="Specify a sensor, and --noise 1 for sensor noise.",
        )


@dataclass(frozen=True)
class Overrides:
    """Changes to a scene for controlled studies. None keeps the value of the scene.

    Attributes:
        views: Number of views. Default: the number in the scene.
        spacing: Angle in degrees between neighboring views on a ring.
        roughness: Roughness of all plastic objects in the foreground.
        index: Refractive index of all plastic objects in the foreground.
    """

    views: int | None = None
    spacing: float | None = None
    roughness: float | None = None
    index: float | None = None

    def apply(self, spec: SceneSpec) -> SceneSpec:
        """Return the scene with the changes.

        Raises:
            PolarguideError: a value is out of range.
        """
        changes = {name: value for name, value in asdict(self).items() if value is not None}
        data = spec.data()
        data["camera"] |= {name: value for name, value in changes.items() if name in ("views", "spacing")}
        for thing in data["things"]:
            if thing["foreground"] and thing["material"]["type"] == "plastic":
                thing["material"] |= {k: v for k, v in changes.items() if k in ("roughness", "index")}
        return parse_scene(data, f"{spec.name} with the flags", folder=spec.folder)


def find_scene(name: str) -> SceneSpec:
    """Read a preset by name, or a scene file by path.

    Raises:
        PolarguideError: the preset or file does not exist, or the file is invalid.
    """
    if name in PRESETS:
        with resources.as_file(resources.files("polarguide_synth") / "presets" / f"{name}.json") as path:
            return read_scene_file(path)
    require(
        Path(name).is_file(),
        name,
        expected=f"a scene file, or the name of a preset ({', '.join(PRESETS)})",
        found="neither",
        remedy="Check the spelling or the path. docs/reference/scene-files.md describes scene files.",
    )
    return read_scene_file(Path(name))
