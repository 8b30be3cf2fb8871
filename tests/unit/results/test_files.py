"""Damaged, hostile and unwritable files: one error of ours, no more memory than the file's size."""

from __future__ import annotations

import errno
import os
import shutil
import tracemalloc
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from results import make_result

from rgbmidic.errors import ResultError, RgbmidicError
from rgbmidic.results import EXPORT_FORMATS, Result, export_result
from rgbmidic.typing import AnyArray

COPIES = 120
"""Mutated copies of each file of a result."""


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    reference = np.random.default_rng(0).normal(1000, 100, (3, 40, 60))
    return make_result(tmp_path_factory.mktemp("files") / "out", frames=1, reference=reference)


@pytest.fixture
def copy(result: Result, tmp_path: Path) -> Path:
    return Path(shutil.copytree(result.path, tmp_path / "copy"))


def _read_all(path: Path) -> tuple[AnyArray, ...]:
    result = Result.open(path)
    assert result.deformed == ()
    return result.nodes, result.elements, result.reference, *result.frame(0).values.values()


def _mutations(content: bytes, seed: int) -> Iterator[bytes]:
    """Copies with bytes changed, most of them in headers, cut short, or with a piece lost or doubled."""
    random = np.random.default_rng(seed)
    headers = [
        i for mark in (b"\x93NUMPY", b"PK\x01\x02", b"{") for i in range(len(content)) if content[i:].startswith(mark)
    ]
    for number in range(COPIES):
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


@pytest.mark.parametrize("name", ["provenance.json", "mesh.npz", "reference.npz", "solution/frame_000000.npz"])
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
    (tmp_path / f"fields.{os.getpid()}.part").symlink_to("/dev/full")
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
