"""The server of the viewer: whom it serves, and what it says of bad input."""

from __future__ import annotations

import asyncio
import http.client
import os
import random
import re
import socket
from contextlib import suppress
from datetime import datetime
from urllib.parse import quote, urlsplit

import pytest
from bokeh.document import Document
from results import make_result
from small_tests import grey_frame
from tornado.httpclient import AsyncHTTPClient
from viewer import serving

from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.frames.images import write_tiff
from rgbmidic.tools.view.server import _fill_list, _find_tests, start_server
from rgbmidic.tools.view.test_file_editor import Draft
from rgbmidic.tools.view.url_state import ViewState

REQUESTS = 300
"""Enough for every kind of request below to come a few times; 20,000 were sent once before this was merged."""
NOISE = "".join(map(chr, range(33, 127))).replace("#", "")
STEPS = ("..", "%2e%2e", "..%2f", "static", "%00", "etc", "passwd", "js", "//", "ws", "metadata", "\\..\\", "a" * 300)
METHODS = ("GET", "GET", "GET", "POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "BREW")
RAW = (b"\0" * 100, b"GET", b"GET / HTTP/9.9\r\n\r\n", b"\xff" * 4096, b"GET " + b"a" * 70_000 + b"\r\n\r\n")
REFUSALS = (400, 403, 404, 405, 414)
UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    with serving(make_result(tmp_path_factory.mktemp("view") / "result").path) as told:
        yield told


def ask(address, method, path, headers=None):
    """Status and body of the answer to a request that need not keep the rules."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=300)
    try:
        connection._validate_path = lambda url: None
        connection.request(method, path, headers=headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def strange_path(choose, token):
    """A path without the token, or with it and out of what is served."""
    tail = [choose.choice([*STEPS, "".join(choose.choices(NOISE, k=6))]) for _ in range(choose.randrange(1, 6))]
    wrong = choose.choice(["", token[:-1], token.swapcase(), token[:-1] + "%41", f"{token}a", f"x/../{token}x"])
    return choose.choice([f"/{token}/static/{'/'.join(tail)}", f"/{'/'.join(tail)}", f"/{wrong}/", f"/{wrong}/ws"])


def test_strangers_get_nothing_whatever_they_ask(address):
    """Wrong tokens, paths out of what is served and plain noise: never a page, a traceback or a file."""
    choose, token = random.Random(7), urlsplit(address).path.strip("/")
    for _ in range(REQUESTS):
        path, method = strange_path(choose, token), choose.choice(METHODS)
        headers = UPGRADE if choose.random() < 0.2 else None
        status, body = ask(address, method, path, headers)
        assert status in REFUSALS, (status, method, path)
        assert len(body) < 300, (path, body)
        assert not re.search(rb"Traceback|root:|rgbmidic", body), (path, body)


@pytest.mark.parametrize("content", RAW, ids=range(len(RAW)))
def test_what_is_no_request_is_dropped(address, content):
    parts = urlsplit(address)
    with socket.create_connection((parts.hostname, parts.port), timeout=0.2) as one, suppress(OSError):
        one.sendall(content)
        assert re.fullmatch(rb"(HTTP/1.1 4\d\d .*)?", one.recv(10_000), re.DOTALL)


def test_a_page_is_served_whatever_its_query_says(address):
    choose, names = random.Random(3), list(ViewState.__dataclass_fields__)
    for _ in range(2):
        words = ["".join(choose.choices(NOISE + "\0é", k=choose.randrange(9))) for _ in names]
        query = "&".join(f"{name}={quote(word)}" for name, word in zip(names, words, strict=True))
        status, body = ask(address, "GET", f"{urlsplit(address).path}?{query}")
        assert status == 200
        assert b"Traceback" not in body
        assert not any(word.encode() in body for word in words if len(word) > 6)


def test_another_page_of_the_web_cannot_speak_with_the_server(address):
    """A page of another origin that knew the address would still be refused by the socket."""
    path = f"{urlsplit(address).path}ws"
    assert ask(address, "GET", path, {**UPGRADE, "Origin": "http://elsewhere.example"})[0] == 403


def test_the_server_answers_under_its_own_address_only(address):
    """A page of the web may give its own name the address of this machine: to a browser both are then of one origin."""
    parts = urlsplit(address)
    for host in ("elsewhere.example", "127.0.0.1.elsewhere.example", "localhost", "[::1]", ""):
        upgrade = UPGRADE | {"Origin": f"http://{host}:{parts.port}"}
        for path, headers in ((parts.path, {}), (f"{parts.path}ws", upgrade)):
            for name in (host, f"{host}:{parts.port}"):
                assert ask(address, "GET", path, {**headers, "Host": name})[0] in (400, 403), name


def test_the_server_listens_to_this_machine_only(address):
    parts = urlsplit(address)
    assert parts.hostname == "127.0.0.1"
    with socket.socket() as other:
        other.settimeout(2)
        assert other.connect_ex(("127.0.0.2", parts.port)) != 0


def test_a_second_viewer_of_a_result_has_an_address_of_its_own(tmp_path):
    path = make_result(tmp_path / "result").path
    with serving(path) as one, serving(path) as other:
        assert ask(one, "GET", urlsplit(one).path)[0] == ask(other, "GET", urlsplit(other).path)[0] == 200
        assert ask(one, "GET", urlsplit(other).path)[0] == 404


def test_a_folder_lists_its_results_and_tests_newest_first_and_opens_only_those(tmp_path):
    older, newer = (make_result(tmp_path / name, frames=2).path for name in ("old & <b>", "deep/new"))
    os.utime(older / "provenance.json", (1e9, 1e9))
    (tmp_path / "test.toml").write_text("[frames]\npath = 'none/*.tif'\n")
    os.utime(tmp_path / "test.toml", (1.1e9, 1.1e9))
    (tmp_path / "pyproject.toml").write_text("[frames]\n")
    assert list(_find_tests(tmp_path)) == [newer, tmp_path / "test.toml", older]
    _fill_list(tmp_path, document := Document())
    rows = re.findall("<tr>(.*?)</tr>", document.roots[0].text)
    assert re.findall('<th scope="col">(.*?)</th>', rows[0]) == ["Name", "What it is", "Changed"]
    times = [re.findall("<td>(.*?)</td>", row)[2] for row in rows[1:]]
    assert times == sorted(times, reverse=True)
    assert times[1:] == [f"{datetime.fromtimestamp(at):%Y-%m-%d %H:%M}" for at in (1.1e9, 1e9)]
    with serving(tmp_path) as told:
        path = urlsplit(told).path
        assert ask(told, "GET", path)[0] == 200
        assert b'class="dark"' in ask(told, "GET", f"{path}open?path=none&theme=dark")[1]  # else it is loaded for ever
        assert b"all results and tests</a>" in ask(told, "GET", f"{path}open?path=deep/new")[1]
        for name in ("deep/new", "../x", "/etc/passwd", "", "test.toml"):
            status, body = ask(told, "GET", f"{path}open?path={quote(name)}")
            assert status == 200
            assert b"Traceback" not in body


def bad_inputs(folder):
    (folder / "empty").mkdir()
    made = make_result(folder / "damaged", frames=2)
    (made.path / "mesh.npz").write_bytes(b"no")
    (folder / "test.toml").write_text("[frames]\npath = 3\n", encoding="utf-8")
    make_result(folder / "good", frames=1)
    yield [str(folder / "none")], "none"
    yield [str(folder / "empty")], "empty"
    yield [str(folder / "damaged")], "mesh.npz is damaged"
    yield [str(folder / "test.toml")], "frames.path"
    yield [str(folder / "good"), "--port", "70000"], "65535"
    with socket.socket() as used:
        used.bind(("127.0.0.1", 0))
        used.listen()
        port = str(used.getsockname()[1])
        yield [str(folder / "good"), "--port", port], f"port {port} of 127.0.0.1 cannot be used"
        write_tiff(folder / "frame.tif", grey_frame(1, (0.0, 0.0)))
        yield [str(folder / "frame.tif"), "--port", port], 'state cfa (RGGB, BGGR, GRBG, GBRG), or kind "monochrome"'
        for options in (["--kind", "monochrome"], ["--cfa", "RGGB", "--black-level", "10"]):  # they are read
            yield [str(folder / "frame.tif"), *options, "--port", port], f"port {port} of 127.0.0.1 cannot be used"
    yield [str(folder / "frame.tif"), "--kind", "colour"], "frames.kind"
    yield [str(folder / "frame.tif"), "--kind", "monochrome", "--shape", "7"], "--shape is ROWSxCOLUMNS"
    refused = "--kind, --black-level: for raw frames only"
    for name, kind in (("good", "a result"), ("", "a folder of results and tests"), ("test.toml", "a TEST.toml")):
        path = str(folder / name)
        yield (
            [path, "--kind", "monochrome", "--black-level", "2"],
            f"{refused}, which do not state it; {path} is {kind}",
        )


def test_bad_input_is_one_line(tmp_path, capsys):
    for arguments, expected in bad_inputs(tmp_path):
        assert execute(cli.app, ["view", *arguments, "--no-browser"]) == 2
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.startswith("error: ")
        assert told.err.count("\n") == 1
        assert expected in told.err


def test_a_test_is_set_up_from_frames_whose_properties_are_stated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frame = grey_frame(1, (0.0, 0.0))
    write_tiff(tmp_path / "frame.tif", frame)
    with serving(tmp_path / "frame.tif", kind="monochrome", black_level=3.0) as told:
        status, body = ask(told, "GET", urlsplit(told).path)
        assert status == 200
        assert b"<title>rgbmidic: frame.tif</title>" in body
    (tmp_path / "frame.raw").write_bytes(frame.values.tobytes())
    stated = {"kind": "monochrome", "shape": frame.values.shape[-2:], "dtype": "uint16"}
    with serving(tmp_path / "frame.raw", **stated) as told:
        assert b"<title>rgbmidic: frame.raw</title>" in ask(told, "GET", urlsplit(told).path)[1]
    draft = Draft.from_path(tmp_path / "frame.raw", stated)  # what is written, so that the run reads the same
    assert draft.section("frames") == {**stated, "shape": list(stated["shape"]), "path": str(tmp_path / "frame.raw")}


def test_others_are_served_while_pages_that_were_left_are_let_go(tmp_path):
    """Each is let go by itself: whoever waits has an answer after one of them, not after all."""
    left = []

    async def leave() -> None:
        server, address = start_server(make_result(tmp_path / "result").path)
        for _ in range(2):
            await AsyncHTTPClient().fetch(address)
        for session in server.get_sessions():
            session.request_expiration()
        server._tornado._cleanup_job.stop()  # the same, at its own time, which comes in between on a busy machine
        letting_go = asyncio.ensure_future(server._tornado._cleanup_sessions())
        while not letting_go.done():
            await asyncio.sleep(0)
            left.append(len(server.get_sessions()))
        server.stop()

    asyncio.run(leave())
    assert set(left) >= {0, 1}  # Python 3.13 also wakes before the first is let go
