"""Who may talk to the viewer, and what a connection may do."""

import asyncio
import contextlib
import math
import random
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from faults import Fault
from served_viewer import CAMERA, PATIENCE, Served, drain
from viewer_scenes import photographs, shown
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus

from polarguide.core.errors import PolarguideError
from polarguide.viewer import Viewer, guard
from polarguide.viewer.guard import LARGEST, Gate, Refused, checked_message, choice, flag, number, pair
from polarguide.viewer.server import _listening

# The viewer ignores it itself, but each test brings back the filters of before.
pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")
NUMBERS = [
    math.nan,
    math.inf,
    -math.inf,
    0,
    -1,
    1e300,
    -1e300,
    2**62,
    3_000_000,
    1e-300,
    True,
    None,
    "x",
    [],
    {},
]


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    serving = Served()
    yield serving
    serving.close()


def malformed(seed: int, controls: list[str]) -> bytes:
    """A message with something wrong about it."""
    rng = random.Random(seed)
    kind = rng.randrange(8)
    if kind < 3:
        message: dict[str, Any] = {**CAMERA}
        for _ in range(rng.randint(1, 3)):
            key = rng.choice([key for key in CAMERA if key != "type"])
            value: Any = rng.choice(NUMBERS)
            if isinstance(CAMERA[key], list) and rng.random() < 0.8:
                value = [rng.choice([0.0, value]) for _ in range(rng.choice([0, 1, 3, 4, 5]))]
            message[key] = value
        if rng.random() < 0.2:
            message.pop(rng.choice([key for key in CAMERA if key != "type"]))
        return msgspec.msgpack.encode(message)
    if kind < 6:
        value = rng.choice(
            [*NUMBERS, [1], [2, 1, 0], [math.nan, 3], [9e9, -9e9], "no such layer", "x" * 9999, 2000]
        )
        name = rng.choice([*controls, "no such control"])
        prop = rng.choice(["value", "value", "value", "order", "update_cb", "__class__", "sync_cb"])
        return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": name, "updates": {prop: value}})
    if kind == 6:
        other = rng.choice(
            ["ShareUrlRequest", "FileTransferStartUpload", "FileTransferPart", "GetRenderResponseMessage", "Message",
             "RunJavascriptMessage", "GuiFormDirtyMessage", "SceneNodeDragMessage", "ResetGuiMessage", "x" * 999]
        )  # fmt: skip
        more = {
            "source_component_uuid": rng.choice(controls), "transfer_uuid": "t", "filename": "../x", "uuid": "u",
            "mime_type": "x", "part_count": 2**31, "size_bytes": 2**60, "part_index": -1, "content": b"x" * 999,
        }  # fmt: skip
        return msgspec.msgpack.encode({"type": other, **more})
    whole = msgspec.msgpack.encode(CAMERA)
    broken = [
        whole[: rng.randrange(len(whole))], rng.randbytes(rng.randrange(200)), b"\x81" * 5000, b"\x91" * 60_000,
        b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff\xa1", msgspec.msgpack.encode(["type"]),
        b"\xa0" * (LARGEST + 9),
    ]  # fmt: skip
    return rng.choice(broken)


def test_a_browser_that_behaves_is_sent_pictures(served: Served) -> None:
    assert served.is_well()


def test_malformed_messages_end_nothing_but_their_sender(
    served: Served, capfd: pytest.CaptureFixture[str]
) -> None:
    """Each has a browser of its own, which is let go at the last for a message that is certainly refused."""
    for seed in range(100):
        browser = served.browser()
        browser.send(msgspec.msgpack.encode(CAMERA))
        served.picture(browser)
        for message in (malformed(seed, served.controls()), b""):
            with contextlib.suppress(ConnectionClosed):
                browser.send(message)
        with pytest.raises(ConnectionClosed) as ended:
            drain(browser)
        assert ended.value.rcvd.code == 1008, seed
        assert served.thread.is_alive(), seed
    assert served.is_well()
    assert served.viewer._server._share_tunnel is None
    assert served.warned == []
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err
    assert "Error" not in said.out + said.err


def test_what_fails_for_one_browser_lets_that_one_go_with_a_line(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("a fault of ours")

    with monkeypatch.context() as patch, served.browser() as browser:
        patch.setattr("polarguide.viewer.scenery.Painter.paint", fail)
        browser.send(msgspec.msgpack.encode(CAMERA))
        with pytest.raises(ConnectionClosed):
            drain(browser)
    (warning,) = served.warned
    assert "ValueError: a fault of ours" in warning
    served.warned.clear()
    assert served.is_well()


@pytest.mark.parametrize(
    "headers", [{"Origin": "https://evil.example"}, {"Origin": "null"}, {"Host": "evil.example:18180"}]
)
def test_strangers_pages_are_turned_away(served: Served, headers: dict[str, str]) -> None:
    with pytest.raises(InvalidStatus) as refused:
        served.browser(**headers)
    assert refused.value.response.status_code == 403
    request = urllib.request.Request(served.viewer.address, headers=headers)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=PATIENCE)


def test_the_page_cannot_be_framed_by_others(served: Served) -> None:
    with urllib.request.urlopen(served.viewer.address, timeout=PATIENCE) as answer:
        policy = answer.headers["Content-Security-Policy"]
        assert "frame-ancestors 'self'" in policy
        assert f"connect-src 'self' ws://{served.viewer.address.removeprefix('http://')} " in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_a_browser_that_takes_nothing_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    aborted = []

    class Stuck:
        class transport:
            abort = staticmethod(lambda: aborted.append(True))

        async def send(self, data: bytes) -> None:
            await asyncio.sleep(PATIENCE)

    monkeypatch.setattr("polarguide.viewer.guard.SENDING_SECONDS", 0.01)
    asyncio.run(guard._Connection(Stuck(), lambda raw: raw).send(b"x"))
    assert aborted


def test_a_viser_that_listens_otherwise_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = shown()
    closed = []

    class Server:
        def stop(self) -> None:
            closed.append(True)

    monkeypatch.setattr("polarguide.viewer.server._listening", lambda *_: Server())
    Fault("the viewer", remedy="viser==1.1").raised_by(
        Viewer, lambda: seen, photographs(seen), shading=seen.shading
    )
    assert closed


def test_servers_of_others_are_left_alone() -> None:
    from websockets.asyncio import server

    async def handler(_: Any) -> None:
        pass

    before = server.serve
    with contextlib.suppress(PolarguideError), guard.guarded(Gate("127.0.0.1"), lambda raw: None):
        assert server.serve is not before
        with pytest.raises(RuntimeError, match="no running event loop"):  # it was handed on as it is
            server.serve(handler, "127.0.0.1", 0)
    assert server.serve is before


@pytest.mark.parametrize(
    ("accepts", "value", "found"),
    [(number(-4, 4), 2000, 4.0), (number(0.5, 10), -1e300, 0.5), (pair(-5, 5), [9e9, -1], [-1.0, 5.0]),
     (choice(["a"]), "a", "a"), (flag, True, True)],
)  # fmt: skip
def test_what_is_out_of_range_is_clamped(accepts: Any, value: Any, found: Any) -> None:
    assert accepts(value) == found


@pytest.mark.parametrize(
    ("accepts", "value"),
    [(number(0, 1), math.nan), (number(0, 1), True), (number(0, 1), "1"), (pair(0, 1), [1]), (pair(0, 1), 1),
     (pair(0, 1), [0, math.inf]), (choice(["a"]), "b"), (choice(["a"]), ["a"]), (flag, 1)],
)  # fmt: skip
def test_what_is_no_value_is_refused(accepts: Any, value: Any) -> None:
    with pytest.raises(Refused):
        accepts(value)


def test_a_camera_is_clamped() -> None:
    wild = {
        **CAMERA,
        "fov": 0.0,
        "image_width": 2e9,
        "position": [1e300, 0, 0],
        "wxyz": [2, 0, 0, 0],
        "more": 1,
    }
    found = msgspec.msgpack.decode(checked_message(msgspec.msgpack.encode(wild), lambda _: None, 50.0) or b"")
    assert (found["fov"], found["image_width"], found["position"]) == (0.01, 8192, [50.0, 0.0, 0.0])
    assert found["wxyz"] == [1.0, 0.0, 0.0, 0.0]
    assert "more" not in found


def test_a_camera_that_looks_at_its_own_place_is_refused() -> None:
    """As clamped, that is: viser asks for the direction."""
    wild = {**CAMERA, "position": [1e300, 0, 0], "look_at": [60.0, 0, 0]}
    with pytest.raises(Refused, match="looks at"):
        checked_message(msgspec.msgpack.encode(wild), lambda _: None, 50.0)


@pytest.mark.parametrize("host", ["a" * 70_000, "\udcff", "xn--\u2603.."])
def test_names_that_no_network_can_have_are_one_line(host: str) -> None:
    Fault("host", "an address of this machine").raised_by(_listening, None, host, 8080, "a title")


OWN = Gate("127.0.0.1", ["tunnel.example.org"], ["https://hub.example.org"])


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8080", "localhost:9", "LOCALHOST.", "[::1]:80", "192.168.1.7", "tunnel.example.org:443"],
)
def test_names_of_this_machine_pass_with_pages_of_their_own_or_none(host: str) -> None:
    assert OWN.refusal(Headers(Host=host)) is None
    name = host.rpartition(":")[0] if not host.endswith((".", "]")) and ":" in host else host
    for origin in (f"http://{name}", f"https://{name}:1234", "https://hub.example.org:8443"):
        assert OWN.refusal(Headers(Host=host, Origin=origin)) is None, origin


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8080", "", "a b", "[::1", "me@127.0.0.1",
     "127.0.0.1/x", "127.0.0.1:port", "0x7f.1", "[::1].evil.example", "[::1]evil.example:80"],
)  # fmt: skip
def test_other_names_are_refused_with_the_remedy(host: str) -> None:
    assert "--allow-host" in (OWN.refusal(Headers(Host=host)) or "")


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "", "file://", "http://127.0.0.1.evil.example", "https://localhost", "http://",
     "chrome-extension://127.0.0.1", "http://127.0.0.1@evil.example", "http://evil.example/127.0.0.1"],
)  # fmt: skip
def test_other_pages_are_refused_with_the_remedy(origin: str) -> None:
    assert "--allow-origin" in (OWN.refusal(Headers(Host="127.0.0.1:8080", Origin=origin)) or "")


def test_a_request_without_a_name_or_with_two_is_refused() -> None:
    host, origin = ("Host", "localhost"), ("Origin", "http://localhost")
    for headers in ([], [host, host], [host, origin, ("Origin", "http://evil.example")]):
        assert OWN.refusal(Headers(headers)) is not None


def test_the_name_that_is_listened_at_passes() -> None:
    assert Gate("workstation.lan").refusal(Headers(Host="workstation.lan:8080")) is None


@pytest.mark.parametrize("name", ["*", "*.example.org", "a b", "a,b", "tunnel..org", "<b>", "a/b", ""])
def test_a_pattern_is_no_name(name: str) -> None:
    Fault("allow_host", "a name such as", name).raised_by(Gate, "127.0.0.1", [name])


def test_an_origin_is_a_page() -> None:
    Fault("allow_origin", "a name such as", "ftp://x").raised_by(Gate, "127.0.0.1", origins=["ftp://x"])
