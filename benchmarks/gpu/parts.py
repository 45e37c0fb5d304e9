"""Run a part of ``make gpu-check`` in its own process: ``parts.py NAME --pack DIR --out DIR``.

A part writes OUT/NAME.json. The long training stops when its time is up and resumes in the next call.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from contenders import Ours, Plain, split_to
from measure import milliseconds, peak_mib
from packed import SUFFIX, enlarged, read_scene

import polarguide
from polarguide.capture import Scene
from polarguide.gaussians.gaussians import Gaussians
from polarguide.methods import RECIPES
from polarguide.raster import Backend, choose_backend
from polarguide.raster.cuda import has_gsplat
from polarguide.results.evaluation.metrics import psnr
from polarguide.runs.folder import CHECKPOINT, load_checkpoint, resolve, save_checkpoint
from polarguide.shading.gbuffer import render
from polarguide.training.angles.polarizers import gaussian_training
from polarguide.training.context import TrainingContext, TrainingState
from polarguide.training.settings import TrainSettings

RECIPE = RECIPES["polarguide"]


@dataclass(frozen=True)
class Job:
    """Arguments of a part.

    Attributes:
        pack: folder of the scenes.
        out: output folder.
        backend: measured backend.
        tiny: True for a dry run on a CPU.
        seconds: time limit.
    """

    pack: Path
    out: Path
    backend: Backend
    tiny: bool
    seconds: float

    def scene(self, name: str) -> Scene:
        """Return a packed scene. A dry run uses few views of the demo instead."""
        scene = read_scene(self.pack / f"{'demo' if self.tiny else name}{SUFFIX}")
        if not self.tiny:
            return scene
        keep = (*scene.train_views[:4], *scene.test_views[:1])
        return Scene(**{**scene.__dict__, "views": keep, "test_names": (keep[-1].name,)})


def train_on(job: Job, name: str, steps: int, folder: Path) -> dict[str, Any]:
    """Train ``polarguide`` until the time is up, resuming the previous call."""
    folder.mkdir(parents=True, exist_ok=True)
    begin, clock = time.perf_counter(), folder / "seconds.json"
    spent = json.loads(clock.read_text()) if clock.exists() else 0.0
    there = (folder / CHECKPOINT).exists()
    state = load_checkpoint(folder, RECIPE, job.backend.device) if there else None
    scene = job.scene(name)
    settings = resolve(TrainSettings(steps, 0), scene, RECIPE)
    trainer, _ = gaussian_training(TrainingContext(scene, RECIPE, settings, job.backend), state)

    def busy() -> bool:
        return trainer.state.step < steps and time.perf_counter() - begin < job.seconds

    while busy():
        trainer.run(min(steps, trainer.state.step + 100))
        wait(job.backend.device)
    spent += time.perf_counter() - begin
    save_checkpoint(folder, trainer.state)
    clock.write_text(json.dumps(spent))
    finished = trainer.state.step == steps
    found = {
        "steps": trainer.state.step,
        "of": steps,
        "minutes": spent / 60,
        "gaussians": len(trainer.state.gaussians),
    }
    found["psnr"] = mean_psnr(scene, trainer.state, job.backend) if finished else None
    return {"finished": finished, **found}


@torch.no_grad()
def mean_psnr(scene: Scene, state: TrainingState, backend: Backend) -> float:
    """Return the mean over the test views, in decibels."""
    shading, values = RECIPE.shading, []
    for view in scene.test_views:
        picture = render(
            state.gaussians, view.camera, backend.rasterize, shading=shading, light=state.light
        ).final
        values.append(psnr(picture, view.photograph(), ~view.invalid))
    return sum(values) / len(values)


def wait(device: torch.device) -> None:
    """Wait until the GPU has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def bench(job: Job, scene: Scene, state: TrainingState) -> dict[str, Any]:
    """Compare our steps with plain gsplat on the same Gaussians."""
    device, few = job.backend.device, job.tiny
    repeats, warm_up = (2, 1) if few else (40, max(10, len(scene.train_views) + 2))
    initial = state.gaussians.snapshot()

    def timed(call: Callable[[], object]) -> float:
        return milliseconds(call, device, repeats=repeats, warm_up=warm_up)

    ours = Ours(scene, state, job.backend)
    found: dict[str, Any] = {"gaussians": len(state.gaussians)}
    camera = scene.train_views[0].camera
    found["size"] = [camera.width, camera.height]
    whole, forward, look = timed(ours.step), timed(ours.forward), timed(ours.look)
    parts = {name: timed(call) for name, call in ours.parts().items()}
    found["ours"] = {
        "forward_ms": forward,
        "forward_backward_ms": look,
        "step_ms": whole,
        "parts_ms": parts,
        "outside": 1 - sum(parts.values()) / whole,
        "fps": 1e3 / timed(lambda: ours.frame(layers=False)),
        "fps_layers": 1e3 / timed(lambda: ours.frame(layers=True)),
        "peak_mib": peak_mib(ours.step, device),
    }
    if device.type != "cuda" or not has_gsplat():
        found["plain"] = None
        return found
    plain = Plain(scene, initial, device)
    forward, look, whole = timed(plain.forward), timed(plain.look), timed(plain.step)
    found["plain"] = {
        "forward_ms": forward,
        "forward_backward_ms": look,
        "step_ms": whole,
        "fps": 1e3 / timed(plain.frame),
        "peak_mib": peak_mib(plain.step, device),
    }
    found["step_ratio"] = found["ours"]["step_ms"] / whole
    found["fps_ratio"] = found["ours"]["fps"] / found["plain"]["fps"]
    return found


def build(job: Job) -> dict[str, Any]:
    """Describe the machine. This also compiles gsplat."""
    found: dict[str, Any] = {
        "polarguide": polarguide.__version__,
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "python": platform.python_version(),
        "device": str(job.backend.device),
    }
    if job.backend.device.type == "cuda":
        found["device"] = torch.cuda.get_device_name(job.backend.device)
        found["capability"] = list(torch.cuda.get_device_capability(job.backend.device))
    return found


def trained(job: Job, name: str) -> TrainingState:
    """Return the state of the short training of a scene."""
    return load_checkpoint(job.out / f"train-{name}", RECIPE, job.backend.device)


def stress(job: Job) -> dict[str, Any]:
    """Measure a million Gaussians at 1224 x 1024."""
    count, size = (10_000, (96, 80)) if job.tiny else (1_000_000, (1224, 1024))
    state = trained(job, "spheres")
    gaussians = Gaussians(split_to(state, count), RECIPE.rates)
    state = TrainingState(0, gaussians, state.environment)
    return bench(job, enlarged(job.scene("spheres"), *size, views=8), state)


def parts_of(tiny: bool) -> dict[str, Callable[[Job], dict[str, Any]]]:
    """Return the parts in their order."""
    short, paper = (10, 20) if tiny else (3000, 97_000)

    def train_short(name: str) -> Callable[[Job], dict[str, Any]]:
        return lambda job: train_on(job, name, short, job.out / f"train-{name}")

    return {
        "build": build,
        "train-demo": train_short("demo"),
        "train-spheres": train_short("spheres"),
        "bench-demo": lambda job: bench(job, job.scene("demo"), trained(job, "demo")),
        "bench-spheres": lambda job: bench(job, job.scene("spheres"), trained(job, "spheres")),
        "bench-stress": stress,
        "train-long": lambda job: train_on(job, "spheres", paper, job.out / "train-long"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=tuple(parts_of(True)))
    parser.add_argument("--pack", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--seconds", type=float, default=400.0)
    arguments = parser.parse_args()
    backend = choose_backend(arguments.device)
    job = Job(arguments.pack, arguments.out, backend, arguments.tiny, arguments.seconds)
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = {"finished": True, **parts_of(arguments.tiny)[arguments.part](job)}
    path = arguments.out / f"{arguments.part}.json"
    path.with_suffix(".tmp").write_text(json.dumps(found, indent=1) + "\n")
    path.with_suffix(".tmp").replace(path)


if __name__ == "__main__":
    main()
