"""``polarguide synth``: a scene as data -> a scene folder with ground truth."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarguide.camera import Camera
from polarguide.capture.write import write_png, write_view
from polarguide.progress import Reporter
from polarguide.synth import folder
from polarguide.synth.bounds import require_unicode
from polarguide.synth.build import BuiltScene, build_scene
from polarguide.synth.cameras import held_out_names, place_cameras, view_names
from polarguide.synth.film import LobeRadiance, render_lobes
from polarguide.synth.filter_shots import FilterShot, filter_jpeg, plan_shot
from polarguide.synth.geometry import ground_truth_maps
from polarguide.synth.manifest import verify_scene, write_manifest
from polarguide.synth.mesh import Array
from polarguide.synth.record import scene_record
from polarguide.synth.schema import SceneSpec
from polarguide.synth.sensor import Sensor, mosaic, noisy
from polarguide.synth.settings import SynthSettings
from polarguide.synth.sheet import write_sheet
from polarguide.synth.sparse import sample_sparse_points, write_model
from polarguide.synth.transport import PathLimits
from polarguide.synth.variant import choose_variant, slow_estimate

TEST_SAMPLES = 4
METER_VIEWS, METER_SAMPLES, METER_WIDTH = 4, 16, 64
BRIGHT = 1.5


@dataclass(frozen=True, eq=False)
class Job:
    """All that the rendering of a view needs."""

    built: BuiltScene
    settings: SynthSettings
    out: Path
    names: list[str]
    tests: list[str]
    cameras: list[Camera]
    exposure: float
    sensor: Sensor

    @property
    def mosaics(self) -> bool:
        """Whether raw mosaics are written."""
        return self.settings.sensor.startswith("imx")

    def photograph(self, number: int) -> tuple[FilterShot, Path] | None:
        """How a view is photographed through a filter, and the file; None where it is not."""
        if self.settings.sensor != "filter":
            return None
        shot = plan_shot(self.settings.seed, number)
        return shot, self.out / "raw" / f"{self.names[number]}_a{shot.body_angle}.jpg"

    def has_ground_truth(self, name: str) -> bool:
        """Whether a view gets ground truth."""
        return self.settings.ground_truth == "all" or name in self.tests

    def files(self, name: str) -> list[Path]:
        """The files of a view."""
        files = folder.view_files(self.out, name, ground_truth=self.has_ground_truth(name), raw=self.mosaics)
        photograph = self.photograph(self.names.index(name))
        return files if photograph is None else [*files, photograph[1]]


def synthesize(
    spec: SceneSpec, out: Path, settings: SynthSettings, reporter: Reporter, *, threads: int = 0
) -> Path:
    """Render a scene, or go on with a rendering that was stopped.

    Args:
        spec: the scene.
        out: folder to write.
        settings: how.
        reporter: told what is going on.
        threads: threads to use; 0 takes all cores.

    Raises:
        PolarguideError: Mitsuba is missing, the folder holds something else, or the scene has a mistake.
    """
    settings.check()
    require_unicode(out)
    if folder.open_folder(out, folder.scene_request(spec, settings)):
        verify_scene(out)
        reporter.say(f"{out} is finished already; all its files have their checksums.")
        return out
    variant = choose_variant(settings.color, threads=threads)
    names = view_names(spec.camera.views)
    tests = held_out_names(names, settings.test_every)
    if variant.note:
        views = len(names) + (TEST_SAMPLES - 1) * len(tests)
        paths = settings.width * settings.height * settings.samples * views
        reporter.warn(f"{variant.note} It will take {slow_estimate(paths)} on this scene.")
    built = build_scene(spec, out, variant)
    cameras = place_cameras(spec.camera, settings.width, settings.height, settings.seed)
    exposure = spec.exposure or _metered_exposure(built, cameras, settings.seed)
    job = Job(built, settings, out, names, tests, cameras, exposure, Sensor())
    _render_all(job, reporter)
    write_sparse(built, cameras, names, tests, out, settings)
    clipped = folder.clipped_share(out, names)
    record = scene_record(spec, settings, variant, names, tests, exposure=exposure, clipped=clipped)
    if job.mosaics:
        gains = {str(45 * k): gain for k, gain in enumerate(job.sensor.gains)}
        folder.write_file(out / "calibration.json", json.dumps({"gains": gains}).encode())
        record["sensor"] = {"name": settings.sensor.upper(), **job.sensor.data()}
    if settings.sensor == "filter":
        record["shots"] = {name: asdict(plan_shot(settings.seed, k)) for k, name in enumerate(names)}
    with_truth = [number for number, name in enumerate(names) if job.has_ground_truth(name)]
    if with_truth:
        write_sheet(out, [names[k] for k in with_truth], [cameras[k] for k in with_truth])
    record["sha256"] = write_manifest(out)
    folder.write_file(out / "scene.json", json.dumps(record, indent=1).encode())
    return out


def _render_all(job: Job, reporter: Reporter) -> None:
    """Render the views that are not finished."""
    left = [number for number, name in enumerate(job.names) if not all(f.exists() for f in job.files(name))]
    if len(left) < len(job.names):
        reporter.say(f"Going on: {len(job.names) - len(left)} of {len(job.names)} views are finished.")
    with reporter.track(f"rendering {job.built.spec.name}", len(job.names)) as progress:
        progress(len(job.names) - len(left))
        for done, number in enumerate(left, 1):
            _render_view(job, number)
            progress(len(job.names) - len(left) + done)


def _render_view(job: Job, number: int) -> None:
    """Render one view and write its files."""
    settings, name, camera = job.settings, job.names[number], job.cameras[number]
    samples = settings.samples * (TEST_SAMPLES if name in job.tests else 1)
    big = camera.scaled(2, 2 * camera.width, 2 * camera.height) if job.mosaics else camera
    if job.mosaics:
        samples = max(1, samples // 4)
    spec = job.built.spec
    limits = PathLimits(spec.depth, spec.clamp / job.exposure, shown_only=spec.object_only)
    light = render_lobes(job.built.scenes, big, samples, seed=settings.seed * 100003 + number, limits=limits)
    random = np.random.default_rng((settings.seed, 31, number))
    if job.mosaics:
        raw = mosaic(light.stokes * job.exposure, settings.sensor.upper(), settings.noise, random, job.sensor)
        write_png(job.out / "raw" / f"{name}.png", raw)
        light = LobeRadiance(_halved(light.specular), _halved(light.diffuse), _halved(light.emitted))
    stokes = light.stokes * job.exposure
    if job.has_ground_truth(name):
        arrays: dict[str, Any] = ground_truth_maps(job.built, camera)
        arrays["stokes"] = stokes.astype(np.float16)
        arrays["specular"] = (light.specular[0] * job.exposure).astype(np.float16)
        arrays["diffuse"] = (light.diffuse[0] * job.exposure).astype(np.float16)
        data = io.BytesIO()
        np.savez_compressed(data, **arrays)
        folder.write_file(job.out / "gt" / f"{name}.npz", data.getvalue())
    photograph = job.photograph(number)
    if photograph is not None:
        rays = camera.rays(dtype=torch.float64).numpy()
        shot, path = photograph
        folder.write_file(path, filter_jpeg(stokes, rays, shot, settings.noise, random, job.sensor))
    # With a sensor the noise is in its files, and these pictures are what they should lead to.
    noise = settings.noise if settings.sensor == "ideal" else 0.0
    codes = folder.sensor_codes(stokes, lambda values: noisy(values, noise, random, job.sensor))
    write_view(job.out, name, codes)


def write_sparse(
    built: BuiltScene,
    cameras: list[Camera],
    names: list[str],
    tests: list[str],
    out: Path,
    settings: SynthSettings,
) -> None:
    """Write the COLMAP model of rendered views, and the split into training and test views."""
    pictures = [folder.photograph(out, name) for name in names]
    sparse = sample_sparse_points(built, cameras, pictures, settings.points, settings.seed)
    write_model(out / "sparse" / "0", cameras, names, sparse)
    folder.write_file(out / "split.json", json.dumps({"test": tests}).encode())


def _metered_exposure(built: BuiltScene, cameras: list[Camera], seed: int) -> float:
    """The exposure by which 1 % of S0 in some small pictures lies above ``BRIGHT``, three quarters of full scale."""
    values = []
    for camera in cameras[:: -(-len(cameras) // METER_VIEWS)]:
        factor = max(1, camera.width // METER_WIDTH)
        limits = PathLimits(built.spec.depth, shown_only=built.spec.object_only)
        small = camera.downscaled(factor)
        light = render_lobes(built.scenes, small, METER_SAMPLES, seed=seed, limits=limits)
        values.append(light.stokes[0].ravel())
    return float(f"{BRIGHT / max(float(np.percentile(np.concatenate(values), 99)), 1e-9):.4g}")


def _halved(values: Array) -> Array:
    """Means over boxes of 2x2 pixels: [..., 2H, 2W, 3] to [..., H, W, 3]."""
    *lead, height, width, colors = values.shape
    boxes = values.reshape(*lead, height // 2, 2, width // 2, 2, colors)
    return np.asarray(boxes.mean(axis=(-4, -2)))
