"""Run by torchrun: trains the tiny scene, once for each job of a JSON file, and writes every rank's state.

A job is an object: ``out``, into which OUT/RANK is written, ``steps``, ``views`` a step, ``until`` which step, and
``begun``, a folder with a checkpoint to go on from ("" for none). Processes start once for all, which takes seconds.
"""

import json
import sys
from pathlib import Path

import torch
import torch.distributed as dist
from tiny import make_busy_recipe, make_scene

from polarguide.raster import choose_backend
from polarguide.runs.folder import load_checkpoint, resolve, save_checkpoint
from polarguide.training.angles.fits import gaussian_training
from polarguide.training.context import TrainingContext
from polarguide.training.distributed import SeveralRanks
from polarguide.training.settings import TrainSettings

torch.set_num_threads(1)
dist.init_process_group("gloo")
ranks = SeveralRanks()
scene, recipe, backend = make_scene(), make_busy_recipe(), choose_backend("cpu")
for job in json.loads(Path(sys.argv[1]).read_text()):
    settings = resolve(TrainSettings(job["steps"], 3, views_per_step=job["views"]), scene, recipe)
    state = load_checkpoint(Path(job["begun"]), recipe) if job["begun"] else None
    trainer, _ = gaussian_training(TrainingContext(scene, recipe, settings, backend, ranks), state)
    trainer.run(job["until"])
    folder = Path(job["out"], str(ranks.rank))
    folder.mkdir(parents=True)
    save_checkpoint(folder, trainer.saved_state())
    ranks.barrier()
dist.destroy_process_group()
# Threads of the group that outlive it may abort the interpreter as it ends.
left = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
assert not [name for name in left if "gloo" in name], left
