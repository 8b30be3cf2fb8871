"""Damaged, hostile and unwritable files: one error of ours, no more memory than the file's size."""

from __future__ import annotations

import errno
import io
import os
import shutil
import socket
import subprocess
import sys
import threading
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damage_results, write_result
from results import corrupt, make_result, random_record

from rgbmidic.disk import check_file, npy_bytes
from rgbmidic.errors import ResultError, RgbmidicError
from rgbmidic.results import EXPORT_FORMATS, Result, export_result, finish_result, records
from rgbmidic.results.provenance import fingerprint
from rgbmidic.results.records import FrameTable
from rgbmidic.typing import AnyArray

COPIES = 120
"""Mutated copies of each small file of a result."""
RECORD_COPIES = 1000
"""Mutated copies of the file of a frame."""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    reference = np.random.default_rng(0).normal(1000, 100, (3, 40, 60))
    return make_result(tmp_path_factory.mktemp("files") / "out", frames=2, reference=reference)


@pytest.fixture
def copy(result: Result, tmp_path: Path) -> Path:
    return Path(shutil.copytree(result.path, tmp_path / "copy"))


def _read_all(path: Path) -> tuple[AnyArray, ...]:
    result = Result.open(path)
    assert result.deformed == (1,)
    values = (*result.frame(0).values.values(), *result.frame(1).values.values())
    return result.nodes, result.elements, result.reference, *values


def _mutations(content: bytes, seed: int, copies: int = COPIES) -> Iterator[bytes]:
    """Copies with bytes changed, most of them in headers, cut short, or with a piece lost or doubled."""
    random = np.random.default_rng(seed)
    headers = [
        i for mark in (b"\x93NUMPY", b"PK\x01\x02", b"{") for i in range(len(content)) if content[i:].startswith(mark)
    ] or [0]
    for number in range(copies):
        copied = bytearray(content)
        near = int(random.choice(headers)) if number % 4 else int(random.integers(len(content)))
        place = min(near + int(random.integers(128)), len(content) - 1)
        if number % 8 == 0:
            del copied[place:]
        elif number % 8 == 1:
            copied[place:place] = copied[: int(random.integers(1, 200))]
        else:
            for offset in random.integers(0, 40, random.integers(1, 6)):
                copied[min(place + int(offset), len(copied) - 1)] = int(random.integers(256))
        yield bytes(copied)


@pytest.mark.parametrize("name", ["provenance.json", "frames.json", "mesh.npz", "reference.npz"])
def test_a_mutated_file_is_read_or_told(copy: Path, name: str) -> None:
    content, whole, told = (copy / name).read_bytes(), _read_all(copy), []
    for mutated in _mutations(content, seed=len(name)):
        (copy / name).write_bytes(mutated)
        try:
            np.testing.assert_equal(_read_all(copy), whole)
        except RgbmidicError as error:
            told.append(str(error))
    assert len(told) > COPIES / 3
    assert all(str(copy) in message for message in told)


def test_mutated_frames_are_read_told_or_not_there(copy: Path) -> None:
    """Also quantity by quantity, and opened as a run that goes on: never anything else than what was written."""
    file, whole = copy / "solution" / "000001.npz", Result.open(copy)
    content, kept = file.read_bytes(), [whole.frame(index).values for index in range(2)]
    told, run = list[str](), fingerprint(whole.provenance)
    for mutated in _mutations(content, 6, RECORD_COPIES):
        file.write_bytes(mutated)
        table = FrameTable.load(copy, whole.table.sizes, 2, run)
        try:
            for index in range(2):
                values = table.read(index, ["u", "status", "reason"])
                np.testing.assert_equal(values, {name: kept[index][name] for name in values})
                np.testing.assert_equal(table.read(index), dict(kept[index]))
        except RgbmidicError as error:
            told.append(str(error))
    assert all("000001.npz is damaged in frame 1: " in message for message in told)
    assert len(told) > RECORD_COPIES / 2


def test_results_damaged_at_random_are_right_or_told(tmp_path: Path) -> None:
    """Bits, digits of the provenance, pieces lost, doubled or cut off, files swapped with another run's or gone."""
    ends = damage_results(tmp_path, 40, seed=4)
    assert sum(ends.values()) == 40
    assert sum(times for (_, end), times in ends.items() if end == "right") < 20
    assert any(end == "told, the rest read, healed by --resume" for _, end in ends)


@pytest.mark.parametrize("name", ["solution/000001.npz", "reference.npz", "mesh.npz", "provenance.json"])
def test_a_file_of_another_run_is_refused_by_name(tmp_path: Path, name: str) -> None:
    """The same mesh, frames and lights, another tolerance of the solver: its numbers are not this run's."""
    mine, other = write_result(tmp_path / "mine"), write_result(tmp_path / "other", tolerance=2e-3, seed=1)
    if name == "mesh.npz":
        np.savez(other / name, nodes=Result.open(other).nodes + 1e-9, elements=Result.open(other).elements)
    shutil.copy(other / name, mine / name)
    shown = "000000.npz is of another run" if name == "provenance.json" else f"{name} is .*another"
    with pytest.raises(ResultError, match=shown):
        _ = Result.open(mine, partial=True).reference


def test_a_damaged_record_loses_its_frame_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A bit in an array of one, a bit in the directory of another; the rest is as it was written."""
    whole = Result.open(write_result(tmp_path / "out"))
    expected = whole.u
    corrupt(whole, 2)
    file = whole.path / "solution" / "000001.npz"
    content = bytearray(file.read_bytes())
    content[-100] ^= 1
    file.write_bytes(content)
    with pytest.raises(
        ResultError, match=r"000001\.npz is damaged in frame 1: its directory .*--resume.*`partial=True`"
    ):
        _ = Result.open(whole.path).u
    with pytest.raises(ResultError, match=r"000002\.npz is damaged in frame 2: the checksum of u is wrong"):
        Result.open(whole.path).frame(2)
    rest = Result.open(whole.path, partial=True)
    assert rest.finished.tolist() == [True, False, False, True, True, True]
    assert rest.reasons[1:3] == ("damaged", "damaged")
    assert "frames lost: 1 (frame 1), 2 (frame 2)" in caplog.text
    assert np.isnan(rest.u[1:3]).all()
    np.testing.assert_array_equal(rest.u[[0, 3, 4, 5]], expected[[0, 3, 4, 5]])
    assert rest.refresh().finished.tolist() == rest.finished.tolist()
    with pytest.raises(ResultError, match=r"of 6 frames are lost 1 \(frame 1\), 2 \(frame 2\); .*--resume.*partial"):
        finish_result(whole.path)


def test_a_record_of_the_former_writer_is_read(copy: Path) -> None:
    """It stated neither a system nor the rights of a file, which `zipfile` does."""
    file, expected = copy / "solution" / "000001.npz", Result.open(copy).frame(1).values
    content = bytearray(file.read_bytes())
    places = [i for i in range(len(content)) if content.startswith(b"PK\x01\x02", i)]
    for i in places:
        content[i + 4 : i + 6], content[i + 38 : i + 42] = b"\x14\0", bytes(4)
    content[-4:] = zlib.crc32(content[places[0] : -4]).to_bytes(4, "little")
    assert content != file.read_bytes()
    file.write_bytes(content)
    np.testing.assert_equal(dict(Result.open(copy).frame(1).values), dict(expected))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_a_pipe_in_the_place_of_a_record_is_not_waited_for(copy: Path) -> None:
    (copy / "solution" / "000001.npz").unlink()
    os.mkfifo(copy / "solution" / "000001.npz")
    with pytest.raises(ResultError, match=r"000001\.npz cannot be read: it is not a regular file but a pipe"):
        Result.open(copy).frame(1)
    assert Result.open(copy, partial=True).reasons[1] == "damaged"


@pytest.mark.parametrize("size", [0, 7, 2**31, 2**32 - 1])
@pytest.mark.parametrize(
    ("part", "name"), [("shape", "weights_thumbnail"), *product(["shape", "length"], ["history", "inputs", "rigid"])]
)
def test_a_forged_record_is_told(copy: Path, part: str, name: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes that no record has, their checksums right: no memory is taken for what is not there."""
    result, record = Result.open(copy), random_record(2)

    def forged(values: Any) -> bytes:
        content = npy_bytes(values)
        if values is not record.values[name] or part == "length":
            return content
        about = {"descr": values.dtype.str, "fortran_order": False, "shape": (size, *values.shape[1:], 3)}
        file = io.BytesIO()
        np.lib.format.write_array_header_1_0(file, about)
        return file.getvalue() + values.tobytes()

    monkeypatch.setattr(records, "npy_bytes", forged)
    records.write_record(copy / "solution", 0, record, result.table.run, lambda: None)
    if part == "length":
        file = copy / "solution" / "000000.npz"
        content = bytearray(file.read_bytes())
        place = content.rindex(f"{name}.npy".encode()) - 26
        content[place : place + 4] = size.to_bytes(4, "little")
        content[-4:] = zlib.crc32(content[content.index(b"PK\x01\x02") : -4]).to_bytes(4, "little")
        file.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ResultError, match="damaged in frame 0"):
            result.frame(0)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def _forged(copy: Path, header: bytes, *, entry: str = "nodes") -> Path:
    """The mesh with another header of one array, its checksum right."""
    with zipfile.ZipFile(copy / "mesh.npz") as archive:
        arrays = {name: archive.read(name) for name in archive.namelist()}
    arrays[f"{entry}.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(copy / "mesh.npz", "w") as archive:
        for name, content in arrays.items():
            archive.writestr(name, content)
    return copy


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 2), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -2), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + 900 * b"(" + b"), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (0, 2), }",
        b"{'descr': '<f8\n', \x00",
        b"{",
    ],
)
def test_a_forged_header_is_told(copy: Path, header: bytes) -> None:
    with pytest.raises(ResultError, match=r"mesh\.npz is damaged"):
        Result.open(_forged(copy, header))


def test_a_packed_file_is_refused_before_it_is_unpacked(copy: Path) -> None:
    """Stored arrays take in memory what they take on disk; 100 MB of zeros packed into 0.1 MB do not."""
    np.savez_compressed(copy / "mesh.npz", nodes=np.zeros((6_000_000, 2)), elements=np.zeros((1, 3)))
    assert (copy / "mesh.npz").stat().st_size < 200_000
    tracemalloc.start()
    try:
        with pytest.raises(ResultError, match=r"mesh\.npz is damaged: nodes is compressed"):
            Result.open(copy)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("text", [100_000 * "[", '{"a":' * 100_000, "\x00", '{"schema": "rgbmidic-result"'])
def test_json_that_cannot_be_read_is_told(copy: Path, text: str) -> None:
    (copy / "provenance.json").write_text(text)
    with pytest.raises(ResultError, match=r"provenance\.json is damaged"):
        Result.open(copy)


@pytest.mark.parametrize("to", EXPORT_FORMATS)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_export_to_a_full_disk_is_told(result: Result, tmp_path: Path, to: str) -> None:
    part = f"fields.{socket.gethostname()}.{threading.get_ident()}.{os.getpid()}.part"
    (tmp_path / part).symlink_to("/dev/full")
    with pytest.raises(ResultError, match=r"fields cannot be written: No space left"):
        export_result(result, to, tmp_path / "fields")
    assert not list(tmp_path.iterdir())


def test_export_to_a_read_only_place_is_told(result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    for name in ("open", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(ResultError, match=r"fields cannot be written: Read-only"):
        export_result(result, "npz", tmp_path / "fields")


def test_export_where_nobody_may_look_is_told(result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "stat", refuse)
    with pytest.raises(ResultError, match=r"fields cannot be written: Permission denied"):
        export_result(result, "npz", tmp_path / "fields")


@pytest.mark.skipif(os.name == "nt", reason="a process cannot be asked for")
def test_what_a_killed_process_left_of_a_file_goes_when_the_file_is_written_again(tmp_path: Path) -> None:
    killed = subprocess.Popen([sys.executable, "-c", "pass"])
    killed.wait()
    host = socket.gethostname()
    parts = {f"{name}.part": tmp_path / f"{name}.part" for name in (
        f"a[1].mp4.{host}.{killed.pid}", f"a[1].mp4.{host}.{os.getpid()}", f"a[1].mp4.elsewhere.{killed.pid}",
        f"b.mp4.{host}.{killed.pid}", f"a[1].mp4.{host}.x",
    )}  # fmt: skip
    for part in parts.values():
        part.touch()
    check_file(tmp_path / "a[1].mp4", overwrite=False)
    assert [name for name, part in parts.items() if not part.exists()] == [f"a[1].mp4.{host}.{killed.pid}.part"]
