"""One process that has imported everything, from which cases are forked: a fresh start takes seconds, a fork none."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import importlib
import io
import os
import sys
from pathlib import Path

os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE", POLARGUIDE_THREADS="1")
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "helpers")]

SHELL = 150  # Gaussians far away, of a run that is spoiled: the fewer, the cheaper is every case
IMPORTED = (
    "encodings.cp437",  # of zip archives; a child without rights could not import it
    "networkx",
    "pycolmap",
    "scipy.spatial",
    "torch._dynamo",  # which the first optimizer of a process imports
    "trimesh",
    "typeguard",
    "polarguide.api.captures",
    "polarguide.api.runs",
    "polarguide_bench.compare",
    "polarguide.preparation.prepare",
)


def warm_up() -> None:
    """Import all, and let recipes begin with fewer Gaussians."""
    import_all()
    _shrink(importlib.import_module("polarguide.methods.registry"))


def import_all() -> None:
    """Import what the verbs import, and compute what they keep; starts no thread, which a fork would lose."""
    for name in IMPORTED:
        importlib.import_module(name)
    importlib.import_module("torch").set_num_threads(1)
    importlib.import_module("cv2").setNumThreads(1)
    app = importlib.import_module("polarguide.cli.app")
    for verb in app.VERBS:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
            app.run([verb, "--help"])
    importlib.import_module("polarguide.results.evaluation.evaluate").code_digest()
    tasks = Path("/proc/self/task")
    threads = [(task / "comm").read_text().strip() for task in tasks.iterdir()] if tasks.exists() else []
    assert len(threads) <= 1, (
        f"threads would be lost in a fork, and with them the locks that they hold: {threads}"
    )
    gc.collect()
    gc.freeze()


def _shrink(registry: object) -> None:
    for recipes in (registry.RECIPES, registry._BUILT_IN):  # type: ignore[attr-defined]
        for name, recipe in recipes.items():
            if hasattr(recipe, "initialization"):  # others have no Gaussians
                start = dataclasses.replace(recipe.initialization, shell=SHELL)
                recipes[name] = dataclasses.replace(recipe, initialization=start)
