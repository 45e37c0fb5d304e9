"""Run by torchrun: trains the tiny scene and writes every rank's state to OUT/RANK. Arguments: OUT, STEPS, VIEWS."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import torch.distributed as dist
from tiny import make_busy_recipe, make_scene

from polarguide.raster import choose_backend
from polarguide.training.ranks import SeveralRanks
from polarguide.training.run import save_checkpoint
from polarguide.training.trainer import Trainer, TrainSettings

torch.set_num_threads(1)
out, steps, views = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
dist.init_process_group("gloo")
ranks = SeveralRanks()
settings = TrainSettings(steps, 3, views_per_step=views)
trainer = Trainer(make_scene(), make_busy_recipe(), settings, choose_backend("cpu"), ranks=ranks)
trainer.run(lambda _: None)
trainer.exchange_statistics()
folder = out / str(ranks.rank)
folder.mkdir(parents=True)
save_checkpoint(folder, trainer.state)
ranks.wait()
dist.destroy_process_group()
