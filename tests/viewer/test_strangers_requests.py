# ruff: noqa: E501
"""The viewer against requests that no browser makes: broken HTTP, broken WebSocket frames, and many of them at once."""

import os
import socket
import struct
import urllib.parse
from collections.abc import Iterator

import msgspec
import pytest
import viser
from served_viewer import CAMERA, Served

PORT = 18190
SECONDS = 5.0
HOST = f"Host: 127.0.0.1:{PORT}\r\n"
UPGRADE = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    "Sec-WebSocket-Version: 13\r\n"
)
PROTOCOL = f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    serving = Served(PORT)
    yield serving
    serving.close()


def talk(served: Served, *parts: bytes, seconds: float = SECONDS, until: bytes = b"") -> bytes:
    """Send something over a bare connection; what comes back until it ends, or until it has ``until`` in it."""
    port = int(served.viewer.address.rpartition(":")[2])
    heard = b""
    with socket.create_connection(("127.0.0.1", port), seconds) as there:
        try:
            for part in parts:
                there.sendall(part)
            while not (until and until in heard) and len(heard) < 1 << 20:
                part = there.recv(1 << 16)
                if not part:
                    break
                heard += part
        except OSError:
            pass
    return heard


def request(line: str, *headers: str, host: str = HOST) -> bytes:
    return f"{line}\r\n{host}{''.join(headers)}\r\n".encode("latin-1", "replace")


OUTSIDE = (
    "/../../../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "/..%2f..%2f..%2fetc%2fpasswd",
    "//etc/passwd", "/%252e%252e/etc/passwd", "/\\..\\..\\etc\\passwd", "/%00/etc/passwd", "/" + "../" * 200 + "etc/passwd",
    "/assets/../../../../../../../../etc/passwd", "http://127.0.0.1/../../../../../../etc/passwd", "/?x=/etc/passwd",
)  # fmt: skip


@pytest.mark.parametrize("path", OUTSIDE)
def test_no_file_outside_the_page_is_sent(served: Served, path: str) -> None:
    assert os.path.exists("/etc/passwd")
    heard = talk(served, request(f"GET {path} HTTP/1.1", "Connection: close\r\n"), until=b"</html>")
    assert b"root:" not in heard
    assert served.thread.is_alive()


NAMES = (
    "", "Host:\r\n", "Host: evil.example\r\n", "Host: 127.0.0.1.nip.io\r\n", "Host: 127.0.0.1@evil.example\r\n",
    "Host: 127.0.0.1\r\nHost: evil.example\r\n", "Host: 2130706433\r\n", "Host: 0x7f000001\r\n", "Host: 127.1\r\n",
    "Host: localhost.\u0000evil.example\r\n", "Host: localhost%2eevil.example\r\n", "Host: \u04cfocalhost\r\n",
    "Host: localhost\r\nX-Forwarded-Host: evil.example\r\nOrigin: http://evil.example\r\n",
    "Host: localhost\r\nOrigin: null\r\n", "Host: localhost\r\nOrigin: http://localhost.evil.example\r\n",
    "Host: localhost\r\nOrigin: http://LOCALHOST@evil.example\r\n", "Host: localhost\r\nOrigin: file://\r\n",
    "Host: localhost\r\nOrigin: http://127.0.0.1\r\n",
)  # fmt: skip


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("upgrade", [False, True])
def test_no_other_name_sees_the_page_or_a_picture(served: Served, names: str, upgrade: bool) -> None:
    more = (UPGRADE, PROTOCOL) if upgrade else ("Connection: close\r\n",)
    heard = talk(served, request("GET / HTTP/1.1", *more, host=names), until=b"\n\n")
    status = heard.partition(b"\r\n")[0]
    assert b" 101 " not in status
    assert b" 200 " not in status
    assert b"<title" not in heard


BROKEN = (
    b"", b"\r\n\r\n", b"\x16\x03\x01\x02\0\x01\0\x01\xfc\x03\x03" + bytes(500), b"GET", b"GET / HTTP/9.9\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"X: " + b"x" * (1 << 20) + b"\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 5000 + b"\r\n",
    b"GET /" + b"x" * (1 << 16) + b" HTTP/1.1\r\n" + HOST.encode() + b"\r\n",
    b"POST / HTTP/1.1\r\n" + HOST.encode() + b"Content-Length: 99999999999\r\n\r\n" + b"x" * 9999,
    b"PUT /x HTTP/1.1\r\n" + HOST.encode() + b"Transfer-Encoding: chunked\r\n\r\nffffffff\r\n",
    b"GET / HTTP/1.1\r\n" + HOST.encode() + b"X\0: \xff\r\n\r\n", b"GET  HTTP/1.1\r\n\r\n",
    b"CONNECT evil.example:443 HTTP/1.1\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", os.urandom(4096),
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n X: folded\r\n\r\n",
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(BROKEN)))
def test_broken_requests_end_nothing(served: Served, number: int, capfd: pytest.CaptureFixture[str]) -> None:
    talk(served, BROKEN[number], seconds=0.4)
    assert served.thread.is_alive()
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err


def frame(
    kind: int, data: bytes, *, last: bool = True, masked: bool = True, length: int | None = None
) -> bytes:
    """A frame of WebSocket; ``length`` is what it says, where that is not so."""
    count = len(data) if length is None else length
    head = bytes([(0x80 if last else 0) | kind])
    head += bytes([0xFF if masked else 0x7F]) + struct.pack(">Q", count)
    return head + (bytes(4) if masked else b"") + data


CLICK = msgspec.msgpack.encode(CAMERA)
FRAMES = (
    (frame(2, b"x" * 64, length=1 << 62),), (frame(2, CLICK, masked=False),), (frame(1, b"\xff\xfe text"),), (frame(3, b"x"),),
    (frame(9, b"x" * 126),), (frame(9, b"x", last=False),), (frame(0, b"x"),), (frame(8, b"\0"),), (frame(8, b"\xff\xff\xff"),),
    (b"\xf2" + frame(2, CLICK)[1:],), (b"\xc2" + frame(2, b"\x00" * 400)[1:],),
    tuple(frame(2 if not k else 0, b"x" * 1000, last=False) for k in range(200)), tuple(frame(9, b"p") for _ in range(3000)),
    tuple(frame(2, b"") for _ in range(500)), (frame(2, b"\xc7\xff\x7f" + bytes(255)),), (frame(2, b"\xde\xff\xff"),),
    (frame(2, b"\x82\xa4type\xb3ViewerCameraMessage\xa4type\xb0GuiUpdateMessage"),), (frame(2, b"\xd9\xff" + b"\xff" * 255),),
    (frame(2, b"\x81\xa4type\xc4\x04\xff\xff\xff\xff"),), (frame(2, CLICK) * 400,),
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(FRAMES)))
def test_broken_frames_end_nothing(served: Served, number: int, capfd: pytest.CaptureFixture[str]) -> None:
    talk(served, request("GET / HTTP/1.1", UPGRADE, PROTOCOL), *FRAMES[number], seconds=0.4, until=b"never")
    assert served.thread.is_alive()
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err


@pytest.mark.parametrize(
    "query",
    ["?websocket=ws://evil.example", "?playbackPath=//evil.example/x", "?x=<script>alert(1)</script>", "?" + "a=b&" * 2000,
     "?websocket=javascript:alert(1)", "?" + urllib.parse.quote("\r\nSet-Cookie: a=b")],
)  # fmt: skip
def test_a_query_changes_neither_the_page_nor_its_policy(served: Served, query: str) -> None:
    plain, asked = (
        talk(served, request(f"GET /{q} HTTP/1.1", "Connection: close\r\n"), until=b"</html>").partition(
            b"\r\n\r\n"
        )
        for q in ("", query)
    )
    if b" 200 " in asked[0]:
        assert asked[2][:5000] == plain[2][:5000]
        assert b"connect-src 'self'" in asked[0]
    assert b"evil.example" not in asked[0] + asked[2]
    assert b"Set-Cookie" not in asked[0]


def test_connections_that_say_nothing_keep_nobody_out(served: Served) -> None:
    port = int(served.viewer.address.rpartition(":")[2])
    idle = [socket.create_connection(("127.0.0.1", port), SECONDS) for _ in range(100)]
    try:
        for index, there in enumerate(idle):
            there.sendall(b"GET / HTTP/1.1\r\n"[: 1 + index % 16])
        assert served.is_well()
    finally:
        for there in idle:
            there.close()


def test_the_viewer_is_well_after_all_that(served: Served) -> None:
    assert served.is_well()
    assert served.warned == []
