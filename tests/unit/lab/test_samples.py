"""Samples: fetched once from a server, checked, kept; the tests that they are can be read; one line where it fails."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import tifffile
from real_files import CROPS, full_folder
from real_files import SAMPLES as FOLDERS

from rgbmidic import cli
from rgbmidic.command import execute
from rgbmidic.frames import list_frames
from rgbmidic.lab import samples
from rgbmidic.lab.samples import SAMPLES, Sample, SampleFile
from rgbmidic.settings import read_test

pytest.importorskip("pooch")

FRAMES = ("first frame.tif", "second.tif")
SETTINGS = '[frames]\npath = "*.tif"\nkind = "monochrome"\n[region]\nrectangle = [4, 4, 40, 40]\n'


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder of a repository at a commit, served on this machine, with the sample "small" of two frames in it."""
    published = tmp_path / "published" / "someone" / "something" / "0123" / "a folder"
    published.mkdir(parents=True)
    for index, name in enumerate(FRAMES):
        tifffile.imwrite(published / name, np.full((48, 48), 7 + index, np.uint8))
    handler = functools.partial(Quiet, directory=str(tmp_path / "published"))
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=httpd.serve_forever, daemon=True).start()
    listed = []
    for name in FRAMES:
        content = (published / name).read_bytes()
        sha = hashlib.sha256(content).hexdigest()
        listed.append(SampleFile(path=f"a folder/{name}", bytes=len(content), sha256=sha))
    small = Sample(
        **{"name": "small", "shows": "two frames", "licence": "MIT", "repository": "someone/something"},
        **{"commit": "0123", "files": tuple(listed), "settings": SETTINGS},
    )
    monkeypatch.setattr(samples, "ADDRESS", f"http://127.0.0.1:{httpd.server_port}")
    monkeypatch.setattr(samples, "SAMPLES", MappingProxyType({"small": small}))
    monkeypatch.setenv("RGBMIDIC_SAMPLES", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    yield published
    httpd.shutdown()
    httpd.server_close()


def sample(*arguments: str) -> int:
    return execute(cli.app, ["sample", *arguments])


def test_a_sample_is_fetched_once_and_is_a_test(
    server: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sample("small") == 0
    output = capsys.readouterr()
    assert "cd small && rgbmidic run test.toml --out result" in output.out
    assert "licence: MIT   source: github.com/someone/something" in output.out
    assert all(name in output.err for name in FRAMES)
    assert read_test(tmp_path / "small" / "test.toml").region.rectangle == (4, 4, 40, 40)
    for name in FRAMES:
        assert (tmp_path / "small" / name).read_bytes() == (server / name).read_bytes()
        (server / name).unlink()
    assert sample("small", "again") == 0  # from the cache: nobody has it any more
    assert capsys.readouterr().err == ""
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == sorted([*FRAMES, "test.toml"])


def test_what_fails_is_one_line_and_writes_nothing(
    server: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*arguments: str) -> str:
        assert sample(*arguments) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if " MB) from " not in line]
        assert len(lines) == 1
        return lines[0]

    assert "no sample 'smal'; there are small" in refused("smal")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    assert "taken is already there; state another folder" in refused("small", "taken")
    (server / FRAMES[1]).write_bytes(b"something else")
    assert "is not the file that was published: its SHA-256" in refused("small")
    (server / FRAMES[1]).unlink()
    assert "second.tif of sample small cannot be fetched: the answer is 404" in refused("small")
    monkeypatch.setattr(samples, "ADDRESS", "http://127.0.0.1:9")
    assert "cannot be fetched: no connection" in refused("small")
    assert not (tmp_path / "small").exists()
    assert [path.name for path in (tmp_path / "cache" / "small").iterdir()] == [FRAMES[0]]


def test_samples_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert sample() == 0
    lines = capsys.readouterr().out.splitlines()
    for name, known in SAMPLES.items():
        (line,) = (line for line in lines if line.startswith(f"{name} "))
        assert known.licence in line
        assert known.source in line


@pytest.mark.parametrize("name", [name for name, known in SAMPLES.items() if known.settings])
def test_settings_of_a_sample_are_a_test_of_its_files(name: str, tmp_path: Path) -> None:
    (tmp_path / "test.toml").write_text(SAMPLES[name].settings)
    for file in SAMPLES[name].files:
        (tmp_path / file.name).touch()
    frames = read_test(tmp_path / "test.toml").frames
    files = list_frames(frames.path[0], tmp_path)
    assert max(frames.reference) < len(files)
    assert "ref" in files[frames.reference[0]].stem.lower() or name in ("tension", "open-hole")  # these: the first


def test_hashes_are_those_of_the_full_files_and_of_what_the_crops_were_cut_from() -> None:
    checked = 0
    for folder, name in FOLDERS.items():
        source = CROPS / folder / "SOURCE.txt"
        for file in SAMPLES[name].files:
            stated = f"github {SAMPLES[name].repository} @ {SAMPLES[name].commit} : {file.path}\n"
            stated += f"    bytes: {file.bytes}  sha256: {file.sha256}"
            if source.is_file() and (CROPS / folder / file.name).is_file():
                assert stated in source.read_text(), file.name
                checked += 1
            if (full := full_folder(folder) / file.name).is_file():
                content = full.read_bytes()
                assert (len(content), hashlib.sha256(content).hexdigest()) == (file.bytes, file.sha256), file.name
    assert checked == 20
