"""Every command and every Python block that README and get-started show works after a plain ``pip install .``.

They run as they are written, page by page, on small inputs, with options behind them that make them short. A command
that this file does not know how to shorten, or an input that it cannot make, is a failure. The first command and the
first Python block are processes of their own, as a user starts them; the others run in forks of a process of the same
environment that has imported the package.
"""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import write_mosaic, write_mosaics
from made_sensor import made_sensor, write_polarizer_shots
from plain_environment import declared, make_plain_environment
from relief import write_relief

from polarguide.capture.sensor.pattern import sensor_pattern, tiled
from polarguide.geometry.polarizer import ANGLES

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs" / "get-started").glob("*.md")))
# A fenced block, or a command or an expression of the API within a sentence.
SHOWN = re.compile(
    r"^```([^\n]*)\n(.*?)^```|`((?:polarguide [a-z]+ |pg\.)[^`\n]+)`", re.MULTILINE | re.DOTALL
)
CHOICES = re.compile(r"# (\w+(?: \| \w+)+)")

EXCLUDED = {
    "polarguide batch captures --out results": "trains several captures: tests/bench/test_collections.py",
    "polarguide prepare DATASET --out SCENE": "each dataset: tests/bench/datasets/test_prepare_datasets.py",
    "make demo": "makes .venv, and runs polarguide demo there",
    "make test": "runs this test",
    "make docs": "CI runs it",
    "make wheel": "takes minutes; what it builds is the module that test_wheel reads",
    "uv pip install --torch-backend=cpu 'dist/polarguide-0.2.0-*.whl'": "what make wheel does itself",
    "sudo apt-get install git g++ make python3-dev python3-venv": "of the system",
    "git clone REPOSITORY polarguide '&&' cd polarguide": "is where this test lies",
    "python3 -m venv .venv '&&' . .venv/bin/activate": "leaves the environment in which all others run here",
    "pip install uv": "another installer",
    "uv pip install --torch-backend=cpu .": "leaves the environment in which all others run here",
    "docker build --tag polarguide .": "needs Docker",
    "docker run --rm --volume '$PWD:/data' --user '$(id -u)' polarguide train SCENE --out runs/mine": "needs Docker",
}
SERVER = Path(__file__).with_name("served_commands.py")
STEPS = 120  # after so many the relief has a surface, of which a mesh can be made
SHORT = {
    "demo": ["--steps", "12"],
    "run": ["--steps", str(STEPS), "--downscale", "2", "--no-view"],
    "calibrate": [],
    "prepare": [],
    "inspect": ["--steps", "50"],
    "train": ["--steps", str(STEPS), "--downscale", "2"],
    "eval": [],
    "view": [],
    "render": [],
    "present": [],
    "share": [],
    "export": ["--resolution", "32"],
    "synth": [],
    "priors": [],
    "priors --run": ["--downscale", "2"],  # as the run was trained
    "measure": [],
    "doctor": [],
}
"""What is added to each verb, or to a verb with an option: it may do less, and has to do it in the same way."""
SHORT_PYTHON = {r"steps=\d+": f"steps={STEPS}", r'load_scene\("SCENE"\)': 'load_scene("SCENE", downscale=2)'}
"""As ``SHORT``, for blocks of Python."""
WITHOUT_EXTRA = ("synth",)
"""Verbs that may say in one line what they lack."""
PATIENCE = 900.0
"""Seconds for one command: a busy machine is slow."""


def raw_mosaics(folder: Path) -> None:
    """The relief as a color polarization camera of twice the size records it."""
    shots = folder.with_name("shots-of-raw")
    names = write_relief(shots)
    pattern = sensor_pattern("IMX250MYR")
    assert pattern.colors is not None
    for name in names:
        four = [cv2.imread(str(shots / str(angle) / f"{name}.png"), cv2.IMREAD_UNCHANGED) for angle in ANGLES]
        seen = np.stack([picture[..., ::-1].repeat(2, 0).repeat(2, 1) for picture in four]) / 65535
        size = seen.shape[1:3]
        angles = tiled(np.vectorize(ANGLES.index)(pattern.angles), size)
        row, column = np.indices(size)
        write_mosaic(folder / f"{name}.png", seen[angles, row, column, tiled(pattern.colors, size)])


def single_shots(folder: Path) -> None:
    """One picture of each view of the relief, at an angle that its name does not tell."""
    shots = folder.with_name("shots-of-singles")
    folder.mkdir()
    for number, name in enumerate(write_relief(shots)):
        shutil.copy(shots / str(ANGLES[number % 4]) / f"{name}.png", folder / f"{name}.png")


def numbered_shots(folder: Path) -> None:
    """Four pictures of each view of the relief in a row, with running numbers as names."""
    shots = folder.with_name("shots-of-numbered")
    folder.mkdir()
    for number, name in enumerate(write_relief(shots)):
        for turn, angle in enumerate(ANGLES):
            shutil.copy(shots / str(angle) / f"{name}.png", folder / f"IMG_{4 * number + turn:04d}.png")


def photographs(folder: Path) -> None:
    """Pictures of the relief in color, without a filter."""
    shots = folder.with_name("shots-of-photographs")
    folder.mkdir()
    for name in write_relief(shots):
        pair = [cv2.imread(str(shots / angle / f"{name}.png"), cv2.IMREAD_UNCHANGED) for angle in ("0", "90")]
        light = (pair[0] / 2 + pair[1] / 2) * [0.6, 0.8, 1.0]
        cv2.imwrite(str(folder / f"{name}.png"), light.astype(np.uint16))


def polarizer_shots(folder: Path) -> None:
    """A polarizer before the sensor, every 15 degrees."""
    write_polarizer_shots(folder.parent, made_sensor("IMX250MYR"), [15.0 * k for k in range(12)])
    (folder.parent / "shots").rename(folder)


def one_part(path: Path) -> None:
    """One mosaic of a monochrome sensor."""
    write_mosaics(path.with_name("parts-of-one"), 1, color=False)
    shutil.copy(path.with_name("parts-of-one") / "v000.png", path)


INPUTS: dict[str, dict[str, Callable[[Path], object]]] = {
    "calibrate": {"SHOTS": polarizer_shots},
    "run": {"RAW": raw_mosaics, "SHOTS": write_relief, "NUMBERED": numbered_shots},
    "prepare": {"RAW": raw_mosaics, "SHOTS": write_relief, "PHOTOS": photographs},
    "prepare --angles": {"SHOTS": single_shots},
    "priors": {"part.png": one_part},
    "measure": {"PARTS": lambda folder: write_mosaics(folder, 2, color=False)},
}
"""What is made for a verb before it is called; everything else comes from the commands above it."""


def shown(page: Path) -> Iterator[tuple[str, str]]:
    """What a page shows, from the top down: ("sh", a command line) or ("python", code)."""
    for language, block, span in SHOWN.findall(page.read_text(encoding="utf-8")):
        assert span or language in ("sh", "python") or language.startswith("{"), (
            f"{page}: how to run {language}?"
        )
        if language == "python" or span.startswith("pg."):
            yield "python", block or f"import polarguide as pg\n{span}\n"
        elif language == "sh" or span:
            for line in (block or span).replace("\\\n", " ").splitlines():
                yield from (("sh", command) for command in commands(line))


def commands(line: str) -> list[str]:
    """The command of a line; one for each choice where its comment lists what may stand in place of a word."""
    command = shlex.join(shlex.split(line, comments=True))
    choices = CHOICES.search(line)
    listed = choices[1].split(" | ") if choices else []
    words = shlex.split(command)
    place = next((words.index(word) for word in listed if word in words), None)
    if place is None:
        return [command] if command else []
    return [shlex.join([*words[:place], choice, *words[place + 1 :]]) for choice in listed]


class Reader:
    """Somebody who types what the pages show, each command once, in a folder of their own."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self.programs, self.folder = programs, folder
        self.typed = set(EXCLUDED)
        self.environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
        self.environment["PATH"] = f"{programs}{os.pathsep}{self.environment['PATH']}"
        self.started: set[str] = set()
        self.server: subprocess.Popen[str] | None = None

    def end(self) -> None:
        """End the process from which commands are forked."""
        if self.server is not None:
            self.server.communicate(timeout=PATIENCE)

    def command(self, text: str) -> None:
        """Run a command line of the shell. What it needs is made; what was there before under such names comes back."""
        program, verb, *words = shlex.split(text)
        assert program == "polarguide", f"how to run {text}? Add it to EXCLUDED, with the reason"
        assert verb in SHORT, f"how to shorten {text}? Add {verb} to SHORT"
        kind = next((f"{verb} {word}" for word in words if f"{verb} {word}" in INPUTS), verb)
        made = {name: make for name, make in INPUTS.get(kind, {}).items() if name in words}
        outputs = [words[k + 1] for k, word in enumerate(words) if word in ("--out", "--video")]
        before = self.set_aside([*made, *outputs])
        for name, make in made.items():
            make(self.folder / name)
        short = next((SHORT[f"{verb} {word}"] for word in words if f"{verb} {word}" in SHORT), SHORT[verb])
        whole = [program, verb, *words, *short]
        if verb == "view":
            self.visit(whole)
        elif verb in WITHOUT_EXTRA:
            self.turned_away(whole, outputs)
        else:
            self.run(whole)
            for name in outputs:
                assert (self.folder / name).exists(), f"{text} has not written {name}"
        self.restore(before)

    def python(self, code: str) -> None:
        """Run a block of code, with few steps."""
        before = self.set_aside(["runs/mine"] if "pg.train(" in code else [])
        for long, short in SHORT_PYTHON.items():
            code = re.sub(long, short, code)
        self.run(["python", "-W", "error", "-c", code])
        self.restore(before)

    def run(self, words: list[str], status: int = 0) -> str:
        """Run a program; returns what it printed."""
        first = words[0] not in self.started
        self.started.add(words[0])
        found, text = self.run_started(words) if first else self.run_forked(words)
        assert found == status, f"{shlex.join(words)}\n{text}"
        return text

    def run_started(self, words: list[str]) -> tuple[int, str]:
        """In a process of its own; its exit status, and what it printed."""
        done = subprocess.run(
            [self.programs / words[0], *words[1:]],
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE,
        )
        return done.returncode, done.stdout

    def run_forked(self, words: list[str]) -> tuple[int, str]:
        """In a fork of a process that has imported the package; as ``run_started``."""
        if self.server is None:
            self.server = subprocess.Popen(
                [self.programs / "python", SERVER],
                cwd=self.folder,
                env=self.environment,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        asked = {"code": words[-1]} if words[0] == "python" else {"words": words}
        self.server.stdin.write(json.dumps({"folder": str(self.folder), **asked}) + "\n")
        self.server.stdin.flush()
        answer = json.loads(self.server.stdout.readline())
        return answer["status"], answer["text"]

    def turned_away(self, words: list[str], outputs: list[str]) -> None:
        """Run a command whose extra is not installed: one line says how to add it, and nothing is written."""
        (line,) = self.run(words, status=2).splitlines()
        assert re.search(r"pip install '?mitsuba", line), line
        assert not any((self.folder / name).exists() for name in outputs)

    def visit(self, words: list[str]) -> None:
        """Start what serves a page, fetch the page, and stop it as Ctrl-C does."""
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            port = listener.getsockname()[1]
        with subprocess.Popen(
            [self.programs / words[0], *words[1:], "--port", str(port)],
            cwd=self.folder,
            env=self.environment | {"PYTHONUNBUFFERED": "1"},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as process:
            said = ""
            for line in process.stdout:
                said += line
                if line.startswith("viewer: "):
                    with urllib.request.urlopen(line.split()[1], timeout=PATIENCE) as answer:
                        assert b"<html" in answer.read().lower()
                    process.send_signal(signal.SIGINT)
        assert process.returncode == 130, said

    def set_aside(self, names: list[str]) -> list[str]:
        """Make room for outputs: those that are there already move away; returns their names."""
        there = [name for name in names if (self.folder / name).exists()]
        for name in there:
            (self.folder / name).rename(self.folder / f"{name}.before")
        return there

    def restore(self, names: list[str]) -> None:
        """Put back what was set aside, in place of what was written meanwhile."""
        for name in names:
            self.remove(name)
            (self.folder / f"{name}.before").rename(self.folder / name)

    def remove(self, name: str) -> None:
        path = self.folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_plain_environment(tmp_path_factory.mktemp("plain") / "venv")


@pytest.fixture(scope="module")
def reader(programs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    made = Reader(programs, tmp_path_factory.mktemp("reader"))
    yield made
    made.end()


def test_the_environment_has_what_is_declared_and_no_more(programs: Path) -> None:
    listing = "import importlib.metadata as m; print(*(d.metadata['Name'] for d in m.distributions()))"
    names = subprocess.run([programs / "python", "-c", listing], text=True, capture_output=True, check=True)
    assert {re.sub(r"[-_.]+", "-", name).lower() for name in names.stdout.split()} == set(declared())
    for module in ("pytest", "mitsuba", "torchmetrics"):
        tried = subprocess.run([programs / "python", "-c", f"import {module}"], capture_output=True)
        assert b"ModuleNotFoundError" in tried.stderr


@pytest.mark.slow
@pytest.mark.parametrize("page", [pytest.param(page, id=page.stem) for page in PAGES if any(shown(page))])
def test_what_a_page_shows_works(page: Path, reader: Reader, request: pytest.FixtureRequest) -> None:
    steps = list(shown(page))
    first = next((text for _, text in steps if "runs/mine" in text), "")
    if first and " train " not in first and not (reader.folder / "runs" / "mine").exists():
        # Of an earlier page, which was not run.
        shutil.copytree(request.getfixturevalue("trained"), reader.folder / "runs" / "mine")
    for kind, text in steps:
        if text not in reader.typed:
            print(text)
            reader.command(text) if kind == "sh" else reader.python(text)
            reader.typed.add(text)


def test_all_pages_are_read() -> None:
    """What is excluded is still shown somewhere, and so are commands and code."""
    found = [step for page in PAGES for step in shown(page)]
    assert set(EXCLUDED) <= {text for _, text in found}
    assert {text.split()[1] for kind, text in found if kind == "sh" and text not in EXCLUDED} == {
        verb for verb in SHORT if " " not in verb
    }
    assert sum(kind == "python" for kind, _ in found) >= 3
    assert {f"polarguide export runs/mine --format {name}" for name in ("ply", "spz", "cameras")} <= {
        text for _, text in found
    }
