"""Compare a training step of this checkout with another checkout, on the same trained Gaussians, in turns.

    python benchmarks/speed/against.py RUN --before CHECKOUT... [--threads 1] [--turns 5] [--steps 40]

Each checkout has its own process with its own code (``CHECKOUT/src``, with its native module built there) and its own
recipe of that name. They take turns, so that only one runs at a time. Steps are those of the longest stage. Each step
runs twice, and the second is timed, so the computation of priors is not included. Prints the median milliseconds, and
the median over the turns of the ratio. Run it without other work on the machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]

# Only features of both checkouts: the other one may be much older.
WORKER = """
import sys, time
sys.path[:] = [path for path in sys.path if path]
import numpy as np, torch
from polarguide.capture import load_scene

try:
    from polarguide.core.system import keep_freed_memory
except ImportError:
    keep_freed_memory = lambda: None
from polarguide.raster import choose_backend

try:
    from polarguide.raster import use_threads
except ImportError:
    use_threads = torch.set_num_threads
from polarguide.methods import RECIPES

try:
    from polarguide.runs.folder import resolve
except ImportError:
    resolve = lambda settings, *of: settings

try:
    from polarguide.training.settings import TrainSettings
except ImportError:
    from polarguide.training.trainer import TrainSettings

try:
    from polarguide.training.angles.polarizers import gaussian_training
    from polarguide.training.context import TrainingContext
    def Trainer(*inputs):
        return gaussian_training(TrainingContext(*inputs))[0]
except ImportError:
    from polarguide.training.trainer import Trainer

scene, downscale, recipe, gaussians, threads = sys.argv[1:]
keep_freed_memory()
use_threads(int(threads))
scene = load_scene(scene, downscale=int(downscale))
settings = resolve(TrainSettings(5000, 0), scene, RECIPES[recipe])
trainer = Trainer(scene, RECIPES[recipe], settings, choose_backend("cpu"))

stored, trained = np.load(gaussians), getattr(trainer.state, "gaussians", None) or trainer.state.rows
count = len(stored["means"])
trained.keep(torch.arange(count) % len(trained))
for name in trained.names:
    if name in stored:
        trained.overwrite(name, torch.from_numpy(stored[name]))

if hasattr(trainer.state, "statistics"):
    trainer.state.statistics.clear(count)
else:
    trainer.begin(trainer.current, trainer.state)

longest = max(RECIPES[recipe].stages, key=lambda stage: stage.fraction)
every = RECIPES[recipe].densification.every
calm = [
    step for step in range(1, 4999)
    if trainer.schedule.at(step).stage is longest and not trainer.schedule.at(step).actions and (step + 1) % every
]
place = 0

def step(number):
    for _ in range(2):  # the first computes the priors of the view
        trainer.state.step = calm[number % len(calm)]
        begin = time.perf_counter()
        trainer.step()
    return 1000 * (time.perf_counter() - begin)

step(0)
print("ready", len(trained), flush=True)
for line in sys.stdin:
    found = [step(place + number) for number in range(int(line))]
    place += int(line)
    print(" ".join(f"{value:.3f}" for value in found), flush=True)
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--before", type=Path, nargs="+", required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--steps", type=int, default=40)
    options = parser.parse_args()

    import numpy as np

    from polarguide import open_run

    run = open_run(options.run, device="cpu")
    camera = run.scene.train_views[0].camera
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "gaussians.npz"
        values = run.gaussians
        np.savez(file, **{name: values[name].detach().numpy() for name in values})
        workers = []
        for checkout in (HERE, *options.before):
            environment = {
                **os.environ,
                "PYTHONPATH": str(checkout.resolve() / "src"),
                "OMP_WAIT_POLICY": "PASSIVE",
                "POLARGUIDE_THREADS": str(options.threads),
            }
            words = (
                run.scene.root,
                run.scene.downscale,
                run.recipe.name.partition(":")[0],
                file,
                options.threads,
            )
            workers.append(
                subprocess.Popen(
                    [sys.executable, "-c", WORKER, *map(str, words)],
                    env=environment,
                    text=True,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                )
            )
            print(f"{checkout.name}: {workers[-1].stdout.readline().strip()} Gaussians", flush=True)  # type: ignore[union-attr]
        rows: list[list[float]] = []
        for _ in range(options.turns):
            rows.append([])
            for worker in workers:
                assert worker.stdin is not None
                assert worker.stdout is not None
                worker.stdin.write(f"{options.steps}\n")
                worker.stdin.flush()
                rows[-1].append(statistics.median(map(float, worker.stdout.readline().split())))
        for worker in workers:
            worker.communicate()
    print(
        f"{run.recipe.name}, {camera.width} x {camera.height}, {options.threads} threads, {options.turns} turns"
    )
    for place, checkout in enumerate((HERE, *options.before)):
        ratio = statistics.median(row[place] / row[0] for row in rows)
        print(
            f"{checkout.name}: {statistics.median(row[place] for row in rows):.1f} ms, {ratio:.2f} of this checkout's"
        )


if __name__ == "__main__":
    main()
