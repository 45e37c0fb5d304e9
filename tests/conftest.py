"""For all tests: one thread for torch, because their tensors are too small for several to pay."""

import torch

torch.set_num_threads(1)
