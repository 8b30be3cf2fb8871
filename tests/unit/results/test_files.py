"""Damaged, hostile and unwritable files: one error of ours, no more memory than the file's size."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from damage import damage_results, write_result
from results import make_result

from rgbmidic.errors import ResultError, RgbmidicError
from rgbmidic.results import EXPORT_FORMATS, Result, export_result
from rgbmidic.results.files import check_file, fingerprint
from rgbmidic.results.store import load_frames
from rgbmidic.typing import AnyArray

COPIES = 120
"""Mutated copies of each small file of a result."""
SHARD_COPIES = 1000
"""Mutated copies of each file that holds frames."""


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
    file, whole = copy / "solution" / "000000.frames", Result.open(copy)
    content, records = file.read_bytes(), [whole.frame(index).values for index in range(2)]
    told, absent, run = list[str](), 0, fingerprint(whole.provenance)
    for mutated in _mutations(content, 6, SHARD_COPIES):
        file.write_bytes(mutated)
        try:
            table = load_frames(copy, whole.table.layout.sizes, 2, run)
            there = np.flatnonzero(table.finished)
            absent += 2 - len(there)
            for index, values in zip(there, table.each(["u", "status", "reason"], there), strict=True):
                np.testing.assert_equal(values, {name: records[index][name] for name in values})
                np.testing.assert_equal(dict(table.read(index).values), dict(records[index]))
        except RgbmidicError as error:
            told.append(str(error))
    assert all("000000." in message for message in told)
    assert len(told) + absent > SHARD_COPIES / 2


def test_results_damaged_at_random_are_right_or_told(tmp_path: Path) -> None:
    """Bits, digits of the provenance, pieces lost, doubled or cut off, files swapped with another run's or gone."""
    ends = damage_results(tmp_path, 40, seed=4)
    assert sum(ends.values()) == 40
    assert sum(times for (_, end), times in ends.items() if end == "right") < 20
    assert any(end == "told, the rest read, healed by --resume" for _, end in ends)


@pytest.mark.parametrize("name", ["solution/000001.frames", "reference.npz", "mesh.npz", "provenance.json"])
def test_a_file_of_another_run_is_refused_by_name(tmp_path: Path, name: str) -> None:
    """The same mesh, frames and lights, another tolerance of the solver: its numbers are not this run's."""
    mine, other = write_result(tmp_path / "mine"), write_result(tmp_path / "other", tolerance=2e-3, seed=1)
    if name == "mesh.npz":
        np.savez(other / name, nodes=Result.open(other).nodes + 1e-9, elements=Result.open(other).elements)
    shutil.copy(other / name, mine / name)
    shown = "000000.frames is of another run" if name == "provenance.json" else f"{name} is .*another"
    with pytest.raises(ResultError, match=shown):
        _ = Result.open(mine, partial=True).reference


def test_a_damaged_header_or_record_loses_its_frame_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Records of one file of four frames: a bit in a header, a bit in a record; the rest is as it was written."""
    whole = Result.open(write_result(tmp_path / "out"))
    file, table = whole.path / "solution" / "000000.frames", whole.table
    content = bytearray(file.read_bytes())
    content[int(table.places["start"][1]) - 3] ^= 1
    content[int(table.places["start"][2] + table.places["length"][2]) - 1] ^= 128
    file.write_bytes(content)
    with pytest.raises(
        ResultError, match=r"\(000000\.frames\): of 6 frames are lost 1 \(frame 1\); .*--resume.*partial"
    ):
        Result.open(whole.path)
    rest = Result.open(whole.path, partial=True)
    assert rest.finished.tolist() == [True, False, False, True, True, True]
    assert rest.reasons[1:3] == ("damaged", "damaged")
    assert "frames lost: 1 (frame 1), 2 (frame 2); " in caplog.text
    assert np.isnan(rest.u[1:3]).all()
    np.testing.assert_array_equal(rest.u[[0, 3, 4, 5]], whole.u[[0, 3, 4, 5]])
    assert rest.refresh().finished.tolist() == rest.finished.tolist()
    content[int(table.places["start"][1]) - 3] ^= 1  # then only the record is damaged, which shows when it is read
    file.write_bytes(content)
    with pytest.raises(ResultError, match=r"000000\.frames is damaged in frame 2: .*--resume"):
        list(Result.open(whole.path).each("reflection_thumbnail"))


@pytest.mark.parametrize("size", [0, 7, 2**31, 2**32 - 1])
@pytest.mark.parametrize("name", ["history", "inputs", "rigid", "weights_thumbnail"])
def test_a_forged_head_is_told(copy: Path, name: str, size: int) -> None:
    """Sizes that no record has, their checksums right: no memory is taken for what is not there."""
    table = Result.open(copy).table
    file = table.files[0]
    content, first = bytearray(file.read_bytes()), int(table.places["start"][0])
    shape = table.layout.places[name].shape
    assert isinstance(shape, slice)
    for number in range(shape.start, shape.stop):
        content[first + 4 * number : first + 4 * number + 4] = size.to_bytes(4, "little")
    file.write_bytes(content)
    table.places["head"][0] = zlib.crc32(content[first : first + table.layout.head])
    tracemalloc.start()
    try:
        with pytest.raises(ResultError, match="damaged in frame 0"):
            table.read(0)
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


@pytest.mark.parametrize("to", [to for to in EXPORT_FORMATS if to != "crackpy"])
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_export_to_a_full_disk_is_told(result: Result, tmp_path: Path, to: str) -> None:
    (tmp_path / f"fields.{socket.gethostname()}.{os.getpid()}.part").symlink_to("/dev/full")
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
