"""Real files to try the program on: fetched from where their makers publish them, checked by SHA-256, and kept.

Nothing of them is part of this package. A sample's folder has the files as they were published and, where they are a
test, a test.toml beside them.
"""

from __future__ import annotations

import os
import shutil
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from urllib.parse import quote

from rgbmidic.errors import InputError, import_optional
from rgbmidic.results.files import write_errors

ADDRESS = "https://raw.githubusercontent.com"
"""Address at which GitHub gives a file of a repository at a commit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleFile:
    """A published file.

    Attributes
    ----------
    path
        Place in the repository.
    bytes
        Its size.
    sha256
        Its SHA-256, in hexadecimal digits.
    """

    path: str
    bytes: int
    sha256: str

    @property
    def name(self) -> str:
        """Name without the folders."""
        return self.path.rpartition("/")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Files of one source, and the test that they are.

    Attributes
    ----------
    name
        What `rgbmidic sample` calls it.
    shows
        What there is to see.
    licence
        SPDX identifier of the source's licence.
    repository, commit
        GitHub repository and its commit.
    files
        What is fetched.
    settings
        Text of test.toml; empty where the files are no test.
    command
        What to try in its folder.
    """

    name: str
    shows: str
    licence: str
    repository: str
    commit: str
    files: tuple[SampleFile, ...]
    settings: str = ""
    command: str = "rgbmidic run test.toml --out result"

    @property
    def source(self) -> str:
        """Repository of the sample on GitHub."""
        return f"github.com/{self.repository}"

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(file.bytes for file in self.files)


def cache_folder() -> Path:
    """Return the folder in which fetched files are kept: RGBMIDIC_SAMPLES, else the user's cache folder.

    Raises
    ------
    InputError
        pooch (extra ``sample``) is not installed.
    """
    folder = os.environ.get("RGBMIDIC_SAMPLES")
    return Path(folder) if folder else Path(import_optional("pooch", "sample").os_cache("rgbmidic"))


def write_sample(name: str, folder: Path, report: Callable[[str], None] = lambda _: None) -> Sample:
    """Fetch a sample, or take it from the cache, and write its files and test.toml into a new folder.

    Parameters
    ----------
    name
        One of `SAMPLES`.
    folder
        Must be empty or not exist.
    report
        Called with a line about each file that has to be fetched.

    Returns
    -------
    Sample
        What was written.

    Raises
    ------
    InputError
        There is no such sample, the folder is taken, a file cannot be fetched or is not what was published, or pooch
        is not installed; nothing is written then.
    """
    if name not in SAMPLES:
        raise InputError(f"there is no sample {name!r}; there are {', '.join(SAMPLES)}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is already there; state another folder: rgbmidic sample {name} FOLDER")
    sample = SAMPLES[name]
    cached = [_fetch(sample, file, report) for file in sample.files]
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for file in cached:
            shutil.copyfile(file, folder / file.name)
        if sample.settings:
            heading = f"# {sample.shows}\n# {sample.licence}, {sample.source} at commit {sample.commit}\n"
            (folder / "test.toml").write_text(heading + sample.settings, encoding="utf-8")
    return sample


def _fetch(sample: Sample, file: SampleFile, report: Callable[[str], None]) -> Path:
    """Return the file in the cache, fetched where it is not there or not what was published."""
    pooch = import_optional("pooch", "sample")
    url = f"{ADDRESS}/{sample.repository}/{sample.commit}/{quote(file.path)}"
    cache_path = cache_folder() / sample.name
    if not (cache_path / file.name).is_file():
        report(f"{file.name} ({file.bytes / 1e6:.1f} MB) from {url}")
    pooch.get_logger().disabled = True
    try:
        local_path = pooch.retrieve(url, f"sha256:{file.sha256}", fname=file.name, path=cache_path)
    except ValueError as error:  # pooch's answer to another hash; it keeps nothing of the file
        if "hash" not in str(error):
            raise
        raise InputError(
            f"{url} is not the file that was published: its SHA-256 is not {file.sha256}; nothing of it is kept"
        ) from None
    except OSError as error:  # requests' errors are such
        response = getattr(error, "response", None)
        reason = f"the answer is {response.status_code}" if response is not None else error.strerror or "no connection"
        raise InputError(
            f"{file.name} of sample {sample.name} cannot be fetched: {reason} ({url}); "
            f"a file that was fetched by other means belongs into {cache_path}"
        ) from None
    return Path(local_path)


def _read_samples() -> Iterator[tuple[str, Sample]]:
    text = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for name, entry in tomllib.loads(text).items():
        files = tuple(SampleFile(**file) for file in entry.pop("files"))
        yield name, Sample(name=name, files=files, **entry)


SAMPLES: Mapping[str, Sample] = MappingProxyType(dict(_read_samples()))
"""All samples by name (samples.toml); sizes and hashes are those of the files at the commits."""
