"""Errors, texts and reports: what a user reads."""

import importlib.metadata
import math
import shlex
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from polarguide.core import errors
from polarguide.core.errors import install_extra, install_package
from polarguide.core.progress import SILENT
from polarguide.core.text import command, decimal

REQUIRES = ["viser==1.1.*", "scikit-image>=0.22", "flip-evaluator>=1.6; python_version < '3.14'",
            'mitsuba==3.9.*; extra == "synth"', "torchmetrics>=1.4; extra == 'lpips'",
            'mitsuba==3.9.*; extra == "test"']  # fmt: skip


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Pretends that the package lies in an environment."""
    monkeypatch.setattr(shutil, "which", lambda name: str(Path(sys.executable).with_name(name)))

    def pretend() -> None:
        folder = tmp_path / "lib" / "polarguide-1.dist-info"
        folder.mkdir(parents=True)
        lines = [
            "Metadata-Version: 2.1",
            "Name: polarguide",
            *(f"Requires-Dist: {line}" for line in REQUIRES),
        ]
        (folder / "METADATA").write_text("\n".join(lines))
        monkeypatch.setattr(importlib.metadata.Distribution, "discover", classmethod(discover))

    def discover(*_: object, **__: object) -> Iterator[importlib.metadata.Distribution]:
        return iter([importlib.metadata.PathDistribution(tmp_path / "lib" / "polarguide-1.dist-info")])

    return pretend


def test_an_extra_is_named_by_its_packages(installed) -> None:
    """Never by itself: from a source folder that would compile polarguide once more."""
    installed()
    assert install_extra("synth") == "pip install 'mitsuba==3.9.*'"
    assert install_extra("lpips") == "pip install 'torchmetrics>=1.4'"


def test_printed_commands_can_be_pasted() -> None:
    assert command("eval", Path("runs/my run")) == "polarguide eval 'runs/my run'"
    assert command("train", "s", "--out", "it's") == """polarguide train s --out 'it'"'"'s'"""


def test_packages_have_the_versions_that_are_required(installed) -> None:
    installed()
    assert (
        install_package("viser")
        == install_package("websockets.asyncio.server")
        == "pip install 'viser==1.1.*'"
    )
    assert install_package("skimage.measure") == "pip install 'scikit-image>=0.22'"
    assert install_package("flip_evaluator") == "pip install 'flip-evaluator>=1.6'"
    assert install_package("unheard_of") == "pip install unheard-of"


def test_the_pip_of_another_python_is_not_used(installed, monkeypatch: pytest.MonkeyPatch) -> None:
    installed()
    monkeypatch.setattr(shutil, "which", lambda name: f"/elsewhere/bin/{name}")
    assert shlex.split(install_package("viser")) == [sys.executable, "-m", "pip", "install", "viser==1.1.*"]


@pytest.mark.parametrize(
    ("text", "value"), [("1.5", 1.5), (" -3e2 ", -300.0), ("inf", math.inf), ("007", 7.0)]
)
def test_numbers(text: str, value: float) -> None:
    assert decimal(text) == value


@pytest.mark.parametrize("text", ["1_0", "4_5.0", "\u0664\u0665", "\uff11", "", "a", "0x10"])
def test_what_python_alone_takes_for_a_number_is_none(text: str) -> None:
    with pytest.raises(ValueError, match=r"not a number|could not convert"):
        decimal(text)


def test_the_default_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    SILENT.say("a")
    SILENT.warn("b")
    with SILENT.track("c", None) as advance:
        advance(1, total=2, note="d")
    assert capsys.readouterr() == ("", "")


def test_a_library_that_takes_ctrl_c_gives_it_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "takes_ctrl_c.py").write_text("import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    assert errors.optional_import("takes_ctrl_c", "a test").__name__ == "takes_ctrl_c"
    assert signal.getsignal(signal.SIGINT) is before
