"""For all tests: the demo scene, one thread for torch, and closing lines that say what was skipped and why.

The reason of a skip names what is missing and, behind an arrow, the command that brings it.
"""

import contextlib
import os
import signal
from collections import Counter
from pathlib import Path

import pytest

# Tensors are small here, and threads that wait by spinning slow every test that runs beside them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from reduced_demo import write_reduced_demo
from tiny import make_busy_recipe, make_scene

import polarguide
from polarguide.capture import Scene
from polarguide.core.options import SceneOptions, SessionOptions
from polarguide.training.recipe import Recipe
from polarguide.training.settings import TrainSettings

torch.set_num_threads(1)
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as a shell starts what runs in its background
    signal.signal(signal.SIGINT, signal.default_int_handler)
with contextlib.suppress(ImportError):  # a machine that runs the GPU's tests alone has none
    import hypothesis

    # An example's time says how busy the machine is.
    hypothesis.settings.register_profile("untimed", hypothesis.settings(), deadline=None)
    hypothesis.settings.load_profile("untimed")

STEPS = 40
SHORT = ("--downscale", "4", "--steps", str(STEPS), "--threads", "1")


@pytest.fixture(scope="session")
def demo_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the scene that ships with the package, with 14 of its 50 views. Tests leave it as it is."""
    return write_reduced_demo(tmp_path_factory.mktemp("reduced") / "demo")


@pytest.fixture(scope="session")
def whole_demo() -> Path:
    """The folder of the scene that ships with the package."""
    return polarguide.demo_scene()


@pytest.fixture(scope="session")
def trained(demo_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder. Tests read it and leave it as it is."""
    out = tmp_path_factory.mktemp("trained") / "run"
    polarguide.train(
        demo_scene,
        out,
        settings=TrainSettings(STEPS),
        reading=SceneOptions(downscale=4),
        session=SessionOptions(threads=1),
    )
    return out


@pytest.fixture(scope="session")
def short() -> tuple[str, ...]:
    """The flags with which ``trained`` was trained."""
    return SHORT


@pytest.fixture(scope="session")
def tiny_scene() -> Scene:
    return make_scene()


@pytest.fixture
def busy_recipe() -> Recipe:
    return make_busy_recipe()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: at the end, one of them would keep one worker busy and leave the others idle."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What was skipped, by reason, the most frequent first."""
    reasons = Counter(skip_reason(report) for report in terminalreporter.stats.get("skipped", ()))
    if reasons:
        terminalreporter.section("skipped, and the command that changes it")
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} skipped: {reason}")


def skip_reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    """The reason of a skip, with the command for a package that could not be imported."""
    assert isinstance(report.longrepr, tuple)
    reason = str(report.longrepr[2]).removeprefix("Skipped: ")
    lacking = reason.startswith("could not import") and " -> " not in reason
    return f"{reason} -> pip install '.[test]'" if lacking else reason
