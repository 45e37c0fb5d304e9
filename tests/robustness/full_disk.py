"""Commands on a disk that is full: a small tmpfs of this process alone, with less room than they need.

python tests/robustness/full_disk.py [--only TEXT] [--shares 0 0.5 ...]

A command writes to the disk once without a limit; then again and again with a share of the room that it took. It has to
end with one line, and to leave every file as it was, as the undisturbed command wrote it, or whole at least. The same
command, once there is room, has to end with the bytes of the undisturbed one and without temporary files. Takes Linux,
and the right to mount: root, or namespaces of users.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import hashlib
import importlib
import json
import os
import shutil
import sys
import tempfile
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from warm import warm_up  # it puts the helpers on the path

from base import EVAL, MOSAICS, READ, make_base  # isort: skip
from forked import ERROR  # isort: skip
from random_runs import ring  # isort: skip
from tiny_capture import NAMES  # isort: skip

CLONE_NEWNS, CLONE_NEWUSER = 0x00020000, 0x10000000
MS_REMOUNT, MS_REC, MS_PRIVATE = 32, 1 << 14, 1 << 18
LARGE = 1 << 30
SHARES = (0.0, 0.1, 0.35, 0.6, 0.85, 0.97)
STEPS = "12"
NO_MOUNT = 77
"""Exit status where nothing may be mounted."""
VARYING = {"log.jsonl", "results.json", "results.md", "results.csv", "results.tex", "report.html", "stderr.txt",
           "metrics.json", "inputs.json", "inspection.html", "inspection.json", "alone.txt"}  # fmt: skip
"""Files with times in them."""
UNCOUNTED = {".lock", "stderr.txt"}

libc = ctypes.CDLL(None, use_errno=True)
Command = Callable[[], list[str]] | Callable[[], None]


def own_mounts() -> bool:
    """Give this process mounts of its own, before it has a thread; whether that is allowed."""
    user, group = os.getuid(), os.getgid()
    if libc.unshare(CLONE_NEWNS | (CLONE_NEWUSER if user else 0)):
        return False
    with contextlib.suppress(OSError):
        if user:
            Path("/proc/self/setgroups").write_text("deny")
            Path("/proc/self/uid_map").write_text(f"0 {user} 1")
            Path("/proc/self/gid_map").write_text(f"0 {group} 1")
        return not libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None)
    return False


def mount(disk: Path, size: int, *, again: bool = False) -> bool:
    """Mount a tmpfs of so many bytes, or give the one that is there another size."""
    options = f"size={size}".encode()
    return not libc.mount(b"tmpfs", bytes(disk), b"tmpfs", MS_REMOUNT if again else 0, options)


def used(disk: Path) -> int:
    """Bytes in use."""
    about = os.statvfs(disk)
    return (about.f_blocks - about.f_bfree) * about.f_frsize


def train() -> list[str]:
    """A training, gone on with where it has begun."""
    more = ["--resume"] if Path("new/run.json").exists() else []
    return ["train", "scene", "--out", "new", "--steps", STEPS, "--checkpoint-every", "3", "--threads", "1", "--device",
            "cpu", *more]  # fmt: skip


def fix() -> None:
    """``inspect --fix`` with the order that it would have found; it is not decided on so small a scene."""
    capture = importlib.import_module("polarguide.inspection.capture").read_capture(Path("scene"))
    calibration = importlib.import_module("polarguide.capture.calibration").Calibration(
        order=(90, 45, 0, 135)
    )
    importlib.import_module("polarguide.inspection.corrections").fix_scene(capture, calibration, Path("new"))


EXPORTS = ("ply", "spz", "sog", "environment", "cameras")
SURFACES = ("mesh", "points")
"""Of the run ``round``: so short a training has none."""
COMMANDS: dict[str, Command] = {
    "train": train,
    "eval": lambda: EVAL,
    "prepare": lambda: MOSAICS,
    "render": lambda: ["render", "run", "--out", "new", "--device", "cpu"],
    "render npy": lambda: ["render", "run", "--out", "new", "--device", "cpu", "--format", "npy"],
    "render exr": lambda: ["render", "run", "--out", "new", "--device", "cpu", "--format", "exr"],
    "render video": lambda: ["render", "run", "--path", "orbit", "--video", "new.mp4", "--frames", "3"],
    "priors": lambda: READ,
    "inspect": lambda: ["inspect", "scene", "--out", "new", "--normals", "points"],
    "inspect --fix": fix,
    "share": lambda: ["share", "run", "--out", "new/page.html"],
    **{f"export {kind}": lambda kind=kind: ["export", "run", "--format", kind, "--out", "new"] for kind in EXPORTS},
    **{f"export {kind}": lambda kind=kind: ["export", "round", "--format", kind, "--out", "new", "--resolution", "24"]
       for kind in SURFACES},
    "compare": lambda: ["compare", "scene", "--recipes", "3dgs", "polarguide", "--steps", STEPS, "--out", "new"],
    "synth": lambda: ["synth", "proof", "--out", "new", "--size", "16x16", "--samples", "1"],
    "bench": lambda: ["bench", "--out", "new"],
}  # fmt: skip
AT_ONCE_ONLY = {"bench"}
"""Too long to wait for: on a disk without any room alone."""
STARTS = {"compare", "synth", "bench"}
"""Start further programs, or import for seconds."""


def make_round(base: Path) -> None:
    """A run with a surface: opaque Gaussians about the origin, in a scene whose cameras stand around it."""
    safetensors = importlib.import_module("safetensors.torch")
    rotation = importlib.import_module("scipy.spatial.transform").Rotation
    torch = importlib.import_module("torch")
    shutil.copytree(base / "scene", base / "circle")
    rows = []
    for number, (name, camera) in enumerate(zip(NAMES, ring(len(NAMES)).values(), strict=True), 1):
        x, y, z, w = rotation.from_matrix(camera.rotation.numpy()).as_quat()
        numbers = " ".join(map(str, (number, w, x, y, z, *camera.translation.tolist(), 1)))
        rows.append(f"{numbers} {name}.png\n\n")
    (base / "circle/sparse/0/images.txt").write_text("".join(rows))
    shutil.copytree(base / "run", base / "round")
    record = json.loads((base / "round/run.json").read_text())
    (base / "round/run.json").write_text(json.dumps({**record, "scene": str(base / "circle")}))
    tensors = safetensors.load_file(base / "round/checkpoint.safetensors")
    count = len(tensors["gaussians.means"])
    tensors["gaussians.means"] = 0.4 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    tensors["gaussians.log_scales"].fill_(-1.5)
    tensors["gaussians.opacity_logits"].fill_(6.0)
    safetensors.save_file(tensors, base / "round/checkpoint.safetensors")


def in_a_fork(act: Callable[[], None]) -> None:
    """Do something in a child, so that this process computes nothing."""
    pid = os.fork()
    if not pid:
        code = 1
        try:
            act()
            code = 0
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(code)
    assert not os.waitpid(pid, 0)[1]


def ended(command: Command, disk: Path, said: Path) -> int:
    """Run a command in a fork, on the disk; its exit status."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    code = 99
    with contextlib.suppress(BaseException):
        words = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(words, 1)
        os.dup2(words, 2)
        os.chdir(disk / "case")
        code = _run(command)
    os._exit(code)


def _run(command: Command) -> int:
    arguments: list[str] = []

    def called() -> list[str]:
        arguments.extend(command() or [])
        return arguments

    app = importlib.import_module("polarguide.cli.app")
    try:
        called()
    except importlib.import_module("polarguide.core.errors").PolarguideError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2
    return int(app.run(arguments)) if arguments else 0


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file but locks."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in UNCOUNTED
    }


def is_whole(path: Path) -> bool:
    """Whether a file that is neither as before nor as in the end can be read to its end."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".safetensors":
            importlib.import_module("safetensors.numpy").load_file(path)
        elif path.suffix == ".npz":
            with zipfile.ZipFile(path) as file:
                return file.testzip() is None
        elif path.suffix == ".html":
            return path.read_text().rstrip().endswith("</html>")
        elif path.suffix == ".jsonl":  # a line that is cut short is passed over
            return True
        else:
            return path.name in VARYING and path.stat().st_size > 0
    except Exception:
        return False
    return True


def faults(name: str, share: float, base: Path, disk: Path, whole: tuple[dict[str, str], int]) -> list[str]:
    """What is wrong after a command with a share of its room, and after it was repeated."""
    command, (expected, room), said = COMMANDS[name], whole, disk.parent / "said"
    begin(base, disk)
    before = digests(disk / "case")
    assert mount(disk, used(disk) + int(share * room) // 4096 * 4096 + 4096 * (share > 0), again=True)
    status = ended(command, disk, said)
    words = said.read_text(errors="replace")
    assert mount(disk, LARGE, again=True)
    found = []
    if status not in (0, 2) or (status == 2 and not ERROR.search(words)) or "Traceback" in words:
        found.append(f"status {status}: {words[-1500:]}")
    after = digests(disk / "case")
    missing = sorted(expected.keys() - after.keys())
    if status == 0 and missing and name not in AT_ONCE_ONLY:
        found.append(f"it did not notice that it lacks {missing[:4]}")
    for path, digest in after.items():
        known = (before.get(path), expected.get(path))
        if ".tmp" in path:
            found.append(f"left {path}")
        elif digest not in known and not is_whole(disk / "case" / path):
            found.append(f"half of {path}")
    found += [f"lost {path}" for path in before.keys() - after.keys() if path in expected]
    if name in AT_ONCE_ONLY:
        return found
    status = ended(command, disk, said)
    after = digests(disk / "case")
    if status:
        found.append(f"repeated: status {status}: {said.read_text(errors='replace')[-1500:]}")
    wrong = [
        p
        for p in expected.keys() | after.keys()
        if expected.get(p) != after.get(p) and Path(p).name not in VARYING
    ]
    if wrong:
        found.append(f"repeated: other bytes in {sorted(wrong)[:6]}")
    return found


def begin(base: Path, disk: Path) -> None:
    """An empty disk with a copy of the base."""
    assert mount(disk, LARGE, again=True)
    for old in disk.iterdir():
        shutil.rmtree(old)
    shutil.copytree(base, disk / "case")
    (disk / "temporary").mkdir()


def undisturbed(name: str, base: Path, disk: Path) -> tuple[dict[str, str], int]:
    """The digests that a command ends with, and the room that it took."""
    begin(base, disk)
    before = used(disk)
    if name in AT_ONCE_ONLY:
        return {}, 0
    status = ended(COMMANDS[name], disk, disk.parent / "said")
    assert status == 0, (name, status, (disk.parent / "said").read_text()[-2000:])
    return digests(disk / "case"), used(disk) - before


def fill(asked: argparse.Namespace, base: Path, disk: Path, counts: Counter[str]) -> None:
    """Every command with every share; counts what was right, and what was not."""
    for name in COMMANDS:
        if asked.only not in name or (asked.quick and name in STARTS):
            continue
        whole = undisturbed(name, base, disk)
        for share in (0.0,) if name in AT_ONCE_ONLY else asked.shares:
            found = faults(name, share, base, disk, whole)
            counts["fault" if found else "right"] += 1
            for fault in found:
                print(f"FAULT {name}, {share:.0%} of {whole[1]} bytes: {fault}", flush=True)
        print(f"{name}: {whole[1]} bytes; {dict(counts)}", flush=True)


def main() -> int:
    """Run; returns 1 where something was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--quick", action="store_true", help="without what starts further programs")
    parser.add_argument("--shares", type=float, nargs="+", default=SHARES)
    asked = parser.parse_args()
    if not own_mounts():
        return NO_MOUNT
    warm_up()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        base, disk = Path(folder) / "base", Path(folder) / "disk"
        make_base(base)
        in_a_fork(lambda: make_round(base))
        disk.mkdir()
        if not mount(disk, LARGE):
            return NO_MOUNT
        os.environ["TMPDIR"] = str(disk / "temporary")
        try:
            fill(asked, base, disk, counts)
        finally:
            libc.umount(bytes(disk))
    print(f"{counts.total()} full disks: {dict(counts)}")
    return int(counts["fault"] > 0 or not counts)


if __name__ == "__main__":
    sys.exit(main())
