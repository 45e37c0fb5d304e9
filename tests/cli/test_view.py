"""``polarguide view`` and ``train --viewer`` as a user starts and stops them."""

import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from safetensors.torch import load_file

from polarguide.cli.app import run
from polarguide.core.system import network_address
from polarguide.runs.folder import CHECKPOINT, LOG

PATIENCE = 120.0


@pytest.fixture
def port() -> int:
    """One that is free now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def started(*arguments: str) -> tuple[subprocess.Popen[str], str]:
    """A process of the command line, and all that it printed up to the viewer's address."""
    command = [sys.executable, "-u", "-m", "polarguide", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    said = ""
    for line in process.stdout:
        said += line
        if line.startswith("viewer: "):
            break
    return process, said


def stop(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal, after which a process says one word more."""
    process.send_signal(number)
    rest, _ = process.communicate(timeout=PATIENCE)
    assert (process.returncode, rest.split()) == (130, ["stopped."])


@pytest.mark.slow
def test_view_serves_a_page_until_it_is_stopped(trained: Path, port: int) -> None:
    process, said = started("view", str(trained), "--port", str(port), "--threads", "1")
    assert f"viewer: http://127.0.0.1:{port}" in said
    assert "warning" not in said
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=PATIENCE) as answer:
        assert b"<html" in answer.read().lower()
    stop(process, signal.SIGINT)


@pytest.mark.slow
def test_view_warns_where_others_can_look_and_takes_a_free_port(trained: Path, port: int) -> None:
    with socket.socket() as listener:
        listener.bind(("0.0.0.0", port))
        listener.listen()
        process, said = started("view", str(trained), "--host", "0.0.0.0", "--port", str(port))
    stop(process, signal.SIGTERM)
    assert "there is no password" in said
    assert "viewer: http://127.0.0.1:" in said
    (tunnel,) = re.findall(r"ssh -L (\d+):127.0.0.1:\1 ", said)
    if (address := network_address()) is not None:
        assert f"from other machines: http://{address}:{tunnel}" in said
    assert f":{port}\n" not in said


def test_a_training_with_a_viewer_gives_the_same_bits(
    trained: Path, short: tuple[str, ...], demo_scene: Path, tmp_path: Path, port: int
) -> None:
    out = tmp_path / "run"
    watched = ("--viewer", "--viewer-port", str(port))
    assert run(["train", str(demo_scene), "--out", str(out), *short, *watched]) == 0
    expected, found = load_file(trained / CHECKPOINT), load_file(out / CHECKPOINT)
    assert expected.keys() == found.keys()
    assert all(expected[name].equal(found[name]) for name in expected)


@pytest.mark.slow
def test_a_training_with_a_viewer_is_stopped_as_any(demo_scene: Path, tmp_path: Path, port: int) -> None:
    flags = ("--downscale", "4", "--threads", "1", "--viewer", "--viewer-port", str(port))
    process, _ = started("train", str(demo_scene), "--out", str(tmp_path / "run"), *flags)
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=PATIENCE):
        give_up = time.monotonic() + PATIENCE
        while not (tmp_path / "run" / LOG).exists() and time.monotonic() < give_up:
            time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "--resume" in said
    assert (tmp_path / "run" / CHECKPOINT).exists()
