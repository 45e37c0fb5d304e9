"""Run by torchrun: trains the tiny scene and writes every rank's state to OUT/RANK.

Arguments: OUT, STEPS, VIEWS, and where to stop and a folder with a checkpoint to go on from ("" for none).
"""

import sys
from pathlib import Path

import torch
import torch.distributed as dist
from tiny import make_busy_recipe, make_scene

from polarguide.raster import choose_backend
from polarguide.runs.defaults import resolve
from polarguide.runs.folder import load_checkpoint, save_checkpoint
from polarguide.training.distributed import SeveralRanks
from polarguide.training.settings import TrainSettings
from polarguide.training.trainer import Trainer

torch.set_num_threads(1)
out, steps, views, until = Path(sys.argv[1]), *(int(number) for number in sys.argv[2:5])
dist.init_process_group("gloo")
ranks = SeveralRanks()
scene, recipe, backend = make_scene(), make_busy_recipe(), choose_backend("cpu")
settings = resolve(TrainSettings(steps, 3, views_per_step=views), scene, recipe)
state = load_checkpoint(Path(sys.argv[5]), recipe) if sys.argv[5] else None
trainer = Trainer(scene, recipe, settings, backend, state, ranks)
trainer.run(lambda _: None, until=until)
trainer.exchange_statistics()
folder = out / str(ranks.rank)
folder.mkdir(parents=True)
save_checkpoint(folder, trainer.state)
ranks.barrier()
dist.destroy_process_group()
# Threads of the group that outlive it may abort the interpreter as it ends.
left = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
assert not [name for name in left if "gloo" in name], left
