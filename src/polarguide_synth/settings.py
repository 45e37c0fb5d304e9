"""Options beyond the scene itself, and the scene with these applied."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from polarguide.capture.sensor.pattern import SENSORS, Sensor, any_case, sensor_named
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.options import picture_size
from polarguide.core.records import check_options
from polarguide_synth.schema import SceneSpec, parse_scene, read_scene_file

Color = Literal["rgb", "spectral"]
OLDEST_LLVM = 16
"""Older ones crash on processors that are newer than they are."""
SLOW_PATHS_PER_SECOND = 800.0
"""Paths per second of the scalar variant, which has no threads: a rough figure of the presets."""
FAST_PATHS_PER_SECOND = 200_000.0
"""Paths per second of each thread of a compiled variant."""
LONG_SECONDS = 3600.0
"""Longer than anybody who typed a command waits beside it: then it should be meant."""


class _Library:
    """A library of the extra ``synth``: it may be missing, and is imported when something in it is first used."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(optional_import(self._module, "synth"), name)


dr: Any = _Library("drjit")
mi: Any = _Library("mitsuba")


@dataclass(frozen=True)
class Variant:
    """A variant of Mitsuba that has been made current.

    Attributes:
        name: Mitsuba's name.
        color: "rgb" renders three channels one after the other, each with exact values; "spectral" follows four
            wavelengths a path and converts.
        paths_per_second: a rough figure for this machine.
        note: the reason for a slow variant; else empty.
    """

    name: str
    color: Color
    paths_per_second: float
    note: str = ""

    @property
    def channels(self) -> int:
        """Renderings per picture."""
        return 3 if self.color == "rgb" else 1


def choose_variant(color: Color = "rgb", *, threads: int = 0) -> Variant:
    """Select a polarized variant: a fast one if the LLVM library can be loaded, else the scalar one.

    Args:
        color: how colors are rendered; the scalar variant supports "spectral" only.
        threads: threads to use; 0 takes all cores.

    Raises:
        PolarguideError: Mitsuba is not installed.
    """
    with _silent_stderr():
        mi.variant()  # imports it
        missing = missing_llvm()
    if not missing:
        mi.set_variant("llvm_ad_mono_polarized" if color == "rgb" else "llvm_ad_spectral_polarized")
        if threads:
            dr.set_thread_count(threads)
        speed = FAST_PATHS_PER_SECOND * (threads or os.cpu_count() or 1)
        return Variant(mi.variant(), color, speed)
    with _silent_stderr():
        mi.set_variant("scalar_spectral_polarized")
    note = (
        f"Mitsuba's fast variants need LLVM {OLDEST_LLVM} or newer as a shared library ({missing}); on Debian "
        "'apt-get install libllvm19', elsewhere set DRJIT_LIBLLVM_PATH. The slow scalar variant is used."
    )
    return Variant(mi.variant(), "spectral", SLOW_PATHS_PER_SECOND, note)


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Suppress what a library writes to the error stream past Python while it loads."""
    sys.stderr.flush()
    stderr = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


def missing_llvm() -> str:
    """Why LLVM cannot be used; empty if it can."""
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    if path and not os.path.exists(path):  # otherwise the library prints messages
        return f"DRJIT_LIBLLVM_PATH names {path}, which does not exist"
    try:
        mi.set_variant("llvm_ad_mono_polarized")
        version = dr.detail.llvm_version()
    except (ImportError, RuntimeError):
        return "none was found"
    if version[0] >= OLDEST_LLVM:
        return ""
    return f"found {'.'.join(str(part) for part in version)}"


def rough_time(seconds: float) -> str:
    """An estimated time as text."""
    hours = seconds / 3600
    return f"about {hours:.0f} hours" if hours >= 2 else f"about {max(2.0, hours * 60):.0f} minutes"


PRESETS = (
    *("figure", "kit", "car", "cup", "water"),
    *("metals-a", "metals-b", "ceramic-a", "ceramic-b", "rough", "lacquer"),
    *("glossy", "proof"),
)
TEST_EVERY = 8
"""As reports of 3DGS do."""


@dataclass(frozen=True)
class SynthSettings:
    """How a scene is rendered and recorded.

    Attributes:
        size: Width and height of the pictures; a simulated polarization sensor has twice as many pixels each way.
        samples: Paths per pixel and lobe; test views take four times as many.
        seed: Seed of every random draw.
        sensor: A sensor whose 12-bit raw mosaics are also written, for polarguide prepare; filter: one 8-bit JPEG of
            each view, through a filter before an ordinary camera.
        noise: Photon and read noise: 1 is a sensor exposed to full scale, 2 a quarter of that light, 0 none.
        color: Three channels with exact values, or a sampled spectrum.
        ground_truth: Views that get ground truth.
        points: Sparse points to look for.
        test_every: One view in so many is held out.
    """

    size: str = "256x192"
    samples: Annotated[int, Meta(ge=1, le=65536)] = 64
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    sensor: Annotated[
        Literal["ideal", "filter"] | Sensor,
        any_case("ideal", *SENSORS, "filter"),
    ] = "ideal"
    noise: Annotated[float, Meta(ge=0, le=100)] = 0.0
    color: Color = "rgb"
    ground_truth: Literal["test", "all"] = "test"
    points: Annotated[int, Meta(ge=0)] = 5000
    test_every: Annotated[int, Meta(ge=2)] = TEST_EVERY

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensor", sensor_named(self.sensor))

    @property
    def width(self) -> int:
        """Of the pictures."""
        return picture_size(self.size)[0]

    @property
    def height(self) -> int:
        """Of the pictures."""
        return picture_size(self.size)[1]

    def data(self) -> dict[str, Any]:
        """As JSON."""
        values = asdict(self)
        del values["size"]
        values["sensor"] = self.sensor.lower()  # as folders of earlier versions have it
        if self.test_every == TEST_EVERY:  # folders of versions without this setting go on
            del values["test_every"]
        return {"width": self.width, "height": self.height, **values}

    def check(self) -> None:
        """Raises PolarguideError where a value makes no sense."""
        check_options(self)
        picture_size(self.size)


@dataclass(frozen=True)
class Overrides:
    """Changes to a scene for controlled studies; None leaves what the scene says.

    Attributes:
        views: Number of views; without it what the scene says.
        spacing: Degrees between neighboring views on a ring.
        roughness: Roughness of all plastic objects in the foreground.
        index: Refractive index of these.
    """

    views: int | None = None
    spacing: float | None = None
    roughness: float | None = None
    index: float | None = None

    def apply(self, spec: SceneSpec) -> SceneSpec:
        """The scene with the changes."""
        changes = {name: value for name, value in asdict(self).items() if value is not None}
        data = spec.data()
        data["camera"] |= {name: value for name, value in changes.items() if name in ("views", "spacing")}
        for thing in data["things"]:
            if thing["foreground"] and thing["material"]["type"] == "plastic":
                thing["material"] |= {k: v for k, v in changes.items() if k in ("roughness", "index")}
        # The changes have to pass the checks of a file.
        return parse_scene(data, f"{spec.name} with the flags", folder=spec.folder)


def find_scene(name: str) -> SceneSpec:
    """A preset by name, or a scene file by path.

    Raises:
        PolarguideError: there is neither, or the file is wrong.
    """
    if name in PRESETS:
        with resources.as_file(resources.files("polarguide_synth") / "presets" / f"{name}.json") as path:
            return read_scene_file(path)
    if not Path(name).is_file():
        raise PolarguideError(
            name,
            expected=f"a scene file, or the name of a preset ({', '.join(PRESETS)})",
            found="neither",
            remedy="Check the spelling or the path. docs/reference/scene-files.md describes scene files.",
        )
    return read_scene_file(Path(name))
