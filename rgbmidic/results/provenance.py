"""Provenance of a result: what all its frames share, kept so that a later run can check that it is the same."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import machine
from rgbmidic._version import __version__
from rgbmidic.disk import read_json
from rgbmidic.errors import AnotherTestError, ResultError
from rgbmidic.extensions import RESULTS
from rgbmidic.fields import CameraCalibration
from rgbmidic.frames import file_hash
from rgbmidic.mesh import MeshLabels
from rgbmidic.results.quantities import MESH_DOCUMENT, MESH_LABELS, SHARED
from rgbmidic.settings import TestSettings
from rgbmidic.typing import AnyArray

SCHEMA_NAME = "rgbmidic-result"
SCHEMA_VERSION = 13
"""Goes up with every change of the quantities or files: a result of another version is refused, not guessed at."""

PROVENANCE = "provenance.json"
RESTORE_REMEDY = "put back the file that was there, or delete it and go on with `resume=True`"
"""What to do about a file of another run."""
_SEAL = "sha256"
_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "rawpy", "tifffile", "h5py")
_NUMERICAL_PACKAGES = ("rgbmidic", *_PACKAGES[:4])
"""Packages whose version decides on the bits of any result; the others read formats of frames."""
READING_SECTIONS = ("scale", "probes", "setup", "channels")
"""Sections of the settings that state how a result is read, and not what is measured."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Origin:
    """Mesh, names, settings and inputs that all frames of a result share.

    Attributes
    ----------
    nodes, elements
        The mesh: (N, 2) positions in px and (E, 3) node indices.
    readers
        Names of the packages, beside those that every result needs, by which the frames are read.
    labels
        Numbers of its nodes and elements and positions in mm, where it is of a source that has them; None: it is not.
    names, lights
        Name of each frame and of each light.
    settings
        Kept in the provenance, with the hash of the calibration file that they name.
    inputs
        A text for each input by its name, such as a file's fingerprint: when it differs, so does the input.
    references
        Positions of the reference frames among the result's frames; may be empty.
    reference : array, shape (k, H, W), optional
        Reference image of each light, NaN where unknown; kept in 8 bit, for figures.
    notes
        Further plain values to keep in the provenance, such as ``frame_rate`` and ``exposure_ns``.

    Examples
    --------
    >>> origin = Origin(nodes=[[0, 0], [9, 0], [0, 9]], elements=[[0, 1, 2]], names=["a.png"], lights=["red"])
    >>> origin.references
    (0,)
    """

    nodes: npt.ArrayLike
    elements: npt.ArrayLike
    names: Sequence[str]
    lights: Sequence[str]
    settings: TestSettings | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)
    readers: Sequence[str] = ()
    labels: MeshLabels | None = None
    references: Sequence[int] = (0,)
    reference: npt.ArrayLike | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def mesh(self) -> dict[str, AnyArray]:
        """`nodes` and `elements`, and their labels, in the types of the table."""
        arrays: dict[str, npt.ArrayLike] = {"nodes": self.nodes, "elements": self.elements}
        if self.labels is not None:
            arrays |= {name: getattr(self.labels, name) for name in MESH_LABELS}
        return {name: SHARED[name].convert(array, {}) for name, array in arrays.items()}

    def provenance(self) -> dict[str, Any]:
        """Return the content of ``provenance.json`` at the start of a run, in plain values.

        Returns
        -------
        dict
        """
        document: dict[str, Any] = {"schema": SCHEMA_NAME, "schema_version": SCHEMA_VERSION, "created": current_time()}
        versions = {"rgbmidic": __version__, "python": platform.python_version()}
        for name in _PACKAGES:
            with suppress(importlib.metadata.PackageNotFoundError):
                versions[name] = importlib.metadata.version(name)
        document |= {"versions": versions, "readers": list(self.readers)}
        document |= {"platform": platform.platform(), "machine": machine()}
        if self.settings is not None:
            document |= {"settings": self.settings.to_mapping(), "base": str(self.settings.base)}
            if (file := self.settings.calibration.file) is not None:
                document["calibration"] = {"file": str(file), "sha256": file_hash(file)}
            if (file := self.settings.scale.camera) is not None:
                document["camera"] = CameraCalibration.read(file).to_document()
        if self.labels is not None:
            document[MESH_DOCUMENT] = dict(self.labels.document)
        document |= {**self.notes, "lights": list(self.lights), "references": list(self.references)}
        document["frames"] = {"count": len(self.names), "sha256": digest(list(self.names))}
        document |= {"mesh": digest(self.mesh), "inputs": dict(self.inputs)}
        return dict(json.loads(json.dumps(document)))


def digest(content: Mapping[str, AnyArray] | list[str]) -> str:
    """Return the SHA-256 of arrays or of texts in hexadecimal digits."""
    if isinstance(content, list):
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()
    sums = hashlib.sha256()
    for name, array in content.items():
        sums.update(f"{name} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return sums.hexdigest()


def check_same(path: Path, stored: Mapping[str, Any], current: Mapping[str, Any]) -> None:
    """Refuse to go on with a result whose provenance `stored` when frames to come would have the provenance `current`.

    Raises
    ------
    AnotherTestError
        Settings, calibration, inputs, frames, mesh, lights, references, or a version differ; the message says which.
    """
    stored_entries, current_entries = dict(_compared_entries(stored)), dict(_compared_entries(current))
    entry_pairs = {
        name: (stored_entries.get(name), current_entries.get(name)) for name in {**stored_entries, **current_entries}
    }
    # 25 and 25.0 are one number; 1 is a frame, true is not
    names = [
        name
        for name, (stored_value, current_value) in entry_pairs.items()
        if stored_value != current_value or isinstance(stored_value, bool) != isinstance(current_value, bool)
    ]
    if names:
        phrases = ["{} was {}, now {}".format(name, *map(_short, entry_pairs[name])) for name in names[:3]]
        differences, remainder = "; ".join(phrases), f"; and {len(names) - 3} more" if len(names) > 3 else ""
        raise AnotherTestError(
            f"{path} is of another test and is not gone on with: {differences}{remainder}; give another folder"
        )


def _compared_entries(document: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield what decides on the bits of a result, each under a name for messages."""
    for section, keys in document.get("settings", {}).items():
        if section not in READING_SECTIONS:
            yield from ((f"{section}.{key}", value) for key, value in keys.items())
    yield "the calibration", document.get("calibration", {}).get("sha256")
    yield from ((f"the input {name}", text) for name, text in document["inputs"].items())
    yield "the mesh", document["mesh"]
    yield "the mesh's file", document.get(MESH_DOCUMENT, {}).get("sha256")
    yield "the number of frames", document["frames"]["count"]
    yield "the list of frames", document["frames"]["sha256"]
    yield from ((name, document[name]) for name in ("lights", "references"))
    for name in (*_NUMERICAL_PACKAGES, *document["readers"]):
        yield f"the version of {name}", document["versions"].get(name)


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:56]} ..."


def fingerprint(document: Mapping[str, Any]) -> bytes:
    """Return the digest (16 bytes) of what `check_same` compares: every record of a run has it in its header."""
    return hashlib.sha256(_canonical(dict(_compared_entries(document)))).digest()[:16]


def with_checksum(document: Mapping[str, Any]) -> dict[str, Any]:
    """Add the checksum of the content to a provenance, as it is written."""
    return {**document, _SEAL: hashlib.sha256(_canonical(document)).hexdigest()}


def _canonical(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, sort_keys=True).encode()


def find_marker(path: Path) -> Path | None:
    """Return the file that marks a folder as that of a result, of a run or of a tool; None where there is none."""
    return next((path / name for name in (PROVENANCE, *RESULTS) if (path / name).exists()), None)


def is_result(path: Path) -> bool:
    """Report whether a folder has the provenance of a result, of whatever version and state.

    Raises
    ------
    ResultError
        It has a foreign file of that name, or one that is no JSON.
    """
    try:
        _document(path)
    except FileNotFoundError:
        return False
    return True


def _document(path: Path) -> dict[str, Any]:
    document = read_json(path / PROVENANCE)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA_NAME:
        raise ResultError(f'{path / PROVENANCE} does not belong to a result: its "schema" is not "{SCHEMA_NAME}"')
    return document


def read_provenance(path: Path) -> dict[str, Any]:
    """Read the provenance of the result in a folder: lights, settings, fingerprints, versions, dates.

    Raises
    ------
    ResultError
        The folder is no result, has another schema version, or the file was changed.
    """
    try:
        document = _document(path)
    except FileNotFoundError:
        within = [f"{file.parent}" for file in sorted(path.glob(f"*/{PROVENANCE}"))[:3]]
        hint = f"; results lie in it: {', '.join(within)}" if within else ""
        raise ResultError(f"{path} is not a result folder: it has no {PROVENANCE}{hint}") from None
    if (version := document.get("schema_version")) != SCHEMA_VERSION:
        versions = document.get("versions")
        writer = versions.get("rgbmidic", "?") if isinstance(versions, dict) else "?"
        raise ResultError(
            f"{path} has schema version {version!r}, written by rgbmidic {writer}; this rgbmidic {__version__} reads "
            f"schema version {SCHEMA_VERSION}: read it with the version that wrote it, or measure the test again"
        )
    seal = document.pop(_SEAL, None)
    if with_checksum(document)[_SEAL] != seal:
        raise ResultError(
            f"{path / PROVENANCE} was changed after it was written: put it back as it was. Another [scale], [setup] or "
            "other [probes] or [channels] are stated in TEST.toml: `rgbmidic run TEST.toml --out DIR --resume` keeps "
            "them, `rgbmidic report --test TEST.toml` reads with them (history and export too)"
        )
    return document


def current_time() -> str:
    """Return the present date and time."""
    return datetime.now(UTC).isoformat(timespec="seconds")
