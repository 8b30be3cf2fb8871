"""The viewer in a real browser: what the page shows is what the result holds, and nobody else is served."""

from __future__ import annotations

import http.client
import random
import re
import socket
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from browser import MISSING, Page, chromium, click, serving
from results import NODES, make_origin, make_result, random_record, smooth_record

from rgbmidic import cli
from rgbmidic.command import execute
from rgbmidic.results import FrameRecord, Result, ResultStore
from rgbmidic.results.probing import read_histories
from rgbmidic.settings import ProbeSettings
from rgbmidic.view.fields import Fields, robust_range

needs_browser = pytest.mark.skipif(bool(MISSING), reason=MISSING)
RIGHT, LEFT = "\ue014", "\ue012"


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Seven frames, of which the fourth failed."""
    store = ResultStore.create(tmp_path_factory.mktemp("view") / "result", make_origin(7))
    for index in range(7):
        failed = FrameRecord.failed("no start <was> found", nodes=NODES, lights=3, number=index)
        store.write_frame(index, failed if index == 3 else smooth_record(index))
    store.finish()
    return Result.open(store.path)


@pytest.fixture(scope="module")
def address(result):
    with serving(result.path) as told:
        yield told


@pytest.fixture(scope="module")
def driver():
    with chromium() as one:
        yield one


def shown(page, frame):
    """The words on the page once it shows a frame."""
    page.until(f"model('state').shown === {frame} && model('words').text.startsWith('Frame {frame} ')")
    return page.run("model('words').text")


@needs_browser
def test_frames_are_scrubbed_and_the_address_holds_what_is_shown(driver, address, result):
    page = Page(driver, address)
    assert "converged" in shown(page, 6)
    page.keys(LEFT, LEFT)
    shown(page, 4)
    page.keys(LEFT)
    assert "failed: no start &lt;was&gt; found" in shown(page, 3)
    page.do("model('quantity').value = 'v'")
    page.do("model('frame').value = 2")
    shown(page, 2)
    low, high = robust_range(Fields.of(result).read("v", 2))
    mapper = "model('colours')"
    page.until(f"{mapper}.low === {low!r} && {mapper}.high === {high!r}")
    held = parse_qs(urlsplit(driver.current_url).query)
    assert held == {"frame": ["2"], "field": ["v"]}
    again = Page(driver, driver.current_url)
    shown(again, 2)
    assert again.run("model('quantity').value") == "v"


@needs_browser
def test_the_value_under_the_pointer_is_that_of_the_array(driver, address, result):
    page = Page(driver, f"{address}?frame=5&field=u")
    shown(page, 5)
    node = int(np.argmin(np.hypot(*(result.nodes - [70, 45]).T)))
    page.pointer(("move", *result.nodes[node]))
    text = page.until("model('under').text")
    x, y, u, std = (float(n) for n in re.findall(r"-?[\d.]+(?:e-?\d+)?", text))
    assert np.hypot(x - result.nodes[node, 0], y - result.nodes[node, 1]) < 0.5
    assert u == pytest.approx(0.002 * 5 * (x - 60), abs=1e-3)
    assert std == pytest.approx(0.01)


@needs_browser
def test_curves_of_a_gauge_that_is_set_and_dragged_are_those_of_history(driver, address, result):
    page = Page(driver, f"{address}?frame=6")
    page.do("model('mode').active = 2")
    page.pointer(("click", 25, 40))
    page.pointer(("click", 95, 40))
    check_gauge(page, result)
    page.pointer(("press", *ends(page)[1]), ("move", 90, 50), ("release", 80, 60))
    page.until("model('marks').data.y[1] > 55")
    check_gauge(page, result)
    page.do(
        "window.saved = ''; URL.createObjectURL = (blob) => { blob.text().then((t) => window.saved = t); return '#'; }"
    )
    page.driver.execute_script(*click("Save CSV"))
    assert page.until("window.saved").splitlines()[0].startswith("frame,number,status,gauge_1_extension_px")


def ends(page):
    data = page.run("[Array.from(model('marks').data.x), Array.from(model('marks').data.y)]")
    return list(zip(*data, strict=True))


def check_gauge(page, result):
    """The curve on the page and its band are what `rgbmidic history` reads at the marks of the page."""
    place = tuple(value for end in ends(page) for value in end)
    expected = read_histories(result, ProbeSettings(gauges=(place,)))["gauge_1_extension"]
    last = f"{expected.values[-1]:.9g}"
    page.until(f"model('lines').data.ys.length === 1 && Math.abs(model('lines').data.ys[0][6] - {last}) < 1e-6")
    curve = page.run("Array.from(model('lines').data.ys[0]).map((v) => Number.isFinite(v) ? v : null)")
    np.testing.assert_allclose([np.nan if v is None else v for v in curve], expected.values, atol=1e-9)
    first = page.run("Array.from(model('bands').data.ys[1])")  # behind the failed frame
    np.testing.assert_allclose(first[:3], (expected.values - 2 * expected.std)[4:], atol=1e-9)


@needs_browser
def test_a_result_that_grows_is_followed(driver, tmp_path):
    store = ResultStore.create(tmp_path / "result", make_origin(4))
    with serving(store.path) as told:
        page = Page(driver, told)
        assert "not measured yet" in shown(page, 0)
        for index in (0, 1):
            store.write_frame(index, smooth_record(index))
        assert "converged" in shown(page, 1)
        page.until("model('head').text.includes('2 of 4 frames measured')")
        for index in (2, 3):
            store.write_frame(index, smooth_record(index))
        store.finish()
        shown(page, 3)
        page.until("model('head').text.includes('4 of 4 frames measured')")


@needs_browser
def test_nothing_is_asked_of_the_network(driver, address):
    page = Page(driver, address)
    asked = page.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert len(asked) >= 3
    assert all(name.startswith((address, "data:", "blob:")) for name in asked)


@needs_browser
def test_a_damaged_frame_is_told_and_the_page_goes_on(driver, tmp_path):
    made = make_result(tmp_path / "result", frames=3)
    file = next((made.path / "solution").glob("*.frames"))
    content = bytearray(file.read_bytes())
    content[int(made.table.start[1]) + 3] ^= 255
    file.write_bytes(content)
    with serving(made.path) as told:
        page = Page(driver, told)
        page.do("model('frame').value = 1")
        page.until("model('words').text.includes('damaged in frame 1')")
        page.do("model('frame').value = 0")
        shown(page, 0)


def test_strangers_get_nothing_whatever_they_ask(address, result):
    """Wrong tokens, paths out of the folder and plain noise: never a page, a traceback or a file."""
    parts, choose = urlsplit(address), random.Random(7)
    token = parts.path.strip("/")
    noise = "".join(map(chr, range(33, 127)))
    steps = ["..", "%2e%2e", "..%2f", "static", "%00", "etc", "passwd", "js", "//", "ws", "metadata", "\\..\\"]
    for number in range(1000):
        own = number % 2
        start = token if own else token[:-1] + choose.choice("-_")
        tail = [
            choose.choice([*steps, "".join(choose.choices(noise, k=6)).replace("#", "")])
            for _ in range(choose.randrange(1, 6))
        ]
        path = f"/{start}/static/{'/'.join(tail)}" if own else choose.choice([f"/{start}/", "/", f"/{'/'.join(tail)}"])
        status, body = ask(parts, choose.choice(["GET", "GET", "POST", "HEAD", "PUT"]), path)
        assert status in (400, 403, 404, 405, 414), (status, path)
        assert len(body) < 300, (path, body)
        assert not re.search(rb"Traceback|root:|rgbmidic", body), (path, body)
    for raw in (b"\0" * 100, b"GET", b"GET / HTTP/9.9\r\n\r\n", b"\xff" * 4096, f"GET {'a' * 70000}\r\n\r\n".encode()):
        assert b"Traceback" not in raw_answer(parts, raw)


def ask(parts, method, path):
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    try:
        connection._validate_path = lambda url: None  # strangers do not keep rules
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def raw_answer(parts, content):
    with socket.create_connection((parts.hostname, parts.port), timeout=0.5) as one:
        try:
            one.sendall(content)
            return one.recv(10000)
        except OSError:
            return b""


def test_another_page_of_the_web_cannot_speak_with_the_server(address):
    """A page of another origin that knew the address would still be refused by the socket."""
    parts = urlsplit(address)
    head = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request("GET", f"{parts.path}ws", headers={**head, "Origin": "http://elsewhere.example"})
    assert connection.getresponse().status == 403
    connection.close()


def test_the_server_listens_to_this_machine_only(address):
    parts = urlsplit(address)
    assert parts.hostname == "127.0.0.1"
    with socket.socket() as other:
        other.settimeout(2)
        assert other.connect_ex(("127.0.0.2", parts.port)) != 0


def bad_inputs(folder):
    (folder / "empty").mkdir()
    made = make_result(folder / "damaged", frames=2)
    (made.path / "mesh.npz").write_bytes(b"no")
    used = socket.socket()
    used.bind(("127.0.0.1", 0))
    used.listen()
    make_result(folder / "good", frames=1)
    port = str(used.getsockname()[1])
    yield [str(folder / "none")], "none"
    yield [str(folder / "empty")], "empty"
    yield [str(folder / "damaged")], "mesh.npz is damaged"
    yield [str(folder / "good"), "--port", port], f"port {port} of 127.0.0.1 cannot be used"
    yield [str(folder / "good"), "--port", "70000"], "70000"
    used.close()


def test_bad_input_is_one_line(tmp_path, capsys):
    for arguments, expected in bad_inputs(tmp_path):
        assert execute(cli.app, ["view", *arguments, "--no-browser"]) == 2
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.startswith("error: ")
        assert told.err.count("\n") == 1
        assert expected in told.err


def test_random_records_are_shown_too(tmp_path):
    """Every field of random records with gaps can be drawn by the page, without a browser."""
    from bokeh.document import Document

    from rgbmidic.view.address import Look
    from rgbmidic.view.page import ResultPage

    made = make_result(tmp_path / "result", frames=3)
    assert random_record(1).u.shape == (NODES,)
    page = ResultPage(Document(), made, Look(frame=2))
    for over in ("reference", "deformed"):
        for name in page.fields.all:
            page.show(field=name, over=over, symmetric=True, range="test")
            assert "Frame 2 of 2" in page.parts.words.text, page.parts.words.text
            image = np.asarray(page.canvas.plot.renderers[0].data_source.data["image"][0])
            assert len(np.unique(image)) > 1
