"""Nothing but an exception ends a kernel: not a lack of memory or threads, not another number of threads meanwhile."""

import os
import subprocess
import sys

import pytest

# Ever more memory until it suffices; in between lie limits that only the scratch of the workers exceeds.
WITHOUT_MEMORY = """
import resource
import torch
from polarguide import _native
from polarguide.geometry.camera import Camera
from polarguide.raster import Splats
from polarguide.raster.cpu import rasterize_cpu

def picture():
    random = torch.Generator().manual_seed(0)
    nothing = torch.zeros(3, dtype=torch.float64)
    camera = Camera(128, 128, 128, 128, 64, 64, torch.eye(3, dtype=torch.float64), nothing)
    means = torch.randn(60000, 3, generator=random) * 0.05 + torch.tensor([0.0, 0.0, 3.0])
    splats = Splats(means, torch.randn(60000, 4, generator=random), torch.full((60000, 3), 0.05),
                    torch.full((60000,), 0.02), torch.rand(60000, 30, generator=random))
    return rasterize_cpu(splats, camera).features

_native.set_thread_count(4)
whole = picture()
refused = 0
for spare in range(0, 400, 4):
    held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + (spare << 20), resource.RLIM_INFINITY))
    try:
        found = picture()
        break
    except MemoryError:
        refused += 1
    except RuntimeError as error:  # of PyTorch
        assert "can't allocate memory" in str(error), error
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
assert torch.equal(found, whole)
print("refused", refused)
"""
# A kernel of three parts that share the scratch of the workers.
WITH_OTHERS = """
import sys, threading
import numpy as np
from polarguide import _native

made = np.random.default_rng(0).random((2, 800, 800, 3), dtype=np.float32)
gradient = np.empty_like(made[0])
sys.setswitchinterval(1e-5)  # neither thread waits long for the other
_native.set_thread_count(1)
expected, done = _native.photometric(*made, None, 640000.0, 0.2, gradient), False

def change():
    while not done:
        _native.set_thread_count(1)
        _native.set_thread_count(8)

other = threading.Thread(target=change, daemon=True)
other.start()
for _ in range(15):
    assert _native.photometric(*made, None, 640000.0, 0.2, gradient) == expected
done = True
other.join()
print("done")
"""
# Their stacks do not fit; some of them have begun by then.
WITHOUT_THREADS = """
import resource
import numpy as np
from polarguide import _native

made = np.zeros((2, 16, 16, 3), np.float32)
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + (200 << 20), resource.RLIM_INFINITY))
_native.set_thread_count(1000)
try:
    _native.photometric(*made, None, 256.0, 0.2, None)
except RuntimeError as error:
    print(error)
_native.set_thread_count(2)
_native.photometric(*made, None, 256.0, 0.2, None)
"""


def run(script: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=300
    )


@pytest.mark.skipif(sys.platform != "linux", reason="it limits the address space as Linux does")
def test_without_memory_a_kernel_raises_and_the_next_one_works() -> None:
    ended = run(WITHOUT_MEMORY)
    assert ended.returncode == 0, ended.stderr
    word, refused = ended.stdout.split()
    assert word == "refused"
    assert int(refused) > 1


@pytest.mark.skipif(sys.platform != "linux", reason="it limits the address space as Linux does")
def test_threads_that_cannot_be_started_are_an_error() -> None:
    ended = run(WITHOUT_THREADS)
    assert (ended.returncode, ended.stdout) == (0, "can't start new thread\n"), ended.stderr


def test_the_number_of_threads_may_change_while_kernels_work() -> None:
    ended = run(WITH_OTHERS)
    assert (ended.returncode, ended.stdout) == (0, "done\n"), ended.stderr
